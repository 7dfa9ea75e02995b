"""What MJX leaves out of a model without a word, and what it has not at all: refused at loading, by name.

No result would show that something was left out, and a scene that cannot be replayed shall not be found out late.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

# C MuJoCo's model arrays that MJX accepts in a file and then leaves out (mujoco-mjx 3.17.0):
# field, and what it is.
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
# Actuators that MJX has not: the enumerations that give one away, its element, and what does the same.
_PID = "without ki it does what <position> with its kp and kv does"
_DCMOTOR = (
    "with motor constant K and resistance R it does, but for its inductance, what a <motor> with gear K/R does on a "
    "joint with K^2/R more damping"
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
    ("actuator_trntype", mujoco.mjtTrn.mjTRN_BODY, "<adhesion>", "take it out"),
)
# Constraints and flags that MJX has not.
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
_HINT = "https://mujoco.readthedocs.io/en/stable/mjx.html#feature-parity lists what there is"


def refuse_ignored(model: mujoco.MjModel, name: str, plugins: tuple[str, ...] = ()) -> None:
    """Raise ValueError listing every feature of the model that MJX would silently leave out.

    plugins: names of the model's plugins, as far as they are known.
    """
    _refuse_actuators(model, name, only_ignored=True)
    found = [what for field, what in IGNORED if _used(model, field)]
    if model.nplugin:
        found.insert(0, f"the plugin {', '.join(plugins)}" if plugins else f"{model.nplugin} plugins")
    if np.any(model.opt.disableactuator != 0):
        found.append("disabled actuator groups")
    if model.opt.noslip_iterations > 0:
        found.append("the noslip solver")
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        found.append("sleeping of bodies (the flag sleep)")
    if (model.opt.density > 0 or model.opt.viscosity > 0) and np.any(model.geom_fluid[:, :1]):
        found.append("the fluid model of ellipsoids (fluidshape)")
    if narrow := _narrow(model):
        found.append(f"the second of two limits that act at once ({', '.join(narrow)}: margin above half the range)")
    passive = (mujoco.mjtDisableBit.mjDSBL_SPRING, mujoco.mjtDisableBit.mjDSBL_DAMPER)
    if sum(bool(model.opt.disableflags & bit) for bit in passive) == 1:
        found.append("springs without dampers, or the other way round (a flag: MJX then drops both, and gravcomp)")
    called = [c for c in _CALLBACKS if getattr(mujoco, f"get_mjcb_{c}")() is not None]
    if called:
        found.append(f"callbacks of this process ({', '.join(f'mjcb_{c}' for c in called)})")
    if found:
        raise ValueError(
            f"scene {name!r} uses features that MJX accepts and then ignores: {', '.join(found)}; "
            "remove them from the MJCF or add the effect through the program's own library"
        )


def refuse_missing(model: mujoco.MjModel, name: str) -> None:
    """Raise ValueError for a part of the model that MJX has not, named by its element, with what does the same."""
    _refuse_actuators(model, name)
    found = [
        f"equality {model.equality(i).name or i!r} ({_EQUALITIES[kind]})"
        for i, kind in enumerate(map(mujoco.mjtEq, model.eq_type.tolist()))
        if kind in _EQUALITIES
    ]
    found += ["deformable bodies (flex)"] if model.nflex else []
    found += [f"the flag {flag}" for bit, flag in _FLAGS.items() if model.opt.enableflags & bit]
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        found.append('the solver PGS (set <option solver="Newton">)')
    if found:
        raise ValueError(
            f"scene {name!r} uses something that MJX has not: {', '.join(found)}; change it in the MJCF ({_HINT})"
        )


def _refuse_actuators(model: mujoco.MjModel, name: str, only_ignored: bool = False) -> None:
    """ValueError for the first actuator of a kind that MJX has not.

    only_ignored: of several inputs, or of those that MJX would take for something else, alone.
    """
    for field, kind, element, instead in _ACTUATORS:
        if only_ignored and element not in ("<pid>", "<dcmotor>", "servo of an orientation"):
            continue
        found = np.flatnonzero(getattr(model, field) == kind)
        if found.size:
            called = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, int(found[0])) or int(found[0])
            raise ValueError(
                f"actuator {called!r} of scene {name!r} is a {element}, which MJX has not: {instead}; change it in "
                "the MJCF"
            )


def check_options(model: Any, parity: bool, what: str = "a replay") -> None:
    """Raise ValueError for an integrator, a friction cone or a fluid that a replay in MJX has not.

    model: MuJoCo's or MJX's.  parity: of mj_step's own steps, which know elliptic cones and fluids.  what: asks for it.
    """
    kinds = (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    if model.opt.integrator not in kinds:
        raise ValueError(
            f"{what} integrates with Euler or implicitfast; set <option integrator=...> to one of them (its own steps "
            "are of second order in the time step)"
        )
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and not parity:
        raise ValueError(
            f"{what} needs pyramidal friction cones; set <option cone='pyramidal'>: a contact then holds up to 29 % "
            "less along the diagonals of its two friction axes, and a high impratio, which is for elliptic cones, "
            "should go too"
        )
    if not parity:
        refuse_fluid(model, what)


def refuse_fluid(model: Any, what: str) -> None:
    """Raise ValueError where bodies move through air or water.

    model: MuJoCo's, or MJX's, in which the numbers may be traced.
    """
    if isinstance(model, mujoco.MjModel):
        fluid = model.opt.density > 0 or model.opt.viscosity > 0 or np.any(model.opt.wind)
    else:
        from droid_jax.model.mjx_internals import has_fluid  # only here: it starts jax

        fluid = has_fluid(model)
    if fluid:
        raise ValueError(
            f"{what} has no air or water: take density, viscosity and wind out of <option>; the effect `drag` is for "
            "doors"
        )


def _narrow(model: mujoco.MjModel) -> list[str]:
    """Names of joints and tendons that both of their limits can push at once: MJX has a row for the nearer one only."""
    single = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    found = []
    for kind, rows, limits, margin in (
        ("joint", single & (model.jnt_limited > 0), model.jnt_range, model.jnt_margin),
        ("tendon", model.tendon_limited > 0, model.tendon_range, model.tendon_margin),
    ):
        which = np.flatnonzero(rows & (2.0 * margin > np.diff(limits, axis=1)[:, 0]))
        found += [getattr(model, kind)(int(i)).name or f"{kind} {i}" for i in which]
    return found


def _used(model: mujoco.MjModel, field: str) -> bool:
    array = getattr(model, field, None)
    return array is not None and np.size(array) > 0 and bool(np.any(np.asarray(array) != 0))
