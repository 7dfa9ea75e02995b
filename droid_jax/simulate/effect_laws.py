"""The laws of effects in a time step: what they make of commands, servos, gears, friction, forces and sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax.model.effect_interface import Effect, Gear, GearStep, Rollout, State, Theta
from droid_jax.model.encoders import misplaced_compensation
from droid_jax.model.step import gear_torques, simulate_step


class Moving(NamedTuple):
    """What a simulation carries from one time step to the next.

    qpos [nq]; qvel [nv]; warm [nv], the solver's start; load [nv], gear [2, nv] and motors [3, nv] as in `State`.
    """

    qpos: jax.Array
    qvel: jax.Array
    warm: jax.Array
    load: jax.Array
    gear: jax.Array
    motors: jax.Array

    @classmethod
    def at(cls, qpos: jax.Array, qvel: jax.Array) -> Moving:
        """A pose and a velocity, nothing loaded."""
        zero = jnp.zeros_like(qvel)
        return cls(qpos, qvel, zero, zero, jnp.stack([zero] * 2), jnp.stack([zero] * 3))

    def state(self, time: Any, model: Any) -> State:
        """The state on which laws depend."""
        return State(time, self.qpos, self.qvel, self.load, model, gear=self.gear, motors=self.motors)


class Stepped(NamedTuple):
    """A time step: mjx.Data after it, what it carries on, and the model that made it.

    push [nv] and reading [3, nv] are those of its gears (`GearStep`); None if all are rigid.
    """

    data: Any
    moving: Moving
    model: Any
    push: jax.Array | None = None
    reading: jax.Array | None = None


def step_with_effects(
    template: Any,
    model: Any,
    theta: Theta,
    state: State,
    moving: Moving,
    command: jax.Array,
    effects: Sequence[Effect],
    *,
    error: jax.Array | None = None,
    parity: bool = False,
    servo_damping: bool = True,
) -> Stepped:
    """One time step with the laws of effects.

    Args:
        template: mjx.Data of the scene.
        model: mjx.Model of the sample.
        theta: parameters of the effects.
        state: of `moving`, with the time of the laws.
        moving: before the step.
        command: [U] to the servos.
        effects: in the model.
        error: [nv] joint position minus encoder reading; None: 0.
        parity: as in `simulate_step`.
        servo_damping: as in `simulate_step`.
    """
    ctrl, gears = servo_input(command, theta, state, effects), None
    used = apply_limits(apply_friction(model, theta, state, effects), theta, state, effects)
    if gear := gear_of(effects):
        gears = gear.step(theta, replace(state, model=used), ctrl)
        used = gears.model
    before = template.replace(qpos=moving.qpos, qvel=moving.qvel, qacc_warmstart=moving.warm, ctrl=ctrl)
    push = apply_forces(theta, state, effects, error, gears)
    after = simulate_step(used, before, parity=parity, servo_damping=servo_damping, push=push)
    torques = gear_torques(used, after, moving.qvel) if changes_friction(effects) else moving.gear
    carried = Moving(after.qpos, after.qvel, after.qacc_warmstart, after.qfrc_actuator, torques, moving.motors)
    if gears is None:
        return Stepped(after, carried, used)
    motors = gears.after((after.qvel - moving.qvel) / model.opt.timestep)
    reading = gears.reading(motors)
    if changes_friction(effects):
        torques = torques + jnp.stack([gears.push, -gears.push])
    carried = carried._replace(load=carried.load + reading[2], gear=torques, motors=motors)
    return Stepped(after, carried, used, gears.push, reading)


def gear_of(effects: Sequence[Effect]) -> Gear | None:
    """The law of the gears; None if all are rigid.  ValueError where effects have different ones."""
    named = {effect.name: effect.gear for effect in effects if effect.gear is not None}
    if len(set(map(id, named.values()))) > 1:
        raise ValueError(
            f"effects {', '.join(named)} have different laws of the gears, and a replay has one: leave some of them "
            "out (gap --without)"
        )
    return next(iter(named.values()), None)


def held_gears(
    command: jax.Array, theta: Theta, state: State, effects: Sequence[Effect]
) -> tuple[jax.Array, jax.Array]:
    """The gears where a replay begins, held by the servos' torques.

    Args:
        command: [U] to the servos.
        theta: parameters of the effects.
        state: with the encoders' readings for positions.
        effects: in the model.

    Returns:
        `State.motors`, and [nv] rad (m) by which encoders are ahead of their links (`Effect.twist`).
    """
    gear, twists = gear_of(effects), [effect.twist for effect in effects if effect.twist is not None]
    ctrl = servo_input(command, theta, state, [effect for effect in effects if effect.twist is None])
    state = replace(state, model=apply_limits(state.model, theta, state, effects))
    motors = state.motors if gear is None else gear.start(theta, state, ctrl)
    return motors, sum((twist(theta, state, ctrl) for twist in twists), jnp.zeros_like(state.qvel))


def profiled(table: jax.Array, timestep: float, theta: Theta, effects: Sequence[Effect]) -> jax.Array:
    """[T, U] the command after the servos' profiles (`Effect.profile`)."""
    for effect in effects:
        if effect.profile is not None:
            table = effect.profile(theta, table, timestep)
    return table


