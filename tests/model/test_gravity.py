"""The generalised force of a field, and its change with a displacement, against C MuJoCo."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from droid_jax.model.gravity import change_of_force, field_force, lean, placed
from droid_jax.model.scene import Scene, compile_scene

# Two trees, a body with two joints, a branch, a slide between hinges, anchors off the bodies' origins.
MJCF = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="a" pos="0.1 0 0.5">
    <joint name="pan" axis="0.2 0.1 1"/><joint name="tilt" axis="0 1 0.3" pos="0.1 0.02 0"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0.1 0" mass="1.5"/>
    <body name="b" pos="0.3 0 0" quat="0.9 0.1 0.3 0.2"><joint name="reach" type="slide" axis="1 0.2 0"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0.1 0.25" mass="0.8"/>
      <body name="c" pos="0.2 0 0.1"><joint name="wrist" axis="1 1 0" pos="-0.05 0 0"/>
        <geom type="box" size="0.05 0.1 0.02" pos="0.1 0 0.05" mass="0.6"/></body></body>
    <body name="d" pos="0 0.2 0"><joint name="side" axis="0 0 1"/>
      <geom size="0.05" pos="0.2 0 0" mass="0.4"/></body></body>
  <body name="e" pos="1 0 0"><joint name="other" axis="1 0 0"/><geom size="0.05" pos="0 0.3 0" mass="2"/></body>
  </worldbody></mujoco>"""
FIELD = np.array([0.7, -1.3, -9.6])  # m/s^2


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(MJCF), "branches", joints=["pan", "tilt", "reach"])


def in_c(scene: Scene, qpos: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """[nv] the sum of J^T m field."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    out, jacobian = np.zeros(model.nv), np.zeros((3, model.nv))
    for body in range(1, model.nbody):
        mujoco.mj_jacBodyCom(model, data, jacobian, np.zeros((3, model.nv)), body)
        out += mass[body] * jacobian.T @ FIELD
    return out


def poses(scene: Scene) -> list[np.ndarray]:
    return list(np.random.default_rng(2).uniform(-1, 1, (5, scene.model.nq)))


def test_a_fields_force_is_the_sum_over_the_bodies(scene: Scene):
    mass = np.random.default_rng(3).uniform(0, 2, scene.model.nbody)
    force = jax.jit(lambda q, m: field_force(scene.mjx, placed(scene.mjx, q), m, jnp.asarray(FIELD)))
    for qpos in poses(scene):
        np.testing.assert_allclose(force(qpos, mass), in_c(scene, qpos, mass), atol=2e-5)


def test_the_change_with_a_displacement(scene: Scene):
    """All joints by some hundredths at once; a thousandth of the change is of third order."""
    mass = np.random.default_rng(3).uniform(0, 2, scene.model.nbody)

    @jax.jit
    def change(q, m, step):
        return change_of_force(scene.mjx, placed(scene.mjx, q), m, jnp.asarray(FIELD), step)

    rng = np.random.default_rng(5)
    for qpos in poses(scene):
        step = rng.uniform(-0.04, 0.04, scene.model.nv)
        expected = in_c(scene, qpos + step, mass) - in_c(scene, qpos, mass)
        np.testing.assert_allclose(change(qpos, mass, step), expected, atol=3e-3 * np.abs(expected).max())
        assert np.abs(expected).max() > 0.1
        np.testing.assert_array_equal(change(qpos, mass, 0 * step), np.zeros(scene.model.nv))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_field_is_turned_about_an_axis(axis: int):
    turned, quaternion = np.zeros(3), np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, np.eye(3)[axis], 0.3)
    mujoco.mju_rotVecQuat(turned, FIELD, quaternion)
    np.testing.assert_allclose(lean(jnp.asarray(FIELD), axis, jnp.float32(0.3)), turned, rtol=1e-5)
    np.testing.assert_array_equal(lean(jnp.asarray(FIELD), axis, jnp.float32(0.0)), FIELD.astype(np.float32))
