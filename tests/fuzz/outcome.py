"""What a reader made of one input: accepted, refused in a sentence, or something that it must not do."""

from __future__ import annotations

import re
import resource
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

MOST_SECONDS = 10.0  # s of processor time for one input: other programs on the machine do not count
MOST_MEMORY = 1 << 30  # bytes that reading one input may add
MOST_WARNINGS = 5  # that one input may cause
LONGEST = 1000  # characters of a message, without the folder's name in it
REFUSALS = (ValueError, OSError)  # what the command line turns into one line and exit code 2
UNNAMED = "does not name the input"
_UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f\ud800-\udfff\u202a-\u202e\u2066-\u2069]")


@dataclass(frozen=True)
class Outcome:
    """result: "accepted", "refused", or a fault: "foreign", "hang", "memory", "message", "warnings".

    message: of the error, or what is wrong; place: file, line and function that raised it; seconds: that it took.
    """

    result: str
    message: str = ""
    place: str = ""
    seconds: float = 0.0

    @property
    def fault(self) -> bool:
        return self.result not in ("accepted", "refused")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def peak() -> int:
    """Bytes of memory that this process had in use at most, since `forget_peak`."""
    try:
        found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:  # no Linux
        found = None
    return 1024 * (int(found[1]) if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def forget_peak() -> None:
    """Count the peak from here, where the system can."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def judged(
    call: Callable[[], Any],
    names: tuple[str, ...],
    hide: str = "",
    refusals: tuple[type[Exception], ...] = REFUSALS,
    most: float = MOST_SECONDS,
) -> Outcome:
    """Calls, and judges what comes of it.

    names: of which the message of a refusal must hold one: the file, its folder, or the argument.  An argument may go
    by other words in a message of this program's own.
    hide: the made-up folder of a file, which does not count in a message's length; empty for arguments.
    refusals: errors that may say so.
    most: s of processor time beyond which it hangs.
    """
    forget_peak()
    before, began, error = peak(), time.process_time(), None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            call()
        except Exception as raised:
            error = raised
    seconds = time.process_time() - began
    used = peak() - before
    if used > MOST_MEMORY or _ran_out(error):
        why = f"{used >> 20} MiB" if error is None else f"{used >> 20} MiB, {_short(error)}"
        return Outcome("memory", why, "" if error is None else _place(error), seconds)
    if seconds > most:
        return Outcome("hang", f"{seconds:.1f} s", "" if error is None else _place(error), seconds)
    shown = [w for w in caught if not issubclass(w.category, (DeprecationWarning, ResourceWarning))]
    if len(shown) > MOST_WARNINGS:
        return Outcome("warnings", f"{len(shown)}: {str(shown[-1].message)[:200]}", shown[-1].filename, seconds)
    if error is None:
        return Outcome("accepted", seconds=seconds)
    if not isinstance(error, refusals):
        return Outcome("foreign", _short(error), _place(error), seconds)
    if wrong := _wrong_words(str(error), () if _stated(error) and not hide else names, hide):
        accident = not isinstance(error, REFUSALS) and wrong == UNNAMED
        return Outcome("foreign" if accident else "message", f"{wrong}: {_short(error)}", _place(error), seconds)
    return Outcome("refused", str(error)[:200], _place(error), seconds)


def _wrong_words(message: str, names: tuple[str, ...], hide: str) -> str:
    """What is wrong with a message; empty where it is one readable line that names its subject."""
    if not message.strip():
        return "no words"
    bare = message.replace(hide, "") if hide else message
    if len(bare) > LONGEST:
        return f"{len(bare)} characters"
    if "\n" in message or _UNPRINTABLE.search(message):
        return "unprintable characters or several lines"
    return "" if not names or any(name in message for name in names) else UNNAMED


def _ran_out(error: BaseException | None) -> bool:
    """Whether memory ran out; the parser of Python's own literals says so of its stack."""
    return isinstance(error, MemoryError) and "s_push" not in str(error)


def _stated(error: BaseException) -> bool:
    """Whether this program raised an error itself, in its own words; numpy's errors show a line of it as well."""
    last = traceback.extract_tb(error.__traceback__)[-1:]
    return any("/droid_jax/" in f.filename and (f.line or "").startswith("raise ") for f in last)


def _short(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error)[:300]}"


def _place(error: BaseException) -> str:
    """The innermost line of this program, and the line that raised."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "/droid_jax/" in f.filename]
    chosen = [*own[-1:], *([frames[-1]] if frames and (not own or frames[-1] is not own[-1]) else [])]
    return " < ".join(f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in reversed(chosen))
