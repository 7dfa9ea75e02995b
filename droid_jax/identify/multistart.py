"""Batched Gauss-Newton (Levenberg-Marquardt) on whitened residuals, from several starts at once.

Works in search coordinates x. The objective is |r(x)|^2 / 2 + |(x - x0) / w|^2 / 2, a negative log
posterior, with a prior of deviation w: one unit for nuisances (their own prior), `main_prior` units
for the parameters of interest, so that what the data do not tell stays put instead of drifting.

An iteration is `levenberg_marquardt`'s.  What is here decides which starts go on, when to stop, and how to leave a
basin that is none of the best: hypotheses, initial means, and CMA-ES around where the iterations stood still.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from droid_jax import arguments
from droid_jax.arguments import check_fields, several, whole
from droid_jax.identify.levenberg_marquardt import (
    DampedProblem,
    LevenbergMarquardtConfig,
    Residuals,
    Starts,
    curvature,
    fall,
    whole_rows,
)
from droid_jax.identify.search import CmaConfig, NotReplayed, cma_search
from droid_jax.model.parameters import Parameter, Space

Hypotheses = Sequence[Mapping[str, float]]

AT_BOUND = 1e-4  # search units: no further from it a parameter counts as stuck there


@dataclass(frozen=True)
class RefineConfig(LevenbergMarquardtConfig):
    """Settings of the refinement, beside those of an iteration.

    iterations: Jacobians at most.
    tolerance: stop when an iteration lowers the objective (a log likelihood) by less than this,
    excess_tolerance: or by less than this share of what it is above that of noise alone: a model that misses something
      may be far from any fit.
    patience: iterations in a row that do not pay before it stops; after one that found nothing slopes are taken over
      another width.
    coarse_tolerance: while starts and hypotheses are sorted out, already when it lowers it by less than this share.
    target_objective: an objective to reach: stop where it is further off than
    give_up: iterations like the last.
    pruning_ratio: after iteration i only starts within pruning_ratio[i] times the best objective go on (the last
      number holds from there on).
    same_basin: of two starts whose replays differ by less than this share of what the better one leaves beyond noise,
      only that one goes on: they would end at the same values.
    misfit_threshold: hypotheses are tried where the residuals' mean square stays above this.
    hold_iterations: iterations for which the values of a hypothesis are held while all else settles.
    followed: hypotheses that go on once all else has settled a little, the best ones.
    basin_hops: searches at most for a better basin around where the iterations stood still; with none of them nothing
      is put back to its initial mean either.
    basin_hop_generations, basin_hop_population: of each.
    basin_hop_sigma: initial step of each, posterior deviations.
    basin_hop_longest: largest component of that step, search units: what the data do not tell is not searched far.
    basin_hop_tolerance: a hop that lowers the objective by less than this ends the refinement,
    basin_hop_excess_tolerance: or by less than this share of what it is above that of noise alone.
    basin_hop_misfit: residuals' mean square above which there is neither a hop nor anything put back: a model that
      misses something is no small step away from a fit.
    reset_distance: search units; a parameter of interest that strayed further from its initial mean is put back once,
    reset_deviation: where its posterior deviation is above this, search units.
    """

    iterations: int = 30
    tolerance: float = 0.5
    excess_tolerance: float = 5e-3
    patience: int = 1
    coarse_tolerance: float = 5e-3
    target_objective: float = np.inf
    give_up: float = 5.0
    pruning_ratio: tuple[float, ...] = (100.0, 20.0, 3.0, 1.3, 1.0)
    same_basin: float = 0.1
    misfit_threshold: float = 1.1
    hold_iterations: int = 2
    followed: int = 2
    basin_hops: int = 4
    basin_hop_generations: int = 20
    basin_hop_population: int = 32
    basin_hop_sigma: float = 1.5
    basin_hop_longest: float = 1.0
    basin_hop_tolerance: float = 2.0
    basin_hop_excess_tolerance: float = 4e-3
    basin_hop_misfit: float = 1.5
    reset_distance: float = 1.0
    reset_deviation: float = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(
            self,
            iterations=partial(whole, least=0),
            **dict.fromkeys(
                (
                    *("tolerance", "excess_tolerance", "coarse_tolerance", "basin_hop_tolerance"),
                    *("basin_hop_excess_tolerance", "reset_distance", "reset_deviation"),
                ),
                partial(arguments.number, least=0),
            ),
            **dict.fromkeys(("give_up", "basin_hop_sigma", "basin_hop_longest"), partial(arguments.number, above=0)),
            target_objective=partial(arguments.number, infinite=True),
            pruning_ratio=several(partial(arguments.number, least=1)),
            same_basin=partial(arguments.number, least=0),
            misfit_threshold=partial(arguments.number, least=0),
            basin_hop_misfit=partial(arguments.number, above=0, infinite=True),
            hold_iterations=partial(whole, least=0),
            patience=partial(whole, least=1),
            basin_hops=partial(whole, least=0),
            followed=partial(whole, least=1),
            basin_hop_generations=partial(whole, least=1),
            basin_hop_population=partial(whole, least=2),
        )


@dataclass(frozen=True, eq=False)
class Refined:
    """Where the refinement ended.

    space; x [D] search coordinates and best [D] physical values of the best start;
    objective: |r|^2 / 2 plus the prior's part; residual [M] and jacobian [M, D] there;
    prior [D] deviations, search units; starts: objective each start ended at; evaluations: replays;
    iterations; converged: it ended before its iterations ran out, since they no longer paid; not where it was given
    up because `target_objective` was out of reach.
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
        return curvature(self.jacobian, self.prior)


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
    rough = _Descent(residuals if first is None else first, space, config, progress)
    begun, slopes = rough.start_with_slopes(rough.inside(space.to_search(space.check(np.atleast_2d(starts)))))
    ended, alive = begun.objective, np.isfinite(begun.objective)
    if not alive.any():
        raise NotReplayed("none of the starts could be replayed; widen the bounds or start nearer to the truth")
    state, ended[alive] = rough.descend(begun.rows(alive), config.coarse_tolerance, slopes[alive])
    if hypotheses and np.mean(state.residual**2) > config.misfit_threshold:
        found = rough.explore(state, hypotheses)
        if found is not state:
            state, _ = rough.descend(found, config.coarse_tolerance)
    problem, slopes = rough, None
    if first is not None:
        problem = _Descent(residuals, space, config, progress, rough)
        state, slopes = problem.start_with_slopes(state.x)
        if not np.isfinite(state.objective[0]):
            raise NotReplayed(
                "the best start on the first recording could not be replayed on all; start nearer to the truth"
            )
    if problem is not rough or not rough.stands_still:
        state, _ = problem.descend(state, jacobian=slopes)
    hops = 0 if problem.misses(state) else config.basin_hops
    if hops:
        state = problem.back(state)
    state, slopes, settled = problem.hopped(state, hops)
    return Refined(
        space=space,
        x=state.x[0],
        best=space.from_search(state.x[0]),
        objective=float(state.objective[0]),
        residual=state.residual[0],
        jacobian=problem.wide_jacobian(state, problem.slopes(state) if slopes is None else slopes),
        prior=problem.prior,
        starts=ended,
        evaluations=problem.evaluations,
        iterations=problem.iterations,
        converged=settled and problem.iterations < config.iterations and not problem.given_up,
    )


