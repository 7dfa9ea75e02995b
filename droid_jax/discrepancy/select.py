"""Which effects belong into the model: judged on a demonstration that moves differently, parameters frozen."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from droid_jax.discrepancy.refit import FittedModel, intervals, zero_warning
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.discrepancy.transfer import remaining_discrepancy

SIGNIFICANT = 0.01  # p below which something is missing
CONFIRMED = 0.05  # and below which one effect's gain on the other demonstration is no chance, among all other gates
LESS = 0.2  # share of U that the first effect must take away on the validation demonstration
MORE = 0.4  # share of what is left that every further effect must: a wrong form of the first leaves something too
OF_ALL = 0.05  # and share of the base model's U: what a wrong form of the first effect leaves is no effect of its own
DOUBT = 0.05  # share of the resamples in which a rival is better, from which it is equivalent
CHOSEN = 0.8  # share of the resamples in which an effect, or one that is equivalent, must win
RESAMPLES = 400
AS_FITTED = 0.05  # share of the gap on the fitted demonstration that is no difference there
TOO_SMALL = "below the minimum effect size"
AT_BOUND = "ran into its bound"
UNCONFIRMED = "not confirmed by the other demonstration"
EDGE = 0.02  # share of a parameter's range that counts as its bound


@dataclass(frozen=True)
class ValidationTest:
    """An effect's case: everything it had to pass, and the reason where it did not.

    discrepancy_train, discrepancy_validation: U with it on both demonstrations; p: of the improvement on the
    validation one.
    interval: of each amplitude; chosen: share of resamples.  indistinguishable: names of models that cannot be told
    from it. reasons: why it lost, empty where it passed.  weak: it lost for nothing but its size or its significance,
    and may yet be the truth.
    """

    name: str
    discrepancy_train: float
    discrepancy_validation: float
    p: float
    interval: dict[str, tuple[float, float]]
    chosen: float
    reasons: tuple[str, ...]
    indistinguishable: tuple[str, ...] = ()
    weak: bool = False

    @property
    def passed(self) -> bool:
        """No reason against it."""
        return not self.reasons


def resamples(count: int, seed: int = 0) -> np.ndarray:
    """[R, N] weights of the repeats in R resamples, each row summing to one."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=RESAMPLES) / count


def validation_tests(
    fit: ResidualSet,
    validation: ResidualSet,
    before: FittedModel,
    models: Sequence[FittedModel],
    smallest: Mapping[str, float],
    whole_gap: float,
    floor: float = 0.0,
    seed: int = 0,
    ends: Collection[str] = (),
) -> list[ValidationTest]:
    """Put extended models on trial against the one without their last effects, and against each other.

    before: that model.  smallest: amplitude -> size worth naming.  whole_gap: U of the model without
    any effect on the validation demonstration.  ends: amplitudes that may stand at their bound.  One batch of
    replays; U of one that blows up is infinite.
    """
    commons = validation.common(np.stack([before.values, *(m.values for m in models)]))
    repeats = [validation.residuals(c) for c in commons]
    left = np.nan_to_num([validation.discrepancy(r) for r in repeats], nan=np.inf)
    squares = np.array([np.sum(r**2, axis=1) for r in repeats])
    losses = np.nan_to_num(validation.losses(commons[1:], resamples(validation.units, seed)), nan=np.inf)
    fitted = np.array([m.discrepancy for m in models])
    same = indistinguishable(
        left[1:], fitted, losses, floor, validation.equivalence_factor, AS_FITTED * before.discrepancy
    )
    winners = np.bincount(np.argmin(losses, axis=1), minlength=len(models)) / len(losses)
    beside = functools.cache(lambda: remaining_discrepancy(fit, validation, before))
    out = []
    for k, model in enumerate(models):
        p = validation.gain_p_value(0.5 * (squares[0] - squares[k + 1])) if np.isfinite(left[k + 1]) else 1.0
        chosen = float(winners[same[k]].sum())
        spans = {a: s for a, s in intervals(fit, model).items() if a not in before.coefficients}
        weak = [f"{UNCONFIRMED} (p = {p:.2g})"] if p >= CONFIRMED else []
        weak += _too_small(fit, model, spans, smallest)
        if before.parts:
            beyond = functools.partial(remaining_discrepancy, fit, validation, model)
            taken = much_more(left[0], left[k + 1], beside, beyond, whole_gap)
        else:
            taken = left[k + 1] <= (1 - LESS) * left[0]
        reasons = _gap_reasons(left[0], left[k + 1], whole_gap, taken, floor)
        reasons += _amplitude_reasons(fit, model, spans, ends)
        if chosen < CHOSEN:
            leader = min(zip(left[1:], models, strict=True), key=lambda lm: lm[0])[1].name
            reasons.append(f"wins only {chosen:.0%} of the resamples; {leader} does better")
        rivals = tuple(models[i].name for i in np.flatnonzero(same[k]).tolist() if i != k)
        out.append(
            ValidationTest(
                model.name, model.discrepancy, float(left[k + 1]), p, spans, chosen, (*weak, *reasons), rivals,
                weak=bool(weak) and not reasons,
            )
        )  # fmt: skip
    return out


