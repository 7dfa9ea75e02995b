"""What the search for a missing effect asks about: an effect, at a place, with a shape."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import library
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

STEERED = ("actuator_", "dof_sol", "pair_")  # how model fields begin that inverse dynamics does not read


@dataclass(frozen=True)
class Candidate:
    """An effect at a place.

    coefficients: names of the parameters that make it; shape_parameters: name -> value tried.
    """

    effect: str
    location: str
    coefficients: tuple[str, ...]
    shape_parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """ "latch at door_hinge"."""
        return f"{self.effect} at {self.location}"

    @property
    def key(self) -> tuple[Any, ...]:
        """Tells candidates apart, shapes included."""
        return self.effect, self.location, *sorted(self.shape_parameters.items())

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that a refit frees."""
        return (*self.coefficients, *self.shape_parameters)


def joined_names(parts: Iterable[Candidate]) -> str:
    """ "latch at door_hinge + drag at door_hinge"."""
    return " + ".join(part.name for part in parts)


def observable_effects(scene: Scene, recordings: Iterable[Recording], scale: float = 1.0) -> tuple[Effect, ...]:
    """The library's effects that could show in these recordings: in one without commands all but `steers`.

    scale: of their forces and torques, see `library`.
    """
    commanded = all(r.command.size for r in recordings)
    return tuple(e for e in library(scene, scale=scale) if commanded or not acts_on_commands_only(e))


def acts_on_commands_only(effect: Effect) -> bool:
    """Whether an effect is one of commands, servos or constraints alone, which a prescribed motion does not have.

    Also one without laws of its own whose parameters write nothing but fields of these (`servo_gain`, `soft_friction`).
    """
    if effect.command or effect.servo:
        return True
    fields = [w.field for p in effect.parameters for w in p.writes]
    laws = (effect.force, effect.frictionloss, effect.observe)
    acts = any(laws) or not all(p.writes for p in effect.parameters)
    return bool(fields) and not acts and all(field.startswith(STEERED) for field in fields)


def candidates(effects: Iterable[Effect]) -> tuple[Candidate, ...]:
    """Every effect at every place with every combination of its shapes' values.

    Raises ValueError where that is none at all.
    """
    out = []
    for effect in effects:
        grid = [
            dict(zip(effect.shape_parameters, values, strict=True))
            for values in itertools.product(*effect.shape_parameters.values())
        ]
        for (place, amplitudes), shapes in itertools.product(effect.locations.items(), grid):
            out.append(Candidate(effect.name, place, amplitudes, shapes))
    if not out:
        raise ValueError(
            "effects: there is nothing to ask about, none of the effects says its locations (`Effect.locations`)"
        )
    return tuple(out)
