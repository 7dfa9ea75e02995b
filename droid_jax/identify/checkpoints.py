"""Numbered checkpoints of a loop that may be killed: save every few steps, resume from the newest good one.

Any loop whose state is a nested dictionary of numpy arrays can use them.  A checkpoint is a folder,
written by orbax under a temporary name and renamed when complete.  Beside the arrays it holds a
fingerprint, what the state belongs to, and a digest over both and the number of the step, because a
damaged file is not always one that cannot be read, and a folder can be renamed.
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

MOST_BYTES = 2**30  # of a checkpoint's arrays, which are read whole; a search with 1024 samples writes 10 MB
Tree = dict[str, Any]  # nested dictionary whose leaves are numpy arrays, none of them empty

# what orbax and the store below it raise where a checkpoint cannot be written
_DAMAGE = (ValueError, KeyError, TypeError, OSError, RuntimeError)


class Checkpoints:
    """The checkpoints of one loop in one folder; use as a context manager, or close().

    folder:      created when missing; belongs to this loop alone.
    keep:        how many of the newest checkpoints stay on disk.
    fingerprint: named texts that say what the loop's state belongs to (its configuration, its data);
                 a checkpoint with other texts is refused.
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
        """Steps that have a checkpoint on disk, oldest first; some may turn out to be damaged."""
        return sorted(self._manager.all_steps())

    def save(self, step: int, tree: Tree) -> None:
        """Write the state after `step` steps.

        Checkpoints of this step or a later one are removed first: they are damaged ones that a
        resumed loop has passed over, and would otherwise count as the newest.  In a run of several processes the
        first one saves.
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
        except _DAMAGE as error:
            raise _not_written(self.folder / str(step), error) from error

    def restore(self) -> tuple[int, Tree] | None:
        """(step, tree) of the newest checkpoint that is whole; None when there is none.

        Warns about every damaged checkpoint it passes over, with its path and what is wrong.
        Raises ValueError when the newest whole checkpoint has another fingerprint.
        """
        for step in reversed(self.steps()):
            try:
                found, tree = self._read(step)
            except Exception as error:  # orbax and the stores below it raise many kinds on changed bytes
                warnings.warn(
                    f"checkpoint {self.folder / str(step)} is damaged and was passed over: {_first_line(error)}",
                    stacklevel=2,
                )
                continue
            self._check_fingerprint(step, found)
            return step, tree
        return None

    def _read(self, step: int) -> tuple[dict[str, str], Tree]:
        """Fingerprint and tree of one checkpoint; raises anything when it is not as written."""
        self._check_size(step)
        items = ocp.args.Composite(state=ocp.args.StandardRestore(), meta=ocp.args.JsonRestore())
        read = self._manager.restore(step, args=items)
        fingerprint, digest = read["meta"]["fingerprint"], read["meta"]["digest"]
        if _digest(step, fingerprint, read["state"]) != digest:
            raise ValueError("its step or its content is not what was written")
        return fingerprint, read["state"]

    def _check_size(self, step: int) -> None:
        """ValueError where a checkpoint declares more than is read: a damaged shape must not fill the memory."""
        folder = self.folder / str(step)
        described = (folder / "meta" / "metadata").stat().st_size
        arrays = jax.tree.leaves(ocp.StandardCheckpointHandler().metadata(cast(Any, folder / "state")).tree)
        declared = described + sum(math.prod(a.shape) * np.dtype(a.dtype).itemsize for a in arrays)
        if declared > MOST_BYTES:
            raise ValueError(f"it declares {declared / 2**20:.0f} MiB, at most {MOST_BYTES >> 20} MiB are read")

    def _check_fingerprint(self, step: int, found: dict[str, str]) -> None:
        """ValueError that names the texts in which a checkpoint differs from this loop."""
        keys = sorted(set(found) | set(self.fingerprint))
        other = [k for k in keys if found.get(k) != self.fingerprint.get(k)]
        if other:
            raise ValueError(
                f"checkpoint {self.folder / str(step)} belongs to another run: it differs in "
                f"{', '.join(other)}; use another folder, or remove this one to start over"
            )


def _options(folder: Path, keep: int) -> ocp.CheckpointManagerOptions:
    """orbax's options, under which each process of a run has its folder to itself."""
    options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False)
    if distributed.count() == 1:
        return options
    folder.mkdir(parents=True, exist_ok=True)
    me = distributed.index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process_{me}"
    )
    return replace(options, create=False, multiprocessing_options=alone)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without orbax's warning of what a killed run has left half written, which it removes."""
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
    """The file system's error behind one of the store's, which says it in a text of its own; names the checkpoint."""
    number = error.errno if isinstance(error, OSError) else None
    if number is None:
        known = {os.strerror(code).lower(): code for code in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)}
        number = next((code for text, code in known.items() if text in str(error).lower()), errno.EIO)
    told = os.strerror(number) if number != errno.EIO else _first_line(error)
    return OSError(number, f"the checkpoint cannot be written: {told}", str(path))


def _first_line(error: BaseException) -> str:
    """Kind and first line of an error, for a message of one line."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:300]}"
