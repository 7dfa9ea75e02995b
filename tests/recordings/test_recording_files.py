"""Recordings on disk: exact round trips, and one clear sentence for every damaged file."""

from __future__ import annotations

import json
import os
import re
import resource
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from droid_jax.commands import convert
from droid_jax.recordings import csv_folder
from droid_jax.recordings.clocks import resample
from droid_jax.recordings.formats import load_recording, save_recording
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


def make(dtype=np.float64) -> Recording:
    """Two repeats of two joints at 100 Hz with awkward numbers and one unmeasured torque."""
    rng = np.random.default_rng(3)
    time = np.arange(20) * 0.01
    values = rng.normal(size=(2, 20, 2)).astype(dtype)
    values[0, 0, 0] = -0.0
    values[0, 1, 0] = 1e-300 if dtype is np.float64 else 1e-30
    mask = np.ones(values.shape, dtype=bool)
    mask[1, 4, 1] = False
    values[1, 4, 1] = np.nan
    slow = np.array([0.0, 1 / 30, 2 / 30, 0.1])
    angle = rng.normal(size=(2, 4, 1))
    return Recording(
        name="pull",
        time=time,
        command=rng.normal(size=(20, 2)).astype(dtype),
        command_names=JOINTS,
        channels={
            "torque": Channel("torque", "N m", JOINTS, time, values, mask),
            "object_angle": Channel("object_angle", "rad", ("door, left",), slow, angle, np.ones(angle.shape, bool)),
        },
        torque=TorqueConvention(TorqueSide.LINK, gravity=True),
        qpos0={"j1": 0.1, "j2": 1 / 3},
        gains=ServoGains(np.array([600.0, 250.0]), np.array([50.0, 15.0])),
        known={"payload": 0.25, "rotor": "second rotor"},
        variant={"body_mass": {"payload": [0.25]}, "body_quat": {"base": [0.8, 0.0, 0.6, 0.0]}},
        phases=(Phase("opening", 0.05, 0.1),),
        object_pose=ObjectPose(np.array([0.5, 0, 0.3]), np.array([1.0, 0, 0, 0]), np.diag([1e-6] * 6)),
        meta={"robot": "panda", "note": "Tür"},
    )


def bare(recording: Recording) -> Recording:
    """The same log without commands."""
    return replace(recording, time=np.zeros(0), command=np.zeros((0, 0)), command_names=(), gains=None)


def fails(path: Path, *parts: str, **options) -> None:
    """load refuses the path in one sentence that holds all these parts."""
    with pytest.raises(ValueError) as caught:
        load_recording(path, **options)
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    for part in parts:
        assert part in text, f"{part!r} is not in {text!r}"


