"""Base parameters and effects fitted together by full replays, how sure a fit is, and what a correct one leaves.

Residual regression alone is biased by the servo loop, contact and stiction: what a candidate adds is measured only
after everything else has been allowed to move.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import project
from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.identify.fit import grip_hypotheses, search_cost, starts
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.identifiability import moved_by_step, posterior_of, step_shift
from droid_jax.identify.levenberg_marquardt import DampedProblem, LevenbergMarquardtConfig, principal_axes
from droid_jax.identify.multistart import Hypotheses, Look, RefineConfig, Refined, RefineProgress, chords, refine
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import NotReplayed, cma_search
from droid_jax.model.effects.candidate import Candidate, Keys, keys_of, names_of
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, with_options
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.replay import Drive

FINER = 4  # parts of a time step
# The step's whole U over U0, of an error that falls no faster than the step: what `beyond_step_error` allows for.
WORST = (FINER / (FINER - 1)) ** 2
SHORTEST_STEP = 0.25  # share of a step that bounds must leave for a slope
LONGEST_STEP = 1.0  # search units: what the fit did not constrain at all is no further from it than that


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted model: the base parameters and the effects that are in it.

    parts: the effects, none for the base model.
    values: [D] over the whole space, absent effects at neutral.
    space: what was free.
    refined: how the fit ended, over `space`.
    residuals: [N, M] of the fitted recording's repeats, or blocks.
    discrepancy: their U.
    """

    parts: tuple[Candidate, ...]
    values: np.ndarray
    space: Space
    refined: Refined
    residuals: np.ndarray
    discrepancy: float

    @property
    def keys(self) -> Keys:
        """Of the effects."""
        return keys_of(self.parts)

    @property
    def name(self) -> str:
        """ "base", "latch at door_hinge", "latch at door_hinge + drag at door_hinge": for people."""
        return names_of(self.keys) or "base"

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the free coefficients."""
        return tuple(a for c in self.parts for a in c.coefficients)


def refit(
    residual_set: ResidualSet,
    base: Space,
    parts: Sequence[Candidate],
    starts: np.ndarray,
    config: RefineConfig,
    hypotheses: Hypotheses = (),
    progress: Callable[[RefineProgress], None] | None = None,
) -> FittedModel:
    """Fit base parameters and the effects `parts` to one recording.

    Args:
        residual_set: of the recording.
        base: the base parameters.
        parts: the effects.
        starts: [S, D] over the whole space; what is not free stays as in the first one.
        config: of the refinement.
        hypotheses: see `identify.multistart.refine`.
        progress: called with each iteration.
    """
    whole = residual_set.cost.space
    free = [name for c in parts for name in c.free]
    space = whole.select([*base.names, *dict.fromkeys(free)])

    def residuals(rows: np.ndarray) -> np.ndarray:
        return residual_set.whitened(whole.embed(space, rows, starts[0]))

    begin = starts[:, whole.columns(space)]
    refined = refine(residuals, space, begin, config, hypotheses=hypotheses, progress=progress)
    values = whole.embed(space, refined.best[None], starts[0])[0]
    rows = residual_set.resampling
    left = rows.residuals(-refined.residual / np.sqrt(residual_set.repeats))
    return FittedModel(tuple(parts), values, space, refined, left, rows.discrepancy(left))


def one_step_fits(
    residual_set: ResidualSet,
    model: FittedModel,
    asked: Sequence[tuple[Candidate, Mapping[str, np.ndarray], np.ndarray]],
    config: LevenbergMarquardtConfig | None = None,
) -> list[tuple[np.ndarray, float]]:
    """A model with one more effect after one step, with slopes that are known already: values [D] and objective of each
    effect, all in the same batches.

    A step begins at the proposed values and without the effect, and the better end counts: it takes parameters two
    prior deviations at most, and a strong effect is many.

    Args:
        residual_set: of the fitted recording.
        model: without the effects.
        asked: effects; of each what a unit of a coefficient adds to the simulation at `model`, [M] in one repeat's
            noise, and values [D]: the model with the effect's coefficients at their linear best.
        config: of the steps.
    """
    whole = residual_set.cost.space
    looks = list[Look]()
    for part, sensitivities, proposed in asked:
        space = whole.select(dict.fromkeys((*model.space.names, *part.free)))
        jacobian = np.zeros((model.refined.jacobian.shape[0], len(space)))
        jacobian[:, space.columns(model.space)] = model.refined.jacobian
        for name in part.coefficients:
            jacobian[:, space.index(name)] = sensitivities[name] * space[name].std * np.sqrt(residual_set.repeats)
        without, coefficients = proposed.copy(), [whole.index(name) for name in part.coefficients]
        without[coefficients] = model.values[coefficients]
        starts = np.stack([without, proposed])[:, whole.columns(space)]
        looks.append(Look(space, starts, jacobian, functools.partial(whole.embed, space, values=without)))
    ended = chords(residual_set.whitened, looks, config)
    return [(look.rows(values[None])[0], objective) for look, (values, objective) in zip(looks, ended, strict=True)]


def base_fit(
    train: ResidualSet, base: Space, config: DiscrepancyConfig, progress: Progress, start: np.ndarray | None = None
) -> FittedModel:
    """Everything but the effects, fitted to the training recording.

    start: [F] values of the base parameters out of an earlier fit; without it they are searched for.  That fit has
      looked for other basins, and this one does not again, neither by hops nor by hypotheses of the grip.
    """
    if start is None:
        return fitted_from_prior(train, base, (), config, progress)
    settings = replace(config.refine, basin_hops=0)
    begin = train.cost.space.embed(base, np.clip(start, base.low, base.high)[None])
    return refit(train, base, (), begin, settings, progress=lambda p: progress("refine", p))


def fitted_from_prior(
    train: ResidualSet, base: Space, parts: Sequence[Candidate], config: DiscrepancyConfig, progress: Progress
) -> FittedModel:
    """Base parameters and the effects `parts`, searched for from the prior on and refined like the base fit.

    What is missing bends the base fit, and may leave it in another basin than the truth's: a door whose catch the model
    lacks was fitted by fingers that slip.  A refit continues from there, and the right effect then explains the fitted
    motion and not the other one.  From the prior on, with the effect in the model from the first replay, it explains
    both.

    The search moves coefficients and holds shape parameters at the candidates' values; the refinement frees both.
    Raises NotReplayed where the replay of every start blows up.
    """
    whole = train.cost.space
    at = whole.values({name: value for part in parts for name, value in part.shape_parameters.items()})
    coefficients = [a for part in parts for a in part.coefficients]
    main = whole.select([*(p.name for p in base.parameters if not p.nuisance), *coefficients])
    found = cma_search(
        search_cost(lambda rows: np.mean(train.distances(rows), axis=1), train.comparison.penalty, whole, main, at),
        main,
        config.search,
        progress=lambda p: progress("search", p),
    )
    space = whole.select([*base.names, *coefficients])
    begin, hypotheses = whole.embed(space, starts(space, main, found), at), grip_hypotheses(base)
    return refit(train, base, parts, begin, config.refine, hypotheses, lambda p: progress("refine", p))


@dataclass(frozen=True, eq=False)
class FinalModel:
    """The model that a search hands on, and what it is fitted to.

    not_made: why it is the search's own although a fit to both motions was due, empty where none was or it was made.
    """

    model: FittedModel
    fitted_to: tuple[ResidualSet, ...]
    not_made: str = ""


def final_refit_due(train: ResidualSet, model: FittedModel) -> bool:
    """Whether a model is to be fitted to both motions once it is selected."""
    return bool(model.parts) and (train.resampling.repeated or isinstance(train.cost, WindowedLog))


def final_refit(
    train: ResidualSet,
    validation: ResidualSet,
    model: FittedModel,
    config: RefineConfig,
    progress: Progress = lambda stage, value: None,
) -> FinalModel:
    """The selected model, fitted further to both motions with the care of a base fit.

    Effects are selected on a motion that the fit did not see.  What is then simulated and trained with is better not of
    one motion alone: of a door whose catch has another form than the library's, the first motion by itself was fitted
    best by pads that had changed places (torsional friction 2.5 and 1.2, where the truth is 0.79 and 2.29), both
    together by 0.88 and 2.31.  Verdict, sizes and discrepancies stay those of the search; the test motion stays out of
    every fit.

    Of commanded logs with few repeats these are the blocks that trained and those that validated.

    Without an effect the model stays unchanged, since `identify` fits a base model to any number of recordings.  So
    does that of a log without commands, and one whose fit to both does not converge.
    """
    if not final_refit_due(train, model):
        return FinalModel(model, (train,))
    whole, space = train.cost.space, model.space

    def residuals(rows: np.ndarray) -> np.ndarray:
        values = whole.embed(space, rows, model.values)
        # The validation recording's own nuisances are at their best: they are no part of the model.
        return np.concatenate([-e.common(values) * e.repeats**0.5 for e in (train, validation)], axis=1)

    begin = model.values[whole.columns(space)]
    progress("final_refit", None)
    refined = refine(residuals, space, begin, config, progress=lambda now: progress("final_refit", now))
    if not refined.converged:
        return FinalModel(model, (train,), "the fit to both motions did not converge")
    values = whole.embed(space, refined.best[None], model.values)[0]
    left = train.residuals(values)
    refitted = FittedModel(model.parts, values, space, refined, left, train.resampling.discrepancy(left))
    return FinalModel(refitted, (train, validation))


def fit_posterior(residual_set: ResidualSet, model: FittedModel) -> Gaussian:
    """What the fitted recording says of a model's parameters, over its space (`posterior_of`), its time step's part
    among it where that was measured (`with_step_difference`)."""
    gaussian = posterior_of(model.refined, residual_set.cost.comparisons, residual_set.identifiability)
    return with_step_moves(residual_set, model, gaussian)


def with_step_moves(residual_set: ResidualSet, model: FittedModel, gaussian: Gaussian) -> Gaussian:
    """A model's Gaussian, as uncertain as the time step makes it (`moved_by_step`).

    An error of first order is `FINER` / (`FINER` - 1) times what a quarter of the step changes.
    """
    if residual_set.step_difference is None:
        return gaussian
    off = FINER / (FINER - 1) * np.sqrt(residual_set.repeats) * residual_set.step_difference
    return moved_by_step(gaussian, step_shift(model.refined, off))


def consistent_with_zero(residual_set: ResidualSet, model: FittedModel, part: Candidate) -> bool:
    """Whether all coefficients of a part may be zero together, by their posterior covariance, bounds or no bounds.

    Together, because two that trade with each other (a friction's slope and curve) may each be zero and not both.  Of
    one coefficient it is the same as its interval (`intervals`) holding zero.
    """
    at, space = [model.space.index(a) for a in part.coefficients], residual_set.cost.space
    away = [(model.values[space.index(a)] - space[a].mean) / space[a].std for a in part.coefficients]
    cov = fit_posterior(residual_set, model).cov[np.ix_(at, at)]
    level = residual_set.config.interval_level
    return bool(away @ np.linalg.solve(cov, away) <= scipy.stats.chi2.ppf(level, len(at)))


def deviations(residual_set: ResidualSet, model: FittedModel) -> dict[str, float]:
    """Posterior deviation of every free coefficient, in its own unit, bounds or no bounds."""
    std = np.sqrt(np.diag(fit_posterior(residual_set, model).cov))
    return {a: float(std[model.space.index(a)] * model.space[a].std) for a in model.coefficients}


def intervals(
    residual_set: ResidualSet, model: FittedModel, names: Iterable[str] | None = None
) -> dict[str, tuple[float, float]]:
    """Interval of free parameters, each in its own unit; of every coefficient unless named.

    Around the model's own values, so that each holds what is reported.  Coefficients that may all be zero together
    (`consistent_with_zero`) have intervals that reach zero: one statement, whichever is read.
    """
    space = model.space
    values = model.values[residual_set.cost.space.columns(space)]
    about = replace(fit_posterior(residual_set, model), mean=space.to_search(values))
    low, high = about.interval(residual_set.config.interval_level)
    for part in model.parts:
        if part.coefficients and consistent_with_zero(residual_set, model, part):
            at = [space.index(a) for a in part.coefficients]
            low[at], high[at] = np.minimum(low[at], space.mean[at]), np.maximum(high[at], space.mean[at])
    asked = model.coefficients if names is None else names
    return {a: (float(low[space.index(a)]), float(high[space.index(a)])) for a in asked}


def with_finer_step(residual_set: ResidualSet, base: Space, recording: Recording) -> Cost | None:
    """The cost of the base model at a quarter of the time step; None where the time step is no error: without commands,
    which has none, and of data that were made with this very step (`CompareConfig.mj_step`).
    """
    cost = residual_set.cost
    if not isinstance(cost.drives[0], Drive) or residual_set.comparison.config.mj_step:
        return None
    scene = _finer(cost.scene)
    if isinstance(cost, WindowedLog):
        return cost.finer(scene, base)
    compared = until(recording, cost.drives[0])
    return make_cost(scene, base, [compared], config=residual_set.comparison.config, check=False)


def until(recording: Recording, drive: Drive) -> Recording:
    """What was measured before a replay ends: one of finer steps may go on for a part of a step."""
    end = float(recording.time[0]) + float(drive.time[-1]) + 1e-9  # as `observation.prepared` has it
    channels = {
        name: replace(c, time=c.time[seen], values=c.values[:, seen], mask=c.mask[:, seen])
        for name, c in recording.channels.items()
        for seen in (c.time <= end,)
    }
    return replace(recording, channels=channels)


@functools.lru_cache(maxsize=4)
def _finer(scene: Scene) -> Scene:
    """The same scene each time, so that its program is compiled once."""
    return with_options(scene, timestep=float(scene.model.opt.timestep) / FINER)


def with_step_difference(residual_set: ResidualSet, model: FittedModel, fine: Cost | None) -> ResidualSet:
    """The same residual set, knowing what a quarter of the time step changes.

    Args:
        residual_set: of the recording that the model was fitted to.
        model: the base model.
        fine: what `with_finer_step` made of the same recording; None leaves the set unchanged.

    Raises:
        NotReplayed: the finer replay blows up.
    """
    if fine is None:
        return residual_set
    values = model.values[residual_set.cost.space.columns(model.space)]
    coarse = residual_set.whitened(model.values[None])[0]
    off = (fine.whitened(values[None])[0] - coarse).astype(np.float64) / np.sqrt(residual_set.repeats)
    if not np.isfinite(off).all():
        name = residual_set.comparison.name
        raise NotReplayed(f"the simulation of {name!r} blows up at a quarter of its time step")
    return replace(residual_set, step_difference=off)


def model_at(
    residual_set: ResidualSet, space: Space, values: np.ndarray, parts: Sequence[Candidate] = (), spreads: int = 1
) -> tuple[FittedModel, np.ndarray]:
    """A model at known values [D], with the slopes that a fit has; and [M, F] slopes along each axis of its space.

    A fit's slopes are of steps along its posterior's axes (`wide_jacobian`), in which several parameters move together
    by so much that sticking joints let go.  There the slope of a delay was no longer the delay's own: what a parameter
    may absorb of an effect shows in the steps along one axis.

    spreads: see `LevenbergMarquardtConfig.spreads`.
    """
    whole, config = residual_set.cost.space, RefineConfig(iterations=0, basin_hops=0, spreads=spreads)

    def residuals(rows: np.ndarray) -> np.ndarray:
        return residual_set.whitened(whole.embed(space, rows, values))

    problem = DampedProblem(residuals, space, config)
    state, slopes = problem.start_with_slopes(problem.inside(space.to_search(values[None, whole.columns(space)])))
    if not np.isfinite(state.objective[0]):
        name = residual_set.comparison.name
        raise NotReplayed(f"the simulation of {name!r} blows up at the parameters' values: begin at other ones")
    x = state.x[0]
    refined = Refined(
        space, x, space.from_search(x), float(state.objective[0]), state.residual[0],
        problem.wide_jacobian(state, slopes[0]), problem.prior, state.objective, problem.evaluations, 0, True,
    )  # fmt: skip
    rows = residual_set.resampling
    left = rows.residuals(-refined.residual / np.sqrt(residual_set.repeats))
    at = whole.embed(space, refined.best[None], values)[0]
    return FittedModel(tuple(parts), at, space, refined, left, rows.discrepancy(left)), slopes[0]


def at_values(residual_set: ResidualSet, model: FittedModel) -> FittedModel:
    """A model that was fitted elsewhere, with its slopes in another residual set and what the base leaves there."""
    here, _ = model_at(residual_set, model.space, model.values, model.parts, RefineConfig().spreads)
    root, free = np.sqrt(residual_set.repeats), here.refined.free
    # What other instants than the fitted ones ask of the base is in the residuals, and no flip knows it: taken out.
    held = here.refined.prior[free] * root * residual_set.prior_slack
    common = project(here.residuals.mean(axis=0)[None], here.refined.jacobian[:, free] / root, held)[0]
    left = residual_set.resampling.residuals(common)
    return replace(here, residuals=left, discrepancy=residual_set.resampling.discrepancy(left))


def discretisation_error(residual_set: ResidualSet, model: FittedModel) -> float:
    """U0, the U that the simulation's own time step leaves; zero where no finer step was measured.

    The base model is replayed at a quarter of the time step and taken for data.  What the base parameters cannot absorb
    of the difference would be called a discrepancy though nothing is missing.

    Args:
        residual_set: of the recording that the model was fitted to (`with_step_difference`).
        model: the base model.
    """
    if residual_set.step_difference is None:
        return 0.0
    off, count = residual_set.step_difference, residual_set.repeats
    left = project(off[None], model.refined.jacobian / np.sqrt(count), model.refined.prior * np.sqrt(count))[0]
    return float(left @ left / residual_set.resampling.counted.sum())


def beyond_step_error(discrepancy: float, discretisation_error: float) -> bool:
    """Whether U is more than the time step could leave.

    U0 is what a quarter of the step changes.  Of an error of second order that is nearly all of it; where joints stick,
    or where a motion begins with a jolt, the error falls with the step itself, and a quarter of it stays.
    """
    return discrepancy > WORST * discretisation_error


def remaining_residuals(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> np.ndarray:
    """[N, M] residuals of a model on another recording than the fitted one, less what the fit's uncertainty allows.

    The fitted motion tells some directions of the parameters poorly, and another motion may show just these.  What that
    adds to U there is no missing effect: on a door with nothing hidden it was 0.025 where U0 is 0.0005, and one
    deviation that the fit's noise leaves along every axis makes 0.016.

    The parameters move once more, along slopes, to where the other recording wants them; how far is held by what the
    fitted one tells of them (`posterior_of`), as if both had been fitted.  The other recording's own nuisances are at
    their best throughout.  Every repeat is projected and not their mean alone, whose noise U estimates from their
    scatter.  Blocks of one log are of one motion: nothing is allowed for there.
    """
    left = other.residuals(model.values)
    if not fitted.resampling.repeated:
        return left
    slopes = transfer_spread(fitted, other, model)
    held = np.full(len(slopes.T), other.repeats**0.5)  # the residual is that of the mean of so many repeats
    return project(left, slopes, held)


def remaining_discrepancy(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> float:
    """U of `remaining_residuals`."""
    return other.resampling.discrepancy(remaining_residuals(fitted, other, model))


def transfer_spread(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> np.ndarray:
    """[M, D] by how much one deviation of the fit, along each of its principal axes, changes the common residual.

    Where a bound cuts a step short, what is left of it gives the slope.  Zero along an axis on which a replay blows up:
    nothing is allowed for there.
    """
    space, whole, x = model.space, other.cost.space, model.refined.x
    covariance = posterior_of(model.refined, fitted.cost.comparisons, fitted.identifiability, misfit=False).cov
    steps = principal_axes(covariance, LONGEST_STEP).T
    ends = [np.clip(x + sign * steps, *map(space.to_search, (space.low, space.high))) for sign in (1.0, -1.0)]
    up, down = np.split(other.common(whole.embed(space, space.from_search(np.concatenate(ends)), model.values)), 2)
    left = np.sum((ends[0] - ends[1]) * steps, axis=1) / np.sum(2 * steps**2, axis=1)
    return np.nan_to_num(0.5 * (up - down) / np.maximum(left, SHORTEST_STEP)[:, None]).T
