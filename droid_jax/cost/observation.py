"""One measured channel, prepared for the comparison with a replay: its clock, its filter and its noise.

The data pass through a low pass with the repeats' masks, and a mean over the repeats.  A simulated trace is resampled
to the channel's clock and passes through the same two operations.  The three are one matrix whose rows have few
consecutive entries.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy import sparse

from droid_jax.cost.noise import DEFAULT_NOISE, Noise, NoiseConfig, coarse_clock, estimate_noise, lowpass, smooth
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Channel


class TooLong(ValueError):
    """The covariance of a recording's noise does not fit into memory."""


@dataclass(frozen=True, eq=False)
class ShortFilter:
    """A filter whose outputs are weighted sums over short windows of T samples.

    begin: [K] first sample of each window.  weights: [C or 1, K, W] of the samples, for each column or one for all.
    """

    begin: np.ndarray
    weights: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """[K, W] sample numbers of each window."""
        return self.begin[:, None] + np.arange(self.weights.shape[-1])


def short_filter(filters: Sequence[sparse.csr_array], length: int) -> ShortFilter:
    """Return sparse filters [K, T], one for each column or one for all, as a `ShortFilter`; length: T."""
    count = len(filters[0].indptr) - 1
    rows = [np.repeat(np.arange(count), np.diff(each.indptr)) for each in filters]
    first, last = np.full(count, length), np.zeros(count, int)
    for row, each in zip(rows, filters, strict=True):
        np.minimum.at(first, row, each.indices)
        np.maximum.at(last, row, each.indices + 1)
    width = int(np.max(last - first, initial=1))
    begin = np.minimum(first, length - width)
    weights = np.zeros((len(filters), count, width))
    for column, row, each in zip(weights, rows, filters, strict=True):
        column[row, each.indices - begin[row]] = each.data
    return ShortFilter(begin, weights)


@dataclass(frozen=True, eq=False)
class Measured:
    """One measured channel, prepared for the comparison.

    unit: of the channel.  at: [Tc] fractional rows of the simulated trace at the samples' times.
    values: [N, Tc, C] samples.  mask: [N, Tc, C] bool, those that were measured.
    columns: [C] of the simulated channel.  kernel: from the simulated trace to K instants.
    noise: of the repeats' mean, for whitened residuals.  span: [2] s, first and last instant of the coarse clock.
    weight: of the channel in the distance.
    moves: [K, C] bool, measured instants at which the column's joint moves.  At rest along a prescribed motion friction
      absorbs the residual, which is then no estimate of the noise.
    """

    name: str
    unit: str
    at: np.ndarray
    values: np.ndarray
    mask: np.ndarray
    columns: np.ndarray
    kernel: ShortFilter
    noise: Noise
    span: tuple[float, float]
    weight: float
    moves: np.ndarray

    @property
    def clock(self) -> np.ndarray:
        """[K] s, the coarse clock of the smoothed values and of the whitened residuals."""
        return np.linspace(*self.span, len(self.noise.mean))


def least_noise(name: str, mean: np.ndarray, config: NoiseConfig = DEFAULT_NOISE) -> np.ndarray:
    """Return the smallest standard deviation [C] of the noise of a channel of one repeat, in the channel's unit.

    Such noise is estimated from the residuals of a fit, which are too small if the model overfits.

    mean: [K, C] smoothed measurement.
    """
    return np.minimum(config.minimum[name], config.minimum_share * np.maximum(np.std(mean, axis=0), 1e-9))


def prepared(
    scene: Scene,
    channel: Channel,
    clock: np.ndarray,
    weight: float,
    motion_torques: np.ndarray | None = None,
    rest: np.ndarray | None = None,
    config: NoiseConfig = DEFAULT_NOISE,
) -> Measured:
    """Prepare a channel for the comparison with a replay.

    Args:
        scene: what is simulated.
        channel: as it was recorded.
        clock: [T] s, regular, times of the replay's rows.
        weight: of the channel in the distance.
        motion_torques: see `make_comparison`; None for channels other than torque.
        rest: see `make_comparison`.
        config: settings of the noise model.

    Raises:
        ValueError: no replay produces the channel, its columns are unknown or constant, it lies outside of the motion,
            none of several repeats measured some stretch of it, or it is too long for the memory.
    """
    channel, columns = compared_columns(scene, channel, config)
    inside = (channel.time >= clock[0] - 1e-9) & (channel.time <= clock[-1] + 1e-9)
    if inside.sum() < 2:
        raise ValueError(
            f"channel {channel.name!r} runs {channel.time[0]:g} .. {channel.time[-1]:g} s, "
            f"outside the motion that is replayed, {clock[0]:g} .. {clock[-1]:g} s"
        )
    time, values, mask = channel.time[inside], channel.values[:, inside], channel.mask[:, inside]
    coarse = coarse_clock(float(time[0]), float(time[-1]), config.rate)
    if len(values) > 1:  # the noise of one repeat is white
        _check_memory(channel, coarse)
    kernel = lowpass(time, coarse, config)
    resampling = _resampling(clock, time)
    offsets = 0.0 if motion_torques is None else np.stack([resampling @ t[:, columns] for t in motion_torques])
    repeats = smooth(values - offsets, mask, kernel, config.least_window)
    trace_filter = short_filter(_trace_filters(kernel, mask, ~np.isnan(repeats), resampling), len(clock))
    repeats, measured = _fill(repeats, channel, coarse, config.least_overlap)
    noise = estimate_noise(repeats, minimum=config.minimum[channel.name], measured=measured, config=config)
    step = clock[1] - clock[0]
    at_rest = np.zeros((len(clock), len(scene.joints)), bool) if rest is None else rest[:, : len(scene.joints)]
    moving = kernel @ (resampling @ (~at_rest[:, columns]).astype(float)) > config.moving_share
    return Measured(
        name=channel.name,
        unit=channel.unit,
        at=(time - clock[0]) / step,
        values=values,
        mask=mask,
        columns=columns,
        kernel=trace_filter,
        noise=noise,
        span=(float(coarse[0]), float(coarse[-1])),
        weight=weight,
        moves=moving & (noise.count > 0),
    )


