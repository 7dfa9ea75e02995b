"""Hidden effects on a door's hinge.  Angle in rad from closed, speed in rad/s, torque in N m, positive opens.

A formula without state is a pure function of amplitude a, angle q and speed v.  The numbers are typical of cabinet
hardware.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from droid_jax.synthetic.hooks import Hidden, Influence, Live, Place, hinge_loss, hinge_torque

BENT = 0.25  # share of a tilted door's torque that misaligned hinges add


def preload(a: float, q: float, v: float) -> float:
    """-a (1 + q / 5): a coil spring wound up by 5 rad before it was mounted; a in N m at the closed door."""
    return -a * (1.0 + q / 5.0)


def binding_spring(a: float, q: float, v: float) -> float:
    """-a s ln(1 + exp((q - 0.45) / s)): a second spring that engages at 0.45 rad, smoothed over s = 0.02 rad.

    a in N m/rad.
    """
    return -a * 0.02 * _softplus((q - 0.45) / 0.02)


def over_centre(a: float, q: float, v: float) -> float:
    """a g(q) / -g(0): a tension spring whose line of pull crosses the hinge axis at q_c = 0.40 rad.

    L = sqrt(R² + r² + 2 R r cos(q - q_c)) is its length between the case (R = 34 mm from the axis) and
    the door (r = 22 mm); g = (L - L_0) R r sin(q - q_c) / L with a free length L_0 of 30 mm.  It closes
    below q_c and opens above; a in N m at the closed door.
    """

    def moment(angle: float) -> float:
        length = math.sqrt(0.034**2 + 0.022**2 + 2 * 0.034 * 0.022 * math.cos(angle - 0.40))
        return (length - 0.030) * math.sin(angle - 0.40) / length

    return a * moment(q) / -moment(0.0)


def magnetic_catch(a: float, q: float, v: float) -> float:
    """-a (1 / (1 + (q / 0.03)²) - 0.12 exp(-((q - 0.14) / 0.04)²)): a magnet attracts, further out it repels.

    0.03 rad are 9 mm of gap at a lever of 0.3 m.  a in N m at the closed door (and for q < 0).
    """
    q = max(q, 0.0)
    return -a * (1.0 / (1.0 + (q / 0.03) ** 2) - 0.12 * math.exp(-(((q - 0.14) / 0.04) ** 2)))


def closer(a: float, q: float, v: float) -> float:
    """a z(q) (|v| / 0.3)^1.6 while closing, zero while opening: an oil damper with a check valve.

    The valve opens further below 0.15 rad: z = 0.35 + 0.65 σ((q - 0.15) / 0.02), σ the logistic function.  a in N m at
    0.3 rad/s.
    """
    if v >= 0.0:
        return 0.0
    return a * (0.35 + 0.65 * _logistic((q - 0.15) / 0.02)) * (-v / 0.3) ** 1.6


def check_at_end(a: float, q: float, v: float) -> float:
    """-a r(q) (v / 0.3)² while opening, r rising linearly from 0 at 0.35 rad to 1 at 0.70 rad; a in N m."""
    if v <= 0.0:
        return 0.0
    return -a * min(max((q - 0.35) / 0.35, 0.0), 1.0) * (v / 0.3) ** 2


def air_drag(a: float, q: float, v: float) -> float:
    """-a (1 + 1.5 exp(-q / 0.12)) v |v|: air drag of a panel, larger when the gap to the frame is narrow.

    a in N m s²/rad².
    """
    return -a * (1.0 + 1.5 * math.exp(-max(q, 0.0) / 0.12)) * v * abs(v)


def detent(a: float, q: float, v: float) -> float:
    """-a x exp((1 - x²) / 2), x = (q - 0.50) / w: a ball in a worn groove; w is 0.04 rad below q = 0.50, 0.06 above.

    a in N m, the largest torque on either flank.
    """
    x = (q - 0.50) / (0.04 if q < 0.50 else 0.06)
    return -a * x * math.exp(0.5 * (1.0 - x * x))


def neighbour_door(a: float, q: float, v: float) -> float:
    """-a (d / 0.1)^1.5 (1 + 0.8 v), d = q - 0.55: contact with another door, which cannot pull.

    Contact model of Hunt and Crossley (1975); a in N m at 0.1 rad of penetration.
    """
    if q <= 0.55:
        return 0.0
    return -a * ((q - 0.55) / 0.1) ** 1.5 * max(1.0 + 0.8 * v, 0.0)


def floor_friction(a: float, q: float) -> float:
    """a (0.6 σ((q - 0.30) / 0.03) + 0.4 σ((q - 0.60) / 0.04)): the door drags on the floor, then on a carpet.

    σ is the logistic function; a in N m, friction loss of both.
    """
    return a * (0.6 * _logistic((q - 0.30) / 0.03) + 0.4 * _logistic((q - 0.60) / 0.04))


def pin_wobble(a: float, q: float) -> float:
    """a cos⁴(5.5 q + 0.35): friction loss of a bent hinge pin, 11 maxima per revolution; a in N m."""
    return a * math.cos(5.5 * q + 0.35) ** 4


def hide_tilted_frame(place: Place, a: float) -> Influence:
    """A frame tilted by a rad: gravity torque axis · (c x M (R g - g)) of the door, plus that of misaligned hinges.

    R turns gravity about a horizontal line 30 degrees off the world's x axis.  In the built-in scene x is the door's
    inward normal, so the door leans along its panel and a little forward.  c is the centre of mass of the bodies that
    the hinge carries, M their mass.  The hinges are not aligned, so BENT of the torque's size is added times
    sin(3 (q - q_start)).  A positive tilt closes the built-in door.  A negative tilt opens it before it is grasped,
    unless friction holds it.
    """
    q, v = place.scene.qpos(place.hinge), place.scene.dof(place.hinge)
    start = [0.0, 0.0, 0.0]  # angle, and the coefficients of cosine and sine

    def begin(live: Live) -> None:
        torques = lean_torque(live.model, live.data, place.scene.id("joint", place.hinge), a)
        start[:] = [float(live.position[q]), *torques]

    def step(live: Live) -> None:
        angle = float(live.position[q]) - start[0]
        bent = BENT * math.hypot(*start[1:]) * math.sin(3.0 * angle)
        live.applied[v] += start[1] * math.cos(angle) + start[2] * math.sin(angle) + bent

    return Influence(begin=begin, step=step)


def lean_torque(model: mujoco.MjModel, data: mujoco.MjData, joint: int, lean: float) -> list[float]:
    """Coefficients, N m, of the cosine and the sine of the angle from the pose in `data`, for a tilt in rad."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    body = int(model.jnt_bodyid[joint])
    axis, arm = data.xaxis[joint], data.subtree_com[body] - data.xanchor[joint]
    line = -np.array([math.cos(math.pi / 6), math.sin(math.pi / 6), 0.0])
    g = model.opt.gravity
    # Rodrigues' rotation minus the vector; exactly zero for no tilt
    extra = np.cross(line, g) * math.sin(lean) + np.cross(line, np.cross(line, g)) * (1.0 - math.cos(lean))
    weight = float(model.body_subtreemass[body]) * extra
    return [float(axis @ np.cross(arm, weight)), float(axis @ np.cross(np.cross(axis, arm), weight))]


