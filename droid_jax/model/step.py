"""One simulation step of MJX with a constraint solver made for float32 and small batches of rows.

mjx.step's Newton solver decides by differences of the cost, which float32 resolves to a relative
1e-7; near the optimum the acceleration is then only right to about 1e-3 rad/s^2, always late in
the same direction, and a sticking grasp creeps: 0.1 N m of joint torque at the end of a door
opening.  `solve` here iterates on the gradient alone and agrees with the C engine (and with
mjx.step in float64) to better than 0.01 N m over the same opening, and it is faster.

Pyramidal and frictionless contacts, limits, equalities and dry friction are solved here; a model
with elliptic cones goes through mjx.solve.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.core import Tracer

from droid_jax.model.actuators import drives_joint
from droid_jax.model.mjx_internals import (
    ConstraintRows,
    at_velocity,
    constraint_rows,
    exact_segments,
    friction_dofs,
    midpoint_constraints,
    with_constraint_force,
)
from droid_jax.model.normal_equations import normal_equations
from droid_jax.model.quiet_mjx import mjx
from droid_jax.model.unsupported_features import check_options

ITERATIONS = 8  # at most; two or three are usual from a warm start
LINE_SEARCH = 6  # corners of the piecewise linear slope followed in one step
FIRM_LINE_SEARCH = 12  # the same where joint friction is firm: its part of the slope is steep and narrow
EXACT_ROWS = 16  # constraint rows up to which all corners of firm friction are looked at at once, which is as cheap
FIRM = 0.95  # impedance of a friction constraint above which it is
_TOLERANCE = 3e-6  # of the acceleration's scale: what float32 can still tell apart
_ROUNDING = 1e-5  # of a Newton step: how exactly float32 solves for it


def simulate_step(
    model: Any,
    data: Any,
    *,
    parity: bool = False,
    servo_damping: bool = True,
    push: Callable[[Any], jax.Array] | None = None,
) -> Any:
    """Advance mjx.Data by one time step; integrators Euler and implicitfast.

    parity=False: second order in the time step.  Positions belong to the time of the step,
      velocities to half a step before (leapfrog); joint damping and constraint damping use the mean
      velocity of the step, and constraints are solved with the inertia that follows, M + h/2 D.
    parity=True: what C MuJoCo's implicitfast and Euler do, first order, for comparisons step by step.
    servo_damping: False spares what only actuators with a velocity gain need (see `actuators.has_servo_damping`).
    push: mjx.Data with the kinematics of the pose -> [nv] generalised forces, which take the place of qfrc_applied.
    Leaves out what no replay reads: sensors, cameras, lights.
    Raises ValueError for other integrators, and for elliptic cones, air and water unless parity.
    """
    check_options(model, parity)
    with exact_segments(), contextlib.nullcontext() if parity else midpoint_constraints():
        data = mjx.fwd_position(model, data)
    data = data if push is None else data.replace(qfrc_applied=push(data))
    data = mjx.fwd_velocity(model, data)
    data = mjx.fwd_actuation(model, data)
    data = mjx.fwd_acceleration(model, data)
    inertia = mjx.full_m(model, data)
    if np.any(model.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE):
        data = _within_range(model, data)
    if servo_damping:
        model = _without_held(model, data, parity)
    if not parity:
        slope = mjx.deriv_smooth_vel(model, data)
        inertia = inertia if slope is None else inertia - 0.5 * model.opt.timestep * slope
    if constraint_rows(data).jacobian.size == 0:
        data = data.replace(qacc=jax.scipy.linalg.solve(inertia, data.qfrc_smooth, assume_a="pos"))
    elif model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        data = mjx.solve(model, data)
    else:
        data = solve(inertia, data, firm=_may_be_firm(model))
    if not parity:
        return mjx.euler(_undamped(model), data)
    if not _is_euler(model):
        return mjx.implicit(model, data)
    without = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_DAMPER  # which mjx.euler does not look at
    return mjx.euler(_undamped(model) if without else model, data)


def servo_force(model: Any, data: Any, velocity: jax.Array) -> jax.Array:
    """[nv] N m, the actuators' forces of the step that `data` comes from, had the joints moved at velocity [nv].

    A step integrates velocity gains at its mean velocity, data.qfrc_actuator is at the one before it.
    """
    return mjx.fwd_actuation(model, at_velocity(data, velocity)).qfrc_actuator


def gear_torques(model: Any, data: Any, velocity: jax.Array) -> jax.Array:
    """[2, nv] N m, of the step that `data` comes from: what motors give to the gears, what the links put onto them.

    Motors: actuators and what compensates gravity.  Links: weight, the motion of the others, springs, contacts, limits
    and applied forces; all but the joints' own inertia, damping and dry friction.  velocity: [nv] before the step.
    """
    rows = constraint_rows(data)
    dry = slice(rows.equalities, rows.equalities + rows.frictions)
    held = data.qfrc_constraint - rows.jacobian[dry].T @ rows.force[dry]
    compensated = (1.0 - model.jnt_actgravcomp[model.dof_jntid]) * data.qfrc_gravcomp
    links = data.qfrc_passive - compensated - data.qfrc_bias + held + data.qfrc_applied
    if not model.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER):
        links = links + model.dof_damping * velocity
    return jnp.stack([data.qfrc_actuator + compensated, links])


def _within_range(model: Any, data: Any) -> Any:
    """The data with controls inside their ranges, as the forces took them: mjx's derivative of a damper does not."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return data
    low, high = model.actuator_ctrlrange.T
    return data.replace(ctrl=jnp.where(model.actuator_ctrllimited, jnp.clip(data.ctrl, low, high), data.ctrl))


