"""Evaluation of a fitted model on recordings: errors of its replays before and after the fit, in physical units.

    replays = evaluate_on(scene, space, recordings, before=space.mean, after=best)

Nothing is fitted, filtered or whitened, so a recording may be long.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from droid_jax.cost.channels import informative_channels, measured_channels
from droid_jax.cost.cost import check_read, followed, replay_clock
from droid_jax.cost.errors import (
    ChannelErrors,
    channel_errors,
    errors_json,
    mean_errors,
    of_scene,
    sample_of,
    simulated_channel,
    within,
)
from droid_jax.cost.residuals import CompareConfig
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.fields import check_space
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.recordings.recording import Channel, Recording, recordings_of
from droid_jax.simulate.batching import in_blocks
from droid_jax.simulate.compiled import check_variant, compiled_replay
from droid_jax.simulate.engine import choose_engine
from droid_jax.simulate.initial_state import check_weight, start_pose
from droid_jax.simulate.repeat_starts import own_starts
from droid_jax.storage import finite


@dataclass(frozen=True, eq=False)
class Replayed:
    """A recording and its replays at two parameter vectors.

    clock: [T] s, of the replays' rows on the recording's clock.  before, after: host arrays of one sample.
    errors: by channel.
    """

    recording: Recording
    clock: np.ndarray
    before: Rollout
    after: Rollout
    errors: dict[str, ChannelErrors]

    @property
    def blown_up(self) -> list[str]:
        """Which of the replays "before" and "after" blew up."""
        return [name for name in ("before", "after") if not bool(np.all(getattr(self, name).finite))]


def evaluate_on(
    scene: Scene,
    space: Space,
    recordings: Recording | Sequence[Recording],
    *,
    before: np.ndarray,
    after: np.ndarray,
    effects: Sequence[Effect] = (),
    engine: str = "mjx",
    config: CompareConfig | None = None,
) -> list[Replayed]:
    """Replay recordings open loop over their full length, at two parameter vectors.

    Measured torques without the weight of the links are left out of the errors, with a warning, if the joints carry
    weight in the simulation.

    Args:
        scene: what is simulated.
        space: meaning of the vectors.
        recordings: with at least one channel that their replay produces.
        before: [D], for example the initial means.
        after: [D] fitted values.
        effects: in the model in addition to the scene.
        engine: "mjx", "mujoco" (plain C), or "auto": `simulate.engine.choose_engine` chooses.
        config: how commands are replayed; None for the defaults.

    Returns:
        The replays and their errors, in the recordings' order.

    Raises:
        ValueError: a recording without any channel that its replay produces, or what `make_cost` refuses.
    """
    check_space(scene, space)
    check_read(scene, space, effects)
    config, rows = config or CompareConfig(), space.check(np.stack([before, after]))
    out: list[Replayed] = []
    recordings = recordings_of(recordings)
    if engine == "auto":
        engine = choose_engine(scene, space, recordings, effects).engine
    for given in recordings:
        recording, own = own_starts(given, config.start), variant_scene(scene, given.variant, given.name)
        check_variant(own, space, effects, given.name)
        informative_channels(scene, [recording])
        compared = _with_comparable_torques(own, recording, config)
        channels = dict.fromkeys(measured_channels(scene, compared), 1.0)
        follows = followed(own, recording, replace(config, channels=channels))
        replay = compiled_replay(engine, own, space, follows, effects, config.mj_step)
        rollouts, clock = in_blocks(replay, rows), replay_clock(recording, follows)
        pair = sample_of(rollouts, 0), sample_of(rollouts, 1)
        out.append(Replayed(recording, clock, *pair, channel_errors(scene, compared, clock, *pair)))
    return out


def _with_comparable_torques(scene: Scene, recording: Recording, config: CompareConfig) -> Recording:
    """The recording without torques that its replay cannot be compared with, if it has other channels."""
    if not recording.command.size or len(measured_channels(scene, recording)) < 2:
        return recording
    try:
        check_weight(scene, recording, start_pose(scene, recording, config.start))
    except ValueError as error:
        warnings.warn(f"torques are left out of the errors: {error}", stacklevel=3)
        return replace(recording, channels={k: c for k, c in recording.channels.items() if k != "torque"})
    return recording


def evaluation_json(replays: Sequence[Replayed], fitted: Sequence[str] = ()) -> dict[str, Any]:
    """Return the errors as plain data; fitted: sha256 of the recordings that the model was fitted to."""
    mean = mean_errors({r.recording.name: r.errors for r in replays})
    units = {name: e.unit for r in replays for name, e in r.errors.items()}
    return {
        "recordings": [
            {
                "name": r.recording.name,
                "sha256": r.recording.sha256,
                "repeats": r.recording.repeats,
                "duration": r.recording.duration,
                "fitted": r.recording.sha256 in fitted,
                "blown_up": r.blown_up,
            }
            for r in replays
        ],
        "errors": {r.recording.name: errors_json(r.errors) for r in replays},
        "mean_mae": {
            name: {"unit": units[name], "before": finite(pair[0]), "after": finite(pair[1])}
            for name, pair in mean.items()
        },
    }


def evaluation_traces(scene: Scene, replays: Sequence[Replayed]) -> dict[str, np.ndarray]:
    """Return measured and simulated channels over time for figures, with keys recording/channel/name."""
    out: dict[str, np.ndarray] = {}
    for replayed in replays:
        for channel in _channels(scene, replayed):
            lines = [simulated_channel(scene, channel, replayed.clock, r) for r in (replayed.before, replayed.after)]
            prefix = f"{replayed.recording.name}/{channel.name}"
            measured = np.where(channel.mask, channel.values, np.nan)
            with np.errstate(all="ignore"):
                low, high = np.fmin.reduce(measured, axis=0), np.fmax.reduce(measured, axis=0)
            count = np.maximum(channel.mask.sum(axis=0), 1)
            mean = np.where(channel.mask, channel.values, 0.0).sum(axis=0) / count
            out |= {
                f"{prefix}/time": channel.time,
                f"{prefix}/measured_mean": np.where(channel.mask.any(axis=0), mean, np.nan),
                f"{prefix}/measured_low": low,
                f"{prefix}/measured_high": high,
                f"{prefix}/before": lines[0],
                f"{prefix}/after": lines[1],
                f"{prefix}/joints": np.array(channel.columns),
            }
    return out


def _channels(scene: Scene, replayed: Replayed) -> Iterator[Channel]:
    for name in replayed.errors:
        yield within(of_scene(scene, replayed.recording.channels[name]), replayed.clock)
