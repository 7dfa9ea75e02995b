"""What a search works on: the training, validation and test recordings, the base parameters and the effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from droid_jax.arguments import instance
from droid_jax.cost.channels import check_channels, chosen_channels, in_noise_units
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.replay_cache import cached
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.residual_set import ResidualSet, residual_set
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import joined, ready
from droid_jax.model.parameters import Parameter, Role, Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import FEWEST_REPEATS

FAR = 1e4  # prior deviations that no sensor is off


@dataclass(frozen=True, eq=False)
class Case:
    """What every step needs.  train: parameters are fitted to it; validation: effects are selected on it; test: opened
    once, at the end.  base: the base parameters; effects: those that are asked about.
    start: [D] from where the base fit of a log begins, None: the prior's mean.  limits: what cannot be concluded from
    these recordings, beside `Split.limits`.
    """

    train: ResidualSet
    validation: ResidualSet
    test: ResidualSet | None
    base: Space
    effects: tuple[Effect, ...]
    config: DiscrepancyConfig
    start: np.ndarray | None = None
    limits: tuple[str, ...] = ()

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
    config = comparing(scene, recordings, config)
    scene = ready(scene)
    base = restrained(base, config.selection.nuisance_bound)
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


def restrained(base: Space, bound: float) -> Space:
    """The base with every nuisance kept within some prior deviations: what stands further off is an effect."""

    def kept(p: Parameter) -> Parameter:
        if not p.nuisance:
            return p
        return replace(p, low=max(p.low, p.mean - bound * p.std), high=min(p.high, p.mean + bound * p.std))

    return Space(tuple(kept(p) for p in base.parameters))
