"""The CMA-ES search on toy costs: minima, the CMA equations in numpy, resuming, failed rows.

Rows, dimensions and restarts are few kinds: each other shape compiles for three seconds.
"""

import dataclasses
import math
import shutil
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from evosax.algorithms import CMA_ES

from droid_jax.identify.checkpoints import Checkpoints
from droid_jax.identify.cma import recombination
from droid_jax.identify.gaussian import load_gaussian
from droid_jax.identify.search import CmaConfig, cma_search
from droid_jax.model.parameters import Parameter, Scaling, Space


def box(dims, low=-5.0, high=5.0, mean=0.0, std=1.0):
    return Space(tuple(Parameter(f"p{i}", "u", mean, std, low, high) for i in range(dims)))


def sphere(target):
    return lambda values: ((values - np.asarray(target)) ** 2).sum(axis=-1)


class Recorder:
    """A cost that records the values it is called with, and can be interrupted at a generation."""

    def __init__(self, cost, die_at=None):
        self.cost, self.die_at, self.asked = cost, die_at, []

    def __call__(self, values):
        if len(self.asked) == self.die_at:
            raise KeyboardInterrupt
        self.asked.append(values.copy())
        return self.cost(values)

    def rows(self, restart, population=30):
        """[G, P, D] values of one restart, by generation."""
        return np.stack([v[restart * population : (restart + 1) * population] for v in self.asked])


ENDLESS = CmaConfig(tol_cost=0.0, tol_sigma=0.0)


def endless(**kw):
    return dataclasses.replace(ENDLESS, **kw)


# ---------------------------------------------------------------- finding minima


@pytest.mark.parametrize("parents", [5, None])
def test_rotated_quadratic(parents):
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    target = np.array([1.0, -2.0, 0.5])
    scales = np.logspace(0, 3, 3)

    def cost(values):  # a device array, as the replay returns
        return jnp.sum(scales * ((values - target) @ rotation) ** 2, axis=-1)

    fit = cma_search(cost, box(3), endless(parents=parents, generations=250, tol_sigma=1e-4))
    assert fit.stop == "tol_sigma"
    np.testing.assert_allclose(fit.best, target, atol=2e-3)
    np.testing.assert_allclose(fit.mean, target, atol=2e-3)
    assert np.all(np.diff(fit.history.best_cost) <= 0)
    # the covariance has learned the quadratic: its long axis is the flat direction
    longest = np.linalg.eigh(fit.cov)[1][:, -1]
    assert abs(longest @ rotation[:, 0]) > 0.95


def test_rosenbrock_inside_bounds():
    def cost(v):
        return (100 * (v[:, 1:] - v[:, :-1] ** 2) ** 2 + (1 - v[:, :-1]) ** 2).sum(axis=1)

    space = box(3, low=-2.0, high=1.5)
    recorder = Recorder(cost)
    fit = cma_search(recorder, space, endless(generations=200, tol_sigma=1e-4))
    np.testing.assert_allclose(fit.best, 1.0, atol=1e-3)
    for values in recorder.asked:
        space.check(values)


def test_two_hundred_prior_deviations_away():
    """A spring of 1.06 N m/rad from a prior of 0.01 with deviation 0.005, thanks to the logarithm."""
    spring = Parameter("k", "N m/rad", 0.01, 0.005, 0.0, 10.0, scaling=Scaling.LOG, log_offset=1e-3)
    space = Space((spring, Parameter("d", "N m s/rad", 0.1, 0.05, 0.0, 5.0, scaling=Scaling.LOG, log_offset=1e-3)))
    truth = np.array([1.06, 0.3])
    assert (truth[0] - spring.mean) / spring.std > 200

    def cost(v):
        return np.abs((v - truth) / truth).sum(axis=-1)

    fit = cma_search(cost, space, endless(generations=40))
    np.testing.assert_allclose(fit.best, truth, rtol=0.02)
    linear = cma_search(cost, space.linear(), endless(generations=10))
    logged = cma_search(cost, space, endless(generations=10))
    assert logged.best_cost < 0.5 * linear.best_cost


