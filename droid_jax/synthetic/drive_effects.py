"""Hidden effects of a servo's drive: a motor that is a mass of its own behind its gear, and one at its full voltage."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
import scipy.optimize

from droid_jax.recordings.recording import TorqueSide
from droid_jax.synthetic.hooks import Hidden, Influence, Live, Place, SensorInput

SUBSTEP = 5e-5  # s, of a motor's own equation
GEAR_DAMPING = 0.04  # damping ratio of a motor on its elastic gear
STIFFENING = 0.3  # share by which an elastic gear is stiffer at `STIFFENED` of twist
STIFFENED = 0.02  # rad
CONTACT, CONTACT_DAMPING = 2e4, 0.3  # N m/rad and damping ratio, of teeth that meet
NO_LOAD_SPEED = 4.0  # rad/s
ROUNDING = 0.05  # share of the stall torque over which a motor's limit sets in

Spring = Callable[[float, float], float]  # lead of the motor, rad and rad/s -> torque of the gear, N m


def hide_resonance(place: Place, a: float) -> Influence:
    """A motor with the joint's armature on a gear of compliance a rad/(N m), which stiffens by a third at 0.02 rad.

    Its encoder is on the motor.  The link begins behind it by the twist under which it is held.
    """

    def gear(inertia: float) -> Spring:
        damper = 2.0 * GEAR_DAMPING * math.sqrt(inertia / a)
        return lambda lead, speed: lead / a * (1.0 + STIFFENING * (lead / STIFFENED) ** 2) + damper * speed

    return _motors(place, gear, encoder_on_motor=True) if a != 0.0 else Influence()


def hide_free_play(place: Place, a: float) -> Influence:
    """A motor that turns freely over a rad; teeth that meet are a spring with a damper, which only pushes.

    The recorded position is the link's.
    """

    def gear(inertia: float) -> Spring:
        damper = 2.0 * CONTACT_DAMPING * math.sqrt(inertia * CONTACT)

        def torque(lead: float, speed: float) -> float:
            depth = abs(lead) - 0.5 * a
            if depth <= 0.0:
                return 0.0
            side = math.copysign(1.0, lead)
            return side * max(CONTACT * depth + damper * side * speed, 0.0)

        return torque

    return _motors(place, gear, encoder_on_motor=False) if a != 0.0 else Influence()


def _motors(place: Place, gear: Callable[[float], Spring], encoder_on_motor: bool) -> Influence:
    """Motors that are masses of their own: the links lose their armature and feel the torques of the gears.

    Each motor's equation is integrated in steps of SUBSTEP while its link moves on with its speed.  Joints without an
    armature have no motor.
    """
    motors, angles, torques = list[_Motor](), list[list[float]](), list[list[float]]()

    def edit(model: mujoco.MjModel) -> None:
        motors.clear()
        for actuator, dof, position, column in zip(place.actuators, place.dofs, place.qpos, place.columns, strict=True):
            inertia = float(model.dof_armature[dof])
            if inertia > 0.0:
                gain, bias = float(model.actuator_gainprm[actuator, 0]), model.actuator_biasprm[actuator, :3].tolist()
                addresses = int(actuator), int(dof), int(position), int(column)
                motors.append(_Motor(*addresses, inertia, gear(inertia), gain, bias))
                # The motor is simulated here, and its gear's torque is applied to the link.
                model.dof_armature[dof] = 0.0
                model.actuator_gainprm[actuator] = model.actuator_biasprm[actuator] = 0.0
        if not motors:
            raise ValueError(
                f"a motor that is a mass of its own needs the armature of its joint; {', '.join(place.joints)} has none"
            )

    def begin(live: Live) -> None:
        for motor in motors:
            motor.angle, motor.speed = float(live.position[motor.position]), 0.0
            if encoder_on_motor:
                live.position[motor.position] -= wound(motor.gear, motor.servo(live)())

    def step(live: Live) -> None:
        angles.append([motor.angle for motor in motors])
        torques.append([motor.turn(live) for motor in motors])

    def sense(signals: SensorInput) -> SensorInput:
        position, torque, columns = signals.position.copy(), signals.torque.copy(), [m.column for m in motors]
        if place.side is TorqueSide.MOTOR:
            torque[:, columns] += np.array(torques)  # the actuators give none
        if encoder_on_motor:
            position[:, columns] = np.array(angles)
        return SensorInput(signals.clock, torque, position)

    return Influence(edit=edit, begin=begin, step=step, sense=sense)


def wound(gear: Spring, torque: float) -> float:
    """The lead at which a gear at rest carries a torque, rad."""
    end = math.copysign(1e-6, torque)
    while abs(gear(end, 0.0)) < abs(torque):
        end *= 2.0
    return float(scipy.optimize.root_scalar(lambda lead: gear(lead, 0.0) - torque, bracket=(0.0, end), xtol=1e-12).root)


@dataclass
class _Motor:
    """A motor behind its gear.

    Attributes:
        actuator, dof, position, column: addresses of its servo, its joint and its sensors.
        inertia: kg m^2.
        gear: the torque of its gear.
        gain, bias: of its servo's law.
        angle, speed: its state, rad and rad/s at the joint.
    """

    actuator: int
    dof: int
    position: int
    column: int
    inertia: float
    gear: Spring
    gain: float
    bias: list[float]
    angle: float = 0.0
    speed: float = 0.0

    def servo(self, live: Live) -> Callable[[], float]:
        """The servo's torque under the command, N m, as a function of the motor's state."""
        model, u = live.model, self.actuator
        gain, ratio = self.gain, float(model.actuator_gear[u, 0])
        b0, b1, b2 = self.bias
        command, (low, high) = float(live.control[u]), _limits(model, u, self.dof)
        if model.actuator_ctrllimited[u]:
            command = min(max(command, float(model.actuator_ctrlrange[u, 0])), float(model.actuator_ctrlrange[u, 1]))

        def torque() -> float:
            asked = ratio * (gain * command + b0 + ratio * (b1 * self.angle + b2 * self.speed))
            return min(max(asked, low), high)

        return torque

    def turn(self, live: Live) -> float:
        """Move through one step, and put the gear's mean torque on the link, in place of the actuator's.

        Returns the motor's mean torque, N m.
        """
        link, moving = float(live.position[self.position]), float(live.velocity[self.dof])
        servo = self.servo(live)
        parts = max(1, math.ceil(live.timestep / SUBSTEP - 1e-9))
        h, mean, given = live.timestep / parts, 0.0, 0.0
        for part in range(parts):
            torque = servo()
            force = self.gear(self.angle - link - part * h * moving, self.speed - moving)
            self.speed += h * (torque - force) / self.inertia
            self.angle += h * self.speed
            mean, given = mean + force / parts, given + torque / parts
        live.applied[self.dof] += mean
        live.gear[self.dof] += mean
        return given


def _limits(model: mujoco.MjModel, actuator: int, dof: int) -> tuple[float, float]:
    """Lowest and highest torque of a joint's servo, N m, of its actuator and its joint."""
    low, high, joint = -math.inf, math.inf, int(model.dof_jntid[dof])
    if model.actuator_forcelimited[actuator]:
        ends = sorted(float(model.actuator_gear[actuator, 0]) * float(e) for e in model.actuator_forcerange[actuator])
        low, high = ends
    if model.jnt_actfrclimited[joint]:
        ends = [float(e) for e in model.jnt_actfrcrange[joint]]
        low, high = max(low, ends[0]), min(high, ends[1])
    return low, high


