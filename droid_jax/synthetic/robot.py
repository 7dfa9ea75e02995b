"""The synthetic robot: plain C MuJoCo with hidden physics, in place of a real Panda and a real door.

Its time step and integrator differ from those of the analysis, and its parameter values are hidden.  Repeats differ by
small errors, and sensors have the noise of a real Panda.  Its torques are motor-side by default, since a link-side
torque does not contain the simulated servo's damping (Table I).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np
import scipy.signal

from droid_jax.arguments import check_fields, choice, number, several, whole
from droid_jax.door.scene import HINGE
from droid_jax.door.space import JOINT_DAMPING, door_nuisances, door_space, torque_offsets
from droid_jax.door.space import truth as table_i
from droid_jax.files import SYNTHETIC_SOURCE as SOURCE
from droid_jax.model.fields import time_offset
from droid_jax.model.inertia import nominal_field
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import TINY_FRICTIONLOSS, Scene
from droid_jax.recordings.checks import validate
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.c_engine import Trace, instrument, simulate


@dataclass(frozen=True)
class SyntheticRobotConfig:
    """Repeats, integration and sensors of the synthetic robot.  Noise is given by standard deviations.

    Attributes:
        repeats: number of repeats N.
        timestep: s, of C MuJoCo's semi-implicit Euler, a first-order integrator.  The default approximates continuous
            time; the second-order steps of the analysis are 20 or 40 times as long.  At 0.25 ms a door's recordings
            have U of about 0.001 that no parameter explains, so a search may report a missing effect.
        rate: Hz, of torque and position samples.
        torque_noise: N m, white, of joints 1-4 and of joints 5-7 (a real Panda: 0.03 to 0.08 at 1 kHz).
        torque_drift: N m, first-order noise, of joints 1-4 and of joints 5-7.
        drift_time: s, correlation time of that noise.
        position_noise: rad, white.
        angle_noise: rad, of a camera that measures the door's angle.
        angle_rate: Hz, of that camera.
        start_noise: rad, error of the start pose in each repeat.
        pose_noise: m, error of the door's position in each repeat.
        side: of the joints on which torques are measured.
    """

    repeats: int = 10
    timestep: float = 0.0001
    rate: float = 500.0
    torque_noise: tuple[float, float] = (0.05, 0.03)
    torque_drift: tuple[float, float] = (0.03, 0.015)
    drift_time: float = 0.15
    position_noise: float = 2e-5
    angle_noise: float = 0.0035
    angle_rate: float = 30.0
    start_noise: float = 2e-4
    pose_noise: float = 1e-4
    side: TorqueSide = TorqueSide.MOTOR

    def __post_init__(self) -> None:
        noises = ("position_noise", "angle_noise", "start_noise", "pose_noise")
        check_fields(
            self,
            **dict.fromkeys(noises, partial(number, least=0)),
            **dict.fromkeys(("torque_noise", "torque_drift"), several(partial(number, least=0), 2)),
            **dict.fromkeys(("timestep", "rate", "angle_rate", "drift_time"), partial(number, above=0)),
            repeats=partial(whole, least=1),
            side=partial(choice, kind=TorqueSide),
        )


@dataclass(frozen=True, eq=False)
class SyntheticRobot:
    """The synthetic robot before it moves, and the motion that it will repeat.

    Attributes:
        demonstration, truth, config, seed: arguments of `record`.
        scene: instrumented, with the synthetic robot's time step and integrator.
        models: [N] models of the repeats, with their errors.
        qpos0: [N, nq] start poses of the repeats, with their errors.
        clock: [T] s, at the synthetic robot's time step.
        control: [T, U] commands on that clock.
        rng: random generator for the sensors.
    """

    demonstration: Recording
    truth: Mapping[str, float]
    config: SyntheticRobotConfig
    seed: int
    scene: Scene
    models: list[mujoco.MjModel]
    qpos0: np.ndarray
    clock: np.ndarray
    control: np.ndarray
    rng: np.random.Generator


_WRIST = 4  # index of the first joint with the smaller noise


def draw_nuisances(scene: Scene, seed: int) -> dict[str, float]:
    """One draw from the nuisances' priors, by name: the set-up of a robot and a door."""
    space = door_nuisances(scene)
    draw = np.random.default_rng([seed, 1]).normal(space.mean, space.std)
    return dict(zip(space.names, np.clip(draw, space.low, space.high).tolist(), strict=True))


