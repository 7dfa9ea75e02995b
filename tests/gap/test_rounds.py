"""Which of several models leads."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from droid_jax.gap.candidates import Candidate
from droid_jax.gap.rounds import plainest


def model(effect: str, amplitudes: int, shapes: int, left: float) -> Any:
    names = tuple(f"{effect}_{k}" for k in range(amplitudes))
    part = Candidate(effect, "slide", names, {f"{effect}_shape_{k}": 1.0 for k in range(shapes)})
    return SimpleNamespace(parts=(part,), name=part.name), SimpleNamespace(gap_confirm=left)


def test_the_fewest_parameters_lead_and_among_equals_the_smallest_gap() -> None:
    stribeck, coulomb, bias = (
        model(*args) for args in (("stribeck", 1, 2, 0.140), ("coulomb", 1, 0, 0.148), ("bias", 1, 0, 0.15))
    )
    assert plainest([stribeck, coulomb, bias]) == coulomb
    assert plainest([stribeck]) == stribeck
