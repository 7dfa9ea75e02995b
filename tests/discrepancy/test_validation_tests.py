"""The validation test of an effect: every reason against it, and none against the true effect."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_gap import FLOOR, Small, small

from droid_jax.discrepancy import posterior, selection
from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.fitting import FittedModel, refit
from droid_jax.discrepancy.posterior import consistent_with_zero, deviations, intervals
from droid_jax.discrepancy.selection import Reason, ValidationTest, reduced_enough, validation_tests, zero_warning
from droid_jax.discrepancy.statistics import Repeats, detrended
from droid_jax.identify.identifiability import posterior_of
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import EffectKey, candidates

GAINS = {
    Reason.REPLAY_FAILED, Reason.NO_DISCREPANCY, Reason.LARGER_DISCREPANCY, Reason.SMALL_GAIN, Reason.SMALL_SHARE
}  # fmt: skip
PRELOAD, PAYLOAD = EffectKey("hinge_preload", "door"), EffectKey("payload", "elbow")


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def extended(found: Small, key: EffectKey) -> FittedModel:
    """The refitted model with one effect."""
    case = found.case
    part = next(c for c in candidates(case.effects) if c.key == key)
    return refit(case.train, case.base, (part,), found.base.values[None], case.config.refit)


def on_validation(
    found: Small, *models: FittedModel, validation: ResidualSet | None = None, before: FittedModel | None = None,
    u0: float = FLOOR, **minimum_sizes: float,
) -> list[ValidationTest]:  # fmt: skip
    """Validation tests of models that extend the base model."""
    case = found.case
    on = case.validation if validation is None else validation
    whole = on.discrepancy_at(found.base.values)
    sizes = {**case.minimum_sizes, **minimum_sizes}
    return validation_tests(case.train, on, before or found.base, models, sizes, whole, u0)


def reasons(test: ValidationTest) -> list[Reason]:
    return [rejection.reason for rejection in test.reasons]


def with_config(residual_set: ResidualSet, **thresholds: float) -> ResidualSet:
    return replace(residual_set, config=replace(residual_set.config, **thresholds))


def test_the_missing_effect_passes(found: Small):
    (test,) = on_validation(found, extended(found, PRELOAD))
    assert test.keys == (PRELOAD,) and test.before == 0
    assert test.passed and test.p < 0.01 and test.chosen == 1.0 and test.indistinguishable == ()


def test_an_effect_below_the_minimum_size_is_weak(found: Small):
    (test,) = on_validation(found, extended(found, PRELOAD), hinge_preload=9.0)
    assert reasons(test) == [Reason.BELOW_MINIMUM_SIZE] and test.weak


def test_a_coefficient_at_its_neutral_bound_may_be_zero(found: Small):
    """The reason and the interval agree: zero is in the interval or the coefficient is not zero."""
    model = extended(found, PRELOAD)
    (name,) = model.coefficients
    at, deviation = found.case.full_space.index(name), deviations(found.case.train, model)[name]
    low, high = intervals(found.case.train, model)[name]
    assert (high - low) / 2 == pytest.approx(1.645 * deviation, rel=0.01)  # no bound is near
    for factor, zero in ((1.0, True), (2.5, False)):
        values = model.values.copy()
        values[at] = factor * deviation
        (test,) = on_validation(found, replace(model, values=values))
        low, high = test.interval[name]
        assert (low <= 0.0 <= high) is zero and low <= values[at] <= high
        texts = [r.text for r in test.reasons if r.reason is Reason.MAY_BE_ZERO]
        assert texts == ([f"its coefficient may be zero (90 % interval {low:.3g} to {high:.3g} N m)"] if zero else [])


def test_the_level_of_the_intervals_is_configured(found: Small):
    model, train = extended(found, PRELOAD), found.case.train
    (name,) = model.coefficients
    wide, narrow = (np.ptp(intervals(with_config(train, interval_level=level), model)[name]) for level in (0.9, 0.5))
    assert narrow / wide == pytest.approx(0.6745 / 1.645, rel=0.01)
    part, values = model.parts[0], model.values.copy()
    values[found.case.full_space.index(name)] = 1.2 * deviations(train, model)[name]
    moved = replace(model, values=values)
    assert consistent_with_zero(train, moved, part)
    assert not consistent_with_zero(with_config(train, interval_level=0.5), moved, part)


def test_intervals_of_coefficients_that_may_all_be_zero_reach_zero(found: Small, monkeypatch: pytest.MonkeyPatch):
    """One at 1.8 deviations is consistent with zero in a joint test of two; its single interval excludes zero."""
    model = extended(found, PAYLOAD)
    (part,) = model.parts
    assert len(part.coefficients) == 2
    at, true = (
        [model.space.index(a) for a in part.coefficients],
        posterior_of(model.refined, found.case.train.cost.comparisons),
    )
    cov = true.cov.copy()
    cov[at], cov[:, at] = 0.0, 0.0
    cov[at, at] = 1.0
    monkeypatch.setattr(posterior, "posterior_of", lambda *args: replace(true, cov=cov))
    space, values = found.case.full_space, model.values.copy()
    for name, off, zero in ((part.coefficients, 1.8, False), (part.coefficients[:1], 1.8, True)):
        values[[space.index(a) for a in part.coefficients]] = 0.0
        for a in name:
            values[space.index(a)] = off * space[a].std
        moved = replace(model, values=values.copy())
        assert consistent_with_zero(found.case.train, moved, part) is zero
        holds = [low <= 0.0 <= high for low, high in intervals(found.case.train, moved).values()]
        assert all(holds) is zero
        assert bool(zero_warning(found.case.train, moved, part)) is zero


@pytest.mark.parametrize(("signs", "zero"), [((1.2, 1.2), False), ((1.2, -1.2), True), ((0.0, 2.0), False)])
def test_two_correlated_coefficients_may_each_be_zero_but_not_both(
    found: Small, monkeypatch: pytest.MonkeyPatch, signs: tuple[float, float], zero: bool
):
    """Posterior deviations of one and correlation -0.99: their sum is known to a tenth of a deviation."""
    model = extended(found, PAYLOAD)
    (part,) = model.parts
    at = [model.space.index(a) for a in part.coefficients]
    cov = np.eye(len(model.space))
    cov[np.ix_(at, at)] = [[1.0, -0.99], [-0.99, 1.0]]
    monkeypatch.setattr(posterior, "posterior_of", lambda *args: SimpleNamespace(cov=cov))
    space, values = found.case.full_space, model.values.copy()
    for name, sign in zip(part.coefficients, signs, strict=True):
        values[space.index(name)] = space[name].mean + sign * space[name].std
    assert consistent_with_zero(found.case.train, replace(model, values=values), part) is zero


@pytest.mark.parametrize("side", ["high", "low"])
def test_a_coefficient_at_a_bound_other_than_neutral_is_rejected(found: Small, side: str):
    model = extended(found, PRELOAD)
    (name,) = model.coefficients
    values, p = model.values.copy(), found.case.full_space[name]
    values[found.case.full_space.index(name)] = getattr(p, side)
    stuck = replace(model, values=values)
    (test,) = on_validation(found, stuck)
    (text,) = [r.text for r in test.reasons if r.reason is Reason.AT_BOUND]
    assert text.startswith(name) and f"{getattr(p, side):g} N m" in text
    case = found.case
    (free,) = validation_tests(
        case.train, case.validation, found.base, [stuck], case.minimum_sizes, 1.0, natural_bounds=(name,)
    )
    assert Reason.AT_BOUND not in reasons(free)


def test_a_gain_that_scatters_over_the_repeats_is_not_confirmed(found: Small):
    """The mean gain is unchanged; it scatters fifty times more over the repeats."""
    validation, model = found.case.validation, extended(found, PRELOAD)
    assert isinstance(validation.resampling, Repeats)
    loud = replace(validation, resampling=Repeats(50 * validation.resampling.deviations))
    (test,) = on_validation(found, model, validation=loud, u0=-1e9)
    assert reasons(test) == [Reason.NOT_CONFIRMED] and test.weak
    assert test.p >= loud.config.confirmation
    (lenient,) = on_validation(found, model, validation=with_config(loud, confirmation=1.0), u0=-1e9)
    assert lenient.passed and lenient.p == test.p


def test_a_further_effect_needs_a_larger_gain_than_the_first(found: Small, monkeypatch: pytest.MonkeyPatch):
    """Half of its gain is enough for the first effect of a model and too little for a second."""
    monkeypatch.setattr(
        selection, "remaining_discrepancy", lambda fit, other, model: other.discrepancy_at(model.values)
    )  # a certain fit
    case, model = found.case, extended(found, PRELOAD)
    share = 1 - np.sqrt(0.7)  # U is quadratic in the residual
    values = (1 - share) * found.base.values + share * model.values
    some = replace(model, values=values)
    assert 0.6 < case.validation.discrepancy_at(values) / case.validation.discrepancy_at(found.base.values) < 0.8
    for parts, rejected in (((), False), ((replace(model.parts[0], coefficients=("drag",)),), True)):
        (test,) = on_validation(found, some, before=replace(found.base, parts=parts))
        assert (Reason.SMALL_GAIN in reasons(test)) is rejected and test.before == len(parts)
    (strict,) = on_validation(found, some, validation=with_config(case.validation, least_gain=0.5))
    assert Reason.SMALL_GAIN in reasons(strict)


def test_a_model_that_is_rarely_best_in_the_resamples_is_rejected(found: Small):
    """The true preload against one that is a third too small, without the rule for indistinguishable models."""
    case, right = found.case, extended(found, PRELOAD)
    values = right.values.copy()
    values[case.full_space.index("hinge_preload")] *= 2 / 3
    wrong = replace(right, values=values)
    unlike = replace(with_config(case.validation, equivalence_doubt=1.0), equivalence_factor=1.0)
    best, worse = on_validation(found, right, wrong, validation=unlike)
    assert best.passed and best.chosen == 1.0 and best.indistinguishable == ()
    assert worse.chosen == 0.0 and reasons(worse) == [Reason.RARELY_BEST] and not worse.weak
    assert right.name in worse.reasons[0].text


@pytest.mark.parametrize(
    ("after", "u_before", "u_after", "enough"),
    [
        (0.55, None, None, True),  # U falls enough
        (1.1, None, None, False),
        (0.7, 0.3, 0.05, True),  # most of the remaining U is within the uncertainty of the fit
        (0.7, 0.3, 0.25, False),
        (0.7, 0.01, -0.01, False),  # nothing remained beyond that uncertainty
    ],
)
def test_a_further_effect_reduces_the_discrepancy_enough(
    after: float, u_before: float | None, u_after: float | None, enough: bool
):
    def asked(value: float | None) -> float:
        return pytest.fail("was not to be asked") if value is None else value

    assert reduced_enough(1.0, after, lambda: asked(u_before), lambda: asked(u_after), 2.0, SelectionConfig()) is enough


@pytest.mark.slow
@pytest.mark.parametrize(
    ("left", "base", "u0", "reason"),
    [
        (0.1, 1.0, 0.01, None),
        (1.1, 1.0, 0.01, Reason.LARGER_DISCREPANCY),
        (0.9, 1.0, 0.01, Reason.SMALL_GAIN),
        (0.1, 25.0, 0.01, Reason.SMALL_SHARE),
        (np.nan, 1.0, 0.01, Reason.REPLAY_FAILED),
        (0.1, 1.0, 2.0, Reason.NO_DISCREPANCY),
        (1.1, 1.0, 2.0, Reason.NO_DISCREPANCY),
    ],
)
def test_reasons_of_the_discrepancy(found: Small, left: float, base: float, u0: float, reason: Reason | None):
    """left: U of the model as a share of the one that it extends; base: U of the base model in the same unit."""
    case, model = found.case, extended(found, PRELOAD)
    before = case.validation.discrepancy_at(found.base.values)
    common = case.validation.common(found.base.values)[0]

    def whitened(rows: np.ndarray) -> np.ndarray:
        share = np.where(np.arange(len(rows)) == 0, 1.0, np.sqrt(left))
        return -np.sqrt(case.validation.repeats) * share[:, None] * common

    known = replace(case.validation, whitened=whitened, nuisances=(), nuisance_columns=None)
    (test,) = validation_tests(case.train, known, found.base, [model], case.minimum_sizes, base * before, u0 * before)
    assert set(reasons(test)) & GAINS == ({reason} if reason else set())


def test_a_model_that_blows_up_on_the_validation_motion_is_rejected(found: Small):
    case, model = found.case, extended(found, PRELOAD)
    wild, replayed = replace(model, values=model.values + 1.0), case.validation.whitened

    def whitened(rows: np.ndarray) -> np.ndarray:
        gone = np.isclose(np.atleast_2d(rows)[:, -1], wild.values[-1])
        return np.where(gone[:, None], np.nan, replayed(np.where(gone[:, None], model.values, rows)))

    fragile = replace(case.validation, whitened=whitened)
    with pytest.raises(NotReplayed, match="blows up with parameters that were fitted to another recording"):
        fragile.discrepancy_at(wild.values)
    worse, best = on_validation(found, wild, model, validation=fragile)
    assert best.passed and best.indistinguishable == ()
    assert (worse.discrepancy_validation, worse.p, worse.chosen) == (np.inf, 1.0, 0.0)
    assert Reason.REPLAY_FAILED in reasons(worse)


def test_a_gain_with_a_trend_is_significant_and_noise_is_not(found: Small):
    """A friction that warms up: the gain of its mean falls over the repeats, down to none."""
    rng = np.random.default_rng(0)
    fading = np.linspace(9.0, -1.0, 10) + 0.1 * rng.normal(size=10)
    p_value = found.case.validation.resampling.gain_p_value
    assert p_value(fading) == 1 / 1024
    assert detrended(fading).mean() == pytest.approx(fading.mean())
    assert np.std(detrended(fading)) < 0.5
    chance = np.array([p_value(rng.normal(size=10)) for _ in range(2000)])
    for level in (0.01, 0.05, 0.2):
        assert np.mean(chance <= level) == pytest.approx(level, abs=4 * np.sqrt(level / 2000))
