"""Make any number of an MJCF a parameter.

    space = Space((
        joint_damping(scene, "elbow", mean=1.0, std=0.5, high=20.0),
        body_mass(scene, "forearm", std=0.3, high=3.0),
        model_parameter(scene, "pair_friction", "left_near", 0, name="grip", unit="-", std=0.2, high=4),
    ))

Every function resolves names to ids once.  For an unknown name it raises ValueError and lists the valid ones.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from droid_jax.model.actuators import drives_joint, has_servo_damping
from droid_jax.model.inertia import PSEUDO_INERTIA, check_single_inertia, nominal_field
from droid_jax.model.parameters import Mode, Parameter, Role, Scaling, Space, Write
from droid_jax.model.scene import TINY_FRICTIONLOSS, Scene

_KIND = {
    "dof": "joint",
    "jnt": "joint",
    "body": "body",
    "geom": "geom",
    "pair": "pair",
    "actuator": "actuator",
}
# field of a limit -> field that says whether the limit is active, which is fixed at compilation
_LIMITED = {
    "actuator_forcerange": "actuator_forcelimited",
    "actuator_ctrlrange": "actuator_ctrllimited",
    "jnt_range": "jnt_limited",
    "jnt_actfrcrange": "jnt_actfrclimited",
}
_POSITION_GAIN = (("actuator_gainprm", 0), ("actuator_biasprm", 1))  # a position servo's, with opposite signs
ENCODER = "encoder_offset"
_SERVO, _VELOCITY_GAIN = ("actuator_gainprm", "actuator_biasprm"), 2  # fields, and the column of the velocity gain


def element_index(scene: Scene, field: str, element: str) -> int:
    """First index into a model field, e.g. ("dof_damping", "hinge") -> the hinge's dof address."""
    kind = _KIND.get(field.split("_")[0])
    if kind is None or not hasattr(scene.model, field):
        written = [f for f in dir(scene.model) if f.split("_")[0] in _KIND]
        close = difflib.get_close_matches(field, written, n=1, cutoff=0.8)
        meant = f", did you mean {close[0]!r}?" if close else ""
        raise ValueError(
            f"{field!r} is not a model field that a parameter can write{meant}; "
            f"fields start with {', '.join(f'{k}_' for k in _KIND)} and are arrays of mujoco.MjModel"
        )
    return scene.dof(element) if field.startswith("dof_") else scene.id(kind, element)


def element_name(model: mujoco.MjModel, field: str, index: Sequence[int]) -> str:
    """Name of the element to which an entry of a model field belongs; "" if it has none.

    An actuator without a name has its joint's.
    """
    if field in ("qpos0", "qpos_spring"):
        return model.joint(int(np.searchsorted(model.jnt_qposadr, index[0], side="right")) - 1).name
    kind = field.split("_")[0]
    if kind not in _KIND:
        return ""
    number = model.dof_jntid[index[0]] if kind == "dof" else index[0]
    name = getattr(model, _KIND[kind])(number).name
    if not name and kind == "actuator" and drives_joint(model)[number]:  # most servos have no name
        return model.joint(model.actuator_trnid[number, 0]).name
    return name


TURNS = 1  # MjModel.body_simple of a body that may rotate; 2 is a body that only slides, without coupling


def _refuse_uncoupled(scene: Scene, p: Parameter, write: Write) -> None:
    """Raise ValueError if C MuJoCo would ignore the inertial coupling that a displaced centre of mass or joint causes.

    If several joints of a body pass through its centre of mass along its axes, MuJoCo compiles an inertia without
    coupling.
    """
    model, (first, *_) = scene.model, write.index
    if write.field in ("body_ipos", "body_iquat", PSEUDO_INERTIA):
        body, coupled = first, model.body_simple[first] == TURNS
    elif write.field in ("jnt_pos", "jnt_axis"):
        body = int(model.jnt_bodyid[first])
        coupled = model.body_simple[body] != 0
    else:
        return
    if coupled and model.body_dofnum[body] > 1:
        name = model.body(body).name
        raise ValueError(
            f"parameter {p.name!r}: MuJoCo compiles body {name!r} without coupling between its "
            f"{model.body_dofnum[body]} degrees of freedom, since its inertial frame is its body frame; displace its "
            '<inertial> in the MJCF, such as by pos="0 0 1e-6"'
        )


