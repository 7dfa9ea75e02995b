"""The built-in scene, a Panda in front of a cabinet door, out of room, arm and door by MjSpec; the arm alone."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import mujoco

from droid_jax.arguments import flag, number, one_of, whole
from droid_jax.model.scene import Grip, Scene, compile_scene
from droid_jax.model.visual_geoms import LOOK_GROUP

ARM = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
HAND = "hand"
HINGE = "hinge"
LEVERS = (0.30, 0.25, 0.20, 0.15)  # m, knob to hinge axis: four locations 5 cm apart (paper, IV-E)

# Table I of the paper, N m/rad by number of springs: its initial mean, and its fitted means (see also door.truth).
SPRINGS = {0: 0.01, 1: 1.06, 2: 1.24}

# Joint damping carried by the simulated position servo, N m s/rad (see docs/paper.md).
IMPEDANCE_STIFFNESS = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)  # N m/rad
IMPEDANCE_DAMPING = (50.0, 50.0, 50.0, 50.0, 20.0, 15.0, 15.0)
PAPER_STIFFNESS = (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0)
PAPER_DAMPING = (100.0, 100.0, 100.0, 100.0, 100.0, 10.0, 0.4)  # Table I


def mjcf_dir() -> Path:
    """Folder of the built-in MJCF files: inside the installed package, else beside it in a checkout.

    Raises FileNotFoundError when neither is there.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "mjcf", package.parent / "mjcf"):
        if (folder / "room.xml").is_file():
            return folder
    raise FileNotFoundError(f"the built-in MJCF files are neither in {package / 'mjcf'} nor beside the package")


def door_scene(
    *,
    springs: int = 0,
    knob: int = 0,
    gains: str = "impedance",
    timestep: float = 0.002,
    limits: bool = False,
) -> Scene:
    """The built-in scene: a Panda in front of a cabinet door.

    Args:
        springs: 0, 1 or 2 springs on the hinge (the paper's three doors).
        knob: 0..3, the knob's location along the lever arm, 5 cm apart (0 is the outermost, 0.30 m).
        gains: "impedance", what a Panda's joint impedance runs at, or "paper", Table I's stiff servo.
        timestep: s.
        limits: enforce the arm's joint ranges (needed when a policy drives the arm; a replay keeps inside).

    Returns:
        The scene, with the hinge as its object and a grip of two fingers.

    Raises:
        ValueError: other springs, knobs or gains, or a time step that is not above 0.
    """
    whole(springs, "springs", least=0, most=max(SPRINGS))
    whole(knob, "knob", least=0, most=len(LEVERS) - 1)
    one_of(gains, "gains", ("impedance", "paper"))
    number(timestep, "timestep", above=0)
    flag(limits, "limits")
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
        f"door ({('', '1 spring, ', '2 springs, ')[springs]}knob {knob}, {gains} gains)",
        joints=ARM,
        object_joint=HINGE,
        grip=grip,
        unlimited=() if limits else ARM,
    )


def panda_arm_scene() -> Scene:
    """The seven-joint Panda of `mjcf/panda.xml` with nothing mounted on its flange.

    Joint ranges are not enforced: a replay of a measured motion keeps inside them.
    """
    spec = mujoco.MjSpec.from_file(str(mjcf_dir() / "panda.xml"))
    for finger in FINGERS:  # its actuator would drive a joint that is gone
        spec.delete(spec.actuator(finger))
    spec.delete(spec.body(HAND))
    spec.modelname = "panda_arm"
    return compile_scene(spec, "Panda arm", joints=ARM, unlimited=ARM)


def _attach(spec: mujoco.MjSpec, file: Path, site: str) -> None:
    """Attach a file's model without a prefix: our three files share no names.

    MuJoCo warns of an empty prefix twice, through Python and on stderr with a log file; both are silenced.
    """

    def nothing(message: str) -> None: ...

    mujoco.set_mju_user_warning(nothing)
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
    fingers: list[tuple[str, str]] = []
    for side in ("left", "right"):
        pairs = (f"{side}_near", f"{side}_far")
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
