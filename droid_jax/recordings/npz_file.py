"""A recording as one npz file."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from droid_jax.arguments import shown
from droid_jax.read_npz import NpzFile
from droid_jax.recordings.metadata import FORMAT, metadata_from_json, metadata_to_json, recording_of
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.storage import write_npz

KIND = "droid_jax recording"  # begins FORMAT in every version


def save_npz(recording: Recording, path: Path) -> None:
    """Write a valid recording."""
    arrays = {
        "format": np.array(FORMAT),
        "metadata": np.array(metadata_to_json(recording)),
        "time": recording.time,
        "command": recording.command,
    }
    for key, c in recording.channels.items():
        arrays |= {f"{key}.time": c.time, f"{key}.values": c.values, f"{key}.mask": c.mask}
    write_npz(path, arrays)


def is_npz(path: Path) -> bool:
    """Whether a file is a recording of this program, possibly a damaged one; reads a few kB at most."""
    try:
        with path.open("rb") as file:
            head = file.read(40)
        if not zipfile.is_zipfile(path):  # cut off: only the first member's name identifies it
            return head.startswith(b"PK\x03\x04") and head.endswith(b"format.npy")
        with zipfile.ZipFile(path) as members, members.open("format.npy") as member:
            return KIND.encode("utf-32-le") in member.read(4096)  # numpy's text
    except (OSError, ValueError, KeyError, RuntimeError, NotImplementedError, EOFError, zlib.error, zipfile.BadZipFile):
        return False


def load_npz(path: Path) -> Recording:
    """The recording in a file, not yet validated; ValueError where there is none or the file is damaged."""
    with NpzFile(path) as file:
        if "format" not in file or (found := file.text("format")) != FORMAT:
            got = found if "format" in file else None
            raise ValueError(f"{path}: expected the key 'format' with {FORMAT!r}, got {shown(got)}")
        meta = metadata_from_json(file.text("metadata"), f"{path}, metadata")
        channels = {}
        for key, unit in meta.units.items():
            if not meta.columns[key]:
                raise ValueError(f"{path}, metadata, channel {key!r}: 'columns' is missing, the names of its columns")
            values = file.array(f"{key}.values")
            masked = f"{key}.mask" in file
            mask = file.array(f"{key}.mask", "b") if masked else np.ones(values.shape, dtype=bool)
            channels[key] = Channel(key, unit, meta.columns[key], file.array(f"{key}.time"), values, mask)
        return recording_of(meta, path, file.array("time"), file.array("command"), meta.command_names, channels)
