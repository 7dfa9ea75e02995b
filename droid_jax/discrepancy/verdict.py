"""What the search for missing effects ends with: the answer and its grounds."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.discrepancy.candidates import ScoreTest, Trend, trend
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.discrepancy.maps import Localisation, localise
from droid_jax.discrepancy.posterior import remaining_residuals
from droid_jax.discrepancy.selection import Reason, SelectionStep, ValidationTest, doubts
from droid_jax.discrepancy.step_error import beyond_step_error, more_than_step_error
from droid_jax.files import LOST
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import EffectKey, Keys, names_of

Alternatives = tuple[Keys, ...]  # each may be several effects together


class Conclusion(enum.Enum):
    """The answers there are."""

    NONE = "none"  # nothing is missing that these recordings could tell
    NAMED = "named"  # these effects are missing
    INDISTINGUISHABLE = "indistinguishable"  # one of these; an experiment that would tell them apart is named
    PARTLY = "partly explained"  # these, and a remainder that nothing in the library explains
    UNEXPLAINED = "unexplained"  # something is missing, and nothing in the library is it
    UNCONVERGED = "fit not converged"  # of the base model or of the extended one; nothing can be concluded


@dataclass(frozen=True)
class Experiment:
    """Something to record that would distinguish indistinguishable models.

    what: in words.
    distance: standardised difference of the models' simulated torques there; above about 6 ten repeats decide.  None
        where the simulation could not be made.
    not_made: why.
    """

    what: str
    distance: float | None
    not_made: str = ""


@dataclass(frozen=True)
class Hint:
    """Effects that passed their tests and close too little to be named: they may only imitate what is missing.

    effects, indistinguishable: as of a verdict.
    closed: share of U beyond the discretisation error by held-out role, "validation" and "test".
    """

    effects: Keys
    indistinguishable: tuple[Alternatives, ...]
    closed: dict[str, float]

    def __str__(self) -> str:
        """ "a (closes 31 %)", "a or b (closes 31 %)": the least that it closes on a held-out recording."""
        each = [_or(e, others) for e, others in zip(self.effects, self.indistinguishable, strict=True)]
        return f"{' and '.join(each)} (closes {max(min(self.closed.values()), 0.0):.0%})"


@dataclass(frozen=True, eq=False)
class Verdict:
    """The answer and its grounds.

    conclusion: which of the answers.
    effects: what is in the model; indistinguishable: for each of them the alternatives that do as well.
    base, model: before and after.
    discretisation_error: U0, what the simulation's own step leaves.
    discrepancies: "train", "validation", "test" -> (U before, U after).
    before, after: where U lives on the training recording.
    config: the thresholds.
    remainder: U on the validation recording that neither `model` nor the uncertainty of its fit explains
        (`posterior.remaining_residuals`), None where no fit converged.
    score_tests, validation_tests: the grounds, in the order they were made.
    failed: models whose replay blew up where their refit was to begin, or on the test recording, which then is not in
        `discrepancies`.
    indistinguishable_models: models that do as well as `model`, refitted.
    experiments: what would distinguish them, the best first.
    not_tried: what the budget left out, empty for nothing.
    trend: what changes from repeat to repeat, None where nothing was asked.
    hints: effects that close too little to be named, see `unnamed`; the model is without them.
    doubts: what is to be doubted of the effects in the model (`selection.doubts`).
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
    indistinguishable_models: tuple[FittedModel, ...] = ()
    experiments: tuple[Experiment, ...] = ()
    not_tried: tuple[str, ...] = ()
    trend: Trend | None = None
    hints: tuple[Hint, ...] = ()
    doubts: tuple[str, ...] = ()

    def closed(self, role: str) -> float:
        """1 - (U_after - U0) / (U_before - U0) on "train", "validation" or "test"."""
        before, after = self.discrepancies[role]
        return 1.0 - open_share(after, before, self.discretisation_error)

    def closed_held_out(self) -> dict[str, float]:
        """`closed` of the held-out roles that show a discrepancy at all."""
        held_out = {role: before for role, (before, _) in self.discrepancies.items() if role != "train"}
        return {
            role: self.closed(role)
            for role, before in held_out.items()
            if beyond_step_error(before, self.discretisation_error)
        }

    @property
    def explained(self) -> float:
        """Share of U on the validation recording that the model, or its fit's uncertainty, explains."""
        before, after = self.discrepancies["validation"]
        left = after if self.remainder is None else self.remainder
        return 1.0 - open_share(left, before, self.discretisation_error)

    @property
    def sentence(self) -> str:
        """The answer in words, and what is to be doubted of it."""
        return "".join([self._answer, *(f" But {doubt}." for doubt in self.doubts)])

    @property
    def _answer(self) -> str:
        lacking = f"The model lacks {_lacking(self.effects, self.indistinguishable)}"
        if self.conclusion is Conclusion.NONE:
            return "Nothing is missing that these recordings could tell."
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
            lost = "".join(f", or {text}" for text in _lost_narrowly(self.validation_tests))
            return f"The model lacks something that is not in the library{lost}.{hints if self.hints else ''}"
        which = "the model with the effects" if self.base.refined.converged else "the base model"
        return f"The fit of {which} did not converge; nothing can be concluded."


