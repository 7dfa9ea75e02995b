"""What a fit is judged on: repeats that it does not see, and the gap to them before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from droid_jax.cost.cost import Cost
from droid_jax.cost.errors import ChannelErrors, channel_errors, channel_unit, sample_of
from droid_jax.cost.observation import Measured
from droid_jax.cost.residuals import Comparison, make_comparison
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

LONG = 1.5  # times the beginning that is asked for, from which on a recording is long
STANDS = 0.01  # share of a command's range, up to which it stands still
WORTH = 0.1  # share of the noise floor by which the distance before a fit must exceed it, unless a config says else
NOISE_UNITS = "noise units"
Judged = Literal["repeats", "time", "same", "recordings"]


@dataclass(frozen=True)
class HeldoutDistance:
    """Disagreement with what was held out of one recording, before and after the fit.

    channels: what was compared; per-joint numbers are of the leading one (torque, where it is compared).
    unit: of the distances, that of the channel, or "noise units" where several are compared (see
    `channels.in_noise_units`).
    before, after, noise_floor: equation 1 without penalty terms, all compared channels; floor is what a perfect
    model would leave, estimated from the scatter of all repeats, fitted and held out, about their mean.
    closed: share of the way from before to noise_floor; None where before does not exceed it by the share
    `worth` of it.
    Floors and closed are None where there is one repeat only.
    per_joint_*: [J] root mean square of the smoothed difference, in per_joint_unit.
    judged: on what: "repeats" that were held out, the last part in "time" of a log, the "same" one repeat that was
    fitted, or whole "recordings" that the fit did not see.
    errors: by channel of all that were measured, in physical units.
    """

    before: float
    after: float
    noise_floor: float | None
    closed: float | None
    per_joint_before: tuple[float, ...]
    per_joint_after: tuple[float, ...]
    per_joint_noise_floor: tuple[float, ...] | None
    judged: Judged
    channels: tuple[str, ...] = ("torque",)
    unit: str = "N m"
    per_joint_unit: str = "N m"
    errors: dict[str, ChannelErrors] = field(default_factory=dict[str, ChannelErrors])


def split_repeats(recording: Recording, share: float) -> tuple[Recording, Recording, tuple[int, ...]]:
    """Fitted and held-out repeats (the last ones), and the latter's indices.

    Of one repeat without commands the last part in time is held out; with commands, one serves as both.
    """
    count = recording.repeats
    if count == 1 and not recording.command.size:
        first, last = recording.span
        cut = last - max(share, 1 / 3) * (last - first)
        return recording.window(first, cut), recording.window(cut, last), (0,)
    held = min(count - 1, max(1, round(share * count))) if count > 1 else 0
    if held == 0:
        return recording, recording, tuple(range(count))
    rows = tuple(range(count - held, count))
    return recording.repeats_subset(range(count - held)), recording.repeats_subset(rows), rows


def judged_on(recording: Recording, held: Recording) -> Judged:
    """What `split` held out of a recording."""
    if held is recording:
        return "same"
    return "time" if recording.repeats == 1 else "repeats"


def heldout_distances(
    cost: Cost,
    recordings: Sequence[Recording],
    held: Sequence[Recording],
    before: np.ndarray,
    after: np.ndarray,
    worth: float = WORTH,
    apart: bool = False,
) -> list[HeldoutDistance]:
    """The distance to what was held out of each recording, of which `cost` is, at two parameter vectors [F].

    worth: share of the noise floor by which the start must exceed it, else there was nothing to close.
    apart: the recordings are whole ones that no fit saw.
    """
    penalty_free = cost.distances(np.stack([before, after])) - cost.penalties(np.stack([before, after]))
    smoothed, rollouts = cost.smoothed(np.stack([before, after])), cost.rollouts(np.stack([before, after]))
    out: list[HeldoutDistance] = []
    for i, (one, recording, own) in enumerate(zip(cost.comparisons, recordings, held, strict=True)):
        seen = one.leading.noise.count > 0
        off = np.where(seen, smoothed[i] - one.leading.noise.mean, 0.0)
        rms = np.sqrt(np.sum(off**2, axis=1) / np.maximum(seen.sum(axis=0), 1))
        alike = cost.from_one_start(i, recording)  # as the held-out repeats that `cost` compares
        everything = make_comparison(cost.scene, alike, one.clock, one.config) if recording.repeats > 1 else None
        floor = None if everything is None else _floor(everything)
        pair = sample_of(rollouts[i], 0), sample_of(rollouts[i], 1)
        first, last = penalty_free[0, i], penalty_free[1, i]
        out.append(
            HeldoutDistance(
                before=float(first),
                after=float(last),
                noise_floor=floor,
                closed=_closed(float(first), float(last), floor, worth),
                per_joint_before=tuple(rms[0].tolist()),
                per_joint_after=tuple(rms[1].tolist()),
                per_joint_noise_floor=None if everything is None else _smooth_floor(everything, one.repeats),
                judged="recordings" if apart else judged_on(recording, own),
                channels=tuple(c.name for c in one.channels),
                unit=distance_unit(cost.scene, one),
                per_joint_unit=unit_of(cost.scene, one.leading),
                errors=channel_errors(cost.scene, cost.from_one_start(i, own), one.clock, *pair),
            )
        )
    return out


def unit_of(scene: Scene, channel: Measured) -> str:
    """Unit of a compared channel's columns in this scene."""
    rows: list[int] = channel.columns.tolist()
    joints = () if channel.name == "object_angle" else [scene.joints[c] for c in rows]
    return channel_unit(scene, channel.name, joints, channel.unit)


