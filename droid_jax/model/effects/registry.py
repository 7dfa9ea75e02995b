"""The one list of effects: `register` adds to it, `library` makes what a scene can have."""

from __future__ import annotations

import copy
import functools
import importlib
import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from droid_jax.model.effect_interface import LAWS, Effect
from droid_jax.model.effects.effect_scaling import sized
from droid_jax.model.fields import ENCODER
from droid_jax.model.inertia import PSEUDO_INERTIA, WEIGHTS
from droid_jax.model.joint_friction import GAIN
from droid_jax.model.parameters import Scaling, Space
from droid_jax.model.scene import HARD, TINY_FRICTIONLOSS, Scene, is_soft

Maker = Callable[[Scene], Effect | None]
_MAKERS: dict[str, Maker] = {}


def register(maker: Maker) -> Maker:
    """Add a maker, Scene -> Effect or None where the scene cannot have it, under its function's name.

    Raises ValueError for a name that another function has taken.
    """
    name = maker.__name__
    known = _MAKERS.get(name)
    if known is not None and (known.__module__, known.__qualname__) != (maker.__module__, maker.__qualname__):
        raise ValueError(f"an effect {name!r} is registered already, by {known.__module__}")
    _MAKERS[name] = maker
    return maker


def registered() -> tuple[str, ...]:
    """Names of all effects, built in and added."""
    package = importlib.import_module("droid_jax.model.effects")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
    return tuple(sorted(_MAKERS))


def library(scene: Scene, names: Iterable[str] | None = None, scale: float = 1.0) -> tuple[Effect, ...]:
    """The effects that a scene can have, in the order of their names; `names` chooses some.

    scale: forces and torques of the built-in effects relative to a light arm's, see `sized`; those of your own have
    the size they were given.

    Raises ValueError for unknown names, listing the valid ones, for an effect that is not well made, and for a scale
    that is not above zero.
    """
    check_scale(scale)
    known = registered()
    chosen = known if names is None else tuple(names)
    unknown = [n for n in chosen if n not in known]
    if unknown:
        raise ValueError(f"unknown effects {', '.join(unknown)}; valid: {', '.join(known)}")
    made = (_made(_MAKERS[name], scene, scale) for name in chosen)
    return tuple(effect for effect in made if effect is not None)


def check_scale(scale: float) -> None:
    """ValueError for a scale of the built-in effects that is not above zero."""
    if not 0.0 < scale < np.inf:
        raise ValueError(f"the scale of the effects must be above 0, got {scale:g}")


def _made(maker: Maker, scene: Scene, scale: float) -> Effect | None:
    made = maker(scene)
    if made is None:
        return None
    effect = checked(made)
    if effect.name != maker.__name__:  # by which it is asked for, left out and loaded again
        raise ValueError(
            f"the effect that {maker.__name__!r} makes is called {effect.name!r}: give it the function's name"
        )
    built_in = str(maker.__module__).startswith(f"{__package__}.")  # None for code that was run as text
    return sized(effect, scene, scale) if built_in else effect


def checked(effect: Effect) -> Effect:
    """The effect; ValueError where it is not well made.

    It must have the parameters that it speaks of, coefficients that are neutral at 0 and linear, and shapes whose
    values to try lie within their bounds.
    """
    own = {p.name: p for p in effect.parameters}
    coefficients = [name for place in effect.locations.values() for name in place]
    for name in (*coefficients, *effect.shape_parameters):
        if name not in own:
            raise ValueError(
                f"effect {effect.name!r} speaks of a parameter {name!r} that it does not have; it has: {', '.join(own)}"
            )
    for p, values in ((own[name], values) for name, values in effect.shape_parameters.items()):
        if strange := [v for v in values if not p.low <= v <= p.high]:
            raise ValueError(
                f"effect {effect.name!r}: values to try of its shape {p.name!r} lie outside its bounds "
                f"[{p.low:g}, {p.high:g}]: {', '.join(f'{v:g}' for v in strange)}"
            )
    for p in (own[name] for name in coefficients):
        if p.mean != 0.0:  # `Parameter` itself sees that the mean lies within the bounds
            raise ValueError(
                f"effect {effect.name!r}: a coefficient is neutral at 0, but {p.name!r} starts at {p.mean:g} {p.unit} "
                f"with bounds [{p.low:g}, {p.high:g}]; let its bounds hold 0 and its mean be 0"
            )
        if p.scaling is not Scaling.LINEAR:
            raise ValueError(f"effect {effect.name!r}: the coefficient {p.name!r} must be scaled linearly")
    return effect


