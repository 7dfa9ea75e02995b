"""Compares a fitted result, applied without jax, with the program's replay on motions that were not fitted.

    python benchmarks/neutral_result.py --fit door runs/all/gap --recording door runs/all/recordings/A.npz

For each fit (a folder of `identify` or `gap`) it writes the neutral result, steps it in plain C MuJoCo in a process
that cannot import jax (`neutral_replay.py`), and compares positions and motor torques with the replay in MJX.  The
tolerance is the difference of both engines without the laws, with C at finer steps and at the replay's steps.  It also
draws from fitted.json and compares mean and covariance with those of the Gaussian.  Other cases in the file are kept.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import common
import numpy as np
import tyro

HERE = Path(__file__).resolve().parent
EXPERIMENTS = HERE.parent / "experiments"
XL330_GAIN, XL330_MOTION = 200, "sin_sin"
DRAWS = 100


@dataclass(frozen=True)
class NeutralResult:
    """Compare fitted results in plain MuJoCo with the replay."""

    fit: dict[str, Path] = field(default_factory=dict)
    """Folders of finished fits by name of the case."""
    recording: dict[str, Path] = field(default_factory=dict)
    """For each case by name, a recording that its fit did not see."""
    scene: dict[str, Path] = field(default_factory=dict)
    """MJCF by name of the case, if it has moved since the fit."""
    xl330: Path | None = None
    """Folder of the logs of Rhoban/bam, for the case xl330, whose fit is experiments/results/real_xl330.json."""
    fine: int = 8
    """Steps of C in one of the replay's."""
    seed: int = 0
    """Seed of the draws."""
    out: Path = HERE / "results"
    """Folder for neutral_result.json."""
    quick: bool = False
    """Write neutral_result_quick.json."""


def without_laws(effects: tuple[Any, ...]) -> tuple[Any, ...]:
    """Effects that only change the model's numbers."""
    bare = dict(profile=None, command=None, servo=None, force=None, frictionloss=None, observe=None)
    return tuple(replace(e, **bare) for e in effects)


def of_folder(fit: Path, recording: Path, scene: Path | None) -> tuple[Any, Any, Any, bool]:
    """The fitted model of a folder, its Gaussian, a recording, and whether the recording is held out."""
    from droid_jax.commands.fitted import load_fitted
    from droid_jax.recordings.formats import load_recording

    fitted, given = load_fitted(fit, scene), load_recording(recording)
    return fitted, gaussian_of(fit, fitted), given, held_out(fit, given, fitted)


def of_xl330(data: Path) -> tuple[Any, Any, Any, bool]:
    """The same for the servo with load-dependent friction, from values in experiments/results/real_xl330.json.

    The Gaussian is made from the intervals there, without correlations.  Two gains were fitted; the log has the third.
    """
    sys.path.insert(0, str(EXPERIMENTS))
    from xl330_logs import xl330_log

    from droid_jax.identify.gaussian import Gaussian
    from droid_jax.model.effects.registry import joined, library, ready
    from droid_jax.model.parameter_file import load_parameters
    from droid_jax.model.scene import load_scene

    kept = json.loads((EXPERIMENTS / "results" / "real_xl330.json").read_text())
    fold = next(fold for fold in kept["folds"] if fold["judge_kp"] == XL330_GAIN)["parameters"]
    scene = load_scene(EXPERIMENTS / "xl330.xml")
    effects = library(scene, kept["effects"])
    space = joined(load_parameters(EXPERIMENTS / "xl330.json", scene), effects)
    values = space.values({name: fold[name]["best"] for name in space.names if name in fold})
    half = np.array([np.ptp(fold[name]["interval"]) / 2 if name in fold else 1e-6 for name in space.names])
    gaussian = Gaussian(space, values, np.diag((half / 1.645) ** 2), "intervals of real_xl330.json", "physical")
    fitted = SimpleNamespace(scene=ready(scene), space=space, effects=effects, after=values)
    return fitted, gaussian, xl330_log(data, XL330_MOTION, XL330_GAIN), True


