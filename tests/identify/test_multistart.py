"""The refinement on residual functions in numpy whose optimum is known in closed form."""

import dataclasses
from functools import partial

import numpy as np
import pytest

from droid_jax.identify.levenberg_marquardt import DampedProblem, secant_slopes
from droid_jax.identify.multistart import Look, RefineConfig, chords, refine
from droid_jax.model.parameters import Parameter, Scaling, Space


def line(name, mean=0.0, std=1.0, low=-1000.0, high=1000.0, **kw):
    return Parameter(name, "u", mean, std, low, high, **kw)


def positive(name, mean, **kw):
    """A logarithmic parameter from a thousandth to a thousand times its mean, a unit being a factor 1.5."""
    return Parameter(name, "u", mean, 0.5 * mean, 1e-3 * mean, 1e3 * mean, scaling=Scaling.LOG, **kw)


class Recorder:
    """A residual function that records its rows."""

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
EXACT = RefineConfig(basin_hops=0, tolerance=1e-9, coarse_tolerance=0.0)
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
    """One datum at 3 of deviation 1, and a prior at 0 of deviation w: the posterior mean is 3 w^2 / (1 + w^2)."""
    for width in (0.5, 2.0):
        config = dataclasses.replace(EXACT, main_prior=width)
        fit = refine(linear([[1.0]], [3.0]), Space((line("a"),)), [0.0], config)
        assert fit.x[0] == pytest.approx(3.0 * width**2 / (1 + width**2), abs=1e-6)


PRECISE, WEAK = 3e4, 5.0


def two_masses():
    """2 m1 + 5 m2 is measured precisely, m1 poorly; the residual is zero at the truth, m1 = 3.5 and m2 = 0.1."""
    matrix = np.array([[2.0 * PRECISE, 5.0 * PRECISE], [WEAK, 0.0]])
    return linear(matrix, matrix @ [3.5, 0.1])


def test_correlated_logarithmic_parameters_reach_the_truth_along_a_curved_valley():
    """From m1 = 0.25, m2 = 1.4: the valley is straight in kg, but bends by a right angle in logarithms."""
    space = Space((positive("m1", 1.0), positive("m2", 1.0)))
    fit = refine(two_masses(), space, [0.25, 1.4], dataclasses.replace(FLAT, tolerance=1e-6))
    np.testing.assert_allclose(fit.best, [3.5, 0.1], rtol=1e-3)
    assert fit.converged


def test_the_first_candidates_include_the_full_step_straight_in_physical_units():
    """If residuals are linear in kg, one Gauss-Newton step that is straight in kg reaches the optimum."""
    matrix = np.array([[20.0, 50.0], [10.0, -30.0]])
    recorder = Recorder(linear(matrix, matrix @ [3.5, 0.1]))
    space = Space((positive("m1", 3.0), positive("m2", 0.3)))
    refine(recorder, space, [3.0, 0.3], dataclasses.replace(FLAT, step=1e-3))
    begun, first = recorder.asked[:2]
    assert len(begun) == 1 + 4  # the start with its differences
    assert np.min(np.max(np.abs(first / [3.5, 0.1] - 1), axis=1)) < 1e-4


def test_with_a_parameter_on_its_bound_the_others_reach_their_constrained_optimum():
    """The unconstrained optimum is beyond a's bound, and b and c are correlated with a."""
    matrix = np.array([[3.0, 2.5, 0.0], [2.5, 3.0, 1.0], [0.0, 1.0, 2.0], [1.0, 1.0, 1.0]])
    target = matrix @ [4.0, -2.0, 1.0]
    space = Space((line("a", high=1.5), line("b"), line("c")))
    fit = refine(linear(matrix, target), space, [0.0, 0.0, 0.0], FLAT)
    others = np.linalg.lstsq(matrix[:, 1:], target - 1.5 * matrix[:, 0])[0]
    assert fit.best[0] == 1.5
    np.testing.assert_allclose(fit.best[1:], others, atol=1e-5)
    np.testing.assert_allclose(fit.jacobian, matrix, atol=1e-7)


