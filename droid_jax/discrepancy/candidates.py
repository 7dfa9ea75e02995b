"""The score test: whether anything is missing, and how much of the residual each candidate would explain.

A candidate is simulated once with a small coefficient.  Its sensitivity is the whitened difference of the simulation,
less the projection on the columns of the base parameters, priors included.  Its score is the product of sensitivity and
residual, one for each repeat.  Source of the projection: Plumlee, Bayesian calibration of inexact computer models, JASA
2017.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from scipy.optimize import lsq_linear

from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.statistics import largest_trend
from droid_jax.model.effect_interface import MOVING, STEERING, Effect, Rollout, has_law
from droid_jax.model.effects.candidate import Candidate, EffectKey, Keys, keys_of
from droid_jax.model.effects.effect_scaling import scale_of, usual_torques
from droid_jax.model.effects.registry import library
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

if TYPE_CHECKING:
    from droid_jax.discrepancy.fitting import FittedModel

ACT_ON_COMMANDS = ("actuator_", "dof_sol", "pair_")  # beginnings of model fields that inverse dynamics does not read
MEASURED = 0.98  # quantile of measured torques, as the largest of them
SAMPLES = 16  # of a random motion, on which the effect of a sensor model is tried


def observable_effects(
    scene: Scene, recordings: Sequence[Recording], scale: float | None = None, channels: Iterable[str] = ("torque",)
) -> tuple[Effect, ...]:
    """The library's effects that can change the compared channels of these recordings.

    Effects that act on commands alone are left out for recordings without commands.

    Args:
        scene: with the effects' joints and bodies.
        recordings: to be searched.
        scale: of the effects' forces and torques, see `library`; None: that of the machine (`machine_scale`).
        channels: names of the compared channels.
    """
    commanded = all(r.command.size for r in recordings)
    scale = machine_scale(scene, recordings) if scale is None else scale
    asked = (e for e in library(scene, scale=scale) if commanded or not acts_on_commands_only(e))
    return tuple(e for e in asked if shows_in(e, scene, channels))


def machine_scale(scene: Scene, recordings: Sequence[Recording]) -> float:
    """Scale of the library's forces and torques for a scene, by its weight and inertia and the measured torques."""
    joints = [j for j in scene.joints if j in scene.single_joints and j != scene.object_joint]
    measured = [
        float(np.quantile(np.abs(channel.values[channel.mask]), MEASURED))
        for channel in (r.channels["torque"] for r in recordings if "torque" in r.channels)
        if channel.mask.any()
    ]
    return scale_of(max([*usual_torques(scene, joints), *measured], default=0.0))


def shows_in(effect: Effect, scene: Scene, channels: Iterable[str]) -> bool:
    """Whether an effect can change a compared channel.

    An effect that moves the robot can change all of them.  A sensor model is tried on a random motion: a torque offset
    does not show in positions.
    """
    if has_law(effect, MOVING) or effect.observe is None or any(p.writes for p in effect.parameters):
        return True
    rng = np.random.default_rng(0)
    torque, position, velocity = rng.normal(size=(3, SAMPLES, len(scene.joints)))
    motion = Rollout(
        np.linspace(0.0, 1.0, SAMPLES), torque, position, velocity, rng.normal(size=SAMPLES),
        np.zeros((SAMPLES, 0), bool), np.array(True),
    )  # fmt: skip
    observed = effect.observe({p.name: jnp.float32(p.mean + p.std) for p in effect.parameters}, motion)
    return any(not np.array_equal(getattr(observed, name), getattr(motion, name)) for name in channels)


def acts_on_commands_only(effect: Effect) -> bool:
    """Whether an effect acts through commands, servos or constraints alone, which a prescribed motion does not have.

    This includes effects without functions whose parameters write only model fields of these (`servo_gain`,
    `soft_friction`).
    """
    if has_law(effect, STEERING):
        return True
    fields = [w.field for p in effect.parameters for w in p.writes]
    acts = has_law(effect, ("force", "frictionloss", "observe")) or not all(p.writes for p in effect.parameters)
    return bool(fields) and not acts and all(field.startswith(ACT_ON_COMMANDS) for field in fields)


