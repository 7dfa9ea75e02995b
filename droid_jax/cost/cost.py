"""The vmapped cost: distance between replays and recordings for a batch of parameter vectors.

cost = make_cost(scene, space, [recording])
cost(values)            # [P, D] -> [P]   N m
cost.whitened(values)   # [P, D] -> [P, M] residuals in noise units
cost.rollouts(values)   # [P, D] -> one Rollout per recording
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax import runtime
from droid_jax.arguments import instance, instances, one_of
from droid_jax.cost.residuals import CompareConfig, Comparison, make_comparison, with_estimated_noise
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
from droid_jax.simulate.compiled import Along, Driven, along_another, check_variant, compiled_replay
from droid_jax.simulate.engine import ENGINES
from droid_jax.simulate.initial_state import StartConfig, coupled_addresses
from droid_jax.simulate.inverse_dynamics import motion_path, prescribed_joints
from droid_jax.simulate.measured_motion import Motion, measured_motion
from droid_jax.simulate.repeat_starts import from_one_start, own_starts
from droid_jax.simulate.replay import Drive, make_drive
from droid_jax.simulate.servo_gains import check_gains, servo_factors


class OneReplay(NamedTuple):
    """What one replay of a recording gives for P values; arrays of the host.

    distance: [P] its cost.  penalty: [P] the part of it for a lost grasp or a door that stayed shut.
    smoothed: [P, K, C] its leading channel through the filter of the data.  rollout: [P, T, ...].
    """

    distance: Any
    penalty: Any
    smoothed: Any
    rollout: Rollout


@dataclass(frozen=True, eq=False, repr=False)
class Cost:
    """The cost of recordings over a space.  Call it with physical values [P, D]; all methods return host arrays.

    scene: what is simulated.  space: meaning of the D entries.  comparisons: one for each of R recordings.
    drives: what each replay follows, commands or a measured motion.
    """

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
        """Return the cost [P] at values [P, D], the mean over the recordings; never NaN."""
        return np.mean(self.distances(values), axis=1)

    def distances(self, values: Any) -> np.ndarray:
        """Return the cost [P, R] of each recording at values [P, D]."""
        return self._blockwise(values, self._distances, lambda parts: np.stack(parts, axis=1))

    def whitened(self, values: Any) -> np.ndarray:
        """Return residuals [P, M] of all recordings at values [P, D], in units of the noise of the repeats' mean."""
        return self._blockwise(values, self._whitened, lambda parts: np.concatenate(parts, axis=1))

    def failed(self, values: Any) -> np.ndarray:
        """Return [P] bool at values [P, D]: the grasp was lost, the door stayed shut, or the replay blew up."""
        return self._blockwise(values, self._failed, lambda parts: np.any(np.stack(parts), axis=0))

    def penalties(self, values: Any) -> np.ndarray:
        """Return the part c beta [P, R] N m of each recording's cost at values [P, D]."""
        failed = self._blockwise(values, self._beta, lambda parts: np.stack(parts, axis=1))
        return failed * np.array([c.config.failure_cost for c in self.comparisons])

    def smoothed(self, values: Any) -> tuple[np.ndarray, ...]:
        """Return each recording's simulated leading channel (torque where it is compared) at values [P, D].

        The channel [P, K, C] has passed through the filter of the data and is in its own unit.
        """
        return self._blockwise(values, self._smoothed, tuple)

    def rollouts(self, values: Any) -> tuple[Rollout, ...]:
        """Return a Rollout of host arrays [P, T, ...] for each recording, at values [P, D].

        Its `time` starts at 0 where commands were replayed; `comparisons[i].clock` [T] is on recording i's own clock.
        """
        identity = tuple((lambda r: r) for _ in self._replays)
        return self._blockwise(values, identity, tuple)

    def replayed(self, values: Any) -> tuple[OneReplay, ...]:
        """Return a `OneReplay` of host arrays for each recording, at values [P, D]: all from one replay."""

        def of(number: int) -> Callable[[Rollout], OneReplay]:
            distance, beta, smoothed = self._distances[number], self._beta[number], self._smoothed[number]
            cost = self.comparisons[number].config.failure_cost
            return lambda r: OneReplay(distance(r), cost * beta(r), smoothed(r), r)

        return self._blockwise(values, [of(number) for number in range(len(self._replays))], tuple)

    def whitened_of(self, rollouts: Sequence[Rollout]) -> np.ndarray:
        """Return residuals [P, M] in noise units of given replays, one Rollout [P, T, ...] for each recording."""
        parts = [np.asarray(f(rollout)) for f, rollout in zip(self._whitened, rollouts, strict=True)]
        return np.concatenate(parts, axis=1)

    def compared_by(self, comparisons: Sequence[Comparison]) -> Cost:
        """Return a cost with the same replays and other comparisons of the same recordings."""
        return assemble(self.scene, self.space, comparisons, self._replays, self.drives)

    def alone(self, number: int) -> Cost:
        """Return the cost of one of the recordings, with the same compiled functions."""
        each = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("scene", "space")}
        return replace(self, **{name: (of_recordings[number],) for name, of_recordings in each.items()})

    def first(self) -> Cost:
        """Return the cost of the first recording alone."""
        return self.alone(0)

    def with_estimated_noise(self, values: np.ndarray) -> Cost:
        """Return a cost whose noise of single repeats is estimated from the residuals at `values` [D]."""
        rollouts = [jax.tree.map(lambda a: a[0], r) for r in self.rollouts(values[None])]
        return self.compared_by(with_estimated_noise(self.comparisons, rollouts))

    def against(self, recordings: Sequence[Recording], config: CompareConfig | None = None) -> Cost:
        """Return a cost with the same compiled replays, compared with other repeats of the same recordings.

        Repeats that start elsewhere are replayed from there.  A recording without commands may hold another motion,
        which its replay then follows.

        Args:
            recordings: as many as this cost has, with the same commands, torque convention and `motion_cutoff`.
                Recordings without commands need the same clock and the same joints that were measured throughout.
            config: how simulation and measurement are compared, with the same `mj_step`; None for that of this cost.

        Raises:
            ValueError: the compiled replays do not fit the recordings or the configuration.
        """
        recordings = recordings_of(recordings)
        if len(recordings) != len(self.drives):
            raise ValueError(f"expected repeats of {len(self.drives)} replayed recordings, got {len(recordings)}")
        if config is not None and any(c.config.mj_step != config.mj_step for c in self.comparisons):
            raise ValueError("the replays were compiled with another mj_step: make another cost (`make_cost`)")
        comparisons, drives, replays = [], [], []
        for given, old, drive, replay in zip(recordings, self.comparisons, self.drives, self._replays, strict=True):
            scene = variant_scene(self.scene, given.variant, given.name)
            recording = own_starts(given, (config or old.config).start)
            new = followed(scene, recording, config or old.config)
            if isinstance(new, Drive):
                check_gains(scene, new)
            if not _same_program(new, drive):
                raise ValueError(
                    f"recording {recording.name!r} holds other commands than {old.name!r} had, measured another torque "
                    "(side, gravity), states another variant of the MJCF or, without commands, has another clock "
                    "(motion_cutoff changes it too) or other joints whose positions were measured throughout"
                )
            drives.append(drive if _same_start(scene, new, drive, (config or old.config).start) else new)
            replays.append(along_another(replay, drives[-1]))
            comparisons.append(_compared(scene, self.space, recording, drives[-1], replays[-1], config or old.config))
        return assemble(self.scene, self.space, comparisons, replays, drives)

    def from_one_start(self, index: int, recording: Recording) -> Recording:
        """Return a recording whose repeats all start where replay `index` does (`repeat_starts.from_one_start`)."""
        config = self.comparisons[index].config.start
        recording, scene = own_starts(recording, config), variant_scene(self.scene, recording.variant, recording.name)
        return _from_one_start(scene, self.space, recording, self.drives[index], self._replays[index], config)

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
    few: bool = False,
) -> Cost:
    """Return the cost of a scene over one or more recordings: equation 1 of the paper.

    A recording with commands is replayed by its servo, one without by inverse dynamics of its measured motion.

    Args:
        scene: what is simulated.
        space: meaning of the vectors [D].
        recordings: R recordings of the same robot and object.
        engine: "mjx" (compiled, all devices) or "mujoco" (plain C, all cores; the parity oracle).
        config: how simulation and measurement are compared; None for the defaults.
        effects: extra physics or observation models whose parameters are part of the space. Torque offsets, and joint
            friction behind the sensor where the space holds any, are built in. Effects that raise the dry friction of a
            joint need `registry.ready(scene)`.
        check: warn of implausible units, signs and clocks in the recordings (`preflight.check_log`).
        few: whether a few vectors will be replayed in all. MJX then compiles sooner and replays more slowly.

    Returns:
        A cost. Called with physical values [P, D], it returns [P] N m.

    Raises:
        ValueError: a space of another scene, unknown engines, joints or channels, parameters that nothing reads, gains
            that do not match, or friction effects at joints without a friction row (`registry.ready` adds one).
    """
    config = instance(CompareConfig() if config is None else config, "config", CompareConfig)
    check_space(instance(scene, "scene", Scene), instance(space, "space", Space))
    recordings, effects = recordings_of(recordings), instances(effects, "effects", Effect)
    one_of(engine, "engine", ENGINES)
    recordings = [own_starts(recording, config.start) for recording in recordings]
    scenes = [variant_scene(scene, r.variant, r.name) for r in recordings]
    drives = [followed(own, r, config) for own, r in zip(scenes, recordings, strict=True)]
    for recording in recordings if check else ():
        warn_of_log(scene, recording)
    check_read(scene, space, effects)
    check_inertia(scene, space)
    for own, recording in zip(scenes, recordings, strict=True):
        check_variant(own, space, effects, recording.name)
    commanded = any(isinstance(drive, Drive) for drive in drives)
    if not commanded:
        _warn_of_commanded(space)
    elif engine == "mjx":
        check_friction_rows(scene, space, effects)
    replays = tuple(
        compiled_replay(engine, own, space, d, effects, config.mj_step, few)
        for own, d in zip(scenes, drives, strict=True)
    )
    comparisons = tuple(
        _compared(own, space, recording, drive, replay, config)
        for own, recording, drive, replay in zip(scenes, recordings, drives, replays, strict=True)
    )
    return assemble(scene, space, comparisons, replays, drives)


