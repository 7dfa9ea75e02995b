"""A scene: an MJCF compiled once, with its names turned into ids once.

`door_scene` composes the built-in scene (room + Panda + door) with MjSpec; `load_scene` takes a
user's own MJCF.  Replays use a model without the geoms of group 2, which are only for the eye.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

LOOK_GROUP = 2
TINY_FRICTIONLOSS = 1e-6  # N m: enough to give a joint its friction-loss row
_ONE_DEGREE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
ARM = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
HINGE = "hinge"
LEVERS = (0.30, 0.25, 0.20, 0.15)  # m, knob to hinge axis: four locations 5 cm apart (paper, IV-E)

# Table I of the paper, fitted means: what an added spring does to the hinge.
SPRINGS = {0: 0.01, 1: 1.06, 2: 1.24}  # N m/rad, by number of springs

# Joint damping carried by the simulated position servo, N m s/rad (see docs/paper.md).
IMPEDANCE_STIFFNESS = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)  # N m/rad
IMPEDANCE_DAMPING = (50.0, 50.0, 50.0, 50.0, 20.0, 15.0, 15.0)
PAPER_STIFFNESS = (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0)
PAPER_DAMPING = (100.0, 100.0, 100.0, 100.0, 100.0, 10.0, 0.4)  # Table I

# C MuJoCo's model arrays that MJX accepts in a file and then leaves out (mujoco-mjx 3.17.0):
# field, and what it is.
_IGNORED = (
    ("jnt_stiffnesspoly", "polynomial joint stiffness"),
    ("dof_dampingpoly", "polynomial joint damping"),
    ("tendon_stiffnesspoly", "polynomial tendon stiffness"),
    ("tendon_dampingpoly", "polynomial tendon damping"),
    ("actuator_delay", "actuator delay"),
    ("actuator_damping", "actuator damping"),
    ("actuator_dampingpoly", "polynomial actuator damping"),
    ("actuator_armature", "actuator armature"),
    ("sensor_delay", "sensor delay"),
    ("actuator_actearly", "early activation of actuators"),
    ("geom_adhesion", "adhesion of geoms"),
    ("pair_adhesion", "adhesion of contact pairs"),
    ("geom_surfacevel", "surface velocity"),
)


def mjcf_dir() -> Path:
    """Folder of the built-in MJCF files: inside the installed package, else beside it in a checkout.

    Raises FileNotFoundError when neither is there.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "mjcf", package.parent / "mjcf"):
        if (folder / "room.xml").is_file():
            return folder
    raise FileNotFoundError(f"the built-in MJCF files are neither in {package / 'mjcf'} nor beside the package")


