"""What recordings must fulfil before an effect is searched in them: said before anything long begins."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from droid_jax.measure.recording import Channel, Recording
from droid_jax.model.scene import Scene

STILL = 0.01  # rad or m: a robot whose joints all move less stood still
SHUT = 0.05  # rad or m: the same for the thing that is moved, whose camera is noisy
MISSED = 0.5  # of the usual travel: a repeat that moves the object by less has missed its grasp
APART = 0.05  # s: repeats that are further apart in time were not cut alike


def check_recordings(scene: Scene, roles: Mapping[str, Recording]) -> None:
    """ValueError where a search in these recordings ("fit", "confirm", perhaps "sealed") could not end well.

    Each must hold repeats, cut alike, of a motion that moves the robot and the object; all must measure the same
    joints, and none may be another one once more.  How many repeats are enough: `droid_jax.gap.split`.
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
    each = None if scene.object_joint is None else _travels(recording, scene.object_joint)
    if each is None:
        return
    usual, least = float(np.nanmedian(each)), int(np.nanargmin(each))
    if usual < SHUT:
        raise ValueError(
            f"{where}: the object joint {scene.object_joint!r} moves by {usual:.2g} only (at least {SHUT:g} is "
            "needed), so nothing about it can be told; record a motion that opens it"
        )
    if each[least] < MISSED * usual:
        raise ValueError(
            f"{where}: in repeat {least} the object joint {scene.object_joint!r} moves by {each[least]:.2g}, in most "
            f"repeats by {usual:.2g}; leave that repeat away if the grasp was missed"
        )


def _travels(recording: Recording, joint: str) -> np.ndarray | None:
    """[N] how far the object's joint moves in each repeat, rad or m, NaN where a repeat did not measure it.

    None where no repeat did.
    """
    name = "object_angle" if "object_angle" in recording.channels else "position"
    if name not in recording.channels:
        return None
    channel = recording.channels[name]
    if name == "position" and joint not in channel.columns:
        return None
    column = 0 if name == "object_angle" else channel.columns.index(joint)
    values, seen = channel.values[:, :, column], channel.mask[:, :, column]
    known = seen.any(axis=1)  # what was not measured in a repeat is no missed grasp
    if not known.any():
        return None
    moved = np.full(len(values), np.nan)
    moved[known] = np.subtract(*np.nanquantile(np.where(seen, values, np.nan)[known], [0.99, 0.01], axis=1))
    return moved


def _check_timing(recording: Recording, where: str) -> None:
    late = lags(recording.channel("position" if "position" in recording.channels else "torque"))
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


def _check_same_joints(roles: Mapping[str, Recording]) -> None:
    joints = {role: recording.channel("torque").columns for role, recording in roles.items()}
    first, *others = joints
    for role in others:
        if set(joints[role]) != set(joints[first]):
            raise ValueError(
                f"the recordings measure torques of different joints: {first} {', '.join(joints[first])}; "
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
