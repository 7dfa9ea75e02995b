"""Gravity that pulls in another direction than in the model: a base that is not level, a door frame out of plumb."""

import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.gravity import field_force, lean, placed
from droid_jax.model.scene import Scene

NAME = "gravity_about"
LEAST_TORQUE = 1e-3  # N m/rad, an axis about which a tilt changes all joint torques by less is left out
POSES = 20  # at which this is tested
SINE, COSINE = "tilt_sine", "tilt_cosine"


@register
def gravity_direction(scene: Scene) -> Effect | None:
    """sum J^T m (R g - g) over the arm's bodies; R turns gravity g about two world axes perpendicular to it, rad.

    An object is not mounted on the base (see `tilted_frame`).  The gravity compensation, and the subtraction of gravity
    from recorded torques, still assume an upright base.
    """
    if not a.arm(scene):
        return None
    nominal = scene.nominal  # all recordings share the angles, also one with numbers of its own
    axes = [axis for axis in _horizontal(nominal) if _largest_torque(nominal, axis) > LEAST_TORQUE]
    if not axes:
        return None
    names = [f"{NAME}_{'xyz'[axis]}" for axis in axes]
    dofs = _arm_side(scene)

    def force(theta, state):
        gravity = state.model.opt.gravity
        turned = gravity
        for axis, name in zip(axes, names, strict=True):
            turned = lean(turned, axis, a.value(theta, name))
        pose = placed(state.model, state.qpos) if state.pose is None else state.pose
        pull = field_force(state.model, pose, state.model.body_mass, turned - gravity)
        return pull * dofs

    return Effect(
        "gravity_direction",
        tuple(a.coefficient(name, "rad", 0.01, 0.1) for name in names),
        force=force,
        description="a base that is not level, while the gravity compensation assumes that it is",
        signature="all joints that carry weight, smooth in their angles, the same at every speed",
        confused_with=("encoder_offset", "payload", "cable_pull", "torque_bias"),
        locations={"base": tuple(names)},
        minimum_size=2e-3,
    )


def _horizontal(scene: Scene) -> list[int]:
    """The two world axes along which gravity is smallest."""
    return sorted(np.argsort(np.abs(scene.model.opt.gravity), kind="stable")[:2].tolist())


def _arm_side(scene: Scene) -> np.ndarray:
    """[nv] 1 for degrees of freedom of the arm's kinematic trees without the object; 0 for others."""
    model = scene.model
    roots = {int(model.body_rootid[model.jnt_bodyid[scene.id("joint", j)]]) for j in a.arm(scene)}
    of_object = set[int]()
    if scene.object_joint is not None:
        of_object = {int(model.jnt_bodyid[scene.id("joint", scene.object_joint)])}
        for body in range(1, model.nbody):
            of_object |= {body} if int(model.body_parentid[body]) in of_object else set()
    bodies = model.dof_bodyid
    return np.array([model.body_rootid[b] in roots and b not in of_object for b in bodies], np.float32)


def _largest_torque(scene: Scene, axis: int) -> float:
    """N m/rad, largest torque at a measured joint of the arm for a tilt about a world axis."""
    model, data = scene.model.__copy__(), mujoco.MjData(scene.model)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        return 0.0
    model.opt.gravity = np.cross(np.eye(3)[axis], model.opt.gravity)
    rng, weight, most = np.random.default_rng(0), np.zeros(model.nv), 0.0
    for _ in range(POSES):
        mujoco.mj_integratePos(model, data.qpos, rng.uniform(-1.0, 1.0, model.nv), 1.0)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_rne(model, data, 0, weight)
        most = max(most, float(np.abs(weight[a.arm_dofs(scene)]).max()))
    return most


@register
def tilted_frame(scene: Scene) -> Effect | None:
    """-(A sin phi + B cos phi) on the hinge, N m: m g d sin(alpha) for tilts forward and sideways."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        phi = a.angle(scene, joint, state)
        return a.at_dof(scene, joint, -(a.value(theta, SINE) * jnp.sin(phi) + a.value(theta, COSINE) * jnp.cos(phi)))

    return Effect(
        "tilted_frame",
        (a.coefficient(SINE, "N m", 0.3, 3.0), a.coefficient(COSINE, "N m", 0.3, 3.0)),
        force=force,
        description="a frame out of plumb, so that gravity moves the door",
        signature="smooth over the angle, the same at every speed and in both directions",
        confused_with=("hinge_preload", "hardening_spring"),
        special_cases=("hinge_preload",),  # A = 0, over a small range of angles
        locations={joint: (SINE, COSINE)},
        minimum_size=0.05,
    )
