"""One measured channel made ready to be compared with a replay: its clock, its filter and its noise.

A replay's trace goes through exactly what the data went through: resampling, the low pass with the repeats' masks,
and the mean over the repeats, all of it one matrix, of which each row is a short window.
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
    """A recording whose covariance of the noise would fill the memory."""


@dataclass(frozen=True, eq=False)
class ShortFilter:
    """A filter whose outputs are sums over short windows of T samples.

    begin: [K] first sample of each window.  weights: [C or 1, K, W] of its samples, for each column or for all.
    """

    begin: np.ndarray
    weights: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """[K, W] the samples of each window."""
        return self.begin[:, None] + np.arange(self.weights.shape[-1])


def short_filter(filters: Sequence[sparse.csr_array], length: int) -> ShortFilter:
    """Sparse filters [K, T], one for each column or one for all, by their windows; length: T."""
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
    """One channel ready to be compared.

    unit: of the channel.  at: [Tc] fractional rows of the simulated trace; values [N,Tc,C], mask [N,Tc,C]; columns [C]
    of the simulated channel; kernel from the trace to K instants, and noise for the whitened form; span [2] s of the
    coarse clock; weight in the distance; moves [K,C] bool, instants that were measured and at which a column's joint
    moves: at rest along a prescribed motion friction takes what is left, and what is left tells nothing of noise.
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
        """[K] s, the coarse clock: the times of what is smoothed and whitened."""
        return np.linspace(*self.span, len(self.noise.mean))


def least_noise(name: str, mean: np.ndarray, config: NoiseConfig = DEFAULT_NOISE) -> np.ndarray:
    """[C] deviation below which the noise of a channel that one repeat measured is never believed, in its unit.

    mean: [K, C] what was measured, smoothed.  Noise is told from what a fit leaves, which a model with too many
    parameters takes away.
    """
    return np.minimum(config.minimum[name], config.minimum_share * np.maximum(np.std(mean, axis=0), 1e-9))


def prepared(
    scene: Scene,
    channel: Channel,
    clock: np.ndarray,
    weight: float,
    apart: np.ndarray | None = None,
    rest: np.ndarray | None = None,
    config: NoiseConfig = DEFAULT_NOISE,
) -> Measured:
    """A channel made ready for a replay whose rows have the times `clock` [T] s; apart, rest: as in `make_comparison`.

    Raises ValueError for a channel that no replay produces, unknown columns, a constant one, one outside the motion,
    one with a stretch that none of several repeats measured, and one too long for the memory.
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
    _needs_memory(channel, coarse)
    kernel = lowpass(time, coarse, config)
    resampling = _resampling(clock, time)
    off = 0.0 if apart is None else np.stack([resampling @ a[:, columns] for a in apart])
    repeats = smooth(values - off, mask, kernel, config.least_window)
    seen = short_filter(_same_filters(kernel, mask, ~np.isnan(repeats), resampling), len(clock))
    repeats, measured = _fill(repeats, channel, coarse, config.least_overlap)
    noise = estimate_noise(repeats, minimum=config.minimum[channel.name], measured=measured, config=config)
    step = clock[1] - clock[0]
    still = np.zeros((len(clock), len(scene.joints)), bool) if rest is None else rest[:, : len(scene.joints)]
    return Measured(
        name=channel.name,
        unit=channel.unit,
        at=(time - clock[0]) / step,
        values=values,
        mask=mask,
        columns=columns,
        kernel=seen,
        noise=noise,
        span=(float(coarse[0]), float(coarse[-1])),
        weight=weight,
        moves=(kernel @ (resampling @ (~still[:, columns]).astype(float)) > config.moving_share) & (noise.count > 0),
    )


def compared_columns(scene: Scene, channel: Channel, config: NoiseConfig = DEFAULT_NOISE) -> tuple[Channel, np.ndarray]:
    """A channel's columns that are compared, and theirs [C] in the simulated channel; ValueError as in `prepared`."""
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
    """One repeat's values [K, C] at instants `coarse` [K] s within a replay's rows `clock` [T] s, and the same filter
    for its trace, C or 1 of [K, T].

    NaN where too little was measured.  Nothing from outside of the replay's rows enters.
    """
    inside = (channel.time >= clock[0] - 1e-9) & (channel.time <= clock[-1] + 1e-9)
    time, values, mask = channel.time[inside], channel.values[[repeat]][:, inside], channel.mask[[repeat]][:, inside]
    if len(time) < 2:
        return np.full((len(coarse), len(channel.columns)), np.nan), (sparse.csr_array((len(coarse), len(clock))),)
    kernel = lowpass(time, coarse, config)
    found = smooth(values, mask, kernel, config.least_window)
    return found[0], tuple(_same_filters(kernel, mask, ~np.isnan(found), _resampling(clock, time)))


