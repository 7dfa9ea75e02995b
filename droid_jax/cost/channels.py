"""Which measured channels a fit compares, and the weights of several channels against each other.

Dependent channels must not be counted twice.  The torque of a position servo follows from its position and its command,
and a velocity is a differentiated position.  So torque is preferred to position, and position to velocity.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np

from droid_jax.cost.cost import Cost
from droid_jax.cost.observation import Measured
from droid_jax.cost.residuals import LEADING, CompareConfig, Comparison
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Channel, Recording

MOTIONS = ("position", "velocity")  # channels of the joints' motion, in the order of preference
SIMULATED = (LEADING, *MOTIONS, "object_angle")  # channels that a replay produces


def measured_channels(scene: Scene, recording: Recording) -> tuple[str, ...]:
    """Return the channels of a recording that its replay can be compared with.

    Such a channel is simulated, belongs to joints of the scene, and is not constant.  Along a measured motion (a log
    without commands) only torques are simulated.
    """
    names = SIMULATED if recording.command.size else SIMULATED[:1]
    present = [name for name in names if name in recording.channels]
    return tuple(name for name in present if _of_scene(scene, recording.channels[name]) and _varies(recording, name))


def informative_channels(scene: Scene, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the channels that are compared by default.

    They are measured in all recordings, and none of them is a function of another one.

    Raises:
        ValueError: the recordings have no channel in common that a replay produces.
    """
    each = {r.name: measured_channels(scene, r) for r in recordings}
    common = [name for name in SIMULATED if all(name in have for have in each.values())]
    if not common and all(LEADING in r.channels and _varies(r, LEADING) for r in recordings):
        return (LEADING,)  # its joints are not in the scene: `compared_columns` names them in its error
    if not common:
        have = "; ".join(f"{name!r}: {', '.join(channels) or 'none'}" for name, channels in each.items())
        raise ValueError(
            f"the recordings have no measured channel in common that a replay produces ({have}); a replay with "
            f"commands produces {', '.join(SIMULATED)} of the scene's joints, one along a measured motion torques. A "
            "channel that never changes does not count"
        )
    if LEADING in common:
        return (LEADING,)
    motion = [name for name in MOTIONS if name in common][:1]
    return (*motion, *(name for name in common if name == "object_angle"))


def chosen_channels(
    scene: Scene, recordings: Sequence[Recording], requested: Sequence[str] | None, compare: CompareConfig
) -> tuple[str, ...]:
    """Return the channels to compare whose weights still have to be set (`in_noise_units`).

    The result is empty where `compare` already states channels or weights other than the default.

    Args:
        scene: what is simulated.
        recordings: to be compared.
        requested: channel names in any order, which replace those of `compare`; None to choose automatically.
        compare: how simulation and measurement are compared.
    """
    if requested:
        return tuple(name for name in SIMULATED if name in requested)
    if compare.channels != CompareConfig().channels:
        return ()
    return informative_channels(scene, recordings)


def check_channels(recordings: Sequence[Recording], names: Iterable[str]) -> None:
    """Raise ValueError where a recording lacks a channel to be compared, or its replay does not produce it."""
    for recording in recordings:
        if absent := [name for name in names if name not in recording.channels]:
            raise ValueError(
                f"recording {recording.name!r} has no channel {', '.join(absent)} to compare; it has: "
                f"{', '.join(recording.channels)}"
            )
        prescribed = [name for name in names if name != LEADING]
        if prescribed and not recording.command.size:
            raise ValueError(
                f"recording {recording.name!r} holds no commands: along its measured motion only torques are "
                f"simulated, so {', '.join(prescribed)} cannot be compared"
            )


def in_noise_units(cost: Cost, at: np.ndarray) -> dict[str, float]:
    """Return the weight of each compared channel, the inverse of the standard deviation of its noise.

    With these weights a distance is in units of the noise.  The noise is the scatter of the repeats about their mean.
    It cannot be estimated from one repeat.  The residual at the values `at` [D] replaces it there, so that all channels
    have the same weight at the start of the fit.
    """
    rollouts = [jax.tree.map(_first, r) for r in cost.rollouts(at[None])]
    names = [c.name for c in cost.comparisons[0].channels]
    pairs = list(zip(cost.comparisons, rollouts, strict=True))
    return {name: float(1.0 / np.sqrt(np.mean([_noise(*pair, name) for pair in pairs]))) for name in names}


def _first(traces: Any) -> Any:
    return traces[0]


def _of_scene(scene: Scene, channel: Channel) -> bool:
    if channel.name == "object_angle":
        return scene.object_joint is not None and len(channel.columns) == 1
    return any(joint in scene.joints for joint in channel.columns)


def _varies(recording: Recording, name: str) -> bool:
    """Whether any column of a channel varies: a constant channel is no measurement."""
    channel = recording.channels[name]
    measured = np.where(channel.mask, channel.values, np.nan).reshape(-1, len(channel.columns))
    with np.errstate(all="ignore"):
        return bool(np.any(np.fmax.reduce(measured, axis=0) > np.fmin.reduce(measured, axis=0)))


def _noise(comparison: Comparison, rollout: Rollout, name: str) -> float:
    """Mean variance of a channel's noise over its columns, in its unit squared, at least `NoiseConfig.minimum`^2."""
    channel = comparison.channel(name)
    minimum = comparison.config.noise.minimum[name]
    if len(channel.values) > 1:
        return max(_scatter(channel), minimum**2)
    residual = channel.noise.mean - np.asarray(comparison.smoothed(rollout, name))
    measured = channel.noise.count > 0
    return max(float(np.sum(residual[measured] ** 2) / max(measured.sum(), 1)), minimum**2)


def _scatter(channel: Measured) -> float:
    """Variance of the repeats [N, T, C] about their mean, at the instants that two or more of them measured."""
    values, mask = np.where(channel.mask, channel.values, 0.0), channel.mask
    count = mask.sum(axis=0)
    deviation = np.where(mask & (count > 1), values - values.sum(axis=0) / np.maximum(count, 1), 0.0)
    degrees_of_freedom = float(np.maximum(count - 1, 0).sum())
    return float(np.sum(deviation**2) / degrees_of_freedom) if degrees_of_freedom else 0.0
