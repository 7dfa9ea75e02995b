"""The interface of hidden effects, and the loop of mj_step that calls them.

Nothing here uses the library of effects of the search for missing effects.  A blind test is only valid if the hidden
effects were written independently.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import scipy.signal

from droid_jax.model.scene import Scene
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import TorqueSide


@dataclass(frozen=True, eq=False)
class Place:
    """What one effect acts on in one repeat.

    Attributes:
        scene: the instrumented scene.
        joints: on which a joint effect acts.
        repeat: number, from 0.
        period: s from the start of a repeat to the start of the next, including the pause.
        side: of the torque sensors.
    """

    scene: Scene
    joints: tuple[str, ...]
    repeat: int = 0
    period: float = 0.0
    side: TorqueSide = TorqueSide.MOTOR

    @functools.cached_property
    def dofs(self) -> np.ndarray:
        """Velocity addresses of `joints`."""
        return np.array([self.scene.dof(j) for j in self.joints], dtype=int)

    @functools.cached_property
    def qpos(self) -> np.ndarray:
        """Position addresses of `joints`."""
        return np.array([self.scene.qpos(j) for j in self.joints], dtype=int)

    @functools.cached_property
    def columns(self) -> np.ndarray:
        """Sensor columns of `joints`."""
        return np.array([self.scene.joints.index(j) for j in self.joints], dtype=int)

    @functools.cached_property
    def actuators(self) -> np.ndarray:
        """Actuators (command columns) that drive `joints`."""
        without = [j for j in self.joints if j not in self.scene.command_names]
        if without:
            raise ValueError(f"no actuator of scene {self.scene.name!r} drives {', '.join(without)}")
        return np.array([self.scene.command_names.index(j) for j in self.joints], dtype=int)

    @property
    def hinge(self) -> str:
        """The object's joint."""
        return str(self.scene.object_joint)


