"""Hidden friction in measured joints, or (by name) in the hinge.  Torques in N m, speeds in rad/s.

Dry friction is MuJoCo's friction loss, so that a joint at rest sticks.  Only bristle models apply a torque themselves.
Every formula takes numbers or arrays.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from droid_jax.synthetic.hooks import Hidden, Influence, Live, Place

FIRM_REACH = 0.0005  # rad, presliding displacement of firm friction
FIRM_SPEED = 0.02  # rad/s, above which its damper fades


def dry_loss(a: float, q: np.ndarray) -> np.ndarray:
    """a (1 + 0.2 sin(2 q + 0.5)): friction of slightly eccentric gears; a in N m."""
    return a * (1.0 + 0.2 * np.sin(2.0 * q + 0.5))


def stribeck_loss(a: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """a (1 + 0.15 sin(8 q)) / (1 + (v / 0.04)²): friction added at low speed, which varies with worn teeth.

    After Hess and Soom (1990), not the Gaussian Stribeck curve.
    """
    return a * (1.0 + 0.15 * np.sin(8.0 * q)) / (1.0 + (v / 0.04) ** 2)


def directional_loss(a: float, v: np.ndarray) -> np.ndarray:
    """a (1 + tanh(v / 0.01)) / 2: friction in the positive direction only; a in N m."""
    return 0.5 * a * (1.0 + np.tanh(v / 0.01))


def load_loss(a: float, torque: np.ndarray) -> np.ndarray:
    """a (sqrt(torque² + 1.5²) - 1.5): mesh friction that grows with the load, smooth at zero; a without unit."""
    return a * (np.sqrt(torque**2 + 1.5**2) - 1.5)


def mesh_loss(a: float, motor: np.ndarray, links: np.ndarray, v: np.ndarray) -> np.ndarray:
    """a (0.6 abs(motor) + 0.4 abs(links)) (1 + 0.5 / (1 + (v / 0.3)²)): friction of loaded teeth; a without unit."""
    return a * (0.6 * np.abs(motor) + 0.4 * np.abs(links)) * (1.0 + 0.5 / (1.0 + (v / 0.3) ** 2))


def warm_up_loss(a: float, seconds: float) -> float:
    """a exp(-seconds / 45): cold grease that warms up from the first repeat on; a in N m when cold."""
    return a * float(np.exp(-seconds / 45.0))


def bristle(force: np.ndarray, a: float, v: np.ndarray, h: float) -> np.ndarray:
    """One step of h s of Dahl's model (1968), dF/dx = a / 0.003 (1 - F sgn(v) / a).

    F opposes the motion and approaches a over about 0.003 rad.  The step is exact for constant speed.
    """
    end = a * np.sign(v)
    return end + (force - end) * np.exp(-np.abs(v) * h / 0.003)


def _friction(place: Place, formula: Callable[[Live], np.ndarray | float]) -> Influence:
    def step(live: Live) -> None:
        live.loss[place.dofs] += formula(live)

    return Influence(step=step)


def hide_dry_friction(place: Place, a: float) -> Influence:
    """Friction loss of `dry_loss`."""
    return _friction(place, lambda live: dry_loss(a, live.position[place.qpos]))


def hide_stribeck_friction(place: Place, a: float) -> Influence:
    """Friction loss of `stribeck_loss`."""
    return _friction(place, lambda live: stribeck_loss(a, live.position[place.qpos], live.velocity[place.dofs]))


def hide_directional_friction(place: Place, a: float) -> Influence:
    """Friction loss of `directional_loss`."""
    return _friction(place, lambda live: directional_loss(a, live.velocity[place.dofs]))


def hide_warm_up_friction(place: Place, a: float) -> Influence:
    """Friction loss of `warm_up_loss`; its clock starts with the first repeat."""
    before = place.repeat * place.period
    return _friction(place, lambda live: warm_up_loss(a, before + live.data.time))


def hide_load_friction(place: Place, a: float) -> Influence:
    """Friction loss of `load_loss` of the motor's torque, with a first-order lag of 20 ms (oil film)."""
    filtered = np.zeros(len(place.dofs))

    def step(live: Live) -> None:
        filtered[:] += (live.motor[place.dofs] - filtered) * (live.timestep / 0.020)
        live.loss[place.dofs] += load_loss(a, filtered)

    return Influence(step=step)


