"""Units in which logs hold joint angles, speeds and torques, as factors to the units of a recording.

A recording holds rad, rad/s and N m (m, m/s and N for slides).  A log may hold degrees, encoder counts, a share of the
joint's travel or a motor current.  `with_torque_constants` converts currents to torques in a recording whose channel
`torque` was read as currents.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from droid_jax.errors import named
from droid_jax.recordings.recording import Recording

NOTE = "torque_constants"  # in `meta` of a recording whose torques were logged in another unit
TURN = 2.0 * math.pi
COUNTS = ("counts", "counts/s")  # per turn of the encoder: `counts_per_turn`
NORMALISED = {"normalised": (-100.0, 100.0), "percent": (0.0, 100.0)}  # of the joint's travel: `range`
CURRENTS = {"A": 1.0, "mA": 1e-3, "V": 1.0, "%": 1.0}  # converted to torques with `torque_constant`

# kind of a channel -> unit -> factor, of hinges and of slides
_ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": TURN / 360.0, "turn": TURN, "counts": TURN}
_SPEED = {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": TURN / 360.0, "turn/s": TURN, "rpm": TURN / 60.0, "counts/s": TURN}
_TORQUE = {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2, "kgf cm": 0.0980665}
HINGES = {
    "position": {**_ANGLE, **dict.fromkeys(NORMALISED, 1.0)},
    "velocity": _SPEED,
    "torque": {**_TORQUE, **CURRENTS},
}
SLIDES = {
    "position": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, **dict.fromkeys(NORMALISED, 1.0)},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "torque": {"N": 1.0, "mN": 1e-3, "kN": 1e3, **CURRENTS},
}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
KINDS = {
    "command": "position",
    "position": "position",
    "object_angle": "position",
    "velocity": "velocity",
    "torque": "torque",
}


def unit_factor(kind: str, unit: str, slides: bool, where: str) -> float:
    """One unit in the units of a recording; for counts and currents, without their constant.

    Args:
        kind: "position", "velocity" or "torque".
        unit: as a map states it.
        slides: whether the joint slides.
        where: beginning of the message.

    Raises:
        ValueError: there is no such unit of this kind.
    """
    known = (SLIDES if slides else HINGES)[kind]
    if unit not in known:
        of = "a joint that slides" if slides else "a hinge"
        raise ValueError(f"{where}: {unit!r} is no unit of the {kind} of {of}; known are: {named(known)}")
    return known[unit]


def with_torque_constants(recording: Recording, constants: Sequence[float]) -> Recording:
    """The recording with its torques multiplied by the torque constants.

    Args:
        recording: its channel `torque` holds another quantity, such as amperes.
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
