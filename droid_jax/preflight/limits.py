"""Commands and measured torques beyond the limits of the scene's actuators: a replay cuts both off there."""

from __future__ import annotations

import mujoco
import numpy as np

from droid_jax.model.actuators import drives_joint
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.initial_state import sent_columns

ROUNDING = 1e-6  # of a range, by which a command may miss it
SLACK = 0.05  # of a torque limit: noise on top of a torque at its limit is none beyond it
RARE = 0.001  # share of the samples: torques beyond a limit more rarely are outliers


def clipped_commands(scene: Scene, recording: Recording) -> str:
    """What is to be known where commands lie beyond their actuators' ctrlrange; else empty."""
    model = scene.model
    if not recording.command.size or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return ""
    said = []
    for actuator, column in sent_columns(scene, recording).items():
        if not model.actuator_ctrllimited[actuator]:
            continue
        low, high = model.actuator_ctrlrange[actuator]
        sent, slack = recording.command[:, column], ROUNDING * (high - low)
        share = float(np.mean((sent < low - slack) | (sent > high + slack)))
        if share:
            name = scene.command_names[actuator]
            said.append(
                f"{name} in {_percent(share)} of the samples (they run {sent.min():.3g} .. {sent.max():.3g}, its range "
                f"{low:.3g} .. {high:.3g})"
            )
    if not said:
        return ""
    return (
        f"commands of recording {recording.name!r} leave the actuator's ctrlrange at {'; '.join(said)}: the replay "
        "cuts them off there; widen ctrlrange in the MJCF if the robot followed them"
    )


def exceeded_torques(scene: Scene, recording: Recording) -> str:
    """What is to be known where measured torques are larger than the scene's actuators can be; else empty."""
    channel = recording.channels.get("torque")
    if channel is None or not recording.command.size:
        return ""
    said = []
    for i, joint in enumerate(channel.columns):
        if joint not in scene.joints:
            continue
        low, high = torque_range(scene, joint)
        seen = channel.values[..., i][channel.mask[..., i]]
        share = (
            float(np.mean((seen < low - SLACK * abs(low)) | (seen > high + SLACK * abs(high)))) if seen.size else 0.0
        )
        if share > RARE:
            said.append(
                f"{joint} in {_percent(share)} of the samples (up to {np.abs(seen).max():.3g} {channel.unit}, limits "
                f"{low:.3g} .. {high:.3g})"
            )
    if not said:
        return ""
    return (
        f"measured torques of recording {recording.name!r} exceed what the actuators of scene {scene.name!r} can do "
        f"(forcerange, actuatorfrcrange) at {'; '.join(said)}: the replay cannot follow them; check the unit and the "
        "limits in the MJCF"
    )


def torque_range(scene: Scene, joint: str) -> tuple[float, float]:
    """Smallest and largest torque (N m, N of slides) that the scene's actuators can have at a joint of one degree.

    Infinite where one of them is not limited, or where one drives a tendon, a site or a body, whose lever is not known.
    """
    model, index = scene.model, scene.id("joint", joint)
    low = high = 0.0
    of_joint = drives_joint(model)
    if not of_joint.all():
        low, high = -np.inf, np.inf
    for actuator in np.flatnonzero(of_joint & (model.actuator_trnid[:, 0] == index)):
        ends = model.actuator_forcerange[actuator] * model.actuator_gear[actuator, 0]
        limited = bool(model.actuator_forcelimited[actuator])
        low, high = (low + min(ends), high + max(ends)) if limited else (-np.inf, np.inf)
    if model.jnt_actfrclimited[index]:
        low, high = max(low, float(model.jnt_actfrcrange[index, 0])), min(high, float(model.jnt_actfrcrange[index, 1]))
    driven = bool(np.any(of_joint & (model.actuator_trnid[:, 0] == index)))
    return (low, high) if driven else (-np.inf, np.inf)


def _percent(share: float) -> str:
    return "< 1 %" if share < 0.005 else f"{min(round(100 * share), 99 if share < 1 else 100)} %"
