"""Results that several processes share: each is made by one process only, also after a stop."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from droid_jax.storage import write_json

UNCOMMITTED = "-dirty"  # what `runtime.versions` puts behind a commit that is not all of the code


def kept(path: Path, make: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """The JSON at `path`, made first where it does not exist; waits for another process that is making it."""
    if not path.is_file():
        with claimed(path, wait=True):
            if not path.is_file():  # which another process may have made meanwhile
                write_json(path, make(), indent=2)
    return json.loads(path.read_text())


def code_name(commit: str | None) -> str:
    """Name for unfinished work of a commit's code; uncommitted code gets a name that no later start has."""
    return commit if commit and not commit.endswith(UNCOMMITTED) else f"{commit}_{time.time_ns()}_{os.getpid()}"


@contextlib.contextmanager
def claimed(path: Path, *, wait: bool) -> Iterator[bool]:
    """Whether this process alone may make the file at `path`, until the end of the block.

    wait: wait for a process that is making it, instead of returning False.  The claim is a lock on `path`.lock, which
    is released when the process ends, however it ends.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f"{path.name}.lock").open("w") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True
