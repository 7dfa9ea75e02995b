"""The task: pull a cabinet door open by its knob, which the hand must hold and not hook.

Pure functions of what is seen of hand and knob, for the simulation that trains and the robot that is judged alike.
Reward: equation 4 of the paper, five terms after DoorGym (Urakami et al. 2019); what counts as a grip is ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True)
class Task:
    """What is asked for, and what it is worth.

    control: s between actions; steps: actions at most.  opened: rad, from which the door counts as open.
    held: s at `opened` or beyond with the grip on that make a success.
    force: N on each finger, yaw: rad of the hand against the door, and behind: m that each pad may be nearer to
    the door than the knob's middle, that make a grip.
    reach: rad by which an action of one moves a joint's target from where the joint is; width: m, finger command
    of an action of one (of minus one: shut).
    door, orientation, distance, log_distance, slip: weights of the reward's terms; near: m, where the
    logarithm of the distance flattens; grip: worth of two fingers that press the knob of a shut door, as a share
    of opening it; close: m, over which a finger's worth falls off that does not press.
    spread: rad, deviation of the joints' start pose; standoff: m, hand in front of the knob at the start.
    """

    control: float = 0.02
    steps: int = 512
    opened: float = float(np.deg2rad(30.0))
    held: float = 0.5
    force: float = 1.0
    yaw: float = float(np.deg2rad(20.0))
    behind: float = 0.012
    reach: float = 0.1
    width: float = 0.04
    door: float = 2.0
    orientation: float = 1.0
    distance: float = 1.0
    log_distance: float = 0.1
    slip: float = 0.2
    near: float = 0.01
    close: float = 0.02
    grip: float = 0.25
    spread: float = 0.02
    standoff: float = 0.05


def substeps_of(control: float, timestep: float, whose: str) -> int:
    """Time steps [s] between two actions [s]; ValueError where that is no whole number."""
    steps = round(control / timestep)
    if steps < 1 or abs(steps * timestep - control) > 1e-9:
        raise ValueError(
            f"the time between actions, {control:g} s, is no multiple of {whose} time step, {timestep:g} s"
        )
    return steps


class HandState(NamedTuple):
    """Hand and knob at one instant.

    angle: [] rad of the hinge.  pinch: [3] and pads: [2, 3] m from the knob, in its frame (x the door's inward
    normal, z up).  normal: [] cosine between the hand's axis and the door's inward normal; yaw: [] rad between
    them, seen from above.  force: [2] N, normal force on each finger.  sliding: [] m/s, the faster pad's, along
    the knob.
    """

    angle: Any
    pinch: Any
    pads: Any
    normal: Any
    yaw: Any
    force: Any
    sliding: Any


def gripped(task: Task, seen: HandState) -> Any:
    """[] bool: both fingers press from the sides, and the hand faces the door.

    A finger that hooks the knob from the side presses alone, or needs the hand turned; two that close behind its
    round end hold it without friction, in a place that a real door takes up.
    """
    return (pressing(task, seen)).all() & (abs(seen.yaw) <= task.yaw)


def pressing(task: Task, seen: HandState) -> Any:
    """[2] bool: each finger presses the knob, and not from behind."""
    return (seen.force >= task.force) & (seen.pads[:, 0] <= task.behind)


def terms(task: Task, seen: HandState) -> dict[str, Any]:
    """The five terms of equation 4, unweighted: door, orientation, distance, log_distance, slip.

    Distances count below `opened` only.  The door's opening counts while the knob is gripped.  Each finger that presses
    counts a little, and one that does not less, the further its pad is from the knob: without the first, training ends
    with open fingers around the knob; without the second, in three of eleven policies, with one that presses and one
    that stands open.  And an open door counts once more: without that, training ends a hair before `opened`, from where
    on the distances pay nothing.
    """
    distance = jnp.linalg.norm(seen.pinch)
    grip = gripped(task, seen)
    close = jnp.exp(-jnp.linalg.norm(seen.pads, axis=-1) / task.close)
    touch = jnp.mean(jnp.where(pressing(task, seen), 1.0, close)) * (jnp.abs(seen.yaw) <= task.yaw)
    shut = seen.angle < task.opened
    opening = jnp.clip(seen.angle / task.opened, 0.0, 2.0) + jnp.where(shut, 0.0, 1.0)
    return {
        "door": task.grip * touch + jnp.where(grip, opening, 0.0),
        "orientation": seen.normal - jnp.abs(seen.yaw),
        "distance": jnp.where(shut, -distance, 0.0),
        "log_distance": jnp.where(shut, -jnp.log(distance + task.near), 0.0),
        "slip": -jnp.where(jnp.any(seen.force > 0.0), jnp.minimum(seen.sliding, 1.0), 0.0),
    }


def reward(task: Task, seen: HandState) -> Any:
    """[] equation 4."""
    return sum(getattr(task, name) * value for name, value in terms(task, seen).items())


def observation(position: Any, velocity: Any, seen: HandState) -> Any:
    """[23] as `control.LAYOUT` says, from joint positions and velocities [7]."""
    return jnp.concatenate([position, velocity, seen.pinch, seen.pads.reshape(-1)])


def held_open(task: Task, seen: HandState, before: Any) -> Any:
    """[] s for which the door has been open with the grip on, without a break; before: the same an action ago."""
    return (before + task.control) * (gripped(task, seen) & (seen.angle >= task.opened))


def succeeded(task: Task, longest: Any) -> Any:
    """[] bool, from the longest time that the open door was held, s."""
    return longest >= task.held - 1e-6
