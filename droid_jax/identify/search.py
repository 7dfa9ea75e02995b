"""CMA-ES over the parameters of a space: the search of the paper's section III-B.

Each generation draws a population from the current Gaussian, asks the cost of every row in one
batch, and moves the Gaussian towards the best rows (`identify.cma`).

The search moves in search coordinates x (one unit is about one prior deviation), the cost sees
physical values.  Independent restarts are rows of the same batch.  Everything random comes from
fold_in(key(seed), generation), so a resumed search repeats an uninterrupted one bit for bit.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from droid_jax.arguments import check_fields, flag, number, one_of, optional, whole
from droid_jax.distributed import agreed
from droid_jax.identify.cma import Strategy, recombination
from droid_jax.identify.fit import REASONS, CmaState, Fit, History, Restart, SearchProgress, on_bound
from droid_jax.identify.gaussian import space_to_json
from droid_jax.model.parameters import Space

if TYPE_CHECKING:
    from droid_jax.identify.checkpoints import Checkpoints

Cost = Callable[[np.ndarray], Any]  # [rows, D] float64 physical values -> [rows]; +inf is a failed row


class NotReplayed(ValueError):
    """No replay gave numbers where a search or a refinement needed some."""


@dataclass(frozen=True)
class CmaConfig:
    """Settings of a search; the defaults are the paper's population with stated stops.

    population: rows per generation and restart.
    parents:    rows with positive weight; None takes half of the population, CMA-ES's own default.
    generations: most generations.
    restarts:   independent searches, evaluated in one batch of restarts * population rows; restart r
                draws what a single search with seed + r would draw.
    sigma:      initial step in search coordinates; 1 starts from the prior.
    bounds:     "resample" redraws rows in which a linearly scaled parameter is out of bounds and clips
                what is still outside after `redraws` draws, and mirrors log-scaled ones at their bounds; at the
                end the best is asked for once more with what lies near a bound (`near_bound`) on it;
                "clip" clips both, which leads nowhere where several optima lie beyond their bounds.
    redraws:    draws per row among which one inside the bounds is looked for.
    near_bound: search coordinates, one prior deviation: so near to a bound the best is tried on it.
    active:     negative weights for the worst rows; None: only when `parents` is None.
    tol_cost:   a restart stops when its best cost fell by less than this share over `patience`
                generations; 0 never.
    patience:   generations, see tol_cost.
    tol_sigma:  a restart stops when the longest axis of its Gaussian (a deviation, in search
                coordinates) is below this; 0 never.  float32 resolves about 1e-5.
    max_seconds: stop after this many seconds of wall time, resumed parts included; None never.
    seed:       of all randomness.
    checkpoint_every: generations between checkpoints.
    """

    population: int = 30
    parents: int | None = 5
    generations: int = 100
    restarts: int = 1
    sigma: float = 1.0
    bounds: Literal["resample", "clip"] = "resample"
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
            bounds=partial(one_of, valid=("resample", "clip")),
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
    """Minimise cost over a space.

    cost:        [restarts * population, D] float64 physical values inside the bounds -> [same] costs on
                 host or device; NaN and infinite costs are failed rows, never chosen as parents.
    start:       [D] or [restarts, D] physical values to start from; None starts at the prior mean.
    checkpoint_dir: saves there and resumes from the newest whole checkpoint; a finished search can be
                 continued with more generations.
    fingerprint: says what the cost was made from (recording, scene, ...); a checkpoint made with another
                 space, configuration, start or fingerprint is refused.

    Raises NotReplayed, a ValueError, when a whole generation failed; ValueError on a cost of the wrong shape, a start
    out of bounds, or somebody else's checkpoint.
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
        asked = _try_bounds(run, cost, space, config)
    return _fit(run, space, config, asked)


def _strategy(space: Space, config: CmaConfig) -> Strategy:
    """The CMA-ES that a configuration asks for."""
    active = config.parents is None if config.active is None else config.active
    weights = recombination(config.population, config.elite, len(space), active)
    seeds = range(config.seed, config.seed + config.restarts)
    redraws = config.redraws if config.bounds == "resample" else 0
    return Strategy(space, weights, sigma=config.sigma, seeds=seeds, redraws=redraws)