@pytest.mark.parametrize("a", [0.0, 0.1, 8.8, 9.0])
def test_differences_at_a_bound_are_divided_by_their_clipped_span(a):
    space = Space((line("a", low=0.0, mean=1.0, high=9.0), line("b")))
    matrix = np.array([[3.0, 2.5], [2.5, 3.0], [1.0, -1.0]])
    recorder = Recorder(linear(matrix, [1.0, 2.0, 3.0]))
    problem = DampedProblem(recorder, space, EXACT)
    state = problem.start(space.to_search(np.array([[a, 0.0]])))
    np.testing.assert_allclose(problem.jacobian(state)[0], matrix, atol=1e-9)
    np.testing.assert_allclose(problem.wide_jacobian(state, problem.jacobian(state)[0]), matrix, atol=1e-9)
    space.check(recorder.rows)


def test_a_start_on_the_wrong_bound_leaves_it():
    matrix = np.array([[3.0, 2.5], [2.5, 3.0]])
    space = Space((line("a", low=0.0, mean=1.0, high=9.0), line("b", low=-5.0, high=5.0)))
    fit = refine(linear(matrix, matrix @ [4.0, -2.0]), space, [0.0, 5.0], FLAT)
    np.testing.assert_allclose(fit.best, [4.0, -2.0], atol=1e-5)


# ---------------------------------------------------------------- basins


def two_basins(values):
    """Minima near s = 3 and at s = -3, where the residual is zero; g is 4 s at both."""
    s, g = values[:, 0], values[:, 1]
    return np.stack([2.0 * (s**2 - 9.0), 0.5 * (s + 3.0), 3.0 * (g - 4.0 * s)], axis=1)


BASINS = Space((line("s"), line("g", std=5.0)))


def test_a_hypothesis_finds_a_lower_basin_than_the_descent():
    """With g = 12 the point s = -3 is far worse than the descent's: g must be fitted first."""
    plain = refine(two_basins, BASINS, [3.2, 12.0], FLAT)
    assert plain.best[0] == pytest.approx(3.0, abs=0.1) and plain.objective > 4.0
    there = 0.5 * np.sum(two_basins(np.array([[-3.0, plain.best[1]]])) ** 2)
    assert there > 100 * plain.objective
    recorder = Recorder(two_basins)
    fit = refine(recorder, BASINS, [3.2, 12.0], FLAT, hypotheses=[{"s": 20.0}, {"s": -2.8}])
    held = recorder.rows[np.isclose(recorder.rows[:, 0], -2.8, rtol=0, atol=1e-9)]
    assert np.min(np.abs(held[:, 1] + 4 * 2.8)) < 0.01  # g has settled while s was held
    np.testing.assert_allclose(fit.best, [-3.0, -12.0], atol=1e-4)
    assert fit.objective < 1e-6


def test_a_hypothesis_that_is_worse_changes_nothing():
    plain = refine(two_basins, BASINS, [-3.1, -12.0], FLAT)
    tried = dataclasses.replace(FLAT, misfit_threshold=0.0)
    fit = refine(two_basins, BASINS, [-3.1, -12.0], tried, hypotheses=[{"s": 3.0}])
    assert fit.evaluations > plain.evaluations
    np.testing.assert_allclose(fit.best, plain.best, atol=1e-6)
    np.testing.assert_allclose(fit.best, [-3.0, -12.0], atol=1e-4)


def test_hypotheses_are_tried_only_if_the_residuals_are_large():
    plain = refine(two_basins, BASINS, [3.2, 12.0], FLAT)
    mean_square = np.mean(plain.residual**2)
    for doubt, end in ((1.01 * mean_square, plain.best), (0.99 * mean_square, [-3.0, -12.0])):
        config = dataclasses.replace(FLAT, misfit_threshold=doubt)
        fit = refine(two_basins, BASINS, [3.2, 12.0], config, hypotheses=[{"s": -2.8}])
        np.testing.assert_allclose(fit.best, end, atol=1e-4)


HOPPING = dataclasses.replace(FLAT, basin_hops=1, basin_hop_generations=1, basin_hop_misfit=np.inf)


