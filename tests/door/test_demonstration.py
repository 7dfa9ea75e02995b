"""Demonstrations: the hand is on the knob, the motion is smooth, the servo follows, limits hold."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from droid_jax.door.demonstration import CLOSED, OPEN, PLANS, demonstrate, demonstration_path, grasp_pose
from droid_jax.door.scene import ARM, FINGERS, door_scene
from droid_jax.door.space import door_space
from droid_jax.model.scene import Scene
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.c_reference import c_replay
from droid_jax.simulate.hand_path import minimum_jerk, solve_pose
from droid_jax.simulate.replay import make_drive


@pytest.fixture(scope="module")
def scene() -> Scene:
    return door_scene()


@pytest.fixture(scope="module", params=sorted(PLANS))
def shipped(request) -> Recording:
    return load_recording(demonstration_path(request.param))


def path_of(recording: Recording) -> np.ndarray:
    return recording.channels["position"].values[0]


def test_minimum_jerk_is_smooth_and_ends_where_it_should():
    s = np.linspace(-0.2, 1.2, 1401)
    x = minimum_jerk(s)
    assert x[s <= 0].max() == 0.0 and x[s >= 1].min() == 1.0
    np.testing.assert_allclose(minimum_jerk(np.array([0.5])), 0.5)
    velocity = np.gradient(x, s)
    acceleration = np.gradient(velocity, s)
    assert (velocity >= -1e-12).all() and velocity.max() == pytest.approx(1.875, rel=1e-3)  # 15/8
    assert np.abs(acceleration[np.abs(s) < 0.002]).max() < 0.2
    assert np.abs(acceleration).max() == pytest.approx(10 / np.sqrt(3), rel=0.01)


@pytest.mark.parametrize("roll", [1, -1])
def test_the_grasp_looks_along_the_doors_normal(scene: Scene, roll: int):
    for angle in (0.0, 0.4, 0.9):
        data = mujoco.MjData(scene.model)
        data.qpos[scene.qpos("hinge")] = angle
        mujoco.mj_kinematics(scene.model, data)
        normal = data.body("door").xmat.reshape(3, 3)[:, 0]
        position, rotation = grasp_pose(scene, angle, 0.05, roll)
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        np.testing.assert_allclose(rotation[:, 2], normal, atol=1e-12)
        np.testing.assert_allclose(rotation[:, 0], [0, 0, roll], atol=1e-12)
        np.testing.assert_allclose(position, data.site("knob").xpos - 0.05 * normal, atol=1e-12)


def test_inverse_kinematics_arrives(scene: Scene):
    rng = np.random.default_rng(0)
    data, site = mujoco.MjData(scene.model), scene.id("site", "pinch")
    for plan in PLANS.values():
        position, rotation = grasp_pose(scene, 0.0, 0.0, plan.roll)
        q = solve_pose(scene, np.array(plan.pose) + rng.normal(0, 0.05, 7), position, rotation)
        data.qpos[scene.joint_qpos] = q
        mujoco.mj_kinematics(scene.model, data)
        np.testing.assert_allclose(data.site_xpos[site], position, atol=1e-6)
        np.testing.assert_allclose(data.site_xmat[site].reshape(3, 3), rotation, atol=1e-6)


def test_a_pose_out_of_reach_is_refused(scene: Scene):
    with pytest.raises(ValueError, match=r"inverse kinematics ended .* away from the pose"):
        solve_pose(scene, np.array(PLANS["A"].pose), np.array([2.0, 0.0, 0.5]), np.eye(3))


def test_the_hand_stays_on_the_knob_from_grasp_to_end(scene: Scene, shipped: Recording):
    """Forward kinematics of the whole path: the pinch point is on the knob's circle about the hinge."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    axis, knob = data.joint("hinge").xanchor.copy(), data.site("knob").xpos.copy()
    grasp = next(p for p in shipped.phases if p.name == "grasp")
    path = path_of(shipped)[shipped.time >= grasp.start]
    points, looks = np.empty((len(path), 3)), np.empty((len(path), 3))
    for k, q in enumerate(path):
        data.qpos[scene.joint_qpos] = q
        mujoco.mj_kinematics(scene.model, data)
        points[k] = data.site("pinch").xpos
        looks[k] = data.site("pinch").xmat.reshape(3, 3)[:, 2]
    np.testing.assert_allclose(points[:, 2], knob[2], atol=1e-5)
    radius = np.linalg.norm(points[:, :2] - axis[:2], axis=1)
    np.testing.assert_allclose(radius, np.linalg.norm(knob[:2] - axis[:2]), atol=1e-5)
    arm, closed = points[:, :2] - axis[:2], knob[:2] - axis[:2]
    turned = np.arctan2(closed[0] * arm[:, 1] - closed[1] * arm[:, 0], arm @ closed)
    np.testing.assert_allclose(np.abs(turned[0]), 0.0, atol=1e-5)
    assert np.rad2deg(np.abs(turned).max()) == pytest.approx(50.0, abs=0.01)
    heading = np.arctan2(looks[:, 1], looks[:, 0])
    np.testing.assert_allclose(np.unwrap(heading), turned, atol=1e-5)  # the hand turns with the door