def compared_columns(scene: Scene, channel: Channel, config: NoiseConfig = DEFAULT_NOISE) -> tuple[Channel, np.ndarray]:
    """Return a channel with its compared columns, and their numbers [C] in the simulated channel.

    Raises:
        ValueError: no replay produces the channel, or its columns are unknown or constant.
    """
    if channel.name not in config.minimum:
        raise ValueError(f"channel {channel.name!r} has no simulated counterpart; known: {', '.join(config.minimum)}")
    if channel.name == "object_angle":
        if scene.object_joint is None or len(channel.columns) != 1:
            raise ValueError(
                f"channel 'object_angle' needs a scene with an object joint and one column; scene {scene.name!r} has "
                f"{scene.object_joint or 'none'}, the channel {', '.join(channel.columns)}"
            )
        columns = np.zeros(1, dtype=int)
    else:
        channel = _of_joints(scene, channel)
        columns = np.array([scene.joints.index(c) for c in channel.columns], dtype=int)
    _refuse_constant(channel)
    return channel, columns


def in_window(
    channel: Channel, repeat: int, clock: np.ndarray, coarse: np.ndarray, config: NoiseConfig = DEFAULT_NOISE
) -> tuple[np.ndarray, tuple[sparse.csr_array, ...]]:
    """Return one repeat's smoothed values in a window, and the filter of the simulated trace.

    Samples outside of the replay's rows do not enter.

    Args:
        channel: as it was recorded, with its compared columns.
        repeat: its number.
        clock: [T] s, times of the replay's rows.
        coarse: [K] s, instants of the smoothed values.
        config: settings of the noise model.

    Returns:
        Values [K, C], NaN where too little was measured; and one filter [K, T] for each of C columns, or one for all.
    """
    inside = (channel.time >= clock[0] - 1e-9) & (channel.time <= clock[-1] + 1e-9)
    time, values, mask = channel.time[inside], channel.values[[repeat]][:, inside], channel.mask[[repeat]][:, inside]
    if len(time) < 2:
        return np.full((len(coarse), len(channel.columns)), np.nan), (sparse.csr_array((len(coarse), len(clock))),)
    kernel = lowpass(time, coarse, config)
    smoothed = smooth(values, mask, kernel, config.least_window)
    return smoothed[0], tuple(_trace_filters(kernel, mask, ~np.isnan(smoothed), _resampling(clock, time)))