def hide_gasket(place: Place, a: float) -> Influence:
    """-a s: a seal that holds the door by suction, with a state s in 0..1; a in N m.

    s' = max(v, 0) / 0.015 (1 - s) - s / T.  Opening widens the gap under the seal.  Air leaks in with T = 0.5 s, or
    8 ms from 0.05 rad on, where the seal detaches.
    """
    q, v = place.scene.qpos(place.hinge), place.scene.dof(place.hinge)
    state = [0.0]

    def step(live: Live) -> None:
        state[0] = suction(state[0], float(live.position[q]), float(live.velocity[v]), live.timestep)
        live.applied[v] += -a * state[0]

    return Influence(step=step)


def suction(s: float, q: float, v: float, h: float) -> float:
    """One step of h s of the seal's state, exact for constant angle and speed."""
    grow, leak = (max(v, 0.0) / 0.015 if q < 0.05 else 0.0), 1.0 / (0.5 if q < 0.05 else 0.008)
    end = grow / (grow + leak)
    return end + (s - end) * math.exp(-(grow + leak) * h)


def _logistic(x: float) -> float:
    return 0.5 * (1.0 + math.tanh(0.5 * x))


def _softplus(x: float) -> float:
    return max(x, 0.0) + math.log1p(math.exp(-abs(x)))


DOOR = (
    Hidden("hinge_preload", "N m", (0.2, 1.5), "hinge", hinge_torque(preload), "a wound coil spring", signed=True),
    Hidden("binding_spring", "N m/rad", (1.0, 5.0), "hinge", hinge_torque(binding_spring), "a progressive spring"),
    Hidden("over_centre", "N m", (0.2, 1.5), "hinge", hinge_torque(over_centre), "a self-closing hinge"),
    Hidden("magnetic_catch", "N m", (0.3, 2.5), "hinge", hinge_torque(magnetic_catch), "a magnet at the frame"),
    Hidden("closer", "N m", (0.3, 2.0), "hinge", hinge_torque(closer), "an oil damper that slows closing"),
    Hidden("opening_check", "N m", (0.3, 2.0), "hinge", hinge_torque(check_at_end), "a check near the end of opening"),
    Hidden("air_drag", "N m s²/rad²", (1.0, 6.0), "hinge", hinge_torque(air_drag), "drag with the square of speed"),
    Hidden("floor_friction", "N m", (0.3, 2.0), "hinge", hinge_loss(floor_friction), "the door drags on the floor"),
    Hidden("tilted_frame", "rad", (0.02, 0.15), "hinge", hide_tilted_frame, "the frame is out of plumb", signed=True),
    Hidden("detent", "N m", (0.3, 1.5), "hinge", hinge_torque(detent), "a ball detent half-way; in no library"),
    Hidden("pin_wobble", "N m", (0.2, 1.5), "hinge", hinge_loss(pin_wobble), "a bent hinge pin; in no library"),
    Hidden("gasket", "N m", (0.3, 2.0), "hinge", hide_gasket, "a seal that holds by suction; in no library"),
    Hidden("neighbour_door", "N m", (0.1, 0.5), "hinge", hinge_torque(neighbour_door), "another door; in no library"),
)
