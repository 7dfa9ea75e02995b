"""Replays compiled in batches; each program is made once for all that differ in nothing but numbers.

Tracing and compiling a replay takes longer than most fits replay.  A program depends on the scene, on what a row of
values writes and on the effects; commands, their number, starts and measured motions are handed to it.  So recordings
of any length, their held-out repeats and every search over them share one.  What the sensors make of a motion is a
second, small program of the motion's own length.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax import runtime
from droid_jax.model.effect_interface import Effect, Rollout, complete
from droid_jax.model.effects.registry import in_variant
from droid_jax.model.inertia import free_inertias, inertia_possible
from droid_jax.model.joint_friction import direction, joint_friction_effect, torque_gain_effect
from droid_jax.model.parameters import Role, Space, Write
from droid_jax.model.physics import make_physics, theta_of
from droid_jax.model.scene import Scene
from droid_jax.model.unsupported_features import refuse_fluid
from droid_jax.model.variant import check_writes
from droid_jax.recordings.recording import TorqueConvention
from droid_jax.simulate.batching import over_block
from droid_jax.simulate.c_reference import c_path_torques, c_replay, why_no_path_in_c
from droid_jax.simulate.inverse_dynamics import Path, PathTorques, motion_path, path_replay, path_sensors
from droid_jax.simulate.measured_motion import Motion
from droid_jax.simulate.replay import (
    TORQUE_OFFSETS,
    Drive,
    Replay,
    sensed,
    servo_motion,
    torque_offset_effect,
    traced_part,
)
from droid_jax.simulate.servo_gains import check_gains

PROGRAMS = 16  # of each kind, kept for whoever asks for the same again; each holds its scene
SHORTEST = 8192  # rows of a motion's program, at least: 16 s at 2 ms

Batch = Callable[[np.ndarray], Rollout]


@dataclass(frozen=True)
class Layout:
    """What a row of values is written to: spaces that differ in means, deviations or bounds alone have the same."""

    entries: tuple[tuple[str, Role, tuple[Write, ...]], ...]
    space: Space = field(compare=False)


@dataclass(frozen=True)
class Clocked:
    """What a servo program must know of a drive: the same of all drives on one clock, torques of one convention."""

    timestep: float
    torque: TorqueConvention
    drive: Drive = field(compare=False)


@dataclass(frozen=True, eq=False)
class Along:
    """A compiled batch of inverse replays along a motion: [B, D] -> Rollout [B, ...].

    torques: the torques [N, T, J] of N paths at the space's means.
    """

    compiled: Callable[..., Rollout]
    scene: Scene
    space: Space
    motion: Motion
    torques: Callable[[Path], jax.Array]

    def __call__(self, values: np.ndarray) -> Rollout:
        known = self.space.with_known(self.motion.known, values)
        return self.compiled(known, motion_path(self.scene, self.motion))


@dataclass(frozen=True, eq=False)
class Driven:
    """A batch of servo replays of a drive: [B, D] -> Rollout [B, ...].

    make: drive -> its batch; one of another start, other gains, or other commands of the same length, compiles nothing
    again.
    """

    make: Callable[[Drive], Batch]
    drive: Drive

    @functools.cached_property
    def _batch(self) -> Batch:
        return self.make(self.drive)

    def __call__(self, values: np.ndarray) -> Rollout:
        return self._batch(values)


def along_another(replay: Batch, follows: Drive | Motion) -> Batch:
    """The same compiled batch along another motion, or of another drive."""
    if isinstance(replay, Along) and isinstance(follows, Motion):
        return replace(replay, motion=follows)
    if isinstance(replay, Driven) and isinstance(follows, Drive):
        return replay if follows is replay.drive else replace(replay, drive=follows)
    return replay


def compiled_replay(
    engine: str, scene: Scene, space: Space, follows: Drive | Motion, effects: Sequence[Effect], mj_step: bool = False
) -> Batch:
    """Batches [B, D] -> Rollout [B, ...] of what a replay follows.

    Args:
        engine: "mjx" (compiled, all devices) or "mujoco" (plain C, all cores).
        scene: what is simulated.
        space: meaning of the values [D].
        follows: the commands or the measured motion.
        effects: in the replay; those of the sensors are added (`with_sensors`).
        mj_step: step as the C engine does.

    Raises:
        ValueError: a measured motion with mj_step, what plain C does not have, gains that the scene does not have, a
            model that was changed since MJX had it, a known value of a parameter that the space does not have or
            bounds, or parameters that set what the recording of a variant states.
    """
    scene.check_unchanged()
    check_writes(scene, space)
    space.with_known(follows.known, space.mean)  # refused here, not at the first call
    effects, layout = with_sensors(scene, space, follows, effects), layout_of(space)
    if isinstance(follows, Motion):
        if mj_step:
            raise ValueError("mj_step replays commands; this recording has none")
        program = _inverse_program if engine == "mjx" else _inverse_in_c
        batch, torques = program(scene, layout, effects, follows.torque, follows.joints)
        means = jnp.asarray(space.with_known(follows.known, space.mean), jnp.float32)
        return Along(batch, scene, space, follows, lambda paths: torques(means, paths))
    check_gains(scene, follows)
    if engine == "mjx":
        program = _servo_program(scene, layout, effects, Clocked(follows.timestep, follows.torque, follows), mj_step)

        def driven(drive: Drive) -> Batch:
            steps = len(drive.command)
            sense = _sensors(scene, layout, effects, drive.timestep, steps)
            table, start, gains = traced_part(scene, drive)
            padding = jnp.repeat(table[-1:], capacity(steps) - steps, axis=0)
            of_drive = jnp.concatenate([table, padding]), start, gains, jnp.int32(steps)

            def replay(values: np.ndarray) -> Rollout:
                values = space.with_known(drive.known, values)
                return sense(values, program(values, *of_drive))

            return replay

        return Driven(driven, follows)
    known = [e for e in effects if e.name != TORQUE_OFFSETS]

    def in_c(drive: Drive) -> Batch:
        checked = _of_bodies(scene, space, c_replay(scene, space, drive, known, late=0.0 if mj_step else 0.5))
        return lambda values: jax.tree.map(_single, checked(space.with_known(drive.known, values)))

    return Driven(in_c, follows)


def window_program(
    scene: Scene, space: Space, drive: Drive, effects: Sequence[Effect], earlier: int, steps: int
) -> Callable[..., Rollout]:
    """(values [B, D], command [B, earlier + steps, U], start [B, nq], gains [B, U, 2], speed [B, nv], origin [B]) ->
    Rollout [B, steps, ...]: every row a window of its own, from its own state (`servo_motion`).

    Of the drive only its time step and its torque's convention are used.
    """
    scene.check_unchanged()
    check_writes(scene, space)
    check_gains(scene, drive)
    made_with = with_sensors(scene, space, drive, effects)
    clocked = Clocked(drive.timestep, drive.torque, drive)
    return _window_program(scene, layout_of(space), made_with, clocked, earlier, steps)


@functools.lru_cache(maxsize=PROGRAMS)
def _window_program(
    scene: Scene, layout: Layout, effects: tuple[Effect, ...], clocked: Clocked, earlier: int, steps: int
) -> Callable[..., Rollout]:
    motion = servo_motion(scene, clocked.drive, effects, earlier=earlier)
    space = layout.space

    def replay(values: jax.Array, table: Any, start: Any, gains: Any, speed: Any, origin: Any) -> Rollout:
        physics = make_physics(scene, space, values)
        moved = motion(physics, table, start, gains, steps, speed, origin)
        return sensed(moved, physics.theta, effects, clocked.timestep, origin=origin)

    return over_block(_of_bodies(scene, space, replay), alike=False)


def batch_replay(scene: Scene, space: Space, replay: Replay) -> Batch:
    """One compiled, sharded block of a per-sample replay of your own: [B, D] -> Rollout [B, ...]."""
    return over_block(_of_bodies(scene, space, lambda values: replay(make_physics(scene, space, values))))


def capacity(steps: int) -> int:
    """Rows of a program for that many steps: few different numbers, so that recordings share it."""
    return max(SHORTEST, 1 << (steps - 1).bit_length())


def layout_of(space: Space) -> Layout:
    """What a program must know of a space."""
    return Layout(tuple((p.name, p.role, p.writes) for p in space.parameters), space)


def with_sensors(scene: Scene, space: Space, drive: Drive | Motion, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects, and those of the torque sensors that are not among them: what a replay is made with.

    Offsets always, all else where the space asks for it.  Friction comes first: it is part of the torque that sensors
    delay, scale or mix.
    """
    given, effects = {e.name for e in effects}, in_variant(scene, tuple(effects))
    friction, gain = bool(space.of_role(Role.VISCOUS, Role.COULOMB)), bool(space.of_role(Role.TORQUE_GAIN))
    felt, read = _sensor_effects(scene.joints, isinstance(drive, Motion), friction, gain)
    return (*(e for e in felt if e.name not in given), *effects, *(e for e in read if e.name not in given))


