"""Selection of effects: validation tests of fitted models on another motion, and the choice among those that pass."""

from __future__ import annotations

import enum
import functools
import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.discrepancy.candidates import Proposal, ScoreTest
from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.discrepancy.posterior import consistent_with_zero, intervals, remaining_discrepancy
from droid_jax.discrepancy.statistics import resample_weights
from droid_jax.identify.fit import bound_of
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import Candidate, Keys, names_of
from droid_jax.model.parameters import Parameter


class Reason(enum.Enum):
    """Reasons for which a model fails its validation test."""

    NOT_CONFIRMED = "not confirmed"
    BELOW_MINIMUM_SIZE = "below minimum size"
    REPLAY_FAILED = "replay failed"
    NO_DISCREPANCY = "no discrepancy"
    LARGER_DISCREPANCY = "larger discrepancy"
    SMALL_GAIN = "small gain"
    SMALL_SHARE = "small share"
    MAY_BE_ZERO = "may be zero"
    AT_BOUND = "at bound"
    RARELY_BEST = "rarely best"
    DOMINATED = "dominated"


WEAK = {Reason.NOT_CONFIRMED, Reason.BELOW_MINIMUM_SIZE}  # an effect with these reasons alone may still be present


@dataclass(frozen=True)
class Rejection:
    """A reason, and a text with its numbers."""

    reason: Reason
    text: str