@dataclass(frozen=True, eq=False)
class Grip:
    """What holds the object: the contact pairs of each finger.

    fingers: for each finger the names of its contact pairs; a finger touches when any of them does.
    """

    fingers: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene.

    name:   for messages and reports.
    spec:   the MjSpec, looks included; never changed after construction.
    model:  compiled without looks; what is replayed.
    joints: servo-driven joints whose torque and position are measured, in channel order [J].
    command_names: joints of the actuators, in actuator order [U].
    object_joint: joint of the thing that is moved (the door's hinge), or None.
    grip:   how a lost grasp is seen, or None where there is nothing to grip.
    """

    name: str
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    joints: tuple[str, ...]
    command_names: tuple[str, ...]
    object_joint: str | None = None
    grip: Grip | None = None

    def id(self, kind: str, name: str) -> int:
        """Id of a named thing; kind is "joint", "body", "geom", "pair", "actuator" or "site"."""
        return name_to_id(self.model, kind, name)

    def dof(self, joint: str) -> int:
        """Address of a (one-degree) joint in velocity vectors."""
        return int(self.model.jnt_dofadr[self.id("joint", joint)])

    def qpos(self, joint: str) -> int:
        """Address of a (one-degree) joint in position vectors."""
        return int(self.model.jnt_qposadr[self.id("joint", joint)])

    @functools.cached_property
    def joint_dofs(self) -> np.ndarray:
        """[J] velocity addresses of `joints`."""
        return np.array([self.dof(j) for j in self.joints], dtype=int)

    @functools.cached_property
    def joint_qpos(self) -> np.ndarray:
        """[J] position addresses of `joints`."""
        return np.array([self.qpos(j) for j in self.joints], dtype=int)

    @functools.cached_property
    def finger_pairs(self) -> tuple[np.ndarray, ...]:
        """For each finger, the ids of its contact pairs."""
        fingers = self.grip.fingers if self.grip else ()
        return tuple(np.array([self.id("pair", p) for p in pairs], dtype=int) for pairs in fingers)

    @functools.cached_property
    def mjx(self) -> Any:
        """The mjx.Model on the default device."""
        import jax
        from mujoco import mjx

        with jax.ensure_compile_time_eval():  # else a first use inside jit would keep that trace's values
            return mjx.put_model(self.model)

    def visual_model(self) -> mujoco.MjModel:
        """The same scene with its looks, for rendering."""
        with warnings.catch_warnings():  # see _attach
            warnings.simplefilter("ignore", UserWarning)
            return self.spec.compile()

    def initial_qpos(self, positions: dict[str, float] | Any) -> np.ndarray:
        """[nq] the model's reference pose with named joints set; unknown names raise."""
        qpos = self.model.qpos0.copy()
        for joint, value in positions.items():
            qpos[self.qpos(joint)] = value
        return qpos

    def command_index(self, names: Sequence[str]) -> np.ndarray:
        """[U] columns of `names` that feed this scene's actuators, in actuator order."""
        missing = [n for n in self.command_names if n not in names]
        if missing:
            raise ValueError(
                f"scene {self.name!r} needs a command for {', '.join(self.command_names)}; "
                f"missing: {', '.join(missing)}; given: {', '.join(names) or 'none'}"
            )
        return np.array([list(names).index(n) for n in self.command_names], dtype=int)


def name_to_id(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Id of a named joint, body, geom, pair, actuator or site; an unknown name lists the valid ones."""
    obj = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    found = mujoco.mj_name2id(model, obj, name)
    if found < 0:
        valid = [mujoco.mj_id2name(model, obj, i) for i in range(_count(model, kind))]
        listed = ", ".join(v for v in valid if v) or "none"
        raise ValueError(f"unknown {kind} {name!r}; this scene has: {listed}")
    return found


def _count(model: mujoco.MjModel, kind: str) -> int:
    return {
        "joint": model.njnt,
        "body": model.nbody,
        "geom": model.ngeom,
        "pair": model.npair,
        "actuator": model.nu,
        "site": model.nsite,
    }[kind]


def refuse_ignored(model: mujoco.MjModel, name: str) -> None:
    """Raise ValueError listing every feature of the model that MJX would silently leave out."""
    found = [what for field, what in _IGNORED if _used(model, field)]
    if np.any(model.opt.disableactuator != 0):
        found.append("disabled actuator groups")
    if model.opt.noslip_iterations > 0:
        found.append("the noslip solver")
    if found:
        raise ValueError(
            f"scene {name!r} uses features that MJX accepts and then ignores: {', '.join(found)}; "
            "remove them from the MJCF or add the effect through the program's own library"
        )


def _used(model: mujoco.MjModel, field: str) -> bool:
    array = getattr(model, field, None)
    return array is not None and np.size(array) > 0 and bool(np.any(np.asarray(array) != 0))


def compile_scene(
    spec: mujoco.MjSpec,
    name: str,
    *,
    joints: Sequence[str] | None = None,
    object_joint: str | None = None,
    grip: Grip | None = None,
    unlimited: Iterable[str] = (),
) -> Scene:
    """Compile a spec into a Scene and check it.

    joints: measured joints; default: every joint that a joint actuator drives.
    unlimited: joints whose range is not enforced in the replay.  Every limited joint costs a
      constraint row per step (a third of the time for the Panda), and a recording that keeps
      inside its ranges never feels them; the servo's command range still holds.
    Raises ValueError for unknown names, for joints of several degrees of freedom and for
    features that MJX would silently ignore.
    """
    bare = spec.copy()
    for geom in list(bare.geoms):
        if geom.group == LOOK_GROUP:
            bare.delete(geom)
    for joint in bare.joints:
        if joint.name in set(unlimited):
            joint.limited = False
    for joint in bare.joints:  # MJX lays friction-loss rows out at compilation: zero could never be raised
        if joint.name == object_joint and joint.type in _ONE_DEGREE and joint.frictionloss <= 0:
            joint.frictionloss = TINY_FRICTIONLOSS
    model = bare.compile()
    refuse_ignored(model, name)
    command_names = _actuated_joints(model)
    scene = Scene(
        name=name,
        spec=spec,
        model=model,
        joints=tuple(joints) if joints is not None else tuple(dict.fromkeys(command_names)),
        command_names=command_names,
        object_joint=object_joint,
        grip=grip,
    )
    for joint in (*scene.joints, *([object_joint] if object_joint else [])):
        kind = mujoco.mjtJoint(model.jnt_type[scene.id("joint", joint)])
        if kind not in _ONE_DEGREE:
            raise ValueError(f"joint {joint!r} of scene {name!r} must be a hinge or a slide")
    _ = scene.finger_pairs  # unknown pair names fail here, not in the first replay
    return scene


def _actuated_joints(model: mujoco.MjModel) -> tuple[str, ...]:
    """[U] the joint each actuator drives, in actuator order."""
    names = []
    for i in range(model.nu):
        if model.actuator_trntype[i] != mujoco.mjtTrn.mjTRN_JOINT:
            raise ValueError(
                f"actuator {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i)!r} does not drive a joint; "
                "a replay needs joint actuators"
            )
        names.append(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, int(model.actuator_trnid[i, 0])))
    return tuple(names)


def load_scene(
    path: str | Path,
    *,
    joints: Sequence[str] | None = None,
    object_joint: str | None = None,
    friction_joints: Sequence[str] = (),
) -> Scene:
    """A user's own MJCF as a Scene.

    friction_joints: joints whose friction loss will be a parameter though the file gives none.
    Raises FileNotFoundError or ValueError (the file does not compile, unknown names, ...).
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no MJCF file at {path}")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    named = {j.name: j for j in spec.joints}
    for joint in friction_joints:
        if joint not in named:
            raise ValueError(f"unknown joint {joint!r}; {path} has: {', '.join(sorted(named))}")
        named[joint].frictionloss = max(named[joint].frictionloss, TINY_FRICTIONLOSS)
    return compile_scene(spec, path.stem, joints=joints, object_joint=object_joint)


def _attach(spec: mujoco.MjSpec, file: Path, site: str) -> None:
    """Attach a file's model without a prefix: our three files share no names.

    MuJoCo warns of an empty prefix twice, through Python and on stderr with a log file; both are silenced.
    """
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            spec.attach(mujoco.MjSpec.from_file(str(file)), site=spec.site(site), prefix="")
    finally:
        mujoco.set_mju_user_warning(None)


def _set_gains(spec: mujoco.MjSpec, stiffness: Sequence[float], damping: Sequence[float]) -> None:
    for joint, kp, kd in zip(ARM, stiffness, damping, strict=True):
        actuator = spec.actuator(joint)
        actuator.gainprm[0], actuator.biasprm[1] = kp, -kp
        # The servo's damping is the joint's: position actuators here carry no velocity gain.
        spec.joint(joint).damping = [kd, 0, 0]


def _add_springs(spec: mujoco.MjSpec, count: int) -> None:
    """Springs as the paper mounted them: stiffness on the hinge, and coils to look at."""
    spec.joint(HINGE).stiffness = [SPRINGS[count], 0, 0]
    door = spec.body("door")
    for i in range(count):
        z = 0.05 - 0.10 * i
        for k in range(8):
            y = -0.03 - 0.012 * k
            door.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[-0.006, y, z - 0.008, -0.006, y - 0.012, z + 0.008],
                size=[0.0022, 0, 0],
                rgba=[0.75, 0.2, 0.15, 1],
                group=LOOK_GROUP,
                contype=0,
                conaffinity=0,
                mass=0,
            )


def _add_grip(spec: mujoco.MjSpec) -> Grip:
    """Explicit contact pairs, two rails a finger; condim 4 so that torsional friction counts.

    The pads' force sets in softly over half a millimetre of indentation, as rubber's does.  With
    MuJoCo's default the full force is there at the first touch, so the replay jumps whenever a touch
    moves to the next time step: the cost then has cliffs 20 log-likelihood units high all around
    the best fit, which no search survives.
    """
    fingers = []
    for side in ("left", "right"):
        pairs = tuple(f"{side}_{rail}" for rail in ("near", "far"))
        for pair, rail in zip(pairs, ("near", "far"), strict=True):
            spec.add_pair(
                name=pair,
                geomname1=f"{side}_rail_{rail}",
                geomname2="knob",
                condim=4,
                friction=[0.5, 0.5, 0.5, 1e-4, 1e-4],  # Table I: sliding 0.5, torsional 0.5
                solref=[0.02, 1.0],
                solimp=[0.01, 0.99, 0.0005, 0.5, 2.0],
            )
        fingers.append(pairs)
    return Grip(tuple(fingers))


def door_scene(
    *,
    springs: int = 0,
    knob: int = 0,
    gains: str = "impedance",
    timestep: float = 0.002,
    limits: bool = False,
) -> Scene:
    """The built-in scene: a Panda in front of a cabinet door.

    springs: 0, 1 or 2 springs on the hinge (the paper's three doors).
    knob:    0..3, the knob's location along the lever arm, 5 cm apart (0 is the outermost, 0.30 m).
    gains:   "impedance": what a Panda's joint impedance runs at; "paper": Table I's stiff servo.
    timestep: s.
    limits:  enforce the arm's joint ranges (needed when a policy drives the arm; a replay keeps inside).
    """
    if springs not in SPRINGS:
        raise ValueError(f"springs must be one of {sorted(SPRINGS)}, got {springs}")
    if knob not in range(len(LEVERS)):
        raise ValueError(f"knob must be 0..{len(LEVERS) - 1}, got {knob}")
    if gains not in ("impedance", "paper"):
        raise ValueError(f"gains must be 'impedance' or 'paper', got {gains!r}")
    folder = mjcf_dir()
    spec = mujoco.MjSpec.from_file(str(folder / "room.xml"))
    _attach(spec, folder / "panda.xml", "robot")
    _attach(spec, folder / "door.xml", "door")
    spec.modelname = "droid_door"
    spec.option.timestep = timestep
    if gains == "impedance":
        _set_gains(spec, IMPEDANCE_STIFFNESS, IMPEDANCE_DAMPING)
    else:
        _set_gains(spec, PAPER_STIFFNESS, PAPER_DAMPING)
    _add_springs(spec, springs)
    spec.body("knob").pos[1] = -LEVERS[knob]
    grip = _add_grip(spec)
    return compile_scene(
        spec,
        f"door ({('no spring', '1 spring', '2 springs')[springs]}, knob {knob}, {gains} gains)",
        joints=ARM,
        object_joint=HINGE,
        grip=grip,
        unlimited=() if limits else ARM,
    )


def with_options(scene: Scene, **changes: Any) -> Scene:
    """The same scene compiled with other options: timestep, integrator, cone, iterations, ls_iterations...

    Names are those of mujoco.MjOption; the spec is not touched.
    """
    model = scene.model.__copy__()
    for name, value in changes.items():
        if not hasattr(model.opt, name):
            raise ValueError(f"unknown option {name!r} of mujoco.MjOption")
        setattr(model.opt, name, value)
    return dataclasses.replace(scene, model=model)
