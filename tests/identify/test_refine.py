"""The refinement on residual functions in numpy whose optimum is known in closed form."""

import dataclasses

import numpy as np
import pytest

from droid_jax.identify.refine import HOP_TOLERANCE, RefineConfig, _Problem, refine
from droid_jax.model.parameters import Parameter, Scaling, Space


def line(name, mean=0.0, std=1.0, low=-1000.0, high=1000.0, **kw):
    return Parameter(name, "u", mean, std, low, high, **kw)


def positive(name, mean, **kw):
    """A logarithmic parameter from a thousandth to a thousand times its mean, a unit being a factor 1.5."""
    return Parameter(name, "u", mean, 0.5 * mean, 1e-3 * mean, 1e3 * mean, scaling=Scaling.LOG, **kw)


class Recorder:
    """A residual function that keeps the rows it was asked."""

    def __init__(self, function):
        self.function, self.asked = function, []

    def __call__(self, values):
        self.asked.append(values.copy())
        return self.function(values)

    @property
    def rows(self):
        return np.concatenate(self.asked) if self.asked else np.zeros((0, 0))


def linear(matrix, target):
    """Residuals matrix @ v - target of the physical values v."""
    return lambda values: values @ np.asarray(matrix).T - np.asarray(target)


# No hops, and gains far below a log likelihood still count: the end is a minimum to many digits.
EXACT = RefineConfig(hops=0, tolerance=1e-9, rough=0.0)
FLAT = dataclasses.replace(EXACT, main_prior=1e6)  # and the prior does not show


# ---------------------------------------------------------------- closed forms


def test_a_linear_residual_gives_the_posterior_of_linear_regression():
    """Two parameters of interest and a nuisance, whose priors are 4, 4 and 1 deviations wide."""
    rng = np.random.default_rng(0)
    space = Space((line("a", 1.0, 0.5), line("b", -2.0, 3.0), line("n", 0.3, 0.2, nuisance=True)))
    matrix, target = 0.3 * rng.normal(size=(7, 3)), rng.normal(size=7)
    fit = refine(linear(matrix, target), space, [3.0, 4.0, -1.0], EXACT)

    slopes = matrix * [0.5, 3.0, 0.2]  # per search unit
    hessian = slopes.T @ slopes + np.diag([1 / 16, 1 / 16, 1.0])
    x = np.linalg.solve(hessian, slopes.T @ (target - matrix @ [1.0, -2.0, 0.3]))
    np.testing.assert_allclose(fit.x, x, atol=1e-7)
    np.testing.assert_allclose(fit.best, [1.0, -2.0, 0.3] + np.array([0.5, 3.0, 0.2]) * x, atol=1e-6)
    np.testing.assert_allclose(fit.jacobian, slopes, atol=1e-9)
    np.testing.assert_allclose(fit.hessian, hessian, atol=1e-9)
    np.testing.assert_allclose(fit.residual, matrix @ fit.best - target, atol=1e-12)
    assert fit.objective == pytest.approx(0.5 * np.sum(fit.residual**2) + 0.5 * np.sum((x / [4, 4, 1]) ** 2))
    assert fit.converged


def test_the_prior_of_a_parameter_of_interest_is_as_wide_as_configured():
    """One datum at 3 with deviation 1 against a prior of deviation w at 0: w^2 / (1 + w^2) of the way."""
    for width in (0.5, 2.0):
        config = dataclasses.replace(EXACT, main_prior=width)
        fit = refine(linear([[1.0]], [3.0]), Space((line("a"),)), [0.0], config)
        assert fit.x[0] == pytest.approx(3.0 * width**2 / (1 + width**2), abs=1e-6)


PRECISE, WEAK = 3e4, 5.0


def two_masses():
    """2 m1 + 5 m2 is seen precisely, m1 weakly; the truth, m1 = 3.5 and m2 = 0.1, leaves no residual."""
    matrix = np.array([[2.0 * PRECISE, 5.0 * PRECISE], [WEAK, 0.0]])
    return linear(matrix, matrix @ [3.5, 0.1])


