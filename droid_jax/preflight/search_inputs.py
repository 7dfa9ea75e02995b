"""What recordings must fulfil before an effect is searched in them: said before anything long begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.preflight.check_log import warn_of_log
from droid_jax.recordings.checks import validate
from droid_jax.recordings.recording import JOINT_CHANNELS, Channel, Recording
from droid_jax.recordings.split import Split, roles_of, split_of

STILL = 0.01  # rad or m: a robot whose joints all move less stood still
BACKWARDS = 0.25  # share of the way down that a hinge may also go up and still open downwards
SHUT = 0.05  # rad or m: the same for the thing that is moved, whose camera is noisy
MISSED = 0.5  # of the usual travel: a repeat that moves the object by less has missed its grasp
APART = 0.05  # s: repeats that are further apart in time were not cut alike


def assigned_roles(
    scene: Scene, recordings: Sequence[Recording], judges: Sequence[Recording] = ()
) -> tuple[Split, dict[str, Recording]]:
    """How recordings share the work, and each by its role; ValueError where a search in them could not end well.

    judges: test data of commanded logs with few repeats.  Warns of what in them can hardly be right (`check_log`).
    """
    everything = [*recordings, *judges]
    for recording in everything:
        validate(recording, allow_jitter=True)  # one made in Python may not have been
    split = split_of(recordings, judges)
    roles = roles_of(split, recordings, judges)
    check_recordings(scene, {"only": recordings[0]} if split is Split.REPEATS else roles)
    for recording in everything:
        warn_of_log(scene, recording)
    return split, roles


def check_recordings(scene: Scene, roles: Mapping[str, Recording]) -> None:
    """ValueError where a search in these recordings ("train", "validation", perhaps "test") could not end well.

    Each must hold repeats, cut alike, of a motion that moves the robot and the object; all must measure the same
    joints, and none may be another one once more.  How many repeats are enough: `droid_jax.recordings.split`.
    """
    for role, recording in roles.items():
        where = f"the {role} recording {recording.name!r}"
        _check_moves(recording, where)
        _check_object(scene, recording, where)
        _check_timing(recording, where)
    _check_different(roles)
    _check_same_joints(roles)


def _check_moves(recording: Recording, where: str) -> None:
    ranges = {}
    if "position" in recording.channels:
        channel = recording.channels["position"]
        ranges = dict(zip(channel.columns, np.ptp(_mean(channel), axis=0), strict=True))
    elif recording.command.size:
        ranges = dict(zip(recording.command_names, np.ptp(recording.command, axis=0), strict=True))
    if ranges and max(ranges.values()) < STILL:
        joint = max(ranges, key=lambda name: ranges[name])
        raise ValueError(
            f"{where} never moves: {joint}, which moves most, does by {ranges[joint]:.2g}; record a motion that "
            "moves the joints and the object"
        )


def _check_object(scene: Scene, recording: Recording, where: str) -> None:
    path = None if scene.object_joint is None else _object_path(recording, scene.object_joint)
    if path is None:
        return
    low, high = _ends(path)
    _check_direction(scene, float(np.nanmedian(low)), float(np.nanmedian(high)), where)
    usual, least = float(np.nanmedian(high - low)), int(np.nanargmin(high - low))
    if usual < SHUT:
        raise ValueError(
            f"{where}: the object joint {scene.object_joint!r} moves by {usual:.2g} only (at least {SHUT:g} is "
            "needed), so nothing about it can be told; record a motion that opens it"
        )
    if (high - low)[least] < MISSED * usual:
        raise ValueError(
            f"{where}: in repeat {least} the object joint {scene.object_joint!r} moves by {(high - low)[least]:.2g}, "
            f"in most repeats by {usual:.2g}; leave that repeat away if the grasp was missed"
        )


def _check_direction(scene: Scene, low: float, high: float, where: str) -> None:
    """A latch, a closer, a spring that peaks: all are written for a hinge that is closed at 0 and opens upwards."""
    if not scene.slides(str(scene.object_joint)) and -low > SHUT and max(high, 0.0) < BACKWARDS * -low:
        raise ValueError(
            f"{where}: the object joint {scene.object_joint!r} opens towards negative angles (to {low:.2g} rad), and "
            "the library's effects of a hinge count from 0 towards positive ones: turn the joint's axis and range "
            "round in the MJCF, and the sign of what was measured"
        )


def _object_path(recording: Recording, joint: str) -> np.ndarray | None:
    """[N, T] where the object's joint is, rad or m, NaN where it was not measured; None where no repeat did."""
    name = "object_angle" if "object_angle" in recording.channels else "position"
    if name not in recording.channels:
        return None
    channel = recording.channels[name]
    if name == "position" and joint not in channel.columns:
        return None
    column = 0 if name == "object_angle" else channel.columns.index(joint)
    path = np.where(channel.mask[:, :, column], channel.values[:, :, column], np.nan)
    return None if np.isnan(path).all() else path


