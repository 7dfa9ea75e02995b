"""Logs for `check`: synthetic ones of a two-link arm, real public ones, and the errors that are put into them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from droid_jax.door.scene import ARM, panda_arm_scene
from droid_jax.model.scene import Scene, compile_scene, load_scene
from droid_jax.recordings.column_map import ChannelMap, ColumnMap, TimeMap, Units
from droid_jax.recordings.log_files import read_log
from droid_jax.recordings.recording import Channel, Recording, ServoGains, TorqueConvention, TorqueSide

ROOT = Path(__file__).resolve().parents[1]
JOINTS = ("shoulder", "elbow")
RATE = 250.0  # Hz, of synthetic logs
KP = np.array([60.0, 25.0])
_ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" armature="0.12" damping="3"/>
    <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="2" contype="0" conaffinity="0"/>
    <body name="fore" pos=".3 0 0"><joint name="elbow" axis="0 1 0" armature="0.05" damping="1"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .25 0 0" mass="1" contype="0" conaffinity="0"/></body></body>
</worldbody>
<actuator><position joint="shoulder" kp="60"/><position joint="elbow" kp="25"/></actuator></mujoco>"""
_PENDULUM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body><joint name="pendulum" axis="0 1 0" armature="0.0018" damping="{damping}" frictionloss="0.013"/>
  <inertial pos="0 0 -0.1" mass="0.49" diaginertia="1e-5 1e-5 1e-5"/></body></worldbody>