def test_logarithmic_parameters_that_trade_reach_the_truth_along_a_curved_valley():
    """From m1 = 0.25, m2 = 1.4: the valley is straight in kg, but a right angle in logarithms."""
    space = Space((positive("m1", 1.0), positive("m2", 1.0)))
    fit = refine(two_masses(), space, [0.25, 1.4], dataclasses.replace(FLAT, tolerance=1e-6))
    np.testing.assert_allclose(fit.best, [3.5, 0.1], rtol=1e-3)
    assert fit.converged


def test_a_parameter_on_its_bound_leaves_the_others_their_constrained_optimum():
    """The free optimum lies beyond a's bound, and b and c trade with a."""
    matrix = np.array([[3.0, 2.5, 0.0], [2.5, 3.0, 1.0], [0.0, 1.0, 2.0], [1.0, 1.0, 1.0]])
    target = matrix @ [4.0, -2.0, 1.0]
    space = Space((line("a", high=1.5), line("b"), line("c")))
    fit = refine(linear(matrix, target), space, [0.0, 0.0, 0.0], FLAT)
    others = np.linalg.lstsq(matrix[:, 1:], target - 1.5 * matrix[:, 0])[0]
    assert fit.best[0] == 1.5
    np.testing.assert_allclose(fit.best[1:], others, atol=1e-5)
    np.testing.assert_allclose(fit.jacobian, matrix, atol=1e-7)  # one-sided differences at the bound


def test_a_start_on_the_wrong_bound_leaves_it():
    matrix = np.array([[3.0, 2.5], [2.5, 3.0]])
    space = Space((line("a", low=0.0, mean=1.0, high=9.0), line("b", low=-5.0, high=5.0)))
    fit = refine(linear(matrix, matrix @ [4.0, -2.0]), space, [0.0, 5.0], FLAT)
    np.testing.assert_allclose(fit.best, [4.0, -2.0], atol=1e-5)


# ---------------------------------------------------------------- basins


def two_basins(values):
    """Minima near s = 3 and at s = -3, which alone leaves no residual; g settles at 4 s in either."""
    s, g = values[:, 0], values[:, 1]
    return np.stack([2.0 * (s**2 - 9.0), 0.5 * (s + 3.0), 3.0 * (g - 4.0 * s)], axis=1)


BASINS = Space((line("s"), line("g")))


def test_a_hypothesis_finds_the_lower_basin_that_descent_misses():
    """With g still at 12 the point s = -3 is far worse than where the descent stood: g must settle first."""
    plain = refine(two_basins, BASINS, [3.2, 12.0], FLAT)
    assert plain.best[0] == pytest.approx(3.0, abs=0.1) and plain.objective > 4.0
    there = 0.5 * np.sum(two_basins(np.array([[-3.0, plain.best[1]]])) ** 2)
    assert there > 100 * plain.objective
    fit = refine(two_basins, BASINS, [3.2, 12.0], FLAT, hypotheses=[{"s": 20.0}, {"s": -2.8}])
    np.testing.assert_allclose(fit.best, [-3.0, -12.0], atol=1e-4)
    assert fit.objective < 1e-6


def test_a_hypothesis_that_is_worse_changes_nothing():
    plain = refine(two_basins, BASINS, [-3.1, -12.0], FLAT)
    fit = refine(two_basins, BASINS, [-3.1, -12.0], FLAT, hypotheses=[{"s": 3.0}])
    np.testing.assert_allclose(fit.best, plain.best, atol=1e-6)
    np.testing.assert_allclose(fit.best, [-3.0, -12.0], atol=1e-4)


def test_the_best_of_several_starts_wins_and_each_says_where_it_ended():
    fit = refine(two_basins, BASINS, [[3.2, 12.0], [-3.3, -10.0]], dataclasses.replace(FLAT, keep=(1e9,)))
    np.testing.assert_allclose(fit.best, [-3.0, -12.0], atol=1e-4)
    upper = refine(two_basins, BASINS, [3.2, 12.0], FLAT).objective
    np.testing.assert_allclose(fit.starts, [upper, 0.0], atol=1e-3)