def two_untold(values):
    """The same two minima, with a posterior of half a deviation: from the upper one the path down passes s = 0."""
    s, g = values[:, 0], values[:, 1]
    return np.stack([0.3 * (s**2 - 9.0), 0.5 * (s + 3.0), 3.0 * (g - 4.0 * s)], axis=1)


def test_a_distant_and_hardly_constrained_parameter_is_reset_and_fitted_again():
    recorder = Recorder(two_untold)
    stood = refine(two_untold, BASINS, [3.2, 12.0], FLAT)
    assert stood.best[0] == pytest.approx(2.5, abs=0.6) and stood.objective > 3.0
    fit = refine(recorder, BASINS, [3.2, 12.0], HOPPING)
    assert np.any(np.isclose(recorder.rows[:, 0], 0.0, rtol=0, atol=1e-9))
    np.testing.assert_allclose(fit.best, [-3.0, -12.0], atol=1e-3)
    assert fit.objective < 1e-6 and fit.converged


@pytest.mark.parametrize(
    ("space", "sharper"),
    [
        (Space((line("s", nuisance=True), line("g", std=5.0, nuisance=True))), 1.0),  # of no interest
        (BASINS, 1000.0),  # well constrained
        (Space((line("s", mean=2.5), line("g", mean=12.0, std=5.0))), 1.0),  # where they were expected
    ],
)
def test_no_other_parameter_is_reset(space, sharper):
    recorder = Recorder(lambda v: sharper * two_untold(v))
    refine(recorder, space, [3.2, 12.0], HOPPING)
    assert not np.any(np.isclose(recorder.rows[:, 0], space.mean[0], rtol=0, atol=1e-9))


def test_the_best_of_several_starts_is_the_result_and_all_final_objectives_are_reported():
    fit = refine(two_basins, BASINS, [[3.2, 12.0], [-3.3, -10.0]], dataclasses.replace(FLAT, pruning_ratio=(1e9,)))
    np.testing.assert_allclose(fit.best, [-3.0, -12.0], atol=1e-4)
    upper = refine(two_basins, BASINS, [3.2, 12.0], FLAT).objective
    np.testing.assert_allclose(fit.starts, [upper, 0.0], atol=1e-3)


def test_starts_far_worse_than_the_best_are_dropped():
    """The second start begins two hundred times as high; it is dropped when the pruning ratio is lower."""
    starts = [[-8.0, -12.0], [20.0, 0.0]]
    heights = 0.5 * np.sum(two_basins(np.array(starts)) ** 2, axis=1)
    assert heights[1] > 20 * heights[0]

    def iterations_of_the_second(keep):
        recorder = Recorder(two_basins)
        refine(recorder, BASINS, starts, dataclasses.replace(FLAT, pruning_ratio=keep))
        # Of two starts, the first time with the starts themselves; four rows for one.
        return sum(len(rows) in (8, 10) for rows in recorder.asked)

    assert iterations_of_the_second((1.0,)) == 1
    assert iterations_of_the_second((1e9, 1e9, 1.0)) == 3


def stepped(values):
    """A bowl about (0.7, -0.4), a unit being one deviation, with 8 on top where a < 1.9 and 6 where b > -1.6."""
    a, b = values[:, 0], values[:, 1]
    on_top = np.where(a < 1.9, 8.0, 0.0) + np.where(b > -1.6, 6.0, 0.0)
    return np.stack([a - 0.7, b + 0.4, np.sqrt(2 * on_top)], axis=1)


def test_basin_hops_pass_steps_that_derivatives_do_not_show():
    """The lowest point is the corner (1.9, -1.6): 1.2 deviations from the bowl's bottom in either direction."""
    space, config = Space((line("a"), line("b"))), dataclasses.replace(FLAT, tolerance=0.5)
    stuck = refine(stepped, space, [-1.0, 1.0], config)
    np.testing.assert_allclose(stuck.best, [0.7, -0.4], atol=1e-3)
    assert stuck.objective == pytest.approx(14.0, abs=1e-3)
    hopping = dataclasses.replace(config, basin_hops=4, basin_hop_misfit=np.inf)
    hopped = refine(stepped, space, [-1.0, 1.0], hopping)
    assert 1.44 <= hopped.objective < 1.44 + 0.2
    np.testing.assert_allclose(hopped.best, [1.9, -1.6], atol=0.1)
    assert hopped.converged


