"""The calibrated Gaussian against sandwiches in closed form, and how often its intervals hold the truth."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from droid_jax.identify import identifiability as uncertainty
from droid_jax.identify.gaussian import Gaussian, prior
from droid_jax.identify.identifiability import (
    DEFAULT_IDENTIFIABILITY,
    calibrated,
    identifiability,
    not_judged,
    posterior,
    time_blocks,
    with_stated_prior,
)
from droid_jax.identify.multistart import Refined
from droid_jax.model.parameters import Parameter, Space


def space_of(dims, nuisances=0):
    names = [f"p{i}" for i in range(dims)]
    late = dims - nuisances
    return Space(tuple(Parameter(n, "u", 0.0, 1.0, -1e4, 1e4, nuisance=i >= late) for i, n in enumerate(names)))


def fitted(jacobian, residual=None, *, x=None, width=4.0, nuisances=0):
    """A refinement that ended at x with this Jacobian [M, D]; the residual is zero by default."""
    rows, dims = jacobian.shape
    space = space_of(dims, nuisances)
    residual = np.zeros(rows) if residual is None else residual
    x = np.zeros(dims) if x is None else x
    return Refined(
        space=space,
        x=x,
        best=space.from_search(x),
        objective=0.5 * float(residual @ residual),
        residual=residual,
        jacobian=jacobian,
        prior=np.where(space.nuisance, 1.0, width),
        starts=np.zeros(1),
        evaluations=0,
        iterations=0,
        converged=True,
    )


def one_block(jacobian):
    return np.zeros(len(jacobian), int)


def deviations(gaussian):
    return np.sqrt(np.diag(gaussian.cov))


def deviations_from_mean(repeats):
    """Deviations of repeats [N, M] from their mean, as a comparison gives them."""
    return repeats - repeats.mean(axis=0)


def white(rng, count, size):
    """Repeats whose mean has unit noise, independent from residual to residual."""
    return np.sqrt(count) * rng.normal(size=(count, size))


def exactly(scale, count, size):
    """Deviations [N, M] of repeats whose mean has noise of exactly this scale, uncorrelated between residuals."""
    draws = deviations_from_mean(np.random.default_rng(9).normal(size=(count, size)))
    return scale * np.sqrt(count * (count - 1)) * np.linalg.qr(draws)[0]


SKEW = np.random.default_rng(0).normal(size=(30, 3)) @ np.array([[6.0, 3.0, 0.0], [0.0, 4.0, 1.0], [0.0, 0.0, 5.0]])
SQUARE = np.kron(np.eye(2), np.full((8, 1), 5.0))  # [16, 2]: eight residuals see p0 alone, eight see p1 alone


# ---------------------------------------------------------------- scatter between repeats


def test_repeats_with_the_assumed_noise_give_the_gauss_newton_covariance():
    """A thousand repeats whose mean has unit white noise, as H^-1 assumes."""
    fit = fitted(SKEW)
    gaussian = calibrated(fit, [deviations_from_mean(white(np.random.default_rng(1), 1000, 30))], one_block(SKEW))
    plain = np.linalg.inv(SKEW.T @ SKEW + np.eye(3) / 16)
    np.testing.assert_allclose(gaussian.cov, plain, rtol=0.1)
    np.testing.assert_array_equal(gaussian.mean, fit.x)
    assert gaussian.coordinates == "search" and gaussian.space is fit.space


def test_repeats_that_scatter_twice_as_far_double_every_deviation():
    fit = fitted(SKEW, nuisances=1)
    gaussian = calibrated(fit, [exactly(2.0, 40, 30)], one_block(SKEW))
    # the share of the prior is not widened, hence the tolerance
    np.testing.assert_allclose(gaussian.cov, 4.0 * np.linalg.inv(fit.hessian), rtol=2e-3)
    assert "(x2.00 in the median)" in gaussian.rule


def test_quiet_repeats_do_not_narrow():
    fit = fitted(SKEW)
    gaussian = calibrated(fit, [exactly(0.1, 40, 30)], one_block(SKEW))
    np.testing.assert_allclose(gaussian.cov, np.linalg.inv(fit.hessian), rtol=1e-9)


def test_a_pattern_shared_by_all_residuals_widens_the_parameter_that_it_looks_like():
    """Repeats differ by c_n times p0's slopes: var(p0) is that of the mean of the c_n, shrunk to the pooled one."""
    shifts = np.array([-9.0, -3.0, -2.0, 0.0, 5.0, 9.0])
    count = len(shifts)
    pattern = np.outer(shifts, SQUARE[:, 0])
    gaussian = calibrated(fitted(SQUARE), [pattern], one_block(SQUARE))

    slopes = 8 * 25.0  # |column|^2; the mean of the c_n scatters by shifts @ shifts / (N (N - 1))
    plain, assumed = 1 / (slopes + 1 / 16), 1 / slopes
    own = (shifts @ shifts) / (count * (count - 1)) / assumed
    weight = (count - 1) / (count - 1 + DEFAULT_IDENTIFIABILITY.pooling)
    ratio = np.array([weight * own, 0.0]) + (1 - weight) * own / 2  # the pool: half of the two parameters' spread
    np.testing.assert_allclose(np.diag(gaussian.cov), plain * ratio, rtol=2e-3)


