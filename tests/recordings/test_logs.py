"""Logs of any column names, each written by its own ecosystem's library, against the motion they were made from."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import re
import sys
import warnings
import zipfile
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest

from droid_jax.recordings import column_map
from droid_jax.recordings.alignment import warn_of_rate
from droid_jax.recordings.column_map import (
    ChannelMap,
    ColumnMap,
    TimeMap,
    Units,
    changed_map,
    layouts,
    read_map,
    write_map,
)
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.log_files import read_log
from droid_jax.recordings.recording import Recording, TorqueSide
from droid_jax.recordings.table_file import open_csv
from droid_jax.recordings.units import HINGES, SLIDES
from droid_jax.run import main

TIME = np.arange(0.0, 2.0, 0.01)  # s
JOINTS = ("shoulder", "elbow")
COMMAND = np.column_stack([0.3 * np.sin(2 * TIME), 0.5 * np.cos(3 * TIME)])  # rad
POSITION = COMMAND - 0.01
VELOCITY = np.gradient(POSITION, 0.01, axis=0)
TORQUE = np.column_stack([np.cos(TIME), -np.sin(TIME)])  # N m
DATA = Path(__file__).parent / "data"
RAD = Units(angle="rad", torque="N m", time="s")


def check(recording: Recording, tolerance: float = 1e-9, **channels: np.ndarray) -> None:
    """Check that the recording holds this motion, on its clock from 0 on."""
    assert recording.time == pytest.approx(TIME, abs=1e-6)
    assert recording.command == pytest.approx(COMMAND, abs=tolerance)
    assert set(recording.channels) == set(channels)
    for name, values in channels.items():
        assert recording.channels[name].values[0] == pytest.approx(values, abs=tolerance)
        assert recording.channels[name].columns == recording.command_names


def refused(path: Path, columns: ColumnMap | Path | None = None, **options: object) -> str:
    """The message for a log that is refused."""
    with pytest.raises(ValueError) as caught:
        load_recording(path, columns=columns, **options)
    text = str(caught.value)
    assert "\n" not in text and len(text) < 700
    return text


def table(path: Path, separator: str = ",", **columns: np.ndarray) -> Path:
    """A CSV file, written by numpy."""
    head, rows = separator.join(columns), np.column_stack(list(columns.values()))
    with (gzip.open if path.suffix == ".gz" else open)(path, "wt") as file:
        np.savetxt(file, rows, "%.17g", separator, header=head, comments="")
    return path


def whole(**changes: object) -> ColumnMap:
    """The map of `log`."""
    usual = dict(
        joints=list(JOINTS), time="t", command="cmd{n}", position="q{n}", velocity="dq{n}", torque="tau{n}",
        side="motor", gravity=True, units=RAD,
    )  # fmt: skip
    return ColumnMap(**{**usual, **changes})  # type: ignore[arg-type]


def log(path: Path, separator: str = ",", **changes: np.ndarray) -> Path:
    columns: dict[str, np.ndarray] = {"t": TIME + 1.7e9, "state": np.ones(len(TIME))}
    # Tens before ones, as a sort by text would have them: numbers count.
    for name, values in {"cmd": COMMAND, "q": POSITION, "dq": VELOCITY, "tau": TORQUE}.items():
        columns |= {f"{name}10": values[:, 1], f"{name}9": values[:, 0]}
    return table(path, separator, **{**columns, **changes})


# Tables


def test_what_was_recorded_with_the_motors_off_is_left_out(tmp_path: Path):
    on = np.ones(len(TIME))
    on[:20] = on[150:] = 0.0  # 0 to 0.2 s and from 1.5 s on
    path = log(tmp_path / "a.csv", enabled=on)
    with pytest.warns(UserWarning, match=r"off in 35% of the rows \('enabled'\); read is 0.2 to 1.49 s"):
        recording = load_recording(path, columns=whole(powered="enabled"))
    assert recording.time == pytest.approx(TIME[20:150] - 0.2, abs=1e-6)
    assert recording.command == pytest.approx(COMMAND[20:150])
    assert recording.channels["position"].values[0] == pytest.approx(POSITION[20:150])
    assert len(load_recording(path, columns=whole(powered="state")).time) == len(TIME)
    assert "'enabled' is 0 throughout: the motors are never on" in refused(
        log(tmp_path / "b.csv", enabled=0.0 * on), whole(powered="enabled")
    )
    assert "no column 'enable'" in refused(path, whole(powered="enable"))


pytest.importorskip("polars", reason="tables are read with polars; it comes with the extra 'formats'")


def test_logs_that_lack_rows_or_say_something_twice(tmp_path: Path):
    """Regressions: polars renames the second column of a name, and logs without rows ended in an IndexError."""
    path = tmp_path / "twice.csv"
    lines = log(path).read_text().splitlines()
    path.write_text("\n".join([lines[0].replace("cmd9", "q9"), *lines[1:]]))
    assert "'q9' stands over 2 columns" in refused(path, whole())
    np.savez(tmp_path / "empty.npz", t=np.zeros(0), q=np.zeros((0, 2)))
    assert "position: has no rows" in refused(
        tmp_path / "empty.npz", ColumnMap(JOINTS, time="t", position="q", units=RAD)
    )


def test_time_columns_of_each_channel_alone(tmp_path: Path):
    """Regression: the rate and the unit of time were ignored where no column of time is stated for all channels."""
    path = tmp_path / "log.npz"
    np.savez(path, t_cmd=1000 * TIME, t_q=1000 * (TIME + 0.0003 * np.sin(40 * TIME)), cmd=COMMAND, q=POSITION)
    columns = ColumnMap(
        list(JOINTS), command=ChannelMap("cmd", time="t_cmd"), position=ChannelMap("q", time="t_q"), rate=100.0,
        units=Units(angle="rad", time="ms"),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = load_recording(path, columns=columns)
    assert found.time == pytest.approx(TIME[: len(found.time)], abs=1e-6) and "rows" not in found.meta
    np.testing.assert_array_equal(found.channels["position"].time, found.time)
    with pytest.raises(ValueError, match="'msec' is no unit of time"):
        changed_map(columns, {}, {"time": "msec"})


def test_a_sliding_object_and_a_zero_beside_a_range(tmp_path: Path):
    path = log(tmp_path / "a.csv", drawer=1000 * POSITION[:, 0])
    drawer = ChannelMap("drawer", joints=["drawer"], unit="mm")
    columns = changed_map(whole(object_angle=drawer, slides=["drawer"]), {}, {})
    assert load_recording(path, columns=columns).channels["object_angle"].values[0, :, 0] == pytest.approx(
        POSITION[:, 0]
    )
    shifted = ChannelMap("q{n}", unit="normalised", range=[-1.9, 1.9], zero=0.5)
    assert "zero is for other units" in refused(path, whole(position=shifted))


def test_an_npz_with_metadata_of_its_own_is_a_log(tmp_path: Path):
    np.savez(tmp_path / "log.npz", t=TIME, q=POSITION, metadata="{}")
    columns = ColumnMap(list(JOINTS), time="t", position="q", units=RAD)
    assert load_recording(tmp_path / "log.npz", columns=columns).channels["position"].values[0] == pytest.approx(
        POSITION
    )


@pytest.mark.parametrize(("name", "separator"), [("a.csv", ","), ("a.csv.gz", ";"), ("a.tsv", "\t")])
def test_csv(tmp_path: Path, name: str, separator: str):
    found = load_recording(log(tmp_path / name, separator), columns=whole())
    check(found, position=POSITION, velocity=VELOCITY, torque=TORQUE)
    assert found.torque.side is TorqueSide.MOTOR and found.torque.gravity and found.name == "a"
    assert found.qpos0 == pytest.approx(dict(zip(JOINTS, POSITION[0], strict=True)))


def test_tables_as_other_programs_write_them(tmp_path: Path):
    """Regression: an unnamed column, decimal commas, dates and a header in a comment were refused or read as texts."""
    columns = whole(command="cmd{n}", velocity=None, torque=None, side=None, gravity=None)
    lines = log(tmp_path / "a.csv").read_text().splitlines()
    stamp = np.datetime_as_string(np.datetime64("2024-05-01T23:59:59.5") + (1e6 * TIME).astype("timedelta64[us]"))

    def read(*new: str, name: str = "b.csv", **changes: object) -> None:
        (tmp_path / name).write_text("\n".join(new) + "\n")
        map_ = msgspec.structs.replace(columns, **changes)  # type: ignore[type-var]
        check(load_recording(tmp_path / name, columns=map_), 1e-6, position=POSITION)

    read(*(f"{'' if i == 0 else i - 1},{line}" for i, line in enumerate(lines)))  # to_csv() of pandas
    read(*(f"{'' if i == 0 else TIME[i - 1]},{line}" for i, line in enumerate(lines)), time="Unnamed: 0")  # an index
    read(*(f"{line},," for line in lines))
    read(f"# {lines[0]}", *lines[1:])  # numpy's savetxt(header=...)
    read("# Monday", f"#{lines[0]}", "# N m, rad", *lines[1:])
    read(*(line.replace(",", ";").replace(".", ",") for line in lines))  # a spreadsheet's decimal comma
    read(*(line.replace(",", ";\t").replace(".", ",") for line in lines))
    read(*(line.replace(",", "\t").replace(".", ",") for line in lines), name="b.tsv")
    for written in (stamp, [f"{text.replace('T', ' ')}+02:00" for text in stamp]):
        dated = (f"{'date' if i == 0 else written[i - 1]},{line}" for i, line in enumerate(lines))
        read(*dated, time="date", units=Units(angle="rad"))
    read(
        *(f"{'id' if i == 0 else '20240501T120000'},{line}" for i, line in enumerate(lines))
    )  # polars takes it for one
    (tmp_path / "c.csv").write_text("\n".join(["# a note", *lines[1:]]))
    assert "c.csv, line 2: expected the names of the columns, got numbers, " in refused(tmp_path / "c.csv", columns)
    numbered = {str(i): values for i, values in enumerate((TIME, COMMAND[:, 0], POSITION[:, 0]))}  # DataFrame(array)
    one = ColumnMap(joints=["shoulder"], time="0", command="1", position="2", units=RAD)
    found = load_recording(table(tmp_path / "d.csv", **numbered), columns=one)
    assert found.channels["position"].values[0, :, 0] == pytest.approx(POSITION[:, 0])


def test_lists_in_the_cells_of_several_files(tmp_path: Path):
    """As of isaac-sim2real/sage: a folder of control.csv and state_motor.csv, in microseconds."""
    for name, columns in {
        "control": {"positions": COMMAND},
        "state_motor": {"positions": POSITION, "torques": TORQUE},
    }.items():
        lines = [f"type,timestamp,{','.join(columns)}"]
        for row, t in enumerate(TIME):
            cells = (f'"{values[row].tolist()}"' for values in columns.values())
            lines.append(f"X,{1e6 * t + 5.017},{','.join(cells)}")
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
    state = {"file": "state_motor.csv*"}
    columns = ColumnMap(
        joints=list(JOINTS),
        time="timestamp",
        command=ChannelMap("positions", file="control.csv*"),
        position=ChannelMap("positions", **state),
        units=Units(angle="rad", time="us"),
    )
    check(load_recording(tmp_path, columns=columns), position=POSITION)
    assert "has no file like 'state.csv'" in refused(
        tmp_path, ColumnMap(joints=["a"], time="t", position=ChannelMap("p", file="state.csv"), units=RAD)
    )
    assert "give the folder" in refused(tmp_path / "control.csv", columns)
    text = ColumnMap(joints=["a"], time="type", position="positions[0]", units=RAD)
    assert "holds no numbers" in refused(tmp_path / "control.csv", text)


def test_parquet_of_pyarrow(tmp_path: Path):
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    stamps = pa.array((1_700_000_000_000_000_000 + np.round(TIME * 1e9)).astype("int64"), pa.timestamp("ns"))
    lists = {name: pa.array(values.tolist()) for name, values in {"cmd": COMMAND, "q": POSITION}.items()}
    pq.write_table(pa.table({"stamp": stamps, **lists}), tmp_path / "a.parquet")
    columns = ColumnMap(joints=list(JOINTS), time="stamp", command="cmd", position="q[0:2]", units=Units(angle="rad"))
    check(load_recording(tmp_path / "a.parquet", columns=columns), position=POSITION)


def test_units_of_every_kind(tmp_path: Path):
    """One motion in other units is the same recording."""
    path = log(
        tmp_path / "a.csv",
        t=np.round(TIME * 1e3),
        cmd9=np.degrees(COMMAND[:, 0]),
        cmd10=np.degrees(COMMAND[:, 1]),
        q9=2048 + COMMAND[:, 0] * 4096 / (2 * np.pi),
        q10=2048 - COMMAND[:, 1] * 4096 / (2 * np.pi),
        dq9=VELOCITY[:, 0] * 60 / (2 * np.pi),
        dq10=VELOCITY[:, 1] * 60 / (2 * np.pi),
        tau9=1e3 * TORQUE[:, 0] / 0.5,
        tau10=1e3 * TORQUE[:, 1] / -2.0,
    )
    columns = whole(
        time="t",
        command=ChannelMap("cmd{n}", unit="deg"),
        position=ChannelMap("q{n}", unit="counts", counts_per_turn=4096, zero=2048, scale=[1, -1]),
        velocity=ChannelMap("dq{n}", unit="rpm"),
        torque=ChannelMap("tau{n}", unit="mA", torque_constant=[0.5, -2.0]),
        units=Units(time="ms"),
    )
    check(load_recording(path, columns=columns), position=COMMAND, velocity=VELOCITY, torque=TORQUE)


def test_normalised_positions(tmp_path: Path):
    low, high = np.array([-1.0, -2.0]), np.array([1.0, 3.0])
    share = 200 * (COMMAND - low) / (high - low) - 100
    path = log(tmp_path / "a.csv", cmd9=share[:, 0], cmd10=share[:, 1])
    entry = {"columns": "cmd{n}", "unit": "normalised"}
    found = load_recording(path, columns=whole(command=ChannelMap(**entry, range=[[-1.0, 1.0], [-2.0, 3.0]])))
    check(found, position=POSITION, velocity=VELOCITY, torque=TORQUE)
    assert "range is needed for a normalised position" in refused(path, whole(command=ChannelMap(**entry)))
    assert "range must be [lowest, highest]" in refused(path, whole(command=ChannelMap(**entry, range=[1.0, -1.0])))


def test_slides(tmp_path: Path):
    path = log(tmp_path / "a.csv", q9=1e3 * POSITION[:, 0], tau9=1e-3 * TORQUE[:, 0])
    units = Units(angle="rad", length="mm", torque="N m", force="kN")
    columns = whole(slides=["shoulder"], command=None, velocity=None, units=units)
    found = load_recording(path, columns=columns)
    assert found.channels["position"].unit == "m or rad" and found.channels["torque"].unit == "N or N m"
    assert found.channels["position"].values[0] == pytest.approx(POSITION)
    assert found.channels["torque"].values[0] == pytest.approx(TORQUE)


def test_missing_cells_are_masked(tmp_path: Path):
    text = log(tmp_path / "a.csv").read_text().splitlines()
    head = text[0].split(",")
    row = text[7].split(",")
    row[head.index("q9")] = ""
    row[head.index("tau10")] = "nan"
    text[7] = ",".join(row)
    (tmp_path / "a.csv").write_text("\n".join(text))
    found = load_recording(tmp_path / "a.csv", columns=whole())
    assert np.argwhere(~found.channels["position"].mask).tolist() == [[0, 6, 0]]
    assert np.argwhere(~found.channels["torque"].mask).tolist() == [[0, 6, 1]]


def test_two_logs_are_two_repeats(tmp_path: Path):
    first = log(tmp_path / "a.csv")
    late = log(tmp_path / "b.csv", t=TIME + 0.0031, q9=POSITION[:, 0] + 0.001)
    found, _, _ = read_log([first, late], whole())
    assert found.repeats == 2 and found.channels["position"].values[1, :, 0] == pytest.approx(POSITION[:, 0] + 0.001)
    other = log(tmp_path / "c.csv", cmd9=COMMAND[:, 0] + 0.01)
    with pytest.raises(
        ValueError, match=r"c\.csv: its command is not that of .*a\.csv, joint 'shoulder' differs by 0\.01"
    ):
        read_log([first, other], whole())


def test_a_rate_makes_one_clock_and_no_stamps_make_a_warning(tmp_path: Path):
    rng = np.random.default_rng(0)
    jitter = TIME + rng.uniform(0, 0.004, len(TIME))
    path = log(tmp_path / "a.csv", t=jitter)
    found = load_recording(path, columns=whole(rate=50.0))
    assert np.diff(found.time) == pytest.approx(0.02)
    at = np.interp(found.time, jitter - jitter[0], POSITION[:, 0])
    assert found.channels["position"].values[0, :, 0] == pytest.approx(at)
    with pytest.warns(UserWarning, match=r"read without stamps, at the stated 100 Hz"):
        found = load_recording(path, columns=whole(time=None, rate=100.0))
    check(found, position=POSITION, velocity=VELOCITY, torque=TORQUE)


def test_a_rate_that_the_stamps_do_not_have_is_said(tmp_path: Path):
    """With both numbers, where it may be meant as theirs; half of it is a coarser clock."""
    path = log(tmp_path / "a.csv")
    with pytest.warns(
        UserWarning, match=r"a\.csv: the stamps are at 100 Hz, not at the 97 Hz of --rate; they are used"
    ):
        load_recording(path, columns=whole(rate=97.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for rate in (50.0, 100.0):
            load_recording(path, columns=whole(rate=rate))


def test_seconds_and_nanoseconds_add_up(tmp_path: Path):
    whole_, part = np.divmod(np.round((TIME + 0.5) * 1e9).astype(int), 10**9)
    path = log(tmp_path / "a.csv", sec=whole_ + 1_700_000_000, nsec=part)
    columns = whole(time=["sec", "nsec"], units=Units(angle="rad", torque="N m"))
    with pytest.raises(ValueError, match='give its unit, "ns"'):
        load_recording(path, columns=columns)  # nanoseconds that were not said to be such
    columns = whole(time=TimeMap(["sec", "nsec"], ["s", "ns"]))
    check(load_recording(path, columns=columns), position=POSITION, velocity=VELOCITY, torque=TORQUE)


def test_unsigned_nanoseconds_do_not_wrap(tmp_path: Path):
    """As ROS 2 counts them."""
    time = TIME + 0.93
    seconds, part = np.divmod(np.round(time * 1e9).astype(np.int64), 10**9)
    np.savez(tmp_path / "a.npz", sec=seconds.astype(np.int32), nsec=part.astype(np.uint32), cmd=COMMAND, q=POSITION)
    columns = ColumnMap(
        joints=list(JOINTS), time=TimeMap(["sec", "nsec"], ["s", "ns"]), command="cmd", position="q", units=RAD
    )
    check(load_recording(tmp_path / "a.npz", columns=columns), position=POSITION)


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_durations_count_in_their_own_unit(tmp_path: Path, unit: Literal["ms", "us", "ns"]):
    import polars as pl

    stamps = pl.Series("t", np.round(TIME * 1e9).astype(np.int64)).cast(pl.Duration("ns")).cast(pl.Duration(unit))
    frame = pl.DataFrame({"cmd": COMMAND.tolist(), "q": POSITION.tolist()}).with_columns(stamps)
    frame.write_parquet(tmp_path / "a.parquet")
    columns = ColumnMap(joints=list(JOINTS), time="t", command="cmd", position="q[0:2]", units=Units(angle="rad"))
    check(load_recording(tmp_path / "a.parquet", columns=columns), position=POSITION)


def test_a_motion_begins_where_its_first_command_finds_the_robot(tmp_path: Path):
    """Not at the start of the state log, a second before; values missing in another file are masked."""
    before = np.arange(-1.0, TIME[-1], 0.01)
    state = np.stack([np.interp(before, TIME, POSITION[:, j], left=9.0) for j in range(2)], axis=1)
    state[before < -0.5] = 2.0
    half = TIME <= 1.0
    np.savez(tmp_path / "a.npz", t=TIME, cmd=COMMAND, ts=before, q=state, th=TIME[half], tau=TORQUE[half])
    columns = ColumnMap(
        joints=list(JOINTS), time="t", command="cmd", position=ChannelMap("q", time="ts"),
        torque=ChannelMap("tau", time="th"), side="motor", gravity=True, units=RAD,
    )  # fmt: skip
    found = load_recording(tmp_path / "a.npz", columns=columns)
    assert found.qpos0 == pytest.approx(dict(zip(JOINTS, POSITION[0], strict=True)), abs=1e-6)
    one = load_recording(tmp_path / "a.npz", columns=msgspec.structs.replace(columns, rate=50.0)).channels["torque"]
    np.testing.assert_array_equal(one.mask[0].all(axis=1), one.time <= 1.0 + 1e-6)


def test_what_is_measured_late_is_no_start(tmp_path: Path):
    """Regression: measurements that begin at 1 s gave the initial position at the first command."""
    late = TIME >= 1.0
    np.savez(tmp_path / "a.npz", t=TIME, cmd=COMMAND, ts=TIME[late], q=POSITION[late])
    position = ChannelMap("q", time="ts")
    columns = ColumnMap(joints=list(JOINTS), time="t", command="cmd", position=position, units=RAD)
    assert load_recording(tmp_path / "a.npz", columns=columns).qpos0 == {}
    alone = load_recording(tmp_path / "a.npz", columns=msgspec.structs.replace(columns, command=None))
    assert alone.qpos0 == pytest.approx(dict(zip(JOINTS, POSITION[late][0], strict=True)))


def test_what_a_table_lacks_is_said_in_a_sentence(tmp_path: Path):
    path = log(tmp_path / "a.csv")
    assert "no column 'angle'; it has: t, state, cmd10" in refused(path, whole(position="angle"))
    assert "no column like 'p{n}'" in refused(path, whole(position="p{n}"))
    assert "has 1 numbers in a row, and there are 2 joints (shoulder, elbow)" in refused(path, whole(position="q9"))
    assert "the unit of joint 'shoulder' is not stated: give --units, one of rad" in refused(path, whole(units=Units()))
    assert "'grad' is no unit of the position of a hinge" in refused(path, whole(units=Units(angle="grad")))
    assert "names no joints" in refused(path, whole(joints=[]))
    assert "counts_per_turn is needed" in refused(path, whole(position=ChannelMap("q{n}", unit="counts")))
    assert "torque_constant is needed for the unit 'A'" in refused(path, whole(torque=ChannelMap("tau{n}", unit="A")))
    assert "no column of time is named" in refused(path, whole(time=None))
    assert "does not say what its columns are" in refused(path)
    hurt = log(tmp_path / "b.csv", t=np.where(np.arange(len(TIME)) == 5, np.nan, TIME))
    assert "time, row 5: expected a number, got nan" in refused(hurt, whole())
    hurt = log(tmp_path / "c.csv", cmd9=np.where(np.arange(len(TIME)) == 3, np.nan, TIME))
    assert "command, row 3, joint 'shoulder': expected a finite number" in refused(hurt, whole())
    burst = log(tmp_path / "h.csv", t=np.round(TIME - 0.004, 1))
    assert "h.csv, time, row 1: time must increase, it repeats" in refused(burst, whole())
    assert "a map with that rate (--rate) and without time reads them by their number" in refused(burst, whole())
    milli = log(tmp_path / "d.csv", t=1e3 * TIME)
    assert 'give its unit, "ms" (100 Hz)' in refused(milli, whole(units=Units(angle="rad", torque="N m")))
    (tmp_path / "e.csv").write_bytes(b"")
    assert "the file is empty" in refused(tmp_path / "e.csv", whole())
    (tmp_path / "f.csv").write_text("t,q9,q10\n0,1\n1,2,3,4\n")
    assert "not a readable table" in refused(tmp_path / "f.csv", whole())
    (tmp_path / "g.parquet").write_bytes(b"PAR1 nothing")
    assert "not a readable table" in refused(tmp_path / "g.parquet", whole())


# npz, HDF5, torch


def test_npz_of_any_names(tmp_path: Path):
    np.savez(tmp_path / "a.npz", t=TIME, desired=np.column_stack([COMMAND, TIME]), q=POSITION, note=np.array("x"))
    columns = ColumnMap(joints=list(JOINTS), time="t", command="desired[0,1]", position="q", units=RAD)
    check(load_recording(tmp_path / "a.npz", columns=columns), position=POSITION)
    assert "a row of it has 3 numbers" in refused(tmp_path / "a.npz", whole(command="desired[2:4]"))
    assert "holds no numbers" in refused(tmp_path / "a.npz", whole(time="note", command=None, position="q"))


def test_vectors_that_are_columns(tmp_path: Path):
    """Regression: time and powered as [T, 1], as MATLAB and t[:, None] write them, were refused."""
    np.savez(tmp_path / "a.npz", t=TIME[:, None], on=np.ones((len(TIME), 1)), cmd=COMMAND, q=POSITION[:, :1])
    columns = ColumnMap(
        joints=list(JOINTS), time="t", command="cmd", powered="on", units=RAD,
        position=ChannelMap("q[0]", joints=["shoulder"]),
    )  # fmt: skip
    found = load_recording(tmp_path / "a.npz", columns=columns)
    assert found.time == pytest.approx(TIME)
    assert found.channels["position"].values[0] == pytest.approx(POSITION[:, :1])


def droid(path: Path) -> Path:
    """trajectory.h5 as DROID publishes it."""
    h5py = pytest.importorskip("h5py")
    arm = [np.tile(values[:, :1], (1, 7)) for values in (COMMAND, POSITION, VELOCITY, TORQUE)]
    state = "observation/robot_state"
    with h5py.File(path, "w") as file:
        file["action/joint_position"], file[f"{state}/joint_positions"] = arm[:2]
        file[f"{state}/joint_velocities"], file[f"{state}/motor_torques_measured"] = arm[2:]
        nanoseconds = 1_680_000_000_250_000_000 + np.round(TIME * 1e9).astype(np.int64)
        stamps = "observation/timestamp/robot_state/robot_timestamp"
        file[f"{stamps}_seconds"], file[f"{stamps}_nanos"] = np.divmod(nanoseconds, 10**9)
        file["observation/controller_info/names"] = [b"x"] * len(TIME)
    return path


def test_hdf5_of_droid_needs_no_map(tmp_path: Path):
    found = load_recording(droid(tmp_path / "trajectory.h5"))
    assert found.command_names == tuple(f"panda_joint{i}" for i in range(1, 8)) and found.torque.gravity
    assert found.torque.side is TorqueSide.LINK
    assert found.time == pytest.approx(TIME, abs=1e-6) and found.command[:, 6] == pytest.approx(COMMAND[:, 0])
    assert found.channels["torque"].values[0, :, 3] == pytest.approx(TORQUE[:, 0])


def test_hdf5_of_robomimic_chooses_a_demonstration(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "low_dim.hdf5", "w") as file:
        file.create_group("data").attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": 100}})
        for demo in (0, 1, 10):
            group = file.create_group(f"data/demo_{demo}")
            group["obs/robot0_joint_pos"] = np.tile(POSITION[:, :1] + demo, (1, 7))
            group["obs/robot0_joint_vel"] = np.tile(VELOCITY[:, :1], (1, 7))
            group["actions"] = np.zeros((len(TIME), 7))
    path = tmp_path / "low_dim.hdf5"
    assert "holds 3 demonstrations" in refused(path)
    found = load_recording(path, episodes=["data/demo_10"])
    assert found.channels["position"].time == pytest.approx(TIME)  # at the controller's rate
    assert found.channels["position"].values[0, :, 0] == pytest.approx(POSITION[:, 0] + 10)
    assert "no group 'data/demo_3'; it has: data" in refused(path, episodes=["data/demo_3"])
    joints = [f"j{i}" for i in range(7)]
    columns = ColumnMap(joints, position="obs/robot0_joint_pos", units=Units(angle="rad"), rate=97.0)
    with pytest.warns(UserWarning, match=r"at the stated 97 Hz \(the log itself states 100 Hz\); a rate that is off"):
        load_recording(path, columns=columns, episodes=["data/demo_0"])
    both = load_recording(path, episodes=["data/demo_0", "data/demo_1"])
    assert both.repeats == 2 and not both.command_names
    (tmp_path / "b.h5").write_bytes(b"\x89HDF broken")
    assert "not a readable HDF5 file" in refused(tmp_path / "b.h5")


def test_hdf5_with_a_dataset_that_has_the_name_of_robomimics_group(tmp_path: Path):
    """`data` holds the positions themselves, and neither demonstrations nor a control rate."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"], file["t"] = POSITION, TIME
        file["data"].attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": 7}})
    columns = ColumnMap(list(JOINTS), position="data", units=Units(angle="rad"), time="t")
    found = load_recording(tmp_path / "a.h5", columns=columns)
    assert found.channels["position"].time == pytest.approx(TIME)
    assert found.channels["position"].values[0] == pytest.approx(POSITION)
    assert "nor the rate of its rows" in refused(tmp_path / "a.h5", msgspec.structs.replace(columns, time=None))


