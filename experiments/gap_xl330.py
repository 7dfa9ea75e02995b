"""What does a real servo's model lack, by positions alone?  Two gains are searched, the third is the test.

    python experiments/gap_xl330.py --data DIR

`gap` searches logs of a Dynamixel XL330 with a pendulum (`xl330.xml`), started from Coulomb and viscous friction
(`xl330.json`), by windows.  Its authors' models have friction that grows with the load.  There are three
folds: each gain is the test data once.  Data as in `real_xl330.py`.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from commanded_fit import HERE, command, kept
from inverse_fit import RESULTS, run
from xl330_logs import GAINS, MOTIONS, SOURCE, log_name, xl330_log

from benchmarks import common
from droid_jax.files import GAP


@dataclass(frozen=True)
class GapXl330:
    """Search a real servo's logs for what the model lacks.

    data: folder with the logs.
    quick: one fold and two motions; its numbers are not to be reported.
    judges: gains of the test data, one per fold.
    out: folder for gap_xl330.json, and for the runs below `gap_xl330_runs`.
    seed: of the searches.
    """

    data: Path
    quick: bool = False
    judges: tuple[int, ...] = GAINS
    out: Path = RESULTS
    seed: int = 0


def fold(config: GapXl330, paths: dict[str, Path], judge: int, motions: tuple[str, ...]) -> dict[str, Any]:
    """One fold: the search at the other gains, and its answer."""
    out = config.out / ("gap_xl330_quick_runs" if config.quick else "gap_xl330_runs") / f"kp{judge}"
    train = [paths[log_name(m, gain)] for gain in GAINS if gain != judge for m in motions]
    test = [paths[log_name(m, judge)] for m in motions]
    began = time.monotonic()
    command(
        ["gap", "--scene", HERE / "xl330.xml", "--parameters", HERE / "xl330.json", "--recording", *train,
         "--test-recording", *test, "--seed", str(config.seed), "--out", out]
    )  # fmt: skip
    found = json.loads((out / GAP).read_text())
    return {
        "judge_kp": judge,
        "seconds": round(time.monotonic() - began, 1),
        **{key: found[key] for key in ("verdict", "sentence", "p", "effects", "indistinguishable", "hints", "doubts")},
        "limits": found["split"]["limits"],
        "coefficients": found["coefficients"],
        "discrepancies": found["discrepancies"],
        "mae_judged_rad": {
            state: float(
                np.mean([found["open_loop"]["errors"][path.stem]["position"][f"mae_{state}"] for path in test])
            )
            for state in ("before", "after")
        },
        "discretisation_error": found["discretisation_error"],
        "ranking": found["score_tests"][0]["ranking"][:6],
        "validation_tests": found["validation_tests"],
    }


def main(config: GapXl330) -> None:
    """Run a fold for each test gain; prints one line of JSON."""
    motions = MOTIONS[:1] + MOTIONS[2:3] if config.quick else MOTIONS
    judges = config.judges[:1] if config.quick else config.judges
    logs = [xl330_log(config.data, motion, gain) for motion in motions for gain in GAINS]
    paths = kept(logs, config.out / "real_xl330_logs")
    folds = [fold(config, paths, judge, motions) for judge in judges]
    result = {
        "experiment": "gap_xl330",
        "source": SOURCE,
        "recordings": {r.name: r.sha256 for r in logs},
        "verdicts": {f"kp{of['judge_kp']}": of["sentence"] for of in folds},
        "mae_judged_rad": {
            state: float(np.mean([of["mae_judged_rad"][state] for of in folds])) for state in ("before", "after")
        },
        "folds": folds,
        "seconds": round(sum(of["seconds"] for of in folds), 1),
    }
    common.publish(
        config.out,
        "gap_xl330",
        config.quick,
        config.seed,
        result,
        line={key: result[key] for key in ("verdicts", "mae_judged_rad")},
    )


if __name__ == "__main__":
    run(lambda: main(tyro.cli(GapXl330, description=__doc__)))
