"""The settings of the blind suite: a scene, what is fitted in it without any effect, and three motions.

hinge  a servo-driven door alone: every effect of a hinge, in seconds.
bench  the same door beside an arm of two links: effects of joints and servos too.
arm    the free Panda, its motors' torques replayed by inverse dynamics, as logs of real arms are.
door   the built-in scene, where the targets are to be met.

In each the first motion ("train") opens and closes at two speeds, "validation" moves differently and "test"
differently again.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from droid_jax.discrepancy.candidates import acts_on_commands_only
from droid_jax.door.scene import ARM, door_scene, panda_arm_scene
from droid_jax.door.space import door_nuisances, door_space, torque_offsets
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import library, ready
from droid_jax.model.fields import (
    body_mass,
    body_mass_scale,
    joint_damping,
    joint_frictionloss,
    joint_stiffness,
    servo_scale,
    time_offset,
)
from droid_jax.model.joint_friction import joint_friction_space
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.hand_path import minimum_jerk
from experiments.blind.door_motion import door_demonstrations

FOLDER = Path(__file__).resolve().parents[1]
ROLES = ("train", "validation", "test")
DOOR = "door"  # the joint that a servo turns in the cheap scenes
SOME_JOINTS = ("panda_joint2", "panda_joint4", "panda_joint6")  # shoulder, elbow, wrist; the search asks for all
SECONDS = 8.0
AJAR = 0.02  # rad: a door that a servo turns here never meets its frame, which is not simulated
SERVO_LAG = 0.07  # s: velocity gain of the free arm's servos over their position gain
# (seconds, furthest angle in rad) of each opening and closing
STROKES = {
    "train": ((3.0, 0.9), (5.0, 0.9)),
    "validation": ((4.6, 0.8), (3.4, 0.95)),
    "test": ((2.6, 0.75), (5.4, 0.85)),
}
RISE = 1.5  # s in which an arm's swings grow from rest
# (rad, rad/s) of two sines for shoulder and elbow
SWINGS = {
    "train": (((0.6, 1.2), (0.0, 0.0)), ((0.8, 2.0), (0.2, 0.7))),
    "validation": (((0.5, 0.9), (0.2, 1.7)), ((0.6, 1.5), (-0.3, 0.5))),
    "test": (((0.4, 1.5), (-0.3, 0.6)), ((0.7, 1.1), (0.25, 2.3))),
}


@dataclass(frozen=True, eq=False)
class Setting:
    """Where something is hidden and searched for.

    base: what is fitted without any effect, nuisances included.  motions: makes the demonstrations, which
    a search has no need of.  prescribed: the search is given the measured motion instead of the commands.
    hidden_joints: joints of the arm on which something is hidden; empty for all.
    """

    name: str
    scene: Scene
    base: Space
    motions: Callable[[], Mapping[str, Recording]]
    prescribed: bool = False
    hidden_joints: tuple[str, ...] = ()

    @functools.cached_property
    def demonstrations(self) -> Mapping[str, Recording]:
        """Role -> what the robot repeats."""
        return self.motions()

    def effects(self, without: Iterable[str] = ()) -> tuple[Effect, ...]:
        """The library's effects for this scene, less those named; a prescribed motion has no servo to be wrong."""
        found = (e for e in library(self.scene) if e.name not in {*without})
        return tuple(e for e in found if not (self.prescribed and acts_on_commands_only(e)))


def setting(name: str, cache: Path | None = None) -> Setting:
    """A setting by name; the door's demonstrations are kept in the folder `cache`."""
    makers = {"hinge": _hinge, "bench": _bench, "arm": _arm, "door": functools.partial(_door, cache)}
    if name not in makers:
        raise ValueError(f"unknown scene {name!r}; valid: {', '.join(makers)}")
    return makers[name]()


def _hinge() -> Setting:
    scene = _from_file("hinge")
    base = Space((*_door_parameters(scene), *_servo_nuisances(scene)))
    return Setting("hinge", scene, base, lambda: _swings((DOOR,)))


def _bench() -> Setting:
    scene = _from_file("bench")
    base = Space(
        (
            body_mass(scene, "forearm", std=0.2, high=3.0),
            joint_damping(scene, "shoulder", std=0.5, high=20.0),
            joint_damping(scene, "elbow", std=0.5, high=20.0),
            joint_frictionloss(scene, "elbow", std=0.1, high=2.0),
            *_door_parameters(scene),
            body_mass_scale(scene, "upper_arm", nuisance=True),
            *_servo_nuisances(scene),
        )
    )
    return Setting("bench", scene, base, lambda: _swings(("shoulder", "elbow", DOOR)))