def _without_held(model: Any, data: Any, parity: bool) -> Any:
    """The model without the velocity gains of servos whose force a limit holds: mjx's derivative counts them too."""
    free = ~_held(model, data, parity)[:, None]
    gains = ("actuator_biasprm", "actuator_gainprm")
    return model.replace(**{g: jnp.where(free, getattr(model, g), getattr(model, g).at[:, 2].set(0.0)) for g in gains})


def _held(model: Any, data: Any, parity: bool) -> jax.Array:
    """[nu] bool, actuators of joints at their own force limit or (the C engine looks past it) at their joint's."""
    held = model.actuator_forcelimited & _outside(data.actuator_force, model.actuator_forcerange)
    if parity:
        return held
    of_joint = drives_joint(model)
    joint = np.where(of_joint, model.actuator_trnid[:, 0], 0)  # a tendon's number is no joint's
    torque = data.qfrc_actuator[model.jnt_dofadr[joint]]
    return held | (of_joint & model.jnt_actfrclimited[joint] & _outside(torque, model.jnt_actfrcrange[joint]))


def _outside(values: jax.Array, bounds: jax.Array) -> jax.Array:
    """bool, values [n] at or beyond one of their bounds [n, 2]."""
    return (values <= bounds[:, 0]) | (values >= bounds[:, 1])


def _is_euler(model: Any) -> bool:
    return model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER


def _undamped(model: Any) -> Any:
    """The model with Euler's own implicit damping off: the acceleration already contains it."""
    flags = model.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return model.replace(opt=model.opt.replace(disableflags=flags))


def _may_be_firm(model: Any) -> bool:
    """Whether a joint's friction is firm, or may be because its impedance is a parameter."""
    if isinstance(model.dof_solimp, Tracer):
        return True
    return bool(np.any(np.asarray(model.dof_solimp)[np.asarray(friction_dofs(model)), 0] > FIRM))


def solve(inertia: jax.Array, data: Any, firm: bool = False) -> Any:
    """Newton's method on the primal problem of MuJoCo's solver, from the warm start.

    min over a: a^T M a / 2 - a^T f + sum_i s_i(J_i a - aref_i), with the smooth forces f and s_i
    quadratic while a row is active (equality: always; dry friction: inside its bounds; the rest:
    while negative).  inertia: [nv, nv] M, or what the integrator will use in its place.  firm: whether joint friction
    may be: the search along a step must not end early then, what is missing to its end adds up to milliradians.
    Source: MuJoCo documentation, "Computation", section "Solver" (primal problem).
    """
    rows = constraint_rows(data)
    jacobian, weight = rows.jacobian, rows.weight
    low, high = _force_bounds(rows)
    exact = firm and weight.shape[0] <= EXACT_ROWS
    of_weights, solved = normal_equations(jacobian)

    def forces(residual: jax.Array) -> tuple[jax.Array, jax.Array]:
        """[rows] forces and curvatures at J a - aref."""
        free = -weight * residual
        force = jnp.clip(free, low, high)
        return force, jnp.where(force == free, weight, 0.0)

    def iterate(carry):
        qacc, residual, force, curvature, count, _ = carry
        pull = _times(inertia, qacc) - data.qfrc_smooth
        hessian = inertia + of_weights(curvature)
        change = solved(hessian, _times(jacobian.T, force) - pull)
        along = _times(jacobian, change)
        slopes = _dot(pull, change), _dot(change, _times(inertia, change))
        if exact:
            share = _exact_share(forces, residual, along, *slopes, jnp.stack([low, high]) / -weight)
        else:
            share = _line_search(forces, residual, along, *slopes, FIRM_LINE_SEARCH if firm else LINE_SEARCH)
        qacc, residual = qacc + share * change, residual + share * along
        force, new_curvature = forces(residual)
        # What is left of the way: all of it, but where no row changed sides the problem was quadratic
        # and the share missing to a full step is left, or what the factorisation rounds off.
        unchanged = jnp.all(new_curvature == curvature)
        left = jnp.where(unchanged, jnp.maximum(jnp.abs(share - 1.0), _ROUNDING), 1.0) * jnp.max(jnp.abs(change))
        moved = left > _TOLERANCE * (1.0 + jnp.max(jnp.abs(qacc)))
        return qacc, residual, force, new_curvature, count + 1, moved

    def unfinished(carry):
        return carry[5] & (carry[4] < ITERATIONS)

    residual = _times(jacobian, data.qacc_warmstart) - rows.reference
    start = (data.qacc_warmstart, residual, *forces(residual), jnp.zeros((), jnp.int32), jnp.array(True))
    qacc, _, force, _, _, _ = jax.lax.while_loop(unfinished, iterate, start)
    data = data.replace(qacc=qacc, qfrc_constraint=_times(jacobian.T, force))
    return with_constraint_force(data, force)