def test_there_are_no_basin_hops_for_a_model_far_from_the_data():
    """The mean square of its residuals is about ten."""
    space, config = Space((line("a"), line("b"))), dataclasses.replace(FLAT, tolerance=0.5, basin_hop_misfit=3.0)
    stood, hopping = (
        refine(stepped, space, [-1.0, 1.0], dataclasses.replace(config, basin_hops=hops)) for hops in (0, 4)
    )
    assert np.mean(stood.residual**2) > 3.0
    np.testing.assert_array_equal(hopping.best, stood.best)
    assert hopping.converged


def test_a_hop_that_finds_no_better_basin_is_the_last():
    matrix, target = np.array([[2.0, 1.0], [1.0, 3.0], [1.0, -1.0]]), np.array([1.0, 2.0, 3.0])
    space = Space((line("a"), line("b")))

    def fit(hops):
        config = dataclasses.replace(FLAT, basin_hops=hops, basin_hop_generations=3, basin_hop_misfit=3.0)
        return refine(linear(matrix, target), space, [5.0, 5.0], config)

    none, one, four = fit(0), fit(1), fit(4)
    assert four.evaluations == one.evaluations > none.evaluations + 3 * EXACT.basin_hop_population
    np.testing.assert_allclose(four.best, np.linalg.lstsq(matrix, target)[0], atol=1e-6)
    assert four.converged


# ---------------------------------------------------------------- solver noise

ROUNDING = 0.05  # of each residual, noise units
ANGLE = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
APART, TOGETHER = 8.0 * np.sin(ANGLE), 0.08 * np.cos(2 * ANGLE)


def rounded(values):
    """Two parameters whose difference is constrained and whose sum is not; each replay has another rounding error."""
    a, b = values[:, :1], values[:, 1:]
    rounding = ROUNDING * np.sin(1e7 * (np.sqrt(2.0 + ANGLE) * a + np.sqrt(3.0 + ANGLE) * b))
    return APART * (a - b) + TOGETHER * (a + b) + rounding


def deviation_of_the_sum(jacobian, prior):
    along = np.array([1.0, 1.0]) / np.sqrt(2)
    hessian = jacobian.T @ jacobian + np.diag(prior**-2.0)
    return np.sqrt(along @ np.linalg.inv(hessian) @ along)


def test_differences_over_the_posterior_width_do_not_take_rounding_for_information():
    config = dataclasses.replace(FLAT, tolerance=0.5, main_prior=50.0)
    space = Space((line("a"), line("b")))
    fit = refine(rounded, space, [0.3, 0.1], config)
    truth = np.stack([APART + TOGETHER, TOGETHER - APART], axis=1)
    true = deviation_of_the_sum(truth, fit.prior)

    problem = DampedProblem(rounded, space, config)
    state = problem.start(fit.x[None])
    narrow = dataclasses.replace(state, widths=np.full((1, 2), config.smallest_step))
    assert deviation_of_the_sum(problem.jacobian(narrow)[0], fit.prior) < 0.5 * true
    wide = problem.wide_jacobian(narrow, problem.jacobian(narrow)[0])
    assert deviation_of_the_sum(wide, fit.prior) == pytest.approx(true, rel=0.15)
    assert deviation_of_the_sum(fit.jacobian, fit.prior) == pytest.approx(true, rel=0.15)


def test_the_wide_slopes_of_a_smooth_residual_are_its_derivatives_averaged_over_the_posterior():
    """r = 5 (v + c v^3): the central difference over h has slope 5 (1 + c h^2) at 0, h being 1.5 deviations."""
    fit = refine(lambda v: 5.0 * (v + 0.5 * v**3), Space((line("a"),)), [0.2], FLAT)
    slope = fit.jacobian[0, 0]
    half_width = np.sqrt(2 * (slope / 5.0 - 1.0))
    assert half_width == pytest.approx(1.5 / slope, rel=0.02)


# ---------------------------------------------------------------- the cheap part


