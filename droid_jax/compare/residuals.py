"""Simulation against measurement: what of a recording is compared, and the residuals.

A `Comparison` holds a recording's measured channels on the host and two traceable functions of a
`Rollout` of one sample: the distance in units (equation 1 of the paper) and the whitened
residuals, in units of the noise of the repeats' mean.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy import sparse

from droid_jax.measure.motion import CUTOFF
from droid_jax.measure.noise import RATE, Noise, coarse_clock, discrepancy, estimate_noise, lowpass, smooth
from droid_jax.measure.recording import Channel, Phase, Recording
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Rollout

ENOUGH = 0.1  # share of the time that two repeats must have measured
# Deviation below which a channel's noise is never believed, in the channel's unit.
MINIMUM_NOISE = {"torque": 0.01, "position": 2e-5, "velocity": 5e-4, "object_angle": 2e-4}


@dataclass(frozen=True)
class CompareConfig:
    """How simulation and measurement are compared.

    channels: weight of each compared channel in the distance (per unit of the channel).
    failure_cost: c of equation 1, N m, added where the grasp is lost or the door stays shut.
    non_finite_cost: N m, the cost of a replay that blew up.
    shut_angle: rad; a door that moves less than this (or half of what the measured one does) stayed shut; of a slide
      only the measured one tells.
    grip_share: share of the gripping time that all fingers must touch.
    whitened: the cost is the root mean square of the whitened residuals instead of N m.
    motion_cutoff: Hz, filter of the measured positions of a recording without commands.
    mj_step: replay as a MuJoCo program logs itself: mj_step's own steps of first order, each row the state before a
      step and the command of that step.  For recordings that MuJoCo made with the scene's own time step; of a real
      robot, or of a finer simulation, the default is the better one by far.
    """

    channels: Mapping[str, float] = field(default_factory=lambda: {"torque": 1.0})
    failure_cost: float = 10.0
    non_finite_cost: float = 1000.0
    shut_angle: float = 0.0873
    grip_share: float = 0.95
    whitened: bool = False
    motion_cutoff: float = CUTOFF
    mj_step: bool = False


@dataclass(frozen=True, eq=False)
class Measured:
    """One channel ready to be compared.

    unit: of the channel.  at: [Tc] fractional rows of the simulated trace; values [N,Tc,C], mask [N,Tc,C]; columns [C]
    of the simulated channel; kernel [C or 1,K,T] and noise for the whitened form; span [2] s of the
    coarse clock; weight in the distance.
    """

    name: str
    unit: str
    at: np.ndarray
    values: np.ndarray
    mask: np.ndarray
    columns: np.ndarray
    kernel: np.ndarray
    noise: Noise
    span: tuple[float, float]
    weight: float

    @property
    def clock(self) -> np.ndarray:
        """[K] s, the coarse clock: the times of what is smoothed and whitened."""
        return coarse_clock(*self.span)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Everything measured in one recording that a replay is compared with; clock: [T] s of the replay's rows."""

    name: str
    clock: np.ndarray
    channels: tuple[Measured, ...]
    grip_rows: tuple[int, int] | None
    shut_travel: float | None
    phases: tuple[Phase, ...]
    config: CompareConfig

    def distance(self, rollout: Rollout) -> jax.Array:
        """[] N m: equation 1, mean over repeats of ||tau_s - tau_r|| + c beta; finite always.

        The norm is the time mean of the Euclidean norm over the joints.
        """
        if self.config.whitened:
            z = self.whitened(rollout)
            total = jnp.sqrt(jnp.mean(z**2))
        else:
            total = sum(c.weight * _distance(c, _trace(rollout, c)) for c in self.channels)
        cost = total + self.config.failure_cost * self.failed(rollout)
        return jnp.where(rollout.finite & jnp.isfinite(cost), cost, self.config.non_finite_cost)

    def failed(self, rollout: Rollout) -> jax.Array:
        """[] bool, beta of equation 1: the grasp was lost or the door stayed shut."""
        failed = jnp.array(False)
        if self.grip_rows is not None and rollout.contact.shape[-1]:
            held = jnp.all(rollout.contact[self.grip_rows[0] : self.grip_rows[1]], axis=-1)
            failed = failed | (jnp.mean(held) < self.config.grip_share) | ~held[-1]
        if self.shut_travel is not None:
            failed = failed | (jnp.ptp(rollout.object_angle) < self.shut_travel)
        return failed

    def whitened(self, rollout: Rollout) -> jax.Array:
        """[M] residuals of the repeats' mean in noise units; NaN throughout where the replay blew up."""
        parts = [
            jnp.einsum(
                "ckl,lc->ck",
                jnp.asarray(c.noise.whitener, jnp.float32),
                _smooth(c, _trace(rollout, c)) - jnp.asarray(c.noise.mean, jnp.float32),
            ).ravel()
            for c in self.channels
        ]
        residual = jnp.concatenate(parts)
        return jnp.where(rollout.finite & jnp.all(jnp.isfinite(residual)), residual, jnp.nan)

    @property
    def repeats(self) -> int:
        """N."""
        return len(self.channels[0].values)

    def deviations(self) -> np.ndarray:
        """[N, M] deviations of the repeats from their mean, whitened as the residuals are."""
        parts = []
        for c in self.channels:
            apart = c.noise.repeats - c.noise.mean  # [N, K, C]
            parts.append(np.einsum("ckl,nlc->nck", c.noise.whitener, apart).reshape(len(apart), -1))
        return np.concatenate(parts, axis=1)

    def restated(self, rollout: Rollout) -> Comparison:
        """The comparison with a noise of every channel that a model's own rollout of one sample leaves plausible.

        One repeat does not tell its noise, and what a model cannot explain is far larger anyway.
        """

        def stated(channel: Measured) -> Measured:
            left = discrepancy(channel.noise.mean - np.asarray(_smooth(channel, _trace(rollout, channel))))
            return replace(channel, noise=channel.noise.stated(np.maximum(left, MINIMUM_NOISE[channel.name])))

        return replace(self, channels=tuple(stated(c) for c in self.channels))

    def smoothed(self, rollout: Rollout, channel: str = "torque") -> jax.Array:
        """[K, C] a channel of the rollout through the filter the data went through."""
        c = self.channel(channel)
        return _smooth(c, _trace(rollout, c))

    def channel(self, name: str) -> Measured:
        """A compared channel by name; an unknown one lists those compared."""
        for channel in self.channels:
            if channel.name == name:
                return channel
        raise ValueError(f"channel {name!r} is not compared; compared: {', '.join(c.name for c in self.channels)}")


