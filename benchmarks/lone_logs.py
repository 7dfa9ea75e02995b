"""A single commanded log: how often is there a false alarm, and how often is a hidden effect named?

    python benchmarks/lone_logs.py [--quick] [--null 50] [--blind 60] [--so101 FILE] [--out DIR] [--runs DIR]

A servo-driven hinge and an arm of three joints, on the synthetic robot: one log of 24 s each, its positions alone or
its torques too, searched in windows of time (`Split.WINDOWS`).  Every case draws a robot with all its nuisances.
Hidden effects are 3 and 10 times their minimum effect size.  They are effects of the library, or what is wrong with a
set-up and with a servo (`--hidden setup`), then also on a lone servo with a pendulum, whose goal has steps.  FILE adds
another robot with nothing hidden, in positions: an SO-101 arm, whose MJCF is not part of this repository, with the
parameters of experiments/so101.json.  One JSON file per case is written under RUNS.  A stopped run can be continued,
and several processes can share the cases.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import itertools  # noqa: E402
import json  # noqa: E402
import math  # noqa: E402
import time  # noqa: E402
from collections.abc import Sequence  # noqa: E402
from dataclasses import asdict, dataclass, replace  # noqa: E402
from typing import Any, Literal  # noqa: E402

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import CODE, publish  # noqa: E402
from benchmarks.sharing import claimed  # noqa: E402
from droid_jax.discrepancy.candidates import ScoreDirection, ScoreTest, directions_of, observable_effects  # noqa: E402
from droid_jax.discrepancy.config import DiscrepancyConfig  # noqa: E402
from droid_jax.discrepancy.cross_validation import case_score_test  # noqa: E402
from droid_jax.discrepancy.fitting import base_model  # noqa: E402
from droid_jax.discrepancy.log_case import case_of  # noqa: E402
from droid_jax.discrepancy.posterior import intervals  # noqa: E402
from droid_jax.discrepancy.search import search_effects  # noqa: E402
from droid_jax.discrepancy.step_error import discretisation_error, with_finer_step, with_step_differences  # noqa: E402
from droid_jax.door.space import torque_offsets  # noqa: E402
from droid_jax.model.effect_interface import Effect  # noqa: E402
from droid_jax.model.effects.candidate import candidates, names_of  # noqa: E402
from droid_jax.model.effects.registry import ready  # noqa: E402
from droid_jax.model.fields import body_mass, joint_damping, joint_frictionloss, servo_scale, time_offset  # noqa: E402
from droid_jax.model.parameter_file import friction_joints, load_parameters  # noqa: E402
from droid_jax.model.parameters import Space  # noqa: E402
from droid_jax.model.scene import Scene, compile_scene, load_scene  # noqa: E402
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide  # noqa: E402
from droid_jax.recordings.split import Split, roles_of  # noqa: E402
from droid_jax.simulate.c_engine import simulate  # noqa: E402
from droid_jax.simulate.hand_path import minimum_jerk  # noqa: E402
from droid_jax.simulate.windows import WindowConfig  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from droid_jax.synthetic.hidden_effects import LIBRARY, ON_HINGE, Applied, record_hidden  # noqa: E402
from droid_jax.synthetic.robot import SyntheticRobotConfig, as_recording, sensor_torque, set_up  # noqa: E402
from experiments.blind.answers import parts, right  # noqa: E402
from experiments.blind.rates import rate  # noqa: E402
from experiments.blind.scenes import AJAR, DOOR, setting  # noqa: E402
from experiments.blind.score import answered  # noqa: E402
from experiments.blind.search import FAILED  # noqa: E402
from experiments.trials import answer_json  # noqa: E402

SECONDS = 24.0
HELD = 1.5  # s, before that: the robot settles where its servos hold it, and no log begins with a jolt
NOISE = 1e-4  # rad, of a position sample
SO101_NOISE = 4.4e-4  # rad, the deviation of rounding to its encoder's 4096 counts
STEP_EVERY, STEP_SIZE = 1.7, 0.3  # s and rad, of a servo's goal
ANGLES = (0.9, 0.3, 1.2, 0.6, -0.4, -1.0, -0.2, 0.8, 1.4, 0.5, -0.7, 0.1)  # rad, of a servo's goal that rests
MOVE = 0.8  # s from one to the next
FACTORS = (3.0, 10.0)  # of the minimum effect size
STROKES = ((3.0, 0.9), (5.0, 0.9), (4.6, 0.8), (3.4, 0.95), (2.6, 0.75), (5.4, 0.85))  # s and rad, there and back
ARM = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <body name="column"><joint name="yaw" axis="0 0 1" armature="0.05" damping="10"/>
    <geom size="0.05 0.1" type="cylinder" mass="2" contype="0" conaffinity="0"/>
    <body name="upper" pos="0 0 0.1"><joint name="shoulder" axis="0 1 0" armature="0.1" damping="20"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="3" contype="0" conaffinity="0"/>
      <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" armature="0.05" damping="10"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.4 0 0" mass="3" contype="0" conaffinity="0"/></body></body>
  </body></worldbody>
  <actuator><position name="yaw" joint="yaw" kp="400"/><position name="shoulder" joint="shoulder" kp="900"/>
    <position name="elbow" joint="elbow" kp="400"/></actuator></mujoco>"""