def test_starts_are_compared_on_the_cheap_part_and_the_result_is_of_all_data():
    """d = g - 4 s is 2 on the cheap part (3 deviations strong), -1 on the rest (4 strong): 2 / 25 on all data."""

    def part(values):
        return two_basins(values - [0.0, 2.0])

    def whole(values):
        rest = 4.0 * (values[:, 1] - 4.0 * values[:, 0] + 1.0)
        return np.concatenate([part(values), rest[:, None]], axis=1)

    cheap, full = Recorder(part), Recorder(whole)
    fit = refine(full, BASINS, [[3.2, 14.0], [-3.2, -10.0]], FLAT, first=cheap)
    np.testing.assert_allclose(fit.best, [-3.0, -12.0 + 2 / 25], atol=1e-4)
    np.testing.assert_allclose(
        full.asked[0][0], [-3.0, -10.0], atol=1e-3
    )  # where the cheap part's winner ended, before its differences
    assert np.all(full.rows[:, 0] < 0)
    assert fit.residual.shape == (4,) and fit.jacobian.shape == (4, 2)


# ---------------------------------------------------------------- failed replays


def test_starts_that_all_fail_are_refused():
    with pytest.raises(ValueError, match="none of the starts could be replayed"):
        refine(lambda v: np.full((len(v), 3), np.nan), BASINS, [[0.0, 0.0], [1.0, 1.0]])


def test_a_start_that_fails_is_dropped_while_another_wins():
    matrix = np.array([[2.0, 1.0], [1.0, 3.0], [1.0, -1.0]])
    solved = linear(matrix, matrix @ [1.0, 2.0])

    def replayed(values):
        BASINS.check(values)  # as a cost does: no NaN among the values that it is asked for
        return np.where(values[:, :1] > 50.0, np.nan, solved(values))

    recorder = Recorder(replayed)
    fit = refine(recorder, BASINS, [[100.0, 0.0], [0.0, 0.0]], FLAT)
    np.testing.assert_allclose(fit.best, [1.0, 2.0], atol=1e-6)
    assert np.isinf(fit.starts[0]) and fit.starts[1] == pytest.approx(fit.objective, abs=1e-6)
    trials = FLAT.trials
    assert [len(rows) for rows in recorder.asked[:2]] == [2 + 8, trials]  # both with differences, then trials of one


def test_a_hypothesis_that_fails_is_dropped_while_another_wins():
    """Replays beyond s = 50 blow up, and so do steps from there."""

    def replayed(values):
        BASINS.check(values)
        return np.where(values[:, :1] > 50.0, np.nan, two_basins(values))

    hypotheses = [{"s": 90.0}, {"s": -3.0}]
    fit = refine(replayed, BASINS, [3.2, 14.0], FLAT, hypotheses=hypotheses)
    assert fit.best[0] == pytest.approx(-3.0, abs=1e-3)
    alone = refine(replayed, BASINS, [3.2, 14.0], FLAT, hypotheses=hypotheses[:1])
    assert alone.best[0] > 0


def test_a_start_that_fails_on_all_the_data_is_refused():
    with pytest.raises(ValueError, match="could not be replayed on all"):
        refine(lambda v: np.full((len(v), 3), np.nan), BASINS, [3.2, 14.0], FLAT, first=two_basins)


def first_look(residuals, space, starts, slopes, config=None):
    """The values and objective of one look, over its free parameters."""
    (found,) = chords(residuals, [Look(space, np.array(starts), slopes, lambda rows: rows)], config)
    return found


def test_a_first_look_does_not_move_if_all_replays_blow_up():
    values, objective = first_look(lambda v: np.full((len(v), 2), np.nan), BASINS, [[1.0, 2.0]], np.eye(2))
    np.testing.assert_allclose(values, [1.0, 2.0])
    assert np.isinf(objective)


def test_a_first_look_begins_at_the_best_of_its_starts():
    """Steps of at most two units do not reach the optimum from the first start; the second is close to it."""
    space, slopes = Space((line("a"),)), np.ones((1, 1))
    far, _ = first_look(linear(slopes, [40.0]), space, [[0.0]], slopes, RefineConfig())
    assert 0.0 < far[0] < 10.0
    values, objective = first_look(linear(slopes, [40.0]), space, [[0.0], [39.0]], slopes)
    assert values[0] == pytest.approx(40.0 / (1 + 1 / 16), abs=0.01)  # the prior is four deviations wide
    assert objective == pytest.approx(0.5 * 40.0**2 / 17, rel=1e-4)