@dataclass(frozen=True, eq=False)
class ScoreDirection:
    """One coefficient of one candidate (a tilted frame has two)."""

    candidate: Candidate
    coefficient: str


def directions_of(candidates: Sequence[Candidate]) -> tuple[ScoreDirection, ...]:
    """One direction for each coefficient of each candidate."""
    return tuple(ScoreDirection(c, a) for c in candidates for a in c.coefficients)


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """Result of the score test of a model.

    directions: K of them.
    raw: [K, M] change of the simulation per unit of each coefficient, in one repeat's noise.
    sensitivities: [K, M] the same after projection.
    t: [K] statistic.
    explained: [K] share of the squared residual that the best coefficient would explain, linearly.
    size: [K] that coefficient's distance from neutral.
    p: p-value of the largest |t|.
    failed: candidates whose replay blew up; their sensitivities are zero.
    """

    directions: tuple[ScoreDirection, ...]
    raw: np.ndarray
    sensitivities: np.ndarray
    t: np.ndarray
    explained: np.ndarray
    size: np.ndarray
    p: float
    failed: Keys = ()

    def ranking(self) -> list[int]:
        """Indices of the directions by the share that they explain, the largest first."""
        return np.argsort(-self.explained).tolist()


def rows_of(found: ScoreTest, parts: Sequence[Candidate]) -> list[int]:
    """Indices of the directions of some candidates with their shape parameters."""
    keys = {part.shaped_key for part in parts}
    return [k for k, d in enumerate(found.directions) if d.candidate.shaped_key in keys]


def sensitivities(
    residual_set: ResidualSet,
    values: np.ndarray,
    directions: Sequence[ScoreDirection],
    at: Sequence[float] | None = None,
) -> np.ndarray:
    """Change of the simulation per unit of each coefficient, by one-sided differences from neutral in one batch.

    Args:
        residual_set: of the recording.
        values: [D] of the fitted model.
        directions: K of them.
        at: [K] distance of each coefficient from neutral; None: `SelectionConfig.sensitivity_step` deviations.

    Returns:
        [K, M] in one repeat's noise.  A row is NaN if its replay blew up.
    """
    space, share = residual_set.cost.space, residual_set.config.sensitivity_step
    rows, sizes = [values], []
    for number, direction in enumerate(directions):
        row = values.copy()
        for name, value in direction.candidate.shape_parameters.items():
            row[space.index(name)] = value
        p = space[direction.coefficient]
        size = from_neutral(p, share) if at is None else at[number]
        row[space.index(direction.coefficient)] = p.mean + size
        rows.append(row)
        sizes.append(size)
    simulated = -residual_set.common(np.stack(rows))
    slopes = (simulated[1:] - simulated[0]) / np.array(sizes)[:, None]
    return np.where(np.isfinite(slopes).all(axis=1, keepdims=True), slopes, np.nan)


def from_neutral(p: Parameter, share: float) -> float:
    """Distance of a coefficient from neutral at which it is tried: a share of its deviation, at most half its range."""
    span = p.high - p.mean or p.low - p.mean  # downwards where neutral is the upper bound
    return math.copysign(min(share * p.std, 0.5 * abs(span)), span)


