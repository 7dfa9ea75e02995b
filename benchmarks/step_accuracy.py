"""Discretisation error of the door's replay: torques against plain C MuJoCo at 0.1 ms.

    python benchmarks/step_accuracy.py [--quick] [--out DIR]

Demonstration A on the door at the initial means and on the three doors of Table I.  Root mean square
over the whole opening, worst joint of the worst door.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import publish  # noqa: E402
from droid_jax.door.demonstration import demonstration_path  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_space, truth  # noqa: E402
from droid_jax.model.physics import make_c_model, make_physics  # noqa: E402
from droid_jax.model.scene import with_options  # noqa: E402
from droid_jax.recordings.formats import load_recording  # noqa: E402
from droid_jax.simulate.batching import over_population  # noqa: E402
from droid_jax.simulate.c_engine import instrument, simulate  # noqa: E402
from droid_jax.simulate.c_reference import c_replay  # noqa: E402
from droid_jax.simulate.replay import make_drive, servo_replay  # noqa: E402

FINE = 1e-4  # s
DEMONSTRATION = load_recording(demonstration_path("A"))


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """One door only."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of step_accuracy.json."""


def rows(doors: int) -> np.ndarray:
    """[P, D] the initial means and the doors of Table I."""
    space = door_space(door_scene())
    return np.array([space.mean, *(space.values(truth(k)) for k in range(3))])[:doors]


def fine(values: np.ndarray) -> np.ndarray:
    """[P, T, J] N m at every 2 ms: C at 0.1 ms with the solver run to the end."""
    scene = door_scene()
    options = dict(timestep=FINE, integrator=mujoco.mjtIntegrator.mjINT_EULER, iterations=100, ls_iterations=50)
    exact = replace(scene, model=with_options(scene, **options).model)
    exact = replace(exact, model=instrument(exact))
    drive = make_drive(exact, DEMONSTRATION)
    models = [make_c_model(exact, door_space(scene), row) for row in values]
    return simulate(exact, models, drive.qpos0[None], drive.command[None]).torque[:, ::20]


def coarse(values: np.ndarray, timestep: float, engine: str) -> np.ndarray:
    """[P, T, J] N m at every `timestep` s; engine "own", "parity" or "c"."""
    scene = door_scene(timestep=timestep)
    space, drive = door_space(scene), make_drive(scene, DEMONSTRATION)
    if engine == "c":
        return c_replay(scene, space, drive)(values).torque
    replay = servo_replay(scene, drive, parity=engine == "parity")
    return over_population(lambda v: replay(make_physics(scene, space, v)))(values).torque


def worst(a: np.ndarray, b: np.ndarray) -> float:
    """N m: root mean square over time of the worst joint of the worst door."""
    length = min(a.shape[1], b.shape[1])
    return float(np.sqrt(np.mean((a[:, :length] - b[:, :length]) ** 2, axis=1)).max())


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    values = rows(1 if arguments.quick else 4)
    reference = fine(values)
    in_c = coarse(values, 0.002, "c")
    result = {
        "c_2ms": worst(in_c, reference),
        "own_2ms": worst(coarse(values, 0.002, "own"), reference),
        "own_4ms": worst(coarse(values, 0.004, "own"), reference[:, ::2]),
        "parity_2ms_against_c_2ms": worst(coarse(values, 0.002, "parity"), in_c),
        "unit": "N m",
    }
    publish(arguments.out, "step_accuracy", arguments.quick, 0, result, result)


if __name__ == "__main__":
    main()
