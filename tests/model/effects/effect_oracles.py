"""The law of each effect, written a second time: as a change of the MJCF, or as a formula in numpy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from effect_bench import ARM, JOINTS

Values = Mapping[str, float]
ByJoint = dict[str, float]
Look = Callable[[np.ndarray], np.ndarray]
SLOW = 0.01  # rad/s: the width of smooth signs
ELBOW_REFERENCE = 0.2  # rad, as in the MJCF
LEAN = (0.05, -0.08)  # of gravity, to x and to y
MOMENT = 2.0 * 0.2  # kg m: the panel's mass times its distance from the hinge; shut, it lies along x
GRAVITY = 9.81
FOREARM = 0.5 * 0.125 + 0.6 * 0.25  # kg m about the elbow: forearm and hand, both compensated
CARRIED = 1.1 * 0.3  # kg m about the shoulder, of their mass at the elbow
UPPER_ARM = 1.5 * 0.15 + CARRIED


USUAL = {"shoulder": 9.54755721, "elbow": 3.5224549}  # N m: weight, inertia at 5 rad/s^2, damping at 1 rad/s
STIFFNESS = {"shoulder": 80.0, "elbow": 40.0}  # N m/rad
OF_THEIR_OWN = ("two_mass_backlash", "two_mass_resonance")  # effects with a state: see test_two_masses.py


@dataclass(frozen=True)
class Now:
    """One moment: each joint's angle, speed, actuator torque before, and how far its command is ahead of it.

    motor, links: what the motor gave to the gear in the step before, less damping at the speed now, and the links.
    """

    q: ByJoint
    w: ByJoint
    load: ByJoint
    ahead: ByJoint
    motor: ByJoint
    links: ByJoint


@dataclass(frozen=True)
class Oracle:
    """An effect at some values of its parameters.

    edit:  what it is in an MJCF, where MuJoCo has it.
    force: torque on joints; beside: what `edit` has no words for.
    loss:  friction loss on top of theirs, the sum at least zero.
    late:  s, of the command.  sent: (values, time [T], look, actuator by joint) -> command [T, U] of look(time).
    lead: rad by which motors are ahead of their links.
    twist: (values, rad by which commands lead encoders) -> rad by which these lead their links, where a motion begins.
    read:  (values, time [T], torque [T,J]) -> [T,J], what the sensor makes of it.
    joints: those to compare.
    """

    values: Values
    edit: Callable[[mujoco.MjSpec, Values], None] | None = None
    force: Callable[[Values, Now], ByJoint] | None = None
    beside: Callable[[Values, Now], ByJoint] | None = None
    loss: Callable[[Values, Now], ByJoint] | None = None
    late: Callable[[Values], float] | None = None
    sent: Callable[[Values, np.ndarray, Look, Mapping[str, int]], np.ndarray] | None = None
    lead: Callable[[Values, Now], ByJoint] | None = None
    twist: Callable[[Values, ByJoint], ByJoint] | None = None
    read: Callable[[Values, np.ndarray, np.ndarray], np.ndarray] | None = None
    joints: tuple[str, ...] = JOINTS


def each(*joints: str, **numbers: tuple[float, ...]) -> dict[str, float]:
    """{"name[joint]": number}."""
    return {f"{n}[{j}]": v for n, values in numbers.items() for j, v in zip(joints, values, strict=True)}


def of_joints(v: Values, name: str) -> np.ndarray:
    """[J]"""
    return np.array([v[f"{name}[{j}]"] for j in JOINTS])


def at_door(torque: Callable[[Values, float, float], float]) -> Callable[[Values, Now], ByJoint]:
    """A function of the door's angle and speed."""
    return lambda v, now: {"door": torque(v, now.q["door"], now.w["door"])}


def at_arm(torque: Callable[[Values, str, Now], float]) -> Callable[[Values, Now], ByJoint]:
    """A function of a joint and the moment; `v` contains that joint's parameters, by names without brackets."""

    def of_arm(v: Values, now: Now) -> ByJoint:
        own = {j: {n.removesuffix(f"[{j}]"): number for n, number in v.items()} for j in ARM}
        return {j: torque(own[j], j, now) for j in ARM}

    return of_arm


