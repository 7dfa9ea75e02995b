"""Batched Gauss-Newton (Levenberg-Marquardt) on whitened residuals, from several starts at once.

Works in search coordinates x. The objective is |r(x)|^2 / 2 + |(x - x0) / w|^2 / 2, a negative log
posterior, with a prior of deviation w: one unit for nuisances (their own prior), `main_prior` units
for the parameters of interest, so that what the data do not tell stays put instead of drifting.

Replays come in batches, so an iteration is: one batch of central differences, then batches of
trial steps with that Jacobian for as long as they pay.  A trial differs from the next in its
damping, its length and its path: straight in search coordinates, or straight in physical units.
Residuals are close to linear in masses, springs and damping, whose search coordinate is their
logarithm; where two of them trade with each other (door and knob turn about the same hinge), the
valley between them is straight in physical units alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from droid_jax.compare.residuals import BLOWN_UP
from droid_jax.identify.search import SearchConfig, search
from droid_jax.model.parameters import Parameter, Scaling, Space

Residuals = Callable[[np.ndarray], np.ndarray]
Hypotheses = Sequence[Mapping[str, float]]


@dataclass(frozen=True)
class RefineConfig:
    """Settings of the refinement.

    iterations: Jacobians at most.
    step: half-width of the first central differences, search units.
    smallest_step: and of later ones at least, search units (below it solver noise would show).
    main_prior: prior deviation of parameters of interest, search units.
    tolerance: stop when an iteration lowers the objective (a log likelihood) by less than this, or by less than a
      share FAR of what it is above that of noise alone: a model that misses something may be far from any fit.
    rough: while starts and hypotheses are sorted out, already when it lowers it by less than this share.
    aim: an objective to reach: stop where the last iteration's gain, HOPELESS times over, would not do.
    chord: a Jacobian serves another batch of trials while the last lowered the objective by this share.
    keep: after iteration i only starts within keep[i] times the best objective go on (the last
      number holds from there on).
    doubt: hypotheses are tried where the residuals' mean square stays above this.
    hold: iterations for which the values of a hypothesis are held while all else settles.
    hops: searches at most for a better basin around where the iterations stood still; with none of them nothing is
      put back to its initial mean either (see `STRAYED`).
    hop_generations: generations of each.
    spreads: times that the slopes are taken over the width of the posterior at the end; 0 leaves the narrow ones.
    """

    iterations: int = 30
    step: float = 0.3
    smallest_step: float = 0.03
    main_prior: float = 4.0
    tolerance: float = 0.5
    rough: float = 5e-3
    aim: float = np.inf
    chord: float = 0.03
    keep: tuple[float, ...] = (100.0, 20.0, 3.0, 1.3, 1.0)
    doubt: float = 1.1
    hold: int = 2
    hops: int = 4
    hop_generations: int = 20
    spreads: int = 2


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
    def free(self) -> np.ndarray:
        """[D] bool, parameters that are not at a bound."""
        space = self.space
        return (self.x > space.to_search(space.low) + AT_BOUND) & (self.x < space.to_search(space.high) - AT_BOUND)

    @property
    def hessian(self) -> np.ndarray:
        """[D, D] Gauss-Newton curvature, prior included."""
        return _curvature(self.jacobian, self.prior)


class NotReplayed(ValueError):
    """Where a refinement was to begin the replay gave no numbers."""


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
    first: Residuals | None = None,
    hypotheses: Hypotheses = (),
    progress: Callable[[RefineProgress], None] | None = None,
) -> Refined:
    """Refine one or several starts [D] or [S, D] (physical values).

    residuals: [P, D] physical values -> [P, M] whitened residuals (rows are independent).
    first: the same for a part of the data that is cheaper to replay; starts and hypotheses are sorted
      out there, and only the best goes on to all of it.
    hypotheses: assignments {name: value} that may lie in another basin (a finger that slips, say),
      each tried once from where the starts converged, if that leaves doubt.
    Raises NotReplayed where no start gives finite residuals; others that do not are left out.
    """
    config = config or RefineConfig()
    rough = _Problem(residuals if first is None else first, space, config, progress)
    begun = rough.start(rough.inside(space.to_search(space.check(np.atleast_2d(starts)))))
    ended, alive = begun.objective, np.isfinite(begun.objective)
    if not alive.any():
        raise NotReplayed("none of the starts could be replayed; widen the bounds or start nearer to the truth")
    state, ended[alive] = rough.descend(begun.rows(alive), config.rough)
    if hypotheses and np.mean(state.residual**2) > config.doubt:
        state, _ = rough.descend(rough.explore(state, hypotheses), config.rough)
    problem = _Problem(residuals, space, config, progress, rough)
    state = problem.start(state.x)
    if not np.isfinite(state.objective[0]):
        raise NotReplayed(
            "the best start on the first recording could not be replayed on all; start nearer to the truth"
        )
    state, _ = problem.descend(state)
    if config.hops:
        state = problem.back(state)
    settled, slopes = config.hops == 0, None
    for number in range(config.hops):
        slopes = problem.jacobian(state)[0]
        hopped = problem.hop(state, slopes, number)
        least = max(HOP_TOLERANCE, HOP_FAR * problem.excess(state)[0])
        settled = bool(state.objective[0] - hopped.objective[0] <= least)
        if hopped.objective[0] < state.objective[0]:
            state, slopes = hopped, None
        if settled:
            break
        state, _ = problem.descend(state)
        slopes = None
    return Refined(
        space=space,
        x=state.x[0],
        best=space.from_search(state.x[0]),
        objective=float(state.objective[0]),
        residual=state.residual[0],
        jacobian=problem.wide_jacobian(state, problem.jacobian(state)[0] if slopes is None else slopes),
        prior=problem.prior,
        starts=ended,
        evaluations=problem.evaluations,
        iterations=problem.iterations,
        converged=settled and problem.iterations < config.iterations,
    )


def chord(residuals: Residuals, space: Space, starts: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, float]:
    """What steps with a Jacobian [M, D] known from elsewhere reach from the best start [S, D]: values [D], objective.

    A few batches of trials and no differences: a first look at what a refinement would find.
    """
    problem = _Problem(residuals, space, RefineConfig())
    state = problem.start(problem.inside(space.to_search(space.check(starts))))
    state = problem.trials(state, np.repeat(jacobian[None], len(state.x), axis=0))
    best = int(np.argmin(state.objective))
    return space.from_search(state.x[best]), float(state.objective[best])


@dataclass(frozen=True, eq=False)
class _State:
    """Live starts: x [S, D], residual [S, M], objective [S], damping [S], difference widths [S, D]."""

    x: np.ndarray
    residual: np.ndarray
    objective: np.ndarray
    damping: np.ndarray
    widths: np.ndarray

    def rows(self, keep: Any) -> _State:
        return _State(*(getattr(self, f)[keep] for f in _State.__dataclass_fields__))


# A batch of trials for each start: damping factors x lengths x paths, 32 in all, the block of a CPU.
_DAMPINGS = 10.0 ** np.arange(-3.0, 5.0)
_LENGTHS = (1.0, 0.5)
TRIALS = 2 * len(_DAMPINGS) * len(_LENGTHS)
_LONGEST = 2.0  # search units: the longest component of a step
HOPELESS = 30.0  # iterations like the last: an aim farther off than that is given up
CHORDS = 3  # batches of trials at most with one Jacobian
WIDE = 1.5  # posterior deviations: half-width of those differences
SPREAD_LONGEST = 1.0  # search units
HOP_POPULATION = 32
HOP_SIGMA = 1.5  # posterior deviations
HOP_TOLERANCE = 2.0  # of the objective: a hop that finds less ends the refinement
FAR, HOP_FAR = 5e-4, 4e-3  # the same as shares of what the objective is above noise alone
# Search units: what strayed further from its initial mean, and is not told to much less than that, is put back once.
STRAYED, UNTOLD = 1.0, 0.05
FOLLOWED = 2  # hypotheses: once all else has settled a little, the best go on
AT_BOUND = 1e-4  # search units: no further from it a parameter counts as stuck there
HOP_LONGEST = 1.0  # search units: what the data do not tell is not searched far
_SHORTEST = 0.05  # a straight path in physical units never takes a parameter below this share of itself


def _curvature(jacobian: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """[D, D] Gauss-Newton curvature of the objective from slopes [M, D] and prior deviations [D]."""
    return jacobian.T @ jacobian + np.diag(prior**-2)


def _fall(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[S] by how much the objectives fell; 0 for a start that could not be replayed and still cannot."""
    return np.where(np.isinf(after), 0.0, before - np.where(np.isinf(after), 0.0, after))


