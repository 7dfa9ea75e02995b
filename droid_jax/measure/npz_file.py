"""A recording as one npz file."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from droid_jax.measure.metadata import FORMAT, metadata_from_json, metadata_to_json, recording_of
from droid_jax.measure.recording import Channel, Recording
from droid_jax.storage import write_npz


def save_npz(recording: Recording, path: Path) -> None:
    """Write a recording, which is taken to be valid."""
    arrays = {
        "format": np.array(FORMAT),
        "metadata": np.array(metadata_to_json(recording)),
        "time": recording.time,
        "command": recording.command,
    }
    for key, c in recording.channels.items():
        arrays |= {f"{key}.time": c.time, f"{key}.values": c.values, f"{key}.mask": c.mask}
    write_npz(path, arrays)


def load_npz(path: Path) -> Recording:
    """The recording in a file, not yet validated; ValueError where there is none or the file is damaged."""
    arrays = _npz_arrays(path)
    if str(arrays.get("format")) != FORMAT:
        raise ValueError(f"{path}: expected the key 'format' with {FORMAT!r}, got {arrays.get('format')}")

    def take(key: str) -> np.ndarray:
        if key not in arrays:
            raise ValueError(f"{path}: missing array {key!r}; the file has: {', '.join(sorted(arrays))}")
        return arrays[key]

    meta = metadata_from_json(str(take("metadata")), f"{path}, metadata")
    channels = {}
    for key, unit in meta.units.items():
        if not meta.columns[key]:
            raise ValueError(f"{path}, metadata, channel {key!r}: 'columns' is missing, the names of its columns")
        values = take(f"{key}.values")
        mask = arrays.get(f"{key}.mask", np.ones(values.shape, dtype=bool))
        channels[key] = Channel(key, unit, meta.columns[key], take(f"{key}.time"), values, mask)
    return recording_of(meta, path, take("time"), take("command"), meta.command_names, channels)


def _npz_arrays(path: Path) -> dict[str, np.ndarray]:
    """Every array of the file, read at once so that damage shows here."""
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: the file is empty")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not an npz file, or one that was cut off while it was written")
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise ValueError(f"{path}: damaged npz file: {error}") from None
        raise ValueError(
            f"{path}: holds pickled Python objects, which are not read; save plain numeric arrays"
        ) from None
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError) as error:
        raise ValueError(f"{path}: damaged npz file: {error}") from None