def _trace(rollout: Rollout, channel: Measured) -> jax.Array:
    """[T, C] the simulated channel that a measured one is compared with."""
    trace = getattr(rollout, channel.name)
    trace = trace[:, None] if trace.ndim == 1 else trace
    return trace[:, channel.columns]


def _smooth(channel: Measured, trace: jax.Array) -> jax.Array:
    """[K, C] a simulated trace [T, C] through exactly what the channel's data went through."""
    kernel = jnp.asarray(channel.kernel, jnp.float32)
    if len(kernel) == 1:
        return kernel[0] @ trace
    return jnp.einsum("ckt,tc->kc", kernel, trace)


def _distance(channel: Measured, trace: jax.Array) -> jax.Array:
    """[] mean over repeats and time of the Euclidean norm over columns, masked samples left out."""
    last = trace.shape[0] - 1
    low = np.clip(np.floor(channel.at).astype(int), 0, last)
    part = jnp.asarray((channel.at - low)[:, None], jnp.float32)
    simulated = trace[low] * (1 - part) + trace[np.minimum(low + 1, last)] * part
    mask = jnp.asarray(channel.mask)
    error = jnp.where(mask, simulated[None] - jnp.asarray(np.where(channel.mask, channel.values, 0), jnp.float32), 0)
    norm = jnp.sqrt(jnp.sum(error**2, axis=-1) + 1e-20)  # [N, Tc]
    measured = jnp.any(mask, axis=-1)
    return jnp.mean(jnp.sum(norm * measured, axis=1) / jnp.maximum(jnp.sum(measured, axis=1), 1))


