"""Commands that take effect late, torques that stay at a limit, and torques that have no sign."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding
from droid_jax.preflight.signals import LogMotion, servo_torque
from droid_jax.preflight.torques import BOUND, GOOD, left_by
from droid_jax.recordings.recording import Channel, Recording

LATES = np.arange(0.0, 0.205, 0.005)  # s at which a command may take effect
VISIBLE = 0.02  # s: delays below are nuisances of every fit
APART = 0.015  # s within which the delays of joints are one
BETTER = 0.5  # share of what is left without the delay that a delay leaves
LEVELS = 50  # different values, below which a column is coarse and its largest one may be frequent
CLOSE = 1e-4  # of a column's span within which values are one
SHARE = 0.01  # of the samples that a limit must hold,
RESTS = 0.002  # and a column that never goes below its 0
RUN = 5  # samples in a row


def check_delay(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """A delay of the commands against the measurements, by the servo's torque at the tracking error."""
    joints = [j for j in motion.command if j in motion.position and j in motion.torque and j in scene.joints]
    best = []
    for joint in joints:
        left = [
            left_by(motion.torque[joint], [(servo_torque(scene, motion, joint, late), 1 / BOUND, BOUND)])
            for late in LATES
        ]
        i = int(np.argmin(left))
        if left[i] < GOOD and left[i] < BETTER * left[0] and i < len(LATES) - 1:
            best.append(float(LATES[i]))
    if not best or len(best) < 0.5 * len(joints) or np.ptp(best) > 2 * APART or np.median(best) < VISIBLE:
        return []
    late = float(np.median(best))
    return [
        Finding(
            "delay", "command", late, 0.0, "note",
            f"recording {recording.name!r}: the commands take effect about {1e3 * late:.0f} ms late, by the torque and "
            "the tracking error: fit a time_offset, or shift a clock if the log was put together out of two",
        )
    ]  # fmt: skip


def check_saturation(recording: Recording) -> list[Finding]:
    """Torques that stay at their largest value, as those of a driver at its limit do, or at 0, as magnitudes do."""
    channel = recording.channels.get("torque")
    if channel is None:
        return []
    found, unsigned = [], []
    for c, joint in enumerate(channel.columns):
        if (said := _limit(channel, c)) is not None:
            limit, share = said
            if limit == 0.0:
                unsigned.append(joint)
                continue
            found.append(
                Finding(
                    "saturation", joint, limit, 0.0, "note",
                    f"recording {recording.name!r}: the torque of {joint} stays at {limit:.4g} {channel.unit} in "
                    f"{100 * share:.0f} % of the samples: is the drive at its limit? Give the actuator that "
                    "forcerange in the MJCF",
                )
            )  # fmt: skip
    if unsigned:
        found.append(
            Finding(
                "sign", unsigned[0], 0.0, 0.0, "likely",
                f"recording {recording.name!r}: the torque of {', '.join(unsigned)} never changes its sign and rests "
                "at 0: is this a load register, the share that the drive puts out, and no torque? Leave that column "
                "out then, and fit the positions",
            )
        )  # fmt: skip
    return found


def _limit(channel: Channel, column: int) -> tuple[float, float] | None:
    """The value at which a column stays, and its share of the samples."""
    values = [v[m] for v, m in zip(channel.values[..., column], channel.mask[..., column], strict=True)]
    every = np.concatenate(values)
    if len(every) < 10 * LEVELS or len(np.unique(every[:: max(1, len(every) // 20000)])) < LEVELS:
        return None
    for limit in (every.max(), every.min()):
        at = [np.abs(v - limit) <= CLOSE * np.ptp(every) for v in values]
        share = float(np.concatenate(at).mean())
        if share > (SHARE if limit else RESTS) and _longest(at) >= RUN:
            return float(limit), share
    return None


def _longest(flags: Sequence[np.ndarray]) -> int:
    """Most samples in a row that are True."""
    runs = [np.diff(np.flatnonzero(np.concatenate([[True], ~f, [True]]))) - 1 for f in flags]
    return int(max((r.max(initial=0) for r in runs), default=0))