def check_space(scene: Scene, space: Space) -> None:
    """Raise ValueError if a space writes entries that the scene's model lacks, or that belong to another element."""
    check_single_inertia(space)
    for p in space.parameters:
        for w in p.writes:
            known = w.field == PSEUDO_INERTIA or hasattr(scene.model, w.field)
            array = nominal_field(scene.model, w.field) if known else None
            if not isinstance(array, np.ndarray):
                raise ValueError(
                    f"parameter {p.name!r} writes {w.field}, which the model of {scene.name!r} does not have"
                )
            if len(w.index) != array.ndim or any(i >= n for i, n in zip(w.index, array.shape, strict=True)):
                raise ValueError(
                    f"parameter {p.name!r} writes {w.field}[{', '.join(map(str, w.index))}]"
                    f"{f' of {w.element!r}' if w.element else ''}, but in {scene.name!r} that field has shape "
                    f"{array.shape}: it belongs to another scene"
                )
            element = element_name(scene.model, w.field, w.index)
            if w.element and w.element != element:
                raise ValueError(
                    f"parameter {p.name!r} writes {w.field} of {w.element!r}, but in {scene.name!r} that entry is of "
                    f"{element or 'an element without a name'!r}: it belongs to another scene"
                )
            _refuse_uncoupled(scene, p, w)


def write(
    scene: Scene, field: str, index: tuple[int, ...], mode: Mode = Mode.SET, *, gain: float = 1.0, offset: float = 0.0
) -> Write:
    """A `Write` with the name of its element.

    Raises ValueError for the pose of a mocap body, which a replay does not read from the model.
    """
    if field in ("body_pos", "body_quat") and scene.model.body_mocapid[index[0]] >= 0:
        name = element_name(scene.model, field, index)
        raise ValueError(f"body {name!r} is a mocap body, whose pose cannot be a parameter: remove mocap from the MJCF")
    return Write(field, index, mode, gain, offset, element_name(scene.model, field, index))


def model_parameter(
    scene: Scene,
    field: str,
    element: str,
    column: int | None = None,
    *,
    name: str | None = None,
    unit: str,
    std: float,
    mean: float | None = None,
    low: float = 0.0,
    high: float,
    mode: Mode = Mode.SET,
    **options: Any,
) -> Parameter:
    """A parameter that is one number of a model field.

    Args:
        scene: with the element.
        field: of MjModel, such as "dof_damping" or "geom_size".
        element: name of the joint, body, geom, pair or actuator.
        column: of the field, if it has several numbers for each element.
        name: of the parameter; None: made of element and field.
        unit: of the number.
        std: prior deviation.
        mean: prior mean; None: the value that leaves the model's number unchanged.
        low, high: bounds.
        mode: how the value enters the field.
        options: further fields of `Parameter` (nuisance, group, scaling, log_offset, width).

    Returns:
        The parameter.

    Raises:
        ValueError: the field, element or column does not exist, or a change of the number has no effect in a replay.
    """
    from droid_jax.model.physics import check_field  # only here: it imports jax, which may have to be tuned first

    if field == "dof_frictionloss":
        _check_frictionloss(scene, element)
    first = element_index(scene, field, element)
    check_field(scene, field)
    columns = _column(scene, field, column)
    index = (first, *columns)
    _check_limited(scene, field, element, first)
    if field in _SERVO and column == _VELOCITY_GAIN:
        _check_servo_damping(scene, element)
    if (field, column) in _POSITION_GAIN:
        _check_whole_servo(scene, element, first)
    first_write = write(scene, field, index, mode)
    if mean is None:
        mean = float(first_write.neutral(np.asarray(getattr(scene.model, field))[index]))
    return Parameter(
        name or f"{element}_{field.split('_', 1)[1]}",
        unit,
        float(mean),
        std,
        low,
        high,
        writes=(
            first_write,
            *(replace(first_write, index=(row, *columns)) for row in _further_dofs(scene, field, first)),
        ),
        **options,
    )