# ----- the MJCF's own means


def rest_angle(spec: mujoco.MjSpec, v: Values) -> None:
    """A constant torque is a spring with another rest angle."""
    joint = spec.joint("door")
    joint.springref = -v["hinge_preload"] / joint.stiffness[0]


def more_frictionloss(spec: mujoco.MjSpec, v: Values) -> None:
    for joint in ARM:
        spec.joint(joint).frictionloss += v[f"joint_coulomb[{joint}]"]


def added_mass(spec: mujoco.MjSpec, v: Values, mass: str = "payload_mass") -> None:
    """A body at the hand's centre of mass, without gravity compensation."""
    spec.body("hand").add_body(name="added_mass").add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0, 0], mass=v[mass], contype=0, conaffinity=0
    )


def outward_moment(v: Values, now: Now) -> ByJoint:
    """With all angles zero the hand's centre of mass is straight below the elbow, and so is that of the load."""
    leans = now.q["shoulder"] + now.q["elbow"] - ELBOW_REFERENCE
    return dict.fromkeys(ARM, -GRAVITY * v["payload_moment"] * np.sin(leans))


def free_moment(v: Values, now: Now) -> ByJoint:
    """A moment in the plane of the links, along the hand's x and z, which are the world's with all angles zero."""
    leans = now.q["shoulder"] + now.q["elbow"] - ELBOW_REFERENCE
    outwards = v["load_moment_x"] * np.cos(leans) + v["load_moment_z"] * np.sin(leans)  # along the world's x
    return dict.fromkeys(ARM, GRAVITY * outwards)


def tilted_gravity(v: Values, now: Now) -> ByJoint:
    """Gravity turned about y pushes the arm's masses along x (and less downwards), without compensation.

    With all angles zero each centre of mass is straight below its joint.
    """
    shift = GRAVITY * np.array([-np.sin(v["gravity_about_y"]), 1 - np.cos(v["gravity_about_y"])])  # along x and z

    def pull(angle: float, moment: float) -> float:  # about y, of a mass that hangs at an angle from straight down
        return moment * (-np.cos(angle) * shift[0] + np.sin(angle) * shift[1])

    upper, lower = now.q["shoulder"], now.q["shoulder"] + now.q["elbow"] - ELBOW_REFERENCE
    behind = pull(lower, FOREARM)
    return {"shoulder": pull(upper, UPPER_ARM) + behind, "elbow": behind}


def compensated_elsewhere(v: Values, now: Now) -> ByJoint:
    """Compensation of forearm and hand at the encoders' readings, minus that at the true positions."""
    off = {j: v[f"encoder_offset[{j}]"] for j in ARM}
    upper, lower = now.q["shoulder"], now.q["shoulder"] + now.q["elbow"] - ELBOW_REFERENCE

    def carried(upper: float, lower: float) -> np.ndarray:
        elbow = GRAVITY * FOREARM * np.sin(lower)
        return np.array([elbow + GRAVITY * CARRIED * np.sin(upper), elbow])

    there = carried(upper + off["shoulder"], lower + off["shoulder"] + off["elbow"])
    return dict(zip(ARM, carried(upper, lower) - there, strict=True))


def turned_encoders(spec: mujoco.MjSpec, v: Values) -> None:
    """The same joint positions have lower readings."""
    for name in ARM:
        joint = spec.joint(name)
        joint.ref, joint.springref = joint.ref - v[f"encoder_offset[{name}]"], -v[f"encoder_offset[{name}]"]


def firmer(spec: mujoco.MjSpec, v: Values) -> None:
    share, joint = v["friction_firmness[elbow]"], spec.joint("elbow")
    joint.solimp_friction[:2] = [0.9 + share * 0.0999, 0.95 + share * 0.0499]


def other_gains(spec: mujoco.MjSpec, share: Callable[[float, str], float]) -> None:
    for actuator in spec.actuators:
        if actuator.target in ARM:
            factor = share(actuator.gainprm[0], actuator.target)
            actuator.gainprm[0] *= factor
            actuator.biasprm[1] *= factor


