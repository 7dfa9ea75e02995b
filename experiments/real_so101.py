"""The SO-101 arm, by positions alone: fitted to two motions, tested on four others, with the program's commands.

    python experiments/real_so101.py --data DIR [--gap | --bodies]

`identify` fits `chirp_sweep` and `friction_gravity` of six STS3215 servos (`so101.json`: a gain, damping and dry
friction of each of the first five joints, one armature that they share, and a delay), with the library's limit of the
acceleration of each servo's own goal: an STS3215 draws ramps between its goals, and LeRobot sets their steepest, 254
times 100 counts/s^2 or 39 rad/s^2.  `so101.toml` is the column map.  `evaluate-fit` replays the other motions open
loop, over their whole length.

Data: isaac-sim2real/sage (Apache 2.0), `output/real/so101/custom`.  DIR holds a folder for each motion, with
control.csv.gz and state_motor.csv.gz, and the arm without meshes, so101_air.xml.  They are not part of this repository.
MuJoCo's default friction creeps where the arm stands still; the fit uses hard friction (`--joint-friction`).

With --gap: what does a model of 24 parameters and a delay (gain, armature, damping and friction of each of the six
joints) with MuJoCo's default friction lack?  `identify` fits it to the four motions and `gap` searches them from there;
the two others are its test data.

With --bodies: the fit with the inertia of four links as nuisances, once as ten numbers each that are a possible body at
every value, once as mass, centre and principal moments that vary freely.  Draws of both Gaussians are checked.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tyro
from commanded_fit import HERE, command, evaluated, fitted, kept, parameters_of
from inverse_fit import RESULTS, possible_bodies, run

from benchmarks import common
from droid_jax.files import EXTENDED, FULL_GAUSSIAN, GAP
from droid_jax.identify.evaluation import evaluate_on
from droid_jax.identify.gaussian import load_gaussian
from droid_jax.model.parameter_file import friction_joints, load_parameters
from droid_jax.model.scene import load_scene
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import Recording
from droid_jax.storage import write_json

JUDGED = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")
FIT = ("chirp_sweep", "friction_gravity")
JUDGES = ("multisine", "velocity_ramp", "step_response", "trapezoidal_profile")
SOURCE = (
    "Logs of isaac-sim2real/sage of an SO-101: a folder for each motion with control.csv.gz and state_motor.csv.gz."
)
SECONDS = 1e9  # all of it
EFFECTS = ("profile_acceleration",)
# Of each joint in the search: an entry of a parameter file, but for its name and its joints.
OF_A_JOINT: dict[str, dict[str, Any]] = {
    "kp": {"std": 0.4, "low": 0.2, "high": 5.0},
    "armature": {"unit": "kg m2", "std": 0.02, "low": 0.001, "high": 0.3, "scaling": "log"},
    "damping": {"unit": "N m s/rad", "std": 0.6, "low": 0.01, "high": 10.0, "scaling": "log"},
    "frictionloss": {"unit": "N m", "std": 0.1, "low": 1e-6, "high": 2.0, "scaling": "log", "log_offset": 0.02},
}
LINKS = ("upper_arm", "lower_arm", "wrist", "gripper")
LINK_STD = 0.2  # prior of each number of a link's inertia, share of the value
CENTRE_STD = 0.01  # m
DRAWS = 100
DELAY = {"sensor": "time_offset", "std": 0.005, "high": 0.05}


@dataclass(frozen=True)
class RealSo101:
    """Fit the SO-101 arm to positions of two motions, test it on four others.

    data: folder with the motions.
    bodies: fit with the links' inertias, in place of the plain fit.
    gap: search what 24 parameters with MuJoCo's default friction lack, in place of the fit; half an hour or more.
    budget: minutes after which that search tries no further candidate; 0: none.
    quick: the first seconds of a motion to fit and of a test motion, and a short search; its numbers are not to be
        reported.
    seconds: of each motion, from its start.
    out: folder for real_so101.json, and for the runs below `real_so101_runs`.
    seed: of the search.
    """

    data: Path
    gap: bool = False
    bodies: bool = False
    budget: float = 0.0
    quick: bool = False
    seconds: float = SECONDS
    out: Path = RESULTS
    seed: int = 0


def so101_log(folder: Path, motion: str, seconds: float) -> Recording:
    """One motion's first seconds on a regular clock, by the stamps of both tables."""
    if not (folder / motion).is_dir():
        raise FileNotFoundError(f"no folder {folder / motion}; --data is the folder that holds the motions. {SOURCE}")
    recording = load_recording(folder / motion, columns=HERE / "so101.toml", name=motion)
    return recording.window(0.0, seconds) if seconds < recording.duration else recording


def scene_of(folder: Path) -> Path:
    """The arm's MJCF."""
    path = folder / "so101_air.xml"
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; --data is the folder that holds the arm's MJCF. {SOURCE}")
    return path