def test_own_ratio_outweighs_the_pool_with_many_repeats():
    rng = np.random.default_rng(4)
    repeats = white(rng, 400, 16) + np.outer(rng.normal(scale=20.0, size=400), SQUARE[:, 0]) / np.sqrt(200.0)
    gaussian = calibrated(fitted(SQUARE), [deviations_from_mean(repeats)], one_block(SQUARE))
    factor = deviations(gaussian) * np.sqrt(200.0 + 1 / 16)
    # the shared part adds 20^2 / N to a variance of 1: p0 doubles its variance, p1 keeps it
    np.testing.assert_allclose(factor**2, [2.0, 1.0], rtol=0.12)


def test_one_repeat_widens_nothing():
    fit = fitted(SKEW)
    gaussian = calibrated(fit, [np.full((1, 30), 50.0)], one_block(SKEW))
    np.testing.assert_allclose(gaussian.cov, np.linalg.inv(fit.hessian), rtol=1e-12)


def test_the_repeats_of_a_recording_apply_to_its_residuals_only():
    """Each of two recordings constrains one parameter.  The second's repeats scatter three times as far."""
    count = 101
    recordings = [np.zeros((1, 8)), exactly(3.0, count, 8)]
    gaussian = calibrated(fitted(SQUARE), recordings, one_block(SQUARE))
    weight = (count - 1) / (count - 1 + DEFAULT_IDENTIFIABILITY.pooling)
    ratio = weight * np.array([1.0, 9.0]) + (1 - weight) * 5.0  # the pool: the mean of 1 and 9
    np.testing.assert_allclose(np.diag(gaussian.cov) * (200.0 + 1 / 16), ratio, rtol=2e-3)


# ---------------------------------------------------------------- scatter of the blocks


BLOCK = 6
COLUMN = np.repeat([3.0, -2.0, 4.0, 1.0], BLOCK)[:, None]  # slopes that are constant in each of four blocks
SIGNS = np.repeat([1.0, 1.0, -1.0, 1.0], BLOCK)
IDS = np.repeat(np.arange(4), BLOCK)
SINGLE = [np.zeros((1, len(COLUMN)))]  # one repeat: the blocks alone decide


def test_residuals_constant_within_blocks_widen_by_their_sandwich():
    """Six equal residuals are one datum for the blocks' scores, but six for H^-1."""
    gaussian = calibrated(fitted(COLUMN, SIGNS), SINGLE, IDS)
    squares = 9.0 + 4.0 + 16.0 + 1.0
    hessian = BLOCK * squares + 1 / 16
    assert gaussian.cov[0, 0] == pytest.approx((BLOCK**2 * squares + 1 / 16) / hessian**2, rel=1e-9)
    assert gaussian.cov[0, 0] == pytest.approx(BLOCK / hessian, rel=1e-2)


def test_a_model_that_is_taken_to_be_right_is_not_widened_by_its_residual():
    fit = fitted(COLUMN, SIGNS)
    assert deviations(calibrated(fit, SINGLE, None)) == pytest.approx(np.sqrt(np.diag(np.linalg.inv(fit.hessian))))
    loud = [exactly(2.0, 40, 30)]
    assert np.array_equal(
        deviations(calibrated(fitted(SKEW), loud, None)), deviations(calibrated(fitted(SKEW), loud, one_block(SKEW)))
    )


