"""Dry friction at rest: are values right and no effects named falsely in logs with nothing missing?

    python experiments/friction_at_rest.py --out DIR            # 100 seeds; about an hour on two cores
    python experiments/friction_at_rest.py --out DIR --quick    # two seeds

Each seed draws a hinge with gravity and dry friction of 0.02 to 0.5 N m that moves, reverses and holds, and records
two logs of 60 s without commands.  Even seeds integrate the set-valued law of friction exactly (Moreau's time stepping,
written here, no MuJoCo); odd ones are plain C MuJoCo, whose soft friction creeps where it should hold.  `identify` fits
damping, friction and armature to the first log, `find_missing_effects` searches both.  One JSON file
per seed is written under OUT/seeds.  A stopped run can be continued, and several processes can share the seeds.
"""

from __future__ import annotations

import sys
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
from benchmarks.sharing import claimed  # noqa: E402
from droid_jax.discrepancy.missing import find_missing_effects  # noqa: E402
from droid_jax.identify.pipeline import IdentifyConfig, identify_parameters  # noqa: E402
from droid_jax.identify.search import CmaConfig  # noqa: E402
from droid_jax.model.fields import joint_damping, joint_frictionloss, model_parameter  # noqa: E402
from droid_jax.model.parameters import Space  # noqa: E402
from droid_jax.model.scene import Scene, compile_scene  # noqa: E402
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from experiments.blind.rates import rate  # noqa: E402
from experiments.trials import answer_json  # noqa: E402

MASS, LENGTH = 0.5, 0.1  # kg, m: a weight of 0.49 N m at the horizontal
STIFFNESS, SERVO_DAMPING = 8.0, 0.3  # N m/rad, N m s/rad, of the servo that makes the motion
SECONDS, RATE = 60.0, 200.0  # s, Hz of a log
STEP = 1e-4  # s, of Moreau's time stepping
FRICTION = (0.02, 0.5)  # N m, drawn uniformly in the logarithm
POSITION_NOISE, TORQUE_NOISE = 1e-4, 0.005  # rad, N m, of each sample
LEVEL = 0.9
TRUTHS = ("joint_damping", "joint_frictionloss", "joint_armature")

MODEL = """<mujoco model="stick"><compiler angle="radian"/><option timestep="{step}" integrator="implicitfast"/>
<worldbody><body><joint name="j" axis="0 1 0" armature="{armature}" damping="{damping}" frictionloss="{friction}"/>
<inertial pos="0 0 {z}" mass="{mass}" diaginertia="1e-5 1e-5 1e-5"/></body></worldbody>
<actuator><position name="j" joint="j" kp="{kp}" kv="{kv}"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Two seeds."""
    seeds: int = 100
    """Number of seeds."""
    first: int = 0
    """The first seed."""
    sum_only: bool = False
    """Run nothing; summarise the existing seeds."""
    out: Path = ROOT / "runs" / "friction_at_rest"
    """Folder of the seeds and of friction_at_rest.json."""


@dataclass(frozen=True)
class Truth:
    """A drawn hinge: N m s/rad, N m, kg m^2."""

    damping: float
    friction: float
    armature: float


def drawn(rng: np.random.Generator) -> Truth:
    """A hinge."""
    low, high = np.log(FRICTION)
    return Truth(rng.uniform(0.02, 0.1), float(np.exp(rng.uniform(low, high))), rng.uniform(0.005, 0.02))


