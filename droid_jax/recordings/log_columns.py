"""Columns of a log of any format by name, and those that a column map selects."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from droid_jax.arguments import said, shown
from droid_jax.errors import named
from droid_jax.recordings.column_map import as_list

_PART = re.compile(r"(.*)\[([\d:,\s]+)\]")
_NUMBER, _JOINT = "{n}", "{joint}"
INFO = Path("meta") / "info.json"  # in the folder of a LeRobot dataset
POSE = ".pos"  # behind the name of a motor, in names of LeRobot's own robots


@dataclass(frozen=True, eq=False)
class LogColumns:
    """The columns of one log, each read when it is asked for.

    where: the file, or a part of it; begins every message.
    widths: name -> numbers per row; 0 for text and pictures, which are not read.
    read: name -> values [T] or [T, W].
    components: name of a column of vectors -> names of its W numbers.
    units: column -> unit, where the log states it.
    hints: column -> sentence that helps to choose the unit, where the log does not state it.
    rate: Hz of the rows, where the log states it.
    notes: for `meta` of the recording.
    """

    where: str
    widths: Mapping[str, int]
    read: Callable[[str], np.ndarray]
    components: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    units: Mapping[str, str] = field(default_factory=dict[str, str])
    hints: Mapping[str, str] = field(default_factory=dict[str, str])
    rate: float | None = None
    notes: Mapping[str, str] = field(default_factory=dict[str, str])

    def has(self, columns: str | Sequence[str], joints: Sequence[str]) -> bool:
        """Whether `pick` finds all of them."""
        try:
            self._found(columns, joints, "")
        except ValueError:
            return False
        return True

    def pick(self, columns: str | Sequence[str], joints: Sequence[str], what: str) -> np.ndarray:
        """The numbers of a map's columns, one for each joint: [T, C], float64.

        Args:
            columns: as in `ChannelMap`.
            joints: C names, in the order wanted.
            what: name of the channel, for messages.

        Raises:
            ValueError: a column is missing or holds no numbers, or there are not as many numbers in a row as joints.
        """
        parts = []
        if isinstance(columns, str) and (by_name := self._by_name(columns, joints)) is not None:
            columns = by_name
        for name, index in self._found(columns, joints, what):
            numbers = self.numbers(name)
            numbers = numbers[:, None] if numbers.ndim == 1 else numbers
            parts.append(numbers if index is None else numbers[:, index])
        if len({len(part) for part in parts}) > 1:
            raise ValueError(f"{self.where}, {what}: its columns have {_counts(parts)} rows, one number expected")
        picked = np.concatenate(parts, axis=1).astype(np.float64, copy=False)
        if picked.shape[1] != len(joints):
            raise ValueError(
                f"{self.where}, {what}: {shown(columns)} has {picked.shape[1]} numbers in a row, and there are "
                f"{len(joints)} joints ({named(joints)}); choose some with {_example(columns)}, or name other joints"
            )
        return picked

    def stated(self, columns: str | Sequence[str], of: Mapping[str, str]) -> str | None:
        """The entry of `units` or `hints` for the columns of a map; None where there is none."""
        for text in as_list(columns):
            for name in (name for name in of if text == name or text.startswith((f"{name}.", f"{name}["))):
                return of[name]
        return None

    def numbers(self, name: str) -> np.ndarray:
        """The numbers of a column, [T] or [T, W], in its own type; [T, 1], as MATLAB writes vectors, becomes [T].

        ValueError where the column is missing or holds no numbers.
        """
        if name not in self.widths:
            raise ValueError(f"{self.where}: no column {shown(name)}; it has: {named(self.widths) or 'none'}")
        if not self.widths[name]:
            raise ValueError(f"{self.where}: the column {shown(name)} holds no numbers")
        numbers = self.read(name)
        return numbers[:, 0] if numbers.ndim == 2 and numbers.shape[1] == 1 else numbers

    def _by_name(self, name: str, joints: Sequence[str]) -> list[str] | None:
        """The vector's components that have the joints' names, as columns; None where these are other names.

        ValueError where only some are known, and not each in its place: the others cannot be taken by position.
        """
        parts = [part.removesuffix(POSE) for part in self.components.get(name, ())]
        asked = [joint.removesuffix(POSE) for joint in joints]
        places = [parts.index(joint) if joint in parts else None for joint in asked]
        if not asked or (all(place in (None, number) for number, place in enumerate(places)) and None in places):
            return None
        if None in places:
            unknown = [joint for joint, place in zip(joints, places, strict=True) if place is None]
            raise ValueError(
                f"{self.where}: {shown(name)} names its numbers {named(parts)}, and none of them is {named(unknown)}: "
                "use its names, or list the columns of the map in the order of the joints"
            )
        return [f"{name}.{self.components[name][place]}" for place in places if place is not None]

    def _found(
        self, columns: str | Sequence[str], joints: Sequence[str], what: str
    ) -> list[tuple[str, list[int] | None]]:
        """(column, components) for every column of a map; None as components means all of them."""
        found: list[tuple[str, list[int] | None]] = []
        for text in as_list(columns):
            if _NUMBER in text and text not in self.widths:
                found += [(name, None) for name in self._numbered(text, what)]
            elif _JOINT in text and text not in self.widths:
                found += [self._one(text.replace(_JOINT, joint), what) for joint in joints]
            else:
                found.append(self._one(text, what))
        return found

    def _numbered(self, text: str, what: str) -> list[str]:
        """Columns like q{n}, in the order of their numbers."""
        pattern = re.compile(re.escape(text).replace(re.escape(_NUMBER), r"(\d+)"))
        matches = {name: match for name in self.widths if (match := pattern.fullmatch(name))}
        if not matches:
            raise ValueError(f"{self.where}, {what}: no column like {shown(text)}; it has: {named(self.widths)}")
        return sorted(matches, key=lambda name: [int(number) for number in matches[name].groups()])

    def _one(self, text: str, what: str) -> tuple[str, list[int] | None]:
        if text in self.widths:
            return text, None
        for name, components in self.components.items():  # "shoulder.pos" of the vectors in "observation.state"
            if text.startswith(f"{name}.") and text[len(name) + 1 :] in components:
                return name, [components.index(text[len(name) + 1 :])]
        if (match := _PART.fullmatch(text)) and (name := match[1].strip()) in self.widths:
            return name, _indices(match[2], self.widths[name], f"{self.where}, {what}, {shown(text)}")
        have = named([*self.widths, *(f"{n}.{c}" for n, all_ in self.components.items() for c in all_)], most=60)
        raise ValueError(f"{self.where}, {what}: no column {shown(text)}; it has: {have or 'none'}")


def width_of(shape: Sequence[int]) -> int:
    """Numbers in a row of an array of that shape, [T] or [T, W]; 0 for any other shape, which is no column."""
    return {1: 1, 2: shape[-1] if shape else 0}.get(len(shape), 0)


@contextlib.contextmanager
def readable(where: Path | str, what: str) -> Iterator[None]:
    """Turns every error of a library that reads a file into a ValueError that names the file.

    Args:
        where: the file, or a part of it; a ValueError that begins with it is raised unchanged.
        what: kind of the file, "HDF5 file".
    """
    try:
        yield
    except (KeyboardInterrupt, SystemExit, FileNotFoundError, PermissionError):
        raise
    except BaseException as error:  # damaged files raise many types; polars' panics are no Exception
        if isinstance(error, ValueError) and str(error).startswith(str(where)):
            raise
        why = said(error) or type(error).__name__
        raise ValueError(f"{where}: not a readable {what}, or a damaged one: {why}") from None


def _indices(text: str, width: int, where: str) -> list[int]:
    """ "0:3,5" as numbers below `width`."""
    out: list[int] = []
    for word in text.replace(" ", "").split(","):
        low, colon, high = word.partition(":")
        try:
            out += range(int(low or 0), int(high or width)) if colon else [int(low)]
        except ValueError:
            raise ValueError(f"{where}: expected numbers like [0:3] or [2,5]") from None
    if not out or max(out) >= width:
        raise ValueError(f"{where}: a row of it has {width} numbers, counted from 0")
    return out


def _example(columns: str | Sequence[str]) -> str:
    name = as_list(columns)[0]
    return f"{shown(f'{name}[0:3]')}" if _NUMBER not in name else "a list of names"


def _counts(parts: Sequence[np.ndarray]) -> str:
    return " and ".join(str(n) for n in sorted({len(part) for part in parts}))