def _generation(run: CmaState, cost: Cost, strategy: Strategy, config: CmaConfig) -> None:
    """One generation of every restart: draw, evaluate, update, record, judge."""
    started = time.perf_counter()
    space = strategy.space
    running = run.stopped == 0
    x, state = strategy.ask(run.state, run.generation)  # [R, P, D]
    drawn = np.asarray(x, np.float64)
    values = space.from_search(drawn if config.bounds == "clip" else mirrored(space, drawn))
    costs = _evaluate(cost, values)  # [R, P]
    if not np.isfinite(costs[running]).any():
        raise NotReplayed(
            f"generation {run.generation}: all {costs.size} rows of the cost are infinite or NaN; evaluate "
            "the cost at space.mean to see why it fails, then start nearer to values that work (a smaller "
            "sigma, another start, tighter bounds) or shorten the time step"
        )
    run.failed += int((~np.isfinite(costs)).sum())
    run.state = strategy.tell(state, x, costs, running)
    run.keep_best(values, costs, running)
    run.generation += 1
    run.ended[running] = run.generation
    run.record(costs, space.from_search(np.asarray(run.state.mean, np.float64)))
    run.records["seconds"].append(np.full(config.restarts, time.perf_counter() - started))
    _judge(run, config)


def mirrored(space: Space, x: np.ndarray) -> np.ndarray:
    """Search coordinates [..., D] with what lies beyond a bound mirrored at it, and held at the other one.

    The algebra is told the raw draw: were draws beyond a bound evaluated on it, all of them would look alike, selection
    would pull outwards, and the step size would grow without end where the optimum lies at or beyond a bound.
    """
    low, high = space.to_search(space.low), space.to_search(space.high)
    return np.clip(np.where(x < low, 2 * low - x, np.where(x > high, 2 * high - x, x)), low, high)


def _try_bounds(run: CmaState, cost: Cost, space: Space, config: CmaConfig) -> int:
    """Ask once more for every restart's best, moved onto bounds it lies near; how many rows were asked.

    Mirrored draws come near a bound and never lie on it.  A row that costs no more becomes the best.  Nothing of this
    is in a checkpoint, so that a search that is continued goes on as it would have.
    """
    if config.bounds == "clip":
        return 0
    known = np.isfinite(run.best_cost)  # a restart whose every row blew up has no best
    bests = np.where(known[:, None], run.best, space.mean)
    values = np.stack(
        [_moved_onto_bounds(space, best, config.population, config.near_bound) for best in bests]
    )  # [R, P, D]
    if (values == bests[:, None])[known].all():
        return 0
    run.keep_best(values, _evaluate(cost, values), known, ties=True)
    return values.shape[0] * values.shape[1]


def _moved_onto_bounds(space: Space, best: np.ndarray, rows: int, near: float) -> np.ndarray:
    """Values [rows, D]: the best [D] with all its near coordinates on their bounds, then with ever fewer."""
    x, low, high = (space.to_search(values) for values in (best, space.low, space.high))
    gap = np.minimum(x - low, high - x)
    values = np.tile(best, (rows, 1))
    farthest = [i for i in np.argsort(-gap) if gap[i] <= near]
    for k, i in enumerate(farthest[-rows:], start=1):
        values[:k, i] = (space.low if x[i] - low[i] == gap[i] else space.high)[i]
    return values


def _evaluate(cost: Cost, values: np.ndarray) -> np.ndarray:
    """Costs [R, P] float64 of values [R, P, D] in one batch; +inf where NaN or infinite."""
    rows = values.reshape(-1, values.shape[-1])
    costs = np.asarray(cost(rows), np.float64)
    if costs.shape != rows.shape[:1]:
        raise ValueError(f"cost must return shape {rows.shape[:1]} for values {rows.shape}, got {costs.shape}")
    return np.where(np.isfinite(costs), costs, np.inf).reshape(values.shape[:2])


def _judge(run: CmaState, config: CmaConfig) -> None:
    """Mark the restarts that have converged; a marked one stays as it is from then on."""
    widest = np.sqrt(np.linalg.eigvalsh(run.cov)[:, -1])  # [R]
    narrow = widest < config.tol_sigma
    stalled = np.zeros_like(narrow)
    if run.generation > config.patience:
        before = run.records["best_cost"][-1 - config.patience]
        with np.errstate(invalid="ignore"):  # inf - inf while a restart has not found a finite row
            stalled = before - run.best_cost < config.tol_cost * np.abs(before)
    running = run.stopped == 0
    run.stopped[running & stalled] = REASONS.index("tol_cost")
    run.stopped[running & narrow] = REASONS.index("tol_sigma")