def compare(
    fitted: Any, gaussian: Any, recording: Any, unseen: bool, fine: int, seed: int, runs: Path
) -> dict[str, Any]:
    """One case."""
    from droid_jax.identify.neutral_result import write_neutral
    from droid_jax.recordings.recording import TorqueConvention, TorqueSide

    motor = TorqueConvention(TorqueSide.MOTOR, gravity=False)
    given = replace(recording, torque=motor)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        write_neutral(folder, fitted.scene, gaussian, fitted.after, fitted.effects, main="fitted.xml")
        drive, full = replayed(fitted, given, fitted.effects, runs)
        _, bare = replayed(fitted, given, without_laws(fitted.effects), runs)
        with_laws = differences(fitted, drive, full, folder, fine, laws=True)
        tolerance = differences(fitted, drive, bare, folder, fine, laws=False)
        own_step = differences(fitted, drive, full, folder, 1, laws=True)
        own_tolerance = differences(fitted, drive, bare, folder, 1, laws=False)
        matter = {
            name: float(np.abs(getattr(full, name) - getattr(bare, name)).max()) for name in ("position", "torque")
        }
        return {
            "recording": given.name,
            "held_out": unseen,
            "effects": sorted({law["effect"] for law in content(folder)["laws"]}),
            "without_table": [e for e in content(folder)["not_in_mjcf"] if "depends on" in e["why"]],
            "in_place": content(folder)["mjcf"]["in_place"],
            "table_error": {law["effect"]: law["error"] for law in content(folder)["laws"]},
            "largest_difference": with_laws,
            "tolerance": tolerance,
            "largest_difference_at_own_step": own_step,
            "tolerance_at_own_step": own_tolerance,
            "effect_of_the_laws": matter,
            "draws": draws_agree(folder, gaussian, seed),
        }


def content(folder: Path) -> dict[str, Any]:
    from droid_jax.identify import apply_fit

    return apply_fit.load(folder / "fitted.json")


def gaussian_of(fit: Path, fitted: Any) -> Any:
    """Of all fitted parameters."""
    from droid_jax.commands.fitted import fitted_folder
    from droid_jax.identify.extended_model import load_extended
    from droid_jax.identify.gaussian import load_gaussian

    stage, folder = fitted_folder(fit)
    if stage == "gap":
        return load_extended(folder / "extended.json", fitted.scene).gaussian
    return load_gaussian(folder / "gaussian_full.json")


def held_out(fit: Path, recording: Any, fitted: Any) -> bool:
    """Whether a recording was neither fitted nor used to choose effects."""
    from droid_jax.commands.fitted import fitted_folder

    stage, folder = fitted_folder(fit)
    if stage == "gap":
        return recording.name not in json.loads((folder / "gap.json").read_text())["final_model"]["fitted_to"]
    return recording.sha256 not in fitted.recordings


def replayed(fitted: Any, recording: Any, effects: tuple[Any, ...], runs: Path) -> tuple[Any, Any]:
    """The drive, and the replay in MJX at the fitted values, kept in a folder since compiling takes a minute."""
    import jax
    import jax.numpy as jnp

    from droid_jax import runtime
    from droid_jax.model.effect_interface import MOVING, has_law
    from droid_jax.model.physics import make_physics
    from droid_jax.simulate.replay import make_drive, servo_replay

    drive = make_drive(fitted.scene, recording, weigh=False)
    laws = sorted(e.name for e in effects if has_law(e, MOVING))
    numbers = hashlib.sha256(np.asarray(fitted.after).tobytes() + recording.sha256.encode() + str(laws).encode())
    kept = runs / f"{numbers.hexdigest()[:16]}.npz"
    if kept.is_file():
        return drive, SimpleNamespace(**np.load(kept))
    seen = without_observers(effects)
    replay = servo_replay(fitted.scene, drive, seen)

    def run(values: Any) -> Any:
        return replay(make_physics(fitted.scene, fitted.space, values))

    out = jax.jit(run, compiler_options=runtime.compiler_options())(jnp.asarray(fitted.after, jnp.float32))
    arrays = {name: np.asarray(getattr(out, name)) for name in ("position", "torque", "object_angle")}
    runs.mkdir(parents=True, exist_ok=True)
    np.savez(kept, **arrays)
    return drive, SimpleNamespace(**arrays)


def without_observers(effects: tuple[Any, ...]) -> tuple[Any, ...]:
    """The drive without observation effects."""
    return tuple(replace(e, observe=None) for e in effects)


