"""Time and memory of a batch of replays against population, recordings, length, joints and number of effects.

    python benchmarks/scaling.py [--quick] [--out DIR] [--only AXIS ...]

Along each axis one quantity varies from the base case: 128 samples, one recording, the whole demonstration A of the
built-in door at a 4 ms step, no effect.  Along "joints" a chain of servo-driven joints replaces the door.  Every point
is a separate process with an empty compilation cache.  It measures the seconds of the first call, which compiles, the
median seconds of later calls, and the peak memory of the whole process.  Writes DIR/scaling.json after every point and
DIR/scaling.png at the end.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tyro  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from benchmarks.common import empty_cache, in_process, interleave, origin, peak_memory_gib, stem  # noqa: E402
from droid_jax.report.style import png_bytes  # noqa: E402
from droid_jax.storage import write_bytes, write_json  # noqa: E402

TIMESTEP = 0.004  # s
BASE = {
    "population": 128,
    "recordings": 1,
    "duration": 0.0,
    "joints": 0,
    "effects": 0,
}  # 0 s: all; 0 joints: the door
AXES: dict[str, tuple[float, ...]] = {
    "population": (1, 32, 128, 512, 2048),
    "recordings": (1, 2, 4, 8),
    "duration": (1.0, 2.0, 4.0, 7.7),
    "joints": (1, 2, 4, 8, 16),
    "effects": (0, 1, 4, 16, 64),
}
QUICK: dict[str, tuple[float, ...]] = {
    "population": (1, 32), "recordings": (1, 2), "duration": (0.2, 0.4), "joints": (1, 2), "effects": (0, 1),
}  # fmt: skip
LABELS = {
    "population": "samples", "recordings": "recordings", "duration": "recording, s", "joints": "joints of a chain",
    "effects": "effects in the replay",
}  # fmt: skip
CHAIN_SECONDS = 4.0
TIMEOUT = 900.0  # s of a point


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Two short points of each axis: shows that it runs."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of scaling.json and scaling.png."""
    only: tuple[str, ...] = tuple(AXES)
    """Axes."""
    repeats: int = 3
    """Timed calls of a point."""
    point: str = ""
    """JSON of one point, measured in this process; used by the script itself."""

    def __post_init__(self) -> None:
        if unknown := [axis for axis in self.only if axis not in AXES]:
            raise SystemExit(f"error: there is no axis {', '.join(unknown)}; there are {', '.join(AXES)}")


def measured(at: dict[str, Any], repeats: int) -> dict[str, Any]:
    """One point, in this process."""
    import tuned  # noqa: F401  # pyright: ignore[reportMissingImports]  (before jax starts)

    # isort: split
    import numpy as np

    from droid_jax.cost.cost import make_cost

    scene, space, recordings, effects = _chain(at) if at["joints"] else _door(at)
    cost = make_cost(scene, space, recordings, effects=effects, check=False)
    rng = np.random.default_rng(0)
    values = space.from_search(0.1 * rng.standard_normal((int(at["population"]), len(space))))
    before = peak_memory_gib()
    first, median = interleave({"cost": lambda: cost(values)}, repeats)
    steps = sum(len(drive.time) for drive in cost.drives)
    return {
        "steps": steps,
        "parameters": len(space),
        "effects": len(effects),
        "first_call_s": first["cost"],
        "seconds": median["cost"],
        "steps_per_s": at["population"] * steps / median["cost"],
        "gib": peak_memory_gib(),
        "gib_before": before,
    }


def _door(at: dict[str, Any]) -> tuple[Any, Any, list[Any], tuple[Any, ...]]:
    """Scene, space, recordings and effects of the built-in door."""
    from droid_jax.door.demonstration import demonstration_path
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_nuisances, door_space
    from droid_jax.model.effects.registry import effect_space, library, ready
    from droid_jax.recordings.formats import load_recording
    from droid_jax.synthetic.robot import SyntheticRobotConfig, record, synthetic_truth

    scene, demonstration = ready(door_scene(timestep=TIMESTEP)), load_recording(demonstration_path("A"))
    truth = synthetic_truth(scene, 1, 0)
    one = record(scene, demonstration, truth, seed=0, config=SyntheticRobotConfig(repeats=2))
    if at["duration"]:
        begin = float(one.time[0])
        one = one.window(begin, begin + at["duration"])
    effects = library(scene)[: int(at["effects"])]
    space = door_space(scene) + door_nuisances(scene)
    if effects:
        space = space + effect_space(effects)
    return scene, space, [replace(one, name=f"A{n}") for n in range(int(at["recordings"]))], effects


