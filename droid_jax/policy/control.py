"""Run a trained policy on a robot: policy file, observation, control loop.  It needs numpy only.

`python -m droid_jax.run export` copies this file to the policy's folder.  On the robot's computer:

    import control

    loop = control.Controller(control.load_policy("policy.npz"))
    while not loop.stopped:
        command = loop.act(control.Reading(time, position, velocity, torque, fingers, knob))
        ...  # send command.arm and command.fingers, wait for the next period

or `control.drive(loop, robot, seconds)` with an object that reads, sends and waits.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np

FORMAT = "droid_jax policy 2"
ARM, FINGERS = 7, 2
LAYOUT = (
    *(f"position of joint {i}, rad" for i in range(1, ARM + 1)),
    *(f"velocity of joint {i}, rad/s" for i in range(1, ARM + 1)),
    *(f"{of} from the knob, {axis} of the knob's frame, m" for of in ("pinch point", "left pad", "right pad")
      for axis in "xyz"),
)  # fmt: skip
OBSERVED, ACTIONS = len(LAYOUT), ARM + FINGERS
SHAPES: dict[str, tuple[int, ...]] = {  # of an `Interface`
    "period": (), "reach": (), "width": (), "ranges": (ARM, 2), "speed": (ARM,), "effort": (ARM,),
    "stiffness": (ARM,), "damping": (ARM,), "workspace": (2, 3), "chain": (ARM + 1, 4, 4), "pads": (FINGERS, 3),
    "slides": (FINGERS, 3), "start": (ARM + FINGERS,), "knob": (4, 4),
}  # fmt: skip
MOST_ARRAYS, MOST_BYTES, MOST_HEAD = 100, 64 * 2**20, 4096  # limits of a policy's file, and of an array's header
POSITIVE = ("period", "reach", "width", "speed", "effort", "stiffness")  # fields that must be above zero


@dataclass(frozen=True, eq=False)
class Interface:
    """The properties on which a policy and its robot must agree, from the scene of the training.

    Attributes:
        period: s between actions.
        reach: rad, distance of a joint's target from its position for an action of one.
        width: m, finger command for an action of one; minus one closes the fingers.
        ranges: [7, 2] rad, of the joints.
        speed: [7] rad/s, velocity limits.
        effort: [7] N m, torque limits.
        stiffness: [7] N m/rad, of the position servos, to be set on the robot.
        damping: [7] N m s/rad, likewise.
        workspace: [2, 3] m, lowest and highest corner of the pinch point's workspace, base frame.
        chain: [8, 4, 4] transforms from base to joint 1, joint to joint, and joint 7 to pinch point, with all joints at
            zero.  Each joint turns about its frame's z axis.
        pads: [2, 3] m, pads in the pinch point's frame with closed fingers.
        slides: [2, 3] direction in which a pad moves with its finger's position.
        start: [9] rad and m, arm and fingers at the start of the training.
        knob: [4, 4] pose of the knob at that start, base frame, m.
    """

    period: float
    reach: float
    width: float
    ranges: np.ndarray
    speed: np.ndarray
    effort: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    workspace: np.ndarray
    chain: np.ndarray
    pads: np.ndarray
    slides: np.ndarray
    start: np.ndarray
    knob: np.ndarray


def differing(one: Interface, other: Interface) -> list[str]:
    """Names of the fields in which two interfaces differ by more than single-precision rounding."""
    both = ((f.name, getattr(one, f.name), getattr(other, f.name)) for f in fields(Interface))
    return [name for name, a, b in both if not np.allclose(a, b, rtol=1e-5, atol=1e-6)]


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained network with the normalisation of its observations.

    Attributes:
        mean, std: [23] of the observations in training.
        weights, biases: of each layer.  The last has 18 outputs, of which the first nine are the action before tanh.
        interface: of the robot.
    """

    mean: np.ndarray
    std: np.ndarray
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    interface: Interface

    def act(self, observation: Any, numbers: Any = np) -> Any:
        """[..., 9] in -1 .. 1, the most likely action at observations [..., 23]; numbers: numpy or jax.numpy."""
        x = (observation - self.mean) / self.std
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = numbers.tanh(x @ weight + bias)
        return numbers.tanh((x @ self.weights[-1] + self.biases[-1])[..., :ACTIONS])


