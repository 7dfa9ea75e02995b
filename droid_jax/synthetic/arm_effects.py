"""Hidden effects on the arm and its grip: mass, cables, gears, servos, contact."""

from __future__ import annotations

import mujoco
import numpy as np

from droid_jax.model.physics import no_short_cut
from droid_jax.synthetic.hooks import Hidden, Influence, Live, Place, Seen

PAYLOAD_AT = np.array([0.03, -0.02, 0.04])  # m from the hand's own centre of mass, in its body's frame
HELD_AT = np.array([0.06, 0.05, 0.02])  # m, likewise: a thing that is held at its end
PAYLOAD_GYRATION = 0.03  # m, radius of gyration: a tool, not a point
TWIST_KNEE = 15.0  # N m, where a harmonic drive's flexspline begins to stiffen


def hide_held_thing(place: Place, a: float) -> Influence:
    """The same of a thing that is held at its end, at `HELD_AT`."""
    return hide_payload(place, a, HELD_AT)


def hide_payload(place: Place, a: float, at: np.ndarray = PAYLOAD_AT) -> Influence:
    """a kg at `PAYLOAD_AT` on the hand: inertia and gravity, which the robot does not compensate.

    The hand's body gets mass, centre and inertia of both (parallel axes); the compensation of the
    hand's own weight goes on acting at the hand's own centre, as a force.
    """
    scene = place.scene
    body = hand_body(scene.model, max(scene.id("joint", joint) for joint in scene.joints))
    own_at, carried = scene.model.body_ipos[body].copy(), np.zeros(3)

    def edit(model: mujoco.MjModel) -> None:
        if a != 0.0:  # of the model that earlier effects left: what compensates already does so once
            own_at[:] = model.body_ipos[body]
            carried[:] = -model.opt.gravity * model.body_mass[body] * model.body_gravcomp[body]
            add_mass(model, body, a, own_at + at)
            model.body_gravcomp[body] = 0.0

    def begin(live: Live) -> None:
        mujoco.mj_kinematics(live.model, live.data)
        mujoco.mj_comPos(live.model, live.data)

    def step(live: Live) -> None:
        if a != 0.0 and carried.any():
            centre = live.data.xpos[body] + live.data.xmat[body].reshape(3, 3) @ own_at
            mujoco.mj_applyFT(live.model, live.data, carried, np.zeros(3), centre, body, live.applied)

    return Influence(edit=edit, begin=begin, step=step)


def hand_body(model: mujoco.MjModel, last_joint: int) -> int:
    """The body of the site "pinch", or of the last measured joint."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "pinch")
    return int(model.site_bodyid[site] if site >= 0 else model.jnt_bodyid[last_joint])


def add_mass(model: mujoco.MjModel, body: int, mass: float, at: np.ndarray) -> None:
    """Fix a mass in kg with its own radius of gyration to a body, at a point of the body's frame."""
    own, centre = float(model.body_mass[body]), model.body_ipos[body].copy()
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[body])
    frame = frame.reshape(3, 3)
    new_centre = (own * centre + mass * at) / (own + mass)
    inertia = frame @ np.diag(model.body_inertia[body]) @ frame.T + own * _steiner(centre - new_centre)
    inertia += mass * (PAYLOAD_GYRATION**2 * np.eye(3) + _steiner(at - new_centre))
    principal, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.flatten())
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = own + mass, new_centre, principal
    no_short_cut(model, [body])
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _steiner(offset: np.ndarray) -> np.ndarray:
    return offset @ offset * np.eye(3) - np.outer(offset, offset)


def hide_cable_pull(place: Place, a: float) -> Influence:
    """-a sinh(2 (q - q_rest)) / sinh(2): a dress pack that hangs slack, then pulls; a in N m at 1 rad.

    It hangs slack in the middle of the joint's range, wherever a motion begins, and rubs in its clamps with a
    tenth of its pull.
    """
    model = place.scene.model
    rest = model.jnt_range[[place.scene.id("joint", name) for name in place.joints]].mean(axis=1)

    def step(live: Live) -> None:
        live.applied[place.dofs] += cable(a, live.position[place.qpos] - rest, live.velocity[place.dofs])

    return Influence(step=step)


