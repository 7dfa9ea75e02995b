"""What does a model of a real Panda lack that has only rigid bodies, viscous friction and offsets?

    python experiments/gap_panda.py --data DIR            # about an hour on two cores, most of it false alarms
    python experiments/gap_panda.py --data DIR --quick    # does it all work?

The base model is the bare arm: link masses (3 %) and centres of mass (5 mm) as nuisances, viscous friction and a
constant offset in every joint.  Dry friction in every joint is published for this log.  There is one log without
repeats: the search of `discrepancy.log_case` runs on the first two thirds.  The last third, which repeats a fitted
motion, is the test data.

Friction in one joint is about a seventh of what is missing, and an effect must explain a fifth of the gap.  Every
effect of a joint is therefore also a candidate in all joints at once, with an amplitude for each joint.  The intervals
of the amplitudes show in which joints it is present.

The residual of joint 2 is mostly gravity and inertia, not friction: the search should leave it unexplained.
Data and filter: see real_panda.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gap_single import (
    adding,
    answer,
    as_known,
    false_alarms,
    make_search,
    names_one_of,
    report,
    run_search,
    settings,
    show,
    silent_about,
)

# isort: split
import numpy as np
import tyro
from inverse_fit import RESULTS, rounded, run
from real_panda import MOTION_CUTOFF, SOURCE, link_nuisances, load_panda, load_published

from benchmarks.common import publish, stem
from droid_jax.discrepancy.candidates import observable_effects
from droid_jax.door.scene import ARM, panda_arm_scene
from droid_jax.model.effect_interface import Effect
from droid_jax.model.joint_friction import joint_friction_space
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

NOT_ASKED = ("torque_bias", "payload")  # the base has offsets and the last link's mass
NINETY = 1.645  # deviations from which on zero is outside of a 90 % interval
EVERYWHERE = "all joints"
FOUND = "joint_coulomb"
ADDED = {
    "torque_ripple": {"ripple_sine[panda_joint4]": 0.6, "ripple_periods": 24.0},  # N m
    "cable_pull": {"cable_stiffness[panda_joint3]": 1.5},  # N m/rad
}


@dataclass(frozen=True)
class GapPanda:
    """Search the Panda's log for what rigid bodies lack.

    data: folder with panda_exciting_traj1.npz and reference_values.json.
    out: folder for gap_panda.json.
    quick: no controls and two synthetic logs, too few to report false alarms.
    cases: synthetic logs with nothing missing.
    seed: of flips, resamples and synthetic logs.
    """

    data: Path
    out: Path = RESULTS
    quick: bool = False
    cases: int = 100
    seed: int = 0


def base_space(scene: Scene) -> Space:
    """Viscous friction and offset of every joint, masses and centres of the links."""
    friction = joint_friction_space(scene.joints)
    return friction.select([n for n in friction.names if not n.startswith("coulomb")]) + link_nuisances(scene)


def asked_about(scene: Scene, recording: Recording) -> list[Effect]:
    """The effects of the library that the log can show, joint by joint and in all joints at once."""
    return [_everywhere(e) for e in observable_effects(scene, [recording]) if e.name not in NOT_ASKED]


def _everywhere(effect: Effect) -> Effect:
    if len(effect.locations) < len(ARM):
        return effect
    amplitudes = tuple(a for place in effect.locations.values() for a in place)
    return replace(effect, locations={**effect.locations, EVERYWHERE: amplitudes})


def by_joint(found: Mapping[str, Any], published: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """Dry friction of each joint beside the published value, and the remaining share of the torque error."""
    values, sealed = found["values"], found["rms"]["test"]
    out = []
    for j, joint in enumerate(ARM):
        entry = values.get(f"{FOUND}[{joint}]")
        ratio = sealed["after"][j] / sealed["before"][j]
        out.append(
            {
                "joint": joint,
                "coulomb_Nm": round(entry["value"], 4) if entry else None,
                "interval_Nm": entry["interval"] if entry else None,
                "named_here": entry is not None and entry["value"] > NINETY * entry["deviation"],
                "published_OSI_Nm": published["fc_OSI"][j],
                "published_CLS_Nm": published["fc_CLS"][j],
                "test_rms_left": round(ratio, 3),
            }
        )
    return out


def of_joints(found: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The gap by joint, before and after."""
    return [cell for cell in found["where"] if cell["axis"] == "phase"]


def main(config: GapPanda) -> None:
    """Four questions about one log; see gap_single.py."""
    scene, recording = panda_arm_scene(), load_panda(config.data)
    published, gap = load_published(config.data), settings(MOTION_CUTOFF, config.seed)
    effects = asked_about(scene, recording)
    known = [as_known(e) for e in effects if e.name == FOUND]
    searches = {
        "rigid": make_search(scene, base_space(scene), effects, [recording], gap),
        "dry": make_search(scene, base_space(scene), effects, [recording], gap, known),
    }
    case, verdict = run_search(searches["rigid"])
    found = {"rigid": report(case, verdict)}
    show("rigid", found["rigid"])
    found["dry"] = answer(searches["dry"])
    show("dry", found["dry"])
    added = {}
    for effect, amplitudes in {} if config.quick else ADDED.items():
        log = searches["dry"].log
        added[effect] = {"added": amplitudes, **answer(searches["dry"], adding(log, log.space.mean, amplitudes))}
        show(f"{effect} added", added[effect])
    logs = config.out / stem("gap_panda_logs", config.quick)
    alarms = false_alarms(searches["rigid"], verdict, 2 if config.quick else config.cases, config.seed, logs)
    print(f"  false alarms: {alarms['said_to_be_missing']}, named {alarms['named']}")
    joints = by_joint(found["rigid"], published)
    for row in joints:
        print(f"  {row}")
    sealed = found["rigid"]["rms"]["test"]
    most_left = max(of_joints(found["rigid"]), key=lambda cell: cell["after"])["joint"]
    result = {
        "experiment": "gap_panda",
        "quick": config.quick,
        "source": SOURCE,
        "recording": recording.sha256,
        "caveat": "the commanded motion has a period of 13.3 s: the sealed part repeats a fitted motion",
        "searches": found,
        "joints": joints,
        "added": added,
        "false_alarms": alarms,
        "targets": {
            "dry_friction_named": f"{FOUND} at {EVERYWHERE}" in found["rigid"]["effects"],
            "in_joints": [row["joint"] for row in joints if row["named_here"]],
            "test_third_better_in_joints": int(np.sum(np.less(sealed["after"], sealed["before"]))),
            "test_rms_ratio": rounded(np.divide(sealed["after"], sealed["before"]), 3),
            "joint_2_left_open": found["rigid"]["verdict"] == "partly explained" and most_left == "panda_joint2",
            "dry_friction_not_named_again": silent_about(
                found["dry"], ("joint_coulomb", "joint_stribeck", "joint_directional", "load_friction")
            ),
            "added_found": {effect: names_one_of(a, [effect]) for effect, a in added.items()},
        },
    }
    publish(config.out, "gap_panda", config.quick, config.seed, result)


if __name__ == "__main__":
    run(lambda: main(tyro.cli(GapPanda, description=__doc__)))