def test_a_first_look_takes_the_configured_steps():
    recorder = Recorder(linear(np.ones((1, 1)), [40.0]))
    few = RefineConfig(dampings=(1e-2, 1e1, 1e3), lengths=(1.0,), chords=1)
    first_look(recorder, Space((line("a"),)), [[0.0]], np.ones((1, 1)), few)
    assert [len(rows) for rows in recorder.asked] == [1, few.trials] and few.trials == 6


def test_first_looks_share_batches_and_end_as_if_they_were_separate():
    """Each frees one of two parameters.  The first is linear and converges after one batch."""

    def separate(v: np.ndarray) -> np.ndarray:
        return np.stack([v[:, 0] - 1.5, 10.0 * np.arctan(0.1 * (3.0 * v[:, 1] - 30.0))], axis=1)

    recorder, slopes = Recorder(separate), np.diag([1.0, 3.0])
    looks = [
        Look(Space((line(name),)), np.array([[0.0], [1.0]]), slopes[:, [k]], partial(with_zero, k))
        for k, name in enumerate("ab")
    ]
    config = RefineConfig()
    together, batches = chords(recorder, looks, config), [len(rows) for rows in recorder.asked]
    each = 2 * RefineConfig().trials  # of a look of two starts
    assert batches == [4, 2 * each, each, each]
    for look, found in zip(looks, together, strict=True):
        alone = chords(recorder, [look], config)[0]
        np.testing.assert_allclose(found[0], alone[0])
        assert found[1] == pytest.approx(alone[1])


def with_zero(column: int, rows: np.ndarray) -> np.ndarray:
    """[P, 2] rows [P, 1] of one parameter, the other at zero."""
    whole = np.zeros((len(rows), 2))
    whole[:, [column]] = rows
    return whole


def test_a_candidate_step_that_blows_up_is_not_taken():
    """The first full step is from -8 to 12; replays beyond 9 blow up, and the optimum is at 8."""
    cliff = Recorder(lambda v: np.where(v > 9.0, np.nan, 30.0 * np.arctan(0.2 * (v - 8.0))))
    fit = refine(cliff, Space((line("a", std=10.0),)), [-8.0], dataclasses.replace(FLAT, step=0.05))
    assert np.any(cliff.rows > 9.0)
    assert fit.best[0] == pytest.approx(8.0, abs=1e-3)


def test_a_start_outside_the_bounds_is_refused():
    with pytest.raises(ValueError, match=r"'g'.*not inside its bounds"):
        refine(two_basins, BASINS, [0.0, 2000.0])


# ---------------------------------------------------------------- accounts


def test_progress_rises_and_every_replay_is_counted():
    """The stages are a cheap part, a hypothesis, all data, and hops."""
    cheap, full, reports = Recorder(two_basins), Recorder(two_basins), []
    config = RefineConfig(main_prior=1e6, basin_hop_generations=3)
    fit = refine(full, BASINS, [3.9, 9.0], config, first=cheap, hypotheses=[{"s": -2.8}], progress=reports.append)
    assert fit.evaluations == len(cheap.rows) + len(full.rows)
    numbers = [p.iteration for p in reports]
    assert len(numbers) > 3 and numbers[0] == 1 and np.all(np.diff(numbers) >= 1)
    assert numbers[-1] == fit.iterations and {p.iterations for p in reports} == {config.iterations}
    assert reports[-1].mean_square == pytest.approx(2 * fit.objective / 3, abs=1e-6)


