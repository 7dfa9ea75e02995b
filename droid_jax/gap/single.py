"""A case out of one recording without repeats: what is fitted, what confirms, what is sealed, and how large noise is.

The last third of the recording is sealed, or a second recording is.  What comes before is cut into blocks (see
`droid_jax.gap.blocks`) that fit and confirm in turns.  In turns, because a log holds its motion once or twice: a
base model fitted to one half of it misses what only the other half moves, and that would look like an effect.
So the confirming blocks tell an effect from noise and not from another form of it; other motions are for what
is sealed.

Noise.  One recording does not tell its noise.  What is stated, and sets the blocks' length, is the residual that
the best single candidate leaves, the amplitudes of all candidates fitted linearly.  With nothing missing that is a
few per cent too small, as the best of many candidates takes some noise with it.  With more missing than the best
candidate takes it is too large: priors then weigh more and intervals come out wide, so less is named.  A gap in
these units is no absolute size; its ratios are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from droid_jax.compare.cost import Cost, make_cost
from droid_jax.compare.residuals import MINIMUM_NOISE
from droid_jax.gap.blocks import Blocks, block_length, blocks, interleaved
from droid_jax.gap.candidates import candidates
from droid_jax.gap.case import Case, GapConfig
from droid_jax.gap.evidence import only_comparison
from droid_jax.gap.flips import FEWEST
from droid_jax.gap.rank import proposals
from droid_jax.gap.refit import Model, refit
from droid_jax.gap.screen import questions_of
from droid_jax.gap.workflow import ask
from droid_jax.measure.motion import Motion
from droid_jax.measure.noise import discrepancy
from droid_jax.measure.recording import Recording
from droid_jax.model.effects.registry import effect_space, ready
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect

FITTED = 2 / 3  # of a recording whose rest is sealed


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

    @property
    def measured(self) -> np.ndarray:
        """[K, C] measured torques, filtered."""
        return only_comparison(self).channel("torque").noise.mean

    @property
    def clock(self) -> np.ndarray:
        """[K] s."""
        return only_comparison(self).channel("torque").clock

    def left(self, values: np.ndarray) -> np.ndarray:
        """[K, C] measured minus simulated torques of one vector [D]."""
        return self.measured - self.simulated(values[None])[0]

    def stated(self, deviation: np.ndarray, instants: np.ndarray) -> Log:
        """With noise of a deviation [C], in the channel's unit, at some instants [K] bool; the rest does not count."""
        noise = self._noise.stated(np.maximum(deviation, MINIMUM_NOISE["torque"]))
        return self._with(replace(noise, whitener=noise.whitener * instants[:, None]))

    def holding(self, torque: np.ndarray) -> Log:
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
    scene: Scene, base: Space, effects: Sequence[Effect], recording: Recording, config: GapConfig | None = None
) -> Log:
    """The log of a recording of one repeat without commands, all effects in its replay, at neutral.

    Raises ValueError for repeats, which tell more than blocks do, and for commands: the numerical floor
    of a servo's replay needs repeats.
    """
    if recording.repeats > 1:
        raise ValueError(f"recording {recording.name!r} has {recording.repeats} repeats: use make_case")
    whole = base + effect_space(effects)
    cost = make_cost(ready(scene), whole, [recording], config=(config or GapConfig()).compare, effects=effects)
    if not isinstance(cost.drives[0], Motion):
        raise ValueError(f"recording {recording.name!r} holds commands; blocks are for logs in inverse mode")
    return Log(**{f.name: getattr(cost, f.name) for f in fields(cost)})


def single_case(
    log: Log, base: Space, effects: Sequence[Effect], sealed: Log | None = None, config: GapConfig | None = None
) -> Case:
    """A case from one log, or from two of which the second is sealed.

    Raises ValueError where the log is too short for its residual's correlation time.
    """
    config = config or GapConfig()
    clock = log.clock
    end = clock[-1] + 1e-6 if sealed is not None else clock[0] + FITTED * (clock[-1] - clock[0])
    deviation, length = noise_of(log, base, effects, end, config)
    parts = interleaved(clock, clock[0], end, length, 2)
    fit, confirm = (_blocks(log, deviation, part) for part in parts)
    rest = log if sealed is None else sealed
    start = end if sealed is None else rest.clock[0]
    last = rest.clock[-1] + 1e-6
    judged = _blocks(rest, deviation, interleaved(rest.clock, start, last, (last - start) / (FEWEST + 0.5))[0])
    return Case(fit, confirm, judged, base, tuple(effects), config)


def base_model(case: Case, start: np.ndarray | None = None) -> Model:
    """The base parameters fitted, from the prior's mean unless a start [D] is given.

    Inverse dynamics is smooth in them, so one start and no search will do.
    """
    start = case.whole.mean if start is None else start
    return refit(case.fit, case.base, (), start[None], case.config.refine)


def noise_of(
    log: Log, base: Space, effects: Sequence[Effect], end: float, config: GapConfig
) -> tuple[np.ndarray, float]:
    """Deviation [C] to state as noise, and length [s] of the blocks, from what lies before `end`; see the module."""
    inside = log.clock < end
    block = interleaved(log.clock, log.clock[0], end, (end - log.clock[0]) / (FEWEST + 0.5))[0]
    values = log.space.mean
    for _ in range(2):  # the first fit's weights are those of the prior's mean
        evidence = _blocks(log, discrepancy(log.left(values)[inside]), block)
        case = Case(evidence, evidence, None, base, tuple(effects), config)
        model = base_model(case, values)
        values = model.values
    found = ask(case, model, questions_of(candidates(effects)))
    best = proposals(found, model.residuals, log.space)[0].start(log.space, values)
    without, left = (log.left(v)[inside] for v in (values, best))
    left = left if np.sum((left / without.std(axis=0)) ** 2) < without.size else without
    return discrepancy(left), block_length(left)


def _blocks(log: Log, deviation: np.ndarray, block: np.ndarray) -> Blocks:
    return blocks(log.stated(deviation, block >= 0), block)