JOINTS = ("yaw", "shoulder", "elbow")
SERVO = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody><body name="arm">
  <joint name="j" axis="0 1 0" armature="0.01" damping="0.3" {friction}/>
  <geom type="capsule" size="0.01" fromto="0 0 0 0.15 0 0" mass="0.2" contype="0" conaffinity="0"/>
  <geom type="sphere" size="0.03" pos="0.15 0 0" mass="0.5" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><position name="j" joint="j" kp="20"/></actuator></mujoco>"""
SOFT, SERVO_FRICTION = "soft_servo", 0.1  # N m, of its joint friction, which creeps in the model
SO101 = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
# rad, rad/s, rad: two sines a joint
WAVES = (
    ((0.7, 1.1, 0.0), (0.2, 2.9, 1.0)), ((0.5, 1.7, 0.3), (0.15, 3.7, 2.0)), ((0.6, 2.3, 1.0), (0.2, 0.9, 0.5)),
    ((0.5, 1.4, 0.7), (0.15, 3.3, 0.2)), ((0.7, 1.9, 0.1), (0.2, 4.1, 1.5)),
    ((0.4, 1.2, 0.4), (0.1, 3.0, 0.8)),
)  # fmt: skip
HIDDEN = {
    "hinge": (
        "hinge_preload", "binding_spring", "over_centre", "magnetic_catch", "closer", "opening_check", "air_drag",
        "floor_friction", "stribeck_friction[door]", "directional_friction[door]", "command_delay",
    ),
    "arm": (
        "dry_friction[shoulder]", "dry_friction[yaw]", "stribeck_friction[elbow]", "directional_friction[yaw]",
        "load_friction[shoulder]", "payload", "cable_pull[elbow]", "torque_ripple[shoulder]",
        "joint_elasticity[elbow]", "servo_gains[shoulder]", "command_delay", "encoder_zero[elbow]", "tilted_base",
    ),
}  # fmt: skip
SETUP = {  # the set-up and the servos; of torques alone what only their sensors show
    "hinge": ("clock_rate",),  # a delay of the commands is its base's own time offset
    "servo": ("tilted_base", "clock_rate", "held_thing", "torque_gain[j]", "mesh_friction[j]", "inner_profile[j]",
              "torque_line[j]", "free_play[j]", "resonance[j]"),
    SOFT: ("firm_friction[j]",),
    "arm": ("tilted_base", "encoder_zero[elbow]", "clock_rate", "held_thing", "inner_profile[shoulder]",
            "torque_gain[shoulder]", "crosstalk[elbow]", "mesh_friction[shoulder]", "torque_line[shoulder]",
            "free_play[elbow]", "resonance[elbow]"),
}  # fmt: skip
OF_SENSORS = ("torque_gain", "crosstalk")
SETS = {"library": HIDDEN, "setup": SETUP}
NAMES = {"library": "lone_logs", "setup": "setup_errors"}  # of the results
CHANNELS = {"positions": ("position",), "torques": ("torque", "position")}
COMBINATIONS = {name: [(scene, channels) for scene in kinds for channels in CHANNELS] for name, kinds in SETS.items()}
OTHER = ("so101", "positions")  # with nothing hidden


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """One case of each kind on the hinge; its numbers are not to be reported."""
    null: int = 50
    """Cases without a hidden effect, for each scene and set of channels."""
    blind: int = 60
    """Cases with a hidden effect, over all scenes and sets of channels."""
    hidden: Literal["library", "setup"] = "library"
    """What is hidden: effects of the library in general, or errors of the set-up, whose result is setup_errors.json."""
    only: str = ""
    """Run only cases whose name begins with this text."""
    so101: Path | None = None
    """MJCF of an SO-101 arm, for as many cases with nothing hidden as the others have each."""
    windows: float = 0.0
    """Length of the windows, s, each replayed from its measured state; 0: whole motions are replayed."""
    minutes: float = 0.0
    """No case is begun after this time; 0: all are run."""
    sum_only: bool = False
    """Run no case; summarise the existing ones."""
    seed: int = 0
    """Seed of all draws."""
    runs: Path | None = None
    """Folder of the cases; default: runs/lone_logs, of --quick below OUT."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of lone_logs.json."""


