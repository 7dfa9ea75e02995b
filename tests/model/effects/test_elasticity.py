"""Gears that give way follow the servo that the sample has, whatever the MJCF says."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from effect_bench import ARM, mechanism

from droid_jax.model.effect_interface import State
from droid_jax.model.effects.registry import library
from droid_jax.model.fields import servo_scale
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_physics


@pytest.mark.parametrize("scale", [1.0, 1.4])
def test_inside_the_play_there_is_no_torque_and_an_elastic_gear_gives_in_proportion(scale: float):
    scene = mechanism()
    space = Space(tuple(servo_scale(scene, joint, std=0.3) for joint in ARM))
    model = make_physics(scene, space, jnp.full(len(space), scale, jnp.float32)).model
    still = jnp.zeros(scene.model.nv, jnp.float32)
    state = State(jnp.float32(0.0), jnp.asarray(scene.initial_qpos({}), jnp.float32), still, still, model)
    rows = [scene.command_names.index(joint) for joint in ARM]
    ahead = jnp.zeros(scene.model.nu).at[np.array(rows)].set(0.002)  # rad, of where the joints are
    ctrl = ahead + state.qpos[np.array([scene.qpos(j) for j in scene.command_names])]
    backlash, compliance = library(scene, ["joint_backlash", "joint_compliance"])
    assert backlash.servo is not None and compliance.servo is not None

    def torque(given) -> np.ndarray:
        length = state.qpos[np.array([scene.qpos(j) for j in scene.command_names])]
        return np.asarray(model.actuator_gainprm[:, 0] * given + model.actuator_biasprm[:, 1] * length)[rows]

    stiffness = scale * scene.model.actuator_gainprm[rows, 0]
    np.testing.assert_allclose(torque(ctrl), 0.002 * stiffness, rtol=1e-4)
    play = backlash.servo({f"joint_backlash[{j}]": 0.006 for j in ARM}, state, ctrl)
    np.testing.assert_allclose(torque(play), 0.0, atol=1e-5)
    soft = compliance.servo({f"joint_compliance[{j}]": 1e-3 for j in ARM}, state, ctrl)
    np.testing.assert_allclose(torque(soft), 0.002 / (1.0 / stiffness + 1e-3), rtol=1e-4)
