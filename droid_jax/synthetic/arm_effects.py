"""Hidden effects on the arm and its grip: payloads, cables, gears, servos, contact."""

from __future__ import annotations

import mujoco
import numpy as np

from droid_jax.model.physics import no_short_cut
from droid_jax.synthetic.hooks import Hidden, Influence, Live, Place, SensorInput

PAYLOAD_AT = np.array([0.03, -0.02, 0.04])  # m from the hand's centre of mass, in its body's frame
HELD_AT = np.array([0.06, 0.05, 0.02])  # m, likewise, of an object that is held at its end
PAYLOAD_GYRATION = 0.03  # m, radius of gyration of a payload
TWIST_KNEE = 15.0  # N m, where a harmonic drive's flexspline begins to stiffen


def hide_held_thing(place: Place, a: float) -> Influence:
    """A payload of a kg at `HELD_AT`: an object that is held at its end."""
    return hide_payload(place, a, HELD_AT)


def hide_payload(place: Place, a: float, at: np.ndarray = PAYLOAD_AT) -> Influence:
    """A payload of a kg at `PAYLOAD_AT` on the hand, whose weight the robot does not compensate.

    The hand's body gets the mass, centre of mass and inertia of both (parallel axes).  A force at the hand's original
    centre of mass continues the compensation of the hand's weight.
    """
    scene = place.scene
    body = hand_body(scene.model, max(scene.id("joint", joint) for joint in scene.joints))
    hand_centre, compensation = scene.model.body_ipos[body].copy(), np.zeros(3)

    def edit(model: mujoco.MjModel) -> None:
        if a != 0.0:  # the model may contain another payload, whose compensation is a force already
            hand_centre[:] = model.body_ipos[body]
            compensation[:] = -model.opt.gravity * model.body_mass[body] * model.body_gravcomp[body]
            add_mass(model, body, a, hand_centre + at)
            model.body_gravcomp[body] = 0.0

    def begin(live: Live) -> None:
        mujoco.mj_kinematics(live.model, live.data)
        mujoco.mj_comPos(live.model, live.data)

    def step(live: Live) -> None:
        if a != 0.0 and compensation.any():
            centre = live.data.xpos[body] + live.data.xmat[body].reshape(3, 3) @ hand_centre
            mujoco.mj_applyFT(live.model, live.data, compensation, np.zeros(3), centre, body, live.applied)

    return Influence(edit=edit, begin=begin, step=step)


def hand_body(model: mujoco.MjModel, last_joint: int) -> int:
    """The body of the site "pinch", or of the last measured joint."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "pinch")
    return int(model.site_bodyid[site] if site >= 0 else model.jnt_bodyid[last_joint])


def add_mass(model: mujoco.MjModel, body: int, mass: float, at: np.ndarray) -> None:
    """Fix a mass in kg with radius of gyration PAYLOAD_GYRATION to a body, at a point [3] m of the body's frame."""
    body_mass, centre = float(model.body_mass[body]), model.body_ipos[body].copy()
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[body])
    frame = frame.reshape(3, 3)
    new_centre = (body_mass * centre + mass * at) / (body_mass + mass)
    inertia = frame @ np.diag(model.body_inertia[body]) @ frame.T + body_mass * _steiner(centre - new_centre)
    inertia += mass * (PAYLOAD_GYRATION**2 * np.eye(3) + _steiner(at - new_centre))
    principal, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.flatten())
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = body_mass + mass, new_centre, principal
    no_short_cut(model, [body])
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _steiner(offset: np.ndarray) -> np.ndarray:
    return offset @ offset * np.eye(3) - np.outer(offset, offset)


def hide_cable_pull(place: Place, a: float) -> Influence:
    """-a sinh(2 (q - q_rest)) / sinh(2): a dress pack that pulls the joint back; a in N m at 1 rad.

    It is slack in the middle of the joint's range.  Friction in its clamps is a tenth of its pull.
    """
    model = place.scene.model
    rest = model.jnt_range[[place.scene.id("joint", name) for name in place.joints]].mean(axis=1)

    def step(live: Live) -> None:
        live.applied[place.dofs] += cable(a, live.position[place.qpos] - rest, live.velocity[place.dofs])

    return Influence(step=step)


