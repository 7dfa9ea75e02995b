"""Recordings to rehearse: as they were measured, or simulated from their commands with a stated noise."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from droid_jax.cost.channels import SIMULATED
from droid_jax.cost.cost import followed
from droid_jax.cost.errors import of_scene
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.recordings.time_scaling import TimeScaling, time_scaled
from droid_jax.rehearsal.config import DEFAULT_REHEARSAL, RehearsalConfig
from droid_jax.simulate.batching import in_blocks
from droid_jax.simulate.compiled import compiled_replay
from droid_jax.simulate.replay import Drive
from droid_jax.simulate.servo_gains import scale_gains, servo_factors
from droid_jax.synthetic.hidden_effects import HIDDEN, LIBRARY, ON_HINGE, Applied, check, record_hidden
from droid_jax.synthetic.robot import SyntheticRobotConfig

ColumnNoise = tuple[str, str, str, float, str]  # channel, column, unit, standard deviation of one sample, its source


@dataclass(frozen=True)
class RehearsalPlan:
    """What is stated instead of measured.

    repeats: of each recording; None for the recording's own number.
    noise: channel -> standard deviation of one sample, in its unit; None if it is not stated.
    values: parameter -> value; the others have their means.
    channels: to compare; None for the search's choice.
    """

    repeats: int | None = None
    noise: Mapping[str, float] | None = None
    values: Mapping[str, float] | None = None
    channels: tuple[str, ...] | None = None

    @property
    def simulated(self) -> bool:
        """Whether the measurement is replaced by a simulation of the commands with noise."""
        return self.repeats is not None or self.noise is not None


def simulated_channels(
    scene: Scene,
    space: Space,
    effects: Sequence[Effect],
    recording: Recording,
    values: np.ndarray,
    config: DiscrepancyConfig,
    engine: str = "mjx",
) -> Rollout:
    """Simulate a recording's commands without noise; return one sample, host arrays [T, ...].

    Its times begin at 0 with the recording's first command.

    Args:
        scene: the robot.
        space: meaning of the values.
        effects: in the model.
        recording: with commands.
        values: [D].
        config: of the search.
        engine: "mjx", or "mujoco" for plain C.

    Raises:
        ValueError: the simulation blows up, or plain C does not support the model.
    """
    scene = variant_scene(scene, recording.variant, recording.name)
    drive = followed(scene, recording, config.compare)
    drive = replace(drive, torque=recording.torque)  # also of torques that were not measured yet
    replay = compiled_replay(engine, scene, space, drive, effects)
    rollout = jax.tree.map(lambda a: np.asarray(a)[0], in_blocks(replay, values[None]))
    if not bool(rollout.finite):
        raise ValueError(
            f"the simulation of {recording.name!r} blows up at the parameters' values: begin at other ones, or shorten "
            "the scene's time step"
        )
    return rollout


def sample_noise(channel: Channel) -> np.ndarray:
    """Return the standard deviation [C] of a channel's noise, from its second differences as if it were white."""
    second = np.diff(np.where(channel.mask, channel.values, np.nan), n=2, axis=1)
    median = np.nanmedian(np.abs(second).reshape(-1, second.shape[-1]), axis=0)
    return 1.4826 * np.nan_to_num(median) / np.sqrt(6.0)


