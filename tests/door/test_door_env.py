"""The environment against plain C MuJoCo: the same commands, the same door, the same grip."""

from __future__ import annotations

import dataclasses

import jax
import mujoco
import numpy as np
import pytest
from scripted import action, opening

from droid_jax import runtime
from droid_jax.door.environment import DoorEnv
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
def trained_on(env: DoorEnv, script: np.ndarray) -> dict[str, np.ndarray]:
    """What MJX makes of the script, each command turned into the action that asks for it."""

    def act(state, target):
        position = state.pipeline_state.qpos[env.scene.joint_qpos]
        action = jax.numpy.concatenate([(target[:7] - position) / TASK.reach, 2 * target[7:] / TASK.width - 1])
        state = env.step(state, action)
        world, metrics = state.pipeline_state, state.metrics
        return state, (metrics["angle"], metrics["grip"], world.qpos, state.obs, world.longest, state.reward)

    def roll(script):
        return jax.lax.scan(act, env.reset(jax.random.key(0)), script)[1]

    rolled = jax.jit(roll, compiler_options=runtime.compiler_options())
    names = ("angle", "grip", "qpos", "obs", "longest", "reward")
    return dict(zip(names, map(np.asarray, rolled(np.asarray(script, np.float32))), strict=True))


@pytest.fixture(scope="module")
def in_c(env: DoorEnv, script: np.ndarray, trained_on: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same commands in C at 0.5 ms, from the same start."""
    scene = door_scene(timestep=0.0005, limits=True)
    model, hand = scene.model, hand_of(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(env.reset(jax.random.key(0)).pipeline_state.qpos)
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


def test_sizes(env: DoorEnv):
    state = env.reset(jax.random.key(1))
    assert state.obs.shape == (env.observation_size,) == (OBSERVED,)
    assert env.action_size == ACTIONS == 9
    assert not np.allclose(state.obs, env.reset(jax.random.key(2)).obs)


def test_a_simulation_that_comes_apart_ends_the_episode_and_is_counted(env: DoorEnv):
    """Also where it is still a number: one such observation would spoil the normalisation of all."""
    step = jax.jit(env.step, compiler_options=runtime.compiler_options())
    start = env.reset(jax.random.key(0))
    usual = step(start, np.zeros(9))
    assert (float(usual.done), float(usual.metrics["blown_up"])) == (0.0, 0.0)
    for speed in (1e6, np.nan):
        world = start.pipeline_state
        fast = start.replace(pipeline_state=world._replace(qvel=world.qvel.at[2].set(speed)))
        after = step(fast, np.zeros(9))
        assert (float(after.done), float(after.metrics["blown_up"]), float(after.reward)) == (1.0, 1.0, 0.0)
        expected = fast.pipeline_state.qpos
        np.testing.assert_array_equal(after.pipeline_state.qpos, expected)


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
            return state.pipeline_state.qpos - first.pipeline_state.qpos

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


def test_a_time_step_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"0\.02 s, is no multiple of the scene's time step, 0\.003 s"):
        DoorEnv(door_scene(timestep=0.003, limits=True), TASK)


def test_other_actuators_than_the_policys_are_refused():
    """Fingers before the arm: joint angles would become the fingers' commands."""
    scene = door_scene(limits=True)
    turned = dataclasses.replace(scene, command_names=(*scene.finger_joints, *scene.joints))
    with pytest.raises(ValueError, match=r"of the arm and then of the fingers, and the actuators .* are panda_finger"):
        DoorEnv(turned, TASK)
