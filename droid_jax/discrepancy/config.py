"""Every threshold of the search for missing effects, with its unit, its meaning and its source."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

from droid_jax.arguments import check_fields, instance, number, one_of, optional, several, whole
from droid_jax.cost.channels import SIMULATED
from droid_jax.cost.residuals import CompareConfig
from droid_jax.identify.identifiability import IdentifiabilityConfig
from droid_jax.identify.levenberg_marquardt import LevenbergMarquardtConfig
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.search import CmaConfig
from droid_jax.simulate.windows import WindowConfig

# Where each row of a batch counts: in first steps that share one, and of long logs.
FEWER_TRIALS = {"dampings": (1e-2, 1e0, 1e1, 1e3), "lengths": (1.0,)}
CONVERGE_ITERATIONS = 60  # of a fit that must converge: where something is missing it takes longer


@dataclass(frozen=True)
class SelectionConfig:
    """What decides which effects are named.  U is the discrepancy (`statistics.discrepancy`).

    The score test and the base model:
        significance: p-value of the score test below which something is missing.
        nuisance_bound: prior deviations within which a nuisance is fitted; what lies further off is an effect (a
            payload of 0.4 kg was absorbed by a forearm eleven deviations too heavy).
        prior_slack: times its prior that a base parameter may move when sensitivities are projected.  With the priors
            unchanged 6 of 200 hinges with nothing missing had p < 0.01.
        collinear: absolute cosine of two sensitivities from which their candidates are both refitted.

    The validation test of an effect:
        confirmation: p-value of its gain on the validation recording, below which it is no chance.
        least_gain: share of U that the first effect must take away on the validation recording.
        least_further_gain: share of the remaining U that each further effect must take away: a wrong form of the first
            effect leaves something too.
        least_share: share of the base model's U that each further effect must take away.
        stability: share of the resamples in which the effect, or one indistinguishable from it, must be best.
        resamples: of the repeats.
        interval_level: of the coefficients' intervals; an interval that holds zero rejects.
        bound_margin: share of a parameter's range that counts as its bound.

    Indistinguishable and simpler models:
        equivalence_factor: times the U that the better of two models leaves beyond the discretisation error, up to
            which the other is indistinguishable from it.
        equivalence_doubt: share of the resamples in which the worse of two models must be better for the same.
        equal_fit: share of the base model's U on the training recording that is no difference there.
        simplest_factor: times the U that the best model leaves beyond the discretisation error, up to which a model
            with fewer parameters is preferred.
        simplest_share: share of the base model's U that is no difference for that.
        generality_factor: times the U that an effect leaves beyond the discretisation error, below which an effect
            that holds it as a special case must get.

    The conclusion:
        open_share: share of U left from which the effects explain it only partly.
        minimum_closed: share of U beyond the discretisation error that a model must close on every held-out recording
            for its effects to be named beside an unexplained remainder; with less they are hints.  0.4 turned 9 false
            names and one right one of the blind run d1a4e04 into hints.
        mostly_explained: share explained below which the sentence says that most of it is not in the library.
        shape_interval_share: of a shape parameter's range; where its interval is wider, its bound says nothing.
        false_discovery_rate: of the cells of the residual maps (Benjamini and Hochberg).
    """

    significance: float = 0.01
    nuisance_bound: float = 3.0
    prior_slack: float = 3.0
    collinear: float = 0.9
    confirmation: float = 0.05
    least_gain: float = 0.2
    least_further_gain: float = 0.4
    least_share: float = 0.05
    stability: float = 0.8
    resamples: int = 400
    interval_level: float = 0.9
    bound_margin: float = 0.02
    equivalence_factor: float = 3.0
    equivalence_doubt: float = 0.05
    equal_fit: float = 0.05
    simplest_factor: float = 1.25
    simplest_share: float = 0.01
    generality_factor: float = 0.9
    open_share: float = 0.1
    minimum_closed: float = 0.4
    mostly_explained: float = 0.5
    shape_interval_share: float = 0.5
    false_discovery_rate: float = 0.1

    def __post_init__(self) -> None:
        above_one = ("nuisance_bound", "prior_slack", "equivalence_factor", "simplest_factor")
        shares = [n for n in self.__dataclass_fields__ if n not in (*above_one, "resamples")]
        check_fields(
            self,
            **dict.fromkeys(above_one, partial(number, least=1)),
            **dict.fromkeys(shares, partial(number, least=0, most=1)),
            resamples=partial(whole, least=1),
        )


@dataclass(frozen=True)
class BlocksConfig:
    """How one recording without repeats is cut into blocks of time, and what counts as its noise.

    correlation_times: of the residual (the median over its columns) that a block lasts at least.
    shortest: s, of a block; the low-pass filter alone reaches 0.2 s to either side.
    fitted_share: of a recording whose remaining part is test data.
    noise_share: share of the base model's squared residual below which what the best candidates leave counts as noise;
        the best of many candidates takes noise too, of slow noise up to three quarters (40 synthetic door logs).
    refit_share: share of a column's squared residual that a candidate must take linearly to be fitted in full for that.
    least_gain: share of U, noise included, that a first effect must take where it leaves nothing to find, in place of
        `SelectionConfig.least_gain` (an arm's log with nothing hidden and p = 0.002: 5 %; two with: 10 and 13 %).
    cross_validated: models of a step whose gain is tested with both halves of the log in turns, where the validation
        blocks alone do not confirm it.
    equivalence_factor: as `SelectionConfig.equivalence_factor`; closer to one, since U of a block holds the noise.
    prior_slack: as `SelectionConfig.prior_slack`; what priors hold back is in every block alike and would look like an
        effect (below p = 0.2: 8 of 40 Panda logs, 19 with the priors unchanged).
    """

    correlation_times: float = 1.5
    shortest: float = 0.5
    fitted_share: float = 2 / 3
    noise_share: float = 0.2
    refit_share: float = 0.3
    least_gain: float = 0.08
    cross_validated: int = 2
    equivalence_factor: float = 1.5
    prior_slack: float = 30.0

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("correlation_times", "shortest"), partial(number, least=0)),
            **dict.fromkeys(("equivalence_factor", "prior_slack"), partial(number, least=1)),
            cross_validated=partial(whole, least=0),
            **dict.fromkeys(
                ("fitted_share", "noise_share", "refit_share", "least_gain"), partial(number, least=0, most=1)
            ),
        )


@dataclass(frozen=True)
class DiscrepancyConfig:
    """Settings of the search for a missing effect.

    Attributes:
        search: of the base fit.
        refine: of the base fit.
        refit: of every extended model.
        one_step: of the one step that candidates get.
        polish: of the selected model, with slopes over the width of its posterior: its intervals are reported.
        one_step_fits: candidates that get one Levenberg-Marquardt step in each selection step.
        full_refits: the best of these, refitted in full; among them
        sure_refits: the first of the ranking, whatever their one step did: a few trials may miss a strong effect.
        pair_refits: pairs of effects refitted.
        max_effects: in a model.
        budget_minutes: for all refits, None for no limit; at least one candidate of a selection step is always tried.
        selection: thresholds that decide which effects are named.
        identifiability: what decides the width of a fit's posterior.
        blocks: thresholds for logs that are cut in time.
        replay: of commanded logs with few repeats.  "windows", each from its own measured state; "whole", the motions
            from their beginnings; "auto", whole where a servo holds every joint.  There a window would begin where the
            robot was measured, and friction that holds it off its command would not show.
        windows: how these logs are cut.
        compare: how simulation and measurement are compared.
        channels: measured ones to compare, as `IdentifyConfig.channels`; of logs without commands torques alone.
        seed: of sign flips and resamples.

    Raises:
        ValueError: a setting is of the wrong type or out of its range.
    """

    search: CmaConfig = field(default_factory=lambda: CmaConfig(parents=None, generations=20))
    refine: RefineConfig = field(default_factory=lambda: RefineConfig(iterations=CONVERGE_ITERATIONS))
    refit: RefineConfig = field(default_factory=lambda: RefineConfig(iterations=20, basin_hops=0, spreads=0))
    one_step: LevenbergMarquardtConfig = field(
        default_factory=lambda: replace(LevenbergMarquardtConfig(), **FEWER_TRIALS, chords=3)
    )
    polish: RefineConfig = field(default_factory=lambda: RefineConfig(iterations=12, basin_hops=0))
    one_step_fits: int = 12
    full_refits: int = 6
    sure_refits: int = 2
    pair_refits: int = 4
    max_effects: int = 3
    budget_minutes: float | None = None
    selection: SelectionConfig = field(default_factory=SelectionConfig)
    identifiability: IdentifiabilityConfig = field(default_factory=IdentifiabilityConfig)
    blocks: BlocksConfig = field(default_factory=BlocksConfig)
    replay: Literal["auto", "whole", "windows"] = "auto"
    windows: WindowConfig = field(default_factory=WindowConfig)
    compare: CompareConfig = field(default_factory=CompareConfig)
    channels: tuple[str, ...] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("one_step_fits", "full_refits", "pair_refits", "max_effects"), partial(whole, least=1)),
            sure_refits=partial(whole, least=0),
            **dict.fromkeys(("refine", "refit", "polish"), partial(instance, kind=RefineConfig)),
            search=partial(instance, kind=CmaConfig),
            one_step=partial(instance, kind=LevenbergMarquardtConfig),
            budget_minutes=optional(partial(number, least=0)),
            selection=partial(instance, kind=SelectionConfig),
            identifiability=partial(instance, kind=IdentifiabilityConfig),
            blocks=partial(instance, kind=BlocksConfig),
            replay=partial(one_of, valid=("auto", "whole", "windows")),
            windows=partial(instance, kind=WindowConfig),
            compare=partial(instance, kind=CompareConfig),
            channels=optional(several(partial(one_of, valid=SIMULATED))),
            seed=partial(whole, least=0),
        )
