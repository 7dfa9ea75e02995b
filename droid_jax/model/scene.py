"""A scene: an MJCF compiled once, with its names resolved to ids once.

`load_scene` reads a user's MJCF, `door.scene.door_scene` composes the built-in one.  Replays use a model without visual
geoms (group 2, without collisions); their mass counts.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np

from droid_jax import arguments
from droid_jax.arguments import said
from droid_jax.model.actuators import actuator_names, drives_joint, of_joint
from droid_jax.model.unsupported_features import check_options, refuse_ignored, refuse_missing
from droid_jax.model.visual_geoms import compiled, visual_geoms, without_visual_geoms
from droid_jax.runtime import first_device

LONGEST = 900  # most characters of an error message about a scene, which may list names
PICTURE = (480, 640)  # height, width of the largest rendered picture
TINY_FRICTIONLOSS = 1e-6  # N m, gives a joint a constraint row for dry friction
# MuJoCo's defaults of a joint's friction constraint, and the largest impedance (mjMAXIMP).
SOFT_REFERENCE, SOFT_IMPEDANCE = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)
HARD = 0.9999
ONE_DEGREE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True, eq=False)
class Grip:
    """The contact pairs of each finger of a hand that holds an object.

    fingers: for each finger the names of its contact pairs; a finger touches if any of them does.
    """

    fingers: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene.

    Attributes:
        name: for messages and reports.
        spec: the MjSpec, with visual geoms; never changed after construction.
        model: of replays, compiled without visual geoms.
        joints: servo-driven joints whose torque and position are measured, in channel order [J].
        command_names: joints of the actuators, in actuator order [U]; the actuator's name if it drives a tendon, or a
            joint in addition to a position servo.
        object_joint: joint of the object that is moved (the door's hinge), or None.
        grip: contact pairs that show a lost grasp, or None without a hand.
        path: of the MJCF; None if the scene is not from one file.
        held: joints whose friction constraint is hard here and soft in the MJCF (`load_scene`).
        hold: whether friction constraints that effects add are hard too (`effects.registry.ready`).
        variant: numbers that the model has in place of the MJCF's (`model.variant`), as JSON; empty: none.
        varied: the scene that a variant was made of; None for other scenes.
    """

    name: str
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    joints: tuple[str, ...]
    command_names: tuple[str, ...]
    object_joint: str | None = None
    grip: Grip | None = None
    path: Path | None = None
    held: tuple[str, ...] = ()
    hold: bool = False
    variant: str = ""
    varied: Scene | None = dataclasses.field(default=None, repr=False)

    @property
    def nominal(self) -> Scene:
        """The scene with the numbers of its MJCF, those of no recording."""
        return self.varied or self

    def id(self, kind: str, name: str) -> int:
        """Id of a named element; kind is "joint", "body", "geom", "pair", "actuator" or "site"."""
        return name_to_id(self.model, kind, name)

    def dof(self, joint: str) -> int:
        """Address of a hinge or slide in velocity vectors."""
        return int(self.model.jnt_dofadr[self.id("joint", joint)])

    def qpos(self, joint: str) -> int:
        """Address of a hinge or slide in position vectors."""
        return int(self.model.jnt_qposadr[self.id("joint", joint)])

    def slides(self, joint: str) -> bool:
        """Whether a joint is a slide (m, N), not a hinge (rad, N m)."""
        return bool(self.model.jnt_type[self.id("joint", joint)] == mujoco.mjtJoint.mjJNT_SLIDE)

    def torque_unit(self, joints: Iterable[str]) -> str:
        """Unit of joint torques: N m for hinges, N for slides, "N m or N" for both."""
        return self._unit(joints, "N m", "N")

    def position_unit(self, joints: Iterable[str]) -> str:
        """Unit of joint positions: rad for hinges, m for slides, "rad or m" for both."""
        return self._unit(joints, "rad", "m")

    def _unit(self, joints: Iterable[str], hinge: str, slide: str) -> str:
        kinds = {self.slides(joint) for joint in joints}
        return " or ".join(unit for unit, slides in ((hinge, False), (slide, True)) if slides in kinds)

    @property
    def has_contacts(self) -> bool:
        """Whether it has a grip, or contact pairs."""
        return self.grip is not None or self.model.npair > 0

    @functools.cached_property
    def joint_dofs(self) -> np.ndarray:
        """[J] velocity addresses of `joints`."""
        return np.array([self.dof(j) for j in self.joints], dtype=int)

    @functools.cached_property
    def joint_qpos(self) -> np.ndarray:
        """[J] position addresses of `joints`."""
        return np.array([self.qpos(j) for j in self.joints], dtype=int)

    @functools.cached_property
    def single_joints(self) -> tuple[str, ...]:
        """Names of all hinges and slides, driven or not, in the model's order."""
        kinds = [mujoco.mjtJoint(k) for k in self.model.jnt_type]
        names = (mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(len(kinds)))
        return tuple(name for name, kind in zip(names, kinds, strict=True) if kind in ONE_DEGREE and name)

    def carriers(self, joints: Iterable[str]) -> tuple[str, ...]:
        """Hinges and slides between the world and the bodies that these joints move, including these joints.

        A joint without a name is described by its body's.
        """
        return tuple(self.joint_called(j) for j in self._above(joints) if self._is_single(j))

    def floating(self, joints: Iterable[str]) -> tuple[str, ...]:
        """Free and ball joints between the world and the bodies that these joints move."""
        return tuple(self.joint_called(j) for j in self.floating_ids(joints))

    def floating_ids(self, joints: Iterable[str]) -> tuple[int, ...]:
        """Ids of the joints that `floating` names."""
        return tuple(j for j in self._above(joints) if not self._is_single(j))

    def _above(self, joints: Iterable[str]) -> list[int]:
        model, above = self.model, set[int]()
        for joint in joints:
            body = int(model.jnt_bodyid[self.id("joint", joint)])
            while body:
                above.add(body)
                body = int(model.body_parentid[body])
        return [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in above]

    def _is_single(self, joint: int) -> bool:
        return mujoco.mjtJoint(self.model.jnt_type[joint]) in ONE_DEGREE

    def joint_called(self, joint: int) -> str:
        """A joint's name by its id; a joint without a name is described by its body's."""
        name = mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_JOINT, joint)
        return name or f"the joint of body {self.model.body(self.model.jnt_bodyid[joint]).name!r}"

    @functools.cached_property
    def finger_pairs(self) -> tuple[np.ndarray, ...]:
        """For each finger, the ids of its contact pairs."""
        fingers = self.grip.fingers if self.grip else ()
        return tuple(np.array([self.id("pair", p) for p in pairs], dtype=int) for pairs in fingers)

    @functools.cached_property
    def of_joint(self) -> np.ndarray:
        """[U] bool, actuators whose entry of `command_names` is a joint."""
        return of_joint(self.model, self.command_names)

    @functools.cached_property
    def driven_joints(self) -> tuple[str, ...]:
        """Joints in `command_names`, in actuator order."""
        return tuple(name for name, of in zip(self.command_names, self.of_joint, strict=True) if of)

    @property
    def finger_joints(self) -> tuple[str, ...]:
        """Joints that are driven, but not measured: those of the gripper."""
        return tuple(name for name in self.driven_joints if name not in self.joints)

    @functools.cached_property
    def mjx(self) -> Any:
        """The mjx.Model on the default device; ValueError for a model that MJX does not support."""
        import jax

        from droid_jax.quiet import mjx

        _ = self._sha256_of_mjx
        try:
            with jax.ensure_compile_time_eval():  # a first use inside jit must not store that trace's values
                put = cast(Callable[..., Any], mjx.put_model)  # pyright: ignore[reportUnknownMemberType]
                return put(self.model, device=first_device())
        except NotImplementedError as error:
            raise ValueError(
                f"scene {self.name!r} uses something that MJX does not support: {error}; change it in the MJCF "
                "(https://mujoco.readthedocs.io/en/stable/mjx.html#feature-parity lists what it supports)"
            ) from None

    @functools.cached_property
    def _sha256_of_mjx(self) -> str:
        """Hash of the model at the time when `mjx` was made of it."""
        return sha256_of(self.model)

    def check_unchanged(self) -> None:
        """Raise ValueError if the model was changed after `mjx` was made of it, since replays would use both."""
        if "mjx" in vars(self) and self._sha256_of_mjx != sha256_of(self.model):
            raise ValueError(
                f"the model of scene {self.name!r} was changed after it was compiled: load the scene again, or change "
                "its options with droid_jax.model.scene.with_options, which returns another scene"
            )

    @functools.cached_property
    def sha256(self) -> str:
        """Hash of the compiled model."""
        return sha256_of(self.model)

    @functools.cached_property
    def full_geom_ids(self) -> np.ndarray:
        """[ngeom] the id of each geom of the model in the MJCF with visual geoms."""
        spec = self.spec.copy()
        compiled(spec)  # numbers the geoms
        visual = {geom.id for geom in visual_geoms(spec)}
        return np.array([geom.id for geom in spec.geoms if geom.id not in visual], dtype=int)

    def visual_model(self) -> mujoco.MjModel:
        """The model with visual geoms, for rendering, with an offscreen buffer of at least PICTURE."""
        return for_pictures(compiled(self.spec))

    def initial_qpos(self, positions: dict[str, float] | Any) -> np.ndarray:
        """[nq] the model's reference pose with named joints set, rad and m; ValueError for unknown names."""
        qpos = self.model.qpos0.copy()
        for joint, value in positions.items():
            qpos[self.qpos(joint)] = value
        return qpos

    @property
    def needs_command(self) -> tuple[str, ...]:
        """Entries of `command_names` that a recording must command: measured joints, or all joints if there is a grip.

        Other actuators hold their start if the recording does not command them.
        """
        secondary = drives_joint(self.model) & ~self.of_joint  # drive a joint in addition to its servo
        gripped = self.grip is not None
        names = zip(self.command_names, secondary, strict=True)
        return tuple(name for name, other in names if name in self.joints or (gripped and not other))

    def command_index(self, names: Sequence[str]) -> np.ndarray:
        """[U] column of `names` for each actuator; -1 without one.

        Raises ValueError if a name of `needs_command` is missing.
        """
        missing = [n for n in self.needs_command if n not in names]
        if missing:
            raise ValueError(
                f"scene {self.name!r} needs a command for {', '.join(self.needs_command)}; "
                f"missing: {', '.join(missing)}; given: {', '.join(names) or 'none'}"
            )
        return np.array([list(names).index(n) if n in names else -1 for n in self.command_names], dtype=int)


