"""A function of parameter vectors that remembers its results on disk."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.read_npz import read_npz
from droid_jax.storage import write_npz

Batched = Callable[[Any], np.ndarray]


def cached(compute: Batched, folder: Path, what: str) -> Batched:
    """`compute`, which looks in a folder before it replays.

    Args:
        compute: [P, D] -> [P, ...], the same for the same rows.
        folder: belongs to this function's recording alone.
        what: begins the names of the files.
    """

    def remembered(values: Any) -> np.ndarray:
        rows = np.asarray(values, np.float32)  # what a replay is given; the last digits of a double may vary
        path = folder / f"{what}_{hashlib.sha256(rows.tobytes()).hexdigest()[:32]}.npz"
        try:
            found = read_npz(path, ("rows", "digest"))
            kept, digest = found["rows"], str(found["digest"])
            if digest != _digest(folder.name, what, rows, kept):
                raise ValueError("its content is not what was written")
            return kept
        except FileNotFoundError:
            pass
        except (ValueError, OSError) as error:
            warnings.warn(f"{path} is damaged and is computed again: {error}", stacklevel=3)
        out = compute(values)
        write_npz(path, {"rows": out, "digest": np.array(_digest(folder.name, what, rows, out))})
        return out

    return remembered


def _digest(role: str, what: str, rows: np.ndarray, out: np.ndarray) -> str:
    """sha256 over what was asked for, of which recording, and what came of it."""
    sha = hashlib.sha256(f"{role} {what} {rows.shape}".encode())
    sha.update(np.ascontiguousarray(rows).tobytes())
    sha.update(f"{out.dtype.str} {out.shape}".encode())
    sha.update(np.ascontiguousarray(out).tobytes())
    return sha.hexdigest()
