"""Batched Gauss-Newton (Levenberg-Marquardt) on whitened residuals, from several starts at once.

Works in search coordinates x. The objective is |r(x)|^2 / 2 + |(x - x0) / w|^2 / 2 with a prior
of deviation w: one unit for nuisances (their own prior), `main_prior` units for the parameters of
interest, so that what the data do not tell stays put instead of drifting.  Every iteration is
one batch: the central differences of all starts, then one batch of trial steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from droid_jax.model.parameters import Space

Residuals = Callable[[np.ndarray], np.ndarray]
Hypotheses = Sequence[Mapping[str, float]]


@dataclass(frozen=True)
class RefineConfig:
    """Settings of the refinement.

    iterations: at most.
    step: half-width of the first central differences, search units.
    smallest_step: and of later ones at least, search units (below it solver noise would show).
    main_prior: prior deviation of parameters of interest, search units.
    tolerance: stop when an iteration lowers the objective by less than this share.
    keep: after iteration i only starts within keep[i] times the best objective go on (the last
      number holds from there on).
    hold: iterations for which the values of a hypothesis are held while all else settles.
    """

    iterations: int = 30
    step: float = 0.3
    smallest_step: float = 0.03
    main_prior: float = 4.0
    tolerance: float = 2e-3
    keep: tuple[float, ...] = (10.0, 4.0, 2.0, 1.3, 1.3, 1.0)
    hold: int = 3


@dataclass(frozen=True, eq=False)
class Refined:
    """Where the refinement ended.

    space; x [D] search coordinates and best [D] physical values of the best start;
    objective: |r|^2 / 2 plus the prior's part; residual [M] and jacobian [M, D] there;
    prior [D] deviations, search units; starts: objective each start ended at; evaluations: replays;
    iterations; converged: the last iteration met the tolerance.
    """

    space: Space
    x: np.ndarray
    best: np.ndarray
    objective: float
    residual: np.ndarray
    jacobian: np.ndarray
    prior: np.ndarray
    starts: np.ndarray
    evaluations: int
    iterations: int
    converged: bool

    @property
    def hessian(self) -> np.ndarray:
        """[D, D] Gauss-Newton curvature, prior included."""
        return self.jacobian.T @ self.jacobian + np.diag(self.prior**-2)


@dataclass(frozen=True)
class RefineProgress:
    """Reported after every iteration: its number, of how many, and the best objective per residual."""

    iteration: int
    iterations: int
    mean_square: float


def refine(
    residuals: Residuals,
    space: Space,
    starts: Any,
    config: RefineConfig | None = None,
    *,
    hypotheses: Hypotheses = (),
    progress: Callable[[RefineProgress], None] | None = None,
) -> Refined:
    """Refine one or several starts [D] or [S, D] (physical values).

    residuals: [P, D] physical values -> [P, M] whitened residuals (rows are independent).
    hypotheses: assignments {name: value} that may lie in another basin (a finger that slips, say),
      each tried once from where the starts converged.
    Raises ValueError where no start gives finite residuals.
    """
    config = config or RefineConfig()
    box = np.stack([space.to_search(space.low), space.to_search(space.high)])
    x = np.clip(space.to_search(space.check(np.atleast_2d(starts))), *box)
    prior = np.where(space.nuisance, 1.0, config.main_prior)
    batch = _Batch(residuals, space, prior)
    residual, objective = batch(x)
    if not np.isfinite(objective).any():
        raise ValueError("none of the starts could be replayed; widen the bounds or start nearer to the truth")
    ended = np.full(len(x), np.inf)
    alive = np.arange(len(x))
    state = _State(x, residual, objective, np.full(len(x), 1e-3), np.full(x.shape, config.step))
    converged, iteration = False, 0
    for iteration in range(1, config.iterations + 1):
        state, gain = _step(batch, state, box, prior, config)
        ended[alive] = state.objective
        best = float(state.objective.min())
        if progress is not None:
            progress(RefineProgress(iteration, config.iterations, 2 * best / residual.shape[1]))
        keep = state.objective <= config.keep[min(iteration, len(config.keep)) - 1] * best
        state, gain, alive = state.rows(keep), gain[keep], alive[keep]
        leader = int(np.argmin(state.objective))
        if gain[leader] > config.tolerance:
            continue
        state = state.rows(np.arange(len(alive)) == leader)
        alive = alive[[leader]]
        branched = _explore(batch, state, box, prior, config, hypotheses) if hypotheses else state
        hypotheses = ()
        if branched.objective[0] > (1 - config.tolerance) * state.objective[0]:
            converged = True
            break
        state = branched
    winner = state.rows(np.arange(len(alive)) == int(np.argmin(state.objective)))
    ended[alive] = np.minimum(ended[alive], state.objective)
    return Refined(
        space=space,
        x=winner.x[0],
        best=space.from_search(winner.x[0]),
        objective=float(winner.objective[0]),
        residual=winner.residual[0],
        jacobian=_jacobian(batch, winner.x, winner.widths, box)[0],
        prior=prior,
        starts=ended,
        evaluations=batch.rows,
        iterations=iteration,
        converged=converged,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """Live starts: x [S, D], residual [S, M], objective [S], damping [S], difference widths [S, D]."""

    x: np.ndarray
    residual: np.ndarray
    objective: np.ndarray
    damping: np.ndarray
    widths: np.ndarray

    def rows(self, keep: np.ndarray) -> _State:
        return _State(*(getattr(self, f)[keep] for f in _State.__dataclass_fields__))


def _step(
    batch: _Batch,
    state: _State,
    box: np.ndarray,
    prior: np.ndarray,
    config: RefineConfig,
    held: np.ndarray | None = None,
) -> tuple[_State, np.ndarray]:
    """One iteration of all live starts; also the share by which each objective fell. held: [S, D] bool, stay put."""
    jacobian = _jacobian(batch, state.x, state.widths, box)
    x, residual, objective, damping, gain = _try_steps(
        batch, state.x, state.residual, state.objective, jacobian, state.damping, box, held
    )
    return _State(x, residual, objective, damping, _next_widths(jacobian, prior, config)), gain


def _explore(
    batch: _Batch, state: _State, box: np.ndarray, prior: np.ndarray, config: RefineConfig, hypotheses: Hypotheses
) -> _State:
    """Follow each hypothesis from a converged start: hold its values while all else settles, then free them.

    Returns the better of what was found and `state`, as one start.
    """
    space = batch.space
    x = np.repeat(state.x, len(hypotheses), axis=0)
    held = np.zeros(x.shape, bool)
    for row, hypothesis in enumerate(hypotheses):
        for name, value in hypothesis.items():
            column = space.index(name)
            x[row, column] = space[name].to_search(value)
            held[row, column] = True
    residual, objective = batch(np.clip(x, *box))
    widths = np.repeat(state.widths, len(x), axis=0)
    branches = _State(np.clip(x, *box), residual, objective, np.full(len(x), 1e-3), widths)
    for iteration in range(config.hold + 1):
        branches, _ = _step(batch, branches, box, prior, config, held if iteration < config.hold else None)
    found = branches.rows(np.arange(len(x)) == int(np.argmin(branches.objective)))
    return found if found.objective[0] < state.objective[0] else state


class _Batch:
    """Residuals and objective in search coordinates, counting rows."""

    def __init__(self, residuals: Residuals, space: Space, prior: np.ndarray) -> None:
        self.residuals, self.space, self.prior, self.rows = residuals, space, prior, 0

    def raw(self, x: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, M]."""
        self.rows += len(x)
        return np.asarray(self.residuals(self.space.from_search(x)), dtype=np.float64)

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[P, D] -> residuals [P, M] and objectives [P]."""
        residual = self.raw(x)
        value = 0.5 * np.sum(residual**2, axis=1) + 0.5 * np.sum((x / self.prior) ** 2, axis=1)
        return residual, np.where(np.isfinite(value), value, np.inf)


def _jacobian(batch: _Batch, x: np.ndarray, widths: np.ndarray, box: np.ndarray) -> np.ndarray:
    """[S, M, D] differences of every start in one batch; one-sided where a bound is in the way."""
    starts, dims = x.shape
    steps = np.eye(dims)[None] * widths[:, None, :]
    up = np.clip(x[:, None, :] + steps, *box)
    down = np.clip(x[:, None, :] - steps, *box)
    both = np.concatenate([up, down], axis=1).reshape(-1, dims)
    residual = batch.raw(both).reshape(starts, 2 * dims, -1)
    span = np.einsum("sii->si", up - down)
    return np.swapaxes((residual[:, :dims] - residual[:, dims:]) / span[..., None], 1, 2)


_DAMPINGS = np.array([0.1, 1.0, 10.0, 100.0, 1000.0])  # times the current damping
_LONGEST = 2.0  # search units: a trial step never moves a parameter further


def _try_steps(
    batch: _Batch,
    x: np.ndarray,
    residual: np.ndarray,
    objective: np.ndarray,
    jacobian: np.ndarray,
    damping: np.ndarray,
    box: np.ndarray,
    held: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """All dampings of all starts in one batch; each start takes its best step, or stays.

    Returns x, residual, objective, damping and the share by which each objective fell.
    """
    starts, dims = x.shape
    trials = np.empty((starts, len(_DAMPINGS), dims))
    for s in range(starts):
        hessian = jacobian[s].T @ jacobian[s] + np.diag(batch.prior**-2)
        slope = jacobian[s].T @ residual[s] + x[s] / batch.prior**2
        free = ~(((x[s] <= box[0]) & (slope > 0)) | ((x[s] >= box[1]) & (slope < 0)))
        free &= True if held is None else ~held[s]
        for k, factor in enumerate(_DAMPINGS):
            damped = hessian + damping[s] * factor * np.diag(np.diag(hessian))
            step = np.zeros(dims)
            step[free] = -np.linalg.solve(damped[np.ix_(free, free)], slope[free])
            step *= min(1.0, _LONGEST / max(np.max(np.abs(step)), 1e-12))
            trials[s, k] = np.clip(x[s] + step, *box)
    new_residual, new_objective = batch(trials.reshape(-1, dims))
    new_objective = new_objective.reshape(starts, -1)
    pick = np.argmin(new_objective, axis=1)
    rows = np.arange(starts)
    better = new_objective[rows, pick] < objective
    gain = np.where(better, 1 - new_objective[rows, pick] / np.maximum(objective, 1e-300), 0.0)
    chosen = new_residual.reshape(starts, len(_DAMPINGS), -1)[rows, pick]
    return (
        np.where(better[:, None], trials[rows, pick], x),
        np.where(better[:, None], chosen, residual),
        np.where(better, new_objective[rows, pick], objective),
        np.clip(np.where(better, damping * _DAMPINGS[pick], damping * 100), 1e-8, 1e4),
        gain,
    )


def _next_widths(jacobian: np.ndarray, prior: np.ndarray, config: RefineConfig) -> np.ndarray:
    """[S, D] difference steps of about one posterior deviation, within the configured limits."""
    curvature = np.einsum("smd,smd->sd", jacobian, jacobian) + prior**-2
    return np.clip(1.0 / np.sqrt(curvature), config.smallest_step, config.step)