def project(columns: np.ndarray, base: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Columns [K, M] less their ridge regression on base columns [M, D] with prior deviations [D]."""
    normal = base.T @ base + np.diag(prior**-2)
    return columns - np.linalg.solve(normal, base.T @ columns.T).T @ base.T


def score_test(
    residual_set: ResidualSet, model: FittedModel, directions: Sequence[ScoreDirection], seed: int = 0
) -> ScoreTest:
    """The score test of directions against a model's residuals on the recording it was fitted to.

    A base parameter at a bound absorbs nothing, so sensitivities are not projected on its column.

    The error of the time step, if computed, is subtracted from the residuals first.  It is the same in every repeat or
    block, so sign flips cannot distinguish it from an effect.
    """
    root, free = residual_set.repeats**0.5, model.refined.free
    base, prior = model.refined.jacobian[:, free] / root, model.refined.prior[free] * root * residual_set.prior_slack
    raw = sensitivities(residual_set, model.values, directions)
    blown_up = np.isnan(raw).any(axis=1)
    raw[blown_up] = 0.0
    projected = project(raw, base, prior)
    rows, residuals = residual_set.resampling, model.residuals
    if residual_set.step_difference is not None:
        step = project(residual_set.step_difference[None], base, model.refined.prior[free] * root)[0]
        residuals = rows.residuals(residuals.mean(axis=0) - step)
    found = scored(residuals, directions, raw, projected, lambda s: rows.largest_score(s, projected, base, prior, seed))
    failed = tuple(dict.fromkeys(directions[k].candidate.key for k in np.flatnonzero(blown_up).tolist()))
    return replace(found, failed=failed)


def scored(
    residuals: np.ndarray,
    directions: Sequence[ScoreDirection],
    raw: np.ndarray,
    projected: np.ndarray,
    largest: Callable[[np.ndarray], tuple[np.ndarray, float]],
) -> ScoreTest:
    """The score test of projected sensitivities against residuals.

    Args:
        residuals: [N, M] of the model.
        directions: K of them.
        raw: [K, M] their sensitivities before projection.
        projected: [K, M] their sensitivities after projection.
        largest: scores [K, N] -> statistic [K] and the p-value of the largest (see `Resampling.largest_score`).
    """
    scores = projected @ residuals.T  # [K, N]
    t, p = largest(scores)
    size = scores.mean(axis=1) / np.maximum(np.einsum("km,km->k", projected, projected), 1e-30)
    common = residuals.mean(axis=0)
    explained = size * scores.mean(axis=1) / max(float(common @ common), 1e-30)
    return ScoreTest(tuple(directions), raw, projected, t, explained, size, p)


@dataclass(frozen=True)
class Trend:
    """The strongest trend over the repeats, e.g. of a gear that warms up or a sensor that drifts.

    Repeats are treated as measurements of one motion.  Changes between them count as noise and are not in U.

    key, coefficient: the candidate and the coefficient whose sensitivity follows the trend.
    per_repeat: change of the coefficient from one repeat to the next, in its unit.
    p: p-value of the largest trend among all candidates, by permutations of the order.
    """

    key: EffectKey
    coefficient: str
    per_repeat: float
    p: float


def trend(found: ScoreTest, residuals: np.ndarray, seed: int = 0) -> Trend | None:
    """The strongest trend of residuals [N, M] over the order of the repeats; None for fewer than three repeats."""
    if len(residuals) < 3 or not found.directions:
        return None
    size = np.maximum(np.linalg.norm(found.sensitivities, axis=1), 1e-30)
    scores = (found.sensitivities @ residuals.T) / size[:, None]  # [K, N], noise of one
    best, slope, p = largest_trend(scores, seed)
    direction = found.directions[best]
    return Trend(direction.candidate.key, direction.coefficient, slope / float(size[best]), p)


@dataclass(frozen=True)
class Proposal:
    """Candidates to add to a model.

    parts: one or several candidates.
    sizes: coefficient -> value.
    explained: share of the squared residual that they would explain, linearly.
    """

    parts: tuple[Candidate, ...]
    sizes: Mapping[str, float]
    explained: float

    @property
    def keys(self) -> Keys:
        """Keys of the candidates."""
        return keys_of(self.parts)

    def start(self, space: Space, values: np.ndarray) -> np.ndarray:
        """`values` [D] with the proposed shape parameters and coefficients."""
        out = values.copy()
        for name, value in {**{k: v for c in self.parts for k, v in c.shape_parameters.items()}, **self.sizes}.items():
            out[space.index(name)] = value
        return out


def proposals(
    found: ScoreTest, residuals: np.ndarray, space: Space, number: int = 1, among: Container[EffectKey] | None = None
) -> list[Proposal]:
    """Every candidate, or every pair of candidates, with its best shape parameters, the best first.

    Coefficients stay inside their bounds: a friction that would have to be negative explains nothing.

    Args:
        found: the score test.
        residuals: [N, M] of the model that was tested.
        space: of all parameters.
        number: 1 for candidates, 2 for pairs.
        among: keys of the candidates to propose, None for all.
    """
    common = residuals.mean(axis=0)
    squared = max(float(common @ common), 1e-30)
    scores, gram = found.sensitivities @ common, found.sensitivities @ found.sensitivities.T
    groups: dict[EffectKey, list[int]] = {}
    for k, direction in enumerate(found.directions):
        if among is None or direction.candidate.key in among:
            groups.setdefault(direction.candidate.shaped_key, []).append(k)
    best: dict[Keys, Proposal] = {}
    for rows in _combinations(list(groups.values()), number, found):
        proposal = _proposal(found, rows, scores[rows], gram[np.ix_(rows, rows)], squared, space)
        known = best.get(proposal.keys)
        if known is None or proposal.explained > known.explained:
            best[proposal.keys] = proposal
    return sorted(best.values(), key=lambda p: -p.explained)


def _combinations(groups: Sequence[list[int]], number: int, found: ScoreTest) -> list[list[int]]:
    if number == 1:
        return list(groups)

    def together(a: Candidate, b: Candidate) -> bool:
        """Whether two candidates fit into one model: no shared coefficient, one shape for an effect's locations."""
        disjoint = not {*a.coefficients} & {*b.coefficients}
        return disjoint and (a.effect != b.effect or a.shape_parameters == b.shape_parameters)

    of = [found.directions[rows[0]].candidate for rows in groups]
    both = ((i, k) for i in range(len(of)) for k in range(i + 1, len(of)) if together(of[i], of[k]))
    return [[*groups[i], *groups[k]] for i, k in both]


def _proposal(
    found: ScoreTest, rows: Sequence[int], scores: np.ndarray, gram: np.ndarray, squared: float, space: Space
) -> Proposal:
    """The candidates of `rows` with their best coefficients inside the bounds; squared: the squared residual."""
    names = [found.directions[k].coefficient for k in rows]
    low = np.array([space[n].low - space[n].mean for n in names])
    high = np.array([space[n].high - space[n].mean for n in names])
    ridge = gram + 1e-9 * max(np.trace(gram), 1e-30) * np.eye(len(gram))
    if len(rows) == 1:
        size = np.clip(scores / ridge[0], low, high)
    else:
        factor = np.linalg.cholesky(ridge)
        size = lsq_linear(factor.T, np.linalg.solve(factor, scores), bounds=(low, high)).x
    explained = float(2 * size @ scores - size @ gram @ size) / squared
    sizes = {n: float(space[n].mean + s) for n, s in zip(names, size, strict=True)}
    parts = {found.directions[k].candidate.shaped_key: found.directions[k].candidate for k in rows}
    return Proposal(tuple(parts.values()), sizes, explained)


def collinear(found: ScoreTest, keys: Container[EffectKey], cosine: float) -> set[EffectKey]:
    """Candidates with a sensitivity whose absolute cosine with one of `keys` is above `cosine`."""
    rows = np.array([d.candidate.key in keys for d in found.directions])
    unit = found.sensitivities / np.maximum(np.linalg.norm(found.sensitivities, axis=1, keepdims=True), 1e-30)
    near = np.max(np.abs(unit @ unit[rows].T), axis=1) > cosine
    return {found.directions[k].candidate.key for k in np.flatnonzero(near)}
