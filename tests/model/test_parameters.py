"""Parameters and spaces: search coordinates, bounds, and what errors say."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from droid_jax.model.parameters import Mode, Parameter, Role, Scaling, Space, Write


def linear(name: str = "offset", **changes) -> Parameter:
    return Parameter(**{**dict(name=name, unit="m", mean=1.0, std=0.5, low=-2.0, high=3.0), **changes})


def log(name: str = "damping", **changes) -> Parameter:
    start = dict(name=name, unit="N m s/rad", mean=2.0, std=1.0, low=0.0, high=20.0, log_offset=0.05)
    return Parameter(**{**start, **changes}, scaling=Scaling.LOG)


SPACE = Space((linear(), log(), log("stiffness", mean=0.01, std=0.005, width=1.0, nuisance=True)))


def random_values(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(SPACE.low, SPACE.high, (count, len(SPACE)))


def test_search_coordinates_round_trip():
    values = random_values(200)
    np.testing.assert_allclose(SPACE.from_search(SPACE.to_search(values)), values, rtol=1e-12, atol=1e-12)


def test_search_coordinates_follow_their_formula():
    values = random_values(20)
    x = SPACE.to_search(values)
    np.testing.assert_allclose(x[:, 0], (values[:, 0] - 1.0) / 0.5)
    width = math.log(1 + 1.0 / 2.05)  # one prior deviation above the mean is one unit
    np.testing.assert_allclose(x[:, 1], np.log((values[:, 1] + 0.05) / 2.05) / width)
    np.testing.assert_allclose(x[:, 2], np.log((values[:, 2] + 0.05) / 0.06))


def test_mean_is_the_origin_and_one_deviation_is_one_unit():
    np.testing.assert_allclose(SPACE.to_search(SPACE.mean), np.zeros(3), atol=1e-15)
    up = SPACE.to_search(SPACE.mean + SPACE.std)
    assert up[0] == pytest.approx(1.0)
    assert up[1] == pytest.approx(1.0)


def test_zero_is_reachable_with_a_log_offset():
    assert SPACE.to_search(np.zeros(3))[1] > -10
    assert SPACE.from_search(np.array([0.0, -50.0, 0.0]))[1] == 0.0


def test_from_search_stays_inside_the_bounds():
    far = np.random.default_rng(1).normal(0, 30, (500, 3))
    values = SPACE.from_search(far)
    assert np.all(values >= SPACE.low) and np.all(values <= SPACE.high)
    SPACE.check(values)


def test_numpy_and_jax_agree_and_keep_their_kind():
    values = random_values(50)
    host = SPACE.to_search(values)
    traced = jax.jit(SPACE.to_search)(jnp.asarray(values, jnp.float32))
    assert isinstance(host, np.ndarray) and isinstance(traced, jax.Array)
    # float32: seven digits of a coordinate up to about 30
    np.testing.assert_allclose(traced, host, atol=1e-4)
    back = jax.jit(SPACE.from_search)(traced)
    np.testing.assert_allclose(back, values, rtol=2e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (dict(mean=3.5), "outside its bounds"),
        (dict(mean=-2.5), "outside its bounds"),
        (dict(low=3.0), "must be below high"),
        (dict(std=0.0), "std must be positive"),
        (dict(std=-1.0), "std must be positive"),
        (dict(width=0.0), "width must be above 0"),
        (dict(mean=math.nan), "must be finite"),
        (dict(high=math.inf), "must be finite"),
    ],
)
def test_a_bad_parameter_is_refused(changes: dict, says: str):
    with pytest.raises(ValueError, match=says) as caught:
        linear(**changes)
    assert "'offset'" in str(caught.value)


def test_log_scaling_needs_a_positive_range():
    with pytest.raises(ValueError, match=r"low \+ log_offset > 0"):
        log(log_offset=0.0)


def test_a_prior_outside_the_bounds_is_refused_by_name():
    with pytest.raises(ValueError, match=r"'damping'.*outside its bounds"):
        SPACE.with_prior(damping=(25.0, 1.0))


@pytest.mark.parametrize(
    "ask",
    [
        lambda: SPACE["dampin"],
        lambda: SPACE.select(["damping", "dampin"]),
        lambda: SPACE.values({"dampin": 1.0}),
        lambda: SPACE.with_prior(dampin=(1.0, 1.0)),
    ],
)
def test_unknown_names_list_the_valid_ones(ask):
    with pytest.raises(ValueError, match=r"unknown parameter 'dampin'.*offset, damping, stiffness"):
        ask()


def test_names_are_unique_and_some_are_given():
    with pytest.raises(ValueError, match="repeated: damping"):
        SPACE + Space((log(),))
    with pytest.raises(ValueError, match="at least one"):
        Space(())


@pytest.mark.parametrize("bad", [20.5, -0.1, math.nan, math.inf])
def test_check_says_which_value_is_outside(bad: float):
    values = random_values(4)
    values[2, 1] = bad
    with pytest.raises(ValueError, match=r"'damping'.*N m s/rad is not inside its bounds \[0.0, 20.0\]"):
        SPACE.check(values)


def test_check_takes_a_bound_in_single_precision_for_the_bound():
    """0.01 is 0.00999999978 in float32; a millionth of the range counts as rounding."""
    space = Space((linear(mean=0.05, low=0.01, high=0.1),))
    for bound in (0.01, 0.1):
        single = np.array([np.float32(bound)])
        assert not 0.01 <= float(single[0]) <= 0.1
        np.testing.assert_array_equal(space.check(single), [bound])
    with pytest.raises(ValueError, match="not inside its bounds"):
        space.check(np.array([0.01 - 1e-5]))


def test_check_refuses_other_lengths():
    with pytest.raises(ValueError, match=r"\[\.\.\., 3\].*\(5, 2\)"):
        SPACE.check(np.zeros((5, 2)))


def test_sub_spaces_and_priors_leave_the_original_alone():
    before = SPACE.mean.copy()
    other = SPACE.with_prior(damping=(5.0, 0.1))
    assert other["damping"].mean == 5.0 and other["damping"].std == 0.1
    np.testing.assert_array_equal(SPACE.mean, before)
    assert SPACE.select(["stiffness", "offset"]).names == ("stiffness", "offset")
    np.testing.assert_array_equal(SPACE.nuisance, [False, False, True])
    assert all(p.scaling is Scaling.LINEAR for p in SPACE.linear().parameters)


def test_values_replaces_by_name():
    np.testing.assert_array_equal(SPACE.values({"damping": 7.0}), [1.0, 7.0, 0.01])


@pytest.mark.parametrize(
    ("mode", "expected"),
    [(Mode.SET, 6.0), (Mode.NEGATIVE, -6.0), (Mode.SCALE, 24.0), (Mode.DIVIDE, 4.0 / 6.0), (Mode.ADD, 10.0)],
)
def test_write_modes(mode: Mode, expected: float):
    """nominal 4, value 2, gain 3."""
    assert Write("dof_damping", (0,), mode, gain=3.0).new(4.0, 2.0) == pytest.approx(expected)


def of_name(name: str, **options) -> Parameter:
    return Parameter(name, "N m", 0.0, 1.0, -5.0, 5.0, **options)


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("time_offset", Role.TIME_OFFSET),
        ("torque_offset[elbow]", Role.TORQUE_OFFSET),
        ("viscous[a[0]]", Role.VISCOUS),
        ("torque_offset", Role.OTHER),
        ("time_offset[elbow]", Role.OTHER),
        ("torque_offset_of_the_elbow", Role.OTHER),
        ("payload_mass", Role.OTHER),  # an effect's, which says so itself
    ],
)
def test_parameters_in_theta_have_their_role_by_name(name: str, role: Role):
    assert of_name(name).role is role
    assert of_name(name, writes=(Write("dof_damping", (0,)),)).role is Role.OTHER  # a model's field is read there


def test_parameters_are_found_by_role():
    space = Space((of_name("a", role=Role.PAYLOAD_MASS), of_name("torque_offset[b]"), of_name("c")))
    assert [p.name for p in space.of_role(Role.TORQUE_OFFSET, Role.PAYLOAD_MASS)] == ["a", "torque_offset[b]"]
    assert space.of_role(Role.SLIDING_FRICTION) == () and space.linear()["a"].role is Role.PAYLOAD_MASS
    with pytest.raises(ValueError, match="role must be one of time_offset, "):
        of_name("a", role="grip")