def rugged(values):
    """A bowl whose unit is one deviation, and steps: each cell 0.4 wide has its own offset up to 12 / 2."""
    cell = np.floor(values / 0.4)
    noise = np.modf(43758.5453 * np.sin(cell @ [12.9898, 78.233]))[0] ** 2
    return np.column_stack([values - [0.7, -0.4], np.sqrt(12.0 * noise)])


def test_hops_get_below_where_steps_stop_the_descent():
    """The lowest objective on a grid far finer than the cells is the oracle."""
    space = Space((line("a"), line("b")))
    side = np.arange(-4.0, 4.0, 0.02) + 0.01
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    lowest = np.min(0.5 * np.sum(rugged(grid) ** 2, axis=1))
    config = dataclasses.replace(FLAT, tolerance=0.5)
    stuck = refine(rugged, space, [3.5, -3.5], config)
    assert stuck.objective > lowest + HOP_TOLERANCE  # a hop is worth it
    hopped = refine(rugged, space, [3.5, -3.5], dataclasses.replace(config, hops=4))
    assert hopped.objective < lowest + 0.25


# ---------------------------------------------------------------- solver noise

ROUNDING = 0.05  # of each residual, noise units
ANGLE = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
APART, TOGETHER = 8.0 * np.sin(ANGLE), 0.08 * np.cos(2 * ANGLE)


def rounded(values):
    """Two parameters whose difference is seen well and whose sum is not; each replay rounds anew."""
    a, b = values[:, :1], values[:, 1:]
    rounding = ROUNDING * np.sin(1e7 * ((1.0 + ANGLE) * a + (2.0 - 0.1 * ANGLE) * b) + 100.0 * ANGLE)
    return APART * (a - b) + TOGETHER * (a + b) + rounding


def deviation_of_the_sum(jacobian, prior):
    along = np.array([1.0, 1.0]) / np.sqrt(2)
    hessian = jacobian.T @ jacobian + np.diag(prior**-2.0)
    return np.sqrt(along @ np.linalg.inv(hessian) @ along)


def test_slopes_over_the_posterior_s_width_do_not_take_rounding_for_information():
    config = dataclasses.replace(FLAT, tolerance=0.5, main_prior=50.0)
    space = Space((line("a"), line("b")))
    fit = refine(rounded, space, [0.3, 0.1], config)
    truth = np.stack([APART + TOGETHER, TOGETHER - APART], axis=1)
    true = deviation_of_the_sum(truth, fit.prior)

    problem = _Problem(rounded, space, config)
    state = problem.start(fit.x[None])
    narrow = dataclasses.replace(state, widths=np.full((1, 2), config.smallest_step))
    assert deviation_of_the_sum(problem.jacobian(narrow)[0], fit.prior) < 0.5 * true
    assert deviation_of_the_sum(problem.wide_jacobian(narrow), fit.prior) == pytest.approx(true, rel=0.15)
    assert deviation_of_the_sum(fit.jacobian, fit.prior) == pytest.approx(true, rel=0.15)


def test_the_wide_slopes_of_a_smooth_residual_are_its_derivatives_averaged_over_the_posterior():
    """r = 5 (v + c v^3): the central difference over h has slope 5 (1 + c h^2) at 0, h being 1.5 deviations."""
    fit = refine(lambda v: 5.0 * (v + 0.5 * v**3), Space((line("a"),)), [0.2], FLAT)
    slope = fit.jacobian[0, 0]
    half_width = np.sqrt(2 * (slope / 5.0 - 1.0))
    assert half_width == pytest.approx(1.5 / slope, rel=0.02)


# ---------------------------------------------------------------- the cheap part


def test_the_cheap_part_sorts_the_starts_and_all_data_give_the_result():
    """On all data the wrong basin has the lower objective at its start, but only the cheap part judges starts."""

    def whole(values):
        return np.concatenate([two_basins(values), 2.0 * (values[:, 1:] + [11.0, 10.0])], axis=1)

    cheap, full = Recorder(two_basins), Recorder(whole)
    fit = refine(full, BASINS, [[3.2, 12.0], [-3.2, -12.0]], FLAT, first=cheap)
    # s and g on all data, with s^2 - 9 linear about its end: one Gauss-Newton step goes nowhere
    residual = whole(fit.best[None])[0]
    slopes = np.array([[4 * fit.best[0], 0], [0.5, 0], [-12.0, 3.0], [0, 2.0], [0, 2.0]])
    np.testing.assert_allclose(np.linalg.lstsq(slopes, residual)[0], 0.0, atol=1e-3)
    assert -3.0 < fit.best[0] < -2.8 and -11.9 < fit.best[1] < -11.0
    np.testing.assert_array_equal(full.asked[0].round(3), [[-3.0, -12.0]])  # one row: the cheap part's winner
    assert np.all(full.rows[:, 0] < 0)
    assert fit.residual.shape == (5,)
    assert fit.evaluations == len(cheap.rows) + len(full.rows)