def test_torch_save_of_pace(monkeypatch: pytest.MonkeyPatch):
    """data/chirp_data.pt was written by torch 1.13 with PACE's keys; torch is not needed to read it."""
    monkeypatch.setitem(sys.modules, "torch", None)
    found = load_recording(DATA / "chirp_data.pt")
    t = np.arange(0, 2.0, 0.05)
    q = np.column_stack([0.3 * np.sin(2 * t), 0.5 * np.cos(t), 0.1 * t])
    assert found.command_names == ("hip", "thigh", "calf") and found.time == pytest.approx(t, abs=1e-6)
    assert found.command == pytest.approx(q, abs=1e-6)  # stored column by column
    assert found.channels["position"].values[0] == pytest.approx(q - 0.01, abs=1e-6)


class Evil:
    def __reduce__(self):
        return (Path.touch, (Path(self.path),))  # type: ignore[attr-defined]


def repacked(path: Path, **members: bytes) -> Path:
    """chirp_data.pt with other members."""
    with zipfile.ZipFile(DATA / "chirp_data.pt") as old, zipfile.ZipFile(path, "w") as new:
        for item in old.infolist():
            short = item.filename.partition("/")[2]
            if short in members and not members[short]:
                continue
            new.writestr(item.filename, members.get(short, old.read(item)))
    return path