def check_read(scene: Scene, space: Space, effects: Sequence[Effect]) -> None:
    """Raise ValueError for parameters that write no model field and that no replay reads: they would have no effect.

    An effect that states no parameters may read any of them.
    """
    time_offset = Role.TIME_OFFSET.in_theta()
    of_joints = [role.in_theta(joint) for role in OF_A_JOINT for joint in scene.joints]
    read = {time_offset, *of_joints, *(p.name for e in effects for p in e.parameters)}
    outside_model = [p for p in space.parameters if not p.writes and p.role is not Role.STANDS_FOR]
    unread = [p.name for p in outside_model if p.name not in read]
    if unread and all(e.parameters for e in effects):
        raise ValueError(
            f"parameters {', '.join(unread)} write no field of the model, and nothing in the replay reads them; names "
            f"that it reads: {time_offset}, {', '.join(of_joints)}, and those of the effects that it is given"
        )


def check_known(space: Space, recordings: Sequence[Recording]) -> None:
    """Raise ValueError for parameters that stand for others only in recordings that are not fitted."""
    used = without_unused(space, recordings).names
    if unused := [name for name in space.names if name not in used]:
        raise ValueError(
            f"parameters {', '.join(unused)} stand for others in recordings that say so, and no fitted one does: state "
            f"it there (`known`, or convert --known PARAMETER={unused[0]}), or leave them out"
        )