def commanded(rng: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """Command [T] rad: two slow sines with pauses."""
    moving = np.ones_like(time)
    for start in rng.uniform(0, SECONDS, 6):
        moving *= 1.0 - (np.abs(time - start) < rng.uniform(0.5, 1.5))
    phase = np.cumsum(moving) * (time[1] - time[0])
    slow, fast = rng.uniform(0.1, 0.25), rng.uniform(0.3, 0.7)
    first, second = rng.uniform(0, 2 * np.pi, 2)
    return 0.9 * np.sin(2 * np.pi * slow * phase + first) + 0.3 * np.sin(2 * np.pi * fast * phase + second)


def exact(truth: Truth, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T] rad and servo torques [T] N m at STEP: the set-valued law by Moreau's time stepping.

    The friction of a step is the torque that would stop the joint, limited to the friction loss.
    """
    inertia = truth.armature + MASS * LENGTH**2 + 1e-5
    q, v = command[0], 0.0
    positions, torques = np.empty_like(command), np.empty_like(command)
    for k, target in enumerate(command):
        torque = STIFFNESS * (target - q) - SERVO_DAMPING * v
        positions[k], torques[k] = q, torque
        free = v + STEP / inertia * (torque - truth.damping * v - MASS * 9.81 * LENGTH * np.sin(q))
        friction = min(max(-inertia * free / STEP, -truth.friction), truth.friction)
        v = free + STEP / inertia * friction
        q = q + STEP * v
    return positions, torques


def in_mujoco(truth: Truth, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T] rad and servo torques [T] N m by plain C MuJoCo at STEP, with its default soft friction."""
    model = mujoco.MjModel.from_xml_string(model_xml(truth, STEP))
    data = mujoco.MjData(model)
    data.qpos[0] = command[0]
    positions, torques = np.empty_like(command), np.empty_like(command)
    for k, target in enumerate(command):
        data.ctrl[0] = target
        positions[k] = data.qpos[0]
        mujoco.mj_step(model, data)
        torques[k] = data.qfrc_actuator[0]
    return positions, torques


def model_xml(truth: Truth, step: float) -> str:
    """MJCF of a hinge."""
    return MODEL.format(
        step=step, armature=truth.armature, damping=truth.damping, friction=truth.friction, z=-LENGTH, mass=MASS,
        kp=STIFFNESS, kv=SERVO_DAMPING,
    )  # fmt: skip


def recorded(seed: int, name: str) -> tuple[Recording, Truth]:
    """One log of a seed's hinge; logs of two names move differently."""
    truth = drawn(np.random.default_rng([seed, 0]))
    rng = np.random.default_rng([seed, 1 + ord(name)])
    time = np.arange(round(SECONDS / STEP)) * STEP
    integrate = exact if seed % 2 == 0 else in_mujoco
    position, torque = integrate(truth, commanded(rng, time))
    every = round(1.0 / (RATE * STEP))
    time, position, torque = time[::every], position[::every], torque[::every]
    position = position + POSITION_NOISE * rng.standard_normal(len(time))
    torque = torque + TORQUE_NOISE * rng.standard_normal(len(time))
    seen = np.ones((1, len(time), 1), bool)
    channels = {
        key: Channel(key, unit, ("j",), time, values[None, :, None], seen)
        for key, unit, values in (("position", "rad", position), ("torque", "N m", torque))
    }
    convention = TorqueConvention(TorqueSide.MOTOR, True)
    return Recording(f"{name}{seed}", np.zeros(0), np.zeros((0, 0)), (), channels, convention), truth


def studied() -> tuple[Scene, Space]:
    """The model that is fitted, with nominal values that differ from the true ones."""
    scene = compile_scene(mujoco.MjSpec.from_string(model_xml(Truth(0.05, 0.05, 0.01), 0.002)), name="stick")
    return scene, Space(
        (
            joint_damping(scene, "j", std=0.05, high=1.0),
            joint_frictionloss(scene, "j", std=0.1, high=2.0),
            model_parameter(scene, "dof_armature", "j", unit="kg m2", std=0.005, low=1e-4, high=0.1, name="j_armature"),
        )
    )


def one(seed: int, scene: Scene, space: Space) -> dict[str, Any]:
    """Fit and search of a seed's two logs."""
    (first, truth), (second, _) = recorded(seed, "a"), recorded(seed, "b")
    # Inverse dynamics is smooth in these parameters: a short search before the refinement is enough.
    config = IdentifyConfig(search=CmaConfig(population=16, generations=8))
    found = identify_parameters(scene, space, [first], config=config)
    low, high = found.full_gaussian.interval(LEVEL)
    verdict, _ = find_missing_effects(scene, space, [first, second])
    truths = (truth.damping, truth.friction, truth.armature)
    return {
        "seed": seed,
        "integrator": "exact" if seed % 2 == 0 else "mujoco",
        "at_rest": float(found.fit.drives[0].rest.mean()),
        "parameters": {
            name: {"truth": t, "best": float(b), "interval": [float(a), float(z)], "inside": bool(a <= t <= z)}
            for name, t, b, a, z in zip(TRUTHS, truths, found.best, low, high, strict=True)
        },
        **answer_json(verdict),
        "p": float(verdict.score_tests[0].p) if verdict.score_tests else None,
    }


def summary(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates with their intervals."""

    def inside(name: str, some: list[dict[str, Any]]) -> Any:
        return rate(some, lambda case: case["parameters"][name]["inside"])

    kinds = {"all": cases} | {k: [c for c in cases if c["integrator"] == k] for k in ("exact", "mujoco")}
    return {
        "seeds": len(cases),
        "false_names": rate(cases, lambda case: bool(case["effects"])),
        "p_below_0.01": rate(cases, lambda case: case["p"] is not None and case["p"] < 0.01),
        "inside": {kind: {name: inside(name, some) for name in TRUTHS} for kind, some in kinds.items() if some},
    }


def main(arguments: Arguments) -> None:
    """Run the seeds that have no result yet, and summarise all."""
    folder = arguments.out / "seeds"
    scene, space = studied()
    for seed in range(arguments.first, arguments.first + (2 if arguments.quick else arguments.seeds)):
        path = folder / f"{seed:04d}.json"
        if arguments.sum_only or path.is_file():
            continue
        with claimed(path, wait=False) as mine:
            if mine and not path.is_file():
                write_json(path, one(seed, scene, space))
                print(path.read_text(), flush=True)
    cases = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    result = {**origin(arguments.first), "level": LEVEL, **summary(cases), "cases": cases}
    write_json(arguments.out / f"friction_at_rest{'_quick' if arguments.quick else ''}.json", result)
    print(json.dumps({k: v for k, v in result.items() if k != "cases"}))


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