@pytest.mark.parametrize("where", ["pull.npz", "pull"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_round_trip(tmp_path: Path, where: str, dtype: type) -> None:
    before = make(dtype)
    after = load_recording(save_recording(before, tmp_path / where))
    assert after.sha256 == before.sha256
    assert (after.name, dict(after.meta), after.phases) == (before.name, before.meta, before.phases)
    assert (after.torque, after.command_names, dict(after.qpos0)) == (before.torque, JOINTS, before.qpos0)
    torque = after.channel("torque")
    np.testing.assert_array_equal(torque.mask, before.channel("torque").mask)
    np.testing.assert_array_equal(torque.values, before.channel("torque").values)
    assert np.signbit(torque.values[0, 0, 0])
    assert after.channel("object_angle").columns == ("door, left",)
    if where.endswith(".npz"):
        assert torque.values.dtype == dtype
        assert after.command.dtype == dtype


@pytest.mark.parametrize("where", ["log.npz", "log"])
def test_round_trip_without_commands(tmp_path: Path, where: str) -> None:
    before = bare(make())
    after = load_recording(save_recording(before, tmp_path / where))
    assert after.sha256 == before.sha256
    assert after.command.shape == (0, 0)


def test_formats_agree_and_name_can_be_given(tmp_path: Path) -> None:
    npz, folder = save_recording(make(), tmp_path / "a.npz"), save_recording(make(), tmp_path / "b")
    assert load_recording(npz).sha256 == load_recording(folder).sha256
    assert load_recording(npz, name="mine").name == load_recording(folder, name="mine").name == "mine"


@pytest.mark.parametrize("where", ["pull.npz", "pull"])
def test_saving_again_replaces_and_leaves_nothing_behind(tmp_path: Path, where: str) -> None:
    save_recording(make(), tmp_path / where)
    second = make().repeats_subset([1])
    assert load_recording(save_recording(second, tmp_path / where)).sha256 == second.sha256
    assert os.listdir(tmp_path) == [where]


def test_what_lies_beside_a_recording_is_never_lost(tmp_path: Path) -> None:
    folder = save_recording(make(), tmp_path / "wave")
    for name in ("raw.bag", "notes_1.csv"):
        (folder / name).write_bytes(b"the only one")
        with pytest.raises(ValueError, match=rf"wave: holds {re.escape(name)} beside a recording, which would be lost"):
            save_recording(make(), folder)
        assert (folder / name).read_bytes() == b"the only one"
        (folder / name).unlink()
    save_recording(make(), folder)


@pytest.mark.parametrize("where", ["door", "door.npz"])
def test_an_irregular_clock_is_accepted_once(tmp_path: Path, where: str) -> None:
    """A clock that was accepted once need not be accepted again: `identify` and `gap` have no such option."""
    recording = make()
    time = recording.time.copy()
    time[10:] += 0.02
    channels = {
        name: replace(c, time=time) if len(c.time) == len(time) else c for name, c in recording.channels.items()
    }
    rough = replace(recording, time=time, channels=channels)
    path = save_recording(rough, tmp_path / where)
    with pytest.raises(ValueError, match="irregular rate"):
        load_recording(path)
    accepted = load_recording(path, allow_jitter=True)
    assert load_recording(save_recording(accepted, tmp_path / f"again_{where}")).sha256 == rough.sha256
    assert (
        "allow_jitter" not in load_recording(save_recording(make(), tmp_path / where), allow_jitter=True).meta
    )  # there was nothing to accept


@pytest.mark.parametrize("where", ["pull.npz", "pull"])
def test_a_failed_save_keeps_the_old_file(tmp_path: Path, where: str, monkeypatch) -> None:
    save_recording(make(), tmp_path / where)

    def broken(*_args, **_kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", broken)
    monkeypatch.setattr(csv_folder, "_write_table", broken)
    with pytest.raises(OSError, match="disk full"):
        save_recording(make().repeats_subset([1]), tmp_path / where)
    monkeypatch.undo()
    assert load_recording(tmp_path / where).sha256 == make().sha256
    assert os.listdir(tmp_path) == [where]


def test_save_refuses(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected the suffix \.npz or none.*'\.csv'"):
        save_recording(make(), tmp_path / "a.csv")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "thesis.txt").write_text("dear")
    with pytest.raises(ValueError, match="is not a recording's folder"):
        save_recording(make(), tmp_path / "notes")
    assert (tmp_path / "notes" / "thesis.txt").exists()
    with pytest.raises(ValueError, match="at least one measured channel"):
        save_recording(replace(make(), channels={}), tmp_path / "b.npz")
    assert sorted(os.listdir(tmp_path)) == ["notes"]


def test_paths_that_are_no_recording(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no recording at .*gone\.npz"):
        load_recording(tmp_path / "gone.npz")
    (tmp_path / "log.mat").write_text("x")
    fails(tmp_path / "log.mat", "unknown suffix '.mat'", ".npz", "recording.json", ".bag", ".mcap", ".db3")
    (tmp_path / "empty").mkdir()
    fails(tmp_path / "empty", "no recording.json", ".npz")
    (tmp_path / "a.bag").write_text("x")
    fails(tmp_path / "a.bag", "pass joints and torque as well")
    save_recording(make(), tmp_path / "a.npz")
    fails(tmp_path / "a.npz", "there is no option jonts", jonts=["j1"])


def test_bags_without_the_package_say_what_to_install(tmp_path: Path, monkeypatch) -> None:
    for name in ("rosbag", "bag_topics"):
        monkeypatch.delitem(sys.modules, f"droid_jax.recordings.{name}", raising=False)
    for name in ("rosbags", "rosbags.highlevel"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "a.bag").write_text("x")
    with pytest.raises(ValueError, match=r"ROS bags need rosbags: in the checkout, pip install .* '\.\[ros\]'"):
        load_recording(tmp_path / "a.bag", joints=JOINTS, torque=make().torque)
    with pytest.raises(ValueError, match="ROS bags need rosbags"):  # several, which convert reads by itself
        convert.run(convert.Convert(source=(tmp_path / "a.bag", tmp_path / "a.bag"), joints=JOINTS, torque="link"))


# npz


def test_damaged_npz(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(b"")
    fails(path, "the file is empty")
    path.write_text("hello, this is text")
    fails(path, "not an npz file")
    path.unlink()  # no recording: `save` would not replace it
    whole = save_recording(make(), path).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    fails(path, "cut off")
    middle = len(whole) // 2
    path.write_bytes(whole[: middle - 100] + bytes(200) + whole[middle + 100 :])
    fails(path, "damaged npz file")


def parts_of(path: Path) -> dict[str, np.ndarray]:
    with np.load(save_recording(make(), path)) as file:
        return dict(file)


def test_pickled_npz_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    arrays = parts_of(path)
    np.savez(path, **{**arrays, "torque.values": np.array([{"a": 1}], dtype=object)})
    fails(path, "pickled Python objects")


def test_npz_keys(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    arrays = parts_of(path)

    def write(**changes) -> None:
        merged = {**arrays, **changes}
        np.savez(path, **{k: v for k, v in merged.items() if v is not None})

    write(**{"torque.time": None})
    fails(path, "missing array 'torque.time'", "command", "torque.values")
    write(format=np.array("something else"))
    fails(path, "'format'", "droid_jax recording 1", "something else")
    write(format=None)
    fails(path, "'format'", "droid_jax recording 1", "None")
    write(metadata=np.array("{nonsense"))
    fails(path, "metadata", "not valid JSON, line 1")
    write(**{"torque.mask": None})
    fails(path, "channel 'torque', repeat 1, row 4, column 'j2'", "nan")
    write(time=arrays["time"][::-1])
    fails(path, "command, row 1", "goes backwards")
    write(command=np.zeros((20, 3)))
    fails(path, "wrong joint count, expected 2 columns (j1, j2), got 3")


# CSV


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return save_recording(make(), tmp_path / "pull")


def edit(path: Path, line: int, text: str | None) -> None:
    """Replaces a line (from 1, as an editor counts), or removes it."""
    lines = path.read_text().splitlines()
    lines[line - 1 : line] = [] if text is None else [text]
    path.write_text("\n".join(lines) + "\n")


def test_csv_is_what_the_documentation_says(folder: Path) -> None:
    tables = ["command.csv", "object_angle_00.csv", "object_angle_01.csv", "torque_00.csv", "torque_01.csv"]
    assert sorted(os.listdir(folder)) == sorted(["recording.json", *tables])
    lines = (folder / "torque_01.csv").read_text().splitlines()
    assert lines[0] == "time,j1,j2"
    assert lines[5].startswith("0.04,") and lines[5].endswith(",")


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (7, "0.05,1.0,abc", ", line 7, column 'j2': 'abc' is not a number"),
        (7, "0.05,1.0,nan", ", line 7, column 'j2': 'nan' is not a finite number"),
        (7, "0.05,1.0", ", line 7: expected 3 cells, got 2"),
        (7, ",1.0,2.0", ", line 7, column 'time': expected a number, the cell is empty"),
        (7, "0.04,1.0,2.0", ", line 7: time must increase, it repeats 0.04 s"),
        (7, "0.01,1.0,2.0", ", line 7: time must increase, it goes backwards: 0.01 s"),
        (7, None, ", line 7: irregular rate"),
        (1, "time,j1", ", line 1: expected 2 joint columns, got 1; missing: j2"),
        (1, "time,j1,j3", ", line 1: expected 2 joint columns, got 2; missing: j2; unknown: j3"),
        (1, "time;j1;j2", ", line 1: the first column must be 'time' (comma separated), got 'time;j1"),
        (1, "time,j1,j1", ", line 1: expected one named column per joint"),
        (7, "0.0500021,1.0,2.0", ": repeat 1 has another clock than repeat 0, 0.0500021 s in data row 5"),
        (21, None, ": repeat 1 has another clock than repeat 0, 19 rows where torque_00.csv has 20"),
    ],
)
def test_bad_cells(folder: Path, line: int, text: str | None, said: str) -> None:
    edit(folder / "torque_01.csv", line, text)
    fails(folder, "torque_01.csv" + said)


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (3, "0.01,,0.5", ", line 3, column 'j1': expected a number, the cell is empty"),
        (3, "0.01,inf,0.5", ", line 3, column 'j1': 'inf' is not a finite number"),
        (1, "time,j1,elbow", ", line 1: expected 2 joint columns, got 2; missing: j2; unknown: elbow"),
    ],
)
def test_bad_commands(folder: Path, line: int, text: str, said: str) -> None:
    edit(folder / "command.csv", line, text)
    fails(folder, "command.csv" + said)


def test_blank_lines_count_as_an_editor_counts_them(folder: Path) -> None:
    path = folder / "torque_00.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], "", *lines[1:]]) + "\n\n")
    assert load_recording(folder).sha256 == make().sha256
    edit(path, 9, "0.06,x,1.0")
    fails(folder, "torque_00.csv, line 9, column 'j1': 'x'")


def test_columns_are_found_by_name_and_excel_files_are_read(folder: Path) -> None:
    path = folder / "torque_01.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_bytes("\ufeff".encode() + "\r\n".join(",".join([r[0], r[2], r[1]]) for r in rows).encode())
    assert load_recording(folder).sha256 == make().sha256


def test_files_missing_or_empty(folder: Path) -> None:
    (folder / "torque_01.csv").rename(folder / "torque_02.csv")
    fails(folder, "missing torque_01.csv, repeat 1 of channel 'torque'")
    (folder / "torque_02.csv").unlink()
    fails(folder, "same number of repeats", "torque 1", "object_angle 2")
    (folder / "torque_00.csv").write_text("time,j1,j2\n")
    fails(folder, "torque_00.csv: empty, there is no row below the header")
    (folder / "torque_00.csv").write_text("")
    fails(folder, "torque_00.csv: the file is empty")
    (folder / "torque_00.csv").write_bytes(b"time,j1,j2\n\xff\xfe")
    fails(folder, "torque_00.csv: not a text file in UTF-8")
    (folder / "command.csv").unlink()
    fails(folder, "missing command.csv", '"commands": false')


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("torque", {"side": "motor"}, "'torque': missing keys: gravity"),
        ("torque", {"side": "motor", "gravty": True, "gravity": True}, "unknown keys: gravty"),
        ("torque", {"side": "joint", "gravity": True}, "'torque', 'side' must be one of motor, link, got 'joint'"),
        ("torque", {"side": "link", "gravity": "no"}, "'torque', 'gravity' must be true or false, got 'no'"),
        ("gain", {}, "unknown keys: gain"),
        ("commands", "false", "'commands' must be true or false, got 'false'"),
        ("channels", [], "'channels' must be an object"),
        ("channels", {"torque": {}}, "'channels', 'torque': missing keys: unit"),
        ("channels", {}, "at least one measured channel"),
        ("command_names", "j1", "'command_names' must be a list, got 'j1'"),
        ("qpos0", {"j1": "0"}, "'qpos0', 'j1' must be a number, got '0'"),
        ("phases", [{"name": "hold", "start": 0.1}], "'phases', entry 0: missing keys: end"),
        (
            "gains",
            {"stiffness": [1, "a"], "damping": [1, 2]},
            "'gains', 'stiffness', entry 1 must be a number, got 'a'",
        ),
        ("gains", {"stiffness": [1], "damping": [1, 2]}, "gains: stiffness"),
        ("object_pose", {"position": [0, 0, 0]}, "missing keys: quaternion, covariance"),
        (
            "format",
            "droid_jax recording 9",
            "expected format 'droid_jax recording 1', got 'droid_jax recording 9'",
        ),
    ],
)
def test_bad_metadata(folder: Path, key: str, value: object, said: str) -> None:
    path = folder / "recording.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    fails(folder, said)