def differences(fitted: Any, drive: Any, own: Any, folder: Path, fine: int, *, laws: bool) -> dict[str, float]:
    """Largest and root mean square difference of positions (rad or m) and motor torques (N m or N) to plain C.

    own: the replay in MJX.
    """
    from droid_jax.simulate.servo_gains import servo_factors

    values = dict(zip(fitted.space.names, fitted.after.tolist(), strict=True))
    ask = dict(
        command=drive.command, timestep=drive.timestep, qpos0=drive.qpos0, gains=servo_factors(fitted.scene, drive),
        fine=fine, time_offset=values.get("time_offset", 0.0), laws=int(laws), spec=0,
    )  # fmt: skip
    np.savez(folder / "ask.npz", **ask)
    paths = (folder, folder / "fitted.xml", folder / "ask.npz", folder / "answer.npz")
    subprocess.run([sys.executable, HERE / "neutral_replay.py", *paths], check=True)
    answer = np.load(folder / "answer.npz")
    assert not len(answer["foreign"]), answer["foreign"]
    scene = fitted.scene
    position = np.abs(answer["qpos"][:, scene.joint_qpos] - own.position)
    torque = np.abs(answer["torque"][:, scene.joint_dofs] - own.torque)
    out = {
        "position": float(position.max()), "position_rms": float(np.sqrt(np.mean(position**2))),
        "torque": float(torque.max()), "torque_rms": float(np.sqrt(np.mean(torque**2))),
    }  # fmt: skip
    if scene.object_joint:
        angle = np.abs(answer["qpos"][:, scene.qpos(scene.object_joint)] - own.object_angle)
        out |= {"object_angle": float(angle.max()), "object_angle_rms": float(np.sqrt(np.mean(angle**2)))}
    return out


def draws_agree(folder: Path, gaussian: Any, seed: int) -> dict[str, float]:
    """Mean and covariance of draws from fitted.json against those of `Gaussian.sample`, in sampling errors.

    mean: largest |z| over the parameters.  variance: smallest and largest ratio.  correlation: largest |z| of Fisher's
    transform.  Expected of sampling alone: 2.4 to 3 for the largest |z| of some 30 parameters.
    """
    from droid_jax.identify import apply_fit

    few = gaussian.space.to_search(apply_fit.draws(content(folder), range(DRAWS), seed))
    many = gaussian.space.to_search(gaussian.sample(seed + 1, 20_000))
    spread = many.std(axis=0)
    moving = spread > 1e-9
    z = (few.mean(axis=0) - many.mean(axis=0))[moving] / (spread[moving] / np.sqrt(DRAWS))
    ratio = few.var(axis=0, ddof=1)[moving] / spread[moving] ** 2
    one, two = (np.arctanh(np.clip(np.corrcoef(x[:, moving].T), -0.999999, 0.999999)) for x in (few, many))
    pairs = np.triu_indices(int(moving.sum()), 1)
    apart = np.abs(one - two)[pairs] * np.sqrt(DRAWS - 3)
    return {
        "draws": DRAWS, "parameters": int(moving.sum()), "mean_largest_z": float(np.abs(z).max()),
        "variance_ratio_low": float(ratio.min()), "variance_ratio_high": float(ratio.max()),
        "correlation_largest_z": float(apart.max(initial=0.0)), "correlation_rms_z": float(np.sqrt(np.mean(apart**2))),
    }  # fmt: skip


def main(config: NeutralResult) -> None:
    from droid_jax import runtime

    runtime.start()
    path = config.out / f"{common.stem('neutral_result', config.quick)}.json"
    runs = config.out / "neutral_result_runs"
    cases: dict[str, Any] = json.loads(path.read_text())["cases"] if path.is_file() else {}
    asked = {
        name: partial(of_folder, folder, config.recording[name], config.scene.get(name))
        for name, folder in config.fit.items()
    }
    if config.xl330 is not None:
        asked["xl330"] = partial(of_xl330, config.xl330)
    for name, case in asked.items():
        found = compare(*case(), config.fine, config.seed, runs)
        cases[name] = {"origin": common.origin(config.seed), **found}
        print(name, cases[name], flush=True)
    largest = {name: case["largest_difference"] for name, case in cases.items()}
    result = {
        "benchmark": "neutral_result",
        "commits": common.commits(cases.values()),
        "fine": config.fine,
        "largest_difference": largest,
        "cases": cases,
    }
    common.publish(config.out, "neutral_result", config.quick, config.seed, result)


if __name__ == "__main__":
    main(tyro.cli(NeutralResult, description=__doc__))