def record(
    scene: Scene,
    demonstration: Recording,
    truth: Mapping[str, float],
    *,
    seed: int,
    config: SyntheticRobotConfig | None = None,
    name: str | None = None,
) -> Recording:
    """Repeat a demonstration N times on the synthetic robot and record it.

    Args:
        scene: what moves.
        demonstration: whose commands are repeated.
        truth: hidden values by parameter name, of the door's space and its nuisances; others have the scene's values.
        seed: of all randomness.
        config: of the robot.
        name: of the recording; None: the demonstration's.

    Returns:
        The recording.

    Raises:
        ValueError: a name is unknown, or a repeat diverges or loses the door (choose another truth then).
    """
    config = config or SyntheticRobotConfig()
    synthetic_robot = set_up(scene, demonstration, truth, seed=seed, config=config)
    trace = simulate(
        synthetic_robot.scene, synthetic_robot.models, synthetic_robot.qpos0, synthetic_robot.control[None]
    )
    return as_recording(synthetic_robot, trace, sensor_torque(synthetic_robot, trace), trace.position, name=name)


def set_up(
    scene: Scene,
    demonstration: Recording,
    truth: Mapping[str, float],
    *,
    seed: int,
    config: SyntheticRobotConfig,
    space: Space | None = None,
) -> SyntheticRobot:
    """Models, start poses and commands of all repeats.

    The arguments are those of `record`.  space: the parameters that truth may name; None: those of a held door, else
    torque offsets and the time offset.
    """
    if config.repeats < 1:
        raise ValueError(f"the synthetic robot needs at least one repeat, got {config.repeats}")
    if not 0 < config.rate * config.timestep <= 1:
        raise ValueError(
            f"the synthetic robot measures at most once per time step, at {1 / config.timestep:g} Hz, got a rate of "
            f"{config.rate:g} Hz"
        )
    rng = np.random.default_rng([seed, 2])
    hidden = _hidden_scene(scene, config)
    nominal = hidden.initial_qpos(dict(demonstration.qpos0))
    models, qpos0 = _repeats(hidden, truth, nominal, config, rng, space)
    if config.side is TorqueSide.LINK:
        _check_link_side(hidden, models)
    clock, control = _control(hidden, demonstration, config.timestep, truth.get("time_offset", 0.0))
    return SyntheticRobot(demonstration, truth, config, seed, hidden, models, qpos0, clock, control, rng)


def as_recording(
    synthetic_robot: SyntheticRobot, trace: Trace, torque: np.ndarray, position: np.ndarray, *, name: str | None = None
) -> Recording:
    """The recording of a trace: torque and position [N, T, J] with offsets and noise, at the sensors' rates."""
    demonstration, config = synthetic_robot.demonstration, synthetic_robot.config
    scene, clock, rng = synthetic_robot.scene, synthetic_robot.clock, synthetic_robot.rng
    _check_opened(demonstration, clock, trace)
    every = round(1.0 / (config.rate * config.timestep))
    time = clock[::every]
    torque = torque[:, ::every] + _offset(scene, synthetic_robot.truth)
    channels = {
        "torque": _channel(
            "torque",
            scene.torque_unit(scene.joints),
            scene.joints,
            time,
            torque + _torque_noise(torque.shape, config, rng),
        ),
        "position": _channel(
            "position",
            scene.position_unit(scene.joints),
            scene.joints,
            time,
            position[:, ::every] + rng.normal(0, config.position_noise, torque.shape),
        ),
    }
    if scene.object_joint:
        channels["object_angle"] = _camera(scene, clock, trace.object_angle, config, rng)
    return validate(
        replace(
            demonstration,
            name=name or demonstration.name,
            channels=channels,
            torque=TorqueConvention(config.side, gravity=_carries_weight(scene)),
            meta={"source": SOURCE, "seed": str(synthetic_robot.seed)},
        )
    )


