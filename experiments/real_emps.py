"""EMPS, a real one-axis benchmark, in a scene of its own: mass and friction against published values.

    python experiments/real_emps.py --data DIR

The scene is `emps.xml`; the log is replayed in inverse mode on the motor side (force = gtau * vir) and
mass, viscous damping, friction loss and offset are identified from DATA_EMPS by CMA-ES and
Gauss-Newton.  The test data are DATA_EMPS_PULSES, another run with steps in its reference.

Data: A. Janot, M. Gautier, M. Brunot, Data Set and Reference Models of EMPS, Workshop on Nonlinear
System Identification Benchmarks, 2019 (nonlinearbenchmark.org).  DIR holds its two files converted
from mat to npz, DATA_EMPS.npz and DATA_EMPS_PULSES.npz, with t [s], qm [m], vir [V] and gtau [N/V].
They are not part of this repository.

Filter, fixed: position at 40 Hz (zero-phase Butterworth, order 4) before it is differentiated,
measured and simulated force at 8 Hz, as everywhere in this program.  Between 20 and 100 Hz the first
does not matter (mass within 0.1 %); at 8 Hz it would round off the jumps of acceleration and make the
mass 1 % too large.

Dry friction is loss * sgn(speed) at every sample, as in the published fit.  The program's own law, in which friction at
rest is any force up to the loss (docs/method.md), is fitted in addition: `friction_at_rest`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from inverse_fit import (
    LEVEL,
    RESULTS,
    SIGN_LAW,
    Estimate,
    clock_of,
    draw_fit,
    estimate,
    find,
    inverse_cost,
    make_recording,
    measured_torque,
    publish,
    read_npz,
    residual,
    rms,
    rounded,
    run,
    share_at_rest,
    table,
)

from droid_jax.cost.cost import Cost
from droid_jax.cost.noise import DEFAULT_NOISE, correlation_time
from droid_jax.identify.search import CmaConfig
from droid_jax.model.fields import body_mass, joint_damping, joint_frictionloss
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene, load_scene
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.report import style
from droid_jax.simulate.measured_motion import OVERSAMPLING
from droid_jax.simulate.rest import RestConfig

SLIDE = "slide"
FIT, JUDGE = "DATA_EMPS", "DATA_EMPS_PULSES"
SOURCE = "The EMPS benchmark (nonlinearbenchmark.org), converted from mat to npz, holds t, qm, vir and gtau."
PUBLISHED = {"carriage_mass": 95.1089, "slide_damping": 203.5034, "slide_frictionloss": 20.3935,
             f"torque_offset[{SLIDE}]": -3.1648}  # fmt: skip
MOTION_CUTOFF = 40.0  # Hz
BLOCK = 1.0  # s, contiguous blocks behind the intervals


@dataclass(frozen=True)
class RealEmps:
    """Identify the EMPS benchmark's carriage from its real log.

    data: folder with DATA_EMPS.npz and DATA_EMPS_PULSES.npz.
    quick: a short search; its numbers are not to be reported.
    out: folder for real_emps.json and real_emps.png.
    seed: of the search.
    """

    data: Path
    quick: bool = False
    out: Path = RESULTS
    seed: int = 0


def emps_scene() -> Scene:
    """The carriage on its slide."""
    return load_scene(Path(__file__).parent / "emps.xml", joints=[SLIDE])


def emps_space(scene: Scene) -> Space:
    """Mass, viscous damping, dry friction and constant offset, from the guesses of the MJCF."""
    return Space(
        (
            body_mass(scene, "carriage", std=30.0, high=300.0),
            joint_damping(scene, SLIDE, std=100.0, high=1000.0, unit="N s/m"),
            joint_frictionloss(scene, SLIDE, std=10.0, high=100.0, unit="N"),
            Parameter(f"torque_offset[{SLIDE}]", "N", 0.0, 5.0, -50.0, 50.0),
        )
    )


def load_emps(folder: Path, name: str) -> Recording:
    """One file of the benchmark as a recording: motor side, nothing to carry."""
    data = read_npz(folder, f"{name}.npz", ("t", "qm", "vir", "gtau"), SOURCE)
    time, position, voltage = (data[k].ravel() for k in ("t", "qm", "vir"))
    if not len(time) == len(position) == len(voltage):
        raise ValueError(
            f"{Path(folder) / name}.npz: t, qm and vir must be of one length, got "
            f"{len(time)}, {len(position)} and {len(voltage)}"
        )
    force = float(data["gtau"]) * voltage
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    return make_recording(name, [SLIDE], time, position[:, None], force[:, None], convention, unit=("m", "N"))


def make_costs(scene: Scene, space: Space, folder: Path, rest: RestConfig = SIGN_LAW) -> tuple[Cost, Cost]:
    """Costs of the file to fit and of the test file, under a law of friction at rest."""
    recordings = (load_emps(folder, name) for name in (FIT, JUDGE))
    fit, judge = (inverse_cost(scene, space, one, MOTION_CUTOFF, rest=rest) for one in recordings)
    return fit, judge


def set_valued(scene: Scene, space: Space, folder: Path, start: np.ndarray, published: Cost) -> dict[str, Any]:
    """The fit from `start` [D] under the set-valued law, tested under both laws.

    published: cost of the test file under the published law.
    """
    cost, judge = make_costs(scene, space, folder, RestConfig())
    found = estimate(cost, space, start, BLOCK)
    return {
        "share_at_rest": share_at_rest(cost),
        "parameters": against_published(found),
        f"{JUDGE}_by_this_law": accuracy(judge, found.best),
        f"{JUDGE}_by_the_published_law": accuracy(published, found.best),
        f"{JUDGE}_by_this_law_without_its_fit": accuracy(judge, start),
    }


def accuracy(cost: Cost, values: np.ndarray) -> dict[str, float]:
    """RMS of the force residual [N], and the residual's size relative to the measured force."""
    left, measured = residual(cost, values), measured_torque(cost)
    relative = float(np.linalg.norm(left) / np.linalg.norm(measured))
    return {"rms_N": round(float(rms(left)[0]), 3), "relative_error": round(relative, 4)}


