"""One simulation step of MJX with a constraint solver for float32 and few constraint rows.

mjx.step's Newton solver uses differences of the cost, which float32 resolves to a relative 1e-7.  Its accelerations are
then exact to about 1e-3 rad/s^2, with an error of constant sign, so that a sticking grasp creeps: 0.1 N m of joint
torque at the end of a door opening.  `solve` uses the gradient only.  It agrees with the C engine (and with mjx.step in
float64) to 0.01 N m over the same opening, and it is faster.

`solve` supports pyramidal and frictionless contacts, limits, equalities and dry friction.  Models with elliptic cones
use mjx.solve.
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
from droid_jax.model.normal_equations import normal_equations, solver
from droid_jax.model.unsupported_features import check_options
from droid_jax.quiet import mjx

ITERATIONS = 8  # most Newton iterations; two or three are usual from a warm start
LINE_SEARCH = 6  # iterations of a line search, each at a corner of the piecewise linear slope
FIRM_LINE_SEARCH = 12  # the same for firm joint friction, whose part of the slope is steep and narrow
EXACT_ROWS = 16  # constraint rows up to which all corners are evaluated at once for firm friction, at the same cost
FIRM = 0.95  # impedance of a friction constraint above which it is firm
_TOLERANCE = 3e-6  # relative change of the acceleration that float32 resolves
_ROUNDING = 1e-5  # relative accuracy of a Newton step in float32


def simulate_step(
    model: Any,
    data: Any,
    *,
    parity: bool = False,
    servo_damping: bool = True,
    push: Callable[[Any], jax.Array] | None = None,
) -> Any:
    """Advance mjx.Data by one time step, without sensors, cameras and lights.

    Args:
        model: mjx.Model with the integrator Euler or implicitfast.
        data: mjx.Data.
        parity: if False, the step is of second order.  Positions belong to the time of the step, velocities to half a
            step before (leapfrog).  Joint damping and constraint damping use the mean velocity of the step, so
            constraints are solved with the inertia M + h/2 D.  If True, the step is that of C MuJoCo, of first order.
        servo_damping: False omits computations for actuators with a velocity gain (`actuators.has_servo_damping`).
        push: mjx.Data with the kinematics of the pose -> [nv] generalised forces that replace qfrc_applied.

    Returns:
        mjx.Data after the step.

    Raises:
        ValueError: the model has another integrator, or elliptic cones or a fluid without `parity`.
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
        model = _without_saturated(model, data, parity)
    if not parity:
        slope = mjx.deriv_smooth_vel(model, data)
        inertia = inertia if slope is None else inertia - 0.5 * model.opt.timestep * slope
    if constraint_rows(data).jacobian.size == 0:
        data = data.replace(qacc=solver(model.nv)(inertia, data.qfrc_smooth))
    elif model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        data = mjx.solve(model, data)
    else:
        data = solve(inertia, data, firm=_may_be_firm(model))
    if not parity:
        return mjx.euler(_undamped(model), data)
    if not _is_euler(model):
        return mjx.implicit(model, data)
    undamped = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_DAMPER  # mjx.euler ignores this flag
    return mjx.euler(_undamped(model) if undamped else model, data)


def servo_force(model: Any, data: Any, velocity: jax.Array) -> jax.Array:
    """[nv] N m, the actuators' forces in the step that gave `data`, at joint velocities [nv].

    A step integrates velocity gains at its mean velocity; data.qfrc_actuator is that at the velocity before the step.
    """
    return mjx.fwd_actuation(model, at_velocity(data, velocity)).qfrc_actuator


def gear_torques(model: Any, data: Any, velocity: jax.Array) -> jax.Array:
    """[2, nv] N m, torques of the motors and of the links on the gears, in the step that gave `data`.

    Motors: actuators and gravity compensation.  Links: weight, velocity terms, springs, contacts, limits and applied
    forces, without the joints' inertia, damping and dry friction.

    velocity: [nv] before the step.
    """
    rows = constraint_rows(data)
    dry = slice(rows.equalities, rows.equalities + rows.frictions)
    constraints = data.qfrc_constraint - rows.jacobian[dry].T @ rows.force[dry]
    compensated = (1.0 - model.jnt_actgravcomp[model.dof_jntid]) * data.qfrc_gravcomp
    links = data.qfrc_passive - compensated - data.qfrc_bias + constraints + data.qfrc_applied
    if not model.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER):
        links = links + model.dof_damping * velocity
    return jnp.stack([data.qfrc_actuator + compensated, links])