def test_torch_files_run_no_code(tmp_path: Path):
    evil = Evil()
    evil.path = str(tmp_path / "touched")  # type: ignore[attr-defined]
    path = repacked(tmp_path / "a.pt", **{"data.pkl": pickle.dumps({"time": evil}, 2)})
    assert "holds the object" in refused(path) and not (tmp_path / "touched").exists()
    for call in (b"cos\nsystem\n(S'touch x'\ntR.", b"cbuiltins\neval\n(S'1'\ntR.", b"ctorch\nload\n(S'x'\ntR."):
        assert "holds the object" in refused(repacked(tmp_path / "b.pt", **{"data.pkl": call}))
    deep: dict = {}
    inner = deep
    for _ in range(30):  # 2^30 values, each of them twice in the next
        inner["a"] = inner["b"] = inner = {}
    bomb = repacked(tmp_path / "c.pt", **{"data.pkl": pickle.dumps(deep, 2)})
    assert "more than 10000 values" in refused(bomb) or "no tensors" in refused(bomb)
    assert "damaged" in refused(repacked(tmp_path / "d.pt", **{"data/1": b"\0" * 8}))
    assert "its numbers are missing" in refused(repacked(tmp_path / "e.pt", **{"data/1": b""}))
    (tmp_path / "f.pt").write_bytes(b"nothing")
    assert "not a readable file of torch.save" in refused(tmp_path / "f.pt")
    (tmp_path / "g.pt").write_bytes(io.BytesIO(b"PK\5\6" + b"\0" * 18).getvalue())
    assert "no data.pkl" in refused(tmp_path / "g.pt")