def check_friction_rows(scene: Scene, space: Space, effects: Sequence[Effect]) -> None:
    """Raise ValueError where an effect raises the dry friction of a joint for which MJX has no friction row.

    MJX allocates these rows at compilation, so the effect would change nothing.
    """
    for effect in (e for e in effects if e.frictionloss is not None):
        locations = [at for at, names in effect.locations.items() if not {*names}.isdisjoint(space.names)]
        joints = [at for at in locations if at in scene.single_joints]
        if without_row := [j for j in joints if scene.model.dof_frictionloss[scene.dof(j)] <= 0]:
            raise ValueError(
                f"effect {effect.name!r} raises dry friction of {', '.join(without_row)}, which scene {scene.name!r} "
                "compiled without any, so it would change nothing: use registry.ready(scene) in its place "
                "(droid_jax.model.effects.registry)"
            )


def without_unused(space: Space, recordings: Sequence[Recording]) -> Space:
    """Return the space without parameters that stand for others in none of these recordings."""
    named = {value for recording in recordings for value in recording.known.values()}
    return Space(tuple(p for p in space.parameters if p.role is not Role.STANDS_FOR or p.name in named))


def _warn_of_commanded(space: Space) -> None:
    """Warn of parameters that act through commands or constraints if no recording has commands: they have no effect."""
    without_effect = [
        p.name
        for p in space.parameters
        if p.role is Role.TIME_OFFSET
        or (p.writes and all(w.field.startswith(("actuator_", "dof_sol")) for w in p.writes))
    ]
    if without_effect:
        warnings.warn(
            f"parameters {', '.join(without_effect)} change nothing where no recording holds commands: its motion is "
            "prescribed",
            stacklevel=3,
        )


