"""Which of the models on trial wins a round."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.select import ValidationTest
from droid_jax.model.effect_interface import Effect

PLAIN = 1.25  # times what the best leaves above the floor: up to here a plainer model is preferred
NOTHING = 0.01  # share of the first gap that is no difference
GENERAL = 0.9  # times what an effect leaves above the floor, below which one that holds it as a special case must get

TestedModel = tuple[FittedModel, ValidationTest]


def selected(judged: Sequence[TestedModel], floor: float, whole_gap: float) -> TestedModel | None:
    """The model that does best on the validation demonstration; of those that do about as well, the simplest.

    None where what does best is too weak: nothing worse is named instead.
    """
    standing = [(m, t) for m, t in judged if t.passed or t.weak]
    _, chosen = min(standing, key=lambda mt: mt[1].discrepancy_validation, default=(None, None))
    if chosen is None or chosen.weak:
        return None
    enough = floor + PLAIN * max(chosen.discrepancy_validation - floor, 0.0) + NOTHING * whole_gap
    alike = [(m, t) for m, t in standing if t.passed and t.name in (chosen.name, *chosen.indistinguishable)]
    return simplest([(m, t) for m, t in alike if t.discrepancy_validation <= enough])


def simplest(tied: Sequence[TestedModel]) -> TestedModel:
    """Of models that do as well, the one with the fewest parameters: a flexible form mimics a plain one."""
    return min(tied, key=lambda mt: (sum(len(c.free) for c in mt[0].parts), mt[1].discrepancy_validation))


def without_dominated(
    judged: Sequence[TestedModel], winner: TestedModel, effects: Sequence[Effect], floor: float
) -> list[ValidationTest]:
    """The trials; those that hold the winner as a special case and leave no less have lost, and are no rivals."""
    plain, chosen = winner
    left = floor + GENERAL * max(chosen.discrepancy_validation - floor, 0.0)
    general = special_cases_of(effects, plain, [m for m, _ in judged])
    idle = f"holds {plain.name} as a special case and leaves no less"
    return [
        replace(t, reasons=(idle,), weak=False)
        if more and max(t.discrepancy_validation, floor) >= left and (t.passed or t.weak)
        else t
        for (_, t), more in zip(judged, general, strict=True)
    ]


def special_cases_of(effects: Sequence[Effect], plain: FittedModel, models: Sequence[FittedModel]) -> list[bool]:
    """Which models are a plain one but for effects that hold one of its own, at the same place, as a special case."""
    holds = {e.name: e.special_cases for e in effects}

    def more_general(model: FittedModel) -> bool:
        ours, theirs = ({(c.effect, c.location) for c in m.parts} for m in (plain, model))
        own, other = tuple(ours - theirs), itertools.permutations(theirs - ours)
        pairs = (zip(own, order, strict=True) for order in other if 0 < len(own) == len(order))
        return any(all(a[1] == b[1] and a[0] in holds[b[0]] for a, b in some) for some in pairs)

    return [more_general(m) for m in models]
