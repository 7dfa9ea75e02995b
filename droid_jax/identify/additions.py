"""Additional motions that make parameters identifiable which a recording does not constrain.

The candidates of each joint are a slow ramp, steps, a chirp and a hold at another pose.  Each moves one joint, and
begins and ends at the recording's start.  Their information comes from replays at the values of `excitation`, with the
recording's noise.  They are chosen greedily by their gain per second.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.cost.cost import make_cost
from droid_jax.identify.excitation import (
    Excitation,
    ProposalConfig,
    identifiability_of,
    jacobian_of,
    silent,
    slopes,
)
from droid_jax.identify.identifiability import Identifiability
from droid_jax.model.actuators import has_feedback
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.preflight.preflight import torque_range
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.simulate.hand_path import minimum_jerk
from droid_jax.simulate.servo_gains import scene_stiffness, with_stated_gains

CHANNELS = ("torque", "position", "velocity")  # that the recording of an addition has
DEFAULT_PROPOSAL = ProposalConfig()
PLACEHOLDER = 1e-3  # rad, m or N m, rise of a channel that is not measured yet


@dataclass(frozen=True, eq=False)
class Addition:
    """A motion of one joint.

    what: in words.  joint: that moves.  time: [K] s from 0.  path: [K] rad or m; it begins and ends at the start.
    """

    what: str
    joint: str
    time: np.ndarray
    path: np.ndarray


@dataclass(frozen=True, eq=False)
class MotionProposal:
    """Motions to record in addition.

    chosen: the motions, in the order of choice.  identifiability: of each parameter with them.
    opened: names that they make identifiable.  left: names that are still not identifiable.
    joints: [U] names of the commands.  start: [U] rad or m, where they begin.
    tried: number of candidates.  why: why there were none; empty if there were some.
    """

    chosen: tuple[Addition, ...]
    identifiability: tuple[Identifiability, ...]
    opened: tuple[str, ...]
    left: tuple[str, ...]
    joints: tuple[str, ...]
    start: np.ndarray
    tried: int
    why: str = ""

    @property
    def seconds(self) -> float:
        """Duration of all chosen motions."""
        return float(sum(a.time[-1] for a in self.chosen))

    @property
    def sentence(self) -> str:
        """What to record, or why no motion is proposed."""
        if not self.opened and not self.left:
            return "These recordings constrain all parameters."
        if not self.tried:
            return f"Not identifiable: {', '.join(self.left)}. No motion is proposed: {self.why}."
        remaining = f"No motion that was tried makes {', '.join(self.left)} identifiable" if self.left else ""
        remaining += ": another load, more repeats or a narrower prior may." if remaining else ""
        if not self.opened:
            return remaining
        counts = Counter(a.what for a in self.chosen)
        motions = ", ".join(what if times == 1 else f"{times} times {what}" for what, times in counts.items())
        names = ", ".join(self.opened)
        return f"To make {names} identifiable, also record {motions}: {self.seconds:.0f} s. {remaining}".strip()

    def commands(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the motions one after the other: times [K] s and commands [K, U] rad or m."""
        times, rows, begin = list[np.ndarray](), list[np.ndarray](), 0.0
        for addition in self.chosen:
            time, table = addition.time + begin, np.tile(self.start, (len(addition.time), 1))
            table[:, self.joints.index(addition.joint)] = addition.path
            first = 1 if times else 0  # the first row repeats the last one of the motion before
            times.append(time[first:])
            rows.append(table[first:])
            begin = float(time[-1])
        return np.concatenate(times), np.concatenate(rows)


