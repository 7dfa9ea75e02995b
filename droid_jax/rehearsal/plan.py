"""What is rehearsed: recordings as they were measured, or what the replay and a noise make of their commands."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from droid_jax.cost.channels import SIMULATED
from droid_jax.cost.cost import followed
from droid_jax.cost.errors import of_scene
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.recordings.time_scaling import TimeScaling, time_scaled
from droid_jax.rehearsal.linear import RehearsalConfig
from droid_jax.simulate.batching import in_blocks
from droid_jax.simulate.compiled import compiled_replay

RATE = 200.0  # Hz, of channels that nobody measured
SMOOTH = 0.1  # of the assumed noise, below which a channel of one repeat is taken to be no measurement
ColumnNoise = tuple[str, str, str, float, str]  # channel, column, unit, deviation of one sample, where it comes from


@dataclass(frozen=True)
class RehearsalPlan:
    """What is rehearsed.

    repeats: of each recording; None: as many as it holds.  noise: channel -> deviation of one sample, in its unit,
    stated.  values: parameter -> value where it stands; others at their means.  channels: to compare; None: the
    search's own choice.
    simulated: replace what was measured by what the replay and the noise make of the commands.
    """

    repeats: int | None = None
    noise: Mapping[str, float] | None = None
    values: Mapping[str, float] | None = None
    channels: tuple[str, ...] | None = None

    @property
    def simulated(self) -> bool:
        """Whether what was measured is replaced by what the replay and the noise make of the commands."""
        return self.repeats is not None or self.noise is not None


def simulated_channels(
    scene: Scene,
    space: Space,
    effects: Sequence[Effect],
    recording: Recording,
    values: np.ndarray,
    config: DiscrepancyConfig,
    engine: str = "mjx",
) -> Rollout:
    """What the replay makes of a recording's commands at values [D], without noise: one sample, host arrays [T, ...].

    Its times count from the recording's first command.  engine: "mjx", or "mujoco" for plain C (ValueError where it
    lacks something).
    """
    drive = followed(scene, recording, config.compare)
    replay = compiled_replay(engine, scene, space, drive, effects)
    rollout = jax.tree.map(lambda a: np.asarray(a)[0], in_blocks(replay, values[None]))
    if not bool(rollout.finite):
        raise ValueError(
            f"the simulation of {recording.name!r} blows up at the parameters' values: begin at other ones, or shorten "
            "the scene's time step"
        )
    return rollout


def sample_noise(channel: Channel) -> np.ndarray:
    """[C] deviation of a measured channel from row to row, as if it were white: of its second differences."""
    second = np.diff(np.where(channel.mask, channel.values, np.nan), n=2, axis=1)
    spread = np.nanmedian(np.abs(second).reshape(-1, second.shape[-1]), axis=0)
    return 1.4826 * np.nan_to_num(spread) / np.sqrt(6.0)


def scattered(channel: Channel) -> np.ndarray | None:
    """[N, T, C] deviations of the repeats from their mean where all was measured; None of one repeat."""
    if len(channel.values) < 2:
        return None
    values = np.where(channel.mask, channel.values, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # instants that nobody measured
        return np.nan_to_num(values - np.nanmean(values, axis=0))


def noisy(
    clean: np.ndarray,
    repeats: int,
    deviation: np.ndarray,
    apart: np.ndarray | None,
    rng: np.random.Generator,
    mix: np.ndarray,
) -> np.ndarray:
    """[N, T, C] a trace [T, C] with noise: what measured repeats [n, T, C] are apart, mixed anew, or white.

    mix: [N, n] of normal numbers; the mixture has the covariance of the measured repeats.
    """
    if apart is not None:
        return clean + np.einsum("nm,mtc->ntc", mix, apart) / np.sqrt(max(len(apart) - 1, 1))
    return clean + deviation * rng.normal(size=(repeats, *clean.shape))


def unit_of_simulated(scene: Scene, name: str, columns: Sequence[str]) -> str:
    """Of a channel that nobody measured."""
    if name == "torque":
        return scene.torque_unit(columns)
    return (
        "/s or ".join(scene.position_unit(columns).split(" or ")) + "/s"
        if name == "velocity"
        else scene.position_unit(columns)
    )


def possible_channels(scene: Scene, recording: Recording) -> tuple[str, ...]:
    """What a replay of a recording could be compared in."""
    if not recording.command.size:
        return ("torque",)
    seen = scene.object_joint is not None and scene.object_joint not in scene.joints
    return tuple(name for name in SIMULATED if name != "object_angle" or seen)


def column_noise(
    known: Channel | None, columns: int, stated: float | None, assumed: float
) -> tuple[np.ndarray, str, np.ndarray | None]:
    """[C] deviation of one sample, where it comes from, and [N, T, C] how repeats scatter where that is known.

    Stated before measured: by the repeats, else from row to row, unless a channel is as smooth as a command.
    """
    if stated is not None:
        return np.full(columns, stated), "stated", None
    apart = None if known is None else scattered(known)
    if apart is not None:
        return apart.std(axis=(0, 1)) * np.sqrt(len(apart) / (len(apart) - 1)), "repeats", apart
    deviation = np.zeros(columns) if known is None else sample_noise(known)
    if deviation.min() > SMOOTH * assumed:
        return deviation, "log, from row to row", None
    return np.full(columns, assumed), "assumed", None


def planned_recording(
    scene: Scene, recording: Recording, rollout: Rollout, plan: RehearsalPlan, config: RehearsalConfig, seed: int
) -> tuple[Recording, list[ColumnNoise]]:
    """A recording with every channel that a replay has, and the noise of each column.

    What was measured stays, unless the plan says otherwise; what was not is simulated, with the noise that was stated,
    measured or assumed.
    """
    rng = np.random.default_rng([seed, 11])
    repeats = plan.repeats or recording.repeats
    mix = rng.normal(size=(repeats, recording.repeats))
    channels, noise = dict[str, Channel](), list[ColumnNoise]()
    for name in possible_channels(scene, recording):
        measured = recording.channels.get(name)
        seen = None if measured is None else of_scene(scene, measured)
        known = seen if seen is not None and seen.columns else None
        stated = (plan.noise or {}).get(name) if plan.simulated or known is None else None
        columns = simulated_columns(scene, name) if known is None else known.columns
        deviation, source, apart = column_noise(known, len(columns), stated, config.noise[name])
        if known is not None and not plan.simulated:
            channels[name] = known
        else:
            trace = np.asarray(getattr(rollout, name), float).reshape(len(rollout.time), -1)
            which = [0] if name == "object_angle" else [scene.joints.index(c) for c in columns]
            begin, end = float(recording.time[0]), float(rollout.time[-1])
            time = begin + np.arange(0.0, end, 1.0 / RATE) if known is None else known.time
            clean = interpolate(time, begin + rollout.time, trace[:, which])
            values = noisy(clean, repeats, deviation, apart, rng, mix)
            unit = unit_of_simulated(scene, name, columns) if known is None else known.unit
            channels[name] = Channel(name, unit, columns, time, values, np.ones(values.shape, bool))
        noise += [(name, c, channels[name].unit, float(d), source) for c, d in zip(columns, deviation, strict=True)]
    others = {} if plan.simulated else {k: c for k, c in recording.channels.items() if k not in channels}
    return replace(recording, channels={**channels, **others}), noise


def simulated_columns(scene: Scene, name: str) -> tuple[str, ...]:
    """Of a channel that nobody measured."""
    return (str(scene.object_joint),) if name == "object_angle" else scene.joints


def noise_of_log(recording: Recording) -> list[ColumnNoise]:
    """The noise of a log whose windows or blocks stand for repeats: what fits leave of it counts, and this beside."""
    return [
        (name, column, channel.unit, float(deviation), "log, from row to row")
        for name, channel in recording.channels.items()
        if name in SIMULATED
        for column, deviation in zip(channel.columns, sample_noise(channel), strict=True)
    ]


def faster_motion(recording: Recording, factor: float) -> Recording:
    """A commanded recording whose motion is made faster and then stands still, as long as before."""

    def clock(new: np.ndarray, duration: float) -> np.ndarray:
        return np.minimum(factor * new, duration)

    return time_scaled(recording, TimeScaling(f"{recording.name}, {factor:g} times as fast", lambda d: d, clock))
