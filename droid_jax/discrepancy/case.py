"""The data of a search: residuals of each recording in units of one repeat's noise, base parameters and effects."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from droid_jax.arguments import instance
from droid_jax.cost.channels import check_channels, chosen_channels, in_noise_units
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.observation import Measured
from droid_jax.cost.replay_cache import cached
from droid_jax.cost.residuals import Comparison
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.config import DiscrepancyConfig, SelectionConfig
from droid_jax.discrepancy.statistics import Blocks, Repeats, Resampling
from droid_jax.identify.identifiability import IdentifiabilityConfig
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import joined, ready
from droid_jax.model.parameters import Parameter, Role, Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import FEWEST_REPEATS

AnyCost: TypeAlias = Cost | WindowedLog  # of one recording, or of pooled logs
NUISANCE_ITERATIONS = 2  # Gauss-Newton steps for per-recording nuisances where joints come to rest during the motion


@dataclass(frozen=True, eq=False)
class ResidualSet:
    """The residuals of one recording: its cost, the rows that are flipped and resampled, its nuisances.

    cost: of this recording alone.
    whitened: [P, D] -> [P, M], and distances: [P, D] -> [P, 1]; the cost's methods, or versions that cache replays.
    resampling: whole repeats, or blocks of time.
    column, time: [M] compared column and instant [s] of each residual.
    config, identifiability: thresholds of the search.
    equivalence_factor, prior_slack: the thresholds of the config for this kind of resampling.
    step_difference: [M] residuals at a quarter of the time step minus residuals, in one repeat's noise; None: not
        computed.
    nuisances: names of per-recording nuisances, which are fitted to this recording (`with_nuisances`).
    nuisance_columns: [M, len(nuisances)] change of the common residual by one prior deviation of each.
    """

    cost: AnyCost
    whitened: Callable[[np.ndarray], np.ndarray]
    distances: Callable[[np.ndarray], np.ndarray]
    resampling: Resampling
    column: np.ndarray
    time: np.ndarray
    config: SelectionConfig
    identifiability: IdentifiabilityConfig
    equivalence_factor: float
    prior_slack: float
    step_difference: np.ndarray | None = field(default=None, kw_only=True)
    nuisances: tuple[str, ...] = field(default=(), kw_only=True)
    nuisance_columns: np.ndarray | None = field(default=None, kw_only=True)

    @property
    def comparison(self) -> Comparison:
        """The comparison of the recording."""
        return only_comparison(self.cost)

    @property
    def repeats(self) -> int:
        """Number of repeats of the recording."""
        return self.comparison.repeats

    def instants_of(self, channel: Measured) -> np.ndarray:
        """[K] bool, instants of a channel's coarse clock that belong to this set."""
        names = [c.name for c in self.comparison.channels]
        before = self.comparison.channels[: names.index(channel.name)]
        return self.resampling.counted[self.column == sum(len(c.columns) for c in before)]

    def common(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, M] mean of the repeats minus simulation, with fitted per-recording nuisances.

        A row is NaN throughout if its replay blew up.
        """
        return self._nuisances_fitted(values)[1]

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """[D] -> [N, M] residuals of every repeat or block."""
        return self.resampling.residuals(self.common(values)[0])

    def at_best_nuisances(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, D] with the fitted values of the per-recording nuisances."""
        return self._nuisances_fitted(values)[0]

    def discrepancy_at(self, values: np.ndarray) -> float:
        """U of the model at `values` [D].

        Raises:
            NotReplayed: the replay blows up.
        """
        common = self.common(values)[0]
        if not np.isfinite(common).all():
            raise NotReplayed(
                f"the simulation of {self.comparison.name!r} blows up with parameters that were fitted to another "
                "recording"
            )
        return self.resampling.discrepancy(self.resampling.residuals(common))

    def with_nuisances(self, names: Sequence[str]) -> ResidualSet:
        """The same set, with nuisances `names` fitted to this recording instead of taken from the training recording.

        They must enter the residual linearly (torque offsets).  Each is fitted with its prior.
        """
        if not names:
            return self
        space = self.cost.space
        rows = [space.mean, *(space.values({n: space[n].mean + space[n].std}) for n in names)]
        common = self._common(np.stack(rows))
        return replace(self, nuisances=tuple(names), nuisance_columns=(common[1:] - common[0]).T)

    def _nuisances_fitted(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows [P, D] with fitted per-recording nuisances, and their common residuals [P, M]."""
        rows = np.array(np.atleast_2d(values), dtype=np.float64)
        space, nuisances = self.cost.space, [self.cost.space.index(name) for name in self.nuisances]
        rows[:, nuisances] = space.mean[nuisances]
        common = self._common(rows)
        if self.nuisance_columns is None:
            return rows, common
        moves = self._moves()
        columns = self.nuisance_columns * moves[:, None]
        normal = columns.T @ columns + np.eye(len(self.nuisances)) / self.repeats
        best = np.zeros((len(rows), len(self.nuisances)))
        # At rest, friction absorbs an offset up to its limit.  The residual is not linear there: it is computed again.
        for _ in range(1 if moves.all() else NUISANCE_ITERATIONS):
            best -= np.linalg.solve(normal, (common @ columns + best / self.repeats).T).T
            rows[:, nuisances] = space.mean[nuisances] + space.std[nuisances] * best
            common = common + best @ self.nuisance_columns.T if moves.all() else self._common(rows)
        return rows, common

    def _common(self, rows: np.ndarray) -> np.ndarray:
        return -self.whitened(rows).astype(np.float64) / np.sqrt(self.repeats)

    def _moves(self) -> np.ndarray:
        """[M] bool, residuals whose joint moves; all of them unless the motion is prescribed."""
        return np.concatenate([channel.moves.T.ravel() for channel in self.comparison.channels])


def residual_set(cost: Cost, config: DiscrepancyConfig | None = None) -> ResidualSet:
    """The residual set of a cost over one recording with repeats.

    Raises:
        ValueError: several recordings, or a single repeat.  The tests flip the signs of whole repeats.
    """
    comparison, config = only_comparison(cost), config or DiscrepancyConfig()
    if comparison.repeats < 2:
        raise ValueError(f"recording {comparison.name!r} has one repeat; a discrepancy needs repeats, or blocks")
    rows = Repeats(comparison.deviations() / np.sqrt(comparison.repeats))
    selection = config.selection
    return _residual_set_of(cost, rows, config, selection.equivalence_factor, selection.prior_slack)


def block_residual_set(
    cost: AnyCost, block: np.ndarray, config: DiscrepancyConfig | None = None, least: int = FEWEST_REPEATS
) -> ResidualSet:
    """The residual set, in blocks of time, of a cost over one recording of one repeat.

    Args:
        cost: over the recording.
        block: [K] block of each instant of the coarse clock.
        config: thresholds of the search.
        least: least number of blocks.

    Raises:
        ValueError: several repeats, or fewer blocks than `least`.
    """
    config, comparison = config or DiscrepancyConfig(), only_comparison(cost)
    if comparison.repeats > 1:
        raise ValueError(f"recording {comparison.name!r} has {comparison.repeats} repeats: flip these, not blocks")
    if block.max() + 1 < least:
        raise ValueError(f"recording {comparison.name!r}: {block.max() + 1} blocks, at least {least} are needed")
    column, _ = residual_locations(comparison)
    rows, blocks = Blocks(np.tile(block, int(column.max()) + 1)), config.blocks
    return _residual_set_of(cost, rows, config, blocks.equivalence_factor, blocks.prior_slack)


def _residual_set_of(
    cost: AnyCost, rows: Resampling, config: DiscrepancyConfig, factor: float, slack: float
) -> ResidualSet:
    return ResidualSet(
        cost,
        cost.whitened,
        cost.distances,
        rows,
        *residual_locations(only_comparison(cost)),
        config=config.selection,
        identifiability=config.identifiability,
        equivalence_factor=factor,
        prior_slack=slack,
    )


def only_comparison(cost: AnyCost) -> Comparison:
    """The comparison of a cost over one recording; ValueError for several."""
    if len(cost.comparisons) != 1:
        raise ValueError(f"a residual set is of one recording, got {len(cost.comparisons)}")
    return cost.comparisons[0]


def residual_locations(comparison: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """Column and instant [s] of each residual, both [M]."""
    columns, times, start = [], [], 0
    for channel in comparison.channels:
        clock = channel.clock
        columns.append(np.repeat(start + np.arange(len(channel.columns)), len(clock)))
        times.append(np.tile(clock, len(channel.columns)))
        start += len(channel.columns)
    return np.concatenate(columns), np.concatenate(times)


UNBOUNDED_DEVIATIONS = 1e4  # prior deviations: bounds of a nuisance that is solved for, beyond any real offset


@dataclass(frozen=True, eq=False)
class Case:
    """The recordings of a search, the base parameters and the effects that are tested.

    train: residual set that parameters are fitted to.
    validation: residual set that effects are selected on.
    test: residual set that is used once, in the verdict; None: no test data.
    base: the base parameters.
    effects: tested effects.
    config: settings of the search.
    start: [D] where the base fit of a log begins; None: the prior's mean.
    limits: conclusions that these recordings do not allow, in words, beside those of `Split.limits`.
    both: training and validation blocks together, if they are of the same logs.  Whether anything is missing is tested
        on all of them.  None if training and validation have different repeats or motions.
    """

    train: ResidualSet
    validation: ResidualSet
    test: ResidualSet | None
    base: Space
    effects: tuple[Effect, ...]
    config: DiscrepancyConfig
    start: np.ndarray | None = None
    limits: tuple[str, ...] = ()
    both: ResidualSet | None = None

    @property
    def full_space(self) -> Space:
        """Base parameters and the parameters of all tested effects."""
        return self.train.cost.space

    @property
    def residual_sets(self) -> dict[str, ResidualSet]:
        """Role -> residual set: "train", "validation" and, if there are test data, "test"."""
        roles = {"train": self.train, "validation": self.validation, "test": self.test}
        return {role: e for role, e in roles.items() if e is not None}

    def against(self, recordings: Mapping[str, Recording]) -> Case:
        """The case of other repeats, by role, with the same compiled replays.

        Raises:
            ValueError: a case of windows, other commands or another clock (see `Cost.against`).
        """
        costs = list[Cost]()
        for role, residual_set in self.residual_sets.items():
            if isinstance(residual_set.cost, WindowedLog):
                raise ValueError("a case of windows has no repeats to replace: make another case (`log_case.case_of`)")
            costs.append(residual_set.cost.against([recordings[role]]))
        return _of_costs(costs, self.base, self.effects, self.config)

    def with_replay_cache(self, folder: Path) -> Case:
        """The same case, which caches the results of its replays in `folder`.  No other case may use the folder.

        A search is deterministic.  After a stop the same search is run again and reads the replays made before.
        """

        def caching(role: str, residual_set: ResidualSet) -> ResidualSet:
            functions = ("whitened", "distances")
            return replace(
                residual_set, **{name: cached(getattr(residual_set, name), folder / role, name) for name in functions}
            )

        sets = self.residual_sets | ({} if self.both is None else {"both": self.both})
        return replace(self, **{role: caching(role, residual_set) for role, residual_set in sets.items()})

    @property
    def minimum_sizes(self) -> dict[str, float]:
        """Coefficient -> minimum effect size."""
        return {a: e.minimum_size for e in self.effects for names in e.locations.values() for a in names}

    @property
    def natural_bounds(self) -> frozenset[str]:
        """Coefficients whose bounds are physical limits and not limits of the search."""
        return frozenset(name for e in self.effects for name in e.natural_bounds)


def make_case(
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    train: Recording,
    validation: Recording,
    test: Recording | None = None,
    config: DiscrepancyConfig | None = None,
) -> Case:
    """The case of recordings with repeats.  Each has one compiled replay with all effects in it, at neutral.

    Args:
        scene: the robot.
        base: parameters that are fitted without any effect.
        effects: to test.
        train: recording that parameters are fitted to.
        validation: recording of another motion, on which effects are selected.
        test: recording on which the selected effects are judged once; `minimum_closed` may then turn names into hints.
        config: settings of the search.

    Raises:
        ValueError: fewer than eight repeats; sign flips of fewer cannot reach the significance level.
    """
    config = instance(DiscrepancyConfig() if config is None else config, "config", DiscrepancyConfig)
    instance(base, "base", Space)
    recordings = [r for r in (train, validation, test) if r is not None]
    few = [r.name for r in recordings if r.repeats < FEWEST_REPEATS]
    if few:
        raise ValueError(
            f"recordings {', '.join(few)}: at least {FEWEST_REPEATS} repeats are needed to distinguish an effect from "
            "noise"
        )
    config = comparing(scene, recordings, config)
    scene = ready(scene)
    base = restrained(base, config.selection.nuisance_bound, {name for r in recordings for name in r.known})
    whole = joined(base, effects)
    spaces = [whole, *[unbounded(whole, per_recording_nuisances(base))] * (len(recordings) - 1)]
    made = zip(recordings, spaces, strict=True)
    costs = [make_cost(scene, space, [r], config=config.compare, effects=effects, check=False) for r, space in made]
    if config.channels is not None and len(config.channels) > 1:
        weighed = replace(config.compare, channels=in_noise_units(costs[0], whole.mean))
        config = replace(config, compare=weighed)
        costs = [cost.against([r], weighed) for cost, r in zip(costs, recordings, strict=True)]
    return _of_costs(costs, base, tuple(effects), config)


def comparing(scene: Scene, recordings: Sequence[Recording], config: DiscrepancyConfig) -> DiscrepancyConfig:
    """The config with the channels that are compared (`channels.chosen_channels`), each of weight one if chosen here.

    Raises:
        ValueError: a recording lacks one of them, or its replay does not produce it.
    """
    chosen = chosen_channels(scene, recordings, config.channels, config.compare)
    if chosen:
        compare = replace(config.compare, channels=dict.fromkeys(chosen, 1.0))
        config = replace(config, compare=compare, channels=chosen)
    check_channels(recordings, config.compare.channels)
    return config


def _of_costs(costs: Sequence[Cost], base: Space, effects: tuple[Effect, ...], config: DiscrepancyConfig) -> Case:
    train, *others = (residual_set(c, config) for c in costs)
    validation, *test = (e.with_nuisances(per_recording_nuisances(base)) for e in others)
    return Case(train, validation, test[0] if test else None, base, effects, config)


def per_recording_nuisances(base: Space) -> list[str]:
    """Names of per-recording nuisances: a torque sensor's offset changes from day to day."""
    return [p.name for p in base.of_role(Role.TORQUE_OFFSET) if p.nuisance]


def unbounded(space: Space, names: Sequence[str]) -> Space:
    """The space with practically no bounds on the nuisances `names`, which are solved for."""
    distance = {n: UNBOUNDED_DEVIATIONS * space[n].std for n in names}
    return Space(
        tuple(
            replace(p, low=p.mean - distance[p.name], high=p.mean + distance[p.name]) if p.name in distance else p
            for p in space.parameters
        )
    )


def restrained(base: Space, bound: float, known: Collection[str] = ()) -> Space:
    """The base parameters with every nuisance bounded to `bound` prior deviations from its mean.

    known: names of parameters whose values a recording states; they keep their bounds.
    """

    def bounded(p: Parameter) -> Parameter:
        if not p.nuisance or p.name in known:
            return p
        return replace(p, low=max(p.low, p.mean - bound * p.std), high=min(p.high, p.mean + bound * p.std))

    return Space(tuple(bounded(p) for p in base.parameters))
