"""Hidden friction in joints: N m, speeds in rad/s, on measured joints or (by name) on the hinge.

Dry friction is given to MuJoCo as friction loss, so that a joint at rest sticks; only the bristle
model applies its torque itself.  Every formula takes numbers or arrays.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from droid_jax.synthetic.hooks import Hidden, Influence, Live, Place

FIRM_REACH = 0.0005  # rad, over which firm friction sets in
FIRM_SPEED = 0.02  # rad/s, above which it is not damped


def dry_loss(a: float, q: np.ndarray) -> np.ndarray:
    """a (1 + 0.2 sin(2 q + 0.5)): gears that run a little out of true; a in N m."""
    return a * (1.0 + 0.2 * np.sin(2.0 * q + 0.5))


def stribeck_loss(a: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """a (1 + 0.15 sin(8 q)) / (1 + (v / 0.04)²): what sticking adds to sliding, more of it where teeth are worn.

    After Hess and Soom (1990), not Stribeck's Gauss.
    """
    return a * (1.0 + 0.15 * np.sin(8.0 * q)) / (1.0 + (v / 0.04) ** 2)


def directional_loss(a: float, v: np.ndarray) -> np.ndarray:
    """a (1 + tanh(v / 0.01)) / 2: friction in the positive direction only; a in N m."""
    return 0.5 * a * (1.0 + np.tanh(v / 0.01))


def load_loss(a: float, torque: np.ndarray) -> np.ndarray:
    """a (sqrt(torque² + 1.5²) - 1.5): mesh friction with the load, without a kink at none; a without unit."""
    return a * (np.sqrt(torque**2 + 1.5**2) - 1.5)


def mesh_loss(a: float, motor: np.ndarray, links: np.ndarray, v: np.ndarray) -> np.ndarray:
    """a (0.6 abs(motor) + 0.4 abs(links)) (1 + 0.5 / (1 + (v / 0.3)²)): teeth that both press; a without unit."""
    return a * (0.6 * np.abs(motor) + 0.4 * np.abs(links)) * (1.0 + 0.5 / (1.0 + (v / 0.3) ** 2))


def warm_up_loss(a: float, seconds: float) -> float:
    """a exp(-seconds / 45): stiff grease that warms up from the first repeat on; a in N m when cold."""
    return a * float(np.exp(-seconds / 45.0))


def bristle(force: np.ndarray, a: float, v: np.ndarray, h: float) -> np.ndarray:
    """Dahl's model (1968), dF/dx = a / 0.003 (1 - F sgn(v) / a): the force one step of h s later.

    F opposes motion and reaches a after some 0.003 rad (bristles bend before they slip); exact for a speed
    held over the step.
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
    """Friction loss of `warm_up_loss`, its clock running on from repeat to repeat."""
    before = place.repeat * place.period
    return _friction(place, lambda live: warm_up_loss(a, before + live.data.time))


def hide_load_friction(place: Place, a: float) -> Influence:
    """Friction loss of `load_loss`, of the motor's torque behind a first-order lag of 20 ms (the oil film's)."""
    filtered = np.zeros(len(place.dofs))

    def step(live: Live) -> None:
        filtered[:] += (live.motor[place.dofs] - filtered) * (live.timestep / 0.020)
        live.loss[place.dofs] += load_loss(a, filtered)

    return Influence(step=step)


def hide_mesh_friction(place: Place, a: float) -> Influence:
    """Friction loss of `mesh_loss`, of the last step's motor torque and weight, behind a lag of 10 ms."""
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
    """A share a of each joint's own friction loss acts as bristles that hold, in place of a constraint that creeps.

    The bristles are Dahl's, as of `bristle`, and a sixth as long: they bend by half a milliradian and stand.  A damper
    of 0.7 of the critical one, which fades above 0.02 rad/s, keeps them from ringing.
    """
    if a > 1.0:
        raise ValueError(f"no more than all of a friction can be firm: an amplitude of at most 1, got {a}")
    level, damper, force = (np.zeros(len(place.dofs)) for _ in range(3))

    def begin(live: Live) -> None:
        """Of this repeat's own friction and inertia."""
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
    Hidden("directional_friction", "N m", (0.3, 2.0), "joint", hide_directional_friction, "friction one way"),
    Hidden("load_friction", "-", (0.03, 0.2), "arm", hide_load_friction, "friction that grows with the load"),
    Hidden(
        "mesh_friction", "-", (0.03, 0.2), "arm", hide_mesh_friction, "gear friction of motor and load, more when slow"
    ),
    Hidden("bristle_friction", "N m", (0.2, 1.0), "joint", hide_bristle_friction, "friction that bends first"),
    Hidden("firm_friction", "-", (0.5, 1.0), "joint", hide_firm_friction, "friction that holds and does not creep"),
    Hidden("warm_up_friction", "N m", (0.2, 1.5), "joint", hide_warm_up_friction, "friction fading by repeats"),
)
