"""Record the synthetic robot with hidden effects, for blind tests of the search for missing effects.

Their formulas, constants and time step are independent of the library of effects that the search uses.  A recording
does not say what was hidden.  The formulas are in `hinge_effects`, `friction_effects`, `arm_effects`, `drive_effects`,
`base_effects` and `signal_effects`.
"""

from __future__ import annotations

import itertools
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
from droid_jax.synthetic.drive_effects import DRIVES
from droid_jax.synthetic.friction_effects import FRICTION
from droid_jax.synthetic.hinge_effects import DOOR
from droid_jax.synthetic.hooks import Hidden, Influence, Place, SensorInput, edited, step_through
from droid_jax.synthetic.robot import SyntheticRobot, SyntheticRobotConfig, as_recording, sensor_torque, set_up
from droid_jax.synthetic.signal_effects import SIGNALS

HIDDEN: dict[str, Hidden] = {h.name: h for h in (*DOOR, *FRICTION, *ARM_EFFECTS, *DRIVES, *BASE, *SIGNALS)}
# Hidden effect -> the corresponding effect of the library; effects that are missing here have none.  The formulas
# differ, except for a tilted base and an encoder's zero, which have one form only and are computed in another way.
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
    "resonance": "two_mass_resonance",
    "free_play": "two_mass_backlash",
    "torque_line": "torque_speed_line",
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
# Effect of the library -> its name on the object's hinge.
ON_HINGE = {"joint_stribeck": "hinge_stribeck", "joint_directional": "hinge_directional"}
OWN_MOTOR = ("resonance", "free_play")  # whose motors are simulated by themselves
# What would have to act on those motors.
BESIDE_NONE = frozenset(
    {*OWN_MOTOR, "servo_gains", "joint_elasticity", "torque_line", "load_friction", "mesh_friction", "encoder_zero"}
)
LONGEST_STEP = 0.00025  # s, for a stable integration of the explicit torques of hidden effects
PAUSE = 5.0  # s between repeats, for effects that warm up or drift