def _of_joints(scene: Scene, channel: Channel) -> Channel:
    """Return a channel with the columns of the scene's measured joints, in the scene's order.

    Columns of other joints of the model are dropped: the user left them out (--joints).
    """
    joints = [mujoco.mj_id2name(scene.model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(scene.model.njnt)]
    unknown = [c for c in channel.columns if c not in joints]
    index = [channel.columns.index(joint) for joint in scene.joints if joint in channel.columns]
    if unknown or not index:
        raise ValueError(
            f"channel {channel.name!r}: unknown joints {', '.join(unknown or channel.columns)}; "
            f"valid: {', '.join(scene.joints)}"
        )
    columns = tuple(channel.columns[i] for i in index)
    return replace(channel, columns=columns, values=channel.values[..., index], mask=channel.mask[..., index])


def _check_memory(channel: Channel, coarse: np.ndarray) -> None:
    """Raise TooLong if the noise's covariance, quadratic in the duration, does not fit into memory."""
    needed = 8.0 * len(channel.columns) * len(coarse) ** 2
    if not hasattr(os, "sysconf"):  # only Linux and macOS have it
        return
    memory = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    if 2.0 * needed > memory:  # inverting it needs as much again
        raise TooLong(
            f"channel {channel.name!r} of {coarse[-1] - coarse[0]:.0f} s needs {needed / 1e9:.1f} GB for the "
            f"covariance of its noise, and half of this machine's memory is {memory / 2e9:.1f} GB: cut the "
            "recording (`python -m droid_jax.run convert --start S --end S`), or fit its parts as several"
        )


def _resampling(clock: np.ndarray, time: np.ndarray) -> sparse.csr_array:
    """[Tc, T] matrix of linear interpolation from the replay's clock to a channel's."""
    at = np.clip((time - clock[0]) / (clock[1] - clock[0]), 0, len(clock) - 1)
    low = np.minimum(at.astype(int), len(clock) - 2)
    rows, share = np.arange(len(time)), at - low
    entries = np.concatenate([1 - share, share]), (np.tile(rows, 2), np.concatenate([low, low + 1]))
    return sparse.csr_array(entries, shape=(len(time), len(clock)))


def _trace_filters(
    kernel: sparse.csr_array, mask: np.ndarray, used: np.ndarray, resampling: sparse.csr_array
) -> list[sparse.csr_array]:
    """Return the filters of a simulated trace [T] that equal those of the data: C matrices [K, T], or one for all.

    They resample, smooth with the repeats' masks, and average over the repeats.

    Args:
        kernel: [K, Tc] low pass.
        mask: [N, Tc, C] bool, measured samples.
        used: [N, K, C] bool, smoothed values that enter the mean over the repeats.
        resampling: [Tc, T].
    """
    if mask.all():
        return [kernel @ resampling]
    columns = list(zip(mask.transpose(2, 0, 1), used.transpose(2, 0, 1), strict=True))
    if all(np.array_equal(m, columns[0][0]) and np.array_equal(u, columns[0][1]) for m, u in columns):
        columns = columns[:1]  # a gap of a log is often the same in all columns
    return [_mean_filter(kernel, *column) @ resampling for column in columns]


def _mean_filter(kernel: sparse.csr_array, mask: np.ndarray, used: np.ndarray) -> sparse.csr_array:
    """[K, Tc] mean over the repeats of one column's filters, each renormalised over its repeat's mask.

    kernel: [K, Tc].  mask: [N, Tc] bool.  used: [N, K] bool.
    """
    total = sparse.csr_array(kernel.shape)
    for measured, valid in zip(mask, used, strict=True):
        scale = np.where(valid, 1.0 / np.where(valid, kernel @ measured.astype(float), 1.0), 0.0)
        total += sparse.diags_array(scale) @ kernel @ sparse.diags_array(measured.astype(float))
    return sparse.diags_array(1.0 / np.maximum(used.sum(axis=0), 1)) @ total


def _refuse_constant(channel: Channel) -> None:
    """Raise ValueError for a column that is constant in a repeat."""
    for c, column in enumerate(channel.columns):
        repeats = [values[mask] for values, mask in zip(channel.values[:, :, c], channel.mask[:, :, c], strict=True)]
        constant = [k for k, values in enumerate(repeats) if values.size and np.ptp(values) == 0]
        if constant:
            where, advice = "", "leave the joint out (--joints, in Python load_scene(joints=...))"
            if len(constant) < len(repeats):
                masked = len(repeats) - len(constant) > 1  # two repeats at least, for an estimate of the noise
                where = f" in repeat {constant[0]}"
                advice = f"{'mask it out there, or ' if masked else ''}leave that repeat out"
            raise ValueError(
                f"channel {channel.name!r}, column {column!r} never changes{where} ({repeats[constant[0]][0]:g} "
                f"{channel.unit}): a dead sensor? {advice}"
            )


def _fill(repeats: np.ndarray, channel: Channel, clock: np.ndarray, overlap: float) -> tuple[np.ndarray, np.ndarray]:
    """Fill gaps of repeats [N, K, C] with the mean of the other repeats; return them and the mask of what was measured.

    Gaps of the only repeat become zero, as in the filtered simulation, and have weight zero.

    Raises:
        ValueError: no repeat measured some instant, or the repeats overlap too little to estimate the noise.
    """
    measured = ~np.isnan(repeats)
    count = measured.sum(axis=0)
    sparse_columns = np.flatnonzero(count.sum(axis=0) < overlap * len(clock))
    if len(repeats) == 1 and len(sparse_columns):
        raise ValueError(
            f"channel {channel.name!r}, column {channel.columns[sparse_columns[0]]!r} was measured for less than "
            f"{100 * overlap:g} % of the time: leave the column out"
        )
    if len(repeats) == 1:
        return np.where(measured, repeats, 0.0), measured
    gaps = np.argwhere(count == 0)
    if len(gaps):
        instant, column = gaps[0]
        raise ValueError(
            f"channel {channel.name!r}, column {channel.columns[column]!r} has a stretch that no repeat measured, at "
            f"{clock[instant]:.3g} s: cut the recording there (window), or leave the column out"
        )
    single = np.flatnonzero((count - 1).sum(axis=0) < overlap * len(clock))
    if len(single):
        raise ValueError(
            f"channel {channel.name!r}, column {channel.columns[single[0]]!r} was measured by one repeat only for most "
            "of the time, so its noise is not known: leave the column out, or the other repeats"
        )
    return (repeats if measured.all() else np.where(measured, repeats, np.nanmean(repeats, axis=0)[None])), measured
