"""What a kind of file is to the fuzz tests, and one attempt to have a damaged one read."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from mutate_json import mutate_json
from mutate_npz import mutate_npz
from mutate_text import mutate_bytes, mutate_csv
from mutate_xml import mutate_xml
from outcome import MOST_SECONDS, Outcome, judged

ROOT = Path(__file__).resolve().parents[2]
STRUCTURE = 0.75  # share of mutations that know the format
Mutate = Callable[[Random, bytes], bytes]
FORMATS: Mapping[str, Mutate] = {".json": mutate_json, ".csv": mutate_csv, ".npz": mutate_npz, ".xml": mutate_xml}


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    file: relative to the folder that `make` fills with a valid example; of several ("*" in it) one is changed.
    read: of that folder; reads and uses it as the commands do: what is accepted must be of use.
    weight: how often it is tried beside the others.  drawn: it draws a whole page, which takes seconds.
    """

    name: str
    file: str
    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    weight: float = 1.0
    drawn: bool = False


def use(*values: Any) -> None:
    """What was computed to see that it can be."""


def mutated(kind: Kind, valid: Path, random: Random) -> tuple[str, bytes]:
    """The file that is changed, relative to the folder, and its new content."""
    name = random.choice(sorted(p.relative_to(valid).as_posix() for p in valid.glob(kind.file) if p.is_file()))
    content = (valid / name).read_bytes()
    mutate = FORMATS.get(Path(name).suffix, mutate_bytes) if random.random() < STRUCTURE else mutate_bytes
    try:
        return name, mutate(random, content)
    except Exception:  # what an earlier change left is not of the format any more: bytes then
        return name, mutate_bytes(random, content)


def attempt(kind: Kind, valid: Path, place: Path, random: Random, most: float = MOST_SECONDS) -> Outcome:
    """Reads one mutation of a kind's valid folder, in a copy at `place`; most: s beyond which it hangs."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(valid, place)
    name, content = mutated(kind, valid, random)
    (place / name).write_bytes(content)
    return judged(lambda: kind.read(place), (Path(name).name, str(place)), hide=str(place), most=most)


def attempt_valid(kind: Kind, valid: Path, place: Path) -> Outcome:
    """Reads the valid example, which must be accepted."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(valid, place)
    return judged(lambda: kind.read(place), (str(place),), hide=str(place))
