"""Files of a run's folder, read with messages that name the file and the command that writes it again."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from msgspec import Struct

from droid_jax.arguments import LONGEST_NAME
from droid_jax.read_json import read_json, typed
from droid_jax.read_npz import NUMBERS, TEXT, NpzFile

Content = TypeVar("Content")


class Fault(ValueError):
    """What is wrong with a run's file, and what to do about it."""


@dataclass(frozen=True)
class Reader:
    """Reads what one command wrote; every fault is a ValueError that names the file.

    command: "identify", "gap", "train" or "evaluate", to run again where something is missing or broken.
    option: a further option that the command then needs ("--again").
    """

    command: str
    option: str = ""

    def fault(self, what: str) -> Fault:
        """The error for a fault, with what to do about it."""
        how = f" with the same options and {self.option}" if self.option else ""
        return Fault(
            f"{what}; run `python -m droid_jax.run {self.command}` again{how}, or pass the folder that it wrote"
        )

    def json(self, path: Path, kind: type[Content] = dict[str, Any]) -> Content:
        """A JSON file as a msgspec.Struct or other type; keys that a Struct does not name are ignored."""
        try:
            value = read_json(path)
        except FileNotFoundError:
            raise self.fault(f"{path} is missing") from None
        except (OSError, ValueError) as error:
            raise self.fault(f"{path} cannot be read ({_reason(path, error)})") from None
        return self.typed(value, kind, str(path))

    def typed(self, value: Any, kind: type[Content], where: str) -> Content:
        """A parsed JSON value as a type; fault at the first place where it has another type."""
        try:
            return typed(value, kind, where)
        except ValueError as error:
            raise self.fault(str(error)) from None

    def arrays(
        self, path: Path, keys: Iterable[str], optional: Iterable[str] = (), texts: Iterable[str] = ()
    ) -> dict[str, np.ndarray]:
        """Arrays of an npz file that must be there, and of those that may be; numbers, and of `texts` text."""
        texts = frozenset(texts)
        try:
            with NpzFile(path) as file:
                self.need(file, keys := tuple(keys), path.name)
                wanted = (*keys, *(key for key in optional if key in file))
                found = {key: file.array(key, TEXT if key in texts else NUMBERS) for key in wanted}
        except FileNotFoundError:
            raise self.fault(f"{path} is missing") from None
        except Fault:
            raise
        except (OSError, ValueError) as error:
            raise self.fault(f"{path} cannot be read ({_reason(path, error)})") from None
        for key in texts & found.keys():  # names, which figures hold; a text without axes is JSON
            if found[key].ndim and (longest := max(map(len, found[key].flat), default=0)) > LONGEST_NAME:
                raise self.fault(f"{path}, {key} holds a name of {longest} characters, at most {LONGEST_NAME} are read")
        return found

    def shaped(self, array: np.ndarray, shape: tuple[int | None, ...], where: str, finite: bool = True) -> None:
        """Fault where an array has another shape (None: any length) or, unless it may, holds NaN or infinities."""
        fits = len(array.shape) == len(shape) and all(w in (None, n) for w, n in zip(shape, array.shape, strict=True))
        if not fits:
            wanted = ", ".join("any" if n is None else str(n) for n in shape)
            raise self.fault(f"{where} must have shape [{wanted}], got {list(array.shape)}")
        if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
            raise self.fault(f"{where} holds NaN or infinite values")

    def need(self, table: Container[str], keys: Iterable[str], where: str) -> None:
        """Fault where a key is absent."""
        absent = [k for k in keys if k not in table]
        if absent:
            raise self.fault(f"{where} lacks {', '.join(map(repr, absent))}")


def _reason(path: Path, error: Exception) -> str:
    """The message of an error without the path in front."""
    return str(error).removeprefix(f"{path}: ")


def read_replay(path: Path, read: Reader) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [K] s of a replay.npz, and the states [K, nq] before and after the fit."""
    replay = read.arrays(path, ("time", "before", "after"))
    time, before, after = replay["time"], replay["before"], replay["after"]
    read.shaped(time, (None,), f"{path}, time")
    read.shaped(before, (len(time), None), f"{path}, before", finite=False)  # one that blew up is not drawn
    read.shaped(after, before.shape, f"{path}, after", finite=False)
    if not len(time):
        raise read.fault(f"{path} is empty")
    return time, before, after


def read_measured(path: Path, read: Reader) -> tuple[str, float, np.ndarray, list[str]]:
    """From a replay.npz: the recording's name, time of the first command [s], measured positions [K, nq] and their
    joints.

    There are no joints where no position was measured, or where an older version wrote the file.
    """
    names = ("recording", "start", "measured", "measured_joints")
    found = read.arrays(path, ("time", "after"), names, texts=("recording", "measured_joints"))
    if not all(name in found for name in names):
        return str(found.get("recording", "")), 0.0, found["after"], []
    read.shaped(found["measured"], found["after"].shape, f"{path}, measured")
    read.shaped(found["start"], (), f"{path}, start")
    read.shaped(found["measured_joints"], (None,), f"{path}, measured_joints")
    return str(found["recording"]), float(found["start"]), found["measured"], found["measured_joints"].tolist()


class FindingEntry(Struct, frozen=True):
    """A finding of the checks of a recording (`preflight.findings`)."""

    kind: str
    column: str
    severity: str
    sentence: str


class PhaseEntry(Struct, frozen=True):
    """A part of the motion, s."""

    name: str
    start: float
    end: float
