"""Requirements on recordings of a search for missing effects, checked before the first fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.preflight.check_log import warn_of_log
from droid_jax.recordings.checks import validate
from droid_jax.recordings.recording import JOINT_CHANNELS, Channel, Recording
from droid_jax.recordings.split import Split, roles_of, split_of

LEAST_TRAVEL = 0.01  # rad or m: at least one joint must move more
OPPOSITE_SHARE = 0.25  # a hinge opens towards negative angles if its positive travel is below this share of it
LEAST_OBJECT_TRAVEL = 0.05  # rad or m, smallest travel of the object; larger since cameras are noisy
MISSED_SHARE = 0.5  # of the median travel: a repeat that moves the object less has missed its grasp
LARGEST_SHIFT = 0.05  # s, largest shift in time of a repeat against the others


def assigned_roles(
    scene: Scene, recordings: Sequence[Recording], judges: Sequence[Recording] = ()
) -> tuple[Split, dict[str, Recording]]:
    """How the recordings are split into training, validation and test data, and role -> recording.

    Warns of the findings of `check_log`.

    Args:
        scene: the robot.
        recordings: train, validation and perhaps test; or one; or logs.
        judges: test recordings of commanded logs with few repeats.

    Raises:
        ValueError: the recordings do not meet the requirements of a search.
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
    """Raise ValueError unless the recordings ("train", "validation", perhaps "test") suit a search.

    Each must have repeats, cut at the same point of the motion, that move the robot and the object.  All must measure
    the same joints, and no two may be equal.  The number of repeats is checked by `droid_jax.recordings.split`.
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
    if ranges and max(ranges.values()) < LEAST_TRAVEL:
        joint = max(ranges, key=lambda name: ranges[name])
        raise ValueError(
            f"{where} never moves: {joint}, which moves most, moves by {ranges[joint]:.2g}; record a motion that "
            "moves the joints and the object"
        )


def _check_object(scene: Scene, recording: Recording, where: str) -> None:
    path = None if scene.object_joint is None else _object_path(recording, scene.object_joint)
    if path is None:
        return
    low, high = _ends(path)
    _check_direction(scene, float(np.nanmedian(low)), float(np.nanmedian(high)), where)
    usual, least = float(np.nanmedian(high - low)), int(np.nanargmin(high - low))
    if usual < LEAST_OBJECT_TRAVEL:
        raise ValueError(
            f"{where}: the object joint {scene.object_joint!r} moves by {usual:.2g} only (at least "
            f"{LEAST_OBJECT_TRAVEL:g} is needed), so its parameters are not identifiable; record a motion that opens it"
        )
    if (high - low)[least] < MISSED_SHARE * usual:
        raise ValueError(
            f"{where}: in repeat {least} the object joint {scene.object_joint!r} moves by {(high - low)[least]:.2g}, "
            f"in most repeats by {usual:.2g}; leave that repeat away if the grasp was missed"
        )


def _check_direction(scene: Scene, low: float, high: float, where: str) -> None:
    """ValueError for a hinge that opens towards negative angles: the library's laws assume positive ones."""
    if (
        not scene.slides(str(scene.object_joint))
        and -low > LEAST_OBJECT_TRAVEL
        and max(high, 0.0) < OPPOSITE_SHARE * -low
    ):
        raise ValueError(
            f"{where}: the object joint {scene.object_joint!r} opens towards negative angles (to {low:.2g} rad), and "
            "the library's effects of a hinge assume that it opens from 0 towards positive ones: turn the joint's axis "
            "and range round in the MJCF, and change the sign of the measurements"
        )


def _object_path(recording: Recording, joint: str) -> np.ndarray | None:
    """Position of the object's joint [N, T], rad or m, NaN where not measured; None if it never was."""
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
    """1 % and 99 % quantiles [N] of each repeat; NaN for a repeat without measurements."""
    low, high = np.full(len(path), np.nan), np.full(len(path), np.nan)
    known = ~np.isnan(path).all(axis=1)
    low[known], high[known] = np.nanquantile(path[known], [0.01, 0.99], axis=1)
    return low, high


def _check_timing(recording: Recording, where: str) -> None:
    name = next((n for n in ("position", *JOINT_CHANNELS) if n in recording.channels), None)
    late = np.zeros(1) if name is None else lags(recording.channel(name))
    worst = int(np.argmax(np.abs(late)))
    if abs(late[worst]) > LARGEST_SHIFT:
        raise ValueError(
            f"{where}: repeat {worst} runs {abs(late[worst]):.2g} s {'behind' if late[worst] > 0 else 'ahead of'} the "
            f"others (at most {LARGEST_SHIFT:g} s); cut the repeats so that each begins with the motion"
        )


def lags(channel: Channel) -> np.ndarray:
    """Lag of each repeat behind the median of the repeats, [N] s, to first order."""
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
                "on a recording of another motion, to which it was not fitted"
            )
    names: dict[str, str] = {}
    for role, recording in roles.items():
        if (first := names.setdefault(recording.name, role)) != role:
            raise ValueError(
                f"the {first} and the {role} recording have one name, {recording.name!r}: rename a file, since results "
                "refer to recordings by name"
            )


def _check_same_joints(roles: Mapping[str, Recording]) -> None:
    name = next((n for n in JOINT_CHANNELS if all(n in r.channels for r in roles.values())), None)
    if name is None:  # reported when channels are compared
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
    """Times [K] s and values [N, K, C], NaN where masked, at which every column was measured in some repeat."""
    seen = np.all(np.any(channel.mask, axis=0), axis=1)
    if seen.sum() < 2:
        raise ValueError(
            f"channel {channel.name!r} has no two instants at which every column was measured; give them one clock"
        )
    return channel.time[seen], np.where(channel.mask, channel.values, np.nan).astype(float)[:, seen]
