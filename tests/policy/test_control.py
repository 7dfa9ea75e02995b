"""The control loop: the observation of the training, limits, stops, and no dependency but numpy."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from droid_jax.door.environment import waiting_pose
from droid_jax.door.hand import hand_of, looked
from droid_jax.door.policy_interface import interface_of
from droid_jax.door.scene import door_scene
from droid_jax.door.task import Task
from droid_jax.door.task import observation as trained_on
from droid_jax.policy import control
from droid_jax.policy.control import ACTIONS, OBSERVED, Command, Controller, Interface, Policy, Reading, Safety, drive
from droid_jax.policy.network import save_policy

TASK = Task()


@pytest.fixture(scope="module")
def scene():
    return door_scene(limits=True)


@pytest.fixture(scope="module")
def start(scene) -> np.ndarray:
    return waiting_pose(scene, TASK)


@pytest.fixture(scope="module")
def interface(scene, start) -> Interface:
    return interface_of(scene, TASK, start)


@pytest.fixture(scope="module")
def policy(interface) -> Policy:
    rng = np.random.default_rng(0)
    weights = (0.3 * rng.normal(size=(OBSERVED, 16)), 0.3 * rng.normal(size=(16, 2 * ACTIONS)))
    return Policy(np.zeros(OBSERVED), np.ones(OBSERVED), weights, (np.zeros(16), np.zeros(2 * ACTIONS)), interface)


def state(scene, start, rng: np.random.Generator) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    data.qpos[:] = start
    data.qpos[scene.joint_qpos] += rng.normal(0, 0.3, 7)
    data.qpos[[scene.qpos(f"panda_finger_joint{i}") for i in (1, 2)]] = rng.uniform(0, 0.04, 2)
    data.qpos[scene.qpos("hinge")] = rng.uniform(0, 1)
    data.qvel[scene.joint_dofs] = rng.normal(0, 0.3, 7)
    mujoco.mj_forward(scene.model, data)
    return data


def reading(scene, data: mujoco.MjData, time: float = 0.0) -> Reading:
    knob = np.eye(4)
    site = scene.id("site", "knob")
    knob[:3, :3], knob[:3, 3] = data.site_xmat[site].reshape(3, 3), data.site_xpos[site]
    fingers = data.qpos[[scene.qpos(f"panda_finger_joint{i}") for i in (1, 2)]].copy()
    position, velocity = data.qpos[scene.joint_qpos].copy(), data.qvel[scene.joint_dofs].copy()
    return Reading(time, position, velocity, np.zeros(7), fingers, knob)


@pytest.fixture
def still(scene, start) -> Reading:
    data = mujoco.MjData(scene.model)
    data.qpos[:] = start
    mujoco.mj_forward(scene.model, data)
    return reading(scene, data)


def test_the_observation_is_that_of_the_training(scene, start, interface):
    """Kinematics in numpy against MuJoCo's, at random poses of arm, fingers and door."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        data = state(scene, start, rng)
        seen = looked(hand_of(scene), data, np.zeros(2), np.zeros((2, 3)), 1.0, np)
        with jax.enable_x64(True):  # what training computes, to as many digits as MuJoCo has
            expected = trained_on(data.qpos[scene.joint_qpos], data.qvel[scene.joint_dofs], seen)
        np.testing.assert_allclose(control.observe(interface, reading(scene, data)), expected, atol=1e-9)


def test_an_action_is_relative_to_the_joints_positions(interface):
    gentle = replace(interface, effort=np.full(7, np.inf), ranges=np.tile([-np.inf, np.inf], (7, 1)))
    action = np.array([1.0, -5.0, 0, 0, 0, 0, 0.5, -1.0, 3.0])
    found = control.limited(gentle, Safety(), np.full(7, 0.5), action)
    np.testing.assert_allclose(found.arm, [0.6, 0.4, 0.5, 0.5, 0.5, 0.5, 0.55], atol=1e-9)
    np.testing.assert_allclose(found.fingers, [0.0, TASK.width], atol=1e-9)


def test_training_uses_the_limits_of_the_robot(interface):
    rng = np.random.default_rng(2)
    for _ in range(20):
        position, action = rng.normal(size=7), rng.uniform(-1.5, 1.5, 9)
        robot, training = (control.limited(interface, Safety(), position, action, numbers) for numbers in (np, jnp))
        np.testing.assert_allclose(training.arm, robot.arm, atol=1e-6)
        np.testing.assert_allclose(training.fingers, robot.fingers, atol=1e-6)


def test_targets_keep_inside_torques_and_ranges(interface):
    rng = np.random.default_rng(3)
    low, high = interface.ranges.T
    for _ in range(200):
        position = rng.uniform(low, high)
        found = control.limited(interface, Safety(), position, rng.choice([-1.0, 1.0], 9))
        inside = (found.arm >= low + 0.02 - 1e-12) & (found.arm <= high - 0.02 + 1e-12)
        assert inside.all() and ((found.fingers == 0) | (found.fingers == 0.04)).all()
        free = (position > low + 0.2) & (position < high - 0.2)
        torque = interface.stiffness * np.abs(found.arm - position)
        assert (torque[free] <= interface.effort[free] + 1e-9).all()
        assert torque[4] <= 12.0 + 1e-9 or not free[4]


