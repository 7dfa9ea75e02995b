"""Detection limits: the amplitude at which the sign-flip test finds an effect in half of the cases.

Computed from the synthetic robot's noise before the method is frozen.  What a hidden effect adds is recorded once,
small, with and without it and with the same noise; what the base model cannot absorb of it grows with the amplitude.
Repeats are drawn, with replacement, from those of a long recording with nothing hidden; the test is `largest_steady_t`
over the full list of candidates.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import CODE
from benchmarks.sharing import code_name
from droid_jax.discrepancy.candidates import directions_of
from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.statistics import largest_detrended_t
from droid_jax.model.effects.candidate import candidates
from droid_jax.storage import write_json
from droid_jax.synthetic.hidden_effects import HIDDEN, Applied
from experiments.blind.cases import SAFE, key, keys
from experiments.blind.draws import DEVELOPMENT, draw_truths, seed_of
from experiments.blind.forms import Forms, forms_of
from experiments.blind.marks import REPEATS, Ground, ground
from experiments.blind.scenes import Setting

POWER = 0.5
DRAWS = 60
LOWEST, HALVINGS = 1e-5, 9  # of the largest amplitude; halvings of the logarithm
RECORDED = 3  # times an effect is recorded at most
# Times the limit: where an effect is recorded, and compared with its library form.  At the limit itself fingers that
# stick a little earlier or later would count as the effect: of wrong servo gains, which the base model absorbs, a sixth
# seemed to be left, and cases of ten times such a limit held nothing that could be seen.
TYPICAL = 3.0
NEAR = 2.0  # within this factor of that size an effect counts as proportional to its amplitude


@dataclass(frozen=True, eq=False)
class Power:
    """How often the test rejects.

    marks: [K, M] of all candidates, raw.  chosen: [D, N] repeats of each draw.  known: projected marks and
    their scores of the noise, by which base parameters are free.
    """

    where: Ground
    marks: np.ndarray
    chosen: np.ndarray
    known: dict[bytes, tuple[np.ndarray, np.ndarray]]

    def at(self, amplitude: float, added: np.ndarray) -> float:
        """Share of draws with p < 0.01, of an effect that adds [N, M] per unit to the repeats."""
        common = added.mean(axis=0)
        left, free = self.where.left(amplitude * common)
        marks, noise = self._projected(free)
        scores = marks @ (left + amplitude * (added - common)).T
        p = [largest_detrended_t(scores + noise[:, rows])[1] for rows in self.chosen]  # as `ResidualSet.largest_score`
        return float(np.mean(np.array(p) < SelectionConfig().significance))

    def limit(self, added: np.ndarray, largest: float) -> float | None:
        """Amplitude with `POWER`, by bisection in its logarithm; None where the largest has less."""
        if self.at(largest, added) < POWER:
            return None
        low, high = largest * LOWEST, largest
        for _ in range(HALVINGS):
            middle = float(np.sqrt(low * high))
            low, high = (low, middle) if self.at(middle, added) >= POWER else (middle, high)
        return float(np.sqrt(low * high))

    def _projected(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if free.tobytes() not in self.known:
            marks = self.where.asked(self.marks, free)
            self.known[free.tobytes()] = marks, marks @ self.where.noise.T
        return self.known[free.tobytes()]


def power_of(where: Ground, seed: int) -> Power:
    """Marks of all candidates, and draws of repeats."""
    rng = np.random.default_rng(seed)
    raw = where.added(directions_of(candidates(where.setting.effects())))
    return Power(where, raw, rng.integers(len(where.noise), size=(DRAWS, REPEATS)), {})


def limit_of(where: Ground, power: Power, forms: Forms, effect: Applied) -> dict[str, Any]:
    """One effect's entry: limit, unit, size worth naming, and how far it is from its library form."""
    hidden = HIDDEN[effect.name]
    largest, size = SAFE * hidden.typical[1], hidden.typical[0]
    limit, added, recorded = None, np.zeros(0), size
    for _ in range(RECORDED):
        recorded = size
        added = where.hidden(replace(effect, amplitude=recorded))
        limit = power.limit(added, largest)
        wanted = largest if limit is None else min(TYPICAL * limit, largest)
        if max(wanted / size, size / wanted) <= NEAR:
            break
        size = wanted
    common = added.mean(axis=0)
    _, free = where.left(TYPICAL * (limit or largest) * common)
    return {"limit": limit, "unit": hidden.unit, "recorded_at": recorded, **forms.of(effect, common, free)}


def scene_limits(
    setting: Setting, draws: int, folder: Path, wanted: tuple[str, ...] = (), tell: Callable[[str], None] = print
) -> dict[str, dict[str, Any]]:
    """key -> entry, the medians over some draws of the robot.

    folder: what one draw found is kept there, so that a run that was stopped goes on where it was.
    """
    asked = [e for e in keys(setting) if not wanted or e.name in wanted]
    found = [_draw_limits(setting, number, folder, asked, tell) for number in range(draws)]
    return {key(e.name, e.joint): _median([entries[key(e.name, e.joint)] for entries in found]) for e in asked}


def _draw_limits(
    setting: Setting, number: int, folder: Path, asked: list[Applied], tell: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """key -> entry, of one robot."""
    path = folder / f"{setting.name}_{number}_{code_name(CODE.get('git'))}.json"
    known = json.loads(path.read_text()) if path.is_file() else {}
    left = [e for e in asked if key(e.name, e.joint) not in known]
    if not left:
        return known
    seed = seed_of(DEVELOPMENT, f"{setting.name}/limits/{number}")
    where = ground(setting, draw_truths(setting, np.random.default_rng(seed))["train"], seed)
    power, forms = power_of(where, seed), forms_of(where)
    for effect in left:
        name = key(effect.name, effect.joint)
        known[name] = limit_of(where, power, forms, effect)
        write_json(path, known)
        tell(f"{setting.name}, robot {number}, {name}: {known[name]['limit']} {known[name]['unit']}")
    return known


def _median(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """The draw with the median limit; undetected ones count as infinite."""
    ordered = sorted(entries, key=lambda e: np.inf if e["limit"] is None else e["limit"])
    return {**ordered[(len(ordered) - 1) // 2], "limits": [e["limit"] for e in entries]}