def assemble(
    scene: Scene,
    space: Space,
    comparisons: Sequence[Comparison],
    replays: Sequence[Callable[[np.ndarray], Rollout]],
    drives: Sequence[Drive | Motion],
) -> Cost:
    """Return a Cost of batch replays ([B, D] -> Rollout), with the comparison and the drive or motion of each."""
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
    """Return what a replay follows: the recording's commands or, if there are none, its measured motion."""
    validate(recording, allow_jitter=True)  # a recording that was made in Python may be invalid
    check_range(scene, recording)
    if recording.command.size:
        drive = make_drive(scene, recording, weigh="torque" in config.channels, config=config.start)
        warn_of_commands(scene, recording)
        warn_if_moving(recording)
        return drive
    if not scene.joints:
        raise ValueError(f"no joint of scene {scene.name!r} is driven: name the measured ones (--joints)")
    relevant = (*scene.joints, *scene.carriers(scene.joints))  # joints whose motion enters the compared torques
    cutoff = config.motion_cutoff
    joints = prescribed_joints(scene, recording, cutoff)
    return measured_motion(recording, joints, cutoff=cutoff, alike=relevant, rest=config.rest)


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
    """The comparison of a recording with its replay."""
    motion_torques = _motion_torques(replay, scene, recording, config) if isinstance(replay, Along) else None
    recording = _from_one_start(scene, space, recording, follows, replay, config.start)
    rest = follows.rest if isinstance(follows, Motion) else None
    return make_comparison(scene, recording, replay_clock(recording, follows), config, motion_torques, rest)


def _motion_torques(along: Along, scene: Scene, recording: Recording, config: CompareConfig) -> np.ndarray | None:
    """[N, T, J] N m, torques of the repeats' own measured motions minus their mean.

    None for one repeat, or where positions are missing.  A replay follows the mean of the measured positions.  The
    noise of that mean, differentiated twice, is common to all repeats.  Its size shows in how much the torques of the
    repeats' own motions differ (errors in variables).
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


def _same_program(new: Drive | Motion, old: Drive | Motion) -> bool:
    """Whether a replay compiled for `old` can replay `new`, which may start elsewhere."""
    if new.torque != old.torque or new.variant != old.variant:
        return False
    if isinstance(new, Motion) and isinstance(old, Motion):
        return new.joints == old.joints and np.array_equal(new.time, old.time)
    if isinstance(new, Motion) or isinstance(old, Motion):
        return False
    sent, sent_before = (np.ones(d.command.shape[1], bool) if d.sent is None else d.sent for d in (new, old))
    return np.array_equal(sent, sent_before) and np.array_equal(new.command[:, sent], old.command[:, sent])


def _same_start(scene: Scene, new: Drive | Motion, old: Drive | Motion, config: StartConfig) -> bool:
    """Whether two drives have the same gains and known values, and start within `config.alike` of each other.

    False for motions.  An object that is ajar by about `config.ajar` is reset to shut for some repeats and not for
    others, so the tolerance of its joint is larger by `ajar`.
    """
    if isinstance(new, Motion) or isinstance(old, Motion):
        return False
    if new.known != old.known or not np.array_equal(servo_factors(scene, new), servo_factors(scene, old)):
        return False
    tolerance = np.full(scene.model.nq, config.alike)
    if scene.object_joint and scene.object_joint not in scene.joints:
        hinge = scene.qpos(scene.object_joint)
        if scene.model.qpos0[hinge] in (new.qpos0[hinge], old.qpos0[hinge]):
            tolerance[hinge] += config.ajar
    coupled = coupled_addresses(scene, new.qpos0) & coupled_addresses(scene, old.qpos0)
    tolerance[list(coupled)] = np.inf  # an equality moves them with the joints that couple them
    return bool(np.all(np.abs(new.qpos0 - old.qpos0) <= tolerance))


def replay_clock(recording: Recording, follows: Drive | Motion) -> np.ndarray:
    """Return times [T] s of a replay's rows, on the recording's clock."""
    return follows.time if isinstance(follows, Motion) else float(recording.time[0]) + follows.time


def _compiled(function: Callable[[Any], jax.Array]) -> Callable[[Any], jax.Array]:
    """A function of one Rollout, vmapped over a batch [P, ...] and compiled."""
    return jax.jit(jax.vmap(runtime.in_full(function)), compiler_options=runtime.compiler_options())