def parameters_of_joints(path: Path) -> Path:
    """The parameter file of the search."""
    joints = [*JUDGED, "Jaw"]
    lines = [
        {"name": what, "each": True, **line}
        | ({"servo": joints} if what == "kp" else {"field": f"dof_{what}", "element": joints})
        for what, line in OF_A_JOINT.items()
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([*lines, DELAY], indent=1))
    return path


def with_held_friction(config: RealSo101, parameters: Path, extended: Path, logs: list[Recording]) -> dict[str, float]:
    """mrad, mean absolute error of the first five joints over whole motions: the search's values and hard friction."""
    scene = load_scene(scene_of(config.data), friction_joints=friction_joints(parameters), hold=True)
    space, known = load_parameters(parameters, scene), json.loads(extended.read_text())["values"]
    values = space.values({name: known[name] for name in space.names})
    replays = evaluate_on(scene, space, logs, before=values, after=values, engine="mujoco")
    return {r.recording.name: _mrad(r.errors["position"].mae_after) for r in replays}


def _mrad(errors: Any) -> float:
    return round(1e3 * float(np.mean(errors[: len(JUDGED)])), 3)


def searched(config: RealSo101) -> dict[str, Any]:
    """Result of `gap` on the four motions, and the errors of all six motions, of the first five joints."""
    seconds = 15.0 if config.quick else config.seconds
    of = {motion: so101_log(config.data, motion, seconds) for motion in (*JUDGES, *FIT)}
    runs = runs_of(config)
    paths = kept(list(of.values()), runs / "logs_of_all_joints")
    options = ["--effects", "soft_friction"] if config.quick else []
    options += ["--budget", str(config.budget)] if config.budget else []
    began, parameters = time.monotonic(), parameters_of_joints(runs / "so101_24.json")
    fit, judges = [paths[m] for m in JUDGES], [paths[m] for m in FIT]
    own = ["--joint-friction", "scene", "--seed", str(config.seed)]
    few = ["--generations", "3"] if config.quick else []
    fitted(scene_of(config.data), parameters, fit, judges, runs / "identify_24", [*own, *few])
    command(
        ["gap", "--scene", scene_of(config.data), "--parameters", parameters, *own, *options,
         "--fit", runs / "identify_24", "--recording", *fit, "--test-recording", *judges, "--out", runs / "gap"]
    )  # fmt: skip
    found = json.loads((runs / "gap" / GAP).read_text())
    mae = {
        when: {name: _mrad(e["position"][f"mae_{when}"]) for name, e in found["open_loop"]["errors"].items()}
        for when in ("before", "after")
    }
    mae["held"] = with_held_friction(config, parameters, runs / "gap" / EXTENDED, list(of.values()))
    before, after, held = (float(np.mean([mae[when][name] for name in JUDGES])) for when in mae)
    return {
        **common.origin(config.seed),
        "recordings": {r.name: r.sha256 for r in of.values()},
        **{key: found[key] for key in ("verdict", "sentence", "p", "effects", "indistinguishable", "hints", "doubts")},
        "limits": found["split"]["limits"],
        "coefficients": found["coefficients"],
        "discrepancies": found["discrepancies"],
        "mae_mrad_before": mae["before"],
        "mae_mrad": mae["after"],
        "mae_mrad_with_held_friction": mae["held"],
        "mean_of_the_four_mrad_before": round(before, 3),
        "mean_of_the_four_mrad": round(after, 3),
        "share_closed_of_the_four": round(1.0 - after / before, 4),
        "share_that_held_friction_closes": round(1.0 - held / before, 4),
        "ranking": found["score_tests"][0]["ranking"][:8],
        "validation_tests": found["validation_tests"],
        "not_tried": found["not_tried"],
        "seconds_of_stages": found["seconds"],
        "seconds": round(max(time.monotonic() - began, sum(found["seconds"].values())), 1),
    }


def parameters_with_links(path: Path, model: mujoco.MjModel, possible: bool) -> Path:
    """The parameter file of the fit with the inertia of LINKS as nuisances, as possible bodies or freely."""
    entries = json.loads((HERE / "so101.json").read_text())
    shared: dict[str, Any] = {"nuisance": True, "group": "Inertia"}
    for link in LINKS:
        if possible:
            entries.append({"inertia": link, "std": LINK_STD, **shared})
            continue
        of = model.body(link)
        entries.append(_entry("body_mass", link, float(of.mass[0]), "kg"))
        for axis in range(3):
            centre = {"std": CENTRE_STD, "low": of.ipos[axis] - 0.1, "high": of.ipos[axis] + 0.1, "unit": "m"}
            named = {"field": "body_ipos", "name": f"{link}_centre_{axis}", "element": link, "column": axis}
            entries.append({**named, **centre, **shared})
            entries.append(_entry("body_inertia", link, float(of.inertia[axis]), "kg m2", column=axis))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(entries, indent=1))
    return path


def _entry(field: str, link: str, value: float, unit: str, **column: int) -> dict[str, Any]:
    """A number of a link that is positive."""
    width = {"std": LINK_STD * value, "low": 0.1 * value, "high": 10.0 * value, "unit": unit, "scaling": "log"}
    name = "_".join([link, field, *map(str, column.values())])
    return {"field": field, "name": name, "element": link, **column, **width, "nuisance": True, "group": "Inertia"}


