"""How far a hidden effect is from the library's form of it, and which other forms look like it.

The library form's amplitudes and shapes are fitted to what the hidden effect adds to the torques (linearly in
the amplitudes, over a dense grid of shapes).  What is left over in N m, as a share of the effect's own root mean
square, says how little of a mirror the synthetic robot is; the same in units of noise, after the base model has been
fitted again, says which forms no data could tell apart, and how much of the gap a right name can close at most.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from droid_jax.model.effects.candidate import Candidate
from droid_jax.synthetic.hidden_effects import Applied
from experiments.blind.answers import right
from experiments.blind.cases import NAMELESS
from experiments.blind.marks import Ground, by_candidate, dense

LOOKS_LIKE = 0.5  # share left over, up to which another form is listed

Best = tuple[float, int, np.ndarray]


@dataclass(frozen=True, eq=False)
class Forms:
    """Candidates over dense shapes, with the rows of marks [K, M] that belong to each; torques: the same in N m."""

    where: Ground
    candidates: tuple[Candidate, ...]
    rows: list[list[int]]
    marks: np.ndarray
    torques: np.ndarray

    def of(self, hidden: Applied, added: np.ndarray, free: np.ndarray | None = None) -> dict[str, Any]:
        """The entry of an effect that adds [M] per unit: its form, what it leaves, what else looks like it.

        free: [D] bool, base parameters that are not at their bounds.
        """
        absorbed = self.where.projected(added[None], free)[0]
        best = self._best(absorbed, self.where.projected(self.marks, free))
        names = [n for n in right(self.where.setting.scene, hidden) if n in best]
        worth = [self._worth(best[n]) for n in names if best[n][0] < NAMELESS]
        return {
            "visible": float(np.linalg.norm(absorbed) / max(np.linalg.norm(added), 1e-30)),
            "right": {n: round(best[n][0], 4) for n in names},
            "looks_like": {n: round(left, 3) for n, (left, _, _) in best.items() if left < LOOKS_LIKE},
            **({"worth": min(worth)} if worth else {}),
            **({"form": self._form(names[0], best[names[0]], added)} if names else {}),
        }

    def _form(self, name: str, found: Best, added: np.ndarray) -> dict[str, Any]:
        left, k, sizes = found
        return {
            "name": name,
            "left": self._best(self.where.torques(added[None])[0], self.torques)[name][0],
            "left_after_refit": left,
            "per_unit": dict(zip(self.candidates[k].coefficients, sizes.tolist(), strict=True)),
            "shape_parameters": dict(self.candidates[k].shape_parameters),
        }

    def _worth(self, found: Best) -> float:
        """Amplitude of the hidden effect from which its library form is large enough to be named."""
        _, k, sizes = found
        smallest = {e.name: e.minimum_size for e in self.where.setting.effects()}[self.candidates[k].effect]
        return smallest / max(float(np.max(np.abs(sizes))), 1e-30)

    def _best(self, wanted: np.ndarray, marks: np.ndarray) -> dict[str, Best]:
        """name -> share left over by its best shape, that candidate, and its amplitudes."""
        best: dict[str, Best] = {}
        size = max(float(np.linalg.norm(wanted)), 1e-30)
        for k, (candidate, rows) in enumerate(zip(self.candidates, self.rows, strict=True)):
            sizes = np.linalg.lstsq(marks[rows].T, wanted, rcond=1e-6)[0]
            left = float(np.linalg.norm(wanted - sizes @ marks[rows])) / size
            if left < best.get(str(candidate.key), (np.inf,))[0]:
                best[str(candidate.key)] = (left, k, sizes)
        return best


def forms_of(where: Ground) -> Forms:
    """All library forms at the truth of `where`."""
    found = dense(where.setting.effects())
    questions, rows = by_candidate(found)
    marks = where.added(questions)
    return Forms(where, found, rows, marks, where.torques(marks))