def test_a_minimal_folder_written_by_hand(tmp_path: Path) -> None:
    (tmp_path / "recording.json").write_text(
        '{"torque": {"side": "motor", "gravity": false}, "channels": {"torque": {"unit": "N m"}}}'
    )
    (tmp_path / "command.csv").write_text("time,j1\n0,0.5\n0.01,0.6\n0.02,0.7\n")
    (tmp_path / "torque_00.csv").write_text("time,j1\n0,1\n0.01,\n0.02,3\n")
    recording = load_recording(tmp_path)
    np.testing.assert_array_equal(recording.command, [[0.5], [0.6], [0.7]])
    np.testing.assert_array_equal(recording.channel("torque").mask, [[[True], [False], [True]]])
    assert recording.torque == TorqueConvention(TorqueSide.MOTOR, False)
    assert recording.name == tmp_path.name


def examples(language: str) -> list[str]:
    """The code blocks of docs/file-formats.md in one language."""
    text = (Path(__file__).parents[2] / "docs" / "file-formats.md").read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def test_the_documented_folder_loads(tmp_path: Path) -> None:
    whole = next(e for e in examples("json") if "object_pose" in e)
    (tmp_path / "recording.json").write_text(whole)
    times = [0.01 * i for i in range(501)]
    for name, columns in (("command", 2), ("torque_00", 2), ("object_angle_00", 1)):
        header = "time,joint1,joint2" if columns == 2 else "time,door_hinge"
        rows = [",".join([repr(t)] + [repr(t)] * columns) for t in times]
        (tmp_path / f"{name}.csv").write_text("\n".join([header, *rows]))
    recording = load_recording(tmp_path)
    assert recording.name == "door pull"
    assert [p.name for p in recording.phases] == ["approach", "opening"]
    assert recording.object_pose is not None and recording.object_pose.covariance[3, 3] == 1e-5
    assert load_recording(save_recording(recording, tmp_path / "a.npz")).sha256 == recording.sha256


