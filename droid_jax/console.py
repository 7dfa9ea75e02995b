"""The program as a shell sees it: its streams, what stops it, and the exit code that says so.

| code | the run |
|---|---|
| 0 | is done |
| 1 | failed for want of something else than good input: a full disk, an output that cannot be written |
| 2 | was given bad input, or a place that cannot be written |
| 130, 143 | was interrupted (Ctrl-C), terminated |
| 141 | had more to say, and nobody reads it any more: `| head` |

A signal ends the program at once, without an exception on its way through other programs' code, which may swallow it:
all files are whole at any time.  What must be tidied up before is told to `at_the_end`.

Light, and imported before everything else: a stop in the first second ends as one in the first hour.
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

GRACE = 1.0  # s: Python's handlers wait for a compiler of minutes to return, another thread does not
CLOSED = 128 + signal.SIGPIPE
_tidying: list[Callable[[], object]] = []
_going_on: list[Callable[[], str]] = []


def program() -> int:
    """The command line as a program of its own: its exit code."""
    _open_streams()
    _watch_signals()
    try:
        code = importlib.import_module("droid_jax.run").main()
    except SystemExit as ended:  # --help, and options that do not exist
        code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 2
    return _flushed(code)


@contextlib.contextmanager
def at_the_end(tidy: Callable[[], object]) -> Iterator[None]:
    """Where a signal ends the program inside the block, `tidy` is called before; otherwise nothing happens."""
    _tidying.append(tidy)
    try:
        yield
    finally:
        _tidying.remove(tidy)


@contextlib.contextmanager
def last_words(going_on: Callable[[], str]) -> Iterator[None]:
    """Inside the block, what `words` says behind "interrupted"."""
    _going_on.append(going_on)
    try:
        yield
    finally:
        _going_on.remove(going_on)


def words(number: int) -> str:
    """What the program says when a signal ends it."""
    return ("terminated" if number == signal.SIGTERM else "interrupted") + "".join(told() for told in _going_on[-1:])


def nobody_reads() -> bool:
    """Whether the standard output is a pipe whose reader is gone."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), select.POLLERR)
        return any(event & select.POLLERR for _, event in poll.poll(0))
    except (OSError, ValueError, AttributeError):
        return False


def drop_output() -> None:
    """Let what is still to be printed go nowhere: Python would fail to flush it at its end."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _open_streams() -> None:
    """Closed standard streams (`>&-`) lead nowhere: the next file opened would be taken for them."""
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
    """Handle Ctrl-C and SIGTERM, unless they were ignored from outside (nohup, a job in the background)."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_end_at_last, args=(reader,), daemon=True, name="signals").start()


def _end(number: int, frame: FrameType | None = None) -> None:
    """Tidy up, say that the program was stopped, and end it."""
    for number_ in (signal.SIGINT, signal.SIGTERM):  # a second one does not wait for what is tidied up
        with contextlib.suppress(ValueError):  # in another thread
            signal.signal(number_, lambda *_: os._exit(128 + number))
    for tidy in reversed(_tidying):
        with contextlib.suppress(Exception):
            tidy()
    with contextlib.suppress(Exception):
        sys.stdout.flush()
    with contextlib.suppress(OSError):
        os.write(2, f"{words(number)}\n".encode())
    os._exit(128 + number)


def _end_at_last(reader: int) -> None:
    """End the program where its main thread has not GRACE seconds behind a signal."""
    while data := os.read(reader, 1):
        if data[0] in (signal.SIGINT, signal.SIGTERM):
            time.sleep(GRACE)
            _end(data[0])


def _flushed(code: int) -> int:
    """The exit code, once all that was printed has gone out."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # nobody heard the last words, but all is done
        drop_output()
        return code
    except OSError as error:
        drop_output()
        print(f"error: the output cannot be written: {(error.strerror or str(error)).lower()}", file=sys.stderr)
        return code or 1
    return code
