"""CMA-ES over the parameters of a space: the search of the paper's section III-B.

Each generation draws a population from the current Gaussian, evaluates the cost of all rows in one batch, and moves the
Gaussian towards the best rows (`identify.cma`).

The search works in search coordinates x, where one unit is about one prior deviation.  The cost receives physical
values.  Independent restarts are rows of the same batch.  All randomness comes from fold_in(key(seed), generation), so
a resumed search repeats an uninterrupted one bit for bit.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from droid_jax.arguments import check_fields, flag, number, optional, whole
from droid_jax.distributed import agreed
from droid_jax.identify.cma import Strategy, recombination
from droid_jax.identify.fit import STOP_REASONS, CmaState, Fit, History, SearchProgress, on_bound
from droid_jax.identify.gaussian import space_to_json
from droid_jax.model.parameters import Space

if TYPE_CHECKING:
    from droid_jax.identify.checkpoints import Checkpoints

Cost = Callable[[np.ndarray], Any]  # [rows, D] float64 physical values -> [rows]; +inf is a failed row


class NotReplayed(ValueError):
    """All replays that a search or a refinement needed blew up."""


@dataclass(frozen=True)
class CmaConfig:
    """Settings of a search; the defaults are the paper's population with stop criteria.

    population: rows per generation and restart.
    parents: rows with positive weight; None takes half of the population, the default of CMA-ES.
    generations: at most.
    restarts: independent searches, evaluated in one batch of restarts * population rows.  Restart r draws the same rows
      as a single search with seed + r.
    sigma: initial step in search coordinates; 1 starts from the prior.
    redraws: draws per row, of which the first inside the bounds is taken; a row that is still outside is clipped.  It
      applies to linearly scaled parameters.  Log-scaled ones are mirrored at their bounds.
    near_bound: search coordinates.  After the last generation the best values closer than this to a bound are also
      evaluated on it.  The default is one prior deviation.
    active: negative weights for the worst rows; None: only if `parents` is None.
    tol_cost: a restart stops if its best cost fell by less than this share over `patience` generations; 0 never.
    patience: generations, see `tol_cost`.
    tol_sigma: a restart stops if the longest axis of its Gaussian (a deviation, in search coordinates) is below this; 0
      never.  float32 resolves about 1e-5.
    max_seconds: stop after this many seconds of wall time, resumed parts included; None never.
    seed: of all randomness.
    checkpoint_every: generations between checkpoints.
    """

    population: int = 30
    parents: int | None = 5
    generations: int = 100
    restarts: int = 1
    sigma: float = 1.0

    redraws: int = 64
    near_bound: float = 1.0
    active: bool | None = None
    tol_cost: float = 1e-4
    patience: int = 20
    tol_sigma: float = 1e-3
    max_seconds: float | None = None
    seed: int = 0
    checkpoint_every: int = 5

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(
                ("generations", "restarts", "patience", "checkpoint_every", "redraws"), partial(whole, least=1)
            ),
            **dict.fromkeys(("tol_cost", "tol_sigma", "near_bound"), partial(number, least=0)),
            population=partial(whole, least=2),
            parents=optional(whole),
            sigma=partial(number, above=0),
            active=optional(flag),
            max_seconds=optional(partial(number, above=0)),
            seed=whole,
        )
        if self.parents is not None and not 1 <= self.parents < self.population:
            raise ValueError(
                f"parents must lie between 1 and population - 1 = {self.population - 1}, got {self.parents}"
            )
        if not 0 <= self.seed < 2**31 - self.restarts:
            raise ValueError(f"seed must lie between 0 and 2^31 - restarts, got {self.seed}")

    @property
    def elite(self) -> int:
        """Number of parents."""
        return self.population // 2 if self.parents is None else self.parents


def cma_search(
    cost: Cost,
    space: Space,
    config: CmaConfig,
    *,
    start: np.ndarray | None = None,
    checkpoint_dir: Path | None = None,
    fingerprint: str = "",
    progress: Callable[[SearchProgress], None] | None = None,
) -> Fit:
    """Minimise a cost over a space.

    Args:
        cost: [restarts * population, D] float64 physical values inside the bounds -> costs of the rows, on host or
            device.  NaN and infinite costs are failed rows, which are never chosen as parents.
        space: meaning of the D entries.
        config: settings.
        start: [D] or [restarts, D] physical values to start from; None for the prior mean.
        checkpoint_dir: folder to save to, and to resume from its newest complete checkpoint.  A finished search can be
            continued with more generations.
        fingerprint: text that identifies the cost (recording, scene, ...).  A checkpoint of another space,
            configuration, start or fingerprint is refused.
        progress: called after every generation.

    Returns:
        The best values and the final Gaussian, of the restart with the lowest cost.

    Raises:
        NotReplayed: all rows of a generation failed; a ValueError.
        ValueError: a cost of the wrong shape, a start out of bounds, or a checkpoint of another search.
    """
    strategy = _strategy(space, config)
    centre = _start(space, config, start)
    with _checkpoints(checkpoint_dir, space, config, centre, fingerprint) as checkpoints:
        run = _restored(checkpoints, strategy, centre) or CmaState.fresh(
            strategy.init(centre), config.restarts, len(space)
        )
        while _unfinished(run, config):
            _generation(run, cost, strategy, config)
            if checkpoints and (run.generation % config.checkpoint_every == 0 or not _unfinished(run, config)):
                checkpoints.save(run.generation, run.tree())
            if progress:
                progress(_progress(run, config))
        extra_rows = _try_bounds(run, cost, space, config)
    return _fit(run, space, config, extra_rows)


def _strategy(space: Space, config: CmaConfig) -> Strategy:
    """The CMA-ES of a configuration."""
    active = config.parents is None if config.active is None else config.active
    weights = recombination(config.population, config.elite, len(space), active)
    seeds = range(config.seed, config.seed + config.restarts)
    return Strategy(space, weights, sigma=config.sigma, seeds=seeds, redraws=config.redraws)


def _generation(run: CmaState, cost: Cost, strategy: Strategy, config: CmaConfig) -> None:
    """One generation of every restart: draw, evaluate, update, record, check the stop criteria."""
    started = time.perf_counter()
    space = strategy.space
    running = run.stopped == 0
    x, state = strategy.ask(run.state, run.generation)  # [R, P, D]
    values = space.from_search(mirrored(space, np.asarray(x, np.float64)))
    costs = _evaluate(cost, values)  # [R, P]
    if not np.isfinite(costs[running]).any():
        raise NotReplayed(
            f"generation {run.generation}: all {costs.size} rows of the cost are infinite or NaN; evaluate "
            "the cost at space.mean to see why it fails, then start nearer to values that work (a smaller "
            "sigma, another start, tighter bounds) or shorten the time step"
        )
    run.failed += int((~np.isfinite(costs)).sum())
    run.state = strategy.tell(state, x, costs, running)
    run.update_best(values, costs, running)
    run.generation += 1
    run.ended[running] = run.generation
    run.record(costs, space.from_search(np.asarray(run.state.mean, np.float64)))
    run.records["seconds"].append(np.full(config.restarts, time.perf_counter() - started))
    _check_stop(run, config)


def mirrored(space: Space, x: np.ndarray) -> np.ndarray:
    """Return search coordinates [..., D] with values beyond a bound mirrored at it, and clipped at the other bound.

    The update of CMA-ES uses the raw draws.  If draws beyond a bound were clipped instead, all of them would cost the
    same.  Selection would then pull outwards, and the step size would grow without limit where the optimum lies at or
    beyond a bound.
    """
    low, high = space.to_search(space.low), space.to_search(space.high)
    return np.clip(np.where(x < low, 2 * low - x, np.where(x > high, 2 * high - x, x)), low, high)


def _try_bounds(run: CmaState, cost: Cost, space: Space, config: CmaConfig) -> int:
    """Evaluate every restart's best once more, moved onto the bounds that it is near; return the number of rows.

    Mirrored draws come near a bound but never lie on it.  A row that costs no more becomes the best.  Checkpoints do
    not hold this step, so a search that is continued is not changed by it.
    """
    has_best = np.isfinite(run.best_cost)  # False for a restart whose rows all blew up
    bests = np.where(has_best[:, None], run.best, space.mean)
    values = np.stack(
        [_moved_onto_bounds(space, best, config.population, config.near_bound) for best in bests]
    )  # [R, P, D]
    if (values == bests[:, None])[has_best].all():
        return 0
    run.update_best(values, _evaluate(cost, values), has_best, ties=True)
    return values.shape[0] * values.shape[1]


def _moved_onto_bounds(space: Space, best: np.ndarray, rows: int, near: float) -> np.ndarray:
    """Values [rows, D]: the best [D] with all coordinates that are near a bound on it, then with ever fewer of them."""
    x, low, high = (space.to_search(values) for values in (best, space.low, space.high))
    distance = np.minimum(x - low, high - x)
    values = np.tile(best, (rows, 1))
    farthest_first = [i for i in np.argsort(-distance) if distance[i] <= near]
    for k, i in enumerate(farthest_first[-rows:], start=1):
        values[:k, i] = (space.low if x[i] - low[i] == distance[i] else space.high)[i]
    return values


def _evaluate(cost: Cost, values: np.ndarray) -> np.ndarray:
    """Costs [R, P] float64 of values [R, P, D], evaluated in one batch; +inf where NaN or infinite."""
    rows = values.reshape(-1, values.shape[-1])
    costs = np.asarray(cost(rows), np.float64)
    if costs.shape != rows.shape[:1]:
        raise ValueError(f"cost must return shape {rows.shape[:1]} for values {rows.shape}, got {costs.shape}")
    return np.where(np.isfinite(costs), costs, np.inf).reshape(values.shape[:2])


def _check_stop(run: CmaState, config: CmaConfig) -> None:
    """Mark the restarts that have converged; a marked one does not change any more."""
    widest = np.sqrt(np.linalg.eigvalsh(run.cov)[:, -1])  # [R]
    narrow = widest < config.tol_sigma
    stalled = np.zeros_like(narrow)
    if run.generation > config.patience:
        before = run.records["best_cost"][-1 - config.patience]
        with np.errstate(invalid="ignore"):  # inf - inf while a restart has not found a finite row
            stalled = before - run.best_cost < config.tol_cost * np.abs(before)
    running = run.stopped == 0
    run.stopped[running & stalled] = STOP_REASONS.index("tol_cost")
    run.stopped[running & narrow] = STOP_REASONS.index("tol_sigma")


def _unfinished(run: CmaState, config: CmaConfig) -> bool:
    """Whether another generation follows."""
    in_time = config.max_seconds is None or agreed(run.seconds < config.max_seconds)
    return bool((run.stopped == 0).any()) and run.generation < config.generations and in_time


def _progress(run: CmaState, config: CmaConfig) -> SearchProgress:
    """Numbers for a display.  The median over ten generations is the pace, which excludes the compilation."""
    pace = float(np.median([s[0] for s in run.records["seconds"][-10:]]))
    seconds_left = pace * (config.generations - run.generation) if _unfinished(run, config) else 0.0
    if config.max_seconds is not None:
        seconds_left = min(seconds_left, max(0.0, config.max_seconds - run.seconds))
    best = int(np.argmin(run.best_cost))
    median = float(np.min(run.records["median_cost"][-1][run.ended == run.generation]))
    sigma = float(run.records["sigma"][-1][best])
    return SearchProgress(
        run.generation, config.generations, float(run.best_cost[best]), median, sigma, run.seconds, seconds_left
    )


def _history(run: CmaState, restart: int) -> History:
    """The records of one restart, over the generations that it ran."""
    ended = int(run.ended[restart])
    records: dict[str, np.ndarray] = {
        name: np.stack([each[restart] for each in rows[:ended]]) for name, rows in run.records.items()
    }
    return History(**records)


def _fit(run: CmaState, space: Space, config: CmaConfig, extra_rows: int) -> Fit:
    """The result of the restart with the lowest cost; extra_rows: evaluated after the last generation."""
    overall = "max_seconds" if run.generation < config.generations else "generations"
    r = int(np.argmin(run.best_cost))
    return Fit(
        space=space,
        best=run.best[r],
        best_cost=float(run.best_cost[r]),
        mean=run.records["mean"][-1][r],
        cov=run.cov[r],
        history=_history(run, r),
        evaluations=run.generation * config.restarts * config.population + extra_rows,
        failed=run.failed,
        stop=STOP_REASONS[int(run.stopped[r])] or overall,
        on_bound=on_bound(space, run.best[r]),
    )


def _start(space: Space, config: CmaConfig, start: np.ndarray | None) -> np.ndarray:
    """[R, D] physical values of the restarts' starts."""
    values = space.check(space.mean if start is None else start)
    if values.shape not in ((len(space),), (config.restarts, len(space))):
        raise ValueError(
            f"start must have shape ({len(space)},) or ({config.restarts}, {len(space)}), got {values.shape}"
        )
    return np.broadcast_to(values, (config.restarts, len(space))).copy()


def _checkpoints(folder: Path | None, space: Space, config: CmaConfig, centre: np.ndarray, fingerprint: str) -> Any:
    """A context manager of the checkpoints of this search, or of None if there is no folder."""
    if folder is None:
        return nullcontext(None)
    from droid_jax.identify.checkpoints import Checkpoints  # only here: it imports orbax

    # settings that do not change a search, and may differ when it is resumed
    may_differ = ("generations", "max_seconds", "checkpoint_every")
    texts = {
        "fingerprint": fingerprint,
        "space": json.dumps(space_to_json(space)),
        "config": json.dumps({k: v for k, v in asdict(config).items() if k not in may_differ}),
        "start": json.dumps(centre.tolist()),
    }
    return Checkpoints(folder, fingerprint=texts)


def _restored(checkpoints: Checkpoints | None, strategy: Strategy, centre: np.ndarray) -> CmaState | None:
    """The search at its newest complete checkpoint, or None."""
    restored = checkpoints.restore() if checkpoints else None
    if restored is None:
        return None
    generation, tree = restored
    state = strategy.put_state(strategy.init(centre), tree["state"])
    return CmaState.of_tree(generation, tree, state)