# Sums of products in place of small matrix products: XLA fuses them with what stands beside them,
# where each `dot` of a batch would be a call of its own.
def _times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    return jnp.sum(matrix * vector, axis=-1)


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sum(a * b)


def _force_bounds(rows: ConstraintRows) -> tuple[jax.Array, jax.Array]:
    """[rows] the range of each row's force: any (equality), +- friction loss, or pushing only."""
    kind = np.arange(rows.weight.shape[0])
    after = rows.equalities + rows.frictions
    equality, dry = kind < rows.equalities, (kind >= rows.equalities) & (kind < after)
    loss = rows.friction
    low = jnp.where(equality, -jnp.inf, jnp.where(dry, -loss, 0.0))
    return low, jnp.where(dry, loss, jnp.inf)


def _line_search(
    forces: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    residual: jax.Array,
    along: jax.Array,
    linear: jax.Array,
    quadratic: jax.Array,
    corners: int,
) -> jax.Array:
    """Root of the cost's slope along a step: Newton's method on the share taken, kept in a bracket.

    The slope at share t is linear + t * quadratic - forces(residual + t * along) . along; it rises
    with t (the cost is convex) and is piecewise linear, so Newton ends after a few corners.
    """
    low: jax.Array = jnp.zeros(())
    high: jax.Array = jnp.full((), jnp.inf)
    share: jax.Array = jnp.ones(())
    for _ in range(corners):
        force, curvature = forces(residual + share * along)
        slope = linear + share * quadratic - _dot(force, along)
        low, high = jnp.where(slope < 0, share, low), jnp.where(slope < 0, high, share)
        newton = share - slope / (quadratic + _dot(curvature, along * along) + 1e-30)
        middle = jnp.where(jnp.isinf(high), 2.0 * low, 0.5 * (low + high))
        # Where Newton stands still it has arrived; bisecting there would lose the root again.
        inside = (newton > low) & (newton < high) | (newton == share)
        share = jnp.where(inside, newton, middle)
    return share


def _exact_share(
    forces: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    residual: jax.Array,
    along: jax.Array,
    linear: jax.Array,
    quadratic: jax.Array,
    ends: jax.Array,
) -> jax.Array:
    """The same root by the slope at all of its corners at once: between two neighbours it is linear.

    ends: [2, rows] of J a - aref, where each row's force reaches its bounds.
    """
    moves = along != 0.0
    at = (ends - residual) / jnp.where(moves, along, 1.0)
    at = jnp.where(moves & jnp.isfinite(at), at, 0.0).reshape(-1)  # [2 rows]

    def slope(share: jax.Array) -> tuple[jax.Array, jax.Array]:
        force, curvature = forces(residual + share[:, None] * along)
        rise = quadratic + jnp.sum(curvature * along * along, axis=-1)
        return linear + share * quadratic - jnp.sum(force * along, axis=-1), rise

    below = slope(at)[0] < 0.0
    low = jnp.max(jnp.where(below & (at > 0.0), at, 0.0))
    high = jnp.min(jnp.where(below | (at <= 0.0), jnp.inf, at))
    middle = jnp.where(jnp.isinf(high), low + 1.0, 0.5 * (low + high))
    there, rise = slope(middle[None])
    return jnp.clip(middle - there[0] / (rise[0] + 1e-30), low, high)
