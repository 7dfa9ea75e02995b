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

# Candidate steps of Levenberg-Marquardt where a row of a batch is expensive: one-step fits and long logs.
FEWER_TRIALS = {"dampings": (1e-2, 1e0, 1e1, 1e3), "lengths": (1.0,)}
CONVERGE_ITERATIONS = 60  # of a fit that must converge; a model that lacks an effect converges slowly


@dataclass(frozen=True)
class SelectionConfig:
    """Thresholds that decide which effects are named.  U is the discrepancy (`statistics.discrepancy`).

    The score test and the base model:
        significance: p-value of the score test below which something is missing.
        nuisance_bound: prior deviations from the mean within which a nuisance is fitted.  A larger deviation is
            attributed to an effect.  (Without the bound a forearm eleven deviations too heavy absorbed a payload of
            0.4 kg.)
        prior_slack: factor that widens the priors of the base parameters when sensitivities are projected.  With a
            factor of 1, 6 of 200 hinges with nothing missing had p < 0.01.
        sensitivity_step: prior deviations of a coefficient, from neutral, for its sensitivity: large against solver
            noise, small enough to be linear.
        collinear: absolute cosine of two sensitivities above which both candidates are refitted.

    The validation test of an effect:
        confirmation: p-value of the gain on the validation recording below which the gain is significant.
        least_gain: share of U on the validation recording by which the first effect must reduce it.
        least_further_gain: share of the remaining U by which each further effect must reduce it.  It is larger than
            `least_gain`, because a wrong form of the first effect also leaves a discrepancy.
        least_share: share of the base model's U by which each further effect must reduce U.
        stability: share of the resamples in which the effect, or one indistinguishable from it, must be best.
        resamples: number of resamples of the repeats or blocks.
        interval_level: level of the coefficients' intervals; an effect whose interval holds zero is rejected.
        bound_margin: distance from a bound, as a share of the parameter's range, within which a value is at its bound.

    Indistinguishable and simpler models:
        equivalence_factor: ratio of two models' U beyond the discretisation error up to which the models are
            indistinguishable.
        equivalence_doubt: share of the resamples above which two models are indistinguishable if the worse one is
            better in so many.
        equal_fit: share of the base model's U on the training recording below which a difference there is ignored.
        simplest_factor: ratio to the best model's U beyond the discretisation error up to which a model with fewer
            parameters is preferred.
        simplest_share: share of the base model's U that is added to that limit.
        generality_factor: ratio to an effect's U beyond the discretisation error below which the U of a more general
            effect must lie.  (The more general one holds the other as a special case.)

    The conclusion:
        open_share: remaining share of U above which the effects explain the discrepancy only partly.
        minimum_closed: share of U beyond the discretisation error that a model with an unexplained remainder must close
            on every held-out recording.  If it closes less, its effects are hints.  0.4 turned 9 false names and one
            right one of the blind run d1a4e04 into hints.
        mostly_explained: explained share below which the sentence says that most of it is not in the library.
        shape_interval_share: width of a shape parameter's interval, as a share of its range, above which a value at a
            bound is no sign of a wrong form.
        false_discovery_rate: of the cells of the residual maps (Benjamini and Hochberg).
    """

    significance: float = 0.01
    nuisance_bound: float = 3.0
    prior_slack: float = 3.0
    sensitivity_step: float = 0.3
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
        shares = [n for n in self.__dataclass_fields__ if n not in (*above_one, "resamples", "sensitivity_step")]
        check_fields(
            self,
            **dict.fromkeys(above_one, partial(number, least=1)),
            **dict.fromkeys(shares, partial(number, least=0, most=1)),
            resamples=partial(whole, least=1),
            sensitivity_step=partial(number, above=0, most=1),
        )


