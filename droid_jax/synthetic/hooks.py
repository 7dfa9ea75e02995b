"""Where a hidden effect takes hold of the synthetic robot, and the loop of mj_step around it.

Nothing here knows the library of effects with which a gap is searched: what is hidden must have
been written without it, or a blind test would test nothing.
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


@dataclass(frozen=True, eq=False)
class Place:
    """What one effect acts on in one repeat.

    scene: the instrumented scene.  joints: what a joint effect acts on.  repeat: counts from 0.
    period: s from the start of a repeat to that of the next one, pause included.
    """

    scene: Scene
    joints: tuple[str, ...]
    repeat: int = 0
    period: float = 0.0

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
    """A running simulation, as views into MuJoCo's own memory.

    Before each step `control` holds the command, `applied` and `gear` zeros and `loss` the model's
    own friction loss; an effect changes them.  `gear` is the part of `applied` between motor and
    link, which a sensor on the link side sees.  `motor` is the last step's torque.
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
class Seen:
    """What one repeat's sensors are about to see at the simulation's own steps.

    clock: [T] s from the start of the repeat; torque [T, J] N m; position [T, J] rad.
    """

    clock: np.ndarray
    torque: np.ndarray
    position: np.ndarray


@dataclass(frozen=True, eq=False)
class Influence:
    """One effect at work in one repeat: any of these, in the order in which they are called.

    edit: changes the model.  command: clock [T] s and command [T, U] -> command.  begin: once,
    with the start pose set.  step: before each mj_step.  sense: changes what the sensors see.
    """

    edit: Callable[[mujoco.MjModel], None] | None = None
    command: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    begin: Callable[[Live], None] | None = None
    step: Callable[[Live], None] | None = None
    sense: Callable[[Seen], Seen] | None = None


@dataclass(frozen=True)
class Hidden:
    """A hidden effect.

    unit, typical: of its amplitude, and the range in which it is felt but safe on the door and the
      Panda; zero is exactly no effect.
    on: "hinge" (the object's joint), "arm" (measured joints), "joint" (measured joints, or the hinge
      by name), "hand" (the last body), "base" (what the arm stands on), "grip" (contact pairs).
    make: the effect in one repeat, with a state of its own.
    what: for lists, in a few words.
    signed: a negative amplitude has a meaning.
    """

    name: str
    unit: str
    typical: tuple[float, float]
    on: str
    make: Callable[[Place, float], Influence]
    what: str
    signed: bool = False


def under(
    model: mujoco.MjModel, data: mujoco.MjData, influences: Sequence[Influence]
) -> tuple[Live, Callable[[np.ndarray], None]]:
    """A simulation that the effects begin to act on, and what takes it one step on with a command [U]."""
    live, own_loss = Live.of(model, data), model.dof_frictionloss.copy()
    for influence in influences:
        if influence.begin:
            influence.begin(live)
    steps = [i.step for i in influences if i.step]
    applied, gear, loss, ctrl = live.applied, live.gear, live.loss, live.control

    def advance(command: np.ndarray) -> None:
        ctrl[:] = command
        applied[:] = 0.0
        gear[:] = 0.0
        loss[:] = own_loss
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
    """Sensor rows [T, S] of one repeat by mj_step; NaN when it blew up.  The model stays as it is.

    gears: [T, nv], filled with what the effects put between motors and links, N m.
    """
    model = copy.copy(model)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos0
    own_loss = model.dof_frictionloss.copy()
    live, advance = under(model, data, influences)
    rows, sensors = np.empty((len(control), model.nsensordata)), data.sensordata
    for k, command in enumerate(control):
        advance(command)
        rows[k] = sensors
        if gears is not None:
            gears[k] = live.gear + _added_friction(data, live.loss, own_loss)
    # MuJoCo starts over where it blows up: its clock is then late.
    if abs(data.time - len(control) * live.timestep) > 0.5 * live.timestep:
        rows[:] = np.nan
    return rows


def _added_friction(data: mujoco.MjData, loss: np.ndarray, own_loss: np.ndarray) -> np.ndarray:
    """[nv] N m, the effects' share of the dry friction that MuJoCo's last step found."""
    rows = slice(data.ne, data.ne + data.nf)
    of_joints = data.efc_type[rows] == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
    dofs = data.efc_id[rows][of_joints]
    friction = np.zeros(len(loss))
    friction[dofs] = data.efc_force[rows][of_joints] * (1.0 - own_loss[dofs] / loss[dofs])
    return friction


def edited(model: mujoco.MjModel, influences: Sequence[Influence]) -> mujoco.MjModel:
    """A copy of the model with every effect's changes."""
    model = copy.copy(model)
    for influence in influences:
        if influence.edit:
            influence.edit(model)
    return model


def hinge_torque(formula: Callable[[float, float, float], float]) -> Callable[[Place, float], Influence]:
    """An effect out of a formula (amplitude, angle rad, speed rad/s) -> N m on the hinge, positive opens."""

    def make(place: Place, amplitude: float) -> Influence:
        q, v = place.scene.qpos(place.hinge), place.scene.dof(place.hinge)

        def step(live: Live) -> None:
            live.applied[v] += formula(amplitude, float(live.position[q]), float(live.velocity[v]))

        return Influence(step=step)

    return make


def hinge_loss(formula: Callable[[float, float], float]) -> Callable[[Place, float], Influence]:
    """An effect out of a formula (amplitude, angle rad) -> N m of friction loss added to the hinge."""

    def make(place: Place, amplitude: float) -> Influence:
        q, v = place.scene.qpos(place.hinge), place.scene.dof(place.hinge)

        def step(live: Live) -> None:
            live.loss[v] += formula(amplitude, float(live.position[q]))

        return Influence(step=step)

    return make


def lagged(values: np.ndarray, clock: np.ndarray, delay: float, lag: float) -> np.ndarray:
    """Signals [T, C] after a dead time and then a first-order lag, both s; before the start they stood still.

    The lag y' = (x - y) / lag is stepped exactly for an input held over each step.
    """
    if delay > 0:
        values = interpolate(clock - delay, clock, values)
    if lag > 0 and len(clock) > 1:
        keep = np.exp(-(clock[1] - clock[0]) / lag)
        start = keep * values[:1]
        values, _ = scipy.signal.lfilter([1 - keep], [1.0, -keep], values, axis=0, zi=start)
    return values