def arrays(policy: Policy) -> dict[str, Any]:
    """The content of a policy's npz file: mean, std, weight_0, bias_0, ..., the interface, the observation's layout."""
    layers = {f"weight_{k}": w for k, w in enumerate(policy.weights)}
    layers |= {f"bias_{k}": b for k, b in enumerate(policy.biases)}
    interface: Any = {f.name: getattr(policy.interface, f.name) for f in fields(Interface)}
    head = {"format": FORMAT, "layout": np.array(LAYOUT), "mean": policy.mean, "std": policy.std}
    return {**head, **layers, **interface}


def load_policy(path: str | Path) -> Policy:
    """Read a policy's npz file.

    Raises ValueError for a file that is missing, damaged, not finite, or of another layout of observations.
    """
    try:
        found = _arrays(Path(path))
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file; `train` and `export` write it") from None
    except Exception as error:  # zipfile, zlib and numpy raise many types for damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise ValueError(f"{path} cannot be read: {reason}") from None
    if str(found.get("format")) != FORMAT:
        raise ValueError(f"{path} is no policy: expected format {FORMAT!r}, got {ascii(str(found.get('format')))[:80]}")
    layers = range(sum(name.startswith("weight_") for name in found))
    names = [f"{kind}_{k}" for kind in ("weight", "bias") for k in layers]
    numeric = ("mean", "std", *names, *(f.name for f in fields(Interface)))
    missing = [name for name in dict.fromkeys(("layout", *numeric, "weight_0")) if name not in found]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}")
    layout = [str(name) for name in found["layout"].reshape(-1)]
    if found["layout"].shape != (OBSERVED,) or tuple(layout) != LAYOUT:
        other = [ascii(name)[1:-1][:80] for name in layout if name not in LAYOUT] or ["another order"]
        raise ValueError(f"{path} was trained on another observation: {', '.join(other[:3])}")
    broken = [n for n in numeric if found[n].dtype.kind not in "fiu" or not np.isfinite(found[n]).all()]
    if broken:
        raise ValueError(f"{path}: {', '.join(broken)} hold NaN, infinite values or text; train again")
    wrong = _misshapen(found, len(layers)) or _not_above_zero(found)
    if wrong:
        raise ValueError(f"{path} is damaged: {wrong}; train or export again")
    weights, biases = (tuple(found[f"{kind}_{k}"] for k in layers) for kind in ("weight", "bias"))
    interface: Any = {f.name: found[f.name] if found[f.name].ndim else float(found[f.name]) for f in fields(Interface)}
    return Policy(found["mean"], found["std"], weights, biases, Interface(**interface))


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a policy's file, numbers and text, whose sizes are checked before they are read.

    Not shared with the package's reader, since the robot gets this file only.
    """
    if not path.is_file() and path.exists():
        raise ValueError("it is no regular file")
    out: dict[str, np.ndarray] = {}
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > MOST_ARRAYS or sum(m.file_size for m in members) > MOST_BYTES:
            raise ValueError(f"it declares {len(members)} arrays of {sum(m.file_size for m in members)} bytes")
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in out:
                raise ValueError(f"{name!r} is there twice")
            out[name] = _array(archive.read(member), name)
    return out


def _array(content: bytes, name: str) -> np.ndarray:
    """The array of an npy file's content."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"{name!r} has npy version {version}")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream, max_header_size=MOST_HEAD)
    declared = math.prod(shape) * dtype.itemsize
    if dtype.kind not in "fiuU" or dtype.names or declared != len(content) - stream.tell():
        raise ValueError(f"{name!r} declares {dtype} of shape {shape}, where {len(content) - stream.tell()} bytes are")
    data = stream.read()
    if dtype.kind == "U":
        data.decode("utf-32-be" if dtype.byteorder == ">" else "utf-32-le")  # raises where bytes are no characters
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy()