def gravity_leans(spec: mujoco.MjSpec, v: Values) -> None:
    spec.option.gravity = [GRAVITY * LEAN[0], GRAVITY * LEAN[1], -GRAVITY]


# ----- formulas


def stribeck(v: Values, name: str, height: float, speed: float) -> float:
    return height * np.exp(-(abs(speed / v[f"{name}_speed"]) ** v[f"{name}_exponent"]))


def gear_friction(v: Values, joint: str, now: Now) -> float:
    """Shares of the torques on both sides of the gear, and an additional part at low speed."""
    motor, links = now.motor[joint], now.links[joint]
    slow = np.exp(-abs(now.w[joint]) / v["gear_speed"])
    return abs(v["gear_links"] * links - v["gear_motor"] * motor) + v["gear_at_rest"] * slow * abs(links - motor)


def feedforward(v: Values, at: np.ndarray, look: Look, servos: Mapping[str, int]) -> np.ndarray:
    """Each servo gets its command and a share of the command's speed over the last 10 ms."""
    command, speed = look(at), (look(at) - look(at - 0.01)) / 0.01
    for joint in ARM:
        command[:, servos[joint]] += v[f"velocity_feedforward[{joint}]"] * speed[:, servos[joint]]
    return command


def limited_profile(v: Values, name: str, at: np.ndarray, look: Look, servos: Mapping[str, int]) -> np.ndarray:
    """The reference of each joint follows the command on the replay's clock, within its limit."""
    h = at[1] - at[0]
    time = h * np.arange(len(at))
    command = look(time)
    for joint in ARM:
        place, speed, most = command[0, servos[joint]], 0.0, 1.0 / v[f"{name}[{joint}]"]
        for k, goal in enumerate(command[:, servos[joint]].copy()):
            way = goal - place
            if name == "profile_speed":
                place += min(max(way, -most * h), most * h)
            else:
                wanted = np.sign(way) * min(abs(way) / h, np.sqrt(2 * most * abs(way)))
                speed += min(max(wanted - speed, -most * h), most * h)
                place += h * speed
            command[k, servos[joint]] = place
    return np.stack([np.interp(at, time, column) for column in command.T], axis=1)


