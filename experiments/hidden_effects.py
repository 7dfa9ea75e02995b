"""Does the search for a missing effect find what was hidden?  Development cases on a cheap scene; NOT the blind suite.

    python experiments/hidden_effects.py [--quick] [--out DIR] [--effects magnetic_catch closer ...]

The stand-in (plain C MuJoCo, another time step, nuisances, its own formulas) records two demonstrations of
an arm of two links and a servo-driven door with one effect hidden; the search gets the recordings alone.
Truths are known while the method is still being changed, so these figures tune it and prove nothing.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import origin  # noqa: E402
from droid_jax.gap.case import make_case  # noqa: E402
from droid_jax.gap.floor import numerical_floor  # noqa: E402
from droid_jax.gap.workflow import base_fit, find  # noqa: E402
from droid_jax.measure.hidden import record_hidden  # noqa: E402
from droid_jax.measure.recording import Recording, TorqueConvention, TorqueSide  # noqa: E402
from droid_jax.model.door import time_offset, torque_offsets  # noqa: E402
from droid_jax.model.effects.registry import library, ready  # noqa: E402
from droid_jax.model.fields import (  # noqa: E402
    body_mass,
    joint_damping,
    joint_frictionloss,
    joint_stiffness,
    servo_scale,
)
from droid_jax.model.parameters import Space  # noqa: E402
from droid_jax.model.scene import Scene, compile_scene  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402

# hidden name -> names in the library that are right
RIGHT: dict[str, tuple[str, ...]] = {
    "hinge_preload": ("hinge_preload", "tilted_frame"),
    "binding_spring": ("hardening_spring",),
    "over_centre": ("over_centre_spring",),
    "magnetic_catch": ("latch",),
    "closer": ("door_closer",),
    "opening_check": ("opening_check",),
    "air_drag": ("drag",),
    "tilted_frame": ("tilted_frame", "hinge_preload"),
    "torque_gain": ("torque_gain",),
    "detent": (),
    "gasket": (),
    "neighbour_door": (),
}
AMPLITUDES = {
    "hinge_preload": 0.4, "binding_spring": 1.0, "over_centre": 1.0, "magnetic_catch": 1.0, "closer": 2.0,
    "opening_check": 3.0, "air_drag": 1.0, "tilted_frame": 0.05, "torque_gain": 0.05, "detent": 0.5, "gasket": 0.5,
    "neighbour_door": 1.0,
}  # fmt: skip
SECONDS = 8.0


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Nothing hidden, and one effect."""
    out: Path = ROOT / "runs" / "hidden_effects"
    """Folder of the cases, one JSON each; what is there is not run again."""
    effects: tuple[str, ...] = ()
    """Hidden effects to try; default: nothing hidden, and all there are amplitudes for."""


def bench() -> Scene:
    """The cheap scene, with rows for every friction that an effect may raise."""
    spec = mujoco.MjSpec.from_file(str(Path(__file__).parent / "bench.xml"))
    return ready(compile_scene(spec, "bench", object_joint="door"))


def base_space(scene: Scene) -> Space:
    """What is fitted without any effect, nuisances included."""
    return Space(
        (
            body_mass(scene, "forearm", std=0.2, high=3.0),
            joint_damping(scene, "shoulder", std=0.5, high=20.0),
            joint_damping(scene, "elbow", std=0.5, high=20.0),
            joint_frictionloss(scene, "elbow", std=0.1, high=2.0),
            joint_damping(scene, "door", std=0.3, high=10.0),
            joint_frictionloss(scene, "door", std=0.1, high=3.0),
            joint_stiffness(scene, "door", std=0.3, high=10.0),
            *(servo_scale(scene, j, nuisance=True, std=0.03) for j in scene.joints),
            time_offset(),
            *torque_offsets(scene.joints),
        )
    )


