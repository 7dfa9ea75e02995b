"""The synthetic robot records motions and runs trials of a policy."""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scripted import Script, opening
from small_gap import TRUTH, demonstration, small_scene

from droid_jax.cost.cost import make_cost
from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.environment import waiting_pose
from droid_jax.door.hand import looked
from droid_jax.door.policy_interface import interface_of
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_nuisances
from droid_jax.door.task import Task
from droid_jax.model.fields import body_mass_scale, body_position, joint_damping, servo_scale, time_offset
from droid_jax.model.parameters import Space
from droid_jax.model.scene import with_options
from droid_jax.policy.trials import BLOWN_UP, Trials
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import TorqueSide
from droid_jax.synthetic import policy_trials as module
from droid_jax.synthetic.hidden_effects import Applied, record_hidden
from droid_jax.synthetic.policy_trials import TransferConfig, _senses, _trial, filmed, synthetic_robot, transfer
from droid_jax.synthetic.robot import SyntheticRobotConfig, _torque_noise, set_up, synthetic_truth

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
    fine = with_options(scene, timestep=0.00025)
    right, *others = make_cost(fine, space, [recording], engine="mujoco")(np.stack(rows))
    assert right < 0.2 * min(others)


def test_noise_and_drift_are_as_large_as_they_say_at_arm_and_wrist():
    config = SyntheticRobotConfig(torque_noise=(0.05, 0.02), torque_drift=(0.0, 0.0))
    white = _torque_noise((4, 20000, 7), config, np.random.default_rng(0)).std(axis=(0, 1))
    np.testing.assert_allclose(white, [0.05] * 4 + [0.02] * 3, rtol=0.02)
    config = SyntheticRobotConfig(torque_noise=(0.0, 0.0), torque_drift=(0.04, 0.01))
    drift = _torque_noise((4, 200000, 7), config, np.random.default_rng(1))
    np.testing.assert_allclose(drift.std(axis=(0, 1)), [0.04] * 4 + [0.01] * 3, rtol=0.05)
    lag = round(config.drift_time * config.rate)
    kept = np.mean(drift[:, lag:] * drift[:, :-lag], axis=(0, 1)) / drift.var(axis=(0, 1))
    np.testing.assert_allclose(kept, np.exp(-1), atol=0.06)


def test_repeats_differ_in_start_and_noise():
    scene, space = small_scene()
    config = replace(QUIET, start_noise=1e-3, repeats=40)
    shown = demonstration("train")
    robot = set_up(scene, shown, TRUTH, seed=3, config=config, space=space)
    apart = robot.qpos0[:, scene.joint_qpos] - robot.qpos0[:, scene.joint_qpos].mean(axis=0)
    assert np.std(apart) == pytest.approx(1e-3, rel=0.3)


def test_repeats_differ_in_the_doors_position():
    scene, config = door_scene(), replace(QUIET, pose_noise=2e-3, repeats=40)
    robot = set_up(scene, load_recording(demonstration_path("A")), {}, seed=3, config=config)
    nuisances = door_nuisances(robot.scene)
    for axis in ("door_x", "door_y"):
        (write,) = nuisances[axis].writes
        at = [getattr(m, write.field)[write.index] for m in robot.models]
        assert np.std(at) == pytest.approx(2e-3, rel=0.35)


def test_without_a_truth_the_synthetic_robot_is_the_scene():
    """For parameters that set a number of the model, scale it or add to it."""
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


def test_link_side_torques_with_dry_friction_in_the_model_are_refused():
    scene, space = small_scene()
    rubs = copy.copy(scene.model)
    rubs.dof_frictionloss[scene.dof("elbow")] = 0.5
    with pytest.raises(ValueError, match=r"link-side torques of joints with a frictionloss \(elbow"):
        config = replace(QUIET, side=TorqueSide.LINK)
        set_up(replace(scene, model=rubs), demonstration("train"), TRUTH, seed=3, config=config, space=space)


def test_a_rate_above_the_time_steps_is_refused():
    scene, space = small_scene()
    with pytest.raises(ValueError, match="at most once per time step, at 4000 Hz, got a rate of 9000 Hz"):
        set_up(scene, demonstration("train"), {}, seed=3, config=replace(QUIET, rate=9000.0), space=space)


# ----- the synthetic robot in closed loop: what opens by the book opens, and what must fail fails


TASK = Task(steps=260, spread=0.0)
ONE = TransferConfig(trials=1)


@pytest.fixture(scope="module")
def scene():
    return door_scene(limits=True)


@pytest.fixture(scope="module")
def start(scene) -> np.ndarray:
    return waiting_pose(scene, TASK)


@pytest.fixture(scope="module")
def commands(scene) -> np.ndarray:
    return opening(scene, TASK, 2.4, np.deg2rad(42.0), hold=1.0)


