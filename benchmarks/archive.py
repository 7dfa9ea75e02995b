"""Scored runs, one compressed file each: plans, sealed truths, results and oracles of all their cases.

    python benchmarks/archive.py list                     # what is there
    python benchmarks/archive.py unpack NAME [--out DIR]  # as the folder that experiments/ writes and scores
    python benchmarks/archive.py pack NAME --folder DIR   # the other way, with its line in manifest.json
    python benchmarks/archive.py check                    # every file against its SHA-256 in manifest.json

NAME.jsonl.xz holds one line of JSON a file: its `path` in the folder and its `text`, or `base64` where it is no text.
Files come back byte for byte.
"""

from __future__ import annotations

import base64
import json
import lzma
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

# ruff: noqa: E402
import tyro

from droid_jax.storage import file_sha256, write_bytes, write_json

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
    """Of the archive."""
    out: Path | None = None
    """Folder; default: runs/NAME."""
    place: Path = PLACE
    """Folder of the archives."""


@dataclass(frozen=True)
class Pack:
    """Make an archive of a folder's files, without locks."""

    name: Annotated[str, tyro.conf.Positional]
    """Of the archive."""
    folder: Path
    """Whose files are packed."""
    place: Path = PLACE
    """Folder of the archives."""


def pack(folder: Path, place: Path, name: str) -> Path:
    """Pack the files below a folder, in the order of their paths; FileNotFoundError where there are none."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.suffix not in LEFT_OUT]
    if not files:
        raise FileNotFoundError(f"{folder} holds no files to pack")
    lines = [json.dumps(_packed(path.relative_to(folder).as_posix(), path.read_bytes())) for path in files]
    data = lzma.compress("".join(f"{line}\n" for line in lines).encode(), preset=9 | lzma.PRESET_EXTREME)
    place.mkdir(parents=True, exist_ok=True)
    path = place / (name + ENDING)
    write_bytes(path, data)
    known = manifest(place) | {name: {"files": len(files), "bytes": len(data), "sha256": file_sha256(path)}}
    write_json(place / MANIFEST, dict(sorted(known.items())))
    return path


def unpack(name: str, folder: Path, place: Path = PLACE) -> int:
    """Write the files of an archive into a folder; how many.  ValueError where it is not of `pack`."""
    count = 0
    for path, content in contents(place / (name + ENDING)):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / path, content)
        count += 1
    return count


def contents(archive: Path) -> Iterator[tuple[PurePosixPath, bytes]]:
    """Path and content of every file in an archive; ValueError where it is not of `pack`."""
    total = 0
    try:
        with lzma.open(archive, "rt", encoding="utf-8") as lines:
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
        raise ValueError(f"{archive} is no archive of benchmarks/archive.py: {error}") from error


def manifest(place: Path) -> dict[str, dict[str, Any]]:
    """Archive's name -> its files, bytes and sha256."""
    path = place / MANIFEST
    return json.loads(path.read_text()) if path.is_file() else {}


def faults(place: Path) -> list[str]:
    """What is wrong with the archives of a folder, a sentence each."""
    known, found = manifest(place), {p.name.removesuffix(ENDING): p for p in sorted(place.glob(f"*{ENDING}"))}
    out = [f"{name}: in the manifest, not in the folder" for name in known if name not in found]
    for name, path in found.items():
        if name not in known:
            out.append(f"{name}: not in the manifest")
        elif file_sha256(path) != known[name]["sha256"]:
            out.append(f"{name}: not what was packed, by its SHA-256")
        elif sum(1 for _ in contents(path)) != known[name]["files"]:
            out.append(f"{name}: another number of files than the manifest says")
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
