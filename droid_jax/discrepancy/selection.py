"""Which effects belong into the model: validation tests with frozen parameters on another motion."""

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
    """Why a model fails its validation test."""

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


WEAK = {Reason.NOT_CONFIRMED, Reason.BELOW_MINIMUM_SIZE}  # for these alone an effect may yet be the truth


@dataclass(frozen=True)
class Rejection:
    """A reason and its numbers, for people."""

    reason: Reason
    text: str


@dataclass(frozen=True)
class ValidationTest:
    """An extended model's test: everything it had to pass, and the reasons where it did not.

    keys: the effects in it.
    before: how many effects the model had that it extends.
    discrepancy_train, discrepancy_validation: U with it on both recordings.
    p: of the improvement on the validation recording.
    interval: of each new coefficient.
    chosen: share of the resamples in which it, or a model indistinguishable from it, is best.
    indistinguishable: effects of the models that cannot be distinguished from it.
    reasons: why it lost, empty where it passed.
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
        """No reason against it."""
        return not self.reasons

    @property
    def weak(self) -> bool:
        """It lost for nothing but its size or its significance, and may yet be the truth."""
        return bool(self.reasons) and all(r.reason in WEAK for r in self.reasons)


TestedModel = tuple[FittedModel, ValidationTest]


@dataclass(frozen=True, eq=False)
class SelectionStep:
    """One step of the search: what was asked, what was tried, and what won.

    score_test: of the model that stood before.
    before: the effects in it.
    ranked: what could be added, the best first.
    tried, tests: the refitted models and their validation tests.
    selected, chosen: the one that does best and its test, or None.
    """

    score_test: ScoreTest
    before: Keys = ()
    ranked: tuple[Proposal, ...] = ()
    tried: tuple[FittedModel, ...] = ()
    tests: tuple[ValidationTest, ...] = ()
    selected: FittedModel | None = None
    chosen: ValidationTest | None = None

    @property
    def indistinguishable(self) -> tuple[FittedModel, ...]:
        """Models that cannot be distinguished from the winner and lost, if at all, for size or significance alone."""
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
    """Test extended models against the one that they extend, and against each other.

    One batch of replays; U of one that blows up is infinite.

    Args:
        train: what the models are fitted to.
        validation: what they are tested on.
        before: the model that they extend.
        models: to test.
        minimum_sizes: coefficient -> minimum effect size.
        base_discrepancy: U of the model without any effect on the validation recording.
        discretisation_error: U0.
        seed: of the resamples.
        natural_bounds: coefficients that may stand at their bound.
    """
    config, rows = validation.config, validation.resampling
    commons = validation.common(np.stack([before.values, *(m.values for m in models)]))
    repeats = [rows.residuals(c) for c in commons]
    left = np.nan_to_num([rows.discrepancy(r) for r in repeats], nan=np.inf)
    squares = np.array([np.sum(r**2, axis=1) for r in repeats])
    draws = resample_weights(rows.units, config.resamples, seed)
    losses = np.nan_to_num(rows.losses(commons[1:], draws), nan=np.inf)
    fitted = np.array([m.discrepancy for m in models])
    same = indistinguishable(
        left[1:],
        fitted,
        losses,
        discretisation_error,
        validation.equivalence_factor,
        config.equal_fit * before.discrepancy,
        config.equivalence_doubt,
    )
    winners = np.bincount(np.argmin(losses, axis=1), minlength=len(models)) / len(losses)
    best = min(zip(left[1:], models, strict=True), key=lambda lm: lm[0])[1]
    beside = functools.cache(lambda: remaining_discrepancy(train, validation, before))
    out = []
    for k, model in enumerate(models):
        p = rows.gain_p_value(0.5 * (squares[0] - squares[k + 1])) if np.isfinite(left[k + 1]) else 1.0
        chosen = float(winners[same[k]].sum())
        spans = {a: s for a, s in intervals(train, model).items() if a not in before.coefficients}
        if before.parts:
            beyond = functools.partial(remaining_discrepancy, train, validation, model)
            enough = reduced_enough(left[0], left[k + 1], beside, beyond, base_discrepancy, config)
        else:
            enough = left[k + 1] <= (1 - config.least_gain) * left[0]
        reasons = [
            *significance_reasons(p, config),
            *_size_reasons(train, model, spans, minimum_sizes),
            *_gain_reasons(left[0], left[k + 1], base_discrepancy, enough, discretisation_error, config),
            *_coefficient_reasons(train, model, spans, natural_bounds),
            *_stability_reasons(chosen, best, config),
        ]
        others = tuple(models[i].keys for i in np.flatnonzero(same[k]).tolist() if i != k)
        out.append(
            ValidationTest(
                model.keys, len(before.parts), model.discrepancy, float(left[k + 1]), p, spans, chosen,
                tuple(reasons), others,
            )
        )  # fmt: skip
    return out


def indistinguishable(
    left: np.ndarray,
    fitted: np.ndarray,
    losses: np.ndarray,
    discretisation_error: float,
    factor: float,
    equal_fit: float,
    doubt: float,
) -> np.ndarray:
    """[K, K] bool, which models cannot be distinguished.

    What two wrong forms leave says little about which is nearer the truth, so a ratio counts and not significance.

    Args:
        left: [K] U on the validation recording.
        fitted: [K] U on the training recording.
        losses: [R, K] in resamples of the validation repeats.
        discretisation_error: U0.
        factor: ratio of U beyond U0 up to which two models are indistinguishable.
        equal_fit: difference of U on the training recording that is none.
        doubt: share of the resamples in which the worse one must be better for the same.
    """
    above, above_fitted = (np.maximum(u - discretisation_error, 1e-12) for u in (left, fitted))
    near = above[None, :] <= factor * above[:, None]
    near &= above_fitted[None, :] <= factor * above_fitted[:, None] + equal_fit
    better = np.mean(losses[:, None, :] < losses[:, :, None], axis=0) > doubt
    as_good = near | better
    return (as_good & as_good.T) | np.eye(len(left), dtype=bool)


def reduced_enough(
    before: float,
    after: float,
    beside: Callable[[], float],
    beyond: Callable[[], float],
    base_discrepancy: float,
    config: SelectionConfig,
) -> bool:
    """Whether a further effect takes its share of the remaining U on the validation recording.

    before, after: U.  beside, beyond: the same less what the uncertainty of each fit leaves there, which no effect can
    take; where U falls by less than the share, that may do, if it is a share of the base model's U too.  (They are
    expensive: asked for where it matters.)
    """
    share = 1 - config.least_further_gain
    if after <= share * before:
        return True
    if not after < before:
        return False
    left, rest = beside(), beyond()
    return rest <= share * left and left - rest >= config.least_share * base_discrepancy


def significance_reasons(p: float, config: SelectionConfig) -> list[Rejection]:
    """A gain that chance may make is a reason against an effect."""
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
    """ "0.5 N m": a number in a parameter's unit."""
    return f"{number:g} {p.unit}".removesuffix(" -").strip()


