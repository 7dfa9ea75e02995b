"""Damaged files and wrong arguments, drawn by hypothesis: each is refused in one line that names it, or is of use.

    python -m pytest -m fuzz tests/fuzz                           a minute, the same inputs every time
    FUZZ_EXAMPLES=2000 python -m pytest -m fuzz tests/fuzz        more, drawn anew

`benchmarks/robustness.py` tries thousands of them in processes of their own, under a watchdog.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from random import Random

import api_calls
import pytest
import run_kinds
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from kinds import Kind, attempt, attempt_valid
from mutate_json import dump, mutate_json, parse
from outcome import MOST_MEMORY, judged

pytestmark = pytest.mark.fuzz

ASKED = os.environ.get("FUZZ_EXAMPLES")
EXAMPLES = int(ASKED or 25)
CALLS = int(ASKED or 400)
RANDOM = st.randoms(use_true_random=False)


def tried(examples: int) -> Callable[[Callable], Callable]:
    """The settings of a test that tries so many inputs; the same ones every time unless a number is asked for."""
    unwanted = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    return settings(
        max_examples=examples, derandomize=not ASKED, deadline=None, database=None, suppress_health_check=unwanted
    )


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Kind], Path]:
    """Makes the folder with a kind's valid example, once."""
    made: dict[str, Path] = {}

    def folder(kind: Kind) -> Path:
        if kind.name not in made:
            made[kind.name] = tmp_path_factory.mktemp("valid")
            kind.make(made[kind.name])
        return made[kind.name]

    return folder


QUICK = [name for name, kind in run_kinds.EVERY.items() if not kind.drawn]


@pytest.mark.parametrize("name", QUICK)
def test_a_damaged_file_is_refused_in_a_sentence_or_is_of_use(
    name: str, valid: Callable[[Kind], Path], tmp_path: Path
) -> None:
    kind = run_kinds.EVERY[name]
    outcome = attempt_valid(kind, valid(kind), tmp_path / "input")
    assert outcome.result == "accepted", outcome

    @tried(EXAMPLES)
    @given(RANDOM)
    def check(random: Random) -> None:
        outcome = attempt(kind, valid(kind), tmp_path / "input", random)
        assert not outcome.fault, outcome

    check()


def test_a_wrong_argument_is_named(tmp_path: Path) -> None:
    calls = api_calls.calls(tmp_path)
    cases = api_calls.cases(calls)

    @tried(CALLS)
    @given(st.sampled_from(cases), st.none() | RANDOM)
    def check(case: tuple[int, str, int], random: Random | None) -> None:
        call, argument, wrong = case
        outcome = api_calls.attempt(calls[call], argument, wrong, random)
        assert not outcome.fault, (calls[call].name, argument, api_calls.WRONG[wrong], outcome)

    check()


# ---------------------------------------------------------------- the harness itself


def test_every_kind_of_fault_is_seen() -> None:
    def raised(error: Exception) -> str:
        def call() -> None:
            raise error

        return judged(call, ("a.json",)).result

    assert judged(lambda: None, ()).result == "accepted"
    assert raised(ValueError("a.json: no number")) == "refused"
    assert raised(KeyError("a.json")) == raised(RecursionError("a.json")) == "foreign"
    assert raised(ValueError("no number")) == raised(ValueError("a.json: " + "x" * 2000)) == "message"
    assert raised(ValueError("a.json:\nno number")) == raised(ValueError("a.json: \x1b")) == "message"
    assert raised(MemoryError()) == "memory"


def test_memory_in_use_is_seen() -> None:
    def take() -> None:
        bytearray(MOST_MEMORY + (1 << 26))

    assert judged(take, ()).result == "memory"


def test_a_json_text_survives_without_a_change() -> None:
    text = '{"a": [1, 2.5, null, {"b": "\\u00e9"}], "c": {}}'
    assert dump(parse(text)) == text
    assert mutate_json(Random(1), text.encode()) == mutate_json(Random(1), text.encode())
