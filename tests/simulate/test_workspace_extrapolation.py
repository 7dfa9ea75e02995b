"""A demonstration that opens the door further, replayed in the C engine."""

from __future__ import annotations

import functools
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from small_gap import record, small_scene

from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_space
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.c_reference import c_replay
from droid_jax.simulate.replay import make_drive
from droid_jax.simulate.workspace_extrapolation import opened_further


@functools.cache
def scene() -> Scene:
    return door_scene()


def replayed(recording: Recording) -> Rollout:
    """By the C engine, at the door's mean parameters."""
    space = door_space(scene())
    rollout = c_replay(scene(), space, make_drive(scene(), recording))(space.mean[None])
    return Rollout(**{name: np.atleast_2d(getattr(rollout, name))[0] for name in rollout.__dataclass_fields__})


@functools.cache
def plan(name: str) -> tuple[Recording, Rollout]:
    demonstration = load_recording(demonstration_path(name))
    return demonstration, replayed(demonstration)


@functools.cache
def further(name: str) -> Recording:
    demonstration, before = plan(name)
    longer = opened_further(scene(), demonstration, before)
    assert longer is not None
    return longer


@pytest.mark.parametrize("name", ["A", pytest.param("C", marks=pytest.mark.slow)])
def test_the_door_goes_a_third_further_and_comes_back(name: str):
    """C closes the door afterwards; its motion after the widest opening is delayed, but unchanged."""
    demonstration, before = plan(name)
    longer = further(name)
    after = replayed(longer)
    assert after.object_angle.max() == pytest.approx(4 / 3 * before.object_angle.max(), abs=np.deg2rad(1.5))
    added = longer.duration - demonstration.duration
    last = int(np.argmax(before.object_angle))
    np.testing.assert_allclose(after.object_angle[:last], before.object_angle[:last], atol=1e-3)
    rest = before.time[last:]
    came_back = np.interp(rest + added, after.time, after.object_angle)
    np.testing.assert_allclose(came_back[100:], before.object_angle[last:][100:], atol=np.deg2rad(0.5))
    assert after.contact[last : last + int(added / (after.time[1] - after.time[0]))].all()  # the knob stays in the hand


def test_the_command_has_no_jerks():
    (demonstration, _), longer = plan("A"), further("A")

    def fastest(recording: Recording) -> np.ndarray:
        return np.abs(np.gradient(recording.command[:, :7], recording.time, axis=0)).max(axis=0)

    assert (fastest(longer) < 1.5 * fastest(demonstration).max()).all()
    for channel in longer.channels.values():
        assert channel.values.shape[1] == len(channel.time)


def test_out_of_reach_or_without_grip_gives_none():
    demonstration, before = plan("A")
    far = replace(before, object_angle=before.object_angle * 3)
    lost = replace(before, contact=np.zeros_like(before.contact))
    assert opened_further(scene(), demonstration, far) is None
    assert opened_further(scene(), demonstration, lost) is None


def test_a_stop_of_the_hinge_is_not_passed():
    demonstration, before = plan("A")
    model = mujoco.MjModel.__copy__(scene().model)
    joint = scene().id("joint", "hinge")
    model.jnt_limited[joint], model.jnt_range[joint] = True, (0.0, before.object_angle.max() * 1.2)
    assert opened_further(replace(scene(), model=model), demonstration, before) is None


def test_a_hand_without_object_gives_none():
    small, _ = small_scene()
    _, before = plan("A")
    assert opened_further(small, record("train"), before) is None