def zero_warning(train: ResidualSet, model: FittedModel, part: Candidate) -> str:
    """ "its coefficient may be zero (90 % interval 0 to 0.58 N m)" of a part of which that is so; empty else."""
    if not consistent_with_zero(train, model, part):
        return ""
    spans = intervals(train, model, part.coefficients)
    each = [f"{low:.3g} to {high:.3g} {model.space[a].unit}".removesuffix(" -") for a, (low, high) in spans.items()]
    what = "its coefficient may be zero" if len(each) == 1 else "its coefficients may all be zero"
    return f"{what} ({100 * train.config.interval_level:.0f} % interval {' and '.join(each)})"


def past_bound(train: ResidualSet, model: FittedModel, coefficient: str) -> str:
    """ "more than 0.5 N m" of a coefficient at a bound that is not neutral; empty of others."""
    p = train.cost.space[coefficient]
    value = model.values[train.cost.space.index(coefficient)]
    margin = train.config.bound_margin * (p.high - p.low)
    if p.high != p.mean and value > p.high - margin:
        return f"more than {with_unit(p.high, p)}"
    if p.low != p.mean and value < p.low + margin:
        return f"less than {with_unit(p.low, p)}"
    return ""


def bound_at(train: ResidualSet, model: FittedModel, name: str) -> str:
    """ "lower" or "upper": the bound that a free parameter sits on; empty for none."""
    space = train.cost.space
    return bound_of(space[name], float(model.values[space.index(name)]))


