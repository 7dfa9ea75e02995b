"""Levenberg-Marquardt in batches: one iteration of several starts at once, in search coordinates.

An iteration is one batch of central differences, then batches of trial steps for as long as they pay.  Each of them
corrects the Jacobian by what the trials before it have shown (`secant_slopes`).  A trial differs from the next in its
damping, its length and its path: straight in search coordinates, or straight in physical units.  Residuals are close to
linear in masses, springs and damping, whose search coordinate is their logarithm; where two of them trade with each
other (door and knob turn about the same hinge), the valley between them is straight in physical units alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from droid_jax.arguments import check_fields, number, several, whole
from droid_jax.model.parameters import Scaling, Space

Residuals = Callable[[np.ndarray], np.ndarray]

PATHS = 2  # of a trial


@dataclass(frozen=True)
class LevenbergMarquardtConfig:
    """Settings of an iteration.

    step: half-width of the first central differences, search units.
    smallest_step: and of later ones at least, search units (below it solver noise would show); trials that are nearer
      correct no slopes either.
    longest_step: largest component of a candidate step, search units: further off the slopes no longer hold.
    least_ratio: a path that is straight in physical units takes a parameter to no less than this share of itself.
    main_prior: prior deviation of parameters of interest, search units.
    chord: without new differences, a Jacobian serves another batch of trials while the last lowered the objective by
      this share.
    chords: batches of trials at most between two batches of differences.
    secant_ridge: of the correction of a Jacobian by trials; limits what two nearly parallel steps may ask for.
    dampings: factors on the last damping that a batch of trials tries; with lengths and both paths 32 trials, the block
      of a CPU in MJX.
    lengths: shares of the whole step that it tries.
    spreads: times that the slopes are taken over the width of the posterior at the end; 0 leaves the narrow ones.
    spread_width: half-width of those differences, posterior deviations.
    spread_longest: and their largest component, search units: what the data do not tell is not followed far.
    """

    step: float = 0.3
    smallest_step: float = 0.03
    longest_step: float = 2.0
    least_ratio: float = 0.05
    main_prior: float = 4.0
    chord: float = 0.03
    chords: int = 6
    secant_ridge: float = 0.01
    dampings: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1e0, 1e1, 1e2, 1e3, 1e4)
    lengths: tuple[float, ...] = (1.0, 0.5)
    spreads: int = 2
    spread_width: float = 1.5
    spread_longest: float = 1.0

    @property
    def trials(self) -> int:
        """Rows of a batch of trials."""
        return PATHS * len(self.dampings) * len(self.lengths)

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("step", "smallest_step", "longest_step", "main_prior"), partial(number, above=0)),
            **dict.fromkeys(("spread_width", "spread_longest"), partial(number, above=0)),
            least_ratio=partial(number, above=0, most=1),
            chord=partial(number, least=0),
            chords=partial(whole, least=1),
            secant_ridge=partial(number, above=0),
            dampings=several(partial(number, above=0)),
            lengths=several(partial(number, above=0, most=1)),
            spreads=partial(whole, least=0),
        )


@dataclass(frozen=True, eq=False)
class Starts:
    """Live starts: x [S, D], residual [S, M], objective [S], damping [S], difference widths [S, D]."""

    x: np.ndarray
    residual: np.ndarray
    objective: np.ndarray
    damping: np.ndarray
    widths: np.ndarray

    def rows(self, keep: Any) -> Starts:
        """The starts that `keep` indexes."""
        return Starts(*(getattr(self, f)[keep] for f in Starts.__dataclass_fields__))

    def with_rows(self, at: np.ndarray, others: Starts) -> Starts:
        """These starts, and at the rows [N] `at` the others."""
        out = self.rows(np.arange(len(self.x)))
        for field in Starts.__dataclass_fields__:
            getattr(out, field)[at] = getattr(others, field)
        return out


def curvature(jacobian: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """[D, D] Gauss-Newton curvature of the objective from slopes [M, D] and prior deviations [D]."""
    return jacobian.T @ jacobian + np.diag(prior**-2)


def penalised(x: np.ndarray, residual: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """[P] objective of residuals [P, M] at search coordinates [P, D]; infinite where a replay gave no numbers."""
    value = 0.5 * np.sum(residual**2, axis=-1) + 0.5 * np.sum((x / prior) ** 2, axis=-1)
    return np.where(np.isfinite(value), value, np.inf)


def whole_rows(residual: np.ndarray) -> np.ndarray:
    """Residuals [P, M] in double precision, NaN throughout a row where a replay failed; of several recordings one may
    have."""
    residual = np.asarray(residual, dtype=np.float64)
    return np.where(np.isfinite(residual).all(axis=1, keepdims=True), residual, np.nan)


def off_bounds(x: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[D] bool, coordinates that a step down the slope [D] does not push over a bound that they sit on."""
    return ~(((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0)))


