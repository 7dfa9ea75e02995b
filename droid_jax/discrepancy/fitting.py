"""Base parameters and effects fitted together by full replays.

Linear regression of residuals is biased by the servo loop, contact and stiction.  The gain of a candidate is therefore
measured after a refit of all parameters.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import from_neutral, project
from droid_jax.discrepancy.case import Case, ResidualSet
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.identify.fit import grip_hypotheses, search_cost, starts
from droid_jax.identify.levenberg_marquardt import DampedProblem
from droid_jax.identify.multistart import Hypotheses, Look, RefineConfig, Refined, RefineProgress, chords, refine
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import NotReplayed, cma_search
from droid_jax.model.effects.candidate import Candidate, Keys, keys_of, names_of
from droid_jax.model.parameters import Space


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted model: base parameters and effects.

    parts: its effects, none for the base model.
    values: [D] over the full space, absent effects at neutral.
    space: the free parameters.
    refined: result of the fit, over `space`.
    residuals: [N, M] of the fitted recording's repeats or blocks.
    discrepancy: U of these residuals.
    """

    parts: tuple[Candidate, ...]
    values: np.ndarray
    space: Space
    refined: Refined
    residuals: np.ndarray
    discrepancy: float

    @property
    def keys(self) -> Keys:
        """Keys of the effects."""
        return keys_of(self.parts)

    @property
    def name(self) -> str:
        """Name for messages: "base", "latch at door_hinge", "latch at door_hinge + drag at door_hinge"."""
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
        starts: [S, D] over the full space; fixed parameters keep their values in the first one.
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
    return _fitted_model(residual_set, parts, values, space, refined)


def _fitted_model(
    residual_set: ResidualSet, parts: Sequence[Candidate], values: np.ndarray, space: Space, refined: Refined
) -> FittedModel:
    """The model of a fit to one recording, with its residuals and their U."""
    rows = residual_set.resampling
    residuals = rows.residuals(-refined.residual / np.sqrt(residual_set.repeats))
    return FittedModel(tuple(parts), values, space, refined, residuals, rows.discrepancy(residuals))


def one_step_fits(
    residual_set: ResidualSet,
    model: FittedModel,
    asked: Sequence[tuple[Candidate, Mapping[str, np.ndarray], np.ndarray]],
    config: DiscrepancyConfig,
) -> list[tuple[np.ndarray, float]]:
    """Models with one more effect each, after one Levenberg-Marquardt step with known slopes, all in the same batches.

    Each effect has three starts: its proposed coefficients, neutral, and the best of `one_step_shares` of the
    coefficients at which its sensitivity was taken (`_scanned`).  A step moves a parameter by at most two prior
    deviations, and the coefficient of a strong effect may be larger.  An effect that begins at a threshold, such as a
    limit of torque, has no slope at neutral and perhaps none at the proposal.  The best end is returned.

    Args:
        residual_set: of the fitted recording.
        model: without the effects.
        asked: of each effect its candidate, coefficient -> sensitivity [M] at `model` in one repeat's noise, and values
            [D] of the model with the proposed coefficients.
        config: settings of the search.

    Returns:
        Values [D] and objective of each effect's model.
    """
    whole = residual_set.cost.space
    begun = [(part, start) for part, _, start in asked]
    looks, scanned = list[Look](), _scanned(residual_set, model, begun, config.one_step_shares)
    for (part, sensitivities, proposed), tried in zip(asked, scanned, strict=True):
        space = whole.select(dict.fromkeys((*model.space.names, *part.free)))
        jacobian = np.zeros((model.refined.jacobian.shape[0], len(space)))
        jacobian[:, space.columns(model.space)] = model.refined.jacobian
        for name in part.coefficients:
            jacobian[:, space.index(name)] = sensitivities[name] * space[name].std * np.sqrt(residual_set.repeats)
        without, coefficients = proposed.copy(), [whole.index(name) for name in part.coefficients]
        without[coefficients] = model.values[coefficients]
        starts = np.stack([without, proposed, tried])[:, whole.columns(space)]
        looks.append(Look(space, starts, jacobian, functools.partial(whole.embed, space, values=without)))
    ends = chords(residual_set.whitened, looks, config.one_step)
    return [(look.rows(values[None])[0], objective) for look, (values, objective) in zip(looks, ends, strict=True)]


