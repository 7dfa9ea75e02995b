"""Which names are right for what was hidden, and which of them are declared ties.

Settled before the method was frozen.  A tie is declared where the two differ, after the base model has been
fitted again, by less than the forms themselves do (`forms.py` measures that; its table is in
benchmarks/results/detection_limits.json).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from droid_jax.model.scene import Scene
from droid_jax.synthetic.hidden_effects import HIDDEN, ON_HINGE, Applied
from experiments.blind.scenes import Setting


@dataclass(frozen=True)
class Answer:
    """exact: the library's name for it, "" where it has none.  ties: names that are as right.  why: of both.
    parts: names beside a right one that are not wrong, but not enough either.

    scenes: where it is hidden; empty for all that can have it.
    """

    exact: str
    ties: tuple[str, ...] = ()
    why: str = ""
    scenes: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()


HINGED = ("hinge", "bench", "door")
SERVO = ("bench", "door")
ANSWERS: dict[str, Answer] = {
    "hinge_preload": Answer(
        "hinge_preload", ("tilted_frame", "torque_bias"),
        "over small angles a tilt's cosine is constant; where the hinge has a sensor of its own, so is its offset",
    ),
    "binding_spring": Answer(
        "hardening_spring", ("tilted_frame",), "with the spring's stiffness free a tilt's sine bends like a cube"
    ),
    "over_centre": Answer(
        "over_centre_spring", ("tilted_frame", "hinge_preload"),
        "its moment is nearly a sine about 0.4 rad: a tilted frame's, or a preload's with less stiffness",
    ),
    "magnetic_catch": Answer("latch"),
    "closer": Answer("door_closer"),
    "opening_check": Answer("opening_check"),
    "air_drag": Answer("drag"),
    "floor_friction": Answer("angle_friction"),
    "tilted_frame": Answer(
        "tilted_frame", ("hinge_preload", "hardening_spring", "torque_bias"), "the same, seen from the other side"
    ),
    "detent": Answer("", why="no library entry acts in the middle of the travel only"),
    "pin_wobble": Answer("", why="friction that is periodic in the angle; angle_friction is a parabola"),
    "gasket": Answer("", why="suction has a memory"),
    "neighbour_door": Answer("", why="a contact far out, with damping"),
    "dry_friction": Answer("joint_coulomb"),
    "stribeck_friction": Answer("joint_stribeck"),
    "directional_friction": Answer(
        "joint_directional", parts=("joint_coulomb", "joint_stribeck", "angle_friction"),
        why="friction one way is as much dry friction both ways, and a difference",
    ),
    "load_friction": Answer(
        "load_friction", parts=("joint_coulomb",), why="under a steady load it is dry friction"
    ),
    "mesh_friction": Answer(
        "gear_friction", ("load_friction",), "where the load does not drive the motor, its shares add up to one"
    ),
    "bristle_friction": Answer("joint_coulomb", why="bristles bend by milliradians before they slip"),
    "warm_up_friction": Answer("joint_coulomb", why="what its repeats share is dry friction; the rest counts as noise"),
    "payload": Answer("payload", scenes=("arm", "door")),
    "held_thing": Answer("free_payload", ("payload",), "of a plane arm one moment is all", scenes=("arm", "door")),
    "cable_pull": Answer(
        "cable_pull", parts=("joint_directional", "joint_coulomb", "joint_stribeck"),
        why="it rubs in its clamps with a tenth of its pull, which is friction",
    ),
    "torque_ripple": Answer("torque_ripple"),
    "joint_elasticity": Answer(
        "joint_compliance", ("servo_gain",), "1 / (1 + k c) on a position servo is exactly a lower gain", SERVO
    ),
    "backlash": Answer(
        "", why="a play that the command leads; joint_backlash follows the load and explains none of it", scenes=SERVO
    ),
    "resonance": Answer(
        "two_mass_resonance", ("joint_compliance", "servo_gain"), "slow motions show the gear's twist alone", ("bench",)
    ),
    "free_play": Answer(
        "two_mass_backlash", ("joint_backlash",), "a motor that crosses the gap at once has no state", ("bench",)
    ),
    "torque_line": Answer("torque_speed_line", scenes=SERVO),
    "servo_gains": Answer(
        "servo_gain", ("joint_compliance",), "a lower gain is exactly an elastic gear's", SERVO
    ),
    "grip_compliance": Answer("contact_compliance"),
    "firm_friction": Answer("soft_friction", scenes=("bench",), why="only the elbow there has friction of its own"),
    "tilted_base": Answer("gravity_direction", scenes=("bench", "arm", "door")),
    "encoder_zero": Answer(
        "encoder_offset", ("gravity_direction",), "of links in one plane a lean is an offset of the first joint",
        ("bench", "arm", "door"),
    ),
    "command_delay": Answer(
        "command_delay", ("sensor_delay",), "positions are not scored", HINGED
    ),
    "clock_rate": Answer("clock_rate", ("command_delay",), "over a short motion it is a delay", HINGED),
    "feedforward": Answer("velocity_feedforward", ("servo_gain",), "both track in proportion to the speed", SERVO),
    "inner_profile": Answer(
        "profile_acceleration", ("velocity_feedforward", "command_delay"), "of slow motions a lag is left", SERVO
    ),
    "crosstalk": Answer("torque_crosstalk", scenes=("bench", "arm", "door")),
    "sensor_delay": Answer("sensor_delay", ("command_delay",), "positions are not scored"),
    "torque_bias": Answer(
        "torque_bias", ("hinge_preload", "tilted_frame", "cable_pull"),
        "a constant torque is a preload on the hinge and a pull on a joint of the arm; it settles, which is a drift",
        parts=("torque_drift",),
    ),
    "torque_gain": Answer("torque_gain"),
    "torque_drift": Answer("torque_drift", ("torque_bias",), "it warms up mostly between the repeats"),
}  # fmt: skip
NO_HINGE = ("cable_pull", "torque_ripple", "dry_friction", "bristle_friction", "warm_up_friction", "load_friction",
            "mesh_friction", "joint_elasticity", "backlash", "resonance", "free_play", "torque_line", "servo_gains",
            "firm_friction",
            "encoder_zero", "crosstalk", "feedforward", "inner_profile")  # fmt: skip
PLACES = {"command_delay": "commands", "clock_rate": "commands", "sensor_delay": "sensors",
          "contact_compliance": "grip", "gravity_direction": "base"}  # fmt: skip
OF_HINGE = frozenset({
    "hinge_preload", "tilted_frame", "hardening_spring", "over_centre_spring", "latch", "door_closer", "opening_check",
    "drag", "angle_friction", "hinge_stribeck", "hinge_directional",
})  # fmt: skip
# A lean in the plane of a joint that is alone is exactly an offset of its encoder.
ALONE = {"tilted_base": ("encoder_offset",)}
# The lone servo's log has steps, in which a motor's own state shows.
NO_TIES = (("resonance", "servo"), ("free_play", "servo"))
WHOLE = (
    "command_delay",
    "clock_rate",
    "sensor_delay",
    "payload",
    "held_thing",
    "grip_compliance",
    "tilted_base",
)  # not one joint's


def inside(name: str) -> bool:
    """Whether the library has a form of it."""
    return bool(ANSWERS[name].exact)


def targets(setting: Setting, name: str) -> tuple[str, ...]:
    """Joints on which something is hidden in a scene ("" for none in particular); empty where it cannot be.

    Dry friction of a joint whose friction is a base parameter is no missing effect; where there is none, none is firm.
    """
    scene, answer, hidden = setting.scene, ANSWERS[name], HIDDEN[name]
    if answer.scenes and setting.name not in answer.scenes:
        return ()
    if hidden.on == "hinge" or name in WHOLE:
        needs = {"hinge": scene.object_joint, "grip": scene.grip}.get(hidden.on, True)
        return ("",) if needs else ()
    arm = setting.hidden_joints or tuple(j for j in scene.joints if j != scene.object_joint)
    on_hinge = scene.object_joint and name not in NO_HINGE
    sensed = scene.object_joint in scene.joints  # by a sensor of its own
    joints = (*arm, str(scene.object_joint)) if on_hinge and (sensed or hidden.on == "joint") else arm
    if answer.exact == "joint_coulomb":
        joints = tuple(j for j in joints if f"{j}_frictionloss" not in setting.base.names)
    if answer.exact == "soft_friction":
        joints = tuple(j for j in joints if scene.spec.joint(j).frictionloss > 0)
    return joints


def right(scene: Scene, hidden: Applied) -> tuple[str, ...]:
    """Names "effect at place" that are right, the exact one first; none where the library has no form of it."""
    answer = ANSWERS[hidden.name]
    if not answer.exact:
        return ()
    ties = () if (hidden.name, scene.name) in NO_TIES else answer.ties
    alone = ALONE.get(hidden.name, ()) if len(scene.joints) == 1 and not scene.object_joint else ()
    names = (_at(scene, name, hidden.joint) for name in (answer.exact, *ties, *alone))
    return tuple(dict.fromkeys(n for n in names if n))


def matched(slots: Sequence[set[str]], right_names: Sequence[Sequence[str]]) -> list[bool]:
    """For each hidden effect: whether a part of the answer (an effect with its ties) names it.

    No part answers for two effects: "a or b" is one name, and of a and b it finds one.
    """
    fits = np.array([[bool(slot & set(names)) for slot in slots] for names in right_names], bool)
    met = np.zeros(len(right_names), bool)
    if fits.size:
        effect, slot = scipy.optimize.linear_sum_assignment(fits, maximize=True)
        met[effect] = fits[effect, slot]
    return met.tolist()


def beside(parts_of: Sequence[Sequence[str]], met: Sequence[bool]) -> list[Sequence[str]]:
    """Names that are not wrong beside a right one: parts of each hidden effect (none for any: empty) that is named."""
    return [names for names, named in zip(parts_of, met, strict=False) if named]


def parts(scene: Scene, hidden: Applied) -> tuple[str, ...]:
    """Names "effect at place" of what is only a part of what was hidden."""
    names = (_at(scene, name, hidden.joint) for name in ANSWERS[hidden.name].parts)
    return tuple(n for n in names if n)


def _at(scene: Scene, name: str, joint: str) -> str:
    """ "" where the place cannot have it: a torque sensor on a joint that has none, a hinge's spring on the arm."""
    on_hinge = not joint or joint == scene.object_joint
    if on_hinge:
        name = ON_HINGE.get(name, name)
    if name in PLACES:
        return f"{name} at {PLACES[name]}"
    if name in ("payload", "free_payload"):
        return f"{name} at {scene.joints[-1]}"
    if name in OF_HINGE:
        return f"{name} at {scene.object_joint}" if on_hinge else ""
    alone = scene.joints[0] if len(scene.joints) == 1 else None
    place = joint or scene.object_joint or alone
    return f"{name} at {place}" if place in scene.joints and (not on_hinge or name not in NO_HINGE) else ""


def without(scene: Scene, hidden: Iterable[Applied]) -> tuple[str, ...]:
    """Library entries that a leave-one-out case does without: all that would be right."""
    return tuple(sorted({n.split(" at ")[0] for h in hidden for n in right(scene, h)}))