def additions(scene: Scene, recording: Recording, config: ProposalConfig = DEFAULT_PROPOSAL) -> tuple[Addition, ...]:
    """Return the candidate motions of a recording's joints, inside their ranges.

    There are none for a hand that holds an object.

    scene: of the recording.  recording: whose start and rate the motions have.  config: of the motions.
    """
    if scene.object_joint is not None or scene.grip is not None:
        return ()
    scene = variant_scene(scene, recording.variant, recording.name)
    joints, start = _start(scene, recording)
    step = float(np.median(np.diff(recording.time))) if recording.command.size else 1.0 / config.rate
    time = np.arange(round(config.seconds / step) + 1) * step
    steps = _steps(time)
    out = list[Addition]()
    for joint, q in zip(joints, start, strict=True):
        gear = _gear(scene, recording, joint)
        down, up, scale = _free_range(scene, recording, joint, float(q) / gear, config)
        if max(down, up) <= 0 or (recording.command.size and joint not in _servos(scene)):
            continue

        def scaled(shape: np.ndarray, largest: float, down: float = down, up: float = up) -> np.ndarray:
            """A path from a shape of -1 to 1, limited to the free range on each side."""
            return np.where(shape > 0, shape * min(up, largest), shape * min(down, largest))

        unit = "m" if scene.slides(joint) else "rad"
        side = 1.0 if up >= down else -1.0
        largest_step = min(scale * config.step, _largest_step(scene, recording, joint, config.torque_share))
        for what, shape, largest in (
            ("a slow ramp", _ramp(time), scale * config.ramp),
            ("steps", steps, largest_step),
            (f"a chirp of {config.chirp[0]:g} to {config.chirp[1]:g} Hz", _chirp(time, config), scale * config.swing),
            ("a hold at another pose", side * _hold(time), scale * config.hold),
        ):
            if shape is steps and not recording.command.size:
                continue  # a measured path has no steps
            path = scaled(shape, largest)
            size = f"{np.abs(path).max():.2g} {unit}"
            out.append(Addition(f"{what} of {joint} ({size})", joint, time, q + gear * path))
    return tuple(out)


def _why_none(scene: Scene, recording: Recording) -> str:
    """Why `additions` returns no motion."""
    joints, _ = _start(scene, recording)
    if scene.object_joint is not None or scene.grip is not None:
        return "a hand holds an object, and its path is not known to be free"
    if recording.command.size and not _servos(scene).intersection(joints):
        return "the commands go to no position servo"
    if not joints:
        return "no joint's position was measured where the recording begins"
    return "every joint is at the end of its range"


def propose(
    scene: Scene, space: Space, found: Excitation, recording: Recording, candidates: Sequence[Addition] | None = None
) -> MotionProposal:
    """Choose motions that make parameters identifiable which recordings do not constrain.

    Args:
        scene: as for `excitation`.
        space: as for `excitation`.
        found: information in the recordings.
        recording: one of them, whose start, rate and torque convention the motions have.
        candidates: motions to choose from; None for `additions` of the recording.

    Returns:
        The proposal.  No motion is chosen if all parameters are identifiable, or if no motion helps.
    """
    config = found.config.proposal
    joints, start = _start(scene, recording)
    candidates = additions(scene, recording, config) if candidates is None else tuple(candidates)
    target = config.margin * found.config.identifiability.identifiable
    main = ~space.nuisance
    chosen, total = list[Addition](), found.information

    def verdicts(information: np.ndarray) -> tuple[Identifiability, ...]:
        return identifiability_of(space, information, found.config.identifiability)

    def log_widths(information: np.ndarray) -> np.ndarray:
        shrinkage = np.array([verdict.shrinkage for verdict in verdicts(information)])[main]
        return np.log(np.maximum(shrinkage, target))

    each, why = dict[int, np.ndarray](), "" if candidates else _why_none(scene, recording)
    if found.open and candidates:
        try:
            each = _information(scene, space, found, recording, candidates)
        except ValueError as error:  # the information in the recordings is valid nevertheless
            candidates, why = (), f"those that were tried cannot be replayed ({error})"
    while each and len(chosen) < config.most and np.any(log_widths(total) > np.log(target)):
        before = log_widths(total)
        gains = {k: float(np.sum(before - log_widths(total + i))) for k, i in each.items()}
        best = max(gains, key=lambda k: gains[k] / candidates[k].time[-1])
        if gains[best] < config.least_gain:
            break
        chosen.append(candidates[best])
        total = total + each[best]
    for motion in list(chosen):  # a later motion may have made an earlier one superfluous
        without = total - each[candidates.index(motion)]
        if np.all(log_widths(without) <= np.maximum(log_widths(total), np.log(target))):
            chosen.remove(motion)
            total = without
    after = verdicts(total)
    identifiable = {verdict.name for verdict in after if verdict.identifiable}
    if not identifiable.intersection(found.open):  # the posteriors are narrower, but none is narrow enough
        chosen, after = [], verdicts(found.information)
    return MotionProposal(
        chosen=tuple(chosen),
        identifiability=after,
        opened=tuple(name for name in found.open if name in identifiable),
        left=tuple(name for name in found.open if name not in identifiable),
        joints=joints,
        start=start,
        tried=len(candidates),
        why=why,
    )


