"""The vmapped cost: parameter vectors in, disagreement with the recordings out.

cost = make_cost(scene, space, [recording])
cost(values)            # [P, D] -> [P]   N m
cost.whitened(values)   # [P, D] -> [P, M] residuals in noise units
cost.rollouts(values)   # [P, D] -> one Rollout per recording
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax import runtime
from droid_jax.arguments import instance, instances, one_of
from droid_jax.cost.residuals import CompareConfig, Comparison, make_comparison, restated
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.fields import check_space
from droid_jax.model.inertia import check_inertia
from droid_jax.model.parameters import OF_A_JOINT, Role, Space
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.preflight.check_log import warn_of_log
from droid_jax.preflight.preflight import check_range, warn_if_moving, warn_of_commands
from droid_jax.recordings.checks import validate
from droid_jax.recordings.recording import Recording, recordings_of
from droid_jax.simulate.batching import in_blocks
from droid_jax.simulate.compiled import Along, Driven, along_another, compiled_replay
from droid_jax.simulate.engine import ENGINES
from droid_jax.simulate.initial_state import StartConfig, following
from droid_jax.simulate.inverse_dynamics import motion_path, prescribed
from droid_jax.simulate.measured_motion import Motion, measured_motion
from droid_jax.simulate.repeat_starts import from_one_start, own_starts
from droid_jax.simulate.replay import Drive, make_drive
from droid_jax.simulate.servo_gains import check_gains, servo_factors


@dataclass(frozen=True, eq=False, repr=False)
class Cost:
    """A cost over a space. Call it with [P, D] physical values; everything returns host arrays."""

    scene: Scene
    space: Space
    comparisons: tuple[Comparison, ...]
    drives: tuple[Drive | Motion, ...]
    _replays: tuple[Callable[[np.ndarray], Rollout], ...]
    _distances: tuple[Callable[[Rollout], jax.Array], ...]
    _whitened: tuple[Callable[[Rollout], jax.Array], ...]
    _failed: tuple[Callable[[Rollout], jax.Array], ...]
    _beta: tuple[Callable[[Rollout], jax.Array], ...]
    _smoothed: tuple[Callable[[Rollout], jax.Array], ...]

    def __repr__(self) -> str:
        names = ", ".join(c.name for c in self.comparisons)
        return f"<Cost of {names} over {len(self.space)} parameters of scene {self.scene.name!r}>"

    def __call__(self, values: Any) -> np.ndarray:
        """[P, D] -> [P] cost, the mean over the recordings; never NaN."""
        return np.mean(self.distances(values), axis=1)

    def distances(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, R] cost of each recording."""
        return self._blockwise(values, self._distances, lambda parts: np.stack(parts, axis=1))

    def whitened(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, M] residuals of all recordings, in units of the noise of the repeats' mean."""
        return self._blockwise(values, self._whitened, lambda parts: np.concatenate(parts, axis=1))

    def failed(self, values: Any) -> np.ndarray:
        """[P, D] -> [P] bool: the grasp was lost, the door stayed shut, or the replay blew up."""
        return self._blockwise(values, self._failed, lambda parts: np.any(np.stack(parts), axis=0))

    def penalties(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, R] N m: the part c beta of each recording's cost."""
        failed = self._blockwise(values, self._beta, lambda parts: np.stack(parts, axis=1))
        return failed * np.array([c.config.failure_cost for c in self.comparisons])

    def smoothed(self, values: Any) -> tuple[np.ndarray, ...]:
        """[P, D] -> for each recording its leading channel (the torque where compared) through the data's filter,
        [P, K, C] in the channel's unit.
        """
        return self._blockwise(values, self._smoothed, tuple)

    def rollouts(self, values: Any) -> tuple[Rollout, ...]:
        """[P, D] -> for each recording a Rollout of host arrays [P, T, ...].

        Its `time` is from 0 where commands were replayed; `comparisons[i].clock` [T] is on recording i's own clock.
        """
        identity = tuple((lambda r: r) for _ in self._replays)
        return self._blockwise(values, identity, tuple)

    def whitened_of(self, rollouts: Sequence[Rollout]) -> np.ndarray:
        """[P, M] residuals in noise units of replays that were made, one Rollout [P, T, ...] for each recording."""
        parts = [np.asarray(f(rollout)) for f, rollout in zip(self._whitened, rollouts, strict=True)]
        return np.concatenate(parts, axis=1)

    def compared_by(self, comparisons: Sequence[Comparison]) -> Cost:
        """The same replays, compared in another way: by comparisons of the same recordings."""
        return assemble(self.scene, self.space, comparisons, self._replays, self.drives)

    def alone(self, number: int) -> Cost:
        """The cost of one of the recordings, on the same compiled functions."""
        each = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("scene", "space")}
        return replace(self, **{name: (of_recordings[number],) for name, of_recordings in each.items()})

    def first(self) -> Cost:
        """The cost of the first recording alone."""
        return self.alone(0)

    def restated(self, values: np.ndarray) -> Cost:
        """The same replays, with the noise of single repeats restated from what `values` [D] leaves unexplained."""
        rollouts = [jax.tree.map(lambda a: a[0], r) for r in self.rollouts(values[None])]
        return self.compared_by(restated(self.comparisons, rollouts))

    def against(self, recordings: Sequence[Recording], config: CompareConfig | None = None) -> Cost:
        """The same compiled replays compared with other repeats of the same recordings, or in another way.

        Repeats that start elsewhere are replayed from there.  A recording without commands may hold another motion:
        its replay is given it.
        Raises ValueError unless these are as many, with the same commands (where there are none, as many instants on
        the same clock and the same joints with positions throughout), the same torque convention, `mj_step` and
        `motion_cutoff`.
        """
        recordings = recordings_of(recordings)
        if len(recordings) != len(self.drives):
            raise ValueError(f"expected repeats of {len(self.drives)} replayed recordings, got {len(recordings)}")
        if config is not None and any(c.config.mj_step != config.mj_step for c in self.comparisons):
            raise ValueError("the replays were compiled with another mj_step: make another cost (`make_cost`)")
        made, drives, replays = [], [], []
        for given, old, drive, replay in zip(recordings, self.comparisons, self.drives, self._replays, strict=True):
            recording, scene = own_starts(given, (config or old.config).start), variant_scene(self.scene, given.variant)
            new = followed(scene, recording, config or old.config)
            if isinstance(new, Drive):
                check_gains(scene, new)
            if not _same(new, drive):
                raise ValueError(
                    f"recording {recording.name!r} holds other commands than {old.name!r} had, measured another torque "
                    "(side, gravity), states another variant of the MJCF or, without commands, has another clock "
                    "(motion_cutoff changes it too) or other joints whose positions were measured throughout"
                )
            drives.append(drive if _start_alike(scene, new, drive, (config or old.config).start) else new)
            replays.append(along_another(replay, drives[-1]))
            made.append(_compared(scene, self.space, recording, drives[-1], replays[-1], config or old.config))
        return assemble(self.scene, self.space, made, replays, drives)

    def from_one_start(self, index: int, recording: Recording) -> Recording:
        """Repeats of a recording as if all had started where its replay does (`repeat_starts.from_one_start`)."""
        config = self.comparisons[index].config.start
        own, scene = own_starts(recording, config), variant_scene(self.scene, recording.variant)
        return _from_one_start(scene, self.space, own, self.drives[index], self._replays[index], config)

    def _blockwise(self, values: Any, functions: Sequence[Callable], join: Callable) -> Any:
        def block(rows: np.ndarray) -> Any:
            return join([f(replay(rows)) for f, replay in zip(functions, self._replays, strict=True)])

        return in_blocks(block, self.space.check(values))