def tried(scene, start, commands, truth=None, hidden=(), task=TASK) -> Trials:
    truth = synthetic_truth(scene, 0, 0) if truth is None else truth
    script = Script(task, commands, interface_of(scene, task, start))
    return transfer(script, synthetic_robot(scene, start, truth, hidden, task, ONE))  # type: ignore[arg-type]


def test_the_demonstrated_opening_succeeds_with_grip(scene, start, commands):
    found = tried(scene, start, commands)
    assert found.success[0] and found.angle[0] > np.deg2rad(30.0)
    assert 100 < found.steps[0] < TASK.steps
    assert found.grip[0] > 0.5


def test_a_film_shows_the_same_trial(scene, start, commands):
    truth, task = synthetic_truth(scene, 0, 0), replace(TASK, steps=12, spread=0.02)
    robot = synthetic_robot(scene, start, truth, (), task, replace(ONE, trials=2))

    def script() -> Script:
        return Script(task, commands, interface_of(scene, task, start))

    films = [filmed(script(), robot, number) for number in (1, 1, 0)]  # type: ignore[arg-type]
    assert films[0].shape == (13, scene.model.nq)
    np.testing.assert_array_equal(films[0], films[1])
    assert np.abs(films[0][0] - films[2][0]).max() > 1e-3


def test_observed_frames_and_joints_are_of_one_instant(scene, start, commands, monkeypatch: pytest.MonkeyPatch):
    task, late = replace(TASK, steps=12), []
    robot = synthetic_robot(scene, start, synthetic_truth(scene, 0, 0), (), task, ONE)

    def looking(hand, data, *rest):
        fresh = mujoco.MjData(robot.scene.model)
        fresh.qpos[:] = data.qpos
        mujoco.mj_kinematics(robot.scene.model, fresh)
        late.append(np.abs(fresh.site_xpos - data.site_xpos).max())
        return looked(hand, data, *rest)

    monkeypatch.setattr(module, "looked", looking)
    transfer(Script(task, commands, interface_of(scene, task, start)), robot)  # type: ignore[arg-type]
    assert len(late) == 13 and max(late) < 1e-9


def test_a_policy_of_another_rate_is_refused(scene, start, commands):
    robot = synthetic_robot(scene, start, {}, (), replace(TASK, control=0.04), ONE)
    with pytest.raises(ValueError, match=r"the policy acts every 0.02 s, the task every 0.04 s"):
        transfer(Script(TASK, commands, interface_of(scene, TASK, start)), robot)  # type: ignore[arg-type]


def test_a_strong_preload_reduces_the_opening(scene, start, commands):
    """The same commands open the door less against a preload that closes it."""
    free, held = (tried(scene, start, commands, hidden=h) for h in ((), (Applied("hinge_preload", 6.0),)))
    assert held.angle[0] < free.angle[0] - np.deg2rad(1.0)


def test_without_friction_on_the_pads_nothing_opens(scene, start, commands):
    slippery = {**synthetic_truth(scene, 2, 0), "hinge_stiffness": 8.0}
    slippery |= {n: 0.05 for n in slippery if n.startswith(("sliding_friction", "torsional_friction"))}
    found = tried(scene, start, commands, slippery)
    assert not found.success[0] and found.angle[0] < np.deg2rad(30.0)


def test_a_hand_at_rest_opens_nothing(scene, start):
    found = tried(scene, start, np.repeat(np.append(start[scene.joint_qpos], [0.04, 0.04])[None], 2, axis=0),
                  task=replace(TASK, steps=40))  # fmt: skip
    assert not found.success[0] and found.steps[0] == 40
    assert found.angle[0] < 0.01 and found.grip[0] == 0.0


def test_trials_differ_and_the_same_seed_repeats_them(scene, start, commands):
    task = replace(TASK, steps=10, spread=0.05)
    interface, truth = interface_of(scene, task, start), synthetic_truth(scene, 0, 0)

    def begun(seed: int) -> list[np.ndarray]:
        robot = synthetic_robot(scene, start, truth, (), task, replace(ONE, trials=3, seed=seed))
        return [filmed(Script(task, commands, interface), robot, number)[0] for number in range(3)]  # type: ignore[arg-type]

    first, again, other = begun(0), begun(0), begun(1)
    np.testing.assert_array_equal(first, again)
    assert all(
        np.abs(a - b).max() > 0.01 for a, b in ((first[0], first[1]), (first[1], first[2]), (first[0], other[0]))
    )


