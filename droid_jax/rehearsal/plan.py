"""What is rehearsed: recordings as they were measured, or what the replay and a noise make of their commands."""

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
from droid_jax.rehearsal.linear import RehearsalConfig
from droid_jax.simulate.batching import in_blocks
from droid_jax.simulate.compiled import compiled_replay
from droid_jax.simulate.replay import Drive
from droid_jax.simulate.servo_gains import scale_gains, servo_factors
from droid_jax.synthetic.hidden_effects import HIDDEN, LIBRARY, ON_HINGE, Applied, check, record_hidden
from droid_jax.synthetic.robot import SyntheticRobotConfig

RATE = 200.0  # Hz, of channels that nobody measured
FINE_RATE = 1000.0  # Hz, of what the synthetic robot hands on before it is put onto the recording's clocks
SMOOTH = 0.1  # of the assumed noise, below which a channel of one repeat is taken to be no measurement
ColumnNoise = tuple[str, str, str, float, str]  # channel, column, unit, deviation of one sample, where it comes from


@dataclass(frozen=True)
class RehearsalPlan:
    """What is rehearsed.

    repeats: of each recording; None: as many as it holds.  noise: channel -> deviation of one sample, in its unit,
    stated.  values: parameter -> value where it stands; others at their means.  channels: to compare; None: the
    search's own choice.
    simulated: replace what was measured by what the replay and the noise make of the commands.
    """

    repeats: int | None = None
    noise: Mapping[str, float] | None = None
    values: Mapping[str, float] | None = None
    channels: tuple[str, ...] | None = None

    @property
    def simulated(self) -> bool:
        """Whether what was measured is replaced by what the replay and the noise make of the commands."""
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
    """What the replay makes of a recording's commands at values [D], without noise: one sample, host arrays [T, ...].

    Its times count from the recording's first command.  engine: "mjx", or "mujoco" for plain C (ValueError where it
    lacks something).
    """
    scene = variant_scene(scene, recording.variant)
    drive = followed(scene, recording, config.compare)
    replay = compiled_replay(engine, scene, space, drive, effects)
    rollout = jax.tree.map(lambda a: np.asarray(a)[0], in_blocks(replay, values[None]))
    if not bool(rollout.finite):
        raise ValueError(
            f"the simulation of {recording.name!r} blows up at the parameters' values: begin at other ones, or shorten "
            "the scene's time step"
        )
    return rollout


def sample_noise(channel: Channel) -> np.ndarray:
    """[C] deviation of a measured channel from row to row, as if it were white: of its second differences."""
    second = np.diff(np.where(channel.mask, channel.values, np.nan), n=2, axis=1)
    spread = np.nanmedian(np.abs(second).reshape(-1, second.shape[-1]), axis=0)
    return 1.4826 * np.nan_to_num(spread) / np.sqrt(6.0)


