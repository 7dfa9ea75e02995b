"""Motions that tell the parameters which a recording leaves open: a few for each joint, and the best of them.

Each begins and ends where the recording does and moves one joint alone: a slow ramp, steps, a chirp, a hold elsewhere.
Their information comes from replays at the values of `excitation`, with the noise that the recording has.  They are
picked greedily by what they gain for each second.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.cost.cost import make_cost
from droid_jax.identify.excitation import Excitation, identifiability_of, jacobian_of, silent, slopes
from droid_jax.identify.identifiability import Identifiability
from droid_jax.model.actuators import has_feedback
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.preflight.preflight import torque_range
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.simulate.hand_path import minimum_jerk
from droid_jax.simulate.servo_gains import own_stiffness, with_stated_gains

SECONDS = 6.0  # of each addition
EASE = 0.5  # s in which a chirp begins and ends
CHIRP = (0.3, 2.0)  # Hz
# Largest ways, rad, that a joint is sent; a slide goes as many times its own motion in the recording.
RAMP, STEP, SWING, AWAY = 0.6, 0.3, 0.1, 0.8
LIMIT = 0.5  # share of a servo's torque limit that a step may ask for at once
FREE = 0.9  # share of the way to the end of a joint's range that an addition may take
RATE = 100.0  # Hz of an addition, where a recording has no command
MARGIN = 0.8  # of the limit of identifiability, that an addition must reach
LEAST = 0.05  # gain (natural logarithm of a width) below which no addition is worth its time
MOST = 8  # additions
COLUMNS = ("torque", "position", "velocity")


@dataclass(frozen=True, eq=False)
class Addition:
    """A motion of one joint.

    what: in words.  joint: that moves.  time: [K] s from 0.  path: [K] rad or m, from and to where the joint starts.
    """

    what: str
    joint: str
    time: np.ndarray
    path: np.ndarray


@dataclass(frozen=True, eq=False)
class MotionProposal:
    """What to record besides.

    chosen: in the order in which they were picked.  identifiability: of each parameter with them.
    opened: the names that they make identifiable.  left: those that stay open.  tried: candidates.
    joints, start: [U] of the commands, and where they begin, rad or m.
    why: no motion was tried; empty where some were.
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
        """Of all that was chosen."""
        return float(sum(a.time[-1] for a in self.chosen))

    @property
    def sentence(self) -> str:
        """What to record, or why nothing would help."""
        if not self.opened and not self.left:
            return "These recordings tell all parameters."
        if not self.tried:
            return f"Open stay {', '.join(self.left)}. No motion is proposed: {self.why}."
        left = f"None of the motions that were tried tells {', '.join(self.left)}" if self.left else ""
        left += ": another load, more repeats or a narrower prior may." if left else ""
        if not self.opened:
            return left
        counts = Counter(a.what for a in self.chosen)
        motions = ", ".join(what if times == 1 else f"{times} times {what}" for what, times in counts.items())
        return f"To tell {', '.join(self.opened)}, record besides {motions}: {self.seconds:.0f} s. {left}".strip()

    def commands(self) -> tuple[np.ndarray, np.ndarray]:
        """[K] s and [K, U] rad or m: the additions one after the other."""
        times, rows, begin = list[np.ndarray](), list[np.ndarray](), 0.0
        for addition in self.chosen:
            time, table = addition.time + begin, np.tile(self.start, (len(addition.time), 1))
            table[:, self.joints.index(addition.joint)] = addition.path
            first = 1 if times else 0  # it begins where the last one ended
            times.append(time[first:])
            rows.append(table[first:])
            begin = float(time[-1])
        return np.concatenate(times), np.concatenate(rows)


def additions(scene: Scene, recording: Recording) -> tuple[Addition, ...]:
    """The motions that a recording's joints could make besides, inside their ranges; none of a hand on an object."""
    if scene.object_joint is not None or scene.grip is not None:
        return ()
    scene = variant_scene(scene, recording.variant)
    joints, start = _start(scene, recording)
    step = float(np.median(np.diff(recording.time))) if recording.command.size else 1.0 / RATE
    time = np.arange(round(SECONDS / step) + 1) * step
    jumps = _steps(time)
    found = list[Addition]()
    for joint, q in zip(joints, start, strict=True):
        gear = _gear(scene, recording, joint)
        down, up, unit = _room(scene, recording, joint, float(q) / gear)
        if max(down, up) <= 0 or (recording.command.size and joint not in _servos(scene)):
            continue

        def both(share: np.ndarray, most: float, down: float = down, up: float = up) -> np.ndarray:
            """A path of -1 to 1 as far as there is room on each side."""
            return np.where(share > 0, share * min(up, most), share * min(down, most))

        kind = "m" if scene.slides(joint) else "rad"
        side = 1.0 if up >= down else -1.0
        for what, share, most in (
            ("a slow ramp", _ramp(time), unit * RAMP),
            ("steps", jumps, min(unit * STEP, _largest_jump(scene, recording, joint))),
            (f"a chirp of {CHIRP[0]:g} to {CHIRP[1]:g} Hz", _chirp(time), unit * SWING),
            ("a hold at another pose", side * _hold(time), unit * AWAY),
        ):
            if share is jumps and not recording.command.size:
                continue  # a measured path has no jumps
            path = both(share, most)
            size = f"{np.abs(path).max():.2g} {kind}"
            found.append(Addition(f"{what} of {joint} ({size})", joint, time, q + gear * path))
    return tuple(found)