def _unfinished(run: CmaState, config: CmaConfig) -> bool:
    """Whether another generation is due."""
    in_time = config.max_seconds is None or agreed(run.seconds < config.max_seconds)
    return bool((run.stopped == 0).any()) and run.generation < config.generations and in_time


def _progress(run: CmaState, config: CmaConfig) -> SearchProgress:
    """Numbers for a display; the pace is the median of ten generations, so that compilation drops out."""
    pace = float(np.median([s[0] for s in run.records["seconds"][-10:]]))
    left = pace * (config.generations - run.generation) if _unfinished(run, config) else 0.0
    if config.max_seconds is not None:
        left = min(left, max(0.0, config.max_seconds - run.seconds))
    leader = int(np.argmin(run.best_cost))
    median = float(np.min(run.records["median_cost"][-1][run.ended == run.generation]))
    sigma = float(run.records["sigma"][-1][leader])
    return SearchProgress(
        run.generation, config.generations, float(run.best_cost[leader]), median, sigma, run.seconds, left
    )


def _history(run: CmaState, restart: int) -> History:
    """One restart's own rows of the records, as long as it ran."""
    ended = int(run.ended[restart])
    records: dict[str, np.ndarray] = {
        name: np.stack([each[restart] for each in rows[:ended]]) for name, rows in run.records.items()
    }
    return History(**records)


def _fit(run: CmaState, space: Space, config: CmaConfig, asked: int) -> Fit:
    """The result, led by the restart with the lowest cost; `asked` rows came after the generations."""
    overall = "max_seconds" if run.generation < config.generations else "generations"
    covs, means = run.cov, run.records["mean"][-1]
    restarts = tuple(
        Restart(
            seed=config.seed + r,
            best=run.best[r],
            best_cost=float(run.best_cost[r]),
            mean=means[r],
            cov=covs[r],
            stop=REASONS[int(run.stopped[r])] or overall,
            history=_history(run, r),
        )
        for r in range(config.restarts)
    )
    winner = min(restarts, key=lambda r: r.best_cost)
    return Fit(
        space=space,
        best=winner.best,
        best_cost=winner.best_cost,
        mean=winner.mean,
        cov=winner.cov,
        history=winner.history,
        evaluations=run.generation * config.restarts * config.population + asked,
        failed=run.failed,
        stop=winner.stop,
        on_bound=on_bound(space, winner.best),
        restarts=restarts,
    )


def _start(space: Space, config: CmaConfig, start: np.ndarray | None) -> np.ndarray:
    """[R, D] physical values that the restarts begin at."""
    values = space.check(space.mean if start is None else start)
    if values.shape not in ((len(space),), (config.restarts, len(space))):
        raise ValueError(
            f"start must have shape ({len(space)},) or ({config.restarts}, {len(space)}), got {values.shape}"
        )
    return np.broadcast_to(values, (config.restarts, len(space))).copy()


def _checkpoints(folder: Path | None, space: Space, config: CmaConfig, centre: np.ndarray, fingerprint: str) -> Any:
    """Checkpoints of this search as a context manager; of None when no folder is given."""
    if folder is None:
        return nullcontext(None)
    from droid_jax.identify.checkpoints import Checkpoints  # only here: it imports orbax

    # what may change between two parts of one search without changing its path
    free = ("generations", "max_seconds", "checkpoint_every")
    texts = {
        "fingerprint": fingerprint,
        "space": json.dumps(space_to_json(space)),
        "config": json.dumps({k: v for k, v in asdict(config).items() if k not in free}),
        "start": json.dumps(centre.tolist()),
    }
    return Checkpoints(folder, fingerprint=texts)


def _restored(checkpoints: Checkpoints | None, strategy: Strategy, centre: np.ndarray) -> CmaState | None:
    """The search as its newest whole checkpoint left it, or None."""
    found = checkpoints.restore() if checkpoints else None
    if found is None:
        return None
    generation, tree = found
    state = strategy.put_state(strategy.init(centre), tree["state"])
    return CmaState.of_tree(generation, tree, state)
