"""The registry of effects: `register` adds to it, `library` makes the effects that a scene can have."""

from __future__ import annotations

import copy
import functools
import importlib
import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from droid_jax.model.effect_interface import LAWS, Effect, has_law
from droid_jax.model.effects.effect_scaling import sized
from droid_jax.model.fields import ENCODER
from droid_jax.model.inertia import PSEUDO_INERTIA, WEIGHTS
from droid_jax.model.joint_friction import GAIN
from droid_jax.model.parameters import Scaling, Space
from droid_jax.model.scene import HARD, TINY_FRICTIONLOSS, Scene, is_soft

Maker = Callable[[Scene], Effect | None]
_MAKERS: dict[str, Maker] = {}


def register(maker: Maker) -> Maker:
    """Register a function Scene -> Effect (or None if the scene cannot have it) under its name.

    Raises ValueError if another function has this name already.
    """
    name = maker.__name__
    known = _MAKERS.get(name)
    if known is not None and (known.__module__, known.__qualname__) != (maker.__module__, maker.__qualname__):
        raise ValueError(f"an effect {name!r} is registered already, by {known.__module__}")
    _MAKERS[name] = maker
    return maker


def registered() -> tuple[str, ...]:
    """Names of all effects, of the library and of the user."""
    package = importlib.import_module("droid_jax.model.effects")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
    return tuple(sorted(_MAKERS))


def library(scene: Scene, names: Iterable[str] | None = None, scale: float = 1.0) -> tuple[Effect, ...]:
    """The effects that a scene can have, in the order of their names.

    Args:
        scene: of the effects.
        names: of the effects; None: all.
        scale: factor on forces and torques of built-in effects, whose sizes are those of a light arm (`sized`).  User
            effects are not scaled.

    Returns:
        The effects at neutral.

    Raises:
        ValueError: a name is unknown, an effect is invalid (`checked`), or the scale is not above zero.
    """
    check_scale(scale)
    known = registered()
    chosen = known if names is None else tuple(names)
    unknown = [n for n in chosen if n not in known]
    if unknown:
        raise ValueError(f"unknown effects {', '.join(unknown)}; valid: {', '.join(known)}")
    effects = (_made(_MAKERS[name], scene, scale) for name in chosen)
    return tuple(effect for effect in effects if effect is not None)


def check_scale(scale: float) -> None:
    """Raise ValueError for a scale of the built-in effects that is not above zero."""
    if not 0.0 < scale < np.inf:
        raise ValueError(f"the scale of the effects must be above 0, got {scale:g}")


def _made(maker: Maker, scene: Scene, scale: float) -> Effect | None:
    made = maker(scene)
    if made is None:
        return None
    effect = checked(made)
    if effect.name != maker.__name__:  # options and files use the function's name
        raise ValueError(
            f"the effect that {maker.__name__!r} makes is called {effect.name!r}: give it the function's name"
        )
    built_in = str(maker.__module__).startswith(f"{__package__}.")  # None for code that was run as text
    return sized(effect, scene, scale) if built_in else effect


def checked(effect: Effect) -> Effect:
    """The effect, if it is valid; else ValueError.

    It must have the parameters that it names.  Coefficients must have mean 0 and linear scaling.  The values of shape
    parameters must be within their bounds.
    """
    parameters = {p.name: p for p in effect.parameters}
    coefficients = [name for of_location in effect.locations.values() for name in of_location]
    for name in (*coefficients, *effect.shape_parameters):
        if name not in parameters:
            raise ValueError(
                f"effect {effect.name!r} names a parameter {name!r} that it does not have; it has: "
                f"{', '.join(parameters)}"
            )
    for p, values in ((parameters[name], values) for name, values in effect.shape_parameters.items()):
        if outside := [v for v in values if not p.low <= v <= p.high]:
            raise ValueError(
                f"effect {effect.name!r}: values of its shape parameter {p.name!r} lie outside its bounds "
                f"[{p.low:g}, {p.high:g}]: {', '.join(f'{v:g}' for v in outside)}"
            )
    for p in (parameters[name] for name in coefficients):
        if p.mean != 0.0:  # `Parameter` checks that the mean is within the bounds
            raise ValueError(
                f"effect {effect.name!r}: a coefficient is neutral at 0, but {p.name!r} starts at {p.mean:g} {p.unit} "
                f"with bounds [{p.low:g}, {p.high:g}]; choose bounds that contain 0, and the mean 0"
            )
        if p.scaling is not Scaling.LINEAR:
            raise ValueError(f"effect {effect.name!r}: the coefficient {p.name!r} must be scaled linearly")
    return effect


@functools.lru_cache(maxsize=16)
def ready(scene: Scene) -> Scene:
    """The scene with a constraint row for dry friction of each measured joint, which an effect may increase.

    MJX lays these rows out at compilation (see TINY_FRICTIONLOSS).  With `Scene.hold` they are hard, as those of joints
    with friction in the MJCF.  The result is cached for each scene.
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

    A law may hold numbers of the scene that it was made for, such as gravity.  What gives its parameters their meaning
    (where a load hangs, the unit of a slope) it takes from `Scene.nominal`.  The parameters stay, and so do effects
    without laws.  Raises ValueError for an effect with a law that such a scene cannot have.
    """
    if not scene.variant:
        return effects
    found = list[Effect]()
    for effect in effects:
        made = _MAKERS[effect.name](scene) if effect.name in _MAKERS else effect
        if made is None and has_law(effect, LAWS):
            raise ValueError(
                f"scene {scene.name!r} with the recording's numbers (variant) cannot have the effect {effect.name!r}: "
                f"leave it out (--without {effect.name})"
            )
        found.append(replace(effect, **{law: getattr(made, law) for law in LAWS}) if made is not None else effect)
    return tuple(found)


def joined(base: Space, effects: Iterable[Effect]) -> Space:
    """The parameters of a base model, followed by those of effects.

    Raises ValueError if a parameter of the base has the name of an effect's.
    """
    effects = tuple(effects)
    effect_of = {p.name: effect.name for effect in effects for p in effect.parameters}
    taken = [f"{name!r} (of the effect {effect_of[name]})" for name in base.names if name in effect_of]
    if taken:
        raise ValueError(
            f"parameters have names that belong to effects of the library: {', '.join(taken)}; rename them (in a "
            'parameter file with "name"), or leave these effects out (gap --without)'
        )
    return base + effect_space(effects)


def beside(base: Space, effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects without those, and without the locations, that parameters of the base model contain already.

    These are gains and encoder offsets of sensors, and loads on a body whose whole inertia is a parameter.
    """
    whole = {w.index[0] for p in base.parameters for w in p.writes if w.field == PSEUDO_INERTIA}
    taken = {f"{term}[{joint}]" for term in (GAIN, ENCODER) for joint in _joints_of(base)} & {*base.names}
    remaining = []
    for effect in effects:
        if any(w.field in WEIGHTS and w.index[0] in whole for p in effect.parameters for w in p.writes):
            continue
        if not taken & {p.name for p in effect.parameters}:
            remaining.append(effect)
            continue
        locations = {at: names for at, names in effect.locations.items() if not taken & {*names}}
        if locations:
            parameters = tuple(p for p in effect.parameters if p.name not in taken)
            remaining.append(replace(effect, locations=locations, parameters=parameters))
    return tuple(remaining)


def _joints_of(base: Space) -> set[str]:
    return {name[name.index("[") + 1 : -1] for name in base.names if name.endswith("]")}


def effect_space(effects: Iterable[Effect]) -> Space:
    """All parameters of effects; its mean is neutral."""
    return Space(tuple(p for effect in effects for p in effect.parameters))
