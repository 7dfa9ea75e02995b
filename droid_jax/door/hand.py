"""What is seen of hand and knob, from the state of a simulation: MJX for training, plain C for the synthetic robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.door.task import HandState
from droid_jax.model.mjx_internals import constraint_rows, contacts
from droid_jax.model.scene import Scene
from droid_jax.simulate.replay import finger_geoms, of_fingers

PAD = (0.0, 0.005, 0.045)  # m, middle of a pad's face in its finger's frame
EDGES = 6  # rows of a pyramidal contact with four degrees of freedom; they add up to the normal force


@dataclass(frozen=True)
class Hand:
    """Ids of what is looked at.

    pinch, knob: sites; fingers: [2] bodies; hinge: address of the door's angle; pairs: for each finger, [n, 2] geoms
    (sorted) of its contact pairs.
    """

    pinch: int
    knob: int
    fingers: np.ndarray
    hinge: int
    pairs: tuple[np.ndarray, ...]


def hand_of(scene: Scene) -> Hand:
    """Of a scene with a gripper of two fingers and a knob; ValueError names what it lacks."""
    if scene.object_joint is None or scene.grip is None or len(scene.finger_pairs) != 2:
        raise ValueError(f"scene {scene.name!r} lacks a door or a gripper of two fingers: there is no such task in it")
    fingers = np.array([scene.id("body", f"{side}_finger") for side in ("left", "right")])
    sites = scene.id("site", "pinch"), scene.id("site", "knob")
    return Hand(*sites, fingers, scene.qpos(scene.object_joint), finger_geoms(scene))


def pads_at(hand: Hand, data: Any, origin: Any, axes: Any, numbers: Any = np) -> Any:
    """[2, 3] m, the middles of the pads' faces in a frame of axes [3, 3] at an origin [3]."""
    pad = numbers.array(PAD, data.xpos.dtype)
    return (data.xpos[hand.fingers] + data.xmat[hand.fingers].reshape(-1, 3, 3) @ pad - origin) @ axes


def looked(hand: Hand, data: Any, force: Any, last: Any, seconds: float, numbers: Any = jnp) -> HandState:
    """From mjx.Data, or MjData with numbers=numpy, with fresh kinematics.

    force: [2] N.  last: [2, 3] pads a while ago, `seconds` before, in the knob's frame.
    """
    knob, turned = data.site_xpos[hand.knob], data.site_xmat[hand.knob].reshape(3, 3)
    pads = pads_at(hand, data, knob, turned, numbers)
    axis, inward = data.site_xmat[hand.pinch].reshape(3, 3)[:, 2], turned[:, 0]
    across, along = inward[0] * axis[1] - inward[1] * axis[0], inward[:2] @ axis[:2]
    return HandState(
        angle=data.qpos[hand.hinge],
        pinch=(data.site_xpos[hand.pinch] - knob) @ turned,
        pads=pads,
        normal=axis @ inward,
        yaw=numbers.arctan2(across, along),
        force=force,
        sliding=numbers.max(numbers.linalg.norm((pads - last) / seconds, axis=1)),
    )


def finger_forces(hand: Hand, data: Any) -> jax.Array:
    """[2] N, normal force on each finger, from mjx.Data after a step."""
    found = contacts(data)
    edges = constraint_rows(data).force[found.first_row[:, None] + np.arange(EDGES)]
    normal = jnp.sum(edges, axis=1) * (found.distance < 0)
    return jnp.stack([jnp.sum(normal * mine) for mine in of_fingers(found, hand.pairs)])


def finger_forces_c(hand: Hand, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """[2] N, the same in plain C."""
    out, wrench = np.zeros(2), np.zeros(6)
    for index in range(data.ncon):
        geoms = sorted((data.contact[index].geom1, data.contact[index].geom2))
        for finger, pairs in enumerate(hand.pairs):
            if any(geoms == list(pair) for pair in pairs):
                mujoco.mj_contactForce(model, data, index, wrench)
                out[finger] += wrench[0]
    return out
