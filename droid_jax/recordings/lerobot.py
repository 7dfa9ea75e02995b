"""Reads datasets of LeRobot, versions 2 and 3, as columns: parquet files, which meta/info.json describes.

The meta names the components of each vector and the rate.  It does not say whether angles are degrees or normalised to
-100 .. 100, because LeRobot does not store its `use_degrees`.  The unit is inferred where the numbers can have only
one; otherwise the user must state it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from droid_jax.arguments import number, shown
from droid_jax.errors import named
from droid_jax.read_json import read_json
from droid_jax.recordings.column_map import ChannelMap, ColumnMap, TimeMap, Units
from droid_jax.recordings.log_columns import INFO, POSE, LogColumns
from droid_jax.recordings.table_file import scan_parquet

VERSIONS = ("v2.", "v3.")
COMMAND, POSITION, TIME = "action", "observation.state", "timestamp"
NORMALISED_MAX = 100.5  # larger numbers are degrees: LeRobot normalises to -100 .. 100


def open_dataset(path: Path, episode: int | None = None) -> LogColumns:
    """The columns of one episode.

    Args:
        path: of the dataset's folder.
        episode: its number; not needed where the dataset has a single episode.

    Raises:
        ValueError: the meta is damaged, of another version, or there is no such episode.
    """
    info = read_info(path)
    rows = pl.scan_parquet(path / "data" / "**" / "*.parquet", missing_columns="insert", extra_columns="ignore")
    if not any((path / "data").rglob("*.parquet")):
        raise ValueError(f"{path}: holds no parquet files in data/ (are they still to be downloaded?)")
    where = f"{path}, episode {episode}"
    probe = scan_parquet(str(path), rows)
    if "episode_index" not in probe.widths:
        raise ValueError(f"{path}: its tables have no column 'episode_index'; they have: {named(probe.widths)}")
    have = np.unique(rows.select("episode_index").collect()["episode_index"].to_numpy())
    if episode is None and len(have) > 1:
        raise ValueError(
            f"{path}: holds {len(have)} episodes, which are repeats only if they all replay one motion: choose "
            f"with --episodes, e.g. --episodes {have[0]}"
        )
    episode = int(have[0]) if episode is None and len(have) else episode
    if episode not in have:
        raise ValueError(f"{path}: has no episode {episode}, it has {named(map(str, have[:10]))}")
    log = scan_parquet(where, rows.filter(pl.col("episode_index") == episode).sort("frame_index"))
    features = info["features"]
    named_parts = {name: _components(features.get(name)) for name in log.widths}
    components = {name: parts for name, parts in named_parts.items() if parts and len(parts) == log.widths[name]}
    notes = {"robot_type": str(info.get("robot_type")), "episode": str(episode)}
    whole = replace(log, components=components, notes=notes, units={TIME: "s"})
    units, hints = _units(whole)
    return replace(whole, units={**whole.units, **units}, hints=hints)


def read_info(path: Path) -> dict[str, Any]:
    """meta/info.json of a dataset; ValueError where it is of another version or lacks something."""
    file = path / INFO
    info = read_json(file)
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise ValueError(f"{file}: not the meta of a LeRobot dataset: it has no 'features'")
    version = info.get("codebase_version")
    if not isinstance(version, str) or not version.startswith(VERSIONS):
        raise ValueError(f"{file}: is of version {shown(version)}; versions 2 and 3 are read")
    number(info.get("fps"), f"{file}: fps", above=0.0)
    return info


def usual_map(log: LogColumns, angle: str | None = None) -> ColumnMap:
    """The map of a dataset: actions are commands, the state is the position, the meta names the joints.

    A gripper beside joints in degrees is left out: LeRobot logs it as a share of its travel, which is not stored.

    Args:
        log: the dataset.
        angle: unit of its angles, where the user states it.
    """
    if POSITION not in log.widths:
        raise ValueError(f"{log.where}: has no {POSITION!r}, the measured positions; it has: {named(log.widths)}")
    names = log.components.get(COMMAND) or log.components.get(POSITION) or ()
    if not names:
        raise ValueError(
            f"{log.where}: its meta does not name the {log.widths[POSITION]} joints of {POSITION!r}: give --joints"
        )
    joints = [name.removesuffix(POSE) for name in names]
    if (angle or log.units.get(POSITION)) == "deg":
        joints = [joint for joint in joints if "gripper" not in joint]
    command = ChannelMap(COMMAND) if log.widths.get(COMMAND) == log.widths[POSITION] else None
    return ColumnMap(joints=joints, command=command, position=POSITION, time=TimeMap(TIME, "s"), units=Units())


def check_gripper(log: LogColumns, columns: ColumnMap) -> None:
    """ValueError where a map reads the gripper of a dataset in degrees, which LeRobot never records."""
    entry, names = columns.channel("position"), log.components.get(POSITION, ())
    if entry is None or entry.columns != POSITION or isinstance(entry.unit, list):
        return
    joints = entry.joints or columns.joints
    read = len(joints) == len(names) or any("gripper" in joint for joint in joints)
    degrees = (entry.unit or columns.units.angle or log.units.get(POSITION)) == "deg"
    gripper = next((name for name in names if "gripper" in name), None)
    if degrees and read and gripper:
        raise ValueError(
            f"{log.where}: LeRobot records {shown(gripper)} as a share of its travel, not in degrees: leave it out of "
            '--joints, or state a unit for each joint in the map ("percent" with its range)'
        )


def _components(feature: Any) -> tuple[str, ...]:
    """Names of a vector's numbers: a list, or a list under one name ("motors")."""
    names: Any = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return ()
    return tuple(names) if len(set(names)) == len(names) else ()


def _units(log: LogColumns) -> tuple[dict[str, str], dict[str, str]]:
    """Column -> unit where its numbers can have only one, and column -> hint for the user where not."""
    units, hints = dict[str, str](), dict[str, str]()
    both = [log.numbers(name) for name in (COMMAND, POSITION) if log.widths.get(name)]
    if not both:
        return units, hints
    # The largest number of all joints decides: a gripper's are 0 .. 100 in either case.
    size = max(float(np.nanmax(np.abs(numbers), initial=0.0)) for numbers in both)
    for name in (COMMAND, POSITION):
        if size > NORMALISED_MAX:
            units[name] = "deg"
        else:
            hints[name] = (
                f"its numbers reach {size:.3g}, and the meta does not say whether LeRobot recorded degrees "
                "(use_degrees) or -100 .. 100 of the calibrated travel"
            )
    return units, hints
