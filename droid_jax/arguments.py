"""Checks of numbers, names and texts, from files and from Python arguments.

Every function returns its argument, converted to the promised type, or raises a ValueError of one sentence.  The
sentence begins with `what`: the argument, or the file and the place in it.
"""

from __future__ import annotations

import enum
import math
import numbers
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np

LONGEST_NAME = 200  # characters of a name; of a name that becomes a file's, bytes in UTF-8 (file systems allow 255)
LONGEST_PATH = 4096  # characters, as Linux allows bytes
LONGEST_NOTE = 10_000  # characters of a free text
# Control characters, half surrogate pairs, line separators, and characters that change the direction of text.  File
# names, figures and pages cannot hold all of them.
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff\u2028-\u202e\u2066-\u2069]")
_UNPRINTABLE_NOTE = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\u202a-\u202e\u2066-\u2069]"
)  # tabs and line ends are fine

Chosen = TypeVar("Chosen", bound=enum.Enum)
Kind = TypeVar("Kind")


def shown(value: Any, longest: int = 80) -> str:
    """The repr of a value in one printable line, cut where it is long: for messages."""
    try:
        text = repr(value)
    except Exception:  # a repr of a user's class may raise anything
        text = f"a {type(value).__name__}"
    text = _UNPRINTABLE.sub("?", " ".join(text.split()))
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def said(error: BaseException, longest: int = 300) -> str:
    """Message of another library's error in one printable line, cut where it is long."""
    text = _UNPRINTABLE.sub("?", " ".join(str(error).split()))
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def name(value: Any, what: str, *, file: bool = False, empty: bool = False) -> str:
    """A name: text without control characters, of at most LONGEST_NAME characters.

    Args:
        value: the name to check.
        what: begins the message, e.g. "recording 'a', phase 2, name".
        file: whether it becomes the name of a file: no path separator, no dot in front.
        empty: whether "" is a name.
    """
    if not isinstance(value, str):
        raise ValueError(f"{what} must be text, got {shown(value)}")
    if not value and not empty:
        raise ValueError(f"{what} must not be empty")
    printable(value, what)
    length = len(value.encode()) if file else len(value)
    if length > LONGEST_NAME:
        unit = "bytes" if file else "characters"
        raise ValueError(f"{what} must have at most {LONGEST_NAME} {unit}, got {length}: {shown(value, 40)}")
    if file and ("/" in value or "\\" in value or value.startswith(".")):
        raise ValueError(f"{what} names files: it must hold no / or \\ and not begin with a dot, got {shown(value)}")
    return str(value)


def names(value: Any, what: str, *, empty: bool = True) -> tuple[str, ...]:
    """Several names, none of them twice; a single text is refused."""
    if not is_list(value):
        raise ValueError(f"{what} must be a list of names, got {shown(value)}")
    out = tuple(name(one, f"{what}, entry {i}") for i, one in enumerate(value, 1))
    if not out and not empty:
        raise ValueError(f"{what} must not be empty")
    if twice := sorted({one for one in out if out.count(one) > 1}):
        raise ValueError(f"{what} must be unique, repeated: {', '.join(twice)}")
    return out


def is_list(value: Any) -> bool:
    """Whether a value has entries: texts and arrays without axes have none."""
    return (
        isinstance(value, Iterable) and not isinstance(value, (str, bytes, PathLike)) and getattr(value, "ndim", 1) > 0
    )


def note(value: Any, what: str) -> str:
    """A free text: no control characters but tabs and line ends, at most LONGEST_NOTE characters."""
    if not isinstance(value, str):
        raise ValueError(f"{what} must be text, got {shown(value)}")
    printable(value, what, lines=True)
    if len(value) > LONGEST_NOTE:
        raise ValueError(f"{what} must have at most {LONGEST_NOTE} characters, got {len(value)}")
    return str(value)


def printable(text: str, what: str, *, lines: bool = False) -> None:
    """ValueError for text with control characters or halves of surrogate pairs; lines: tabs and line ends may be."""
    if found := (_UNPRINTABLE_NOTE if lines else _UNPRINTABLE).search(text):
        raise ValueError(
            f"{what} holds the character U+{ord(found[0]):04X} at position {found.start()}, which cannot be printed: "
            f"{shown(text)}"
        )


def number(
    value: Any,
    what: str,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    infinite: bool = False,
) -> float:
    """A finite number; booleans and texts are refused.

    Args:
        value: a Python or numpy number.
        what: begins the message.
        above: it must be larger.  least: it must not be smaller.  below: it must be smaller.
        most: it must not be larger.  infinite: whether infinities are numbers too.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise ValueError(f"{what} must be a number, got {shown(value)}")
    try:
        out = float(value)
    except (OverflowError, ValueError):
        raise ValueError(f"{what} must be a number, got {shown(value)}") from None
    if math.isnan(out) or (math.isinf(out) and not infinite):
        raise ValueError(f"{what} must be finite, got {shown(value)}")
    _check_range(out, what, above, least, below, most)
    return out


def lists_of_numbers(of: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, list[float]]]:
    """Numbers by two names as plain data: each a list, of one or more."""
    import numpy as np

    return {
        key: {inner: np.ravel(value).astype(np.float64).tolist() for inner, value in each.items()}
        for key, each in of.items()
    }


def numeric(value: Any, what: str) -> np.ndarray:
    """Numbers as a float64 array, possibly NaN or infinite; texts and lists of unequal length are refused."""
    import numpy as np

    try:
        if np.asarray(value).dtype.kind not in "biuf":
            raise ValueError(f"{what} must be numbers, got {_got(value)}")
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(said if said.startswith(what) else f"{what} must be numbers: {said}") from None


def whole(value: Any, what: str, *, least: int | None = None, most: int | None = None) -> int:
    """A whole number as an int; 2.0 is refused."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise ValueError(f"{what} must be a whole number, got {shown(value)}")
    out = int(value)
    _check_range(out, what, None, least, None, most)
    return out


