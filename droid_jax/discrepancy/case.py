"""What a search for a missing effect works on: the data of each demonstration and what may be free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from droid_jax.arguments import check_fields, instance, number, optional, whole
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.discrepancy.refit import REFIT
from droid_jax.discrepancy.residual_set import ResidualSet, residual_set
from droid_jax.discrepancy.sign_flips import FEWEST_REPEATS
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.search import SearchConfig
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import joined, ready
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

SETTLED = 60  # iterations of the base fit at most: where something is missing it takes longer
BEYOND = 3.0  # prior deviations of a nuisance from which on it is an effect
FAR = 1e4  # prior deviations that no sensor is off


@dataclass(frozen=True)
class DiscrepancyConfig:
    """Settings of the search for a missing effect.

    search, refine: of the base fit.  refit: of every extended model.
    one_step_fits: candidates that get one Levenberg-Marquardt step in each selection step; full_refits: the best of
    these, refitted in full.  max_effects.  budget_minutes: for all refits, None for no limit; at least one candidate of
    a selection step is always tried.
    minimum_closed: share of U beyond the floor that a model must close on every held-out recording for its effects to
    be named beside an unexplained remainder; with less they are hints.  0.4 turned 9 false names and one right one of
    the blind run d1a4e04 into hints (docs/discrepancy-search.md).
    compare: how simulation and measurement are compared.  seed: of flips and resamples.
    """

    search: SearchConfig = field(default_factory=lambda: SearchConfig(parents=None, generations=20))
    refine: RefineConfig = field(default_factory=lambda: RefineConfig(iterations=SETTLED))
    refit: RefineConfig = REFIT
    one_step_fits: int = 12
    full_refits: int = 6
    max_effects: int = 3
    budget_minutes: float | None = None
    minimum_closed: float = 0.4
    compare: CompareConfig = field(default_factory=CompareConfig)
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("one_step_fits", "full_refits", "max_effects"), partial(whole, least=1)),
            **dict.fromkeys(("refine", "refit"), partial(instance, kind=RefineConfig)),
            search=partial(instance, kind=SearchConfig),
            budget_minutes=optional(partial(number, least=0)),
            minimum_closed=partial(number, least=0, most=1),
            compare=partial(instance, kind=CompareConfig),
            seed=partial(whole, least=0),
        )
        if set(self.compare.channels) != {"torque"}:
            names = ", ".join(self.compare.channels)
            raise ValueError(f"a search for missing effects compares torques alone, got the channels {names}")


@dataclass(frozen=True, eq=False)
class Case:
    """What every stage needs: the data of each demonstration and what may be free."""

    train: ResidualSet
    validation: ResidualSet
    test: ResidualSet | None  # opened once, at the end
    base: Space
    effects: tuple[Effect, ...]
    config: DiscrepancyConfig

    @property
    def full_space(self) -> Space:
        """Base parameters and all effects'."""
        return self.train.cost.space

    @property
    def held_sets(self) -> dict[str, ResidualSet]:
        """Role -> data: "train", "validation" and, where there is one, "test"."""
        roles = {"train": self.train, "validation": self.validation, "test": self.test}
        return {role: e for role, e in roles.items() if e is not None}

    def against(self, recordings: Mapping[str, Recording]) -> Case:
        """The same compiled replays and other repeats, by role.

        Raises ValueError unless they have the same commands on the same clock (see `Cost.against`).
        """
        costs = [e.cost.against([recordings[role]]) for role, e in self.held_sets.items()]
        return _case(costs, self.base, self.effects, self.config)

    @property
    def minimum_sizes(self) -> dict[str, float]:
        """Amplitude -> size worth naming."""
        return {a: e.minimum_size for e in self.effects for amplitudes in e.locations.values() for a in amplitudes}

    @property
    def natural_bounds(self) -> frozenset[str]:
        """Amplitudes whose bounds are where nature ends, not where the search does."""
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
    """One compiled replay per demonstration, all effects in it, at neutral.

    train: parameters are fitted to it.  validation: moves differently; effects are chosen on it.  test:
    judged on once, when everything is decided.
    Raises ValueError for too few repeats: with fewer than eight, no flip of signs could ever be
    significant.
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
    base = restrained(base)
    whole = joined(base, effects)
    spaces = [whole, *[unbounded(whole, per_recording_nuisances(base))] * (len(recordings) - 1)]
    made = zip(recordings, spaces, strict=True)
    costs = [make_cost(scene, space, [r], config=config.compare, effects=effects, check=False) for r, space in made]
    return _case(costs, base, tuple(effects), config)


def _case(costs: Sequence[Cost], base: Space, effects: tuple[Effect, ...], config: DiscrepancyConfig) -> Case:
    train, *others = (residual_set(c) for c in costs)
    validation, *test = (e.with_nuisances(per_recording_nuisances(base)) for e in others)
    return Case(train, validation, test[0] if test else None, base, effects, config)


def per_recording_nuisances(base: Space) -> list[str]:
    """Nuisances that every recording has for itself: what a sensor shows at rest changes from day to day."""
    return [p.name for p in base.parameters if p.nuisance and p.name.startswith("torque_offset[")]


def unbounded(whole: Space, names: Sequence[str]) -> Space:
    """The space of a recording whose own nuisances `names` are solved for, however far off they are."""
    far = {n: FAR * whole[n].std for n in names}
    return Space(
        tuple(
            replace(p, low=p.mean - far[p.name], high=p.mean + far[p.name]) if p.name in far else p
            for p in whole.parameters
        )
    )


def restrained(base: Space) -> Space:
    """The base with every nuisance kept within BEYOND prior deviations.

    What stands that far off is no nuisance but something missing: a payload of 0.4 kg, say, was absorbed by a forearm
    eleven deviations too heavy and a shoulder seven too light.
    """

    def kept(p: Parameter) -> Parameter:
        if not p.nuisance:
            return p
        return replace(p, low=max(p.low, p.mean - BEYOND * p.std), high=min(p.high, p.mean + BEYOND * p.std))

    return Space(tuple(kept(p) for p in base.parameters))
