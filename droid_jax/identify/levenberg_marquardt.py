"""Levenberg-Marquardt in batches: one iteration of several starts at once, in search coordinates.

An iteration is one batch of central differences, then batches of candidate steps, as long as they lower the objective
enough.  If differences take more replays than a batch of candidate steps, each batch corrects the Jacobian with its
replays (`secant_slopes`); else new differences are as cheap.  Candidate steps differ in their damping, their length and
their path.  The path is straight in search coordinates or in physical units.  Residuals are close to linear in masses,
springs and damping, whose search coordinates are logarithms.  Where two of these are correlated (door and knob turn
about the same hinge), the valley of the objective is straight in physical units only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from droid_jax.arguments import check_fields, number, optional, several, whole
from droid_jax.model.parameters import Scaling, Space

Residuals = Callable[[np.ndarray], np.ndarray]

PATHS = 2  # of a candidate step: straight in search coordinates, and in physical units


@dataclass(frozen=True)
class LevenbergMarquardtConfig:
    """Settings of an iteration.

    step: half-width of the first central differences, search units.
    smallest_step: smallest half-width of later ones, search units; with narrower ones solver noise would dominate.
      Candidate steps that are shorter do not correct the Jacobian either.
    longest_step: largest component of a candidate step, search units, within which the residuals are about linear.
    least_ratio: smallest factor on a parameter of a path that is straight in physical units.
    main_prior: prior deviation of parameters of interest, search units.
    chord: where a Jacobian is not corrected, share of the objective by which a batch of candidate steps must lower it
      for another batch.
    chords: largest number of batches with one uncorrected Jacobian.
    corrected_batches: largest number of batches with a Jacobian that each of them corrects.
    secant_ridge: ridge of the correction of a Jacobian, which limits the effect of two nearly parallel steps; None: no
      correction, and `chord` decides about another batch.
    dampings: factors on the last damping in a batch of candidate steps.  With `lengths` and both paths these are 32
      steps, the size of a block of rows on a CPU in MJX.
    lengths: factors on the full step in a batch of candidate steps.
    first_damping: damping of the first iteration, share of the curvature's diagonal.
    spreads: number of passes over the posterior's principal axes for the final Jacobian (`wide_jacobian`); 0 keeps the
      differences by single parameters.
    spread_width: half-width of these differences, posterior deviations.
    spread_longest: largest component of these differences, search units, which limits directions that the data do not
      constrain.
    """

    step: float = 0.3
    smallest_step: float = 0.03
    longest_step: float = 2.0
    least_ratio: float = 0.05
    main_prior: float = 4.0
    chord: float = 0.03
    chords: int = 3
    corrected_batches: int = 6
    secant_ridge: float | None = 0.01
    dampings: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1e0, 1e1, 1e2, 1e3, 1e4)
    lengths: tuple[float, ...] = (1.0, 0.5)
    first_damping: float = 1e-3
    spreads: int = 2
    spread_width: float = 1.5
    spread_longest: float = 1.0

    @property
    def trials(self) -> int:
        """Number of candidate steps of one start in a batch."""
        return PATHS * len(self.dampings) * len(self.lengths)

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("step", "smallest_step", "longest_step", "main_prior"), partial(number, above=0)),
            **dict.fromkeys(("first_damping", "spread_width", "spread_longest"), partial(number, above=0)),
            least_ratio=partial(number, above=0, most=1),
            chord=partial(number, least=0),
            chords=partial(whole, least=1),
            corrected_batches=partial(whole, least=1),
            secant_ridge=optional(partial(number, above=0)),
            dampings=several(partial(number, above=0)),
            lengths=several(partial(number, above=0, most=1)),
            spreads=partial(whole, least=0),
        )


@dataclass(frozen=True, eq=False)
class Starts:
    """State of S starts.

    x: [S, D] search coordinates.  residual: [S, M].  objective: [S].  damping: [S], share of the curvature's diagonal.
    widths: [S, D] half-widths of the next differences, search units.
    """

    x: np.ndarray
    residual: np.ndarray
    objective: np.ndarray
    damping: np.ndarray
    widths: np.ndarray

    def rows(self, keep: Any) -> Starts:
        """Return the starts that `keep` indexes."""
        return Starts(*(getattr(self, f)[keep] for f in Starts.__dataclass_fields__))

    def with_rows(self, at: np.ndarray, others: Starts) -> Starts:
        """Return these starts with the rows [N] `at` replaced by other ones."""
        out = self.rows(np.arange(len(self.x)))
        for field in Starts.__dataclass_fields__:
            getattr(out, field)[at] = getattr(others, field)
        return out


def curvature(jacobian: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the Gauss-Newton curvature [D, D] of the objective, from a Jacobian [M, D] and prior deviations [D]."""
    return jacobian.T @ jacobian + np.diag(prior**-2)