def test_minimum_on_a_bound_is_named():
    space = Space(tuple(dataclasses.replace(p, low=0.0, mean=1.0) for p in box(3).parameters))
    fit = cma_search(sphere([-2.0, 2.0, 5.0]), space, endless(generations=40))
    assert fit.on_bound == ("p0", "p2")
    np.testing.assert_allclose(fit.best, [0.0, 2.0, 5.0], atol=0.05)


def test_minimum_on_the_bound_of_a_logarithm_is_reached():
    """Mirrored draws never lie on the bound; the best is evaluated on it after the last generation."""
    friction = Parameter("f", "N m", 0.1, 0.05, 0.0, 5.0, scaling=Scaling.LOG, log_offset=1e-3)
    fit = cma_search(sphere([0.0, 1.0]), Space((friction, *box(1).parameters)), endless(generations=40))
    assert fit.best[0] == 0.0
    assert fit.on_bound == ("f",)
    assert fit.mean[0] < 1e-3  # the mean has not wandered off
    assert fit.evaluations == 41 * endless().population
    np.testing.assert_allclose(fit.best[1], 1.0, atol=1e-2)


# ---------------------------------------------------------------- bounds


@pytest.mark.parametrize("beyond", [0.5, 2.0])
@pytest.mark.parametrize("count", [1, 4])
def test_optima_beyond_bounds_do_not_spoil_the_search(count: int, beyond: float):
    """A model that lacks an effect pushes parameters against their bounds; the others must still be found.

    The cost is a bowl in search coordinates whose bottom lies beyond the lower bound in `count` of 16 log-scaled
    parameters.  With clipped draws the step size would grow and the search would stop early.
    """
    logs = tuple(Parameter(f"p{i}", "u", 1.0, 0.5, 0.1, 10.0, scaling=Scaling.LOG, log_offset=0.05) for i in range(16))
    space = Space(logs)
    low = space.to_search(space.low)
    bottom = np.where(np.arange(16) < count, low - beyond, 0.3)
    least = 0.5 * np.sum(np.minimum(bottom - low, 0.0) ** 2)

    def bowl(values):
        return 0.5 * np.sum((space.to_search(np.asarray(values)) - bottom) ** 2, axis=1)

    fit = cma_search(bowl, space, endless(population=30, parents=None, generations=150))
    assert fit.best_cost - least < 3e-3
    assert set(fit.on_bound) == {f"p{i}" for i in range(count)}


def test_a_restart_without_a_finite_row_does_not_keep_another_off_its_bound():
    """All rows of restart 1 blow up; the best of restart 0 is still evaluated on its bound."""
    mass = Parameter("mass", "kg", 1.0, 0.5, 0.0, 10.0, scaling=Scaling.LOG, log_offset=1.0)
    space = Space((mass, Parameter("x", "u", 0.0, 1.0, -5.0, 5.0)))

    def cost(values):
        return np.where(values[:, 1] > 2.5, np.nan, values[:, 0] ** 2 + 0.01 * values[:, 1] ** 2)

    config = endless(parents=None, generations=25, restarts=2, sigma=0.02)
    recorder = Recorder(cost)
    fit = cma_search(recorder, space, config, start=np.array([[1.0, 0.0], [1.0, 4.9]]))
    assert np.isnan(cost(np.concatenate(recorder.rows(1)[:25]))).all()
    assert fit.best[0] == 0.0 and fit.on_bound == ("mass",)


def test_draws_outside_the_bounds_are_redrawn():
    """First generations from a prior as in the paper: damping 0.10 with deviation 0.19, never negative.

    Clipped to the bound, normal.cdf(-0.10 / 0.19) = 30 % of the rows would lie on it.
    """
    space = Space((Parameter("d", "N m s/rad", 0.10, 0.19, 0.0, 5.0), Parameter("e", "u", 0, 1, -9, 9)))
    recorder = Recorder(sphere([1, 1]))
    for seed in range(10):
        cma_search(recorder, space, endless(generations=1, seed=seed))
    assert np.concatenate(recorder.asked)[:, 0].min() > 0


# ---------------------------------------------------------------- the update


def test_exactly_five_of_thirty_have_positive_weight():
    w = recombination(30, 5, dims=10, active=False).weights
    assert np.flatnonzero(w > 0).tolist() == [0, 1, 2, 3, 4] and not w[5:].any()
    assert w.sum() == pytest.approx(1.0)
    active = recombination(30, 5, dims=10, active=True).weights
    assert np.all(active[5:] < 0) and active[:5].sum() == pytest.approx(1.0)


