"""Scored runs, compressed: plans, sealed truths, results and oracles of all their cases.

    python benchmarks/archive.py list                     # what is there
    python benchmarks/archive.py unpack NAME [--out DIR]  # as the folder that experiments/ writes and scores
    python benchmarks/archive.py pack NAME --folder DIR   # make an archive, and its entry in manifest.json
    python benchmarks/archive.py check                    # every archive against its SHA-256 in manifest.json

An archive is an xz stream with one line of JSON per file: its `path` in the folder and its `text`, or `base64` if it is
not text.  Files are restored byte for byte.  KIND.jsonl.xz holds the streams of all runs named KIND_COMMIT, one after
the other; manifest.json holds the start and SHA-256 of each.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import lzma
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

# ruff: noqa: E402
import tyro

from droid_jax.storage import write_bytes, write_json

PLACE = ROOT / "benchmarks" / "results" / "archive"
ENDING, MANIFEST = ".jsonl.xz", "manifest.json"
LEFT_OUT = (".lock", ".tmp")
MOST_BYTES = 2**30  # of one archive's files together: more is none of ours


@dataclass(frozen=True)
class List:
    """Name, files and bytes of every archive."""

    place: Path = PLACE
    """Folder of the archives."""


@dataclass(frozen=True)
class Check:
    """Compare every archive with the manifest, and see that it unpacks."""

    place: Path = PLACE
    """Folder of the archives."""


@dataclass(frozen=True)
class Unpack:
    """Write the files of an archive."""

    name: Annotated[str, tyro.conf.Positional]
    """Name of the archive."""
    out: Path | None = None
    """Folder; default: runs/NAME."""
    place: Path = PLACE
    """Folder of the archives."""


@dataclass(frozen=True)
class Pack:
    """Make an archive of a folder's files, without locks."""

    name: Annotated[str, tyro.conf.Positional]
    """Name of the archive."""
    folder: Path
    """Folder whose files are packed."""
    place: Path = PLACE
    """Folder of the archives."""


def pack(folder: Path, place: Path, name: str) -> Path:
    """Pack the files below a folder, in the order of their paths; FileNotFoundError where there are none."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.suffix not in LEFT_OUT]
    if not files:
        raise FileNotFoundError(f"{folder} holds no files to pack")
    lines = [json.dumps(_packed(path.relative_to(folder).as_posix(), path.read_bytes())) for path in files]
    data = lzma.compress("".join(f"{line}\n" for line in lines).encode(), preset=9 | lzma.PRESET_EXTREME)
    file, known = file_of(name), manifest(place)
    together = {other: stream(place, entry) for other, entry in known.items() if entry["file"] == file} | {name: data}
    place.mkdir(parents=True, exist_ok=True)
    write_bytes(place / file, b"".join(together[key] for key in sorted(together)))
    known[name] = {"file": file, "files": len(files), "sha256": hashlib.sha256(data).hexdigest()}
    start = 0
    for key in sorted(together):
        known[key] |= {"start": start, "bytes": len(together[key])}
        start += len(together[key])
    write_json(place / MANIFEST, dict(sorted(known.items())))
    return place / file


def file_of(name: str) -> str:
    """The file of an archive: that of its kind where its name ends with a commit, else one of its own."""
    return re.sub(r"_[0-9a-f]{7}$", "", name) + ENDING


def stream(place: Path, entry: dict[str, Any]) -> bytes:
    """The compressed bytes of an archive, at the place that the manifest states."""
    with (place / entry["file"]).open("rb") as file:
        file.seek(entry["start"])
        return file.read(entry["bytes"])


def unpack(name: str, folder: Path, place: Path = PLACE) -> int:
    """Write the files of an archive into a folder; returns their number.  ValueError where `pack` did not write it."""
    count = 0
    for path, content in contents(stream(place, manifest(place)[name]), name):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / path, content)
        count += 1
    return count


def contents(data: bytes, name: str) -> Iterator[tuple[PurePosixPath, bytes]]:
    """Path and content of every file in an archive's bytes; ValueError where `pack` did not write it."""
    total = 0
    try:
        with lzma.open(io.BytesIO(data), "rt", encoding="utf-8") as lines:
            for line in lines:
                entry = json.loads(line)
                path, text = PurePosixPath(entry["path"]), entry.get("text")
                if path.is_absolute() or ".." in path.parts:
                    raise ValueError(f"the path {path} leads out of the folder")
                content = text.encode() if text is not None else base64.b64decode(entry["base64"], validate=True)
                total += len(content)
                if total > MOST_BYTES:
                    raise ValueError(f"more than {MOST_BYTES >> 20} MiB")
                yield path, content
    except (lzma.LZMAError, EOFError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{name} is no archive of benchmarks/archive.py: {error}") from error


def manifest(place: Path) -> dict[str, dict[str, Any]]:
    """Archive's name -> its file, start and bytes in there, how many files it holds, and its sha256."""
    path = place / MANIFEST
    return json.loads(path.read_text()) if path.is_file() else {}


def faults(place: Path) -> list[str]:
    """Faults of the archives in a folder, one sentence each."""
    known, out = manifest(place), []
    files = sorted({entry["file"] for entry in known.values()} | {p.name for p in place.glob(f"*{ENDING}")})
    for file in files:
        within = sorted((entry["start"], name) for name, entry in known.items() if entry["file"] == file)
        if not (place / file).is_file():
            out.append(f"{file}: in the manifest, not in the folder")
            continue
        end = 0
        for start, name in within:
            data = stream(place, known[name])
            if start != end or hashlib.sha256(data).hexdigest() != known[name]["sha256"]:
                out.append(f"{name}: not what was packed, by its place or its SHA-256")
            elif sum(1 for _ in contents(data, name)) != known[name]["files"]:
                out.append(f"{name}: another number of files than the manifest says")
            end = start + known[name]["bytes"]
        if (place / file).stat().st_size != end:
            out.append(f"{file}: holds bytes that are not in the manifest")
    return out


def _packed(path: str, content: bytes) -> dict[str, str]:
    try:
        return {"path": path, "text": content.decode("utf-8")}
    except UnicodeDecodeError:
        return {"path": path, "base64": base64.b64encode(content).decode()}


def main(command: List | Check | Unpack | Pack) -> None:
    """Print one line of JSON."""
    match command:
        case List(place):
            result: dict[str, Any] = manifest(place)
        case Check(place):
            wrong = faults(place)
            result = {"archives": len(manifest(place)), "faults": wrong}
            if wrong:
                sys.exit("error: " + "; ".join(wrong))
        case Unpack(name, out, place):
            folder = out or ROOT / "runs" / name
            if name not in manifest(place):
                sys.exit(f"error: no archive {name!r} in {place}; there are {', '.join(manifest(place)) or 'none'}")
            result = {"folder": str(folder), "files": unpack(name, folder, place)}
        case Pack(name, folder, place):
            result = {"archive": str(pack(folder, place, name)), **manifest(place)[name]}
    print(json.dumps(result))


if __name__ == "__main__":
    main(tyro.cli(List | Check | Unpack | Pack, description=__doc__))