def hide_mesh_friction(place: Place, a: float) -> Influence:
    """Friction loss of `mesh_loss` of the last step's motor and link torques, with a first-order lag of 10 ms."""
    motor, links = np.zeros(len(place.dofs)), np.zeros(len(place.dofs))

    def step(live: Live) -> None:
        share = live.timestep / 0.010
        motor[:] += (live.motor[place.dofs] + live.data.qfrc_gravcomp[place.dofs] - motor) * share
        links[:] += (live.data.qfrc_bias[place.dofs] - links) * share
        live.loss[place.dofs] += mesh_loss(a, motor, links, live.velocity[place.dofs])

    return Influence(step=step)


def hide_bristle_friction(place: Place, a: float) -> Influence:
    """Torque of `bristle`, applied to the joint."""
    force = np.zeros(len(place.dofs))

    def step(live: Live) -> None:
        force[:] = bristle(force, a, live.velocity[place.dofs], live.timestep)
        live.applied[place.dofs] -= force
        live.gear[place.dofs] -= force

    return Influence(step=step)


def hide_firm_friction(place: Place, a: float) -> Influence:
    """A share a of each joint's friction loss acts by Dahl's model, which holds, in place of a constraint that creeps.

    The presliding displacement is FIRM_REACH, a sixth of that of `bristle`.  A damper with 0.7 of critical damping
    suppresses ringing and fades above FIRM_SPEED.
    """
    if a > 1.0:
        raise ValueError(f"hidden effect 'firm_friction' is a share of the friction, at most 1, got {a}")
    level, damper, force = (np.zeros(len(place.dofs)) for _ in range(3))

    def begin(live: Live) -> None:
        """Compute friction and damper from this repeat's model."""
        level[:] = a * live.model.dof_frictionloss[place.dofs]
        damper[:] = 1.4 * np.sqrt(level / FIRM_REACH * live.model.dof_M0[place.dofs])

    def step(live: Live) -> None:
        v = live.velocity[place.dofs]
        end = level * np.sign(v)
        force[:] = end + (force - end) * np.exp(-np.abs(v) * live.timestep / FIRM_REACH)
        live.loss[place.dofs] -= level
        live.applied[place.dofs] -= force + damper * v * np.exp(-((v / FIRM_SPEED) ** 2))

    return Influence(begin=begin, step=step)


FRICTION = (
    Hidden("dry_friction", "N m", (0.2, 1.5), "joint", hide_dry_friction, "dry friction that varies with angle"),
    Hidden("stribeck_friction", "N m", (0.3, 2.0), "joint", hide_stribeck_friction, "more friction when slow"),
    Hidden("directional_friction", "N m", (0.3, 2.0), "joint", hide_directional_friction, "friction in one direction"),
    Hidden("load_friction", "-", (0.03, 0.2), "arm", hide_load_friction, "friction that grows with the load"),
    Hidden(
        "mesh_friction", "-", (0.03, 0.2), "arm", hide_mesh_friction, "gear friction of motor and load, more when slow"
    ),
    Hidden("bristle_friction", "N m", (0.2, 1.0), "joint", hide_bristle_friction, "friction with presliding"),
    Hidden("firm_friction", "-", (0.5, 1.0), "joint", hide_firm_friction, "friction that holds and does not creep"),
    Hidden("warm_up_friction", "N m", (0.2, 1.5), "joint", hide_warm_up_friction, "friction fading by repeats"),
)
