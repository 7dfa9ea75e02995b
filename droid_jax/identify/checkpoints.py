"""Numbered checkpoints of a loop that may be killed: save every few steps, resume from the newest intact one.

They serve any loop whose state is a nested dictionary of numpy arrays.  A checkpoint is a folder, which orbax writes
under a temporary name and renames when it is complete.  It also holds a fingerprint of the loop's configuration and
data, and a digest of the arrays, the fingerprint and the step's number.  The digest detects damaged files that can
still be read, and renamed folders.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import math
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
import orbax.checkpoint as ocp

from droid_jax import distributed

MOST_BYTES = 2**30  # largest size of a checkpoint's arrays that is read; a search with 1024 samples writes 10 MB
Tree = dict[str, Any]  # nested dictionary whose leaves are numpy arrays, none of them empty

_WRITE_ERRORS = (ValueError, KeyError, TypeError, OSError, RuntimeError)  # of orbax and the store below it


class Checkpoints:
    """The checkpoints of one loop in one folder; use as a context manager, or close().

    folder: created if missing; it belongs to this loop alone.
    keep: number of the newest checkpoints that stay on disk.
    fingerprint: named texts that identify the loop (its configuration, its data); a checkpoint with other texts is
      refused.
    """

    def __init__(self, folder: str | Path, *, keep: int = 3, fingerprint: Mapping[str, str] | None = None):
        if keep < 1:
            raise ValueError(f"keep must be at least 1, got {keep}")
        self.folder = Path(folder).resolve()
        self.fingerprint = dict(fingerprint or {})
        self._manager = ocp.CheckpointManager(self.folder, options=_options(self.folder, keep))

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the folder; no save or restore afterwards."""
        self._manager.close()

    def steps(self) -> list[int]:
        """Return the steps that have a checkpoint on disk, oldest first; some may be damaged."""
        return sorted(self._manager.all_steps())

    def save(self, step: int, tree: Tree) -> None:
        """Write the state after `step` steps.

        Checkpoints of this step or a later one are removed first.  They are damaged ones that `restore` skipped, and
        would otherwise count as the newest.  In a run of several processes only the first one saves.

        Raises:
            OSError: the checkpoint cannot be written.
        """
        if not distributed.first():
            return
        for old in self.steps():
            if old >= step:
                self._manager.delete(old)
        meta = {"fingerprint": self.fingerprint, "digest": _digest(step, self.fingerprint, tree)}
        items = ocp.args.Composite(state=ocp.args.StandardSave(tree), meta=ocp.args.JsonSave(meta))
        try:
            with _quiet():
                self._manager.save(step, args=items, force=True)
        except _WRITE_ERRORS as error:
            raise _not_written(self.folder / str(step), error) from error

    def restore(self) -> tuple[int, Tree] | None:
        """Return (step, tree) of the newest intact checkpoint, or None if there is none.

        A warning names every damaged checkpoint that is skipped, and its fault.

        Raises:
            ValueError: the newest intact checkpoint has another fingerprint.
        """
        for step in reversed(self.steps()):
            try:
                found, tree = self._read(step)
            except Exception as error:  # orbax and the stores below it raise many types for damaged files
                warnings.warn(
                    f"checkpoint {self.folder / str(step)} is damaged and was passed over: {_first_line(error)}",
                    stacklevel=2,
                )
                continue
            self._check_fingerprint(step, found)
            return step, tree
        return None

    def _read(self, step: int) -> tuple[dict[str, str], Tree]:
        """Fingerprint and tree of one checkpoint; raises any exception for a damaged one."""
        self._check_size(step)
        items = ocp.args.Composite(state=ocp.args.StandardRestore(), meta=ocp.args.JsonRestore())
        read = self._manager.restore(step, args=items)
        fingerprint, digest = read["meta"]["fingerprint"], read["meta"]["digest"]
        if _digest(step, fingerprint, read["state"]) != digest:
            raise ValueError("its step or its content is not what was written")
        return fingerprint, read["state"]

    def _check_size(self, step: int) -> None:
        """Raise ValueError if a checkpoint declares more than MOST_BYTES: a damaged shape must not fill the memory."""
        folder = self.folder / str(step)
        described = (folder / "meta" / "metadata").stat().st_size
        arrays = jax.tree.leaves(ocp.StandardCheckpointHandler().metadata(cast(Any, folder / "state")).tree)
        declared = described + sum(math.prod(a.shape) * np.dtype(a.dtype).itemsize for a in arrays)
        if declared > MOST_BYTES:
            raise ValueError(f"it declares {declared / 2**20:.0f} MiB, at most {MOST_BYTES >> 20} MiB are read")

    def _check_fingerprint(self, step: int, found: dict[str, str]) -> None:
        """Raise ValueError with the names of the texts in which a checkpoint differs from this loop."""
        keys = sorted(set(found) | set(self.fingerprint))
        different = [k for k in keys if found.get(k) != self.fingerprint.get(k)]
        if different:
            raise ValueError(
                f"checkpoint {self.folder / str(step)} belongs to another run: it differs in "
                f"{', '.join(different)}; use another folder, or remove this one to start over"
            )


def _options(folder: Path, keep: int) -> ocp.CheckpointManagerOptions:
    """orbax's options, with which the processes of a run do not wait for each other."""
    options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False)
    if distributed.count() == 1:
        return options
    folder.mkdir(parents=True, exist_ok=True)
    index = distributed.index()
    independent = ocp.options.MultiprocessingOptions(
        primary_host=index, active_processes={index}, barrier_sync_key_prefix=f"process_{index}"
    )
    return replace(options, create=False, multiprocessing_options=independent)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress orbax's warning of a killed run's incomplete checkpoints, which it removes."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _digest(step: int, fingerprint: Mapping[str, str], tree: Tree) -> str:
    """sha256 over the step, the fingerprint and every array's path, type, shape and bytes."""
    sha = hashlib.sha256(json.dumps([int(step), dict(fingerprint)], sort_keys=True).encode())
    for path, leaf in _leaves(tree):
        array = np.ascontiguousarray(leaf)
        sha.update(f"{path} {array.dtype.str} {np.shape(leaf)}".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """(path, array) of every leaf, in the order of the names."""
    if not isinstance(tree, Mapping):
        yield path, tree
        return
    for name in sorted(tree):
        yield from _leaves(tree[name], f"{path}/{name}")


def _not_written(path: Path, error: BaseException) -> OSError:
    """An OSError that names the checkpoint; its errno is found in the text of the store's error, which has none."""
    number = error.errno if isinstance(error, OSError) else None
    if number is None:
        known = {os.strerror(code).lower(): code for code in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)}
        number = next((code for text, code in known.items() if text in str(error).lower()), errno.EIO)
    reason = os.strerror(number) if number != errno.EIO else _first_line(error)
    return OSError(number, f"the checkpoint cannot be written: {reason}", str(path))


def _first_line(error: BaseException) -> str:
    """Type and first line of an error, for a message of one line."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:300]}"
