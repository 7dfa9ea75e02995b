"""What a search for a missing effect leaves in its folder: gap.json and gap.npz, the extended model beside them.

The verdict is written when it is known; what is added to it later (`discrepancy.amendments`) is written again.

docs/results-folder.md lists every entry; `report.gap_folder` reads them, for a page and for a user.  No pickle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np

from droid_jax.discrepancy.candidates import Candidate
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.doubts import bound_at
from droid_jax.discrepancy.extended import extended, save_extended
from droid_jax.discrepancy.final_refit import FinalModel
from droid_jax.discrepancy.localise import Localisation
from droid_jax.discrepancy.refit import intervals
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.discrepancy.screen import ScoreTest
from droid_jax.discrepancy.select import ValidationTest
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.files import GAP, GAP_TRACES
from droid_jax.identify.identifiability import posterior_of
from droid_jax.storage import finite, write_json, write_npz


def write_gap(
    folder: Path,
    case: Case,
    verdict: Verdict,
    handed: FinalModel,
    description: Mapping[str, Any],
    amendments: Mapping[str, str] | None = None,
) -> None:
    """Write all files of a search as soon as its verdict is known; gap.json last.

    handed: the model to hand on, the search's own while the final refit is to be made.
    description: what else gap.json shall hold: "seconds", "versions", "device", "setup", ...
    amendments: their states (`Amended.states`); None where all that is due has been made.
    """
    write_npz(folder / GAP_TRACES, gap_arrays(case, verdict))
    write_amended(folder, case, verdict, handed, description, amendments)


def write_amended(
    folder: Path,
    case: Case,
    verdict: Verdict,
    handed: FinalModel,
    description: Mapping[str, Any],
    amendments: Mapping[str, str] | None = None,
) -> None:
    """Write what an amendment changes of `write_gap`'s files: the extended model, then gap.json."""
    save_extended(folder, extended(case, handed))
    more = {"handed_on": _handed_on(case, verdict, handed), "amendments": dict(amendments or {})}
    write_json(folder / GAP, {**gap_json(case, verdict), **more, **description})


def gap_json(case: Case, verdict: Verdict) -> dict[str, Any]:
    """The answer and its grounds as plain data."""
    return {
        "verdict": verdict.kind.value,
        "sentence": verdict.sentence,
        "effects": list(verdict.effects),
        "indistinguishable": [list(rivals) for rivals in verdict.indistinguishable],
        "doubts": list(verdict.doubts),
        "hints": [asdict(hint) for hint in verdict.hints],
        "thresholds": {"least_closed": case.config.minimum_closed},
        "about": _about(case, verdict),
        "p": verdict.score_tests[0].p if verdict.score_tests else None,
        "floor": verdict.discretisation_error,
        "converged": verdict.base.refined.converged,
        "cut": verdict.not_tried,
        "remainder": verdict.remainder,
        "explained": verdict.explained if verdict.effects else None,
        "gaps": {role: _gap(role, case.held_sets[role], verdict) for role in verdict.discrepancies},
        "phases": {role: _phases(case.held_sets[role]) for role in verdict.discrepancies},
        "screens": [
            {"p": found.p, "ranking": _ranking(found), "failed": list(found.failed)} for found in verdict.score_tests
        ],
        "failed": list(verdict.failed),
        "trials": [_trial(trial) for trial in verdict.validation_tests],
        "cells": {"before": _cells(verdict.before), "after": _cells(verdict.after)},
        "amplitudes": _sizes(case, verdict, "coefficients"),
        "shapes": _sizes(case, verdict, "shape_parameters"),
        "shifts": _shifts(case, verdict),
        "experiments": [asdict(experiment) for experiment in verdict.experiments],
        "trends": [{**asdict(t), "unit": case.full_space[t.amplitude].unit} for t in (verdict.trend,) if t is not None],
        "units": case.train.cost.scene.torque_unit(_joints(case.train)),
    }


def gap_arrays(case: Case, verdict: Verdict) -> dict[str, np.ndarray]:
    """Smoothed joint torques of each recording: the repeats, and the simulation before and after.

    Where one log has several roles, each has the instants of its own blocks.
    """
    joints = _joints(case.train)
    out = {"joints": np.array(joints)}
    for role in verdict.discrepancies:
        residual_set = case.held_sets[role]
        order = [_joints(residual_set).index(joint) for joint in joints]
        channel = residual_set.cost.comparisons[0].channel("torque")
        mine = residual_set.instants
        (simulated,) = residual_set.cost.smoothed(_before_after(residual_set, verdict))
        before, after = simulated[:, mine][:, :, order]
        repeats = channel.noise.repeats[:, mine][:, :, order]
        out |= {
            f"{role}.time": channel.clock[mine],
            f"{role}.measured": channel.noise.mean[mine][:, order],
            f"{role}.scatter": np.std(repeats, axis=0, ddof=1) if len(repeats) > 1 else np.zeros(repeats.shape[1:]),
            f"{role}.before": before,
            f"{role}.after": after,
        }
    return out