def _misshapen(found: Mapping[str, np.ndarray], layers: int) -> str | None:
    """The first array of a policy's file with a wrong shape, for messages; None if there is none."""
    inner = [found[f"bias_{k}"].size for k in range(layers - 1)]
    sizes = [OBSERVED, *inner, 2 * ACTIONS]
    expected: dict[str, tuple[int, ...]] = {"mean": (OBSERVED,), "std": (OBSERVED,), **SHAPES}
    for k in range(layers):
        expected |= {f"weight_{k}": (sizes[k], sizes[k + 1]), f"bias_{k}": (sizes[k + 1],)}
    for name, shape in expected.items():
        if found[name].shape != shape:
            return f"{name} has shape {found[name].shape}, expected {shape}"
    return None


def _not_above_zero(found: Mapping[str, np.ndarray]) -> str | None:
    """The first array of a policy's file that must be above zero but is not, for messages; None if there is none."""
    for name in ("std", *POSITIVE):
        if (found[name] <= 0.0).any():
            return f"{name} must be above zero, got {found[name].min():g}"
    return None


@dataclass(frozen=True, eq=False)
class Reading:
    """The state of a robot at one instant.

    Attributes:
        time: s, of any monotonic clock.
        position: [7] rad, of the arm.
        velocity: [7] rad/s, of the arm.
        torque: [7] N m, without gravity compensation; None if not measured.
        fingers: [2] m, distance of each finger from its closed position.
        knob: [4, 4] pose of the knob in the robot's base frame, m; x is the door's inward normal, z is up.
        sight: s, time of the knob's pose on the same clock; None if it is as recent as the rest (such as a pose that is
            computed from an encoder of the hinge).
    """

    time: float
    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray | None
    fingers: np.ndarray
    knob: np.ndarray
    sight: float | None = None


@dataclass(frozen=True, eq=False)
class Command:
    """Targets of the position servos: arm [7] rad and fingers [2] m; why the loop stopped, if it did."""

    arm: np.ndarray
    fingers: np.ndarray
    stopped: str | None = None


def pinch_pose(interface: Interface, position: np.ndarray) -> np.ndarray:
    """[4, 4] pose of the pinch point in the base frame at joint positions [7], rad."""
    pose = interface.chain[0]
    for angle, link in zip(position, interface.chain[1:], strict=True):
        c, s = np.cos(angle), np.sin(angle)
        pose = pose @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ link
    return pose


def observe(interface: Interface, reading: Reading) -> np.ndarray:
    """[23] the observation of a reading (`LAYOUT`)."""
    hand = pinch_pose(interface, reading.position)
    pads = interface.pads + reading.fingers[:, None] * interface.slides
    points = np.vstack([hand[:3, 3], pads @ hand[:3, :3].T + hand[:3, 3]])
    in_knob_frame = (points - reading.knob[:3, 3]) @ reading.knob[:3, :3]
    return np.concatenate([reading.position, reading.velocity, in_knob_frame.reshape(-1)])


@dataclass(frozen=True)
class Safety:
    """Limits at which the control loop stops.

    Attributes:
        late: largest delay of a reading, as a share of the period.
        early: largest advance of a reading, as a share of the period.
        speed: largest measured velocity, as a share of the arm's limit.
        effort: largest measured torque, as a share of the arm's limit.
        margin: rad, least distance of targets from the ends of the joints' ranges, and largest distance of a joint
            beyond them.
        off: m, largest distance of the knob from its position in training when the loop begins.
        turned: rad, likewise of its rotation.
        old: s, largest age of the knob's pose relative to its reading.
    """

    late: float = 0.5
    early: float = 0.5
    speed: float = 1.0
    effort: float = 1.1
    margin: float = 0.02
    off: float = 0.03
    turned: float = 0.2
    old: float = 0.1


