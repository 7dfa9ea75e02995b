"""Mean absolute and RMS error of a replay against the measurement, for each channel and joint.

The replay is open loop over the whole motion.  The errors are in physical units, and nothing is filtered.
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

    unit: of all numbers.  joints: [C] names.  mae_*, rms_*: [C] mean absolute and root mean square of simulated minus
    measured values, over all measured samples of all repeats.
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
    """Return the errors of every measured channel of the scene's joints, by channel name.

    Args:
        scene: the simulated one.
        recording: the measurement, N repeats.
        clock: [T] s, times of the replay's rows on the recording's clock.
        before: the replay at the initial means, host arrays of one sample, [T, J].
        after: the same at the fitted values.

    Returns:
        Errors by channel name.  A channel is left out where a column has no measured sample during the replay.
    """
    out = dict[str, ChannelErrors]()
    for name in measured_channels(scene, recording):
        recorded = recording.channels[name]
        channel = within(of_scene(scene, recorded), clock)
        unit = channel_unit(scene, name, channel.columns, recorded.unit)
        errors = [simulated_channel(scene, channel, clock, r)[None] - channel.values for r in (before, after)]
        if not channel.mask.any(axis=(0, 1)).all():
            continue
        mae = [_mean(np.abs(e), channel.mask) for e in errors]
        rms = [np.sqrt(_mean(e**2, channel.mask)) for e in errors]
        numbers = [tuple(row.tolist()) for row in (*mae, *rms)]
        out[name] = ChannelErrors(unit, channel.columns, *numbers)
    return out


def of_scene(scene: Scene, channel: Channel) -> Channel:
    """Return a channel with the columns that the scene simulates; the object's angle stays unchanged."""
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
    """Return a channel with its samples inside the time `clock` [T] s of a replay."""
    inside = (channel.time >= clock[0] - 1e-9) & (channel.time <= clock[-1] + 1e-9)
    cut = {"time": channel.time[inside], "values": channel.values[:, inside], "mask": channel.mask[:, inside]}
    return replace(channel, **cut)


def channel_unit(scene: Scene, name: str, joints: Sequence[str], unit: str) -> str:
    """Return the unit of a channel of these joints, "rad or m" where hinges and slides are mixed.

    unit: what the recording states; it is returned for the object's angle.
    """
    if name == "object_angle":
        return unit
    if name == "torque":
        return scene.torque_unit(joints)
    position = scene.position_unit(joints)
    return position if name == "position" else " or ".join(f"{part}/s" for part in position.split(" or "))


def simulated_channel(scene: Scene, channel: Channel, clock: np.ndarray, rollout: Rollout) -> np.ndarray:
    """Return the simulated counterpart [Tc, C] of a channel of `of_scene`, at the channel's times."""
    if channel.name not in SIMULATED:
        raise ValueError(f"channel {channel.name!r} has no simulated counterpart; known: {', '.join(SIMULATED)}")
    trace = np.asarray(getattr(rollout, channel.name), np.float64)
    columns = [trace] if trace.ndim == 1 else [trace[:, scene.joints.index(joint)] for joint in channel.columns]
    return np.stack([np.interp(channel.time, clock, column) for column in columns], axis=1)


def sample_of(rollouts: Rollout, row: int) -> Rollout:
    """Return sample `row` of a batch of rollouts [P, ...]."""

    def of_row(traces: Any) -> Any:
        return traces[row]

    return jax.tree.map(of_row, rollouts)


def errors_json(errors: Mapping[str, ChannelErrors]) -> dict[str, Any]:
    """Return errors by channel as plain data, None where a replay blew up."""

    def plain(value: Any) -> Any:
        return [finite(v) if isinstance(v, float) else v for v in value] if isinstance(value, tuple) else value

    return {name: {key: plain(value) for key, value in asdict(of).items()} for name, of in errors.items()}


def mean_errors(errors: Mapping[str, Mapping[str, ChannelErrors]]) -> dict[str, tuple[float, float]]:
    """Return the mean absolute error before and after the fit, by channel.

    It is averaged over joints, then over the recordings that hold the channel.

    errors: by recording name, by channel name.
    """
    names = dict.fromkeys(name for of in errors.values() for name in of)
    pairs = {name: [of[name].mean_mae for of in errors.values() if name in of] for name in names}
    return {name: tuple(np.mean(rows, axis=0).tolist()) for name, rows in pairs.items()}


def _mean(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[C] mean of values [N, T, C] over the measured samples."""
    return np.where(mask, values, 0.0).sum(axis=(0, 1)) / mask.sum(axis=(0, 1))