def penalised(x: np.ndarray, residual: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the objective [P] of residuals [P, M] at search coordinates [P, D]; infinite where a replay blew up."""
    value = 0.5 * np.sum(residual**2, axis=-1) + 0.5 * np.sum((x / prior) ** 2, axis=-1)
    return np.where(np.isfinite(value), value, np.inf)


def whole_rows(residual: np.ndarray) -> np.ndarray:
    """Return residuals [P, M] in double precision, with rows NaN throughout if they are not finite throughout.

    With several recordings the replay of one may blow up alone.
    """
    residual = np.asarray(residual, dtype=np.float64)
    return np.where(np.isfinite(residual).all(axis=1, keepdims=True), residual, np.nan)


def off_bounds(x: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return [D] bool, False for coordinates on a bound that a step down the gradient [D] would leave the bounds by."""
    return ~(((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0)))


def damped_steps(
    hessian: np.ndarray,
    slope: np.ndarray,
    free: np.ndarray,
    dampings: Sequence[float],
    lengths: Sequence[float],
    longest: float,
) -> np.ndarray:
    """Return Levenberg-Marquardt steps [dampings * lengths, D].

    Args:
        hessian: [D, D] curvature of the objective.
        slope: [D] gradient of the objective.
        free: [D] bool, coordinates that move.
        dampings: shares of the curvature's diagonal.
        lengths: factors on each full step.
        longest: largest component of a full step.
    """
    out = np.zeros((len(dampings), len(lengths), len(slope)))
    for k, damping in enumerate(dampings):
        damped = hessian + damping * np.diag(np.diag(hessian))
        step = -np.linalg.solve(damped[np.ix_(free, free)], slope[free])
        step *= min(1.0, longest / max(np.max(np.abs(step), initial=0.0), 1e-12))
        out[k][:, free] = np.outer(lengths, step)
    return out.reshape(-1, len(slope))


def secant_slopes(
    jacobian: np.ndarray, prior: np.ndarray, steps: np.ndarray, changes: np.ndarray, ridge: float
) -> np.ndarray:
    """Return the Jacobian [M, D] that agrees with known differences and is closest to `jacobian`.

    This is Broyden's update (1965) for several steps at once.  Distances are in conditional deviations of each
    parameter, so that all columns change alike.  Short steps have more weight, since the differences of long ones
    contain more curvature.

    Args:
        jacobian: [M, D] before.
        prior: [D] prior deviations, search units.
        steps: [N, D] steps from the point of the Jacobian, search units.
        changes: [N, M] changes of the residuals; NaN where a replay failed.
        ridge: ridge of the least squares problem, in units of the shortest step's weight.
    """
    scale = np.sqrt(np.einsum("md,md->d", jacobian, jacobian) + prior**-2)
    length = np.linalg.norm(steps * scale, axis=1)
    known = np.isfinite(changes).all(axis=1) & (length > 0)
    if not known.any():
        return jacobian
    steps, changes, length = steps[known], changes[known], length[known]
    weight = np.min(length) / length**2
    weighted = steps * scale * weight[:, None]
    missing = (changes - steps @ jacobian.T) * weight[:, None]
    correction = weighted.T @ np.linalg.solve(weighted @ weighted.T + ridge * np.eye(len(weighted)), missing)
    return jacobian + correction.T * scale


def principal_axes(cov: np.ndarray, longest: float) -> np.ndarray:
    """Return the principal axes [D, D] of a covariance as columns one deviation long, with no entry above `longest`."""
    variance, axes = np.linalg.eigh(cov)
    return axes * np.minimum(np.sqrt(np.maximum(variance, 0.0)), longest / np.max(np.abs(axes), axis=0))


def fall(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the decrease [S] of the objectives; 0 for a start whose replay still blows up."""
    return np.where(np.isinf(after), 0.0, before - np.where(np.isinf(after), 0.0, after))


class DampedProblem:
    """Residuals and prior in search coordinates, and the steps of an iteration; counts iterations and replays.

    residuals: [P, D] physical values -> [P, M].  space: meaning of the D entries.  config: settings.
    before: a problem whose counts are continued.
    """

    def __init__(
        self, residuals: Residuals, space: Space, config: LevenbergMarquardtConfig, before: DampedProblem | None = None
    ) -> None:
        self.residuals, self.space = residuals, space
        self._config = config
        self.prior = np.where(space.nuisance, 1.0, config.main_prior)
        self.low, self.high = space.to_search(space.low), space.to_search(space.high)
        self.log_width = np.array([p.log_width if p.scaling is Scaling.LOG else 0.0 for p in space.parameters])
        self.evaluations = before.evaluations if before else 0
        self.iterations = before.iterations if before else 0

    def inside(self, x: np.ndarray) -> np.ndarray:
        """Return search coordinates x, clipped to the bounds."""
        return np.clip(x, self.low, self.high)

    def replay(self, x: np.ndarray) -> np.ndarray:
        """Return residuals [P, M] at search coordinates [P, D]; rows of replays that blew up are NaN throughout."""
        self.evaluations += len(x)
        return whole_rows(self.residuals(self.space.from_search(x)))

    def differences(self, up: np.ndarray, down: np.ndarray, state: Starts) -> tuple[np.ndarray, np.ndarray]:
        """Return spans [S, N, D] and residual differences [S, N, M] between points `up` and `down`, both [S, N, D].

        The start replaces a point whose replay blew up.
        """
        points = np.stack([up, down])
        residual = self.replay(points.reshape(-1, points.shape[-1])).reshape(*points.shape[:3], -1)
        return self._differences(points, residual, state)

    @staticmethod
    def _differences(points: np.ndarray, residual: np.ndarray, state: Starts) -> tuple[np.ndarray, np.ndarray]:
        """The same from points [2, S, N, D] and their residuals [2, S, N, M]."""
        failed = np.isnan(residual[..., :1])
        points = np.where(failed, state.x[:, None], points)
        residual = np.where(failed, state.residual[:, None], residual)
        return points[0] - points[1], residual[0] - residual[1]

    def objective(self, x: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """Return the objective [P]; infinite where a replay blew up."""
        return penalised(x, residual, self.prior)

    def start(self, x: np.ndarray) -> Starts:
        """Replay starts [S, D] and return their state."""
        return self.begun(x, self.replay(x))

    def begun(self, x: np.ndarray, residual: np.ndarray) -> Starts:
        """Return the state of new starts [S, D] with residuals [S, M]."""
        widths = np.full(x.shape, self._config.step)
        return Starts(x, residual, self.objective(x, residual), np.full(len(x), self._config.first_damping), widths)

    def start_with_slopes(self, x: np.ndarray) -> tuple[Starts, np.ndarray]:
        """Return `start` and `jacobian` [S, M, D] of new starts [S, D], from one batch of replays."""
        widths = np.full(x.shape, self._config.step)
        points = np.stack(self._around(x, widths))
        residual = self.replay(np.concatenate([x, points.reshape(-1, x.shape[1])]))
        state = self.begun(x, residual[: len(x)])
        return state, self._slopes(*self._differences(points, residual[len(x) :].reshape(*points.shape[:3], -1), state))

    def step(
        self, state: Starts, held: np.ndarray | None = None, jacobian: np.ndarray | None = None
    ) -> tuple[Starts, np.ndarray]:
        """Do one iteration of all starts; return them, and the decrease [S] of each objective.

        held: [S, D] bool, coordinates that stay fixed.  jacobian: [S, M, D] if it is known.
        """
        jacobian = self.jacobian(state) if jacobian is None else jacobian
        before = state.objective
        self.iterations += 1
        state, jacobian = self.candidate_steps(state, jacobian, held)
        curvature = np.einsum("smd,smd->sd", jacobian, jacobian) + self.prior**-2
        # About one conditional deviation wide; three for a start that did not move, to get another Jacobian.
        widths = np.where((state.objective < before)[:, None], 1.0, 3.0) / np.sqrt(curvature)
        widths = np.clip(widths, self._config.smallest_step, self._config.step)
        return replace(state, widths=widths), fall(before, state.objective)

    def candidate_steps(
        self, state: Starts, jacobian: np.ndarray, held: np.ndarray | None = None
    ) -> tuple[Starts, np.ndarray]:
        """Take batches of candidate steps; return the starts, and the Jacobian [S, M, D] with its corrections.

        A start gets another batch if the last one decreased its objective enough.  The decrease for each replay must be
        that of the first batch, whose replays include the differences.  Without corrections see `paid`.

        held: [S, D] bool, coordinates that stay fixed.
        """
        config, differences = self._config, 2 * len(self.space)
        replays = config.trials, config.trials + differences
        ridge = config.secant_ridge if differences > config.trials else None
        active, first, jacobian = np.arange(len(state.x)), np.zeros(len(state.x)), jacobian.copy()
        for batch in range(config.chords if ridge is None else config.corrected_batches):
            last = state.rows(active)
            candidates = self.trials(last, jacobian[active], None if held is None else held[active])
            residual = self.replay(candidates.reshape(-1, candidates.shape[-1])).reshape(*candidates.shape[:2], -1)
            now = self.taken(last, candidates, residual)
            state, decrease = state.with_rows(active, now), fall(last.objective, now.objective)
            if ridge is None:
                if not self.paid(last, now):
                    break
                continue
            first = first if batch else decrease
            for k in np.flatnonzero(decrease > 0):  # at a start that did not move, central differences are better
                # A step that raised the objective may have left the basin: its difference is no slope.
                lower = self.objective(candidates[k], residual[k]) <= last.objective[k]
                steps = np.vstack([last.x[k], candidates[k][lower]]) - now.x[k]
                changes = np.vstack([last.residual[k], residual[k][lower]]) - now.residual[k]
                wide = np.max(np.abs(steps), axis=1) >= config.smallest_step
                jacobian[active[k]] = secant_slopes(jacobian[active[k]], self.prior, steps[wide], changes[wide], ridge)
            active = active[(decrease > 0) & (decrease * replays[1] >= first[active] * replays[0])]
            if not len(active):
                break
        return state, jacobian

    def jacobian(self, state: Starts) -> np.ndarray:
        """Return central differences [S, M, D] of every start from one batch; one-sided at a bound."""
        return self._slopes(*self.differences(*self._around(state.x, state.widths), state))

    def _around(self, x: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [S, D, D] a width above and below starts [S, D] along each axis, within bounds."""
        steps = np.eye(x.shape[1]) * widths[:, None, :]
        return self.inside(x[:, None] + steps), self.inside(x[:, None] - steps)

    @staticmethod
    def _slopes(spans: np.ndarray, differences: np.ndarray) -> np.ndarray:
        """Slopes [S, M, D] from spans [S, D, D] and residual differences [S, D, M] along each axis."""
        span = np.einsum("sii->si", spans)[..., None]
        return np.swapaxes(np.where(span > 0, differences / np.where(span > 0, span, 1.0), 0.0), 1, 2)

    def axes(self, jacobian: np.ndarray, longest: float) -> np.ndarray:
        """Return the posterior's principal axes [D, D] as columns one deviation long, with no entry above `longest`."""
        return principal_axes(np.linalg.inv(curvature(jacobian, self.prior)), longest)

    def wide_jacobian(self, state: Starts, jacobian: np.ndarray) -> np.ndarray:
        """Return the Jacobian [M, D] of one start from differences along the posterior's principal axes.

        Differences by single parameters contain the solver's rounding error.  Where two parameters are correlated,
        their slopes cancel along the valley and the rounding error does not, so it looks like information.  Differences
        along the principal axes are `spread_width` posterior deviations wide, so that rounding is small beside them.
        The first axes come from `jacobian` [M, D], which contains the error; they are improved `spreads` times.
        """
        for _ in range(self._config.spreads):
            steps = self._config.spread_width * self.axes(jacobian, self._config.spread_longest).T
            spans, differences = self.differences(
                self.inside(state.x[:, None] + steps), self.inside(state.x[:, None] - steps), state
            )
            if np.any(np.all(spans[0] == 0, axis=1)):  # both replays of an axis blew up
                return jacobian
            jacobian = np.linalg.lstsq(spans[0], differences[0])[0].T
        return jacobian

    def trials(self, state: Starts, jacobian: np.ndarray, held: np.ndarray | None = None) -> np.ndarray:
        """Return the candidate steps' points [S, N, D] of all starts: every damping and length, on both paths."""
        steps = np.stack([self._steps(state.rows([s]), jacobian[s], held, s) for s in range(len(state.x))])
        paths = [self.inside(state.x[:, None] + steps), self.inside(self._straight(state.x[:, None], steps))]
        return np.concatenate(paths, axis=1)

    def taken(self, state: Starts, trials: np.ndarray, residual: np.ndarray) -> Starts:
        """Return each start at its best candidate point, or unchanged if none is better.

        trials: [S, N, D] points.  residual: [S, N, M] of them.
        """
        objective = self.objective(trials, residual)
        rows, pick = np.arange(len(state.x)), np.argmin(objective, axis=1)
        better = objective[rows, pick] < state.objective
        factor = np.tile(np.repeat(self._config.dampings, len(self._config.lengths)), PATHS)[pick]
        return Starts(
            x=np.where(better[:, None], trials[rows, pick], state.x),
            residual=np.where(better[:, None], residual[rows, pick], state.residual),
            objective=np.where(better, objective[rows, pick], state.objective),
            damping=np.clip(np.where(better, state.damping * factor, state.damping), 1e-8, 1e4),
            widths=state.widths,
        )

    def paid(self, before: Starts, after: Starts) -> bool:
        """Return whether a batch lowered the objective of some start enough for another one with the same Jacobian."""
        return bool(np.any(fall(before.objective, after.objective) > self._config.chord * after.objective))

    def _steps(self, state: Starts, jacobian: np.ndarray, held: np.ndarray | None, row: int) -> np.ndarray:
        """Levenberg-Marquardt steps [dampings * lengths, D] of one start, along the bounds that it is on.

        Zero for a start whose replay blew up.
        """
        x, dampings, lengths = state.x[0], self._config.dampings, self._config.lengths
        if not np.isfinite(state.objective[0]):
            return np.zeros((len(dampings) * len(lengths), len(x)))
        slope = jacobian.T @ state.residual[0] + x / self.prior**2
        free = off_bounds(x, slope, self.low, self.high)
        free &= True if held is None else ~held[row]
        scaled = [state.damping[0] * factor for factor in dampings]
        return damped_steps(curvature(jacobian, self.prior), slope, free, scaled, lengths, self._config.longest_step)

    def _straight(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """x moved by `step` along lines that are straight in physical units instead of search coordinates."""
        width = np.where(self.log_width > 0, self.log_width, 1.0)
        path = np.log(np.maximum(1.0 + width * step, self._config.least_ratio)) / width
        return x + np.where(self.log_width > 0, path, step)