def test_the_documented_npz_loads(tmp_path: Path, monkeypatch) -> None:
    code = next(e for e in examples("python") if "savez" in e)
    monkeypatch.chdir(tmp_path)
    time = np.arange(10) * 0.01
    torques = np.random.default_rng(0).normal(size=(3, 10, 2))
    exec(code, {"time": time, "command": np.ones((10, 2)), "torques": torques})
    recording = load_recording(tmp_path / "door.npz")
    np.testing.assert_array_equal(recording.channel("torque").values, torques)
    assert recording.torque == TorqueConvention(TorqueSide.LINK, gravity=True)


def test_resample_is_linear_over_the_common_part() -> None:
    times = [np.arange(0, 1.01, 0.1), np.arange(0.25, 1.3, 0.07)]
    values = [np.stack([2 * t, 5 - t], axis=-1) for t in times]
    values[1][5] = np.nan  # at 0.6 s
    clock, out = resample(times, values)
    np.testing.assert_allclose(clock, np.arange(3, 11) * 0.1)
    for repeat in out:
        seen = np.isfinite(repeat)
        np.testing.assert_allclose(repeat[seen], np.stack([2 * clock, 5 - clock], axis=-1)[seen])
    # The gap reaches from 0.53 to 0.67 s.
    np.testing.assert_array_equal(np.isnan(out[1]).all(axis=1), np.isclose(clock, 0.6))
    with pytest.raises(ValueError, match="no common part"):
        resample([times[0], times[0] + 5], values)


