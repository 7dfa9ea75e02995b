"""The folder of a run: the result of an identification as JSON, npz, CSV and MJCF.

docs/results-folder.md lists the files.  `report` makes a page of them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.cost.errors import errors_json, sample_of
from droid_jax.cost.observation import Measured
from droid_jax.files import (
    CONFIG,
    CORRELATION,
    DISTRIBUTION,
    FIT,
    FIT_VERSION,
    FITTED,
    FULL_GAUSSIAN,
    GAUSSIAN,
    HISTORY,
    HISTORY_TABLE,
    SAMPLES,
    TRACES,
)
from droid_jax.identify.fit import on_bound
from droid_jax.identify.gaussian import prior
from droid_jax.identify.holdout import NOISE_UNITS, HeldoutDistance
from droid_jax.identify.neutral_result import write_neutral
from droid_jax.identify.pipeline import Identified
from droid_jax.identify.solution_checks import SolutionCheck, solution_notes
from droid_jax.model.effect_interface import Effect
from droid_jax.model.mjcf import unwritten
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding
from droid_jax.storage import config_json, finite, write_csv, write_json, write_npz

FORMAT = "droid_jax fit"


def write_run(
    folder: Path,
    found: Identified,
    config: Mapping[str, Any],
    *,
    truth: Mapping[str, float] | None = None,
    samples: Callable[[], Mapping[str, np.ndarray]] | None = None,
    effects: Sequence[Effect] = (),
    notes: Iterable[str] = (),
    findings: Iterable[Finding] = (),
) -> None:
    """Write all files of a run into a folder.

    Args:
        folder: to write to.
        found: the result of the identification.
        config: content of config.json.
        truth: parameter values of the synthetic robot, where they are known.
        samples: returns draws and their costs (`pipeline.cost_samples`); called once the fit is on disk.
        effects: in the model in addition to the scene.
        notes: sentences for the report.
        findings: of the checks of the recordings.
    """
    notes = [*notes, *solution_notes(found.checks, found.scene.name)]
    error = write_neutral(
        folder, found.scene, found.full_gaussian, found.best, effects, main=FITTED, checks=found.checks
    )
    notes += [f"fitted.xml is not written: {error}"] if error else []
    write_json(folder / FIT, {**fit_json(found, truth or {}, notes), "findings": [asdict(f) for f in findings]})
    found.gaussian.save(folder / GAUSSIAN)
    found.full_gaussian.save(folder / FULL_GAUSSIAN)
    _write_history(folder, found)
    write_npz(folder / TRACES, traces(found))
    correlation = found.full_gaussian.cov / np.sqrt(
        np.outer(np.diag(found.full_gaussian.cov), np.diag(found.full_gaussian.cov))
    )
    write_npz(folder / CORRELATION, {"names": np.array(found.full.names), "correlation": correlation})
    if samples is not None:
        drawn = samples()
        write_npz(folder / DISTRIBUTION, drawn)
        write_csv(folder / SAMPLES, found.space.names, drawn["fitted"].tolist())
    write_json(folder / CONFIG, dict(config))  # last: its presence means that the run is complete


def fit_json(found: Identified, truth: Mapping[str, float], notes: list[str]) -> dict[str, Any]:
    """Return the content of fit.json: parameters with intervals, distances, costs, stop criteria.

    truth: see `write_run`.  notes: sentences for the report.
    """
    low, high = found.full_gaussian.interval(0.9)
    initial = np.stack(prior(found.full).interval(0.9), axis=1)
    mean, std = found.full_gaussian.physical_mean, found.full_gaussian.physical_std
    bound = on_bound(found.full, found.best)
    x, initial_x = (found.full.to_search(v).tolist() for v in (found.best, found.full.mean))
    parameters = []
    for i, p in enumerate(found.full.parameters):
        verdict = found.identifiability[i]
        parameters.append(
            {
                "name": p.name,
                "unit": p.unit,
                "group": p.group,
                "nuisance": p.nuisance,
                "initial_mean": p.mean,
                "initial_std": p.std,
                "initial_interval": initial[i].tolist(),
                "low": p.low,
                "high": p.high,
                "best": float(found.best[i]),
                "mean": float(mean[i]),
                "std": float(std[i]),
                "interval": [float(low[i]), float(high[i])],
                "identifiable": verdict.identifiable,
                "reason": verdict.reason,
                "moved": finite(x[i] - initial_x[i] if math.isnan(verdict.moved) else verdict.moved),
                "truth": truth.get(p.name),
                "on_bound": p.name in bound,
                "partners": [{"name": n, "correlation": c} for n, c in verdict.partners],
            }
        )
    costs = found.fit(np.stack([found.start, found.best]))
    floors: list[Any] = [g.noise_floor for g in found.heldout_distances.values()]
    comparison = found.fit.comparisons[0]
    whitened = comparison.config.whitened  # noise floors are in the unit of the channel
    distances = list(found.heldout_distances.values())
    unit = distances[0].unit
    same_recordings = distances[0].judged != "recordings"  # floors of other recordings do not apply to this cost
    evaluations = found.search.evaluations + (found.refined.evaluations if found.refined else 0)
    return {
        "format": FORMAT,
        "version": FIT_VERSION,
        "parameters": parameters,
        "cost": {
            "initial": float(costs[0]),
            "best": float(costs[1]),
            "noise_floor": float(np.mean(floors)) if same_recordings and not whitened and None not in floors else None,
            "unit": NOISE_UNITS if whitened else unit,
        },
        "heldout_distances": {
            name: asdict(distance) | per_joint(distance) | {"errors": errors_json(distance.errors)}
            for name, distance in found.heldout_distances.items()
        },
        "distance_unit": unit,
        "compared": dict(comparison.config.channels),
        "stop": found.search.stop,
        "converged": None if found.refined is None else found.refined.converged,
        "mean_square": None if found.refined is None else float(np.mean(found.refined.residual**2)),
        "generations": len(found.search.history.best_cost),
        "evaluations": int(evaluations),
        "seconds": {**found.seconds, "total": sum(found.seconds.values())},
        "rule": found.gaussian.rule,
        "mjcf_lacks": list(unwritten(found.scene, found.full)),
        "notes": notes,
        "config": config_json(found.config),
        "checks": {name: _check_json(check) for name, check in found.checks.items()},
    }


def _check_json(check: SolutionCheck) -> dict[str, Any]:
    """A check with its verdicts; the settings are under `config`."""
    measured = {name: value for name, value in asdict(check).items() if name != "config"}
    return {**measured, "too_coarse": check.too_coarse, "engines_differ": check.engines_differ}


def per_joint(distance: HeldoutDistance) -> dict[str, list[float | None]]:
    """Return the numbers of each joint, None where the simulation of the held-out data blew up."""
    each = {"per_joint_before": distance.per_joint_before, "per_joint_after": distance.per_joint_after}
    return {name: [finite(v) for v in values] for name, values in each.items()}


def _write_history(folder: Path, found: Identified) -> None:
    history = found.search.history
    names = found.space.names
    arrays = {
        "names": np.array(names),
        "generation": np.arange(1, len(history.best_cost) + 1),
        "mean": history.mean,
        "std": _physical_deviation(found.space, history.mean, history.std),
        "best_cost": history.best_cost,
        "median_cost": history.median_cost,
        "sigma": history.sigma,
    }
    write_npz(folder / HISTORY, arrays)
    table = np.column_stack([arrays[k] for k in ("generation", "best_cost", "median_cost", "sigma", "mean", "std")])
    header = ["generation", "best_cost", "median_cost", "sigma", *(f"mean_{n}" for n in names)]
    write_csv(folder / HISTORY_TABLE, [*header, *(f"std_{n}" for n in names)], table.tolist())


def _physical_deviation(space: Space, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """[G, D] half the distance in physical units of the points one search deviation above and below the mean."""
    x = space.to_search(mean)
    return 0.5 * (space.from_search(x + std) - space.from_search(x - std))


def traces(found: Identified) -> dict[str, np.ndarray]:
    """Return the smoothed channels of the held-out data, before and after the fit.

    The leading channel is under the recording's name, the others are under recording/channel.
    """
    both, rollouts = np.stack([found.start, found.best]), found.heldout.rollouts(np.stack([found.start, found.best]))
    out: dict[str, np.ndarray] = {}
    for comparison, pair in zip(found.heldout.comparisons, rollouts, strict=True):
        rows = [sample_of(pair, row) for row in range(len(both))]
        for channel in comparison.channels:
            is_leading = channel is comparison.leading
            prefix = comparison.name if is_leading else f"{comparison.name}/{channel.name}"
            lines = [np.asarray(comparison.smoothed(row, channel.name)) for row in rows]
            out |= {f"{prefix}/{key}": value for key, value in _of_channel(found.scene, channel, *lines).items()}
        out[f"{comparison.name}/phases"] = np.array(json.dumps([asdict(phase) for phase in comparison.phases]))
    return out


def _of_channel(scene: Scene, channel: Measured, before: np.ndarray, after: np.ndarray) -> dict[str, np.ndarray]:
    """A measured channel with the spread of its repeats, and simulated [K, C]; NaN where nothing was measured."""
    repeats = channel.noise.repeats
    joints = [scene.joints[c] for c in channel.columns]
    lines = {
        "measured_mean": channel.noise.mean,
        "measured_low": np.quantile(repeats, 0.05, axis=0),
        "measured_high": np.quantile(repeats, 0.95, axis=0),
        "before": before,
        "after": after,
    }
    return {
        "time": channel.clock,
        **{key: np.where(channel.noise.count > 0, line, np.nan) for key, line in lines.items()},
        "joints": np.array([scene.object_joint] if channel.name == "object_angle" else joints),
    }