def _information(
    scene: Scene, space: Space, found: Excitation, recording: Recording, candidates: Sequence[Addition]
) -> dict[int, np.ndarray]:
    """Number of a candidate -> its information [D, D], per squared search unit."""
    motions = [motion_recording(scene, recording, addition, str(k)) for k, addition in enumerate(candidates)]
    config = found.config
    with silent():
        cost = make_cost(scene, space, motions, engine=found.engine, config=config.compare, check=False)
        if not recording.command.size and "torque" in recording.channels:  # friction at rest follows measured torques
            motions = [
                _with_torques(scene, motion, rollout)
                for motion, rollout in zip(motions, cost.rollouts(found.values[None]), strict=True)
            ]
            cost = cost.against(motions)
    comparison = cost.comparisons[0]  # all have one clock and one filter, and the measurement cancels in differences
    channels = []
    for channel in comparison.channels:
        noise = found.noise[channel.name]
        median = float(np.median(list(noise.values())))
        names = [scene.joints[c] if c < len(scene.joints) else "" for c in channel.columns.tolist()]
        # The residual of a joint at rest underestimates its noise.
        deviation = np.array([max(median, noise.get(name, median)) for name in names])
        channels.append(replace(channel, noise=channel.noise.stated(deviation)))
    first = cost.first().compared_by([replace(comparison, channels=tuple(channels))])
    rollouts, steps = slopes(cost, space, space.to_search(found.values), config.step)
    out = dict[int, np.ndarray]()
    for k, rollout in enumerate(rollouts):
        jacobian = jacobian_of(first.whitened_of([rollout]), steps) / found.widening
        out[k] = jacobian.T @ jacobian
    return out


def _with_torques(scene: Scene, motion: Recording, rollout: Rollout) -> Recording:
    """A recording whose torques are those of its replay [1, T, ...]; they rise as its placeholders did."""
    channel = motion.channels["torque"]
    torque = interpolate(channel.time, np.asarray(rollout.time[0]), np.asarray(rollout.torque[0]))
    values = channel.values + torque[:, [scene.joints.index(j) for j in channel.columns]]
    return replace(motion, channels={**motion.channels, "torque": replace(channel, values=values)})


def motion_recording(scene: Scene, recording: Recording, addition: Addition, name: str) -> Recording:
    """Return an addition as a recording of one repeat, with placeholder measurements: only its replay is used."""
    scene = variant_scene(scene, recording.variant, recording.name)
    joints, start = _start(scene, recording)
    table = np.tile(start, (len(addition.time), 1))
    table[:, joints.index(addition.joint)] = addition.path
    commanded = bool(recording.command.size)
    # Of a motor the command is no position.
    places = {
        j: float(q) / _gear(scene, recording, j)
        for j, q in zip(joints, start, strict=True)
        if j in scene.single_joints and not (commanded and j not in _servos(scene))
    }
    begin = {**recording.measured_start(), **recording.qpos0, **places}
    # Placeholders increase with time, since constant channels are refused, and stay near the start.
    rising = np.linspace(0.0, PLACEHOLDER, len(addition.time))
    channels = dict[str, Channel]()
    for key in CHANNELS:
        if key not in recording.channels and key != "position":
            continue
        names = recording.channels[key].columns if key in recording.channels else joints
        columns = tuple(j for j in names if j in joints)
        if key == "position" and not commanded:
            values = table[:, [joints.index(j) for j in columns]]
        else:
            first = [begin.get(j, 0.0) if key == "position" else 0.0 for j in columns]
            values = np.array(first) + rising[:, None]
        unit = recording.channels[key].unit if key in recording.channels else "rad"
        measured = np.ones((1, *values.shape), bool)
        channels[key] = Channel(key, unit, columns, addition.time, values[None].copy(), measured)
    qpos0 = {j: q for j, q in begin.items() if j in recording.qpos0 or j in scene.single_joints}
    return Recording(
        name=name,
        time=addition.time if commanded else np.zeros(0),
        command=table if commanded else np.zeros((0, 0)),
        command_names=joints if commanded else (),
        channels=channels,
        torque=recording.torque,
        qpos0=qpos0,
        gains=recording.gains,
        known=recording.known,
        variant=recording.variant,
    )