@pytest.mark.parametrize("population", [12, 30])
def test_half_as_parents_are_cma_es_s_own_weights(population):
    oracle = CMA_ES(population, jnp.zeros(7)).default_params
    ours = recombination(population, population // 2, dims=7, active=True)
    for name, value in ours._asdict().items():
        np.testing.assert_allclose(value, getattr(oracle, name), rtol=2e-5, err_msg=name)


def first_update(change):
    """mean [D], cov [D, D] after one generation in which costs went through `change`, and the rows."""
    recorder = Recorder(lambda v: change(sphere([1, 2, 3])(v)))
    fit = cma_search(recorder, box(3), endless(generations=1))
    return fit.mean, fit.cov, recorder.asked[0]


def test_the_parents_are_the_five_best():
    def spoil_the_rest(costs):
        order = np.argsort(costs)
        costs[order[5:]] = 100 + np.random.default_rng(0).random(25)
        return costs

    def swap_five_and_six(costs):
        order = np.argsort(costs)
        costs[order[4]], costs[order[5]] = costs[order[5]], costs[order[4]]
        return costs

    mean, cov, rows = first_update(lambda c: c)
    other_mean, other_cov, _ = first_update(spoil_the_rest)
    np.testing.assert_array_equal(other_mean, mean)
    np.testing.assert_array_equal(other_cov, cov)
    best = rows[np.argsort(sphere([1, 2, 3])(rows))[:5]]
    weights = np.log(5.5) - np.log(np.arange(1, 6))
    np.testing.assert_allclose(mean, weights @ best / weights.sum(), atol=1e-5)
    assert not np.array_equal(first_update(swap_five_and_six)[0], mean)


def test_float32_cannot_blur_the_order():
    """Costs that differ by 1e-12 are ranked, and equal ones do not share a weight."""
    mean, _, _ = first_update(lambda c: c)
    np.testing.assert_array_equal(first_update(lambda c: 1.0 + 1e-12 * c)[0], mean)
    rows_mean, _, rows = first_update(np.zeros_like)
    weights = np.log(5.5) - np.log(np.arange(1, 6))
    np.testing.assert_allclose(rows_mean, weights @ rows[:5] / weights.sum(), atol=1e-5)


def numpy_cma(generations, dims, population, mu, active):
    """Hansen's equations in float64, driven by the rows a search drew: [(mean, sigma, cov)]."""
    w = np.log(mu + 0.5) - np.log(np.arange(1, population + 1))
    me = w[:mu].sum() ** 2 / (w[:mu] ** 2).sum()
    me_minus = w[mu:].sum() ** 2 / (w[mu:] ** 2).sum()
    c1 = 2 / ((dims + 1.3) ** 2 + me)
    cmu = min(1 - c1, 2 * (me - 2 + 1 / me) / ((dims + 2) ** 2 + me))
    cs = (me + 2) / (dims + me + 5)
    ds = 1 + 2 * max(0, np.sqrt((me - 1) / (dims + 1)) - 1) + cs
    cc = (4 + me / dims) / (dims + 4 + 2 * me / dims)
    chi = np.sqrt(dims) * (1 - 1 / (4 * dims) + 1 / (21 * dims**2))
    alpha = min(1 + c1 / cmu, 1 + 2 * me_minus / (me + 2), (1 - c1 - cmu) / (dims * cmu)) if active else 0.0
    w = np.where(w > 0, w / w[w > 0].sum(), alpha * w / -w[w < 0].sum())
    mean, sigma, cov, ps, pc, out = np.zeros(dims), 1.0, np.eye(dims), np.zeros(dims), np.zeros(dims), []
    for g, (rows, costs) in enumerate(generations):
        y = (rows[np.argsort(costs)] - mean) / sigma
        step = w[:mu] @ y[:mu]
        values, axes = np.linalg.eigh(cov)
        inverse_root = axes @ np.diag(values**-0.5) @ axes.T
        mean = mean + sigma * step
        ps = (1 - cs) * ps + np.sqrt(cs * (2 - cs) * me) * inverse_root @ step
        length = np.linalg.norm(ps)
        h = length / np.sqrt(1 - (1 - cs) ** (2 * (g + 2))) < (1.4 + 2 / (dims + 1)) * chi
        pc = (1 - cc) * pc + h * np.sqrt(cc * (2 - cc) * me) * step
        wo = np.where(w >= 0, w, w * dims / ((y @ inverse_root) ** 2).sum(1))
        rank_mu = sum(wi * np.outer(yi, yi) for wi, yi in zip(wo, y, strict=True))
        decay = 1 + c1 * (1 - h) * cc * (2 - cc) - c1 - cmu * w.sum()
        cov = decay * cov + c1 * np.outer(pc, pc) + cmu * rank_mu
        sigma = sigma * np.exp(cs / ds * (length / chi - 1))
        out.append((mean, sigma, sigma**2 * cov))
    return out


@pytest.mark.parametrize(("parents", "active"), [(5, False), (5, True), (None, None)])
def test_updates_agree_with_the_equations_in_numpy(parents, active):
    cost = sphere([1.0, -2.0, 0.5])
    recorder = Recorder(cost)
    space = box(3, low=-1e3, high=1e3)
    fit = cma_search(recorder, space, endless(parents=parents, active=active, generations=6))
    generations = [(rows, cost(rows)) for rows in recorder.asked]
    oracle = numpy_cma(generations, 3, 30, parents or 15, active is not False)
    for g, (mean, sigma, cov) in enumerate(oracle):
        np.testing.assert_allclose(fit.history.mean[g], mean, atol=1e-4)
        np.testing.assert_allclose(fit.history.sigma[g], sigma, rtol=1e-4)
        np.testing.assert_allclose(fit.history.std[g], np.sqrt(np.diag(cov)), rtol=1e-3)
    last = np.asarray(oracle[-1][2])
    np.testing.assert_allclose(fit.cov, last, atol=1e-3)


# ---------------------------------------------------------------- failed rows


def test_failed_rows_do_not_poison():
    def cost(v):
        out = sphere([1.0, 2.0])(v)
        out[v[:, 0] < 0.0] = np.nan
        out[v[:, 1] > 3.0] = np.inf
        return out

    recorder = Recorder(cost)
    fit = cma_search(recorder, box(2), endless(generations=60))
    np.testing.assert_allclose(fit.best, [1.0, 2.0], atol=1e-3)
    assert fit.failed == sum((~np.isfinite(cost(rows))).sum() for rows in recorder.asked) > 10
    for name in ("mean", "std", "sigma", "mean_cost", "median_cost"):
        assert np.isfinite(getattr(fit.history, name)).all(), name
    assert not np.isnan(fit.history.costs).any()


def test_fewer_good_rows_than_parents():
    """Two rows of thirty are finite: the mean is made of these two alone."""

    def two(costs):
        order = np.argsort(costs)
        costs[order[2:]] = np.inf
        return costs

    mean, cov, rows = first_update(two)
    best = rows[np.argsort(sphere([1, 2, 3])(rows))[:2]]
    weights = np.log(5.5) - np.log([1, 2])
    np.testing.assert_allclose(mean, weights @ best / weights.sum(), atol=1e-5)
    assert np.isfinite(cov).all()


def test_a_generation_without_a_good_row_raises_with_advice():
    with pytest.raises(ValueError, match=r"generation 0: all 30 rows .* smaller sigma"):
        cma_search(lambda v: np.full(len(v), np.nan), box(2), ENDLESS)


def test_a_restart_without_a_good_row_is_drawn_again():
    """Restart 1 fails in its first generation.  Its Gaussian does not change, and it still finds the minimum."""
    calls = []

    def cost(v):
        out = sphere([1.0, 2.0])(v)
        if not calls:
            out[30:] = np.inf
        calls.append(1)
        return out

    recorder = Recorder(cost)
    cma_search(recorder, box(2), endless(restarts=2, generations=40))
    rows = recorder.rows(1)
    assert np.linalg.norm(rows[1].mean(axis=0)) < 0.75 and 0.7 < rows[1].std() < 1.3  # still a unit normal about 0
    np.testing.assert_allclose(rows[-1].mean(axis=0), [1.0, 2.0], atol=1e-2)


# ---------------------------------------------------------------- restarts and stops


def test_restarts_in_one_batch_equal_separate_searches():
    cost = Recorder(sphere([1.0, 2.0]))
    together = cma_search(cost, box(2), endless(restarts=2, generations=12, seed=7))
    assert {rows.shape for rows in cost.asked} == {(60, 2)}
    assert together.evaluations == 12 * 60
    single = list[Recorder]()
    for r in range(2):
        single.append(Recorder(sphere([1.0, 2.0])))
        cma_search(single[r], box(2), endless(generations=12, seed=7 + r))
        np.testing.assert_allclose(cost.rows(r), single[r].rows(0), atol=1e-4)
    costs = [cost.cost(np.concatenate(of.asked)) for of in single]
    assert together.best_cost == pytest.approx(min(each.min() for each in costs), rel=1e-3)
    assert not np.allclose(costs[0], costs[1])


def test_a_converged_restart_does_not_change_while_others_continue():
    """Restart 0 starts at the minimum and restart 1 far off: each stops by its own criterion."""
    start = np.array([[1.0, 2.0], [-4.0, -4.0]])
    config = endless(restarts=2, generations=200, tol_sigma=1e-2, sigma=0.1)
    recorder = Recorder(sphere([1.0, 2.0]))
    fit = cma_search(recorder, box(2), config, start=start)
    alone = cma_search(sphere([1.0, 2.0]), box(2), dataclasses.replace(config, restarts=1), start=start[0])
    stopped, rows = len(alone.history.sigma), recorder.rows(0)
    assert fit.stop == "tol_sigma" and stopped + 10 < len(rows) < config.generations
    deviation = np.sqrt(np.mean((rows[stopped:] - alone.mean) ** 2))
    assert deviation == pytest.approx(np.sqrt(np.trace(alone.cov) / 2), rel=0.1)


def test_stop_reasons():
    bowl = sphere([1.0, 2.0])
    assert cma_search(bowl, box(2), endless(generations=3)).stop == "generations"
    narrow = cma_search(bowl, box(2), endless(tol_sigma=0.05))
    assert narrow.stop == "tol_sigma" and np.sqrt(np.linalg.eigvalsh(narrow.cov)[-1]) < 0.05
    assert len(narrow.history.sigma) < 100
    flat = cma_search(lambda v: 1.0 + 0 * v[:, 0], box(2), endless(tol_cost=1e-6, patience=7))
    assert flat.stop == "tol_cost" and len(flat.history.sigma) == 8
    hurried = cma_search(bowl, box(2), endless(max_seconds=1e-6))
    assert hurried.stop == "max_seconds" and len(hurried.history.sigma) == 1


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_a_search_stalls_by_shares_of_its_cost(size: float):
    """Falling by 1e-2 per generation is no stall and by 1e-5 is one, in any unit."""

    def falling(share: float):
        generation = iter(range(1000))
        return lambda values: np.full(len(values), size * (1 - share) ** next(generation))

    config = endless(tol_cost=1e-3, patience=5, generations=12)
    assert cma_search(falling(0.01), box(2), config).stop == "generations"
    assert cma_search(falling(1e-5), box(2), config).stop == "tol_cost"


def test_history_says_what_the_cost_said():
    recorder = Recorder(sphere([1.0, 2.0]))
    reports = []
    fit = cma_search(recorder, box(2), endless(generations=5), progress=reports.append)
    costs = np.array([recorder.cost(rows) for rows in recorder.asked])
    np.testing.assert_array_equal(fit.history.costs, costs)
    np.testing.assert_array_equal(fit.history.best_cost, np.minimum.accumulate(costs.min(axis=1)))
    np.testing.assert_allclose(fit.history.mean_cost, costs.mean(axis=1))
    np.testing.assert_allclose(fit.history.median_cost, np.median(costs, axis=1))
    assert fit.best_cost == costs.min()
    np.testing.assert_array_equal(fit.best, np.concatenate(recorder.asked)[costs.argmin()])
    assert [p.generation for p in reports] == [1, 2, 3, 4, 5] and reports[-1].seconds_left == 0.0
    assert [p.best_cost for p in reports] == fit.history.best_cost.tolist()


def test_every_generation_and_seed_draws_anew():
    def lengths(seed):  # Mahalanobis length per row: the same normal draws give it whatever the axes are
        recorder = Recorder(sphere([0.1, 0.1]))
        cma_search(recorder, box(2, -99, 99), endless(population=300, generations=2, seed=seed))
        centred = [asked - asked.mean(axis=0) for asked in recorder.asked]
        return [np.einsum("pi,ij,pj->p", c, np.linalg.inv(np.cov(c.T)), c) for c in centred]

    (first, second), (other, _) = lengths(0), lengths(1)
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.25
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.25


def test_the_fit_s_gaussian_is_the_search_distribution(tmp_path):
    fit = cma_search(sphere([1.0, 2.0]), box(2, mean=0.5, std=2.0), endless(generations=8))
    g = fit.gaussian()
    assert g.rule == "cma-es covariance" and g.coordinates == "search"
    np.testing.assert_allclose(g.quantiles([0.5])[0], fit.mean, atol=1e-3)
    draws = g.sample(0, 20_000)
    np.testing.assert_allclose(np.cov(draws.T), 4.0 * fit.cov, rtol=0.1, atol=1e-3)
    g.save(tmp_path / "g.json")
    np.testing.assert_array_equal(load_gaussian(tmp_path / "g.json").cov, g.cov)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parents": 30}, "parents"),
        ({"population": 1}, "population"),
        ({"sigma": math.inf}, "sigma"),
        ({"generations": 0}, "generations"),
        ({"tol_cost": math.nan}, "tol_cost"),
        ({"max_seconds": 0.0}, "max_seconds"),
        ({"seed": -1}, "seed"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        CmaConfig(**change)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"cost must return shape \(30,\)"):
        cma_search(lambda v: v, box(2), ENDLESS)
    with pytest.raises(ValueError, match="start must have shape"):
        cma_search(sphere([0, 0]), box(2), ENDLESS, start=np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"'p1'.*not inside its bounds"):
        cma_search(sphere([0, 0]), box(2), ENDLESS, start=np.array([0.0, 9.0]))


# ---------------------------------------------------------------- checkpoints

RESUMED = endless(generations=14, checkpoint_every=3, restarts=2)
BOWL = sphere([1.0, 2.0])


def assert_same(a, b):
    """Bit for bit, except for wall time."""
    for name in ("best", "best_cost", "mean", "cov"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for f in dataclasses.fields(a.history):
        if f.name != "seconds":
            np.testing.assert_array_equal(getattr(a.history, f.name), getattr(b.history, f.name), f.name)
    assert (a.evaluations, a.failed, a.stop) == (b.evaluations, b.failed, b.stop)


def interrupted(folder, at=11):
    with pytest.raises(KeyboardInterrupt):
        cma_search(Recorder(BOWL, die_at=at), box(2), RESUMED, checkpoint_dir=folder)


@pytest.fixture(scope="module")
def whole():
    return cma_search(BOWL, box(2), RESUMED)


def test_a_killed_search_resumes_bit_for_bit(tmp_path, whole):
    interrupted(tmp_path)
    again = Recorder(BOWL)
    assert_same(cma_search(again, box(2), RESUMED, checkpoint_dir=tmp_path), whole)
    assert len(again.asked) == 14 - 9  # from the checkpoint of generation 9
    idle = Recorder(BOWL)
    assert_same(cma_search(idle, box(2), RESUMED, checkpoint_dir=tmp_path), whole)
    assert not idle.asked


def test_a_finished_search_continues_with_more_generations(tmp_path, whole):
    short = dataclasses.replace(RESUMED, generations=5)
    assert cma_search(BOWL, box(2), short, checkpoint_dir=tmp_path).stop == "generations"
    assert_same(cma_search(BOWL, box(2), RESUMED, checkpoint_dir=tmp_path), whole)


def truncate(folder):
    for file in folder.rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def flip_digest(folder):
    meta = folder / "meta" / "metadata"
    meta.write_text(meta.read_text().replace('"digest": "', '"digest": "0'))


def remove_state(folder):
    for file in (folder / "state").rglob("*"):
        if file.is_file():
            file.unlink()


def swap_with_an_older(folder):
    """Whole, with its own digest, under the number of another step."""
    shutil.rmtree(folder)
    shutil.copytree(folder.parent / "6", folder)


# orbax leaves cancelled reads behind when a file is damaged, which pytest would report
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("damage", [truncate, flip_digest, remove_state, swap_with_an_older])
def test_a_damaged_checkpoint_is_reported_and_the_one_before_used(tmp_path, whole, damage):
    interrupted(tmp_path)
    damage(tmp_path / "9")
    again = Recorder(BOWL)
    with pytest.warns(UserWarning, match="is damaged and was passed over") as caught:
        fit = cma_search(again, box(2), RESUMED, checkpoint_dir=tmp_path)
    assert str(tmp_path / "9") in str(caught[0].message)
    assert len(again.asked) == 14 - 6
    assert_same(fit, whole)
    with warnings.catch_warnings():  # the damaged one has been replaced
        warnings.simplefilter("error")
        assert_same(cma_search(BOWL, box(2), RESUMED, checkpoint_dir=tmp_path), whole)


def test_a_checkpoint_of_another_search_is_refused(tmp_path):
    config = endless(generations=2)
    cma_search(BOWL, box(2), config, checkpoint_dir=tmp_path, fingerprint="door 1")
    with pytest.raises(ValueError, match="differs in fingerprint;"):
        cma_search(BOWL, box(2), config, checkpoint_dir=tmp_path, fingerprint="door 2")
    with pytest.raises(ValueError, match="differs in config;"):
        other = dataclasses.replace(config, seed=1)
        cma_search(BOWL, box(2), other, checkpoint_dir=tmp_path, fingerprint="door 1")
    with pytest.raises(ValueError, match="differs in space;"):
        cma_search(BOWL, box(2, high=6.0), config, checkpoint_dir=tmp_path, fingerprint="door 1")
    with pytest.raises(ValueError, match="differs in start;"):
        cma_search(BOWL, box(2), config, checkpoint_dir=tmp_path, fingerprint="door 1", start=np.ones(2))


def test_an_incomplete_checkpoint_of_a_killed_run_is_replaced_without_a_warning(tmp_path, caplog):
    (tmp_path / "1.orbax-checkpoint-tmp").mkdir()
    with Checkpoints(tmp_path) as checkpoints:
        (tmp_path / "1.orbax-checkpoint-tmp").mkdir(exist_ok=True)  # opening the folder may have removed it
        checkpoints.save(1, {"a": np.arange(3.0)})
        assert checkpoints.restore() is not None
    assert not caplog.records


def test_a_checkpoint_that_declares_too_much_is_not_read(tmp_path, monkeypatch):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, {"a": np.arange(3.0)})
        checkpoints.save(2, {"a": np.zeros(2**20)})  # 8 MiB, a few kB when compressed
        monkeypatch.setattr("droid_jax.identify.checkpoints.MOST_BYTES", 2**20)
        with pytest.warns(UserWarning, match="2 is damaged and was passed over: .* declares 8 MiB"):
            restored = checkpoints.restore()
    assert restored is not None and restored[0] == 1


def test_checkpoints_keep_the_newest_and_their_types(tmp_path):
    tree = {"a": np.arange(3) / 3, "b": {"c": np.array([[1.5]], np.float32), "n": np.array(7)}}
    with Checkpoints(tmp_path, keep=2, fingerprint={"data": "x"}) as checkpoints:
        assert checkpoints.restore() is None
        for step in (1, 2, 3):
            checkpoints.save(step, tree | {"step": np.array(step)})
        assert checkpoints.steps() == [2, 3]
        checkpoints.save(2, tree | {"step": np.array(22)})  # an earlier step supersedes later ones
    with Checkpoints(tmp_path, keep=2, fingerprint={"data": "x"}) as checkpoints:
        restored = checkpoints.restore()
    assert restored is not None
    step, back = restored
    assert step == 2 and back["step"] == 22
    assert back["a"].dtype == np.float64 and back["b"]["c"].dtype == np.float32
    np.testing.assert_array_equal(back["a"], tree["a"])
    with (
        Checkpoints(tmp_path, fingerprint={"data": "y"}) as checkpoints,
        pytest.raises(ValueError, match="differs in data"),
    ):
        checkpoints.restore()
