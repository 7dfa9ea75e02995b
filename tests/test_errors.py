"""What errors of several layers say alike."""

from __future__ import annotations

from droid_jax.errors import faults, named


def test_names_of_a_file_are_told_printable_and_cut():
    assert named(["a", "b"]) == "a, b"
    assert named(map(str, range(25))).endswith("18, 19 and 5 more")
    told = faults({"unknown:": ["z" * 100_000, "\x1b[31m"], "missing:": []})
    assert told.startswith("unknown: zzz") and len(told) < 200 and told.isprintable()
