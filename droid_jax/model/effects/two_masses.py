"""Motor and link as two masses: an elastic gear that vibrates, and backlash in which both move freely.

With the motor's angle theta, the link's q, the gear's torque F and the motor's inertia J (the joint's armature):

    J theta'' = servo(theta) - F        M q'' = F + all else        F = (d - o) / c + D d'     d = theta - q

d is the lead of the motor, o the nearer end of the backlash, c the compliance of the gear and D its damping.  F is zero
inside the backlash.  Damping and dry friction of the joint act on the link.

In a time step the motor moves by the implicit midpoint rule.  The gear's mean torque is then a constant minus a share
of J q'', and the link moves with that share of the armature in one solve with everything else: both masses are
implicit, and the step is stable at any stiffness.  As the compliance vanishes the share is one, and the replay is that
of a rigid gear.  A rigid gear that meets the end of its backlash does not rebound: momentum is conserved, and the two
move together until the torque on the contact changes its sign.

A weight that MuJoCo compensates (gravcomp) acts on the link and not through the gear, as a robot's motors would carry
it, so arms with compensated bodies do not have these effects.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax.model.effect_interface import Effect, Gear, GearStep, State, Theta, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.position_servos import PositionServos, arm_servos
from droid_jax.model.effects.registry import register
from droid_jax.model.physics import moved_bodies
from droid_jax.model.scene import Scene

RESONANCE, BACKLASH, DAMPING = "two_mass_resonance", "two_mass_backlash", "two_mass_damping"
DAMPING_RATIOS = (0.02, 0.1)  # of a motor on its gear, held at the other side
LEAST_COMPLIANCE = 1e-9  # rad/(N m), at and below which a gear is rigid
LEAST_INERTIA = 1e-9  # kg m^2


@register
def two_mass_resonance(scene: Scene) -> Effect | None:
    """A motor with the joint's armature on a gear of compliance c, rad/(N m); the servo's encoder is on the motor."""
    servos = _geared(scene)
    if servos is None:
        return None
    sizes = servos.compliances
    of_joints = (a.coefficient(f"{RESONANCE}[{j}]", "rad/(N m)", *sizes[j], low=0.0) for j in servos.joints)
    return Effect(
        RESONANCE,
        (*of_joints, a.shape(DAMPING, "-", DAMPING_RATIOS, 0.0, 1.0)),
        gear=_gear(scene),
        twist=functools.partial(_twist, servos),
        description="an elastic gear on which the motor and the link vibrate against each other",
        signature="vibration of that joint after fast changes, and a tracking error in proportion to load",
        confused_with=("joint_compliance", "servo_gain", "profile_acceleration"),
        special_cases=("joint_compliance",),
        locations=a.locations(servos.joints, RESONANCE),
        shape_parameters={DAMPING: DAMPING_RATIOS},
        minimum_size=0.2 * min(usual for usual, _ in sizes.values()),
    )


@register
def two_mass_backlash(scene: Scene) -> Effect | None:
    """A motor that turns freely over b rad, half of it to either side of the link, whose position is recorded."""
    servos = _geared(scene)
    if servos is None:
        return None
    return Effect(
        BACKLASH,
        a.of_joints(BACKLASH, servos.joints, "rad", 4e-3, 5e-2, low=0.0),
        gear=_gear(scene),
        description="backlash in a joint's gear, which the motor and the link cross on their own",
        signature="where the load of that joint changes sign: a jump, a short impact, or small oscillations at rest",
        confused_with=("joint_backlash", "joint_coulomb", "joint_compliance"),
        special_cases=("joint_backlash",),
        locations=a.locations(servos.joints, BACKLASH),
        minimum_size=1e-3,
    )


def _geared(scene: Scene) -> PositionServos | None:
    """The position servos of joints with an armature, which is the inertia of the motor; None if there are none.

    None also if the weight of a body behind one of them is compensated.
    """
    servos, model = arm_servos(scene), scene.model
    if servos is None:
        return None
    carried = moved_bodies(model)[np.ix_(model.body_gravcomp != 0.0, servos.dofs)]
    return None if carried.any() else servos.where(model.dof_armature[servos.dofs] > 0.0)


@functools.lru_cache(maxsize=64)
def _gear(scene: Scene) -> Gear:
    """The law that both effects share, so that they act in one model."""
    servos = _geared(scene)
    assert servos is not None

    def step(theta: Theta, state: State, ctrl: jax.Array) -> GearStep:
        return _step(servos, theta, state, ctrl)

    def start(theta: Theta, state: State, ctrl: jax.Array) -> jax.Array:
        lead, _ = _held(servos, theta, state, ctrl)
        return jnp.zeros((3, len(state.qvel)), jnp.float32).at[0, servos.dofs].set(lead)

    return Gear(step, start)


def _twist(servos: PositionServos, theta: Theta, state: State, ctrl: jax.Array) -> jax.Array:
    """[nv] rad, the elastic part of the lead at the start, which the encoder reads and the link does not have."""
    _, elastic = _held(servos, theta, state, ctrl)
    return jnp.zeros_like(state.qvel).at[servos.dofs].set(elastic)


def _held(servos: PositionServos, theta: Theta, state: State, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
    """[J] rad, the lead of motors that stand still, and its elastic part.

    The state's positions are what was recorded: the link's position and the twist of the gear.
    """
    compliance, half, _ = _of(servos, theta)
    stiffness, torque = servos.stiffness_in(state), servos.rigid_torque(state, ctrl)
    free = torque / stiffness  # the lead at which the servo is at its goal
    held = jnp.clip(torque - stiffness * jnp.sign(torque) * half, *servos.limits_in(state))
    elastic = compliance * held
    inside = jnp.abs(free) < half
    elastic = jnp.where(inside, 0.0, elastic)
    return jnp.where(inside, free, jnp.sign(torque) * half + elastic), elastic


def _of(servos: PositionServos, theta: Theta) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compliance [J] rad/(N m), half of the backlash [J] rad, and damping ratio []."""
    compliance, backlash = column(theta, RESONANCE, servos.joints), column(theta, BACKLASH, servos.joints)
    return jnp.abs(compliance), 0.5 * jnp.abs(backlash), a.value(theta, DAMPING, DAMPING_RATIOS[-1])


