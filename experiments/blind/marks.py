"""What a hidden effect leaves in a recording, in the search's own terms: whitened, with and without the base model.

Everything is taken at one draw of the robot's hidden values: its noise, the slopes of the base model there, and
what the library's candidates would add.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
import scipy.optimize

from droid_jax.cost.noise import lowpass, smooth
from droid_jax.discrepancy.candidates import ScoreDirection, directions_of, project, sensitivities
from droid_jax.discrepancy.case import ResidualSet, make_case
from droid_jax.discrepancy.fitting import FittedModel, refit
from droid_jax.identify.multistart import RefineConfig
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import Candidate, EffectKey, candidates
from droid_jax.model.effects.registry import effect_space
from droid_jax.recordings.recording import Recording
from droid_jax.synthetic.hidden_effects import Applied
from droid_jax.synthetic.robot import SyntheticRobotConfig
from experiments.blind.draws import Truth
from experiments.blind.make import Drawn, record
from experiments.blind.scenes import Setting

REPEATS = 10  # of a case
NOISY = 80  # repeats from which noise is drawn
DENSE = 24  # values of a shape, where a form is fitted
BY_REPEAT = ("warm_up_friction", "torque_drift")  # differ from repeat to repeat


@dataclass(frozen=True, eq=False)
class Ground:
    """A recording with nothing hidden, at the truth.

    setting, truth, seed: of the recording.  evidence: of its `NOISY` repeats.  model: the base model at the
    truth.  wide: [M, D] its slopes as the search has them, over the width of the posterior.  noise: [NOISY, M] of
    single repeats.  plain: number of repeats -> [N, M] with nothing hidden.
    """

    setting: Setting
    truth: Truth
    seed: int
    evidence: ResidualSet
    model: FittedModel
    wide: np.ndarray
    noise: np.ndarray
    plain: dict[int, np.ndarray] = field(default_factory=dict)

    @functools.cached_property
    def slopes(self) -> np.ndarray:
        """[M, D] of the base parameters, in search units, in units of one repeat's noise.

        Over a third of a search unit and not over the width of the posterior: an effect that the base model absorbs
        moves it by a hundred posterior deviations, and what those slopes owe to the solver's rounding seemed to be
        left.  Of a command delay of 3 ms they left 33 units, a refit leaves 8 and these slopes 11.
        """
        return self.model.refined.jacobian / np.sqrt(self.evidence.repeats)

    @property
    def prior(self) -> np.ndarray:
        """[D] deviations, search units, for `REPEATS` repeats whose noise is one."""
        return self.model.refined.prior * np.sqrt(REPEATS)

    def projected(self, columns: np.ndarray, free: np.ndarray | None = None) -> np.ndarray:
        """[K, M] without what the base parameters (those `free`, [D] bool) would absorb of them in a fit."""
        chosen = np.ones(len(self.prior), bool) if free is None else free
        return project(columns, self.slopes[:, chosen], self.prior[chosen])

    def asked(self, columns: np.ndarray, free: np.ndarray) -> np.ndarray:
        """[K, M] marks as the test has them, which lets base parameters move further (`ResidualSet.prior_slack`)."""
        return project(columns, self.wide[:, free], self.evidence.prior_slack * self.prior[free])

    def left(self, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[M] what the base model leaves of a column within its bounds, and which parameters [D] stay off them."""
        space, x = self.model.space, self.model.refined.x
        low, high = space.to_search(space.low) - x, space.to_search(space.high) - x
        normal = self.slopes.T @ self.slopes + np.diag(self.prior**-2)
        root = scipy.linalg.cholesky(normal)  # as upper triangle: |root dx - w|^2 is the objective
        aim = scipy.linalg.solve_triangular(root.T, self.slopes.T @ column, lower=True)
        step = scipy.optimize.lsq_linear(root, aim, (low - 1e-9, high + 1e-9)).x
        return column - self.slopes @ step, (step > low + 1e-6) & (step < high - 1e-6)

    def added(self, questions: tuple[ScoreDirection, ...]) -> np.ndarray:
        """[K, M] what the library's amplitudes add, per unit of each; 0 where a replay blows up, as in the search."""
        return np.nan_to_num(sensitivities(self.evidence, self.model.values, questions))

    def record(self, hidden: tuple[Applied, ...], repeats: int) -> Recording:
        """The same robot and the same noise, with something hidden."""
        return _recorded(self.setting, hidden, self.truth, self.seed, repeats)

    def hidden(self, effect: Applied) -> np.ndarray:
        """[REPEATS, M] what a hidden effect adds to each repeat, per unit of its amplitude.

        In inverse mode the motion counts as unchanged by it: the servo holds the arm on its path.
        """
        count = REPEATS if effect.name in BY_REPEAT else 2
        if count not in self.plain:
            self.plain[count] = self._whitened(self.record((), count))
        each = (self._whitened(self.record((effect,), count)) - self.plain[count]) / effect.amplitude
        return each if count == REPEATS else np.repeat(each.mean(axis=0)[None], REPEATS, axis=0)

    def torques(self, columns: np.ndarray) -> np.ndarray:
        """[K, M] units of noise -> [K, M] N m."""
        return torques(self.evidence, columns)

    def _whitened(self, recording: Recording) -> np.ndarray:
        """[N, M] of a recording's torques, in units of one repeat's noise."""
        (channel,) = self.evidence.cost.comparisons[0].channels
        measured = recording.channel(channel.name)
        smoothed = smooth(measured.values, measured.mask, lowpass(measured.time, channel.clock))
        return whitened(self.evidence, smoothed.transpose(0, 2, 1).reshape(len(smoothed), -1))


