"""Hidden effects on the synthetic robot, for blind tests of the search for a gap.

Written without knowledge of the library of effects that the search offers: forms, constants and
time step are the synthetic robot's own.  What was hidden stands nowhere in the recording.  The formulas
are in `hidden_door`, `hidden_friction`, `hidden_arm`, `hidden_base` and `hidden_signals`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from droid_jax import runtime
from droid_jax.door.scene import HINGE
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording, TorqueSide
from droid_jax.report.text import label
from droid_jax.report.text import listed as enumerated
from droid_jax.simulate.c_engine import split
from droid_jax.synthetic.arm_effects import ARM_EFFECTS
from droid_jax.synthetic.base_effects import BASE
from droid_jax.synthetic.friction_effects import FRICTION
from droid_jax.synthetic.hinge_effects import DOOR
from droid_jax.synthetic.hooks import Hidden, Influence, Place, Seen, edited, step_through
from droid_jax.synthetic.robot import SyntheticRobot, SyntheticRobotConfig, as_recording, sensor_torque, set_up
from droid_jax.synthetic.signal_effects import SIGNALS

HIDDEN: dict[str, Hidden] = {h.name: h for h in (*DOOR, *FRICTION, *ARM_EFFECTS, *BASE, *SIGNALS)}
# What the library of effects calls them; what is missing here it has no form of.  No two forms are the same, but of
# what has one form only (a base that leans, an encoder's zero), which is computed in another way.
LIBRARY = {
    "hinge_preload": "hinge_preload",
    "binding_spring": "hardening_spring",
    "over_centre": "over_centre_spring",
    "magnetic_catch": "latch",
    "closer": "door_closer",
    "opening_check": "opening_check",
    "air_drag": "drag",
    "floor_friction": "angle_friction",
    "tilted_frame": "tilted_frame",
    "dry_friction": "joint_coulomb",
    "stribeck_friction": "joint_stribeck",
    "directional_friction": "joint_directional",
    "load_friction": "load_friction",
    "mesh_friction": "gear_friction",
    "bristle_friction": "joint_coulomb",
    "warm_up_friction": "joint_coulomb",
    "firm_friction": "soft_friction",
    "payload": "payload",
    "held_thing": "free_payload",
    "cable_pull": "cable_pull",
    "torque_ripple": "torque_ripple",
    "joint_elasticity": "joint_compliance",
    "servo_gains": "servo_gain",
    "grip_compliance": "contact_compliance",
    "tilted_base": "gravity_direction",
    "encoder_zero": "encoder_offset",
    "command_delay": "command_delay",
    "clock_rate": "clock_rate",
    "feedforward": "velocity_feedforward",
    "inner_profile": "profile_acceleration",
    "sensor_delay": "sensor_delay",
    "crosstalk": "torque_crosstalk",
    "torque_bias": "torque_bias",
    "torque_gain": "torque_gain",
    "torque_drift": "torque_drift",
}
# On a hinge these have a name of their own there.
ON_HINGE = {"joint_stribeck": "hinge_stribeck", "joint_directional": "hinge_directional"}
LONGEST_STEP = 0.00025  # s: the explicit torques of hidden effects want a step this short
PAUSE = 5.0  # s between repeats, for what warms up or drifts


@dataclass(frozen=True)
class Applied:
    """One hidden effect at work: amplitude in the effect's unit, on one joint or on all that it can act on.

    joint: "" for every measured joint; the hinge's name puts an effect "on" joints there.
    """

    name: str
    amplitude: float
    joint: str = ""


def record_hidden(
    scene: Scene,
    demonstration: Recording,
    truth: Mapping[str, float],
    effects: Mapping[str, float] | Sequence[Applied],
    *,
    seed: int,
    config: SyntheticRobotConfig | None = None,
    name: str | None = None,
    space: Space | None = None,
) -> Recording:
    """Like `robot.record`, with effects that no parameter of the model stands for.

    effects: amplitudes by name, or by "name[joint]"; or `Applied`.
    config: time steps of more than LONGEST_STEP are refused.
    space: what truth may speak of; the default is a held door's parameters, else offsets and timing.
    Without effects the recording equals `record`'s with the same config bit for bit: the same steps
    of the same model, taken one by one.
    On the link side the torque has passed what the effects put into the gears: friction added to
    measured joints, ripple.
    Raises ValueError for unknown names, joints or amplitudes, and like `record`.
    """
    config = config or SyntheticRobotConfig()
    if config.timestep > LONGEST_STEP * (1 + 1e-9):
        raise ValueError(f"hidden effects need time steps of at most {LONGEST_STEP} s, got {config.timestep}")
    applied = as_applied(effects)
    for one in applied:
        check(one, scene)
    synthetic_robot = set_up(scene, demonstration, truth, seed=seed, config=config, space=space)
    rows, gears, sensors, synthetic_robot = _simulate(synthetic_robot, applied)
    trace = split(synthetic_robot.scene, rows)
    torque = sensor_torque(synthetic_robot, trace)
    if config.side is TorqueSide.LINK:
        torque = torque + gears[..., synthetic_robot.scene.joint_dofs]
    torque, position = _sensed(synthetic_robot, sensors, torque, trace.position)
    return as_recording(synthetic_robot, trace, torque, position, name=name)


def as_applied(effects: Mapping[str, float] | Sequence[Applied]) -> list[Applied]:
    """Amplitudes by name or by "name[joint]" as effects at work; a list of these as it is."""
    if not isinstance(effects, Mapping):
        return list(effects)
    found = []
    for key, amplitude in effects.items():
        match = re.fullmatch(r"([^\[\]]*)(?:\[(.+)\])?", key)
        found.append(Applied(match[1], amplitude, match[2] or "") if match else Applied(key, amplitude))
    return found


def in_words(hide: Sequence[str]) -> str:
    """["magnetic_catch=1.5"] -> "magnetic catch (1.5 N m; in the library: latch)"; empty for nothing."""
    said = []
    for entry in hide:
        name, _, amplitude = entry.partition("=")
        kind, _, joint = name.rstrip("]").partition("[")
        effect, called = HIDDEN.get(kind), LIBRARY.get(kind, "")
        called = ON_HINGE.get(called, called) if joint == HINGE else called
        size = f"{amplitude} {effect.unit}".removesuffix(" -") if effect else amplitude
        library = f"in the library: {label(called).lower()}" if called else "the library has no form of it"
        said.append(f"{label(name).lower()} ({size}; {library})")
    return enumerated(said)


def hidden_effect(name: str) -> Hidden:
    """The effect of that name; ValueError lists the valid ones."""
    if name not in HIDDEN:
        raise ValueError(f"unknown hidden effect {name!r}; there are: {', '.join(sorted(HIDDEN))}")
    return HIDDEN[name]


def possible(scene: Scene) -> tuple[str, ...]:
    """Names of the effects that a scene can have."""
    return tuple(name for name, effect in HIDDEN.items() if _lacks(effect, scene) is None)


def _lacks(effect: Hidden, scene: Scene) -> str | None:
    """What a scene would need and does not have."""
    if effect.on == "hinge" and not scene.object_joint:
        return "an object joint"
    if effect.on == "base" and not scene.model.opt.gravity.any():
        return "gravity"
    if effect.on == "grip" and not (scene.grip and any(scene.grip.fingers)):
        return "a grip"
    return None


def check(one: Applied, scene: Scene) -> None:
    """ValueError for an effect that is unknown, an amplitude it cannot have, a scene or joint it cannot act on."""
    effect = hidden_effect(one.name)
    if not math.isfinite(one.amplitude) or (one.amplitude < 0 and not effect.signed):
        least = "a finite" if effect.signed else "a finite, not negative"
        raise ValueError(f"hidden effect {one.name!r} needs {least} amplitude, got {one.amplitude}")
    lacks = _lacks(effect, scene)
    if lacks:
        raise ValueError(f"hidden effect {one.name!r} needs a scene with {lacks}; {scene.name!r} has none")
    valid = _joints(effect, scene)
    if one.joint and one.joint not in valid:
        known = ", ".join(valid) or "none"
        raise ValueError(f"hidden effect {one.name!r} cannot act on joint {one.joint!r}; it can on: {known}")


def _joints(effect: Hidden, scene: Scene) -> tuple[str, ...]:
    """Joints an effect can be put on by name."""
    if effect.on == "arm":
        return scene.joints
    if effect.on == "joint":
        return tuple(dict.fromkeys((*scene.joints, *([scene.object_joint] if scene.object_joint else []))))
    return ()


def at_work(scene: Scene, applied: Sequence[Applied], repeat: int = 0, period: float = 0.0) -> list[Influence]:
    """The effects of one repeat, each with a fresh state; repeat and period as in `Place`."""
    places = [Place(scene, (one.joint,) if one.joint else scene.joints, repeat, period) for one in applied]
    return [HIDDEN[one.name].make(place, one.amplitude) for one, place in zip(applied, places, strict=True)]


def _simulate(
    synthetic_robot: SyntheticRobot, applied: Sequence[Applied]
) -> tuple[np.ndarray, np.ndarray, list[list[Influence]], SyntheticRobot]:
    """Sensor rows [N, T, S], torques in the gears [N, T, nv] (N m; only for the link side), the
    effects of every repeat, and the synthetic robot with the models that they edited."""
    count = len(synthetic_robot.models)
    since = synthetic_robot.clock - synthetic_robot.clock[0]
    period = float(since[-1]) + PAUSE
    effects = [at_work(synthetic_robot.scene, applied, repeat, period) for repeat in range(count)]
    models = [edited(model, own) for model, own in zip(synthetic_robot.models, effects, strict=True)]
    link = synthetic_robot.config.side is TorqueSide.LINK
    gears = np.zeros((count, len(synthetic_robot.clock) if link else 0, synthetic_robot.scene.model.nv))

    def one(repeat: int) -> np.ndarray:
        control = synthetic_robot.control
        for influence in effects[repeat]:
            if influence.command:
                control = influence.command(since, control)
        qpos0, own = synthetic_robot.qpos0[repeat], gears[repeat] if link else None
        return step_through(models[repeat], qpos0, control, effects[repeat], own)

    with ThreadPoolExecutor(max_workers=min(count, runtime.cores())) as pool:
        rows = np.stack(list(pool.map(one, range(count))))
    return rows, gears, effects, replace(synthetic_robot, models=models)


def _sensed(
    synthetic_robot: SyntheticRobot, effects: Sequence[Sequence[Influence]], torque: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Torque and position [N, T, J] behind the effects on the sensors."""
    seen = []
    for repeat, own in enumerate(effects):
        now = Seen(synthetic_robot.clock - synthetic_robot.clock[0], torque[repeat], position[repeat])
        for influence in own:
            now = influence.sense(now) if influence.sense else now
        seen.append(now)
    return np.stack([s.torque for s in seen]), np.stack([s.position for s in seen])