def scattered(channel: Channel) -> np.ndarray | None:
    """Return deviations [N, T, C] of the repeats from their mean, 0 where not measured; None for one repeat."""
    if len(channel.values) < 2:
        return None
    values = np.where(channel.mask, channel.values, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # instants that no repeat measured
        return np.nan_to_num(values - np.nanmean(values, axis=0))


def noisy(
    clean: np.ndarray,
    repeats: int,
    deviation: np.ndarray,
    deviations: np.ndarray | None,
    rng: np.random.Generator,
    mix: np.ndarray,
) -> np.ndarray:
    """Return a trace with noise in N repeats, [N, T, C].

    Args:
        clean: [T, C] trace without noise.
        repeats: N.
        deviation: [C] standard deviation of white noise, where `deviations` is None.
        deviations: [n, T, C] of measured repeats from their mean, which are mixed at random; or None.
        rng: source of the white noise.
        mix: [N, n] standard normal numbers; the mixture has the covariance of the measured repeats.
    """
    if deviations is not None:
        return clean + np.einsum("nm,mtc->ntc", mix, deviations) / np.sqrt(max(len(deviations) - 1, 1))
    return clean + deviation * rng.normal(size=(repeats, *clean.shape))


def unit_of_simulated(scene: Scene, name: str, columns: Sequence[str]) -> str:
    """Return the unit of a channel that was not measured."""
    if name == "torque":
        return scene.torque_unit(columns)
    return (
        "/s or ".join(scene.position_unit(columns).split(" or ")) + "/s"
        if name == "velocity"
        else scene.position_unit(columns)
    )


def possible_channels(scene: Scene, recording: Recording) -> tuple[str, ...]:
    """Return the channels of a recording that its replay produces, whether they were measured or not."""
    if not recording.command.size:
        return ("torque",)
    has_object = scene.object_joint is not None and scene.object_joint not in scene.joints
    return tuple(name for name in SIMULATED if name != "object_angle" or has_object)


def column_noise(
    measured: Channel | None, columns: int, stated: float | None, assumed: float, smooth: float
) -> tuple[np.ndarray, str, np.ndarray | None]:
    """Return the standard deviation [C] of one sample, its source, and deviations [N, T, C] of the repeats or None.

    A stated noise has priority, then the scatter of the repeats, then second differences of one repeat, then the
    assumed noise.

    Args:
        measured: the channel, or None if it was not measured.
        columns: C.
        stated: standard deviation, or None.
        assumed: standard deviation.
        smooth: share of `assumed`; a channel with less noise in its second differences is taken for a command.
    """
    if stated is not None:
        return np.full(columns, stated), "stated", None
    deviations = None if measured is None else scattered(measured)
    if deviations is not None:
        count = len(deviations)
        return deviations.std(axis=(0, 1)) * np.sqrt(count / (count - 1)), "repeats", deviations
    deviation = np.zeros(columns) if measured is None else sample_noise(measured)
    if deviation.min() > smooth * assumed:
        return deviation, "log, from row to row", None
    return np.full(columns, assumed), "assumed", None


def planned_recording(
    scene: Scene, recording: Recording, rollout: Rollout, plan: RehearsalPlan, config: RehearsalConfig, seed: int
) -> tuple[Recording, list[ColumnNoise]]:
    """Return a recording with every channel that a replay produces, and the noise of each column.

    Measured channels are unchanged unless the plan replaces them.  The others are simulated, with the stated, measured
    or assumed noise.

    Args:
        scene: the robot.
        recording: as measured.
        rollout: simulation of its commands, of one sample.
        plan: what replaces the measurement.
        config: assumed noise and rate.
        seed: of the noise.
    """
    rng = np.random.default_rng([seed, 11])
    repeats = plan.repeats or recording.repeats
    mix = rng.normal(size=(repeats, recording.repeats))
    channels, noise = dict[str, Channel](), list[ColumnNoise]()
    for name in possible_channels(scene, recording):
        recorded = recording.channels.get(name)
        of_joints = None if recorded is None else of_scene(scene, recorded)
        measured = of_joints if of_joints is not None and of_joints.columns else None
        stated = (plan.noise or {}).get(name) if plan.simulated or measured is None else None
        columns = simulated_columns(scene, name) if measured is None else measured.columns
        deviation, source, deviations = column_noise(measured, len(columns), stated, config.noise[name], config.smooth)
        if measured is not None and not plan.simulated:
            channels[name] = measured
        else:
            trace = np.asarray(getattr(rollout, name), float).reshape(len(rollout.time), -1)
            which = [0] if name == "object_angle" else [scene.joints.index(c) for c in columns]
            begin, end = float(recording.time[0]), float(rollout.time[-1])
            time = begin + np.arange(0.0, end, 1.0 / config.rate) if measured is None else measured.time
            clean = interpolate(time, begin + rollout.time, trace[:, which])
            values = noisy(clean, repeats, deviation, deviations, rng, mix)
            unit = unit_of_simulated(scene, name, columns) if measured is None else measured.unit
            channels[name] = Channel(name, unit, columns, time, values, np.ones(values.shape, bool))
        noise += [(name, c, channels[name].unit, float(d), source) for c, d in zip(columns, deviation, strict=True)]
    others = {} if plan.simulated else {k: c for k, c in recording.channels.items() if k not in channels}
    return replace(recording, channels={**channels, **others}), noise


def simulated_columns(scene: Scene, name: str) -> tuple[str, ...]:
    """Return the columns of a channel that was not measured."""
    return (str(scene.object_joint),) if name == "object_angle" else scene.joints


def noise_of_log(recording: Recording) -> list[ColumnNoise]:
    """Return the noise of a log in windows or blocks, for display; the tests use the residual of fits instead."""
    return [
        (name, column, channel.unit, float(deviation), "log, from row to row")
        for name, channel in recording.channels.items()
        if name in SIMULATED
        for column, deviation in zip(channel.columns, sample_noise(channel), strict=True)
    ]


def faster_motion(recording: Recording, factor: float) -> Recording:
    """Return a commanded recording with a faster motion that then stands still, of the same duration."""

    def clock(new: np.ndarray, duration: float) -> np.ndarray:
        return np.minimum(factor * new, duration)

    return time_scaled(recording, TimeScaling(f"{recording.name}, {factor:g} times as fast", lambda d: d, clock))


@dataclass(frozen=True)
class HiddenCase:
    """One complete rehearsal, with an effect of some size at a location, or with nothing hidden (effect "").

    number: of the case.  coefficient, shape: of the library's effect.
    size: of the library's coefficient.  times: factor on the size that the quick rehearsal predicts.
    hidden: name of the synthetic robot's law; empty if the library's law is simulated.
    joint: of the synthetic robot's law.
    amplitude: of the synthetic robot's law, as strong in this motion as `size` (`equally_strong`).
    form: share of that law's unabsorbed part that the library's law can explain.
    """

    number: int
    effect: str = ""
    location: str = ""
    coefficient: str = ""
    shape: Mapping[str, float] | None = None
    size: float = 0.0
    times: float = 0.0
    hidden: str = ""
    joint: str = ""
    amplitude: float = 0.0
    form: float = 1.0

    @property
    def name(self) -> str:
        """Name of its folder."""
        what = f"{self.effect}_{self.location}_{self.times:g}x" if self.effect else "nothing"
        return f"{self.number:04d}_{''.join(c if c.isalnum() or c in '._-' else '_' for c in what)}"


def hidden_form(scene: Scene, effect: str, location: str, unit: str) -> tuple[str, str]:
    """Return the name and the joint of the synthetic robot's law for an effect of the library; empty if it has none.

    A law whose amplitude has another unit than the library's coefficient does not count.

    scene: the robot.  effect, location: of the library.  unit: of its coefficient.
    """
    for name, library in LIBRARY.items():
        on_hinge = ON_HINGE.get(library, library)
        form = HIDDEN[name]
        joint = location if form.on in ("arm", "joint") and location in (*scene.joints, scene.object_joint) else ""
        in_library = on_hinge if joint and joint == scene.object_joint else library
        if in_library != effect or form.unit.replace("²", "^2") != unit:
            continue
        try:
            check(Applied(name, 0.0, joint), scene)
        except ValueError:
            continue
        return name, joint
    return "", ""


def robot_trace(
    scene: Scene,
    space: Space,
    recording: Recording,
    values: np.ndarray,
    case: HiddenCase,
    config: DiscrepancyConfig,
    seed: int,
    rehearsal: RehearsalConfig = DEFAULT_REHEARSAL,
) -> Rollout:
    """Simulate the synthetic robot without noise; return its motion as a Rollout of one sample.

    Args:
        scene: the robot.
        space: meaning of the values.
        recording: whose commands it follows.
        values: [D] of the robot's parameters.
        case: the hidden effect.
        config: of the search.
        seed: of the robot.
        rehearsal: its time step and rate.
    """
    noise_free = SyntheticRobotConfig(
        repeats=1, timestep=rehearsal.robot_timestep, rate=rehearsal.robot_rate, torque_noise=(0.0, 0.0),
        torque_drift=(0.0, 0.0), position_noise=0.0, angle_noise=0.0, angle_rate=rehearsal.robot_rate, start_noise=0.0,
        pose_noise=0.0, side=recording.torque.side,
    )  # fmt: skip
    scene = variant_scene(scene, recording.variant, recording.name)
    drive = followed(scene, recording, config.compare)
    assert isinstance(drive, Drive)
    robot = replace(scene, model=scale_gains(copy.copy(scene.model), servo_factors(scene, drive)))
    start = {**recording.measured_start(), **recording.qpos0}
    hidden = [Applied(case.hidden, case.amplitude, case.joint)] if case.hidden else []
    values = space.with_known(recording.known, values)
    truth = {name: float(v) for name, v in zip(space.names, values, strict=True)}
    log = record_hidden(
        robot, replace(recording, qpos0=start, gains=None), truth, hidden, seed=seed, config=noise_free, space=space
    )
    time = log.channel("torque").time
    position = log.channel("position").values[0].astype(float)
    angle = np.zeros(len(time))
    if "object_angle" in log.channels:
        measured = log.channel("object_angle")
        angle = np.interp(time, measured.time, measured.values[0, :, 0])
    return Rollout(
        time=time - recording.time[0],
        torque=log.channel("torque").values[0].astype(float),
        position=position,
        velocity=np.gradient(position, time, axis=0),
        object_angle=angle,
        contact=np.zeros((len(time), 0), bool),
        finite=np.array(True),
    )