def ground(setting: Setting, truth: Truth, seed: int) -> Ground:
    """Record, compile, and take the slopes at the truth."""
    recording = _recorded(setting, (), truth, seed, NOISY)
    case = make_case(setting.scene, setting.base, setting.effects(), recording, recording)
    base = case.base
    known = {n: float(np.clip(v, base[n].low, base[n].high)) for n, v in truth.items() if n in base.names}
    at = case.full_space.values(known)[None]
    model, asked = (
        refit(case.train, base, (), at, RefineConfig(iterations=0, basin_hops=0, spreads=s)) for s in (0, 2)
    )
    wide = asked.refined.jacobian / np.sqrt(case.train.repeats)
    noise = case.train.resampling.residuals(np.zeros(len(case.train.time))) * np.sqrt(NOISY / (NOISY - 1))
    return Ground(setting, truth, seed, case.train, model, wide, noise)


def _recorded(setting: Setting, hidden: tuple[Applied, ...], truth: Truth, seed: int, repeats: int) -> Recording:
    drawn = Drawn(hidden, {"train": truth}, {"train": seed})
    return record(setting, drawn, ("train",), SyntheticRobotConfig(repeats=repeats))["train"]


def dense(effects: tuple[Effect, ...]) -> tuple[Candidate, ...]:
    """Candidates with `DENSE` values of every shape, within its bounds."""
    out = []
    for effect in effects:
        bounds = {p.name: (p.low, p.high) for p in effect_space([effect]).parameters}
        grid = {n: tuple(np.geomspace(*bounds[n], DENSE).tolist()) for n in effect.shape_parameters}
        out.append(replace(effect, shape_parameters=grid))
    return candidates(out)


def by_candidate(found: tuple[Candidate, ...]) -> tuple[tuple[ScoreDirection, ...], list[list[int]]]:
    """All questions, and which of them belong to each candidate."""
    questions = directions_of(found)
    rows: dict[EffectKey, list[int]] = {}
    for k, question in enumerate(questions):
        rows.setdefault(question.candidate.shaped_key, []).append(k)
    return questions, [rows[c.shaped_key] for c in found]


# ----- between N m and units of noise, for evidence of torques alone


def whitened(evidence: ResidualSet, torque: np.ndarray) -> np.ndarray:
    """[K, M] N m, column after column on the coarse clock -> [K, M] in units of one repeat's noise."""
    whitener = _whitener(evidence)
    parts = torque.reshape(len(torque), len(whitener), -1)
    return np.einsum("ckl,ncl->nck", whitener, parts).reshape(torque.shape)


def torques(evidence: ResidualSet, columns: np.ndarray) -> np.ndarray:
    """[K, M] units of one repeat's noise -> [K, M] N m."""
    whitener = _whitener(evidence)
    parts = columns.reshape(len(columns), len(whitener), -1)
    return np.linalg.solve(whitener, parts.transpose(1, 2, 0)).transpose(2, 0, 1).reshape(columns.shape)


def _whitener(evidence: ResidualSet) -> np.ndarray:
    """[C, K, K]."""
    (channel,) = evidence.cost.comparisons[0].channels
    return channel.noise.whitener / np.sqrt(evidence.repeats)
