"""Check for delayed commands, torques that stay at a limit, and torques without a sign."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding
from droid_jax.preflight.signals import LogMotion, servo_torque
from droid_jax.preflight.torques import EXPLAINED, MODEL_FACTOR, residual_share
from droid_jax.recordings.recording import Channel, Recording

DELAYS = np.arange(0.0, 0.205, 0.005)  # s, delays of the command that are tested
LEAST_DELAY = 0.02  # s; smaller delays are fitted as a nuisance anyway
DELAY_SPREAD = 0.015  # s within which the delays of all joints must lie, to both sides
DELAY_IMPROVEMENT = 0.5  # a delay must reduce the unexplained share below this factor
FEWEST_VALUES = 50  # columns with fewer different values are coarse: their largest value may be frequent
SAME_VALUE = 1e-4  # share of a column's span within which values are equal
LIMIT_SHARE = 0.01  # share of the samples that must be at a limit
ZERO_SHARE = 0.002  # the same for a limit of 0
FEWEST_IN_A_ROW = 5  # consecutive samples that must be at the limit


def check_delay(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """Finding for a delay of the commands, from the servo's torque at the tracking error."""
    joints = [j for j in motion.command if j in motion.position and j in motion.torque and j in scene.joints]
    best = []
    for joint in joints:
        unexplained = [
            residual_share(
                motion.torque[joint], [(servo_torque(scene, motion, joint, late), 1 / MODEL_FACTOR, MODEL_FACTOR)]
            )
            for late in DELAYS
        ]
        i = int(np.argmin(unexplained))
        if unexplained[i] < EXPLAINED and unexplained[i] < DELAY_IMPROVEMENT * unexplained[0] and i < len(DELAYS) - 1:
            best.append(float(DELAYS[i]))
    if not best or len(best) < 0.5 * len(joints) or np.ptp(best) > 2 * DELAY_SPREAD or np.median(best) < LEAST_DELAY:
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
    """Findings for torques that stay at their extreme value, as at a drive's limit, or at 0, as magnitudes do."""
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
                "at 0: is this a load register, which contains the drive's duty cycle and not a torque? If so, leave "
                "that column out and fit the positions",
            )
        )  # fmt: skip
    return found


def _limit(channel: Channel, column: int) -> tuple[float, float] | None:
    """The extreme value at which a column stays, and the share of samples there; None if there is none."""
    values = [v[m] for v, m in zip(channel.values[..., column], channel.mask[..., column], strict=True)]
    every = np.concatenate(values)
    if len(every) < 10 * FEWEST_VALUES or len(np.unique(every[:: max(1, len(every) // 20000)])) < FEWEST_VALUES:
        return None
    for limit in (every.max(), every.min()):
        at = [np.abs(v - limit) <= SAME_VALUE * np.ptp(every) for v in values]
        share = float(np.concatenate(at).mean())
        if share > (LIMIT_SHARE if limit else ZERO_SHARE) and _longest(at) >= FEWEST_IN_A_ROW:
            return float(limit), share
    return None


def _longest(flags: Sequence[np.ndarray]) -> int:
    """Largest number of consecutive True samples in any of the arrays."""
    runs = [np.diff(np.flatnonzero(np.concatenate([[True], ~f, [True]]))) - 1 for f in flags]
    return int(max((r.max(initial=0) for r in runs), default=0))
