"""A base that is not level: gravity points elsewhere than the model and the controller's compensation assume."""

import mujoco
import numpy as np

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.gravity import field_force, lean, placed
from droid_jax.model.scene import Scene

NAME = "gravity_about"
FELT = 1e-3  # N m/rad: a lean that no measured joint of the arm feels more of is no candidate
POSES = 20  # at which that is looked at


@register
def gravity_direction(scene: Scene) -> Effect | None:
    """sum J^T m (R g - g), R by two angles about the world's axes that lie most across gravity g, rad.

    On the bodies that the arm carries; what an object hangs from is no part of the base (see `tilted_frame`).  The
    gravity compensation goes on assuming an upright base, and so does what takes the weight out of a torque.
    """
    if not a.arm(scene):
        return None
    axes = [axis for axis in _across(scene) if _felt(scene, axis) > FELT]
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
        description="a base that is not level, which the gravity compensation takes for upright",
        signature="all joints that carry weight, smooth in their angles, the same at every speed",
        confused_with=("encoder_offset", "payload", "cable_pull", "torque_bias"),
        locations={"base": tuple(names)},
        minimum_size=2e-3,
    )


def _across(scene: Scene) -> list[int]:
    """The two axes of the world along which gravity is least."""
    return sorted(np.argsort(np.abs(scene.model.opt.gravity), kind="stable")[:2].tolist())


def _arm_side(scene: Scene) -> np.ndarray:
    """[nv] 1 for degrees of freedom in the trees of the arm's joints, 0 from the object's joint on, and elsewhere."""
    model = scene.model
    roots = {int(model.body_rootid[model.jnt_bodyid[scene.id("joint", j)]]) for j in a.arm(scene)}
    behind = set[int]()
    if scene.object_joint is not None:
        behind = {int(model.jnt_bodyid[scene.id("joint", scene.object_joint)])}
        for body in range(1, model.nbody):
            behind |= {body} if int(model.body_parentid[body]) in behind else set()
    bodies = model.dof_bodyid
    return np.array([model.body_rootid[b] in roots and b not in behind for b in bodies], np.float32)


def _felt(scene: Scene, axis: int) -> float:
    """N m/rad, the most that a measured joint of the arm feels of a lean about an axis of the world."""
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
