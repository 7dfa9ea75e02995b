"""A commanded log in windows, each replayed from the state that was measured where it begins.

All windows of all samples are rows of one batch: parallel in time.  A window cannot know what is inside of an actuator
(a command on its way, the side of a gear's play).  So it is replayed for a short lead-in that is not compared, and
delays find the commands that were sent before it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np

from droid_jax.arguments import check_fields, number, optional, whole
from droid_jax.model.actuators import drives_joint, has_feedback
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.simulate.replay import Drive
from droid_jax.simulate.servo_gains import servo_factors

ORDER = 3  # of the polynomial through measured positions
SAMPLES = 7  # that it goes through at least
ONE_SIDED = 2.0  # times the reach, where nothing was measured before the beginning
WIDER = 1.6  # times its reach, for a second one: what both differ by is the error of its form


@dataclass(frozen=True)
class WindowConfig:
    """How a commanded log is cut into windows.

    length: s, of what is compared of a window.
    lead: s, replayed before that and not compared; of a motion that is replayed whole its beginning.
    history: s, of commands before the lead-in; the longest delay that it can know.
    past: s, the same where servos draw paths of their own to their goals (`Effect.profile`), which may lag for longer.
    reach: s, to both sides of its beginning, of the measured positions that tell where and how fast it begins.
    every: s, in each of which one window lies, at a place that differs; None: none is left out.
    longest: s, of motions that are replayed whole where a servo holds every joint, in all.  Of more of them
    samples: windows or so are replayed instead, spread over them,
    sample_length, sample_lead: s, of each.
    """

    length: float = 0.5
    lead: float = 0.2
    history: float = 0.15
    past: float = 2.0
    reach: float = 0.06
    every: float | None = None
    longest: float = 120.0
    samples: int = 48
    sample_length: float = 3.0
    sample_lead: float = 0.5

    def __post_init__(self) -> None:
        above, least = partial(number, above=0), partial(number, least=0)
        check_fields(
            self,
            **dict.fromkeys(("length", "reach", "longest", "sample_length"), above),
            **dict.fromkeys(("lead", "history", "past", "sample_lead"), least),
            every=optional(above),
            samples=partial(whole, least=1),
        )

    def sampled(self, seconds: float) -> WindowConfig:
        """Of motions of so many seconds in all: a number of longer windows, spread over them."""
        every = max(self.sample_length, seconds / self.samples)
        return replace(self, length=self.sample_length, lead=self.sample_lead, every=every)


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of one repeat of a recording.

    begin: [W] s, of each replay, on the recording's clock.
    table: [W, earlier + steps, U] commands, `earlier` rows of them sent earlier.
    gains: [W, U, 2] factors on the scene's.
    start: [W, nq], speed: [W, nv].
    spread: [W, 2 nv, 2 nv] columns by which positions and speeds (one after the other, by degree of freedom) may be off
    together: a square root of their covariance.
    """

    begin: np.ndarray
    table: np.ndarray
    gains: np.ndarray
    start: np.ndarray
    speed: np.ndarray
    spread: np.ndarray
    earlier: int
    steps: int

    def kept(self, rows: np.ndarray) -> Windows:
        """Some of them; rows: [W] bool."""
        return Windows(
            self.begin[rows],
            self.table[rows],
            self.gains[rows],
            self.start[rows],
            self.speed[rows],
            self.spread[rows],
            self.earlier,
            self.steps,
        )


def held(scene: Scene) -> bool:
    """Whether a servo holds every joint, so that what a replay misses now is mostly gone some time later."""
    model = scene.model
    servos = model.actuator_trnid[drives_joint(model) & has_feedback(model), 0]
    return set(range(model.njnt)) <= set(servos.tolist())


