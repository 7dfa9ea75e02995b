"""Compiled batches of replays; replays that differ in numbers only share one program.

Compiling a replay takes longer than the replays of most fits.  A program depends on the scene, on the fields that a row
of values writes, and on the effects.  Commands, their number, starts and measured motions are its inputs.  So
recordings of less than `LONG` steps, their held-out repeats and every search over them share one program, and so do
those of more.  The sensor model is a second, small program for each length of a motion.
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
from droid_jax.model.variant import check_writes, of_recording
from droid_jax.recordings.recording import TorqueConvention
from droid_jax.simulate.batching import over_block
from droid_jax.simulate.c_reference import c_path_torques, c_replay, why_no_path_in_c
from droid_jax.simulate.inverse_dynamics import Path, PathTorques, motion_path, path_replay, path_sensors
from droid_jax.simulate.measured_motion import Motion
from droid_jax.simulate.replay import (
    TORQUE_OFFSETS,
    Drive,
    Replay,
    servo_motion,
    torque_offset_effect,
    traced_part,
    with_sensor_model,
)
from droid_jax.simulate.servo_gains import check_gains

PROGRAMS = 16  # most programs of each kind in the cache; each holds its scene
LONG = 1000  # steps of a motion from which a program's faster replays are worth a longer compilation
MIN_ROWS = 8192  # least rows of a motion's program: 16 s at 2 ms

Batch = Callable[[np.ndarray], Rollout]


@dataclass(frozen=True)
class Layout:
    """The part of a space that a program depends on: names, roles and written fields, not means, widths or bounds."""

    entries: tuple[tuple[str, Role, tuple[Write, ...]], ...]
    space: Space = field(compare=False)


@dataclass(frozen=True)
class Clocked:
    """The part of a drive that a servo program depends on: the time step and the torque convention."""

    timestep: float
    torque: TorqueConvention
    drive: Drive = field(compare=False)


@dataclass(frozen=True, eq=False)
class Along:
    """A batch of inverse-dynamics replays along a measured motion: [B, D] -> Rollout [B, ...].

    torques: a function of N paths; their torques [N, T, J], N m, at the space's means.
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

    make: drive -> its batch.  A drive with another start, other gains, or other commands of the same length shares the
    compiled program.
    """

    make: Callable[[Drive], Batch]
    drive: Drive

    @functools.cached_property
    def _batch(self) -> Batch:
        return self.make(self.drive)

    def __call__(self, values: np.ndarray) -> Rollout:
        return self._batch(values)


def along_another(replay: Batch, follows: Drive | Motion) -> Batch:
    """The same compiled batch for another measured motion or another drive."""
    if isinstance(replay, Along) and isinstance(follows, Motion):
        return replace(replay, motion=follows)
    if isinstance(replay, Driven) and isinstance(follows, Drive):
        return replay if follows is replay.drive else replace(replay, drive=follows)
    return replay


def compiled_replay(
    engine: str,
    scene: Scene,
    space: Space,
    follows: Drive | Motion,
    effects: Sequence[Effect],
    mj_step: bool = False,
    few: bool = False,
) -> Batch:
    """A batch of replays of a drive or a measured motion: [B, D] -> Rollout [B, ...].

    Args:
        engine: "mjx" (compiled, all devices) or "mujoco" (plain C, all cores).
        scene: what is simulated.
        space: meaning of the values [D].
        follows: the commands or the measured motion.
        effects: in the replay; those of the sensors are added (`with_sensors`).
        mj_step: step as the C engine does.
        few: whether a few rows will be replayed in all.  The program of a long motion then compiles sooner and replays
            more slowly.

    Raises:
        ValueError: a measured motion with mj_step, a replay that plain C does not support, gains for actuators that
            are no position servos, a model that was changed after MJX got it, a known value of a parameter that the
            space does not have or that is out of its bounds, or parameters that set what the recording of a variant
            states.
    """
    scene.check_unchanged()
    check_variant(scene, space, effects)
    space.with_known(follows.known, space.mean)  # raise here, not at the first call
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
        clocked = Clocked(follows.timestep, follows.torque, follows)
        program = _servo_program(scene, layout, effects, clocked, mj_step, len(follows.command) >= LONG and not few)

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


def check_variant(scene: Scene, space: Space, effects: Sequence[Effect], recording: str = "") -> None:
    """Raise ValueError for parameters and effects that the variant of a recording cannot have.

    scene: with the recording's numbers.  space: of the replay.  effects: in it.  recording: its name, if it is known.
    """
    with of_recording(recording):
        check_writes(scene, space, effects)
        in_variant(scene, tuple(effects))


def window_program(
    scene: Scene, space: Space, drive: Drive, effects: Sequence[Effect], earlier: int, steps: int
) -> Callable[..., Rollout]:
    """A compiled batch of windows; every row is one window with its own initial state (`servo_motion`).

    Args:
        scene: what is simulated.
        space: meaning of the values [D].
        drive: of which only the time step and the torque convention are used.
        effects: in the replay; those of the sensors are added.
        earlier: commands before the first step.
        steps: time steps of a window.

    Returns:
        (values [B, D], command [B, earlier + steps, U], start [B, nq], gains [B, U, 2], speed [B, nv], origin [B]) ->
        Rollout [B, steps, ...].
    """
    scene.check_unchanged()
    check_variant(scene, space, effects)
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
        return with_sensor_model(moved, physics.theta, effects, clocked.timestep, origin=origin)

    return over_block(_of_bodies(scene, space, replay), shared=False)


def batch_replay(scene: Scene, space: Space, replay: Replay) -> Batch:
    """Compile your own per-sample replay into a sharded batch: [B, D] -> Rollout [B, ...]."""
    return over_block(_of_bodies(scene, space, lambda values: replay(make_physics(scene, space, values))))


def capacity(steps: int) -> int:
    """Rows of a program for that many steps: a power of two, so that recordings of different lengths share it."""
    return max(MIN_ROWS, 1 << (steps - 1).bit_length())


def layout_of(space: Space) -> Layout:
    """The part of a space that a program depends on."""
    return Layout(tuple((p.name, p.role, p.writes) for p in space.parameters), space)


def with_sensors(scene: Scene, space: Space, drive: Drive | Motion, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects of a replay: the given ones and those of the torque sensors that are not among them.

    Torque offsets are always added, friction and gain of sensors if the space has their parameters.  Friction comes
    first, since sensors delay, scale or mix a torque that contains it.
    """
    given, effects = {e.name for e in effects}, in_variant(scene, tuple(effects))
    friction, gain = bool(space.of_role(Role.VISCOUS, Role.COULOMB)), bool(space.of_role(Role.TORQUE_GAIN))
    before, after = _sensor_effects(scene.joints, isinstance(drive, Motion), friction, gain)
    return (*(e for e in before if e.name not in given), *effects, *(e for e in after if e.name not in given))


