"""Repeats with different starts are each compared with a replay from their own start."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from two_link import JOINTS, arm, motion

from droid_jax.cost.cost import make_cost
from droid_jax.identify.holdout import heldout_distances
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.preflight.check_log import check_log
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.repeat_starts import own_starts, start_ranges

NOISE = 0.05  # N m
APART = 0.02  # rad
TRUE = 1.4  # N m s/rad, of the elbow


@pytest.fixture(scope="module")
def scene() -> Scene:
    return arm()


def space(scene: Scene) -> Space:
    return Space((joint_damping(scene, "elbow", name="elbow_damping", std=0.5, high=50.0),))


def repeats(scene: Scene, count: int, apart: float, noise: float = 1e-4) -> Recording:
    """The arm in C in fine steps, each repeat from another start."""
    time, command = motion(2.0)
    model = mujoco.MjModel.from_xml_string(scene.spec.to_xml())
    model.dof_damping[1] = TRUE
    model.opt.timestep = 1e-4
    rng = np.random.default_rng(1)
    seen = np.empty((2, count, len(time), 2))
    for n in range(count):
        data = mujoco.MjData(model)
        data.qpos[:] = command[0] + apart * rng.uniform(-1, 1, 2)
        for k in range(20 * len(time)):
            data.ctrl[:] = [np.interp(k * 1e-4, time, command[:, j]) for j in (1, 0)]
            at = data.qpos.copy()
            mujoco.mj_step(model, data)
            if k % 20 == 0:
                seen[:, n, k // 20] = data.qfrc_actuator, at
    mask = np.ones(seen[0].shape, bool)
    channels = {
        "torque": Channel("torque", "N m", JOINTS, time, seen[0] + rng.normal(0, NOISE, mask.shape), mask),
        "position": Channel("position", "rad", JOINTS, time, seen[1] + rng.normal(0, noise, mask.shape), mask),
    }
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=False)
    return Recording("apart", time, command, JOINTS, channels, convention, qpos0={})


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_fitted_and_held_out_repeats_with_different_starts(scene: Scene, engine: str):
    whole = repeats(scene, 8, APART)
    assert min(start_ranges(whole).values()) > 0.015
    stated = own_starts(replace(whole, qpos0={"shoulder": 0.0, "elbow": -0.3}))
    assert stated.qpos0 == {}
    fit, held = stated.repeats_subset([0, 1, 2, 5, 6]), stated.repeats_subset([3, 4, 7])  # 18 mrad apart on average
    known = space(scene)
    cost = make_cost(scene, known, [fit], engine=engine)
    other = cost.against([held])
    assert np.abs(other.drives[0].qpos0 - cost.drives[0].qpos0).max() > 0.015  # pyright: ignore
    grid = np.linspace(0.6, 2.2, 17)[:, None]
    for one in (cost, other):  # the starts' own torques, of up to 1 N m, are no noise
        assert float(grid[np.argmin(one(grid)), 0]) == pytest.approx(TRUE, abs=0.11)
        left = one(np.array([[TRUE]]))[0]  # C steps of 2 ms are off by 0.05 N m themselves
        assert left == pytest.approx(NOISE * np.sqrt(np.pi / 2), rel=0.1) or (engine == "mujoco" and left < 0.12)
    (gap,) = heldout_distances(other, [whole], [held], known.mean, np.array([TRUE]))
    assert gap.noise_floor == pytest.approx(NOISE * np.sqrt(np.pi / 2), rel=0.1)
    assert gap.closed is not None and gap.closed > (0.9 if engine == "mjx" else 0.5)


def test_the_range_of_starts_and_close_starts(scene: Scene):
    (note,) = check_log(scene, repeats(scene, 4, APART))
    assert note.severity == "note" and "repeats start up to 0.0" in note.sentence
    near = repeats(scene, 4, 0.001)
    assert start_ranges(near) == {} and own_starts(near) is near
    noisy = repeats(scene, 4, 0.0, noise=0.01)
    assert start_ranges(noisy) == {}
