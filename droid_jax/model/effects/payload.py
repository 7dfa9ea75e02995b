"""A tool or load that the arm's controller does not know of."""

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
POSES, FELT = 20, 1e-3  # poses at which it is looked at whether a moment weighs, m/s^2 that count
LOAD, MOMENTS = "load_mass", tuple(f"load_moment_{axis}" for axis in "xyz")


@register
def payload(scene: Scene) -> Effect | None:
    """m more kilograms at the centre of mass of the heaviest body behind the arm's last joint, and where they hang.

    The gravity of the nominal mass goes on being compensated, that of the payload is not.  A load whose own centre lies
    by r further out, on the line from the last joint to the body's centre, weighs with a moment m r more (kg m).  That
    moment's inertia is left out: of a hand that turns by 1 rad/s^2 it is a tenth of what it weighs.
    """
    if (carried := _carried(scene)) is None:
        return None
    last, body = carried
    more = _more_mass(scene, body, MASS, Role.PAYLOAD_MASS)
    weighs = _weighs(scene, last, body)
    parameters = (more,) if weighs is None else (more, a.coefficient(MOMENT, "kg m", 0.02, 0.3))
    return Effect(
        "payload",
        parameters,
        force=weighs,
        description="a tool or load that the arm's controller does not know of",
        signature="free motion: all joints in proportion to their lever",
        confused_with=("torque_bias", "cable_pull"),
        locations={last: tuple(p.name for p in parameters)},
        minimum_size=0.02,
        native=lambda values, model: None if values.get(MOMENT) else {},  # a mass alone is written as such
    )


@register
def free_payload(scene: Scene) -> Effect | None:
    """The same with its own centre anywhere: m r has three coordinates in the body's frame, from the body's centre.

    Of these, those that some pose turns into a torque of a measured joint.
    """
    if (carried := _carried(scene)) is None:
        return None
    last, body = carried
    felt = _felt(scene, body)
    names = tuple(name for name, of in zip(MOMENTS, felt, strict=True) if of)
    along = jnp.asarray(np.eye(3)[felt], jnp.float32)
    force = _hangs(scene, body, lambda theta: jnp.stack([a.value(theta, name) for name in names]) @ along)
    if force is None or len(names) < 2:
        return None
    return Effect(
        "free_payload",
        (_more_mass(scene, body, LOAD), *(a.coefficient(name, "kg m", 0.02, 0.3) for name in names)),
        force=force,
        description="a tool or load with a centre off the hand's own line, that the controller does not know of",
        signature="free motion: all joints, in proportion to levers that turn with the hand",
        confused_with=("payload", "gravity_direction", "torque_bias", "cable_pull"),
        special_cases=("payload",),
        locations={last: (LOAD, *names)},
        minimum_size=0.02,
        native=lambda values, model: None if any(values.get(name) for name in names) else {},
    )


def _carried(scene: Scene) -> tuple[str, int] | None:
    """The arm's last joint and the body that a load hangs on; None where there is none with a mass."""
    joints = a.arm(scene)
    if not joints:
        return None
    last = max(joints, key=lambda joint: scene.id("joint", joint))  # in the chain, whatever order the channels have
    body = _carrier(scene, last)
    return (last, body) if scene.model.body_mass[body] > 0 else None


def _felt(scene: Scene, body: int) -> np.ndarray:
    """[3] bool, axes of a body's frame along which a moment weighs on a measured joint of the arm in some pose."""
    model, data = scene.model, mujoco.MjData(scene.model)
    rng, turning, most = np.random.default_rng(0), np.zeros((3, model.nv)), np.zeros(3)
    for _ in range(POSES):
        mujoco.mj_integratePos(model, data.qpos, rng.uniform(-1.0, 1.0, model.nv), 1.0)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_jacBody(model, data, None, turning, body)
        torques = np.cross(data.xmat[body].reshape(3, 3).T, model.opt.gravity) @ turning[:, a.arm_dofs(scene)]
        most = np.maximum(most, np.abs(torques).max(axis=1))
    return most > FELT


def _more_mass(scene: Scene, body: int, name: str, role: Role = Role.OTHER) -> Parameter:
    """Kilograms at a body's centre of mass, which nobody compensates.

    Of a body that is compensated, mass and compensation go by one share of the model's mass, so that the compensated
    weight stays: beside a fitted mass they are kilograms of the model's.
    """
    mass = float(scene.model.body_mass[body])
    share = dict(gain=1.0 / mass, offset=1.0)
    writes = [write(scene, "body_mass", (body,), Mode.ADD)]
    if scene.model.body_gravcomp[body] != 0:
        writes = [write(scene, "body_mass", (body,), Mode.SCALE, **share)]
        writes.append(write(scene, "body_gravcomp", (body,), Mode.DIVIDE, **share))
    of_it: dict[str, Any] = dict(group=a.GROUP, role=role)
    return Parameter(name, "kg", 0.0, 0.2, -0.9 * min(mass, 1.0), 2.0, writes=tuple(writes), **of_it)


def _weighs(scene: Scene, joint: str, body: int) -> Callable[[Theta, State], jax.Array] | None:
    """What the moment of a load weighs on the joints; None where no line leads outwards, or the body flies."""
    outwards = _outwards(scene, joint, body)
    if outwards is None:
        return None
    along = jnp.asarray(outwards, jnp.float32)
    return _hangs(scene, body, lambda theta: a.value(theta, MOMENT) * along)


def _hangs(scene: Scene, body: int, moment: Callable[[Theta], jax.Array]) -> Callable[[Theta, State], jax.Array] | None:
    """What a moment [3] kg m in a body's frame weighs on the joints; None where the body flies."""
    links = turned(scene, body)
    if links is None:
        return None
    gravity = jnp.asarray(scene.model.opt.gravity, jnp.float32)

    def force(theta: Theta, state: State) -> jax.Array:
        axes, rotation = links(state.qpos)
        return axes @ jnp.cross(rotation @ moment(theta), gravity)

    return force


def _outwards(scene: Scene, joint: str, body: int) -> np.ndarray | None:
    """[3] unit vector in a body's frame, from a joint that carries it to its centre; None where both coincide."""
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    line = data.xmat[body].reshape(3, 3).T @ (data.xipos[body] - data.xanchor[scene.id("joint", joint)])
    length = float(np.linalg.norm(line))
    return line / length if length > 1e-6 else None


def _carrier(scene: Scene, joint: str) -> int:
    """Id of the heaviest body that moves with a joint and with no other one after it."""
    model = scene.model
    last = int(model.jnt_bodyid[scene.id("joint", joint)])
    moving = [last]
    for body in range(last + 1, model.nbody):
        if int(model.body_parentid[body]) in moving and model.body_jntnum[body] == 0:
            moving.append(body)
    return max(moving, key=lambda body: float(model.body_mass[body]))
