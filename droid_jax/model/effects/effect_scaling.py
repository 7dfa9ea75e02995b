"""Scale the library's effects, whose sizes are those of a light arm, to another machine."""

from __future__ import annotations

from dataclasses import replace

from droid_jax.model.effect_interface import Effect
from droid_jax.model.parameters import Parameter
from droid_jax.model.scene import Scene

TORQUE = "N m"
LENGTHS = (("(N m)", "N"), (TORQUE, "N"), ("rad", "m"), ("turn", "(2 pi m)"))  # units at hinges -> at slides


def sized(effect: Effect, scene: Scene, scale: float) -> Effect:
    """An effect with the torques' priors, bounds and minimum effect size multiplied by `scale`.

    Coefficients that are no torques (masses, gains, delays) are unchanged.  At slides units are N and m in place of N m
    and rad; those of shape parameters if all locations of the effect are slides.
    """
    location_of = {name: location for location, names in effect.locations.items() for name in names}
    slides = {name: _is_slide(scene, location) for name, location in location_of.items()}
    shapes = bool(slides) and all(slides.values())
    torques = {p.name for p in effect.parameters if p.name in location_of and p.unit.startswith(TORQUE)}
    parameters = (_sized(p, scale if p.name in torques else 1.0, slides.get(p.name, shapes)) for p in effect.parameters)
    return replace(effect, parameters=tuple(parameters), minimum_size=effect.minimum_size * (scale if torques else 1.0))


def _sized(p: Parameter, scale: float, slide: bool) -> Parameter:
    unit = p.unit
    for old, new in LENGTHS if slide else ():
        unit = unit.replace(old, new)
    return replace(p, unit=unit, std=scale * p.std, low=scale * p.low, high=scale * p.high)


def _is_slide(scene: Scene, location: str) -> bool:
    """Whether a location is a slide; it may also be a hinge, "commands", "grip" or a body."""
    return location in scene.joints and scene.slides(location)