@dataclass(frozen=True, eq=False)
class Look:
    """A first look at what a refinement would find.

    space: of what is free; starts: [S, D] in it; jacobian: [M, D] known from elsewhere; rows: values [P, D] -> what the
    batch of replays takes, [P, W].
    """

    space: Space
    starts: np.ndarray
    jacobian: np.ndarray
    rows: Callable[[np.ndarray], np.ndarray]


def chords(
    residuals: Residuals, looks: Sequence[Look], config: LevenbergMarquardtConfig | None = None
) -> list[tuple[np.ndarray, float]]:
    """What steps with known Jacobians reach: of each look values [D] and objective of its best start.

    A few batches of trials, of all looks at once, and no differences.
    """
    config = config or LevenbergMarquardtConfig()
    problems = [DampedProblem(residuals, look.space, config) for look in looks]

    def replayed(points: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
        """Search coordinates [..., D] of some looks -> residuals [..., M], of one batch."""
        rows = [looks[k].rows(looks[k].space.from_search(x.reshape(-1, x.shape[-1]))) for k, x in points.items()]
        parts = np.split(whole_rows(residuals(np.concatenate(rows))), np.cumsum([len(r) for r in rows])[:-1])
        return {k: part.reshape(*x.shape[:-1], -1) for (k, x), part in zip(points.items(), parts, strict=True)}

    begin = {
        k: problem.inside(look.space.to_search(look.space.check(look.starts)))
        for k, (problem, look) in enumerate(zip(problems, looks, strict=True))
    }
    states = {k: problems[k].begun(begin[k], residual) for k, residual in replayed(begin).items()}
    slopes = {k: np.repeat(look.jacobian[None], len(begin[k]), axis=0) for k, look in enumerate(looks)}
    going = list(states)
    for _ in range(config.chords):
        trials = {k: problems[k].trials(states[k], slopes[k]) for k in going}
        after = {k: problems[k].taken(states[k], trials[k], residual) for k, residual in replayed(trials).items()}
        going = [k for k in going if problems[k].paid(states[k], after[k])]
        states |= after
        if not going:
            break
    best = [states[k].rows(int(np.argmin(states[k].objective))) for k in range(len(looks))]
    return [(look.space.from_search(end.x), float(end.objective)) for look, end in zip(looks, best, strict=True)]


class _Descent(DampedProblem):
    """Iterations until they no longer pay, and the ways out of a basin."""

    def __init__(
        self,
        residuals: Residuals,
        space: Space,
        config: RefineConfig,
        progress: Callable[[RefineProgress], None] | None = None,
        before: DampedProblem | None = None,
    ) -> None:
        super().__init__(residuals, space, config, before)
        self.config, self.progress = config, progress
        self.given_up, self.stands_still = False, False

    def excess(self, state: Starts) -> np.ndarray:
        """[S] by how much the objectives are above half a unit for each residual, which noise alone leaves."""
        return np.maximum(state.objective - 0.5 * state.residual.shape[1], 0.0)

    def descend(
        self, state: Starts, rough: float = 0.0, jacobian: np.ndarray | None = None
    ) -> tuple[Starts, np.ndarray]:
        """Iterate until the best start stands still; that start, and the objective [S] each one ended at.

        rough: a share of the objective that is not worth an iteration either.  jacobian: [S, M, D] at `state`, where it
        is known.  `stands_still` then says whether an iteration without `rough` would pay either.
        """
        ended, alive, self.given_up = state.objective.copy(), np.arange(len(state.x)), False
        keep, idle, still = self.config.pruning_ratio, 0, 0
        for number in range(self.config.iterations - self.iterations):
            state, gain = self.step(state, jacobian=None if number else jacobian)
            ended[alive] = state.objective
            leader = int(np.argmin(state.objective))
            self._report(state.objective[leader], state.residual.shape[1])
            least = self.least(state)
            idle = 0 if gain[leader] > max(least, rough * state.objective[leader]) else idle + 1
            still = 0 if gain[leader] > least else still + 1
            # One that found nothing at all may yet with slopes over another width.
            self.stands_still = still >= self.config.patience and bool(gain[leader] > 0)
            if idle == (1 if rough else self.config.patience):
                break
            self.given_up = bool(
                self.config.give_up * gain[leader] < state.objective[leader] - self.config.target_objective
            )
            if self.given_up:
                self.stands_still = bool(gain[leader] > 0)
                break
            good = state.objective <= keep[min(number, len(keep) - 1)] * state.objective[leader]
            good &= self.apart(state, state.rows([leader])) | (np.arange(len(state.x)) == leader)
            state, alive = state.rows(good), alive[good]
        return state.rows([int(np.argmin(state.objective))]), ended

    def apart(self, state: Starts, other: Starts) -> np.ndarray:
        """[S] bool, whether starts replay otherwise than another one [1], which is no worse than they are."""
        between = 0.5 * np.sum((state.residual - other.residual) ** 2, axis=1)
        return between > max(self.config.tolerance, self.config.same_basin * float(self.excess(other)[0]))

    def back(self, state: Starts) -> Starts:
        """Leave a basin that the data hardly chose: put back to its initial mean what strayed, and follow that.

        In logarithms a small mass is a plateau, and a finger that sticks is one in its friction: where another
        parameter pushed them there, no slope leads back.  Not with the last iterations: they are for what is there.
        """
        tried, last = set[str](), self.config.iterations - 2 * (self.config.hold_iterations + 1)
        while self.iterations <= last and (strayed := [n for n in self.strayed(state) if n not in tried]):
            tried.update(strayed)
            means = {name: self.space[name].mean for name in strayed}
            alone = [{name: mean} for name, mean in means.items()]
            found = self.explore(state, [*alone, means] if len(alone) > 1 else alone)
            if fall(state.objective, found.objective)[0] <= self.least(state):
                break
            state, _ = self.descend(found)
        return state

    def misses(self, state: Starts) -> bool:
        """Whether the leader is so far from the data that the model must lack something."""
        left: np.ndarray = state.residual[0]
        return float(left @ left) > self.config.basin_hop_misfit * len(left)

    def least(self, state: Starts) -> float:
        """By how much the best objective must fall for it to be worth an iteration."""
        leader = int(np.argmin(state.objective))
        return max(self.config.tolerance, self.config.excess_tolerance * float(self.excess(state)[leader]))

    def strayed(self, state: Starts) -> list[str]:
        """Parameters of interest far from their initial means that the data do not tell sharply."""
        slopes = self.slopes(state)
        deviation = np.sqrt(np.diag(np.linalg.inv(curvature(slopes, self.prior))))
        far, open_ = np.abs(state.x[0]) > self.config.reset_distance, deviation > self.config.reset_deviation
        which = ~self.space.nuisance & far & open_
        return [self.space.names[k] for k in np.flatnonzero(which)]

    def hopped(self, state: Starts, hops: int) -> tuple[Starts, np.ndarray | None, bool]:
        """Leave small basins, as often as that pays and no more than `hops` times; one start.

        Returns where that ended, its slopes [M, D] where they are known, and whether a hop found nothing more, or none
        was to be made.
        """
        settled, slopes = hops == 0, None
        for number in range(hops):
            slopes = self.slopes(state)
            hopped = self.hop(state, slopes, number)
            excess = self.config.basin_hop_excess_tolerance * self.excess(state)[0]
            least = max(self.config.basin_hop_tolerance, excess)
            settled = bool(state.objective[0] - hopped.objective[0] <= least)
            if hopped.objective[0] < state.objective[0]:
                state, slopes = hopped, None
            if settled:
                break
            state, _ = self.descend(state)
            slopes = None
        return state, slopes, settled

    def hop(self, state: Starts, jacobian: np.ndarray, seed: int) -> Starts:
        """Leave a small basin: CMA-ES in the metric of the posterior, from a start that stands still.

        In x = x0 + L u, L L^T the posterior's covariance, the objective is about |u|^2 / 2 and what
        remains are the steps where a finger begins to stick or to slip, which no derivative sees.
        """
        factor = self.axes(jacobian, self.config.basin_hop_longest)

        def around(u: np.ndarray) -> np.ndarray:
            return self.inside(state.x + u @ factor.T)

        def cost(u: np.ndarray) -> np.ndarray:
            x = around(u)
            return self.objective(x, self.replay(x))

        unit = Space(tuple(Parameter(f"u{i}", "-", 0.0, 1.0, -50.0, 50.0) for i in range(len(self.space))))
        settings = CmaConfig(
            population=self.config.basin_hop_population,
            parents=None,
            generations=self.config.basin_hop_generations,
            sigma=self.config.basin_hop_sigma,
            seed=seed,
        )
        try:
            return self.start(around(cma_search(cost, unit, settings).best[None]))
        except NotReplayed:  # nothing around here can be
            return state

    def explore(self, state: Starts, hypotheses: Hypotheses) -> Starts:
        """Follow each hypothesis from a converged start: hold its values while all else settles, then free them.

        After each iteration only the best of them go on, and of these only those in another basin than `state`, one
        start.  Returns the better of what they found and `state`.
        """
        x = np.repeat(state.x, len(hypotheses), axis=0)
        held = np.zeros(x.shape, bool)
        for row, hypothesis in enumerate(hypotheses):
            for name, value in hypothesis.items():
                column = self.space.index(name)
                x[row, column] = self.space[name].to_search(value)
                held[row, column] = True
        branches, slopes = self.start_with_slopes(self.inside(x))
        alive = np.isfinite(branches.objective)
        if not alive.any():
            return state
        branches, held, slopes = branches.rows(alive), held[alive], slopes[alive]
        for iteration in range(self.config.hold_iterations + 1):
            still = held if iteration < self.config.hold_iterations else None
            branches, _ = self.step(branches, still, None if iteration else slopes)
            ahead = np.argsort(branches.objective)[: self.config.followed]
            if iteration < self.config.hold_iterations:  # what is back in the basin that it left has nothing to find
                other = (branches.objective < state.objective[0]) | self.apart(branches, state)
                ahead = ahead[other[ahead]]
            if not len(ahead):
                return state
            branches, held = branches.rows(ahead), held[ahead]
        found = branches.rows([int(np.argmin(branches.objective))])
        best = found if found.objective[0] < state.objective[0] else state
        self._report(best.objective[0], best.residual.shape[1])
        return best

    def _report(self, objective: float, residuals: int) -> None:
        if self.progress is not None:
            self.progress(RefineProgress(self.iterations, self.config.iterations, 2 * objective / residuals))