def _why_none(scene: Scene, recording: Recording) -> str:
    """Why `additions` has no motion."""
    joints, _ = _start(scene, recording)
    if scene.object_joint is not None or scene.grip is not None:
        return "a hand holds an object, and its way is not known to be free"
    if recording.command.size and not _servos(scene).intersection(joints):
        return "the commands go to no position servo"
    if not joints:
        return "no joint's position was measured where the recording begins"
    return "no joint has room in its range"


def propose(
    scene: Scene, space: Space, found: Excitation, recording: Recording, candidates: Sequence[Addition] | None = None
) -> MotionProposal:
    """The shortest addition, of those of `additions`, that tells what a recording leaves open.

    Args:
        scene: as of `excitation`.
        space: likewise.
        found: what the recording, or several, tell.
        recording: whose start, rate and torque the additions have.
        candidates: additions to choose from; None: `additions` of the recording.

    Returns:
        What to record; nothing chosen where nothing is open, or where no addition would help.
    """
    joints, start = _start(scene, recording)
    candidates = additions(scene, recording) if candidates is None else tuple(candidates)
    limit = found.config.identifiability.identifiable
    main = ~space.nuisance
    chosen, total = list[Addition](), found.information

    def judged(information: np.ndarray) -> tuple[Identifiability, ...]:
        return identifiability_of(space, information, found.config.identifiability)

    def widths(information: np.ndarray) -> np.ndarray:
        reached = np.array([t.shrinkage for t in judged(information)])[main]
        return np.log(np.maximum(reached, MARGIN * limit))

    each, why = dict[int, np.ndarray](), "" if candidates else _why_none(scene, recording)
    if found.open and candidates:
        try:
            each = _information(scene, space, found, recording, candidates)
        except ValueError as error:  # what the recording tells is known all the same
            candidates, why = (), f"those that were tried cannot be replayed ({error})"
    while each and len(chosen) < MOST and np.any(widths(total) > np.log(limit * MARGIN)):
        before = widths(total)
        gains = {k: float(np.sum(before - widths(total + i))) for k, i in each.items()}
        best = max(gains, key=lambda k: gains[k] / candidates[k].time[-1])
        if gains[best] < LEAST:
            break
        chosen.append(candidates[best])
        total = total + each[best]
    for picked in list(chosen):  # what a later one tells too needs no time
        rest = total - each[candidates.index(picked)]
        if np.all(widths(rest) <= np.maximum(widths(total), np.log(limit * MARGIN))):
            chosen.remove(picked)
            total = rest
    after = judged(total)
    now = {t.name for t in after if t.identifiable}
    if not now.intersection(found.open):  # narrower, but none of them enough
        chosen, after = [], judged(found.information)
    return MotionProposal(
        chosen=tuple(chosen),
        identifiability=after,
        opened=tuple(name for name in found.open if name in now),
        left=tuple(name for name in found.open if name not in now),
        joints=joints,
        start=start,
        tried=len(candidates),
        why=why,
    )


def _information(
    scene: Scene, space: Space, found: Excitation, recording: Recording, candidates: Sequence[Addition]
) -> dict[int, np.ndarray]:
    """Number of an addition -> [D, D] information, per squared search unit."""
    motions = [motion_recording(scene, recording, addition, str(k)) for k, addition in enumerate(candidates)]
    config = found.config
    with silent():
        cost = make_cost(scene, space, motions, engine=found.engine, config=config.compare, check=False)
    comparison = cost.comparisons[0]  # all have one clock and one filter, and what was measured cancels
    channels = []
    for channel in comparison.channels:
        of = found.noise[channel.name]
        usual = float(np.median(list(of.values())))
        names = [scene.joints[c] if c < len(scene.joints) else "" for c in channel.columns.tolist()]
        deviation = np.array([max(usual, of.get(name, usual)) for name in names])  # at rest a joint shows less of it
        channels.append(replace(channel, noise=channel.noise.stated(deviation)))
    one = cost.first().compared_by([replace(comparison, channels=tuple(channels))])
    rollouts, steps = slopes(cost, space, space.to_search(found.values), config.step)
    out = dict[int, np.ndarray]()
    for k, rollout in enumerate(rollouts):
        jacobian = jacobian_of(one.whitened_of([rollout]), steps) / found.widening
        out[k] = jacobian.T @ jacobian
    return out


