"""The Gaussian over parameters against scipy, numpy and closed forms."""

import dataclasses
import json
import math
import os
from typing import Literal

import numpy as np
import pytest
from scipy import integrate, stats

from droid_jax.identify.gaussian import Gaussian, ParameterEntry, load_gaussian, prior, space_of, space_to_json
from droid_jax.identify.truncated_normal import gibbs, quantiles
from droid_jax.model.parameters import Mode, Parameter, Role, Scaling, Space, Write
from droid_jax.read_json import typed


def wide(name, mean=0.0, std=1.0, **kw):
    return Parameter(name, "N m", mean, std, -1000.0, 1000.0, **kw)


def log_parameter(name="stiffness", low=0.0, high=100.0, floor=0.01, **kw):
    return Parameter(name, "N m/rad", 1.0, 0.5, low, high, scaling=Scaling.LOG, log_offset=floor, **kw)


COV = np.array([[1.0, 0.6, 0.0], [0.6, 2.0, -0.5], [0.0, -0.5, 0.7]])


@pytest.fixture
def free():
    """Three linear parameters with wide bounds, in physical coordinates."""
    space = Space((wide("a"), wide("b"), wide("c")))
    return Gaussian(space, np.array([1.0, -2.0, 0.5]), COV, "test", "physical")


def test_prior_is_the_gaussian_of_the_space():
    g = prior(Space((wide("a", 3.0, 2.0), log_parameter())))
    assert g.rule == "prior" and g.coordinates == "search"
    np.testing.assert_allclose(g.quantiles([0.5])[0], [3.0, 1.0])
    one_deviation_up = float(stats.norm.cdf(1.0))
    np.testing.assert_allclose(g.quantiles([one_deviation_up])[0], [5.0, 1.5], rtol=1e-9)


def test_sample_moments(free):
    draws = free.sample(0, 200_000)
    np.testing.assert_allclose(draws.mean(0), free.mean, atol=0.02)
    np.testing.assert_allclose(np.cov(draws.T), COV, atol=0.03)


def test_sample_is_a_function_of_the_seed(free):
    np.testing.assert_array_equal(free.sample(3, 50), free.sample(3, 50))
    assert not np.array_equal(free.sample(3, 50), free.sample(4, 50))
    assert free.sample(np.random.default_rng(3), 0).shape == (0, 3)


@pytest.mark.parametrize("coordinates", ["search", "physical"])
def test_rows_out_of_bounds_are_drawn_again(coordinates):
    """A door's damping of 0.10 with deviation 0.19: rows are redrawn, not clipped to zero."""
    space = Space((Parameter("damping", "N m s/rad", 0.10, 0.19, 0.0, 5.0), wide("other")))
    mean, cov = (np.zeros(2), np.eye(2))
    if coordinates == "physical":
        mean, cov = np.array([0.10, 0.0]), np.diag([0.19**2, 1.0])
    g = Gaussian(space, mean, cov, "test", coordinates)
    damping = g.sample(1, 20_000)[:, 0]
    oracle = stats.truncnorm((0 - 0.10) / 0.19, np.inf, loc=0.10, scale=0.19)
    assert damping.min() > 0.0
    assert stats.kstest(damping, oracle.cdf).pvalue > 1e-3
    np.testing.assert_allclose(g.quantiles([0.1, 0.5, 0.9])[:, 0], oracle.ppf([0.1, 0.5, 0.9]), rtol=1e-6)


def test_whole_rows_are_drawn_again():
    """Truncating one of two correlated parameters moves the other; the oracle is scipy's truncated mean."""
    space = Space((Parameter("a", "u", 0.0, 1.0, 0.0, 50.0), wide("b")))
    g = Gaussian(space, np.zeros(2), np.array([[1.0, 0.8], [0.8, 1.0]]), "test", "physical")
    draws = g.sample(0, 50_000)
    half_normal = math.sqrt(2 / math.pi)
    np.testing.assert_allclose(draws.mean(0), [half_normal, 0.8 * half_normal], atol=0.02)


def test_log_scaled_parameters_are_clipped_and_reach_zero():
    """Log-scaled draws beyond a bound of zero become zero, with the probability of the normal."""
    p = log_parameter(floor=0.1, width=1.0)
    draws = prior(Space((p,))).sample(0, 50_000)[:, 0]
    expected = stats.norm.cdf(math.log(0.1 / 1.1))
    assert abs((draws == 0.0).mean() - expected) < 3 * math.sqrt(expected / 50_000)


