"""The batch of C rollouts against mj_step, and the instrumented model against the scene's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_space, truth
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, compile_scene, with_options
from droid_jax.recordings.formats import load_recording
from droid_jax.simulate import c_engine as engine
from droid_jax.simulate.c_engine import Trace, instrument, simulate
from droid_jax.synthetic.robot import _carries_weight


@pytest.fixture(scope="module")
def scene() -> Scene:
    return door_scene()


@pytest.fixture(scope="module")
def models(scene: Scene) -> list[mujoco.MjModel]:
    from dataclasses import replace

    plain = replace(scene, model=instrument(scene))
    space = door_space(scene)
    return [make_c_model(plain, space, space.values(truth(k))) for k in (0, 2)]


@pytest.fixture(scope="module")
def control(scene: Scene) -> np.ndarray:
    """[1, T, 9]: the demonstration up to the first centimetres of the opening."""
    recording = load_recording(demonstration_path("A"))
    return recording.command[None, :1700, scene.command_index(recording.command_names)]


@pytest.fixture(scope="module")
def start(scene: Scene) -> np.ndarray:
    return scene.initial_qpos(dict(load_recording(demonstration_path("A")).qpos0))[None]


@pytest.fixture(scope="module")
def trace(scene: Scene, models: list[mujoco.MjModel], control: np.ndarray, start: np.ndarray) -> Trace:
    return simulate(scene, models, start, control)


def test_actuator_torques_contain_the_weight_that_nothing_else_compensates():
    """Without compensation, with gravcomp, and with actuatorgravcomp."""
    xml = """<mujoco><worldbody><body {body}><joint name="j" axis="0 1 0" {joint}/><geom size=".1" pos=".3 0 0"/></body>
    </worldbody><actuator><position joint="j" kp="9"/></actuator></mujoco>"""
    lifted, own = 'gravcomp="1"', 'actuatorgravcomp="true"'
    for body, joint, carried in (("", "", True), (lifted, "", False), (lifted, own, True), ("", own, True)):
        scene = compile_scene(mujoco.MjSpec.from_string(xml.format(body=body, joint=joint)), "one")
        assert _carries_weight(scene) is carried
        assert not _carries_weight(with_options(scene, gravity=[0.0, 0.0, 0.0]))


def test_threads_are_limited_to_the_cores_of_the_process(
    scene: Scene, models: list[mujoco.MjModel], control: np.ndarray, start: np.ndarray, monkeypatch: pytest.MonkeyPatch
):
    asked, own = [], engine.rollout.Rollout
    monkeypatch.setattr(engine.runtime, "cores", lambda: 1)
    monkeypatch.setattr(engine.rollout, "Rollout", lambda nthread: asked.append(nthread) or own(nthread=nthread))
    simulate(scene, models, start, control[:, :3])
    assert asked == [1]


def stepped(scene: Scene, model: mujoco.MjModel, qpos: np.ndarray, control: np.ndarray) -> dict[str, np.ndarray]:
    """The same by mj_step, with contacts read from the contact list."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    geoms = [[{int(model.pair_geom1[i]), int(model.pair_geom2[i])} for i in f] for f in scene.finger_pairs]
    rows = {k: [] for k in ("torque", "position", "velocity", "object_angle", "object_velocity", "contact")}
    for command in control:
        data.ctrl[:] = command
        rows["position"].append(data.qpos[scene.joint_qpos].copy())
        rows["velocity"].append(data.qvel[scene.joint_dofs].copy())
        rows["object_angle"].append(data.qpos[scene.qpos("hinge")])
        rows["object_velocity"].append(data.qvel[scene.dof("hinge")])
        mujoco.mj_step(model, data)
        rows["torque"].append(data.qfrc_actuator[scene.joint_dofs].copy())
        touching = [{int(g) for g in c.geom} for c in data.contact]
        rows["contact"].append([any(pair in touching for pair in finger) for finger in geoms])
    return {k: np.array(v) for k, v in rows.items()}


