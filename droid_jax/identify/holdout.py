"""Held-out data of a fit, and the distance to them before and after the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from droid_jax.arguments import check_fields, number
from droid_jax.cost.cost import Cost
from droid_jax.cost.errors import ChannelErrors, channel_errors, channel_unit, sample_of
from droid_jax.cost.observation import Measured
from droid_jax.cost.residuals import Comparison, make_comparison
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

WORTH = 0.1  # default of `IdentifyConfig.worth`
NOISE_UNITS = "noise units"
Judged = Literal["repeats", "time", "same", "recordings"]


@dataclass(frozen=True)
class BeginningConfig:
    """When only the beginning of a long commanded recording is used, and how much of it.

    long: factor on the requested seconds above which a recording is long; a design choice.
    covered: share of its range that every command must have covered at the end of the beginning; a design choice.
    still: share of its range by which a command may have changed while the robot still stands; a design choice.
    responds: s after which the last joint to be commanded has moved, and the last channel has samples; a design choice.
    """

    long: float = 1.5
    covered: float = 0.5
    still: float = 0.01
    responds: float = 1.0

    def __post_init__(self) -> None:
        check_fields(
            self,
            long=partial(number, least=1),
            covered=partial(number, least=0, most=1),
            still=partial(number, least=0, most=1),
            responds=partial(number, least=0),
        )


DEFAULT_BEGINNING = BeginningConfig()


@dataclass(frozen=True)
class HeldoutDistance:
    """Distance to the held-out part of one recording, before and after the fit.

    before, after: equation 1 without penalty terms, over all compared channels.
    noise_floor: the distance of a perfect model, estimated from the scatter of all repeats, fitted and held out, about
      their mean; None for one repeat.
    closed: share of the difference between `before` and `noise_floor` that the fit removed; None for one repeat, or if
      that difference is less than the share `worth` of the floor.
    per_joint_*: [J] root mean square of the smoothed residual of the leading channel, in `per_joint_unit`.
    judged: the held-out data: "repeats", the last part in "time" of a log, the "same" repeat that was fitted, or whole
      "recordings".
    channels: that were compared; the leading one is torque where it is compared.
    unit: of the distances, that of the channel, or "noise units" for several channels (`channels.in_noise_units`).
    errors: of all measured channels, in physical units.
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
    """Return a recording's repeats for the fit, the held-out ones (the last), and the numbers of the latter.

    From one repeat without commands, the last part in time is held out, at least a third.  One repeat with commands is
    used for both.

    share: of the repeats that is held out, at least one of them.
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
    """Return what `split_repeats` held out of a recording."""
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
    whole_recordings: bool = False,
) -> list[HeldoutDistance]:
    """Return the distance to the held-out part of each recording, at two parameter vectors.

    Args:
        cost: of the held-out parts.
        recordings: with all their repeats.
        held: the held-out parts.
        before: [F] initial values.
        after: [F] fitted values.
        worth: share of the noise floor by which the distance before the fit must exceed it for `closed` to be defined.
        whole_recordings: the held-out data are whole recordings that the fit did not use.
    """
    replayed = cost.replayed(np.stack([before, after]))
    out: list[HeldoutDistance] = []
    for i, (one, recording, heldout) in enumerate(zip(cost.comparisons, recordings, held, strict=True)):
        measured = one.leading.noise.count > 0
        residual = np.where(measured, replayed[i].smoothed - one.leading.noise.mean, 0.0)
        rms = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(measured.sum(axis=0), 1))
        from_start = cost.from_one_start(i, recording)  # from the start of the repeats that `cost` compares
        everything = make_comparison(cost.scene, from_start, one.clock, one.config) if recording.repeats > 1 else None
        floor = None if everything is None else _floor(everything)
        pair = sample_of(replayed[i].rollout, 0), sample_of(replayed[i].rollout, 1)
        first, last = replayed[i].distance - replayed[i].penalty
        out.append(
            HeldoutDistance(
                before=float(first),
                after=float(last),
                noise_floor=floor,
                closed=_closed(float(first), float(last), floor, worth),
                per_joint_before=tuple(rms[0].tolist()),
                per_joint_after=tuple(rms[1].tolist()),
                per_joint_noise_floor=None if everything is None else _smooth_floor(everything, one.repeats),
                judged="recordings" if whole_recordings else judged_on(recording, heldout),
                channels=tuple(c.name for c in one.channels),
                unit=distance_unit(cost.scene, one),
                per_joint_unit=unit_of(cost.scene, one.leading),
                errors=channel_errors(cost.scene, cost.from_one_start(i, heldout), one.clock, *pair),
            )
        )
    return out


def unit_of(scene: Scene, channel: Measured) -> str:
    """Return the unit of a compared channel's columns in this scene."""
    rows: list[int] = channel.columns.tolist()
    joints = () if channel.name == "object_angle" else [scene.joints[c] for c in rows]
    return channel_unit(scene, channel.name, joints, channel.unit)