def indistinguishable(
    left: np.ndarray, fitted: np.ndarray, losses: np.ndarray, floor: float, tie: float, nothing: float
) -> np.ndarray:
    """[K, K] bool, which models cannot be told apart.

    left, fitted: [K] U on the validation and on the training motion; losses: [R, K] in resamples of the validation
    one's repeats.  What two wrong forms leave says little about which is nearer the truth, so a ratio `tie` counts and
    not significance; on the fitted one differences up to `nothing` are none.
    """
    above, above_fitted = (np.maximum(u - floor, 1e-12) for u in (left, fitted))
    near = above[None, :] <= tie * above[:, None]
    near &= above_fitted[None, :] <= tie * above_fitted[:, None] + nothing
    better = np.mean(losses[:, None, :] < losses[:, :, None], axis=0) > DOUBT
    as_good = near | better
    return (as_good & as_good.T) | np.eye(len(left), dtype=bool)


def much_more(
    before: float, after: float, beside: Callable[[], float], beyond: Callable[[], float], whole_gap: float
) -> bool:
    """Whether a further effect takes its share of what is left on the validation demonstration.

    before, after: U.  beside, beyond: the same less what the uncertainty of each fit leaves there, which no effect can
    take; where U falls by less than the share, that may do, if it is a share of the first gap too.  (They are dear:
    asked for where it matters.)
    """
    if after <= (1 - MORE) * before:
        return True
    if not after < before:
        return False
    left, rest = beside(), beyond()
    return rest <= (1 - MORE) * left and left - rest >= OF_ALL * whole_gap


def _gap_reasons(before: float, after: float, whole_gap: float, taken: bool, floor: float) -> list[str]:
    reasons = []
    if not np.isfinite(after):
        reasons.append("its replay of the other demonstration blew up")
    elif before <= floor:
        reasons.append("the other demonstration shows no gap that it could take away")
    elif after > before:
        reasons.append("makes the gap on the other demonstration larger")
    elif not taken:
        reasons.append(f"takes only {1 - after / before:.0%} of the gap away on the other demonstration")
    elif before - after < OF_ALL * whole_gap:
        reasons.append(f"takes only {(before - after) / whole_gap:.1%} of the first gap away")
    return reasons


def _too_small(
    fit: ResidualSet, model: FittedModel, spans: Mapping[str, tuple[float, float]], smallest: Mapping[str, float]
) -> list[str]:
    space = fit.cost.space
    small = all(abs(model.values[space.index(a)] - space[a].mean) < smallest[a] for a in spans)
    return [TOO_SMALL] if small else []


def _amplitude_reasons(
    fit: ResidualSet, model: FittedModel, spans: Mapping[str, tuple[float, float]], ends: Collection[str]
) -> list[str]:
    new = [c for c in model.parts if set(c.coefficients) <= set(spans)]
    reasons = [said for c in new if (said := zero_warning(fit, model, c))][:1]
    return reasons + [
        f"{a} {AT_BOUND}: {beyond}" for a in spans if a not in ends and (beyond := past_bound(fit, model, a))
    ]


def past_bound(fit: ResidualSet, model: FittedModel, amplitude: str) -> str:
    """ "more than 0.5 N m" of an amplitude at a bound that is not neutral; empty of others."""
    p = fit.cost.space[amplitude]
    value, reach = model.values[fit.cost.space.index(amplitude)], EDGE * (p.high - p.low)
    if p.high != p.mean and value > p.high - reach:
        return f"more than {p.high:g} {p.unit}".removesuffix(" -")
    if p.low != p.mean and value < p.low + reach:
        return f"less than {p.low:g} {p.unit}".removesuffix(" -")
    return ""
