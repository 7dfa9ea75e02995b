"""Simulation against measurement: the compared channels of a recording, its distance and its residuals.

A `Comparison` holds a recording's measured channels on the host, and two traceable functions of a `Rollout` of one
sample.  One is the distance in physical units (equation 1 of the paper).  The other is the whitened residuals, in units
of the noise of the repeats' mean.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax.arguments import check_fields, flag, instance, number, weights
from droid_jax.cost.noise import Noise, NoiseConfig, deviation_of, stated_deviation
from droid_jax.cost.observation import Measured, least_noise, prepared
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Phase, Recording
from droid_jax.simulate.initial_state import StartConfig
from droid_jax.simulate.measured_motion import CUTOFF
from droid_jax.simulate.rest import RestConfig

LEADING = "torque"  # channel of figures and checks, where it is compared; the servo relates it to the other channels


@dataclass(frozen=True)
class CompareConfig:
    """How simulation and measurement are compared.

    channels: weight of each compared channel in the distance, per unit of the channel, above 0.
      `channels.in_noise_units` sets weights by the channels' noise.  The weights act in the distance and the search
      only.  The refinement uses residuals in noise units, which need no weights.
    failure_cost: c of equation 1, N m, added where the grasp is lost or the door stays shut.
    non_finite_cost: N m, the cost of a replay that blew up; see `Comparison.penalty` for other units.
    shut_angle: rad.  A door counts as shut if it moves by less than this, or by less than `shut_share` of the measured
      travel.  It is not checked if the measured door stays shut too, or if the recording's phases end with the grasp.
      For a slide only the measured travel is used.
    shut_share: share of the measured travel, see `shut_angle`; a design choice.
    grip_share: share of the gripping time that all fingers must touch.
    whitened: the cost is the root mean square of the whitened residuals, without a unit, instead of equation 1.
    motion_cutoff: Hz, filter of the measured positions of a recording without commands.
    rest: when a joint of such a recording counts as at rest, where its friction is only bounded.
    start: where a motion starts, and whether repeats start from one state.
    noise: settings of the noise model.
    mj_step: replay with mj_step's own first-order steps, where each row is the state before a step and the command of
      that step.  Use it for recordings that a MuJoCo program made with the scene's own time step.  For a real robot, or
      a finer simulation, the default is more accurate.
    """

    channels: Mapping[str, float] = field(default_factory=lambda: {"torque": 1.0})
    failure_cost: float = 10.0
    non_finite_cost: float = 1000.0
    shut_angle: float = 0.0873
    shut_share: float = 0.5
    grip_share: float = 0.95
    whitened: bool = False
    motion_cutoff: float = CUTOFF
    rest: RestConfig = field(default_factory=RestConfig)
    start: StartConfig = field(default_factory=StartConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    mj_step: bool = False

    def __post_init__(self) -> None:
        check_fields(
            self,
            channels=weights,
            failure_cost=partial(number, least=0),
            non_finite_cost=partial(number, above=0),
            shut_angle=partial(number, least=0),
            shut_share=partial(number, least=0, most=1),
            grip_share=partial(number, least=0, most=1),
            whitened=flag,
            motion_cutoff=partial(number, above=0),
            rest=partial(instance, kind=RestConfig),
            start=partial(instance, kind=StartConfig),
            noise=partial(instance, kind=NoiseConfig),
            mj_step=flag,
        )
        if unweighed := [name for name, weight in self.channels.items() if not weight]:
            raise ValueError(
                f"channels: {', '.join(unweighed)} has weight 0, but the refinement does not use weights and would "
                "compare it: leave the channel out"
            )


@dataclass(frozen=True, eq=False)
class Comparison:
    """The measured channels of one recording, prepared for the comparison with its replay.

    name: of the recording.  clock: [T] s, times of the replay's rows.  channels: those that are compared.
    grip_rows: first row, and end, in which the fingers must touch the object; None without a grip.
    shut_travel: rad or m; an object that moves less counts as shut.  None if it is not checked.
    phases: of the recording.  config: how simulation and measurement are compared.
    """

    name: str
    clock: np.ndarray
    channels: tuple[Measured, ...]
    grip_rows: tuple[int, int] | None
    shut_travel: float | None
    phases: tuple[Phase, ...]
    config: CompareConfig

    def distance(self, rollout: Rollout) -> jax.Array:
        """Return equation 1, the mean over repeats of ||tau_s - tau_r|| + c beta, in N m or the channel's unit.

        The norm is the time mean of the Euclidean norm over the joints.  The result [] is always finite.
        """
        if self.config.whitened:
            z = self.whitened(rollout)
            total = jnp.sqrt(jnp.mean(z**2))
        else:
            total = sum(c.weight * _distance(c, _trace(rollout, c)) for c in self.channels)
        cost = total + self.config.failure_cost * self.failed(rollout)
        return jnp.where(rollout.finite & jnp.isfinite(cost), cost, self.penalty)

    @property
    def penalty(self) -> float:
        """Cost of a replay that blew up, in the distance's unit.

        It is `non_finite_cost` times the largest weight of a channel, if that is above 1, so that no finite replay
        costs more.  For whitened residuals the weight is the inverse standard deviation of the noise.
        """
        if self.config.whitened:
            largest = max(float(np.abs(c.noise.whitener).max(initial=0.0)) for c in self.channels)
        else:
            largest = max(c.weight for c in self.channels)
        return self.config.non_finite_cost * max(1.0, largest)

    def failed(self, rollout: Rollout) -> jax.Array:
        """Return beta of equation 1, [] bool: the grasp was lost or the door stayed shut."""
        failed = jnp.array(False)
        if self.grip_rows is not None and rollout.contact.shape[-1]:
            grasped = jnp.all(rollout.contact[self.grip_rows[0] : self.grip_rows[1]], axis=-1)
            failed = failed | (jnp.mean(grasped) < self.config.grip_share) | ~grasped[-1]
        if self.shut_travel is not None:
            failed = failed | (jnp.ptp(rollout.object_angle) < self.shut_travel)
        return failed

    def whitened(self, rollout: Rollout) -> jax.Array:
        """Return residuals [M] of the repeats' mean in noise units; NaN throughout if the replay blew up."""
        parts = [
            _whiten(c.noise, _smooth(c, _trace(rollout, c)) - jnp.asarray(c.noise.mean, jnp.float32)).ravel()
            for c in self.channels
        ]
        residual = jnp.concatenate(parts)
        return jnp.where(rollout.finite & jnp.all(jnp.isfinite(residual)), residual, jnp.nan)

    @property
    def repeats(self) -> int:
        """Number N of repeats."""
        return len(self.channels[0].values)

    def deviations(self) -> np.ndarray:
        """Return deviations [N, M] of the repeats from their mean, whitened as the residuals are."""
        parts = []
        for c in self.channels:
            deviations = c.noise.repeats - c.noise.mean  # [N, K, C]
            parts.append(c.noise.whitened(deviations).reshape(len(deviations), -1))
        return np.concatenate(parts, axis=1)

    def unexplained(self, rollout: Rollout) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return, by channel, the root mean square [C] of the residual of a rollout of one sample, and a noise [C].

        The noise is the standard deviation of white noise with as much information (`stated_deviation`).  It serves as
        the noise of a single repeat, which cannot be estimated, and is usually far below the model's error.
        """

        def estimate(channel: Measured) -> tuple[np.ndarray, np.ndarray]:
            residual = channel.noise.mean - np.asarray(_smooth(channel, _trace(rollout, channel)))
            minimum = least_noise(channel.name, channel.noise.mean, self.config.noise)
            rms = deviation_of(residual, channel.moves)
            stated = stated_deviation(residual, channel.moves, self.config.noise.rate)
            return np.maximum(rms, minimum), np.maximum(stated, minimum)

        return {channel.name: estimate(channel) for channel in self.channels}

    def stated(self, deviations: Mapping[str, np.ndarray]) -> Comparison:
        """Return the comparison with white noise of stated standard deviations, by channel [C]."""
        channels = (replace(c, noise=c.noise.stated(deviations[c.name])) for c in self.channels)
        return replace(self, channels=tuple(channels))

    @property
    def leading(self) -> Measured:
        """The channel of figures and checks: torque where it is compared, else the first one."""
        return next((c for c in self.channels if c.name == LEADING), self.channels[0])

    def smoothed(self, rollout: Rollout, name: str | None = None) -> jax.Array:
        """Return a compared channel [K, C] of a rollout, through the filter of its data.

        name: of the channel; None for the leading one.
        """
        c = self.leading if name is None else self.channel(name)
        return _smooth(c, _trace(rollout, c))

    def channel(self, name: str) -> Measured:
        """Return a compared channel by name; ValueError for another one lists those that are compared."""
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
    """[K, C] a simulated trace [T, C] through the filter of the channel's data."""
    weights = jnp.asarray(channel.kernel.weights, jnp.float32)
    return jnp.einsum("ckw,kwc->kc" if len(weights) > 1 else "zkw,kwc->kc", weights, trace[channel.kernel.rows])