def test_a_diverging_simulation_stops_the_trial(scene, start, commands):
    """MuJoCo resets it; the trial must not continue."""
    script = Script(TASK, commands, interface_of(scene, TASK, start))
    seen, hinge = list[float](), scene.dof(scene.object_joint)

    def watch(data: mujoco.MjData) -> None:
        seen.append(data.time)
        if len(seen) == 5:
            data.qvel[hinge] = 1e12  # no sensor of the policy sees it

    robot = synthetic_robot(scene, start, synthetic_truth(scene, 0, 0), (), TASK, ONE)
    success, angle, steps, _, stopped = _trial(script, robot, 0, watch)  # type: ignore[arg-type]
    assert stopped == "the simulation blew up"
    assert not success and steps == 4 and len(seen) == 5 and 0 <= angle < 0.1


def test_the_interval_is_wilsons():
    found = Trials(np.arange(100) < 80, *np.zeros((3, 100)), np.full(100, ""))
    low, high = found.interval()
    assert (low, high) == (pytest.approx(0.711, abs=1e-3), pytest.approx(0.867, abs=1e-3))


def test_statistics_of_trials():
    why = ["", "", "too fast: joint 5 at 2.7 rad/s", "too fast: joint 1 at 3.1 rad/s"]
    found = Trials(
        np.array([True, True, False, False]), np.ones(4), np.array([100, 200, 3, 5]), np.ones(4), np.array(why)
    )
    content = found.to_json()
    assert content["steps"]["mean"] == 150.0 and content["steps"]["all"] == [100, 200, 3, 5]
    assert content["stopped"] == {"too fast": 2} and content["stopped_each"] == ["", "", "too fast", "too fast"]
    nothing = Trials(np.zeros(2, bool), np.zeros(2), np.ones(2), np.zeros(2), np.full(2, "")).to_json()
    assert nothing["steps"]["mean"] is None and nothing["stopped"] == {}


def test_diverged_trials_are_not_counted():
    """All of the eight counted trials succeed; two diverge."""
    blown = np.arange(10) >= 8
    found = Trials(~blown, np.where(blown, 9.0, 1.0), np.full(10, 7), 1.0 * ~blown, np.where(blown, BLOWN_UP, ""))
    content, alone = found.to_json(), Trials(*(a[:8] for a in (found.success, found.angle, found.steps, found.grip)),
                                             found.stopped[:8])  # fmt: skip
    assert found.rate == 1.0 and found.interval() == alone.interval()
    assert content["trials"] == 10 and content["stopped"] == {BLOWN_UP: 2} and len(content["success"]) == 10
    assert content["angle_deg"]["mean"] == pytest.approx(np.rad2deg(1.0)) and content["grip"]["mean"] == 1.0
    nothing = Trials(*(a[8:] for a in (found.success, found.angle, found.steps, found.grip)), found.stopped[8:])
    with pytest.raises(ValueError, match="blew up in all 2 trials"):
        _ = nothing.rate
    assert nothing.to_json()["success_rate"] is None and nothing.to_json()["angle_deg"]["mean"] is None


def test_invalid_amplitudes_are_refused(scene, start):
    with pytest.raises(ValueError, match="hidden effect 'closer' needs a finite, not negative amplitude, got nan"):
        synthetic_robot(scene, start, {}, (Applied("closer", np.nan),), TASK, ONE)


def test_effects_on_whole_traces_are_refused(scene, start, commands):
    with pytest.raises(ValueError, match="hidden effects command_delay change whole traces"):
        tried(scene, start, commands, hidden=(Applied("command_delay", 0.01),))


def test_sensor_noise_has_the_configured_size(scene):
    """The camera's error is constant in a trial, and different in the next."""
    config = TransferConfig(position_noise=1e-3, velocity_noise=2e-2, knob_noise=3e-3)
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    seen = []
    for trial in range(30):
        sense = _senses(scene, data, config, np.random.default_rng(trial))
        readings = [sense(0.02 * k) for k in range(50)]
        position, velocity = (np.array([getattr(r, what) for r in readings]) for what in ("position", "velocity"))
        assert np.std(position - data.qpos[scene.joint_qpos]) == pytest.approx(1e-3, rel=0.15)
        assert np.std(velocity - data.qvel[scene.joint_dofs]) == pytest.approx(2e-2, rel=0.15)
        knobs = np.array([sense(0.02 * k).knob[:3, 3].copy() for k in range(3)])
        np.testing.assert_array_equal(knobs, knobs[:1].repeat(3, axis=0))
        seen.append(knobs[0] - data.site("knob").xpos)
    assert np.std(seen) == pytest.approx(3e-3, rel=0.25) and abs(np.mean(seen)) < 1e-3


def test_a_time_step_that_divides_no_action_is_refused():
    scene = door_scene(limits=True)
    for timestep in (0.0003, 0.05):
        with pytest.raises(ValueError, match=f"is no multiple of the synthetic robot's time step, {timestep:g} s"):
            synthetic_robot(scene, np.zeros(scene.model.nq), {}, config=TransferConfig(trials=1, timestep=timestep))
