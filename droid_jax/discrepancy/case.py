"""What a search works on: recordings against a model in units of one repeat's noise, base parameters and effects."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from droid_jax.arguments import instance
from droid_jax.cost.channels import check_channels, chosen_channels, in_noise_units
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.observation import Measured
from droid_jax.cost.replay_cache import cached
from droid_jax.cost.residuals import Comparison
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

AT_REST = 2  # steps of Gauss and Newton for a recording's own nuisances where joints are at rest along its motion


@dataclass(frozen=True, eq=False)
class ResidualSet:
    """A recording's cost, what is resampled and tested of it, and its own nuisances.

    cost: of this recording alone.
    whitened: [P, D] -> [P, M], distances: [P, D] -> [P, 1]: the cost's own, or ones that remember their replays.
    resampling: whole repeats, or blocks of time.
    column, time: [M] compared column and instant [s] of each residual.
    config, identifiability: thresholds of the search.
    equivalence_factor, prior_slack: those of the config that go with the resampling.
    step_difference: [M] what a quarter of the time step changes, in one repeat's noise; None: not measured.
    nuisances: names of nuisances that this recording has for itself; nuisance_columns: [M, len(nuisances)] what one
    prior deviation of each adds to the common residual.  See `with_nuisances`.
    """

    cost: Cost
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
        """Of the recording."""
        return only_comparison(self.cost)

    @property
    def repeats(self) -> int:
        """Of the recording."""
        return self.comparison.repeats

    def instants_of(self, channel: Measured) -> np.ndarray:
        """[K] bool of a channel's coarse clock, those that count."""
        names = [c.name for c in self.comparison.channels]
        before = self.comparison.channels[: names.index(channel.name)]
        return self.resampling.counted[self.column == sum(len(c.columns) for c in before)]

    def common(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, M] mean of the repeats minus simulation, the recording's own nuisances at their best.

        NaN throughout where a replay blew up.
        """
        return self._nuisances_fitted(values)[1]

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """[D] -> [N, M] of every repeat or block."""
        return self.resampling.residuals(self.common(values)[0])

    def at_best_nuisances(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, D] with the recording's own nuisances where `common` has them."""
        return self._nuisances_fitted(values)[0]

    def discrepancy_at(self, values: np.ndarray) -> float:
        """U of the model at `values` [D]; NotReplayed where its replay blows up."""
        common = self.common(values)[0]
        if not np.isfinite(common).all():
            raise NotReplayed(
                f"the simulation of {self.comparison.name!r} blows up with parameters that were fitted to another "
                "recording"
            )
        return self.resampling.discrepancy(self.resampling.residuals(common))

    def with_nuisances(self, names: Sequence[str]) -> ResidualSet:
        """The same, with nuisances `names` that are not the fitted recording's but fitted to this one.

        They must enter the residual linearly (torque offsets).  Each is fitted with its own prior.
        """
        if not names:
            return self
        space = self.cost.space
        rows = [space.mean, *(space.values({n: space[n].mean + space[n].std}) for n in names)]
        common = self._common(np.stack(rows))
        return replace(self, nuisances=tuple(names), nuisance_columns=(common[1:] - common[0]).T)

    def _nuisances_fitted(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows [P, D] with own nuisances at their best, and their residuals [P, M]."""
        rows = np.array(np.atleast_2d(values), dtype=np.float64)
        space, own = self.cost.space, [self.cost.space.index(name) for name in self.nuisances]
        rows[:, own] = space.mean[own]
        common = self._common(rows)
        if self.nuisance_columns is None:
            return rows, common
        moves = self._moves()
        columns = self.nuisance_columns * moves[:, None]
        normal = columns.T @ columns + np.eye(len(self.nuisances)) / self.repeats
        best = np.zeros((len(rows), len(self.nuisances)))
        # Where a joint is at rest its friction takes up an offset as far as it can: there it is replayed again.
        for _ in range(1 if moves.all() else AT_REST):
            best -= np.linalg.solve(normal, (common @ columns + best / self.repeats).T).T
            rows[:, own] = space.mean[own] + space.std[own] * best
            common = common + best @ self.nuisance_columns.T if moves.all() else self._common(rows)
        return rows, common

    def _common(self, rows: np.ndarray) -> np.ndarray:
        return -self.whitened(rows).astype(np.float64) / np.sqrt(self.repeats)

    def _moves(self) -> np.ndarray:
        """[M] bool, residuals at which their joint moves; all of them where motions are not prescribed."""
        return np.concatenate([channel.moves.T.ravel() for channel in self.comparison.channels])


def residual_set(cost: Cost, config: DiscrepancyConfig | None = None) -> ResidualSet:
    """The residual set of a cost over one recording with repeats.

    Raises:
        ValueError: several recordings at once, or a single repeat: whole repeats are what the tests flip.
    """
    comparison, config = only_comparison(cost), config or DiscrepancyConfig()
    if comparison.repeats < 2:
        raise ValueError(f"recording {comparison.name!r} has one repeat; a discrepancy needs repeats, or blocks")
    rows = Repeats(comparison.deviations() / np.sqrt(comparison.repeats))
    selection = config.selection
    return _of(cost, rows, config, selection.equivalence_factor, selection.prior_slack)


def block_residual_set(
    cost: Cost, block: np.ndarray, config: DiscrepancyConfig | None = None, least: int = FEWEST_REPEATS
) -> ResidualSet:
    """The residual set of a cost over one recording of one repeat; block: [K] of each instant of the coarse clock.

    least: blocks that there must be.  Raises:
        ValueError: repeats, which need no blocks, or fewer blocks than flips can use.
    """
    config, comparison = config or DiscrepancyConfig(), only_comparison(cost)
    if comparison.repeats > 1:
        raise ValueError(f"recording {comparison.name!r} has {comparison.repeats} repeats: flip these, not blocks")
    if block.max() + 1 < least:
        raise ValueError(f"recording {comparison.name!r}: {block.max() + 1} blocks, at least {least} are needed")
    column, _ = residual_locations(comparison)
    rows, blocks = Blocks(np.tile(block, int(column.max()) + 1)), config.blocks
    return _of(cost, rows, config, blocks.equivalence_factor, blocks.prior_slack)


def _of(cost: Cost, rows: Resampling, config: DiscrepancyConfig, factor: float, slack: float) -> ResidualSet:
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


def only_comparison(cost: Cost) -> Comparison:
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


FAR = 1e4  # prior deviations that no sensor is off


@dataclass(frozen=True, eq=False)
class Case:
    """What every step needs.  train: parameters are fitted to it; validation: effects are selected on it; test: opened
    once, at the end.  base: the base parameters; effects: those that are tested.
    start: [D] from where the base fit of a log begins, None: the prior's mean.  limits: what cannot be concluded from
    these recordings, beside `Split.limits`.
    both: the blocks of training and validation together, where they are of the same logs: what tells whether anything
    is missing at all; None where they are other repeats or motions.
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
        """Base parameters and all effects'."""
        return self.train.cost.space

    @property
    def residual_sets(self) -> dict[str, ResidualSet]:
        """Role -> residual set: "train", "validation" and, where there is one, "test"."""
        roles = {"train": self.train, "validation": self.validation, "test": self.test}
        return {role: e for role, e in roles.items() if e is not None}

    def against(self, recordings: Mapping[str, Recording]) -> Case:
        """The same compiled replays and other repeats, by role.

        Raises ValueError unless they have the same commands on the same clock (see `Cost.against`).
        """
        costs = [e.cost.against([recordings[role]]) for role, e in self.residual_sets.items()]
        return _of_costs(costs, self.base, self.effects, self.config)

    def with_replay_cache(self, folder: Path) -> Case:
        """The same, remembering its replays below `folder`, which belongs to this case alone.

        The search is the same computation every time, so one that was killed is simply run again: what it asks of a
        replay the second time is read.
        """

        def remembering(role: str, known: ResidualSet) -> ResidualSet:
            both = {name: cached(getattr(known, name), folder / role, name) for name in ("whitened", "distances")}
            return replace(known, **both)

        sets = self.residual_sets | ({} if self.both is None else {"both": self.both})
        return replace(self, **{role: remembering(role, e) for role, e in sets.items()})

    @property
    def minimum_sizes(self) -> dict[str, float]:
        """Coefficient -> minimum effect size."""
        return {a: e.minimum_size for e in self.effects for names in e.locations.values() for a in names}

    @property
    def natural_bounds(self) -> frozenset[str]:
        """Coefficients whose bounds are where nature ends, not where the search does."""
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
    """Of recordings with repeats: one compiled replay for each, all effects in it, at neutral.

    Args:
        scene: the robot.
        base: all that is fitted without any effect.
        effects: to test.
        train: parameters are fitted to it.
        validation: moves differently; effects are selected on it.
        test: judged on once, when the effects are selected; `minimum_closed` may then turn names into hints.
        config: of the search.

    Raises:
        ValueError: too few repeats: with fewer than eight, no flip of signs could ever be significant.
    """
    config = instance(DiscrepancyConfig() if config is None else config, "config", DiscrepancyConfig)
    instance(base, "base", Space)
    recordings = [r for r in (train, validation, test) if r is not None]
    few = [r.name for r in recordings if r.repeats < FEWEST_REPEATS]
    if few:
        raise ValueError(
            f"recordings {', '.join(few)}: at least {FEWEST_REPEATS} repeats are needed to tell an effect from noise"
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

    Raises ValueError where a recording lacks one of them, or its replay does not produce it.
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
    """Nuisances that every recording has for itself: what a sensor shows at rest changes from day to day."""
    return [p.name for p in base.of_role(Role.TORQUE_OFFSET) if p.nuisance]


def unbounded(whole: Space, names: Sequence[str]) -> Space:
    """The space of a recording whose own nuisances `names` are solved for, however far off they are."""
    far = {n: FAR * whole[n].std for n in names}
    return Space(
        tuple(
            replace(p, low=p.mean - far[p.name], high=p.mean + far[p.name]) if p.name in far else p
            for p in whole.parameters
        )
    )


def restrained(base: Space, bound: float, known: Collection[str] = ()) -> Space:
    """The base with every nuisance kept within some prior deviations: what stands further off is an effect.

    known: those that a recording states, whose values may lie anywhere within their bounds.
    """

    def kept(p: Parameter) -> Parameter:
        if not p.nuisance or p.name in known:
            return p
        return replace(p, low=max(p.low, p.mean - bound * p.std), high=min(p.high, p.mean + bound * p.std))

    return Space(tuple(kept(p) for p in base.parameters))