def _column(scene: Scene, field: str, column: int | None) -> tuple[int, ...]:
    """The index after the element's: empty, or the column; ValueError lists the columns."""
    width = np.asarray(getattr(scene.model, field)).shape[1:]
    if not width:
        if column is not None:
            raise ValueError(f'{field} has one number for each {_KIND[field.split("_")[0]]}: leave "column" out')
        return ()
    if isinstance(column, bool) or not isinstance(column, (int, np.integer)) or not 0 <= column < width[0]:
        got = "" if column is None else f", got {column!r}"
        raise ValueError(
            f"{field} has {width[0]} numbers for each {_KIND[field.split('_')[0]]}: "
            f'give "column", 0 to {width[0] - 1}{got}'
        )
    return (int(column),)


def _further_dofs(scene: Scene, field: str, first: int) -> range:
    """The other rows of a ball or free joint, whose degrees of freedom share one number in an MJCF."""
    if not field.startswith("dof_"):
        return range(0)
    return range(first + 1, first + int(np.sum(scene.model.dof_jntid == scene.model.dof_jntid[first])))


def _check_limited(scene: Scene, field: str, element: str, index: int) -> None:
    """Raise ValueError for a limit that is not active in the compiled model."""
    flag = _LIMITED.get(field)
    if flag and not getattr(scene.model, flag)[index]:
        raise ValueError(
            f"{element!r} was compiled without the limit {field}, which a replay cannot activate; give it one in the "
            "MJCF"
        )


def _check_servo_damping(scene: Scene, actuator: str) -> None:
    if not has_servo_damping(scene.model):
        raise ValueError(
            f"no actuator of scene {scene.name!r} was compiled with a velocity gain, and a replay is made without; "
            f'give actuator {actuator!r} one in the MJCF (kv="1e-6")'
        )


def _check_whole_servo(scene: Scene, actuator: str, index: int) -> None:
    gain, bias = scene.model.actuator_gainprm[index, 0], scene.model.actuator_biasprm[index, 1]
    if gain and bias == -gain:
        raise ValueError(
            f"actuator {actuator!r} is a position servo, whose gain is in gainprm and in biasprm: a change of one "
            'would pull it towards zero; vary both with servo_scale(scene, joint) ({"servo": joint, "std": 0.03})'
        )


def _check_frictionloss(scene: Scene, joint: str) -> None:
    if scene.model.dof_frictionloss[scene.dof(joint)] < TINY_FRICTIONLOSS:
        raise ValueError(
            f"joint {joint!r} was compiled with friction loss 0, which MJX cannot change; "
            f"give it {TINY_FRICTIONLOSS:g} in the MJCF or name it in load_scene(friction_joints=...)"
        )


def shared(parameters: Sequence[Parameter], name: str | None = None) -> Parameter:
    """One parameter with the writes of several, such as one armature of all servos of a type.

    Args:
        parameters: that differ in their writes only, such as `model_parameter` of each joint.
        name: of the shared one; None joins the names with "+".

    Returns:
        The first parameter with the writes of all.

    Raises:
        ValueError: the list is empty, a parameter writes no field of the model, or their means differ.
    """
    if not parameters:
        raise ValueError("a shared parameter needs at least one parameter")
    first = parameters[0]
    if absent := [p.name for p in parameters if not p.writes]:
        raise ValueError(f"parameters {', '.join(absent)} write no field of the model, so they cannot be shared")
    if other := [p for p in parameters if not np.isclose(p.mean, first.mean, rtol=1e-9, atol=0.0)]:
        raise ValueError(
            f"{first.name} is {first.mean:g} in the model and {other[0].name} is {other[0].mean:g}: state a common "
            'mean, or scale the number of each ("mode": "scale", as Mode.SCALE)'
        )
    joined = "+".join(dict.fromkeys(p.name for p in parameters)) if name is None else name
    return replace(first, name=joined, writes=tuple(w for p in parameters for w in p.writes))


def joint_damping(scene: Scene, joint: str, *, std: float, high: float, **options: Any) -> Parameter:
    """Viscous damping of a joint, N m s/rad; log-scaled by default."""
    options = {"unit": "N m s/rad", "scaling": Scaling.LOG, "log_offset": 0.05, **options}
    return model_parameter(scene, "dof_damping", joint, std=std, high=high, **options)


