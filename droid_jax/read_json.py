"""Reads JSON, bounded in size and depth, with finite numbers only, and checks types by a schema.

content = read_json(path)                      # plain values, or ValueError with file and place
settings = typed(content, Settings, str(path)) # as a msgspec.Struct or TypedDict says
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from droid_jax.arguments import printable, shown
from droid_jax.errors import faults
from droid_jax.storage import read_text

MOST_BYTES = 16 * 2**20  # of a JSON file; the longest that the program writes has half a megabyte
MOST_LEVELS = 64  # of lists and objects in one another; the program writes six
LARGEST_INTEGER = 2**63  # beyond it a whole number fits no array

Content = TypeVar("Content")


def read_json(path: Path) -> Any:
    """The content of a JSON file as plain values.

    Raises:
        OSError: there is no such file, or it cannot be opened.
        ValueError: it is too large, too deep, not JSON, or holds a key twice, a number that is not finite or too large,
            or a text that cannot be printed; the message begins with the path.
    """
    text = read_text(path, most=MOST_BYTES)
    if not text.strip():
        raise ValueError(f"{path}: the file is empty")
    return parse_json(text, str(path))


def parse_json(text: str, where: str) -> Any:
    """The content of a JSON text as plain values; where: the file, begins the message."""
    if len(text) > MOST_BYTES:
        raise ValueError(f"{where}: {len(text)} characters of JSON, at most {MOST_BYTES} are read")
    try:
        value = json.loads(text, object_pairs_hook=_object, parse_constant=_no_number)
    except json.JSONDecodeError as error:
        raise ValueError(f"{where}: not valid JSON, line {error.lineno}: {error.msg}") from None
    except RecursionError:
        raise ValueError(f"{where}: lists and objects stand in one another more than {MOST_LEVELS} deep") from None
    except ValueError as error:  # of the hooks, and of int() for thousands of digits
        what = "a whole number of thousands of digits" if "integer string conversion" in str(error) else error
        raise ValueError(f"{where}: {what}") from None
    if fault := _fault(value):
        raise ValueError(f"{where}{fault}")
    return value


def typed(value: Any, kind: type[Content], where: str) -> Content:
    """A parsed value converted to a type; ValueError names the place and what is wrong there.

    Args:
        value: of `read_json` or `parse_json`.
        kind: a msgspec.Struct, TypedDict or any other type that msgspec converts to.
        where: what the value belongs to, begins the message.

    Returns:
        The value as an object of that type; of a TypedDict, without the keys that it does not name.
    """
    try:
        return msgspec.convert(value, kind, strict=True)
    except msgspec.ValidationError as error:
        raise ValueError(f"{where}{_sentence(value, kind, str(error))}") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) < len(pairs):
        seen = set[str]()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise ValueError(f"the key {shown(twice)} is there twice in one object")
    return out


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON: numbers must be finite")


def _fault(value: Any) -> str:
    """Fault and place of the first scalar or key that is not allowed in any file; empty where there is none."""
    waiting: list[tuple[Any, tuple[Any, ...]]] = [(value, ())]
    while waiting:
        item, place = waiting.pop()
        if isinstance(item, (dict, list)):
            if len(place) >= MOST_LEVELS:
                return f": lists and objects stand in one another more than {MOST_LEVELS} deep"
            for key, inner in item.items() if isinstance(item, dict) else enumerate(item):
                if isinstance(key, str) and (what := _text_fault(key, "the key", is_key=True)):
                    return f"{_said(place)}: {what}"
                if isinstance(inner, (dict, list)):
                    waiting.append((inner, (*place, key)))
                elif what := _scalar_fault(inner):
                    return f"{_said((*place, key))}: {what}"
        elif what := _scalar_fault(item):
            return f": {what}"
    return ""


def _scalar_fault(value: Any) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return "a number too large for a float"
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        return "a whole number beyond 2^63"
    return _text_fault(value, "the text", is_key=False) if isinstance(value, str) else ""


def _text_fault(text: str, what: str, is_key: bool) -> str:
    try:
        printable(text, what, lines=not is_key)
    except ValueError as error:
        return str(error)
    return ""


def _said(place: tuple[Any, ...]) -> str:
    """A place in a message: ": 'phases', entry 0, 'name'"."""
    said = ", ".join(f"entry {key}" if isinstance(key, int) else shown(key) for key in place)
    return f": {said}" if said else ""


_WORDS = {
    **{"float": "a number", "int": "a whole number", "str": "text", "bool": "true or false"},
    **{"null": "null", "array": "a list", "object": "an object"},
}


def _sentence(value: Any, kind: Any, said: str) -> str:
    """msgspec's message about a value, in this program's words, with the place first."""
    said, _, path = said.partition(" - at `")
    if path.startswith("key in"):
        return f": {said}"
    place = _place(value, kind, said, path.rstrip("`")) if path else ()
    found, node = value, inspect.type_info(kind)
    for key in place:
        found, node = found[key], _inner(node, key, found)
    options = node.types if isinstance(node, inspect.UnionType) else (node,)
    if said.startswith("Object"):
        return f"{_said(place)}{_keys(found, options)}"
    if valid := [v for o in options for v in _values(o)]:
        return f"{_said(place) or ': the content'} must be one of {', '.join(map(str, valid))}, got {shown(found)}"
    wanted = re.sub(r"`([^`]*)`", lambda m: " or ".join(_WORDS.get(w, w) for w in m[1].split(" | ")), said)
    wanted = wanted.removeprefix("Expected ").partition(", got ")[0]
    return f"{_said(place) or ': the content'} must be {wanted}, got {shown(found)}"


def _keys(found: dict[str, Any], options: tuple[Any, ...]) -> str:
    """Which keys of an object are missing, and which are unknown where its type allows no others."""
    node = next(o for o in options if isinstance(o, (inspect.StructType, inspect.TypedDictType)))
    names = {f.encode_name: f.required for f in node.fields}
    missing = [key for key, required in names.items() if required and key not in found]
    if isinstance(node, inspect.TypedDictType) or not node.cls.__struct_config__.forbid_unknown_fields:
        return f" lacks {', '.join(map(repr, missing))}"
    unknown = sorted(map(str, found.keys() - names.keys()))
    return f": {faults({'unknown keys:': unknown, 'missing keys:': missing})}; valid keys: {', '.join(names)}"


def _values(node: Any) -> Iterator[Any]:
    if isinstance(node, inspect.EnumType):
        yield from (member.value for member in node.cls)
    elif isinstance(node, inspect.LiteralType):
        yield from node.values


def _inner(node: Any, key: Any, found: Any) -> Any:
    """The type of a key's value in an object of a given type."""
    options = node.types if isinstance(node, inspect.UnionType) else (node,)
    for option in options:
        if isinstance(found, dict) and isinstance(option, (inspect.StructType, inspect.TypedDictType)):
            return next(f.type for f in option.fields if f.encode_name == key)
        if isinstance(found, dict) and isinstance(option, inspect.DictType):
            return option.value_type
        if isinstance(found, list) and isinstance(option, inspect.TupleType):
            return option.item_types[key]
        if isinstance(found, list) and isinstance(option, (inspect.ListType, inspect.VarTupleType)):
            return option.item_type
    return inspect.AnyType()


def _place(value: Any, kind: Any, said: str, path: str) -> tuple[Any, ...]:
    """The keys of msgspec's path "$.phases[0].name"; "[...]", any key of an object, is found by trying."""
    place: list[Any] = []
    found = value
    for field, entry in re.findall(r"\.([^.\[]+)|\[(\.\.\.|\d+)\]", path):
        if entry == "...":
            key = next((k for k in found if _fails(_with(value, place, {k: found[k]}), kind, said, path)), None)
        else:
            key = field or int(entry)
        if key is None or (isinstance(found, dict) and key not in found):
            break
        place.append(key)
        found = found[key]
    return tuple(place)


def _with(value: Any, place: list[Any], new: Any) -> Any:
    """A copy of a value with another entry at one place."""
    if not place:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[place[0]] = _with(value[place[0]], place[1:], new)
    return copy


def _fails(value: Any, kind: Any, said: str, path: str) -> bool:
    try:
        msgspec.convert(value, kind, strict=True)
    except msgspec.ValidationError as error:
        return str(error) == f"{said} - at `{path}`"
    return False
