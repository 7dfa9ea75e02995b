"""Refuse features of a model that MJX silently ignores or does not support, by name and at loading.

Results would not show that a feature was ignored.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

# Fields of MjModel that MJX accepts and ignores (mujoco-mjx 3.17.0), and their descriptions.
IGNORED = (
    ("jnt_stiffnesspoly", "polynomial joint stiffness"),
    ("dof_dampingpoly", "polynomial joint damping"),
    ("tendon_stiffnesspoly", "polynomial tendon stiffness"),
    ("tendon_dampingpoly", "polynomial tendon damping"),
    ("actuator_delay", "actuator delay"),
    ("actuator_damping", "actuator damping"),
    ("actuator_dampingpoly", "polynomial actuator damping"),
    ("actuator_armature", "actuator armature"),
    ("sensor_delay", "sensor delay"),
    ("actuator_actearly", "early activation of actuators (actearly)"),
    ("geom_adhesion", "adhesion of geoms"),
    ("pair_adhesion", "adhesion of contact pairs"),
    ("geom_surfacevel", "surface velocity"),
)
# Actuators that MJX does not support: field and value that identify one, its element, and a replacement.
_PID = "without ki it is equivalent to <position> with its kp and kv"
_DCMOTOR = (
    "with motor constant K and resistance R it is equivalent, apart from its inductance, to a <motor> with gear K/R on "
    "a joint with K^2/R more damping"
)
_ACTUATORS = (
    ("actuator_gaintype", mujoco.mjtGain.mjGAIN_PID, "<pid>", _PID),
    ("actuator_dyntype", mujoco.mjtDyn.mjDYN_PID, "<pid>", _PID),
    ("actuator_gaintype", mujoco.mjtGain.mjGAIN_DCMOTOR, "<dcmotor>", _DCMOTOR),
    ("actuator_biastype", mujoco.mjtBias.mjBIAS_DCMOTOR, "<dcmotor>", _DCMOTOR),
    ("actuator_dyntype", mujoco.mjtDyn.mjDYN_DCMOTOR, "<dcmotor>", _DCMOTOR),
    ("actuator_gaintype", mujoco.mjtGain.mjGAIN_SO3, "servo of an orientation", "give each axis a servo"),
    ("actuator_trntype", mujoco.mjtTrn.mjTRN_SO3, "servo of an orientation", "give each axis a servo"),
    ("actuator_gaintype", mujoco.mjtGain.mjGAIN_USER, "actuator with a callback (user)", "write its law in the MJCF"),
    ("actuator_biastype", mujoco.mjtBias.mjBIAS_USER, "actuator with a callback (user)", "write its law in the MJCF"),
    ("actuator_dyntype", mujoco.mjtDyn.mjDYN_USER, "actuator with a callback (user)", "write its law in the MJCF"),
    ("actuator_trntype", mujoco.mjtTrn.mjTRN_SLIDERCRANK, "slider-crank", "drive the joint, or model the crank"),
    ("actuator_trntype", mujoco.mjtTrn.mjTRN_BODY, "<adhesion>", "remove it"),
)
# Constraints and flags that MJX does not support.
_EQUALITIES = {
    mujoco.mjtEq.mjEQ_DISTANCE: "distance equality",
    mujoco.mjtEq.mjEQ_FLEX: "flex equality",
    mujoco.mjtEq.mjEQ_FLEXVERT: "flex equality",
    mujoco.mjtEq.mjEQ_FLEXSTRAIN: "flex equality",
}
_FLAGS = {
    mujoco.mjtEnableBit.mjENBL_OVERRIDE: "override",
    mujoco.mjtEnableBit.mjENBL_ENERGY: "energy",
    mujoco.mjtEnableBit.mjENBL_FWDINV: "fwdinv",
    mujoco.mjtEnableBit.mjENBL_DIAGEXACT: "diagexact",
}
_CALLBACKS = ("passive", "control", "contactfilter", "act_dyn", "act_gain", "act_bias")
_HINT = "https://mujoco.readthedocs.io/en/stable/mjx.html#feature-parity lists what it supports"


def refuse_ignored(model: mujoco.MjModel, name: str, plugins: tuple[str, ...] = ()) -> None:
    """Raise ValueError listing all features of the model that MJX silently ignores.

    plugins: names of the model's plugins, if they are known.
    """
    _refuse_actuators(model, name, only_ignored=True)
    ignored = [description for field, description in IGNORED if _used(model, field)]
    if model.nplugin:
        ignored.insert(0, f"the plugin {', '.join(plugins)}" if plugins else f"{model.nplugin} plugins")
    if np.any(model.opt.disableactuator != 0):
        ignored.append("disabled actuator groups")
    if model.opt.noslip_iterations > 0:
        ignored.append("the noslip solver")
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        ignored.append("sleeping of bodies (the flag sleep)")
    if (model.opt.density > 0 or model.opt.viscosity > 0) and np.any(model.geom_fluid[:, :1]):
        ignored.append("the fluid model of ellipsoids (fluidshape)")
    if narrow := _narrow(model):
        ignored.append(f"the second of two limits that act at once ({', '.join(narrow)}: margin above half the range)")
    passive = (mujoco.mjtDisableBit.mjDSBL_SPRING, mujoco.mjtDisableBit.mjDSBL_DAMPER)
    if sum(bool(model.opt.disableflags & bit) for bit in passive) == 1:
        ignored.append("springs without dampers, or dampers without springs (a flag: MJX drops both, and gravcomp)")
    callbacks = [c for c in _CALLBACKS if getattr(mujoco, f"get_mjcb_{c}")() is not None]
    if callbacks:
        ignored.append(f"callbacks of this process ({', '.join(f'mjcb_{c}' for c in callbacks)})")
    if ignored:
        raise ValueError(
            f"scene {name!r} uses features that MJX accepts but ignores: {', '.join(ignored)}; "
            "remove them from the MJCF or add them as an effect"
        )


def refuse_missing(model: mujoco.MjModel, name: str) -> None:
    """Raise ValueError listing the features of the model that MJX does not support, with replacements."""
    _refuse_actuators(model, name)
    missing = [
        f"equality {model.equality(i).name or i!r} ({_EQUALITIES[kind]})"
        for i, kind in enumerate(map(mujoco.mjtEq, model.eq_type.tolist()))
        if kind in _EQUALITIES
    ]
    missing += ["deformable bodies (flex)"] if model.nflex else []
    missing += [f"the flag {flag}" for bit, flag in _FLAGS.items() if model.opt.enableflags & bit]
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        missing.append('the solver PGS (set <option solver="Newton">)')
    if missing:
        raise ValueError(
            f"scene {name!r} uses something that MJX does not support: {', '.join(missing)}; change it in the MJCF "
            f"({_HINT})"
        )


def _refuse_actuators(model: mujoco.MjModel, name: str, only_ignored: bool = False) -> None:
    """Raise ValueError for the first actuator of a type that MJX does not support.

    only_ignored: only for types with several inputs, or that MJX would treat as another type.
    """
    for field, kind, element, instead in _ACTUATORS:
        if only_ignored and element not in ("<pid>", "<dcmotor>", "servo of an orientation"):
            continue
        of_kind = np.flatnonzero(getattr(model, field) == kind)
        if of_kind.size:
            actuator = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, int(of_kind[0])) or int(of_kind[0])
            raise ValueError(
                f"actuator {actuator!r} of scene {name!r} is a {element}, which MJX does not support: {instead}; "
                "change it in the MJCF"
            )


def check_options(model: Any, parity: bool, what: str = "a replay") -> None:
    """Raise ValueError for an integrator, a friction cone or a fluid that a replay in MJX does not support.

    Args:
        model: MuJoCo's or MJX's.
        parity: whether the steps are those of mj_step, which support elliptic cones and fluids.
        what: subject of the message.
    """
    kinds = (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    if model.opt.integrator not in kinds:
        raise ValueError(
            f"{what} integrates with Euler or implicitfast; set <option integrator=...> to one of them (the replay's "
            "steps are of second order in the time step)"
        )
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and not parity:
        raise ValueError(
            f"{what} needs pyramidal friction cones; set <option cone='pyramidal'>: a contact's friction is then up to "
            "29 % smaller along the diagonals of its two friction axes; also remove a high impratio, which is for "
            "elliptic cones"
        )
    if not parity:
        refuse_fluid(model, what)


def refuse_fluid(model: Any, what: str) -> None:
    """Raise ValueError for a model with a fluid (density, viscosity or wind).

    Args:
        model: MuJoCo's, or MJX's, whose numbers may be traced.
        what: subject of the message.
    """
    if isinstance(model, mujoco.MjModel):
        fluid = model.opt.density > 0 or model.opt.viscosity > 0 or np.any(model.opt.wind)
    else:
        from droid_jax.model.mjx_internals import has_fluid  # imported here since it starts jax

        fluid = has_fluid(model)
    if fluid:
        raise ValueError(
            f"{what} has no air or water: remove density, viscosity and wind from <option>; the effect `drag` is for "
            "doors"
        )


def _narrow(model: mujoco.MjModel) -> list[str]:
    """Names of joints and tendons on which both limits can act at once; MJX has a row for the nearer one only."""
    single = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    names = []
    for kind, rows, limits, margin in (
        ("joint", single & (model.jnt_limited > 0), model.jnt_range, model.jnt_margin),
        ("tendon", model.tendon_limited > 0, model.tendon_range, model.tendon_margin),
    ):
        which = np.flatnonzero(rows & (2.0 * margin > np.diff(limits, axis=1)[:, 0]))
        names += [getattr(model, kind)(int(i)).name or f"{kind} {i}" for i in which]
    return names


def _used(model: mujoco.MjModel, field: str) -> bool:
    array = getattr(model, field, None)
    return array is not None and np.size(array) > 0 and bool(np.any(np.asarray(array) != 0))
