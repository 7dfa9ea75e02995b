"""The environment against plain C MuJoCo: the same commands, the same door, the same grip."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from brax.envs.base import State
from scripted import action, opening

from droid_jax import runtime
from droid_jax.door.environment import PAST, DoorEnv, World
from droid_jax.door.hand import finger_forces_c, hand_of, looked
from droid_jax.door.scene import door_scene
from droid_jax.door.task import Task
from droid_jax.model.effects.registry import library
from droid_jax.model.physics import Physics
from droid_jax.policy.control import ACTIONS, OBSERVED, Safety, limited

TASK = Task()
SECONDS, TO = 2.4, 0.5  # of the scripted opening, rad


@pytest.fixture(scope="module")
def env() -> DoorEnv:
    return DoorEnv(door_scene(timestep=0.004, limits=True), TASK)


@pytest.fixture(scope="module")
def script(env: DoorEnv) -> np.ndarray:
    """[K, 9] commands: to the knob, grip, open."""
    return opening(env.scene, TASK, SECONDS, TO)


@pytest.fixture(scope="module")
def rolled(env: DoorEnv, script: np.ndarray) -> Callable[[State], dict[str, np.ndarray]]:
    """What MJX makes of the script from a state, each command turned into the action that asks for it.

    One program for all tests: it compiles for longer than it runs.
    """

    def act(state, target):
        position = state.pipeline_state.moving.qpos[env.scene.joint_qpos]
        action = jax.numpy.concatenate([(target[:7] - position) / TASK.reach, 2 * target[7:] / TASK.width - 1])
        state = env.step(state, action)
        world, metrics = state.pipeline_state, state.metrics
        shown = {name: metrics[name] for name in ("angle", "grip", "blown_up")}
        return state, {**shown, "qpos": world.moving.qpos, "obs": state.obs, "reward": state.reward, "done": state.done}

    def roll(start):
        return jax.lax.scan(act, start, np.asarray(script, np.float32))[1]

    compiled = jax.jit(roll, compiler_options=runtime.compiler_options())
    return lambda start: jax.tree.map(np.asarray, compiled(start))


@pytest.fixture(scope="module")
def reset(env: DoorEnv) -> Callable[[jax.Array], State]:
    """Compiled: op by op it takes longer."""
    return jax.jit(env.reset, compiler_options=runtime.compiler_options())


@pytest.fixture(scope="module")
def start(reset: Callable[[jax.Array], State]) -> State:
    return reset(jax.random.key(0))


@pytest.fixture(scope="module")
def trained_on(rolled: Callable[[State], dict[str, np.ndarray]], start: State) -> dict[str, np.ndarray]:
    return rolled(start)


@pytest.fixture(scope="module")
def in_c(env: DoorEnv, script: np.ndarray, start: State) -> dict[str, np.ndarray]:
    """The same commands in C at 0.5 ms, from the same start."""
    scene = door_scene(timestep=0.0005, limits=True)
    model, hand = scene.model, hand_of(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(start.pipeline_state.moving.qpos)
    out, last = {"angle": [], "force": [], "yaw": [], "pads": []}, np.zeros((2, 3))
    for target in script:
        position = data.qpos[scene.joint_qpos]
        asked = limited(env.interface, Safety(), position, action(TASK, position, target))
        data.ctrl[:] = np.append(asked.arm, asked.fingers)
        for _ in range(round(TASK.control / 0.0005)):
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        seen = looked(hand, data, finger_forces_c(hand, model, data), last, TASK.control, np)
        last = seen.pads
        for name, values in out.items():
            values.append(getattr(seen, name))
    return {name: np.array(values) for name, values in out.items()}


def test_the_door_opens_as_in_c(trained_on, in_c):
    assert in_c["angle"].max() > 0.9 * TO
    np.testing.assert_allclose(trained_on["angle"], in_c["angle"], atol=np.deg2rad(1.0))


def test_the_grip_is_on_where_c_presses_with_both_fingers(trained_on, in_c):
    pressed = np.all(in_c["force"] >= TASK.force, axis=1) & (np.abs(in_c["yaw"]) < TASK.yaw)
    assert pressed[-50:].all() and not pressed[:40].any()
    assert np.mean(trained_on["grip"].astype(bool) == pressed) > 0.97


def test_observations_are_what_c_sees(trained_on, in_c):
    """Pads to a tenth of a millimetre; while the fingers snap shut, to their way in a time step."""
    apart = np.abs(trained_on["obs"][:, -6:] - in_c["pads"].reshape(-1, 6))
    assert apart.max() < 3e-3
    assert np.median(apart) < 1e-4 and np.quantile(apart, 0.99) < 1e-3


def test_the_reward_rises_as_the_door_opens(trained_on):
    assert trained_on["reward"][-1] > trained_on["reward"][70] > trained_on["reward"][0]
    assert np.isfinite(trained_on["reward"]).all()


def test_sizes(env: DoorEnv, reset: Callable[[jax.Array], State], start: State):
    assert start.obs.shape == (env.observation_size,) == (OBSERVED,)
    assert env.action_size == ACTIONS == 9
    assert not np.allclose(start.obs, reset(jax.random.key(2)).obs)


@pytest.mark.parametrize("speed", [1e6, np.nan])
def test_a_simulation_that_comes_apart_ends_the_episode_and_is_counted(rolled, start: State, trained_on, speed: float):
    """Also where it is still a number: one such observation would spoil the normalisation of all."""
    assert not trained_on["done"].any() and not trained_on["blown_up"].any()
    world: Any = start.pipeline_state
    moving = world.moving._replace(qvel=world.moving.qvel.at[2].set(speed))
    found = rolled(start.replace(pipeline_state=world._replace(moving=moving)))  # pyright: ignore
    assert (found["done"][0], found["blown_up"][0], found["reward"][0]) == (1.0, 1.0, 0.0)
    np.testing.assert_array_equal(found["qpos"][0], world.moving.qpos)


@pytest.mark.slow
def test_effects_of_an_extended_model_act_here_too(env: DoorEnv):
    """At neutral nothing; a preload that pushes the door open; a command that comes an action late."""
    scene = door_scene(timestep=0.004, limits=True)
    extended = DoorEnv(scene, TASK, library(scene, ("hinge_preload", "command_delay")))
    hinge, arm = scene.qpos("hinge"), scene.joint_qpos

    def moved(env: DoorEnv, **theta: float) -> np.ndarray:
        """[nq] how far two actions of one move everything."""

        @jax.jit
        def run(values):
            env.sys = Physics(env.scene.mjx, values)
            first = env.reset(jax.random.key(0))
            state = env.step(env.step(first, jax.numpy.ones(9)), jax.numpy.ones(9))
            return state.pipeline_state.moving.qpos - first.pipeline_state.moving.qpos

        before = env.sys
        try:
            return np.asarray(run({name: jax.numpy.float32(value) for name, value in theta.items()}))
        finally:
            env.sys = before

    plain, neutral = moved(env), moved(extended, hinge_preload=0.0, command_delay=0.0)
    np.testing.assert_allclose(neutral, plain, atol=1e-5)
    pushed = moved(extended, hinge_preload=-2.0, command_delay=0.0)
    assert pushed[hinge] > plain[hinge] + 1e-4
    late = moved(extended, hinge_preload=0.0, command_delay=TASK.control)
    assert np.all(np.abs(late[arm]) < 0.7 * np.abs(plain[arm])) and np.all(np.abs(plain[arm]) > 1e-3)


def test_the_clock_of_a_recording_is_not_the_control_loops(env: DoorEnv):
    """Late in an episode the servo got a command of three actions before."""
    extended = DoorEnv(env.scene, TASK, library(env.scene, ("clock_rate",)))
    number, commands = jax.numpy.float32, jax.numpy.arange(PAST)[:, None] * jax.numpy.ones(9)
    nothing: Any = None  # that this does not read
    world = World(nothing, commands, nothing, number(9.0), nothing, nothing)
    np.testing.assert_array_equal(extended._command({"clock_rate": number(-0.01)}, world.time, world), commands[-1])


def test_a_time_step_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"0\.02 s, is no multiple of the scene's time step, 0\.003 s"):
        DoorEnv(door_scene(timestep=0.003, limits=True), TASK)


def test_other_actuators_than_the_policys_are_refused():
    """Fingers before the arm: joint angles would become the fingers' commands."""
    scene = door_scene(limits=True)
    turned = dataclasses.replace(scene, command_names=(*scene.finger_joints, *scene.joints))
    with pytest.raises(ValueError, match=r"of the arm and then of the fingers, and the actuators .* are panda_finger"):
        DoorEnv(turned, TASK)