@dataclass(frozen=True, eq=False)
class Bench:
    """A scene with a set of channels; its cases share compiled programs."""

    name: str
    scene: Scene
    base: Space
    demonstration: Recording
    effects: tuple[Effect, ...]
    channels: tuple[str, ...]
    noise: float  # rad, of a position sample


@dataclass(frozen=True)
class Plan:
    """A case: nothing hidden, or a hidden effect ("name" or "name[joint]") times its minimum effect size."""

    name: str
    scene: str
    channels: str
    effect: str = ""
    factor: float = 0.0


def bench(scene: str, channels: str, so101: Path | None = None) -> Bench:
    """Of a scene and a set of channels; `so101` is the MJCF of that scene."""
    compared, clock = CHANNELS[channels], np.arange(0.0, HELD + SECONDS, 0.004)
    if scene == "hinge":
        where = setting("hinge")
        model, base, joints, command = where.scene, where.base, (DOOR,), _strokes(clock - HELD)[:, None]
    elif scene == "arm":
        model = ready(compile_scene(mujoco.MjSpec.from_string(ARM), "arm", joints=JOINTS))
        base, joints, command = _arm_base(model), JOINTS, _waves(np.maximum(clock - HELD, 0.0), JOINTS)
    elif scene in ("servo", SOFT):
        friction = f'frictionloss="{SERVO_FRICTION}"' if scene == SOFT else ""
        spec, joints = mujoco.MjSpec.from_string(SERVO.format(friction=friction)), ("j",)
        model = ready(compile_scene(spec, "servo", joints=joints))
        moved = _waves(np.maximum(clock - HELD, 0.0), joints) + _steps(clock - HELD)
        base, command = _servo_base(model), _rests(clock - HELD) if scene == SOFT else moved
    else:
        assert so101 is not None  # its cases are planned only then
        file = ROOT / "experiments" / "so101.json"
        model = ready(load_scene(so101, joints=SO101, friction_joints=friction_joints(file), hold=True))
        base, joints, command = load_parameters(file, model), SO101, _waves(np.maximum(clock - HELD, 0.0), SO101)
    if "torque" not in compared:
        base = Space(tuple(p for p in base.parameters if not p.name.startswith("torque_offset")))
    start = dict(zip(joints, command[0].tolist(), strict=True))
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    demonstration = Recording("log", clock, command, joints, {}, convention, qpos0=start)
    effects = observable_effects(model, [demonstration], channels=compared)
    noise = SO101_NOISE if scene == OTHER[0] else NOISE
    return Bench(scene, model, base, demonstration, effects, compared, noise)


def _arm_base(scene: Scene) -> Space:
    damping = (joint_damping(scene, j, std=2.0, high=60.0) for j in JOINTS)
    servos = (servo_scale(scene, j, nuisance=True) for j in JOINTS)
    mass = body_mass(scene, "fore", std=0.2, high=9.0)
    return Space((*damping, mass, *servos, time_offset(), *torque_offsets(JOINTS)))


def _servo_base(scene: Scene) -> Space:
    rubs = scene.spec.joint("j").frictionloss > 0
    friction = (joint_frictionloss(scene, "j", std=0.3 * SERVO_FRICTION, high=1.0),) if rubs else ()
    mass, gain = body_mass(scene, "arm", std=0.1, high=3.0), servo_scale(scene, "j", nuisance=True)
    damping = joint_damping(scene, "j", std=0.1, high=3.0)
    return Space((damping, *friction, mass, gain, time_offset(), *torque_offsets(("j",))))


