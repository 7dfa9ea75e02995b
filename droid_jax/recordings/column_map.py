"""The meaning of a log's columns: `ColumnMap`, read from and written to a small TOML file.

A map states which columns of a table, an npz, an HDF5 file or a dataset hold commands and measurements, in which units
and of which joints.  One map reads all logs with the same columns.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from droid_jax.arguments import shown
from droid_jax.read_json import typed
from droid_jax.recordings.units import COUNTS, CURRENTS, HINGES, KINDS, NORMALISED, SLIDES, TIMES
from droid_jax.storage import read_text, refuse_foreign, write_text

SUFFIX = ".map.toml"
HEAD = "# Column map of droid_jax: `python -m droid_jax.run convert LOG --map THIS_FILE`"
MOST_BYTES = 2**18  # of a map
CHANNELS = ("command", "position", "velocity", "torque", "object_angle")
_POSITIONS = ("command", "position", "velocity", "object_angle")
# kind of `Units` -> entries of a map that may state a unit themselves
_STATE = {"angle": _POSITIONS, "length": _POSITIONS, "torque": ("torque",), "force": ("torque",), "time": ("time",)}
LAYOUTS = Path(__file__).parent / "layouts"  # maps of widely used layouts


class ChannelMap(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True, frozen=True):
    """Columns of one channel, or of the command.

    columns: a name, or one name per joint.  In a name, `{n}` stands for a number and `{joint}` for the joint's name.
        `[0:3]` or `[2,5]` behind a name selects components of a column of vectors.
    unit: unit of the numbers, or one per joint (`droid_jax.recordings.units`); that of `ColumnMap.units` by default.
    file: name of the file in a log of several files, `*` for any characters.
    time: the time column of that file, where it has another name.
    scale: factor on the numbers, e.g. -1 where an axis points the other way.
    zero: the log's number where the model has 0, in the log's unit.
    counts_per_turn: counts of the encoder in one turn, with the unit "counts".
    range: lowest and highest position of each joint (or of all), rad or m, with the unit "normalised" or "percent".
    torque_constant: N m (N) per A or per %, with the units "A", "mA", "%".
    joints: joints of these numbers, where they are not `ColumnMap.joints`.
    """

    columns: str | list[str]
    unit: str | list[str] | None = None
    file: str | None = None
    time: str | None = None
    scale: float | list[float] = 1.0
    zero: float | list[float] = 0.0
    counts_per_turn: float | list[float] | None = None
    range: list[float | list[float]] | None = None
    torque_constant: float | list[float] | None = None
    joints: list[str] | None = None


class TimeMap(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True, frozen=True):
    """The column of time stamps, or several that add up (seconds and nanoseconds), with the unit of each."""

    columns: str | list[str]
    unit: str | list[str] | None = None


class Units(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True, frozen=True):
    """Units of all channels whose entry states none; the unit of speeds is that of angle or length, per second."""

    angle: str | None = None
    length: str | None = None
    torque: str | None = None
    force: str | None = None
    time: str | None = None


class ColumnMap(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True, frozen=True):
    """The meaning of a log's columns.

    joints: measured joints, named as in the MJCF.
    slides: those of the joints that slide.
    time: columns of the time stamps; without them, `rate` is the rate of the rows.
    command, position, velocity, torque, object_angle: columns of each channel; a name alone stands for a `ChannelMap`
        with this name.
    powered: a column that is 0 (or false) where the motors are off, in the file that holds the command.  Only the
        longest interval in which they are on is read.
    side, gravity: convention of the torque, as in a recording.
    stiffness, damping: gains of the commanded joints, N m/rad and N m s/rad; without damping, the scene's is used.
    rate: Hz; with a column of time, the rate of the common clock that everything is interpolated onto.
    units: units of all channels whose entry states none.
    """

    joints: list[str] = []
    slides: list[str] = []
    time: str | list[str] | TimeMap | None = None
    command: str | list[str] | ChannelMap | None = None
    position: str | list[str] | ChannelMap | None = None
    velocity: str | list[str] | ChannelMap | None = None
    torque: str | list[str] | ChannelMap | None = None
    object_angle: str | list[str] | ChannelMap | None = None
    powered: str | None = None
    side: str | None = None
    gravity: bool | None = None
    stiffness: list[float] = []
    damping: list[float] = []
    rate: float | None = None
    units: Units = Units()

    def channel(self, name: str) -> ChannelMap | None:
        """The entry of a channel as a `ChannelMap`; None where the map has none."""
        entry = getattr(self, name)
        return entry if entry is None or isinstance(entry, ChannelMap) else ChannelMap(entry)

    @property
    def stamps(self) -> TimeMap | None:
        """The entry of the time, with the unit of `units` unless it states one."""
        entry = self.time if self.time is None or isinstance(self.time, TimeMap) else TimeMap(self.time)
        if entry is None or entry.unit is not None:
            return entry
        return TimeMap(entry.columns, self.units.time)


def read_map(path: str | Path) -> ColumnMap:
    """The map in a TOML file, or a layout of this program by its name ("droid").

    Raises:
        OSError: there is no such file.
        ValueError: the file is not TOML, has unknown keys or values of another kind, or maps no measured channel.
    """
    known = layouts()
    if str(path) in known:
        path = known[str(path)]
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no map at {path}; layouts known by name are: {', '.join(known)}")
    text = read_text(path, most=MOST_BYTES)
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not a TOML file: {error}") from None
    return check_map(typed(content, ColumnMap, str(path)), str(path))


def layouts() -> dict[str, Path]:
    """Name -> file of the maps that come with the program."""
    return {path.stem: path for path in sorted(LAYOUTS.glob("*.toml"))}


def check_map(columns: ColumnMap, where: str) -> ColumnMap:
    """The map itself; ValueError where it maps no measured channel or contradicts itself."""
    if not any(columns.channel(name) for name in CHANNELS if name != "command"):
        raise ValueError(f"{where}: maps no measured channel: give the columns of position, velocity or torque")
    if columns.torque is not None and (columns.side is None or columns.gravity is None):
        raise ValueError(
            f'{where}: maps a torque but does not state its convention: give side = "motor" or "link" (--torque), and '
            "gravity = true where it contains the arm's weight (--gravity), false where not"
        )
    if columns.side not in (None, "motor", "link"):
        raise ValueError(f'{where}: side must be "motor" or "link", got {shown(columns.side)}')
    if columns.rate is not None and not 0 < columns.rate < 1e5:
        raise ValueError(f"{where}: rate must be above 0 and below 1e5 Hz, got {columns.rate:g}")
    entries = [entry for name in CHANNELS if (entry := columns.channel(name)) is not None]
    known = {*columns.joints, *(joint for entry in entries for joint in entry.joints or ())}
    unnamed = not columns.joints and any(entry.joints is None for entry in entries)  # the log may name them
    if not unnamed and (strange := [s for s in columns.slides if s not in known]):
        raise ValueError(f"{where}: slides must be among the joints, got {', '.join(strange)}")
    if columns.damping and len(columns.stiffness) != len(columns.damping):
        raise ValueError(f"{where}: got {len(columns.stiffness)} stiffness and {len(columns.damping)} damping")
    stamps = columns.stamps
    unit = columns.units.time if stamps is None else stamps.unit
    units = [] if unit is None else as_list(unit)
    if wrong := [unit for unit in units if unit not in TIMES]:
        raise ValueError(f"{where}: {wrong[0]!r} is no unit of time; known are: {', '.join(TIMES)}")
    return columns


def changed_map(
    columns: ColumnMap | None,
    channels: Mapping[str, str],
    units: Mapping[str, str],
    torque_constant: Sequence[float] = (),
    unstated: Mapping[str, Any] | None = None,
    **changes: Any,
) -> ColumnMap:
    """A map changed by options of the command line.

    Args:
        columns: the map that is changed; None for a map that holds nothing but the changes.
        channels: channel or "time" -> columns, several with commas between them.
        units: "angle", "length", "torque", "force", "time" -> unit, also of channels whose entry states another.
        torque_constant: of the torque's columns, one for each joint or one for all; used only where their unit is that
            of a current.
        unstated: other fields of `ColumnMap`, where neither the map nor `changes` states them.
        changes: other fields of `ColumnMap`; None and empty ones change nothing.  The side "none" removes the torque.
    """
    where = "--columns"
    content: dict[str, Any] = {} if columns is None else msgspec.to_builtins(columns)
    if strange := [name for name in channels if name not in (*CHANNELS, "time", "powered")]:
        raise ValueError(f"{where}: {strange[0]!r} is no channel; known are: time, {', '.join(CHANNELS)}, powered")
    for name, words in channels.items():
        entry = content.get(name)
        names = [word.strip() for word in _split(words)]
        given = names[0] if len(names) == 1 else names
        content[name] = {**entry, "columns": given} if isinstance(entry, dict) else given
    if changes.get("side") == "none":
        of_torque = ("torque", "side", "gravity")
        content, changes = ({k: v for k, v in d.items() if k not in of_torque} for d in (content, changes))
    if strange := [name for name in units if name not in Units.__struct_fields__]:
        raise ValueError(f"--units: {strange[0]!r} has no unit; known are: {', '.join(Units.__struct_fields__)}")
    content["units"] = {**content.get("units", {}), **units}
    for kind, unit in units.items():
        content |= {k: _restated(content[k], k, kind, unit) for k in _STATE[kind] if isinstance(content.get(k), dict)}
    if torque_constant:
        if "torque" not in content:
            raise ValueError("--torque-constant: no column of the torque is read (--columns torque=..., --torque)")
        entry = content["torque"] if isinstance(content["torque"], dict) else {"columns": content["torque"]}
        of_all = [content["units"].get(kind) for kind in ("torque", "force")]
        if "torque_constant" in entry or any(unit in CURRENTS for unit in as_list(entry.get("unit") or of_all)):
            of_one = torque_constant[0] if len(torque_constant) == 1 else list(torque_constant)
            content["torque"] = {**entry, "torque_constant": of_one}
    content |= {name: list(v) if isinstance(v, tuple) else v for name, v in changes.items() if v not in (None, ())}
    content = {**(unstated or {}), **content}
    return check_map(typed(content, ColumnMap, where), where)


def _restated(entry: dict[str, Any], key: str, kind: str, unit: str) -> dict[str, Any]:
    """A map's entry in which the unit of that kind, if the entry states one, is replaced."""
    if not (own := as_list(entry.get("unit") or ())):
        return entry
    if key == "time":
        if len(own) > 1:  # parts that add up: seconds and nanoseconds
            return entry
        return {name: value for name, value in entry.items() if name != "unit"}
    known = (SLIDES if kind in ("length", "force") else HINGES)[KINDS[key]]
    per = "/s" if key == "velocity" else ""  # not rpm, which is no angle per second
    kept = {*COUNTS, *NORMALISED}  # their conversion needs further numbers of the entry
    if per and unit in kept:
        return entry
    new = [f"{unit}{per}" if one in known and one not in kept and one.endswith(per) else one for one in own]
    return {**entry, "unit": new[0] if isinstance(entry["unit"], str) else new}


def _split(words: str) -> list[str]:
    """Names at the commas outside of brackets."""
    out, depth = [""], 0
    for letter in words:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and depth == 0:
            out.append("")
        else:
            out[-1] += letter
    return out


def map_beside(target: Path) -> Path:
    """The file for the map of a converted recording."""
    return target.with_name(f"{target.stem if target.suffix == '.npz' else target.name}{SUFFIX}")


def write_map(columns: ColumnMap, path: Path) -> None:
    """Write a map; ValueError where the file exists and is not a map of this program."""
    check_map_target(path)
    text = tomli_w.dumps(msgspec.to_builtins(columns))
    write_text(path, f"{HEAD}\n{text}")


def check_map_target(path: Path) -> None:
    """ValueError where `write_map` would replace something else."""
    refuse_foreign(path, "a file", _is_map, "a column map")


def _is_map(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(HEAD)) == HEAD.encode()


def as_list(value: Any) -> list[Any]:
    """A value or a list of values as a list."""
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
