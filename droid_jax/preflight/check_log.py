"""Check a recording against a scene: units, signs, order of the joints, gravity, clocks and repeats.

`check_log` compares the recording with predictions of the scene at its nominal values.  An alternative is reported
only if the recording as stated explains hardly any of the signal and the alternative nearly all of it, so a moderately
wrong model causes no finding.  Findings are printed and written into the results.  `refuse_certain` stops a fit that
would be meaningless.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Iterable
from dataclasses import replace

from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.preflight.clocks import check_clocks, check_stamps
from droid_jax.preflight.findings import Finding
from droid_jax.preflight.late_commands import check_delay, check_saturation
from droid_jax.preflight.repeats import check_repeats
from droid_jax.preflight.servo_balance import check_servo_balance
from droid_jax.preflight.signals import log_motion
from droid_jax.preflight.torques import check_torque
from droid_jax.preflight.tracking import check_tracking
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.servo_gains import with_stated_gains

_Found = weakref.WeakKeyDictionary[Scene, tuple[Finding, ...]]
_FOUND: weakref.WeakKeyDictionary[Recording, _Found] = weakref.WeakKeyDictionary()  # each is checked once


def check_log(scene: Scene, recording: Recording) -> tuple[Finding, ...]:
    """Probable errors of a recording in this scene, the most severe first.

    Args:
        scene: at its nominal values: masses within a factor of three, servo gains as on the robot. Gains that the
            recording states replace the scene's, as in its replay, and so do the numbers of its variant.
        recording: a valid one (`recordings.checks.validate`).

    Returns:
        The findings; empty if nothing is wrong, or if the measurements are too few for a check.
    """
    scene = variant_scene(scene, recording.variant, recording.name)
    known = _FOUND.setdefault(recording, weakref.WeakKeyDictionary())
    if scene not in known:
        found = [*check_alone(recording, clocks=False), *check_clocks(scene, recording)]
        motion = log_motion(scene, recording)
        if motion is not None:
            tracking = check_tracking(scene, recording, motion)
            found += tracking
            if not tracking:  # otherwise the motion, by which torques are checked, is wrong itself
                replayed = replace(scene, model=with_stated_gains(scene, recording))
                wrong = check_torque(replayed, recording, motion) or check_servo_balance(replayed, recording, motion)
                clocks = any(f.kind == "clock" and f.severity != "note" for f in found)
                found += wrong or ([] if clocks else check_delay(replayed, recording, motion))
        known[scene] = tuple(sorted(found, key=lambda finding: ("certain", "likely", "note").index(finding.severity)))
    return known[scene]


def check_alone(recording: Recording, *, clocks: bool = True) -> list[Finding]:
    """Findings that need no scene; clocks: whether time stamps are checked too."""
    found = [*check_repeats(recording), *_unused(recording), *check_saturation(recording)]
    return found + (check_stamps(recording) if clocks else [])


def _unused(recording: Recording) -> list[Finding]:
    """Note about set-points in the log that no replay uses."""
    fields = recording.meta.get("unused_setpoints", "")
    if not fields:
        return []
    sentence = (
        f"recording {recording.name!r}: its commands also had set-points of {fields}, which no replay uses: a servo "
        "that uses them lags less than its replay, and a fit explains that by damping, a delay or another gain"
    )
    return [Finding("unused", fields, 1.0, 0.0, "note", sentence)]


def refuse_certain(scene: Scene, recordings: Iterable[Recording]) -> None:
    """Raise ValueError for recordings with a finding of severity "certain", whose fit would be meaningless."""
    said = [f.sentence for recording in recordings for f in check_log(scene, recording) if f.severity == "certain"]
    if said:
        raise ValueError(
            f"{'; '.join(dict.fromkeys(said))}: a fit would be meaningless; `check` shows all findings. "
            "Correct the recording or the scene, or go on with --force"
        )


def warn_of_log(scene: Scene, recording: Recording) -> None:
    """Warn of each finding of `check_log`."""
    for finding in check_log(scene, recording):
        warnings.warn(finding.sentence, stacklevel=2)
