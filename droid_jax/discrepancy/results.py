"""Files of a search for missing effects: gap.json, gap.npz and the extended model.

The verdict is written when it is known, and again after each amendment (`missing.amended`).  docs/results-folder.md
lists every entry.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np

from droid_jax.discrepancy.candidates import ScoreTest
from droid_jax.discrepancy.case import Case, ResidualSet
from droid_jax.discrepancy.fitting import FinalModel
from droid_jax.discrepancy.maps import Localisation
from droid_jax.discrepancy.posterior import fit_posterior, intervals, with_step_moves
from droid_jax.discrepancy.selection import ValidationTest, bound_at
from droid_jax.discrepancy.verdict import Alternatives, Verdict
from droid_jax.files import GAP, GAP_TRACES, GAP_VERSION
from droid_jax.identify.extended_model import Extended, save_extended
from droid_jax.identify.holdout import distance_unit, unit_of
from droid_jax.identify.identifiability import posterior
from droid_jax.model.effects.candidate import Candidate, EffectKey, Keys
from droid_jax.model.parameters import Parameter
from droid_jax.storage import config_json, finite, write_json, write_npz

FORMAT, VERSION = "droid_jax gap", GAP_VERSION


def extended(case: Case, final: FinalModel) -> Extended:
    """The final model of a search as an extended model, which can be saved."""
    model = final.model
    values = model.values[case.full_space.columns(model.space)]
    gaussian = posterior(
        model.refined,
        [c for fitted in final.fitted_to for c in fitted.cost.comparisons],
        case.config.identifiability,
    )
    gaussian = with_step_moves(case.train, model, gaussian)
    named = {part.effect for part in model.parts}
    effects = tuple(e for e in case.effects if e.name in named)
    return Extended(case.train.cost.scene, model.parts, effects, values, gaussian)


def write_gap(
    folder: Path,
    case: Case,
    verdict: Verdict,
    final: FinalModel,
    description: Mapping[str, Any],
    amendments: Mapping[str, str] | None = None,
) -> None:
    """Write all files of a search as soon as its verdict is known; gap.json last.

    Args:
        folder: of the run.
        case: the recordings.
        verdict: of the search.
        final: the final model; that of the search until the final refit is made.
        description: further entries of gap.json: "seconds", "versions", "device", "setup", ...
        amendments: states of the amendments (`missing.Amended.states`); None if none is due.
    """
    write_npz(folder / GAP_TRACES, gap_arrays(case, verdict))
    write_amended(folder, case, verdict, final, description, amendments)


def write_amended(
    folder: Path,
    case: Case,
    verdict: Verdict,
    final: FinalModel,
    description: Mapping[str, Any],
    amendments: Mapping[str, str] | None = None,
) -> None:
    """Write the files of `write_gap` that an amendment changes: the extended model, then gap.json."""
    save_extended(folder, extended(case, final))
    more = {"final_model": _final_json(case, verdict, final), "amendments": dict(amendments or {})}
    write_json(folder / GAP, {**gap_json(case, verdict), **more, **description})


def gap_json(case: Case, verdict: Verdict) -> dict[str, Any]:
    """The verdict as plain data, see docs/results-folder.md."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "verdict": verdict.conclusion.value,
        "sentence": verdict.sentence,
        "effects": _keys(verdict.effects),
        "indistinguishable": _alternatives(verdict.indistinguishable),
        "doubts": list(verdict.doubts),
        "hints": [
            {
                "effects": _keys(hint.effects),
                "indistinguishable": _alternatives(hint.indistinguishable),
                "closed": hint.closed,
            }
            for hint in verdict.hints
        ],
        "config": config_json(case.config),
        "about": _about(case, verdict),
        "p": verdict.score_tests[0].p if verdict.score_tests else None,
        "discretisation_error": verdict.discretisation_error,
        "converged": verdict.base.refined.converged,
        "ruled_out": list(verdict.ruled_out),
        "not_tried": "; ".join(verdict.not_tried),
        "remainder": verdict.remainder,
        "explained": verdict.explained if verdict.effects else None,
        "discrepancies": {
            role: _discrepancy(role, case.residual_sets[role], verdict) for role in verdict.discrepancies
        },
        "phases": {
            role: [asdict(phase) for phase in case.residual_sets[role].comparison.phases]
            for role in verdict.discrepancies
        },
        "score_tests": [
            {"p": found.p, "ranking": _ranking(found), "failed": _keys(found.failed)} for found in verdict.score_tests
        ],
        "failed": list(verdict.failed),
        "validation_tests": [_test(test) for test in verdict.validation_tests],
        "cells": {"before": _cells(verdict.before), "after": _cells(verdict.after)},
        "coefficients": _parameters(case, verdict, "coefficients"),
        "shape_parameters": _parameters(case, verdict, "shape_parameters"),
        "shifts": _shifts(case, verdict),
        "experiments": [asdict(experiment) for experiment in verdict.experiments],
        "trends": [
            {
                **_key(t.key),
                "coefficient": t.coefficient,
                "per_repeat": t.per_repeat,
                "p": t.p,
                "unit": case.full_space[t.coefficient].unit,
            }
            for t in (verdict.trend,)
            if t is not None
        ],
        "units": unit_of(case.train.cost.scene, case.train.comparison.leading),
        "channel": case.train.comparison.leading.name,
        "channels": [c.name for c in case.train.comparison.channels],
        "distance_unit": distance_unit(case.train.cost.scene, case.train.comparison),
    }


