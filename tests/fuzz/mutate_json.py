"""Mutations of JSON: values, keys and the structure, as text, so that what is no JSON can be written too.

Like all mutations here they take a seeded generator (`random.Random`, which hypothesis draws as well) and valid
content, and return damaged content; they know nothing of this program.
"""

from __future__ import annotations

import json
from random import Random
from typing import Any

DEEP = 100_000  # levels of nesting, beyond every recursion limit
LONG = 200_000  # characters of a text


class Raw(str):
    """The JSON text of a leaf, valid or not."""


class Pairs(list[tuple[str, Any]]):
    """An object as pairs of a key's JSON text and a node, so that a key can stand there twice."""


def parse(content: str | bytes) -> Any:
    """JSON as nodes: `Pairs`, lists and `Raw`."""

    def node(value: Any) -> Any:
        if isinstance(value, (Pairs, Raw)):
            return value
        return [node(v) for v in value] if isinstance(value, list) else Raw(json.dumps(value))

    def pairs(found: list[tuple[str, Any]]) -> Pairs:
        return Pairs((json.dumps(key), node(value)) for key, value in found)

    return node(json.loads(content, object_pairs_hook=pairs))


def dump(node: Any) -> str:
    """The JSON text of a node."""
    if isinstance(node, Pairs):
        return "{" + ", ".join(f"{key}: {dump(value)}" for key, value in node) + "}"
    return node if isinstance(node, Raw) else "[" + ", ".join(map(dump, node)) + "]"


_NUMBERS = (
    *("0", "-0.0", "1", "-1", "2", "0.5", "3.7", "-2.5e-3", "1e-320", "1e30", "-1e300", "1e308", "1e999", "-1e999"),
    *("NaN", "Infinity", "-Infinity", str(2**31), str(2**63), str(-(2**64)), "1" + "0" * 400, "7" * 5000),
)
_TEXTS = (
    *('""', '"x"', '"NaN"', '"1.5"', '"\\ud800"', '"a\\u0000b"', '"\\u001b[31mred"', '"line\\nbreak"', '"\\u202eabc"'),
    *('"../../outside"', '"/etc/hostname"', '"C:\\\\x"', '"<script>alert(1)</script>"', '"$\\\\frac{1$"', '"{}"'),
    *('"%s %d"', '"a/b"', '"."', '"\\u00e9\\u4e2d"', f'"{"y" * 300}"', f'"{"z" * LONG}"'),
)
_STRUCTURES = (
    *("null", "true", "false", "[]", "{}", "[[]]", "[null]", "[NaN]", "[1, 2, 3]", "[[1, 2], [3]]", '["a", 1]'),
    *('{"a": {"b": []}}', '{"": 0}', "[" * 200 + "]" * 200, "[" * DEEP + "]" * DEEP, '{"a":' * DEEP + "1" + "}" * DEEP),
    "[" + "0," * 50_000 + "0]",
)
_NOT_JSON = ("", "nul", "'x'", "[1,]", '{"a"}', '"\\x"', '"open', "0x10", "01", "+1", "\x00", "// note", "{,}")


def mutate_json(random: Random, content: bytes) -> bytes:
    """One to three changes of the structure or of values."""
    node = parse(content)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        node = random.choice(_JSON)(random, node)
    text = dump(node)
    if random.random() < 0.03:
        return text.encode(random.choice(("utf-16", "utf-8-sig", "latin-1")), errors="replace")
    return text.encode("utf-8", errors="surrogatepass")


def _value(random: Random) -> Raw:
    kind = random.choices((_NUMBERS, _TEXTS, _STRUCTURES, _NOT_JSON), (5, 4, 4, 1))[0]
    return Raw(random.choice(kind))


def _spots(node: Any) -> list[tuple[Any, int]]:
    """(container, position) of every node below the root."""
    out, waiting = [], [node]
    while waiting:
        here = waiting.pop()
        if isinstance(here, list):
            for i, item in enumerate(here):
                out.append((here, i))
                waiting.append(item[1] if isinstance(here, Pairs) else item)
    return out


def _get(spot: tuple[Any, int]) -> Any:
    container, i = spot
    return container[i][1] if isinstance(container, Pairs) else container[i]


def _put(spot: tuple[Any, int], value: Any) -> None:
    container, i = spot
    container[i] = (container[i][0], value) if isinstance(container, Pairs) else value


def _spot(random: Random, node: Any) -> tuple[Any, int] | None:
    """A place, those of objects as likely as the many numbers of lists."""
    spots = _spots(node)
    keyed = [s for s in spots if isinstance(s[0], Pairs)]
    return random.choice(keyed if keyed and random.random() < 0.6 else spots) if spots else None


def _retyped(random: Random, node: Any) -> Any:
    if random.random() < 0.03 or not (spot := _spot(random, node)):
        return _value(random)
    _put(spot, _value(random))
    return node


def _removed(random: Random, node: Any) -> Any:
    if spot := _spot(random, node):
        del spot[0][spot[1]]
    return node


def _doubled(random: Random, node: Any) -> Any:
    """An entry twice; of an object the key, with another value."""
    if spot := _spot(random, node):
        container, i = spot
        container.insert(i, (container[i][0], _value(random)) if isinstance(container, Pairs) else container[i])
    return node


def _renamed(random: Random, node: Any) -> Any:
    keyed = [s for s in _spots(node) if isinstance(s[0], Pairs)]
    if keyed:
        container, i = random.choice(keyed)
        other = random.choice((random.choice(_TEXTS), random.choice(keyed)[0][0][0], random.choice(_NUMBERS)))
        container[i] = (other, container[i][1])
    return node


def _extended(random: Random, node: Any) -> Any:
    containers = [n for n in [node, *map(_get, _spots(node))] if isinstance(n, list)]
    if containers:
        here = random.choice(containers)
        here.append((random.choice(_TEXTS), _value(random)) if isinstance(here, Pairs) else _value(random))
    return node


def _swapped(random: Random, node: Any) -> Any:
    one, other = _spot(random, node), _spot(random, node)
    if one and other:
        a, b = dump(_get(one)), dump(_get(other))  # as text: one may hold the other
        _put(one, Raw(b))
        _put(other, Raw(a))
    return node


def _wrapped(random: Random, node: Any) -> Any:
    if spot := _spot(random, node):
        inner = _get(spot)
        _put(spot, random.choice(([inner], [inner, inner], Pairs([('"value"', inner)]))))
    return node


def _scaled(random: Random, node: Any) -> Any:
    numbers = [s for s in _spots(node) if isinstance(v := _get(s), Raw) and v[:1] in "-0123456789"]
    if numbers:
        spot = random.choice(numbers)
        try:
            number = float(_get(spot)) * random.choice((-1.0, 0.0, 1e-9, 0.5, 2.0, 1e9, 1e200))
        except ValueError:
            return node
        _put(spot, Raw(json.dumps(number)))
    return node


_JSON = (_retyped, _retyped, _retyped, _removed, _doubled, _renamed, _extended, _swapped, _wrapped, _scaled)
