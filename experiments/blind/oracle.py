"""What the right names could reach on a case: the library's forms of what was hidden, fitted from the truth.

The base model absorbs most of many effects, and what a hidden effect's other equation leaves does not shrink with
it: of friction that grows with the load the base model took 98 % on the door, and the right form from the truth took
only a tenth of the rest away.  No search can name that, and none should.  The oracle knows the truth and says so; the
search never sees it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.sharing import claimed
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.fitting import FittedModel, refit
from droid_jax.identify.multistart import RefineConfig
from droid_jax.model.effects.candidate import Candidate, candidates
from droid_jax.recordings.formats import load_recording
from droid_jax.storage import file_sha256, write_json
from droid_jax.synthetic.hidden_effects import Applied
from experiments.blind.answers import right
from experiments.blind.quiet import settled
from experiments.blind.scenes import ROLES
from experiments.blind.score import oracle_of
from experiments.blind.search import FAILED, Bench

FROM_TRUTH = RefineConfig(iterations=12, basin_hops=0, spreads=0)
SIZES = np.geomspace(3e-3, 0.8, 12)  # of the way from neutral to a bound
KINDS = ("single", "pair")  # whose effects the library has forms of


def oracle(folder: Path, truth: dict[str, Any], result: dict[str, Any], bench: Bench) -> dict[str, Any]:
    """U on every recording with the right forms in the model, parameters fitted to the first alone.

    result: what the search found, whose amplitudes are then told without noise as well (`quiet.py`).
    """
    recordings = {role: load_recording(folder / "recordings" / f"{role}.npz") for role in ROLES}
    case = bench.case(truth["scene"], recordings)
    scene = bench.setting(truth["scene"]).scene
    model = fitted(case, truth["truths"]["train"], [right(scene, Applied(**h)) for h in truth["hidden"]])
    return {
        "model": model.name,
        "discrepancies": {role: of.discrepancy_at(model.values) for role, of in case.residual_sets.items()},
        "coefficients": {name: float(model.values[case.full_space.index(name)]) for name in model.coefficients},
        "converged": model.refined.converged,
        "settled": settled(recordings, truth, result, bench),
    }


def fitted(case: Case, truth: dict[str, float], names: Sequence[Sequence[str]]) -> FittedModel:
    """The best model with one of the right names for each hidden effect, from the truth of all else."""
    whole = case.full_space
    known = {name: value for name, value in truth.items() if name in whole.names}
    start, parts = np.clip(whole.values(known), whole.low, whole.high), list[Candidate]()
    for own in names:
        start, part = best_start(case, start, [c for c in candidates(case.effects) if str(c.key) in own])
        parts.append(part)
    return refit(case.train, case.base, parts, start[None], FROM_TRUTH)


def best_start(case: Case, start: np.ndarray, asked: Iterable[Candidate]) -> tuple[np.ndarray, Candidate]:
    """Values [D] with the one amplitude, of all of these candidates over a grid of sizes, that leaves the least."""
    whole = case.full_space
    rows, parts = list[np.ndarray](), list[Candidate]()
    for candidate in asked:
        for amplitude in candidate.coefficients:
            p = whole[amplitude]
            for reach in {p.high - p.mean, p.low - p.mean} - {0.0}:
                for size in SIZES:
                    row = start.copy()
                    for name, value in candidate.shape_parameters.items():
                        row[whole.index(name)] = value
                    row[whole.index(amplitude)] = p.mean + size * reach
                    rows.append(row)
                    parts.append(candidate)
    left = np.sum(case.train.whitened(np.stack(rows)) ** 2, axis=1)
    best = int(np.nanargmin(left))
    return rows[best], parts[best]


def oracle_all(runs: Path, chosen: Iterable[str], bench: Bench, tell: Callable[[str], None] = print) -> int:
    """The oracle of every chosen case that is searched, has forms in the library and no oracle yet of that result.

    They go to the folder `oracle` of a run; a case that cannot be fitted from its truth leaves the error there.
    """
    count = 0
    for name in chosen:
        path, sealed, known = (runs / folder / f"{name}.json" for folder in ("oracle", "sealed", "results"))
        truth = json.loads(sealed.read_text())
        if truth["kind"] not in KINDS or not known.is_file():
            continue
        with claimed(path, wait=False) as mine:
            if not mine or oracle_of(known, path):
                continue
            try:
                found = oracle(runs / "cases" / name, truth, json.loads(known.read_text()), bench)
            except FAILED as error:
                found = {"error": str(error)}
            write_json(path, {"of": file_sha256(known), **found})
        count += 1
        left = ", ".join(f"U {role} {u:.3g}" for role, u in found.get("discrepancies", {}).items())
        tell(f"{name}: {found.get('error', found.get('model'))} {left}")
    return count
