"""The cost of one log: a recording of one repeat without commands, replayed by inverse dynamics.

Its noise is stated, not estimated from repeats.  Its residuals are whitened on the host, so that other data, another
noise or fewer instants need no new compilation.
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
    """The cost of a recording of one repeat without commands, whitened on the host."""

    def whitened(self, values: Any) -> np.ndarray:
        """Return residuals [P, M] at values [P, D], in units of the stated noise; zero at instants without weight."""
        noise = self._torque.noise
        residual = (self.simulated(values) - noise.mean) * noise.weight
        return np.swapaxes(residual, 1, 2).reshape(len(residual), -1)

    def simulated(self, values: Any) -> np.ndarray:
        """Return simulated torques [P, K, C] at values [P, D], through the data's filter, in the channel's unit."""
        return self.smoothed(values)[0].astype(np.float64)

    def distances(self, values: Any) -> np.ndarray:
        """Return equation 1 [P, 1] at values [P, D], over the instants that have a weight."""
        (rollout,) = self.rollouts(values)
        comparison = self.comparisons[0]
        torque = self._torque
        has_weight = np.any(torque.noise.weight > 0, axis=1)
        times = comparison.clock[0] + torque.at * (comparison.clock[1] - comparison.clock[0])
        instants = (times - self.clock[0]) / (self.clock[1] - self.clock[0])  # the clock is regular
        nearest = np.clip(np.ceil(instants - 0.5 - 1e-9).astype(int), 0, len(self.clock) - 1)
        part = replace(comparison, channels=(replace(torque, mask=torque.mask & has_weight[nearest][:, None]),))
        return np.asarray(jax.vmap(part.distance)(rollout))[:, None]

    def part(self, name: str) -> LoneLog:
        """Return the same log under another name, that of a part of it."""
        return replace(self, comparisons=(replace(self.comparisons[0], name=name),))

    @property
    def columns(self) -> list[int]:
        """[C] number of the scene's joint of each torque column."""
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
        """[K, C] bool, instants at which each joint moves; at rest friction absorbs the residual."""
        return self._torque.moves

    def residual(self, values: np.ndarray) -> np.ndarray:
        """Return measured minus simulated torques [K, C] at one vector [D]."""
        return self.measured - self.simulated(values[None])[0]

    def least_noise(self) -> np.ndarray:
        """Return the smallest standard deviation [C] of the noise (`observation.least_noise`)."""
        return least_noise("torque", self.measured, self.comparisons[0].config.noise)

    def with_noise(self, deviation: np.ndarray, instants: np.ndarray) -> LoneLog:
        """Return the log with white noise, and weight at some instants only.

        deviation: [C] standard deviation in the channel's unit.  instants: [K] bool, those that have a weight.
        """
        noise = self._torque.noise.stated(np.maximum(deviation, self.least_noise()))
        return self._with(replace(noise, whitener=noise.whitener * instants))

    def with_torques(self, torque: np.ndarray) -> LoneLog:
        """Return the log with other measured torques [K, C] of the same motion."""
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
    """Return the cost of a log over a space.

    Args:
        scene: what is simulated.
        space: meaning of the vectors [D].
        recording: of one repeat, without commands.
        config: how simulation and measurement are compared; None for the defaults.
        effects: in the replay.

    Raises:
        ValueError: the recording has several repeats, or commands.
    """
    if recording.repeats > 1:
        raise ValueError(f"recording {recording.name!r} has {recording.repeats} repeats, and a log in blocks has one")
    cost = make_cost(scene, space, [recording], config=config, effects=effects, check=False)
    if not isinstance(cost.drives[0], Motion):
        raise ValueError(f"recording {recording.name!r} holds commands; blocks are for logs without")
    return LoneLog(**{f.name: getattr(cost, f.name) for f in fields(cost)})