def compose(law: Callable, theta: Theta, command: Callable) -> Callable:
    """The command t -> [U] after an effect's law."""
    return lambda time: law(theta, time, command)


def servo_input(ctrl: jax.Array, theta: Theta, state: State, effects: Sequence[Effect]) -> jax.Array:
    """[U] the input of the servos: the command changed by effects (`Effect.servo`)."""
    for effect in effects:
        if effect.servo is not None:
            ctrl = effect.servo(theta, state, ctrl)
    return ctrl


def changes_friction(effects: Sequence[Effect]) -> bool:
    """Whether an effect changes dry friction, which may depend on the torques of the gears."""
    return any(effect.frictionloss is not None for effect in effects)


def apply_friction(model, theta: Theta, state: State, effects: Sequence[Effect]):
    """The model with the friction losses of effects in this state."""
    loss = model.dof_frictionloss
    for effect in effects:
        if effect.frictionloss is not None:
            loss = effect.frictionloss(theta, state, loss)
    return model if loss is model.dof_frictionloss else model.replace(dof_frictionloss=loss)


def apply_limits(model, theta: Theta, state: State, effects: Sequence[Effect]):
    """The model with the force ranges that effects give to its actuators in this state, within its own."""
    laws = [effect.limits for effect in effects if effect.limits is not None]
    if not laws:
        return model
    own = np.asarray(model.actuator_forcelimited, bool)[:, None]
    ranges: jax.Array = jnp.where(own, jnp.asarray(model.actuator_forcerange), jnp.array([-jnp.inf, jnp.inf]))
    low, high = ranges[:, 0], ranges[:, 1]
    of_motors = replace(state, qvel=state.qvel + state.motors[1])  # a motor behind its gear has its own speed
    for law in laws:
        ends = law(theta, of_motors)
        low, high = jnp.clip(ends[:, 0], low, high), jnp.clip(ends[:, 1], low, high)
    ranges = jnp.stack([low, high], axis=1)
    return model.replace(actuator_forcelimited=np.ones(len(own), bool), actuator_forcerange=ranges)


def apply_forces(
    theta: Theta,
    state: State,
    effects: Sequence[Effect],
    error: jax.Array | None = None,
    gears: GearStep | None = None,
) -> Callable[[Any], jax.Array] | None:
    """pose -> [nv] N m (N) of effects in this state and of gravity compensation at wrong positions; None if none acts.

    error: [nv] joint position minus encoder reading, rad (m); None: 0.  gears: of this step; None: rigid.
    """
    laws = [effect.force for effect in effects if effect.force is not None]
    if not laws and error is None and gears is None:
        return None
    always = jnp.zeros_like(state.qvel) if gears is None else gears.push

    def forces(pose: Any) -> jax.Array:
        at = replace(state, pose=pose)
        astray = misplaced_compensation(state.model, pose, error)
        return sum((law(theta, at) for law in laws), always if astray is None else always + astray)

    return forces


def apply_sensor_model(rollout: Rollout, theta: Theta, effects: Sequence[Effect]) -> Rollout:
    """The rollout after the sensor effects (`Effect.observe`), with `finite`."""
    for effect in effects:
        if effect.observe is not None:
            rollout = effect.observe(theta, rollout)
    traces = (rollout.torque, rollout.position, rollout.velocity, rollout.object_angle)
    finite = [jnp.all(jnp.isfinite(trace)) for trace in traces]
    return replace(rollout, finite=jnp.all(jnp.stack(finite)))