def why_whole(scene: Scene, recording: Recording) -> str:
    """Why a recording's motion must be replayed whole, in words; empty where windows can begin within it."""
    if scene.grip is not None:
        return "the hand holds its object by contact, and a window that begins there would not know the grip"
    model = scene.model
    measured = recording.channels["position"].columns if "position" in recording.channels else ()
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, i) or f"joint {i}" for i in range(model.njnt)]
    single = set(scene.single_joints)
    unknown = [name for name in names if name not in measured or name not in single]
    if unknown:
        return f"no position of {', '.join(unknown)} was measured, so a window that begins later would not know it"
    return ""


class TooShort(ValueError):
    """A recording that is shorter than one window."""


def cut(
    scene: Scene,
    recording: Recording,
    drive: Drive,
    repeat: int,
    config: WindowConfig,
    grid: float | None = None,
    number: int = 0,
) -> Windows:
    """Windows of a repeat one after the other, without those whose beginning was not measured (`why_whole` is empty).

    drive: what `make_drive` made of the recording.
    grid: s, that windows begin on, a whole number of the drive's time steps; None: one.
    number: of windows in other repeats before these, so that places differ (`WindowConfig.every`).
    Raises TooShort where the motion is shorter than one window.
    """
    channel, timestep = recording.channel("position"), drive.timestep
    grid = timestep if grid is None else grid
    finer = round(grid / timestep)
    stride = finer * max(1, round(config.length / grid))
    steps = stride + finer * round(config.lead / grid) + 1
    earlier = finer * round(config.history / grid)
    reach = reach_of(channel, config)
    first = finer * int(np.ceil(reach / grid - 1e-6))
    rows = np.arange(first, len(drive.command) - steps + 1, stride)
    if config.every is not None and len(rows):
        rows = first + finer * _spread(
            (len(drive.command) - steps - first) // finer, stride // finer, config.every / grid, number
        )
    if not len(rows):
        raise TooShort(
            f"recording {recording.name!r} of {recording.duration:.3g} s is shorter than one window of "
            f"{config.length + config.lead + reach:.3g} s"
        )
    begin = float(recording.time[0]) + rows * timestep
    early = 0.5 * timestep
    states = {
        joint: joint_states(channel, repeat, channel.columns.index(joint), begin, reach, early)
        for joint in scene.single_joints
    }
    start, speed = np.tile(drive.qpos0, (len(rows), 1)), np.zeros((len(rows), scene.model.nv))
    spread = np.zeros((len(rows), 2 * scene.model.nv, 2 * scene.model.nv))
    for joint, (state, root) in states.items():
        dof = scene.dof(joint)
        start[:, scene.qpos(joint)], speed[:, dof] = state.T
        pair = np.array([dof, scene.model.nv + dof])
        spread[:, pair[:, None], pair] = root
    padded = np.concatenate([np.repeat(drive.command[:1], earlier, axis=0), drive.command])
    table = padded[rows[:, None] + np.arange(earlier + steps)]
    known = np.asarray(np.isfinite(start).all(axis=1) & np.isfinite(speed).all(axis=1))
    gains = np.repeat(servo_factors(scene, drive)[None], len(rows), axis=0)
    return Windows(begin, table, gains, start, speed, spread, earlier, steps).kept(known)