def make_comparison(
    scene: Scene, recording: Recording, clock: np.ndarray, config: CompareConfig, apart: np.ndarray | None = None
) -> Comparison:
    """Prepare a recording's channels for comparison with a replay whose rows have the times `clock` [T] s, regular.

    apart: [N, T, J] N m by which the repeats' torques may differ because they moved, or measured their motion,
    differently, with mean zero; it is taken off them where their noise is estimated.
    Raises ValueError for a channel the recording does not have, one that no replay produces, or a
    constant (dead) channel.
    """
    channels = tuple(
        _measure(scene, recording.channel(name), clock, weight, apart if name == "torque" else None)
        for name, weight in config.channels.items()
    )
    acts = scene.grip is not None and recording.command.size > 0  # along a prescribed motion nothing is gripped
    grip = _grip_window(recording) if acts else None
    shut = _shut_travel(scene, recording, config) if acts else None
    rows = None
    if grip is not None:
        steps, timestep = len(clock), clock[1] - clock[0]
        first, end = (int(np.clip(round((t - clock[0]) / timestep), 0, steps)) for t in grip)
        rows = (min(first, steps - 1), max(end, first + 1))
    return Comparison(recording.name, clock, channels, rows, shut, recording.phases, config)


def _shut_travel(scene: Scene, recording: Recording, config: CompareConfig) -> float | None:
    """rad (m of a slide): an object that moves less than this stayed shut; None where nothing tells what is little."""
    if scene.object_joint is None:
        return None
    least = None if scene.slides(scene.object_joint) else config.shut_angle
    if "object_angle" not in recording.channels:
        return least
    angle = recording.channels["object_angle"]
    return max(least or 0.0, 0.5 * float(np.ptp(angle.values[angle.mask])))


def _grip_window(recording: Recording) -> tuple[float, float] | None:
    """From the end of the grasp to the beginning of the release, s; None where no phases are stated."""
    named = {p.name: p for p in recording.phases}
    if "grasp" not in named:
        return None
    end = named["release"].start if "release" in named else recording.time[-1]
    return named["grasp"].end, float(end)


def _of_joints(scene: Scene, channel: Channel) -> Channel:
    """The columns of a channel that the scene's measured joints are: others that it has were left out on purpose."""
    joints = [mujoco.mj_id2name(scene.model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(scene.model.njnt)]
    unknown = [c for c in channel.columns if c not in joints]
    kept = [i for i, c in enumerate(channel.columns) if c in scene.joints]
    if unknown or not kept:
        raise ValueError(
            f"channel {channel.name!r}: unknown joints {', '.join(unknown or channel.columns)}; "
            f"valid: {', '.join(scene.joints)}"
        )
    columns = tuple(channel.columns[i] for i in kept)
    return replace(channel, columns=columns, values=channel.values[..., kept], mask=channel.mask[..., kept])


def _measure(scene: Scene, channel: Channel, clock: np.ndarray, weight: float, apart: np.ndarray | None) -> Measured:
    if channel.name not in MINIMUM_NOISE:
        raise ValueError(f"channel {channel.name!r} has no simulated counterpart; known: {', '.join(MINIMUM_NOISE)}")
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
    inside = (channel.time >= clock[0] - 1e-9) & (channel.time <= clock[-1] + 1e-9)
    if inside.sum() < 2:
        raise ValueError(
            f"channel {channel.name!r} runs {channel.time[0]:g} .. {channel.time[-1]:g} s, "
            f"outside the motion that is replayed, {clock[0]:g} .. {clock[-1]:g} s"
        )
    time, values, mask = channel.time[inside], channel.values[:, inside], channel.mask[:, inside]
    coarse = coarse_clock(float(time[0]), float(time[-1]))
    _needs_memory(channel, len(clock), len(coarse))
    kernel = lowpass(time, coarse)
    resampling = _resampling(clock, time)
    off = 0.0 if apart is None else np.stack([resampling @ a[:, columns] for a in apart])
    repeats = smooth(values - off, mask, kernel)
    seen = _same_filter(kernel, mask, ~np.isnan(repeats), resampling)
    repeats, measured = _fill(repeats, channel, coarse)
    noise = estimate_noise(repeats, minimum=MINIMUM_NOISE[channel.name], measured=measured)
    step = clock[1] - clock[0]
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
    )