@pytest.mark.slow
def test_shipped_demonstrations_are_what_the_plans_make(scene: Scene):
    made, file = demonstrate(scene, PLANS["A"]), load_recording(demonstration_path("A"))
    np.testing.assert_allclose(made.command, file.command, atol=1e-6)
    assert made.phases == file.phases and made.command_names == file.command_names
    np.testing.assert_allclose(made.gains.stiffness, file.gains.stiffness)


def test_limits_of_the_panda_are_kept(scene: Scene, shipped: Recording):
    """Franka's data sheet: joint ranges, and velocities of 2.175 and 2.61 rad/s."""
    ids = [scene.id("joint", j) for j in ARM]
    low, high = scene.model.jnt_range[ids].T
    path = path_of(shipped)
    assert (path > low + 0.05).all() and (path < high - 0.05).all()
    command = shipped.command[:, :7]
    assert (command > low).all() and (command < high).all()
    speed = np.abs(np.gradient(path, shipped.time, axis=0)).max(axis=0)
    assert (speed < [2.175] * 4 + [2.61] * 3).all()


def test_demonstrations_start_and_end_at_rest_without_jumps(shipped: Recording):
    command, path = shipped.command, path_of(shipped)
    assert np.abs(np.diff(command[:, :7], axis=0)).max() < 0.005
    for end in (path[:5], path[-5:]):
        assert np.abs(np.diff(end, axis=0)).max() < 1e-5
    acceleration = np.diff(path, 2, axis=0) / 0.002**2
    assert np.abs(np.diff(acceleration, axis=0)).max() < 1.0  # rad/s^2 from one command to the next
    assert all(shipped.qpos0[j] == pytest.approx(q) for j, q in zip(ARM, path[0], strict=True))


def test_phases_tile_the_motion_and_the_fingers_close_in_the_grasp(shipped: Recording):
    assert shipped.phases[0].start == 0.0
    assert shipped.phases[-1].end == pytest.approx(shipped.time[-1], abs=1e-6)
    for before, after in zip(shipped.phases, shipped.phases[1:], strict=False):
        assert after.start == pytest.approx(before.end) and after.name != before.name
    assert len({p.name for p in shipped.phases}) == len(shipped.phases)
    grasp = next(p for p in shipped.phases if p.name == "grasp")
    fingers = shipped.command[:, 7:]
    assert shipped.command_names == (*ARM, *FINGERS)
    np.testing.assert_allclose(fingers[shipped.time <= grasp.start + 1e-9], OPEN)
    np.testing.assert_allclose(fingers[shipped.time >= grasp.end - 1e-9], CLOSED, atol=1e-12)


def test_the_command_leads_so_that_the_servo_stays_on_the_path(scene: Scene):
    """In free motion a servo with damping D and stiffness K trails by D/K v unless the command leads by it."""
    recording = load_recording(demonstration_path("A"))
    rollout = c_replay(scene, door_space(scene), make_drive(scene, recording))(door_space(scene).mean[None])
    free = recording.time < 1.5
    path = path_of(recording)
    lag = np.abs(rollout.position[0] - path)[free].max()
    lead = np.abs(recording.command[:, :7] - path)[free].max()
    assert lead > 0.005
    assert lag < 0.1 * lead
    assert np.rad2deg(rollout.object_angle.max()) == pytest.approx(50.0, abs=2.0)


@pytest.mark.slow
def test_a_path_too_close_to_a_limit_is_refused(scene: Scene):
    plan = PLANS["A"]
    far = replace(plan, segments=tuple(replace(s, angle=s.angle * 1.9) for s in plan.segments))
    with pytest.raises(ValueError, match=r"demonstration A: panda_joint\d (comes within|needs)|inverse kinematics"):
        demonstrate(scene, far)
    hasty = replace(plan, segments=tuple(replace(s, seconds=s.seconds / 6) for s in plan.segments))
    with pytest.raises(ValueError, match=r"demonstration A: panda_joint\d needs \d+% of its torque limit"):
        demonstrate(scene, hasty)


def test_unknown_demonstrations_list_the_shipped_ones():
    with pytest.raises(
        ValueError, match=r"no demonstration 'Z' for 'impedance' gains.*A_impedance_knob0.*B_impedance_knob0"
    ):
        demonstration_path("Z")