class Controller:
    """The control loop of a policy, from a reading to a command.

    Targets stay inside the joints' ranges.  They also stay so close to the arm that the servo's spring torque,
    stiffness times distance, is within the joints' limits.  The loop stops if

    - a reading or its pose of the knob is stale, late, early, of a wrong shape, or not finite,
    - a joint is out of its range, or a measured velocity or torque exceeds its limit,
    - the hand is outside the workspace, or the command is not finite.

    From then on it commands the pose of the last valid reading, and `stopped` gives the reason.
    """

    def __init__(self, policy: Policy, safety: Safety | None = None):
        self.policy, self.safety = policy, safety or Safety()
        self.stopped: str | None = None
        self._hold: Command | None = None
        self._time = -np.inf

    def act(self, reading: Reading) -> Command:
        """The command for the period that begins with this reading.

        Raises ValueError if the first reading is invalid, since there is no pose to hold.
        """
        if self.stopped is None:
            try:
                reading = _copied(reading)
                self.stopped = fault(self.policy.interface, self.safety, reading, self._time)
            except (TypeError, ValueError) as error:
                self.stopped = f"a reading that cannot be read: {error}"
        if self.stopped is None:
            action = self.policy.act(observe(self.policy.interface, reading))
            command = limited(self.policy.interface, self.safety, reading.position, action)
            if np.isfinite(command.arm).all() and np.isfinite(command.fingers).all():
                self._hold, self._time = Command(reading.position, command.fingers), reading.time
                return command
            self.stopped = "the policy's command holds a value that is NaN or infinite"
        return self.hold()

    def hold(self) -> Command:
        """The arm's pose of the last valid reading and the last finger command; ValueError if there is none."""
        if self._hold is None:
            raise ValueError(f"cannot begin: {self.stopped or 'nothing was read yet'}")
        return Command(self._hold.arm, self._hold.fingers, self.stopped)


def _copied(reading: Reading) -> Reading:
    """A copy, since a driver may write into its arrays later."""
    return Reading(
        time=reading.time,
        position=np.array(reading.position, float),
        velocity=np.array(reading.velocity, float),
        torque=None if reading.torque is None else np.array(reading.torque, float),
        fingers=np.array(reading.fingers, float),
        knob=np.array(reading.knob, float),
        sight=reading.sight,
    )


def limited(interface: Interface, safety: Safety, position: Any, action: Any, numbers: Any = np) -> Command:
    """The command of an action [9] at joint positions [7], limited by torques and ranges.

    Training uses it too, so that a policy is trained with the limits of the robot.  numbers: numpy or jax.numpy.
    """
    action = numbers.clip(action, -1.0, 1.0)
    farthest = interface.effort / interface.stiffness
    low, high = interface.ranges[:, 0] + safety.margin, interface.ranges[:, 1] - safety.margin
    arm = numbers.clip(position + numbers.clip(interface.reach * action[:ARM], -farthest, farthest), low, high)
    return Command(arm, 0.5 * interface.width * (1.0 + action[ARM:]))