def test_resampling_invents_nothing_in_a_gap() -> None:
    """A gap of a second is not filled by interpolation."""
    whole = np.arange(0, 3.0, 0.01)
    holed = whole[(whole < 1.0) | (whole > 1.995)] + 0.003
    clock, out = resample([whole, holed], [np.sin(5 * t)[:, None] for t in (whole, holed)])
    silent = (clock > 0.993 + 1e-6) & (clock < 2.003 - 1e-6)
    np.testing.assert_array_equal(np.isnan(out[1, :, 0]), silent)
    np.testing.assert_allclose(out[1, ~silent, 0], np.sin(5 * clock[~silent]), atol=5e-4)
    assert np.isfinite(out[0]).all()


def test_a_number_is_one_repeat(folder: Path) -> None:
    (folder / "torque_1.csv").write_text((folder / "torque_01.csv").read_text())
    fails(folder, "torque_01.csv and torque_1.csv are both repeat 1 of channel 'torque'")


def test_load_resamples_only_when_asked(folder: Path) -> None:
    recording = make()
    t = recording.time
    for r, clock in enumerate((t, t + 0.004)):
        rows = "\n".join(f"{a},{3 * a},{1 - a}" for a in clock)
        (folder / f"torque_{r:02d}.csv").write_text("time,j1,j2\n" + rows + "\n")
    fails(folder, "torque_01.csv", "repeat 1", "0.004 s", "resample=True")
    torque = load_recording(folder, resample=True).channel("torque")
    np.testing.assert_allclose(torque.time, t[1:])
    np.testing.assert_allclose(torque.values[1], np.stack([3 * t[1:], 1 - t[1:]], axis=-1))


