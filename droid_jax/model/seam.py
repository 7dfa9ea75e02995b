"""Where effects enter a replay: the protocol every effect follows.

An effect is a named set of parameters in theta and up to four pure functions.  A replay is
specialised on its effects when it is traced: one that asks for none pays for none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax

from droid_jax.model.parameters import Parameter

Theta = Mapping[str, jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """What a force may depend on, before a step.

    time: s.  qpos: [nq].  qvel: [nv].  load: [nv] N m, the previous step's actuator torque.
    """

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    load: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rollout:
    """What a replay returns, for one sample (leading [P] when batched).

    time:     [T] s, of the states the rest was computed from.
    torque:   [T, J] N m (N for slides), in the recording's convention.
    position: [T, J] rad or m.
    velocity: [T, J] rad/s or m/s.
    object_angle: [T] rad, zeros where the scene has no object.
    contact:  [T, F] bool, True where finger f touches.
    finite:   [] bool, False where any of the above became NaN or infinite.
    """

    time: Any
    torque: Any
    position: Any
    velocity: Any
    object_angle: Any
    contact: Any
    finite: Any


@dataclass(frozen=True, eq=False)
class Effect:
    """One physical effect outside the MuJoCo model.

    name, parameters: the theta entries it reads, with their neutral values as means.
    command:      (theta, time [], look) -> [U]; look(t) gives the command at time t [s].
    force:        (theta, State) -> [nv] generalised force added to qfrc_applied.
    frictionloss: (theta, State, base [nv]) -> [nv] N m, rewritten every step.
    observe:      (theta, Rollout) -> Rollout, what the sensor makes of the truth.
    """

    name: str
    parameters: tuple[Parameter, ...] = ()
    command: Callable[[Theta, jax.Array, Callable], jax.Array] | None = None
    force: Callable[[Theta, State], jax.Array] | None = None
    frictionloss: Callable[[Theta, State, jax.Array], jax.Array] | None = None
    observe: Callable[[Theta, Rollout], Rollout] | None = None