def _within_range(model: Any, data: Any) -> Any:
    """The data with clipped controls, which mjx's derivative of a damper does not clip."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return data
    low, high = model.actuator_ctrlrange.T
    return data.replace(ctrl=jnp.where(model.actuator_ctrllimited, jnp.clip(data.ctrl, low, high), data.ctrl))


def _without_saturated(model: Any, data: Any, parity: bool) -> Any:
    """The model without velocity gains of servos at a force limit, which mjx's derivative would include."""
    free = ~_saturated(model, data, parity)[:, None]
    gains = ("actuator_biasprm", "actuator_gainprm")
    return model.replace(**{g: jnp.where(free, getattr(model, g), getattr(model, g).at[:, 2].set(0.0)) for g in gains})


def _saturated(model: Any, data: Any, parity: bool) -> jax.Array:
    """[nu] bool, actuators at their force limit, or at that of their joint, which the C engine ignores here."""
    saturated = model.actuator_forcelimited & _outside(data.actuator_force, model.actuator_forcerange)
    if parity:
        return saturated
    of_joint = drives_joint(model)
    joint = np.where(of_joint, model.actuator_trnid[:, 0], 0)  # the id of a tendon is no joint's
    torque = data.qfrc_actuator[model.jnt_dofadr[joint]]
    return saturated | (of_joint & model.jnt_actfrclimited[joint] & _outside(torque, model.jnt_actfrcrange[joint]))


def _outside(values: jax.Array, bounds: jax.Array) -> jax.Array:
    """bool, values [n] at or beyond one of their bounds [n, 2]."""
    return (values <= bounds[:, 0]) | (values >= bounds[:, 1])


def _is_euler(model: Any) -> bool:
    return model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER


def _undamped(model: Any) -> Any:
    """The model without the implicit damping of Euler, since the acceleration contains it already."""
    flags = model.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return model.replace(opt=model.opt.replace(disableflags=flags))


def _may_be_firm(model: Any) -> bool:
    """Whether a joint's friction is firm, or its impedance is a parameter."""
    if isinstance(model.dof_solimp, Tracer):
        return True
    return bool(np.any(np.asarray(model.dof_solimp)[np.asarray(friction_dofs(model)), 0] > FIRM))


def solve(inertia: jax.Array, data: Any, firm: bool = False) -> Any:
    """Solve the primal problem of MuJoCo's constraint solver by Newton's method, from the warm start.

    min over a: a^T M a / 2 - a^T f + sum_i s_i(J_i a - aref_i), with the smooth forces f.  s_i is quadratic while a row
    is active: equalities always, dry friction inside its bounds, other rows while negative.

    Args:
        inertia: [nv, nv] M, or the matrix that the integrator uses in its place.
        data: mjx.Data after the smooth accelerations.
        firm: whether joint friction may be firm.  Line searches are then exact, since an early end of them adds up to
            errors of milliradians.

    Returns:
        mjx.Data with accelerations and constraint forces.

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
        # Bound of the remaining error: the whole step.  If no row changed its state, the problem was quadratic and the
        # error is the missing share of a full step, or the rounding of the factorisation.
        unchanged = jnp.all(new_curvature == curvature)
        error = jnp.where(unchanged, jnp.maximum(jnp.abs(share - 1.0), _ROUNDING), 1.0) * jnp.max(jnp.abs(change))
        moved = error > _TOLERANCE * (1.0 + jnp.max(jnp.abs(qacc)))
        return qacc, residual, force, new_curvature, count + 1, moved

    def unfinished(carry):
        return carry[5] & (carry[4] < ITERATIONS)

    residual = _times(jacobian, data.qacc_warmstart) - rows.reference
    start = (data.qacc_warmstart, residual, *forces(residual), jnp.zeros((), jnp.int32), jnp.array(True))
    qacc, _, force, _, _, _ = jax.lax.while_loop(unfinished, iterate, start)
    data = data.replace(qacc=qacc, qfrc_constraint=_times(jacobian.T, force))
    return with_constraint_force(data, force)


# Sums of products in place of small matrix products.  XLA fuses them with neighbouring operations, whereas each `dot`
# of a batch would be a separate library call.
def _times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    return jnp.sum(matrix * vector, axis=-1)


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sum(a * b)


def _force_bounds(rows: ConstraintRows) -> tuple[jax.Array, jax.Array]:
    """[rows] lower and upper bounds of forces: none (equalities), +- friction loss, or not negative."""
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
    """The share of a step at which the cost's slope is zero, by Newton's method in a bracket.

    The slope at share t is linear + t * quadratic - forces(residual + t * along) . along.  It increases with t (the
    cost is convex) and is piecewise linear, so Newton's method ends after a few corners.
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
        # Newton's method has converged if the share does not change; a bisection would lose the root.
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
    """The same root from the slopes at all corners at once; between two corners the slope is linear.

    ends: [2, rows] values of J a - aref at which each row's force reaches its bounds.
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
