"""Batched Gauss-Newton (Levenberg-Marquardt) on whitened residuals, from several starts at once.

The coordinates are search coordinates x.  The objective is |r(x)|^2 / 2 + |(x - x0) / w|^2 / 2, a negative log
posterior with prior deviations w.  They are one unit for nuisances (their stated prior), and `main_prior` units for the
parameters of interest, so that parameters that the data do not constrain do not drift.

`levenberg_marquardt` does an iteration.  This module prunes the starts, stops the iterations, and leaves local minima
in three ways: hypotheses, a reset to initial means, and CMA-ES around the point where the iterations ended.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
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

SORTED = 2  # iterations after which starts near each other are in one basin: the first ones still share their misfit
AT_BOUND = 1e-4  # search units; a parameter that is no further from a bound is not free


@dataclass(frozen=True)
class RefineConfig(LevenbergMarquardtConfig):
    """Settings of the refinement, in addition to those of an iteration.

    The excess of the objective is its part above that of noise alone, half a unit for each residual.

    iterations: largest number of iterations, each with one batch of differences.
    tolerance: an iteration that lowers the objective (a negative log likelihood) by less than this has failed.
    excess_tolerance: the same as a share of the excess; a model that lacks an effect may be far from any fit.
    patience: failed iterations in a row after which the refinement stops; after a failed one the differences are wider.
    coarse_tolerance: share of the objective below which an iteration has failed while starts and hypotheses are
      compared.
    target_objective: objective to reach.  The refinement stops if it is further off than `give_up` times the decrease
      by the last iteration.
    give_up: number of iterations, see `target_objective`.
    pruning_ratio: after iteration i only starts within pruning_ratio[i] times the best objective continue; the last
      entry applies to all later iterations.
    same_basin: share of the excess.  Of two starts whose replays differ by less, only the better one continues.
    misfit_threshold: mean square of the residuals above which hypotheses are tried.
    hold_iterations: iterations in which the values of a hypothesis are fixed while the others are fitted.
    followed: number of hypotheses, the best ones, that continue after the first iteration.
    basin_hops: largest number of searches for a better basin around the point where the iterations ended.  With 0, no
      parameter is reset to its initial mean either.
    basin_hop_generations, basin_hop_population: of each search.
    basin_hop_sigma: initial step of each search, posterior deviations.
    basin_hop_longest: largest component of that step, search units, which limits directions that the data do not
      constrain.
    basin_hop_tolerance: a search that lowers the objective by less than this ends the refinement.
    basin_hop_excess_tolerance: the same as a share of the excess.
    basin_hop_misfit: mean square of the residuals above which there is neither a search nor a reset: a model that lacks
      an effect has no fit nearby.
    reset_distance: search units.  A parameter of interest that is further from its initial mean is reset to it once, if
      its posterior deviation is above `reset_deviation`.
    reset_deviation: search units, see `reset_distance`.
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