class _Problem:
    """Residuals and prior in search coordinates, with what an iteration does; counts replays."""

    def __init__(
        self,
        residuals: Residuals,
        space: Space,
        config: RefineConfig,
        progress: Callable[[RefineProgress], None] | None = None,
        before: _Problem | None = None,
    ) -> None:
        self.residuals, self.space, self.config, self.progress = residuals, space, config, progress
        self.prior = np.where(space.nuisance, 1.0, config.main_prior)
        self.low, self.high = space.to_search(space.low), space.to_search(space.high)
        self.log_width = np.array([p.log_width if p.scaling is Scaling.LOG else 0.0 for p in space.parameters])
        self.evaluations = before.evaluations if before else 0
        self.iterations = before.iterations if before else 0

    def inside(self, x: np.ndarray) -> np.ndarray:
        """x clipped to the bounds."""
        return np.clip(x, self.low, self.high)

    def replay(self, x: np.ndarray) -> np.ndarray:
        """[P, D] -> residuals [P, M]; NaN throughout where a replay failed."""
        self.evaluations += len(x)
        residual = np.asarray(self.residuals(self.space.from_search(x)), dtype=np.float64)
        failed = ~np.isfinite(residual).all(axis=1) | (residual == BLOWN_UP).any(axis=1)  # of one recording of several
        return np.where(failed[:, None], np.nan, residual)

    def differences(self, up: np.ndarray, down: np.ndarray, state: _State) -> tuple[np.ndarray, np.ndarray]:
        """Spans [S, N, D] and residual differences [S, N, M] between up and down, both [S, N, D].

        The start itself takes the place of a replay that failed.
        """
        points = np.stack([up, down])
        residual = self.replay(points.reshape(-1, points.shape[-1])).reshape(*points.shape[:3], -1)
        failed = np.isnan(residual[..., :1])
        points = np.where(failed, state.x[:, None], points)
        residual = np.where(failed, state.residual[:, None], residual)
        return points[0] - points[1], residual[0] - residual[1]

    def objective(self, x: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """[P]; infinite where a replay gave no numbers."""
        value = 0.5 * np.sum(residual**2, axis=-1) + 0.5 * np.sum((x / self.prior) ** 2, axis=-1)
        return np.where(np.isfinite(value), value, np.inf)

    def excess(self, state: _State) -> np.ndarray:
        """[S] by how much the objectives are above half a unit for each residual, which noise alone leaves."""
        return np.maximum(state.objective - 0.5 * state.residual.shape[1], 0.0)

    def start(self, x: np.ndarray) -> _State:
        """The state of fresh starts [S, D]."""
        residual = self.replay(x)
        widths = np.full(x.shape, self.config.step)
        return _State(x, residual, self.objective(x, residual), np.full(len(x), 1e-3), widths)

    def descend(self, state: _State, rough: float = 0.0) -> tuple[_State, np.ndarray]:
        """Iterate until the best start stands still; that start, and the objective [S] each one ended at.

        rough: a share of the objective that is not worth an iteration either.
        """
        ended, alive = state.objective.copy(), np.arange(len(state.x))
        keep = self.config.keep
        for number in range(self.config.iterations - self.iterations):
            state, gain = self.step(state)
            ended[alive] = state.objective
            leader = int(np.argmin(state.objective))
            self._report(state.objective[leader], state.residual.shape[1])
            if gain[leader] <= max(self.least(state), rough * state.objective[leader]):
                break
            if HOPELESS * gain[leader] < state.objective[leader] - self.config.aim:
                break
            good = state.objective <= keep[min(number, len(keep) - 1)] * state.objective[leader]
            state, alive = state.rows(good), alive[good]
        return state.rows([int(np.argmin(state.objective))]), ended

    def back(self, state: _State) -> _State:
        """Leave a basin that the data hardly chose: put back to its initial mean what strayed, and follow that.

        In logarithms a small mass is a plateau, and a finger that sticks is one in its friction: where another
        parameter pushed them there, no slope leads back.  Not with the last iterations: they are for what is there.
        """
        tried, last = set[str](), self.config.iterations - 2 * (self.config.hold + 1)
        while self.iterations <= last and (strayed := [n for n in self.strayed(state) if n not in tried]):
            tried.update(strayed)
            means = {name: self.space[name].mean for name in strayed}
            alone = [{name: mean} for name, mean in means.items()]
            found = self.explore(state, [*alone, means] if len(alone) > 1 else alone)
            if _fall(state.objective, found.objective)[0] <= self.least(state):
                break
            state, _ = self.descend(found)
        return state

    def least(self, state: _State) -> float:
        """By how much the best objective must fall for it to be worth an iteration."""
        leader = int(np.argmin(state.objective))
        return max(self.config.tolerance, FAR * float(self.excess(state)[leader]))

    def strayed(self, state: _State) -> list[str]:
        """Parameters of interest far from their initial means that the data do not tell sharply."""
        slopes = self.jacobian(state)[0]
        deviation = np.sqrt(np.diag(np.linalg.inv(_curvature(slopes, self.prior))))
        which = ~self.space.nuisance & (np.abs(state.x[0]) > STRAYED) & (deviation > UNTOLD)
        return [self.space.names[k] for k in np.flatnonzero(which)]

    def hop(self, state: _State, jacobian: np.ndarray, seed: int) -> _State:
        """Leave a small basin: CMA-ES in the metric of the posterior, from a start that stands still.

        In x = x0 + L u, L L^T the posterior's covariance, the objective is about |u|^2 / 2 and what
        remains are the steps where a finger begins to stick or to slip, which no derivative sees.
        """
        factor = self.axes(jacobian, HOP_LONGEST)

        def around(u: np.ndarray) -> np.ndarray:
            return self.inside(state.x + u @ factor.T)

        def cost(u: np.ndarray) -> np.ndarray:
            x = around(u)
            return self.objective(x, self.replay(x))

        unit = Space(tuple(Parameter(f"u{i}", "-", 0.0, 1.0, -50.0, 50.0) for i in range(len(self.space))))
        settings = SearchConfig(
            population=HOP_POPULATION, parents=None, generations=self.config.hop_generations, sigma=HOP_SIGMA, seed=seed
        )
        return self.start(around(search(cost, unit, settings).best[None]))

    def _report(self, objective: float, residuals: int) -> None:
        if self.progress is not None:
            self.progress(RefineProgress(self.iterations, self.config.iterations, 2 * objective / residuals))

    def step(self, state: _State, held: np.ndarray | None = None) -> tuple[_State, np.ndarray]:
        """One iteration of all starts, and by how much each objective fell. held: [S, D] bool, stay put."""
        jacobian = self.jacobian(state)
        before = state.objective
        self.iterations += 1
        state = self.trials(state, jacobian, held)
        curvature = np.einsum("smd,smd->sd", jacobian, jacobian) + self.prior**-2
        # About one deviation wide, the others given; a start that stood still looks from elsewhere.
        widths = np.where((state.objective < before)[:, None], 1.0, 3.0) / np.sqrt(curvature)
        widths = np.clip(widths, self.config.smallest_step, self.config.step)
        return replace(state, widths=widths), _fall(before, state.objective)

    def trials(self, state: _State, jacobian: np.ndarray, held: np.ndarray | None = None) -> _State:
        """Batches of trials with one Jacobian [S, M, D] for as long as they pay."""
        for _ in range(CHORDS):
            last = state.objective
            state = self._try(state, jacobian, held)
            if np.all(_fall(last, state.objective) <= self.config.chord * state.objective):
                break
        return state

    def jacobian(self, state: _State) -> np.ndarray:
        """[S, M, D] differences of every start in one batch; one-sided where a bound is in the way."""
        steps = np.eye(state.x.shape[1]) * state.widths[:, None, :]
        up, down = self.inside(state.x[:, None] + steps), self.inside(state.x[:, None] - steps)
        spans, apart = self.differences(up, down, state)
        span = np.einsum("sii->si", spans)[..., None]
        return np.swapaxes(np.where(span > 0, apart / np.where(span > 0, span, 1.0), 0.0), 1, 2)

    def axes(self, jacobian: np.ndarray, longest: float) -> np.ndarray:
        """[D, D] columns: the posterior's principal axes, one deviation long, no entry beyond `longest`."""
        variance, axes = np.linalg.eigh(np.linalg.inv(_curvature(jacobian, self.prior)))
        return axes * np.minimum(np.sqrt(np.maximum(variance, 0.0)), longest / np.max(np.abs(axes), axis=0))

    def wide_jacobian(self, state: _State, jacobian: np.ndarray) -> np.ndarray:
        """[M, D] slopes of one start over the width of its posterior, from narrow ones, along the posterior's own axes.

        Differences of one parameter at a time carry the solver's rounding, which looks like
        information where two parameters trade with each other: their slopes cancel, its does not.
        Along the axes each difference is WIDE deviations of the result; as the first axes suffer from
        that rounding themselves, they are improved `spreads` times.
        """
        for _ in range(self.config.spreads):
            steps = WIDE * self.axes(jacobian, SPREAD_LONGEST).T
            spans, apart = self.differences(
                self.inside(state.x[:, None] + steps), self.inside(state.x[:, None] - steps), state
            )
            if np.any(np.all(spans[0] == 0, axis=1)):  # failed on both sides: the narrow differences are all there is
                return jacobian
            jacobian = np.linalg.lstsq(spans[0], apart[0])[0].T
        return jacobian

    def explore(self, state: _State, hypotheses: Hypotheses) -> _State:
        """Follow each hypothesis from a converged start: hold its values while all else settles, then free them.

        After one iteration only the best of them go on.  Returns the better of what they found and `state`, one start.
        """
        x = np.repeat(state.x, len(hypotheses), axis=0)
        held = np.zeros(x.shape, bool)
        for row, hypothesis in enumerate(hypotheses):
            for name, value in hypothesis.items():
                column = self.space.index(name)
                x[row, column] = self.space[name].to_search(value)
                held[row, column] = True
        branches = self.start(self.inside(x))
        alive = np.isfinite(branches.objective)
        if not alive.any():
            return state
        branches, held = branches.rows(alive), held[alive]
        for iteration in range(self.config.hold + 1):
            branches, _ = self.step(branches, held if iteration < self.config.hold else None)
            ahead = np.argsort(branches.objective)[:FOLLOWED]
            branches, held = branches.rows(ahead), held[ahead]
        found = branches.rows([int(np.argmin(branches.objective))])
        best = found if found.objective[0] < state.objective[0] else state
        self._report(best.objective[0], best.residual.shape[1])
        return best

    def _try(self, state: _State, jacobian: np.ndarray, held: np.ndarray | None) -> _State:
        """All trials of all starts in one batch; each start takes its best, or stays."""
        starts, dims = state.x.shape
        steps = np.stack([self._steps(state.rows([s]), jacobian[s], held, s) for s in range(starts)])
        paths = [self.inside(state.x[:, None] + steps), self.inside(self._straight(state.x[:, None], steps))]
        trials = np.concatenate(paths, axis=1)
        residual = self.replay(trials.reshape(-1, dims)).reshape(*trials.shape[:2], -1)
        objective = self.objective(trials, residual)
        rows, pick = np.arange(starts), np.argmin(objective, axis=1)
        better = objective[rows, pick] < state.objective
        factor = np.tile(np.repeat(_DAMPINGS, len(_LENGTHS)), len(paths))[pick]
        return _State(
            x=np.where(better[:, None], trials[rows, pick], state.x),
            residual=np.where(better[:, None], residual[rows, pick], state.residual),
            objective=np.where(better, objective[rows, pick], state.objective),
            damping=np.clip(np.where(better, state.damping * factor, state.damping), 1e-8, 1e4),
            widths=state.widths,
        )

    def _steps(self, state: _State, jacobian: np.ndarray, held: np.ndarray | None, row: int) -> np.ndarray:
        """[dampings * lengths, D] Levenberg-Marquardt steps of one start, along the bounds it sits on.

        None from a start that could not be replayed.
        """
        x = state.x[0]
        if not np.isfinite(state.objective[0]):
            return np.zeros((len(_DAMPINGS) * len(_LENGTHS), len(x)))
        hessian = _curvature(jacobian, self.prior)
        slope = jacobian.T @ state.residual[0] + x / self.prior**2
        free = ~(((x <= self.low) & (slope > 0)) | ((x >= self.high) & (slope < 0)))
        free &= True if held is None else ~held[row]
        out = np.zeros((len(_DAMPINGS), len(_LENGTHS), len(x)))
        for k, factor in enumerate(_DAMPINGS):
            damped = hessian + state.damping[0] * factor * np.diag(np.diag(hessian))
            step = -np.linalg.solve(damped[np.ix_(free, free)], slope[free])
            step *= min(1.0, _LONGEST / max(np.max(np.abs(step), initial=0.0), 1e-12))
            out[k][:, free] = np.outer(_LENGTHS, step)
        return out.reshape(-1, len(x))

    def _straight(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """x moved by `step` along straight lines in physical units instead of search coordinates."""
        width = np.where(self.log_width > 0, self.log_width, 1.0)
        path = np.log(np.maximum(1.0 + width * step, _SHORTEST)) / width
        return x + np.where(self.log_width > 0, path, step)