# LeRobot


def dataset(folder: Path, version: str, degrees: bool = True, names: object = None) -> Path:
    """Two episodes as LeRobot lays them out, written with pyarrow, on which its own library writes."""
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    names = [f"{joint}.pos" for joint in (*JOINTS, "gripper")] if names is None else names
    factor = 180 / np.pi * (6 if degrees else 1)  # beyond 100 in degrees
    tables = []
    for episode in (0, 1):
        rows = len(TIME)
        vectors = [np.column_stack([factor * v, np.full(rows, 40.0)]) + episode for v in (COMMAND, POSITION)]
        lists = [pa.FixedSizeListArray.from_arrays(pa.array(v.astype(np.float32).ravel()), 3) for v in vectors]
        counted = pa.array(np.arange(rows))
        tables.append(
            pa.table(
                {
                    "action": lists[0], "observation.state": lists[1], "timestamp": pa.array(TIME.astype(np.float32)),
                    "frame_index": counted, "episode_index": pa.array(np.full(rows, episode)), "index": counted,
                }
            )
        )  # fmt: skip
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if version == "v3.0":
        pq.write_table(pa.concat_tables(tables), chunk / "file-000.parquet")
    else:
        for episode, one in enumerate(tables):
            pq.write_table(one, chunk / f"episode_{episode:06d}.parquet")
    vector = {"dtype": "float32", "shape": [3], "names": names}
    info = {
        "codebase_version": version, "robot_type": "so101_follower", "fps": 100, "total_episodes": 2,
        "features": {"action": vector, "observation.state": vector, "observation.images.top": {"dtype": "video"}},
    }  # fmt: skip
    (folder / "meta").mkdir()
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    return folder


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_lerobot_in_degrees(tmp_path: Path, version: str):
    """The meta names the joints; numbers beyond 100 are degrees, and the gripper is none."""
    path = dataset(tmp_path / "set", version, names={"motors": [*JOINTS, "gripper"]} if version == "v2.0" else None)
    assert "holds 2 episodes" in refused(path) and "has no episode 7" in refused(path, episodes=[7])
    found = load_recording(path, episodes=["1"])
    one = np.pi / 180
    assert found.command_names == JOINTS and found.command == pytest.approx(6 * COMMAND + one, abs=1e-4)
    assert found.channels["position"].values[0] == pytest.approx(6 * POSITION + one, abs=1e-4)
    assert found.meta["robot_type"] == "so101_follower"