@dataclass(frozen=True)
class Applied:
    """A hidden effect with its amplitude.

    Attributes:
        name: of the effect.
        amplitude: in the effect's unit (`Hidden.unit`).
        joint: on which it acts; "" for all measured joints.  A friction effect may act on the object's hinge.
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
    """Record the synthetic robot with effects that the model has no parameters for.

    Without effects the recording equals that of `robot.record` with the same configuration bit for bit.  A link-side
    torque includes what effects add in the gears: friction of measured joints and ripple.

    Args:
        scene: what moves.
        demonstration: to be repeated.
        truth: hidden values by parameter name, as for `robot.record`.
        effects: amplitudes by name or by "name[joint]", or a list of `Applied`.
        seed: of all randomness.
        config: of the robot; its time step must be at most LONGEST_STEP.
        name: of the recording; None: the demonstration's.
        space: the parameters that truth may name; None: those of a held door, else torque offsets and the time offset.

    Returns:
        The recording.

    Raises:
        ValueError: an effect, joint or amplitude is unknown or invalid, or as in `robot.record`.
    """
    config = config or SyntheticRobotConfig()
    if config.timestep > LONGEST_STEP * (1 + 1e-9):
        raise ValueError(f"hidden effects need time steps of at most {LONGEST_STEP} s, got {config.timestep}")
    applied = as_applied(effects)
    for one in applied:
        check(one, scene)
    _check_motors(applied)
    # A motor that is simulated by itself comes first: what other effects do to its sensors, they do to its readings.
    applied = sorted(applied, key=lambda one: one.name not in OWN_MOTOR)
    synthetic_robot = set_up(scene, demonstration, truth, seed=seed, config=config, space=space)
    rows, gears, sensors, synthetic_robot = _simulate(synthetic_robot, applied)
    trace = split(synthetic_robot.scene, rows)
    torque = sensor_torque(synthetic_robot, trace)
    if config.side is TorqueSide.LINK:
        torque = torque + gears[..., synthetic_robot.scene.joint_dofs]
    torque, position = _sensed(synthetic_robot, sensors, torque, trace.position)
    return as_recording(synthetic_robot, trace, torque, position, name=name)


def as_applied(effects: Mapping[str, float] | Sequence[Applied]) -> list[Applied]:
    """Amplitudes by name or by "name[joint]" as a list of `Applied`; a sequence of these is copied."""
    if not isinstance(effects, Mapping):
        return list(effects)
    applied = []
    for key, amplitude in effects.items():
        match = re.fullmatch(r"([^\[\]]*)(?:\[(.+)\])?", key)
        applied.append(Applied(match[1], amplitude, match[2] or "") if match else Applied(key, amplitude))
    return applied


def in_words(hide: Sequence[str]) -> str:
    """["magnetic_catch=1.5"] -> "magnetic catch (1.5 N m; in the library: latch)"; empty for an empty list."""
    phrases = []
    for entry in hide:
        name, _, amplitude = entry.partition("=")
        effect_name, _, joint = name.rstrip("]").partition("[")
        effect, in_library = HIDDEN.get(effect_name), LIBRARY.get(effect_name, "")
        in_library = ON_HINGE.get(in_library, in_library) if joint == HINGE else in_library
        size = f"{amplitude} {effect.unit}".removesuffix(" -") if effect else amplitude
        library = f"in the library: {label(in_library).lower()}" if in_library else "not in the library"
        phrases.append(f"{label(name).lower()} ({size}; {library})")
    return enumerated(phrases)


def _check_motors(applied: Sequence[Applied]) -> None:
    """Raise ValueError for effects that would have to act on a motor that another one simulates."""
    for alone, other in itertools.permutations(applied, 2):
        meet = not alone.joint or not other.joint or alone.joint == other.joint
        if alone.name in OWN_MOTOR and other.name in BESIDE_NONE and meet:
            raise ValueError(
                f"hidden effects {alone.name!r} and {other.name!r} cannot act on one joint: the first one simulates "
                "its motor, without the other"
            )


def hidden_effect(name: str) -> Hidden:
    """The effect of that name; ValueError lists the valid ones."""
    if name not in HIDDEN:
        raise ValueError(f"unknown hidden effect {name!r}; there are: {', '.join(sorted(HIDDEN))}")
    return HIDDEN[name]


def possible(scene: Scene) -> tuple[str, ...]:
    """Names of the effects that a scene can have."""
    return tuple(name for name, effect in HIDDEN.items() if _lacks(effect, scene) is None)


def _lacks(effect: Hidden, scene: Scene) -> str | None:
    """What the effect needs and the scene lacks; None if nothing."""
    if effect.on == "hinge" and not scene.object_joint:
        return "an object joint"
    if effect.on == "base" and not scene.model.opt.gravity.any():
        return "gravity"
    if effect.on == "grip" and not (scene.grip and any(scene.grip.fingers)):
        return "a grip"
    return None


def check(one: Applied, scene: Scene) -> None:
    """Raise ValueError for an unknown effect, an invalid amplitude, or a scene or joint on which it cannot act."""
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
    """Joints on which an effect may act alone."""
    if effect.on == "arm":
        return scene.joints
    if effect.on == "joint":
        return tuple(dict.fromkeys((*scene.joints, *([scene.object_joint] if scene.object_joint else []))))
    return ()


def influences_of(
    scene: Scene,
    applied: Sequence[Applied],
    repeat: int = 0,
    period: float = 0.0,
    side: TorqueSide = TorqueSide.MOTOR,
) -> list[Influence]:
    """The effects in one repeat, each with a new state; the other arguments are those of `Place`."""
    places = [Place(scene, (one.joint,) if one.joint else scene.joints, repeat, period, side) for one in applied]
    return [HIDDEN[one.name].make(place, one.amplitude) for one, place in zip(applied, places, strict=True)]


def _simulate(
    synthetic_robot: SyntheticRobot, applied: Sequence[Applied]
) -> tuple[np.ndarray, np.ndarray, list[list[Influence]], SyntheticRobot]:
    """Simulate all repeats.

    Returns:
        Sensor values [N, T, S]; torques of effects in the gears [N, T, nv], N m (no rows for motor-side torques); the
        effects of each repeat; the synthetic robot with the models that they edited.
    """
    count = len(synthetic_robot.models)
    since = synthetic_robot.clock - synthetic_robot.clock[0]
    period = float(since[-1]) + PAUSE
    side = synthetic_robot.config.side
    effects = [influences_of(synthetic_robot.scene, applied, repeat, period, side) for repeat in range(count)]
    models = [edited(model, influences) for model, influences in zip(synthetic_robot.models, effects, strict=True)]
    link = side is TorqueSide.LINK
    gears = np.zeros((count, len(synthetic_robot.clock) if link else 0, synthetic_robot.scene.model.nv))

    def one(repeat: int) -> np.ndarray:
        control = synthetic_robot.control
        for influence in effects[repeat]:
            if influence.command:
                control = influence.command(since, control)
        qpos0, in_gears = synthetic_robot.qpos0[repeat], gears[repeat] if link else None
        return step_through(models[repeat], qpos0, control, effects[repeat], in_gears)

    with ThreadPoolExecutor(max_workers=min(count, runtime.cores())) as pool:
        rows = np.stack(list(pool.map(one, range(count))))
    return rows, gears, effects, replace(synthetic_robot, models=models)


def _sensed(
    synthetic_robot: SyntheticRobot, effects: Sequence[Sequence[Influence]], torque: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Torque and position [N, T, J] after the effects on the sensors."""
    sensed = []
    for repeat, influences in enumerate(effects):
        signals = SensorInput(synthetic_robot.clock - synthetic_robot.clock[0], torque[repeat], position[repeat])
        for influence in influences:
            signals = influence.sense(signals) if influence.sense else signals
        sensed.append(signals)
    return np.stack([s.torque for s in sensed]), np.stack([s.position for s in sensed])
