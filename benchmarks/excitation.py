"""Does a fit identify the parameters that `check --parameters` predicts, also with its proposed motion?

    python benchmarks/excitation.py [--quick] [--real DIR] [--out DIR]

Poor motions of a two-link arm (one joint at rest, slow, small, quick), recorded in C MuJoCo on arms with other masses,
damping, friction and armature.  For each, the check's prediction for nine parameters is compared with a fit.  The
proposed motion is then recorded on the same arm, and both motions are fitted.  The same is done for poor motions of a
Panda: logs without commands, with link-side torques, whose joint friction is fitted.  With --real DIR it is done for
the log of a real Panda (franka_gaz2019), which is also compared with the committed fit of experiments/real_panda.py.
That fit has another filter and other time blocks.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

# ruff: noqa: E402  (what is imported lies in a folder that is no package)
from droid_jax import runtime

runtime.tune()
# isort: split

import mujoco
import numpy as np
import tyro
from scipy import interpolate, signal

from benchmarks.check_cases import JOINTS, KP, RATE, measured, played, real, two_link
from benchmarks.common import publish
from droid_jax.cost.residuals import CompareConfig
from droid_jax.door.scene import panda_arm_scene
from droid_jax.identify.additions import MotionProposal, propose
from droid_jax.identify.excitation import Excitation, ExcitationConfig, excitation
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import IdentifyConfig, identify_parameters
from droid_jax.identify.search import CmaConfig
from droid_jax.model.fields import body_mass, joint_damping, joint_frictionloss, model_parameter, servo_scale
from droid_jax.model.joint_friction import joint_friction_space
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, ServoGains, TorqueConvention, TorqueSide

SECONDS = 8.0  # of a poor motion
MOTIONS = ("shoulder alone", "elbow alone", "slow", "small", "quick and small", "both")
PANDA = ("three joints", "slow", "small")  # motions of the Panda
PANDA_NOISE = (1e-5, 0.1)  # rad, N m
SMOOTH = 5.0  # Hz, up to which it follows a path
FITS = IdentifyConfig(
    search=CmaConfig(population=32, parents=None, generations=15),
    refine=RefineConfig(basin_hops=0),
    samples=0,
    checks=False,
)


@dataclass(frozen=True)
class Compared:
    """Compare the check's predictions for parameters with fits.

    real: folder of public logs.  quick: two motions of one arm, one of a Panda.  out: folder of excitation.json.
    seed: of the arms.  arms: number of arms; each makes every motion.
    """

    real: Path | None = None
    quick: bool = False
    out: Path = ROOT / "benchmarks" / "results"
    seed: int = 0
    arms: int = 1


def with_friction() -> Scene:
    """The two-link arm with a friction loss that can be fitted."""
    spec = two_link().spec.copy()
    for joint in spec.joints:
        joint.frictionloss = 0.02
    return compile_scene(spec, "arm", joints=JOINTS)


def space_of(scene: Scene) -> Space:
    """Nine parameters of the arm."""
    damping = [joint_damping(scene, j, std=1.0, high=20.0) for j in JOINTS]
    friction = [joint_frictionloss(scene, j, std=0.2, high=5.0) for j in JOINTS]
    rotor = [
        model_parameter(scene, "dof_armature", j, name=f"armature[{j}]", unit="kg m^2", std=0.05, high=1.0)
        for j in JOINTS
    ]
    return Space(
        (*damping, *friction, *rotor, body_mass(scene, "fore", std=0.3, high=5.0), servo_scale(scene, "elbow", std=0.1))
    )


def arm(scene: Scene, seed: int) -> mujoco.MjModel:
    """An arm with other numbers than the scene's."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(scene.spec.to_xml())
    factors = rng.uniform(0.8, 1.4, 2)
    model.body_mass[1:] *= factors
    model.body_inertia[1:] *= factors[:, None]
    model.dof_damping[:] *= rng.uniform(0.5, 1.5, 2)
    model.dof_armature[:] *= rng.uniform(0.7, 1.4, 2)
    model.dof_frictionloss[:] = rng.uniform(0.1, 0.5, 2)
    model.opt.timestep = 1.0 / (4 * RATE)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def motion(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """[K] s and [K, 2] rad of commands."""
    time = np.arange(0.0, SECONDS, 1.0 / RATE)
    quick = 3.0 if kind.startswith("quick") else 0.3 if kind == "slow" else 1.0
    size = 0.03 if "small" in kind else 0.4
    waves = np.stack([np.sin(2 * np.pi * 0.35 * quick * time), np.sin(2 * np.pi * 0.55 * quick * time)], axis=1)
    moving = np.array([kind != "elbow alone", kind != "shoulder alone"])
    return time, np.array([0.2, -0.5]) + size * np.clip(time, 0, 1)[:, None] ** 2 * waves * moving


def recorded(name: str, model: mujoco.MjModel, time: np.ndarray, command: np.ndarray, seed: int) -> Recording:
    """One repeat of torques and positions, with noise."""
    channels = measured(time, *played(model, command, command[0]), 1, np.random.default_rng(seed))
    start: dict[str, float] = {str(j): float(q) for j, q in zip(JOINTS, command[0], strict=True)}
    return Recording(
        name, time, command, JOINTS, channels, TorqueConvention(TorqueSide.MOTOR, gravity=True), qpos0=start,
        gains=ServoGains(KP, np.zeros(2)),
    )  # fmt: skip


def identifiable(
    scene: Scene, space: Space, recordings: Sequence[Recording], config: IdentifyConfig, judge: Sequence[Recording] = ()
) -> dict[str, bool]:
    """Identifiable parameters of a fit.

    judge: test recordings; by default the last third of a log without commands is held out.
    """
    found = identify_parameters(scene, space, recordings, config=config, judge_on=judge)
    return {t.name: t.identifiable for t in found.identifiability}


def said(found: Excitation) -> dict[str, bool]:
    """Identifiable parameters by the check."""
    return {t.name: t.identifiable for t in found.identifiability}


def of_arm(scene: Scene, space: Space, kind: str, seed: int) -> dict[str, Any]:
    """One poor motion of one arm."""
    model = arm(scene, seed)

    def record(name: str, clock: np.ndarray, command: np.ndarray, seed: int) -> Recording:
        return recorded(name, model, clock, command, seed)

    return of_motion(scene, space, kind, seed, record("poor", *motion(kind), seed), record, FITS)


Record = Callable[[str, np.ndarray, np.ndarray, int], Recording]


def of_motion(
    scene: Scene, space: Space, kind: str, seed: int, log: Recording, record: Record, fits: IdentifyConfig,
    judge: Sequence[Recording] = (),
) -> dict[str, Any]:  # fmt: skip
    """Check and fit of a poor log, and fit with the proposed motion in addition.

    record: (name, [K] s, [K, J] rad, seed) -> a recording of that motion on the same robot.
    """
    found = excitation(scene, space, [log])
    began = time.monotonic()
    proposal: MotionProposal = propose(scene, space, found, log)
    seconds = found.seconds + time.monotonic() - began
    fit = identifiable(scene, space, [log], fits, judge)
    row: dict[str, Any] = {
        "robot": scene.name, "motion": kind, "seed": seed, "seconds": seconds, "said": said(found), "fit": fit,
    }  # fmt: skip
    if proposal.chosen:
        clock, command = proposal.commands()
        after = identifiable(scene, space, [log, record("added", clock, command, seed + 1)], fits, judge)
        row |= {"added": [a.what for a in proposal.chosen], "added_s": proposal.seconds, "after": after}
        row["identifiable_by_it"] = list(proposal.opened)
    return row


def of_synthetic_panda(kind: str, seed: int) -> dict[str, Any]:
    """One poor motion of a Panda with other masses and with friction behind its gears, without commands."""
    scene = panda_arm_scene()
    space, rng = joint_friction_space(scene.joints), np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(scene.spec.to_xml())
    model.body_mass[1:] *= rng.uniform(0.98, 1.02, model.nbody - 1)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    viscous, coulomb, offset = (rng.uniform(low, high, 7) for low, high in ((0.1, 0.5), (0.1, 0.5), (-0.3, 0.3)))
    start = np.array([0.0, 0.2, 0.0, -1.8, 0.0, 1.6, 0.5])

    def record(name: str, clock: np.ndarray, path: np.ndarray, seed: int) -> Recording:
        rate, noise = 1.0 / float(np.median(np.diff(clock))), np.random.default_rng(seed)
        lowpass = signal.butter(2, SMOOTH, fs=rate, output="sos")
        followed = interpolate.make_interp_spline(clock, signal.sosfiltfilt(lowpass, path, axis=0), k=5)
        q, v, a = (followed.derivative(n)(clock) if n else followed(clock) for n in range(3))
        data, torque = mujoco.MjData(model), np.empty(q.shape)
        for k in range(len(clock)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
            mujoco.mj_inverse(model, data)
            torque[k] = data.qfrc_inverse + data.qfrc_passive - model.dof_armature * a[k]  # behind the gears
        torque = torque + viscous * v + coulomb * np.tanh(v / 1e-3) + offset
        columns = (("position", "rad", q, PANDA_NOISE[0]), ("torque", "N m", torque, PANDA_NOISE[1]))
        channels = {}
        for of, unit, clean, size in columns:
            values = (clean + noise.normal(0.0, size, clean.shape))[None]
            channels[of] = Channel(of, unit, scene.joints, clock, values, np.ones(values.shape, bool))
        convention = TorqueConvention(TorqueSide.LINK, gravity=True)
        return Recording(name, np.zeros(0), np.zeros((0, 0)), (), channels, convention, qpos0={})

    clock = np.arange(0.0, SECONDS, 0.01)
    quick, size = 0.3 if kind == "slow" else 1.0, 0.03 if kind == "small" else 0.4
    waves = np.sin(2 * np.pi * quick * np.linspace(0.3, 0.6, 7) * clock[:, None])
    moving = np.arange(7) < (3 if kind == "three joints" else 7)
    path = start + size * np.clip(clock, 0, 1)[:, None] ** 2 * waves * moving
    fits = replace(FITS, engine="mujoco")
    judge = [record("judge", clock, path, seed + 2)]
    return of_motion(scene, space, kind, seed, record("poor", clock, path, seed), record, fits, judge)


def of_panda(folder: Path) -> dict[str, Any] | None:
    """Check of the first two thirds of the Panda's log, with a fit of them and with the committed fit."""
    case = next((c for c in real(folder) if c.name == "panda/exciting"), None)
    if case is None:
        return None
    fitted = json.loads((ROOT / "experiments" / "results" / "real_panda.json").read_text())
    first, last = case.recording.span
    cut = first + (last - first) * 2 / 3
    log, judge = case.recording.window(first, cut), replace(case.recording.window(cut, last), name="last third")
    compare, space = CompareConfig(motion_cutoff=8.0), joint_friction_space(case.scene.joints)
    found = excitation(case.scene, space, [log], ExcitationConfig(compare=compare))
    fit = identifiable(case.scene, space, [log], replace(FITS, engine="mujoco", compare=compare), [judge])
    names = {p["name"]: bool(p["identifiable"]) for p in fitted["models"]["friction"]["parameters"]}
    return {"motion": "panda/exciting", "seconds": found.seconds, "said": said(found), "fit": fit, "committed": names}


def main(command: Compared) -> dict[str, Any]:
    """All motions; returns what is published."""
    scene = with_friction()
    space = space_of(scene)
    kinds, arms = (MOTIONS[:2], 1) if command.quick else (MOTIONS, command.arms)
    rows = list[dict[str, Any]]()
    for seed in range(command.seed, command.seed + arms):
        for kind in kinds:
            rows.append(of_arm(scene, space, kind, 10 * seed))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
        for kind in PANDA[:1] if command.quick else PANDA:
            rows.append(of_synthetic_panda(kind, 10 * seed))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return summary(rows, of_panda(command.real) if command.real is not None else None)


def summary(rows: list[dict[str, Any]], panda: dict[str, Any] | None) -> dict[str, Any]:
    """What is published of the motions, and of the Panda."""
    names = list(dict.fromkeys(row["robot"] for row in rows))
    result = {**_counted(rows), "robots": {name: _counted([r for r in rows if r["robot"] == name]) for name in names}}
    if panda is not None:
        result["panda"] = panda
        for of in ("fit", "committed"):
            result[f"panda_agreement_{of}"] = float(np.mean([panda["said"][n] == panda[of][n] for n in panda["said"]]))
    return {**result, "motions": rows}


def _counted(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts of agreement of check and fit, and the share of unidentifiable parameters that the addition identifies."""
    agreeing = [row["said"][n] == row["fit"][n] for row in rows for n in row["said"]]
    added = [row["after"][n] for row in rows if "after" in row for n in row["identifiable_by_it"]]
    missing = [(row, n) for row in rows for n, known in row["fit"].items() if not known]
    found = [row.get("after", row["fit"])[n] for row, n in missing]
    return {
        "parameters_judged": len(agreeing),
        "agreement": float(np.mean(agreeing)),
        "open_before": sum(not known for row in rows for known in row["said"].values()),
        "identifiable_by_addition": len(added),
        "addition_confirmed": float(np.mean(added)) if added else None,
        "open_in_fit": len(found),
        "identifiable_in_fit_with_addition": float(np.mean(found)) if found else None,
        "slowest_s": max(row["seconds"] for row in rows),
    }


if __name__ == "__main__":
    given = tyro.cli(Compared, description=__doc__)
    outcome = main(given)
    line = {key: value for key, value in outcome.items() if not isinstance(value, (list, dict))}
    publish(given.out, "excitation", given.quick, given.seed, outcome, line)
