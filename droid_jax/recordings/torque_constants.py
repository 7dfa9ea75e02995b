"""Torques that were logged as motor currents, or as shares of the largest torque, in N m."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from droid_jax.recordings.recording import Recording

NOTE = "torque_constants"  # in `meta` of a recording whose torques were logged in another unit


def with_torque_constants(recording: Recording, constants: Sequence[float]) -> Recording:
    """The recording with its torques multiplied by what one unit of the log is in N m (N).

    Args:
        recording: whose channel `torque` holds another quantity, such as amperes.
        constants: N m (N) per unit, one for each column of the channel or one for all; negative ones turn the sign.

    Returns:
        The recording in N m (N); its `meta` says what was done.

    Raises:
        ValueError: for a recording without torques, another number of constants, or one that is zero or not finite.
    """
    if "torque" not in recording.channels:
        raise ValueError(f"recording {recording.name!r} has no channel 'torque' that torque constants could scale")
    channel = recording.channels["torque"]
    if len(constants) not in (1, len(channel.columns)):
        raise ValueError(
            f"recording {recording.name!r} has {len(channel.columns)} torques ({', '.join(channel.columns)}), got "
            f"{len(constants)} torque constants: give one for each, or one for all"
        )
    for constant in constants:
        if not np.isfinite(constant) or constant == 0:
            raise ValueError(f"a torque constant must be a finite number other than 0, got {constant:g}")
    scaled = replace(channel, values=channel.values * np.asarray(constants, channel.values.dtype))
    meta = {**recording.meta, NOTE: " ".join(f"{constant:g}" for constant in constants)}
    return replace(recording, channels={**recording.channels, "torque": scaled}, meta=meta)
