"""Which parameters a motion makes identifiable, before any fit, from the sensitivities of its replay.

The replay is differentiated at the initial means.  Since these may be far from the robot, a few Levenberg-Marquardt
steps follow, and the replay is differentiated again.  The last residuals and Jacobian give the width of a Gaussian by
the rules of a fit (`posterior`), and with it which parameters are identifiable.
Source: Gautier and Khalil, Exciting trajectories for the identification of base inertial parameters, IJRR 1992.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import numpy as np

from droid_jax.arguments import check_fields, instance, number, several, whole
from droid_jax.cost.channels import check_channels, chosen_channels
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.residuals import CompareConfig, Comparison, with_estimated_noise
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.holdout import BeginningConfig, beginning
from droid_jax.identify.identifiability import Identifiability, IdentifiabilityConfig, identifiability, posterior
from droid_jax.identify.levenberg_marquardt import (
    LevenbergMarquardtConfig,
    curvature,
    damped_steps,
    off_bounds,
    penalised,
)
from droid_jax.identify.multistart import Refined
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.c_reference import why_no_path_in_c, why_not_in_c
from droid_jax.simulate.replay import replayed_torque


@dataclass(frozen=True)
class ProposalConfig:
    """Settings of the motions that are proposed (`identify.additions`); all are design choices.

    seconds: duration of each motion.
    rate: Hz, of a motion beside a recording without commands.
    ramp, step, swing, hold: rad, largest displacement of a slow ramp, steps, a chirp and a hold elsewhere.  For a slide
      they are factors on its own motion in the recording.
    chirp: Hz, first and last frequency of a chirp.
    ease: s, in which a chirp begins and ends.
    torque_share: share of a servo's torque limit that a step may demand at once.
    range_share: share of the distance to the end of a joint's range that a motion may use.
    margin: share of the limit of identifiability that a posterior width should reach.
    least_gain: decrease of the summed logarithms of widths below which a motion is not added.
    most: largest number of motions.
    """

    seconds: float = 6.0
    rate: float = 100.0
    ramp: float = 0.6
    step: float = 0.3
    swing: float = 0.1
    hold: float = 0.8
    chirp: tuple[float, ...] = (0.3, 2.0)
    ease: float = 0.5
    torque_share: float = 0.5
    range_share: float = 0.9
    margin: float = 0.8
    least_gain: float = 0.05
    most: int = 8

    def __post_init__(self) -> None:
        above, share = partial(number, above=0), partial(number, above=0, most=1)
        check_fields(
            self,
            **dict.fromkeys(("seconds", "rate", "ramp", "step", "swing", "hold", "ease"), above),
            **dict.fromkeys(("torque_share", "range_share", "margin"), share),
            chirp=several(above, 2),
            least_gain=partial(number, least=0),
            most=partial(whole, least=0),
        )
        if self.chirp[0] == self.chirp[1]:
            raise ValueError(f"chirp must have two different frequencies, got {self.chirp}")


@dataclass(frozen=True)
class ExcitationConfig:
    """Settings of the sensitivities, and of when a parameter counts as identifiable.

    seconds: of each recording that are replayed; the information is scaled with the length of a longer one.
    beginning_rule: when a recording is longer, and how much of it is replayed.
    step: half-width of the differences, search units.
    steps: largest number of Levenberg-Marquardt steps from the initial means.
    worth: share of the objective; a step that lowers it by less is the last.
    longest_step: largest component of a step, search units.
    dampings: of the candidate steps, shares of the curvature's diagonal.
    lengths: factors on each full step; with `dampings` one block of rows on a CPU in MJX.
    compare: how simulation and measurement are compared.
    identifiability: when a parameter counts as identifiable.
    proposal: the motions that are proposed for parameters that are not.
    """

    seconds: float = 20.0
    beginning_rule: BeginningConfig = field(default_factory=BeginningConfig)
    step: float = 0.1
    steps: int = 12
    worth: float = 0.05
    longest_step: float = 2.0
    dampings: tuple[float, ...] = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0, 1000.0)
    lengths: tuple[float, ...] = (1.0, 0.5, 0.2)
    compare: CompareConfig = field(default_factory=CompareConfig)
    identifiability: IdentifiabilityConfig = field(default_factory=IdentifiabilityConfig)
    proposal: ProposalConfig = field(default_factory=ProposalConfig)

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("seconds", "step", "longest_step"), partial(number, above=0)),
            beginning_rule=partial(instance, kind=BeginningConfig),
            worth=partial(number, least=0, below=1),
            steps=partial(whole, least=0),
            dampings=several(partial(number, above=0)),
            lengths=several(partial(number, above=0, most=1)),
            compare=partial(instance, kind=CompareConfig),
            identifiability=partial(instance, kind=IdentifiabilityConfig),
            proposal=partial(instance, kind=ProposalConfig),
        )


@dataclass(frozen=True, eq=False)
class Excitation:
    """The information in recordings about the parameters of a space.

    values: [D] at which the replay was differentiated.
    information: [D, D] of the data, per squared search unit, by the fit's rule of the width.
    widening: [D] factors by which that rule widens deviations.
    identifiability: of each parameter.
    noise: channel -> joint -> standard deviation of white noise at the noise model's coarse rate.
    config: settings, with the channels that were compared.  engine: of the replays.  seconds: duration of the analysis.
    """

    space: Space
    values: np.ndarray
    information: np.ndarray
    widening: np.ndarray
    identifiability: tuple[Identifiability, ...]
    noise: Mapping[str, Mapping[str, float]]
    config: ExcitationConfig
    engine: str
    seconds: float

    @property
    def open(self) -> tuple[str, ...]:
        """Names of the parameters of interest that are not identifiable."""
        return tuple(
            verdict.name
            for verdict, p in zip(self.identifiability, self.space.parameters, strict=True)
            if not (verdict.identifiable or p.nuisance)
        )


def excitation(
    scene: Scene, space: Space, recordings: Sequence[Recording], config: ExcitationConfig | None = None
) -> Excitation:
    """Return which parameters are identifiable from recordings that are fitted together.

    Args:
        scene: with its nominal values.
        space: parameters and nuisances, D in all; their means are the nominal values.
        recordings: valid ones, of the same robot.
        config: settings; None for the defaults.

    Returns:
        The information in the recordings, and the verdict for each parameter.

    Raises:
        ValueError: recordings or parameters that do not fit the scene, or means that cannot be simulated.
    """
    began = time.monotonic()
    config = ExcitationConfig() if config is None else config
    chosen = chosen_channels(scene, recordings, None, config.compare)
    if chosen:
        config = replace(config, compare=replace(config.compare, channels=dict.fromkeys(chosen, 1.0)))
    check_channels(recordings, config.compare.channels)
    short = [beginning(recording, config.seconds, config.beginning_rule) for recording in recordings]
    engine = engine_for(scene, space, short)
    with silent():
        cost = make_cost(scene, space, short, engine=engine, config=config.compare, check=False)
    refined, cost = _stepped(cost, space, config, engine)
    gaussian = posterior(refined, cost.comparisons, config.identifiability)
    length_ratio = sum(r.duration for r in recordings) / sum(s.duration for s in short)
    information = length_ratio * (np.linalg.inv(gaussian.cov) - np.eye(len(space)))
    gauss_newton = np.linalg.inv(refined.jacobian.T @ refined.jacobian + np.eye(len(space)))
    return Excitation(
        space=space,
        values=refined.best,
        information=information,
        widening=np.sqrt(np.maximum(1.0, np.diag(gaussian.cov) / np.diag(gauss_newton))),
        identifiability=identifiability_of(space, information, config.identifiability),
        noise=_noise_of(scene, cost.comparisons),
        config=config,
        engine=engine,
        seconds=time.monotonic() - began,
    )


def identifiability_of(
    space: Space, information: np.ndarray, config: IdentifiabilityConfig
) -> tuple[Identifiability, ...]:
    """Return the verdict for each parameter from data of an information [D, D] and the stated prior.

    information: per squared search unit.
    """
    cov = np.linalg.inv(information + np.eye(len(space)))
    gaussian = Gaussian(space, np.zeros(len(space)), 0.5 * (cov + cov.T), "sensitivities and the stated prior")
    return identifiability(gaussian, np.ones(len(space)), config)


def engine_for(scene: Scene, space: Space, recordings: Sequence[Recording]) -> str:
    """Return "mujoco" if plain C can replay the recordings, since it needs no compilation; else "mjx"."""
    for recording in recordings:
        own = variant_scene(scene, recording.variant, recording.name)
        if recording.command.size and (scene.has_contacts or why_not_in_c(own, space, replayed_torque(recording), ())):
            return "mjx"
        if not recording.command.size and why_no_path_in_c(space, recording.torque, ()):
            return "mjx"
    return "mujoco"


@contextmanager
def silent() -> Iterator[None]:
    """Suppress the warnings of a replay, which `check` shows as findings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def slopes(cost: Cost, space: Space, x: np.ndarray, step: float) -> tuple[tuple[Rollout, ...], np.ndarray]:
    """Return replays for a Jacobian by one-sided differences, and the steps [D].

    Row 0 is at search coordinates x [D], and rows 1 to D are a step further along one coordinate each.  A step is
    negative if the upper bound is closer.
    """
    steps = np.where(x + step <= space.to_search(space.high), step, -step)
    return cost.rollouts(space.from_search(np.vstack([x, x + np.diag(steps)]))), steps