def _check_range(
    value: float, what: str, above: float | None, least: float | None, below: float | None, most: float | None
) -> None:
    wanted = [
        f"{word} {limit:g}"
        for word, limit, holds in (
            ("above", above, above is None or value > above),
            ("at least", least, least is None or value >= least),
            ("below", below, below is None or value < below),
            ("at most", most, most is None or value <= most),
        )
        if not holds
    ]
    if wanted:
        raise ValueError(f"{what} must be {' and '.join(wanted)}, got {shown(value)}")


def flag(value: Any, what: str) -> bool:
    """True or False, of Python or numpy; other values are refused."""
    if isinstance(value, bool):
        return value
    if type(value).__name__ in ("bool", "bool_") and type(value).__module__ == "numpy":
        return bool(value)
    raise ValueError(f"{what} must be True or False, got {shown(value)}")


def choice(value: Any, what: str, kind: type[Chosen]) -> Chosen:
    """A member of an enum; its value, as files state it, is converted."""
    if isinstance(value, kind):
        return value
    for member in kind:
        if isinstance(value, str) and value == member.value:
            return member
    raise ValueError(f"{what} must be one of {', '.join(str(m.value) for m in kind)}, got {shown(value)}")


def one_of(value: Any, what: str, valid: Collection[str]) -> str:
    """One of these texts."""
    if not isinstance(value, str) or value not in valid:
        raise ValueError(f"{what} must be one of {', '.join(valid)}, got {shown(value)}")
    return value


def instance(value: Any, what: str, kind: type[Kind]) -> Kind:
    """An object of a class."""
    if not isinstance(value, kind):
        raise ValueError(f"{what} must be {_article(kind.__name__)}, got {_got(value)}")
    return value


def mapping(value: Any, what: str) -> Mapping[Any, Any]:
    """A dictionary or another mapping; its keys and values are not checked."""
    return instance(value, what, Mapping)


def instances(value: Any, what: str, kind: type[Kind], *, empty: bool = True) -> tuple[Kind, ...]:
    """A list of objects of a class."""
    if isinstance(value, dict) or not is_list(value):
        raise ValueError(f"{what} must be a list of {kind.__name__} objects, got {_got(value)}")
    out = tuple(instance(one, f"{what}, entry {i}", kind) for i, one in enumerate(value))
    if not out and not empty:
        raise ValueError(f"{what} must not be empty")
    return out


def path_of(value: Any, what: str) -> Path:
    """A path, given as a Path or as text."""
    if not isinstance(value, (str, PathLike)) or len(str(value)) > LONGEST_PATH:
        raise ValueError(f"{what} must be text or a Path, got {shown(value)}")
    printable(str(value), what)
    return Path(value)


def optional(check: Callable[[Any, str], Any]) -> Callable[[Any, str], Any]:
    """The same check, which lets None pass."""
    return lambda value, what: None if value is None else check(value, what)


def several(check: Callable[[Any, str], Any], count: int | None = None) -> Callable[[Any, str], tuple[Any, ...]]:
    """A check of every entry of a list; count: how many there must be, None for one or more."""

    def each(value: Any, what: str) -> tuple[Any, ...]:
        if not is_list(value):
            raise ValueError(f"{what} must be a list, got {_got(value)}")
        out = tuple(check(one, f"{what}, entry {i}") for i, one in enumerate(value))
        if not out or len(out) != (count or len(out)):
            raise ValueError(f"{what} must have {count or 'one or more'} entries, got {len(out)}")
        return out

    return each


def weights(value: Any, what: str) -> dict[str, float]:
    """Names, each with a number of 0 or more, at least one of them above."""
    if not isinstance(value, Mapping) or not value:
        raise ValueError(f"{what} must map names to weights, got {shown(value)}")
    out = {name(key, f"a name of {what}"): number(w, f"{what}, {key!r}", least=0) for key, w in value.items()}
    if not any(out.values()):
        raise ValueError(f"{what} must have a weight above 0, got {shown(value)}")
    return out


def check_fields(of: Any, **checks: Callable[[Any, str], Any]) -> None:
    """Check fields of a frozen dataclass, in its __post_init__, and keep what the checks return.

    Args:
        of: the dataclass.
        checks: field name -> function of its value and its name, as those of this module.
    """
    for field, check in checks.items():
        set_field(of, field, check(getattr(of, field), field))


def set_field(of: Any, field: str, value: Any) -> None:
    """Store a checked value in a field of a frozen dataclass, in its __post_init__."""
    object.__setattr__(of, field, value)


def _article(word: str) -> str:
    return f"{'an' if word[0] in 'AEIOUaeiou' else 'a'} {word}"


def _got(value: Any) -> str:
    """A value for a message: its text where it is short data, else its type."""
    plain = value is None or isinstance(value, (str, bytes, int, float))
    return shown(value) if plain else _article(type(value).__name__)
