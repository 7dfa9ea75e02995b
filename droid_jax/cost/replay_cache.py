"""A disk cache of a function of parameter vectors."""

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
    """Return `compute` with a cache on disk.

    A damaged file is computed again, with a warning.

    Args:
        compute: [P, D] -> [P, ...], deterministic.
        folder: of the cache; it belongs to this function's recording alone.
        what: begins the names of the files.
    """

    def lookup(values: Any) -> np.ndarray:
        rows = np.asarray(values, np.float32)  # the precision of a replay; the last digits of a double may vary
        path = folder / f"{what}_{hashlib.sha256(rows.tobytes()).hexdigest()[:32]}.npz"
        try:
            content = read_npz(path, ("rows", "digest"))
            out, digest = content["rows"], str(content["digest"])
            if digest != _digest(folder.name, what, rows, out):
                raise ValueError("its content is not what was written")
            return out
        except FileNotFoundError:
            pass
        except (ValueError, OSError) as error:
            warnings.warn(f"{path} is damaged and is computed again: {error}", stacklevel=3)
        out = compute(values)
        write_npz(path, {"rows": out, "digest": np.array(_digest(folder.name, what, rows, out))})
        return out

    return lookup


def _digest(role: str, what: str, rows: np.ndarray, out: np.ndarray) -> str:
    """sha256 of the recording's folder name, the kind of result, the rows and the result."""
    sha = hashlib.sha256(f"{role} {what} {rows.shape}".encode())
    sha.update(np.ascontiguousarray(rows).tobytes())
    sha.update(f"{out.dtype.str} {out.shape}".encode())
    sha.update(np.ascontiguousarray(out).tobytes())
    return sha.hexdigest()
