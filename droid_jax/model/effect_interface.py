"""Where effects enter a replay: the protocol every effect follows.

An effect is a named set of parameters in theta and pure functions.  A replay is
specialised on its effects when it is traced: one that asks for none pays for none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from droid_jax.model.parameters import Parameter

Theta = Mapping[str, jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """What a force may depend on, before a step.

    time: s, 0 at the first step of a servo replay; along a prescribed motion the recording's own clock.
    qpos: [nq].  qvel: [nv].
    load: [nv] N m, in a servo replay the actuators' torque in the step before, along a prescribed motion the torque
    of the same instant, without effects.
    model: the sample's mjx.Model, with the values of its parameters (fitted servo gains, say).
    gear: [2, nv] N m, of the same moment as load: what motors give to the gears (actuators and gravity compensation),
    and what the links put onto them (`step.gear_torques`); None where no effect changes dry friction.
    pose: mjx.Data with the kinematics of qpos, for forces; None where nobody has worked them out.
    """

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    load: jax.Array
    model: Any = None
    pose: Any = None
    gear: Any = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rollout:
    """What a replay returns, for one sample (leading [P] when batched).

    time:     [T] s, of the states the rest was computed from: from 0 in a servo replay, on the recording's clock along
              a measured motion.  `cost.comparisons[i].clock` is the recording's clock in both.
    torque:   [T, J] N m (N for slides), in the recording's convention.
    position: [T, J] rad or m.
    velocity: [T, J] rad/s or m/s.
    object_angle: [T] rad or m, zeros where the scene has no object.
    contact:  [T, F] bool, True where finger f touches.
    finite:   [] bool, False where a number of the above became NaN or infinite.
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
    """One physical effect outside the MuJoCo model, or a change of it, that vanishes at neutral.

    name:         "hinge_preload", that of the function that makes it.
    parameters:   what it reads from theta or writes into the model; their means are its neutral values,
                  at which a replay is as without it.
    profile:      (theta, command [T, U], s between its rows) -> [T, U], what a servo makes of the whole command, before
                  any law of `command`.
    profile_limits: "acceleration" or "speed" where `profile` limits that of a joint's goal to one over its coefficient,
                  so that programs without this one can; empty for another path.
    command:      (theta, time [], look) -> [U]; look(t) gives the command at time t [s].
    servo:        (theta, State, ctrl [U]) -> [U], what the servo is given in place of the command.
    force:        (theta, State) -> [nv] generalised force added to qfrc_applied.
    frictionloss: (theta, State, base [nv]) -> [nv] N m, rewritten every step.
    observe:      (theta, Rollout) -> Rollout, what the sensor makes of the truth.
    native:       (values by name, MjModel with the fitted values) -> (field, row) -> what to add there: the same law
                  in MuJoCo's own numbers, for the MJCF; None where this model has none.

    For the search for missing effects:
    description, signature:   a sentence each: what it is, and where it should show.
    confused_with: names of effects that look alike on some data.
    remedy: what to do, where the simulator is at fault and nothing on the robot.
    special_cases:        names of effects that are special cases of it, or nearly so over the range of a motion:
                  where one of them is equivalent, this one is dominated.
    locations:       place -> the coefficients there, e.g. {"joint3": ("joint_coulomb[joint3]",)}; without
                  them the effect is of no interest to the search.  A place may hold other places ("all joints").
    shape_parameters:       parameters that matter only beside a coefficient, and the values to try.
    minimum_size:     coefficient below which it is not named, in its own unit.
    natural_bounds:         coefficients whose bounds are where nature ends (friction that is wholly firm): a fit may
    stand there.
    over_time: its law goes by the time since the recording began, of which a window out of it knows nothing.
    """

    name: str
    parameters: tuple[Parameter, ...] = ()
    profile: Callable[[Theta, jax.Array, float], jax.Array] | None = None
    profile_limits: str = ""
    command: Callable[[Theta, jax.Array, Callable], jax.Array] | None = None
    servo: Callable[[Theta, State, jax.Array], jax.Array] | None = None
    force: Callable[[Theta, State], jax.Array] | None = None
    frictionloss: Callable[[Theta, State, jax.Array], jax.Array] | None = None
    observe: Callable[[Theta, Rollout], Rollout] | None = None
    native: Callable[[Mapping[str, float], mujoco.MjModel], Mapping[tuple[str, int], float] | None] | None = None
    description: str = ""
    signature: str = ""
    confused_with: tuple[str, ...] = ()
    remedy: str = ""
    special_cases: tuple[str, ...] = ()
    locations: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    shape_parameters: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    minimum_size: float = 0.0
    natural_bounds: tuple[str, ...] = ()
    over_time: bool = False


LAWS = ("profile", "command", "servo", "force", "frictionloss", "observe", "native")  # fields that are functions


def complete(theta: Theta, effects: Sequence[Effect]) -> Theta:
    """theta with the neutral values of what the effects read and it does not hold.

    A model in which an effect was named at one joint has no parameters of the others.
    """
    neutral = {p.name: jnp.float32(p.mean) for e in effects for p in e.parameters if not p.writes}
    return {**neutral, **theta}


def column(theta: Theta, name: str, joints: Sequence[str]) -> jax.Array:
    """[J] the entries `name[joint]` of theta, in their own unit; zero where theta has none."""
    return jnp.stack([jnp.asarray(theta.get(f"{name}[{j}]", 0.0), jnp.float32) for j in joints])
