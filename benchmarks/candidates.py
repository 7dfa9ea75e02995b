"""Computing time of candidate effects: a replay with all of them, and each stage of a search per candidate.

    python benchmarks/candidates.py [--quick] [--out DIR]

On the built-in door at a 4 ms step, demonstration A: the replay with the whole library at neutral beside the one with
no effect (interleaved), and the rows that screening, a first look and a refit need.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split

import numpy as np  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import interleave, publish  # noqa: E402
from droid_jax.cost.cost import Cost, make_cost  # noqa: E402
from droid_jax.discrepancy.candidates import directions_of  # noqa: E402
from droid_jax.discrepancy.config import DiscrepancyConfig  # noqa: E402
from droid_jax.door.demonstration import demonstration_path  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_nuisances, door_space  # noqa: E402
from droid_jax.model.effects.candidate import candidates  # noqa: E402
from droid_jax.model.effects.registry import effect_space, library, ready  # noqa: E402
from droid_jax.recordings.formats import load_recording  # noqa: E402
from droid_jax.recordings.recording import Recording  # noqa: E402
from droid_jax.synthetic.robot import SyntheticRobotConfig, record, synthetic_truth  # noqa: E402

TIMESTEP = 0.004  # s
SHORT = 1.0  # s of the demonstration with --quick


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """A second of the demonstration, one timed call."""
    rows: int = 128
    """Rows of a batch."""
    repeats: int = 5
    """Timed calls."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of candidates.json."""


def recording(quick: bool) -> Recording:
    """Two repeats of the synthetic robot; their content does not matter here."""
    scene, demonstration = door_scene(), load_recording(demonstration_path("A"))
    if quick:
        first = float(demonstration.time[0])
        demonstration = demonstration.window(first, first + SHORT)
    return record(scene, demonstration, synthetic_truth(scene, 1, 0), seed=0, config=SyntheticRobotConfig(repeats=2))


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    scene, measured = ready(door_scene(timestep=TIMESTEP)), recording(arguments.quick)
    base, effects = door_space(scene) + door_nuisances(scene), library(scene)
    bare = make_cost(scene, base, [measured])
    full = make_cost(scene, base + effect_space(effects), [measured], effects=effects)

    def batch(cost: Cost) -> np.ndarray:
        return cost.whitened(np.repeat(cost.space.mean[None], arguments.rows, axis=0))

    repeats = 1 if arguments.quick else arguments.repeats
    first, usual = interleave({"bare": lambda: batch(bare), "full": lambda: batch(full)}, repeats)
    apart = np.abs(full.smoothed(full.space.mean[None])[0] - bare.smoothed(base.mean[None])[0]).max()
    asked, config = candidates(effects), DiscrepancyConfig()
    questions = directions_of(asked)
    row = usual["full"] / arguments.rows
    steps = config.refit.corrected_batches * config.refit.trials  # of an iteration, if it takes all batches
    look_rows = 2 * (1 + config.one_step.chords * config.one_step.trials)  # from two starts, whose Jacobian is known
    refit_rows = 2 * (len(base) + 2) + steps
    result = {
        "quick": arguments.quick,
        "timestep": TIMESTEP,
        "seconds_of_motion": measured.duration,
        "rows": arguments.rows,
        "first_call_s": first,
        "batch_s": usual,
        "row_s": {name: s / arguments.rows for name, s in usual.items()},
        "effects_cost": usual["full"] / usual["bare"],
        "neutral_apart_n_m": float(apart),
        "effects": len(effects),
        "candidates": len(asked),
        "questions": len(questions),
        "screening_s": (len(questions) + 1) * row,
        "candidate_screened_s": (len(questions) + 1) * row / len(asked),
        "look_rows_at_most": look_rows,
        "look_s_at_most": look_rows * row,
        "refit_iteration_rows": refit_rows,
        "refit_s_at_most": (1 + config.refit.iterations * refit_rows) * row,
    }
    publish(arguments.out, "candidates", arguments.quick, 0, result)


if __name__ == "__main__":
    main()
