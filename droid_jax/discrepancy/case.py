"""What a search works on: the training, validation and test recordings, the base parameters and the effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from droid_jax.arguments import instance
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.lone_log import LoneLog, lone_log
from droid_jax.cost.noise import stated_deviation
from droid_jax.cost.observation import least_noise
from droid_jax.cost.replay_cache import cached
from droid_jax.discrepancy.candidates import ScoreTest, directions_of, proposals, score_test
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import FittedModel, refit
from droid_jax.discrepancy.residual_set import ResidualSet, block_residual_set, residual_set
from droid_jax.discrepancy.statistics import OUTSIDE, block_length, fewest_blocks, interleaved
from droid_jax.identify.multistart import RefineProgress
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import candidates
from droid_jax.model.effects.registry import beside, joined, ready
from droid_jax.model.parameters import Parameter, Role, Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import FEWEST_REPEATS, Split

FAR = 1e4  # prior deviations that no sensor is off


@dataclass(frozen=True, eq=False)
class Case:
    """What every step needs.  train: parameters are fitted to it; validation: effects are selected on it; test: opened
    once, at the end.  base: the base parameters; effects: those that are asked about.
    """

    train: ResidualSet
    validation: ResidualSet
    test: ResidualSet | None
    base: Space
    effects: tuple[Effect, ...]
    config: DiscrepancyConfig

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

        return replace(self, **{role: remembering(role, e) for role, e in self.residual_sets.items()})

    @property
    def minimum_sizes(self) -> dict[str, float]:
        """Coefficient -> minimum effect size."""
        return {a: e.minimum_size for e in self.effects for names in e.locations.values() for a in names}

    @property
    def natural_bounds(self) -> frozenset[str]:
        """Coefficients whose bounds are where nature ends, not where the search does."""
        return frozenset(name for e in self.effects for name in e.natural_bounds)


def case_of(
    split: Split,
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    roles: Mapping[str, Recording],
    config: DiscrepancyConfig,
) -> Case:
    """Of recordings by role (see `preflight.search_inputs.assigned_roles`), one or two logs where they are blocks.

    Sensors' gains and encoders' offsets that the base has as parameters are not asked about there.
    Raises ValueError for what is wrong with them, or does not fit the scene.
    """
    effects = beside(base, effects)
    if split is not Split.BLOCKS:
        return make_case(scene, base, effects, **roles, config=config)
    config = replace(config, refine=replace(config.refine, basin_hops=0, spreads=0))  # inverse dynamics is smooth
    logs = {role: make_log(scene, base, effects, recording, config) for role, recording in roles.items()}
    return single_case(logs["train"], base, effects, logs.get("test"), config)


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
        effects: to ask about.
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
    scene = ready(scene)
    base = restrained(base, config.selection.nuisance_bound)
    whole = joined(base, effects)
    spaces = [whole, *[unbounded(whole, per_recording_nuisances(base))] * (len(recordings) - 1)]
    made = zip(recordings, spaces, strict=True)
    costs = [make_cost(scene, space, [r], config=config.compare, effects=effects, check=False) for r, space in made]
    return _of_costs(costs, base, tuple(effects), config)


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


def restrained(base: Space, bound: float) -> Space:
    """The base with every nuisance kept within some prior deviations: what stands further off is an effect."""

    def kept(p: Parameter) -> Parameter:
        if not p.nuisance:
            return p
        return replace(p, low=max(p.low, p.mean - bound * p.std), high=min(p.high, p.mean + bound * p.std))

    return Space(tuple(kept(p) for p in base.parameters))


def make_log(
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    recording: Recording,
    config: DiscrepancyConfig | None = None,
    known: Sequence[Effect] = (),
) -> LoneLog:
    """The cost of a recording of one repeat without commands, all effects in its replay, at neutral.

    known: effects that the base has already; their parameters are in `base`.
    Raises ValueError for repeats and for commands, see `lone_log`.
    """
    config = config or DiscrepancyConfig()
    whole = joined(restrained(base, config.selection.nuisance_bound), effects)
    return lone_log(ready(scene), whole, recording, config.compare, [*known, *effects])


def single_case(
    log: LoneLog,
    base: Space,
    effects: Sequence[Effect],
    test: LoneLog | None = None,
    config: DiscrepancyConfig | None = None,
    start: np.ndarray | None = None,
) -> Case:
    """A case from one log, or from two of which the second is test data, with its own torque offsets.

    The last third of the log is test data, or a second log is.  What comes before is cut into blocks that train and
    validate in turns.  In turns, because a log holds its motion once or twice: a base model fitted to one half of it
    misses what only the other half moves, and that would look like an effect.  So the validation blocks tell an effect
    from noise and not from another form of it; other motions are for what is test data.

    start: [D] where fits begin, fitted to this motion before; the prior's mean unless given.
    Raises ValueError where the log is too short for its residual's correlation time.
    """
    config = config or DiscrepancyConfig()
    clock = log.clock
    share = 1.0 if test is not None else config.blocks.fitted_share
    end = clock[-1] + 1e-6 if test is not None else clock[0] + share * (clock[-1] - clock[0])
    deviation, length = noise_of(log, base, effects, end, config, start)
    train, validation = (
        _blocks(log.part(f"{log.comparisons[0].name}, {which}"), deviation, part, config)
        for which, part in zip(
            ("every other block", "the blocks between"),
            interleaved(clock, clock[0], end, length, 2, share),
            strict=True,
        )
    )
    own = [] if test is None else per_recording_nuisances(base)  # another day's; the rest of the same log has the same
    rest = log.part(f"{log.comparisons[0].name}, last third") if test is None else test
    judged = _blocks(
        replace(rest, space=unbounded(rest.space, own)) if own else rest,
        deviation[[log.columns.index(c) for c in rest.columns]],
        fewest_blocks(rest.clock, end if test is None else rest.clock[0]),
        config,
    )
    if own:
        judged = judged.with_nuisances(own)
    base = restrained(base, config.selection.nuisance_bound)
    return Case(train, validation, judged, base, tuple(effects), config)


def base_model(
    case: Case, start: np.ndarray | None = None, progress: Callable[[RefineProgress], None] | None = None
) -> FittedModel:
    """The base parameters of a case in blocks fitted, from the prior's mean unless a start [D] is given.

    Inverse dynamics is smooth in them, so one start and no search will do.
    """
    start = case.full_space.mean if start is None else start
    return refit(case.train, case.base, (), start[None], case.config.refine, progress=progress)


def noise_of(
    log: LoneLog,
    base: Space,
    effects: Sequence[Effect],
    end: float,
    config: DiscrepancyConfig,
    start: np.ndarray | None,
) -> tuple[np.ndarray, float]:
    """Deviation [C] to state as noise, and length [s] of the blocks, from what lies before `end`.

    One recording does not tell its noise.  What is stated, and sets the blocks' length, is the smallest residual that
    an extended model leaves, the base and up to `max_effects` candidates chosen and fitted linearly, where that is less
    than a fifth of what the base leaves (in squares, `BlocksConfig.noise_share`); else what the base leaves.  The fifth
    is there because the best of many candidates takes noise too, and what it leaves is correlated for too short a time.
    So with something missing that the library explains in part only, noise is stated too large and blocks are long:
    intervals are wide and less is named.  A discrepancy in these units is no absolute size, but ratios of
    discrepancies are free of the unit.
    """
    inside = log.clock < end
    block = fewest_blocks(log.clock[inside], log.clock[0])
    block = np.r_[block, np.full(len(log.clock) - len(block), OUTSIDE)]
    if start is None:  # what the prior's mean leaves is no noise
        start = _rough_fit(log, base, effects, log.space.mean, block, config)[1].values
    case, model, deviation = _rough_fit(log, base, effects, start, block, config)
    found = score_test(case.train, model, directions_of(candidates(effects)), config.seed)
    whole = model.residuals.mean(axis=0)
    least = _least(found, whole, log.space, config)
    noise = least if least @ least < config.blocks.noise_share * (whole @ whole) else whole
    left = (noise.reshape(len(deviation), -1).T * deviation)[inside]
    rate = config.compare.noise.rate
    return stated_deviation(left, log.moves[inside], rate), block_length(left, config.blocks, rate)


def _rough_fit(
    log: LoneLog,
    base: Space,
    effects: Sequence[Effect],
    values: np.ndarray,
    block: np.ndarray,
    config: DiscrepancyConfig,
) -> tuple[Case, FittedModel, np.ndarray]:
    """The base fitted with the noise [C] stated that `values` [D] leave."""
    noise, inside = config.compare.noise, block >= 0
    left = stated_deviation(log.residual_torque(values)[inside], log.moves[inside], noise.rate)
    deviation = np.maximum(left, least_noise("torque", log.measured, noise))
    rows = _blocks(log, deviation, block, config)
    case = Case(rows, rows, None, base, tuple(effects), config)
    return case, base_model(case, values), deviation


def _least(found: ScoreTest, left: np.ndarray, space: Space, config: DiscrepancyConfig) -> np.ndarray:
    """[M] what the best `max_effects` candidates leave of residuals `left` [M], one after the other, linearly.

    One that takes less than an effect must is left out: it would take noise.
    """
    for _ in range(config.max_effects):
        best = proposals(found, left[None], space)[0]
        if best.explained < config.selection.least_gain:
            break
        keys = {part.shaped_key for part in best.parts}
        rows = [k for k, d in enumerate(found.directions) if d.candidate.shaped_key in keys]
        taken, _ = np.linalg.qr(found.sensitivities[rows].T)
        left = left - taken @ (taken.T @ left)
        found = replace(found, sensitivities=found.sensitivities - (found.sensitivities @ taken) @ taken.T)
    return left


def _blocks(log: LoneLog, deviation: np.ndarray, block: np.ndarray, config: DiscrepancyConfig) -> ResidualSet:
    return block_residual_set(log.with_noise(deviation, block >= 0), block, config)
