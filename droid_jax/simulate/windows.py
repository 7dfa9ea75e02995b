"""Cut a commanded log into windows, each replayed from its own measured initial state (multiple shooting).

All windows of all samples are rows of one batch, which is parallel in time.  The internal state of an actuator (a
delayed command, the side of a gear's backlash) is not measured.  So each window begins with a short lead-in that is not
compared, and delays can reach back to commands before the window.
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


@dataclass(frozen=True)
class WindowConfig:
    """How a commanded log is cut into windows.

    Attributes:
        length: s, compared part of a window.
        lead: s, replayed before that and not compared; also the beginning of a motion that is replayed whole.
        history: s of commands before the lead-in, the longest delay that a window can have.
        past: s, the same if servos draw their own profiles to their goals (`Effect.profile`), which may lag longer.
        reach: s, to both sides of a window's beginning; measured positions within it give its initial state.
        every: s, one window lies in each such interval, at varying places; None: windows cover the whole log.
        longest: s, total duration of motions that are replayed whole if a servo holds every joint.  Longer motions are
            sampled by windows.
        samples: number of these windows, approximately.
        sample_length, sample_lead: s, compared part and lead-in of each of them.
        order: of the polynomial through measured positions that gives the initial state.
        least_samples: positions that `reach` contains at least; it is widened for a slow log.
        one_sided: factor on the reach at the beginning of a log, where only one side was measured.
        wider: factor on the reach of a second polynomial; the difference of the two is the error of the model.
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
    order: int = 3
    least_samples: int = 7
    one_sided: float = 2.0
    wider: float = 1.6

    def __post_init__(self) -> None:
        above, least = partial(number, above=0), partial(number, least=0)
        check_fields(
            self,
            **dict.fromkeys(("length", "reach", "longest", "sample_length"), above),
            **dict.fromkeys(("lead", "history", "past", "sample_lead"), least),
            every=optional(above),
            samples=partial(whole, least=1),
            order=partial(whole, least=1),
            least_samples=partial(whole, least=1),
            **dict.fromkeys(("one_sided", "wider"), partial(number, above=1)),
        )

    def sampled(self, seconds: float) -> WindowConfig:
        """The configuration for motions of `seconds` s in total: `samples` longer windows, spread over them."""
        every = max(self.sample_length, seconds / self.samples)
        return replace(self, length=self.sample_length, lead=self.sample_lead, every=every)


DEFAULT_WINDOWS = WindowConfig()


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of one repeat of a recording.

    Attributes:
        begin: [W] s, begin of each replay on the recording's clock.
        table: [W, earlier + steps, U] commands; the first `earlier` rows precede the window.
        gains: [W, U, 2] factors on the scene's gains.
        start: [W, nq] initial positions, rad and m.
        speed: [W, nv] initial velocities, rad/s and m/s.
        spread: [W, 2 nv, 2 nv] a square root of the covariance of initial positions and velocities, positions of all
            degrees of freedom first.
        earlier: commands before the first step.
        steps: time steps of a window.
    """

    begin: np.ndarray
    table: np.ndarray
    gains: np.ndarray
    start: np.ndarray
    speed: np.ndarray
    spread: np.ndarray
    earlier: int
    steps: int

    def subset(self, rows: np.ndarray) -> Windows:
        """The windows of `rows`, [W] bool."""
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


def fully_servoed(scene: Scene) -> bool:
    """Whether a servo holds every joint, so that an error of a replay decays with time."""
    model = scene.model
    servos = model.actuator_trnid[drives_joint(model) & has_feedback(model), 0]
    return set(range(model.njnt)) <= set(servos.tolist())


def why_no_windows(scene: Scene, recording: Recording) -> str:
    """Why a recording cannot be cut into windows; empty if it can."""
    if scene.grip is not None:
        return "the hand holds its object by contact, and the state of the grip within a motion is not measured"
    model = scene.model
    measured = recording.channels["position"].columns if "position" in recording.channels else ()
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, i) or f"joint {i}" for i in range(model.njnt)]
    single = set(scene.single_joints)
    unknown = [name for name in names if name not in measured or name not in single]
    if unknown:
        return f"no position of {', '.join(unknown)} was measured, so the initial state of a window is unknown"
    return ""


class TooShort(ValueError):
    """A recording that is shorter than one window."""


def cut_windows(
    scene: Scene,
    recording: Recording,
    drive: Drive,
    repeat: int,
    config: WindowConfig,
    grid: float | None = None,
    number: int = 0,
) -> Windows:
    """Consecutive windows of a repeat, without those whose initial state was not measured.

    Args:
        scene: what is simulated.
        recording: for which `why_no_windows` is empty.
        drive: of the recording (`make_drive`).
        repeat: of the recording.
        config: lengths and places.
        grid: s, windows begin on multiples of it, a whole number of the drive's time steps; None: one time step.
        number: windows of other repeats before these, so that places differ (`WindowConfig.every`).

    Returns:
        The windows.

    Raises:
        TooShort: the motion is shorter than one window.
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
        joint: joint_states(channel, repeat, channel.columns.index(joint), begin, reach, early, config=config)
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
    return Windows(begin, table, gains, start, speed, spread, earlier, steps).subset(known)


