"""One run on several processes, on one machine or on many: jax.distributed, without a scheduler of its own.

Every process runs the same command with the same files and seeds, and so asks for the same replays.  Each replays its
share of the rows on its own devices, and all of them get all results (`over_processes`); searches and statistics are
done by each process alike.  Process 0 writes the results folder.  The others work on a copy of it in a temporary
folder, which is how they know what is done already, and print nothing.

Switched on by DROID_JAX_DISTRIBUTED=1.  Where jax cannot find out by itself (Slurm, Open MPI) who takes part,
JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID say it.  docs/scale.md has the launch lines.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import hashlib
import io
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droid_jax.console import at_the_end
from droid_jax.files import LOCK

if TYPE_CHECKING:
    import subprocess

VARIABLE = "DROID_JAX_DISTRIBUTED"
COORDINATOR, COUNT, INDEX = "JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
RANKS = (INDEX, "SLURM_PROCID", "OMPI_COMM_WORLD_RANK")  # set by launchers: number of this process
HEARTBEAT = 15  # s without a sign of life after which a process counts as lost
JOINING = 300  # s to wait for all processes
LEAVING = 7 * 24 * 3600  # s that a process waits at its end for the others; process 0 may evaluate a policy meanwhile
_LEFT_OUT = (
    LOCK,
    "films",
    "figures",
    "frames",
    "tensorboard",
    "report.html",
)  # of a folder's copy: no process reads them
_AGAIN = "the same command goes on from its last checkpoint, with fewer processes too"
_place = [0, 1]  # index of this process, and how many there are
_guards: list[subprocess.Popen[bytes]] = []


class Lost(RuntimeError):
    """Another process of the run ended, or cannot be reached."""


def asked() -> bool:
    """Whether the environment asks for several processes."""
    return os.environ.get(VARIABLE, "").lower() not in ("", "0", "false", "no")


def index() -> int:
    """Number of this process, 0 in a run of one."""
    return _place[0]


def count() -> int:
    """How many processes the run has."""
    return _place[1]


def first() -> bool:
    """Whether this process is the one that writes, draws and prints."""
    return index() == 0


def rank() -> int:
    """Number of this process as its launcher states it, also before `join`; 0 where it is not stated."""
    return next((number for name in RANKS if (number := _number(name)) is not None), 0)


def join() -> None:
    """Connect to the other processes; call it after `runtime.tune` and before jax computes anything.

    Raises:
        ValueError: the number of processes is not stated, or they do not connect within JOINING seconds.
    """
    import jax

    given = {COUNT: _number(COUNT), INDEX: _number(INDEX)}
    known = os.environ.get(COORDINATOR) and None not in given.values()
    # jax's handler would swallow SIGTERM, which must end the run.
    jax.config.update("jax_enable_preemption_service", False)
    how = f"under Slurm start them with srun, elsewhere set {COORDINATOR} (HOST:PORT of process 0), {COUNT} and {INDEX}"
    _guard(f"the processes of this run did not find together in {JOINING} s: {how}")
    try:
        jax.distributed.initialize(
            num_processes=given[COUNT],
            process_id=given[INDEX],
            cluster_detection_method="deactivate" if known else None,
            initialization_timeout=JOINING,
            heartbeat_timeout_seconds=HEARTBEAT,
            shutdown_timeout_seconds=LEAVING,
        )
    except (ValueError, RuntimeError, OSError) as error:
        why = str(error).splitlines()[0].rstrip(".")
        raise ValueError(f"{VARIABLE} is set, and the processes did not find together: {why}; {how}") from None
    finally:
        _dismiss()
    if jax.process_index() == 0:
        _guard(f"a process of the {jax.process_count()} of this run was lost; {_AGAIN}")
    with _to_null(1):  # the library below says on the standard output that it is connected
        _place[:] = [jax.process_index(), jax.process_count()]
        _broadcast(b"-")  # both of its collectives


def over_processes(function: Callable[[Any], Any], values: Any) -> Any:
    """Values of a function of rows, shared among processes; all processes get all results, in order.

    Args:
        function: [n, D] -> pytree of arrays [n, ...] on the host, row by row.
        values: [P, D], the same in every process.

    Raises:
        Lost: another process ended.
        RuntimeError: another process asks for other rows.
    """
    if count() == 1:
        return function(values)
    import jax
    import numpy as np

    values = np.asarray(values)
    if values.ndim != 2 or not len(values):
        return function(values)  # which raises the same error in every process
    share = -(-len(values) // count())
    rows = np.minimum(np.arange(index() * share, (index() + 1) * share), len(values) - 1)
    leaves, form = jax.tree.flatten(function(values[rows]))
    leaves = [np.ascontiguousarray(leaf) for leaf in leaves]
    shapes = [(leaf.shape, leaf.dtype.str) for leaf in leaves]
    _check_alike(hashlib.sha256(f"{values.shape} {shapes}".encode() + np.float32(values).tobytes()).digest())
    # As bytes, because jax would convert doubles to single precision.
    packed = np.concatenate([leaf.reshape(share, -1).view(np.uint8).reshape(share, -1) for leaf in leaves], axis=1)
    found, at, parts = _allgather(packed), 0, []
    for leaf in leaves:
        width = leaf.nbytes // share
        part = np.ascontiguousarray(found[: len(values), at : at + width]).view(leaf.dtype)
        parts.append(part.reshape(len(values), *leaf.shape[1:]))
        at += width
    return jax.tree.unflatten(form, parts)


def agreed(decision: bool) -> bool:
    """The decision of process 0, for decisions that depend on a clock, which differs between processes."""
    return decision if count() == 1 else _gathered(bytes([decision]))[0] == b"\1"


@contextlib.contextmanager
def part(folder: Path | None) -> Iterator[Path | None]:
    """Context of a command in each process.

    jax makes all processes wait for each other when they end.  Before that, an exchange of results (`over_processes`)
    waits for 30 minutes at most.

    Args:
        folder: the results folder; None for none.

    Yields:
        The folder that this process is to use: in process 0 it itself, in others a copy of it, removed at the end.
    """
    if count() == 1:
        yield folder
        return
    import tarfile  # only here: `--help` waits for what is imported above

    with contextlib.ExitStack() as stack:
        stack.enter_context(at_the_end(_dismiss))
        copied = None if folder is None else _broadcast(_packed(folder) if first() else b"")
        if not first():
            stack.enter_context(_to_null(1))
            stack.enter_context(warnings.catch_warnings())
            warnings.simplefilter("ignore")
            if folder is not None and copied is not None:
                folder = Path(stack.enter_context(_temporary())) / folder.name
                with tarfile.open(fileobj=io.BytesIO(copied)) as archive:
                    archive.extractall(folder, filter="data")
        yield folder


def leave(code: int) -> int:
    """The exit code; a process that failed ends at once.

    Otherwise it would wait for the others to end, and they for its replays.
    """
    if count() > 1 and code:
        _dismiss()
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
    return code


def speaker() -> str:
    """Beginning of an error message, which names the process; empty in process 0."""
    return "" if first() else f"process {index()} of {count()}: "


def _number(name: str) -> int | None:
    """An environment variable's whole number; None where it is not set."""
    text = os.environ.get(name, "")
    if text and not text.isdecimal():
        raise ValueError(f"{name} must be a whole number, got {text!r}")
    return int(text) if text else None