def _whiten(noise: Noise, x: jax.Array) -> jax.Array:
    """[C, K] deviations [K, C] in units of the noise."""
    if noise.whitener.ndim == 2:  # white noise
        return jnp.asarray(noise.whitener, jnp.float32) * x.T
    return jnp.einsum("ckl,lc->ck", jnp.asarray(noise.whitener, jnp.float32), x)


def _distance(channel: Measured, trace: jax.Array) -> jax.Array:
    """[] mean over repeats and time of the Euclidean norm over columns; samples that were not measured do not enter."""
    last = trace.shape[0] - 1
    low = np.clip(np.floor(channel.at).astype(int), 0, last)
    part = jnp.asarray((channel.at - low)[:, None], jnp.float32)
    simulated = trace[low] * (1 - part) + trace[np.minimum(low + 1, last)] * part
    mask = jnp.asarray(channel.mask)
    error = jnp.where(mask, simulated[None] - jnp.asarray(np.where(channel.mask, channel.values, 0), jnp.float32), 0)
    norm = jnp.sqrt(jnp.sum(error**2, axis=-1) + 1e-20)  # [N, Tc]
    measured = jnp.any(mask, axis=-1)
    samples = jnp.sum(measured, axis=1)  # [N], 0 where a repeat was not measured during the replay
    return jnp.sum(jnp.sum(norm * measured, axis=1) / jnp.maximum(samples, 1)) / jnp.maximum(jnp.sum(samples > 0), 1)


