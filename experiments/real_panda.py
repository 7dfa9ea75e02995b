"""A real Panda: friction of its joints from one measured motion, tested on the part that was not fitted.

    python experiments/real_panda.py --data DIR            # one to two minutes on two cores
    python experiments/real_panda.py --data DIR --quick    # does it all work?

The measured motion is replayed in inverse mode through the bare arm (link side, gravity in) and viscous
damping, Coulomb friction and offset of every joint are identified as observation parameters of the
link-side torque, by CMA-ES and Gauss-Newton, on the first two thirds; the last third is the test data.  Four
models are fitted and reported:

- friction: the three terms and nothing else.
- inertia:  friction, and a term proportional to acceleration.  In theory it is zero, because the rotor's inertia acts
  on the motor side of the sensor; its fitted value shows how wrong the link inertias are.
- links:    friction, with link masses (3 %) and centres of mass (5 mm) as nuisances, marginalised.
- bodies:   friction, with the whole inertia of each link as ten numbers that are physically consistent at every value
  (`model/inertia.py`), marginalised; draws of its Gaussian are checked in compiled models.

`links` is the main model, since nuisances are on everywhere in this program except in the paper's preset: an error of
2 % in gravity torques of 20 N m is as large as the friction to be identified.

Data: C. Gaz, M. Cognetti, A. Oliva, P. Robuffo Giordano, A. De Luca, Dynamic identification of the
Franka Emika Panda robot with retrieval of feasible parameters using penalty-based optimization,
RA-L 2019; github.com/marcocognetti/FrankaEmikaPandaDynModel, matlab/data/Exciting_Traj/Trajectory_1.
DIR holds panda_exciting_traj1.npz with t [T] s, q [T, 7] rad and tau [T, 7] N m, and
reference_values.json with the published friction.  They are not part of this repository.

Filter, fixed beforehand: position at 8 Hz (zero-phase Butterworth, order 4) before it is
differentiated, measured and simulated torque at 8 Hz.  Rows that only repeat the one before are left
out, the rest is interpolated to a regular 1 kHz.  The measured velocity lags and is not used.
The commanded motion has a period of 13.3 s, so that the last third repeats a fitted motion: it tests noise, drift and
fit, not other motions.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tuned  # noqa: F401  before anything that imports jax

# isort: split
import jax.numpy as jnp
import numpy as np
import tyro
from inverse_fit import (
    LEVEL,
    RESULTS,
    Estimate,
    clock_of,
    draw_fit,
    estimate,
    find,
    inverse_cost,
    make_recording,
    possible_bodies,
    publish,
    read_npz,
    resampled,
    residual,
    rms,
    rounded,
    run,
    share_at_rest,
    table,
)

from droid_jax.cost.cost import Cost
from droid_jax.cost.noise import DEFAULT_NOISE, correlation_time
from droid_jax.door.scene import ARM, panda_arm_scene
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effect_interface import Effect, Rollout, Theta
from droid_jax.model.fields import body_mass_scale, model_parameter
from droid_jax.model.inertia import inertia_parameters
from droid_jax.model.joint_friction import SMOOTHING, joint_friction_space
from droid_jax.model.parameters import Mode, Parameter, Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.report import style
from droid_jax.report.text import label
from droid_jax.simulate.measured_motion import OVERSAMPLING
from droid_jax.simulate.rest import RestConfig

FILE, REFERENCE = "panda_exciting_traj1.npz", "reference_values.json"
SOURCE = (
    "Gaz et al., RA-L 2019: github.com/marcocognetti/FrankaEmikaPandaDynModel, "
    "matlab/data/Exciting_Traj/Trajectory_1, converted to npz."
)
LINKS = tuple(f"link{i}" for i in range(1, 8))
MODELS = ("friction", "inertia", "links", "bodies")
LEADING = "links"
MOTION_CUTOFF = 8.0  # Hz
LOG_RATE = 1000.0  # Hz
SHARE = 2 / 3  # of the log that is fitted
BLOCK = 2.5  # s, contiguous blocks behind the intervals
BODY_STD = 0.2  # prior of each of the ten numbers of a link's inertia; 0.05 holds back more than `links` does
DRAWS = 500  # of the Gaussian, whose bodies are checked
SCALE_STD, COM_STD, COM_LIMIT = 0.03, 0.005, 0.05  # prior of a link's mass (-) and centre of mass (m)
OTHER_COM_STD = (0.002, 0.010)  # m, to see how much hangs on that prior
CLOSE = 0.4  # of the published values
NOT_FRICTION = ("panda_joint2",)  # its residual is mostly gravity and inertia, not friction


@dataclass(frozen=True)
class RealPanda:
    """Identify the joint friction of a real Panda from its log.

    data: folder with panda_exciting_traj1.npz and reference_values.json.
    out: folder for real_panda.json and real_panda.png.
    quick: the friction model alone and a short search; its numbers are not to be reported.
    seed: of the search.
    """

    data: Path
    out: Path = RESULTS
    quick: bool = False
    seed: int = 0


# Measurement -------------------------------------------------------------------------------


def load_panda(folder: Path) -> Recording:
    """The log as a recording: link side, gravity in, no commands, regular 1 kHz."""
    data = read_npz(folder, FILE, ("t", "q", "tau"), SOURCE)
    time, shape = data["t"].ravel(), (data["t"].size, len(ARM))
    for key in ("q", "tau"):
        if data[key].shape != shape:
            raise ValueError(f"{Path(folder) / FILE}: expected {key} of shape {shape}, got {data[key].shape}")
    clock = np.arange(int((time[-1] - time[0]) * LOG_RATE) + 1) / LOG_RATE
    q, tau = (resampled(time - time[0], data[key], clock) for key in ("q", "tau"))
    return make_recording("panda", ARM, clock, q, tau, TorqueConvention(TorqueSide.LINK, gravity=True))


def load_published(folder: Path) -> dict[str, list[float]]:
    """The published viscous, Coulomb and offset terms of this log: fv_OSI, fc_OSI, fo_OSI, fv_CLS, ..."""
    path = Path(folder) / REFERENCE
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; --data is the folder that holds it. {SOURCE}")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["gaz2019_linear_from_THIS_trajectory"]
        return {f"{term}_{rule}": found[f"{term}_{rule}"] for rule in ("OSI", "CLS") for term in ("fv", "fc", "fo")}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the expected table of friction values ({error!r})") from None


# Models ------------------------------------------------------------------------------------


def inertia_effect(joints: Sequence[str]) -> Effect:
    """An effect of this experiment: adds `inertia[joint]` times the joint's acceleration to the torque."""

    def observe(theta: Theta, rollout: Rollout) -> Rollout:
        step = (rollout.time[-1] - rollout.time[0]) / (len(rollout.time) - 1)
        acceleration = jnp.gradient(rollout.velocity, axis=0) / step
        inertia = jnp.stack([jnp.asarray(theta.get(f"inertia[{j}]", 0.0), jnp.float32) for j in joints])
        return replace(rollout, torque=rollout.torque + inertia * acceleration)

    return Effect("link-side inertia", observe=observe)