def _step(servos: PositionServos, theta: Theta, state: State, ctrl: jax.Array) -> GearStep:
    """One time step of the motors; see the module's text for the equations."""
    model, dofs, actuators = state.model, servos.dofs, servos.actuators
    before: jax.Array = state.motors[:, dofs]
    lead, speed, acceleration = before[0], before[1], before[2]
    compliance, half, ratio = _of(servos, theta)
    timestep: jax.Array = jnp.asarray(model.opt.timestep)
    inertia = jnp.maximum(model.dof_armature[dofs], LEAST_INERTIA)
    stiffness, damping = servos.stiffness_in(state), servos.damping_in(state)
    rigid = servos.rigid_torque(state, ctrl)
    low, high = servos.limits_in(state)
    # A servo at its limit gives that limit, whatever its gains.  What it would give is asked of the middle of the step.
    ahead = (2.0 * inertia / timestep) * speed - stiffness * lead + rigid - inertia * acceleration
    ahead = ahead / (2.0 * inertia / timestep + 0.5 * timestep * stiffness + damping)
    middle = rigid - stiffness * (lead + 0.5 * timestep * ahead) - damping * ahead
    free_running = (middle > low) & (middle < high)
    torque = jnp.where(free_running, rigid, jnp.clip(middle, low, high))
    stiffness, damping = (jnp.where(free_running, gain, jnp.zeros_like(gain)) for gain in (stiffness, damping))

    # Contact or free.  A rigid contact lasts while the motor, left alone, would go further.
    is_rigid = compliance <= LEAST_COMPLIANCE
    alone = (torque - stiffness * lead - damping * speed) / inertia - acceleration
    coming = jnp.where(is_rigid, lead + timestep * speed + 0.5 * timestep**2 * alone, lead)
    free = jnp.abs(coming) < half
    end = jnp.where(free, 0.0, jnp.sign(coming) * half)
    hard: jax.Array = is_rigid & ~free
    soft: jax.Array = ~is_rigid & ~free
    stiff: jax.Array = 1.0 / jnp.maximum(compliance, LEAST_COMPLIANCE)
    spring: jax.Array = jnp.where(soft, stiff, jnp.zeros_like(stiff))
    damper: jax.Array = jnp.where(soft, 2.0 * ratio * jnp.sqrt(inertia * stiff), jnp.zeros_like(stiff))

    # The mean speed of the lead is (pull - J' q'') / resistance; J' has the servo's damping at the link's mean speed.
    resistance = 2.0 * inertia / timestep + 0.5 * timestep * (stiffness + spring) + damping + damper
    pull = torque + 2.0 * inertia * speed / timestep - stiffness * lead - spring * (lead - end)
    share: jax.Array = jnp.where(hard, jnp.ones_like(lead), (0.5 * timestep * spring + damper) / resistance)
    force: jax.Array = jnp.where(
        hard, inertia * speed / timestep + torque - stiffness * end, spring * (lead - end) + share * pull
    )
    # What the actuators give with the velocity gains below, at the velocity before the step.
    own = servos.damping_in(state) - share * damping
    push = force - jnp.clip(rigid + own * state.qvel[dofs], low, high)
    armature, bias = model.dof_armature, model.actuator_biasprm
    geared = model.replace(
        dof_armature=armature.at[dofs].set(armature[dofs] * share),
        actuator_biasprm=bias.at[actuators, 2].set(-share * damping / servos.gear**2),
    )

    def after(qacc: jax.Array) -> jax.Array:
        mean = (pull - (inertia + 0.5 * timestep * damping) * qacc[dofs]) / resistance
        moved: jax.Array = jnp.where(hard, end, lead + timestep * mean)
        faster: jax.Array = jnp.where(hard, jnp.zeros_like(lead), 2.0 * mean - speed)
        # The acceleration of an impact ends with it and does not tell whether the contact lasts; that before it does.
        lasting: jax.Array = jnp.where(hard & (speed != 0.0), acceleration, qacc[dofs])
        return state.motors.at[:, dofs].set(jnp.stack([moved, faster, lasting]))

    def reading(motors: jax.Array) -> jax.Array:
        later, faster, qacc = motors[0, dofs], motors[1, dofs], motors[2, dofs]
        middle = 0.5 * (lead + later)  # at the time of the position, half a step after `lead`
        elastic = middle - jnp.clip(middle, -half, half)
        quicker: jax.Array = jnp.where(soft, 0.5 * (speed + faster), jnp.zeros_like(speed))
        torque = push + (1.0 - share) * inertia * qacc + inertia * (faster - speed) / timestep
        return jnp.zeros_like(motors).at[:, dofs].set(jnp.stack([elastic, quicker, torque]))

    return GearStep(geared, jnp.zeros_like(state.qvel).at[dofs].set(push), after, reading)