def test_lerobot_asks_for_a_unit_that_the_numbers_leave_open(tmp_path: Path):
    path = dataset(tmp_path / "set", "v3.0", degrees=False)
    assert "degrees (use_degrees) or -100 .. 100" in refused(path, episodes=[0])
    found = load_recording(path, episodes=[0], units={"angle": "deg"}, joints=JOINTS)
    check(found, 1e-5, position=POSITION)
    turned = load_recording(path, episodes=[0], units={"angle": "deg"}, joints=JOINTS[::-1])
    assert turned.command == pytest.approx(COMMAND[:, ::-1], abs=1e-5)  # by name, in the order wanted


def test_lerobot_records_no_gripper_in_degrees(tmp_path: Path):
    """Regression: where the user stated degrees, the gripper's percentage was read as degrees."""
    path = dataset(tmp_path / "set", "v3.0", degrees=False)
    degrees = {"angle": "deg"}
    assert load_recording(path, episodes=[0], units=degrees).command_names == JOINTS
    for joints in ((*JOINTS, "gripper"), (*JOINTS, "jaw")):
        assert "records 'gripper.pos' as a share" in refused(path, episodes=[0], units=degrees, joints=joints)
    mixed = refused(path, episodes=[0], units=degrees, joints=("elbow", "jaw"))
    assert "none of them is jaw" in mixed  # not by position: the first is known by name