def jacobian_of(residuals: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the Jacobian [M, D] of residuals [1 + D, M] of `slopes`; 0 where a replay blew up."""
    return np.nan_to_num((residuals[1:] - residuals[0]) / steps[:, None]).T


def _stepped(cost: Cost, space: Space, config: ExcitationConfig, engine: str) -> tuple[Refined, Cost]:
    """The result of a few Levenberg-Marquardt steps from the means, and the cost with the noise estimated there.

    The steps use the noise that is known before a fit.  Their residuals then give the noise of single repeats.
    """
    x, prior = space.to_search(space.mean), np.where(space.nuisance, 1.0, LevenbergMarquardtConfig().main_prior)
    low, high = space.to_search(space.low), space.to_search(space.high)
    count = 0
    while True:
        rollouts, steps = slopes(cost, space, x, config.step)
        first = [jax.tree.map(lambda a: a[0], rollout) for rollout in rollouts]
        if not all(bool(np.all(rollout.finite)) for rollout in first):
            raise ValueError("the simulation blows up at the parameters' initial means: shorten the time step")
        residuals = cost.whitened_of(rollouts)
        now = penalised(x[None], np.asarray(residuals[:1], np.float64), prior)[0]
        jacobian = jacobian_of(residuals, steps)
        slope = jacobian.T @ residuals[0] + x / prior**2
        free = off_bounds(x, slope, low, high)
        problem = curvature(jacobian, prior), slope, free, config.dampings
        # A block holds all lengths.  C replays row by row, so shorter steps follow only where longer ones fail.
        batches = [config.lengths] if engine == "mjx" else [(length,) for length in config.lengths]
        better = None
        for lengths in batches if count < config.steps else ():
            candidates = np.clip(x + damped_steps(*problem, lengths, config.longest_step), low, high)
            residual = np.asarray(cost.whitened(space.from_search(candidates)), np.float64)
            objective = penalised(candidates, residual, prior)
            if np.min(objective) < (1 - config.worth) * now:
                better = candidates[int(np.argmin(objective))]
                break
        if better is None:
            break
        x, count = better, count + 1
    cost = cost.compared_by(with_estimated_noise(cost.comparisons, first))
    residuals = cost.whitened_of(rollouts)
    objective = float(penalised(x[None], np.asarray(residuals[:1], np.float64), prior)[0])
    refined = Refined(
        space=space, x=x, best=space.from_search(x), objective=objective, residual=residuals[0],
        jacobian=jacobian_of(residuals, steps), prior=prior, starts=np.array([objective]),
        evaluations=(count + 1) * (len(x) + 1), iterations=count, converged=False,
    )  # fmt: skip
    return refined, cost


def _noise_of(scene: Scene, comparisons: Sequence[Comparison]) -> dict[str, dict[str, float]]:
    """Channel -> joint -> standard deviation of white noise equivalent to that of the repeats' mean.

    It is the smallest one over the recordings.  A whitener is triangular, so the product of its diagonal is the
    determinant, which the equivalent white noise shares.
    """
    out: dict[str, dict[str, float]] = {}
    for channel in (c for comparison in comparisons for c in comparison.channels):
        of_channel = out.setdefault(channel.name, {})
        for diagonal, column in zip(np.abs(channel.noise.weight.T), channel.columns.tolist(), strict=True):
            weighted = diagonal[diagonal > 0]
            deviation = float(np.exp(-np.mean(np.log(weighted)))) if weighted.size else np.inf
            joint = scene.joints[column] if column < len(scene.joints) else str(scene.object_joint)
            of_channel[joint] = min(deviation, of_channel.get(joint, np.inf))
    return out
