"""The program as a shell command: its streams, signals and exit codes.

| code | the run |
|---|---|
| 0 | is done |
| 1 | failed, but not because of its input: a full disk, an output that cannot be written |
| 2 | was given bad input, or a place that cannot be written |
| 130, 143 | was interrupted (Ctrl-C), terminated |
| 141 | had more output, but the reader is gone: `| head` |

A signal ends the program at once, without an exception, which other libraries' code might swallow.  All files are
complete at any time.  Actions that are needed before the end are registered with `at_the_end`.

The module imports little and is imported first, so that a stop in the first second is handled as any later one.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

GRACE = 1.0  # s until another thread ends the program: Python's handler may wait minutes for a compiler to return
CLOSED = 128 + signal.SIGPIPE
_tidying: list[Callable[[], object]] = []
_going_on: list[Callable[[], str]] = []


def program() -> int:
    """Run the command line as a program; returns its exit code."""
    _open_streams()
    _watch_signals()
    try:
        code = importlib.import_module("droid_jax.run").main()
    except SystemExit as ended:  # --help, and options that do not exist
        code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 2
    return _flushed(code)


@contextlib.contextmanager
def at_the_end(tidy: Callable[[], object]) -> Iterator[None]:
    """Calls `tidy` before the program ends, if a signal ends it inside the block."""
    _tidying.append(tidy)
    try:
        yield
    finally:
        _tidying.remove(tidy)


@contextlib.contextmanager
def stop_advice(going_on: Callable[[], str]) -> Iterator[None]:
    """Inside the block, `stop_message` ends with the text of `going_on`, which says how to continue the run."""
    _going_on.append(going_on)
    try:
        yield
    finally:
        _going_on.remove(going_on)


def stop_message(number: int) -> str:
    """The message when signal `number` ends the program."""
    return ("terminated" if number == signal.SIGTERM else "interrupted") + "".join(text() for text in _going_on[-1:])


def reader_gone() -> bool:
    """Whether the standard output is a pipe whose reader is gone."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), select.POLLERR)
        return any(event & select.POLLERR for _, event in poll.poll(0))
    except (OSError, ValueError, AttributeError):
        return False


def drop_output() -> None:
    """Discard output that is not printed yet, which Python would fail to flush at its end."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _open_streams() -> None:
    """Open closed standard streams (`>&-`) on the null device, or the next opened file would take their place."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def _watch_signals() -> None:
    """Handle Ctrl-C and SIGTERM, unless the caller ignores them (nohup, a job in the background)."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_end_at_last, args=(reader,), daemon=True, name="signals").start()


def _end(number: int, frame: FrameType | None = None) -> None:
    """Tidy up, print the message, and end the program."""
    for number_ in (signal.SIGINT, signal.SIGTERM):  # a second signal ends the program at once
        with contextlib.suppress(ValueError):  # in another thread
            signal.signal(number_, lambda *_: os._exit(128 + number))
    for tidy in reversed(_tidying):
        with contextlib.suppress(Exception):
            tidy()
    with contextlib.suppress(Exception):
        sys.stdout.flush()
    with contextlib.suppress(OSError):
        os.write(2, f"{stop_message(number)}\n".encode())
    os._exit(128 + number)


def _end_at_last(reader: int) -> None:
    """End the program if its main thread has not ended it within GRACE seconds of a signal."""
    while data := os.read(reader, 1):
        if data[0] in (signal.SIGINT, signal.SIGTERM):
            time.sleep(GRACE)
            _end(data[0])


def _flushed(code: int) -> int:
    """The exit code, after the output is flushed."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # the reader is gone, but the run is done
        drop_output()
        return code
    except OSError as error:
        drop_output()
        print(f"error: the output cannot be written: {(error.strerror or str(error)).lower()}", file=sys.stderr)
        return code or 1
    return code