def test_a_good_reading_is_acted_on(policy, still):
    loop = Controller(policy)
    first = loop.act(still)
    second = loop.act(replace(still, time=0.02))
    assert loop.stopped is None and second.stopped is None
    np.testing.assert_array_equal(first.arm, second.arm)


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda r: replace(r, time=0.0), "stale reading"),
        (lambda r: replace(r, time=np.nan), "stale reading"),
        (lambda r: replace(r, time=0.1), "late: 100 ms between readings, expected 20"),
        (lambda r: replace(r, position=np.full(7, np.nan)), "position holds a value that is NaN or infinite"),
        (lambda r: replace(r, knob=np.full((4, 4), np.inf)), "knob holds a value that is NaN or infinite"),
        (lambda r: replace(r, velocity=np.zeros(6)), r"velocity must have shape \[7\], got \[6\]"),
        (lambda r: replace(r, velocity=np.array([0, 0, 0, 0, 2.7, 0, 0])), "too fast: joint 5 at 2.7 rad/s"),
        (lambda r: replace(r, torque=np.array([0, 99, 0, 0, 0, 0, 0])), "too much torque: joint 2 at 99 N m"),
        (lambda r: replace(r, torque=[[1.0], [1.0, 2.0]]), "a reading that cannot be read"),
        (lambda r: replace(r, position=r.position + 2 * np.pi * np.eye(7)[6]), "out of range: joint 7"),
        (lambda r: replace(r, position=r.position - 0.5 * np.eye(7)[0]), "the hand has left its workspace"),
        (lambda r: replace(r, knob=1e3 * r.knob), "the knob's pose is invalid"),
        (lambda r: replace(r, sight=-0.09), "stale pose of the knob: it is of -0.09 s, the reading of 0.02 s"),
        (lambda r: replace(r, sight=np.nan), "stale pose of the knob"),
    ],
)  # fmt: skip
def test_it_stops_and_holds_the_pose(policy, still, spoil, why: str):
    loop = Controller(policy)
    before = loop.act(still)
    bad = loop.act(spoil(replace(still, time=0.02)))
    assert bad.stopped is not None and loop.stopped == bad.stopped
    with pytest.raises(AssertionError, match=why):
        raise AssertionError(bad.stopped)
    np.testing.assert_array_equal(bad.arm, still.position)
    np.testing.assert_array_equal(bad.fingers, before.fingers)
    again = loop.act(replace(still, time=0.04))
    assert again.stopped == bad.stopped
    np.testing.assert_array_equal(again.arm, still.position)


def test_an_invalid_first_reading_is_refused(policy, still):
    with pytest.raises(ValueError, match="cannot begin: position holds a value that is NaN or infinite"):
        Controller(policy).act(replace(still, position=np.full(7, np.nan)))


@pytest.mark.parametrize("moved", [np.array([0.0, 0.06, 0.0]), np.array([300.0, 0.0, 0.0])])
def test_a_displaced_knob_is_refused_at_the_beginning(policy, still, moved):
    knob = still.knob.copy()
    knob[:3, 3] += moved
    with pytest.raises(ValueError, match=r"cannot begin: the knob is elsewhere: [\d.]+ m and 0.00 rad"):
        Controller(policy).act(replace(still, knob=knob))


