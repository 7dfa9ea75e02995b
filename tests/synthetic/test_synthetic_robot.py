"""The synthetic robot's errors and sensors: what was hidden is what a replay has to be given, with its sign."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from small_gap import TRUTH, demonstration, small_scene

from droid_jax.cost.cost import make_cost
from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_nuisances
from droid_jax.model.fields import body_mass_scale, body_position, joint_damping, servo_scale, time_offset
from droid_jax.model.parameters import Space
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import TorqueSide
from droid_jax.synthetic.hidden_effects import record_hidden
from droid_jax.synthetic.robot import DRIFT_TIME, SyntheticRobotConfig, _torque_noise, set_up

QUIET = SyntheticRobotConfig(
    repeats=2, timestep=0.00025, torque_noise=(1e-3, 1e-3), torque_drift=(0.0, 0.0), start_noise=0.0, pose_noise=0.0
)


def test_a_hidden_delay_and_offset_come_back_with_their_signs():
    scene, known = small_scene()
    space = known + Space((time_offset(),))
    hidden = {**TRUTH, "time_offset": 0.01, "torque_offset[elbow]": 0.2}
    recording = record_hidden(scene, demonstration("train"), hidden, {}, seed=1, config=QUIET, space=space)
    wrong = (
        {"time_offset": -0.01},
        {"time_offset": 0.0},
        {"torque_offset[elbow]": -0.2},
        {"torque_offset[elbow]": 0.0},
    )
    rows = [space.values(hidden), *(space.values({**hidden, **other}) for other in wrong)]
    right, *others = make_cost(scene, space, [recording])(np.stack(rows))
    assert right < 0.2 * min(others)


def test_noise_and_drift_are_as_large_as_they_say_at_arm_and_wrist():
    config = SyntheticRobotConfig(torque_noise=(0.05, 0.02), torque_drift=(0.0, 0.0))
    white = _torque_noise((4, 20000, 7), config, np.random.default_rng(0)).std(axis=(0, 1))
    np.testing.assert_allclose(white, [0.05] * 4 + [0.02] * 3, rtol=0.02)
    config = SyntheticRobotConfig(torque_noise=(0.0, 0.0), torque_drift=(0.04, 0.01))
    drift = _torque_noise((4, 200000, 7), config, np.random.default_rng(1))
    np.testing.assert_allclose(drift.std(axis=(0, 1)), [0.04] * 4 + [0.01] * 3, rtol=0.05)
    lag = round(DRIFT_TIME * config.rate)
    kept = np.mean(drift[:, lag:] * drift[:, :-lag], axis=(0, 1)) / drift.var(axis=(0, 1))
    np.testing.assert_allclose(kept, np.exp(-1), atol=0.06)


def test_every_repeat_begins_and_measures_a_little_otherwise():
    scene, space = small_scene()
    config = replace(QUIET, start_noise=1e-3, repeats=40)
    shown = demonstration("train")
    robot = set_up(scene, shown, TRUTH, seed=3, config=config, space=space)
    apart = robot.qpos0[:, scene.joint_qpos] - robot.qpos0[:, scene.joint_qpos].mean(axis=0)
    assert np.std(apart) == pytest.approx(1e-3, rel=0.3)


def test_the_door_stands_a_little_otherwise_in_every_repeat():
    scene, config = door_scene(), replace(QUIET, pose_noise=2e-3, repeats=40)
    robot = set_up(scene, load_recording(demonstration_path("A")), {}, seed=3, config=config)
    nuisances = door_nuisances(robot.scene)
    for axis in ("door_x", "door_y"):
        (write,) = nuisances[axis].writes
        at = [getattr(m, write.field)[write.index] for m in robot.models]
        assert np.std(at) == pytest.approx(2e-3, rel=0.35)


def test_without_a_truth_the_synthetic_robot_is_the_scene():
    """Whether a parameter sets a number of the model, scales it or adds to it."""
    scene, _ = small_scene()
    forearm, elbow = "forearm", "elbow"
    space = Space(
        (
            joint_damping(scene, elbow, std=1.0, high=20.0),
            body_mass_scale(scene, forearm, std=0.1),
            body_position(scene, forearm, 0, std=0.01, limit=0.5),
            servo_scale(scene, elbow, std=0.1),
        )
    )
    robot = set_up(scene, demonstration("train"), {}, seed=3, config=QUIET, space=space)
    for field in ("dof_damping", "body_mass", "body_inertia", "body_pos", "actuator_gainprm", "actuator_biasprm"):
        for model in robot.models:
            np.testing.assert_allclose(getattr(model, field), getattr(robot.scene.model, field), rtol=1e-12)


def test_the_link_side_of_dry_friction_in_the_model_is_not_known():
    scene, space = small_scene()
    rubs = copy.copy(scene.model)
    rubs.dof_frictionloss[scene.dof("elbow")] = 0.5
    with pytest.raises(ValueError, match=r"link side of joints with a frictionloss of their own \(elbow"):
        config = replace(QUIET, side=TorqueSide.LINK)
        set_up(replace(scene, model=rubs), demonstration("train"), TRUTH, seed=3, config=config, space=space)


def test_a_rate_above_the_time_steps_is_refused():
    scene, space = small_scene()
    with pytest.raises(ValueError, match="at most once per time step, at 4000 Hz, got a rate of 9000 Hz"):
        set_up(scene, demonstration("train"), {}, seed=3, config=replace(QUIET, rate=9000.0), space=space)