def against_published(found: Estimate) -> dict[str, dict[str, Any]]:
    """Value, interval and relative error of every parameter, beside the published value."""
    return {
        entry["name"]: {
            **{k: entry[k] for k in ("unit", "value", "interval", "identifiable", "why")},
            "published": PUBLISHED[entry["name"]],
            "relative_error": round(entry["value"] / PUBLISHED[entry["name"]] - 1, 4),
        }
        for entry in table(found)
    }


def trace_figure(cost: Cost, before: np.ndarray, after: np.ndarray) -> Any:
    """Force of the test file, measured and simulated, before and after the fit."""
    measured = measured_torque(cost)
    lines = {
        "before the fit": (measured - residual(cost, before), style.BEFORE),
        "after the fit": (measured - residual(cost, after), style.AFTER),
    }
    label = f"Force below {DEFAULT_NOISE.cutoff:g} Hz [N]"
    return draw_fit(clock_of(cost), [f"{JUDGE} (not fitted)"], measured, lines, label)


def main(config: RealEmps) -> None:
    """Fit one file, test on the other, write figure and JSON."""
    scene = emps_scene()
    space = emps_space(scene)
    cost, judge = make_costs(scene, space, config.data)
    print(f"EMPS: {FIT} fitted, {JUDGE} judges", flush=True)
    generations = 10 if config.quick else 120
    search = find(cost, space, CmaConfig(population=32, parents=None, generations=generations, seed=config.seed))
    found = estimate(cost, space, search.best, BLOCK)
    parameters = against_published(found)
    for name, p in parameters.items():
        low, high = p["interval"]
        print(f"  {name:22s} {p['value']:9.3f} [{low:.3f}, {high:.3f}] {p['unit']:8s} published {p['published']:.3f}")
    result = {
        "experiment": "real_emps",
        "quick": config.quick,
        "source": SOURCE,
        "recordings": {name: load_emps(config.data, name).sha256 for name in (FIT, JUDGE)},
        "filter": {
            "position": f"zero-phase Butterworth, order 4, {MOTION_CUTOFF:g} Hz, then central differences at 1 kHz",
            "force": f"windowed sinc, {DEFAULT_NOISE.cutoff:g} Hz, measured and simulated alike",
            "simulated_at_hz": OVERSAMPLING * MOTION_CUTOFF,
        },
        "search": {"generations": len(search.history.sigma), "stop": search.stop, "best": rounded(search.best)},
        "intervals": {
            "level": LEVEL,
            "block_s": BLOCK,
            "correlation_time_s": rounded(correlation_time(residual(cost, found.best)))[0],
            "rule": found.gaussian.rule,
        },
        "parameters": parameters,
        "before": {FIT: accuracy(cost, space.mean), JUDGE: accuracy(judge, space.mean)},
        "after": {FIT: accuracy(cost, found.best), JUDGE: accuracy(judge, found.best)},
        "friction_at_rest": set_valued(scene, space, config.data, found.best, judge),
        "targets": {
            "mass_within_1_percent": abs(parameters["carriage_mass"]["relative_error"]) < 0.01,
            "coulomb_within_5_percent": abs(parameters["slide_frictionloss"]["relative_error"]) < 0.05,
        },
    }
    print(f"  {JUDGE}: {result['before'][JUDGE]} before, {result['after'][JUDGE]} after")
    publish(config.out, "real_emps", config.quick, config.seed, result, trace_figure(judge, space.mean, found.best))


if __name__ == "__main__":
    run(lambda: main(tyro.cli(RealEmps, description=__doc__)))
