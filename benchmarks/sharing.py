"""Work that can be stopped and that several processes share: what one of them made, or makes, no other makes too."""

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
    """The JSON that lies at `path`, made first where there is none; another process that is making it is waited for."""
    if not path.is_file():
        with claimed(path, wait=True):
            if not path.is_file():  # which another process may have made meanwhile
                write_json(path, make(), indent=2)
    return json.loads(path.read_text())


def code_name(commit: str | None) -> str:
    """A name for what code of a commit leaves half done; of uncommitted code one that no later start has."""
    return commit if commit and not commit.endswith(UNCOMMITTED) else f"{commit}_{time.time_ns()}_{os.getpid()}"


@contextlib.contextmanager
def claimed(path: Path, *, wait: bool) -> Iterator[bool]:
    """Whether this process alone may make what lies at `path`, until the end of the block.

    wait: for a process that is making it, instead of False at once.  The claim is a lock on `path`.lock, which ends
    with the process however it ends.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f"{path.name}.lock").open("w") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True