def test_lerobot_of_another_version(tmp_path: Path):
    path = dataset(tmp_path / "set", "v1.6")
    assert "is of version 'v1.6'; versions 2 and 3 are read" in refused(path)


# Maps and the command


def test_maps_come_back_as_they_were_written(tmp_path: Path):
    columns = whole(
        time=["a", "b"], position=ChannelMap(["x", "y"], scale=[1.0, -1.0], zero=3.0), stiffness=[1.0], damping=[2.0]
    )
    write_map(columns, tmp_path / "a.map.toml")
    assert read_map(tmp_path / "a.map.toml") == columns
    (tmp_path / "b.map.toml").write_text("dear = 1")
    with pytest.raises(ValueError, match="is not a column map: it is not replaced"):
        write_map(columns, tmp_path / "b.map.toml")
    with pytest.raises(ValueError, match=r"b\.map\.toml: unknown keys: dear"):
        read_map(tmp_path / "b.map.toml")
    (tmp_path / "c.toml").write_text("joints = [")
    with pytest.raises(ValueError, match=r"c\.toml: not a TOML file"):
        read_map(tmp_path / "c.toml")
    with pytest.raises(FileNotFoundError, match="layouts known by name are: droid, pace, robomimic"):
        read_map("drod")
    assert all(read_map(name) for name in layouts())


def test_currents_need_no_map_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path, out = log(tmp_path / "a.csv", tau1=1000 * POSITION[:, 0], tau2=500 * POSITION[:, 0]), tmp_path / "out"
    said = ["--columns", "time=t", "command=cmd{n}", "position=q9,q10", "torque=tau1,tau2", "--joints", *JOINTS]
    said += ["--units", "angle=rad", "torque=mA", "--torque", "motor", "--gravity"]
    assert main(["convert", str(path), *said, "--out", str(out / "none.npz")]) == 2
    assert "torque_constant is needed for the unit 'mA'" in capsys.readouterr().err
    assert main(["convert", str(path), *said, "--torque-constant", "1.8", "-1.2", "--out", str(out / "one.npz")]) == 0
    assert main(["convert", str(path), "--out", str(out / "two.npz")]) == 0  # by the map that the first one left
    for name in ("one", "two"):
        torque = load_recording(out / f"{name}.npz").channels["torque"].values[0]
        np.testing.assert_allclose(torque, POSITION[:, :1] * [1.8, -0.6], rtol=1e-6)
    wrong = [word for word in said if not word.startswith("torque=tau")]
    assert main(["convert", str(path), *wrong, "--torque-constant", "2", "--out", str(tmp_path / "no" / "x.npz")]) == 2
    assert "--torque-constant: no column of the torque is read" in capsys.readouterr().err