def fault(interface: Interface, safety: Safety, reading: Reading, before: float) -> str | None:
    """Why the loop must stop at a reading; None if it may continue.

    before: s, time of the reading before it; minus infinity for the first.
    """
    invalid = _invalid({"position": (reading.position, (ARM,)), "velocity": (reading.velocity, (ARM,)),
                        "fingers": (reading.fingers, (FINGERS,)), "knob": (reading.knob, (4, 4)),
                        **({} if reading.torque is None else {"torque": (reading.torque, (ARM,))})})  # fmt: skip
    if invalid is not None:
        return invalid
    if not np.isfinite(reading.time) or reading.time <= before:
        return f"stale reading: its time is {reading.time:g} s, the last one's was {before:g} s"
    if reading.time - before < (1.0 - safety.early) * interface.period:
        return f"early: {1e3 * (reading.time - before):.0f} ms between readings, expected {1e3 * interface.period:.0f}"
    if reading.time - before > (1.0 + safety.late) * interface.period and np.isfinite(before):
        return f"late: {1e3 * (reading.time - before):.0f} ms between readings, expected {1e3 * interface.period:.0f}"
    if reading.sight is not None and not abs(reading.time - reading.sight) <= safety.old:  # NaN is stale too
        return f"stale pose of the knob: it is of {reading.sight:g} s, the reading of {reading.time:g} s"
    middle, half = interface.ranges.mean(axis=1), np.ptp(interface.ranges, axis=1) / 2 + safety.margin
    outside = _beyond(reading.position - middle, half, "rad from the middle of its range")
    if outside is not None:
        return f"out of range: {outside}"
    fast = _beyond(reading.velocity, safety.speed * interface.speed, "rad/s")
    if fast is not None:
        return f"too fast: {fast}"
    overload = None if reading.torque is None else _beyond(reading.torque, safety.effort * interface.effort, "N m")
    if overload is not None:
        return f"too much torque: {overload}"
    point = pinch_pose(interface, reading.position)[:3, 3]
    if (point < interface.workspace[0]).any() or (point > interface.workspace[1]).any():
        return f"the hand has left its workspace: it is at ({', '.join(f'{x:.2f}' for x in point)}) m"
    return _knob_elsewhere(interface, safety, reading.knob, not np.isfinite(before))


def _knob_elsewhere(interface: Interface, safety: Safety, knob: np.ndarray, first: bool) -> str | None:
    """Why a pose of the knob is invalid, or not the one of the training if the reading is the first; else None."""
    rotation = knob[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        return "the knob's pose is invalid: its first three rows and columns are no rotation"
    if not first:
        return None
    distance = float(np.linalg.norm(knob[:3, 3] - interface.knob[:3, 3]))
    angle = float(np.arccos(np.clip((np.trace(interface.knob[:3, :3].T @ rotation) - 1) / 2, -1, 1)))
    if distance > safety.off or angle > safety.turned:
        return (
            f"the knob is elsewhere: {distance:.2f} m and {angle:.2f} rad from its pose in training, "
            f"({', '.join(f'{x:.2f}' for x in interface.knob[:3, 3])}) m in the base frame"
        )
    return None


def _invalid(values: Mapping[str, tuple[Any, tuple[int, ...]]]) -> str | None:
    for name, (value, shape) in values.items():
        if np.shape(value) != shape:
            return f"{name} must have shape {list(shape)}, got {list(np.shape(value))}"
        if not np.isfinite(value).all():
            return f"{name} holds a value that is NaN or infinite"
    return None


def _beyond(values: np.ndarray, limits: np.ndarray, unit: str) -> str | None:
    over = np.abs(values) > limits
    if not over.any():
        return None
    joint = int(np.argmax(np.abs(values) / limits))
    return f"joint {joint + 1} at {values[joint]:.3g} {unit}, limit {limits[joint]:.3g}"


class ControlledRobot(Protocol):
    """The interface that `drive` needs of a robot."""

    def read(self) -> Reading:
        """The current state."""
        ...

    def send(self, command: Command) -> None:
        """Send the targets to the servos."""
        ...

    def wait(self, period: float) -> None:
        """Sleep until the next period begins; period: s."""
        ...


def drive(controller: Controller, robot: ControlledRobot, seconds: float) -> str | None:
    """Control a robot for `seconds` s, or until the loop stops; returns why it stopped, or None.

    At the end, also if a function of the robot raises, the robot is sent one command to hold its pose.  A robot that
    needs commands continuously must be sent `Controller.hold` further on.
    """
    started = False
    try:
        for _ in range(round(seconds / controller.policy.interface.period)):
            command = controller.act(robot.read())
            started = True
            if command.stopped is not None:
                break
            robot.send(command)
            robot.wait(controller.policy.interface.period)
    finally:
        if started:
            robot.send(controller.hold())
    return controller.stopped
