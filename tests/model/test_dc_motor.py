"""Parameters of a servo's DC motor, against the differential equation of a motor."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from droid_jax.model.dc_motor import MOTOR_TERMS, motor_parameter
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model, make_physics
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.simulate.batching import over_population
from droid_jax.simulate.replay import Drive, servo_replay

INERTIA, VOLTS, GAIN = 0.01, 7.4, 8.0  # kg m2, V, 1/rad: duty per position error
CONSTANT, RESISTANCE = 0.4, 3.0  # V s/rad (N m/A), Ohm


def mjcf(constant: float, resistance: float) -> str:
    stall = constant * VOLTS / resistance
    return f"""<mujoco><option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/><worldbody><body>
      <joint name="j" axis="0 1 0" armature="{INERTIA}" damping="{constant**2 / resistance}"/>
      <inertial pos="0 0 0" mass="1e-3" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>
      <actuator><position joint="j" kp="{GAIN * stall}" forcerange="{-stall} {stall}"/></actuator></mujoco>"""


def scene_of(text: str) -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(text), "motor", joints=["j"])


def space_of(scene: Scene, *terms: str) -> Space:
    return Space(tuple(motor_parameter(scene, term, "j") for term in terms))


def by_motor(constant: float, resistance: float, goal: np.ndarray, substeps: int = 5) -> np.ndarray:
    """[T] rad: duty, voltage, current, torque, in small steps of the classical Runge-Kutta method."""

    def slope(state: np.ndarray, target: float) -> np.ndarray:
        duty = np.clip(GAIN * (target - state[0]), -1.0, 1.0)
        current = (duty * VOLTS - constant * state[1]) / resistance
        return np.array([state[1], constant * current / (INERTIA + 1e-9)])

    state, out, h = np.zeros(2), [], 1e-3 / substeps
    for k, target in enumerate(goal):
        out.append(state[0])
        ahead = goal[min(k + 1, len(goal) - 1)]
        for i in range(substeps):
            now = target + (ahead - target) * i / substeps
            a = slope(state, now)
            b = slope(state + 0.5 * h * a, now)
            c = slope(state + 0.5 * h * b, now)
            state = state + h / 6 * (a + 2 * b + 2 * c + slope(state + h * c, now))
    return np.array(out)


def test_a_replay_is_that_of_a_motor_with_other_constants():
    """Through saturation to the no-load speed and back: a slow sine that the motor cannot follow."""
    scene = scene_of(mjcf(CONSTANT, RESISTANCE))
    space = space_of(scene, "torque_constant", "resistance")
    goal = 6.0 * np.sin(8.0 * np.arange(900) * 1e-3)
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    replay = servo_replay(scene, Drive(goal[:, None], np.zeros(1), 1e-3, convention))
    rows = np.array([[1.0, 1.0], [1.4, 0.8]])
    position = over_population(lambda v: replay(make_physics(scene, space, v)))(rows).position[:, :, 0]
    for got, (k, r) in zip(position, rows, strict=True):
        expected = by_motor(k * CONSTANT, r * RESISTANCE, goal)
        np.testing.assert_allclose(got, expected, atol=2e-3)
        assert np.abs(np.gradient(expected, 1e-3)).max() < VOLTS / (k * CONSTANT)
    assert np.abs(position[0] - position[1]).max() > 0.3


@pytest.mark.parametrize(
    ("terms", "values", "constant", "resistance"),
    [
        (("torque_constant", "resistance"), (1.3, 0.7), 1.3, 0.7),
        (("stall_torque", "no_load_speed"), (1.5, 0.8), 1 / 0.8, 1 / 0.8 / 1.5),  # T = K V / R, W = V / K
    ],
)
def test_either_pair_of_terms_equals_an_mjcf(terms, values, constant: float, resistance: float):
    scene = scene_of(mjcf(CONSTANT, RESISTANCE))
    got = make_c_model(scene, space_of(scene, *terms), np.array(values))
    expected = mujoco.MjModel.from_xml_string(mjcf(constant * CONSTANT, resistance * RESISTANCE))
    for field in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "dof_damping"):
        np.testing.assert_allclose(getattr(got, field), getattr(expected, field), rtol=1e-12)


def test_each_term_is_neutral_at_one():
    scene = scene_of(mjcf(CONSTANT, RESISTANCE))
    got = make_c_model(scene, space_of(scene, *MOTOR_TERMS), np.ones(len(MOTOR_TERMS)))
    np.testing.assert_array_equal(got.actuator_forcerange, scene.model.actuator_forcerange)
    np.testing.assert_array_equal(got.dof_damping, scene.model.dof_damping)


def test_what_cannot_be_is_refused():
    scene = scene_of(mjcf(CONSTANT, RESISTANCE))
    with pytest.raises(ValueError, match="unknown motor term 'kt'; valid: stall_torque, no_load_speed"):
        motor_parameter(scene, "kt", "j")
    with pytest.raises(ValueError, match="no actuator drives 'k'; driven joints: j"):
        motor_parameter(scene, "resistance", "k")
    undamped = scene_of(mjcf(CONSTANT, RESISTANCE).replace(f'damping="{CONSTANT**2 / RESISTANCE}"', ""))
    with pytest.raises(ValueError, match="joint 'j' has no damping, which its motor's no_load_speed would change"):
        motor_parameter(undamped, "no_load_speed", "j")
