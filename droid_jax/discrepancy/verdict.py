"""The result of a search for missing effects: the conclusion and its grounds."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.discrepancy.candidates import ScoreTest, Trend, trend
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.discrepancy.maps import Localisation, localise
from droid_jax.discrepancy.posterior import remaining_discrepancy, remaining_residuals
from droid_jax.discrepancy.selection import Reason, SelectionStep, ValidationTest, doubts
from droid_jax.discrepancy.step_error import beyond_step_error, more_than_step_error
from droid_jax.files import LOST
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import EffectKey, Keys, names_of

Alternatives = tuple[Keys, ...]  # each may be several effects together


class Conclusion(enum.Enum):
    """Possible conclusions."""

    NONE = "none"  # these recordings show no missing effect
    NAMED = "named"  # the named effects are missing
    INDISTINGUISHABLE = "indistinguishable"  # one of several effects; experiments that distinguish them are proposed
    PARTLY = "partly explained"  # the named effects, and a remainder that nothing in the library explains
    UNEXPLAINED = "unexplained"  # something is missing that is not in the library
    UNCONVERGED = "fit not converged"  # of the base model or of the model with effects: no conclusion


@dataclass(frozen=True)
class Experiment:
    """An experiment that would distinguish indistinguishable models.

    what: description.
    distance: standardised difference of the models' simulated channels; ten repeats decide above about 6.  None if the
        simulation failed.
    not_made: reason of the failure.
    """

    what: str
    distance: float | None
    not_made: str = ""


@dataclass(frozen=True)
class Hint:
    """Effects that passed their tests but explain too little to be named: they may imitate what is missing.

    effects, indistinguishable: as in a verdict.
    closed: held-out role, "validation" or "test" -> share of U beyond the discretisation error that they explain.
    """

    effects: Keys
    indistinguishable: tuple[Alternatives, ...]
    closed: dict[str, float]

    def __str__(self) -> str:
        """Text with the smallest share on a held-out recording, e.g. "a or b (closes 31 %)"."""
        each = [_or(e, others) for e, others in zip(self.effects, self.indistinguishable, strict=True)]
        return f"{' and '.join(each)} (closes {max(min(self.closed.values()), 0.0):.0%})"


@dataclass(frozen=True, eq=False)
class Verdict:
    """The conclusion of a search and its grounds.

    conclusion: see `Conclusion`.
    effects: effects in the model.
    indistinguishable: for each of them the alternatives that are indistinguishable from it.
    base, model: the base model, and the model with the effects.
    discretisation_error: U0.
    discrepancies: "train", "validation", "test" -> (U of the base model, U of the model).
    before, after: U of both models by cell of the training recording.
    config: the thresholds.
    remainder: U on the validation recording that neither `model` nor the uncertainty of its fit explains
        (`posterior.remaining_residuals`); None if a fit did not converge.
    score_tests, validation_tests: all tests, in the order in which they were made.
    failed: names of models whose replay blew up at the start of their refit, on the validation recording, or on the
        test recording, which then is not in `discrepancies`.
    indistinguishable_models: groups of refitted models that are indistinguishable from each other, one for each step
        whose choice is open, the chosen one first.  Those of an earlier step lack the effects of later ones.
    experiments: experiments that would distinguish them, the best first.
    ruled_out: names of models that were not refitted, since after one step they were too far from the best ones.
    not_tried: fits that were skipped for lack of time, in words.
    trend: the strongest trend over the repeats; None for logs, or if there was no score test.
    hints: effects that explain too little to be named (`unnamed`); the model does not have them.
    doubts: doubts about the effects in the model (`selection.doubts`).
    """

    conclusion: Conclusion
    effects: Keys
    indistinguishable: tuple[Alternatives, ...]
    base: FittedModel
    model: FittedModel
    discretisation_error: float
    discrepancies: dict[str, tuple[float, float]]
    score_tests: tuple[ScoreTest, ...]
    validation_tests: tuple[ValidationTest, ...]
    before: Localisation
    after: Localisation
    config: SelectionConfig
    remainder: float | None = None
    failed: tuple[str, ...] = ()
    indistinguishable_models: tuple[tuple[FittedModel, ...], ...] = ()
    experiments: tuple[Experiment, ...] = ()
    ruled_out: tuple[str, ...] = ()
    not_tried: tuple[str, ...] = ()
    trend: Trend | None = None
    hints: tuple[Hint, ...] = ()
    doubts: tuple[str, ...] = ()

    def closed(self, role: str) -> float:
        """Share of U beyond U0 that the model explains on a role: 1 - (U_after - U0) / (U_before - U0)."""
        before, after = self.discrepancies[role]
        return 1.0 - open_share(after, before, self.discretisation_error)

    def closed_held_out(self) -> dict[str, float]:
        """Held-out role -> `closed`, for roles with a discrepancy beyond the discretisation error."""
        held_out = {role: before for role, (before, _) in self.discrepancies.items() if role != "train"}
        return {
            role: self.closed(role)
            for role, before in held_out.items()
            if beyond_step_error(before, self.discretisation_error)
        }

    @property
    def explained(self) -> float:
        """Share of U on the validation recording that the model, or the uncertainty of its fit, explains."""
        before, after = self.discrepancies["validation"]
        remaining = after if self.remainder is None else self.remainder
        return 1.0 - open_share(remaining, before, self.discretisation_error)

    @property
    def sentence(self) -> str:
        """The conclusion and its doubts in words."""
        return "".join([self._answer, *(f" But {doubt}." for doubt in self.doubts)])

    @property
    def _answer(self) -> str:
        lacking = f"The model lacks {_lacking(self.effects, self.indistinguishable)}"
        if self.conclusion is Conclusion.NONE:
            return "Nothing is missing that these recordings could show."
        if self.conclusion is Conclusion.NAMED:
            return f"The model lacks: {_lacking(self.effects, self.indistinguishable)}."
        if self.conclusion is Conclusion.INDISTINGUISHABLE:
            return f"{lacking}."
        if self.conclusion is Conclusion.PARTLY and self.explained >= self.config.mostly_explained:
            return f"{lacking}; a remainder is unexplained."
        if self.conclusion is Conclusion.PARTLY:
            return (
                "Most of what the model lacks is not in the library; what there is explains or imitates "
                f"{max(self.explained, 0.0):.0%} of it: {_lacking(self.effects, self.indistinguishable)}."
            )
        if self.conclusion is Conclusion.UNEXPLAINED:
            hints = f" Hints, not names, since they may only imitate it: {'; '.join(map(str, self.hints))}."
            rejected = "".join(f", or {text}" for text in _narrowly_rejected(self.validation_tests))
            left = "; not all of the library was tried" if self.not_tried else " that is not in the library"
            return f"The model lacks something{left}{rejected}.{hints if self.hints else ''}"
        which = "the model with the effects" if self.base.refined.converged else "the base model"
        return f"The fit of {which} did not converge; nothing can be concluded."


def open_share(remaining: float, before: float, discretisation_error: float) -> float:
    """Remaining share of U beyond the discretisation error: (U_remaining - U0) / (U_before - U0)."""
    return (remaining - discretisation_error) / max(before - discretisation_error, 1e-12)


def _or(effect: object, alternatives: Alternatives) -> str:
    return " or ".join((str(effect), *map(names_of, alternatives)))


def _lacking(effects: Keys, indistinguishable: Sequence[Alternatives]) -> str:
    """Effects and their alternatives in words, e.g. "a and b" or "a, and one of: b or c"."""
    both = list(zip(effects, indistinguishable, strict=True))
    certain = " and ".join(str(e) for e, others in both if not others)
    open_ones = [f"one of: {_or(e, others)}" for e, others in both if others]
    return ", and ".join([certain, *open_ones] if certain else open_ones)


def _narrowly_rejected(tests: Sequence[ValidationTest]) -> list[str]:
    """Models, in words, that were rejected for their size, a bound or their significance alone.

    A model that has all effects of another one, and more, is not listed beside it.
    """

    def only(reason: Reason) -> list[ValidationTest]:
        rejected = [t for t in tests if t.reasons and all(r.reason is reason for r in t.reasons)]
        return [t for t in rejected if not any({*other.keys} < {*t.keys} for other in rejected)]

    large = {names_of(t.keys): " and ".join(r.text for r in t.reasons) for t in only(Reason.AT_BOUND)}
    groups = (
        (dict.fromkeys(names_of(t.keys) for t in only(Reason.BELOW_MINIMUM_SIZE)), "below the minimum effect size"),
        ([f"{name} ({beyond})" for name, beyond in large.items()], "larger than its bounds allow"),
        (
            dict.fromkeys(names_of(t.keys) for t in only(Reason.NOT_CONFIRMED)),
            "not confirmed by the validation recording",
        ),
    )
    return [f"{' or '.join(names)}, {why}" for names, why in groups if names]


def conclude(
    case: Case,
    base: FittedModel,
    model: FittedModel,
    steps: Sequence[SelectionStep],
    discretisation_error: float,
    *,
    exhausted: bool = False,
    failed: tuple[str, ...] = (),
    ruled_out: tuple[Keys, ...] = (),
    not_tried: tuple[str, ...] = (),
) -> Verdict:
    """The verdict on a base model and a selected model.  If one of their fits did not converge, nothing is named.

    Args:
        case: the recordings.
        base: the base model.
        model: the selected model; the base model if none was selected.
        steps: steps of the search.
        discretisation_error: U0.
        exhausted: whether the last score test found nothing more.
        failed: names of models whose replay blew up.
        ruled_out: effects of models that one step of the search ruled out (`Notes`).
        not_tried: fits that were skipped for lack of time.
    """
    config = case.config.selection
    converged = base.refined.converged and model.refined.converged
    if not converged:
        model, steps = base, [replace(step, selected=None, chosen=None) for step in steps]
    discrepancies, failed_on_test = _discrepancies(case, base, model)
    missing = bool(steps) and steps[0].score_test.p < config.significance
    missing = missing and more_than_step_error(case, base, steps[0].score_test, discretisation_error)
    alternatives = tuple(_alternatives(part.key, model, steps) for part in model.parts)
    residuals = remaining_residuals(case.train, case.validation, model) if converged else None
    conclusion = Conclusion.UNEXPLAINED if missing else Conclusion.NONE
    if residuals is None:
        conclusion = Conclusion.UNCONVERGED
    elif model.parts:
        conclusion = Conclusion.INDISTINGUISHABLE if any(alternatives) else Conclusion.NAMED
        before = discrepancies["validation"][0]
        if _remains(case, residuals, before, discretisation_error, exhausted):
            conclusion = Conclusion.PARTLY
    first, tests = steps[0].score_test if steps else None, tuple(t for step in steps for t in step.tests)
    repeated = case.train.resampling.repeated
    verdict = Verdict(
        conclusion=conclusion,
        effects=model.keys,
        indistinguishable=alternatives,
        base=base,
        model=model,
        discretisation_error=discretisation_error,
        discrepancies=discrepancies,
        remainder=None if residuals is None else case.validation.resampling.discrepancy(residuals),
        score_tests=tuple(dict.fromkeys(step.score_test for step in steps)),  # pairs are proposed from the first one
        validation_tests=tests,
        before=localise(case.train, base.values, base.residuals, model.values),
        after=localise(case.train, model.values, model.residuals, model.values),
        config=config,
        failed=(*failed, *failed_on_test),
        indistinguishable_models=_indistinguishable_models(model, steps),
        ruled_out=_not_refitted(ruled_out, tests, failed),
        not_tried=not_tried,
        trend=trend(first, base.residuals, case.config.seed) if first is not None and repeated else None,
        doubts=(
            *doubts(case.train, model, case.natural_bounds),
            *worsened(discrepancies, model, discretisation_error, config),
        ),
    )
    return unnamed(case, verdict) if closes_too_little(verdict) else verdict


def _not_refitted(ruled_out: Sequence[Keys], tests: Sequence[ValidationTest], failed: Sequence[str]) -> tuple[str, ...]:
    """Names of models that were ruled out by one step and not refitted later, in this order of effects or another."""
    refitted = {frozenset(test.keys) for test in tests}
    names = dict.fromkeys(names_of(keys) for keys in ruled_out if frozenset(keys) not in refitted)
    return tuple(name for name in names if name not in failed)


def closes_too_little(verdict: Verdict) -> bool:
    """Whether effects with an unexplained remainder explain less than `minimum_closed` on a held-out recording.

    An effect that explains a third of a discrepancy may only imitate what is missing.
    """
    closed = verdict.closed_held_out() if verdict.conclusion is Conclusion.PARTLY else {}
    return bool(closed) and min(closed.values()) < verdict.config.minimum_closed


def unnamed(case: Case, verdict: Verdict) -> Verdict:
    """The verdict with its effects as hints, and the base model as its model."""
    base = verdict.base
    cells = localise(case.train, base.values, base.residuals, base.values)
    return replace(
        verdict,
        conclusion=Conclusion.UNEXPLAINED,
        effects=(),
        indistinguishable=(),
        model=base,
        discrepancies={role: (before, before) for role, (before, _) in verdict.discrepancies.items()},
        remainder=remaining_discrepancy(case.train, case.validation, base),
        before=cells,
        after=cells,
        indistinguishable_models=(),
        doubts=(),
        hints=(Hint(verdict.effects, verdict.indistinguishable, verdict.closed_held_out()),),
    )


def _discrepancies(
    case: Case, base: FittedModel, model: FittedModel
) -> tuple[dict[str, tuple[float, float]], tuple[str, ...]]:
    """Role -> U of both models, and notes.  If a replay of the test recording blows up, that role is left out."""
    discrepancies = {}
    for role, residual_set in case.residual_sets.items():
        try:
            discrepancies[role] = residual_set.discrepancy_at(base.values), residual_set.discrepancy_at(model.values)
        except NotReplayed:
            if role != "test":
                raise
            return discrepancies, (LOST,)
    return discrepancies, ()


def worsened(
    discrepancies: Mapping[str, tuple[float, float]],
    model: FittedModel,
    discretisation_error: float,
    config: SelectionConfig,
) -> tuple[str, ...]:
    """A doubt if the effects increase U on the test recording by more than `SelectionConfig.least_gain`.

    There is none if U with the effects is within the error of the time step.
    """
    before, after = discrepancies.get("test", (0.0, 0.0))
    if not model.parts or after <= (1 + config.least_gain) * max(before, 0.0):
        return ()
    if not beyond_step_error(after, discretisation_error):
        return ()
    return (f"the test recording is matched worse with it, U {before:.3g} before and {after:.3g} after",)


def _remains(case: Case, residuals: np.ndarray, before: float, discretisation_error: float, exhausted: bool) -> bool:
    """Whether the remaining residuals of the validation recording show a large and significant part of its U.

    A score test cannot detect an effect that resembles no candidate; the repeats can.
    """
    rows, config = case.validation.resampling, case.config.selection
    if open_share(rows.discrepancy(residuals), before, discretisation_error) <= config.open_share:
        return False
    everywhere = np.ones((1, residuals.shape[1]), bool)
    return not exhausted or float(rows.cell_p_values(residuals, everywhere)[0]) < config.significance


def _alternatives(part: EffectKey, model: FittedModel, steps: Sequence[SelectionStep]) -> Alternatives:
    """Alternatives to one effect: the effects in its place in models indistinguishable from the one that was selected.

    They are those of the last step that selected the effect.  An alternative that replaces several effects of the model
    is listed for each of them.
    """
    present, done = set(model.keys), _selecting(part, steps)
    if done is None:
        return ()
    added, others = _added(done), [set(m.keys) - set(done.before) for m in _other_models(done, present)]
    instead = {tuple(sorted(o - added)) for o in others if part not in o}
    return tuple(sorted(keys for keys in instead if keys))


def _other_models(done: SelectionStep, present: Set[EffectKey]) -> list[FittedModel]:
    """Models indistinguishable from the one that a step selected, without those whose effects a later step added."""
    chosen = {*done.before, *_added(done)}
    return [m for m in done.indistinguishable if not (set(m.keys) - chosen) & present]


def _added(done: SelectionStep) -> set[EffectKey]:
    """The effects that a step selected."""
    return set() if done.selected is None else set(done.selected.keys) - set(done.before)


def _selecting(part: EffectKey, steps: Sequence[SelectionStep]) -> SelectionStep | None:
    """The last step that selected an effect."""
    return next((done for done in reversed(steps) if part in _added(done)), None)


def _indistinguishable_models(
    model: FittedModel, steps: Sequence[SelectionStep]
) -> tuple[tuple[FittedModel, ...], ...]:
    """The model that each deciding step selected, with those indistinguishable from it, where there are any.

    A step decides if it is the last one that selected some effect of `model`.
    """
    deciding = [_selecting(key, steps) for key in model.keys]
    groups = list[tuple[FittedModel, ...]]()
    for done in steps:
        others = _other_models(done, set(model.keys))
        if done.selected is not None and others and any(done is each for each in deciding):
            chosen = model if set(model.keys) == set(done.selected.keys) else done.selected
            groups.append((chosen, *others))
    return tuple(groups)
