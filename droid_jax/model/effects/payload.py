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


@register
def payload(scene: Scene) -> Effect | None:
    """m more kilograms at the centre of mass of the heaviest body behind the arm's last joint, and where they hang.

    The gravity of the nominal mass goes on being compensated, that of the payload is not.  A load whose own centre lies
    by r further out, on the line from the last joint to the body's centre, weighs with a moment m r more (kg m).  That
    moment's inertia is left out: of a hand that turns by 1 rad/s^2 it is a tenth of what it weighs.
    """
    joints = a.arm(scene)
    if not joints:
        return None
    last = max(joints, key=lambda joint: scene.id("joint", joint))  # in the chain, whatever order the channels have
    body = _carrier(scene, last)
    mass = float(scene.model.body_mass[body])
    if mass <= 0:
        return None
    share = dict(gain=1.0 / mass, offset=1.0)
    writes = [write(scene, "body_mass", (body,), Mode.SCALE, **share)]
    if scene.model.body_gravcomp[body] != 0:
        writes.append(write(scene, "body_gravcomp", (body,), Mode.DIVIDE, **share))
    of_it: dict[str, Any] = dict(group=a.GROUP, role=Role.PAYLOAD_MASS)
    more = Parameter(MASS, "kg", 0.0, 0.2, -0.9 * min(mass, 1.0), 2.0, writes=tuple(writes), **of_it)
    weighs = _weighs(scene, last, body)
    parameters = (more,) if weighs is None else (more, a.amplitude(MOMENT, "kg m", 0.02, 0.3))
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


def _weighs(scene: Scene, joint: str, body: int) -> Callable[[Theta, State], jax.Array] | None:
    """What the moment of a load weighs on the joints; None where no line leads outwards, or the body flies."""
    outwards, links = _outwards(scene, joint, body), turned(scene, body)
    if outwards is None or links is None:
        return None
    gravity, along = (jnp.asarray(v, jnp.float32) for v in (scene.model.opt.gravity, outwards))

    def force(theta: Theta, state: State) -> jax.Array:
        axes, rotation = links(state.qpos)
        return axes @ jnp.cross(a.value(theta, MOMENT) * (rotation @ along), gravity)

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
