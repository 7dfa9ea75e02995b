"""Candidates of a search: an effect at a location, with values of its shape parameters."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from droid_jax.model.effect_interface import Effect


@dataclass(frozen=True, order=True)
class EffectKey:
    """An effect at a location, optionally with values of its shape parameters.

    Attributes:
        effect: its name.
        location: a key of `Effect.locations`.
        shape: (shape parameter, value) pairs, sorted; empty if the shape does not matter.
    """

    effect: str
    location: str
    shape: tuple[tuple[str, float], ...] = ()

    def __str__(self) -> str:
        """Text for messages, such as "latch at door_hinge"."""
        return f"{self.effect} at {self.location}"


Keys = tuple[EffectKey, ...]  # the effects of a model


def names_of(keys: Iterable[EffectKey]) -> str:
    """Text for messages, such as "latch at door_hinge + drag at door_hinge"."""
    return " + ".join(map(str, keys))


@dataclass(frozen=True)
class Candidate:
    """An effect at a location, with values of its shape parameters.

    Attributes:
        effect: its name.
        location: a key of `Effect.locations`.
        coefficients: names of its coefficients there.
        shape_parameters: name -> value.
    """

    effect: str
    location: str
    coefficients: tuple[str, ...]
    shape_parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def key(self) -> EffectKey:
        """The effect and the location."""
        return EffectKey(self.effect, self.location)

    @property
    def shaped_key(self) -> EffectKey:
        """The effect, the location and the shape."""
        return EffectKey(self.effect, self.location, tuple(sorted(self.shape_parameters.items())))

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that a refit frees."""
        return (*self.coefficients, *self.shape_parameters)


def keys_of(parts: Iterable[Candidate]) -> Keys:
    """The effects and locations of candidates."""
    return tuple(part.key for part in parts)


def candidates(effects: Iterable[Effect]) -> tuple[Candidate, ...]:
    """All effects at all their locations, with all combinations of their shape parameters' values.

    Raises:
        ValueError: there are none.
    """
    out = []
    for effect in effects:
        grid = [
            dict(zip(effect.shape_parameters, values, strict=True))
            for values in itertools.product(*effect.shape_parameters.values())
        ]
        for (location, coefficients), shape in itertools.product(effect.locations.items(), grid):
            out.append(Candidate(effect.name, location, coefficients, shape))
    if not out:
        raise ValueError(
            "effects: there is nothing to test, since none of the effects states its locations (`Effect.locations`)"
        )
    return tuple(out)