def damped_steps(
    hessian: np.ndarray,
    slope: np.ndarray,
    free: np.ndarray,
    dampings: Sequence[float],
    lengths: Sequence[float],
    longest: float,
) -> np.ndarray:
    """[dampings * lengths, D] Levenberg-Marquardt steps of the free coordinates [D], no component beyond `longest`.

    dampings: shares of the curvature's diagonal.  lengths: shares of each whole step.
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
    """Slopes [M, D] that agree with known differences, and change as little from `jacobian` as that allows.

    Broyden's update (1965) for several differences at once.  How little is counted in units of each parameter's own
    deviation, so that sharp parameters are not changed more than others.  Short steps count more: the longer a step,
    the more of its difference is curvature.

    Args:
        jacobian: [M, D].
        prior: [D] prior deviations.
        steps: [N, D] from where the slopes are wanted.
        changes: [N, M] of the residuals; NaN where a replay failed.
        ridge: share of the shortest step's weight that is noise.
    """
    scale = np.sqrt(np.einsum("md,md->d", jacobian, jacobian) + prior**-2)
    length = np.linalg.norm(steps * scale, axis=1)
    known = np.isfinite(changes).all(axis=1) & (length > 0)
    if not known.any():
        return jacobian
    steps, changes, length = steps[known], changes[known], length[known]
    weight = np.min(length) / length**2
    ways = steps * scale * weight[:, None]
    wanted = (changes - steps @ jacobian.T) * weight[:, None]
    change = ways.T @ np.linalg.solve(ways @ ways.T + ridge * np.eye(len(ways)), wanted)
    return jacobian + change.T * scale


def principal_axes(cov: np.ndarray, longest: float) -> np.ndarray:
    """[D, D] columns: principal axes of a covariance, one deviation long, no entry beyond `longest`."""
    variance, axes = np.linalg.eigh(cov)
    return axes * np.minimum(np.sqrt(np.maximum(variance, 0.0)), longest / np.max(np.abs(axes), axis=0))


def fall(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[S] by how much the objectives fell; 0 for a start that could not be replayed and still cannot."""
    return np.where(np.isinf(after), 0.0, before - np.where(np.isinf(after), 0.0, after))