def hide_torque_line(place: Place, a: float) -> Influence:
    """A motor with stall torque 1 / a, a in 1/(N m): the limit falls linearly to zero at NO_LOAD_SPEED.

    The limit sets in over ROUNDING of the stall torque.
    """
    if a == 0.0:
        return Influence()

    def step(live: Live) -> None:
        model = live.model
        for u, dof, position in zip(place.actuators, place.dofs, place.qpos, strict=True):
            gain, bias, ratio = model.actuator_gainprm[u, 0], model.actuator_biasprm[u], model.actuator_gear[u, 0]
            speed = float(live.velocity[dof])
            own = bias[0] + ratio * (bias[1] * live.position[position] + bias[2] * speed)
            torque = full_voltage_torque(float(ratio * (gain * live.control[u] + own)), speed, 1.0 / a)
            live.control[u] = (torque / ratio - own) / gain

    return Influence(step=step)


def full_voltage_torque(torque: float, speed: float, stall: float) -> float:
    """The torque in N m of a motor with that stall torque at a speed in rad/s, of which `torque` is asked."""
    width = 0.5 * ROUNDING * stall
    for sign in (1.0, -1.0):
        most = stall * (1.0 - sign * speed / NO_LOAD_SPEED)
        torque = sign * (most - width * float(np.logaddexp(0.0, (most - sign * torque) / width)))
    return torque


DRIVES = (
    Hidden("resonance", "rad/(N m)", (1e-4, 2e-3), "arm", hide_resonance, "motors that vibrate on their gears"),
    Hidden("free_play", "rad", (0.002, 0.03), "arm", hide_free_play, "gears in which the motor turns freely"),
    Hidden("torque_line", "1/(N m)", (0.01, 0.06), "arm", hide_torque_line, "motors at their full voltage"),
)
