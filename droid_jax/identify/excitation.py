"""Which parameters a motion can tell, before any fit: from the sensitivity of its replay.

The replay is differentiated at the initial means and, since these may be far from the robot, again where a few
Levenberg-Marquardt steps from there lead.  What the replay leaves there and its slopes are then judged by the rules of
a fit: the width of its Gaussian (`posterior`), and when a parameter is identifiable.
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

from droid_jax.arguments import check_fields, instance, number, whole
from droid_jax.cost.channels import check_channels, chosen_channels
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.residuals import CompareConfig, Comparison, restated
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.holdout import beginning
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

DAMPINGS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0, 1000.0)  # of the trial steps, as shares of the curvature
LENGTHS = (1.0, 0.5, 0.2)  # shares of a whole step: with the dampings one block of a CPU


@dataclass(frozen=True)
class ExcitationConfig:
    """What decides which parameters a motion can tell.

    seconds: of each recording that are replayed; what a longer one tells is taken to grow with its length.
    step: half-width of the differences, search units.
    steps: Levenberg-Marquardt steps from the initial means at most; they end where
    worth: one lowers the objective by no more than this share.
    longest_step: of each of their components, search units.
    compare: how simulation and measurement are compared.
    identifiability: when a parameter counts as identifiable.
    """

    seconds: float = 20.0
    step: float = 0.1
    steps: int = 12
    worth: float = 0.05
    longest_step: float = 2.0
    compare: CompareConfig = field(default_factory=CompareConfig)
    identifiability: IdentifiabilityConfig = field(default_factory=IdentifiabilityConfig)

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("seconds", "step", "longest_step"), partial(number, above=0)),
            worth=partial(number, least=0, below=1),
            steps=partial(whole, least=0),
            compare=partial(instance, kind=CompareConfig),
            identifiability=partial(instance, kind=IdentifiabilityConfig),
        )


@dataclass(frozen=True, eq=False)
class Excitation:
    """What recordings tell of the parameters of a space.

    values: [D] where the replay was differentiated.
    information: [D, D] of the data, per squared search unit, by the fit's rule of the width.
    widening: [D] factors by which that rule widens deviations.
    identifiability: of each parameter.
    noise: channel -> joint -> white deviation at the noise model's coarse rate.
    config: with the channels that were compared.  engine: that replayed.  seconds: that this took.
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
            t.name
            for t, p in zip(self.identifiability, self.space.parameters, strict=True)
            if not (t.identifiable or p.nuisance)
        )


def excitation(
    scene: Scene, space: Space, recordings: Sequence[Recording], config: ExcitationConfig | None = None
) -> Excitation:
    """Which parameters recordings can tell that are fitted together.

    Args:
        scene: with its nominal values.
        space: parameters and nuisances, D in all; their means are the nominal values.
        recordings: valid ones, of the same robot.
        config: settings; None for the defaults.

    Returns:
        What they tell.

    Raises:
        ValueError: recordings or parameters that do not fit the scene, or means that cannot be simulated.
    """
    began = time.monotonic()
    config = ExcitationConfig() if config is None else config
    chosen = chosen_channels(scene, recordings, None, config.compare)
    if chosen:
        config = replace(config, compare=replace(config.compare, channels=dict.fromkeys(chosen, 1.0)))
    check_channels(recordings, config.compare.channels)
    short = [beginning(recording, config.seconds) for recording in recordings]
    engine = engine_for(scene, space, short)
    with silent():
        cost = make_cost(scene, space, short, engine=engine, config=config.compare, check=False)
    refined, cost = _stepped(cost, space, config, engine)
    gaussian = posterior(refined, cost.comparisons, config.identifiability)
    longer = sum(r.duration for r in recordings) / sum(s.duration for s in short)
    known = np.linalg.inv(gaussian.cov) - np.eye(len(space))
    plain = np.linalg.inv(refined.jacobian.T @ refined.jacobian + np.eye(len(space)))
    information = longer * known
    return Excitation(
        space=space,
        values=refined.best,
        information=information,
        widening=np.sqrt(np.maximum(1.0, np.diag(gaussian.cov) / np.diag(plain))),
        identifiability=identifiability_of(space, information, config.identifiability),
        noise=_noise_of(scene, cost.comparisons),
        config=config,
        engine=engine,
        seconds=time.monotonic() - began,
    )