@pytest.mark.parametrize(("turned", "begins"), [(0.1, True), (0.3, False), (np.pi / 2, False)])
def test_a_turned_knob_is_refused_at_the_beginning(policy, still, turned, begins):
    """A pose in the camera's frame, not the base's, would drive the arm."""
    knob, c, s = still.knob.copy(), np.cos(turned), np.sin(turned)
    knob[:3, :3] = knob[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    if begins:
        assert Controller(policy).act(replace(still, knob=knob)).stopped is None
        return
    with pytest.raises(ValueError, match=rf"0.00 m and {turned:.2f} rad from its pose in training"):
        Controller(policy).act(replace(still, knob=knob))


def test_a_policy_for_another_knob_location_is_refused(policy, scene):
    next_place = door_scene(limits=True, knob=1)
    own = interface_of(next_place, TASK, waiting_pose(next_place, TASK))
    data = mujoco.MjData(scene.model)
    data.qpos[:] = waiting_pose(scene, TASK)
    mujoco.mj_forward(scene.model, data)
    at_the_limit = replace(reading(scene, data), position=own.start[:7], fingers=own.start[7:])
    with pytest.raises(ValueError, match=r"cannot begin: the knob is elsewhere: 0\.05 m"):
        Controller(replace(policy, interface=own)).act(at_the_limit)


def test_a_pose_of_the_knob_may_be_slightly_old(policy, still):
    loop = Controller(policy)
    assert loop.act(replace(still, sight=-0.05)).stopped is None
    assert loop.act(replace(still, time=0.02, sight=-0.05)).stopped is None


def test_the_knob_may_move_after_the_beginning(policy, still):
    loop, knob = Controller(policy), still.knob.copy()
    loop.act(still)
    knob[:3, 3] -= [0.1, 0.0, 0.0]
    assert loop.act(replace(still, time=0.02, knob=knob)).stopped is None


def test_readings_are_copied(policy, still):
    loop, buffer = Controller(policy), still.position.copy()
    loop.act(replace(still, position=buffer))
    buffer[:] = np.nan
    held = loop.act(replace(still, position=buffer, time=0.02))
    assert held.stopped is not None
    np.testing.assert_array_equal(held.arm, still.position)


def test_a_policy_that_gives_nan_is_stopped(policy, still):
    loop = Controller(policy)
    loop.act(still)
    loop.policy = replace(policy, biases=(policy.biases[0], np.full(2 * ACTIONS, np.nan)))
    held = loop.act(replace(still, time=0.02))
    assert held.stopped == "the policy's command holds a value that is NaN or infinite"
    np.testing.assert_array_equal(held.arm, still.position)


def test_a_command_with_nan_is_stopped(policy, still):
    loop = Controller(policy)
    loop.act(still)
    loop.policy = replace(policy, interface=replace(policy.interface, width=np.nan))
    held = loop.act(replace(still, time=0.02))
    assert (
        held.stopped == "the policy's command holds a value that is NaN or infinite" and np.isfinite(held.fingers).all()
    )


def test_early_readings_stop_the_loop(policy, still):
    loop = Controller(policy)
    loop.act(still)
    assert loop.act(replace(still, time=0.0001)).stopped == "early: 0 ms between readings, expected 20"
    loop = Controller(policy)
    loop.act(still)
    assert loop.act(replace(still, time=0.011)).stopped is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"weight_0": np.zeros((20, 16))}, r"weight_0 has shape \(20, 16\), expected \(23, 16\)"),
        ({"bias_1": np.zeros(9)}, r"bias_1 has shape \(9,\), expected \(18,\)"),
        ({"effort": np.zeros(6)}, r"effort has shape \(6,\), expected \(7,\)"),
        ({"effort": np.full(7, np.nan)}, "effort hold NaN"),
    ],
)
def test_a_damaged_file_is_refused(policy, tmp_path: Path, changes, said: str):
    np.savez(tmp_path / "policy.npz", **{**control.arrays(policy), **changes})
    with pytest.raises(ValueError, match=said):
        control.load_policy(tmp_path / "policy.npz")


def test_a_robot_without_torque_sensors_is_fine(policy, still):
    assert Controller(policy).act(replace(still, torque=None)).stopped is None


class Arm:
    """A robot that does not move, whose clock fails after some readings."""

    def __init__(self, reading: Reading, good: int):
        self.reading, self.good, self.time, self.sent = reading, good, 0.0, list[Command]()

    def read(self) -> Reading:
        return replace(self.reading, time=min(self.time, self.good * 0.02))

    def send(self, command: Command) -> None:
        self.sent.append(command)

    def wait(self, period: float) -> None:
        self.time += period


def test_driving_ends_with_the_time_or_with_a_stop(policy, still):
    arm = Arm(still, 1000)
    assert drive(Controller(policy), arm, 0.2) is None and len(arm.sent) == 11
    np.testing.assert_array_equal(arm.sent[-1].arm, still.position)  # in the end it holds
    arm = Arm(still, 4)
    assert "stale" in str(drive(Controller(policy), arm, 0.2)) and len(arm.sent) == 6
    assert arm.sent[-1].stopped is not None


def test_a_robot_that_fails_is_sent_a_command_to_hold(policy, still):
    arm = Arm(still, 1000)

    def fail() -> Reading:
        if len(arm.sent) == 3:
            raise OSError("no connection")
        return Arm.read(arm)

    arm.read = fail  # type: ignore[method-assign]
    with pytest.raises(OSError, match="no connection"):
        drive(Controller(policy), arm, 0.2)
    np.testing.assert_array_equal(arm.sent[-1].arm, still.position)


def test_only_numpy_is_needed(policy, still, tmp_path: Path):
    """A copy of the file beside a policy, in a Python that can import numpy only."""
    save_policy(tmp_path / "policy.npz", policy)
    (tmp_path / "control.py").write_text(Path(control.__file__).read_text())
    np.savez(tmp_path / "reading.npz", position=still.position, fingers=still.fingers, knob=still.knob)
    script = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "mujoco", "droid_jax", "scipy", "brax", "flax"):
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
import numpy as np, control
r = np.load("reading.npz")
loop = control.Controller(control.load_policy("policy.npz"))
out = loop.act(control.Reading(0.0, r["position"], np.zeros(7), None, r["fingers"], r["knob"]))
print(",".join(repr(float(x)) for x in (*out.arm, *out.fingers)))
"""
    run = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    expected = Controller(policy).act(replace(still, torque=None))
    np.testing.assert_allclose(
        [float(x) for x in run.stdout.split(",")], [*expected.arm, *expected.fingers], atol=1e-12
    )