def with_estimated_noise(comparisons: Sequence[Comparison], rollouts: Sequence[Rollout]) -> list[Comparison]:
    """Return comparisons whose noise of single repeats is estimated from the residuals of one sample's rollouts.

    The size of the noise is the geometric mean of two root mean squares: of the recording's own residual, and of the
    residuals of all recordings with the same columns.  The own one alone would feed back on the fit: a log that fits
    badly would lose weight, and one that fits well would gain weight.  Fits of eight logs of an XL330 then ended at
    0.054 or 0.095 rad, depending on the search's draws, and with the geometric mean at 0.051 to 0.054.  The shared one
    alone would let the log that fits worst dominate.  A recording whose simulation blew up keeps its noise.
    """
    single = [k for k, c in enumerate(comparisons) if c.repeats == 1 and np.all(rollouts[k].finite)]
    estimates = {k: comparisons[k].unexplained(rollouts[k]) for k in single}
    same_columns = defaultdict[tuple[Any, ...], list[np.ndarray]](list)
    for k in single:
        for c in comparisons[k].channels:
            same_columns[c.name, *c.columns.tolist()].append(estimates[k][c.name][0])
    shared = {columns: np.sqrt(np.mean(np.square(each), axis=0)) for columns, each in same_columns.items()}
    out = list(comparisons)
    for k in single:
        common = {c.name: shared[c.name, *c.columns.tolist()] for c in out[k].channels}
        noise = {name: stated * np.sqrt(common[name] / rms) for name, (rms, stated) in estimates[k].items()}
        out[k] = out[k].stated(noise)
    return out


def make_comparison(
    scene: Scene,
    recording: Recording,
    clock: np.ndarray,
    config: CompareConfig,
    motion_torques: np.ndarray | None = None,
    rest: np.ndarray | None = None,
) -> Comparison:
    """Prepare a recording's channels for the comparison with its replay.

    Args:
        scene: what is simulated.
        recording: the measurement, N repeats.
        clock: [T] s, regular, times of the replay's rows.
        config: how simulation and measurement are compared.
        motion_torques: [N, T, J] N m, torques of the repeats' own measured motions minus their mean.  They are
            subtracted before the noise of the torques is estimated.  None: zero.
        rest: [T, J] bool, rows at which a joint is at rest along a prescribed motion (`simulate.rest`).

    Raises:
        ValueError: the recording does not have a compared channel, no replay produces it, or it is constant.
    """
    channels = tuple(
        prepared(
            scene,
            recording.channel(name),
            clock,
            weight,
            *((motion_torques, rest) if name == "torque" else (None, None)),
            config=config.noise,
        )
        for name, weight in config.channels.items()
    )
    has_grip = scene.grip is not None and recording.command.size > 0  # along a prescribed motion nothing is gripped
    grip = recording.grip_window if has_grip else None
    shut = _shut_travel(scene, recording, clock, config) if has_grip else None
    rows = None
    if grip is not None and grip[0] < clock[-1]:  # gripping begins before the replay ends
        steps, timestep = len(clock), clock[1] - clock[0]
        first, end = (int(np.clip(round((t - clock[0]) / timestep), 0, steps)) for t in grip)
        rows = (min(first, steps - 1), max(end, first + 1))
    return Comparison(recording.name, clock, channels, rows, shut, recording.phases, config)


def _shut_travel(scene: Scene, recording: Recording, clock: np.ndarray, config: CompareConfig) -> float | None:
    """Travel in rad (m of a slide) below which the object counts as shut; None if it cannot be checked.

    It cannot be checked if the measured object does not open, or if the recording's phases end with the grasp.
    """
    if scene.object_joint is None:
        return None
    minimum = 0.0 if scene.slides(scene.object_joint) else config.shut_angle
    if "object_angle" in recording.channels:
        angle = recording.channels["object_angle"]
        inside = (angle.time >= clock[0] - 1e-9) & (angle.time <= clock[-1] + 1e-9)
        measured = angle.values[:, inside][angle.mask[:, inside]]
        travel = float(np.ptp(measured)) if measured.size else 0.0
        return None if travel < minimum else max(minimum, config.shut_share * travel)
    grasp_ends = [p.end for p in recording.phases if p.name == "grasp"]
    continues = any(p.start >= end - 1e-9 for p in recording.phases for end in grasp_ends)
    return (minimum or None) if continues or not recording.phases else None
