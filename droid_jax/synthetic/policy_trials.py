"""Trials of a policy on the synthetic robot, in plain C MuJoCo with hidden values and effects and noisy sensors.

The control loop is the one of a real robot, `control.Controller`.  The synthetic robot replaces the real one of the
paper's Table II, and reports call it a synthetic robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np

from droid_jax import runtime
from droid_jax.arguments import check_fields, number, whole
from droid_jax.door.hand import finger_forces_c, hand_of, looked
from droid_jax.door.space import door_nuisances, door_space
from droid_jax.door.task import Task, gripped, held_open, substeps_of, succeeded
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene
from droid_jax.policy.control import Controller, Policy, Reading
from droid_jax.policy.trials import BLOWN_UP, Trials
from droid_jax.synthetic.hidden_effects import LONGEST_STEP, Applied, check, influences_of
from droid_jax.synthetic.hooks import Influence, edited, start_simulation
from droid_jax.synthetic.robot import set_engine

TRIAL = 4  # random stream of trials; the synthetic robot's recordings use [seed, 1] to [seed, 3]


@dataclass(frozen=True)
class TransferConfig:
    """Trials, time step and sensor noise of the synthetic robot.

    Attributes:
        trials: number of trials.
        timestep: s, of the Euler integrator; at most LONGEST_STEP with hidden effects.
        position_noise: rad, standard deviation of the joint position sensors.
        velocity_noise: rad/s, of the joint velocity sensors.
        knob_noise: m, of the knob's position by the camera, drawn once for each trial and axis.
        seed: of all randomness.
    """

    trials: int = 100
    timestep: float = 0.0005
    position_noise: float = 1e-4
    velocity_noise: float = 5e-3
    knob_noise: float = 1e-3
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(
            self,
            **dict.fromkeys(("position_noise", "velocity_noise", "knob_noise"), partial(number, least=0)),
            trials=partial(whole, least=1),
            timestep=partial(number, above=0),
            seed=partial(whole, least=0),
        )


@dataclass(frozen=True, eq=False)
class PolicyRobot:
    """The synthetic robot before a trial; `synthetic_robot` makes it.

    Attributes:
        scene: with the hidden values, and the robot's time step, integrator and solver settings.
        start: [nq] mean start pose.
        hidden: effects.
        task: of the policy.
        config: noise and number of trials.
    """

    scene: Scene
    start: np.ndarray
    hidden: tuple[Applied, ...]
    task: Task
    config: TransferConfig


def synthetic_robot(
    scene: Scene,
    start: np.ndarray,
    truth: Mapping[str, float],
    hidden: Sequence[Applied] = (),
    task: Task | None = None,
    config: TransferConfig | None = None,
) -> PolicyRobot:
    """A synthetic robot with hidden values and effects, for trials of a policy.

    Args:
        scene: the door.
        start: [nq] mean start pose, as in training (`DoorEnv.start`); `Task.spread` varies it in each trial.
        truth: hidden values of the door's space and its nuisances; others are at the prior's mean.
        hidden: effects.
        task: of the policy.
        config: noise and number of trials.

    Returns:
        The robot.

    Raises:
        ValueError: an effect or amplitude is invalid, or an effect acts on whole traces of commands or sensors, which
            a closed loop does not support.
    """
    task, config = task or Task(), config or TransferConfig()
    check_playable(scene, hidden)
    if hidden:
        config = replace(config, timestep=min(config.timestep, LONGEST_STEP))
    substeps_of(task.control, config.timestep, "the synthetic robot's")
    space = door_space(scene) + door_nuisances(scene)
    model = make_c_model(scene, space, space.values(dict(truth)))
    return PolicyRobot(replace(scene, model=set_engine(model, config.timestep)), start, tuple(hidden), task, config)


def check_playable(scene: Scene, hidden: Sequence[Applied]) -> None:
    """Raise ValueError for hidden effects that are invalid or that a closed loop does not support."""
    for one in hidden:
        check(one, scene)
    unsupported = [a.name for a in hidden if _acts_on_traces(scene, a)]
    if unsupported:
        raise ValueError(
            f"hidden effects {', '.join(unsupported)} change whole traces, which trials of a policy do not support: "
            "choose others, or none"
        )


def transfer(policy: Policy, robot: PolicyRobot, progress: Callable[[int], None] = lambda done: None) -> Trials:
    """Outcomes of all trials of a policy on the synthetic robot.

    progress: is called with the number of finished trials.
    Raises ValueError for a policy that acts at another rate than the task.
    """
    _check_rate(policy, robot.task)
    outcomes = []
    with ThreadPoolExecutor(runtime.cores()) as pool:
        for outcome in pool.map(lambda number: _trial(policy, robot, number), range(robot.config.trials)):
            outcomes.append(outcome)
            progress(len(outcomes))
    return Trials(*(np.array(column) for column in zip(*outcomes, strict=True)))


def filmed(policy: Policy, robot: PolicyRobot, number: int) -> np.ndarray:
    """[K, nq] positions in trial `number` of `transfer`, before each action and at the end."""
    states: list[np.ndarray] = []
    watched(policy, robot, number, lambda data: states.append(data.qpos.copy()))
    return np.array(states)


def watched(policy: Policy, robot: PolicyRobot, number: int, watch: Callable[[mujoco.MjData], None]) -> None:
    """Repeat trial `number` of `transfer`; `watch` is called before each action and at the end."""
    _check_rate(policy, robot.task)
    _trial(policy, robot, number, watch)


def _check_rate(policy: Policy, task: Task) -> None:
    if abs(policy.interface.period - task.control) > 1e-9:
        raise ValueError(f"the policy acts every {policy.interface.period:g} s, the task every {task.control:g} s")


def _trial(
    policy: Policy, robot: PolicyRobot, number: int, watch: Callable[[mujoco.MjData], None] = lambda data: None
) -> tuple[bool, float, int, float, str]:
    """Success, largest angle [rad], number of actions until success, share of actions with a grip, reason of a stop."""
    scene, task, config = robot.scene, robot.task, robot.config
    rng = np.random.default_rng([config.seed, number, TRIAL])
    influences = influences_of(scene, robot.hidden)
    model, hand = edited(scene.model, influences), hand_of(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.start
    data.qpos[scene.joint_qpos] += rng.normal(0.0, task.spread, len(scene.joints))
    mujoco.mj_forward(model, data)
    advance = _advancer(model, data, influences, substeps_of(task.control, config.timestep, "the synthetic robot's"))
    sense = _senses(scene, data, config, rng)
    seen = looked(hand, data, finger_forces_c(hand, model, data), np.zeros((2, 3)), task.control, np)
    loop = Controller(policy)
    open_time = longest = angle = 0.0
    grips = actions = steps = 0
    stopped = ""
    watch(data)
    while actions < task.steps:
        command = loop.act(sense(actions * task.control))
        if command.stopped is not None:
            stopped = command.stopped
            break
        advance(np.concatenate([command.arm, command.fingers]))
        actions += 1
        if not np.isfinite(data.qpos).all() or data.time < (actions - 0.5) * task.control:
            stopped = BLOWN_UP  # MuJoCo resets a simulation that diverges: its clock is late then
            break
        watch(data)
        mujoco.mj_kinematics(model, data)  # after mj_step, frames are those before its last step
        seen = looked(hand, data, finger_forces_c(hand, model, data), seen.pads, task.control, np)
        grips += bool(gripped(task, seen))
        angle, open_time = max(angle, float(seen.angle)), float(held_open(task, seen, open_time))
        steps += not succeeded(task, longest)
        longest = max(longest, open_time)
    return bool(succeeded(task, longest)), angle, steps, grips / max(actions, 1), stopped


def _senses(
    scene: Scene, data: mujoco.MjData, config: TransferConfig, rng: np.random.Generator
) -> Callable[[float], Reading]:
    """A function of time [s] that gives the sensors' reading; the camera's error is drawn once."""
    joints, dofs, knob = scene.joint_qpos, scene.joint_dofs, scene.id("site", "knob")
    fingers = [scene.qpos(name) for name in scene.finger_joints]
    camera_error, pose = rng.normal(0.0, config.knob_noise, 3), np.eye(4)

    def sense(time: float) -> Reading:
        pose[:3, :3], pose[:3, 3] = data.site_xmat[knob].reshape(3, 3), data.site_xpos[knob] - camera_error
        return Reading(
            time,
            data.qpos[joints] + rng.normal(0.0, config.position_noise, len(joints)),
            data.qvel[dofs] + rng.normal(0.0, config.velocity_noise, len(joints)),
            data.qfrc_actuator[dofs].copy(),
            data.qpos[fingers].copy(),
            pose,
        )

    return sense


def _advancer(
    model: mujoco.MjModel, data: mujoco.MjData, influences: Sequence[Influence], steps: int
) -> Callable[[np.ndarray], None]:
    """A function of a command [U] that makes so many time steps."""
    _, step = start_simulation(model, data, influences)

    def without_effects(ctrl: np.ndarray) -> None:
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=steps)  # all in C

    def with_effects(ctrl: np.ndarray) -> None:
        for _ in range(steps):
            step(ctrl)

    return with_effects if any(i.step for i in influences) else without_effects


def _acts_on_traces(scene: Scene, one: Applied) -> bool:
    (influence,) = influences_of(scene, [one])
    return influence.command is not None or influence.sense is not None