def _of_joints(scene: Scene, channel: Channel) -> Channel:
    """A channel's columns that are measured joints of the scene, in its order: others were left out on purpose."""
    joints = [mujoco.mj_id2name(scene.model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(scene.model.njnt)]
    unknown = [c for c in channel.columns if c not in joints]
    kept = [channel.columns.index(joint) for joint in scene.joints if joint in channel.columns]
    if unknown or not kept:
        raise ValueError(
            f"channel {channel.name!r}: unknown joints {', '.join(unknown or channel.columns)}; "
            f"valid: {', '.join(scene.joints)}"
        )
    columns = tuple(channel.columns[i] for i in kept)
    return replace(channel, columns=columns, values=channel.values[..., kept], mask=channel.mask[..., kept])


def _needs_memory(channel: Channel, coarse: np.ndarray) -> None:
    """Raise TooLong where the noise's covariance, which grows with the square of the duration, fills the memory."""
    needed = 8.0 * len(channel.columns) * len(coarse) ** 2
    if not hasattr(os, "sysconf"):  # elsewhere than on Linux and macOS
        return
    there = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    if 2.0 * needed > there:  # what computes with it needs as much again
        raise TooLong(
            f"channel {channel.name!r} of {coarse[-1] - coarse[0]:.0f} s needs {needed / 1e9:.1f} GB for the "
            f"covariance of its noise, and half of this machine's memory is {there / 2e9:.1f} GB: cut the "
            "recording (`python -m droid_jax.run convert --start S --end S`), or fit its parts as several"
        )


def _resampling(clock: np.ndarray, time: np.ndarray) -> sparse.csr_array:
    """[Tc, T] linear interpolation from the replay's clock to a channel's."""
    at = np.clip((time - clock[0]) / (clock[1] - clock[0]), 0, len(clock) - 1)
    low = np.minimum(at.astype(int), len(clock) - 2)
    rows, share = np.arange(len(time)), at - low
    entries = np.concatenate([1 - share, share]), (np.tile(rows, 2), np.concatenate([low, low + 1]))
    return sparse.csr_array(entries, shape=(len(time), len(clock)))


def _same_filters(
    kernel: sparse.csr_array, mask: np.ndarray, kept: np.ndarray, resampling: sparse.csr_array
) -> list[sparse.csr_array]:
    """What resampling, smoothing with a mask and averaging over repeats does to a replay's trace [T]: C or 1 of [K, T].

    kernel [K, Tc]; mask [N, Tc, C]; kept [N, K, C], the outputs that enter the mean; resampling [Tc, T].
    """
    if mask.all():
        return [kernel @ resampling]
    columns = list(zip(mask.transpose(2, 0, 1), kept.transpose(2, 0, 1), strict=True))
    if all(np.array_equal(m, columns[0][0]) and np.array_equal(k, columns[0][1]) for m, k in columns):
        columns = columns[:1]  # a log that was silent for a while was so in all of them
    return [_mean_filter(kernel, *column) @ resampling for column in columns]


def _mean_filter(kernel: sparse.csr_array, mask: np.ndarray, kept: np.ndarray) -> sparse.csr_array:
    """[K, Tc] the mean of one column's filters: kernel [K, Tc], renormalised over each repeat's mask [N, Tc].

    kept: [N, K].
    """
    total = sparse.csr_array(kernel.shape)
    for seen, own in zip(mask, kept, strict=True):
        share = np.where(own, 1.0 / np.where(own, kernel @ seen.astype(float), 1.0), 0.0)
        total += sparse.diags_array(share) @ kernel @ sparse.diags_array(seen.astype(float))
    return sparse.diags_array(1.0 / np.maximum(kept.sum(axis=0), 1)) @ total


def _refuse_constant(channel: Channel) -> None:
    for c, column in enumerate(channel.columns):
        repeats = [values[mask] for values, mask in zip(channel.values[:, :, c], channel.mask[:, :, c], strict=True)]
        still = [k for k, values in enumerate(repeats) if values.size and np.ptp(values) == 0]
        if still:
            where, do = "", "leave the joint away (--joints, in Python load_scene(joints=...))"
            if len(still) < len(repeats):
                masked = len(repeats) - len(still) > 1  # one repeat alone does not tell its noise
                where = f" in repeat {still[0]}"
                do = f"{'mask it out there, or ' if masked else ''}leave that repeat away"
            raise ValueError(
                f"channel {channel.name!r}, column {column!r} never changes{where} ({repeats[still[0]][0]:g} "
                f"{channel.unit}): a dead sensor? {do}"
            )


def _fill(repeats: np.ndarray, channel: Channel, clock: np.ndarray, overlap: float) -> tuple[np.ndarray, np.ndarray]:
    """Repeats [N, K, C] whose gaps take the other repeats' mean there, and what was measured.

    The gaps of one repeat alone are zero, as its filter of the simulation is there, and count for nothing.
    Raises ValueError for a gap in all of several repeats, and for a column that hardly two of several measured, since
    nothing says then how noisy it is, or one alone hardly did.
    """
    measured = ~np.isnan(repeats)
    count = measured.sum(axis=0)
    seldom = np.flatnonzero(count.sum(axis=0) < overlap * len(clock))
    if len(repeats) == 1 and len(seldom):
        raise ValueError(
            f"channel {channel.name!r}, column {channel.columns[seldom[0]]!r} was measured for less than "
            f"{100 * overlap:g} % of the time: leave the column away"
        )
    if len(repeats) == 1:
        return np.where(measured, repeats, 0.0), measured
    gaps = np.argwhere(count == 0)
    if len(gaps):
        instant, column = gaps[0]
        raise ValueError(
            f"channel {channel.name!r}, column {channel.columns[column]!r} has a stretch that no repeat measured, at "
            f"{clock[instant]:.3g} s: cut the recording there (window), or leave the column away"
        )
    alone = np.flatnonzero((count - 1).sum(axis=0) < overlap * len(clock))
    if len(alone):
        raise ValueError(
            f"channel {channel.name!r}, column {channel.columns[alone[0]]!r} was measured by one repeat only for most "
            "of the time, so its noise is not known: leave the column away, or the other repeats"
        )
    return (repeats if measured.all() else np.where(measured, repeats, np.nanmean(repeats, axis=0)[None])), measured