def scattered(channel: Channel) -> np.ndarray | None:
    """[N, T, C] deviations of the repeats from their mean where all was measured; None of one repeat."""
    if len(channel.values) < 2:
        return None
    values = np.where(channel.mask, channel.values, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # instants that nobody measured
        return np.nan_to_num(values - np.nanmean(values, axis=0))


def noisy(
    clean: np.ndarray,
    repeats: int,
    deviation: np.ndarray,
    apart: np.ndarray | None,
    rng: np.random.Generator,
    mix: np.ndarray,
) -> np.ndarray:
    """[N, T, C] a trace [T, C] with noise: what measured repeats [n, T, C] are apart, mixed anew, or white.

    mix: [N, n] of normal numbers; the mixture has the covariance of the measured repeats.
    """
    if apart is not None:
        return clean + np.einsum("nm,mtc->ntc", mix, apart) / np.sqrt(max(len(apart) - 1, 1))
    return clean + deviation * rng.normal(size=(repeats, *clean.shape))


def unit_of_simulated(scene: Scene, name: str, columns: Sequence[str]) -> str:
    """Of a channel that nobody measured."""
    if name == "torque":
        return scene.torque_unit(columns)
    return (
        "/s or ".join(scene.position_unit(columns).split(" or ")) + "/s"
        if name == "velocity"
        else scene.position_unit(columns)
    )


def possible_channels(scene: Scene, recording: Recording) -> tuple[str, ...]:
    """What a replay of a recording could be compared in."""
    if not recording.command.size:
        return ("torque",)
    seen = scene.object_joint is not None and scene.object_joint not in scene.joints
    return tuple(name for name in SIMULATED if name != "object_angle" or seen)


def column_noise(
    known: Channel | None, columns: int, stated: float | None, assumed: float
) -> tuple[np.ndarray, str, np.ndarray | None]:
    """[C] deviation of one sample, where it comes from, and [N, T, C] how repeats scatter where that is known.

    Stated before measured: by the repeats, else from row to row, unless a channel is as smooth as a command.
    """
    if stated is not None:
        return np.full(columns, stated), "stated", None
    apart = None if known is None else scattered(known)
    if apart is not None:
        return apart.std(axis=(0, 1)) * np.sqrt(len(apart) / (len(apart) - 1)), "repeats", apart
    deviation = np.zeros(columns) if known is None else sample_noise(known)
    if deviation.min() > SMOOTH * assumed:
        return deviation, "log, from row to row", None
    return np.full(columns, assumed), "assumed", None


def planned_recording(
    scene: Scene, recording: Recording, rollout: Rollout, plan: RehearsalPlan, config: RehearsalConfig, seed: int
) -> tuple[Recording, list[ColumnNoise]]:
    """A recording with every channel that a replay has, and the noise of each column.

    What was measured stays, unless the plan says otherwise; what was not is simulated, with the noise that was stated,
    measured or assumed.
    """
    rng = np.random.default_rng([seed, 11])
    repeats = plan.repeats or recording.repeats
    mix = rng.normal(size=(repeats, recording.repeats))
    channels, noise = dict[str, Channel](), list[ColumnNoise]()
    for name in possible_channels(scene, recording):
        measured = recording.channels.get(name)
        seen = None if measured is None else of_scene(scene, measured)
        known = seen if seen is not None and seen.columns else None
        stated = (plan.noise or {}).get(name) if plan.simulated or known is None else None
        columns = simulated_columns(scene, name) if known is None else known.columns
        deviation, source, apart = column_noise(known, len(columns), stated, config.noise[name])
        if known is not None and not plan.simulated:
            channels[name] = known
        else:
            trace = np.asarray(getattr(rollout, name), float).reshape(len(rollout.time), -1)
            which = [0] if name == "object_angle" else [scene.joints.index(c) for c in columns]
            begin, end = float(recording.time[0]), float(rollout.time[-1])
            time = begin + np.arange(0.0, end, 1.0 / RATE) if known is None else known.time
            clean = interpolate(time, begin + rollout.time, trace[:, which])
            values = noisy(clean, repeats, deviation, apart, rng, mix)
            unit = unit_of_simulated(scene, name, columns) if known is None else known.unit
            channels[name] = Channel(name, unit, columns, time, values, np.ones(values.shape, bool))
        noise += [(name, c, channels[name].unit, float(d), source) for c, d in zip(columns, deviation, strict=True)]
    others = {} if plan.simulated else {k: c for k, c in recording.channels.items() if k not in channels}
    return replace(recording, channels={**channels, **others}), noise


def simulated_columns(scene: Scene, name: str) -> tuple[str, ...]:
    """Of a channel that nobody measured."""
    return (str(scene.object_joint),) if name == "object_angle" else scene.joints


def noise_of_log(recording: Recording) -> list[ColumnNoise]:
    """The noise of a log whose windows or blocks stand for repeats: what fits leave of it counts, and this beside."""
    return [
        (name, column, channel.unit, float(deviation), "log, from row to row")
        for name, channel in recording.channels.items()
        if name in SIMULATED
        for column, deviation in zip(channel.columns, sample_noise(channel), strict=True)
    ]


def faster_motion(recording: Recording, factor: float) -> Recording:
    """A commanded recording whose motion is made faster and then stands still, as long as before."""

    def clock(new: np.ndarray, duration: float) -> np.ndarray:
        return np.minimum(factor * new, duration)

    return time_scaled(recording, TimeScaling(f"{recording.name}, {factor:g} times as fast", lambda d: d, clock))


@dataclass(frozen=True)
class HiddenCase:
    """One rehearsal: nothing hidden (effect ""), or an effect at a place, of some size of one coefficient.

    size: of the library's coefficient.  times: of the size that the quick form predicts.
    hidden: how the synthetic robot calls it; empty where the library's own law is simulated.
    amplitude: of the synthetic robot's law, as strong in this motion as `size` (`equally_strong`).
    form: share of what that law leaves that the library's form could take.
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
        """Of its folder."""
        what = f"{self.effect}_{self.location}_{self.times:g}x" if self.effect else "nothing"
        return f"{self.number:04d}_{''.join(c if c.isalnum() or c in '._-' else '_' for c in what)}"


def hidden_form(scene: Scene, effect: str, location: str, unit: str) -> tuple[str, str]:
    """What the synthetic robot calls an effect of the library at a place, and its joint; empty where it has none.

    Where its amplitude has another unit than the library's coefficient it counts as none.
    """
    for name, library in LIBRARY.items():
        on_hinge = ON_HINGE.get(library, library)
        form = HIDDEN[name]
        joint = location if form.on in ("arm", "joint") and location in (*scene.joints, scene.object_joint) else ""
        called = on_hinge if joint and joint == scene.object_joint else library
        if called != effect or form.unit.replace("²", "^2") != unit:
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
) -> Rollout:
    """What the synthetic robot does, without noise, as a replay of one sample."""
    quiet = SyntheticRobotConfig(
        repeats=1, timestep=0.00025, rate=FINE_RATE, torque_noise=(0.0, 0.0), torque_drift=(0.0, 0.0),
        position_noise=0.0, angle_noise=0.0, angle_rate=FINE_RATE, start_noise=0.0, pose_noise=0.0,
        side=recording.torque.side,
    )  # fmt: skip
    scene = variant_scene(scene, recording.variant)
    drive = followed(scene, recording, config.compare)
    assert isinstance(drive, Drive)
    robot = replace(scene, model=scale_gains(copy.copy(scene.model), servo_factors(scene, drive)))
    start = {**recording.measured_start(), **recording.qpos0}
    hidden = [Applied(case.hidden, case.amplitude, case.joint)] if case.hidden else []
    values = space.with_known(recording.known, values)
    truth = {name: float(v) for name, v in zip(space.names, values, strict=True)}
    log = record_hidden(
        robot, replace(recording, qpos0=start, gains=None), truth, hidden, seed=seed, config=quiet, space=space
    )
    time = log.channel("torque").time
    position = log.channel("position").values[0].astype(float)
    angle = np.zeros(len(time))
    if "object_angle" in log.channels:
        seen = log.channel("object_angle")
        angle = np.interp(time, seen.time, seen.values[0, :, 0])
    return Rollout(
        time=time - recording.time[0],
        torque=log.channel("torque").values[0].astype(float),
        position=position,
        velocity=np.gradient(position, time, axis=0),
        object_angle=angle,
        contact=np.zeros((len(time), 0), bool),
        finite=np.array(True),
    )
