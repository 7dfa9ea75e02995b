"""Which measured channels a fit compares, and how several weigh against each other.

What a channel tells beside another one counts once: a position servo's torque follows from its position and command,
and a velocity is a position differentiated.  So torque goes before position, and position before velocity.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np

from droid_jax.cost.cost import Cost
from droid_jax.cost.observation import Measured
from droid_jax.cost.residuals import LEADS, CompareConfig, Comparison
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Channel, Recording

MOTIONS = ("position", "velocity")  # the first that was measured says how the joints move
SIMULATED = (LEADS, *MOTIONS, "object_angle")  # channels that a replay produces


def measured_channels(scene: Scene, recording: Recording) -> tuple[str, ...]:
    """Channels of a recording that its replay can be compared with: simulated, of the scene's joints, and not dead.

    Along a measured motion (a log without commands) only torques are simulated.
    """
    names = SIMULATED if recording.command.size else SIMULATED[:1]
    there = [name for name in names if name in recording.channels]
    return tuple(name for name in there if _of_scene(scene, recording.channels[name]) and _alive(recording, name))


def informative_channels(scene: Scene, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """The channels that are compared unless somebody says otherwise: of those that all recordings hold, what is no
    function of another one.

    Raises ValueError where the recordings have no channel in common that a replay produces.
    """
    each = {r.name: measured_channels(scene, r) for r in recordings}
    common = [name for name in SIMULATED if all(name in have for have in each.values())]
    if not common and all(LEADS in r.channels and _alive(r, LEADS) for r in recordings):
        return (LEADS,)  # of joints that the scene does not have: what compares them says which
    if not common:
        have = "; ".join(f"{name!r}: {', '.join(channels) or 'none'}" for name, channels in each.items())
        raise ValueError(
            f"the recordings have no measured channel in common that a replay produces ({have}); a replay with "
            f"commands produces {', '.join(SIMULATED)} of the scene's joints, one along a measured motion torques. A "
            "channel that never changes does not count"
        )
    if LEADS in common:
        return (LEADS,)
    motion = [name for name in MOTIONS if name in common][:1]
    return (*motion, *(name for name in common if name == "object_angle"))


def chosen_channels(
    scene: Scene, recordings: Sequence[Recording], asked: Sequence[str] | None, compare: CompareConfig
) -> tuple[str, ...]:
    """The channels to compare, whose weights are then to be found (`in_noise_units`); none where `compare` states its
    own.

    asked: names, in any order; None: those of `compare` where it names other ones, or weights, than its default, else
    what is informative.
    """
    if asked:
        return tuple(name for name in SIMULATED if name in asked)
    if compare.channels != CompareConfig().channels:
        return ()
    return informative_channels(scene, recordings)


def check_channels(recordings: Sequence[Recording], names: Iterable[str]) -> None:
    """Raise ValueError where a recording lacks a channel that is to be compared, or its replay does not produce it."""
    for recording in recordings:
        if absent := [name for name in names if name not in recording.channels]:
            raise ValueError(
                f"recording {recording.name!r} has no channel {', '.join(absent)} to compare; it has: "
                f"{', '.join(recording.channels)}"
            )
        prescribed = [name for name in names if name != LEADS]
        if prescribed and not recording.command.size:
            raise ValueError(
                f"recording {recording.name!r} holds no commands: along its measured motion only torques are "
                f"simulated, so {', '.join(prescribed)} cannot be compared"
            )


def in_noise_units(cost: Cost, at: np.ndarray) -> dict[str, float]:
    """Weight of each compared channel by which a distance is in units of its noise: one over the noise's deviation.

    It is the repeats' scatter about their mean.  One repeat does not tell its noise: what the values `at` [D] leave
    stands in for it, which weighs the channels alike where the fit begins.
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


def _alive(recording: Recording, name: str) -> bool:
    """Whether anything in a channel changes: a channel of zeros is no measurement."""
    channel = recording.channels[name]
    seen = np.where(channel.mask, channel.values, np.nan).reshape(-1, len(channel.columns))
    with np.errstate(all="ignore"):
        return bool(np.any(np.fmax.reduce(seen, axis=0) > np.fmin.reduce(seen, axis=0)))


def _noise(comparison: Comparison, rollout: Rollout, name: str) -> float:
    """Mean square of a channel's noise over its columns, in its unit squared, and never below what is believed."""
    channel = comparison.channel(name)
    least = comparison.config.noise.minimum[name]
    if len(channel.values) > 1:
        return max(_scatter(channel), least**2)
    left, seen = channel.noise.mean - np.asarray(comparison.smoothed(rollout, name)), channel.noise.count > 0
    return max(float(np.sum(left[seen] ** 2) / max(seen.sum(), 1)), least**2)


def _scatter(channel: Measured) -> float:
    """Variance of the repeats [N, T, C] about their mean, over what two or more of them measured."""
    values, mask = np.where(channel.mask, channel.values, 0.0), channel.mask
    count = mask.sum(axis=0)
    off = np.where(mask & (count > 1), values - values.sum(axis=0) / np.maximum(count, 1), 0.0)
    freedom = float(np.maximum(count - 1, 0).sum())
    return float(np.sum(off**2) / freedom) if freedom else 0.0
