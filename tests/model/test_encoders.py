"""An encoder offset as a parameter: the same robot with other readings, in the model, in C and in the MJCF."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from droid_jax.cost.cost import make_cost
from droid_jax.model.effect_interface import State
from droid_jax.model.effects.registry import effect_space, library
from droid_jax.model.encoders import encoder_error
from droid_jax.model.fields import joint_encoder_offset
from droid_jax.model.mjcf import fitted_mjcf, unwritten
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model, make_physics
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide

MJCF = """<mujoco><worldbody><body name="upper" gravcomp="SHARE"><joint name="shoulder" axis="0 1 0" ref="10"/>
  <geom size="0.03" type="capsule" fromto="0 0 0 0.3 0 0" mass="2" contype="0" conaffinity="0"/>
  <body name="fore" pos="0.3 0 0" gravcomp="SHARE">
    <joint name="elbow" axis="0 1 0" stiffness="3" springref="20" range="-60 40" armature="0.5"/>
    <geom size="0.02" type="capsule" fromto="0 0 0 0.3 0 0" mass="1" contype="0" conaffinity="0"/>
    <body name="rail" pos="0.3 0 0" gravcomp="SHARE"><joint name="slide" type="slide" axis="1 0 0"/>
      <geom size="0.02" mass="0.3" contype="0" conaffinity="0"/></body></body></body></worldbody>
  <actuator><position joint="shoulder" kp="80"/><position joint="elbow" kp="40"/></actuator></mujoco>"""
OFF = 0.07  # rad


def scene_of(share: str = "0") -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(MJCF.replace("SHARE", share)), "arm")


def loaded(folder: Path, scene: Scene, *entries: dict) -> Space:
    path = folder / "parameters.json"
    path.write_text(json.dumps(entries))
    return load_parameters(path, scene)


def forces(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Weight, springs and limits at rest, [3, nv]."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)  # a servo goes by the reading
    mujoco.mj_forward(model, data)
    return np.array([data.qfrc_bias, data.qfrc_passive, data.qfrc_constraint])


def test_offsets_are_found_in_a_model_that_a_program_returned():
    """Its arrays are copies, as in environments with randomised physics."""
    scene = scene_of()
    model = jax.jit(lambda masses: scene.mjx.replace(body_mass=2 * masses))(scene.mjx.body_mass)
    assert model.qpos0 is not scene.mjx.qpos0 and encoder_error(scene, model) is None
    moved = model.replace(qpos0=model.qpos0.at[1].add(-OFF))
    np.testing.assert_allclose(encoder_error(scene, moved), [0.0, OFF, 0.0], atol=1e-6)
    np.testing.assert_allclose(jax.jit(partial(encoder_error, scene))(model), 0.0)  # not known while it is traced


@pytest.mark.parametrize("reading", [-0.4, 0.8])  # the second beyond its limit of 40 degrees
def test_the_robot_is_the_same_at_readings_lower_by_the_offset(reading: float):
    scene = scene_of()
    space = Space((joint_encoder_offset(scene, "elbow", std=0.02, high=0.1),))
    model = make_c_model(scene, space, np.array([OFF]))
    read = np.array([0.3, reading, 0.05])
    expected = forces(scene.model, np.add(read, [0.0, OFF, 0.0]))
    np.testing.assert_allclose(forces(model, read), expected, atol=1e-9)
    assert (np.abs(expected[2]).max() > 0.1) == (reading > 0)
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, np.array([OFF])))
    np.testing.assert_allclose(forces(written, read), expected, rtol=1e-4, atol=1e-4)
    assert unwritten(scene, space) == ()


@pytest.mark.parametrize("name", ["payload", "free_payload"])
def test_a_load_beside_an_offset_hangs_at_the_true_positions(name: str):
    """Its torques at lower readings of the moved model are those of the plain model at the true positions."""
    scene = scene_of()
    (load,) = library(scene, [name])
    elbow = joint_encoder_offset(scene, "elbow", std=0.02, high=0.1)
    space = Space((elbow,)) + effect_space([load])
    values = space.values({elbow.name: OFF, **{p.name: 0.1 for p in load.parameters if "moment" in p.name}})
    physics, read = make_physics(scene, space, jnp.asarray(values, jnp.float32)), np.array([0.3, -0.4, 0.05])
    assert load.force is not None

    def torques(qpos: np.ndarray, model: Any) -> np.ndarray:
        state = State(jnp.float32(0), jnp.asarray(qpos, jnp.float32), jnp.zeros(3), jnp.zeros(3), model)
        return np.asarray(load.force(physics.theta, state))

    expected = torques(np.add(read, [0.0, OFF, 0.0]), scene.mjx)
    np.testing.assert_allclose(torques(read, physics.model), expected, rtol=1e-4, atol=1e-5)
    assert np.abs(expected - torques(read, scene.mjx)).max() > 1e-2


def test_a_file_states_it_as_a_sensors_term(tmp_path: Path):
    scene = scene_of()
    entry = {"sensor": "encoder_offset", "element": "elbow", "std": 0.02, "high": 0.1}
    p = loaded(tmp_path, scene, entry)["encoder_offset[elbow]"]
    assert (p.unit, p.mean, p.low, p.high, p.std, p.nuisance) == ("rad", 0.0, -0.1, 0.1, 0.02, False)
    assert {w.element for w in p.writes} == {"elbow"}
    gain = loaded(tmp_path, scene, {**entry, "sensor": "torque_gain"})["torque_gain[elbow]"]
    assert (gain.unit, gain.mean, gain.writes) == ("-", 0.0, ())
    for change, says in (
        ({"element": "slide"}, "unknown joint 'slide'; measured joints: shoulder, elbow"),
        ({"name": "zero"}, "leave name out"),
        ({"sensor": "encoder"}, "unknown sensor term 'encoder'; valid: .*torque_gain, encoder_offset"),
    ):
        with pytest.raises(ValueError, match=f"entry 1: .*{says}"):
            loaded(tmp_path, scene, {**entry, **change})


def test_c_refuses_offsets_with_gravity_compensation():
    """Without compensation the C engine replays encoder offsets."""
    scene, clock = scene_of("1"), np.arange(0, 0.4, 0.002)
    size = (1, len(clock), 2)
    torque = Channel(
        "torque", "N m", scene.joints, clock, np.random.default_rng(0).normal(size=size), np.ones(size, bool)
    )
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=False)
    start = dict.fromkeys(scene.joints, 0.0)
    recording = Recording(
        "still", clock, np.zeros((len(clock), 2)), scene.joints, {"torque": torque}, convention, start
    )
    space = Space((joint_encoder_offset(scene, "elbow", std=0.02, high=0.1),))
    with pytest.raises(
        ValueError, match="compensates gravity at the true joint positions, not at those that encoders read; use MJX"
    ):
        make_cost(scene, space, [recording], engine="mujoco").distances(space.mean[None])
