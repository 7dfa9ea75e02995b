"""Shared by the tests of the effects: two scenes, each with one compiled replay that has all its effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax
import mujoco
import numpy as np

from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.scene import door_scene
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.effects.registry import effect_space, library, ready
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_physics
from droid_jax.model.scene import Scene, compile_scene, with_options
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.simulate.batching import over_population
from droid_jax.simulate.replay import Drive, make_drive, servo_replay

# An arm of two links with a hand, and a door with a servo of its own.  Degrees of freedom, measured joints and
# actuators stand in three different orders, the hand is heavier than the forearm, and the elbow's reference is not
# zero: an index, a body or an origin taken from the wrong place shows.
MECHANISM = """<mujoco><compiler angle="radian"/>
<option timestep="0.005" integrator="implicitfast" iterations="100" tolerance="1e-12"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <body name="panel" pos="1 0 0">
    <joint name="door" axis="0 0 1" damping="0.5" frictionloss="0.2" stiffness="0.5"/>
    <geom type="box" size="0.2 0.01 0.3" pos="0.2 0 0" mass="2"/></body>
  <body name="upper_arm"><joint name="shoulder" axis="0 1 0" armature="0.05" damping="2"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1.5"/>
    <body name="forearm" pos="0 0 -0.3" gravcomp="1">
      <joint name="elbow" axis="0 1 0" armature="0.02" damping="1" frictionloss="0.1" ref="0.2"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.5"/>
      <body name="hand" pos="0 0 -0.25" gravcomp="1"><geom type="sphere" size="0.03" mass="0.6"/></body></body></body>
</worldbody>
<actuator><position name="e" joint="elbow" kp="40"/><position name="d" joint="door" kp="60"/>
  <position name="s" joint="shoulder" kp="80"/></actuator></mujoco>"""
JOINTS = ("shoulder", "elbow", "door")
ARM = JOINTS[:2]
SECONDS = 4.0
MOTOR = TorqueConvention(TorqueSide.MOTOR, gravity=False)


@dataclass(frozen=True, eq=False)
class Bench:
    """A scene, what drives it, and the compiled replay of its effects.

    run: [P, D] physical values -> Rollout of host arrays [P, ...].
    """

    scene: Scene
    drive: Drive
    effects: tuple[Effect, ...]
    space: Space
    run: Callable[[np.ndarray], Rollout]

    def effect(self, name: str) -> Effect:
        return next(e for e in self.effects if e.name == name)

    def torque(self, *rows: Mapping[str, float]) -> np.ndarray:
        """[P, T, J] N m of rows that name what is not at neutral."""
        return self.run(np.array([self.space.values(dict(row)) for row in rows])).torque


def make_bench(scene: Scene, drive: Drive, effects: Sequence[Effect] | None = None, *, parity: bool = False) -> Bench:
    """Compile a scene with all its effects, or with some."""
    effects = library(scene) if effects is None else tuple(effects)
    space = effect_space(effects)
    replay = servo_replay(scene, drive, effects, parity=parity)
    return Bench(scene, drive, effects, space, over_population(lambda v: replay(make_physics(scene, space, v))))


def bare(bench: Bench, *, parity: bool = False) -> Rollout:
    """The same scene and commands compiled without effects, [T, ...].

    No parameter of an effect is written into the model, which would compile as long again.
    """
    replay = servo_replay(bench.scene, bench.drive, parity=parity)
    outside = Space(tuple(p for p in bench.space.parameters if not p.writes))
    run = over_population(lambda v: replay(make_physics(bench.scene, outside, v)))
    return jax.tree.map(lambda array: array[0], run(outside.mean[None]))


def typical(parameter: Parameter) -> float:
    """Mean plus one prior deviation, inside the bounds."""
    return min(parameter.mean + parameter.std, parameter.high)


def coefficients(effect: Effect) -> list[Parameter]:
    """Coefficients of all locations."""
    names = {n for place in effect.locations.values() for n in place}
    return [p for p in effect.parameters if p.name in names]


def everywhere(effect: Effect, value: Callable[[Parameter], float] = typical) -> dict[str, float]:
    """All coefficients of an effect, with the value that a function gives."""
    return {p.name: value(p) for p in coefficients(effect)}


def motion(time: np.ndarray) -> np.ndarray:
    """[T, 3] rad, of JOINTS: reversals everywhere; the door opens fast, closes slowly and passes zero slightly."""
    phase = 1.9 * time + 0.35 * np.sin(1.9 * time)
    shoulder = 0.6 * np.sin(1.6 * time) + 0.1 * np.sin(4.1 * time)
    elbow = 0.3 + 0.5 * np.sin(2.5 * time)
    door = -0.05 + 0.5 * (1 - np.cos(phase))
    return np.stack([shoulder, elbow, door], axis=1)


def mechanism(timestep: float = 0.005) -> Scene:
    """The small scene with a friction row for each joint."""
    scene = compile_scene(mujoco.MjSpec.from_string(MECHANISM), "mechanism", joints=JOINTS, object_joint="door")
    return ready(with_options(scene, timestep=timestep))


def mechanism_bench(timestep: float = 0.005, *, parity: bool = False) -> Bench:
    """The small scene with its motion as commands, from their first row."""
    scene = mechanism(timestep)
    path = motion(np.arange(round(SECONDS / timestep)) * timestep)
    command = path[:, [JOINTS.index(j) for j in scene.command_names]]
    start = scene.initial_qpos(dict(zip(JOINTS, path[0], strict=True)))
    return make_bench(scene, Drive(command, start, timestep, MOTOR), parity=parity)


def door(gains: str = "impedance") -> Scene:
    """The built-in scene with a friction row for each joint."""
    return ready(door_scene(springs=1, timestep=0.004, gains=gains))


def door_bench(gains: str = "impedance", names: Sequence[str] | None = None, motion: str = "A") -> Bench:
    """The built-in scene, one of its demonstrations, and all or some of its effects; for slow tests."""
    scene = door(gains)
    drive = make_drive(scene, load_recording(demonstration_path(motion, gains=gains)))
    return make_bench(scene, drive, library(scene, names))