def open_share(left: float, before: float, discretisation_error: float) -> float:
    """Share of U that is left open: of U before and U left, both above the discretisation error."""
    return (left - discretisation_error) / max(before - discretisation_error, 1e-12)


def _or(effect: object, alternatives: Alternatives) -> str:
    return " or ".join((str(effect), *map(names_of, alternatives)))


def _lacking(effects: Keys, indistinguishable: Sequence[Alternatives]) -> str:
    """ "a and b", "a, and one of: b or c"."""
    both = list(zip(effects, indistinguishable, strict=True))
    certain = " and ".join(str(e) for e, others in both if not others)
    open_ones = [f"one of: {_or(e, others)}" for e, others in both if others]
    return ", and ".join([certain, *open_ones] if certain else open_ones)


def _lost_narrowly(tests: Sequence[ValidationTest]) -> list[str]:
    """Candidates that lost for their size or their significance alone: one of them may be all there is.

    A model with all the effects of another one, and more, is not listed beside it.
    """

    def only(reason: Reason) -> list[ValidationTest]:
        lost = [t for t in tests if t.reasons and all(r.reason is reason for r in t.reasons)]
        return [t for t in lost if not any({*other.keys} < {*t.keys} for other in lost)]

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
    not_tried: tuple[str, ...] = (),
) -> Verdict:
    """The verdict on a base model and a selected one.  Of a fit that did not converge nothing is named.

    Args:
        case: the recordings.
        base: the base model.
        model: the selected one, the base model where none was.
        steps: of the search.
        discretisation_error: U0.
        exhausted: whether the last score test found nothing more.
        failed: models whose replay blew up.
        not_tried: what the budget left out.
    """
    config = case.config.selection
    converged = base.refined.converged and model.refined.converged
    if not converged:
        model, steps = base, [replace(step, selected=None, chosen=None) for step in steps]
    discrepancies, lost = _discrepancies(case, base, model)
    missing = bool(steps) and steps[0].score_test.p < config.significance
    missing = missing and more_than_step_error(case, base, steps[0].score_test, discretisation_error)
    alternatives = tuple(_alternatives(part.key, model, steps) for part in model.parts)
    left = remaining_residuals(case.train, case.validation, model) if converged else None
    conclusion = Conclusion.UNEXPLAINED if missing else Conclusion.NONE
    if left is None:
        conclusion = Conclusion.UNCONVERGED
    elif model.parts:
        conclusion = Conclusion.INDISTINGUISHABLE if any(alternatives) else Conclusion.NAMED
        before = discrepancies["validation"][0]
        if _remains(case, left, before, discretisation_error, exhausted):
            conclusion = Conclusion.PARTLY
    first = steps[0].score_test if steps else None
    repeated = case.train.resampling.repeated
    verdict = Verdict(
        conclusion=conclusion,
        effects=model.keys,
        indistinguishable=alternatives,
        base=base,
        model=model,
        discretisation_error=discretisation_error,
        discrepancies=discrepancies,
        remainder=None if left is None else case.validation.resampling.discrepancy(left),
        score_tests=tuple(dict.fromkeys(step.score_test for step in steps)),  # pairs are proposed from the first one
        validation_tests=tuple(t for step in steps for t in step.tests),
        before=localise(case.train, base.values, base.residuals, model.values),
        after=localise(case.train, model.values, model.residuals, model.values),
        config=config,
        failed=(*failed, *lost),
        indistinguishable_models=next((s.indistinguishable for s in reversed(steps) if s.selected is not None), ()),
        not_tried=not_tried,
        trend=trend(first, base.residuals, case.config.seed) if first is not None and repeated else None,
        doubts=(*doubts(case.train, model, case.natural_bounds), *worsened(discrepancies, model, config)),
    )
    return unnamed(case, verdict) if closes_too_little(verdict) else verdict