def distance_unit(scene: Scene, comparison: Comparison) -> str:
    """Return the unit of equation 1: the compared channel's, or noise units for several channels."""
    return unit_of(scene, comparison.channels[0]) if len(comparison.channels) == 1 else NOISE_UNITS


def _closed(before: float, after: float, floor: float | None, worth: float = WORTH) -> float | None:
    """Share of the difference to the floor that the fit removed; None if the difference was below `worth` of it."""
    if floor is None or before - floor <= worth * floor:
        return None
    return 1 - (after - floor) / (before - floor)


def _floor(everything: Comparison) -> float | None:
    """Equation 1 of a perfect model, from the scatter of all repeats; None if no instant was measured twice."""
    total = 0.0
    for channel in everything.channels:
        scatter = _scatter(channel.values, channel.mask)
        if scatter is None:
            return None
        total += channel.weight * scatter
    return total


def _scatter(values: np.ndarray, mask: np.ndarray) -> float | None:
    """Distance of the repeats [N, T, C] to their mean, corrected for the mean's noise, at instants measured twice."""
    count = mask.sum(axis=0)  # [T, C]
    filled = np.where(mask, values, 0.0)
    mean = filled.sum(axis=0) / np.maximum(count, 1)
    measured_twice = mask & (count > 1)
    error = np.where(measured_twice, (filled - mean) / np.sqrt(1 - 1 / np.maximum(count, 2)), 0.0)
    rows = np.any(measured_twice, axis=-1)  # [N, T]
    repeats = np.any(rows, axis=1)
    if not repeats.any():
        return None
    distance: np.ndarray = np.linalg.norm(error, axis=-1).sum(axis=1)[repeats] / rows.sum(axis=1)[repeats]
    return float(np.mean(distance))


def _smooth_floor(everything: Comparison, held: int) -> tuple[float, ...]:
    """[J] N m, root mean square of a smoothed residual that consists of the noise of the mean of `held` repeats."""
    noise = everything.leading.noise
    squares = ((noise.repeats - noise.mean) ** 2).sum(axis=0)
    variance = squares.sum(axis=0) / (noise.count - 1).sum(axis=0)
    return tuple(np.sqrt(variance / held).tolist())


def beginning(recording: Recording, seconds: float, config: BeginningConfig = DEFAULT_BEGINNING) -> Recording:
    """Return the beginning of a long commanded recording; a short one, or one without commands, is unchanged.

    It is longer than `seconds` if the commands cover their range later.

    seconds: counted from where a command begins to change, since a robot that stands is hardly informative.
    """
    begin, end = recording.span
    if not recording.command.size or end - begin <= config.long * seconds:
        return recording
    extent = np.maximum.accumulate(recording.command) - np.minimum.accumulate(recording.command)
    covered = recording.time[int(np.argmax(np.all(extent >= config.covered * extent[-1], axis=1)))]
    starts = recording.time[int(np.argmax(np.any(extent > config.still * extent[-1], axis=1)))]
    measured = max((float(c.time[0]) for c in recording.channels.values()), default=begin)
    until = max(float(starts) + seconds, float(covered) + config.responds, measured + config.responds)
    return recording if until > begin + (end - begin) / config.long else recording.window(begin, until)