@functools.lru_cache(maxsize=PROGRAMS)
def _sensor_effects(
    joints: tuple[str, ...], prescribed: bool, friction: bool, gain: bool
) -> tuple[tuple[Effect, ...], tuple[Effect, ...]]:
    """What a sensor feels and what it makes of it; the same effects each time: programs are distinguished by theirs."""
    felt = (joint_friction_effect(joints, jnp.sign if prescribed else direction),) if friction else ()
    read = (torque_gain_effect(joints),) if gain else ()
    return felt, (*read, torque_offset_effect(joints))


@functools.lru_cache(maxsize=PROGRAMS)
def _servo_program(
    scene: Scene,
    layout: Layout,
    effects: tuple[Effect, ...],
    clocked: Clocked,
    mj_step: bool,
) -> Callable[..., Rollout]:
    """(values [B, D], *`traced_part` of a drive, steps) -> motion [B, T, ...]; scene and effects count by identity."""
    motion = servo_motion(scene, clocked.drive, effects, parity=mj_step, late=0.0 if mj_step else 0.5)
    space = layout.space
    return over_block(lambda values, *of_drive: motion(make_physics(scene, space, values), *of_drive))


@functools.lru_cache(maxsize=PROGRAMS)
def _sensors(
    scene: Scene, layout: Layout, effects: tuple[Effect, ...], timestep: float, steps: int
) -> Callable[..., Rollout]:
    """(values [B, D], motion [B, T, ...]) -> Rollout [B, ...] of the motion's first steps."""
    space = layout.space

    def sense(values: jax.Array, motion: Rollout) -> Rollout:
        return sensed(motion, theta_of(space, values), effects, timestep, steps)

    return over_block(_of_bodies(scene, space, sense), alike=False)


