"""A leg in the air, by positions alone: fitted to one half of a log, tested on the other, with the program's commands.

    python experiments/real_go2.py --data DIR

`identify` fits armature, damping, dry friction and encoder zero of the three joints of a Go2's front left leg, and a
delay (`go2.json`), to the first six seconds.  `evaluate-fit` replays the whole log open loop; the last six seconds
are the test data.  `go2.toml` is the column map.

Data: iit-DLSLab/sim2real-robot-identification (BSD 3-clause), `datasets/go2/traj_0.pt`, its first 12 s.  DIR holds
go2_first_12s.npz with time [s], desired_position and position [T, 12] rad.  It is not part of this repository.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from commanded_fit import HERE, evaluated, fitted, kept, parameters_of
from inverse_fit import RESULTS, run

from benchmarks import common
from droid_jax.recordings.formats import load_recording

LOG = "go2_first_12s.npz"
SOURCE = "The log is the first 12 s of traj_0.pt of iit-DLSLab/sim2real-robot-identification, with the trunk in a rig."
HALF, END = 6.0, 11.995  # s
WHEN = ("before", "after")
# Mean absolute position error on held-out data, mrad (hip, thigh, calf): the maker's model, and
# one fitted to torques that were reconstructed from the servo's law.
OTHERS = {"maker's model": [10.4, 12.2, 14.9], "fitted to reconstructed torque": [8.4, 5.6, 7.2]}


@dataclass(frozen=True)
class RealGo2:
    """Fit a quadruped's leg to half a log of positions, test it on the other half.

    data: folder with the log.
    quick: two seconds of each half and a short search; its numbers are not to be reported.
    out: folder for real_go2.json, and for the runs below `real_go2_runs`.
    seed: of the search.
    """

    data: Path
    quick: bool = False
    out: Path = RESULTS
    seed: int = 0


def in_mrad(errors: list[float]) -> list[float]:
    """Angles [J] rad in mrad, rounded to the microradian."""
    return [round(1e3 * error, 3) for error in errors]


def main(config: RealGo2) -> None:
    """One fit, the error on the other half, one line of JSON."""
    if not (config.data / LOG).is_file():
        raise FileNotFoundError(f"no file {config.data / LOG}; --data is the folder that holds it. {SOURCE}")
    whole = load_recording(config.data / LOG, columns=HERE / "go2.toml", name="go2")
    first, last = (2.0, HALF + 2.0) if config.quick else (HALF, END)
    halves = [
        replace(whole.window(0.0, first), name="first_half"),
        replace(whole.window(HALF, last), name="second_half"),
    ]
    runs = config.out / ("real_go2_quick_runs" if config.quick else "real_go2_runs")
    paths = kept(halves, runs / "logs")
    options = ["--seed", str(config.seed), *(["--generations", "3"] if config.quick else [])]
    fit, judge = [paths["first_half"]], [paths["second_half"]]
    found, seconds = fitted(HERE / "go2_leg.xml", HERE / "go2.json", fit, judge, runs / "identify", options)
    errors = evaluated(runs / "identify", [*fit, *judge], runs / "evaluation")["errors"]
    mae = {when: {name: in_mrad(of["position"][f"mae_{when}"]) for name, of in errors.items()} for when in WHEN}
    parameters = parameters_of(found)
    result = {
        "experiment": "real_go2",
        "source": SOURCE,
        "recordings": {whole.name: whole.sha256},
        "joints": list(whole.channels["position"].columns),
        "mae_mrad": mae["after"]["second_half"],
        "mae_mrad_before": mae["before"]["second_half"],
        "mae_mrad_fitted_half": mae["after"]["first_half"],
        "others_mae_mrad": OTHERS,
        "armature": {name: of for name, of in parameters.items() if name.startswith("armature")},
        "parameters": parameters,
        "seconds": round(seconds, 1),
    }
    common.publish(config.out, "real_go2", config.quick, config.seed, result)


if __name__ == "__main__":
    run(lambda: main(tyro.cli(RealGo2, description=__doc__)))
