"""The recording type: refusals of validation and their messages, the hash, subsets, windows."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from droid_jax.recordings.checks import check_joints, validate
from droid_jax.recordings.recording import (
    Channel,
    ObjectPose,
    Phase,
    Recording,
    ServoGains,
    TorqueConvention,
    TorqueSide,
)

JOINTS = ("j1", "j2")


def make(n: int = 3, t: int = 101) -> Recording:
    """Two joints at 100 Hz, and a door angle at 25 Hz of which one sample was not seen."""
    rng = np.random.default_rng(0)
    time, slow = np.arange(t) * 0.01, np.arange(0, t, 4) * 0.01
    ramp = np.stack([time, 2 * time], axis=-1)

    def channel(name: str, unit: str, values: np.ndarray) -> Channel:
        return Channel(name, unit, JOINTS, time, values, np.ones(values.shape, dtype=bool))

    door = Channel(
        "object_angle",
        "rad",
        ("hinge",),
        slow,
        np.tile(0.5 * slow[:, None], (n, 1, 1)),
        np.ones((n, len(slow), 1), bool),
    )
    door.mask[1, 3, 0] = False
    door.values[1, 3, 0] = np.nan
    return Recording(
        name="pull",
        time=time,
        command=ramp.copy(),
        command_names=JOINTS,
        channels={
            "torque": channel("torque", "N m", rng.normal(size=(n, t, 2))),
            "position": channel("position", "rad", ramp + np.arange(n)[:, None, None]),
            "object_angle": door,
        },
        torque=TorqueConvention(TorqueSide.MOTOR, gravity=True),
        qpos0={"j1": 0.0, "j2": 0.1, "hinge": 0.0},
        gains=ServoGains(np.array([600.0, 250.0]), np.array([50.0, 15.0])),
        phases=(Phase("approach", 0.0, 0.4), Phase("opening", 0.4, 1.0)),
        object_pose=ObjectPose(np.array([0.5, 0, 0.3]), np.array([1.0, 0, 0, 0]), np.eye(6) * 1e-6),
        meta={"robot": "panda"},
    )


def with_channel(recording: Recording, name: str, /, **changes) -> Recording:
    return replace(recording, channels={**recording.channels, name: replace(recording.channels[name], **changes)})


def changed(array: np.ndarray, index, value) -> np.ndarray:
    out = array.copy()
    out[index] = value
    return out


def refuses(recording: Recording, *parts: str) -> None:
    """Validation refuses it, with the file and all these parts in one sentence."""
    with pytest.raises(ValueError) as caught:
        validate(recording, source="log.npz")
    text = str(caught.value)
    assert text.startswith("log.npz")
    assert "\n" not in text
    for part in parts:
        assert part in text, f"{part!r} is not in {text!r}"


def test_a_good_recording_passes_and_comes_back_itself() -> None:
    recording = make()
    assert validate(recording) is recording
    assert recording.repeats == 3
    assert recording.duration == pytest.approx(1.0)


def test_a_log_without_commands_passes() -> None:
    recording = replace(make(), time=np.zeros(0), command=np.zeros((0, 0)), command_names=(), gains=None)
    assert validate(recording).duration == pytest.approx(1.0)


def test_what_is_no_torque_convention_and_no_mapping_is_said() -> None:
    refuses(replace(make(), torque="motor"), "torque must be a TorqueConvention", "'motor'")  # pyright: ignore[reportArgumentType]
    refuses(replace(make(), qpos0=[0.0, 1.0]), "qpos0 must map joint names")  # pyright: ignore[reportArgumentType]


def test_empty() -> None:
    refuses(replace(make(), channels={}), "empty", "at least one measured channel")
    r = make()
    refuses(replace(r, time=r.time[:1], command=r.command[:1]), "command", "empty", "1 rows")
    refuses(replace(r, time=r.time[:0], command=r.command[:0]), "command", "empty", "0 rows and 2 joints")
    c = r.channels["torque"]
    refuses(with_channel(r, "torque", values=c.values[:0], mask=c.mask[:0]), "'torque'", "empty", "[0, 101, 2]")
    refuses(with_channel(r, "torque", mask=changed(c.mask, 2, False)), "'torque', repeat 2", "masked out")


def test_shapes() -> None:
    r = make()
    c = r.channels["torque"]
    refuses(replace(r, command=r.command[:-1]), "command", "expected 101 rows", "got 100")
    refuses(replace(r, command=r.command[:, :1]), "wrong joint count", "expected 2 columns (j1, j2), got 1")
    refuses(replace(r, command=r.command.tolist()), "command", "numpy array of float, got list")
    refuses(with_channel(r, "torque", values=c.values[:, :50], mask=c.mask[:, :50]), "[3, 101, 2]", "[3, 50, 2]")
    refuses(with_channel(r, "torque", values=c.values[0]), "'torque'", "[any, any, any]", "[101, 2]")
    refuses(with_channel(r, "torque", columns=("j1",)), "'torque'", "expected 1 columns (j1), got 2")
    refuses(with_channel(r, "torque", mask=c.mask[:, :, :1]), "mask", "[3, 101, 2]", "[3, 101, 1]")
    refuses(with_channel(r, "torque", mask=c.mask.astype(float)), "mask", "bool", "float64")
    refuses(
        with_channel(r, "torque", values=c.values[:2], mask=c.mask[:2]),
        "same number of repeats",
        "torque 2",
        "position 3",
    )


def test_names() -> None:
    r = make()
    refuses(replace(r, command_names=("j1", "j1")), "command", "unique", "j1")
    refuses(with_channel(r, "torque", columns=("j2", "j2")), "'torque'", "unique", "j2")
    for wrong in ("mN m", "Nmm", "kg", "°"):
        refuses(with_channel(r, "torque", unit=wrong), "'torque'", "'N m' or 'N'", repr(wrong))
    refuses(with_channel(r, "torque", unit="deg"), "'torque'", "'N m' or 'N'", "'deg'")
    refuses(with_channel(r, "torque", name="effort"), "'torque'", "'effort'")
    refuses(replace(r, channels={"a/b": replace(r.channels["torque"], name="a/b")}), "'a/b'", "identifier")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite(value: float) -> None:
    r = make()
    refuses(replace(r, command=changed(r.command, (7, 1), value)), "command, row 7, column 'j2'", str(value))
    c = r.channels["torque"]
    bad = with_channel(r, "torque", values=changed(c.values, (2, 12, 0), value))
    refuses(bad, "channel 'torque', repeat 2, row 12, column 'j1'", str(value))
    masked = with_channel(bad, "torque", mask=changed(c.mask, (2, 12, 0), False))
    assert validate(masked) is masked
    refuses(replace(r, qpos0={"j1": value}), "qpos0", "'j1'")
    refuses(replace(r, time=changed(r.time, 4, value)), "command, row 4", "time must be finite")


def test_time_must_increase() -> None:
    r = make()
    refuses(replace(r, time=changed(r.time, 5, r.time[4])), "command, row 5", "repeats 0.04 s")
    slow = r.channels["object_angle"].time
    refuses(with_channel(r, "object_angle", time=changed(slow, 6, 0.0)), "'object_angle', row 6", "goes backwards")


def test_irregular_rate_unless_allowed() -> None:
    r = make()
    keep = np.arange(101) != 40  # one lost sample: a step of twice the usual
    gappy = replace(r, time=r.time[keep], command=r.command[keep])
    refuses(gappy, "command, row 40", "irregular rate", "0.02 s", "0.01 s", "allow_jitter=True")
    assert validate(gappy, allow_jitter=True) is gappy
    jittered = replace(r, time=r.time + np.random.default_rng(1).uniform(-0.002, 0.002, 101))
    assert validate(jittered) is jittered  # steps within 40 % of the usual


@pytest.mark.parametrize(
    ("factor", "said"),
    [(1e3, "step is 10 s"), (1e2, "step is 1 s"), (1e6, "more than a day"), (1e-4, "below 1e-5 s")],
)
def test_time_in_another_unit(factor: float, said: str) -> None:
    r = make()
    refuses(replace(r, time=r.time * factor), "command", said, "must be in seconds")


def test_wall_clock_time() -> None:
    r = make()
    refuses(replace(r, time=r.time + 1.7e9), "command", "starts at 1.7e+09 s", "subtract")


def test_channel_beside_the_command() -> None:
    r = make()
    late = with_channel(r, "torque", time=r.time + 50)
    refuses(late, "channel 'torque'", "50 .. 51 s", "0 .. 1 s")


def test_phases() -> None:
    r = make()
    refuses(replace(r, phases=(Phase("hold", 0.5, 3.0),)), "phase 'hold'", "0.5 .. 3 s", "0 .. 1 s")
    refuses(replace(r, phases=(Phase("hold", -1.0, 0.5),)), "phase 'hold'", "outside")
    refuses(replace(r, phases=(Phase("hold", 0.5, 0.5),)), "phase 'hold'", "start before it ends")
    refuses(replace(r, phases=(Phase("a", 0, 0.5), Phase("a", 0.5, 1))), "phase names", "unique")


def test_gains() -> None:
    r, two = make(), np.array([1.0, 2.0])
    refuses(replace(r, gains=ServoGains(np.ones(3), two)), "gains", "stiffness", "[2]", "[3]")
    refuses(replace(r, gains=ServoGains(two, np.array([1.0, -2.0]))), "damping of joint 'j2'", "-2.0")
    refuses(replace(r, gains=ServoGains(np.array([np.nan, 1]), two)), "stiffness of joint 'j1'", "nan")


def test_object_pose() -> None:
    r = make()
    pose = r.object_pose
    assert pose is not None
    refuses(
        replace(r, object_pose=replace(pose, covariance=changed(pose.covariance, (0, 1), 1e-6))),
        "symmetric",
        "[0, 1]",
    )
    refuses(replace(r, object_pose=replace(pose, covariance=-pose.covariance)), "positive semi-definite", "-1e-06")
    refuses(replace(r, object_pose=replace(pose, covariance=np.eye(3))), "[6, 6]", "[3, 3]")
    refuses(replace(r, object_pose=replace(pose, quaternion=np.array([1.0, 1, 0, 0]))), "length 1", "1.41421")
    refuses(replace(r, object_pose=replace(pose, position=np.array([np.nan, 0, 0]))), "position", "finite")
    singular = replace(r, object_pose=replace(pose, covariance=np.zeros((6, 6))))
    assert validate(singular) is singular  # an exactly known pose


def test_without_a_source_the_message_names_the_recording() -> None:
    with pytest.raises(ValueError, match=r"^recording 'pull': empty"):
        validate(replace(make(), channels={}))


def test_check_joints() -> None:
    r = make()
    check_joints(r, ["j2", "j1"])
    with pytest.raises(ValueError, match=r"command: expected 3 joints, got 2; missing: j3; valid names"):
        check_joints(r, ["j1", "j2", "j3"])
    with pytest.raises(ValueError, match=r"expected 2 joints, got 2; missing: a; unknown: j1; valid names: a, j2"):
        check_joints(r, ["a", "j2"])
    with pytest.raises(ValueError, match=r"channel 'torque': unknown joints elbow; valid names: j1, j2"):
        check_joints(with_channel(r, "torque", columns=("j1", "elbow")), JOINTS)
    bare = replace(r, time=np.zeros(0), command=np.zeros((0, 0)), command_names=(), gains=None)
    check_joints(bare, JOINTS)
    with pytest.raises(ValueError, match=r"its channels: expected 3 joints, got 2; missing: j3"):
        check_joints(bare, ["j1", "j2", "j3"])


def test_unknown_channel_lists_the_valid_ones() -> None:
    with pytest.raises(ValueError, match=r"unknown channel 'effort'.*object_angle, position, torque"):
        make().channel("effort")


def test_hash_is_the_same_in_another_process() -> None:
    code = "import test_recording as t; print(t.make().sha256)"
    folder = str(Path(__file__).parent)
    out = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
        env={**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert out.stdout.strip() == make().sha256


def test_hash_ignores_what_is_not_content() -> None:
    r = make()
    c = r.channels["object_angle"]
    assert replace(r, name="other", meta={}).sha256 == r.sha256
    assert replace(r, channels=dict(reversed(r.channels.items()))).sha256 == r.sha256
    assert replace(r, qpos0=dict(reversed(r.qpos0.items()))).sha256 == r.sha256
    assert with_channel(r, "object_angle", values=changed(c.values, (1, 3, 0), 99.0)).sha256 == r.sha256
    single = replace(r, command=r.command.astype(np.float32))
    assert replace(single, command=single.command.astype(np.float64)).sha256 == single.sha256


def test_hash_sees_every_part_of_the_content() -> None:
    r = make()
    t, gains, pose = r.channels["torque"], r.gains, r.object_pose
    assert gains is not None and pose is not None
    variants = [
        r,
        replace(r, time=r.time + 1e-9),
        replace(r, command=changed(r.command, (0, 0), 1e-12)),
        replace(r, command_names=("j2", "j1")),
        replace(r, torque=TorqueConvention(TorqueSide.LINK, True)),
        replace(r, torque=TorqueConvention(TorqueSide.MOTOR, False)),
        replace(r, qpos0={**r.qpos0, "j1": 1e-9}),
        replace(r, gains=None),
        replace(r, known={"payload": 0.2}),
        replace(r, known={"payload": 0.3}),
        replace(r, known={"payload": "tool"}),
        replace(r, variant={"body_mass": {"payload": [0.2]}}),
        replace(r, variant={"body_mass": {"payload": [0.3]}}),
        replace(r, gains=replace(gains, damping=gains.damping * 2)),
        replace(r, gains=replace(gains, damping=None)),
        replace(r, phases=r.phases[:1]),
        replace(r, object_pose=None),
        replace(r, object_pose=replace(pose, covariance=pose.covariance * 2)),
        with_channel(r, "torque", unit="N"),
        with_channel(r, "torque", columns=("j2", "j1")),
        with_channel(r, "torque", time=t.time + 1e-9),
        with_channel(r, "torque", values=changed(t.values, (2, 100, 1), 0.5)),
        with_channel(r, "torque", mask=changed(t.mask, (0, 0, 0), False)),
        replace(r, channels={k: r.channels[k] for k in ("torque", "position")}),
    ]
    hashes = [v.sha256 for v in variants]
    assert len(set(hashes)) == len(variants)


def test_repeats_subset() -> None:
    r = make()
    held = r.repeats_subset([2, 0])
    assert held.repeats == 2
    for key, c in r.channels.items():
        np.testing.assert_array_equal(held.channels[key].values, c.values[[2, 0]])
        np.testing.assert_array_equal(held.channels[key].mask, c.mask[[2, 0]])
    assert r.repeats == 3
    for bad in ([3], [-1], []):
        with pytest.raises(ValueError, match=r"repeats must be out of 0 \.\. 2"):
            r.repeats_subset(bad)


def test_window_cuts_clocks_and_phases_and_finds_the_positions() -> None:
    r = make()
    part = validate(r.window(0.3, 0.6))
    np.testing.assert_allclose(part.time, np.arange(30, 61) * 0.01)
    np.testing.assert_allclose(part.channels["object_angle"].time, np.arange(0.32, 0.605, 0.04))
    np.testing.assert_array_equal(part.channels["torque"].values, r.channels["torque"].values[:, 30:61])
    assert part.phases == (Phase("approach", 0.3, 0.4), Phase("opening", 0.4, 0.6))
    # Positions are ramps 1 and 2 rad/s plus 0, 1, 2 rad over the repeats; the door opens at 0.5.
    assert part.qpos0 == pytest.approx({"j1": 1.3, "j2": 1.6, "hinge": 0.15})
    assert r.window(0.3, 0.6, qpos0={"j1": -1.0}).qpos0["j1"] == -1.0
    assert r.window(0.0, 0.6).qpos0 == r.qpos0


def test_window_between_two_samples_ends_where_its_samples_do() -> None:
    """Regression: phases ended at the asked time, which validation refuses, and the pose was that of the asked time."""
    part = validate(make().window(0.3033, 0.6077))
    assert part.phases == (Phase("approach", pytest.approx(0.31), 0.4), Phase("opening", 0.4, pytest.approx(0.6)))
    assert part.qpos0["j1"] == pytest.approx(1.31)  # of the first command that is kept
    assert validate(make().window(0.3992, 0.6)).phases == (Phase("opening", 0.4, pytest.approx(0.6)),)


def test_window_says_what_it_lacks() -> None:
    r = make()
    with pytest.raises(ValueError, match=r"too little of the command, which runs 0 \.\. 1 s"):
        r.window(2.0, 3.0)
    with pytest.raises(ValueError, match=r"too little of channel 'object_angle'"):
        r.window(0.01, 0.03)
    with pytest.raises(ValueError, match=r"start < end, got 0.6 and 0.3"):
        r.window(0.6, 0.3)
    for wrong, said in (
        (["j1"], "qpos0 must be a Mapping, got a list"),
        ({"j1": "x"}, "qpos0, joint 'j1' must be a number"),
    ):
        with pytest.raises(ValueError, match=said):
            r.window(0.3, 0.6, qpos0=wrong)
    blind = replace(r, channels={"torque": r.channels["torque"]})
    with pytest.raises(ValueError, match=r"not measured: j1, j2, hinge; begin it at the recording's start"):
        blind.window(0.3, 0.6)
    assert blind.window(0.3, 0.6, qpos0={"j1": 1.0, "j2": 2.0, "hinge": 0.0}).qpos0["j2"] == 2.0
    log = replace(r, time=np.zeros(0), command=np.zeros((0, 0)), command_names=(), qpos0={**r.qpos0, "finger": 0.04})
    assert log.window(0.3, 0.6).qpos0["finger"] == 0.04  # what a log does not measure stands still
    unseen = np.zeros_like(log.channels["object_angle"].mask)
    gone = {**log.channels, "object_angle": replace(log.channels["object_angle"], mask=unseen)}
    assert set(replace(log, channels=gone).window(0.3, 0.6).qpos0) == {"j1", "j2", "finger"}  # and nothing else does


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "a\0b"}, "its name holds the character U+0000"),
        ({"name": "a/b"}, "its name names files"),
        ({"name": ""}, "its name must not be empty"),
        ({"name": 3}, "its name must be text"),
        ({"phases": (Phase("\ud800", 0.0, 0.1),)}, "a phase's name holds the character U+D800"),
        ({"phases": (Phase("p" * 201, 0.0, 0.1),)}, "a phase's name must have at most 200 characters"),
        ({"phases": (Phase("p", "0", 0.1),)}, "start of phase 'p' must be a number, got '0'"),
        ({"phases": "opening"}, "phases must be a list of Phase objects, got 'opening'"),
        ({"phases": (("p", 0.0, 0.1),)}, "phases, entry 0 must be a Phase, got a tuple"),
        ({"command_names": ("j1", "j\x1b2")}, "holds the character U+001B"),
        ({"command_names": "j1"}, "must be non-empty names, got 'j1'"),
        ({"qpos0": {"j1": "0"}}, "qpos0 of joint 'j1' must be a number, got '0'"),
        ({"qpos0": {"j1": float("nan")}}, "qpos0 of joint 'j1' must be finite"),
        ({"meta": {"note": "\ud800"}}, "meta 'note' holds the character U+D800"),
        ({"meta": {"note": 3}}, "meta 'note' must be text, got 3"),
        ({"meta": []}, "meta must map texts to texts"),
        ({"known": {"payload": [2]}}, "known value of 'payload' must be a number, got [2]"),
        ({"known": {"payload": ""}}, "the parameter named for 'payload'"),
        ({"known": ["payload"]}, "known must map parameter names to values or names"),
        ({"variant": {"body_mass": {"payload": [np.nan]}}}, "variant, body_mass of 'payload' must be finite"),
        ({"gains": (1.0, 2.0)}, "gains must be a ServoGains, got a tuple"),
        ({"channels": [1]}, "channels must map names to channels"),
        ({"channels": {"torque": np.zeros(3)}}, "channel 'torque' must be a Channel, got a ndarray"),
        ({"time": [0.0, 0.1]}, "must be a numpy array"),
    ],
)
def test_texts_and_types_are_checked(change: dict, said: str) -> None:
    refuses(replace(make(), **change), said)
    with pytest.raises(ValueError, match="a recording must be a Recording, got 'log"):
        validate("log.npz")  # pyright: ignore[reportArgumentType]