def test_draws_are_possible_inside_distant_bounds():
    space = Space((Parameter("good", "u", 0.0, 1.0, -9.0, 9.0), Parameter("bad", "u", 0.5, 1.0, 0.0, 1.0)))
    draws = Gaussian(space, np.array([0.0, -30.0]), np.eye(2), "test", "physical").sample(0, 5_000)
    assert stats.kstest(draws[:, 0], stats.norm.cdf).pvalue > 1e-3
    assert stats.kstest(draws[:, 1], stats.expon(scale=1 / 30.03).cdf).pvalue > 1e-3  # the tail, to a thousandth


def test_many_parameters_at_a_bound_are_sampled():
    """Fifteen means one deviation outside: one row in 10^12 would be inside."""
    space = Space((*(Parameter(f"p{i}", "u", 0.5, 1.0, 0.0, 9.0) for i in range(15)), wide("free")))
    g = Gaussian(space, np.r_[np.full(15, -1.0), 2.0], np.eye(16), "test", "physical")
    draws = g.sample(0, 3_000)
    assert draws[:, :15].min() >= 0.0
    for k in range(15):
        assert stats.kstest(draws[:, k], stats.truncnorm(1, 10, loc=-1).cdf).pvalue > 1e-4
    assert stats.kstest(draws[:, 15], stats.norm(2.0).cdf).pvalue > 1e-3
    np.testing.assert_array_equal(draws, g.sample(0, 3_000))