def identifiability_of(
    space: Space, information: np.ndarray, config: IdentifiabilityConfig
) -> tuple[Identifiability, ...]:
    """What data of an information [D, D], per squared search unit, tell of each parameter beside its stated prior."""
    cov = np.linalg.inv(information + np.eye(len(space)))
    gaussian = Gaussian(space, np.zeros(len(space)), 0.5 * (cov + cov.T), "sensitivity beside the stated prior")
    return identifiability(gaussian, np.ones(len(space)), config)


def engine_for(scene: Scene, space: Space, recordings: Sequence[Recording]) -> str:
    """Plain C where it can replay the recordings, which compiles nothing; else MJX."""
    contacts = scene.grip is not None or scene.model.npair
    for recording in recordings:
        own = variant_scene(scene, recording.variant)
        if recording.command.size and (contacts or why_not_in_c(own, space, recording.torque, ())):
            return "mjx"
        if not recording.command.size and why_no_path_in_c(own, space, recording.torque, ()):
            return "mjx"
    return "mujoco"


@contextmanager
def silent() -> Iterator[None]:
    """Without the warnings of a replay, which `check` shows as findings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def slopes(cost: Cost, space: Space, x: np.ndarray, step: float) -> tuple[tuple[Rollout, ...], np.ndarray]:
    """Replays at search coordinates x [D], row 0, and with each a step further, rows 1 to D; and the steps [D].

    A step goes down where a bound is in the way.
    """
    up = np.where(x + step <= space.to_search(space.high), step, -step)
    return cost.rollouts(space.from_search(np.vstack([x, x + np.diag(up)]))), up


def jacobian_of(residuals: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """[M, D] slopes from residuals [1 + D, M] of `slopes`; 0 where a replay failed."""
    return np.nan_to_num((residuals[1:] - residuals[0]) / steps[:, None]).T


def _stepped(cost: Cost, space: Space, config: ExcitationConfig, engine: str) -> tuple[Refined, Cost]:
    """Where a few Levenberg-Marquardt steps lead from the means, and the cost with its noise stated from there.

    The steps are taken in the noise that is known before a fit; what they leave then tells the noise of one repeat.
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
        steps_of = curvature(jacobian, prior), slope, free, DAMPINGS
        # A compiled block holds all lengths; in C, where each replay counts, shorter ones wait for the longer to fail.
        tried = [LENGTHS] if engine == "mjx" else [(length,) for length in LENGTHS]
        better = None
        for lengths in tried if count < config.steps else ():
            trials = np.clip(x + damped_steps(*steps_of, lengths, config.longest_step), low, high)
            reached = penalised(trials, np.asarray(cost.whitened(space.from_search(trials)), np.float64), prior)
            if np.min(reached) < (1 - config.worth) * now:
                better = trials[int(np.argmin(reached))]
                break
        if better is None:
            break
        x, count = better, count + 1
    cost = cost.compared_by(restated(cost.comparisons, first))
    residuals = cost.whitened_of(rollouts)
    objective = float(penalised(x[None], np.asarray(residuals[:1], np.float64), prior)[0])
    refined = Refined(
        space=space, x=x, best=space.from_search(x), objective=objective, residual=residuals[0],
        jacobian=jacobian_of(residuals, steps), prior=prior, starts=np.array([objective]),
        evaluations=(count + 1) * (len(x) + 1), iterations=count, converged=False,
    )  # fmt: skip
    return refined, cost


def _noise_of(scene: Scene, comparisons: Sequence[Comparison]) -> dict[str, dict[str, float]]:
    """Channel -> joint -> deviation of white noise as large as that of the repeats' mean; the smallest one.

    A whitener is triangular, so the product of its diagonal states the volume of its noise.
    """
    found: dict[str, dict[str, float]] = {}
    for channel in (c for comparison in comparisons for c in comparison.channels):
        mine = found.setdefault(channel.name, {})
        for whitener, column in zip(channel.noise.whitener, channel.columns.tolist(), strict=True):
            own = np.abs(np.diagonal(whitener))
            deviation = float(np.exp(-np.mean(np.log(own[own > 0])))) if np.any(own > 0) else np.inf
            joint = scene.joints[column] if column < len(scene.joints) else str(scene.object_joint)
            mine[joint] = min(deviation, mine.get(joint, np.inf))
    return found