def cable(a: float, turned: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The cable's torque in N m at an angle turned from where it hangs slack, rad, and a speed in rad/s."""
    pull = a * np.sinh(2.0 * turned) / np.sinh(2.0)
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
    """Quasi-static: the motor stands `twist` ahead of the link, and the servo and its encoder see the motor.

    The servo's command loses the twist of its torque behind a lag of 3 ms (the motor's inertia in the
    spring); the recorded position is the motor's.
    """
    loaded = np.zeros(len(place.dofs))

    def step(live: Live) -> None:
        loaded[:] += (live.motor[place.dofs] - loaded) * (live.timestep / 0.003)
        live.control[place.actuators] -= twist(a, loaded)

    def sense(seen: Seen) -> Seen:
        position = seen.position.copy()
        position[:, place.columns] += twist(a, seen.torque[:, place.columns])
        return Seen(seen.clock, seen.torque, position)

    return Influence(step=step, sense=sense)


def play(values: np.ndarray, width: float) -> np.ndarray:
    """[T, C] -> [T, C]: the play operator, an output that follows when the input crosses the gap; centred at first."""
    out = np.empty_like(values)
    follows = values[0]
    for k, value in enumerate(values):
        follows = np.minimum(np.maximum(follows, value - 0.5 * width), value + 0.5 * width)
        out[k] = follows
    return out


def hide_backlash(place: Place, a: float) -> Influence:
    """A gap of a rad between motor and link: the link is led by the command behind a play of that width."""

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        control = control.copy()
        control[:, place.actuators] = play(control[:, place.actuators], a)
        return control

    return Influence(command=command)


def hide_servo_gains(place: Place, a: float) -> Influence:
    """Stiffness times 1 + a and damping times sqrt(1 + a): another gain set of the same damping ratio; a > -1."""
    if a <= -1.0:
        raise ValueError(f"wrong servo gains need an amplitude above -1, got {a}")

    def edit(model: mujoco.MjModel) -> None:
        model.actuator_gainprm[place.actuators, 0] *= 1.0 + a
        model.actuator_biasprm[place.actuators, 1] *= 1.0 + a
        model.actuator_biasprm[place.actuators, 2] *= np.sqrt(1.0 + a)
        model.dof_damping[place.dofs] *= np.sqrt(1.0 + a)

    return Influence(edit=edit)


def hide_grip_compliance(place: Place, a: float) -> Influence:
    """Softer pads: the contact's force sets in over a m more, with a time constant 1 + 400 a times as long."""
    pairs = np.concatenate(place.scene.finger_pairs)

    def edit(model: mujoco.MjModel) -> None:
        model.pair_solimp[pairs, 2] += a
        model.pair_solref[pairs, 0] *= 1.0 + 400.0 * a

    return Influence(edit=edit)


ARM_EFFECTS = (
    Hidden("payload", "kg", (0.05, 0.6), "hand", hide_payload, "a tool on the hand that the robot does not know"),
    Hidden("held_thing", "kg", (0.05, 0.6), "hand", hide_held_thing, "a thing held at its end, off the hand's line"),
    Hidden("cable_pull", "N m", (0.1, 1.0), "arm", hide_cable_pull, "a cable that pulls the joint back"),
    Hidden("torque_ripple", "N m", (0.1, 1.0), "arm", hide_torque_ripple, "two harmonics of a gear"),
    Hidden("joint_elasticity", "rad/(N m)", (5e-5, 1e-3), "arm", hide_joint_elasticity, "gears that twist"),
    Hidden("backlash", "rad", (0.0005, 0.005), "arm", hide_backlash, "a gap in the gears"),
    Hidden("servo_gains", "-", (0.05, 0.3), "arm", hide_servo_gains, "another gain set than stated", signed=True),
    Hidden("grip_compliance", "m", (0.0005, 0.003), "grip", hide_grip_compliance, "softer finger pads"),
)