def for_pictures(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model itself, with an offscreen buffer of at least PICTURE."""
    buffer = model.vis.global_  # the MJCF may ask for a small one
    buffer.offheight, buffer.offwidth = np.maximum((buffer.offheight, buffer.offwidth), PICTURE)
    return model


def sha256_of(model: mujoco.MjModel) -> str:
    """Hash of a model's content; it takes a quarter of a millisecond for the door's."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()


def name_to_id(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Id of a named joint, body, geom, pair, actuator or site; ValueError for an unknown name lists the valid ones."""
    obj = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    given: Any = name
    plain = isinstance(given, str) and bool(given) and given.isprintable()
    index = mujoco.mj_name2id(model, obj, name) if plain else -1
    if index < 0:
        valid = [v for v in (mujoco.mj_id2name(model, obj, i) for i in range(_count(model, kind))) if v]
        has = f"has: {', '.join(valid)}" if valid else f"has no {kind} with a name"
        raise ValueError(f"unknown {kind} {arguments.shown(name)}; this scene {has}")
    return index


def _count(model: mujoco.MjModel, kind: str) -> int:
    return {
        "joint": model.njnt,
        "body": model.nbody,
        "geom": model.ngeom,
        "pair": model.npair,
        "actuator": model.nu,
        "site": model.nsite,
    }[kind]


def compile_scene(
    spec: mujoco.MjSpec,
    name: str,
    *,
    joints: Sequence[str] | None = None,
    object_joint: str | None = None,
    grip: Grip | None = None,
    unlimited: Iterable[str] = (),
    engine: str = "mjx",
    mj_step: bool = False,
) -> Scene:
    """Compile a spec into a Scene and check it.

    Args:
        spec: of the scene.
        name: for messages and reports.
        joints: measured joints; None: all joints that an actuator drives.
        object_joint: joint of the object that is moved.
        grip: contact pairs of a hand.
        unlimited: joints whose range replays do not enforce.  Each limited joint costs a constraint row (a third of the
            time for the Panda), which a recording inside the ranges does not need.  Command ranges still apply.
        engine: of the replays.  "mujoco" allows features that C MuJoCo supports but MJX does not (integrators, friction
            cones, fluids, types of actuators and equalities).
        mj_step: whether replays use mj_step's own steps, which support elliptic cones and fluids.

    Returns:
        The compiled scene.

    Raises:
        ValueError: a name is unknown, a measured joint is no hinge or slide, or the model has features that MJX
            silently ignores, plugins, or features that replays do not support.
    """
    arguments.one_of(engine, "engine", ("mjx", "mujoco"))
    joints = None if joints is None else arguments.names(joints, "joints")
    object_joint = None if object_joint is None else arguments.name(object_joint, "object_joint")
    bare, free = without_visual_geoms(spec), set(unlimited)
    for joint in bare.joints:
        if joint.name in free:
            joint.limited = False
    for joint in bare.joints:  # MJX lays constraint rows out at compilation, none for zero friction loss
        if joint.name == object_joint and joint.type in ONE_DEGREE and joint.frictionloss <= 0:
            joint.frictionloss = TINY_FRICTIONLOSS
    model = bare.compile()
    refuse_ignored(model, name, tuple(dict.fromkeys(plugin.plugin_name for plugin in spec.plugins)))
    if engine == "mjx":
        refuse_missing(model, name)
        check_options(model, mj_step, f"a replay of scene {name!r}")
    command_names = actuator_names(model)
    driven = tuple(n for n, of in zip(command_names, of_joint(model, command_names), strict=True) if of)
    scene = Scene(
        name=name,
        spec=spec,
        model=model,
        joints=driven if joints is None else joints,
        command_names=command_names,
        object_joint=object_joint,
        grip=grip,
    )
    for joint in (*scene.joints, *([object_joint] if object_joint else [])):
        kind = mujoco.mjtJoint(model.jnt_type[scene.id("joint", joint)])
        if kind not in ONE_DEGREE:
            raise ValueError(f"joint {joint!r} of scene {name!r} must be a hinge or a slide")
    _ = scene.finger_pairs  # raises for unknown pair names
    return scene


def load_scene(
    path: str | Path,
    *,
    joints: Sequence[str] | None = None,
    object_joint: str | None = None,
    friction_joints: Sequence[str] = (),
    assets: Mapping[str, bytes] | None = None,
    hold: bool = False,
    engine: str = "mjx",
    mj_step: bool = False,
) -> Scene:
    """Load a user's MJCF as a Scene.

    Args:
        path: of the MJCF.
        joints: measured joints, in channel order; None for all driven ones.
        object_joint: joint of the object that is moved, or None.
        friction_joints: joints whose friction loss will be a parameter, but is zero in the file.
        assets: name -> content of files that the MJCF names but that are not beside it, such as `env.model_assets` of
            mujoco_playground. An MJCF that is written later contains the same names.
        hold: whether dry friction does not creep: friction constraints have MuJoCo's hardest impedance, unless the
            MJCF sets their solver parameters (solimpfriction, solreffriction).
        engine, mj_step: as in `compile_scene`.

    Returns:
        The compiled scene.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file does not compile, names are unknown, or MJX does not support or would ignore a feature.
    """
    path = arguments.path_of(path, "the path of an MJCF")
    friction_joints = arguments.names(friction_joints, "friction_joints")
    assets = {} if assets is None else arguments.mapping(assets, "assets")
    given: Mapping[Any, Any] = assets
    for key, content in given.items():
        if not isinstance(key, str) or not isinstance(content, bytes):
            raise ValueError(f"assets must map file names to bytes, got {arguments.shown(key)}")
    if path.is_dir():
        raise FileNotFoundError(f"{path} is a folder, not an MJCF file")
    if not path.is_file():
        raise FileNotFoundError(f"no MJCF file at {path}")
    try:
        spec = _read(path, assets)
    except ValueError as error:
        raise ValueError(f"{path}: {said(error)}") from None
    named = {j.name: j for j in spec.joints}
    for joint in friction_joints:
        if joint not in named:
            has = f"has: {', '.join(sorted(named))}" if named else "has no joints at all"
            raise ValueError(f"unknown joint {joint!r}; {path} {has}")
        named[joint].frictionloss = max(named[joint].frictionloss, TINY_FRICTIONLOSS)
    held = _hold(spec) if hold else ()
    try:
        scene = compile_scene(spec, path.stem, joints=joints, object_joint=object_joint, engine=engine, mj_step=mj_step)
    except ValueError as error:
        raise ValueError(f"{path}: {said(error, LONGEST)}") from None
    return dataclasses.replace(scene, held=held, hold=hold, path=None if assets else path.resolve())


def _hold(spec: mujoco.MjSpec) -> tuple[str, ...]:
    """Harden the friction constraints of a spec's joints that have default solver parameters; returns their names."""
    soft = [joint for joint in spec.joints if joint.frictionloss > 0 and is_soft(joint)]
    for joint in soft:
        joint.solimp_friction[:2] = HARD
    return tuple(joint.name for joint in soft if joint.name)


def is_soft(joint: Any) -> bool:
    """Whether the friction constraint of a spec's joint has MuJoCo's default solver parameters, which creep."""
    default = np.allclose(joint.solref_friction, SOFT_REFERENCE)
    return bool(default and np.allclose(joint.solimp_friction, SOFT_IMPEDANCE))


def _read(path: Path, assets: Mapping[str, bytes]) -> mujoco.MjSpec:
    """The spec of an MJCF, with the content of some included files, meshes and textures given."""
    included = {name: content for name, content in assets.items() if name.endswith(".xml")}
    others = {name: content for name, content in assets.items() if name not in included}
    return mujoco.MjSpec.from_file(str(path), include=included, assets=others)


def with_options(scene: Scene, **changes: Any) -> Scene:
    """A copy of the scene with other options of mujoco.MjOption (timestep, integrator, cone, iterations, ...).

    The spec is unchanged.  Raises ValueError for an unknown option or an invalid value.
    """
    model = scene.model.__copy__()
    for name, value in changes.items():
        if not hasattr(model.opt, name):
            raise ValueError(f"unknown option {name!r} of mujoco.MjOption")
        try:
            setattr(model.opt, name, value)
        except (TypeError, ValueError):
            raise ValueError(f"option {name!r} of mujoco.MjOption cannot be {arguments.shown(value)}") from None
    return dataclasses.replace(scene, model=model)
