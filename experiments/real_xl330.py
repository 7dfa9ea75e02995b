"""A real servo, by positions alone: fitted at two firmware gains, tested on the third, with the program's commands.

    python experiments/real_xl330.py --data DIR

`identify` fits the eight logs of two gains of a Dynamixel XL330 with a pendulum (`xl330.xml`, `xl330.json`), with the
library's friction of gears (`gear_friction`) in the model; each log states its own gain.  `evaluate-fit` replays the
four logs of the third gain open loop, over their whole length.  Three folds.

Data: Rhoban/bam (Apache 2.0), logs of 2026-01-15.  DIR holds MOTION_kpGAIN.npz with time [s], goal_position and
position [rad] and torque_enable.  They are not part of this repository.  `lift_and_drop` counts up to where the motor
is switched off.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from commanded_fit import HERE, evaluated, fitted, kept, parameters_of
from inverse_fit import RESULTS, run
from xl330_logs import GAINS, MOTIONS, SOURCE, log_name, xl330_log

from benchmarks import common

EFFECTS = ("gear_friction",)
PUBLISHED = {
    "M1": 0.064,
    "M6": 0.0455,
}  # rad, mean over the twelve logs of the authors' fit to all of them, simulated again here


@dataclass(frozen=True)
class RealXl330:
    """Fit a real servo at two gains, test it on the third.

    data: folder with the logs.
    quick: one fold, two motions and a short search; its numbers are not to be reported.
    out: folder for real_xl330.json, and for the runs below `real_xl330_runs`.
    seed: of the searches.
    """

    data: Path
    quick: bool = False
    out: Path = RESULTS
    seed: int = 0


def fold(config: RealXl330, paths: dict[str, Path], judge: int, motions: tuple[str, ...]) -> dict[str, Any]:
    """One fold: the fit at the other gains, and the errors of every log of the test gain."""
    runs = config.out / ("real_xl330_quick_runs" if config.quick else "real_xl330_runs") / f"kp{judge}"
    fit_on = [paths[log_name(m, gain)] for gain in GAINS if gain != judge for m in motions]
    judge_on = [paths[log_name(m, judge)] for m in motions]
    options = ["--effects", *EFFECTS, "--seed", str(config.seed), *(["--generations", "5"] if config.quick else [])]
    found, seconds = fitted(HERE / "xl330.xml", HERE / "xl330.json", fit_on, judge_on, runs / "identify", options)
    errors = evaluated(runs / "identify", judge_on, runs / "evaluation")["errors"]
    return {
        "judge_kp": judge,
        "parameters": parameters_of(found),
        "mae_before": {name: round(of["position"]["mae_before"][0], 5) for name, of in errors.items()},
        "mae": {name: round(of["position"]["mae_after"][0], 5) for name, of in errors.items()},
        "seconds": round(seconds, 1),
    }


def main(config: RealXl330) -> None:
    """Three folds, the mean over all logs, one line of JSON."""
    motions = MOTIONS[:1] + MOTIONS[-1:] if config.quick else MOTIONS
    gains = GAINS[-1:] if config.quick else GAINS
    logs = [xl330_log(config.data, motion, gain) for motion in motions for gain in GAINS]
    paths = kept(logs, config.out / "real_xl330_logs")
    folds = [fold(config, paths, gain, motions) for gain in gains]
    by_log = {name: mae for of in folds for name, mae in of["mae"].items()}
    before = {name: mae for of in folds for name, mae in of["mae_before"].items()}
    result = {
        "experiment": "real_xl330",
        "source": SOURCE,
        "recordings": {r.name: r.sha256 for r in logs},
        "mae_rad": round(float(np.mean(list(by_log.values()))), 5),
        "mae_rad_before": round(float(np.mean(list(before.values()))), 5),
        "by_log": by_log,
        "effects": list(EFFECTS),
        "tied": [],
        "named": False,  # the effect was given, not found by a search
        "published_mae_rad": PUBLISHED,
        "folds": folds,
        "seconds": round(sum(of["seconds"] for of in folds), 1),
    }
    common.publish(config.out, "real_xl330", config.quick, config.seed, result)


if __name__ == "__main__":
    run(lambda: main(tyro.cli(RealXl330, description=__doc__)))