def test_residuals_that_alternate_within_blocks_widen_nothing():
    alternating = np.tile([1.0, -1.0], len(COLUMN) // 2)
    gaussian = calibrated(fitted(COLUMN, alternating), SINGLE, IDS)
    assert gaussian.cov[0, 0] == pytest.approx(1 / (BLOCK * 30.0 + 1 / 16), rel=1e-9)


def test_the_larger_of_both_scatters_is_used_for_each_parameter():
    """Eight equal residuals make p0's variance 8 times as large; the repeats make both parameters' 4 times."""
    residual = np.concatenate([np.ones(8), np.tile([1.0, -1.0], 4)])
    ids = np.repeat([0, 1], 8)
    gaussian = calibrated(fitted(SQUARE, residual, nuisances=1), [exactly(2.0, 20, 16)], ids)
    np.testing.assert_allclose(np.diag(gaussian.cov) * (200.0 + 1 / 16), [8.0, 4.0], rtol=1e-2)
    assert "(x2.83 in the median)" in gaussian.rule  # of the parameters of interest: p1 is a nuisance


def test_widening_keeps_correlations():
    """Deviations change by different factors, correlations do not."""
    rng = np.random.default_rng(7)
    repeats = deviations_from_mean(
        white(rng, 50, 30) + 30.0 * np.outer(rng.normal(size=50), SKEW[:, 0] / np.linalg.norm(SKEW[:, 0]))
    )
    fit = fitted(SKEW, nuisances=1)
    plain, wide = np.linalg.inv(fit.hessian), calibrated(fit, [repeats], one_block(SKEW)).cov
    factor = np.sqrt(np.diag(wide) / np.diag(plain))
    assert np.ptp(factor) > 0.3
    np.testing.assert_allclose(wide, plain * np.outer(factor, factor), rtol=1e-9)


# ---------------------------------------------------------------- coverage


REPEATS = 10


def one_problem(rng):
    """A linear problem's fit, its repeats and its truth; each repeat has an error common to all residuals."""
    jacobian = rng.normal(size=(40, 3)) @ (np.eye(3) + 0.5 * rng.normal(size=(3, 3)))
    truth = rng.normal(scale=4.0, size=3)
    pose = np.sqrt(REPEATS) * rng.normal(size=(REPEATS, 3)) @ rng.normal(size=(3, 40))
    repeats = jacobian @ truth + white(rng, REPEATS, 40) + pose
    measured = repeats.mean(axis=0)
    x = np.linalg.solve(jacobian.T @ jacobian + np.eye(3) / 16, jacobian.T @ measured)
    return fitted(jacobian, jacobian @ x - measured, x=x), deviations_from_mean(repeats), truth


def another_problem(rng):
    """The same for one repeat, with an error that is constant over four residuals, a hundred times."""
    jacobian = np.repeat(rng.normal(size=(100, 3)), 4, axis=0)
    truth = rng.normal(scale=4.0, size=3)
    measured = jacobian @ truth + np.repeat(rng.normal(size=100), 4)
    x = np.linalg.solve(jacobian.T @ jacobian + np.eye(3) / 16, jacobian.T @ measured)
    return fitted(jacobian, jacobian @ x - measured, x=x), np.zeros((1, 400)), truth


def coverage(gaussians, truths):
    """[D] share of the truths [P, D] that lie in the 90 % intervals."""
    low, high = np.stack([g.interval(0.9) for g in gaussians], axis=1)
    return np.mean((low <= truths) & (truths <= high), axis=0)


@pytest.mark.parametrize(
    ("problem", "block"),
    [(one_problem, 40), (one_problem, 4), (another_problem, 4)],
    ids=["repeats", "repeats and blocks", "blocks"],
)
def test_ninety_percent_intervals_hold_the_truth_in_nine_of_ten_problems(problem, block):
    rng = np.random.default_rng(8)
    problems = [problem(rng) for _ in range(300)]
    truths = np.stack([truth for _, _, truth in problems])
    wide = [calibrated(fit, [repeats], np.arange(len(fit.residual)) // block) for fit, repeats, _ in problems]
    plain = [Gaussian(fit.space, fit.x, np.linalg.inv(fit.hessian), "H^-1", "search") for fit, _, _ in problems]
    assert 0.85 < np.mean(coverage(wide, truths)) < 0.95
    assert np.mean(coverage(plain, truths)) < 0.7


# ---------------------------------------------------------------- blocks of time


def test_time_blocks_are_contiguous_and_of_one_column_each():
    """Two columns of 10 samples over 5 s, then one of 6 over 2 s: 5, 5 and 2 blocks of a second."""
    ids = time_blocks([(2, 10), (1, 6)], [5.0, 2.0])
    second = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    np.testing.assert_array_equal(ids, [*second, *(5 + i for i in second), 10, 10, 10, 11, 11, 11])


def test_time_blocks_have_the_configured_length():
    np.testing.assert_array_equal(time_blocks([(1, 8)], [4.0], block=2.0), [0, 0, 0, 0, 1, 1, 1, 1])
    uneven = time_blocks([(1, 100)], [7.0], block=1.0)
    sizes = np.bincount(uneven)
    assert len(sizes) == 7 and sizes.min() >= 14 and sizes.max() <= 15 and np.all(np.diff(uneven) >= 0)


@pytest.mark.parametrize("duration", [0.2, 0.49])
def test_a_channel_shorter_than_half_a_block_is_one_block_per_column(duration):
    np.testing.assert_array_equal(time_blocks([(3, 4)], [duration]), np.repeat([0, 1, 2], 4))


def test_blocks_shorter_than_a_sample_hold_one_sample():
    ids = time_blocks([(2, 3)], [30.0])
    assert ids.shape == (6,) and len(set(ids.tolist())) == 6 and np.all(np.diff(ids) > 0)


def test_every_channel_needs_its_duration():
    with pytest.raises(ValueError, match="shorter"):
        time_blocks([(1, 3), (1, 3)], [1.0])


# ---------------------------------------------------------------- which parameters are identifiable


def four_verdicts():
    """Four posteriors of 12, 24.75, 26 and 98 % of their stated priors; p0 is correlated with p1 and p3.

    Three have a prior four times as wide in the refinement, which counts for nothing here, one has a narrower one.
    """
    deviation = np.array([0.12, 0.2475, 0.13, 0.98])
    correlation = np.eye(4)
    for i, j, value in ((0, 1, 0.72), (1, 3, -0.6), (0, 3, -0.75), (2, 3, 0.1)):
        correlation[i, j] = correlation[j, i] = value
    gaussian = Gaussian(space_of(4), np.zeros(4), correlation * np.outer(deviation, deviation), "test", "search")
    return identifiability(gaussian, np.array([4.0, 4.0, 0.5, 4.0]))


def test_a_parameter_is_identifiable_below_a_quarter_of_its_prior():
    verdicts = four_verdicts()
    assert [v.name for v in verdicts] == ["p0", "p1", "p2", "p3"]
    np.testing.assert_allclose([v.shrinkage for v in verdicts], [0.12, 0.2475, 0.26, 0.98])
    assert [v.identifiable for v in verdicts] == [True, True, False, False]


def test_partners_are_those_of_strong_correlation_with_its_sign_the_strongest_first():
    partners = [dict(v.partners) for v in four_verdicts()]
    assert [list(p) for p in partners] == [["p3", "p1"], ["p0"], [], ["p0"]]
    assert partners[0] == pytest.approx({"p3": -0.75, "p1": 0.72})
    assert partners[3] == pytest.approx({"p0": -0.75})


def test_no_more_than_three_partners_are_named():
    correlation = np.full((6, 6), 0.9) + 0.1 * np.eye(6)
    correlation[0, 1:] = correlation[1:, 0] = [0.8, 0.84, 0.82, 0.86, 0.75]
    gaussian = Gaussian(space_of(6), np.zeros(6), correlation, "test", "search")
    assert [n for n, _ in identifiability(gaussian, np.full(6, 4.0))[0].partners] == ["p4", "p2", "p3"]


def test_reasons_state_the_shrinkage_and_partners_the_correlations():
    assert [[n for n, _ in v.partners] for v in four_verdicts()] == [["p3", "p1"], ["p0"], [], ["p0"]]
    reasons = [v.reason for v in four_verdicts()]
    assert reasons == [
        "the data narrow the prior to 12%",
        "the data narrow the prior to 25%",
        "the data narrow the prior only to 26%",
        "the data narrow the prior only to 98%",
    ]


def test_the_distance_from_the_prior_mean_is_in_deviations_of_the_stated_prior():
    space = space_of(2)
    for coordinates, mean in (("search", np.array([5.0, -0.5])), ("physical", space.from_search([5.0, -0.5]))):
        gaussian = Gaussian(space, mean, 0.09 * np.eye(2), "test", coordinates)
        assert [v.moved for v in identifiability(gaussian, np.full(2, 4.0))] == pytest.approx([5.0, -0.5])


def test_a_parameter_that_the_data_do_not_constrain_keeps_its_prior():
    """From Jacobian to verdict: p1 hardly changes the residuals."""
    fit = fitted(SQUARE * [1.0, 1e-5])
    gaussian = calibrated(fit, [np.zeros((1, 16))], one_block(SQUARE))
    first, second = identifiability(gaussian, fit.prior)
    assert first.identifiable and first.shrinkage == pytest.approx(1 / np.sqrt(200.0), rel=1e-3)
    assert not second.identifiable and second.shrinkage == pytest.approx(
        4.0, abs=1e-4
    )  # as wide as the refinement let it
    assert second.reason == "the data do not narrow the prior"


def test_a_posterior_as_wide_as_the_stated_prior_is_not_identifiable():
    """It is narrower than the refinement's prior of four units, which does not count."""
    gaussian = Gaussian(space_of(1), np.zeros(1), np.eye(1), "test", "search")
    (verdict,) = identifiability(gaussian, np.array([4.0]))
    assert not verdict.identifiable and verdict.shrinkage == 1.0


def test_the_covariance_of_a_search_gives_no_verdict():
    """This holds for any width."""
    space = space_of(3)
    narrow = dataclasses.replace(prior(space), cov=1e-6 * np.eye(3))
    verdicts = not_judged(narrow)
    assert [v.name for v in verdicts] == list(space.names)
    assert not any(v.identifiable for v in verdicts) and all(v.partners == () for v in verdicts)
    assert {v.reason for v in verdicts} == {"not judged: the search's covariance depends on when it stopped"}


def test_a_parameter_without_any_effect_keeps_its_prior():
    fit = fitted(SQUARE * [1.0, 0.0])
    g = calibrated(fit, [exactly(2.0, 20, 16)], one_block(SQUARE))
    np.testing.assert_allclose(np.sqrt(np.diag(g.cov)), [2 / np.sqrt(200), 4.0], rtol=1e-3)


def test_an_unconstrained_parameter_has_its_stated_prior_in_the_result():
    """The refinement's prior is four times as wide.  Constrained parameters keep their width and correlations."""
    fit = fitted(SQUARE * [1.0, 0.0])
    wide = calibrated(fit, [exactly(2.0, 20, 16)], one_block(SQUARE))
    handed = with_stated_prior(wide, fit)
    np.testing.assert_allclose(np.sqrt(np.diag(handed.cov)), [2 / np.sqrt(200), 1.0], rtol=0.02)
    np.testing.assert_array_equal(handed.mean, wide.mean)
    skewed = fitted(100 * SKEW)
    constrained = calibrated(skewed, [exactly(2.0, 40, 30)], one_block(SKEW))
    np.testing.assert_allclose(with_stated_prior(constrained, skewed).cov, constrained.cov, rtol=0.02)
    plain = fitted(SQUARE, width=1.0)  # none wider was used, nothing widened
    alone = calibrated(plain, [exactly(0.5, 20, 16)], one_block(SQUARE))
    np.testing.assert_allclose(with_stated_prior(alone, plain).cov, alone.cov, rtol=1e-9)


def test_the_result_combines_the_stated_prior_with_blocks_of_a_second():
    """One column of six seconds with a residual that is constant within a second; p1 is not constrained."""
    count, per_second = 60, 10
    jacobian = np.stack([np.ones(count), np.zeros(count)], axis=1)
    residual = np.repeat([1.0, -1.0, 2.0, -2.0, 3.0, -3.0], per_second)
    fit = fitted(jacobian, residual)
    noise = SimpleNamespace(mean=np.zeros((count, 1)))
    channel = SimpleNamespace(columns=np.zeros(1), noise=noise, span=(0.0, 6.0))
    comparison: Any = SimpleNamespace(channels=(channel,), deviations=lambda: exactly(1.0, 60, count))
    scores = per_second * np.array([1.0, -1.0, 2.0, -2.0, 3.0, -3.0])
    expected = np.sqrt(np.sum(scores**2)) / count
    np.testing.assert_allclose(deviations(uncertainty.posterior_of(fit, [comparison])), [expected, 4.0], rtol=0.01)
    with_prior = 1 / np.sqrt(expected**-2 + 1)
    np.testing.assert_allclose(deviations(posterior(fit, [comparison])), [with_prior, 1.0], rtol=0.01)
    assert deviations(posterior(fit, [comparison]))[1] <= 1.0


def test_a_poor_model_makes_no_posterior_wider_than_its_stated_prior():
    """The residual looks like both parameters: the data's information is widened, the prior is not."""
    jacobian = SQUARE * 0.5
    residual = 200.0 * jacobian[:, 0] + 200.0 * jacobian[:, 1]
    fit = fitted(jacobian, residual, nuisances=1)
    wide = calibrated(fit, [exactly(1.0, 20, 16)], one_block(jacobian))
    handed = with_stated_prior(wide, fit)
    assert (deviations(wide) > 4.0).all()  # beyond both priors that the refinement used
    np.testing.assert_allclose(deviations(handed), 1.0, rtol=0.05)
    assert (deviations(handed) <= 1.0 + 1e-9).all()


def test_noisy_repeats_do_not_widen_an_unconstrained_parameter_beyond_its_prior():
    fit = fitted(SQUARE * [1.0, 1e-5])
    g = calibrated(fit, [exactly(3.0, 20, 16)], one_block(SQUARE))
    assert identifiability(g, fit.prior)[1].shrinkage <= 4.004