@dataclass(frozen=True)
class BlocksConfig:
    """How a log without repeats is cut into blocks of time, and how its noise is estimated.

    correlation_times: least length of a block, in correlation times of the residual (the median over its columns).
    shortest: s, least length of a block; the low-pass filter alone reaches 0.2 s to either side.
    fitted_share: share of the log that is training and validation data; the rest is test data.
    noise_share: share of the base model's squared residual in a column.  If the best candidates leave less than it,
        their residual is taken for noise, otherwise the base model's.  (The best of many candidates fits noise too, up
        to three quarters of slow noise in 40 synthetic door logs.)
    refit_share: share of a column's squared residual that a candidate must explain linearly to be refitted for the
        noise estimate.
    least_gain: share of U, noise included, by which a first effect must reduce it if the score test finds nothing more
        beside it.  It takes the place of `SelectionConfig.least_gain` there.  (An arm's log with nothing hidden and
        p = 0.002: 5 %; two logs with a hidden effect: 10 and 13 %.)
    cross_validated: number of models in a step that are tested by two-fold cross-validation if the validation blocks
        alone do not confirm them.
    equivalence_factor: as `SelectionConfig.equivalence_factor`; closer to one, since U of a block includes the noise.
    prior_slack: as `SelectionConfig.prior_slack`.  A residual that the priors hold back is alike in every block and
        would look like an effect.  (p < 0.2 with nothing missing: 8 of 40 Panda logs, 19 with a factor of 1.)
    least_test: least number of windows, or stretches of whole motions, that are kept as test data.
    start_draws: number of draws from the prior that are tried as starts of a base fit of windows.
    best_draws: number of the best of them that the fit starts from, beside the prior's mean.
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
    least_test: int = 4
    start_draws: int = 31
    best_draws: int = 1

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("correlation_times", "shortest"), partial(number, least=0)),
            **dict.fromkeys(("equivalence_factor", "prior_slack"), partial(number, least=1)),
            **dict.fromkeys(("cross_validated", "start_draws", "best_draws"), partial(whole, least=0)),
            least_test=partial(whole, least=1),
            **dict.fromkeys(
                ("fitted_share", "noise_share", "refit_share", "least_gain"), partial(number, least=0, most=1)
            ),
        )


@dataclass(frozen=True)
class DiscrepancyConfig:
    """Settings of the search for missing effects.

    Attributes:
        search: CMA-ES of the base fit.
        refine: refinement of the base fit.
        refit: refinement of every model with effects.
        one_step: the single Levenberg-Marquardt step of a candidate.
        polish: refinement of the selected model, with slopes over the width of its posterior.  Its intervals are
            reported.
        one_step_fits: number of candidates that get one Levenberg-Marquardt step in each selection step.
        one_step_shares: shares of the coefficients at which a candidate's sensitivity was taken.  Its step also begins
            at the best of them, since an effect with a threshold may have no slope at neutral.
        full_refits: number of these that are refitted in full, the best first.
        sure_refits: number of full refits for the first candidates of the ranking, whatever their one-step fits
            reached.  One step may miss a strong effect.
        pair_refits: number of pairs of effects that are refitted.
        max_effects: largest number of effects in a model.
        budget_minutes: for all refits, None for no limit.  Each selection step refits at least one candidate.
        selection: thresholds that decide which effects are named.
        identifiability: thresholds that decide the width of a fit's posterior.
        blocks: thresholds for logs that are cut in time.
        replay: how commanded logs with few repeats are replayed.  "windows": in windows, each from its measured state.
            "whole": from the beginning of the motion.  "auto": whole if a servo holds every joint.  (A window would
            begin at the measured position there, and friction that keeps a joint off its command would not show.)
        windows: how these logs are cut.
        compare: how simulation and measurement are compared.
        channels: names of the compared channels, as `IdentifyConfig.channels`; torques alone for logs without commands.
        seed: of sign flips and resamples.

    Raises:
        ValueError: a setting is of the wrong type or out of its range.
    """

    search: CmaConfig = field(default_factory=lambda: CmaConfig(parents=None, generations=20))
    refine: RefineConfig = field(default_factory=lambda: RefineConfig(iterations=CONVERGE_ITERATIONS))
    # A joint that sticks makes slopes of little use: one iteration that gains nothing says too little.
    refit: RefineConfig = field(
        default_factory=lambda: RefineConfig(iterations=20, basin_hops=0, spreads=0, patience=2)
    )
    one_step: LevenbergMarquardtConfig = field(
        default_factory=lambda: replace(LevenbergMarquardtConfig(), **FEWER_TRIALS)
    )
    polish: RefineConfig = field(default_factory=lambda: RefineConfig(iterations=12, basin_hops=0))
    one_step_fits: int = 12
    one_step_shares: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125)
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
            one_step_shares=several(partial(number, above=0, most=1)),
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