def closes_too_little(verdict: Verdict) -> bool:
    """Whether effects beside a remainder close less than `minimum_closed` on a held-out recording.

    What closes a third of a discrepancy and leaves the rest may only imitate what is missing.
    """
    closed = verdict.closed_held_out() if verdict.conclusion is Conclusion.PARTLY else {}
    return bool(closed) and min(closed.values()) < verdict.config.minimum_closed


def unnamed(case: Case, verdict: Verdict) -> Verdict:
    """The verdict with its effects as hints, and the base model as the one that stands."""
    base = verdict.base
    where = localise(case.train, base.values, base.residuals, base.values)
    left = remaining_residuals(case.train, case.validation, base)
    return replace(
        verdict,
        conclusion=Conclusion.UNEXPLAINED,
        effects=(),
        indistinguishable=(),
        model=base,
        discrepancies={role: (before, before) for role, (before, _) in verdict.discrepancies.items()},
        remainder=case.validation.resampling.discrepancy(left),
        before=where,
        after=where,
        indistinguishable_models=(),
        doubts=(),
        hints=(Hint(verdict.effects, verdict.indistinguishable, verdict.closed_held_out()),),
    )


def _discrepancies(
    case: Case, base: FittedModel, model: FittedModel
) -> tuple[dict[str, tuple[float, float]], tuple[str, ...]]:
    """U before and after by role; without the test recording, and with a note, where one cannot be replayed there."""
    found = {}
    for role, judged in case.residual_sets.items():
        try:
            found[role] = judged.discrepancy_at(base.values), judged.discrepancy_at(model.values)
        except NotReplayed:
            if role != "test":
                raise
            return found, (LOST,)
    return found, ()


def worsened(
    discrepancies: Mapping[str, tuple[float, float]], model: FittedModel, config: SelectionConfig
) -> tuple[str, ...]:
    """A doubt where the test recording is matched clearly worse with the effects than without, by the share that a
    first effect has to gain: they do not carry over to it.
    """
    before, after = discrepancies.get("test", (0.0, 0.0))
    if not model.parts or after <= (1 + config.least_gain) * max(before, 0.0):
        return ()
    return (f"the test recording is matched worse with it, U {before:.3g} before and {after:.3g} after",)


def _remains(case: Case, residuals: np.ndarray, before: float, discretisation_error: float, exhausted: bool) -> bool:
    """Whether residuals of the validation recording hold much of its U, and more than chance leaves.

    An effect that no candidate looks like is seen by no score test, but by every repeat.
    """
    rows, config = case.validation.resampling, case.config.selection
    if open_share(rows.discrepancy(residuals), before, discretisation_error) <= config.open_share:
        return False
    everywhere = np.ones((1, residuals.shape[1]), bool)
    return not exhausted or float(rows.cell_p_values(residuals, everywhere)[0]) < config.significance


def _alternatives(part: EffectKey, model: FittedModel, steps: Sequence[SelectionStep]) -> Alternatives:
    """What is equivalent to one effect of the model: what others have in its place in the last step that selected it.

    An alternative that does without several of the model's effects is named whole, beside each of them.
    """
    known = set(model.keys)
    for done in reversed(steps):
        added = set(done.selected.keys) - set(done.before) if done.selected is not None else set()
        if part in added:
            others = [set(m.keys) - set(done.before) for m in done.indistinguishable]
            instead = {tuple(sorted(o - added)) for o in others if part not in o and not (o - added) & known}
            return tuple(sorted(keys for keys in instead if keys))
    return ()