# ---------------------------------------------------------------- failed replays


def test_starts_that_all_fail_are_refused():
    with pytest.raises(ValueError, match="none of the starts could be replayed"):
        refine(lambda v: np.full((len(v), 3), np.nan), BASINS, [[0.0, 0.0], [1.0, 1.0]])


def test_a_start_that_fails_is_dropped_while_another_wins():
    matrix = np.array([[2.0, 1.0], [1.0, 3.0], [1.0, -1.0]])
    solved = linear(matrix, matrix @ [1.0, 2.0])
    recorder = Recorder(lambda v: np.where(v[:, :1] > 50.0, np.nan, solved(v)))
    fit = refine(recorder, BASINS, [[100.0, 0.0], [0.0, 0.0]], FLAT)
    np.testing.assert_allclose(fit.best, [1.0, 2.0], atol=1e-6)
    assert np.isinf(fit.starts[0]) and fit.starts[1] == pytest.approx(fit.objective, abs=1e-6)
    tried = [bool(np.any(rows[:, 0] > 50.0)) for rows in recorder.asked]
    assert tried[0] and not any(tried[len(tried) // 2 :])  # replayed at first, no longer at the end


def test_a_trial_that_fails_is_not_taken():
    """The full step would land at 10, beyond which nothing can be replayed; the optimum is at 8."""

    def cliff(values):
        return np.where(values > 9.0, np.nan, np.arctan(0.2 * (values - 8.0)) * 30.0)

    fit = refine(cliff, Space((line("a"),)), [-8.0], FLAT)
    assert fit.best[0] == pytest.approx(8.0, abs=1e-3)


def test_a_start_outside_the_bounds_is_refused():
    with pytest.raises(ValueError, match=r"'g'.*not inside its bounds"):
        refine(two_basins, BASINS, [0.0, 2000.0])


# ---------------------------------------------------------------- accounts


def test_progress_rises_and_every_replay_is_counted():
    """Through all stages: a cheap part, a hypothesis, all data, hops."""
    cheap, full, seen = Recorder(two_basins), Recorder(two_basins), []
    config = RefineConfig(main_prior=1e6, hop_generations=3)
    fit = refine(full, BASINS, [3.9, 9.0], config, first=cheap, hypotheses=[{"s": -2.8}], progress=seen.append)
    assert fit.evaluations == len(cheap.rows) + len(full.rows)
    numbers = [p.iteration for p in seen]
    assert len(numbers) > 3 and numbers[0] == 1 and np.all(np.diff(numbers) >= 1)
    assert numbers[-1] == fit.iterations and {p.iterations for p in seen} == {config.iterations}
    assert seen[-1].mean_square == pytest.approx(2 * fit.objective / 3, abs=1e-6)


def test_iterations_are_limited_and_then_nothing_has_converged():
    """Rosenbrock's valley takes more than three Jacobians of one batch each."""

    def rosenbrock(values):
        return np.stack([100.0 * (values[:, 1] - values[:, 0] ** 2), 1.0 - values[:, 0]], axis=1)

    seen = []
    start, few = [-1.2, 1.0], dataclasses.replace(FLAT, iterations=1)
    fit = refine(rosenbrock, BASINS, start, few, progress=seen.append)
    assert fit.iterations == 1 and len(seen) == 1 and not fit.converged
    long = refine(rosenbrock, BASINS, start, FLAT)
    assert long.converged and 1 < long.iterations < FLAT.iterations
    np.testing.assert_allclose(long.best, 1.0, atol=1e-3)