def _start(scene: Scene, recording: Recording) -> tuple[tuple[str, ...], np.ndarray]:
    """Names [U] of the commanded joints, and the start [U] of an addition, rad or m."""
    if recording.command.size:
        return recording.command_names, recording.command[0].astype(float)
    measured = recording.measured_start()
    joints = tuple(j for j in scene.joints if j in measured)
    return joints, np.array([measured[j] for j in joints])


def _servos(scene: Scene) -> set[str]:
    """Names of the position servos."""
    return {scene.command_names[u] for u in np.flatnonzero(has_feedback(scene.model))}


def _gear(scene: Scene, recording: Recording, joint: str) -> float:
    """The ratio of a joint's command to its position."""
    if not recording.command.size or joint not in scene.command_names:
        return 1.0
    u = scene.command_names.index(joint)
    return float(scene.model.actuator_gear[u, 0]) if scene.of_joint[u] else 1.0


def _free_range(
    scene: Scene, recording: Recording, joint: str, q: float, config: ProposalConfig
) -> tuple[float, float, float]:
    """Distances rad or m that a joint can move down and up from q, and the unit of displacements.

    The unit is 1 rad, or for a slide its motion in the recording.
    """
    low, high = -np.inf, np.inf
    if joint in scene.single_joints:
        index = scene.id("joint", joint)
        if scene.model.jnt_range[index, 0] < scene.model.jnt_range[index, 1]:
            low, high = scene.model.jnt_range[index]
    if joint in scene.command_names:
        u = scene.command_names.index(joint)
        if scene.model.actuator_ctrllimited[u]:
            ends = sorted(scene.model.actuator_ctrlrange[u] / _gear(scene, recording, joint))
            low, high = max(low, ends[0]), min(high, ends[1])
    unit = 1.0
    if joint not in scene.single_joints or scene.slides(joint):
        path = (
            recording.command[:, recording.command_names.index(joint)]
            if recording.command.size
            else _measured(recording.channels["position"], joint)
        )
        unit = float(np.ptp(path)) / abs(_gear(scene, recording, joint))
    return max(0.0, config.range_share * (q - low)), max(0.0, config.range_share * (high - q)), unit


def _largest_step(scene: Scene, recording: Recording, joint: str, share: float) -> float:
    """Step of a servo's command, rad or m, that demands a share of its torque limit; infinite without a limit."""
    if joint not in scene.single_joints or joint not in scene.command_names:
        return np.inf
    u, limit = scene.command_names.index(joint), min(np.abs(torque_range(scene, joint)))
    stiffness = scene_stiffness(replace(scene, model=with_stated_gains(scene, recording)))[u]
    return share * limit / stiffness if stiffness > 0 else np.inf


def _measured(channel: Channel, joint: str) -> np.ndarray:
    """[K] measured samples of a joint, of all repeats."""
    i = channel.columns.index(joint)
    return channel.values[..., i][channel.mask[..., i]]


# Shapes from -1 to 1 over a time [K], which begin and end at 0 ------------------------------------------------


def _ramp(time: np.ndarray) -> np.ndarray:
    """Up, down to the other side, and back, at constant speed."""
    return np.interp(time / time[-1], [0.0, 0.05, 0.275, 0.725, 0.95, 1.0], [0.0, 0.0, 1.0, -1.0, 0.0, 0.0])


def _steps(time: np.ndarray) -> np.ndarray:
    """Steps to each side and back to the middle, so that no step is larger than 1."""
    levels = np.array([0.0, 1.0, 0.0, -1.0, 0.0, 0.0])
    return levels[np.minimum((time / time[-1] * len(levels)).astype(int), len(levels) - 1)]


def _chirp(time: np.ndarray, config: ProposalConfig) -> np.ndarray:
    """A sine whose frequency grows exponentially."""
    first, last = config.chirp
    growth = np.log(last / first) / time[-1]
    fade_in, fade_out = (np.clip(t / config.ease, 0.0, 1.0) for t in (time, time[-1] - time))
    return fade_in * fade_out * np.sin(2 * np.pi * first * np.expm1(growth * time) / growth)


def _hold(time: np.ndarray) -> np.ndarray:
    """To another pose in the first quarter of the time, and back in the last."""
    share = time / time[-1]
    return minimum_jerk(np.clip(np.minimum(share, 1.0 - share) / 0.25, 0.0, 1.0))