class DampedProblem:
    """Residuals and prior in search coordinates, with what an iteration does; counts iterations and replays.

    It keeps the slopes of the last iteration, corrected to where that ended (`slopes`).

    before: a problem whose counts are gone on with.
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
        self._known = np.zeros((0, len(space))), np.zeros((0, 0, len(space)))  # starts [S, D], slopes [S, M, D] there

    def inside(self, x: np.ndarray) -> np.ndarray:
        """x clipped to the bounds."""
        return np.clip(x, self.low, self.high)

    def replay(self, x: np.ndarray) -> np.ndarray:
        """[P, D] -> residuals [P, M]; NaN throughout where a replay failed."""
        self.evaluations += len(x)
        return whole_rows(self.residuals(self.space.from_search(x)))

    def differences(self, up: np.ndarray, down: np.ndarray, state: Starts) -> tuple[np.ndarray, np.ndarray]:
        """Spans [S, N, D] and residual differences [S, N, M] between up and down, both [S, N, D].

        The start itself takes the place of a replay that failed.
        """
        points = np.stack([up, down])
        residual = self.replay(points.reshape(-1, points.shape[-1])).reshape(*points.shape[:3], -1)
        return self._apart(points, residual, state)

    @staticmethod
    def _apart(points: np.ndarray, residual: np.ndarray, state: Starts) -> tuple[np.ndarray, np.ndarray]:
        """The same of points [2, S, N, D] and their residuals [2, S, N, M]."""
        failed = np.isnan(residual[..., :1])
        points = np.where(failed, state.x[:, None], points)
        residual = np.where(failed, state.residual[:, None], residual)
        return points[0] - points[1], residual[0] - residual[1]

    def objective(self, x: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """[P]; infinite where a replay gave no numbers."""
        return penalised(x, residual, self.prior)

    def start(self, x: np.ndarray) -> Starts:
        """The state of fresh starts [S, D]."""
        return self.begun(x, self.replay(x))

    def begun(self, x: np.ndarray, residual: np.ndarray) -> Starts:
        """The state of fresh starts [S, D] with residuals [S, M]."""
        widths = np.full(x.shape, self._config.step)
        return Starts(x, residual, self.objective(x, residual), np.full(len(x), 1e-3), widths)

    def start_with_slopes(self, x: np.ndarray) -> tuple[Starts, np.ndarray]:
        """`start` of fresh starts [S, D] and their `jacobian` [S, M, D], of one batch of replays."""
        widths = np.full(x.shape, self._config.step)
        points = np.stack(self._around(x, widths))
        residual = self.replay(np.concatenate([x, points.reshape(-1, x.shape[1])]))
        state = self.begun(x, residual[: len(x)])
        return state, self._slopes(*self._apart(points, residual[len(x) :].reshape(*points.shape[:3], -1), state))

    def step(
        self, state: Starts, held: np.ndarray | None = None, jacobian: np.ndarray | None = None
    ) -> tuple[Starts, np.ndarray]:
        """One iteration of all starts, and by how much each objective fell.

        held: [S, D] bool, stay put.  jacobian: [S, M, D] where it is known.
        """
        jacobian = self.jacobian(state) if jacobian is None else jacobian
        before = state.objective
        self.iterations += 1
        state, jacobian = self.candidate_steps(state, jacobian, held)
        self._known = state.x, jacobian
        curvature = np.einsum("smd,smd->sd", jacobian, jacobian) + self.prior**-2
        # About one deviation wide, the others given; a start that stood still looks from elsewhere.
        widths = np.where((state.objective < before)[:, None], 1.0, 3.0) / np.sqrt(curvature)
        widths = np.clip(widths, self._config.smallest_step, self._config.step)
        return replace(state, widths=widths), fall(before, state.objective)

    def candidate_steps(
        self, state: Starts, jacobian: np.ndarray, held: np.ndarray | None = None
    ) -> tuple[Starts, np.ndarray]:
        """Batches of trials from a Jacobian [S, M, D], for as long as they pay; and the slopes where they end.

        Of each start another batch pays while the last one lowered its objective by as much, for its replays, as the
        first one did for its own and those of the differences.
        """
        replays = self._config.trials, self._config.trials + 2 * len(self.space)
        going, first, jacobian = np.arange(len(state.x)), np.zeros(len(state.x)), jacobian.copy()
        for batch in range(self._config.chords):
            last = state.rows(going)
            trials = self.trials(last, jacobian[going], None if held is None else held[going])
            residual = self.replay(trials.reshape(-1, trials.shape[-1])).reshape(*trials.shape[:2], -1)
            now = self.taken(last, trials, residual)
            state, fell = state.with_rows(going, now), fall(last.objective, now.objective)
            first = first if batch else fell
            for k in np.flatnonzero(fell > 0):  # where a start stands still, differences are better than any trial
                points, seen = np.vstack([last.x[k], trials[k]]), np.vstack([last.residual[k], residual[k]])
                steps, changes = points - now.x[k], seen - now.residual[k]
                wide = np.max(np.abs(steps), axis=1) >= self._config.smallest_step  # solver noise hides in shorter ones
                jacobian[going[k]] = secant_slopes(
                    jacobian[going[k]], self.prior, steps[wide], changes[wide], self._config.secant_ridge
                )
            going = going[(fell > 0) & (fell * replays[1] >= first[going] * replays[0])]
            if not len(going):
                break
        return state, jacobian

    def jacobian(self, state: Starts) -> np.ndarray:
        """[S, M, D] differences of every start in one batch; one-sided where a bound is in the way."""
        return self._slopes(*self.differences(*self._around(state.x, state.widths), state))

    def slopes(self, state: Starts) -> np.ndarray:
        """[M, D] slopes of one start: those of the last iteration where it ended there, else differences."""
        starts, jacobians = self._known
        at = np.flatnonzero(np.all(starts == state.x, axis=1))
        return jacobians[at[0]] if len(at) else self.jacobian(state)[0]

    def _around(self, x: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[S, D, D] a width up and down of starts [S, D] along each axis, within bounds."""
        steps = np.eye(x.shape[1]) * widths[:, None, :]
        return self.inside(x[:, None] + steps), self.inside(x[:, None] - steps)

    @staticmethod
    def _slopes(spans: np.ndarray, apart: np.ndarray) -> np.ndarray:
        """[S, M, D] slopes of differences along each axis."""
        span = np.einsum("sii->si", spans)[..., None]
        return np.swapaxes(np.where(span > 0, apart / np.where(span > 0, span, 1.0), 0.0), 1, 2)

    def axes(self, jacobian: np.ndarray, longest: float) -> np.ndarray:
        """[D, D] columns: the posterior's principal axes, one deviation long, no entry beyond `longest`."""
        return principal_axes(np.linalg.inv(curvature(jacobian, self.prior)), longest)

    def wide_jacobian(self, state: Starts, jacobian: np.ndarray) -> np.ndarray:
        """[M, D] slopes of one start over the width of its posterior, from narrow ones, along the posterior's own axes.

        Differences of one parameter at a time carry the solver's rounding, which looks like
        information where two parameters trade with each other: their slopes cancel, its does not.
        Along the axes each difference is `spread_width` deviations of the result; as the first axes suffer from
        that rounding themselves, they are improved `spreads` times.
        """
        for _ in range(self._config.spreads):
            steps = self._config.spread_width * self.axes(jacobian, self._config.spread_longest).T
            spans, apart = self.differences(
                self.inside(state.x[:, None] + steps), self.inside(state.x[:, None] - steps), state
            )
            if np.any(np.all(spans[0] == 0, axis=1)):  # failed on both sides: the narrow differences are all there is
                return jacobian
            jacobian = np.linalg.lstsq(spans[0], apart[0])[0].T
        return jacobian

    def trials(self, state: Starts, jacobian: np.ndarray, held: np.ndarray | None = None) -> np.ndarray:
        """[S, N, D] the trials of all starts: every damping and length, on both paths."""
        steps = np.stack([self._steps(state.rows([s]), jacobian[s], held, s) for s in range(len(state.x))])
        paths = [self.inside(state.x[:, None] + steps), self.inside(self._straight(state.x[:, None], steps))]
        return np.concatenate(paths, axis=1)

    def taken(self, state: Starts, trials: np.ndarray, residual: np.ndarray) -> Starts:
        """Each start at its best trial, or where it was; residual: [S, N, M] of the trials."""
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
        """Whether a batch of trials lowered the objective of some start enough for another one with its Jacobian."""
        return bool(np.any(fall(before.objective, after.objective) > self._config.chord * after.objective))

    def _steps(self, state: Starts, jacobian: np.ndarray, held: np.ndarray | None, row: int) -> np.ndarray:
        """[dampings * lengths, D] Levenberg-Marquardt steps of one start, along the bounds it sits on.

        None from a start that could not be replayed.
        """
        x, dampings, lengths = state.x[0], self._config.dampings, self._config.lengths
        if not np.isfinite(state.objective[0]):
            return np.zeros((len(dampings) * len(lengths), len(x)))
        slope = jacobian.T @ state.residual[0] + x / self.prior**2
        free = off_bounds(x, slope, self.low, self.high)
        free &= True if held is None else ~held[row]
        own = [state.damping[0] * factor for factor in dampings]
        return damped_steps(curvature(jacobian, self.prior), slope, free, own, lengths, self._config.longest_step)

    def _straight(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """x moved by `step` along straight lines in physical units instead of search coordinates."""
        width = np.where(self.log_width > 0, self.log_width, 1.0)
        path = np.log(np.maximum(1.0 + width * step, self._config.least_ratio)) / width
        return x + np.where(self.log_width > 0, path, step)
