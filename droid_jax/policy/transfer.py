"""A policy on the stand-in robot: plain MuJoCo C, a fine time step, hidden values and effects, noisy sensors.

The loop that closes it is the one that goes to a real robot, `control.Controller`.

It stands for the paper's robot in Table II, and is called a stand-in wherever its figures are shown.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import scipy.stats

from droid_jax.measure.hidden import HIDDEN, Applied
from droid_jax.measure.hidden_hooks import Influence, Live, Place, edited
from droid_jax.measure.surrogate import own_engine
from droid_jax.model.door import door_nuisances, door_space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene
from droid_jax.policy.control import Controller, Policy, Reading
from droid_jax.policy.hand import finger_forces_c, hand_of, looked
from droid_jax.policy.task import Task, gripped, holding, succeeded


@dataclass(frozen=True)
class TransferConfig:
    """How the stand-in robot differs from what the policy was trained on, beside its hidden values.

    trials.  timestep: s, of the Euler integrator.  position_noise, velocity_noise: rad, rad/s of the joints' sensors;
    knob_noise: m, of the camera's sight of the knob, drawn once for each trial and axis.  seed.
    """

    trials: int = 100
    timestep: float = 0.0005
    position_noise: float = 1e-4
    velocity_noise: float = 5e-3
    knob_noise: float = 1e-3
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Transfer:
    """What came of the trials.

    success: [N] bool.  angle: [N] rad, the largest; steps: [N] actions until success, or all there were;
    grip: [N] share of actions with the knob gripped.  stopped: [N] why the control loop stopped, "" where it did not.
    """

    success: np.ndarray
    angle: np.ndarray
    steps: np.ndarray
    grip: np.ndarray
    stopped: np.ndarray

    @property
    def rate(self) -> float:
        """Share of trials that succeeded."""
        return float(np.mean(self.success))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Of the success rate.  Wilson, JASA 1927."""
        count = scipy.stats.binomtest(int(np.sum(self.success)), len(self.success))
        span = count.proportion_ci(level, method="wilson")
        return float(span.low), float(span.high)


def transfer(
    policy: Policy,
    scene: Scene,
    start: np.ndarray,
    truth: Mapping[str, float],
    hidden: Sequence[Applied] = (),
    task: Task | None = None,
    config: TransferConfig | None = None,
) -> Transfer:
    """Trials of a policy on the stand-in robot.

    start: [nq] as in training (`DoorEnv.start`), off by `Task.spread` in every trial.  truth: hidden values, of the
    door space and its nuisances.  hidden: effects as of the blind suite.
    Raises ValueError for hidden effects that act on commands or sensors as whole traces: in a closed loop there are
    none yet; and for a policy that acts at another rate than the task's.
    """
    task, config = task or Task(), config or TransferConfig()
    if abs(policy.interface.period - task.control) > 1e-9:
        raise ValueError(f"the policy acts every {policy.interface.period:g} s, the task asks every {task.control:g} s")
    unfit = [a.name for a in hidden if _acts_on_traces(scene, a)]
    if unfit:
        raise ValueError(
            f"hidden effects {', '.join(unfit)} change whole traces, which a closed loop does not have yet"
        )
    stand_in = robot(scene, truth, config.timestep)
    rngs = np.random.default_rng(config.seed).spawn(config.trials)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = list(pool.map(lambda rng: _trial(policy, stand_in, start, hidden, task, config, rng), rngs))
    return Transfer(*(np.array(column) for column in zip(*done, strict=True)))


def robot(scene: Scene, truth: Mapping[str, float], timestep: float) -> Scene:
    """The scene with hidden values, at the stand-in's own time step, integrator and solver effort."""
    space = door_space(scene) + door_nuisances(scene)
    model = make_c_model(scene, space, space.values(dict(truth)))
    return replace(scene, model=own_engine(model, timestep))


def _trial(
    policy: Policy,
    stand_in: Scene,
    start: np.ndarray,
    hidden: Sequence[Applied],
    task: Task,
    config: TransferConfig,
    rng: np.random.Generator,
) -> tuple[bool, float, int, float, str]:
    """Success, largest angle, actions, share of them with the grip on, why the loop stopped."""
    influences = [_influence(stand_in, a) for a in hidden]
    model, hand, joints = edited(stand_in.model, influences), hand_of(stand_in), stand_in.joint_qpos
    data = mujoco.MjData(model)
    data.qpos[:] = start
    data.qpos[joints] += rng.normal(0.0, task.spread, len(joints))
    mujoco.mj_forward(model, data)
    advance = _stepper(model, data, influences, round(task.control / config.timestep))
    sense = _senses(stand_in, data, config, rng)
    seen = looked(hand, data, finger_forces_c(hand, model, data), np.zeros((2, 3)), task.control, np)
    loop = Controller(policy)
    held = longest = angle = 0.0
    grips = number = 0
    while number < task.steps and not succeeded(task, longest):
        asked = loop.act(sense(number * task.control))
        if asked.stopped is not None:
            break
        advance(np.concatenate([asked.arm, asked.fingers]))
        number += 1
        if not np.isfinite(data.qpos).all():
            break
        seen = looked(hand, data, finger_forces_c(hand, model, data), seen.pads, task.control, np)
        grips += bool(gripped(task, seen))
        angle, held = max(angle, float(seen.angle)), float(holding(task, seen, held))
        longest = max(longest, held)
    return bool(succeeded(task, longest)), angle, number, grips / max(number, 1), loop.stopped or ""


def _senses(
    stand_in: Scene, data: mujoco.MjData, config: TransferConfig, rng: np.random.Generator
) -> Callable[[float], Reading]:
    """What the robot's sensors say at a time; the camera's error is drawn once."""
    joints, dofs, knob = stand_in.joint_qpos, stand_in.joint_dofs, stand_in.id("site", "knob")
    fingers = [stand_in.qpos(name) for name in stand_in.command_names if name not in stand_in.joints]
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


def _stepper(model: mujoco.MjModel, data: mujoco.MjData, influences: Sequence[Influence], steps: int) -> Any:
    """A function of a command [U] that advances the simulation by so many steps."""
    live, own_loss = Live.of(model, data), model.dof_frictionloss.copy()
    for influence in influences:
        if influence.begin:
            influence.begin(live)
    each = [i.step for i in influences if i.step]

    def plain(ctrl: np.ndarray) -> None:
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=steps)

    def influenced(ctrl: np.ndarray) -> None:
        for _ in range(steps):
            live.control[:], live.applied[:], live.gear[:], live.loss[:] = ctrl, 0.0, 0.0, own_loss
            for step in each:
                step(live)
            mujoco.mj_step(model, data)

    return influenced if each else plain


def _influence(scene: Scene, one: Applied) -> Influence:
    joints = (one.joint,) if one.joint else scene.joints
    return HIDDEN[one.name].make(Place(scene, joints), one.amplitude)


def _acts_on_traces(scene: Scene, one: Applied) -> bool:
    found = _influence(scene, one)
    return found.command is not None or found.sense is not None