def crosstalk(v: Values, t: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Shoulder and elbow, the first two channels, read each other."""
    shoulder = torque[:, 0] + v["crosstalk_after[shoulder]"] * torque[:, 1]
    elbow = torque[:, 1] + v["crosstalk_before[elbow]"] * torque[:, 0]
    return np.stack([shoulder, elbow, torque[:, 2]], axis=1)


def latch(v: Values, phi: float, w: float) -> float:
    """The pull builds up over a tenth of the width; there is none beyond closed."""
    share = max(phi, 0.0) / v["latch_width"]
    return -v["latch_torque"] * np.exp(-(share ** v["latch_exponent"])) * (1 - np.exp(-10 * share))


def over_centre(v: Values, phi: float, w: float) -> float:
    share = phi / v["over_centre_angle"]
    return -v["over_centre_torque"] * share * np.exp(1 - share) if phi > 0 else 0.0


def check(v: Values, phi: float, w: float) -> float:
    brake = 0.3 * min(max(w, 0.0) / 0.3, 1.5) ** v["check_exponent"]
    return -v["check_damping"] * brake / (1 + np.exp(-(phi - v["check_angle"]) / 0.05))


def closer(v: Values, phi: float, w: float) -> float:
    return v["closer_damping"] * 0.3 * min(max(-w, 0.0) / 0.3, 1.5) ** v["closer_exponent"]


def stretch(joint: str, now: Now) -> float:
    return now.q[joint] - (ELBOW_REFERENCE if joint == "elbow" else 0.0)


def at_most(v: Values, joint: str, now: Now) -> float:
    """N m that a motor at its full voltage gives of what its servo asks for; v without the joint's name."""
    stall, fall = 1.0 / v["torque_speed_line"], v["torque_speed_slope"] * USUAL[joint] * now.w[joint]
    return float(np.clip(STIFFNESS[joint] * now.ahead[joint], -stall - fall, stall - fall))


ORACLES = {
    "angle_friction": Oracle(  # below zero in the middle
        {"angle_friction_slope": -1.5, "angle_friction_curve": 1.8},
        loss=at_door(lambda v, phi, w: v["angle_friction_slope"] * phi + v["angle_friction_curve"] * phi**2),
    ),
    "cable_pull": Oracle(
        each(*ARM, cable_stiffness=(1.5, -0.7), cable_pull=(-0.4, 0.6)),
        force=at_arm(lambda v, j, now: -v["cable_stiffness"] * stretch(j, now) - v["cable_pull"]),
    ),
    "clock_rate": Oracle({"clock_rate": -0.004}, sent=lambda v, at, look, _: look((1 + v["clock_rate"]) * at)),
    "command_delay": Oracle({"command_delay": 0.0123}, late=lambda v: v["command_delay"]),
    "door_closer": Oracle({"closer_damping": 3.0, "closer_exponent": 1.4}, force=at_door(closer)),
    "drag": Oracle({"drag": 1.2}, force=at_door(lambda v, phi, w: -v["drag"] * w**2 * np.sign(w))),
    "encoder_offset": Oracle(
        each(*ARM, encoder_offset=(0.03, -0.05)), edit=turned_encoders, beside=compensated_elsewhere
    ),
    "free_payload": Oracle(
        {"load_mass": 0.2, "load_moment_x": 0.05, "load_moment_z": -0.02},
        edit=lambda spec, v: added_mass(spec, v, "load_mass"),
        beside=free_moment,
    ),
    "gear_friction": Oracle(
        {**each(*ARM, gear_motor=(0.1, 0.15), gear_links=(0.05, 0.2), gear_at_rest=(0.1, 0.05)), "gear_speed": 0.4},
        loss=at_arm(gear_friction),
    ),
    "gravity_direction": Oracle({"gravity_about_y": 0.04}, force=tilted_gravity, joints=ARM),
    "hardening_spring": Oracle(
        {"hardening_square": 1.5, "hardening_cube": -0.8},
        force=at_door(lambda v, phi, w: -v["hardening_square"] * phi * abs(phi) - v["hardening_cube"] * phi**3),
    ),
    "hinge_directional": Oracle(  # more than the hinge has: none at all while it opens
        {"hinge_directional": -0.3}, loss=at_door(lambda v, phi, w: v["hinge_directional"] * np.tanh(w / SLOW))
    ),
    "hinge_preload": Oracle(
        {"hinge_preload": 0.7}, edit=rest_angle, force=at_door(lambda v, phi, w: -v["hinge_preload"])
    ),
    "hinge_stribeck": Oracle(
        {"hinge_stribeck": 0.8, "hinge_stribeck_speed": 0.06, "hinge_stribeck_exponent": 1.3},
        loss=at_door(lambda v, phi, w: stribeck(v, "hinge_stribeck", v["hinge_stribeck"], w)),
    ),
    "joint_backlash": Oracle(  # as far as the command leads, and no further than half the backlash
        each(*ARM, joint_backlash=(0.015, 0.01)),
        lead=at_arm(lambda v, j, now: min(abs(now.ahead[j]), v["joint_backlash"] / 2) * np.sign(now.ahead[j])),
    ),
    "joint_compliance": Oracle(  # two springs in series
        each(*ARM, joint_compliance=(3e-4, 4e-4)),
        edit=lambda spec, v: other_gains(spec, lambda kp, j: 1 / (1 + kp * v[f"joint_compliance[{j}]"])),
        twist=lambda v, ahead: {j: v[f"joint_compliance[{j}]"] * STIFFNESS[j] * ahead[j] for j in ARM},
    ),
    "joint_coulomb": Oracle(
        each(*ARM, joint_coulomb=(0.5, 0.2)), edit=more_frictionloss, loss=at_arm(lambda v, j, now: v["joint_coulomb"])
    ),
    "joint_directional": Oracle(
        each(*ARM, joint_directional=(0.5, -0.3)),
        loss=at_arm(lambda v, j, now: v["joint_directional"] * np.tanh(now.w[j] / SLOW)),
    ),
    "joint_stribeck": Oracle(
        {**each(*ARM, joint_stribeck=(0.6, 0.3)), "joint_stribeck_speed": 0.15, "joint_stribeck_exponent": 1.4},
        loss=at_arm(lambda v, j, now: stribeck(v, "joint_stribeck", v["joint_stribeck"], now.w[j])),
    ),
    "latch": Oracle({"latch_torque": 1.5, "latch_width": 0.05, "latch_exponent": 1.6}, force=at_door(latch)),
    "load_friction": Oracle(
        each(*ARM, load_friction=(0.1, 0.2)), loss=at_arm(lambda v, j, now: v["load_friction"] * abs(now.load[j]))
    ),
    "opening_check": Oracle({"check_damping": 2.5, "check_angle": 0.4, "check_exponent": 1.7}, force=at_door(check)),
    "over_centre_spring": Oracle({"over_centre_torque": 1.5, "over_centre_angle": 0.25}, force=at_door(over_centre)),
    "payload": Oracle({"payload_mass": 0.3, "payload_moment": -0.04}, edit=added_mass, beside=outward_moment),
    "profile_acceleration": Oracle(
        each(*ARM, profile_acceleration=(0.5, 0.4)),
        sent=lambda v, at, look, servos: limited_profile(v, "profile_acceleration", at, look, servos),
    ),
    "profile_speed": Oracle(
        each(*ARM, profile_speed=(1.5, 1.2)),
        sent=lambda v, at, look, servos: limited_profile(v, "profile_speed", at, look, servos),
    ),
    "sensor_delay": Oracle(
        {"sensor_delay": 0.0077},
        read=lambda v, t, torque: np.stack([np.interp(t - v["sensor_delay"], t, c) for c in torque.T], axis=1),
    ),
    "servo_gain": Oracle(
        each(*ARM, servo_gain=(0.1, -0.2)),
        edit=lambda spec, v: other_gains(spec, lambda kp, j: 1 + v[f"servo_gain[{j}]"]),
    ),
    "soft_friction": Oracle({"friction_firmness[elbow]": 0.8}, edit=firmer),
    "tilted_frame": Oracle(  # the arm's weight leans with it: the door alone
        {"tilt_sine": MOMENT * GRAVITY * LEAN[0], "tilt_cosine": -MOMENT * GRAVITY * LEAN[1]},
        edit=gravity_leans,
        force=at_door(lambda v, phi, w: MOMENT * GRAVITY * (LEAN[1] * np.cos(phi) - LEAN[0] * np.sin(phi))),
        joints=("door",),
    ),
    "torque_bias": Oracle(
        each(*JOINTS, torque_bias=(0.3, -0.2, 0.1)), read=lambda v, t, torque: torque + of_joints(v, "torque_bias")
    ),
    "torque_crosstalk": Oracle({"crosstalk_after[shoulder]": 0.06, "crosstalk_before[elbow]": -0.04}, read=crosstalk),
    "torque_drift": Oracle(
        each(*JOINTS, torque_drift=(0.05, -0.02, 0.03)),
        read=lambda v, t, torque: torque + np.outer(t - t.mean(), of_joints(v, "torque_drift")),
    ),
    "torque_gain": Oracle(
        each(*JOINTS, torque_gain=(0.05, -0.03, 0.1)),
        read=lambda v, t, torque: torque * (1 + of_joints(v, "torque_gain")),
    ),
    "torque_ripple": Oracle(
        {**each(*ARM, ripple_sine=(0.2, -0.1), ripple_cosine=(-0.15, 0.3)), "ripple_periods": 13.0},
        force=at_arm(
            lambda v, j, now: (
                v["ripple_sine"] * np.sin(v["ripple_periods"] * now.q[j])
                + v["ripple_cosine"] * np.cos(v["ripple_periods"] * now.q[j])
            )
        ),
    ),
    "torque_speed_line": Oracle(
        {**each(*ARM, torque_speed_line=(0.4, 0.8)), "torque_speed_slope": 0.3},
        lead=at_arm(lambda v, j, now: now.ahead[j] - at_most(v, j, now) / STIFFNESS[j]),
    ),
    "velocity_feedforward": Oracle(each(*ARM, velocity_feedforward=(0.03, -0.02)), sent=feedforward),
}
