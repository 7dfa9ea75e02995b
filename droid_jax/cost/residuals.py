"""Simulation against measurement: what of a recording is compared, and the residuals.

A `Comparison` holds a recording's measured channels on the host and two traceable functions of a
`Rollout` of one sample: the distance in units (equation 1 of the paper) and the whitened
residuals, in units of the noise of the repeats' mean.
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

LEADS = "torque"  # the channel that others, which follow from it through the servo, stand behind


@dataclass(frozen=True)
class CompareConfig:
    """How simulation and measurement are compared.

    channels: weight of each compared channel in the distance, per unit of the channel, above 0;
      `channels.in_noise_units` weighs several by their noise.  Weights act in the distance and the search alone:
      residuals in noise units, which are refined, count every channel by its noise.
    failure_cost: c of equation 1, N m, added where the grasp is lost or the door stays shut.
    non_finite_cost: N m, the cost of a replay that blew up.  Weights above one and noise units multiply it, so that it
      stays above what replays cost (`Comparison.penalty`).
    shut_angle: rad; a door that moves less than this (or half of what the measured one does) stayed shut, unless the
      measured one does so too, or the recording's phases end with the grasp; of a slide only the measured one tells.
    grip_share: share of the gripping time that all fingers must touch.
    whitened: the cost is the root mean square of the whitened residuals instead of N m.
    motion_cutoff: Hz, filter of the measured positions of a recording without commands.
    rest: below which speed a joint of such a recording counts as at rest, where its friction is only bounded.
    start: what decides where a motion starts, and whether repeats start at one place.
    noise: what decides the noise of the channels.
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
                f"channels: {', '.join(unweighed)} with a weight of 0 would count in noise units nonetheless: leave "
                "the channel out"
            )


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
        """[] N m, or the compared channel's unit: equation 1, mean over repeats of ||tau_s - tau_r|| + c beta; finite
        always.

        The norm is the time mean of the Euclidean norm over the joints.
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
        """What a replay that blew up costs, in the distance's unit: `non_finite_cost` in the unit of the channel that
        weighs most, in which one over the noise is a weight too.
        """
        if self.config.whitened:
            most = max(float(np.abs(c.noise.whitener).max(initial=0.0)) for c in self.channels)
        else:
            most = max(c.weight for c in self.channels)
        return self.config.non_finite_cost * max(1.0, most)

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
            _whiten(c.noise, _smooth(c, _trace(rollout, c)) - jnp.asarray(c.noise.mean, jnp.float32)).ravel()
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

    def unexplained(self, rollout: Rollout) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """By channel, root mean square [C] of what a model's own rollout of one sample leaves, and the deviation [C] to
        state as its noise (`stated_deviation`).

        One repeat does not tell its noise, and what a model cannot explain is far larger anyway.
        """

        def of(channel: Measured) -> tuple[np.ndarray, np.ndarray]:
            left = channel.noise.mean - np.asarray(_smooth(channel, _trace(rollout, channel)))
            least = least_noise(channel.name, channel.noise.mean, self.config.noise)
            both = deviation_of(left, channel.moves), stated_deviation(left, channel.moves, self.config.noise.rate)
            return np.maximum(both[0], least), np.maximum(both[1], least)

        return {channel.name: of(channel) for channel in self.channels}

    def stated(self, deviations: Mapping[str, np.ndarray]) -> Comparison:
        """The comparison with a noise of every channel that has the deviation [C]."""
        made = (replace(c, noise=c.noise.stated(deviations[c.name])) for c in self.channels)
        return replace(self, channels=tuple(made))

    @property
    def leading(self) -> Measured:
        """The channel that figures and checks are of: the torque where it is compared, else the first one."""
        return next((c for c in self.channels if c.name == LEADS), self.channels[0])

    def smoothed(self, rollout: Rollout, name: str | None = None) -> jax.Array:
        """[K, C] a compared channel of the rollout (default: the leading one) through the filter of its data."""
        c = self.leading if name is None else self.channel(name)
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
    weights = jnp.asarray(channel.kernel.weights, jnp.float32)
    return jnp.einsum("ckw,kwc->kc" if len(weights) > 1 else "zkw,kwc->kc", weights, trace[channel.kernel.rows])


def _whiten(noise: Noise, x: jax.Array) -> jax.Array:
    """[C, K] deviations [K, C] in units of the noise."""
    own = np.einsum("ckk->ck", noise.whitener)
    if np.count_nonzero(noise.whitener) == np.count_nonzero(own):  # white noise: a long log has many instants
        return jnp.asarray(own, jnp.float32) * x.T
    return jnp.einsum("ckl,lc->ck", jnp.asarray(noise.whitener, jnp.float32), x)


def _distance(channel: Measured, trace: jax.Array) -> jax.Array:
    """[] mean over repeats and time of the Euclidean norm over columns; what was not measured is left out."""
    last = trace.shape[0] - 1
    low = np.clip(np.floor(channel.at).astype(int), 0, last)
    part = jnp.asarray((channel.at - low)[:, None], jnp.float32)
    simulated = trace[low] * (1 - part) + trace[np.minimum(low + 1, last)] * part
    mask = jnp.asarray(channel.mask)
    error = jnp.where(mask, simulated[None] - jnp.asarray(np.where(channel.mask, channel.values, 0), jnp.float32), 0)
    norm = jnp.sqrt(jnp.sum(error**2, axis=-1) + 1e-20)  # [N, Tc]
    measured = jnp.any(mask, axis=-1)
    samples = jnp.sum(measured, axis=1)  # [N], none where a repeat was not measured during the replay
    return jnp.sum(jnp.sum(norm * measured, axis=1) / jnp.maximum(samples, 1)) / jnp.maximum(jnp.sum(samples > 0), 1)


def restated(comparisons: Sequence[Comparison], rollouts: Sequence[Rollout]) -> list[Comparison]:
    """Comparisons with the noise of single repeats restated from what one sample's rollouts leave unexplained.

    Recordings of the same columns share half of its size: it is the geometric mean of what this one leaves and of what
    all leave, as root mean squares.  Each with its own, one that the model follows badly would count for little, and
    one that it follows well for ever more: eight logs of an XL330 ended at 0.054 or 0.095 rad as their search fell out,
    and so at 0.051 to 0.054.  With all of it shared, the log that is followed worst would decide.  One whose simulation
    blew up keeps the noise that it had.
    """
    single = [k for k, c in enumerate(comparisons) if c.repeats == 1 and np.all(rollouts[k].finite)]
    left = {k: comparisons[k].unexplained(rollouts[k]) for k in single}
    alike = defaultdict[tuple[Any, ...], list[np.ndarray]](list)
    for k in single:
        for c in comparisons[k].channels:
            alike[c.name, *c.columns.tolist()].append(left[k][c.name][0])
    shared = {of: np.sqrt(np.mean(np.square(each), axis=0)) for of, each in alike.items()}
    out = list(comparisons)
    for k in single:
        common = {c.name: shared[c.name, *c.columns.tolist()] for c in out[k].channels}
        out[k] = out[k].stated({name: alone * np.sqrt(common[name] / rms) for name, (rms, alone) in left[k].items()})
    return out


def make_comparison(
    scene: Scene,
    recording: Recording,
    clock: np.ndarray,
    config: CompareConfig,
    apart: np.ndarray | None = None,
    rest: np.ndarray | None = None,
) -> Comparison:
    """Prepare a recording's channels for comparison with a replay whose rows have the times `clock` [T] s, regular.

    apart: [N, T, J] N m by which the repeats' torques may differ because they moved, or measured their motion,
    differently, with mean zero; it is taken off them where their noise is estimated.
    rest: [T, J] bool, rows at which a joint is at rest along a prescribed motion (`simulate.rest`).
    Raises ValueError for a channel the recording does not have, one that no replay produces, or a
    constant (dead) channel.
    """
    channels = tuple(
        prepared(
            scene,
            recording.channel(name),
            clock,
            weight,
            *((apart, rest) if name == "torque" else (None, None)),
            config=config.noise,
        )
        for name, weight in config.channels.items()
    )
    acts = scene.grip is not None and recording.command.size > 0  # along a prescribed motion nothing is gripped
    grip = recording.grip_window if acts else None
    shut = _shut_travel(scene, recording, clock, config) if acts else None
    rows = None
    if grip is not None and grip[0] < clock[-1]:  # else the grasp has only just ended
        steps, timestep = len(clock), clock[1] - clock[0]
        first, end = (int(np.clip(round((t - clock[0]) / timestep), 0, steps)) for t in grip)
        rows = (min(first, steps - 1), max(end, first + 1))
    return Comparison(recording.name, clock, channels, rows, shut, recording.phases, config)


def _shut_travel(scene: Scene, recording: Recording, clock: np.ndarray, config: CompareConfig) -> float | None:
    """rad (m of a slide): an object that moves less than this stayed shut; None where nothing tells what is little.

    So of a part of a motion in which the measured one does not open either, or that ends with the grasp.
    """
    if scene.object_joint is None:
        return None
    least = 0.0 if scene.slides(scene.object_joint) else config.shut_angle
    if "object_angle" in recording.channels:
        angle = recording.channels["object_angle"]
        inside = (angle.time >= clock[0] - 1e-9) & (angle.time <= clock[-1] + 1e-9)
        seen = angle.values[:, inside][angle.mask[:, inside]]
        travel = float(np.ptp(seen)) if seen.size else 0.0
        return None if travel < least else max(least, 0.5 * travel)
    grasped = [p.end for p in recording.phases if p.name == "grasp"]
    follows = any(p.start >= end - 1e-9 for p in recording.phases for end in grasped)
    return (least or None) if follows or not recording.phases else None