def _ends(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest [N] of each repeat but for strays; NaN for one that measured nothing: no missed grasp."""
    low, high = np.full(len(path), np.nan), np.full(len(path), np.nan)
    known = ~np.isnan(path).all(axis=1)
    low[known], high[known] = np.nanquantile(path[known], [0.01, 0.99], axis=1)
    return low, high


def _check_timing(recording: Recording, where: str) -> None:
    name = next((n for n in ("position", *JOINT_CHANNELS) if n in recording.channels), None)
    late = np.zeros(1) if name is None else lags(recording.channel(name))
    worst = int(np.argmax(np.abs(late)))
    if abs(late[worst]) > APART:
        raise ValueError(
            f"{where}: repeat {worst} runs {abs(late[worst]):.2g} s {'behind' if late[worst] > 0 else 'ahead of'} the "
            f"others (at most {APART:g} s); cut the repeats so that each begins with the motion"
        )


def lags(channel: Channel) -> np.ndarray:
    """[N] s by which each repeat lags the repeats' median, to first order in the lag."""
    time, values = _measured(channel)
    usual = np.nanmedian(values, axis=0)
    slope = np.gradient(usual, time, axis=0)
    apart = np.nan_to_num(values - usual)
    return -np.einsum("ntc,tc->n", apart, slope) / max(float(np.sum(slope**2)), 1e-12)


def _check_different(roles: Mapping[str, Recording]) -> None:
    seen: dict[str, str] = {}
    for role, recording in roles.items():
        first = seen.setdefault(recording.sha256, role)
        if first != role:
            raise ValueError(
                f"the {first} and the {role} recording are the same ({recording.name!r}): an effect must be confirmed "
                "on a recording that it was not fitted to, of another motion"
            )
    names: dict[str, str] = {}
    for role, recording in roles.items():
        if (first := names.setdefault(recording.name, role)) != role:
            raise ValueError(
                f"the {first} and the {role} recording have one name, {recording.name!r}: rename a file, since answers "
                "name recordings"
            )


def _check_same_joints(roles: Mapping[str, Recording]) -> None:
    name = next((n for n in JOINT_CHANNELS if all(n in r.channels for r in roles.values())), None)
    if name is None:  # what compares them says so
        return
    joints = {role: recording.channel(name).columns for role, recording in roles.items()}
    first, *others = joints
    for role in others:
        if set(joints[role]) != set(joints[first]):
            raise ValueError(
                f"the recordings measure the {name} of different joints: {first} {', '.join(joints[first])}; "
                f"{role} {', '.join(joints[role])}"
            )


def _mean(channel: Channel) -> np.ndarray:
    """[K, C] mean over the repeats."""
    return np.nanmean(_measured(channel)[1], axis=0)


def _measured(channel: Channel) -> tuple[np.ndarray, np.ndarray]:
    """[K] s and values [N, K, C], NaN where masked, at the instants at which some repeat measured each column."""
    seen = np.all(np.any(channel.mask, axis=0), axis=1)
    if seen.sum() < 2:
        raise ValueError(
            f"channel {channel.name!r} has no two instants at which every column was measured; give them one clock"
        )
    return channel.time[seen], np.where(channel.mask, channel.values, np.nan).astype(float)[:, seen]
