"""Soft and firm friction: the creep of MuJoCo's constraint, and its removal."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pytest
from effect_bench import Bench, make_bench

from droid_jax.discrepancy.candidates import acts_on_commands_only, observable_effects
from droid_jax.model.effects.registry import effect_space, library, ready
from droid_jax.model.mjcf import fitted_mjcf, unwritten
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.replay import Drive

MJCF = """<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/><worldbody><body>
  <joint name="j" axis="0 1 0" armature="INERTIA" frictionloss="0.3"/>
  <inertial pos="0 0 0" mass="1e-3" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>
  <actuator><motor joint="j"/></actuator></mujoco>"""
LOAD, SECONDS = 0.2, 2.0  # N m, s
MOTOR = TorqueConvention(TorqueSide.MOTOR, gravity=True)
NAME = "friction_firmness[j]"


def scene_of(mjcf: str) -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(mjcf), "held", joints=["j"])


@functools.cache
def held(inertia: float) -> Bench:
    scene = scene_of(MJCF.replace("INERTIA", str(inertia)))
    command = np.full((round(SECONDS / 0.002), 1), LOAD)
    return make_bench(scene, Drive(command, np.zeros(1), 0.002, MOTOR), library(scene, ["soft_friction"]))


def creep(inertia: float, first: float, last: float) -> float:
    """rad/s: load (1 - d) / (d b) over the inertia, b = 2 / (dmax timeconst)."""
    return LOAD * (1 - first) / first / (2 / (last * 0.02)) / inertia


@pytest.mark.slow
@pytest.mark.parametrize("inertia", [0.03, 0.002])
def test_the_joint_creeps_by_the_remaining_share(inertia: float):
    bench, shares = held(inertia), (0.0, 0.5, 0.9, 1.0)
    position = bench.run(np.array([[share] for share in shares])).position[:, :, 0]
    half = position.shape[1] // 2
    got = (position[:, -1] - position[:, half]) / (0.002 * (position.shape[1] - 1 - half))
    expected = [creep(inertia, 0.9 + s * 0.0999, 0.95 + s * 0.0499) for s in shares]
    np.testing.assert_allclose(got, expected, rtol=5e-3)
    assert expected[0] > 1000 * expected[-1] * 0.9


def in_c(first: float, seconds: float, frictionloss: float) -> tuple[np.ndarray, np.ndarray]:
    """Clock [T] s at 2 ms and angle [T] rad of a joint that a servo moves and stops, in plain C at 0.05 ms."""
    spec = mujoco.MjSpec.from_string(SERVO)
    spec.option.timestep = 5e-5
    spec.joint("j").solimp_friction[:2] = [first, max(first, 0.95)]
    spec.joint("j").frictionloss = frictionloss
    model = spec.compile()
    data, out = mujoco.MjData(model), []
    for k in range(round(seconds / 5e-5)):
        if k % 40 == 0:
            out.append(data.qpos[0])
        data.ctrl[:] = swing(k * 5e-5)
        mujoco.mj_step(model, data)
    return 0.002 * np.arange(len(out)), np.array(out)


SERVO = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
  <joint name="j" axis="0 1 0" armature="0.01" damping="0.2" frictionloss="0.4"/>
  <inertial pos="0.1 0 0" mass="0.3" diaginertia="1e-4 1e-4 1e-4"/></body></worldbody>
  <actuator><position joint="j" kp="15"/></actuator></mujoco>"""


def swing(time):
    """rad: a motion, a stop, back, a stop."""
    return 0.6 * np.clip(np.sin(1.5 * time) * 1.6, -1.0, 1.0)


def swinging() -> Bench:
    scene = scene_of(SERVO)
    command = swing(np.arange(2000) * 0.002)[:, None]
    return make_bench(scene, Drive(command, np.zeros(1), 0.002, MOTOR), library(scene, ["soft_friction"]))


@pytest.mark.slow
def test_firm_friction_is_that_of_c_with_the_same_impedance():
    position = swinging().run(np.array([[0.0], [1.0]])).position[:, :, 0]
    soft, firm = (in_c(first, 4.0, 0.4)[1] for first in (0.9, 0.9999))
    np.testing.assert_allclose(position[0], soft, atol=2e-4)
    np.testing.assert_allclose(position[1], firm, atol=2e-4)
    assert np.abs(soft - firm).max() > 2e-3


def test_it_is_written_into_the_mjcf():
    bench = held(0.03)
    space = effect_space(bench.effects)
    assert unwritten(bench.scene, space) == ()
    joint = mujoco.MjSpec.from_string(fitted_mjcf(bench.scene, space, np.ones(1), bench.effects)).joint("j")
    np.testing.assert_allclose(joint.solimp_friction[:2], [0.9999, 0.9999])


def test_locations_are_joints_with_soft_friction():
    plain = MJCF.replace("INERTIA", "0.03")
    none = scene_of(plain.replace('frictionloss="0.3"', ""))
    firm = scene_of(plain.replace('frictionloss="0.3"', 'frictionloss="0.3" solimpfriction="0.9999 0.9999"'))
    asked = scene_of(plain.replace('frictionloss="0.3"', 'frictionloss="1e-6"'))  # to be fitted
    has = [
        [*e.locations] for s in (none, ready(none), firm, asked) for e in library(s, ["soft_friction"]) or (None,) if e
    ]
    assert has == [["j"]]


def test_all_joints_with_soft_friction_are_one_location():
    """The third joint is firm, so it is not among them."""
    body = "<body><joint name='{}' frictionloss='0.3' {}/><inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>{}</body>"
    inner = body.format("c", "solimpfriction='0.9999 0.9999'", "")
    chain = body.format("a", "", body.format("b", "", inner))
    motors = "".join(f"<motor joint='{j}'/>" for j in "abc")
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{chain}</worldbody><actuator>{motors}</actuator></mujoco>")
    (effect,) = library(compile_scene(spec, "chain", joints=list("abc")), ["soft_friction"])
    assert "solimpfriction" in effect.remedy
    one, other = (f"friction_firmness[{j}]" for j in "ab")
    assert effect.locations == {"a": (one,), "b": (other,), "all joints": (one, other)}
    assert effect.natural_bounds == (one, other)


def test_a_prescribed_motion_does_not_have_it():
    scene = held(0.03).scene
    (effect,) = library(scene, ["soft_friction"])
    assert acts_on_commands_only(effect)
    log = Recording("log", np.zeros(0), np.zeros((0, 0)), (), {}, MOTOR)
    assert "soft_friction" not in {e.name for e in observable_effects(scene, [log])}