def distance_unit(scene: Scene, comparison: Comparison) -> str:
    """Unit of equation 1: the compared channel's; of several, which enter by their noise, noise units."""
    return unit_of(scene, comparison.channels[0]) if len(comparison.channels) == 1 else NOISE_UNITS


def _closed(before: float, after: float, floor: float | None, worth: float = WORTH) -> float | None:
    """Share of the way from before to the floor that was gone; None where there was hardly any."""
    if floor is None or before - floor <= worth * floor:
        return None
    return 1 - (after - floor) / (before - floor)


def _floor(everything: Comparison) -> float | None:
    """Equation 1 of a perfect model, from the scatter of all repeats; None where no instant was measured twice."""
    total = 0.0
    for channel in everything.channels:
        scatter = _scatter(channel.values, channel.mask)
        if scatter is None:
            return None
        total += channel.weight * scatter
    return total


def _scatter(values: np.ndarray, mask: np.ndarray) -> float | None:
    """The repeats' [N, T, C] distance to their mean, corrected for the mean's own noise, where two or more measured."""
    count = mask.sum(axis=0)  # [T, C]
    filled = np.where(mask, values, 0.0)
    mean = filled.sum(axis=0) / np.maximum(count, 1)
    seen = mask & (count > 1)
    error = np.where(seen, (filled - mean) / np.sqrt(1 - 1 / np.maximum(count, 2)), 0.0)
    rows = np.any(seen, axis=-1)  # [N, T]
    repeats = np.any(rows, axis=1)
    if not repeats.any():
        return None
    distance: np.ndarray = np.linalg.norm(error, axis=-1).sum(axis=1)[repeats] / rows.sum(axis=1)[repeats]
    return float(np.mean(distance))


def _smooth_floor(everything: Comparison, held: int) -> tuple[float, ...]:
    """[J] N m, what the noise of the mean of `held` repeats leaves of a smoothed difference."""
    noise = everything.leading.noise
    squares = ((noise.repeats - noise.mean) ** 2).sum(axis=0)
    variance = squares.sum(axis=0) / (noise.count - 1).sum(axis=0)
    return tuple(np.sqrt(variance / held).tolist())


def beginning(recording: Recording, seconds: float) -> Recording:
    """A long commanded recording's first seconds, and more until its commands have covered half of their range.

    The seconds count from where a command begins to change: a robot that stands still tells little.
    """
    begin, end = recording.span
    if not recording.command.size or end - begin <= LONG * seconds:
        return recording
    reach = np.maximum.accumulate(recording.command) - np.minimum.accumulate(recording.command)
    moved = recording.time[int(np.argmax(np.all(reach >= 0.5 * reach[-1], axis=1)))]
    starts = recording.time[int(np.argmax(np.any(reach > STANDS * reach[-1], axis=1)))]
    until = max(float(starts) + seconds, float(moved))
    return recording if until > begin + (end - begin) / LONG else recording.window(begin, until)
