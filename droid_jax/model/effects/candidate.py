"""An effect at a location, with a shape: what a model may lack, and what a fitted model may have."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from droid_jax.model.effect_interface import Effect


@dataclass(frozen=True, order=True)
class EffectKey:
    """Which effect, where, and in which shape; no shape where only the location matters.

    effect: its name.
    location: a key of `Effect.locations`.
    shape: (shape parameter, value) pairs, sorted.
    """

    effect: str
    location: str
    shape: tuple[tuple[str, float], ...] = ()

    def __str__(self) -> str:
        """ "latch at door_hinge": for people; nothing reads it back."""
        return f"{self.effect} at {self.location}"


Keys = tuple[EffectKey, ...]  # the effects of a model


def names_of(keys: Iterable[EffectKey]) -> str:
    """ "latch at door_hinge + drag at door_hinge": for people."""
    return " + ".join(map(str, keys))


@dataclass(frozen=True)
class Candidate:
    """An effect at a location.

    coefficients: names of the parameters that make it.
    shape_parameters: name -> value tried.
    """

    effect: str
    location: str
    coefficients: tuple[str, ...]
    shape_parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def key(self) -> EffectKey:
        """Which effect, and where."""
        return EffectKey(self.effect, self.location)

    @property
    def shaped_key(self) -> EffectKey:
        """Which effect, where, and in which shape."""
        return EffectKey(self.effect, self.location, tuple(sorted(self.shape_parameters.items())))

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that a refit frees."""
        return (*self.coefficients, *self.shape_parameters)


def keys_of(parts: Iterable[Candidate]) -> Keys:
    """Which effects, and where."""
    return tuple(part.key for part in parts)


def candidates(effects: Iterable[Effect]) -> tuple[Candidate, ...]:
    """Every effect at every location with every combination of its shape parameters' values.

    Raises:
        ValueError: there is none at all.
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