def joint_stiffness(scene: Scene, joint: str, *, std: float, high: float, **options: Any) -> Parameter:
    """Spring stiffness of a joint about its `springref`, N m/rad; log-scaled by default."""
    options = {"unit": "N m/rad", "scaling": Scaling.LOG, "log_offset": 0.05, **options}
    return model_parameter(scene, "jnt_stiffness", joint, std=std, high=high, **options)


def joint_frictionloss(scene: Scene, joint: str, *, std: float, high: float, **options: Any) -> Parameter:
    """Dry friction of a joint, N m; log-scaled by default.

    Raises ValueError if the model was compiled with friction loss 0: MJX lays constraint rows out at compilation, so
    the joint has none (see `load_scene(friction_joints=...)`).
    """
    options = {"unit": "N m", "scaling": Scaling.LOG, "log_offset": 0.05, **options}
    return model_parameter(scene, "dof_frictionloss", joint, std=std, high=high, **options)


def body_mass(
    scene: Scene,
    body: str,
    *,
    std: float,
    mean: float | None = None,
    low: float = 0.01,
    high: float,
    **options: Any,
) -> Parameter:
    """Mass of a body, kg; its inertia scales with it, as for a body of uniform density.

    The search coordinate is logarithmic above the initial mean and linear below.  The effect of a mass is linear in it.
    In a plain logarithm the gradient would vanish near zero.
    """
    index = scene.id("body", body)
    nominal = float(scene.model.body_mass[index])
    if nominal <= 0:
        raise ValueError(f"body {body!r} has no mass in this scene")
    mean = nominal if mean is None else mean
    options = {"name": f"{body}_mass", "unit": "kg", "scaling": Scaling.LOG, "log_offset": mean, **options}
    writes = (write(scene, "body_mass", (index,)), *_inertia(scene, index, Mode.SCALE, 1.0 / nominal))
    return Parameter(mean=mean, std=std, low=low, high=high, writes=writes, **options)


def body_mass_scale(scene: Scene, body: str, *, std: float = 0.03, **options: Any) -> Parameter:
    """Factor on a body's mass and inertia, 1 at nominal.

    The robot's controller still compensates the gravity of the nominal mass (gravcomp is divided by the factor).  So a
    factor other than one causes a gravity torque.
    """
    index = scene.id("body", body)
    writes = (write(scene, "body_mass", (index,), Mode.SCALE), *_inertia(scene, index, Mode.SCALE, 1.0))
    if scene.model.body_gravcomp[index] != 0:
        writes += (write(scene, "body_gravcomp", (index,), Mode.DIVIDE),)
    options = {"name": f"{body}_mass_scale", "unit": "-", "mean": 1.0, "low": 0.5, "high": 1.5, **options}
    return Parameter(std=std, writes=writes, **options)


def servo_scale(scene: Scene, joint: str, *, std: float = 0.03, **options: Any) -> Parameter:
    """Factor on the position gain of a joint's servo, or on the gain of a velocity servo; 1 at nominal."""
    if joint not in scene.driven_joints:
        raise ValueError(f"no actuator drives {joint!r}; driven joints: {', '.join(scene.driven_joints)}")
    actuator = scene.command_names.index(joint)
    bias = scene.model.actuator_biasprm[actuator]
    feedback = 2 if bias[1] == 0 and bias[2] == -scene.model.actuator_gainprm[actuator, 0] else 1
    writes = (
        write(scene, "actuator_gainprm", (actuator, 0), Mode.SCALE),
        write(scene, "actuator_biasprm", (actuator, feedback), Mode.SCALE),
    )
    options = {"name": f"{joint}_servo_scale", "unit": "-", "mean": 1.0, "low": 0.5, "high": 1.5, **options}
    return Parameter(std=std, writes=writes, **options)


