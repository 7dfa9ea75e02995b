"""A case out of one recording without repeats: training, validation and test data, and how large noise is.

The last third of the recording is test data, or a second recording is.  What comes before is cut into blocks (see
`discrepancy.blocks`) that train and validate in turns.  In turns, because a log holds its motion once or twice: a
base model fitted to one half of it misses what only the other half moves, and that would look like an effect.
So the validation blocks tell an effect from noise and not from another form of it; other motions are for what
is test data.

Noise.  One recording does not tell its noise.  What is stated, and sets the blocks' length, is the smallest residual
that an extended model leaves, the base and up to DiscrepancyConfig.max_effects candidates chosen and fitted linearly,
where that is
less than a fifth of what the base leaves (in squares); else what the base leaves.  The fifth is there because
the best of many candidates takes noise too, of slow noise up to three quarters (40 synthetic door logs), and what it
leaves is correlated for too short a time.  So with something missing that the library explains in part only,
noise is stated too large and blocks are long: intervals are wide and less is named.  A gap in these units is no
absolute size, but ratios of gaps are free of the unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import numpy as np

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.noise import stated_deviation as discrepancy
from droid_jax.cost.observation import least_noise
from droid_jax.discrepancy.blocks import OUTSIDE, BlockResidualSet, block_length, block_residual_set, interleaved
from droid_jax.discrepancy.candidates import candidates
from droid_jax.discrepancy.case import Case, DiscrepancyConfig, per_recording_nuisances, restrained, unbounded
from droid_jax.discrepancy.rank import proposals
from droid_jax.discrepancy.refit import FittedModel, refit
from droid_jax.discrepancy.residual_set import only_comparison
from droid_jax.discrepancy.screen import ScoreTest, directions_of
from droid_jax.discrepancy.select import LESS
from droid_jax.discrepancy.sign_flips import FEWEST_REPEATS
from droid_jax.discrepancy.workflow import score
from droid_jax.identify.multistart import RefineProgress
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import joined, ready
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.measured_motion import Motion

FITTED = 2 / 3  # of a recording whose rest is test data
EXPLAINED = 0.2  # share of the base's residual, in squares, below which what is left counts as noise


@dataclass(frozen=True, eq=False)
class Log(Cost):
    """The cost of one recording of one repeat, whitened on the host.

    Other data, another noise or fewer instants then compile nothing anew.
    """

    def whitened(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, M] residuals in units of the noise stated, zero at instants left out."""
        noise = only_comparison(self).channel("torque").noise
        weight = np.einsum("ckk->kc", noise.whitener)
        left = (self.simulated(values) - noise.mean) * weight
        return np.swapaxes(left, 1, 2).reshape(len(left), -1)

    def simulated(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, K, C] simulated torques through the data's filter, in the channel's unit."""
        return self.smoothed(values)[0].astype(np.float64)

    def distances(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, 1] equation 1 over the instants that count."""
        (rollout,) = self.rollouts(values)
        comparison = only_comparison(self)
        torque = comparison.channel("torque")
        counts = np.any(np.einsum("ckk->kc", torque.noise.whitener) > 0, axis=1)
        raw = comparison.clock[0] + torque.at * (comparison.clock[1] - comparison.clock[0])
        near = np.abs(raw[:, None] - self.clock).argmin(axis=1)
        part = replace(comparison, channels=(replace(torque, mask=torque.mask & counts[near][:, None]),))
        return np.asarray(jax.vmap(part.distance)(rollout))[:, None]

    def part(self, name: str) -> Log:
        """The same log under a name for one part of it."""
        return replace(self, comparisons=(replace(only_comparison(self), name=name),))

    @property
    def columns(self) -> list[int]:
        """[C] measured joint of each torque column."""
        return only_comparison(self).channel("torque").columns.tolist()

    @property
    def measured(self) -> np.ndarray:
        """[K, C] measured torques, filtered."""
        return only_comparison(self).channel("torque").noise.mean

    @property
    def clock(self) -> np.ndarray:
        """[K] s."""
        return only_comparison(self).channel("torque").clock

    @property
    def moves(self) -> np.ndarray:
        """[K, C] bool, instants at which each joint moves: at rest friction takes what is left."""
        return only_comparison(self).channel("torque").moves

    def residual_torque(self, values: np.ndarray) -> np.ndarray:
        """[K, C] measured minus simulated torques of one vector [D]."""
        return self.measured - self.simulated(values[None])[0]

    def with_noise(self, deviation: np.ndarray, instants: np.ndarray) -> Log:
        """With noise of a deviation [C], in the channel's unit, at some instants [K] bool; the rest does not count."""
        noise = self._noise.stated(np.maximum(deviation, least_noise("torque", self.measured)))
        return self._with(replace(noise, whitener=noise.whitener * instants[:, None]))

    def with_torques(self, torque: np.ndarray) -> Log:
        """With other measured torques [K, C] of the same motion."""
        return self._with(replace(self._noise, mean=torque, repeats=torque[None]))

    @property
    def _noise(self) -> Any:
        return only_comparison(self).channel("torque").noise

    def _with(self, noise: Any) -> Log:
        comparison = only_comparison(self)
        torque = replace(comparison.channel("torque"), noise=noise)
        return replace(self, comparisons=(replace(comparison, channels=(torque,)),))