@functools.lru_cache(maxsize=PROGRAMS)
def _sensor_effects(
    joints: tuple[str, ...], prescribed: bool, friction: bool, gain: bool
) -> tuple[tuple[Effect, ...], tuple[Effect, ...]]:
    """Effects before and after the others.  Cached, since programs are looked up by the identity of their effects."""
    before = (joint_friction_effect(joints, jnp.sign if prescribed else direction),) if friction else ()
    after = (torque_gain_effect(joints),) if gain else ()
    return before, (*after, torque_offset_effect(joints))


@functools.lru_cache(maxsize=PROGRAMS)
def _servo_program(
    scene: Scene,
    layout: Layout,
    effects: tuple[Effect, ...],
    clocked: Clocked,
    mj_step: bool,
    long: bool,
) -> Callable[..., Rollout]:
    """(values [B, D], *`traced_part` of a drive, steps) -> motion [B, T, ...], cached by identity of the scene."""
    motion = servo_motion(scene, clocked.drive, effects, parity=mj_step, late=0.0 if mj_step else 0.5)
    space = layout.space
    return over_block(lambda values, *of_drive: motion(make_physics(scene, space, values), *of_drive), long=long)


@functools.lru_cache(maxsize=PROGRAMS)
def _sensors(
    scene: Scene, layout: Layout, effects: tuple[Effect, ...], timestep: float, steps: int
) -> Callable[..., Rollout]:
    """The sensor model: (values [B, D], motion [B, T, ...]) -> Rollout [B, ...] of the motion's first steps."""
    space = layout.space

    def sense(values: jax.Array, motion: Rollout) -> Rollout:
        return with_sensor_model(motion, theta_of(space, values), effects, timestep, steps)

    return over_block(_of_bodies(scene, space, sense), shared=False)


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
    """`_inverse_program` with inverse dynamics in plain C; the sensor model is compiled."""
    space = layout.space
    if why := why_no_path_in_c(space, torque, effects):
        raise ValueError(f"the C engine cannot replay this: {why}; use MJX")
    refuse_fluid(scene.model, f"a replay of scene {scene.name!r}")
    bodies, sense = c_path_torques(scene, space, torque, joints), path_sensors(scene, torque, effects, joints)

    def read(values: jax.Array, torques: PathTorques, path: Path) -> Rollout:
        return sense(complete(theta_of(space, values), effects), path, torques)

    each = jax.jit(
        jax.vmap(_of_bodies(scene, space, read), in_axes=(0, 0, None)), compiler_options=runtime.compiler_options()
    )

    def batch(values: np.ndarray, path: Path) -> Rollout:
        in_c = PathTorques(*(jnp.asarray(part, jnp.float32) for part in bodies(values, path)))
        return each(jnp.asarray(values, jnp.float32), in_c, path)

    def torques(values: jax.Array, paths: Path) -> jax.Array:
        row = np.asarray(values)[None]
        return jnp.stack([batch(row, Path(*(a[n] for a in paths))).torque[0] for n in range(len(paths.time))])

    return batch, torques


def _of_bodies(scene: Scene, space: Space, replay: Callable[..., Rollout]) -> Callable[..., Rollout]:
    """The replay of a row of values [D], not finite if the row has an inertia that no body can have."""
    if not free_inertias(space):
        return replay

    def checked(values: Any, *more: Any) -> Rollout:
        rollout = replay(values, *more)
        return replace(rollout, finite=rollout.finite & inertia_possible(scene, space, values))

    return checked


def _single(array: np.ndarray) -> jax.Array:
    return jnp.asarray(array, jnp.float32) if np.issubdtype(array.dtype, np.floating) else jnp.asarray(array)