def _carries_weight(scene: Scene) -> bool:
    """Whether the measured torques contain gravity.

    They do if no body of a measured joint is compensated, or if the joints' actuators do it (actuatorgravcomp).
    """
    model = scene.model
    joints = [scene.id("joint", j) for j in scene.joints]
    excluded = (model.body_gravcomp[model.jnt_bodyid[joints]] != 0) & (model.jnt_actgravcomp[joints] == 0)
    return bool(model.opt.gravity.any()) and not excluded.any()


def _hidden_scene(scene: Scene, config: SyntheticRobotConfig) -> Scene:
    """The scene with sensors, and with the synthetic robot's time step, integrator and solver settings."""
    hidden = replace(scene, model=set_engine(copy.copy(scene.model), config.timestep))
    return replace(hidden, model=instrument(hidden))


def set_engine(model: mujoco.MjModel, timestep: float) -> mujoco.MjModel:
    """Set a model's time step, integrator and solver settings to the synthetic robot's, and return it."""
    model.opt.timestep, model.opt.integrator = timestep, mujoco.mjtIntegrator.mjINT_EULER
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    return model


def _repeats(
    hidden: Scene,
    truth: Mapping[str, float],
    nominal: np.ndarray,
    config: SyntheticRobotConfig,
    rng: np.random.Generator,
    space: Space | None,
) -> tuple[list[mujoco.MjModel], np.ndarray]:
    """Models [N] and start poses [N, nq] of the repeats, with their errors."""
    space = _space(hidden, truth, space)
    axes = [axis for axis in ("door_x", "door_y") if axis in space.names]
    models, poses = [], []
    for _ in range(config.repeats):
        values = space.values(dict(truth))
        for axis in axes:
            values[space.index(axis)] += rng.normal(0, config.pose_noise)
        models.append(make_c_model(hidden, space, values))
        pose = nominal.copy()
        pose[hidden.joint_qpos] += rng.normal(0, config.start_noise, len(hidden.joints))
        poses.append(pose)
    return models, np.array(poses)


def _space(hidden: Scene, truth: Mapping[str, float], space: Space | None) -> Space:
    """The parameters that truth may name, with the scene's values as means.

    Without a space: those of Table I and the nuisances of a door that is held, else torque offsets and the time offset.
    """
    if space is None and hidden.object_joint == HINGE and hidden.grip:
        space = door_space(hidden) + door_nuisances(hidden)
    elif space is None:
        space = Space((time_offset(), *torque_offsets(hidden.joints)))
    means = {p.name: (_value_in_scene(hidden, p), p.std) for p in space.parameters if p.writes and not p.nuisance}
    for name in truth:
        space.index(name)  # raises for an unknown name
    return space.with_prior(**means)


def _value_in_scene(scene: Scene, parameter: Parameter) -> float:
    """The parameter's value in the unchanged scene."""
    first = parameter.writes[0]
    return float(first.neutral(nominal_field(scene.model, first.field)[first.index]))