def _spread(last: int, least: int, every: float, number: int = 0) -> np.ndarray:
    """Places from 0 to `last`, one in each stretch of `every` and `least` apart or more.

    Within their stretches by the golden ratio, so that a motion that repeats is not seen at one phase alone; number: of
    places before, in other motions.
    """
    count = max(1, min(round(last / every), last // least))
    begin = np.arange(count) * last / count
    within = (0.5 * (np.sqrt(5.0) - 1.0) * (1 + number + np.arange(count))) % 1.0
    return np.floor(begin + within * (last / count - (least if count > 1 else 0.0))).astype(int)


def start_spread(
    scene: Scene, recording: Recording, qpos0: np.ndarray, repeat: int, timestep: float, config: WindowConfig
) -> np.ndarray:
    """[2 nv, 2 nv] how far the start at rest of a motion that is replayed whole may be off, as `Windows.spread`.

    The state is that of a cubic through the first measured positions.  What the start differs from it by counts as a
    deviation beside its noise, so that a log that begins in motion has a wide one.  Zero of joints that were not
    measured, or too seldom.

    Args:
        scene: the robot.
        recording: with the positions, if they were measured.
        qpos0: [nq] where the replay starts, at rest.
        repeat: of the recording.
        timestep: s, of the replay.
        config: how far its measured positions reach.
    """
    size = scene.model.nv
    found = np.zeros((2 * size, 2 * size))
    if "position" not in recording.channels or size != scene.model.nq:
        return found
    channel = recording.channels["position"]
    reach, begin = ONE_SIDED * reach_of(channel, config), np.array([float(recording.time[0])])
    for joint in set(scene.single_joints) & set(channel.columns):
        column = channel.columns.index(joint)
        (state,), (root,) = joint_states(channel, repeat, column, begin, reach, 0.5 * timestep, one_sided=True)
        if np.isfinite(state).all():
            off = state - [qpos0[scene.qpos(joint)], 0.0]
            pair = np.array([scene.dof(joint), size + scene.dof(joint)])
            found[pair[:, None], pair] = np.linalg.cholesky(root @ root.T + np.diag(off**2))
    return found


def reach_of(channel: Channel, config: WindowConfig) -> float:
    """s, to both sides, that hold enough samples of a channel for the state where a window begins."""
    return max(config.reach, 0.5 * SAMPLES * float(np.median(np.diff(channel.time))))


def joint_states(
    channel: Channel,
    repeat: int,
    column: int,
    at: np.ndarray,
    reach: float,
    early: float = 0.0,
    *,
    one_sided: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Position and speed [W, 2] of a joint at W instants [s], and a square root [W, 2, 2] of their covariance.

    early: s, by which the speed is that of an earlier instant: a replay's lie half a step before its positions.
    one_sided: nothing was measured before these instants.

    A cubic through the samples within `reach`; its covariance is that of the samples' noise (of all instants, or of
    this one's where it is larger) and of the difference to a wider one.  NaN where too little was measured.
    """
    seen = channel.mask[repeat, :, column]
    time, values = channel.time[seen], channel.values[repeat, seen, column].astype(float)
    narrow, wide = ([_cubic(time, values, t, r, early, one_sided) for t in at] for r in (reach, WIDER * reach))
    variances = [fit[2] for fit in narrow if fit is not None]
    usual = float(np.mean(variances)) if variances else 0.0
    state, root = np.full((len(at), 2), np.nan), np.zeros((len(at), 2, 2))
    for k, (fit, other) in enumerate(zip(narrow, wide, strict=True)):
        if fit is None or other is None:
            continue
        state[k] = fit[0]
        covariance = max(fit[2], usual) * fit[1] + np.diag((fit[0] - other[0]) ** 2)
        root[k] = np.linalg.cholesky(covariance + 1e-18 * np.eye(2))
    return state, root


def _cubic(
    time: np.ndarray, values: np.ndarray, at: float, reach: float, early: float, one_sided: bool
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Position and speed [2] at an instant, their covariance [2, 2] for noise of one, and the noise's variance."""
    inside = np.abs(time - at) <= reach + 1e-9
    x = (time[inside] - at) / reach
    before = one_sided or np.min(x, initial=1.0) < -0.3
    if len(x) <= ORDER + 1 or not (before and np.max(x, initial=-1.0) > 0.3):
        return None
    order = np.arange(ORDER + 1)
    powers = x[:, None] ** order
    inverse = np.linalg.pinv(powers)
    factors = inverse @ values[inside]
    left = values[inside] - powers @ factors
    slope = order[1:] * (-early / reach) ** (order[1:] - 1) / reach
    taken = np.stack([np.eye(ORDER + 1)[0], np.r_[0.0, slope]]) @ inverse
    return taken @ values[inside], taken @ taken.T, float(left @ left) / (len(x) - ORDER - 1)