@dataclass(frozen=True, eq=False)
class Live:
    """A running simulation, as views into MuJoCo's memory.

    Before each step `control` is the command, `applied` and `gear` are zero, and `loss` is the model's friction loss;
    effects change them.

    Attributes:
        model, data: of the simulation.
        timestep: s.
        position, velocity: [nq], [nv] rad, rad/s (m, m/s).
        applied: [nv] N m (N), applied forces (qfrc_applied).
        loss: [nv] N m (N), friction loss.
        motor: [nv] N m (N), actuator forces of the last step.
        control: [U] command.
        gear: [nv] N m (N), the part of `applied` between motor and link, which a link-side sensor measures.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    timestep: float
    position: np.ndarray
    velocity: np.ndarray
    applied: np.ndarray
    loss: np.ndarray
    motor: np.ndarray
    control: np.ndarray
    gear: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData) -> Live:
        """Views of a model and its data."""
        return cls(
            model, data, float(model.opt.timestep), data.qpos, data.qvel, data.qfrc_applied, model.dof_frictionloss,
            data.qfrc_actuator, data.ctrl, np.zeros(model.nv),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SensorInput:
    """Input of the sensors in one repeat, at the simulation's time steps.

    Attributes:
        clock: [T] s from the start of the repeat.
        torque: [T, J] N m.
        position: [T, J] rad.
    """

    clock: np.ndarray
    torque: np.ndarray
    position: np.ndarray


@dataclass(frozen=True, eq=False)
class Influence:
    """The functions of one effect in one repeat, in the order of their calls; each may be None.

    Attributes:
        edit: changes the model.
        command: (clock [T] s, command [T, U]) -> command [T, U].
        begin: is called once, in the start pose and, in recordings, with the first command in `Live.control` (in trials
            of policies it is still 0).  It may move links behind their encoders, which read the start pose.
        step: is called before each mj_step.
        sense: changes the input of the sensors.
    """

    edit: Callable[[mujoco.MjModel], None] | None = None
    command: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    begin: Callable[[Live], None] | None = None
    step: Callable[[Live], None] | None = None
    sense: Callable[[SensorInput], SensorInput] | None = None


@dataclass(frozen=True)
class Hidden:
    """A hidden effect.

    Attributes:
        name: of the effect.
        unit: of its amplitude; amplitude zero is exactly no effect.
        typical: range of amplitudes that are noticeable but safe on the door and the Panda.
        on: "hinge" (the object's joint), "arm" (measured joints), "joint" (measured joints, or the hinge by name),
            "hand" (the last body), "base" (the arm's mount), "grip" (contact pairs).
        make: (place, amplitude) -> the effect in one repeat, with a new state.
        what: description for lists, in a few words.
        signed: whether a negative amplitude is valid.
    """

    name: str
    unit: str
    typical: tuple[float, float]
    on: str
    make: Callable[[Place, float], Influence]
    what: str
    signed: bool = False


def start_simulation(
    model: mujoco.MjModel, data: mujoco.MjData, influences: Sequence[Influence]
) -> tuple[Live, Callable[[np.ndarray], None]]:
    """Begin the effects; returns the simulation and a function of a command [U] that makes one step."""
    live, model_loss = Live.of(model, data), model.dof_frictionloss.copy()
    for influence in influences:
        if influence.begin:
            influence.begin(live)
    steps = [i.step for i in influences if i.step]
    applied, gear, loss, ctrl = live.applied, live.gear, live.loss, live.control

    def advance(command: np.ndarray) -> None:
        ctrl[:] = command
        applied[:] = 0.0
        gear[:] = 0.0
        loss[:] = model_loss
        for step in steps:
            step(live)
        mujoco.mj_step(model, data)

    return live, advance


def step_through(
    model: mujoco.MjModel,
    qpos0: np.ndarray,
    control: np.ndarray,
    influences: Sequence[Influence],
    gears: np.ndarray | None = None,
) -> np.ndarray:
    """Simulate one repeat by mj_step.

    Args:
        model: instrumented; it is not changed.
        qpos0: [nq] start pose, as the encoders read it.
        control: [T, U] commands.
        influences: the effects.
        gears: [T, nv] an output, N m, torques of effects between motors and links.

    Returns:
        [T, S] sensor values; all NaN if the simulation diverges.
    """
    model = copy.copy(model)
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = qpos0, control[0]
    model_loss = model.dof_frictionloss.copy()
    live, advance = start_simulation(model, data, influences)
    rows, sensors = np.empty((len(control), model.nsensordata)), data.sensordata
    for k, command in enumerate(control):
        advance(command)
        rows[k] = sensors
        if gears is not None:
            gears[k] = live.gear + _added_friction(data, live.loss, model_loss)
    # MuJoCo resets a simulation that diverges: its clock is late then.
    if abs(data.time - len(control) * live.timestep) > 0.5 * live.timestep:
        rows[:] = np.nan
    return rows


def _added_friction(data: mujoco.MjData, loss: np.ndarray, model_loss: np.ndarray) -> np.ndarray:
    """[nv] N m, the effects' share of the dry friction in MuJoCo's last step."""
    rows = slice(data.ne, data.ne + data.nf)
    of_joints = data.efc_type[rows] == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
    dofs = data.efc_id[rows][of_joints]
    friction = np.zeros(len(loss))
    friction[dofs] = data.efc_force[rows][of_joints] * (1.0 - model_loss[dofs] / loss[dofs])
    return friction


def edited(model: mujoco.MjModel, influences: Sequence[Influence]) -> mujoco.MjModel:
    """A copy of the model with the changes of all effects."""
    model = copy.copy(model)
    for influence in influences:
        if influence.edit:
            influence.edit(model)
    return model


def hinge_torque(formula: Callable[[float, float, float], float]) -> Callable[[Place, float], Influence]:
    """An effect from a formula (amplitude, angle rad, speed rad/s) -> N m on the hinge, positive opens."""

    def make(place: Place, amplitude: float) -> Influence:
        q, v = place.scene.qpos(place.hinge), place.scene.dof(place.hinge)

        def step(live: Live) -> None:
            live.applied[v] += formula(amplitude, float(live.position[q]), float(live.velocity[v]))

        return Influence(step=step)

    return make


def hinge_loss(formula: Callable[[float, float], float]) -> Callable[[Place, float], Influence]:
    """An effect from a formula (amplitude, angle rad) -> N m of friction loss added to the hinge."""

    def make(place: Place, amplitude: float) -> Influence:
        q, v = place.scene.qpos(place.hinge), place.scene.dof(place.hinge)

        def step(live: Live) -> None:
            live.loss[v] += formula(amplitude, float(live.position[q]))

        return Influence(step=step)

    return make


def lagged(values: np.ndarray, clock: np.ndarray, delay: float, lag: float) -> np.ndarray:
    """Signals [T, C] after a dead time and then a first-order lag, both in s; constant before the start.

    The lag y' = (x - y) / lag is integrated exactly for an input that is constant over each step.
    """
    if delay > 0:
        values = interpolate(clock - delay, clock, values)
    if lag > 0 and len(clock) > 1:
        decay = np.exp(-(clock[1] - clock[0]) / lag)
        start = decay * values[:1]
        values, _ = scipy.signal.lfilter([1 - decay], [1.0, -decay], values, axis=0, zi=start)
    return values
