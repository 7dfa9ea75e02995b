"""The trial of an effect: every reason against it, and none where it is right."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from droid_jax.discrepancy.select import UNCONFIRMED, _gap_reasons
from small_gap import FLOOR, Small, small

from droid_jax.discrepancy import refit as refit_module
from droid_jax.discrepancy import select
from droid_jax.discrepancy.fitting import consistent_with_zero, deviations, intervals, refit
from droid_jax.discrepancy.selection import much_more, validation_tests, zero_warning
from droid_jax.discrepancy.statistics import detrended
from droid_jax.identify.identifiability import posterior_of
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import candidates


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def extended(found: Small, name: str):
    """The base model with one effect, refitted."""
    case = found.case
    (part,) = [c for c in candidates(case.effects) if c.name == name][:1]
    return refit(case.train, case.base, (part,), found.base.values[None], case.config.refit)


def tried(found: Small, model, **smallest: float):
    case = found.case
    whole = case.validation.discrepancy_at(found.base.values)
    (trial,) = validation_tests(
        case.train, case.validation, found.base, [model], {**case.minimum_sizes, **smallest}, whole, FLOOR
    )
    return trial


def test_the_missing_effect_passes(found: Small):
    trial = tried(found, extended(found, "hinge_preload at door"))
    assert trial.passed and trial.p < 0.01 and trial.chosen == 1.0 and trial.indistinguishable == ()


def test_an_effect_smaller_than_is_worth_a_name_is_weak(found: Small):
    trial = tried(found, extended(found, "hinge_preload at door"), hinge_preload=9.0)
    assert trial.reasons == ("below the minimum effect size",) and trial.weak


def test_an_amplitude_at_its_neutral_bound_may_be_zero(found: Small):
    """What is said of it and its interval are one statement: zero lies in the interval, or it is not zero."""
    model = extended(found, "hinge_preload at door")
    (name,) = model.coefficients
    at, deviation = found.case.full_space.index(name), deviations(found.case.train, model)[name]
    low, high = intervals(found.case.train, model)[name]
    assert (high - low) / 2 == pytest.approx(1.645 * deviation, rel=0.01)  # no bound is near
    for factor, zero in ((1.0, True), (2.5, False)):
        values = model.values.copy()
        values[at] = factor * deviation
        trial = tried(found, replace(model, values=values))
        low, high = trial.interval[name]
        assert (low <= 0.0 <= high) is zero and low <= values[at] <= high
        said = [r for r in trial.reasons if "may be zero" in r]
        assert said == ([f"its amplitude may be zero (90 % interval {low:.3g} to {high:.3g} N m)"] if zero else [])


def test_amplitudes_that_may_all_be_zero_have_intervals_that_say_so(found: Small, monkeypatch: pytest.MonkeyPatch):
    """1.8 deviations off, one alone is within chance of two and its own interval would leave zero out; both are not."""
    model = extended(found, "payload at elbow")
    (part,) = model.parts
    assert len(part.coefficients) == 2
    at, true = (
        [model.space.index(a) for a in part.coefficients],
        posterior_of(model.refined, found.case.train.cost.comparisons),
    )
    cov = true.cov.copy()
    cov[at], cov[:, at] = 0.0, 0.0
    cov[at, at] = 1.0
    monkeypatch.setattr(refit_module, "posterior_of", lambda *args: replace(true, cov=cov))
    space, values = found.case.full_space, model.values.copy()
    for name, off, zero in ((part.coefficients, 1.8, False), (part.coefficients[:1], 1.8, True)):
        values[[space.index(a) for a in part.coefficients]] = 0.0
        for a in name:
            values[space.index(a)] = off * space[a].std
        moved = replace(model, values=values.copy())
        assert consistent_with_zero(found.case.train, moved, part) is zero
        holds = [low <= 0.0 <= high for low, high in intervals(found.case.train, moved).values()]
        assert all(holds) is zero
        assert ("its amplitudes may all be zero (90 % interval" in zero_warning(found.case.train, moved, part)) is zero


@pytest.mark.parametrize(("signs", "zero"), [((1.2, 1.2), False), ((1.2, -1.2), True), ((0.0, 2.0), False)])
def test_of_two_amplitudes_that_trade_each_may_be_zero_and_not_both(
    found: Small, monkeypatch: pytest.MonkeyPatch, signs: tuple[float, float], zero: bool
):
    """Posterior deviations of one, correlation -0.99: along their sum a tenth of a deviation is told."""
    model = extended(found, "payload at elbow")
    (part,) = model.parts
    at = [model.space.index(a) for a in part.coefficients]
    cov = np.eye(len(model.space))
    cov[np.ix_(at, at)] = [[1.0, -0.99], [-0.99, 1.0]]
    monkeypatch.setattr(refit_module, "posterior_of", lambda *args: SimpleNamespace(cov=cov))
    space, values = found.case.full_space, model.values.copy()
    for name, sign in zip(part.coefficients, signs, strict=True):
        values[space.index(name)] = space[name].mean + sign * space[name].std
    assert consistent_with_zero(found.case.train, replace(model, values=values), part) is zero


def test_an_amplitude_at_its_other_bound_has_run_into_it(found: Small):
    model = extended(found, "hinge_preload at door")
    (name,) = model.coefficients
    values = model.values.copy()
    values[found.case.full_space.index(name)] = found.case.full_space[name].high
    p = found.case.full_space[name]
    assert f"{name} ran into its bound: more than {p.high:g} N m" in tried(found, replace(model, values=values)).reasons
    values[found.case.full_space.index(name)] = p.low
    assert f"{name} ran into its bound: less than {p.low:g} N m" in tried(found, replace(model, values=values)).reasons


def test_what_the_repeats_do_not_agree_on_is_not_confirmed(found: Small):
    """The same mean gain, in repeats that differ by fifty times as much."""
    case, model = found.case, extended(found, "hinge_preload at door")
    loud = replace(case.validation, deviations=50 * case.validation.deviations)
    (trial,) = validation_tests(
        case.train, loud, found.base, [model], case.minimum_sizes, loud.discrepancy_at(found.base.values), -1e9
    )
    assert trial.p >= 0.01 and trial.weak
    assert [r.partition(" (")[0] for r in trial.reasons] == [UNCONFIRMED]


def test_a_further_effect_must_take_more_than_the_first(found: Small, monkeypatch: pytest.MonkeyPatch):
    """Half-way to what it would take: enough for the first effect of a model, too little for a second."""
    monkeypatch.setattr(
        select, "remaining_discrepancy", lambda fit, other, model: other.discrepancy_at(model.values)
    )  # a certain fit
    case, model = found.case, extended(found, "hinge_preload at door")
    share = 1 - np.sqrt(0.7)  # the gap is square in what is left
    values = (1 - share) * found.base.values + share * model.values
    whole = case.validation.discrepancy_at(found.base.values)
    some = replace(model, values=values)
    assert 0.6 < case.validation.discrepancy_at(values) / whole < 0.8
    for parts, says in (((), False), ((replace(model.parts[0], coefficients=("drag",)),), True)):
        before = replace(found.base, parts=parts)
        (trial,) = validation_tests(case.train, case.validation, before, [some], case.minimum_sizes, whole, FLOOR)
        assert any("of the gap away on the other demonstration" in r for r in trial.reasons) is says


def test_one_that_another_beats_in_the_resamples_is_not_named(found: Small, monkeypatch: pytest.MonkeyPatch):
    """Were they not alike: the right preload against one that is a third too small."""
    case, right = found.case, extended(found, "hinge_preload at door")
    values = right.values.copy()
    values[case.full_space.index("hinge_preload")] *= 2 / 3
    monkeypatch.setattr(select, "indistinguishable", lambda left, *_: np.eye(len(left), dtype=bool))
    whole = case.validation.discrepancy_at(found.base.values)
    wrong = replace(right, values=values)
    best, worse = validation_tests(
        case.train, case.validation, found.base, [right, wrong], case.minimum_sizes, whole, FLOOR
    )
    assert best.passed and best.chosen == 1.0
    assert worse.chosen == 0.0 and worse.reasons == (f"wins only 0% of the resamples; {right.name} does better",)
    assert not worse.weak


@pytest.mark.parametrize(
    ("after", "beside", "beyond", "enough"),
    [
        (0.55, None, None, True),  # U says enough
        (1.1, None, None, False),
        (0.7, 0.3, 0.05, True),  # most of what stays, stays since the fit is uncertain
        (0.7, 0.3, 0.25, False),
        (0.7, 0.01, -0.01, False),  # nothing was left beyond that
    ],
)
def test_a_further_effect_takes_its_share(after: float, beside: float | None, beyond: float | None, enough: bool):
    def asked(value: float | None) -> float:
        return pytest.fail("was not to be asked") if value is None else value

    assert much_more(1.0, after, lambda: asked(beside), lambda: asked(beyond), 2.0) is enough


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (1.0, 0.1, None),
        (1.0, 1.1, "makes the gap on the other demonstration larger"),
        (1.0, 0.9, "takes only 10% of the gap away on the other demonstration"),
        (0.04, 0.001, "takes only 3.9% of the first gap away"),
        (1.0, np.nan, "its replay of the other demonstration blew up"),
        (0.005, 0.001, "the other demonstration shows no gap that it could take away"),
        (-0.01, -0.012, "the other demonstration shows no gap that it could take away"),
    ],
)
def test_reasons_of_the_gap(before: float, after: float, said: str | None):
    assert _gap_reasons(before, after, 1.0, after <= 0.8 * before, 0.01) == ([] if said is None else [said])


def test_a_model_that_blows_up_on_the_other_demonstration_loses(found: Small, monkeypatch: pytest.MonkeyPatch):
    case, model = found.case, extended(found, "hinge_preload at door")
    wild = replace(model, values=model.values + 1.0)
    cost = case.validation.cost
    replayed = type(cost).whitened

    def whitened(self, rows):
        gone = np.isclose(np.atleast_2d(rows)[:, -1], wild.values[-1])
        return np.where(gone[:, None], np.nan, replayed(self, np.where(gone[:, None], model.values, rows)))

    monkeypatch.setattr(type(cost), "whitened", whitened)
    whole = case.validation.discrepancy_at(found.base.values)
    with pytest.raises(NotReplayed, match="blows up with parameters that were fitted to another recording"):
        case.validation.discrepancy_at(wild.values)
    worse, best = validation_tests(
        case.train, case.validation, found.base, [wild, model], case.minimum_sizes, whole, FLOOR
    )
    assert best.passed and best.indistinguishable == ()
    assert (worse.discrepancy_validation, worse.p, worse.chosen) == (np.inf, 1.0, 0.0)
    assert "its replay of the other demonstration blew up" in worse.reasons


def test_a_gain_that_fades_steadily_is_significant_and_chance_is_not(found: Small):
    """A friction that warms up: its mean helps every repeat but by less and less, in the end not at all."""
    rng = np.random.default_rng(0)
    fading = np.linspace(9.0, -1.0, 10) + 0.1 * rng.normal(size=10)
    p_value = found.case.validation.gain_p_value
    assert p_value(fading) == 1 / 1024
    assert detrended(fading).mean() == pytest.approx(fading.mean())
    assert np.std(detrended(fading)) < 0.5
    chance = np.array([p_value(rng.normal(size=10)) for _ in range(2000)])
    for level in (0.01, 0.05, 0.2):
        assert np.mean(chance <= level) == pytest.approx(level, abs=4 * np.sqrt(level / 2000))