def joint_encoder_offset(scene: Scene, joint: str, *, std: float, high: float, **options: Any) -> Parameter:
    """Joint position minus encoder reading, rad (m for slides); 0 at nominal (`model.encoders`).

    The joint's positions in the model are encoder readings, so reference, spring and range decrease by the offset.
    """
    row, address = scene.id("joint", joint), scene.qpos(joint)
    entries = [("qpos0", (address,)), ("qpos_spring", (address,))]
    entries += [("jnt_range", (row, k)) for k in (0, 1) if scene.model.jnt_limited[row]]
    writes = tuple(write(scene, field, index, Mode.ADD, gain=-1.0) for field, index in entries)
    options = {"name": f"{ENCODER}[{joint}]", "unit": scene.position_unit([joint]), "mean": 0.0, "low": -high,
               "group": "Sensors", **options}  # fmt: skip
    return Parameter(std=std, high=high, writes=writes, **options)


def body_position(scene: Scene, body: str, axis: int, *, std: float, limit: float, **options: Any) -> Parameter:
    """Displacement of a body in its parent along axis 0, 1 or 2, m; 0 at nominal."""
    index = scene.id("body", body)
    options = {
        "name": f"{body}_{'xyz'[axis]}",
        "unit": "m",
        "mean": 0.0,
        "low": -limit,
        "high": limit,
        **options,
    }
    return Parameter(std=std, writes=(write(scene, "body_pos", (index, axis), Mode.ADD),), **options)


def body_yaw(scene: Scene, body: str, *, std: float, limit: float, **options: Any) -> Parameter:
    """Small rotation of a body about its z axis, rad; 0 at nominal.

    It is written as the quaternion (1, 0, 0, yaw / 2), which is normalised when it is applied.  The error is of third
    order in the angle.  Raises ValueError if the body is rotated in its parent.
    """
    index = scene.id("body", body)
    if not np.allclose(scene.model.body_quat[index], [1, 0, 0, 0]):
        raise ValueError(f"body {body!r} is rotated in its parent; its yaw cannot be a parameter")
    options = {"name": f"{body}_yaw", "unit": "rad", "mean": 0.0, "low": -limit, "high": limit, **options}
    return Parameter(std=std, writes=(write(scene, "body_quat", (index, 3), Mode.SET, gain=0.5),), **options)


def capsule_radius(scene: Scene, geom: str, *, std: float, limit: float, **options: Any) -> Parameter:
    """Change of a capsule's radius, m; 0 at nominal. Mass and inertia are unchanged."""
    index = scene.id("geom", geom)
    fields = [("geom_size", (index, 0)), ("geom_rbound", (index,))]
    fields += [("geom_aabb", (index, k)) for k in (3, 4, 5)]
    writes = tuple(write(scene, f, i, Mode.ADD) for f, i in fields)
    options = {"name": f"{geom}_radius", "unit": "m", "mean": 0.0, "low": -limit, "high": limit, **options}
    return Parameter(std=std, writes=writes, **options)


def pair_friction(
    scene: Scene, pairs: Sequence[str], columns: Sequence[int], *, std: float, **options: Any
) -> Parameter:
    """Friction of explicit contact pairs, whose pair_friction replaces geom_friction.

    columns: 0 and 1 sliding (-), 2 torsional (m).  The lower bound is 0.05 by default: below it a pyramidal cone is too
    steep for float32 (its rows scale with the friction squared).
    """
    ids = [scene.id("pair", p) for p in pairs]
    writes = tuple(write(scene, "pair_friction", (i, c)) for i in ids for c in columns)
    nominal = float(scene.model.pair_friction[ids[0], columns[0]])
    options = {"mean": nominal, "low": 0.05, "high": 6.0, "scaling": Scaling.LOG, **options}
    return Parameter(std=std, writes=writes, **options)


def _inertia(scene: Scene, body: int, mode: Mode, gain: float) -> tuple[Write, ...]:
    return tuple(write(scene, "body_inertia", (body, k), mode, gain=gain) for k in range(3))


def time_offset(std: float = 0.001, limit: float = 0.05) -> Parameter:
    """Delay of the command relative to the measurement's clock, s; the replay reads it from theta."""
    return Parameter(Role.TIME_OFFSET.value, "s", 0.0, std, -limit, limit, nuisance=True, group="Nuisance")