@functools.lru_cache(maxsize=PROGRAMS)
def _inverse_program(
    scene: Scene,
    layout: Layout,
    effects: tuple[Effect, ...],
    torque: TorqueConvention,
    joints: tuple[str, ...],
) -> tuple[Callable[..., Rollout], Callable[[jax.Array, Path], jax.Array]]:
    """(values [B, D], path) -> Rollout [B, ...], and (values [D], N paths) -> torques [N, T, J]."""
    along, space = path_replay(scene, torque, effects, joints), layout.space

    def replay(values: jax.Array, path: Path) -> Rollout:
        return along(make_physics(scene, space, values), path)

    torques = jax.jit(
        jax.vmap(runtime.in_full(lambda values, path: replay(values, path).torque), in_axes=(None, 0)),
        compiler_options=runtime.compiler_options(),
    )
    return over_block(_of_bodies(scene, space, replay)), torques


@functools.lru_cache(maxsize=PROGRAMS)
def _inverse_in_c(
    scene: Scene,
    layout: Layout,
    effects: tuple[Effect, ...],
    torque: TorqueConvention,
    joints: tuple[str, ...],
) -> tuple[Callable[..., Rollout], Callable[[jax.Array, Path], jax.Array]]:
    """The same in plain C, but for what the sensors make of it."""
    space = layout.space
    if why := why_no_path_in_c(scene, space, torque, effects):
        raise ValueError(f"the C engine cannot replay this: {why}; use MJX")
    refuse_fluid(scene.model, f"a replay of scene {scene.name!r}")
    bodies, sense = c_path_torques(scene, space, torque, joints), path_sensors(scene, torque, effects, joints)

    def read(values: jax.Array, felt: PathTorques, path: Path) -> Rollout:
        return sense(complete(theta_of(space, values), effects), path, felt)

    each = jax.jit(
        jax.vmap(_of_bodies(scene, space, read), in_axes=(0, 0, None)), compiler_options=runtime.compiler_options()
    )

    def batch(values: np.ndarray, path: Path) -> Rollout:
        felt = PathTorques(*(jnp.asarray(part, jnp.float32) for part in bodies(values, path)))
        return each(jnp.asarray(values, jnp.float32), felt, path)

    def torques(values: jax.Array, paths: Path) -> jax.Array:
        row = np.asarray(values)[None]
        return jnp.stack([batch(row, Path(*(a[n] for a in paths))).torque[0] for n in range(len(paths.time))])

    return batch, torques


def _of_bodies(scene: Scene, space: Space, replay: Callable[..., Rollout]) -> Callable[..., Rollout]:
    """The replay of a row of values [D], which gives no numbers where no body can have the row's inertia."""
    if not free_inertias(scene, space):
        return replay

    def checked(values: Any, *more: Any) -> Rollout:
        rollout = replay(values, *more)
        return replace(rollout, finite=rollout.finite & inertia_possible(scene, space, values))

    return checked


def _single(array: np.ndarray) -> jax.Array:
    return jnp.asarray(array, jnp.float32) if np.issubdtype(array.dtype, np.floating) else jnp.asarray(array)