def _strokes(clock: np.ndarray) -> np.ndarray:
    angle, start = np.full(len(clock), AJAR), 0.0
    for seconds, reach in STROKES:
        now = (clock >= start) & (clock < start + seconds)
        angle[now] += 0.5 * (reach - AJAR) * (1 - np.cos(2 * np.pi * (clock[now] - start) / seconds))
        start += seconds
    return angle


def _steps(clock: np.ndarray) -> np.ndarray:
    """[T, 1] rad, jumps of a servo's goal in the second half of a log."""
    count = np.floor((clock - 0.5 * SECONDS) / STEP_EVERY)
    return np.where(count >= 0, STEP_SIZE * (count % 2), 0.0)[:, None]


def _rests(clock: np.ndarray) -> np.ndarray:
    """[T, 1] rad, moves of MOVE s between ANGLES and rests, in which a joint with soft friction creeps."""
    angles, goal = np.array([0.0, *ANGLES]), np.zeros(len(clock))
    for number, (before, after) in enumerate(itertools.pairwise(angles)):
        share = minimum_jerk((clock - number * SECONDS / len(ANGLES)) / MOVE)
        goal += (after - before) * share
    return goal[:, None]


def _waves(clock: np.ndarray, joints: Sequence[str]) -> np.ndarray:
    swings = [sum(size * np.sin(w * clock + phase) for size, w, phase in waves) for waves in WAVES[: len(joints)]]
    return minimum_jerk(clock / 1.5)[:, None] * np.stack(swings, axis=1)