def _control(hidden: Scene, demonstration: Recording, timestep: float, delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Clock [T] s and commands [T, U] at the synthetic robot's time step, delayed by `delay` s."""
    columns = hidden.command_index(demonstration.command_names)
    if missing := [n for n, c in zip(hidden.command_names, columns, strict=True) if c < 0]:
        raise ValueError(
            f"the synthetic robot needs a command for {', '.join(missing)} too; the demonstration has none"
        )
    start, end = demonstration.time[0], demonstration.time[-1]
    clock = start + np.arange(int((end - start) / timestep + 1e-6) + 1) * timestep
    return clock, interpolate(clock - delay, demonstration.time, demonstration.command[:, columns])


def _check_opened(demonstration: Recording, clock: np.ndarray, trace: Trace) -> None:
    if not np.isfinite(trace.torque).all():
        raise ValueError("the synthetic robot's simulation became unstable with these values")
    window = demonstration.grip_window
    if window is None or trace.contact.shape[-1] == 0:
        return
    held = trace.contact[:, (clock >= window[0]) & (clock <= window[1])].all(axis=-1)
    lost = np.flatnonzero(held.mean(axis=1) < 0.99)
    if lost.size:
        raise ValueError(f"the synthetic robot lost its grasp in repeat {lost[0]} (too little friction for this door?)")


def _check_link_side(scene: Scene, models: Sequence[mujoco.MjModel]) -> None:
    """Raise ValueError for joints with dry friction, whose link-side torque no sensor of C MuJoCo measures."""
    friction = np.max([m.dof_frictionloss[scene.joint_dofs] for m in models], axis=0)
    limit = 1.001 * TINY_FRICTIONLOSS
    if affected := [joint for joint, loss in zip(scene.joints, friction, strict=True) if loss > limit]:
        raise ValueError(
            f"the synthetic robot cannot measure link-side torques of joints with a frictionloss "
            f"({', '.join(affected)}): remove it from the scene and hide 'dry_friction' or 'stribeck_friction', or "
            "measure at the motor"
        )


def sensor_torque(synthetic_robot: SyntheticRobot, trace: Trace) -> np.ndarray:
    """[N, T, J] N m, torques on the side of the configuration; link-side ones exclude armature and joint damping."""
    if synthetic_robot.config.side is TorqueSide.MOTOR:
        return trace.torque
    dofs = synthetic_robot.scene.joint_dofs
    acceleration = np.gradient(trace.velocity, synthetic_robot.config.timestep, axis=1)
    armature = np.array([m.dof_armature[dofs] for m in synthetic_robot.models])[:, None]
    damping = np.array([m.dof_damping[dofs] for m in synthetic_robot.models])[:, None]
    return trace.torque - armature * acceleration - damping * trace.velocity


def _offset(scene: Scene, truth: Mapping[str, float]) -> np.ndarray:
    """[J] N m, constant sensor errors."""
    return np.array([truth.get(f"torque_offset[{j}]", 0.0) for j in scene.joints])


def _torque_noise(shape: tuple[int, ...], config: SyntheticRobotConfig, rng: np.random.Generator) -> np.ndarray:
    """[N, T, J] N m, white noise plus slow first-order noise."""
    wrist = np.arange(shape[-1]) >= _WRIST
    white = np.where(wrist, config.torque_noise[1], config.torque_noise[0])
    slow = np.where(wrist, config.torque_drift[1], config.torque_drift[0])
    decay = np.exp(-1.0 / (config.rate * config.drift_time))
    innovation = rng.normal(size=shape) * np.sqrt(1 - decay**2)
    innovation[:, 0] = rng.normal(size=(shape[0], shape[2]))
    drift = scipy.signal.lfilter([1.0], [1.0, -decay], innovation, axis=1)
    return white * rng.normal(size=shape) + slow * drift


def _camera(
    scene: Scene, clock: np.ndarray, angle: np.ndarray, config: SyntheticRobotConfig, rng: np.random.Generator
) -> Channel:
    """The channel of the door's angle on the camera's clock, [N, Tc, 1] rad (m for a slide)."""
    joint = str(scene.object_joint)
    time = np.arange(clock[0], clock[-1], 1.0 / config.angle_rate)
    values = np.stack([np.interp(time, clock, row) for row in angle])[..., None]
    return _channel(
        "object_angle",
        scene.position_unit([joint]),
        (joint,),
        time,
        values + rng.normal(0, config.angle_noise, values.shape),
    )


def _channel(name: str, unit: str, columns: tuple[str, ...], time: np.ndarray, values: np.ndarray) -> Channel:
    return Channel(name, unit, columns, time, values.astype(np.float32), np.ones(values.shape, bool))


def is_synthetic(recording: Recording) -> bool:
    """Whether the synthetic robot made a recording, also after it was written to a file and read."""
    return recording.meta.get("source") == SOURCE


def synthetic_truth(scene: Scene, springs: int, seed: int, *, nuisances: bool = True) -> dict[str, float]:
    """Hidden values of a synthetic robot and door.

    Args:
        scene: the door.
        springs: number of springs, which chooses a fitted column of Table I.
        seed: of the draws.
        nuisances: whether to draw the nuisances too.

    Returns:
        The column's values, joint dampings with a standard deviation of 7 % around the scene's, and the nuisances.
    """
    rng = np.random.default_rng([seed, 3])
    space = door_space(scene)
    damping = {n: float(space[n].mean * np.exp(rng.normal(0, 0.07))) for n in JOINT_DAMPING}
    return {**table_i(springs), **damping, **(draw_nuisances(scene, seed) if nuisances else {})}
