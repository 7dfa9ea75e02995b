"""The task as a brax environment on MJX: one door, whose physics (`sys`) brax's wrappers may randomise."""

from __future__ import annotations

from droid_jax.model.quiet_mjx import mjx  # first: brax would import mujoco.mjx with its two lines about warp

# isort: split
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State as EnvState

from droid_jax.door.demonstration import OPEN, grasp_pose
from droid_jax.door.hand import finger_forces, hand_of, looked
from droid_jax.door.policy_interface import PLAN, interface_of
from droid_jax.door.task import (
    Task,
    gripped,
    held_open,
    observation,
    reward,
    substeps_of,
    succeeded,
    terms,
)
from droid_jax.model.actuators import has_servo_damping
from droid_jax.model.effect_interface import Effect, Theta, complete
from droid_jax.model.effects.registry import ready
from droid_jax.model.encoders import encoder_error
from droid_jax.model.physics import Physics
from droid_jax.model.scene import Scene
from droid_jax.policy.control import ACTIONS, OBSERVED, Safety, limited
from droid_jax.policy.environment import Environment
from droid_jax.runtime import first_device
from droid_jax.simulate.batching import time_loop
from droid_jax.simulate.effect_laws import Moving, compose, step_with_effects
from droid_jax.simulate.hand_path import solve_pose
from droid_jax.simulate.replay import check_stateless

PAST = 4  # commands remembered: a delay of up to three times Task.control
FAST = 100.0  # rad/s or m/s: ten times what arm, fingers and door ever do; beyond, the simulation has come apart


class World(NamedTuple):
    """What the simulation carries from one action to the next.

    commands: [PAST, 9], the latest last; pads [2, 3] m in the knob's frame; time, held, longest: s.
    """

    moving: Moving
    commands: jax.Array
    pads: jax.Array
    time: jax.Array
    held: jax.Array
    longest: jax.Array