def test_iterations_are_limited_and_the_result_is_then_not_converged():
    """Rosenbrock's valley takes more than one Jacobian."""

    def rosenbrock(values):
        return np.stack([10.0 * (values[:, 1] - values[:, 0] ** 2), 1.0 - values[:, 0]], axis=1)

    reports = []
    start, few = [-1.2, 1.0], dataclasses.replace(FLAT, iterations=1)
    fit = refine(rosenbrock, BASINS, start, few, progress=reports.append)
    assert fit.iterations == 1 and len(reports) == 1 and not fit.converged
    assert fit.objective > 0.1 and reports[0].mean_square == pytest.approx(np.mean(fit.residual**2), rel=1e-6)
    long = refine(rosenbrock, BASINS, start, FLAT)
    assert long.converged and 1 < long.iterations < FLAT.iterations
    np.testing.assert_allclose(long.best, 1.0, atol=1e-3)


def test_a_failed_replay_within_the_posterior_does_not_end_the_refinement():
    matrix = np.array([[5.0, 1.0], [1.0, 4.0], [2.0, 2.0]])
    solved = linear(matrix, matrix @ [0.0, 1.0])
    fit = refine(lambda v: np.where(v[:, :1] > 0.05, np.nan, solved(v)), BASINS, [-1.0, 0.0], FLAT)
    np.testing.assert_allclose(fit.best, [0.0, 1.0], atol=1e-3)


def test_a_fit_is_kept_if_all_replays_around_it_blow_up():
    """A hop draws far from the converged point, where all replays blow up."""
    inside = linear(np.eye(2), [0.0, 1.0])
    near = Recorder(lambda v: np.where(np.linalg.norm(v - [0.0, 1.0], axis=1, keepdims=True) > 0.02, np.nan, inside(v)))
    fit = refine(near, BASINS, [0.01, 1.0], dataclasses.replace(FLAT, basin_hops=2, step=1e-3))
    np.testing.assert_allclose(fit.best, [0.0, 1.0], atol=1e-3)
    assert fit.converged and np.any(np.linalg.norm(near.rows - [0.0, 1.0], axis=1) > 0.1)


def test_replays_nearby_that_blow_up_are_no_information():
    matrix = np.array([[5.0, 1.0], [1.0, 4.0], [2.0, 2.0]])
    solved = linear(matrix, matrix @ [0.0, 1.0])
    fit = refine(lambda v: np.where(v[:, :1] > 0.03, np.nan, solved(v)), BASINS, [-1.0, 0.0], FLAT)
    truth = matrix * [1, 5]
    np.testing.assert_allclose(
        np.sqrt(np.diag(np.linalg.inv(fit.hessian))), np.sqrt(np.diag(np.linalg.inv(truth.T @ truth))), rtol=0.3
    )