@pytest.mark.parametrize("row", [0, 1])
def test_rollouts_are_mj_step(
    scene: Scene, models: list[mujoco.MjModel], control: np.ndarray, start: np.ndarray, trace: Trace, row: int
):
    expected = stepped(scene, models[row], start[0], control[0])
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(trace, name)[row], values, atol=1e-9, err_msg=name)
    assert expected["contact"][-1].all() and not expected["contact"][0].any()


def test_the_order_of_models_is_kept_on_any_number_of_threads(
    scene: Scene,
    models: list[mujoco.MjModel],
    control: np.ndarray,
    start: np.ndarray,
    trace: Trace,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(engine.runtime, "cores", lambda: 3)
    many = [models[0], models[1], models[1], models[0], models[0]]
    again = simulate(scene, many, start, control[:, :300])
    for i, k in enumerate((0, 1, 1, 0, 0)):
        np.testing.assert_array_equal(again.torque[i], trace.torque[k, :300])


def test_each_row_can_have_its_own_start_and_command(
    scene: Scene, models: list[mujoco.MjModel], control: np.ndarray, start: np.ndarray, trace: Trace
):
    starts, commands = np.repeat(start, 2, axis=0), np.repeat(control[:, :200], 2, axis=0)
    starts[1, scene.joint_qpos[0]] += 0.01
    commands[1] += 0.02
    both = simulate(scene, [models[0], models[0]], starts, commands)
    np.testing.assert_array_equal(both.torque[0], trace.torque[0, :200])
    np.testing.assert_array_equal(both.position[1, 0], starts[1, scene.joint_qpos])
    assert np.abs(both.torque[1] - both.torque[0]).max() > 1.0


def test_instrumenting_keeps_the_scenes_numbers():
    """Options and fields that were changed after compilation are kept, and the dynamics are unchanged."""
    scene = with_options(
        door_scene(springs=1), timestep=0.0005, integrator=mujoco.mjtIntegrator.mjINT_EULER, gravity=[0.0, 0.1, -9.7]
    )
    scene.model.dof_damping[:] *= 1.5
    scene.model.body_mass[scene.id("body", "link3")] *= 1.1
    model = instrument(scene)
    assert model.nsensordata > 0
    for name in ("nq", "nv", "nu", "nbody", "ngeom", "npair", "njnt"):
        assert getattr(model, name) == getattr(scene.model, name), name
    for name in dir(scene.model):
        ours = getattr(model, name, None)
        theirs = getattr(scene.model, name, None)
        dynamics = name.startswith(("body_", "jnt_", "dof_", "geom_", "pair_", "actuator_", "eq_", "tendon_", "qpos"))
        if dynamics and isinstance(theirs, np.ndarray) and theirs.dtype.kind in "fiu":
            np.testing.assert_array_equal(ours, theirs, err_msg=name)
    for name in dir(scene.model.opt):
        value = getattr(scene.model.opt, name)
        if not name.startswith("_") and isinstance(value, (int, float, np.ndarray)):
            np.testing.assert_array_equal(getattr(model.opt, name), value, err_msg=name)
    assert model.stat.meaninertia == scene.model.stat.meaninertia


def test_a_rollout_that_diverges_is_not_finite(scene: Scene, models: list[mujoco.MjModel], start: np.ndarray):
    """MuJoCo's batch repeats the last valid state for the rest of the motion."""
    wild = models[0].__copy__()
    wild.dof_damping[scene.joint_dofs] = -3000.0
    control = np.tile(start[:, None, :9] * 0, (1, 200, 1))
    trace = simulate(scene, [models[0], wild], start, control)
    assert np.isfinite(trace.torque[0]).all()
    assert not np.isfinite(trace.torque[1]).all()


def test_a_users_scene_without_object_or_grip(tmp_path):
    xml = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" damping="1"/><geom size=".1" pos=".2 0 0"/></body>
      </worldbody><actuator><position joint="a" kp="5"/></actuator><sensor><jointvel joint="a"/></sensor></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "one")
    trace = simulate(scene, [instrument(scene)], np.zeros((1, 1)), np.full((1, 50, 1), 0.3))
    assert trace.contact.shape == (1, 50, 0) and not trace.object_angle.any()
    assert trace.position[0, 0, 0] == 0.0 and trace.torque[0, 0, 0] == pytest.approx(1.5)
