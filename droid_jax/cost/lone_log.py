"""The cost of one log: a recording of one repeat without commands, replayed by inverse dynamics.

Its noise is stated, not estimated, and its residuals are whitened on the host, so that other data, another noise or
fewer instants compile nothing again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import numpy as np

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.observation import Measured, least_noise
from droid_jax.cost.residuals import CompareConfig
from droid_jax.model.effect_interface import Effect
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.measured_motion import Motion


@dataclass(frozen=True, eq=False)
class LoneLog(Cost):
    """The cost of one recording of one repeat, whitened on the host.

    Other data, another noise or fewer instants then compile nothing again.
    """

    def whitened(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, M] residuals in units of the noise stated, zero at instants left out."""
        noise = self._torque.noise
        weight = np.einsum("ckk->kc", noise.whitener)
        left = (self.simulated(values) - noise.mean) * weight
        return np.swapaxes(left, 1, 2).reshape(len(left), -1)

    def simulated(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, K, C] simulated torques through the data's filter, in the channel's unit."""
        return self.smoothed(values)[0].astype(np.float64)

    def distances(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, 1] equation 1 over the instants that count."""
        (rollout,) = self.rollouts(values)
        comparison = self.comparisons[0]
        torque = self._torque
        counts = np.any(np.einsum("ckk->kc", torque.noise.whitener) > 0, axis=1)
        raw = comparison.clock[0] + torque.at * (comparison.clock[1] - comparison.clock[0])
        places = (raw - self.clock[0]) / (self.clock[1] - self.clock[0])  # the clock is regular
        near = np.clip(np.ceil(places - 0.5 - 1e-9).astype(int), 0, len(self.clock) - 1)
        part = replace(comparison, channels=(replace(torque, mask=torque.mask & counts[near][:, None]),))
        return np.asarray(jax.vmap(part.distance)(rollout))[:, None]

    def part(self, name: str) -> LoneLog:
        """The same log under a name for one part of it."""
        return replace(self, comparisons=(replace(self.comparisons[0], name=name),))

    @property
    def columns(self) -> list[int]:
        """[C] measured joint of each torque column."""
        return self._torque.columns.tolist()

    @property
    def measured(self) -> np.ndarray:
        """[K, C] measured torques, filtered."""
        return self._torque.noise.mean

    @property
    def clock(self) -> np.ndarray:
        """[K] s."""
        return self._torque.clock

    @property
    def moves(self) -> np.ndarray:
        """[K, C] bool, instants at which each joint moves: at rest friction takes what is left."""
        return self._torque.moves

    def residual(self, values: np.ndarray) -> np.ndarray:
        """[K, C] measured minus simulated torques of one vector [D]."""
        return self.measured - self.simulated(values[None])[0]

    def least_noise(self) -> np.ndarray:
        """[C] deviation below which the noise is never believed."""
        return least_noise("torque", self.measured, self.comparisons[0].config.noise)

    def with_noise(self, deviation: np.ndarray, instants: np.ndarray) -> LoneLog:
        """With noise of a deviation [C], in the channel's unit, at some instants [K] bool; the rest does not count."""
        noise = self._torque.noise.stated(np.maximum(deviation, self.least_noise()))
        return self._with(replace(noise, whitener=noise.whitener * instants[:, None]))

    def with_torques(self, torque: np.ndarray) -> LoneLog:
        """With other measured torques [K, C] of the same motion."""
        return self._with(replace(self._torque.noise, mean=torque, repeats=torque[None]))

    @property
    def _torque(self) -> Measured:
        return self.comparisons[0].channel("torque")

    def _with(self, noise: Any) -> LoneLog:
        comparison = self.comparisons[0]
        torque = replace(self._torque, noise=noise)
        return replace(self, comparisons=(replace(comparison, channels=(torque,)),))


def lone_log(
    scene: Scene, space: Space, recording: Recording, config: CompareConfig | None, effects: Sequence[Effect] = ()
) -> LoneLog:
    """The cost of a log over a space.

    Raises:
        ValueError: repeats, which say more than blocks of time do; or commands: the discretisation error of a servo's
            replay needs repeats.
    """
    if recording.repeats > 1:
        raise ValueError(f"recording {recording.name!r} has {recording.repeats} repeats, and a log in blocks has one")
    cost = make_cost(scene, space, [recording], config=config, effects=effects, check=False)
    if not isinstance(cost.drives[0], Motion):
        raise ValueError(f"recording {recording.name!r} holds commands; blocks are for logs without")
    return LoneLog(**{f.name: getattr(cost, f.name) for f in fields(cost)})
