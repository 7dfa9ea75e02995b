"""What is said of a replay that gives no numbers."""

from __future__ import annotations

import mujoco
import numpy as np

from droid_jax.identify.divergence import blow_up
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene, compile_scene

ARM = """<mujoco><compiler autolimits="true"/><option timestep="0.002" integrator="Euler"/><worldbody><body>
  <joint name="shoulder" axis="0 1 0" range="-90 90"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="2"/>
  <body pos="0 0 -.4"><joint name="wrist" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.05" size=".01" mass=".05"/>
  </body></body></worldbody><actuator><position joint="shoulder" kp="50" kv="5"/>
  <position joint="wrist" kp="2000" kv="0"/></actuator></mujoco>"""


def arm() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(ARM), "arm")


def rollout(position: np.ndarray) -> Rollout:
    time = 0.002 * np.arange(len(position))
    velocity = np.gradient(position, time, axis=0)
    still = np.zeros(len(time))
    return Rollout(time, position, position, velocity, still, np.zeros((len(time), 0), bool), np.array(False))


def test_the_joint_that_leaves_its_range_first_is_named_with_what_its_servo_needs():
    path = np.zeros((50, 2))
    path[12:, 1] = 1e3
    path[20:] = np.nan
    said = blow_up(arm(), rollout(path))
    assert said.startswith("wrist leaves its range at step 12 (0.024 s), where its servo's 2e+03 N m/rad on")
    assert "need a time step well below" in said and "armature well above 0.002 kg m2" in said


def test_a_joint_with_a_range_and_a_gentle_servo_is_named_alone():
    path = np.zeros((50, 2))
    path[30:, 0] = 6.0
    assert blow_up(arm(), rollout(path)) == "shoulder leaves its range at step 30 (0.06 s)"


def test_numbers_that_are_none_are_a_range_left():
    path = np.zeros((50, 2))
    path[7:, 1] = np.nan
    assert blow_up(arm(), rollout(path)).startswith("wrist leaves its range at step 6")


def test_a_replay_that_shows_nothing_is_not_explained():
    assert blow_up(arm(), rollout(np.zeros((5, 2)))) == ""