def _check_alike(digest: bytes) -> None:
    """RuntimeError where other processes have another digest of the replays they ask for."""
    other = [str(number) for number, each in enumerate(_gathered(digest)) if each != digest]
    if other:
        raise RuntimeError(
            f"process {index()} and process {', '.join(other)} no longer ask for the same replays: give all the same "
            "command, files and versions, on machines of one kind"
        )


def _gathered(own: bytes) -> list[bytes]:
    """As many bytes of each process, by process."""
    import numpy as np

    return [row.tobytes() for row in _allgather(np.frombuffer(own, np.uint8)[None])]


def _allgather(own: Any) -> Any:
    """[n, B] bytes of each process, one below the other.  Lost where one is gone."""
    from jax.experimental.multihost_utils import process_allgather

    try:
        return process_allgather(own, tiled=True)
    except (RuntimeError, ValueError) as error:  # which of them depends on where jax notices
        raise _lost(error) from None


def _broadcast(content: bytes) -> bytes:
    """The bytes that process 0 has."""
    import numpy as np
    from jax.experimental.multihost_utils import broadcast_one_to_all

    size = int.from_bytes(_gathered(len(content).to_bytes(8, "big"))[0], "big")
    own = np.frombuffer(content, np.uint8) if first() else np.zeros(size, np.uint8)
    try:
        return bytes(broadcast_one_to_all(own).tobytes())
    except (RuntimeError, ValueError) as error:  # which of them depends on where jax notices
        raise _lost(error) from None


def _lost(error: Exception) -> Lost:
    return Lost(f"another process of this run ended or cannot be reached ({str(error).splitlines()[0]}); {_AGAIN}")


def _packed(folder: Path) -> bytes:
    """A folder as tar, without files that no process reads; an empty tar where it is missing."""
    import tarfile

    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        if folder.is_dir():
            archive.add(folder, ".", filter=lambda file: None if Path(file.name).name in _LEFT_OUT else file)
    return buffer.getvalue()


@contextlib.contextmanager
def _temporary() -> Iterator[str]:
    """A temporary folder, removed at the end and where a signal ends the program."""
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="droid_jax_", ignore_cleanup_errors=True))
        stack.enter_context(at_the_end(lambda: shutil.rmtree(folder, ignore_errors=True)))
        yield folder


def _flush() -> None:
    """Write out what is buffered for the standard output, by libraries in C too."""
    sys.stdout.flush()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).fflush(None)


@contextlib.contextmanager
def _to_null(descriptor: int) -> Iterator[None]:
    """What is written to a stream inside the block, by libraries in C too, goes nowhere."""
    _flush()
    kept, null = os.dup(descriptor), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, descriptor)
        yield
    finally:
        _flush()
        os.dup2(kept, descriptor)
        os.close(kept)
        os.close(null)


def _guard(line: str) -> None:
    """Start a shell that prints this error if jax aborts the process because another one is lost or does not connect.

    jax then aborts with a stack of its own functions and without an exception.
    """
    import subprocess

    with contextlib.suppress(OSError):
        command = ["/bin/sh", "-c", f'read -r done || echo "error: {line}" >&2']
        _guards.append(subprocess.Popen(command, stdin=subprocess.PIPE))
        atexit.register(_dismiss)


def _dismiss() -> None:
    """End the guards without a message, because this process ends normally."""
    while _guards:
        guard = _guards.pop()
        with contextlib.suppress(OSError):
            guard.communicate(b"done\n")
