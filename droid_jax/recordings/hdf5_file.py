"""Reads HDF5 files, such as robomimic's and DROID's, as columns, with h5py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from droid_jax.arguments import shown
from droid_jax.errors import named
from droid_jax.read_npz import COMPRESSED, FREE_BYTES
from droid_jax.recordings.log_columns import LogColumns, readable, width_of

MOST_DATASETS = 20_000


def open_hdf5(path: Path, group: str | None = None) -> LogColumns:
    """The datasets of an HDF5 file by their path, "observation/robot_state/joint_positions".

    Args:
        path: of the file.
        group: read only the datasets of this group ("data/demo_0"); their names are then relative to it.

    Raises:
        ValueError: the file is not HDF5, or has no such group.
    """
    inside = f"{path}, group {shown(group)}" if group else str(path)
    with readable(path, "HDF5 file"), h5py.File(path, "r") as file:
        top = _group(file, group, path)
        shapes: dict[str, tuple[int, ...]] = {}

        def visit(name: str, item: Any) -> None:  # links to other files are not followed
            if isinstance(item, h5py.Dataset) and len(shapes) < MOST_DATASETS:
                shapes[name] = item.shape if item.dtype.kind in "biuf" and item.shape else ()

        top.visititems(visit)
        rate = _control_rate(file)

    def read(name: str) -> np.ndarray:
        with readable(path, "HDF5 file"), h5py.File(path, "r") as file:
            dataset = _group(file, group, path)[name]
            size, most = dataset.size * dataset.dtype.itemsize, max(FREE_BYTES, COMPRESSED * path.stat().st_size)
            if size > most:
                raise ValueError(
                    f"{inside}: {shown(name)} declares {size >> 20} MiB, at most {most >> 20} are read from such a file"
                )
            return dataset[()]

    widths = {name: width_of(shape) for name, shape in shapes.items()}
    return LogColumns(inside, widths, read, rate=rate)


def demonstrations(path: Path) -> list[str]:
    """Names of the groups that hold one demonstration each, as robomimic's data/demo_0; none in other files."""
    with readable(path, "HDF5 file"), h5py.File(path, "r") as file:
        data: Any = file.get("data", ())
        if not isinstance(data, h5py.Group):
            return []
        names = [str(name) for name in data if str(name).startswith("demo_")]
        return [f"data/{name}" for name in sorted(names, key=lambda name: (len(name), name))]


def _group(file: h5py.File, group: str | None, path: Path) -> Any:
    if group is None:
        return file
    found = file.get(group)
    if not isinstance(found, h5py.Group):
        raise ValueError(f"{path}: no group {shown(group)}; it has: {named(file)}")
    return found


def _control_rate(file: h5py.File) -> float | None:
    """Hz of robomimic's rows: the control rate in the JSON text that describes the environment."""
    data = file.get("data")
    text = data.attrs.get("env_args") if isinstance(data, h5py.Group) else None
    try:
        return float(json.loads(text)["env_kwargs"]["control_freq"])  # type: ignore[arg-type]
    except (TypeError, ValueError, KeyError, RecursionError):
        return None
