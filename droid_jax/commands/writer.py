"""Lock of a results folder: one process writes at a time, and files of other programs are never replaced.

The lock is the operating system's, so a killed process releases it.  The lock file exists while a run writes.
`report`, `view` and other readers need no lock.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from droid_jax import console
from droid_jax.files import ASKED, CONFIG, FIT, GAP, LOCK, SETUP, SYNTHETIC_ROBOT, SYNTHETIC_SOURCE, TRAINING, WRITTEN
from droid_jax.read_json import read_json
from droid_jax.storage import kind_of

_HELD = set[Path]()  # folders whose lock this process holds
T = TypeVar("T")


class InUse(ValueError):
    """Another run writes to the folder."""


def writes(
    stage: str | None, folder: Callable[[Any], Path] = lambda command: command.out, make: bool = True
) -> Callable[..., Any]:
    """Decorator of a command's `run` that makes it the only writer of its results folder.

    Args:
        stage: "identify", "gap", "train" or "all": files with the names of this stage must be this program's. None: the
            command checks this itself.
        folder: function from the command to its folder; default: its --out.
        make: whether to make a missing folder.
    """

    def of(run: Callable[[T], None]) -> Callable[[T], None]:
        @functools.wraps(run)
        def alone(command: T) -> None:
            at = folder(command)
            with one_writer(at, stage) if make or at.is_dir() else contextlib.nullcontext():
                run(command)

        return alone

    return of


@contextlib.contextmanager
def one_writer(folder: Path, stage: str | None) -> Iterator[None]:
    """Lock a results folder while the block runs; new folders that stay empty are removed.

    Raises:
        InUse: another process writes there, or to the folder of `all` above it.
        ValueError: the folder cannot be written, or holds files of others under names that the stage writes.
    """
    if stage is not None:
        check_own(folder, stage)
    try:
        made = _make(folder)
    except OSError as error:
        raise ValueError(f"the results folder {folder} cannot be written: {error.strerror or error}") from None

    def remove_empty() -> None:
        for path in made:
            with contextlib.suppress(OSError):
                path.rmdir()

    try:
        with console.at_the_end(remove_empty), _locked(folder):
            yield
    finally:
        remove_empty()


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    from filelock import FileLock, Timeout  # only here: `--help` waits for what is imported above

    here = folder.resolve()
    if here in _HELD:
        yield
        return
    if here.parent not in _HELD and _is_locked(here.parent / LOCK):
        raise InUse(_in_use(here.parent))
    lock = FileLock(here / LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise InUse(_in_use(folder)) from None
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"the results folder {folder} cannot be written: {reason}") from None

    def leave() -> None:
        # Removed while the lock is held: a process that has opened the file meanwhile notices, and makes another.
        (here / LOCK).unlink(missing_ok=True)

    _HELD.add(here)
    try:
        with console.at_the_end(leave):
            (here / LOCK).write_text(f"{os.getpid()}\n")
            yield
    finally:
        _HELD.discard(here)
        leave()
        lock.release()


def _in_use(folder: Path) -> str:
    """Message about the process that writes to a folder."""
    try:
        process = f" (process {int((folder / LOCK).read_text())})"
    except (OSError, ValueError):
        process = ""
    return f"another run writes to {folder}{process}: wait until it ends, or choose another --out"


def _is_locked(path: Path) -> bool:
    """Whether another process holds the lock of a file."""
    from filelock import FileLock, Timeout

    if not path.is_file():
        return False
    try:
        with FileLock(path, timeout=0):
            return False
    except Timeout:
        return True
    except (OSError, NotImplementedError):  # a file of another owner: not this program's lock
        return False


def _make(folder: Path) -> list[Path]:
    """Make a folder; returns the folders that were missing, the deepest first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing


# Keys that identify files of this program.
_SIGNS = {
    SETUP: ("preset", "seed"),
    ASKED: ("preset", "seed", "effect_scale", "files"),
    CONFIG: ("preset", "recordings", "synthetic_robot"),
    FIT: ("parameters",),
    GAP: ("verdict", "discrepancies"),
    TRAINING: ("setup", "history"),
}
_SYNTHETIC = re.compile(r"[A-Z](_springs\d_seed\d+(_paper)?)?\.npz")  # recordings of the synthetic robot


def check_own(folder: Path, stage: str) -> None:
    """ValueError if a folder has files of other programs with names that the stage writes or removes."""
    if not folder.is_dir() or any(_is_sign(folder / name, keys) for name, keys in _SIGNS.items()):
        return
    strange = [name for name in WRITTEN[stage] if kind_of(folder / name)]
    strange += [f"recordings/{path.name}" for path in _strange_recordings(folder / "recordings")]
    if strange:
        raise ValueError(
            f"{folder} holds {strange[0]}, and no run of this program: it is not replaced; choose another --out, or "
            "move it away"
        )


def _is_sign(path: Path, keys: tuple[str, ...]) -> bool:
    """Whether a JSON file has these keys, or is a damaged setup, which the command reports itself."""
    try:
        found = read_json(path)
    except OSError:
        return False
    except ValueError:
        return path.name in (SETUP, ASKED)
    return isinstance(found, dict) and all(key in found for key in keys)


def _strange_recordings(folder: Path) -> list[Path]:
    """Files in a folder of recordings with names of the synthetic robot's that it did not record."""
    if not folder.is_dir() or (folder / SYNTHETIC_ROBOT).is_file():
        return []
    from droid_jax.recordings.formats import load_recording

    def strange(path: Path) -> bool:
        try:
            return load_recording(path).meta.get("source") != SYNTHETIC_SOURCE
        except (OSError, ValueError):
            return True

    return [path for path in sorted(folder.iterdir()) if _SYNTHETIC.fullmatch(path.name) and strange(path)]