def test_gibbs_sampling_agrees_with_rejection():
    """Moments of correlated variables, half of which have bounds."""
    rng = np.random.default_rng(2)
    axes = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    cov = axes @ np.diag([2.0, 1.0, 0.3, 0.05]) @ axes.T
    mean, low, high = (
        rng.normal(size=4),
        np.array([0.5, -np.inf, -1.0, -np.inf]),
        np.array([np.inf, np.inf, 0.4, np.inf]),
    )
    draws = rng.multivariate_normal(mean, cov, 2_000_000)
    kept = draws[np.all((draws >= low) & (draws <= high), axis=1)]
    ours = gibbs(rng, 40_000, mean, cov, low, high)
    assert len(kept) > 50_000 and np.all((ours >= low) & (ours <= high))
    np.testing.assert_allclose(ours.mean(axis=0), kept.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(np.cov(ours.T), np.cov(kept.T), atol=0.03)


@pytest.mark.parametrize(
    "box", [(-1.0, 2.0), (-np.inf, np.inf), (3.0, np.inf), (-np.inf, -40.0), (8.0, 8.1), (35.0, 36.0)]
)
def test_truncated_quantiles_against_scipy(box):
    q = np.linspace(0.01, 0.99, 15)
    ours = quantiles(q, *(np.asarray(b) for b in box))
    np.testing.assert_allclose(ours, stats.truncnorm.ppf(q, *box), rtol=1e-8)
    ends = quantiles(np.array([0.0, 1.0]), *(np.asarray(b) for b in box))
    np.testing.assert_allclose(ends, box, rtol=1e-12)


def test_log_density_against_scipy(free):
    points = np.random.default_rng(0).normal(size=(4, 5, 3))
    oracle = stats.multivariate_normal.logpdf(points, free.mean, COV)
    np.testing.assert_allclose(free.log_density(points), oracle, rtol=1e-10)


def test_log_density_in_search_coordinates_integrates_to_one_in_physical_units():
    space = Space((log_parameter(low=0.0, high=1e6, width=0.7),))
    g = Gaussian(space, np.array([0.3]), np.array([[0.5]]), "test")
    # v + floor is log-normal: scipy's closed form
    scale = 1.01 * math.exp(0.7 * 0.3)
    oracle = stats.lognorm(s=0.7 * math.sqrt(0.5), loc=-0.01, scale=scale)
    for v in (0.2, 1.0, 5.0):
        assert g.log_density(np.array([v])) == pytest.approx(oracle.logpdf(v), rel=1e-9)
    mass, _ = integrate.quad(lambda v: math.exp(float(g.log_density(np.array([v])))), 0, 200, limit=200)
    assert mass == pytest.approx(1.0, abs=1e-3)


def test_log_density_outside_the_bounds_and_singular(free):
    assert free.log_density(np.array([0.0, 0.0, 1001.0])) == -np.inf
    with pytest.raises(ValueError, match="shape"):
        free.log_density(np.zeros(2))
    singular = dataclasses.replace(free, cov=np.diag([1.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match="singular"):
        singular.log_density(np.zeros(3))
    assert np.isfinite(singular.marginal(["a", "c"]).log_density(np.zeros(2)))


def test_quantiles_and_interval_against_scipy(free):
    q = [0.05, 0.5, 0.95]
    oracle = stats.norm(free.mean, np.sqrt(np.diag(COV))).ppf(np.array(q)[:, None])
    np.testing.assert_allclose(free.quantiles(q), oracle, atol=1e-9)
    low, high = free.interval(0.9)
    np.testing.assert_allclose((low, high), oracle[[0, 2]], atol=1e-9)
    with pytest.raises(ValueError, match="level"):
        free.interval(1.0)
    with pytest.raises(ValueError, match="q must"):
        free.quantiles([1.5])


def test_physical_moments_against_the_log_normal():
    space = Space((log_parameter(low=0.0, high=1e6, width=0.4), wide("b", 2.0, 3.0)))
    g = prior(space)
    oracle = stats.lognorm(s=0.4, loc=-0.01, scale=1.01)
    np.testing.assert_allclose(g.physical_mean, [oracle.mean(), 2.0], rtol=1e-4)
    np.testing.assert_allclose(g.physical_std, [oracle.std(), 3.0], rtol=2e-3)
    np.testing.assert_allclose(g.centre, [1.0, 2.0], rtol=1e-6)  # the median


def test_marginal_follows_the_names(free):
    m = free.marginal(["c", "a"])
    assert m.space.names == ("c", "a")
    np.testing.assert_array_equal(m.mean, [0.5, 1.0])
    np.testing.assert_array_equal(m.cov, [[0.7, 0.0], [0.0, 1.0]])
    with pytest.raises(ValueError, match="unknown parameter 'z'"):
        free.marginal(["z"])


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("mean", [0.0, 1.0], "mean must have shape"),
        ("mean", [0.0, 1.0, math.nan], "not finite"),
        ("cov", np.eye(2), "cov must have shape"),
        ("cov", COV + np.diag([0.3, 0.0], k=1), "symmetric"),
        ("cov", np.array([[1.0, 2, 0], [2, 1, 0], [0, 0, 1]]), "semi-definite"),
        ("coordinates", "log", "coordinates"),
    ],
)
def test_invalid_gaussians_are_refused(free, field, value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(free, **{field: value})


def test_variances_of_very_different_scale_are_accepted():
    space = Space((wide("tiny"), wide("huge")))
    Gaussian(space, np.zeros(2), np.array([[1e-14, 0.9e-5], [0.9e-5, 1e4]]), "test", "physical")
    with pytest.raises(ValueError, match="semi-definite"):
        Gaussian(space, np.zeros(2), np.array([[1e-14, 1.2e-5], [1.2e-5, 1e4]]), "test", "physical")


WRITES = (Write("body_mass", (3,)), Write("dof_damping", (2, 1), Mode.SCALE, 0.5))


@pytest.fixture
def saved(tmp_path):
    space = Space((wide("a", nuisance=True, group="Nuisance"), log_parameter(width=0.3, writes=WRITES)))
    g = Gaussian(space, np.array([0.1, 1 / 3]), np.array([[1.0, 0.1], [0.1, 0.2]]), "cma-es covariance")
    path = tmp_path / "folder" / "gaussian.json"
    g.save(path)
    return g, path


def test_save_and_load_give_the_same_gaussian(saved):
    g, path = saved
    back = load_gaussian(path)
    assert back.space == g.space and back.space["stiffness"].writes == WRITES
    assert (back.rule, back.coordinates) == (g.rule, g.coordinates)
    np.testing.assert_array_equal(back.mean, g.mean)
    np.testing.assert_array_equal(back.cov, g.cov)
    np.testing.assert_array_equal(back.sample(5, 20), g.sample(5, 20))
    assert os.listdir(path.parent) == [path.name]


def space_from_json(entries):
    return space_of(typed(entries, list[ParameterEntry], "space"))


def test_roles_survive_json_and_may_be_missing_as_in_older_files():
    one = Parameter("a", "kg", 0.0, 1.0, -5.0, 5.0, role=Role.PAYLOAD_MASS)
    other = Parameter("torque_offset[b]", "N m", 0.0, 1.0, -5.0, 5.0)
    entries = json.loads(json.dumps(space_to_json(Space((one, other)))))
    assert ["role" in entry for entry in entries] == [True, False]
    assert [p.role for p in space_from_json(entries).parameters] == [Role.PAYLOAD_MASS, Role.TORQUE_OFFSET]
    del entries[0]["role"]
    assert space_from_json(entries)["a"].role is Role.OTHER


def test_the_space_survives_json():
    space = Space((wide("a"), log_parameter(writes=WRITES)))
    assert space_from_json(json.loads(json.dumps(space_to_json(space)))) == space


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("cov"), "missing keys: cov"),
        (lambda c: c.update(version=1), "version 2, got 1"),
        (lambda c: c.update(format="other"), "format"),
        (lambda c: c.update(mean=[0.0]), "mean must have shape"),
        (lambda c: c.update(mean=["x", 0.0]), "'mean', entry 0 must be a number, got 'x'"),
        (lambda c: c["cov"][0].__setitem__(1, math.nan), "NaN is no number of JSON"),
        (lambda c: c["cov"][0].__setitem__(1, 0.2), "symmetric"),
        (lambda c: c["space"][1].pop("unit"), "'space', entry 1: missing keys: unit"),
        (
            lambda c: c["space"][1].update(scaling="cubic"),
            "entry 1, 'scaling' must be one of linear, log, got 'cubic'",
        ),
        (lambda c: c["space"][0].update(low=2000.0), "must be below high"),
        (lambda c: c["space"][0].update(low=10**400), "a whole number beyond 2\\^63"),
        (lambda c: c["space"][0].update(colour="red"), "'space', entry 0: unknown keys: colour"),
        (lambda c: c["space"][1]["writes"][0].update(index=[-1]), "index must be at least 0, got -1"),
        (lambda c: c["space"][1]["writes"][0].update(index=[]), "index must be a tuple of whole numbers"),
        (lambda c: c["space"][1]["writes"][0].update(mode="cube"), "'mode' must be one of set, "),
        (lambda c: c["space"][1].update(name="a\0"), r"the text holds the character U\+0000"),
        (lambda c: c["space"][1].update(name="a" * 201), "at most 200 characters"),
        (lambda c: c.update(cov=[[1.0], [1.0, 2.0]]), "cov must have rows of one length"),
        (lambda c: c.update(space={}), "'space' must be a list, got {}"),
    ],
)
def test_bad_files_are_named(saved, change, message):
    _, path = saved
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message) as error:
        load_gaussian(path)
    assert str(path) in str(error.value)