def make_log(
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    recording: Recording,
    config: DiscrepancyConfig | None = None,
    known: Sequence[Effect] = (),
) -> Log:
    """The log of a recording of one repeat without commands, all effects in its replay, at neutral.

    known: effects that the base has already; their parameters are in `base`.
    Raises ValueError for repeats, which tell more than blocks do, and for commands: the numerical floor
    of a servo's replay needs repeats.
    """
    if recording.repeats > 1:
        raise ValueError(f"recording {recording.name!r} has {recording.repeats} repeats: use make_case")
    whole, config = joined(restrained(base), effects), config or DiscrepancyConfig()
    cost = make_cost(ready(scene), whole, [recording], config=config.compare, effects=[*known, *effects], check=False)
    if not isinstance(cost.drives[0], Motion):
        raise ValueError(f"recording {recording.name!r} holds commands; blocks are for logs in inverse mode")
    return Log(**{f.name: getattr(cost, f.name) for f in fields(cost)})


def single_case(
    log: Log,
    base: Space,
    effects: Sequence[Effect],
    test: Log | None = None,
    config: DiscrepancyConfig | None = None,
    start: np.ndarray | None = None,
) -> Case:
    """A case from one log, or from two of which the second is test data, with its own torque offsets.

    start: [D] where fits begin, fitted to this motion before; the prior's mean unless given.
    Raises ValueError where the log is too short for its residual's correlation time.
    """
    config = config or DiscrepancyConfig()
    clock = log.clock
    share = 1.0 if test is not None else FITTED
    end = clock[-1] + 1e-6 if test is not None else clock[0] + share * (clock[-1] - clock[0])
    deviation, length = noise_of(log, base, effects, end, config, start)
    parts = interleaved(clock, clock[0], end, length, 2, share)
    name = only_comparison(log).name
    turns = (f"{name}, every other block", f"{name}, the blocks between")
    fit, validation = (_blocks(log.part(n), deviation, part) for n, part in zip(turns, parts, strict=True))
    own = [] if test is None else per_recording_nuisances(base)  # another day's; the rest of the same log has the same
    rest = log.part(f"{name}, last third") if test is None else test
    judged = _blocks(
        replace(rest, space=unbounded(rest.space, own)) if own else rest,
        deviation[[log.columns.index(c) for c in rest.columns]],
        _any_blocks(rest.clock, end if test is None else rest.clock[0]),
    )
    if own:
        judged = judged.with_nuisances(own)
    return Case(fit, validation, judged, restrained(base), tuple(effects), config)


def base_model(
    case: Case, start: np.ndarray | None = None, progress: Callable[[RefineProgress], None] | None = None
) -> FittedModel:
    """The base parameters fitted, from the prior's mean unless a start [D] is given.

    Inverse dynamics is smooth in them, so one start and no search will do.
    """
    start = case.full_space.mean if start is None else start
    return refit(case.train, case.base, (), start[None], case.config.refine, progress=progress)


def noise_of(
    log: Log, base: Space, effects: Sequence[Effect], end: float, config: DiscrepancyConfig, start: np.ndarray | None
) -> tuple[np.ndarray, float]:
    """Deviation [C] to state as noise, and length [s] of the blocks, from what lies before `end`; see the module."""
    inside = log.clock < end
    block = _any_blocks(log.clock[inside], log.clock[0])
    block = np.r_[block, np.full(len(log.clock) - len(block), OUTSIDE)]
    if start is None:  # what the prior's mean leaves is no noise
        start = _rough_fit(log, base, effects, log.space.mean, block, config)[1].values
    case, model, deviation = _rough_fit(log, base, effects, start, block, config)
    found = score(case, model, directions_of(candidates(effects)))
    whole = model.residuals.mean(axis=0)
    least = _least(found, whole, log.space, config.max_effects)
    noise = least if least @ least < EXPLAINED * (whole @ whole) else whole
    left = (noise.reshape(len(deviation), -1).T * deviation)[inside]
    return discrepancy(left, log.moves[inside]), block_length(left)


def _rough_fit(
    log: Log, base: Space, effects: Sequence[Effect], values: np.ndarray, block: np.ndarray, config: DiscrepancyConfig
) -> tuple[Case, FittedModel, np.ndarray]:
    """The base fitted with the noise [C] stated that `values` [D] leave."""
    left = discrepancy(log.residual_torque(values)[block >= 0], log.moves[block >= 0])
    deviation = np.maximum(left, least_noise("torque", log.measured))
    residual_set = _blocks(log, deviation, block)
    case = Case(residual_set, residual_set, None, base, tuple(effects), config)
    return case, base_model(case, values), deviation


def _least(found: ScoreTest, left: np.ndarray, space: Space, most: int) -> np.ndarray:
    """[M] what the best `most` candidates leave of residuals `left` [M], one after the other, linearly.

    One that takes less than an effect must is left out: it would take noise.
    """
    for _ in range(most):
        best = proposals(found, left[None], space)[0]
        if best.explained < LESS:
            break
        keys = {part.key for part in best.parts}
        rows = [k for k, q in enumerate(found.directions) if q.candidate.key in keys]
        taken, _ = np.linalg.qr(found.sensitivities[rows].T)
        left = left - taken @ (taken.T @ left)
        found = replace(found, sensitivities=found.sensitivities - (found.sensitivities @ taken) @ taken.T)
    return left


def _any_blocks(clock: np.ndarray, first: float) -> np.ndarray:
    """[K] block of each instant from `first` on, for what is not tested: as few as there may be."""
    end = clock[-1] + 1e-6
    return interleaved(clock, first, end, (end - first) / (FEWEST_REPEATS + 0.5))[0]


def _blocks(log: Log, deviation: np.ndarray, block: np.ndarray) -> BlockResidualSet:
    return block_residual_set(log.with_noise(deviation, block >= 0), block)