@dataclass(frozen=True)
class RefineInCConfig:
    """Settings that replace those of `RefineConfig` if plain C MuJoCo does the replays.

    In C there are no blocks of rows to fill, so fewer candidate steps are cheaper.  There are no contact pairs, whose
    sticking and slipping makes small basins, so no searches for better basins are needed.  In double precision one pass
    over the posterior's axes gives the final Jacobian.  Corrected Jacobians save hardly any replays beside so few
    candidate steps.

    dampings, lengths, secant_ridge, patience, basin_hops, spreads: see `RefineConfig`.
    """

    dampings: tuple[float, ...] = (0.1, 1.0, 10.0, 1e3)
    lengths: tuple[float, ...] = (1.0,)
    secant_ridge: float | None = None
    patience: int = 2
    basin_hops: int = 0
    spreads: int = 1

    def __post_init__(self) -> None:
        for name, value in asdict(self.applied(RefineConfig())).items():  # the checks are those of RefineConfig
            if hasattr(self, name):
                arguments.set_field(self, name, value)

    def applied(self, config: RefineConfig) -> RefineConfig:
        """Return `config` with these settings."""
        return replace(config, **{f.name: getattr(self, f.name) for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of the refinement, of the best start.

    space: meaning of the D entries.  x: [D] search coordinates.  best: [D] the same as physical values.
    objective: |r|^2 / 2 plus the prior's part.  residual: [M].  jacobian: [M, D], by search coordinates.
    prior: [D] deviations, search units.  starts: [S] final objective of each start.  evaluations: replays.
    iterations: done.  converged: it stopped by its tolerances, neither at the largest number of iterations nor because
      `target_objective` was out of reach.
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
        """[D] bool, parameters that are not on a bound."""
        space = self.space
        return (self.x > space.to_search(space.low) + AT_BOUND) & (self.x < space.to_search(space.high) - AT_BOUND)

    @property
    def hessian(self) -> np.ndarray:
        """[D, D] Gauss-Newton curvature, prior included."""
        return curvature(self.jacobian, self.prior)


@dataclass(frozen=True)
class RefineProgress:
    """State after an iteration: its number, the largest number, and twice the best objective over M residuals."""

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
    """Refine one or several starts to a local minimum of the objective.

    Args:
        residuals: [P, D] physical values -> [P, M] whitened residuals; rows are independent.
        space: meaning of the D entries.
        starts: [D] or [S, D] physical values.
        config: settings; None for the defaults.
        first: the residuals of a part of the data that is cheaper to replay.  Starts and hypotheses are compared on it,
            and only the best one continues on all data.
        hypotheses: assignments {name: value} that may be in another basin, such as a finger that slips.  Each is tried
            once from the best start, if the mean square of its residuals is above `misfit_threshold`.
        progress: called after every iteration.

    Returns:
        The best start's values, with residuals and Jacobian.

    Raises:
        NotReplayed: no start has finite residuals.  Single starts that blow up are dropped.
    """
    config = config or RefineConfig()
    coarse = _Descent(residuals if first is None else first, space, config, progress)
    begun, jacobian = coarse.start_with_slopes(coarse.inside(space.to_search(space.check(np.atleast_2d(starts)))))
    ended, alive = begun.objective, np.isfinite(begun.objective)
    if not alive.any():
        raise NotReplayed("none of the starts could be replayed; widen the bounds or start nearer to the truth")
    state, ended[alive] = coarse.descend(begun.rows(alive), config.coarse_tolerance, jacobian[alive])
    if hypotheses and np.mean(state.residual**2) > config.misfit_threshold:
        explored = coarse.explore(state, hypotheses)
        if explored is not state:
            state, _ = coarse.descend(explored, config.coarse_tolerance)
    problem, jacobian = coarse, None
    if first is not None:
        problem = _Descent(residuals, space, config, progress, coarse)
        state, jacobian = problem.start_with_slopes(state.x)
        if not np.isfinite(state.objective[0]):
            raise NotReplayed(
                "the best start on the first recording could not be replayed on all; start nearer to the truth"
            )
    if problem is not coarse or not coarse.ended:
        state, _ = problem.descend(state, jacobian=jacobian)
    hops = 0 if problem.has_misfit(state) else config.basin_hops
    if hops:
        state = problem.reset(state)
    state, jacobian, settled = problem.hop_basins(state, hops)
    return Refined(
        space=space,
        x=state.x[0],
        best=space.from_search(state.x[0]),
        objective=float(state.objective[0]),
        residual=state.residual[0],
        jacobian=problem.wide_jacobian(state, problem.jacobian(state)[0] if jacobian is None else jacobian),
        prior=problem.prior,
        starts=ended,
        evaluations=problem.evaluations,
        iterations=problem.iterations,
        converged=settled and problem.iterations < config.iterations and not problem.given_up,
    )


@dataclass(frozen=True, eq=False)
class Look:
    """A cheap preview of a refinement, from a known Jacobian.

    space: of the D free parameters.  starts: [S, D] physical values.  jacobian: [M, D], by search coordinates.
    rows: values [P, D] -> rows [P, W] of the batch of replays.
    """

    space: Space
    starts: np.ndarray
    jacobian: np.ndarray
    rows: Callable[[np.ndarray], np.ndarray]


def chords(
    residuals: Residuals, looks: Sequence[Look], config: LevenbergMarquardtConfig | None = None
) -> list[tuple[np.ndarray, float]]:
    """Take Levenberg-Marquardt steps with known Jacobians; return values [D] and objective of each look's best start.

    It takes a few batches of candidate steps, of all looks at once, and no differences.

    Args:
        residuals: rows [P, W] -> [P, M] whitened residuals.
        looks: previews.
        config: settings of the steps; None for the defaults.
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
    jacobians = {k: np.broadcast_to(o.jacobian, (len(begin[k]), *o.jacobian.shape)) for k, o in enumerate(looks)}
    active = list(states)
    for _ in range(config.chords):
        trials = {k: problems[k].trials(states[k], jacobians[k]) for k in active}
        after = {k: problems[k].taken(states[k], trials[k], residual) for k, residual in replayed(trials).items()}
        active = [k for k in active if problems[k].paid(states[k], after[k])]
        states |= after
        if not active:
            break
    best = [states[k].rows(int(np.argmin(states[k].objective))) for k in range(len(looks))]
    return [(look.space.from_search(end.x), float(end.objective)) for look, end in zip(looks, best, strict=True)]


class _Descent(DampedProblem):
    """Iterations until they fail, and the ways out of a local minimum."""

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
        self.given_up, self.ended = False, False

    def excess(self, state: Starts) -> np.ndarray:
        """Return the part [S] of the objectives above that of noise alone, half a unit for each residual."""
        return np.maximum(state.objective - 0.5 * state.residual.shape[1], 0.0)

    def descend(
        self, state: Starts, coarse: float = 0.0, jacobian: np.ndarray | None = None
    ) -> tuple[Starts, np.ndarray]:
        """Iterate until the best start does not improve; return it, and the final objective [S] of each start.

        `ended` is then whether another descent from there, with `coarse` 0, would end at once.

        coarse: share of the objective by which an iteration must lower it as well (`coarse_tolerance`).
        jacobian: [S, M, D] at `state`, if it is known.
        """
        final, alive, self.given_up = state.objective.copy(), np.arange(len(state.x)), False
        ratios, failed, failed_finely = self.config.pruning_ratio, 0, 0
        for number in range(self.config.iterations - self.iterations):
            state, decrease = self.step(state, jacobian=None if number else jacobian)
            final[alive] = state.objective
            best = int(np.argmin(state.objective))
            self._report(state.objective[best], state.residual.shape[1])
            least = self.least_decrease(state)
            failed = 0 if decrease[best] > max(least, coarse * state.objective[best]) else failed + 1
            failed_finely = 0 if decrease[best] > least else failed_finely + 1
            moved = bool(decrease[best] > 0)  # one that did not may yet, with wider differences
            self.ended = moved and failed_finely >= self.config.patience
            if failed == (1 if coarse else self.config.patience):
                break
            self.given_up = bool(
                self.config.give_up * decrease[best] < state.objective[best] - self.config.target_objective
            )
            if self.given_up:
                self.ended = moved
                break
            good = state.objective <= ratios[min(number, len(ratios) - 1)] * state.objective[best]
            if number >= SORTED:
                good &= self.differs(state, state.rows([best])) | (np.arange(len(state.x)) == best)
            state, alive = state.rows(good), alive[good]
        return state.rows([int(np.argmin(state.objective))]), final

    def differs(self, state: Starts, other: Starts) -> np.ndarray:
        """Return whether [S] the replays of starts differ from those of another one [1] (`RefineConfig.same_basin`)."""
        difference = 0.5 * np.sum((state.residual - other.residual) ** 2, axis=1)
        return difference > max(self.config.tolerance, self.config.same_basin * float(self.excess(other)[0]))

    def reset(self, state: Starts) -> Starts:
        """Reset distant, hardly constrained parameters to their initial means, and descend from there.

        The objective is flat in the logarithm of a small mass, and in the friction of a finger that sticks.  If another
        parameter pushed them there, no slope leads back.  The last iterations are reserved for the present basin.
        """
        tried, last = set[str](), self.config.iterations - 2 * (self.config.hold_iterations + 1)
        while self.iterations <= last and (names := [n for n in self.distant(state) if n not in tried]):
            tried.update(names)
            means = {name: self.space[name].mean for name in names}
            single = [{name: mean} for name, mean in means.items()]
            explored = self.explore(state, [*single, means] if len(single) > 1 else single)
            if fall(state.objective, explored.objective)[0] <= self.least_decrease(state):
                break
            state, _ = self.descend(explored)
        return state

    def has_misfit(self, state: Starts) -> bool:
        """Return whether the mean square of the first start's residuals is above `basin_hop_misfit`."""
        residual: np.ndarray = state.residual[0]
        return float(residual @ residual) > self.config.basin_hop_misfit * len(residual)

    def least_decrease(self, state: Starts) -> float:
        """Return the decrease of the best objective below which an iteration has failed."""
        best = int(np.argmin(state.objective))
        return max(self.config.tolerance, self.config.excess_tolerance * float(self.excess(state)[best]))

    def distant(self, state: Starts) -> list[str]:
        """Return the parameters of interest that are far from their initial means and hardly constrained."""
        deviation = np.sqrt(np.diag(np.linalg.inv(curvature(self.jacobian(state)[0], self.prior))))
        far = np.abs(state.x[0]) > self.config.reset_distance
        unconstrained = deviation > self.config.reset_deviation
        which = ~self.space.nuisance & far & unconstrained
        return [self.space.names[k] for k in np.flatnonzero(which)]

    def hop_basins(self, state: Starts, hops: int) -> tuple[Starts, np.ndarray | None, bool]:
        """Search for better basins around one start, at most `hops` times.

        Returns the final start, its Jacobian [M, D] if it is known, and whether the last search found no better basin
        (or `hops` is 0).
        """
        settled, jacobian = hops == 0, None
        for number in range(hops):
            jacobian = self.jacobian(state)[0]
            hopped = self.hop(state, jacobian, number)
            excess = self.config.basin_hop_excess_tolerance * self.excess(state)[0]
            least = max(self.config.basin_hop_tolerance, excess)
            settled = bool(state.objective[0] - hopped.objective[0] <= least)
            if hopped.objective[0] < state.objective[0]:
                state, jacobian = hopped, None
            if settled:
                break
            state, _ = self.descend(state)
            jacobian = None
        return state, jacobian, settled

    def hop(self, state: Starts, jacobian: np.ndarray, seed: int) -> Starts:
        """Search with CMA-ES in the metric of the posterior, around one start that has converged.

        In x = x0 + L u, with L L^T the posterior's covariance, the objective is about |u|^2 / 2.  The exceptions are
        steps where a finger begins to stick or to slip, which no derivative shows.
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
        except NotReplayed:  # every point around this one blows up
            return state

    def explore(self, state: Starts, hypotheses: Hypotheses) -> Starts:
        """Refine each hypothesis from a converged start, first with its values fixed, then with all parameters free.

        After each iteration only the best hypotheses continue, if they are in another basin than `state`, one start.
        Returns the better of their best result and `state`.
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
            fixed = held if iteration < self.config.hold_iterations else None
            branches, _ = self.step(branches, fixed, None if iteration else slopes)
            best_first = np.argsort(branches.objective)[: self.config.followed]
            if fixed is not None:
                other = (branches.objective < state.objective[0]) | self.differs(branches, state)
                best_first = best_first[other[best_first]]
            if not len(best_first):
                return state
            branches, held = branches.rows(best_first), held[best_first]
        explored = branches.rows([int(np.argmin(branches.objective))])
        best = explored if explored.objective[0] < state.objective[0] else state
        self._report(best.objective[0], best.residual.shape[1])
        return best

    def _report(self, objective: float, residuals: int) -> None:
        if self.progress is not None:
            self.progress(RefineProgress(self.iterations, self.config.iterations, 2 * objective / residuals))