@functools.lru_cache(maxsize=16)
def ready(scene: Scene) -> Scene:
    """The scene with a friction row for every joint whose friction an effect may raise; one for one scene.

    MJX lays these rows out at compilation (see TINY_FRICTIONLOSS); they cost a little time each.  Where the scene holds
    friction (`Scene.hold`), they are as hard as those of joints with friction of their own.
    """
    model = copy.copy(scene.model)
    dofs = [scene.dof(j) for j in scene.joints]
    model.dof_frictionloss[dofs] = np.maximum(model.dof_frictionloss[dofs], TINY_FRICTIONLOSS)
    rows: list[str] = list(dict.fromkeys((*scene.joints, *([scene.object_joint] if scene.object_joint else []))))
    soft = tuple(j for j in rows if scene.hold and is_soft(scene.spec.joint(j)))
    spec = scene.spec.copy() if soft else scene.spec
    for joint in soft:
        spec.joint(joint).solimp_friction[:2] = HARD
        model.dof_solimp[scene.dof(joint), :2] = HARD
    return replace(scene, model=model, spec=spec, held=(*scene.held, *soft))


@functools.lru_cache(maxsize=64)
def in_variant(scene: Scene, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """The effects with the laws that they have in a scene with the numbers of one recording (`model.variant`).

    A law may hold numbers of the scene that it was made for, such as where a load hangs.  Their parameters stay.
    Raises ValueError for an effect that such a scene cannot have.
    """
    if not scene.variant:
        return effects
    found = list[Effect]()
    for effect in effects:
        made = _MAKERS[effect.name](scene) if effect.name in _MAKERS else effect
        if made is None:
            raise ValueError(f"scene {scene.name!r} cannot have the effect {effect.name!r} with a recording's variant")
        found.append(replace(effect, **{law: getattr(made, law) for law in LAWS}))
    return tuple(found)


def joined(base: Space, effects: Iterable[Effect]) -> Space:
    """A base model's parameters, and then all of some effects'.

    Raises ValueError, with what to do, where one of the base has the name of an effect's.
    """
    effects = tuple(effects)
    whose = {p.name: effect.name for effect in effects for p in effect.parameters}
    taken = [f"{name!r} (of the effect {whose[name]})" for name in base.names if name in whose]
    if taken:
        raise ValueError(
            f"parameters have names that belong to effects of the library: {', '.join(taken)}; give yours others, in a "
            'file of parameters with "name", or leave these effects away (gap --without)'
        )
    return base + effect_space(effects)


def beside(base: Space, effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects less their locations where the base has the sensor parameters that they would test.

    A sensor's gain or an encoder's offset that is fitted as a parameter is no missing effect there, and neither is a
    load on a body whose whole inertia is one.
    """
    whole = {w.index[0] for p in base.parameters for w in p.writes if w.field == PSEUDO_INERTIA}
    taken = {f"{term}[{joint}]" for term in (GAIN, ENCODER) for joint in _joints_of(base)} & {*base.names}
    found = []
    for effect in effects:
        if any(w.field in WEIGHTS and w.index[0] in whole for p in effect.parameters for w in p.writes):
            continue
        if not taken & {p.name for p in effect.parameters}:
            found.append(effect)
            continue
        places = {at: names for at, names in effect.locations.items() if not taken & {*names}}
        if places:
            left = tuple(p for p in effect.parameters if p.name not in taken)
            found.append(replace(effect, locations=places, parameters=left))
    return tuple(found)


def _joints_of(base: Space) -> set[str]:
    return {name[name.index("[") + 1 : -1] for name in base.names if name.endswith("]")}


def effect_space(effects: Iterable[Effect]) -> Space:
    """All parameters of some effects; its mean is neutral."""
    return Space(tuple(p for effect in effects for p in effect.parameters))