def _before_after(residual_set: ResidualSet, verdict: Verdict) -> np.ndarray:
    """[2, D] values of the base model and of the extended one, the recording's own nuisances at their best."""
    return residual_set.at_best_nuisances(np.stack([verdict.base.values, verdict.model.values]))


def _joints(residual_set: ResidualSet) -> list[str]:
    """Measured joints, in the order of the torque channel's columns."""
    return [residual_set.cost.scene.joints[c] for c in residual_set.cost.comparisons[0].channel("torque").columns]


def _handed_on(case: Case, verdict: Verdict, handed: FinalModel) -> dict[str, Any]:
    """Which recordings the model that is handed on is fitted to, and U of each role with it; null where it blows up."""
    commons = {role: case.held_sets[role].common(handed.model.values)[0] for role in verdict.discrepancies}
    return {
        "fitted_to": [residual_set.cost.comparisons[0].name for residual_set in handed.fitted_to],
        "gaps": {
            role: finite(case.held_sets[role].discrepancy(case.held_sets[role].residuals(c)))
            for role, c in commons.items()
        },
    }


def _gap(role: str, residual_set: ResidualSet, verdict: Verdict) -> dict[str, Any]:
    """U and the paper's distance, N m, before and after; closed: None where there was nothing above the floor."""
    before, after = verdict.discrepancies[role]
    both = _before_after(residual_set, verdict)
    distance = (residual_set.cost.distances(both) - residual_set.cost.penalties(both))[:, 0]
    return {
        "recording": residual_set.cost.comparisons[0].name,
        "before": before,
        "after": after,
        "closed": verdict.closed(role) if before > verdict.discretisation_error else None,
        "torque_before": float(distance[0]),
        "torque_after": float(distance[1]),
    }


def _phases(residual_set: ResidualSet) -> list[dict[str, Any]]:
    return [asdict(phase) for phase in residual_set.cost.comparisons[0].phases]


def _ranking(found: ScoreTest) -> list[dict[str, Any]]:
    """Every candidate with its best shape, by what that explains."""
    best: dict[str, int] = {}
    for k in found.best():
        best.setdefault(found.directions[k].candidate.name, k)
    return [
        {"candidate": name, "t": float(found.t[k]), "explained": float(found.explained[k])} for name, k in best.items()
    ]


def _trial(trial: ValidationTest) -> dict[str, Any]:
    return {
        "round": trial.name.count(" + "),
        "name": trial.name,
        "discrepancy_train": trial.discrepancy_train,
        "discrepancy_validation": finite(trial.discrepancy_validation),
        "p": trial.p,
        "chosen": trial.chosen,
        "passed": trial.passed,
        "reasons": list(trial.reasons),
        "interval": {name: list(span) for name, span in trial.interval.items()},
    }


def _cells(found: Localisation) -> list[dict[str, Any]]:
    return [asdict(cell) for cell in found.cells]


def _about(case: Case, verdict: Verdict) -> dict[str, dict[str, Any]]:
    """Of each effect of the answer, ties and hints with it: what it is, where its mark should appear, and its likes."""
    groups = [
        (verdict.effects, verdict.indistinguishable),
        *((hint.effects, hint.indistinguishable) for hint in verdict.hints),
    ]
    answers = [a for effects, tied in groups for a in (*effects, *(rival for rivals in tied for rival in rivals))]
    named = {candidate.partition(" at ")[0] for answer in answers for candidate in answer.split(" + ")}
    return {
        e.name: {"what": e.description, "mark": e.signature, "confused_with": list(e.confused_with)}
        for e in case.effects
        if e.name in named
    }


def _sizes(case: Case, verdict: Verdict, kind: Literal["coefficients", "shape_parameters"]) -> list[dict[str, Any]]:
    """Coefficients or shape parameters of the final model with intervals, each at the first of the parts that
    share it.
    """
    model, what = verdict.model, {e.name: e.description for e in case.effects}
    first: dict[str, Candidate] = {}
    for part in model.parts:
        for name in getattr(part, kind):
            first.setdefault(name, part)
    spans = intervals(case.train, model, first)
    return [
        {
            "name": name,
            "unit": case.full_space[name].unit,
            "value": float(model.values[case.full_space.index(name)]),
            "low": spans[name][0],
            "high": spans[name][1],
            "bound": bound_at(case.train, model, name),
            "effect": part.name,
            "what": what[part.effect],
        }
        for name, part in first.items()
    ]


def _shifts(case: Case, verdict: Verdict) -> list[dict[str, Any]]:
    """How the base parameters moved when the effects came in, against what the base fit thought it knew."""
    columns = case.full_space.columns(case.base)
    deviation = posterior_of(verdict.base.refined, case.train.cost.comparisons).physical_std
    before, after = verdict.base.values[columns], verdict.model.values[columns]
    return [
        {"name": p.name, "unit": p.unit, "before": b, "after": a, "deviation_before": s}
        for p, b, a, s in zip(case.base.parameters, before.tolist(), after.tolist(), deviation.tolist(), strict=True)
    ]