def _arm() -> Setting:
    scene = ready(_driven(panda_arm_scene()))
    friction = joint_friction_space(ARM)
    viscous = friction.select([n for n in friction.names if n.startswith("viscous")])
    links = Space(tuple(body_mass_scale(scene, f"link{i}", nuisance=True) for i in range(2, 8)))
    return Setting("arm", scene, viscous + links + Space(torque_offsets(ARM)), _waves, True, SOME_JOINTS)


def _door(cache: Path | None) -> Setting:
    scene, motions = ready(door_scene(timestep=0.004)), functools.partial(door_demonstrations, cache)
    return Setting("door", scene, door_space(scene) + door_nuisances(scene), motions, hidden_joints=SOME_JOINTS)


def _from_file(name: str) -> Scene:
    """The cheap scene, with rows for every friction that an effect may raise."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / f"{name}.xml"))
    return ready(compile_scene(spec, name, object_joint=DOOR))


def _driven(scene: Scene) -> Scene:
    """The arm as its motors feel it, with its weight, and with servos that damp what they drive."""
    spec = scene.spec.copy()
    for body in spec.bodies:
        body.gravcomp = 0
    for servo in spec.actuators:
        servo.biasprm[2] = -SERVO_LAG * servo.gainprm[0]
    return compile_scene(spec, scene.name, joints=scene.joints, unlimited=scene.joints)


def _door_parameters(scene: Scene) -> tuple[Parameter, ...]:
    return (
        joint_damping(scene, DOOR, std=0.3, high=10.0),
        joint_frictionloss(scene, DOOR, std=0.1, high=3.0),
        joint_stiffness(scene, DOOR, std=0.3, high=10.0),
        body_mass_scale(scene, "panel", nuisance=True),
    )


def _servo_nuisances(scene: Scene) -> tuple[Parameter, ...]:
    servos = (servo_scale(scene, j, nuisance=True) for j in scene.joints)
    return (*servos, time_offset(), *torque_offsets(scene.joints))


def _swings(joints: tuple[str, ...]) -> dict[str, Recording]:
    """The door opens and closes, the arm (where there is one) swings beside it."""
    clock = np.arange(0.0, SECONDS, 0.002)
    made = {}
    for role in ROLES:
        rise = minimum_jerk(clock / RISE)
        arm = [rise * sum(size * np.sin(w * clock) for size, w in waves) for waves in SWINGS[role]]
        columns = [*(arm if len(joints) > 1 else []), _strokes(clock, STROKES[role])]
        made[role] = _commanded(role, clock, np.stack(columns, axis=1), joints)
    return made


def _strokes(clock: np.ndarray, strokes: tuple[tuple[float, float], ...]) -> np.ndarray:
    """[T] rad: from ajar to the furthest angle and back, one stroke after the other."""
    angle, start = np.full(len(clock), AJAR), 0.0
    for seconds, reach in strokes:
        now = (clock >= start) & (clock < start + seconds)
        angle[now] += 0.5 * (reach - AJAR) * (1 - np.cos(2 * np.pi * (clock[now] - start) / seconds))
        start += seconds
    return angle


def _waves() -> dict[str, Recording]:
    """Two sines a joint about a pose inside the Panda's ranges; other frequencies and phases in each role."""
    centre = np.array([0.0, 0.2, 0.1, -1.8, 0.2, 1.6, 0.3])
    clock = np.arange(0.0, 10.0, 0.002)
    k = np.arange(len(ARM))
    made = {}
    for number, role in enumerate(ROLES):
        slow, fast = 0.21 + 0.03 * ((k + 2 * number) % 7), 0.5 - 0.02 * ((k + 3 * number) % 7)
        turned = 0.4 * np.sin(2 * np.pi * slow * clock[:, None] + k + number)
        turned += 0.12 * np.sin(2 * np.pi * fast * clock[:, None] + 2 * k - number)
        made[role] = _commanded(role, clock, centre + minimum_jerk(clock / RISE)[:, None] * turned, ARM)
    return made


def _commanded(name: str, clock: np.ndarray, command: np.ndarray, joints: tuple[str, ...]) -> Recording:
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    start = dict(zip(joints, command[0].tolist(), strict=True))
    return Recording(name, clock, command, joints, {}, convention, qpos0=start)