def _spread(last: int, least: int, every: float, number: int = 0) -> np.ndarray:
    """Places from 0 to `last`, one in each interval of length `every`, at distances of at least `least`.

    The golden ratio varies the places within their intervals, so that a periodic motion is sampled at all phases.
    number: places before these, in other motions.
    """
    count = max(1, min(round(last / every), last // least))
    begin = np.arange(count) * last / count
    within = (0.5 * (np.sqrt(5.0) - 1.0) * (1 + number + np.arange(count))) % 1.0
    return np.floor(begin + within * (last / count - (least if count > 1 else 0.0))).astype(int)


def start_spread(
    scene: Scene, recording: Recording, qpos0: np.ndarray, repeat: int, timestep: float, config: WindowConfig
) -> np.ndarray:
    """[2 nv, 2 nv] a square root of the covariance of the initial state of a motion that is replayed whole.

    The replay starts at rest.  A polynomial through the first measured positions estimates the true initial state.  Its
    difference from the replay's counts as a standard deviation, beside its noise.  So the spread is wide for a log that
    begins in motion.  It is zero for joints that were not measured, or too rarely.  The order is that of
    `Windows.spread`.

    Args:
        scene: the robot.
        recording: with the positions, if they were measured.
        qpos0: [nq] where the replay starts, at rest.
        repeat: of the recording.
        timestep: s, of the replay.
        config: of the polynomial.
    """
    size = scene.model.nv
    spread = np.zeros((2 * size, 2 * size))
    if "position" not in recording.channels or size != scene.model.nq:
        return spread
    channel = recording.channels["position"]
    reach, begin = config.one_sided * reach_of(channel, config), np.array([float(recording.time[0])])
    for joint in set(scene.single_joints) & set(channel.columns):
        column, half = channel.columns.index(joint), 0.5 * timestep
        (state,), (root,) = joint_states(channel, repeat, column, begin, reach, half, one_sided=True, config=config)
        if np.isfinite(state).all():
            error = state - [qpos0[scene.qpos(joint)], 0.0]
            pair = np.array([scene.dof(joint), size + scene.dof(joint)])
            spread[pair[:, None], pair] = np.linalg.cholesky(root @ root.T + np.diag(error**2))
    return spread


def reach_of(channel: Channel, config: WindowConfig) -> float:
    """s, to both sides of a window's beginning, that contain enough samples of a channel for the initial state."""
    return max(config.reach, 0.5 * config.least_samples * float(np.median(np.diff(channel.time))))


def joint_states(
    channel: Channel,
    repeat: int,
    column: int,
    at: np.ndarray,
    reach: float,
    early: float = 0.0,
    *,
    one_sided: bool = False,
    config: WindowConfig = DEFAULT_WINDOWS,
) -> tuple[np.ndarray, np.ndarray]:
    """Position and speed of a joint at W instants, from a local polynomial through its measured positions.

    The covariance consists of the samples' noise and the squared difference from a polynomial over a wider reach.  The
    noise's variance is the mean over all instants, or the instant's if that is larger.

    Args:
        channel: of positions.
        repeat: of the recording.
        column: of the joint.
        at: [W] s, the instants.
        reach: s, samples within it are used.
        early: s, the speed is that of an earlier instant; a replay's speeds lie half a step before its positions.
        one_sided: whether nothing was measured before these instants.
        config: of the polynomial.

    Returns:
        [W, 2] rad and rad/s (m and m/s), and [W, 2, 2] a square root of their covariance.  NaN if too few samples were
        measured.
    """
    mask = channel.mask[repeat, :, column]
    time, values = channel.time[mask], channel.values[repeat, mask, column].astype(float)
    narrow, wide = (
        [_polynomial(time, values, t, r, early, one_sided, config.order) for t in at]
        for r in (reach, config.wider * reach)
    )
    variances = [fit[2] for fit in narrow if fit is not None]
    mean_variance = float(np.mean(variances)) if variances else 0.0
    state, root = np.full((len(at), 2), np.nan), np.zeros((len(at), 2, 2))
    for k, (fit, other) in enumerate(zip(narrow, wide, strict=True)):
        if fit is None or other is None:
            continue
        state[k] = fit[0]
        covariance = max(fit[2], mean_variance) * fit[1] + np.diag((fit[0] - other[0]) ** 2)
        root[k] = np.linalg.cholesky(covariance + 1e-18 * np.eye(2))
    return state, root


def _polynomial(
    time: np.ndarray, values: np.ndarray, at: float, reach: float, early: float, one_sided: bool, order: int
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Position and speed [2] at an instant, their covariance [2, 2] for unit noise, and the noise's variance."""
    inside = np.abs(time - at) <= reach + 1e-9
    x = (time[inside] - at) / reach
    before = one_sided or np.min(x, initial=1.0) < -0.3
    if len(x) <= order + 1 or not (before and np.max(x, initial=-1.0) > 0.3):
        return None
    exponents = np.arange(order + 1)
    powers = x[:, None] ** exponents
    inverse = np.linalg.pinv(powers)
    coefficients = inverse @ values[inside]
    residual = values[inside] - powers @ coefficients
    slope = exponents[1:] * (-early / reach) ** (exponents[1:] - 1) / reach
    weights = np.stack([np.eye(order + 1)[0], np.r_[0.0, slope]]) @ inverse
    return weights @ values[inside], weights @ weights.T, float(residual @ residual) / (len(x) - order - 1)
