"""How far a replay is from what was measured: mean absolute and RMS error of each channel and joint, as measured.

Open loop over the whole motion, without filter, in physical units: the numbers that people know from their plots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np

from droid_jax.cost.channels import SIMULATED, measured_channels
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.storage import finite


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of one measured channel of one recording, before and after a fit; NaN where a replay blew up.

    unit: of all numbers.  joints: [C].  mae_*, rms_*: [C] mean absolute and root mean square of simulated less
    measured, over all repeats and samples that were measured.
    """

    unit: str
    joints: tuple[str, ...]
    mae_before: tuple[float, ...]
    mae_after: tuple[float, ...]
    rms_before: tuple[float, ...]
    rms_after: tuple[float, ...]

    @property
    def mean_mae(self) -> tuple[float, float]:
        """Mean absolute error over the joints, before and after the fit."""
        return float(np.mean(self.mae_before)), float(np.mean(self.mae_after))


def channel_errors(
    scene: Scene, recording: Recording, clock: np.ndarray, before: Rollout, after: Rollout
) -> dict[str, ChannelErrors]:
    """Errors by channel, of all that were measured of the scene's joints.

    Args:
        scene: the simulated one.
        recording: what was measured, N repeats.
        clock: [T] s, times of the replay's rows on the recording's clock.
        before: the replay at the initial means, host arrays of one sample, [T, J].
        after: at the fitted values.
    """
    found = dict[str, ChannelErrors]()
    for name in measured_channels(scene, recording):
        channel = recording.channels[name]
        kept = within(of_scene(scene, channel), clock)
        unit = channel_unit(scene, name, kept.columns, channel.unit)
        left = [simulated_channel(scene, kept, clock, rollout)[None] - kept.values for rollout in (before, after)]
        if not kept.mask.any(axis=(0, 1)).all():
            continue
        mae = [_mean(np.abs(e), kept.mask) for e in left]
        rms = [np.sqrt(_mean(e**2, kept.mask)) for e in left]
        numbers = [tuple(row.tolist()) for row in (*mae, *rms)]
        found[name] = ChannelErrors(unit, kept.columns, *numbers)
    return found


def of_scene(scene: Scene, channel: Channel) -> Channel:
    """A channel's columns that the scene simulates; the object's angle has one."""
    if channel.name == "object_angle":
        return channel
    columns = [i for i, joint in enumerate(channel.columns) if joint in scene.joints]
    return replace(
        channel,
        columns=tuple(channel.columns[i] for i in columns),
        values=channel.values[..., columns],
        mask=channel.mask[..., columns],
    )


def within(channel: Channel, clock: np.ndarray) -> Channel:
    """A channel's samples inside the time [T] s of a replay."""
    inside = (channel.time >= clock[0] - 1e-9) & (channel.time <= clock[-1] + 1e-9)
    cut = {"time": channel.time[inside], "values": channel.values[:, inside], "mask": channel.mask[:, inside]}
    return replace(channel, **cut)


def channel_unit(scene: Scene, name: str, joints: Sequence[str], unit: str) -> str:
    """Unit of a channel of these joints in this scene, "rad or m" where some of them slide; `unit` of an object's."""
    if name == "object_angle":
        return unit
    if name == "torque":
        return scene.torque_unit(joints)
    position = scene.position_unit(joints)
    return position if name == "position" else " or ".join(f"{part}/s" for part in position.split(" or "))


def simulated_channel(scene: Scene, channel: Channel, clock: np.ndarray, rollout: Rollout) -> np.ndarray:
    """[Tc, C] the simulated counterpart of a channel of `of_scene`, at the channel's times."""
    if channel.name not in SIMULATED:
        raise ValueError(f"channel {channel.name!r} has no simulated counterpart; known: {', '.join(SIMULATED)}")
    trace = np.asarray(getattr(rollout, channel.name), np.float64)
    columns = [trace] if trace.ndim == 1 else [trace[:, scene.joints.index(joint)] for joint in channel.columns]
    return np.stack([np.interp(channel.time, clock, column) for column in columns], axis=1)


def sample_of(rollouts: Rollout, row: int) -> Rollout:
    """One sample of a batch [P, ...]."""

    def of(traces: Any) -> Any:
        return traces[row]

    return jax.tree.map(of, rollouts)


def errors_json(errors: Mapping[str, ChannelErrors]) -> dict[str, Any]:
    """Errors by channel as plain data, None where a replay blew up."""

    def plain(value: Any) -> Any:
        return [finite(v) if isinstance(v, float) else v for v in value] if isinstance(value, tuple) else value

    return {name: {key: plain(value) for key, value in asdict(of).items()} for name, of in errors.items()}


def mean_errors(errors: Mapping[str, Mapping[str, ChannelErrors]]) -> dict[str, tuple[float, float]]:
    """By channel the mean absolute error before and after, over joints and then over the recordings that hold it.

    errors: by recording, by channel.
    """
    names = dict.fromkeys(name for of in errors.values() for name in of)
    pairs = {name: [of[name].mean_mae for of in errors.values() if name in of] for name in names}
    return {name: tuple(np.mean(rows, axis=0).tolist()) for name, rows in pairs.items()}


def _mean(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[C] mean of values [N, T, C] over what was measured."""
    return np.where(mask, values, 0.0).sum(axis=(0, 1)) / mask.sum(axis=(0, 1))