def _needs_memory(channel: Channel, steps: int, instants: int) -> None:
    """Raise ValueError where filter and covariance, which grow with the square of the duration, fill the memory."""
    filters = 1 if channel.mask.all() or np.all(channel.mask == channel.mask[..., :1]) else len(channel.columns)
    needed = 8.0 * instants * (filters * steps + len(channel.columns) * instants)
    if not hasattr(os, "sysconf"):  # elsewhere than on Linux and macOS
        return
    there = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    if 2.0 * needed > there:  # what computes with them needs as much again
        raise ValueError(
            f"channel {channel.name!r} of {instants / RATE:.0f} s needs {needed / 1e9:.1f} GB for its filter and the "
            f"covariance of its noise, and half of this machine's memory is {there / 2e9:.1f} GB: cut the recording "
            "(`python -m droid_jax.run convert --start S --end S`), or fit its parts as several"
        )


def _resampling(clock: np.ndarray, time: np.ndarray) -> sparse.csr_array:
    """[Tc, T] linear interpolation from the replay's clock to a channel's."""
    at = np.clip((time - clock[0]) / (clock[1] - clock[0]), 0, len(clock) - 1)
    low = np.minimum(at.astype(int), len(clock) - 2)
    rows, share = np.arange(len(time)), at - low
    entries = np.concatenate([1 - share, share]), (np.tile(rows, 2), np.concatenate([low, low + 1]))
    return sparse.csr_array(entries, shape=(len(time), len(clock)))


def _same_filter(
    kernel: sparse.csr_array, mask: np.ndarray, kept: np.ndarray, resampling: sparse.csr_array
) -> np.ndarray:
    """[C or 1, K, T] what resampling, smoothing with a mask and averaging over the repeats does to a replay's trace.

    kernel [K, Tc]; mask [N, Tc, C]; kept [N, K, C], the outputs that enter the mean; resampling [Tc, T].
    """
    if mask.all():
        return (kernel @ resampling).toarray()[None]
    columns = list(zip(mask.transpose(2, 0, 1), kept.transpose(2, 0, 1), strict=True))
    if all(np.array_equal(m, columns[0][0]) and np.array_equal(k, columns[0][1]) for m, k in columns):
        columns = columns[:1]  # a log that was silent for a while was so in all of them
    return np.stack([(_mean_filter(kernel, *column) @ resampling).toarray() for column in columns])


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
            where = "" if len(still) == len(repeats) else f" in repeat {still[0]}"
            raise ValueError(
                f"channel {channel.name!r}, column {column!r} never changes{where} ({repeats[still[0]][0]:g} "
                f"{channel.unit}): a dead sensor? mask it out or leave {'that repeat' if where else 'the joint'} away"
                f"{'' if where else ' (--joints)'}"
            )


def _fill(repeats: np.ndarray, channel: Channel, clock: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Repeats [N, K, C] whose gaps take the other repeats' mean there, and what was measured.

    Raises ValueError for a gap in all repeats, and for a column that hardly two of several measured: nothing says then
    how noisy it is.
    """
    measured = ~np.isnan(repeats)
    count = measured.sum(axis=0)
    gaps = np.argwhere(count == 0)
    if len(gaps):
        instant, column = gaps[0]
        raise ValueError(
            f"channel {channel.name!r}, column {channel.columns[column]!r} has a stretch that no repeat measured, at "
            f"{clock[instant]:.3g} s: cut the recording there (window), or leave the column away"
        )
    alone = np.flatnonzero((count - 1).sum(axis=0) < ENOUGH * len(clock))
    if len(repeats) > 1 and len(alone):
        raise ValueError(
            f"channel {channel.name!r}, column {channel.columns[alone[0]]!r} was measured by one repeat only for most "
            "of the time, so its noise is not known: leave the column away, or the other repeats"
        )
    return (repeats if measured.all() else np.where(measured, repeats, np.nanmean(repeats, axis=0)[None])), measured