class DoorEnv(Environment):
    """Opening the built-in door.

    scene: the built-in one, with joint limits enforced.  effects: of the extended model; their parameters are in
    `sys.theta`, and what they do to torque sensors is not seen by a policy.  sys: `Physics`, the scene's own unless
    randomised.
    The hand starts in front of the knob, open, in the arm pose of demonstration A.
    """

    def __init__(self, scene: Scene, task: Task | None = None, effects: Sequence[Effect] = ()):
        check_stateless(scene)
        if shaping := [effect.name for effect in effects if effect.profile is not None]:
            raise ValueError(f"effects {', '.join(shaping)} need a whole command, which a policy has not given yet")
        if scene.command_names != (*scene.joints, *scene.finger_joints):
            raise ValueError(
                f"commands of a policy are of the arm and then of the fingers, and the actuators of scene "
                f"{scene.name!r} are {', '.join(scene.command_names)}"
            )
        self.scene, self.task, self.effects = ready(scene) if effects else scene, task or Task(), tuple(effects)
        self.sys = Physics(self.scene.mjx, {})
        self.start = waiting_pose(self.scene, self.task)
        self.interface = interface_of(self.scene, self.task, self.start)
        self._hand, self._template = hand_of(self.scene), mjx.make_data(self.scene.mjx, device=first_device())
        self._timestep = float(self.scene.model.opt.timestep)
        self._servo_damping = has_servo_damping(self.scene.model)
        self._substeps = substeps_of(self.task.control, self._timestep, "the scene's")

    @property
    def observation_size(self) -> int:
        return OBSERVED

    @property
    def action_size(self) -> int:
        return ACTIONS

    @property
    def backend(self) -> str:
        return "mjx"

    def reset(self, rng: jax.Array) -> EnvState:
        """The start pose, each joint of the arm off by its own draw."""
        scene = self.scene
        off = self.task.spread * jax.random.normal(rng, (len(scene.joints),))
        qpos = jnp.asarray(self.start, jnp.float32).at[scene.joint_qpos].add(off)
        still = jnp.concatenate([qpos[scene.joint_qpos], jnp.full(2, OPEN, jnp.float32)])
        nothing = jnp.zeros(())
        moving = Moving.at(qpos, jnp.zeros(scene.model.nv, jnp.float32))
        world = World(moving, jnp.tile(still, (PAST, 1)), jnp.zeros((2, 3)), nothing, nothing, nothing)
        seen = self._look(self.sys.model, world, jnp.zeros(2))
        world = world._replace(pads=seen.pads)
        seen = seen._replace(sliding=nothing)
        metrics = {name: nothing for name in ("success", "angle", "grip", "blown_up", *terms(self.task, seen))}
        carried: Any = world  # brax means its own kind of state
        return EnvState(carried, self._observe(world, seen), nothing, nothing, metrics)

    def step(self, state: EnvState, action: jax.Array) -> EnvState:
        """One action: `Task.control` seconds of simulation.

        An episode ends early where the simulation is no longer one, its state no number or faster than `FAST`
        (counted in `blown_up`; one such observation would spoil the running statistics that all are normalised with).
        It does not end with success: an end is an end of rewards, and a policy would wait in front of it.  `success` is
        1 in the step that earns it.
        """
        carried: Any = state.pipeline_state
        before: World = carried
        target = limited(self.interface, Safety(), before.moving.qpos[self.scene.joint_qpos], action, jnp)
        commands = jnp.concatenate([before.commands[1:], jnp.concatenate([target.arm, target.fingers])[None]])
        world, force = self._advance(self.sys, before._replace(commands=commands))
        finite = jnp.all(jnp.isfinite(world.moving.qpos)) & jnp.all(jnp.isfinite(force))
        finite &= jnp.all(jnp.abs(world.moving.qvel) < FAST)
        world = jax.tree.map(lambda new, old: jnp.where(finite, new, old), world, before)
        force = jnp.where(finite, force, 0.0)
        seen = self._look(self.sys.model, world, force)
        held = held_open(self.task, seen, before.held)
        world = world._replace(pads=seen.pads, held=held, longest=jnp.maximum(before.longest, held))
        success = succeeded(self.task, world.longest) & ~succeeded(self.task, before.longest)
        metrics = {
            "success": success,
            "angle": seen.angle,
            "grip": gripped(self.task, seen),
            "blown_up": ~finite,
            **terms(self.task, seen),
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=world,
            obs=self._observe(world, seen),
            reward=jnp.where(finite, reward(self.task, seen), 0.0),
            done=(~finite).astype(jnp.float32),
            metrics=state.metrics | {name: jnp.asarray(value, jnp.float32) for name, value in metrics.items()},
        )

    def _advance(self, physics: Physics, world: World) -> tuple[World, jax.Array]:
        """`Task.control` seconds later; and the force on each finger [2] N in the last of its steps."""

        def substep(sample: Any, number: jax.Array, carry: Any) -> Any:
            model, theta, error, world = sample
            moving, _ = carry
            now = moving.state(world.time + number * self._timestep, model)
            after, moving, *_ = step_with_effects(
                self._template,
                model,
                theta,
                now,
                moving,
                self._command(theta, now.time, world),
                self.effects,
                error=error,
                servo_damping=self._servo_damping,
            )
            return moving, finger_forces(self._hand, after)

        model, theta = physics.model, complete(physics.theta, self.effects)
        sample = model, theta, encoder_error(self.scene, model), world
        moving, force = time_loop(substep, sample, (world.moving, jnp.zeros(2)), self._substeps)
        return world._replace(moving=moving, time=world.time + self.task.control), force

    def _command(self, theta: Theta, now: jax.Array, world: World) -> jax.Array:
        """[9] the latest command, or what effects make of the latest ones."""

        def look(time: jax.Array) -> jax.Array:
            back = jnp.ceil((world.time - time) / self.task.control - 1e-6)
            return world.commands[jnp.clip(PAST - 1 - back.astype(jnp.int32), 0, PAST - 1)]

        for effect in self.effects:
            if effect.command is not None and not effect.over_time:  # no recording runs, nor its clock
                look = compose(effect.command, theta, look)
        return look(now)

    def _look(self, model, world: World, force: jax.Array):
        data = mjx.kinematics(model, self._template.replace(qpos=world.moving.qpos))
        return looked(self._hand, data, force, world.pads, self.task.control)

    def _observe(self, world: World, seen) -> jax.Array:
        return observation(world.moving.qpos[self.scene.joint_qpos], world.moving.qvel[self.scene.joint_dofs], seen)


def waiting_pose(scene: Scene, task: Task) -> np.ndarray:
    """[nq] the arm in front of the closed door's knob, fingers open.  ValueError where the knob is out of reach."""
    q = solve_pose(scene, np.array(PLAN.pose), *grasp_pose(scene, 0.0, 0.0, PLAN.roll))
    for standoff in np.linspace(0.0, task.standoff, 10):
        q = solve_pose(scene, q, *grasp_pose(scene, 0.0, standoff, PLAN.roll))
    arm = dict(zip(scene.joints, q.tolist(), strict=True))
    return scene.initial_qpos({**arm, **dict.fromkeys(scene.finger_joints, OPEN)})
