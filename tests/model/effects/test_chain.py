"""Axes and rotations of an arm's own kinematics against MuJoCo's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from effect_bench import door, mechanism

from droid_jax.model.effects.kinematics import turned
from droid_jax.model.scene import Scene, compile_scene


@pytest.mark.parametrize(("scene", "body"), [(mechanism, "hand"), (door, "hand"), (door, "door")])
def test_axes_and_rotation_are_mujocos(scene, body: str):
    made: Scene = scene()
    model, data, rng = made.model, mujoco.MjData(made.model), np.random.default_rng(0)
    number = made.id("body", body)
    links = turned(made, number)
    assert links is not None
    carried = {number}
    while number := int(model.body_parentid[number]):
        carried.add(number)
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    turning = [j for j in hinges if int(model.jnt_bodyid[j]) in carried]
    assert len(turning) in (1, 2, 7)
    for _ in range(5):
        data.qpos[:] = rng.uniform(-1, 1, model.nq)
        mujoco.mj_kinematics(model, data)
        axes, rotation = links(data.qpos.astype(np.float32))
        expected = np.zeros((model.nv, 3))
        expected[model.jnt_dofadr[turning]] = data.xaxis[turning]
        np.testing.assert_allclose(axes, expected, atol=2e-6)
        np.testing.assert_allclose(rotation, data.xmat[made.id("body", body)].reshape(3, 3), atol=2e-6)


def test_what_flies_has_none():
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='ball'><freejoint/><geom size='1'/>"
        "<body name='arm'><joint name='j'/><geom size='1'/></body></body></worldbody></mujoco>"
    )
    scene = compile_scene(spec, "flies", joints=("j",))
    assert turned(scene, scene.id("body", "arm")) is None