def _chain(at: dict[str, Any]) -> tuple[Any, Any, list[Any], tuple[Any, ...]]:
    """A chain of links in space, each driven by a servo, and a recording of its own simulation."""
    import mujoco
    import numpy as np

    from droid_jax.model.fields import body_mass, joint_damping
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import compile_scene
    from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
    from droid_jax.synthetic.hidden_effects import record_hidden
    from droid_jax.synthetic.robot import SyntheticRobotConfig

    joints = int(at["joints"])
    names = tuple(f"joint{n}" for n in range(joints))
    inside = ""
    for n in reversed(range(joints)):
        place = 'pos="0.1 0 0"' if n else ""
        inside = (
            f'<body name="link{n}" {place}><joint name="joint{n}" axis="0 {n % 2} {1 - n % 2}" armature="0.05" '
            f'damping="0.5"/><geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 0" mass="0.5" contype="0" '
            f'conaffinity="0"/>{inside}</body>'
        )
    servos = "".join(f'<position name="{name}" joint="{name}" kp="60" kv="4"/>' for name in names)
    text = (
        f'<mujoco><option timestep="{TIMESTEP}" integrator="implicitfast"/><worldbody>{inside}</worldbody>'
        f"<actuator>{servos}</actuator></mujoco>"
    )
    scene = compile_scene(mujoco.MjSpec.from_string(text), "chain", joints=names)
    time = np.arange(0.0, at["duration"] or CHAIN_SECONDS, 0.01)
    ease = np.clip(time / 0.5, 0.0, 1.0)[:, None] ** 3  # it begins at rest
    command = 0.2 * ease * np.sin(np.outer(time, 1.0 + 0.2 * np.arange(joints)))
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    asked = Recording("chain", time, command, names, {}, convention, qpos0=dict.fromkeys(names, 0.0))
    space = Space(
        (*(joint_damping(scene, name, std=0.2, high=10.0) for name in names),
         body_mass(scene, f"link{joints - 1}", std=0.1, high=3.0)),
    )  # fmt: skip
    truth = dict(zip(space.names, space.mean.tolist(), strict=True))
    config = SyntheticRobotConfig(repeats=2)
    made = record_hidden(scene, asked, truth, {}, seed=0, config=config, name="chain", space=space)
    return scene, space, [made], ()


def figure(points: list[dict[str, Any]]) -> Figure:
    """Seconds above, memory below, one column for each axis."""
    axes = [axis for axis in AXES if any(p["axis"] == axis and "error" not in p for p in points)]
    made = Figure(figsize=(2.4 * len(axes) + 0.6, 4.4), layout="constrained")
    grid = made.subplots(2, len(axes), squeeze=False)
    for column, axis in enumerate(axes):
        of = sorted((p for p in points if p["axis"] == axis and "error" not in p), key=lambda p: p[axis])
        x = [p[axis] for p in of]
        above, below = grid[:, column]
        above.plot(x, [p["seconds"] for p in of], "o-", color="#2b6cb0")
        below.plot(x, [p["gib"] for p in of], "o-", color="#c05621")
        below.set_xlabel(LABELS[axis])
        for plot in (above, below):
            plot.set_ylim(0.0, 1.1 * max(plot.lines[0].get_ydata()))
            plot.grid(alpha=0.3)
            if axis == "population":
                plot.set_xscale("log")
    grid[0, 0].set_ylabel("s of a batch")
    grid[1, 0].set_ylabel("peak memory, GiB")
    return made


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    if arguments.point:
        print(json.dumps(measured(json.loads(arguments.point), arguments.repeats)))
        return
    path = arguments.out / f"{stem('scaling', arguments.quick)}.json"
    base = {**BASE, "population": 32, "duration": 0.2} if arguments.quick else BASE
    points: list[dict[str, Any]] = []
    for axis in arguments.only:
        for value in (QUICK if arguments.quick else AXES)[axis]:
            at = {**base, axis: value}
            words = ["--point", json.dumps(at), "--repeats", str(1 if arguments.quick else arguments.repeats)]
            with tempfile.TemporaryDirectory() as cache:
                found = in_process(__file__, words, TIMEOUT, empty_cache(cache))
            points.append({"axis": axis, **at, **found})
            how = found.get("error") or f"{found['seconds']:.3f} s, {found['gib']:.2f} GiB"
            print(f"{axis} {value:g}: {how}", flush=True)
            write_json(path, {"quick": arguments.quick, "timestep": TIMESTEP, "points": points}, indent=2)
    source = origin(0)  # imported only now, so that the points had the accelerator's memory
    write_json(path, {**source, "quick": arguments.quick, "timestep": TIMESTEP, "points": points}, indent=2)
    write_bytes(path.with_suffix(".png"), png_bytes(figure(points)))
    failed = [f"{p['axis']} {p[p['axis']]:g}: {p['error']}" for p in points if "error" in p]
    print(json.dumps({"points": len(points), "failed": failed, "device": source["device"]}))


if __name__ == "__main__":
    main()