def inertia_space(joints: Sequence[str]) -> Space:
    """`inertia[joint]`, kg m^2, zero at first."""
    return Space(tuple(Parameter(f"inertia[{j}]", "kg m^2", 0.0, 0.1, -1.0, 1.0) for j in joints))


def link_nuisances(scene: Scene) -> Space:
    """Mass and centre of mass of every link, with a prior about the nominal ones."""
    note: dict[str, Any] = dict(nuisance=True, group="Nuisance")
    masses = [body_mass_scale(scene, link, std=SCALE_STD, **note) for link in LINKS]
    centres = [
        model_parameter(scene, "body_ipos", link, axis, name=f"{link}_com_{'xyz'[axis]}", unit="m", std=COM_STD,
                        low=-COM_LIMIT, high=COM_LIMIT, mode=Mode.ADD, **note)
        for link in LINKS
        for axis in range(3)
    ]  # fmt: skip
    return Space((*masses, *centres))


def link_bodies(scene: Scene) -> Space:
    """The whole inertia of every link."""
    each = (inertia_parameters(scene, link, std=BODY_STD, nuisance=True, group="Nuisance") for link in LINKS)
    return Space(tuple(p for parameters in each for p in parameters))


def model_space(scene: Scene, model: str) -> Space:
    """The parameters of one of MODELS."""
    friction = joint_friction_space(scene.joints)
    if model == "inertia":
        return friction + inertia_space(scene.joints)
    more = {"links": link_nuisances, "bodies": link_bodies}.get(model)
    return friction if more is None else friction + more(scene)


# Fit ---------------------------------------------------------------------------------------


def cut(recording: Recording) -> tuple[Recording, Recording]:
    """The part to fit and the test data."""
    first, last = recording.span
    split = first + SHARE * (last - first)
    return recording.window(first, split), recording.window(split, last)