def make_cost(
    scene: Scene,
    space: Space,
    recordings: Recording | Sequence[Recording],
    *,
    engine: str = "mjx",
    config: CompareConfig | None = None,
    effects: Sequence[Effect] = (),
    check: bool = True,
) -> Cost:
    """The cost of a scene over one or more recordings: equation 1 of the paper.

    A recording with commands is replayed by its servo, one without by inverse dynamics of its measured motion.

    Args:
        scene: what is simulated.
        space: meaning of the vectors [D].
        recordings: R recordings of the same robot and object.
        engine: "mjx" (compiled, all devices) or "mujoco" (plain C, all cores; the parity oracle).
        config: how simulation and measurement are compared; None for the defaults.
        effects: extra physics or observation models whose parameters are part of the space. Torque offsets, and joint
            friction behind the sensor where the space holds any, are there already. Those that raise the dry friction
            of a joint need `registry.ready(scene)`.
        check: warn of units, signs and clocks in the recordings that can hardly be right (`preflight.check_log`).

    Returns:
        A cost to be called with [P, D] physical values, which gives [P] N m.

    Raises:
        ValueError: a space of another scene, unknown engines, joints or channels, parameters that nothing reads, gains
            that do not match, or friction effects at joints without a friction row (`registry.ready` makes them).
    """
    config = instance(CompareConfig() if config is None else config, "config", CompareConfig)
    check_space(instance(scene, "scene", Scene), instance(space, "space", Space))
    recordings, effects = recordings_of(recordings), instances(effects, "effects", Effect)
    one_of(engine, "engine", ENGINES)
    recordings = [own_starts(recording, config.start) for recording in recordings]
    scenes = [variant_scene(scene, r.variant) for r in recordings]
    drives = [followed(own, r, config) for own, r in zip(scenes, recordings, strict=True)]
    for recording in recordings if check else ():
        warn_of_log(scene, recording)
    check_read(scene, space, effects)
    check_inertia(scene, space)
    commanded = any(isinstance(drive, Drive) for drive in drives)
    if not commanded:
        _warn_of_commanded(space)
    elif engine == "mjx":
        check_friction_rows(scene, space, effects)
    replays = tuple(
        compiled_replay(engine, own, space, d, effects, config.mj_step) for own, d in zip(scenes, drives, strict=True)
    )
    comparisons = tuple(
        _compared(own, space, recording, drive, replay, config)
        for own, recording, drive, replay in zip(scenes, recordings, drives, replays, strict=True)
    )
    return assemble(scene, space, comparisons, replays, drives)


