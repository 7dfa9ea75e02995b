"""The reader of JSON: bounded, strict, and its errors name the place."""

from __future__ import annotations

import enum
import os
from pathlib import Path
from typing import NotRequired, TypedDict

import msgspec
import pytest

from droid_jax.read_json import MOST_BYTES, parse_json, read_json, typed


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a": 1, "a": 2}', "the key 'a' is there twice"),
        ("[NaN]", "NaN is no number of JSON"),
        ("[-Infinity]", "-Infinity is no number of JSON"),
        ('{"a": [1, 1e999]}', "'a', entry 1: a number too large for a float"),
        ('{"a": 1' + "0" * 400 + "}", "'a': a whole number beyond 2^63"),
        ("1" + "0" * 5000, "a whole number of thousands of digits"),
        ("[" * 100 + "]" * 100, "more than 64 deep"),
        ("[" * 100_000, "more than 64 deep"),
        ('{"a":' * 100_000, "more than 64 deep"),
        ('{"a": "\\ud800"}', "'a': the text holds the character U+D800"),
        ('{"a\\u0000": 1}', "the key holds the character U+0000"),
        ('["\\u001b[2J"]', "entry 0: the text holds the character U+001B"),
        ("{", "not valid JSON, line 1"),
        ("", "not valid JSON, line 1"),
    ],
)
def test_what_is_not_read(text: str, said: str) -> None:
    with pytest.raises(ValueError, match="file") as caught:
        parse_json(text, "file")
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"\xef\xbb\xbf" + b'{"a": [1, 2.5, "Gr\xc3\xbc\xc3\x9fe\\n", true, null]}')
    assert read_json(path) == {"a": [1, 2.5, "Grüße\n", True, None]}
    path.write_bytes(b" \n")
    with pytest.raises(ValueError, match=r"a\.json: the file is empty"):
        read_json(path)
    path.write_bytes(b'"\xff"')
    with pytest.raises(ValueError, match=r"a\.json: not a text file in UTF-8"):
        read_json(path)
    with path.open("wb") as file:
        file.truncate(MOST_BYTES + 2**20)
    with pytest.raises(ValueError, match=r"a\.json: has 17 MiB, at most 16 are read"):
        read_json(path)
    with pytest.raises(ValueError, match="is no regular file"):
        read_json(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="is no regular file"):
        read_json(tmp_path / "pipe")
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "none.json")


class Side(enum.Enum):
    MOTOR, LINK = "motor", "link"


class Part(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    size: float
    side: Side = Side.MOTOR


class Whole(msgspec.Struct, forbid_unknown_fields=True):
    named: dict[str, Part]
    listed: list[Part] = []
    pair: tuple[float, float] | None = None
    part: Part | None = None


class Open(TypedDict):
    gaps: dict[str, dict[str, float | None]]
    count: int
    note: NotRequired[str]


PART = {"name": "a", "size": 1}


@pytest.mark.parametrize(
    ("value", "kind", "said"),
    [
        ({"named": {"a": PART, "b": {**PART, "size": "x"}}}, Whole, ": 'named', 'b', 'size' must be a number, got 'x'"),
        ({"named": {"a": {**PART, "y": 1}}}, Whole, ": 'named', 'a': unknown keys: y; valid keys: name, size, side"),
        ({"named": {"a": True}}, Whole, ": 'named', 'a' must be an object, got True"),
        ({"listed": []}, Whole, ": missing keys: named; valid keys: named, listed, pair, part"),
        ([], Whole, ": the content must be an object, got []"),
        ({"named": {}, "pair": [1]}, Whole, ": 'pair' must be a list of length 2, got [1]"),
        ({"named": {}, "pair": [1, None]}, Whole, ": 'pair', entry 1 must be a number, got None"),
        ({"named": {}, "listed": [PART, {**PART, "side": "x"}]}, Whole, ", 'side' must be one of motor, link, got 'x'"),
        ({"named": {}, "part": {}}, Whole, ": 'part': missing keys: name, size; valid keys: name, size, side"),
        ({"named": {}, "part": 3}, Whole, ": 'part' must be an object or null, got 3"),
        ({"gaps": {"fit": {"before": "4"}}, "count": 1}, Open, ": 'gaps', 'fit', 'before' must be a number or null"),
        ({"gaps": {"fit": {"before": True}}, "count": 1}, Open, ": 'gaps', 'fit', 'before' must be a number or null"),
        ({"gaps": {}, "count": 1.5}, Open, ": 'count' must be a whole number, got 1.5"),
        ({"gaps": {}}, Open, " lacks 'count'"),
    ],
)
def test_types_are_checked_and_the_place_is_named(value: object, kind: type, said: str) -> None:
    with pytest.raises(ValueError) as caught:
        typed(value, kind, "file")
    assert str(caught.value).startswith("file") and said in str(caught.value)


def test_what_fits_is_converted() -> None:
    whole = typed({"named": {"a": {**PART, "side": "link"}}, "pair": [1, 2]}, Whole, "file")
    assert whole.named["a"].side is Side.LINK and whole.named["a"].size == 1.0 and whole.pair == (1.0, 2.0)
    assert typed({"gaps": {"a": {"b": None}}, "count": 1, "more": 2}, Open, "file")["count"] == 1