def gap_arrays(case: Case, verdict: Verdict) -> dict[str, np.ndarray]:
    """The smoothed leading channel (torques, if compared) of each recording: repeats, base model and final model.

    If one log has several roles, each role has the instants of its blocks.
    """
    joints = _joints(case.train)
    out = {"joints": np.array(joints)}
    for role in verdict.discrepancies:
        residual_set = case.residual_sets[role]
        order = [_joints(residual_set).index(joint) for joint in joints]
        channel = residual_set.comparison.leading
        counted = residual_set.instants_of(channel)
        (simulated,) = residual_set.cost.smoothed(_before_after(residual_set, verdict))
        before, after = simulated[:, counted][:, :, order]
        repeats = channel.noise.repeats[:, counted][:, :, order]
        out |= {
            f"{role}.time": channel.clock[counted],
            f"{role}.measured": channel.noise.mean[counted][:, order],
            f"{role}.scatter": np.std(repeats, axis=0, ddof=1) if len(repeats) > 1 else np.zeros(repeats.shape[1:]),
            f"{role}.before": before,
            f"{role}.after": after,
        }
    return out


def _before_after(residual_set: ResidualSet, verdict: Verdict) -> np.ndarray:
    """[2, D] values of the base model and of the final model, with fitted per-recording nuisances."""
    return residual_set.at_best_nuisances(np.stack([verdict.base.values, verdict.model.values]))


def _joints(residual_set: ResidualSet) -> list[str]:
    """Measured joints, in the order of the leading channel's columns."""
    scene, channel = residual_set.cost.scene, residual_set.comparison.leading
    return [str(scene.object_joint)] if channel.name == "object_angle" else [scene.joints[c] for c in channel.columns]


def _key(key: EffectKey) -> dict[str, str]:
    return {"effect": key.effect, "location": key.location}


def _keys(keys: Keys) -> list[dict[str, str]]:
    return [_key(key) for key in keys]


def _alternatives(each: tuple[Alternatives, ...]) -> list[list[list[dict[str, str]]]]:
    return [[_keys(keys) for keys in alternatives] for alternatives in each]


def _final_json(case: Case, verdict: Verdict, final: FinalModel) -> dict[str, Any]:
    """Names of the recordings that the final model is fitted to, and its U by role; None if the replay blows up."""

    def of(residual_set: ResidualSet) -> float | None:
        return finite(residual_set.resampling.discrepancy(residual_set.residuals(final.model.values)))

    return {
        "fitted_to": [fitted.comparison.name for fitted in final.fitted_to],
        "discrepancies": {role: of(case.residual_sets[role]) for role in verdict.discrepancies},
    }