def _scanned(
    residual_set: ResidualSet,
    model: FittedModel,
    asked: Sequence[tuple[Candidate, np.ndarray]],
    shares: Sequence[float],
) -> list[np.ndarray]:
    """Values [D] of each effect's model at one of `shares` of the coefficients at which its sensitivity was taken.

    It is the share that leaves least to the residual after the base parameters have absorbed their part of it.  All are
    replayed in one batch.

    asked: of each effect its candidate, and values [D] of the model with its proposed coefficients.
    """
    whole, rows = residual_set.cost.space, list[np.ndarray]()
    for part, proposed in asked:
        for share in shares:
            row = proposed.copy()
            for name in part.coefficients:
                neutral, at = whole[name].mean, whole.index(name)
                step = from_neutral(whole[name], residual_set.config.sensitivity_step)
                row[at] = neutral + share * math.copysign(step, proposed[at] - neutral or step)
            rows.append(np.clip(row, whole.low, whole.high))
    left = project(residual_set.whitened(np.stack(rows)), model.refined.jacobian, model.refined.prior)
    squares = np.nan_to_num(np.sum(left**2, axis=1), nan=np.inf).reshape(len(asked), len(shares))
    return [rows[len(shares) * k + int(best)] for k, best in enumerate(np.argmin(squares, axis=1))]


def base_fit(
    train: ResidualSet, base: Space, config: DiscrepancyConfig, progress: Progress, start: np.ndarray | None = None
) -> FittedModel:
    """The base model, fitted to the training recording.

    Args:
        train: residual set of the training recording.
        base: the base parameters.
        config: settings of the search.
        progress: called with a stage's name and its progress.
        start: [F] values of the base parameters from an earlier fit; None: CMA-ES searches from the prior.  The earlier
            fit has tried other basins, so this one makes no basin hops and tries no hypotheses of the grip.
    """
    if start is None:
        return fitted_from_prior(train, base, (), config, progress)
    settings = replace(config.refine, basin_hops=0)
    begin = train.cost.space.embed(base, np.clip(start, base.low, base.high)[None])
    return refit(train, base, (), begin, settings, progress=lambda p: progress("refine", p))


def base_model(
    case: Case, start: np.ndarray | None = None, progress: Callable[[RefineProgress], None] | None = None
) -> FittedModel:
    """The base model of a case in blocks, fitted from `start` [D], from the case's start or from the prior's mean.

    The residuals of inverse dynamics, and nearly those of windows, are smooth in the parameters.  One start suffices.
    """
    default = case.full_space.mean if case.start is None else case.start
    start = default if start is None else start
    return refit(case.train, case.base, (), start[None], case.config.refine, progress=progress)


def fitted_from_prior(
    train: ResidualSet, base: Space, parts: Sequence[Candidate], config: DiscrepancyConfig, progress: Progress
) -> FittedModel:
    """Base parameters and the effects `parts`, fitted from the prior by CMA-ES and a refinement like the base fit.

    A missing effect biases the base fit and may move it into a wrong basin.  (A door whose catch the model lacks was
    fitted by slipping fingers.)  A refit that continues from there may explain the fitted motion and no other one.  A
    fit from the prior, with the effect in the model from the first replay, explains both.

    CMA-ES moves coefficients and keeps shape parameters at the candidates' values.  The refinement frees both.

    Raises:
        NotReplayed: the replay of every start blows up.
    """
    whole = train.cost.space
    at = whole.values({name: value for part in parts for name, value in part.shape_parameters.items()})
    coefficients = [a for part in parts for a in part.coefficients]
    main = whole.select([*(p.name for p in base.parameters if not p.nuisance), *coefficients])
    searched = cma_search(
        search_cost(lambda rows: np.mean(train.distances(rows), axis=1), train.comparison.penalty, whole, main, at),
        main,
        config.search,
        progress=lambda p: progress("search", p),
    )
    space = whole.select([*base.names, *coefficients])
    begin, hypotheses = whole.embed(space, starts(space, main, searched), at), grip_hypotheses(base)
    return refit(train, base, parts, begin, config.refine, hypotheses, lambda p: progress("refine", p))