def check_read(scene: Scene, space: Space, effects: Sequence[Effect]) -> None:
    """Raise ValueError for parameters that write no model field and are read by no replay: they would change nothing.

    An effect that states no parameters may read any of them.
    """
    late = Role.TIME_OFFSET.in_theta()
    sensed = [role.in_theta(joint) for role in OF_A_JOINT for joint in scene.joints]
    read = {late, *sensed, *(p.name for e in effects for p in e.parameters)}
    own = [p for p in space.parameters if not p.writes and p.role is not Role.STANDS_FOR]
    unread = [p.name for p in own if p.name not in read]
    if unread and all(e.parameters for e in effects):
        raise ValueError(
            f"parameters {', '.join(unread)} write no field of the model, and nothing in the replay reads them; names "
            f"that it reads: {late}, {', '.join(sensed)}, and those of the effects that it is given"
        )


def check_known(space: Space, recordings: Sequence[Recording]) -> None:
    """Raise ValueError for parameters that stand for others where no fitted recording says so: nothing fits them."""
    kept = without_unused(space, recordings).names
    if idle := [name for name in space.names if name not in kept]:
        raise ValueError(
            f"parameters {', '.join(idle)} stand for others in recordings that say so, and no fitted one does: state "
            f"it there (`known`, or convert --known PARAMETER={idle[0]}), or leave them out"
        )


def check_friction_rows(scene: Scene, space: Space, effects: Sequence[Effect]) -> None:
    """Raise ValueError where an effect would raise dry friction of a joint that MJX has no friction row for.

    MJX lays these rows out at compilation: the effect would change nothing.
    """
    for effect in (e for e in effects if e.frictionloss is not None):
        acts = [at for at, names in effect.locations.items() if not {*names}.isdisjoint(space.names)]
        joints = [at for at in acts if at in scene.single_joints]
        if without := [j for j in joints if scene.model.dof_frictionloss[scene.dof(j)] <= 0]:
            raise ValueError(
                f"effect {effect.name!r} raises dry friction of {', '.join(without)}, which scene {scene.name!r} "
                "compiled without any, so it would change nothing: use registry.ready(scene) in its place "
                "(droid_jax.model.effects.registry)"
            )


def without_unused(space: Space, recordings: Sequence[Recording]) -> Space:
    """The space less parameters that stand for others where none of these recordings says so."""
    named = {value for recording in recordings for value in recording.known.values()}
    return Space(tuple(p for p in space.parameters if p.role is not Role.STANDS_FOR or p.name in named))


def _warn_of_commanded(space: Space) -> None:
    """Warn of parameters that act through commands or constraints, where no recording has any: they change nothing."""
    idle = [
        p.name
        for p in space.parameters
        if p.role is Role.TIME_OFFSET
        or (p.writes and all(w.field.startswith(("actuator_", "dof_sol")) for w in p.writes))
    ]
    if idle:
        warnings.warn(
            f"parameters {', '.join(idle)} change nothing where no recording holds commands: its motion is prescribed",
            stacklevel=3,
        )


def assemble(
    scene: Scene,
    space: Space,
    comparisons: Sequence[Comparison],
    replays: Sequence[Callable[[np.ndarray], Rollout]],
    drives: Sequence[Drive | Motion],
) -> Cost:
    """A Cost from batch replays ([B, D] -> Rollout), what each is compared with, and what each follows."""
    return Cost(
        scene=scene,
        space=space,
        comparisons=tuple(comparisons),
        drives=tuple(drives),
        _replays=tuple(replays),
        _distances=tuple(_compiled(c.distance) for c in comparisons),
        _whitened=tuple(_compiled(c.whitened) for c in comparisons),
        _failed=tuple(_compiled(lambda r, c=c: c.failed(r) | ~r.finite) for c in comparisons),
        _beta=tuple(_compiled(c.failed) for c in comparisons),
        _smoothed=tuple(_compiled(c.smoothed) for c in comparisons),
    )