def fit_models(scene: Scene, parts: tuple[Recording, Recording], config: RealPanda) -> dict[str, Any]:
    """For every model: estimate, residuals [K, J] on both parts before and after, history of the search."""
    out: dict[str, Any] = {}
    friction = np.empty(0)
    for model in MODELS[:1] if config.quick else MODELS:
        space = model_space(scene, model)
        inertia = inertia_effect(scene.joints)
        fitted, judge = (inverse_cost(scene, space, part, MOTION_CUTOFF, [inertia]) for part in parts)
        print(f"{model}: {len(space)} parameters", flush=True)
        if model == "friction":
            search = CmaConfig(population=64, parents=None, generations=60 if config.quick else 400, seed=config.seed)
            start = find(fitted, space, search)
            friction = start.best
            out["search"] = {"generations": len(start.history.sigma), "stop": start.stop}
        found = estimate(fitted, space, np.r_[friction, space.mean[len(friction) :]], BLOCK)
        if model == "friction":
            friction = found.best
        names = {"fitted": fitted, "held_out": judge}
        out["held_out_clock"] = clock_of(judge)
        out[model] = {
            "estimate": found,
            "before": {k: residual(cost, space.mean) for k, cost in names.items()},
            "after": {k: residual(cost, found.best) for k, cost in names.items()},
        }
        if model == "links":
            out["other_priors"] = other_priors(fitted, judge, space, friction)
            out["set_valued"] = set_valued(scene, space, parts, found.best)
    return out


def set_valued(scene: Scene, space: Space, parts: tuple[Recording, Recording], start: np.ndarray) -> dict[str, Any]:
    """The fit from `start` [D] under the program's own law, in which friction at rest is an interval."""
    inertia = inertia_effect(scene.joints)
    fitted, judge = (inverse_cost(scene, space, part, MOTION_CUTOFF, [inertia], RestConfig()) for part in parts)
    found = estimate(fitted, space, start, BLOCK)
    return {"estimate": found, "judge": judge, "share_at_rest": share_at_rest(fitted), "start": start}


def other_priors(fitted: Cost, judge: Cost, space: Space, friction: np.ndarray) -> list[dict[str, Any]]:
    """The links model under other priors of the centres of mass: held-out ratio and Coulomb friction."""
    start = np.r_[friction, space.mean[len(friction) :]]
    before = rms(residual(judge, space.mean))
    rows = []
    for std in OTHER_COM_STD:
        other = space.with_prior(**{n: (0.0, std) for n in space.names if "_com_" in n})
        best = estimate(fitted, other, start, BLOCK).best
        coulomb = [best[other.index(f"coulomb[{j}]")] for j in ARM]
        ratio = rms(residual(judge, best)) / before
        rows.append({"com_std_m": std, "held_out_ratio": rounded(ratio, 3), "coulomb_Nm": rounded(coulomb)})
    return rows


# Result ------------------------------------------------------------------------------------


def against_published(found: Estimate, published: dict[str, list[float]]) -> dict[str, Any]:
    """Fitted Coulomb friction of every joint beside the published values of this log."""
    entries = {e["name"]: e for e in table(found)}
    coulomb = [entries[f"coulomb[{j}]"] for j in ARM]
    values = np.array([e["value"] for e in coulomb])
    ratio = {rule: values / np.array(published[f"fc_{rule}"]) for rule in ("OSI", "CLS")}
    close = np.all([np.abs(r - 1) <= CLOSE for r in ratio.values()], axis=0)
    return {
        "value_Nm": rounded(values),
        "interval_Nm": [rounded(e["interval"]) for e in coulomb],
        "published_OSI_Nm": published["fc_OSI"],
        "published_CLS_Nm": published["fc_CLS"],
        "over_OSI": rounded(ratio["OSI"], 3),
        "over_CLS": rounded(ratio["CLS"], 3),
        "within_40_percent_of_both": [bool(c) for c in close],
    }


def summary(parts: dict[str, Any], published: dict[str, list[float]]) -> dict[str, Any]:
    """One model's result as JSON values."""
    before, after = (rms(parts[k]["held_out"]) for k in ("before", "after"))
    close = against_published(parts["estimate"], published)
    others = [c for c, j in zip(close["within_40_percent_of_both"], ARM, strict=True) if j not in NOT_FRICTION]
    left = parts["after"]["fitted"]
    return {
        "held_out_rms_before_Nm": rounded(before),
        "held_out_rms_after_Nm": rounded(after),
        "held_out_ratio": rounded(after / before, 3),
        "fitted_rms_before_Nm": rounded(rms(parts["before"]["fitted"])),
        "fitted_rms_after_Nm": rounded(rms(left)),
        "joints_halved": int(np.sum(after <= 0.5 * before)),
        "coulomb": close,
        "coulomb_close_but_joint_2": all(others),
        "correlation_time_s": rounded(correlation_time(left), 2),
        "width_rule": parts["estimate"].gaussian.rule,
        "parameters": table(parts["estimate"]),
    }