@dataclass(frozen=True, eq=False)
class FinalModel:
    """The model that a search returns, and the residual sets that it is fitted to.

    not_made: reason why a final refit that was due is missing; empty if it was made or was not due.
    """

    model: FittedModel
    fitted_to: tuple[ResidualSet, ...]
    not_made: str = ""


def final_refit_due(train: ResidualSet, model: FittedModel) -> bool:
    """Whether the selected model gets a final refit to both motions."""
    return bool(model.parts) and (train.resampling.repeated or isinstance(train.cost, WindowedLog))


def final_refit(
    train: ResidualSet,
    validation: ResidualSet,
    model: FittedModel,
    config: RefineConfig,
    progress: Progress = lambda stage, value: None,
) -> FinalModel:
    """The selected model, refined further on both motions with the settings of a base fit.

    Effects are selected on the validation motion, which the search does not fit.  The returned model should not depend
    on one motion alone.  (The catch of a door had another form than the library's.  A fit to the first motion exchanged
    the two pads: torsional friction 2.5 and 1.2, truth 0.79 and 2.29.  A fit to both found 0.88 and 2.31.)  Verdict,
    sizes and discrepancies stay those of the search.  No fit uses the test motion.

    For commanded logs with few repeats the two sets are the training blocks and the validation blocks.

    The model is returned unchanged if it has no effect (`identify` fits base models to several recordings), for a log
    without commands, and if the final refit does not converge.
    """
    if not final_refit_due(train, model):
        return FinalModel(model, (train,))
    whole, space = train.cost.space, model.space

    def residuals(rows: np.ndarray) -> np.ndarray:
        values = whole.embed(space, rows, model.values)
        # The per-recording nuisances of the validation recording are fitted to it: they are no part of the model.
        return np.concatenate([-e.common(values) * e.repeats**0.5 for e in (train, validation)], axis=1)

    begin = model.values[whole.columns(space)]
    progress("final_refit", None)
    refined = refine(residuals, space, begin, config, progress=lambda now: progress("final_refit", now))
    if not refined.converged:
        return FinalModel(model, (train,), "the fit to both motions did not converge")
    values = whole.embed(space, refined.best[None], model.values)[0]
    residuals_train = train.residuals(values)
    discrepancy = train.resampling.discrepancy(residuals_train)
    refitted = FittedModel(model.parts, values, space, refined, residuals_train, discrepancy)
    return FinalModel(refitted, (train, validation))


def model_at(
    residual_set: ResidualSet, space: Space, values: np.ndarray, parts: Sequence[Candidate] = (), spreads: int = 1
) -> tuple[FittedModel, np.ndarray]:
    """A model at known values, without a fit, and its slopes along each axis of its space.

    The model's Jacobian is that of a fit: slopes along the principal axes of the posterior (`wide_jacobian`).  These
    steps move several parameters by so much that sticking joints break away.  The slope of a single parameter, which
    may absorb an effect, is better taken from a step along its axis alone.

    Args:
        residual_set: of the recording.
        space: the free parameters.
        values: [D] over the full space.
        parts: effects of the model.
        spreads: see `LevenbergMarquardtConfig.spreads`.

    Returns:
        The model, and [M, F] slopes along each axis.

    Raises:
        NotReplayed: the replay blows up.
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
    at = whole.embed(space, refined.best[None], values)[0]
    return _fitted_model(residual_set, parts, at, space, refined), slopes[0]


def at_values(residual_set: ResidualSet, model: FittedModel) -> FittedModel:
    """A fitted model on another residual set: its slopes there, and its residuals projected on the base columns.

    The base parameters were not fitted to all of these instants.  Their error is in the residuals, alike in every row,
    so sign flips cannot distinguish it from an effect.  The projection removes it.
    """
    here, _ = model_at(residual_set, model.space, model.values, model.parts, RefineConfig().spreads)
    root, free = np.sqrt(residual_set.repeats), here.refined.free
    prior = here.refined.prior[free] * root * residual_set.prior_slack
    common = project(here.residuals.mean(axis=0)[None], here.refined.jacobian[:, free] / root, prior)[0]
    residuals = residual_set.resampling.residuals(common)
    return replace(here, residuals=residuals, discrepancy=residual_set.resampling.discrepancy(residuals))