<actuator><position joint="pendulum" kp="{kp}" forcerange="-0.7 0.7"/></actuator></mujoco>"""
_LEG = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><joint armature="0.01" damping="0.6" frictionloss="0.2"/><position kp="20" kv="1.5"/></default>
<worldbody><body pos="0.1934 0.0465 0"><joint name="hip" axis="1 0 0" range="-1.047 1.047"/>
 <inertial pos="-0.0054 0.00194 -0.000105" mass="0.678" diaginertia="0.00088403 0.000596 0.00047997"
  quat="0.49701389 0.49924489 0.50546189 0.49823689"/>
 <body pos="0 0.0955 0"><joint name="thigh" axis="0 1 0" range="-1.571 3.491"/>
  <inertial pos="-0.00374 -0.0223 -0.0327" mass="1.152" diaginertia="0.00594973 0.00584149 0.00087879"
   quat="0.82953287 0.08476349 -0.0200632 0.55162291"/>
  <body pos="0 0 -0.213"><joint name="calf" axis="0 1 0" range="-2.723 -0.838"/>
   <inertial pos="0.00629595 -0.00062212 -0.141417" mass="0.241352" diaginertia="1.49010e-3 1.46356e-3 5.31397e-5"
    quat="0.71067171 0.00154099 -0.00450087 0.70350771"/></body></body></body></worldbody>
<actuator><position joint="hip"/><position joint="thigh"/><position joint="calf"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Case:
    """A log with the scene that it is checked in.

    known: kinds of findings that are correct about the unchanged log.
    """

    name: str
    scene: Scene
    recording: Recording
    known: tuple[str, ...] = ()


def _scene(xml: str, name: str, joints: tuple[str, ...]) -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(xml), name, joints=joints)


def two_link() -> Scene:
    """The arm at its nominal values."""
    return _scene(_ARM, "arm", JOINTS)


def played(
    model: mujoco.MjModel, control: np.ndarray, start: np.ndarray, late: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Torques and positions [T, J] of C MuJoCo at RATE, four steps per row.

    control: [T, U].  start: [J] rad.  late: delay of the commands in steps.
    """
    data = mujoco.MjData(model)
    torque, position = np.empty((2, len(control), model.nq))
    data.qpos[:] = start
    for k in range(4 * len(control)):
        data.ctrl[:] = control[max(0, k - late) // 4]
        at = data.qpos.copy()
        mujoco.mj_step(model, data)
        if k % 4 == 0:
            torque[k // 4], position[k // 4] = data.qfrc_actuator, at
    return torque, position


def measured(
    time: np.ndarray, torque: np.ndarray, position: np.ndarray, repeats: int, rng: np.random.Generator
) -> dict[str, Channel]:
    """Channels of several repeats of torques and positions [T, J], with noise."""
    torque = torque + rng.normal(0.0, 0.05, (repeats, *torque.shape))
    position = position + rng.normal(0.0, 2e-4, (repeats, *position.shape))
    mask = np.ones(torque.shape, bool)
    return {
        "torque": Channel("torque", "N m", JOINTS, time, torque, mask),
        "position": Channel("position", "rad", JOINTS, time, position, mask),
    }


def synthetic(seed: int, scene: Scene) -> Case:
    """A log of the arm with other masses, damping, friction and delay than the scene's, in C MuJoCo, with noise.

    Motion, repeats, noise, and whether positions, torques and commands are in the log are drawn from the seed.
    """
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(scene.spec.to_xml())
    factors = rng.uniform(0.7, 1.5, 2)
    model.body_mass[1:] *= factors
    model.body_inertia[1:] *= factors[:, None]
    model.dof_damping[:] *= rng.uniform(0.4, 2.0, 2)
    model.dof_armature[:] *= rng.uniform(0.6, 1.5, 2)
    model.dof_frictionloss[:] = rng.uniform(0.0, 0.3, 2)
    model.opt.timestep = 1.0 / (4 * RATE)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    time = np.arange(0.0, rng.uniform(8.0, 16.0), 1.0 / RATE)
    waves = rng.uniform(0.15, 0.8, (2, 3, 1)) * time * 2 * np.pi
    size = rng.uniform(0.1, 0.6, (2, 1)) / 3
    ease = np.clip(time, 0, 1) ** 2
    command = rng.uniform(-0.5, 0.5, 2) + (size * ease * np.sin(waves).sum(axis=1)).T
    late = int(rng.integers(0, 2)) * 4  # ms
    channels = measured(time, *played(model, command, command[0], late), int(rng.integers(1, 5)), rng)
    kind = ("whole", "whole", "log", "positions")[seed % 4]
    if kind == "positions":
        del channels["torque"]
    if kind == "log":
        time, command = np.zeros(0), np.zeros((0, 0))
    names = JOINTS if kind != "log" else ()
    gains = ServoGains(KP, np.zeros(2)) if names else None
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    recording = Recording(f"{kind}_{seed}", time, command, names, channels, convention, qpos0={}, gains=gains)
    return Case(f"synthetic/{recording.name}", scene, recording)


def real(folder: Path) -> Iterator[Case]:
    """The public logs in a folder, as far as they exist: so101, bam_xl330, go2_leg, franka_gaz2019, emps,
    door_pr2_ikea.
    """
    rad = Units(angle="rad", torque="N m", time="s")
    so101 = folder / "so101"
    if so101.is_dir():
        names = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
        scene = load_scene(so101 / "so101_air.xml", joints=names)
        state = "state_motor.csv*"
        columns = ColumnMap(
            joints=list(names), time=TimeMap("timestamp", "us"), command=ChannelMap("positions", file="control.csv*"),
            position=ChannelMap("positions", file=state), units=Units(angle="rad"),
        )  # fmt: skip
        for path in sorted(p for p in so101.iterdir() if p.is_dir()):
            yield Case(f"so101/{path.name}", scene, _read(path, columns))
    for path in sorted((folder / "bam_xl330").glob("*.npz")):
        gain = 0.7028 * 0.002877 * float(path.stem.rpartition("kp")[2])  # kt V / R times duty per rad
        scene = _scene(_PENDULUM.format(kp=gain, damping=0.041), path.stem, ("pendulum",))
        columns = ColumnMap(
            joints=["pendulum"], time="time", command="goal_position", position="position", rate=185.0, units=rad
        )
        recording = _read(path, columns)
        if path.stem.startswith("lift_and_drop"):  # the motor is off after two seconds
            recording = recording.window(0.0, 1.9)
        yield Case(f"xl330/{path.stem}", scene, recording)
    leg = folder / "go2_leg" / "go2_first_12s.npz"
    if leg.exists():
        joints = ("hip", "thigh", "calf")
        columns = ColumnMap(
            joints=list(joints), time="time", command="desired_position[0:3]", position="position[0:3]", units=rad
        )
        yield Case("go2/leg", _scene(_LEG, "leg", joints), _read(leg, columns))
    panda = folder / "franka_gaz2019" / "panda_exciting_traj1.npz"
    if panda.exists():
        columns = ColumnMap(
            joints=list(ARM), time="t", position="q", torque="tau", side="link", gravity=True, rate=500.0, units=rad
        )
        yield Case("panda/exciting", panda_arm_scene(), _read(panda, columns))
    for path in sorted((folder / "emps").glob("*.npz")):
        with np.load(path) as file:
            constant = float(file["gtau"])
        columns = ColumnMap(
            joints=["slide"], slides=["slide"], time="t", position="qm", side="motor", gravity=True,
            torque=ChannelMap("vir", unit="V", torque_constant=constant), units=Units(length="m", time="s"),
        )  # fmt: skip
        yield Case(
            f"emps/{path.stem}", load_scene(ROOT / "experiments" / "emps.xml", joints=["slide"]), _read(path, columns)
        )

    for path in sorted((folder / "door_pr2_ikea").glob("*.npz")):
        with np.load(path) as file:
            radius = float(file["radius_fit"])
        columns = ColumnMap(
            joints=["hinge"], time="t_reconstructed", position="angle_fit", side="motor", gravity=True,
            torque=ChannelMap("ftan_ati_fit", unit="N m", scale=-radius), units=rad,
        )  # fmt: skip
        scene = load_scene(ROOT / "experiments" / "cabinet.xml", joints=["hinge"], object_joint="hinge")
        yield Case(f"door/{path.stem}", scene, _read(path, columns))


def _read(path: Path, columns: ColumnMap) -> Recording:
    return read_log([path], columns)[0]


# Errors ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Error:
    """A wrong use of a log.

    kinds: of findings that name it.  words: one of them must be in the finding's sentence.
    applies: whether it can be put into a recording.  put: does it.  scene: changes the scene.
    """

    name: str
    kinds: tuple[str, ...]
    words: tuple[str, ...]
    applies: Callable[[Case], bool]
    put: Callable[[Recording], Recording]
    scene: Callable[[Case], Scene] = lambda case: case.scene


def stronger(case: Case) -> Scene:
    """The scene with ten times its servos' gains."""
    scene, spec = case.scene, case.scene.spec.copy()
    for actuator in spec.actuators:
        actuator.gainprm[0] *= 10.0
        actuator.biasprm[1] *= 10.0
        actuator.biasprm[2] *= 10.0
    return compile_scene(spec, scene.name, joints=scene.joints)


def _channel(r: Recording, name: str, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    if name not in r.channels:
        return r
    return replace(r, channels={**r.channels, name: replace(r.channels[name], values=change(r.channels[name].values))})


def _positions(r: Recording, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """Change positions and commands alike."""
    changed = _channel(r, "position", change)
    return replace(changed, command=change(r.command)) if r.command.size else changed


def _torque(c: Case) -> bool:
    return "torque" in c.recording.channels


def _command(c: Case) -> bool:
    return bool(c.recording.command.size)


def _several(c: Case) -> bool:
    return len(c.recording.channels["position"].columns) > 1


def _both(c: Case) -> bool:
    return _torque(c) and _command(c)


def _turned(values: np.ndarray) -> np.ndarray:
    """The last joint's sign turned."""
    return values * np.where(np.arange(values.shape[-1]) == values.shape[-1] - 1, -1.0, 1.0)


def _exchanged(values: np.ndarray) -> np.ndarray:
    """The first two joints exchanged."""
    return values[..., [1, 0, *range(2, values.shape[-1])]]


def _no_gains(r: Recording) -> Recording:
    """The scene's gains count."""
    return replace(r, gains=None)


def _late(r: Recording, seconds: float) -> Recording:
    """Measurements with stamps later than the true times."""
    channels = {key: replace(c, time=c.time + seconds) for key, c in r.channels.items()}
    return replace(r, channels=channels)


def _nominal(r: Recording) -> Recording:
    """Commands at a nominal rate that differs from that of their stamps."""
    return replace(r, time=r.time * 0.985)


def _saturated(r: Recording) -> Recording:
    torque = r.channels["torque"]
    limit = 0.6 * np.abs(np.where(torque.mask, torque.values, 0.0)).max(axis=(0, 1))
    return _channel(r, "torque", lambda v: np.clip(v, -limit, limit))


def _gravity(r: Recording) -> Recording:
    return replace(r, torque=replace(r.torque, gravity=not r.torque.gravity))


def _always(c: Case) -> bool:
    return True


def _first_dead(values: np.ndarray) -> np.ndarray:
    return values * np.where(np.arange(values.shape[-1]) == 0, 0.0, 1.0)


def _several_torques(c: Case) -> bool:
    return _torque(c) and _several(c)


def _heavy(c: Case) -> bool:
    """Whether the torque can hold a weight."""
    return _torque(c) and bool(np.any(c.scene.model.opt.gravity))


def _command_in_rad(c: Case) -> bool:
    return _command(c) and c.recording.channels["position"].unit == "rad"


def _in_other_units(r: Recording) -> Callable[[np.ndarray], np.ndarray]:
    """Degrees, or millimetres of slides."""
    return np.rad2deg if r.channels["position"].unit == "rad" else lambda v: 1e3 * v


def _several_commands(c: Case) -> bool:
    return _command(c) and _several(c)


def of(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recording], Recording]:
    """A function that changes a channel, or the command."""
    if name == "command":
        return lambda r: replace(r, command=change(r.command))
    return lambda r: _channel(r, name, change)


def _whole(r: Recording, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """All clocks."""
    channels = {key: replace(c, time=change(c.time)) for key, c in r.channels.items()}
    return replace(r, time=change(r.time), channels=channels)


def _span(r: Recording) -> float:
    values = r.channels["position"].values[r.channels["position"].mask]
    return float(np.abs(values).max())


def _register(values: np.ndarray) -> np.ndarray:
    """Per mille of the largest torque, of the other sign."""
    return -np.round(1000.0 * values / np.nanmax(np.abs(values)))


def _per_cent(values: np.ndarray) -> np.ndarray:
    """Per cent of each joint's rated torque, which is a fifth above the largest torque of the log."""
    return 100.0 * values / (1.2 * np.nanmax(np.abs(values), axis=(0, 1)))


def _crosses(c: Case) -> bool:
    """Whether every torque changes its sign, so that a magnitude loses information."""
    if not _torque(c):
        return False
    values = c.recording.channels["torque"].values
    return bool(np.all(np.mean(values > 0, axis=(0, 1)) > 0.1) and np.all(np.mean(values > 0, axis=(0, 1)) < 0.9))


def magnitude(values: np.ndarray) -> np.ndarray:
    """A register of 50 steps without a sign, whose first steps read 0."""
    step = np.nanmax(np.abs(values), axis=(0, 1)) / 60.0
    return step * np.maximum(np.round(np.abs(values) / step) - 3.0, 0.0)


def _standing(r: Recording) -> Recording:
    """The value of the first instant throughout, with the noise of the log."""

    def stopped(values: np.ndarray) -> np.ndarray:
        return values[:, :1] + 1e-4 * np.sin(7.0 * np.arange(values.shape[1]))[None, :, None]

    still = replace(r, channels={k: replace(c, values=stopped(c.values)) for k, c in r.channels.items()})
    return replace(still, command=np.tile(r.command[:1], (len(r.command), 1))) if r.command.size else still


def _fastest(r: Recording) -> float:
    """s, where a position's mean changes most quickly, not near the ends."""
    c = r.channels["position"]
    speed = np.abs(np.gradient(np.where(c.mask, c.values, 0.0).mean(axis=0), c.time, axis=0)).max(axis=1)
    inner = slice(len(speed) // 5, len(speed) // 2)
    return float(c.time[inner][np.argmax(speed[inner])])


def _cut(r: Recording) -> Recording:
    return r.window(_fastest(r), r.span[1])


def _limited(share: float, torque: bool) -> Callable[[Case], Scene]:
    """A scene whose actuators do a share of what the log has; torque: of its torques, else of its commands."""

    def limit(case: Case) -> Scene:
        spec, recording = case.scene.spec.copy(), case.recording
        for actuator in spec.actuators:
            joint = actuator.target
            if torque:
                c = recording.channels["torque"]
                most = share * float(np.abs(c.values[..., c.columns.index(joint)]).max())
                actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-most, most]
            elif joint in recording.command_names:
                path = recording.command[:, recording.command_names.index(joint)]
                middle, half = (path.max() + path.min()) / 2, share * np.ptp(path) / 2 + 1e-3
                actuator.ctrllimited, actuator.ctrlrange = (
                    mujoco.mjtLimited.mjLIMITED_TRUE,
                    [middle - half, middle + half],
                )
        return compile_scene(spec, case.scene.name, joints=case.scene.joints)

    return limit


def _floating(case: Case) -> Scene:
    """The robot on a floating base."""
    base = '<body name="loose_base"><freejoint/><inertial pos="0 0 0" mass="5" diaginertia="0.1 0.1 0.1"/>'
    before, _, after = case.scene.spec.to_xml().partition("<worldbody>")
    xml = f"{before}<worldbody>{base}{after}".replace("</worldbody>", "</body></worldbody>")
    return _scene(xml, case.scene.name, case.scene.joints)


def _without_files(c: Case) -> bool:
    return c.name.startswith(("synthetic", "xl330", "go2"))


def _silent(r: Recording) -> Recording:
    """Nothing measured for a tenth of a second in the middle."""

    def cut(time: np.ndarray) -> np.ndarray:
        middle = (time[0] + time[-1]) / 2
        return np.abs(time - middle) > max(0.05, 4.0 * float(np.median(np.diff(time))))

    channels = {}
    for key, c in r.channels.items():
        keep = cut(c.time)
        channels[key] = replace(c, time=c.time[keep], values=c.values[:, keep], mask=c.mask[:, keep])
    return replace(r, channels=channels)


def _apart(r: Recording) -> Recording:
    """Two repeats, the second one 30 mrad (mm) elsewhere, with noise of its own."""
    twice = r.repeats_subset([0, 0])
    offset = np.array([0.0, 0.03])[:, None, None]
    ripple = 1e-3 * np.random.default_rng(0).normal(size=twice.channels["position"].values.shape)
    return _channel(twice, "position", lambda v: v + offset + ripple)


def _turned_round(values: np.ndarray) -> np.ndarray:
    """Every joint's column under the name of the next joint."""
    return np.roll(values, 1, axis=-1)


def _three_commands(c: Case) -> bool:
    return _command(c) and len(c.recording.command_names) > 2


def _three_torques(c: Case) -> bool:
    return _torque(c) and len(c.recording.channels["torque"].columns) > 2


def _turns(c: Case) -> bool:
    return c.recording.channels["position"].unit == "rad"


ERRORS = (
    Error(
        "degrees", ("units", "range"), ("degrees", "millimetres"), _always, lambda r: _positions(r, _in_other_units(r))
    ),
    Error("degrees in positions alone", ("units", "range"), ("degrees",), _command, of("position", np.rad2deg)),
    Error("milliamperes", ("units",), ("milliamperes",), _torque, of("torque", lambda v: 1e3 * v / 1.6)),
    Error("amperes", ("units",), ("amperes",), _torque, of("torque", lambda v: v / 9.0)),
    Error("sign of a torque", ("sign",), ("sign",), _torque, of("torque", _turned)),
    Error("sign of all torques", ("sign",), ("sign",), _torque, of("torque", np.negative)),
    Error("sign of a command", ("sign",), ("sign",), _command, of("command", _turned)),
    Error("sign of a position", ("sign",), ("sign",), _always, of("position", _turned)),
    Error("order of torques", ("order",), ("exchanged", "order"), _several_torques, of("torque", _exchanged)),
    Error("order of commands", ("order",), ("exchanged", "order"), _several_commands, of("command", _exchanged)),
    Error("order of positions", ("order",), ("exchanged", "order"), _several, of("position", _exchanged)),
    Error("gravity flag", ("gravity",), ("weight",), _heavy, _gravity),
    Error("delay of 60 ms", ("delay",), ("late",), _both, lambda r: _late(r, 0.06)),
    Error("nominal rate", ("clock",), ("rate",), _command, _nominal),
    Error("saturation", ("saturation",), ("stays at",), _torque, _saturated),
    Error("copies of a repeat", ("repeats",), ("identical",), _always, lambda r: r.repeats_subset([0, 0])),
    Error("dead position", ("sensor",), ("dead", "does not move"), _always, of("position", _first_dead)),
    Error("gains of another robot", ("gains", "units"), ("gains",), _command, _no_gains, stronger),
    Error("degrees in commands alone", ("units", "range"), ("degrees",), _command_in_rad, of("command", np.rad2deg)),
    Error(
        "normalised positions",
        ("units", "range"),
        ("normalised",),
        _turns,
        lambda r: _positions(r, lambda v: 100.0 * v / _span(r)),
    ),
    Error(
        "encoder counts",
        ("units", "range"),
        ("counts", "degrees"),
        _turns,
        lambda r: _positions(r, lambda v: np.round(4096.0 * v / (2 * np.pi))),
    ),
    Error("milliseconds", ("clock",), ("millisecond",), _always, lambda r: _whole(r, lambda t: 1e3 * t)),
    Error("load register", ("sign", "units"), ("load register",), _torque, of("torque", _register)),
    Error("per cent", ("units",), ("per cent",), _torque, of("torque", _per_cent)),
    Error("magnitudes", ("sign",), ("load register",), _crosses, of("torque", magnitude)),
    Error("dead torque", ("sensor",), ("dead", "does not move"), _several_torques, of("torque", _first_dead)),
    Error("rotated torques", ("order",), ("order",), _three_torques, of("torque", _turned_round)),
    Error("rotated commands", ("order",), ("order",), _three_commands, of("command", _turned_round)),
    Error("rotated positions", ("order",), ("order",), _three_commands, of("position", _turned_round)),
    Error("no motion", ("motion",), ("nothing moves",), _always, _standing),
    Error("begins in motion", ("start",), ("begins while",), _command, _cut),
    Error("commands beyond ctrlrange", ("scene",), ("ctrlrange",), _command, lambda r: r, _limited(0.5, torque=False)),
    Error("torques beyond forcerange", ("scene",), ("forcerange",), _both, lambda r: r, _limited(0.5, torque=True)),
    Error("a base that nothing holds", ("scene",), ("free", "base", "held"), _without_files, lambda r: r, _floating),
    Error("a gap in time", ("clock",), ("gap",), _always, _silent),
    Error("repeats that start apart", ("repeats",), ("apart",), _command, _apart),
    Error(
        "set-points that no replay uses",
        ("unused",),
        ("set-points",),
        _command,
        lambda r: replace(r, meta={**r.meta, "unused_setpoints": "velocity"}),
    ),
)
