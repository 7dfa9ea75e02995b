"""The interface of effects: what a replay gives to them and what they return.

An effect is a named set of parameters and pure functions.  A replay is specialised on its effects when it is traced.
Effects that it does not have cost no time.
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
    """The state on which a law may depend, before a step.

    Attributes:
        time: s, 0 at the first step of a servo replay; on the recording's clock along a prescribed motion.
        qpos: [nq] rad and m.
        qvel: [nv] rad/s and m/s.
        load: [nv] N m, in a servo replay the actuators' torque in the previous step; along a prescribed motion the
            torque at the same instant, without effects.
        model: the sample's mjx.Model, with the values of its parameters (such as servo gains).
        pose: mjx.Data with the kinematics of qpos; None if they are not computed.
        gear: [2, nv] N m, at the time of `load`: torque of the motors on the gears (actuators and gravity compensation)
            and torque of the links on them (`step.gear_torques`); zero if no effect changes dry friction.
        motors: [3, nv] the state of gears (`Gear`): rad and rad/s by which the motors are ahead of their links, half a
            step before, and the links' acceleration in the previous step, rad/s^2; zero if no effect has a `gear`.
    """

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    load: jax.Array
    model: Any = None
    pose: Any = None
    gear: Any = None
    motors: Any = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rollout:
    """The result of a replay, for one sample (leading [P] when batched).

    Attributes:
        time: [T] s, of the states; from 0 in a servo replay, on the recording's clock along a measured motion.
            `cost.comparisons[i].clock` is the recording's clock in both cases.
        torque: [T, J] N m (N for slides), in the recording's convention.
        position: [T, J] rad or m.
        velocity: [T, J] rad/s or m/s.
        object_angle: [T] rad or m; zeros if the scene has no object.
        contact: [T, F] bool, True if finger f touches.
        finite: [] bool, False if a number of the above is NaN or infinite.
    """

    time: Any
    torque: Any
    position: Any
    velocity: Any
    object_angle: Any
    contact: Any
    finite: Any


@dataclass(frozen=True, eq=False)
class GearStep:
    """How motors drive their links through their gears in one time step.

    Attributes:
        model: mjx.Model with the inertia and the velocity gains of the motors that their links feel.
        push: [nv] N m, torques of the gears on the links beyond those of the model's actuators.
        after: link accelerations in the step [nv] -> `State.motors` of the next one.
        reading: those -> [3, nv] what the motors' encoders read beyond the links, rad and rad/s, and what their torque
            is beyond that of the model's actuators, N m.
    """

    model: Any
    push: jax.Array
    after: Callable[[jax.Array], jax.Array]
    reading: Callable[[jax.Array], jax.Array]


@dataclass(frozen=True, eq=False)
class Gear:
    """The law of gears between motors and links.  A replay has one, which several effects may share.

    Attributes:
        step: (theta, State, servo's input [U]) -> GearStep.
        start: (theta, State of `Effect.twist`, servo's input [U]) -> `State.motors` of motors at rest on their links.
    """

    step: Callable[[Theta, State, jax.Array], GearStep]
    start: Callable[[Theta, State, jax.Array], jax.Array]


@dataclass(frozen=True, eq=False)
class Effect:
    """A physical effect beside the MuJoCo model, or a change of the model, that vanishes at neutral.

    Attributes:
        name: such as "hinge_preload", the name of the function that makes it.
        parameters: read from theta or written into the model.  Their means are the neutral values, at which a replay
            equals one without the effect.
        profile: (theta, command [T, U], s between its rows) -> [T, U], changes the whole command in the servo, before
            the laws of `command`.
        profile_limits: "acceleration" or "speed" if `profile` limits that of a joint's goal to one over the
            coefficient, which other programs can do too; empty for another profile.
        command: (theta, time [], command_at) -> [U]; command_at(t) is the command at time t [s].
        servo: (theta, State, ctrl [U]) -> [U], the servo's input in place of the command.
        limits: (theta, State) -> [U, 2] N m (N), lowest and highest force of each actuator in the step; infinite: none.
        gear: the gears between motors and links, in place of rigid ones.
        twist: (theta, State where a replay begins, servo's input [U]) -> [nv] rad (m) by which encoders are ahead of
            their links there.  The State has the encoders' readings for positions, and the input lacks the `servo` laws
            of effects with a twist, since a servo at the reading needs no correction for it.  The State has no
            pose, and its model the force limits of `limits`.  The links begin that far behind the recorded positions.
        force: (theta, State) -> [nv] generalised force, added to qfrc_applied.
        frictionloss: (theta, State, base [nv]) -> [nv] N m, friction loss of the step.
        observe: (theta, Rollout) -> Rollout, the sensor model.
        native: (values by name, MjModel with the fitted values) -> {(field, row): increment}, the same law as numbers
            of a MuJoCo model; None if this model cannot express it.

    For the search for missing effects:
        description: what it is, a sentence.
        signature: where it shows in recordings, a sentence.
        confused_with: names of effects that are indistinguishable in some motions.
        remedy: what to do if the simulator, not the robot, is the cause.
        special_cases: names of effects that are special cases of it, or nearly so over the range of a motion.  If one
            of them is equivalent, this effect is dominated.
        locations: location -> the coefficients there, such as {"joint3": ("joint_coulomb[joint3]",)}.  The search does
            not consider an effect without locations.  A location may contain others ("all joints").
        shape_parameters: parameters that act only with a non-zero coefficient -> values from which fits start.
        minimum_size: minimum effect size of a coefficient, in its unit.
        natural_bounds: coefficients with physical bounds (such as a share of one), at which a fit may end.
        over_time: whether its law depends on the time since the recording began, which a window does not know.
    """

    name: str
    parameters: tuple[Parameter, ...] = ()
    profile: Callable[[Theta, jax.Array, float], jax.Array] | None = None
    profile_limits: str = ""
    command: Callable[[Theta, jax.Array, Callable], jax.Array] | None = None
    servo: Callable[[Theta, State, jax.Array], jax.Array] | None = None
    limits: Callable[[Theta, State], jax.Array] | None = None
    gear: Gear | None = None
    twist: Callable[[Theta, State, jax.Array], jax.Array] | None = None
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


# Fields with functions: what acts on commands and servos, what moves the robot, and all of them.
STEERING = ("profile", "command", "servo", "limits", "gear", "twist")
MOVING = (*STEERING, "force", "frictionloss")
LAWS = (*MOVING, "observe", "native")


def has_law(effect: Effect, laws: Sequence[str]) -> bool:
    """Whether an effect has one of these laws."""
    return any(getattr(effect, law) is not None for law in laws)


def complete(theta: Theta, effects: Sequence[Effect]) -> Theta:
    """theta, with neutral values for parameters of the effects that it lacks.

    A model with an effect at one joint has no parameters of that effect at other joints.
    """
    neutral = {p.name: jnp.float32(p.mean) for e in effects for p in e.parameters if not p.writes}
    return {**neutral, **theta}


def column(theta: Theta, name: str, joints: Sequence[str]) -> jax.Array:
    """[J] the entries `name[joint]` of theta, in the parameter's unit; zero if theta lacks them."""
    return jnp.stack([jnp.asarray(theta.get(f"{name}[{j}]", 0.0), jnp.float32) for j in joints])