def cable(a: float, angle: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The cable's torque in N m at an angle from its slack position, rad, and a speed v in rad/s."""
    pull = a * np.sinh(2.0 * angle) / np.sinh(2.0)
    return -pull - 0.1 * np.abs(pull) * np.tanh(v / 0.01)


def hide_torque_ripple(place: Place, a: float) -> Influence:
    """a (sin(18 q + 0.4) + 0.35 sin(44 q + 1.9)) on the joint: two harmonics of a gear; a in N m."""

    def step(live: Live) -> None:
        torque = ripple(a, live.position[place.qpos])
        live.applied[place.dofs] += torque
        live.gear[place.dofs] += torque

    return Influence(step=step)


def ripple(a: float, q: np.ndarray) -> np.ndarray:
    """The ripple's torque in N m at an angle in rad."""
    return a * (np.sin(18.0 * q + 0.4) + 0.35 * np.sin(44.0 * q + 1.9))


def twist(a: float, torque: np.ndarray) -> np.ndarray:
    """a t arsinh(torque / t), t = 15 N m: a gear that stiffens with its load; rad, a in rad/(N m) when unloaded."""
    return a * TWIST_KNEE * np.arcsinh(torque / TWIST_KNEE)


def hide_joint_elasticity(place: Place, a: float) -> Influence:
    """Quasi-static elasticity: the motor is `twist` ahead of the link, and the encoder is on the motor.

    The servo's command is reduced by the twist of its torque after a lag of 3 ms (the motor's inertia on the spring).
    The recorded position is the motor's.  The links begin behind it by the twist under which they are held.
    """
    loaded = np.zeros(len(place.dofs))

    def begin(live: Live) -> None:
        if a != 0.0:
            mujoco.mj_forward(live.model, live.data)  # the links still stand where the motors do
            loaded[:] = live.motor[place.dofs]
            live.position[place.qpos] -= twist(a, loaded)

    def step(live: Live) -> None:
        if live.data.time > 0.0:  # before the first step there is no torque of a step
            loaded[:] += (live.motor[place.dofs] - loaded) * (live.timestep / 0.003)
        live.control[place.actuators] -= twist(a, loaded)

    def sense(signals: SensorInput) -> SensorInput:
        position = signals.position.copy()
        position[:, place.columns] += twist(a, signals.torque[:, place.columns])
        return SensorInput(signals.clock, signals.torque, position)

    return Influence(begin=begin, step=step, sense=sense)


def play(values: np.ndarray, width: float) -> np.ndarray:
    """The play operator, [T, C] -> [T, C]: the output stays within width / 2 of the input; it starts centred."""
    out = np.empty_like(values)
    output = values[0]
    for k, value in enumerate(values):
        output = np.minimum(np.maximum(output, value - 0.5 * width), value + 0.5 * width)
        out[k] = output
    return out


def hide_backlash(place: Place, a: float) -> Influence:
    """A gap of a rad between motor and link: the servo follows the command after a `play` of that width."""

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        control = control.copy()
        control[:, place.actuators] = play(control[:, place.actuators], a)
        return control

    return Influence(command=command)


def hide_servo_gains(place: Place, a: float) -> Influence:
    """Stiffness times 1 + a and damping times sqrt(1 + a): other gains with the same damping ratio; a > -1."""
    if a <= -1.0:
        raise ValueError(f"wrong servo gains need an amplitude above -1, got {a}")

    def edit(model: mujoco.MjModel) -> None:
        model.actuator_gainprm[place.actuators, 0] *= 1.0 + a
        model.actuator_biasprm[place.actuators, 1] *= 1.0 + a
        model.actuator_biasprm[place.actuators, 2] *= np.sqrt(1.0 + a)
        model.dof_damping[place.dofs] *= np.sqrt(1.0 + a)

    return Influence(edit=edit)


def hide_grip_compliance(place: Place, a: float) -> Influence:
    """Softer pads: the contact force builds up over a m more, with a time constant 1 + 400 a times as long."""
    pairs = np.concatenate(place.scene.finger_pairs)

    def edit(model: mujoco.MjModel) -> None:
        model.pair_solimp[pairs, 2] += a
        model.pair_solref[pairs, 0] *= 1.0 + 400.0 * a

    return Influence(edit=edit)


ARM_EFFECTS = (
    Hidden("payload", "kg", (0.05, 0.6), "hand", hide_payload, "a tool on the hand that the model lacks"),
    Hidden("held_thing", "kg", (0.05, 0.6), "hand", hide_held_thing, "an object held at its end, off the hand's axis"),
    Hidden("cable_pull", "N m", (0.1, 1.0), "arm", hide_cable_pull, "a cable that pulls the joint back"),
    Hidden("torque_ripple", "N m", (0.1, 1.0), "arm", hide_torque_ripple, "two harmonics of a gear"),
    Hidden("joint_elasticity", "rad/(N m)", (5e-5, 1e-3), "arm", hide_joint_elasticity, "gears that twist"),
    Hidden("backlash", "rad", (0.0005, 0.005), "arm", hide_backlash, "a gap in the gears"),
    Hidden("servo_gains", "-", (0.05, 0.3), "arm", hide_servo_gains, "other gains than stated", signed=True),
    Hidden("grip_compliance", "m", (0.0005, 0.003), "grip", hide_grip_compliance, "softer finger pads"),
)