def plans(arguments: Arguments) -> list[Plan]:
    """All cases, ordered so that a stopped run has some of every kind."""
    combinations, kinds = COMBINATIONS[arguments.hidden], SETS[arguments.hidden]
    unchanged = [*combinations, *([OTHER] if arguments.so101 or arguments.sum_only else [])]
    null = [Plan(f"null-{scene}-{channels}-{n}", scene, channels)
            for n in range(1 if arguments.quick else arguments.null) for scene, channels in unchanged]  # fmt: skip
    count = 1 if arguments.quick else arguments.blind
    lists = {
        (scene, channels): [
            (e, f) for e in kinds[scene] for f in FACTORS if channels == "torques" or not e.startswith(OF_SENSORS)
        ]
        for scene, channels in combinations
    }
    if arguments.hidden == "library":
        hidden = list[Plan]()
        for n in range(count):
            scene, channels = key = combinations[n % len(combinations)]
            each = lists[key]
            order = np.random.default_rng([arguments.seed, combinations.index(key)]).permutation(len(each))
            effect, factor = each[order[(n // len(combinations)) % len(each)]]
            hidden.append(Plan(f"blind-{scene}-{channels}-{n}", scene, channels, effect, factor))
    else:  # every kind once, then some of them again
        each = [(*key, *one) for key, some in lists.items() for one in some]
        order = np.random.default_rng(arguments.seed).permutation(len(each))
        drawn = [each[order[n % len(each)]] for n in range(count)]
        hidden = [Plan(f"{'-'.join(map(str, one[:3]))}-{one[3]:g}x-{n}", *one) for n, one in enumerate(drawn)]
    some = math.ceil(len(null) / max(len(hidden), 1))
    mixed = [p for n, one in enumerate(hidden) for p in (*null[n * some : (n + 1) * some], one)]
    mixed += null[len(hidden) * some :]
    return [p for p in mixed if not arguments.quick or p.scene == "hinge"]


def recorded(bench: Bench, plan: Plan, seed: int) -> tuple[Recording, Applied | None, dict[str, float]]:
    """One log of a robot that is drawn around the priors, its hidden effect and its true parameters."""
    rng, base = np.random.default_rng(seed), bench.base
    values = rng.normal(base.mean, np.where(base.nuisance, 1.0, 0.5) * base.std)
    truth = dict(zip(base.names, np.clip(values, base.low, base.high).tolist(), strict=True))
    config = SyntheticRobotConfig(repeats=1, position_noise=bench.noise)
    hidden = None
    if plan.effect:
        kind, _, joint = plan.effect.rstrip("]").partition("[")
        hidden = Applied(kind, plan.factor * _minimum(bench, kind, joint), joint)
        config = replace(config, timestep=0.00025)
        log = record_hidden(
            bench.scene, bench.demonstration, truth, [hidden], seed=seed, config=config, name=plan.name, space=base
        )
    else:
        robot = set_up(bench.scene, bench.demonstration, truth, seed=seed, config=config, space=base)
        trace = simulate(robot.scene, robot.models, robot.qpos0, robot.control[None])
        log = as_recording(robot, trace, sensor_torque(robot, trace), trace.position, name=plan.name)
    kept = {name: log.channels[name] for name in ("position", *bench.channels)}
    return replace(log, channels=kept).window(HELD, HELD + SECONDS), hidden, truth


def _minimum(bench: Bench, kind: str, joint: str) -> float:
    """Minimum effect size of the library's effect that corresponds to a hidden one."""
    called = LIBRARY[kind]
    called = ON_HINGE.get(called, called) if joint == DOOR else called
    return next(e.minimum_size for e in bench.effects if e.name == called)


def configured(channels: tuple[str, ...], windows: float) -> DiscrepancyConfig:
    """Settings of the search, by windows of so many seconds unless that is 0."""
    if not windows:
        return DiscrepancyConfig(channels=channels, replay="whole")
    return DiscrepancyConfig(channels=channels, replay="windows", windows=WindowConfig(length=windows))


def made(bench: Bench, plan: Plan, seed: int, arguments: Arguments) -> dict[str, Any]:
    """The result of one case; a failure is a result too."""
    began = time.monotonic()
    result: dict[str, Any] = {**asdict(plan), "seed": seed, "code": CODE.get("git")}
    try:
        log, hidden, truth = recorded(bench, plan, seed)
        result["recorded"] = time.monotonic() - began
        config = configured(bench.channels, arguments.windows)
        roles = roles_of(Split.WINDOWS, [log])
        case = case_of(Split.WINDOWS, bench.scene, bench.base, bench.effects, roles, config)
        result["prepared"] = time.monotonic() - began
        model = base_model(case)
        result["fitted"] = time.monotonic() - began
        case = with_step_differences(case, model, with_finer_step(case.train, case.base, log))
        screen = case_score_test(case, model, directions_of(candidates(case.effects)))
        result |= {
            "p": screen.p,
            "discrepancy": model.discrepancy,
            "converged": bool(model.refined.converged),
            "limits": list(case.limits),
            "blocks": case.train.resampling.units,
            "ranked": [str(d.candidate.key) for d in _best(screen)],
            "screened": time.monotonic() - began,
        }
        main = [p.name for p in bench.base.parameters if not p.nuisance]
        stated = intervals(case.train, model, main)  # 90 %
        result["held"] = {name: low <= truth[name] <= high for name, (low, high) in stated.items()}
        if not model.refined.converged:
            return {**result, "verdict": "fit not converged", "effects": [], "seconds": time.monotonic() - began}
        if screen.p >= config.selection.significance:  # where the search ends too
            return {**result, "verdict": "none", "effects": [], "seconds": time.monotonic() - began} | _judged(
                bench, hidden, {"verdict": "none"}
            )
        verdict = search_effects(case, model, discretisation_error(case.train, model))
    except FAILED as error:
        return {**result, "verdict": "error", "error": str(error), "seconds": time.monotonic() - began}
    result |= {
        **answer_json(verdict),
        "discrepancies": {role: list(pair) for role, pair in verdict.discrepancies.items()},
        "discretisation_error": verdict.discretisation_error,
        "hints": [list(map(str, hint.effects)) for hint in verdict.hints],
        "reasons": [f"{names_of(t.keys)}: {r.text}" for t in verdict.validation_tests for r in t.reasons][:20],
        "seconds": time.monotonic() - began,
    }
    return result | _judged(bench, hidden, result)


def _judged(bench: Bench, hidden: Applied | None, result: dict[str, Any]) -> dict[str, Any]:
    """Which parts of an answer are right where an effect is hidden."""
    if hidden is None:
        return {}
    names, beside = [list(right(bench.scene, hidden))], [list(parts(bench.scene, hidden))]
    judged = answered({"truth": {"kind": "single"}, "result": result, "right": names, "parts": beside})
    return {"right": names, "named": judged["named"], "wrong": judged["wrong_confident"]}


def _best(found: ScoreTest) -> list[ScoreDirection]:
    """The three best directions of a score test, of different candidates."""
    best = {found.directions[k].candidate.key: found.directions[k] for k in reversed(found.ranking())}
    return list(best.values())[::-1][:3]


def summary(cases: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rates with Wilson's 95 % intervals; failed cases are counted as neither an alarm nor a named effect."""
    null, blind = [c for c in cases if not c["effect"]], [c for c in cases if c["effect"]]
    silent = ("none", "error", "fit not converged")
    return {
        "cases": {"null": len(null), "blind": len(blind), "errors": sum(c["verdict"] == "error" for c in cases)},
        "score_test_rejects": rate(null, lambda c: (c.get("p") or 1.0) < 0.01),
        "false_alarm_rate": rate(null, lambda c: c["verdict"] not in silent),
        "false_name_rate": rate(null, lambda c: bool(c.get("effects"))),
        "unconverged": rate(cases, lambda c: c["verdict"] == "fit not converged"),
        "detected": rate(blind, lambda c: c["verdict"] not in silent),
        "named_up_to_tie": rate(blind, lambda c: bool(c.get("named"))),
        "wrong_name_rate": rate(blind, lambda c: bool(c.get("wrong"))),
        "intervals_hold": rate([{"held": h} for c in null for h in c.get("held", {}).values()], lambda h: h["held"]),
        "p_below": {f"{a:g}": float(np.mean([(c.get("p") or 1.0) < a for c in null])) for a in (0.01, 0.05, 0.1, 0.5)}
        if null
        else {},
        "seconds_median": float(np.median([c["seconds"] for c in cases])) if cases else None,
    }


def main(arguments: Arguments) -> None:
    """Run the missing cases, and summarise all."""
    began, benches = time.monotonic(), dict[tuple[str, str], Bench]()
    folder = arguments.runs or (arguments.out if arguments.quick else ROOT / "runs") / "lone_logs"
    runs = folder / ("quick" if arguments.quick else f"seed{arguments.seed}")
    wanted = plans(arguments)
    for plan in wanted if not arguments.sum_only else ():
        late = arguments.minutes and time.monotonic() - began > 60 * arguments.minutes
        path = runs / f"{plan.name}.json"
        if late or path.is_file() or not plan.name.startswith(arguments.only):
            continue
        with claimed(path, wait=False) as mine:
            if not mine or path.is_file():
                continue
            key = plan.scene, plan.channels
            if key not in benches:
                benches[key] = bench(*key, arguments.so101)
            seed = int(np.random.default_rng([arguments.seed, *plan.name.encode()]).integers(1 << 31))
            found = made(benches[key], plan, seed, arguments)
            write_json(path, found)
            print(f"{plan.name} {plan.effect} {plan.factor:g}x: {found['verdict']} {found.get('effects', '')} "
                  f"p = {found.get('p')}, {found['seconds']:.0f} s {found.get('error', '')}", flush=True)  # fmt: skip
    cases = [json.loads(path.read_text()) for plan in wanted if (path := runs / f"{plan.name}.json").is_file()]
    groups = {f"{scene}, {channels}": [c for c in cases if (c["scene"], c["channels"]) == (scene, channels)]
              for scene, channels in (*COMBINATIONS[arguments.hidden], OTHER)}  # fmt: skip
    whole = summary(cases)
    result = {
        **whole,
        "by": {name: summary(some) for name, some in groups.items() if some},
        "by_effect": {
            e: summary(some) for e in sorted({c["effect"] for c in cases if c["effect"]})
            if (some := [c for c in cases if c["effect"] == e])
        },
        "by_factor": {f"{f:g}": summary([c for c in cases if c["factor"] == f]) for f in FACTORS},
        "codes": sorted({str(c["code"]) for c in cases}),
        **({"false_names": whole["false_name_rate"]} if arguments.hidden == "setup" else {}),
        "setting": {"seconds": SECONDS, "position_noise_rad": NOISE, "so101_noise_rad": SO101_NOISE,
                    "windows_s": arguments.windows},
        "blind_cases": [{k: c.get(k) for k in ("name", "effect", "factor", "verdict", "effects", "indistinguishable",
                                               "named", "wrong", "p", "ranked")} for c in cases if c["effect"]],
    }  # fmt: skip
    publish(arguments.out, NAMES[arguments.hidden], arguments.quick, arguments.seed, result, line=whole)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