def motion_recording(scene: Scene, recording: Recording, addition: Addition, name: str) -> Recording:
    """An addition as a recording of one repeat, whose measurements are made up: only its replay is looked at."""
    joints, start = _start(scene, recording)
    table = np.tile(start, (len(addition.time), 1))
    table[:, joints.index(addition.joint)] = addition.path
    shape = (1, len(addition.time), len(joints))
    changing = np.tile(np.linspace(0.0, 1.0, shape[1])[None, :, None], (1, 1, shape[2]))  # lest it count as dead
    channels = dict[str, Channel]()
    for key in COLUMNS:
        if key not in recording.channels and key != "position":
            continue
        names = recording.channels[key].columns if key in recording.channels else joints
        columns = [j for j in names if j in joints]
        values = table[None] if key == "position" and not recording.command.size else changing
        values = values[..., [joints.index(j) for j in columns]].copy()
        unit = recording.channels[key].unit if key in recording.channels else "rad"
        channels[key] = Channel(key, unit, tuple(columns), addition.time, values, np.ones(values.shape, bool))
    begin = {
        j: float(q) / _gear(scene, recording, j) for j, q in zip(joints, start, strict=True) if j in scene.single_joints
    }
    qpos0 = {**recording.qpos0, **begin}
    commanded = bool(recording.command.size)
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
    """Names [U] of the joints that are sent, and where an addition begins, rad or m."""
    if recording.command.size:
        return recording.command_names, recording.command[0].astype(float)
    measured = recording.measured_start()
    joints = tuple(j for j in scene.joints if j in measured)
    return joints, np.array([measured[j] for j in joints])


def _servos(scene: Scene) -> set[str]:
    """Names of the position servos."""
    return {scene.command_names[u] for u in np.flatnonzero(has_feedback(scene.model))}


def _gear(scene: Scene, recording: Recording, joint: str) -> float:
    """What a joint's command is times its position."""
    if not recording.command.size or joint not in scene.command_names:
        return 1.0
    u = scene.command_names.index(joint)
    return float(scene.model.actuator_gear[u, 0]) if scene.of_joint[u] else 1.0


def _room(scene: Scene, recording: Recording, joint: str, q: float) -> tuple[float, float, float]:
    """rad or m that a joint can go down and up from q, and what the ways are counted in: 1 rad, or a slide's motion."""
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
        unit = float(np.ptp(path))
    return max(0.0, FREE * (q - low)), max(0.0, FREE * (high - q)), unit


def _largest_jump(scene: Scene, recording: Recording, joint: str) -> float:
    """rad or m by which a servo's command may jump, lest its torque reach the limit; infinite without one."""
    if joint not in scene.single_joints or joint not in scene.command_names:
        return np.inf
    u, limit = scene.command_names.index(joint), min(np.abs(torque_range(scene, joint)))
    stiffness = own_stiffness(replace(scene, model=with_stated_gains(scene, recording)))[u]
    return LIMIT * limit / stiffness if stiffness > 0 else np.inf


def _measured(channel: Channel, joint: str) -> np.ndarray:
    """[K] what was measured of a joint, in all repeats."""
    i = channel.columns.index(joint)
    return channel.values[..., i][channel.mask[..., i]]


# Paths of -1 to 1 over a time [K], which begin and end at 0 ---------------------------------------------------


def _ramp(time: np.ndarray) -> np.ndarray:
    """Up, down to the other side, and back, at one speed."""
    return np.interp(time / time[-1], [0.0, 0.05, 0.275, 0.725, 0.95, 1.0], [0.0, 0.0, 1.0, -1.0, 0.0, 0.0])


def _steps(time: np.ndarray) -> np.ndarray:
    """To each side from the middle, so that no jump is larger than the way that is said."""
    levels = np.array([0.0, 1.0, 0.0, -1.0, 0.0, 0.0])
    return levels[np.minimum((time / time[-1] * len(levels)).astype(int), len(levels) - 1)]


def _chirp(time: np.ndarray) -> np.ndarray:
    """A swing whose frequency grows exponentially."""
    first, last = CHIRP
    growth = np.log(last / first) / time[-1]
    ease: Callable[[np.ndarray], np.ndarray] = lambda t: np.clip(t / EASE, 0.0, 1.0)  # noqa: E731
    return ease(time) * ease(time[-1] - time) * np.sin(2 * np.pi * first * np.expm1(growth * time) / growth)


def _hold(time: np.ndarray) -> np.ndarray:
    """Away in a quarter of the time, and back in another."""
    share = time / time[-1]
    return minimum_jerk(np.clip(np.minimum(share, 1.0 - share) / 0.25, 0.0, 1.0))