@dataclass(frozen=True)
class Tested:
    """A fit to FIT, tested on JUDGES.  logs: of both.  mae: mrad by motion, before and after."""

    logs: list[Recording]
    folder: Path
    found: dict[str, Any]
    seconds: float
    mae: dict[str, dict[str, float]]
    judges: tuple[str, ...]

    def mean_judged(self, when: str) -> float:
        """mrad, over the test motions."""
        return round(float(np.mean([self.mae[when][name] for name in self.judges])), 3)


def runs_of(config: RealSo101) -> Path:
    """Folder of the runs."""
    return config.out / ("real_so101_quick_runs" if config.quick else "real_so101_runs")


def tested(config: RealSo101, parameters: Path, kind: str = "") -> Tested:
    """The fit of a parameter file, in folders whose names end with `kind`."""
    seconds = 4.0 if config.quick else config.seconds
    fit, judges = (FIT[:1], JUDGES[:1]) if config.quick else (FIT, JUDGES)
    logs = [so101_log(config.data, motion, seconds) for motion in (*fit, *judges)]
    runs = runs_of(config)
    paths, folder = kept(logs, runs / "logs"), runs / f"identify{kind}"
    options = ["--joints", *JUDGED, "--effects", *EFFECTS, "--seed", str(config.seed)]
    options += ["--generations", "3"] if config.quick else []
    given, test = ([paths[name] for name in names] for names in (fit, judges))
    found, took = fitted(scene_of(config.data), parameters, given, test, folder, options)
    errors = evaluated(folder, [*given, *test], runs / f"evaluation{kind}")["errors"]
    mae = {
        when: {name: _mrad(of["position"][f"mae_{when}"]) for name, of in errors.items()}
        for when in ("before", "after")
    }
    return Tested(logs, folder, found, round(took, 1), mae, judges)


def with_links(config: RealSo101) -> dict[str, Any]:
    """Both fits with the links' inertias: errors of the first five joints, and draws that are possible bodies."""
    scene, out = load_scene(scene_of(config.data), joints=JUDGED), dict[str, Any]()
    files = {
        kind: parameters_with_links(runs_of(config) / f"so101_{kind}.json", scene.model, kind == "possible_bodies")
        for kind in ("possible_bodies", "free_entries")
    }
    # Read here, so that errors in them are raised before anything takes long.
    spaces = {kind: load_parameters(file, scene) for kind, file in files.items()}
    for kind, parameters in files.items():
        fit = tested(config, parameters, f"_{kind}")
        gaussian, full = load_gaussian(fit.folder / FULL_GAUSSIAN), spaces[kind]
        space = full.select(n for n in gaussian.space.names if n in full.names)
        draws = gaussian.sample(config.seed, DRAWS)[:, gaussian.space.columns(space)]
        of_links = [p for p in fit.found["parameters"] if p["group"] == "Inertia"]
        out[kind] = {
            "mean_judged_mrad": fit.mean_judged("after"),
            "mae_mrad": fit.mae["after"],
            **possible_bodies(scene, space, draws, LINKS),
            "numbers_of_links": len(of_links),
            "not_identifiable": [p["name"] for p in of_links if not p["identifiable"]],
            "seconds": fit.seconds,
        }
    return out


def main(config: RealSo101) -> None:
    """One fit tested on four motions, fits with the links' inertias, or one search; prints one line of JSON."""
    if config.gap and config.bodies:
        raise ValueError("--gap and --bodies are two experiments: give one of them")
    name = "real_so101_quick" if config.quick else "real_so101"
    path = config.out / f"{name}.json"
    known = json.loads(path.read_text()) if path.is_file() else {}
    if config.gap:
        known["gap"] = searched(config)
        write_json(path, known, indent=2)
        print(json.dumps({"gap": known["gap"]}))
        return
    if config.bodies:
        known["links"] = {**common.origin(config.seed), **with_links(config)}
        write_json(path, known, indent=2)
        print(json.dumps({"links": known["links"]}))
        return
    fit = tested(config, HERE / "so101.json")
    result = {
        "experiment": "real_so101",
        "source": SOURCE,
        "recordings": {r.name: r.sha256 for r in fit.logs},
        "seconds_of_each_motion": {r.name: round(r.duration, 2) for r in fit.logs},
        "mean_judged_mrad": fit.mean_judged("after"),
        "mean_judged_mrad_before": fit.mean_judged("before"),
        "mae_mrad": fit.mae["after"],
        "mae_mrad_before": fit.mae["before"],
        "effects": list(EFFECTS),
        "tied": [],
        "parameters": parameters_of(fit.found),
        "seconds": fit.seconds,
        **{key: known[key] for key in ("gap", "links") if key in known},
    }
    common.publish(config.out, "real_so101", config.quick, config.seed, result)


if __name__ == "__main__":
    run(lambda: main(tyro.cli(RealSo101, description=__doc__)))