def at_rest(held: dict[str, Any], published: dict[str, list[float]]) -> dict[str, Any]:
    """The fit under the set-valued law as JSON values, and the residuals of the other fit under that law."""
    found, judge = held["estimate"], held["judge"]
    return {
        "share_at_rest": held["share_at_rest"],
        "coulomb": against_published(found, published),
        "held_out_rms_Nm": rounded(rms(residual(judge, found.best))),
        "held_out_rms_without_its_fit_Nm": rounded(rms(residual(judge, held["start"]))),
    }


def show(model: str, result: dict[str, Any]) -> None:
    """Print a few lines about the result."""
    for key in ("held_out_rms_before_Nm", "held_out_rms_after_Nm", "held_out_ratio"):
        print(f"  {key:24s} {'  '.join(f'{v:6.3f}' for v in result[key])}")
    for key in ("value_Nm", "over_OSI", "over_CLS"):
        print(f"  {'Coulomb ' + key:24s} {'  '.join(f'{v:6.3f}' for v in result['coulomb'][key])}")
    silent = [p["name"] for p in result["parameters"] if not p["identifiable"] and not p["nuisance"]]
    print(
        f"  {model}: {result['joints_halved']} of 7 joints halved; not identifiable from this log: "
        f"{', '.join(silent) or '-'}"
    )


def residual_figure(time: np.ndarray, models: dict[str, dict[str, Any]], leading: str) -> Any:
    """Held-out torque that rigid bodies do not explain, and its prediction by each model."""
    measured = models[leading]["before"]["held_out"]
    plain = models["friction"]
    lines = {"friction": (measured - plain["after"]["held_out"], style.BEFORE)}
    if leading != "friction":
        name = "friction, link masses marginalised"
        lines[name] = (measured - models[leading]["after"]["held_out"], style.AFTER)
    return draw_fit(time, [label(j) for j in ARM], measured, lines, "Torque beyond\nrigid body [N m]")


def main(config: RealPanda) -> None:
    """Fit the first two thirds, test on the last, write figure and JSON."""
    published = load_published(config.data)
    recording = load_panda(config.data)
    scene = panda_arm_scene()
    parts = cut(recording)
    fits = fit_models(scene, parts, config)
    search, others, clock = fits.pop("search"), fits.pop("other_priors", []), fits.pop("held_out_clock")
    held = fits.pop("set_valued", None)
    bodies = None
    if "bodies" in fits:
        found = fits["bodies"]["estimate"]
        bodies = possible_bodies(scene, found.space, found.gaussian.sample(config.seed, DRAWS), LINKS)
    results = {model: summary(fit, published) for model, fit in fits.items()}
    for model, result in results.items():
        show(model, result)
    leading = LEADING if LEADING in results else MODELS[0]
    lead = results[leading]
    rigid = np.concatenate([fits["friction"]["before"][k] for k in ("fitted", "held_out")])
    result = {
        "experiment": "real_panda",
        "quick": config.quick,
        "source": SOURCE,
        "recording": recording.sha256,
        "filter": {
            "position": f"zero-phase Butterworth, order 4, {MOTION_CUTOFF:g} Hz, then central differences at 1 kHz",
            "torque": f"windowed sinc, {DEFAULT_NOISE.cutoff:g} Hz, measured and simulated alike",
            "simulated_at_hz": OVERSAMPLING * MOTION_CUTOFF,
            "sign_smoothed_over_rad_s": SMOOTHING,
        },
        "fitted_s": rounded(parts[0].span, 3),
        "held_out_s": rounded(parts[1].span, 3),
        "caveat": "the commanded motion has a period of 13.3 s: the held-out part repeats a fitted motion",
        "rigid_body_rms_whole_Nm": rounded(rms(rigid)),
        "search": search,
        "intervals": {
            "level": LEVEL,
            "block_s": BLOCK,
            "noise": "RMS that the friction model leaves, times the root of the samples it stays correlated for",
        },
        "leading_model": leading,
        "joints_halved_by_model": {model: r["joints_halved"] for model, r in results.items()},
        "models": results,
        "links_under_other_priors": others,
        "possible_bodies": bodies,
        "friction_at_rest": None if held is None else at_rest(held, published),
        "targets": {
            "held_out_halved_on_most_joints": lead["joints_halved"] >= 4,
            "coulomb_within_40_percent_but_joint_2": lead["coulomb_close_but_joint_2"],
        },
    }
    publish(config.out, "real_panda", config.quick, config.seed, result, residual_figure(clock, fits, leading))


if __name__ == "__main__":
    run(lambda: main(tyro.cli(RealPanda, description=__doc__)))
