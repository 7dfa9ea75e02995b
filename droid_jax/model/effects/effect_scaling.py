"""The library's sizes are a light arm's; here they become those of another machine."""

from __future__ import annotations

from dataclasses import replace

from droid_jax.model.effect_interface import Effect
from droid_jax.model.parameters import Parameter
from droid_jax.model.scene import Scene

TORQUE = "N m"
LENGTHS = (("(N m)", "N"), (TORQUE, "N"), ("rad", "m"), ("turn", "(2 pi m)"))  # units at hinges and at slides


def sized(effect: Effect, scene: Scene, scale: float) -> Effect:
    """An effect whose forces and torques are `scale` times the library's: priors, bounds and the minimum effect size.

    Amplitudes that are no torques (masses, gains, delays) stay as they are.  At slides a torque is a force, in N, and
    an angle a way, in m; shapes are in these units where all places of the effect are slides.
    """
    of = {name: place for place, names in effect.locations.items() for name in names}
    slides = {name: _is_slide(scene, place) for name, place in of.items()}
    shapes = bool(slides) and all(slides.values())
    torques = {p.name for p in effect.parameters if p.name in of and p.unit.startswith(TORQUE)}
    parameters = (_sized(p, scale if p.name in torques else 1.0, slides.get(p.name, shapes)) for p in effect.parameters)
    return replace(effect, parameters=tuple(parameters), minimum_size=effect.minimum_size * (scale if torques else 1.0))


def _sized(p: Parameter, scale: float, slide: bool) -> Parameter:
    unit = p.unit
    for old, new in LENGTHS if slide else ():
        unit = unit.replace(old, new)
    return replace(p, unit=unit, std=scale * p.std, low=scale * p.low, high=scale * p.high)


def _is_slide(scene: Scene, place: str) -> bool:
    """Whether a place is a joint that slides; places may also be "commands", "grip" or a body."""
    return place in scene.joints and scene.slides(place)
