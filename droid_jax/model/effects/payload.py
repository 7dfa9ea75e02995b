"""A tool or load at the hand whose weight the controller does not compensate."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.effect_interface import Effect, State, Theta
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.kinematics import turned
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import write
from droid_jax.model.parameters import Mode, Parameter, Role
from droid_jax.model.scene import Scene

MASS, MOMENT = "payload_mass", "payload_moment"
POSES, LEAST_ACCELERATION = 20, 1e-3  # poses at which torques of a moment are tested, and the least m/s^2 that count
LOAD, MOMENTS = "load_mass", tuple(f"load_moment_{axis}" for axis in "xyz")


@register
def payload(scene: Scene) -> Effect | None:
    """A mass m, kg, at the centre of mass of the heaviest body after the arm's last joint, and its moment m r, kg m.

    The gravity of the nominal mass is still compensated, that of the payload is not.  r is the distance of the load's
    centre of mass from the body's, on the line from the last joint.  The inertia of the moment is neglected: at
    1 rad/s^2 it is a tenth of its weight.  Body and line are those of the MJCF also for a recording with numbers of its
    own, since all recordings share m and r; the weight acts along that recording's gravity, on its arm.
    """
    if (carried := _carried(scene)) is None:
        return None
    last, body = carried
    mass = _added_mass(scene, body, MASS, Role.PAYLOAD_MASS)
    force = _outward_moment(scene, last, body)
    parameters = (mass,) if force is None else (mass, a.coefficient(MOMENT, "kg m", 0.02, 0.3))
    return Effect(
        "payload",
        parameters,
        force=force,
        description="a tool or load whose weight the controller does not compensate",
        signature="free motion: all joints in proportion to their lever",
        confused_with=("torque_bias", "cable_pull"),
        locations={last: tuple(p.name for p in parameters)},
        minimum_size=0.02,
        native=lambda values, model: None if values.get(MOMENT) else {},  # the mass is a field of the model
    )


@register
def free_payload(scene: Scene) -> Effect | None:
    """A payload with its centre of mass anywhere: m r is a vector in the body's frame, from the body's centre of mass.

    Coordinates that cause no torque at a measured joint in any pose are left out.
    """
    if (carried := _carried(scene)) is None:
        return None
    last, body = carried
    active = _active_axes(scene, body)
    names = tuple(name for name, used in zip(MOMENTS, active, strict=True) if used)
    basis = jnp.asarray(np.eye(3)[active], jnp.float32)
    force = _weight_of_moment(scene, body, lambda theta: jnp.stack([a.value(theta, name) for name in names]) @ basis)
    if force is None or len(names) < 2:
        return None
    return Effect(
        "free_payload",
        (_added_mass(scene, body, LOAD), *(a.coefficient(name, "kg m", 0.02, 0.3) for name in names)),
        force=force,
        description="a tool or load off the hand's axis, whose weight the controller does not compensate",
        signature="free motion: all joints, in proportion to levers that turn with the hand",
        confused_with=("payload", "gravity_direction", "torque_bias", "cable_pull"),
        special_cases=("payload",),
        locations={last: (LOAD, *names)},
        minimum_size=0.02,
        native=lambda values, model: None if any(values.get(name) for name in names) else {},
    )


def _carried(scene: Scene) -> tuple[str, int] | None:
    """The arm's last joint and the body of the MJCF that carries a load; None if there is no body with a mass."""
    scene = scene.nominal
    joints = a.arm(scene)
    if not joints:
        return None
    last = max(joints, key=lambda joint: scene.id("joint", joint))  # in the model's order, not the channels'
    body = _carrier(scene, last)
    return (last, body) if scene.model.body_mass[body] > 0 else None


def _active_axes(scene: Scene, body: int) -> np.ndarray:
    """[3] bool, axes of a body's frame along which a moment causes a torque at a measured joint in some pose."""
    scene = scene.nominal
    model, data = scene.model, mujoco.MjData(scene.model)
    rng, turning, most = np.random.default_rng(0), np.zeros((3, model.nv)), np.zeros(3)
    for _ in range(POSES):
        mujoco.mj_integratePos(model, data.qpos, rng.uniform(-1.0, 1.0, model.nv), 1.0)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_jacBody(model, data, None, turning, body)
        torques = np.cross(data.xmat[body].reshape(3, 3).T, model.opt.gravity) @ turning[:, a.arm_dofs(scene)]
        most = np.maximum(most, np.abs(torques).max(axis=1))
    return most > LEAST_ACCELERATION


def _added_mass(scene: Scene, body: int, name: str, role: Role = Role.OTHER) -> Parameter:
    """A mass at a body's centre of mass, kg, without gravity compensation.

    For a compensated body the mass is scaled and gravcomp is divided by the same factor, so that the compensated weight
    is unchanged.  If the body's mass is fitted too, the added mass is relative to the model's.
    """
    mass = float(scene.model.body_mass[body])
    share = dict(gain=1.0 / mass, offset=1.0)
    writes = [write(scene, "body_mass", (body,), Mode.ADD)]
    if scene.model.body_gravcomp[body] != 0:
        writes = [write(scene, "body_mass", (body,), Mode.SCALE, **share)]
        writes.append(write(scene, "body_gravcomp", (body,), Mode.DIVIDE, **share))
    options: dict[str, Any] = dict(group=a.GROUP, role=role)
    return Parameter(name, "kg", 0.0, 0.2, -0.9 * min(mass, 1.0), 2.0, writes=tuple(writes), **options)


def _outward_moment(scene: Scene, joint: str, body: int) -> Callable[[Theta, State], jax.Array] | None:
    """Joint torques of a load's moment along `_outwards`; None without this direction, or if the body floats."""
    outwards = _outwards(scene.nominal, joint, body)
    if outwards is None:
        return None
    direction = jnp.asarray(outwards, jnp.float32)
    return _weight_of_moment(scene, body, lambda theta: a.value(theta, MOMENT) * direction)


def _weight_of_moment(
    scene: Scene, body: int, moment: Callable[[Theta], jax.Array]
) -> Callable[[Theta, State], jax.Array] | None:
    """Joint torques [nv] of the weight of a moment [3] kg m in a body's frame; None if the body floats."""
    links = turned(scene, body)
    if links is None:
        return None
    gravity = jnp.asarray(scene.model.opt.gravity, jnp.float32)

    def force(theta: Theta, state: State) -> jax.Array:
        # The sample's own reference position: an encoder that is off reads another angle than the joint has.
        axes, rotation = links(state.qpos, scene.model.qpos0 if state.model is None else state.model.qpos0)
        return axes @ jnp.cross(rotation @ moment(theta), gravity)

    return force


def _outwards(scene: Scene, joint: str, body: int) -> np.ndarray | None:
    """[3] unit vector in a body's frame, from a joint to the body's centre of mass; None if both coincide."""
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    line = data.xmat[body].reshape(3, 3).T @ (data.xipos[body] - data.xanchor[scene.id("joint", joint)])
    length = float(np.linalg.norm(line))
    return line / length if length > 1e-6 else None


def _carrier(scene: Scene, joint: str) -> int:
    """Id of the heaviest body that moves with a joint and with no later one."""
    model = scene.model
    last = int(model.jnt_bodyid[scene.id("joint", joint)])
    moving = [last]
    for body in range(last + 1, model.nbody):
        if int(model.body_parentid[body]) in moving and model.body_jntnum[body] == 0:
            moving.append(body)
    return max(moving, key=lambda body: float(model.body_mass[body]))