def test_missing_and_truncated_files_are_named(saved):
    _, path = saved
    path.write_text(path.read_text()[:-20])
    with pytest.raises(ValueError, match=r"gaussian\.json"):
        load_gaussian(path)
    with pytest.raises(ValueError, match=r"nowhere\.json: there is no such file"):
        load_gaussian(path.parent / "nowhere.json")
    with pytest.raises(ValueError, match=r"is a folder; a run keeps its Gaussian in gaussian\.json there"):
        load_gaussian(path.parent)


@pytest.mark.parametrize("mean", [-0.4, 0.0, 0.3, 1.0, 4.0])
@pytest.mark.parametrize("coordinates", ["search", "physical"])
def test_an_interval_holds_its_centre_and_its_probability_and_ends_at_the_bounds(
    mean: float, coordinates: Literal["search", "physical"]
):
    """One parameter of 0 or more, of unit deviation: 1.645 to both sides far from the bound, one-sided at it."""
    space = Space((Parameter("a", "N m", 1.0, 1.0, 0.0, 10.0),))
    at = np.array([mean]) if coordinates == "physical" else space.to_search(np.array([mean]))
    gaussian = Gaussian(space, at, np.eye(1), "made up", coordinates)
    (low,), (high,) = gaussian.interval(0.9)
    assert 0.0 <= low <= gaussian.centre[0] <= high <= 10.0
    beyond = stats.truncnorm(-mean, 10.0 - mean, loc=mean)
    assert 0.9 - 1e-6 <= beyond.cdf(high) - beyond.cdf(low) <= 0.95
    if mean >= 0.0:
        assert low == pytest.approx(max(0.0, mean - 1.6449), abs=1e-4) and high == pytest.approx(
            mean + 1.6449, abs=1e-4
        )