def test_a_torque_constant_counts_once(tmp_path: Path):
    """Regression: a constant in the kept map was applied twice if the command stated it again without the unit."""
    path, out = log(tmp_path / "a.csv"), tmp_path / "out"
    said = ["--columns", "time=t", "command=cmd{n}", "position=q{n}", "torque=tau{n}", "--joints", *JOINTS]
    said += ["--units", "angle=rad", "torque=mA", "--torque", "motor", "--gravity"]
    assert main(["convert", str(path), *said, "--torque-constant", "1.8", "-1.2", "--out", str(out / "one.npz")]) == 0
    assert main(["convert", str(path), "--torque-constant", "1.5", "-1.2", "--out", str(out / "two.npz")]) == 0
    unit = whole(torque=ChannelMap("tau{n}", unit="mA"))  # and no constant
    write_map(unit, tmp_path / "servo.toml")
    again = ["--map", str(tmp_path / "servo.toml"), "--torque-constant", "1.5", "-1.2"]
    assert main(["convert", str(path), *again, "--out", str(tmp_path / "three.npz")]) == 0
    for file in (out / "two.npz", tmp_path / "three.npz"):
        torque = load_recording(file).channels["torque"].values[0]
        np.testing.assert_allclose(torque, 1e-3 * TORQUE * [1.5, -1.2], rtol=1e-6)
    plain = load_recording(path, columns=whole(), torque_constant=[2.0])  # efforts in another unit than stated
    np.testing.assert_allclose(plain.channels["torque"].values[0], 2.0 * TORQUE, rtol=1e-6)


def test_units_on_the_command_line_are_those_of_channels_that_state_their_own(tmp_path: Path):
    """Regression: they were ignored there, and numbers were read in the map's unit."""
    degrees = {
        f"{name}{10 - i}": np.degrees(v[:, 1 - i])
        for name, v in {"cmd": COMMAND, "q": POSITION}.items()
        for i in (0, 1)
    }
    path = log(tmp_path / "a.csv", t=np.round(TIME * 1e3), tau9=1e3 * TORQUE[:, 0], tau10=1e3 * TORQUE[:, 1], **degrees)
    columns = whole(
        time=TimeMap("t", "s"),
        command=ChannelMap("cmd{n}", unit="rad"),
        position=ChannelMap("q{n}", unit=["rad", "rad"]),
        velocity=ChannelMap("dq{n}", unit="rpm"),
        torque=ChannelMap("tau{n}", unit="N m"),
        units=Units(),
    )
    write_map(columns, tmp_path / "servo.toml")
    said = {"angle": "deg", "torque": "mN m", "time": "ms"}
    found = load_recording(path, columns=tmp_path / "servo.toml", units=said)
    check(found, position=POSITION, velocity=VELOCITY * 2 * np.pi / 60, torque=TORQUE)  # rpm is no angle per second
    per = changed_map(whole(velocity=ChannelMap("dq{n}", unit=["rad/s", "m/s"])), {}, {"angle": "deg"}).velocity
    assert isinstance(per, ChannelMap) and per.unit == ["deg/s", "m/s"]  # a length is none of these angles


def test_torque_on_the_command_line_and_in_the_map(tmp_path: Path):
    """Regression: `none` kept the torque and changed its gravity, and so did a side that was stated again."""
    path, columns = log(tmp_path / "a.csv"), tmp_path / "servo.toml"
    write_map(whole(), columns)

    def made(*words: str) -> Recording:
        assert main(["convert", str(path), "--map", str(columns), *words, "--out", str(tmp_path / "a.npz")]) == 0
        return load_recording(tmp_path / "a.npz")

    without = made("--torque", "none")
    assert "torque" not in without.channels and "position" in without.channels
    kept = read_map(tmp_path / "a.map.toml")
    assert kept.torque is None and kept.side is None and kept.gravity is None
    link = made("--torque", "link")
    assert link.torque.side is TorqueSide.LINK and link.torque.gravity and "torque" in link.channels
    write_map(whole(gravity=False), columns)
    assert made("--torque", "motor", "--gravity").torque.gravity and not made("--torque", "motor").torque.gravity
    write_map(whole(torque=None, side=None, gravity=None), columns)
    new = made("--columns", "torque=tau{n}", "--torque", "motor")
    assert "torque" in new.channels and not new.torque.gravity


def test_servo_gains_are_of_one_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Regression: the kept map held them, so that the next log got the gains of the first."""
    path, out = log(tmp_path / "kp200.csv"), tmp_path / "out"
    said = ["--columns", "time=t", "command=cmd{n}", "position=q{n}", "--units", "angle=rad", "--joints", *JOINTS]
    given = ["--stiffness", "20", "20", "--damping", "0", "1"]
    assert main(["convert", str(path), *said, *given, "--out", str(out / "kp200.npz")]) == 0
    assert "except --stiffness and --damping: servo gains belong to one log" in capsys.readouterr().out
    gains = load_recording(out / "kp200.npz").gains
    assert gains is not None and gains.stiffness.tolist() == [20.0, 20.0]
    assert main(["convert", str(path), "--out", str(out / "kp800.npz")]) == 0
    assert load_recording(out / "kp800.npz").gains is None
    assert "servo gains" not in capsys.readouterr().out
    for target in (out / "stiff.npz", out / "stiff"):  # and damping that is not known is not stated
        assert main(["convert", str(path), "--stiffness", "20", "30", "--out", str(target)]) == 0
        gains = load_recording(target).gains
        assert gains is not None and gains.stiffness.tolist() == [20.0, 30.0] and gains.damping is None


def test_gains_in_a_kept_map_are_not_those_of_the_next_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Regression: a map of an earlier version holds gains; converting one log twice gave two recordings."""
    path, out = log(tmp_path / "a.csv"), tmp_path / "out"
    write_map(whole(stiffness=[20.0, 20.0], damping=[0.0, 1.0]), out / "old.map.toml")
    for name in ("a", "b"):
        assert main(["convert", str(path), "--out", str(out / f"{name}.npz")]) == 0
        assert load_recording(out / f"{name}.npz").gains is None
    own = out / "own.map.toml"
    write_map(whole(stiffness=[20.0, 20.0], damping=[0.0, 1.0]), own)
    before = own.read_text()
    assert main(["convert", str(path), "--map", str(own), "--out", str(out / "own.npz")]) == 0
    assert load_recording(out / "own.npz").gains is not None and own.read_text() == before
    assert main(["convert", str(path), "--joints", "a=shoulder", "elbow", "--out", str(out / "c.npz")]) == 2
    assert "is for ROS bags" in capsys.readouterr().err