def selected(
    tested: Sequence[TestedModel], discretisation_error: float, base_discrepancy: float, config: SelectionConfig
) -> TestedModel | None:
    """The model that leaves least on the validation recording; of those that leave about as little, the simplest.

    None where the one that leaves least is too weak: nothing worse is named instead.
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
    """The model with the fewest parameters: a flexible form mimics a plain one."""
    return min(tied, key=lambda mt: (sum(len(c.free) for c in mt[0].parts), mt[1].discrepancy_validation))


def without_dominated(
    tested: Sequence[TestedModel],
    winner: TestedModel,
    effects: Sequence[Effect],
    discretisation_error: float,
    config: SelectionConfig,
) -> list[ValidationTest]:
    """The tests, those rejected that hold the winner as a special case and leave no less."""
    plain, chosen = winner
    beyond = max(chosen.discrepancy_validation - discretisation_error, 0.0)
    left = discretisation_error + config.generality_factor * beyond
    general = more_general(effects, plain, [m for m, _ in tested])
    text = f"holds {names_of(plain.keys)} as a special case and leaves no less"
    return [
        replace(t, reasons=(Rejection(Reason.DOMINATED, text),))
        if more and max(t.discrepancy_validation, discretisation_error) >= left and (t.passed or t.weak)
        else t
        for (_, t), more in zip(tested, general, strict=True)
    ]


def more_general(effects: Sequence[Effect], plain: FittedModel, models: Sequence[FittedModel]) -> list[bool]:
    """Which models are a plain one but for effects that hold one of its own, at its location, as a special case."""
    holds = {e.name: e.special_cases for e in effects}

    def general(model: FittedModel) -> bool:
        ours, theirs = ({(c.effect, c.location) for c in m.parts} for m in (plain, model))
        own, other = tuple(ours - theirs), itertools.permutations(theirs - ours)
        pairs = (zip(own, order, strict=True) for order in other if 0 < len(own) == len(order))
        return any(all(a[1] == b[1] and a[0] in holds[b[0]] for a, b in some) for some in pairs)

    return [general(m) for m in models]


def doubts(train: ResidualSet, model: FittedModel, natural_bounds: Collection[str] = ()) -> tuple[str, ...]:
    """What to doubt of the effects in a final model: a form that does not fit, a size that may be zero.

    One text for each: "the form of latch at door does not fit: latch_width at its lower bound, 0.01 rad".  A shape
    parameter is bounded by what such a thing can be.  One that the recordings constrain, and that wants beyond, says
    that the library's form is not the robot's, although its location and type may be right.

    natural_bounds: coefficients that may stand at their bound.
    """
    out = []
    for part in model.parts:
        wrong = [text for name in part.shape_parameters if (text := _misfit(train, model, name))]
        if wrong:
            out.append(f"the form of {part.key} does not fit: {' and '.join(wrong)}")
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
    p, side = train.cost.space[name], bound_at(train, model, name)
    low, high = intervals(train, model, [name])[name]
    if not side or high - low > train.config.shape_interval_share * (p.high - p.low):
        return ""
    return f"{name} at its {side} bound, {with_unit(p.low if side == 'lower' else p.high, p)}"