def _discrepancy(role: str, residual_set: ResidualSet, verdict: Verdict) -> dict[str, Any]:
    """U and the distance of equation 1, of the base model and of the final model.

    "torque_before" and "torque_after" hold the distance of whatever channels are compared, in "distance_unit" of
    gap.json: the channel's unit, or noise units for several channels.  (The keys date from searches of torques alone.)
    "closed" is None if U of the base model is not above U0.
    """
    before, after = verdict.discrepancies[role]
    both = _before_after(residual_set, verdict)
    distance = (residual_set.distances(both) - residual_set.cost.penalties(both))[:, 0]
    return {
        "recording": residual_set.comparison.name,
        "before": before,
        "after": after,
        "closed": verdict.closed(role) if before > verdict.discretisation_error else None,
        "torque_before": float(distance[0]),
        "torque_after": float(distance[1]),
    }


def _ranking(found: ScoreTest) -> list[dict[str, Any]]:
    """Every candidate with its best shape parameters, by the share that it explains."""
    best: dict[EffectKey, int] = {}
    for k in found.ranking():
        best.setdefault(found.directions[k].candidate.key, k)
    return [{**_key(key), "t": float(found.t[k]), "explained": float(found.explained[k])} for key, k in best.items()]


def _test(test: ValidationTest) -> dict[str, Any]:
    return {
        "parts": _keys(test.keys),
        "parts_before": test.before,
        "discrepancy_train": test.discrepancy_train,
        "discrepancy_validation": finite(test.discrepancy_validation),
        "p": test.p,
        "chosen": test.chosen,
        "passed": test.passed,
        "reasons": [{"reason": r.reason.value, "text": r.text} for r in test.reasons],
        "interval": {name: list(span) for name, span in test.interval.items()},
    }


def _cells(found: Localisation) -> list[dict[str, Any]]:
    return [
        {
            **config_json(cell.key),
            "discrepancy": cell.discrepancy,
            "p": cell.p,
            "found": cell.found,
        }
        for cell in found
    ]


def _about(case: Case, verdict: Verdict) -> dict[str, dict[str, Any]]:
    """Effect -> description, signature and similar effects, for those in the verdict, its alternatives and hints."""
    answers = [(verdict.effects, verdict.indistinguishable), *((h.effects, h.indistinguishable) for h in verdict.hints)]
    named = {key.effect for effects, _ in answers for key in effects}
    named |= {key.effect for _, each in answers for alternatives in each for keys in alternatives for key in keys}
    return {
        e.name: {
            "what": e.description,
            "signature": e.signature,
            "confused_with": list(e.confused_with),
            **({"remedy": e.remedy} if e.remedy else {}),
        }
        for e in case.effects
        if e.name in named
    }


def _parameters(
    case: Case, verdict: Verdict, kind: Literal["coefficients", "shape_parameters"]
) -> list[dict[str, Any]]:
    """Coefficients or shape parameters of the model with intervals; a shared one is listed for its first part."""
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
            "value": (value := float(model.values[case.full_space.index(name)])),
            "low": spans[name][0],
            "high": spans[name][1],
            "bound": _reached(case.full_space[name], value, spans[name], bound_at(case.train, model, name)),
            **_key(part.key),
            "what": what[part.effect],
        }
        for name, part in first.items()
    ]


def _reached(parameter: Parameter, value: float, span: tuple[float, float], side: str) -> str:
    """The bound `side` ("lower" or "upper") if the value or its interval reaches it, otherwise empty.

    `fit.bound_of`, which gives `side`, allows a distance that may be large if the range is wide.
    """
    near = 1e-4 * (parameter.high - parameter.low)
    if side == "lower":
        return side if min(value, span[0]) <= parameter.low + near else ""
    return side if max(value, span[1]) >= parameter.high - near else ""


def _shifts(case: Case, verdict: Verdict) -> list[dict[str, Any]]:
    """Base parameters before and after the effects were added, with their posterior deviation in the base fit."""
    columns = case.full_space.columns(case.base)
    deviation = fit_posterior(case.train, verdict.base).physical_std
    before, after = verdict.base.values[columns], verdict.model.values[columns]
    return [
        {"name": p.name, "unit": p.unit, "before": b, "after": a, "deviation_before": s}
        for p, b, a, s in zip(case.base.parameters, before.tolist(), after.tolist(), deviation.tolist(), strict=True)
    ]