@dataclass(frozen=True)
class ValidationTest:
    """The validation test of a model.

    keys: its effects.
    before: number of effects in the model that it extends.
    discrepancy_train, discrepancy_validation: its U on both recordings.
    p: p-value of its gain on the validation recording.
    interval: coefficient -> interval, of each new coefficient.
    chosen: share of the resamples in which it, or a model indistinguishable from it, is best.
    reasons: reasons for its rejection, empty if it passed.
    indistinguishable: effects of each model that is indistinguishable from it.
    """

    keys: Keys
    before: int
    discrepancy_train: float
    discrepancy_validation: float
    p: float
    interval: Mapping[str, tuple[float, float]]
    chosen: float
    reasons: tuple[Rejection, ...]
    indistinguishable: tuple[Keys, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether there is no reason against it."""
        return not self.reasons

    @property
    def weak(self) -> bool:
        """Whether it failed for its size or its significance alone, so that its effect may still be present."""
        return bool(self.reasons) and all(r.reason in WEAK for r in self.reasons)


TestedModel = tuple[FittedModel, ValidationTest]


@dataclass(frozen=True, eq=False)
class SelectionStep:
    """One step of the search.

    score_test: of the model before the step.
    before: the effects in it.
    ranked: proposals of the score test, the best first.
    nearest: proposals with the best one-step fits, refitted or not.
    tried, tests: the refitted models and their validation tests.
    selected, chosen: the selected model and its test, or None.
    """

    score_test: ScoreTest
    before: Keys = ()
    ranked: tuple[Proposal, ...] = ()
    tried: tuple[FittedModel, ...] = ()
    tests: tuple[ValidationTest, ...] = ()
    selected: FittedModel | None = None
    chosen: ValidationTest | None = None
    nearest: tuple[Proposal, ...] = ()

    @property
    def indistinguishable(self) -> tuple[FittedModel, ...]:
        """Models that are indistinguishable from the selected one and passed, or failed for a weak reason alone."""
        if self.chosen is None:
            return ()
        both = zip(self.tried, self.tests, strict=True)
        return tuple(m for m, t in both if (t.passed or t.weak) and t.keys in self.chosen.indistinguishable)


def validation_tests(
    train: ResidualSet,
    validation: ResidualSet,
    before: FittedModel,
    models: Sequence[FittedModel],
    minimum_sizes: Mapping[str, float],
    base_discrepancy: float,
    discretisation_error: float = 0.0,
    seed: int = 0,
    natural_bounds: Collection[str] = (),
) -> list[ValidationTest]:
    """Test models against the one that they extend, and against each other.

    The models are replayed in one batch.  U of a model whose replay blows up is infinite.

    Args:
        train: residual set that the models are fitted to.
        validation: residual set that they are tested on.
        before: the model that they extend.
        models: to test.
        minimum_sizes: coefficient -> minimum effect size.
        base_discrepancy: U of the base model on the validation recording.
        discretisation_error: U0.
        seed: of the resamples.
        natural_bounds: coefficients whose bounds are physical limits, where they may stand.
    """
    config, rows = validation.config, validation.resampling
    commons = validation.common(np.stack([before.values, *(m.values for m in models)]))
    residuals = [rows.residuals(c) for c in commons]
    u = np.nan_to_num([rows.discrepancy(r) for r in residuals], nan=np.inf)  # of `before`, then of the models
    squares = np.array([np.sum(r**2, axis=1) for r in residuals])
    draws = resample_weights(rows.units, config.resamples, seed)
    losses = np.nan_to_num(rows.losses(commons[1:], draws), nan=np.inf)
    u_train = np.array([m.discrepancy for m in models])
    same = indistinguishable(
        u[1:],
        u_train,
        losses,
        discretisation_error,
        validation.equivalence_factor,
        config.equal_fit * before.discrepancy,
        config.equivalence_doubt,
    )
    winners = np.bincount(np.argmin(losses, axis=1), minlength=len(models)) / len(losses)
    best = models[int(np.argmin(u[1:]))]
    remaining_before = functools.cache(lambda: remaining_discrepancy(train, validation, before))
    out = []
    for k, model in enumerate(models):
        p = rows.gain_p_value(0.5 * (squares[0] - squares[k + 1])) if np.isfinite(u[k + 1]) else 1.0
        chosen = float(winners[same[k]].sum())
        spans = {a: s for a, s in intervals(train, model).items() if a not in before.coefficients}
        if before.parts:
            remaining_after = functools.partial(remaining_discrepancy, train, validation, model)
            enough = reduced_enough(u[0], u[k + 1], remaining_before, remaining_after, base_discrepancy, config)
        else:
            enough = u[k + 1] <= (1 - config.least_gain) * u[0]
        reasons = [
            *significance_reasons(p, config),
            *_size_reasons(train, model, spans, minimum_sizes),
            *_gain_reasons(u[0], u[k + 1], base_discrepancy, enough, discretisation_error, config),
            *_coefficient_reasons(train, model, spans, natural_bounds),
            *_stability_reasons(chosen, best, config),
        ]
        others = tuple(models[i].keys for i in np.flatnonzero(same[k]).tolist() if i != k)
        out.append(
            ValidationTest(
                model.keys, len(before.parts), model.discrepancy, float(u[k + 1]), p, spans, chosen,
                tuple(reasons), others,
            )
        )  # fmt: skip
    return out


def indistinguishable(
    u: np.ndarray,
    u_train: np.ndarray,
    losses: np.ndarray,
    discretisation_error: float,
    factor: float,
    equal_fit: float,
    doubt: float,
) -> np.ndarray:
    """[K, K] bool, pairs of models that cannot be distinguished.

    The remaining discrepancies of two wrong forms say little about which form is nearer to the truth.  So a ratio
    decides and not significance.

    Args:
        u: [K] U on the validation recording.
        u_train: [K] U on the training recording.
        losses: [R, K] squared residual in resamples of the validation repeats.
        discretisation_error: U0.
        factor: see `SelectionConfig.equivalence_factor`.
        equal_fit: difference of U on the training recording that is ignored.
        doubt: see `SelectionConfig.equivalence_doubt`.
    """
    beyond, beyond_train = (np.maximum(each - discretisation_error, 1e-12) for each in (u, u_train))
    near = beyond[None, :] <= factor * beyond[:, None]
    near &= beyond_train[None, :] <= factor * beyond_train[:, None] + equal_fit
    better = np.mean(losses[:, None, :] < losses[:, :, None], axis=0) > doubt
    as_good = near | better
    return (as_good & as_good.T) | np.eye(len(u), dtype=bool)


def reduced_enough(
    before: float,
    after: float,
    remaining_before: Callable[[], float],
    remaining_after: Callable[[], float],
    base_discrepancy: float,
    config: SelectionConfig,
) -> bool:
    """Whether a further effect reduces U on the validation recording by `SelectionConfig.least_further_gain`.

    If U itself falls by less, U beyond the uncertainty of each fit (`remaining_discrepancy`) may fall by that share: no
    effect can explain the rest.  It must fall by `SelectionConfig.least_share` of the base model's U too.

    Args:
        before, after: U without and with the effect.
        remaining_before, remaining_after: functions that return the remaining U; expensive, called only if needed.
        base_discrepancy: U of the base model.
        config: thresholds.
    """
    share = 1 - config.least_further_gain
    if after <= share * before:
        return True
    if not after < before:
        return False
    u_before, u_after = remaining_before(), remaining_after()
    return u_after <= share * u_before and u_before - u_after >= config.least_share * base_discrepancy


def significance_reasons(p: float, config: SelectionConfig) -> list[Rejection]:
    """The reason against an effect whose gain has the p-value `p`, if it is not significant."""
    if p < config.confirmation:
        return []
    return [Rejection(Reason.NOT_CONFIRMED, f"not confirmed by the validation recording (p = {p:.2g})")]


def _gain_reasons(
    before: float,
    after: float,
    base_discrepancy: float,
    enough: bool,
    discretisation_error: float,
    config: SelectionConfig,
) -> list[Rejection]:
    if not np.isfinite(after):
        return [Rejection(Reason.REPLAY_FAILED, "its replay of the validation recording blew up")]
    if before <= discretisation_error:
        return [Rejection(Reason.NO_DISCREPANCY, "the validation recording shows no discrepancy to reduce")]
    if after > before:
        return [Rejection(Reason.LARGER_DISCREPANCY, "increases the discrepancy on the validation recording")]
    if not enough:
        text = f"reduces the discrepancy on the validation recording by only {1 - after / before:.0%}"
        return [Rejection(Reason.SMALL_GAIN, text)]
    if before - after < config.least_share * base_discrepancy:
        share = (before - after) / base_discrepancy
        return [Rejection(Reason.SMALL_SHARE, f"reduces the base model's discrepancy by only {share:.1%}")]
    return []


def _size_reasons(
    train: ResidualSet, model: FittedModel, spans: Collection[str], minimum_sizes: Mapping[str, float]
) -> list[Rejection]:
    space = train.cost.space
    small = all(abs(model.values[space.index(a)] - space[a].mean) < minimum_sizes[a] for a in spans)
    return [Rejection(Reason.BELOW_MINIMUM_SIZE, "below the minimum effect size")] if small else []


def _coefficient_reasons(
    train: ResidualSet, model: FittedModel, spans: Collection[str], natural_bounds: Collection[str]
) -> list[Rejection]:
    new = [c for c in model.parts if set(c.coefficients) <= set(spans)]
    zero = [Rejection(Reason.MAY_BE_ZERO, text) for c in new if (text := zero_warning(train, model, c))][:1]
    return zero + [
        Rejection(Reason.AT_BOUND, f"{a} at its bound: {beyond}")
        for a in spans
        if a not in natural_bounds and (beyond := past_bound(train, model, a))
    ]


def _stability_reasons(chosen: float, best: FittedModel, config: SelectionConfig) -> list[Rejection]:
    if chosen >= config.stability:
        return []
    text = f"best in only {chosen:.0%} of the resamples; {best.name} fits better"
    return [Rejection(Reason.RARELY_BEST, text)]


def with_unit(number: float, p: Parameter) -> str:
    """A number with a parameter's unit, e.g. "0.5 N m"."""
    return f"{number:g} {p.unit}".removesuffix(" -").strip()


def zero_warning(train: ResidualSet, model: FittedModel, part: Candidate) -> str:
    """Text for a part that is consistent with zero, e.g. "its coefficient may be zero (90 % interval 0 to 0.58 N m)".

    Empty for other parts.
    """
    if not consistent_with_zero(train, model, part):
        return ""
    spans = intervals(train, model, part.coefficients)
    each = [f"{low:.3g} to {high:.3g} {model.space[a].unit}".removesuffix(" -") for a, (low, high) in spans.items()]
    what = "its coefficient may be zero" if len(each) == 1 else "its coefficients may all be zero"
    return f"{what} ({100 * train.config.interval_level:.0f} % interval {' and '.join(each)})"


def past_bound(train: ResidualSet, model: FittedModel, coefficient: str) -> str:
    """Text for a coefficient at a bound other than neutral, e.g. "more than 0.5 N m"; empty for others."""
    p = train.cost.space[coefficient]
    value = model.values[train.cost.space.index(coefficient)]
    margin = train.config.bound_margin * (p.high - p.low)
    if p.high != p.mean and value > p.high - margin:
        return f"more than {with_unit(p.high, p)}"
    if p.low != p.mean and value < p.low + margin:
        return f"less than {with_unit(p.low, p)}"
    return ""


def bound_at(train: ResidualSet, model: FittedModel, name: str) -> str:
    """Bound at which a free parameter stands, "lower" or "upper"; empty for none."""
    space = train.cost.space
    return bound_of(space[name], float(model.values[space.index(name)]))


def selected(
    tested: Sequence[TestedModel], discretisation_error: float, base_discrepancy: float, config: SelectionConfig
) -> TestedModel | None:
    """The model with the smallest U on the validation recording, or the simplest of nearly equal ones.

    None if no model passed, or if the one with the smallest U has a weak reason against it.  A model with a larger U is
    not selected in its place.
    """
    standing = [(m, t) for m, t in tested if t.passed or t.weak]
    _, chosen = min(standing, key=lambda mt: mt[1].discrepancy_validation, default=(None, None))
    if chosen is None or chosen.weak:
        return None
    beyond = max(chosen.discrepancy_validation - discretisation_error, 0.0)
    enough = discretisation_error + config.simplest_factor * beyond + config.simplest_share * base_discrepancy
    alike = [(m, t) for m, t in standing if t.passed and t.keys in (chosen.keys, *chosen.indistinguishable)]
    return simplest([(m, t) for m, t in alike if t.discrepancy_validation <= enough])


def simplest(tied: Sequence[TestedModel]) -> TestedModel:
    """The model with the fewest parameters, since a flexible form can imitate a simple one."""
    return min(tied, key=lambda mt: (sum(len(c.free) for c in mt[0].parts), mt[1].discrepancy_validation))


def without_dominated(
    tested: Sequence[TestedModel],
    winner: TestedModel,
    effects: Sequence[Effect],
    discretisation_error: float,
    config: SelectionConfig,
) -> list[ValidationTest]:
    """The tests, with those rejected whose model holds the winner as a special case and has no smaller U."""
    special, chosen = winner
    beyond = max(chosen.discrepancy_validation - discretisation_error, 0.0)
    limit = discretisation_error + config.generality_factor * beyond
    general = more_general(effects, special, [m for m, _ in tested])
    text = f"holds {names_of(special.keys)} as a special case and reduces the discrepancy no further"
    return [
        replace(t, reasons=(Rejection(Reason.DOMINATED, text),))
        if more and max(t.discrepancy_validation, discretisation_error) >= limit and (t.passed or t.weak)
        else t
        for (_, t), more in zip(tested, general, strict=True)
    ]


def more_general(effects: Sequence[Effect], special: FittedModel, models: Sequence[FittedModel]) -> list[bool]:
    """Whether each model equals a special one, except for effects that hold its effects as special cases."""
    special_cases = {e.name: e.special_cases for e in effects}

    def general(model: FittedModel) -> bool:
        of_special, of_model = ({(c.effect, c.location) for c in m.parts} for m in (special, model))
        replaced, orders = tuple(of_special - of_model), itertools.permutations(of_model - of_special)
        pairs = (zip(replaced, order, strict=True) for order in orders if 0 < len(replaced) == len(order))
        return any(all(a[1] == b[1] and a[0] in special_cases[b[0]] for a, b in some) for some in pairs)

    return [general(m) for m in models]


def doubts(train: ResidualSet, model: FittedModel, natural_bounds: Collection[str] = ()) -> tuple[str, ...]:
    """Doubts about the effects in a final model: a form that does not fit, a size that may be zero or is at a bound.

    One text for each, e.g. "the form of latch at door does not fit: latch_width at its lower bound, 0.01 rad".  The
    bounds of a shape parameter hold all plausible values.  A parameter that the recordings constrain to a bound shows
    that the form in the library differs from the robot's, although location and type may be right.

    Args:
        train: residual set that the model was fitted to.
        model: the final model.
        natural_bounds: coefficients whose bounds are physical limits, where they may stand.
    """
    out = []
    for part in model.parts:
        misfits = [text for name in part.shape_parameters if (text := _misfit(train, model, name))]
        if misfits:
            out.append(f"the form of {part.key} does not fit: {' and '.join(misfits)}")
        if zero := zero_warning(train, model, part) if part.coefficients else "":
            out.append(f"of {part.key}, {zero}")
        large = [
            f"{a} {text}"
            for a in part.coefficients
            if a not in natural_bounds and (text := past_bound(train, model, a))
        ]
        if large:
            out.append(f"{part.key} is larger than its bounds allow: {' and '.join(large)}")
    return tuple(out)


def _misfit(train: ResidualSet, model: FittedModel, name: str) -> str:
    """Text for a well-constrained shape parameter at a bound; empty for others."""
    p, side = train.cost.space[name], bound_at(train, model, name)
    low, high = intervals(train, model, [name])[name]
    if not side or high - low > train.config.shape_interval_share * (p.high - p.low):
        return ""
    return f"{name} at its {side} bound, {with_unit(p.low if side == 'lower' else p.high, p)}"