def followed(scene: Scene, recording: Recording, config: CompareConfig) -> Drive | Motion:
    """What a replay follows: the recording's commands or, where it holds none, its measured motion."""
    validate(recording, allow_jitter=True)  # one made in Python may not have been
    check_range(scene, recording)
    if recording.command.size:
        drive = make_drive(scene, recording, weigh="torque" in config.channels, config=config.start)
        warn_of_commands(scene, recording)
        warn_if_moving(recording)
        return drive
    if not scene.joints:
        raise ValueError(f"no joint of scene {scene.name!r} is driven: name the measured ones (--joints)")
    felt = (*scene.joints, *scene.carriers(scene.joints))  # by the torques that are compared
    cutoff = config.motion_cutoff
    joints = prescribed(scene, recording, cutoff)
    return measured_motion(recording, joints, cutoff=cutoff, alike=felt, rest=config.rest)


def _from_one_start(
    scene: Scene,
    space: Space,
    recording: Recording,
    follows: Drive | Motion,
    replay: Callable,
    config: StartConfig,
) -> Recording:
    if not isinstance(follows, Drive) or not isinstance(replay, Driven):
        return recording

    def alone(drive: Drive) -> Rollout:
        return jax.tree.map(lambda a: a[0], in_blocks(replace(replay, drive=drive), space.mean[None]))

    return from_one_start(scene, recording, follows, alone, config)


def _compared(
    scene: Scene, space: Space, recording: Recording, follows: Drive | Motion, replay: Callable, config: CompareConfig
) -> Comparison:
    """What a recording is compared with its replay by."""
    apart = _apart(replay, scene, recording, config) if isinstance(replay, Along) else None
    recording = _from_one_start(scene, space, recording, follows, replay, config.start)
    rest = follows.rest if isinstance(follows, Motion) else None
    return make_comparison(scene, recording, replay_clock(recording, follows), config, apart, rest)


def _apart(along: Along, scene: Scene, recording: Recording, config: CompareConfig) -> np.ndarray | None:
    """[N, T, J] N m: torques of the repeats' own measured motions, less their mean; None unless each measured its own.

    A replay follows the mean of the measured positions, whose noise, differentiated twice, all repeats share.  What
    the repeats' own motions would take tells how large it is (errors in variables).
    """
    if recording.repeats == 1 or not recording.channel("position").mask.all():
        return None
    motions = [
        measured_motion(
            recording.repeats_subset([n]), along.motion.joints, cutoff=config.motion_cutoff, rest=config.rest
        )
        for n in range(recording.repeats)
    ]
    paths = [motion_path(scene, motion) for motion in motions]
    torques = np.asarray(along.torques(jax.tree.map(lambda *a: jnp.stack(a), *paths)), np.float64)
    return torques - torques.mean(axis=0)


def _same(new: Drive | Motion, old: Drive | Motion) -> bool:
    """Whether what was compiled for the one serves the other, from its own start."""
    if new.torque != old.torque or new.variant != old.variant:
        return False
    if isinstance(new, Motion) and isinstance(old, Motion):
        return new.joints == old.joints and np.array_equal(new.time, old.time)
    if isinstance(new, Motion) or isinstance(old, Motion):
        return False
    sent, before = (np.ones(d.command.shape[1], bool) if d.sent is None else d.sent for d in (new, old))
    return np.array_equal(sent, before) and np.array_equal(new.command[:, sent], old.command[:, sent])


def _start_alike(scene: Scene, new: Drive | Motion, old: Drive | Motion, config: StartConfig) -> bool:
    """Whether two drives have the same gains and known values and start at one place, but for `alike`; motions, which
    are followed as they are, never do.

    An object that stands ajar by about `ajar` is put back for some repeats and not for others.
    """
    if isinstance(new, Motion) or isinstance(old, Motion):
        return False
    if new.known != old.known or not np.array_equal(servo_factors(scene, new), servo_factors(scene, old)):
        return False
    apart = np.full(scene.model.nq, config.alike)
    if scene.object_joint and scene.object_joint not in scene.joints:
        hinge = scene.qpos(scene.object_joint)
        if scene.model.qpos0[hinge] in (new.qpos0[hinge], old.qpos0[hinge]):
            apart[hinge] += config.ajar
    apart[list(following(scene, new.qpos0) & following(scene, old.qpos0))] = np.inf  # by as much as what has them there
    return bool(np.all(np.abs(new.qpos0 - old.qpos0) <= apart))


def replay_clock(recording: Recording, follows: Drive | Motion) -> np.ndarray:
    """[T] s of a replay's rows, on the recording's clock."""
    return follows.time if isinstance(follows, Motion) else float(recording.time[0]) + follows.time


def _compiled(function: Callable[[Any], jax.Array]) -> Callable[[Any], jax.Array]:
    """Of one row of a batch of Rollouts -> of all, in one compiled piece."""
    return jax.jit(jax.vmap(runtime.in_full(function)), compiler_options=runtime.compiler_options())