def demonstration(name: str) -> Recording:
    """Two motions that open and close at two speeds; they differ in speed and reach."""
    t = np.arange(0.0, SECONDS, 0.002)
    if name == "fit":
        fast, slow = 0.45 * (1 - np.cos(2 * np.pi * t / 3)), 0.45 * (1 - np.cos(2 * np.pi * (t - 3) / 5))
        door = np.where(t < 3, fast, slow)
        arm = [0.6 * np.sin(1.2 * t), 0.8 * np.sin(2.0 * t) + 0.2 * np.sin(0.7 * t)]
    else:
        door = 0.35 * (1 - np.cos(2 * np.pi * t / 4))
        arm = [0.5 * np.sin(0.9 * t), 0.6 * np.sin(1.5 * t) - 0.3 * np.sin(0.5 * t)]
    joints = ("shoulder", "elbow", "door")
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    return Recording(name, t, np.stack([*arm, door], axis=1), joints, {}, convention, qpos0=dict.fromkeys(joints, 0.0))


def run_case(name: str) -> dict[str, Any]:
    """Hide, record, search, score."""
    scene = bench()
    base = base_space(scene)
    rng = np.random.default_rng(sorted([*AMPLITUDES, "none"]).index(name))
    nuisance = base.nuisance
    truth_values = np.clip(rng.normal(base.mean, np.where(nuisance, base.std, 0.5 * base.std)), base.low, base.high)
    truth = dict(zip(base.names, truth_values.tolist(), strict=True))
    hidden = {} if name == "none" else {name: AMPLITUDES[name]}
    recordings = [
        record_hidden(scene, demonstration(n), truth, hidden, seed=int(rng.integers(1 << 30)), name=n, space=base)
        for n in ("fit", "confirm")
    ]
    began = time.monotonic()
    fit, confirm = recordings
    case = make_case(scene, base, library(scene), fit, confirm)
    model = base_fit(case, lambda stage, value: None)
    verdict = find(case, model, numerical_floor(case.fit, model, fit))
    effects = [e.split(" at ")[0] for e in verdict.effects]
    rivals = [[r.split(" at ")[0] for r in rs] for rs in verdict.tied]
    return {
        "hidden": hidden,
        "verdict": verdict.kind.value,
        "sentence": verdict.sentence,
        "effects": list(verdict.effects),
        "tied": [list(t) for t in verdict.tied],
        "right": score(name, verdict.kind.value, effects, rivals),
        "gaps": {k: list(v) for k, v in verdict.gaps.items()},
        "floor": verdict.floor,
        "p": verdict.screens[0].p if verdict.screens else None,
        "converged": model.refined.converged,
        "seconds": time.monotonic() - began,
    }


def score(name: str, verdict: str, effects: list[str], rivals: list[list[str]]) -> bool:
    """Nothing for nothing; no clean name for what no library holds; else only right names, ties included."""
    if name == "none":
        return verdict == "none"
    if not RIGHT[name]:
        return verdict in ("unexplained", "partly explained")
    named = [{e, *r} for e, r in zip(effects, rivals, strict=True)]
    return bool(named) and all(n & set(RIGHT[name]) for n in named)


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    names = arguments.effects or (("none", "closer") if arguments.quick else ("none", *AMPLITUDES))
    unknown = [n for n in names if n != "none" and n not in AMPLITUDES]
    if unknown:
        raise SystemExit(f"error: unknown effects {', '.join(unknown)}; valid: none, {', '.join(AMPLITUDES)}")
    results = {}
    for name in names:
        path = arguments.out / f"{name}.json"
        if not path.is_file():
            write_json(path, {**origin(0), **run_case(name)})
        results[name] = json.loads(path.read_text())
        print(f"{name}: {results[name]['sentence']} ({results[name]['seconds']:.0f} s)", flush=True)
    print(json.dumps({"cases": len(results), "right": sum(r["right"] for r in results.values())}))


if __name__ == "__main__":
    main()