def test_jitter_must_be_allowed(folder: Path) -> None:
    edit(folder / "command.csv", 7, None)
    fails(folder, "command.csv, line 7: irregular rate", "allow_jitter=True")
    assert len(load_recording(folder, allow_jitter=True).time) == 19


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "a\0b"}, "the text holds the character U+0000 at position 1"),
        ({"name": "a/b"}, "its name names files: it must hold no / or"),
        ({"name": ".."}, "not begin with a dot"),
        ({"name": "n" * 201}, "its name must have at most 200 bytes, got 201"),
        ({"name": "ö" * 101}, "its name must have at most 200 bytes, got 202"),
        ({"phases": [{"name": "open\ud800", "start": 0.0, "end": 0.1}]}, "U+D800 at position 4"),
        ({"phases": [{"name": "\x1b[2J", "start": 0.0, "end": 0.1}]}, "U+001B at position 0"),
        ({"phases": [{"name": "p" * 201, "start": 0.0, "end": 0.1}]}, "at most 200 characters, got 201"),
        ({"meta": {"robot": "a\0"}}, "'meta', 'robot': the text holds the character U+0000"),
        ({"meta": {"r\nb": "a"}}, "the key holds the character U+000A"),
        ({"meta": {"robot": "a" * 10_001}}, "meta 'robot' must have at most 10000 characters"),
        ({"qpos0": {"j\u2028": 0.0}}, "the key holds the character U+2028"),
        ({"qpos0": {"j1": float("nan")}}, "NaN is no number of JSON"),
        ({"qpos0": {"j1": 10**400}}, "'qpos0', 'j1': a whole number beyond 2^63"),
    ],
)
def test_texts_that_no_file_name_or_page_can_hold(folder: Path, change: dict[str, object], said: str) -> None:
    path = folder / "recording.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    fails(folder, said)
    written = json.dumps({**json.loads(path.read_text()), **change})
    np.savez(folder.parent / "a.npz", **{**parts_of(folder.parent / "b.npz"), "metadata": np.array(written)})
    fails(folder.parent / "a.npz", said)


def test_a_repeat_far_beyond_the_others_is_not_counted_up_to(folder: Path) -> None:
    (folder / "torque_99999999.csv").write_text((folder / "torque_01.csv").read_text())
    fails(folder, "missing torque_02.csv, repeat 2 of channel 'torque'; torque_99999999.csv is there")


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (3, "0.01,1e999,0.5", "line 3, column 'j1': '1e999' is not a finite number"),
        (3, "0.01,1_0,0.5", "line 3, column 'j1': '1_0' is not a number"),
        (3, "0.01,1\0,0.5", "line 3: holds a zero byte"),
        (3, "0.01," + "1" * 70_000, "line 3: is longer than 65536 characters"),
        (1, "time," + ",".join(map(str, range(2000))), "line 1: has 2000 columns beside 'time', at most 1000"),
        (1, "time,j1,j\x1b2", "line 1: the column name holds the character U+001B"),
        (3, '0.01,"1,0.5', "line 20: "),
    ],
)
def test_tables_that_are_no_tables(folder: Path, line: int, text: str, said: str) -> None:
    path = folder / "torque_01.csv"
    lines = path.read_text().splitlines()
    lines[line - 1] = text
    path.write_text("\n".join(lines))
    fails(folder, said if "line 20" not in said else "torque_01.csv")


def test_a_pipe_and_a_huge_table_are_not_waited_for(folder: Path) -> None:
    (folder / "torque_01.csv").unlink()
    os.mkfifo(folder / "torque_01.csv")
    fails(folder, "torque_01.csv: is no regular file")
    (folder / "torque_01.csv").unlink()
    with (folder / "torque_01.csv").open("wb") as file:
        file.truncate(257 * 2**20)
    fails(folder, "torque_01.csv: has 257 MiB, at most 256 are read")


def test_resampling_is_refused_where_nothing_is_resampled(tmp_path: Path) -> None:
    fails(save_recording(make(), tmp_path / "a.npz"), "resample is for CSV folders", resample=True)


def test_only_the_members_of_a_recording_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, **parts_of(tmp_path / "b.npz"), more=np.zeros(30 * 2**20))
    before = peak()
    assert load_recording(path).sha256 == make().sha256
    assert peak() - before < 60 * 2**20


def peak() -> int:
    """Bytes of this process at its largest."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