def test_units_on_the_command_line_leave_numbers_of_other_kinds(tmp_path: Path):
    def restated(entry: dict[str, Any], key: str, kind: str, unit: str) -> Any:
        return column_map._restated(entry, key, kind, unit)["unit"]

    assert restated({"unit": "counts", "counts_per_turn": 4096}, "command", "angle", "rad") == "counts"
    assert restated({"unit": ["rad", "percent"]}, "position", "angle", "deg") == ["deg", "percent"]
    assert restated({"unit": ["s", "ns"]}, "time", "time", "s") == ["s", "ns"]
    assert restated({"unit": "rad/s"}, "velocity", "angle", "percent") == "rad/s"


def test_tables_with_units_below_their_names_and_commas_beside_nan(tmp_path: Path):
    (tmp_path / "units.csv").write_text("# time,q1,q2\n# s,rad,rad\n0,0.1,0.2\n0.01,0.3,0.4\n")
    assert [*open_csv(tmp_path / "units.csv").widths] == ["time", "q1", "q2"]
    (tmp_path / "numbered.csv").write_text("1,2,3\n0,0.1,0.2\n0.01,0.3,0.4\n")
    assert [*open_csv(tmp_path / "numbered.csv").widths] == ["1", "2", "3"]
    (tmp_path / "comma.csv").write_text("t;q1\n0,00;0,10\n0,01;NaN\n0,02;0,12\n")
    values = open_csv(tmp_path / "comma.csv").read("q1")
    assert np.array_equal(values, [0.1, np.nan, 0.12], equal_nan=True)


def test_what_is_known_of_one_log_is_stated_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    said = ["--columns", "time=t", "command=cmd{n}", "position=q{n}", "--units", "angle=rad", "--joints", *JOINTS]
    out = tmp_path / "out" / "log.npz"
    words = ["convert", str(log(tmp_path / "log.csv")), *said, "--out", str(out), "--known"]
    assert main([*words, "payload=0.5", "rotor=second rotor"]) == 0
    assert load_recording(out).known == {"payload": 0.5, "rotor": "second rotor"}
    for word, said in (("payload", "expected --known PARAMETER=VALUE"), ("payload=nan", "known value of 'payload'")):
        assert main([*words, word]) == 2
        assert said in capsys.readouterr().err


def test_convert_remembers_the_map_beside_the_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    first, second = log(tmp_path / "a.csv"), log(tmp_path / "b.csv", q9=POSITION[:, 0] + 0.1)
    said = ["--columns", "time=t", "command=cmd{n}", "position=q9,q10", "--units", "angle=rad", "--joints", *JOINTS]
    out = tmp_path / "out"
    assert main(["convert", str(first), *said, "--out", str(out / "one.npz")]) == 0
    assert main(["convert", str(second), "--out", str(out / "two.npz")]) == 0
    assert f"columns as in {out / 'one.map.toml'}" in capsys.readouterr().out
    found = load_recording(out / "two.npz")
    assert found.command == pytest.approx(COMMAND) and found.name == "two"
    assert found.channels["position"].values[0, :, 0] == pytest.approx(POSITION[:, 0] + 0.1)
    assert main(["convert", str(second), "--rate", "50", "--out", str(out / "slow.npz")]) == 0
    assert main(["convert", str(second), "--out", str(out / "four.npz")]) == 0  # of two maps the newest
    assert len(load_recording(out / "four.npz").time) == 100
    wrong = ["--map", str(out / "one.map.toml"), "--units", "angle=deg"]
    assert main(["convert", str(first), *wrong, "--out", str(out / "deg.npz")]) == 0
    assert load_recording(out / "deg.npz").command == pytest.approx(np.radians(COMMAND))
    assert main(["convert", str(first), "--out", str(out / "three.npz")]) == 2
    assert "both map its columns, and differ: choose with --map" in capsys.readouterr().err
    assert main(["convert", str(first), "--units", "angle=rad", "--out", str(out / "rad.npz")]) == 0  # not in this
    for words, error in {
        ("--columns", "position"): "expected --columns CHANNEL=COLUMN",
        ("--columns", "pose=q9"): "'pose' is no channel",
        (
            "--map",
            str(out / "one.map.toml"),
            "--torque",
            "link",
            "--state-topic",
            "/x",
        ): "--state-topic is for ROS bags",
        ("--map", "droid"): "no column 'action/joint_position'",
        (
            "--map",
            str(out / "one.map.toml"),
            "--columns",
            "torque=tau{n}",
        ): "maps a torque but does not state its convention",
    }.items():
        assert main(["convert", str(first), *words, "--out", str(tmp_path / "no.npz")]) == 2
        assert error in capsys.readouterr().err


@pytest.mark.parametrize(("package", "name"), [("polars", "a.csv"), ("h5py", "a.h5")])
def test_readers_that_are_not_installed_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, name: str
):
    (tmp_path / name).write_bytes(b"x")
    monkeypatch.setitem(sys.modules, package, None)
    assert f"need {package}: in the checkout, pip install -c constraints.txt -e '.[formats]'" in refused(
        tmp_path / name
    )


def test_the_maps_in_the_documentation_are_maps(tmp_path: Path):
    text = (Path(__file__).parents[2] / "docs" / "file-formats.md").read_text()
    blocks = re.findall(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        (tmp_path / "a.toml").write_text(block)
        assert read_map(tmp_path / "a.toml").joints and len(block.splitlines()) <= 10
    row = next(line for line in text.splitlines() if line.startswith("| `unit` |"))
    units = {unit for of in (HINGES, SLIDES) for kind in of.values() for unit in kind}
    stated = {word.strip() for part in row.split("|")[2].split(";") for word in part.partition(":")[2].split(",")}
    assert {word.partition(" (")[0] for word in stated} == units


def test_lost_samples_are_no_other_rate(recwarn: pytest.WarningsRecorder):
    every = np.arange(400) / 100.0
    warn_of_rate(np.delete(every, slice(100, 112)), 100.0, "log.csv")
    assert not recwarn.list
    with pytest.warns(UserWarning, match="the stamps are at 100 Hz, not at the 98 Hz"):
        warn_of_rate(np.delete(every, slice(100, 112)), 98.0, "log.csv")
