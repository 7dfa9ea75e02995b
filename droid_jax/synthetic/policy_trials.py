"""A policy on the synthetic robot: plain MuJoCo C, a fine time step, hidden values and effects, noisy sensors.

The loop that closes it is the one that goes to a real robot, `control.Controller`.

It stands for the paper's robot in Table II, and is called a synthetic robot wherever its figures are shown.
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
from droid_jax.synthetic.hidden_effects import LONGEST_STEP, Applied, at_work, check
from droid_jax.synthetic.hooks import Influence, edited, under
from droid_jax.synthetic.robot import own_engine

TRIAL = 4  # a stream of its own: those of the hidden errors are [seed, 1] to [seed, 3]


@dataclass(frozen=True)
class TransferConfig:
    """How the synthetic robot differs from what the policy was trained on, beside its hidden values.

    trials.  timestep: s, of the Euler integrator; hidden effects shorten it where they must.
    position_noise, velocity_noise: rad, rad/s of the joints' sensors; knob_noise: m, of the camera's sight of the
    knob, drawn once for each trial and axis.  seed.
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

    scene: with the hidden values, at the robot's own time step, integrator and solver effort.  start: [nq].
    hidden: effects, as of the blind suite.
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
    """A robot with hidden values and effects.

    start: [nq] as in training (`DoorEnv.start`), off by `Task.spread` in every trial.  truth: hidden values, of the
    door space and its nuisances; what it leaves out is at its prior's mean.
    Raises ValueError for unknown effects and amplitudes, and for hidden effects that act on commands or sensors as
    whole traces: in a closed loop there are none yet.
    """
    task, config = task or Task(), config or TransferConfig()
    check_playable(scene, hidden)
    if hidden:
        config = replace(config, timestep=min(config.timestep, LONGEST_STEP))
    substeps_of(task.control, config.timestep, "the synthetic robot's")
    space = door_space(scene) + door_nuisances(scene)
    model = make_c_model(scene, space, space.values(dict(truth)))
    own = replace(scene, model=own_engine(model, config.timestep))
    return PolicyRobot(own, start, tuple(hidden), task, config)


def check_playable(scene: Scene, hidden: Sequence[Applied]) -> None:
    """ValueError for hidden effects that a policy cannot be tried with."""
    for one in hidden:
        check(one, scene)
    unfit = [a.name for a in hidden if _acts_on_traces(scene, a)]
    if unfit:
        raise ValueError(
            f"hidden effects {', '.join(unfit)} change whole traces, which a closed loop does not have yet: "
            "choose others, or none"
        )


def transfer(policy: Policy, robot: PolicyRobot, progress: Callable[[int], None] = lambda done: None) -> Trials:
    """Trials of a policy on the synthetic robot.  ValueError for a policy that acts at another rate than the task's.

    progress: is told how many trials are over.
    """
    _check_rate(policy, robot.task)
    done = []
    with ThreadPoolExecutor(runtime.cores()) as pool:
        for trial in pool.map(lambda number: _trial(policy, robot, number), range(robot.config.trials)):
            done.append(trial)
            progress(len(done))
    return Trials(*(np.array(column) for column in zip(*done, strict=True)))


def filmed(policy: Policy, robot: PolicyRobot, number: int) -> np.ndarray:
    """[K, nq] the states of one of `transfer`'s trials, before each action and at the end."""
    states: list[np.ndarray] = []
    watched(policy, robot, number, lambda data: states.append(data.qpos.copy()))
    return np.array(states)


def watched(policy: Policy, robot: PolicyRobot, number: int, watch: Callable[[mujoco.MjData], None]) -> None:
    """One of `transfer`'s trials again; watch: sees the simulation before each action and at the end."""
    _check_rate(policy, robot.task)
    _trial(policy, robot, number, watch)


def _check_rate(policy: Policy, task: Task) -> None:
    if abs(policy.interface.period - task.control) > 1e-9:
        raise ValueError(f"the policy acts every {policy.interface.period:g} s, the task asks every {task.control:g} s")


def _trial(
    policy: Policy, robot: PolicyRobot, number: int, watch: Callable[[mujoco.MjData], None] = lambda data: None
) -> tuple[bool, float, int, float, str]:
    """Success, largest angle, actions, share of them with the grip on, why the loop stopped."""
    scene, task, config = robot.scene, robot.task, robot.config
    rng = np.random.default_rng([config.seed, number, TRIAL])
    influences = at_work(scene, robot.hidden)
    model, hand = edited(scene.model, influences), hand_of(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.start
    data.qpos[scene.joint_qpos] += rng.normal(0.0, task.spread, len(scene.joints))
    mujoco.mj_forward(model, data)
    advance = _advancer(model, data, influences, substeps_of(task.control, config.timestep, "the synthetic robot's"))
    sense = _senses(scene, data, config, rng)
    seen = looked(hand, data, finger_forces_c(hand, model, data), np.zeros((2, 3)), task.control, np)
    loop = Controller(policy)
    held = longest = angle = 0.0
    grips = made = steps = 0
    stopped = ""
    watch(data)
    while made < task.steps:
        asked = loop.act(sense(made * task.control))
        if asked.stopped is not None:
            stopped = asked.stopped
            break
        advance(np.concatenate([asked.arm, asked.fingers]))
        made += 1
        if not np.isfinite(data.qpos).all() or data.time < (made - 0.5) * task.control:
            stopped = BLOWN_UP  # MuJoCo starts over then: its clock is late
            break
        watch(data)
        mujoco.mj_kinematics(model, data)  # mj_step leaves places as they were before its last step
        seen = looked(hand, data, finger_forces_c(hand, model, data), seen.pads, task.control, np)
        grips += bool(gripped(task, seen))
        angle, held = max(angle, float(seen.angle)), float(held_open(task, seen, held))
        steps += not succeeded(task, longest)
        longest = max(longest, held)
    return bool(succeeded(task, longest)), angle, steps, grips / max(made, 1), stopped


def _senses(
    scene: Scene, data: mujoco.MjData, config: TransferConfig, rng: np.random.Generator
) -> Callable[[float], Reading]:
    """What the robot's sensors say at a time; the camera's error is drawn once."""
    joints, dofs, knob = scene.joint_qpos, scene.joint_dofs, scene.id("site", "knob")
    fingers = [scene.qpos(name) for name in scene.finger_joints]
    sight, pose = rng.normal(0.0, config.knob_noise, 3), np.eye(4)

    def sense(time: float) -> Reading:
        pose[:3, :3], pose[:3, 3] = data.site_xmat[knob].reshape(3, 3), data.site_xpos[knob] - sight
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
    """A function of a command [U] that takes the simulation so many steps on."""
    _, step = under(model, data, influences)

    def plain(ctrl: np.ndarray) -> None:
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=steps)  # all in C

    def influenced(ctrl: np.ndarray) -> None:
        for _ in range(steps):
            step(ctrl)

    return influenced if any(i.step for i in influences) else plain


def _acts_on_traces(scene: Scene, one: Applied) -> bool:
    (found,) = at_work(scene, [one])
    return found.command is not None or found.sense is not None