def test_a_replay_that_blows_up_on_one_recording_of_two_is_no_information():
    """b is not constrained: one side of its difference blows up on the second recording, which is no slope."""
    matrix = np.array([[5.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    solved = linear(matrix, matrix @ [0.0, 0.0])

    def both(v, where):
        one, two = solved(v), np.where(v[:, 1:] > 0.02, np.nan, solved(v))
        return np.concatenate([two, two] if where == "both" else [one, two], axis=1)

    deviation = {
        where: np.sqrt(np.diag(np.linalg.inv(refine(lambda v, w=where: both(v, w), BASINS, [1.0, 0.0], FLAT).hessian)))
        for where in ("both", "second")
    }
    np.testing.assert_allclose(deviation["second"], deviation["both"], rtol=0.05)
    with pytest.raises(ValueError, match="none of the starts could be replayed"):
        refine(lambda v: np.concatenate([solved(v), np.full((len(v), 3), np.nan)], axis=1), BASINS, [1.0, 0.0], FLAT)


def test_a_better_basin_is_kept():
    def step(v):
        return np.stack([v[:, 0] - 0.7, v[:, 1] + 0.4, np.sqrt(2 * np.where(v[:, 0] < 1.9, 2.0, 0.0))], axis=1)

    space = Space((line("a"), line("b")))
    fit = refine(step, space, [-1.0, 1.0], RefineConfig(main_prior=1e6))
    assert fit.objective < 1.9  # 0.72 is found by the hop, 2.0 returned


def test_a_target_objective_out_of_reach_is_given_up_and_one_within_reach_is_not():
    """In a quartic valley the decrease becomes smaller and smaller: a distant target is not reached, the bottom is."""
    space = Space((line("a", 0.0, 1.0),))

    def quartic(values):
        return (values - 50.0) ** 2 * 0.2

    plain = RefineConfig(basin_hops=0, tolerance=1e-3, coarse_tolerance=0.0, main_prior=1e6)
    whole = refine(quartic, space, [0.0], plain)
    reachable = refine(quartic, space, [0.0], dataclasses.replace(plain, target_objective=0.0))
    hopeless = refine(quartic, space, [0.0], dataclasses.replace(plain, target_objective=-5e5))
    assert reachable.objective == whole.objective and reachable.evaluations == whole.evaluations
    assert hopeless.evaluations < whole.evaluations
    assert hopeless.objective > whole.objective
    assert whole.converged and reachable.converged and not hopeless.converged
    still = refine(quartic, space, [50.0], dataclasses.replace(plain, target_objective=-5e5))
    assert still.converged


def test_a_period_is_found_though_the_first_differences_span_a_whole_one():
    """A ripple of 17.7 periods begun at 20: half a deviation's difference, 5 periods, says nothing about its slope."""
    times = np.linspace(0.0, 1.0, 200)
    space = Space((line("sine"), line("cosine"), line("periods", 36.0, std=17.5, low=10.0, high=80.0)))

    def residuals(values):
        sine, cosine, periods = values.T[..., None]
        return 30.0 * (sine * np.sin(periods * times) + cosine * np.cos(periods * times) - 0.5 * np.sin(17.7 * times))

    start = np.array([[0.25, -0.3, 20.0]])
    fit = refine(residuals, space, start, RefineConfig(iterations=8, basin_hops=0, spreads=0, target_objective=100.0))
    np.testing.assert_allclose(fit.best, [0.5, 0.0, 17.7], atol=0.02)


def test_trials_correct_the_slopes_along_their_own_steps_alone():
    rng = np.random.default_rng(0)
    truth, known = rng.normal(size=(9, 4)), rng.normal(size=(9, 4))
    steps = np.array([[0.1, 0.0, 0.0, 0.0], [0.1, 0.3, 0.0, 0.0], [0.0, 0.0, 9.0, 9.0]])
    changes = steps @ truth.T
    changes[2] = np.nan  # a replay that failed says nothing
    found = secant_slopes(known, np.ones(4), steps, changes, ridge=1e-9)
    np.testing.assert_allclose(found[:, :2], truth[:, :2], atol=1e-5)
    np.testing.assert_array_equal(found[:, 2:], known[:, 2:])
    np.testing.assert_array_equal(secant_slopes(known, np.ones(4), steps[2:], changes[2:], 0.1), known)


def test_short_steps_correct_the_slopes_more_than_long_ones():
    """x + x^2 at zero: a step of 0.1 shows a slope of 1.1, one of 2 shows 3."""
    steps = np.array([[0.1], [2.0]])
    found = secant_slopes(np.zeros((1, 1)), np.ones(1), steps, steps + steps**2, ridge=1e-9)
    assert 1.1 < found[0, 0] < 1.2


def test_corrected_slopes_save_replays():
    """A chain of Rosenbrock's valleys in 20 parameters, whose differences take more replays than candidate steps."""
    space = Space(tuple(line(f"v{k}") for k in range(20)))

    def chain(x: np.ndarray) -> np.ndarray:
        return np.concatenate([10.0 * (x[:, 1:] - x[:, :-1] ** 2), 1.0 - x[:, :-1]], axis=1)

    counts = {}
    for ridge in (1e-2, None):
        fit = refine(chain, space, np.zeros(20), dataclasses.replace(FLAT, secant_ridge=ridge, iterations=90))
        np.testing.assert_allclose(fit.best, 1.0, atol=1e-4)
        counts[ridge] = fit.evaluations
    assert counts[1e-2] < 0.7 * counts[None], counts


def test_where_differences_are_cheap_they_are_taken_anew():
    """Two parameters: four replays of differences, 32 of candidate steps."""
    counts = [
        refine(two_basins, BASINS, [3.2, 14.0], dataclasses.replace(FLAT, secant_ridge=ridge)).evaluations
        for ridge in (1e-2, None)
    ]
    assert counts[0] == counts[1]
