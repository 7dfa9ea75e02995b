"""Identification from a log without commands, end to end: a carriage with a known equation of motion.

Slow throughout; test_pipeline.py has a log of this kind too.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from droid_jax.cost.cost import make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.identify.holdout import split_repeats
from droid_jax.identify.pipeline import Identified, IdentifyConfig, identify_parameters
from droid_jax.identify.search import CmaConfig
from droid_jax.model.fields import body_mass, joint_damping
from droid_jax.model.joint_friction import joint_friction_space, sensor_parameter
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.compiled import Along

XML = """<mujoco><option gravity="0 0 0"/><worldbody><body name="carriage">
  <joint name="slide" type="slide" axis="1 0 0" damping="10" frictionloss="1e-6"/><geom size=".1" mass="8"/></body>
</worldbody></mujoco>"""
MASS, DAMPING, COULOMB = 5.0, 20.0, 3.0  # kg, N s/m, N
pytestmark = pytest.mark.slow
TIME = np.arange(0, 12.0, 2e-3)


def log(repeats: int, side: TorqueSide = TorqueSide.MOTOR) -> Recording:
    """Two sines and the force for them, with noise of 0.05 N and 2 um."""
    rng = np.random.default_rng(repeats)
    w = 2 * np.pi * np.array([0.31, 0.83])[:, None]
    size = np.array([[0.3], [0.1]])
    x, v = (size * np.sin(w * TIME)).sum(0), (size * w * np.cos(w * TIME)).sum(0)
    force = -MASS * (size * w**2 * np.sin(w * TIME)).sum(0) + DAMPING * v + COULOMB * np.sign(v)
    shape = (repeats, len(TIME), 1)

    def channel(name: str, unit: str, clean: np.ndarray, noise: float) -> Channel:
        values = clean[None, :, None] + rng.normal(0, noise, shape)
        return Channel(name, unit, ("slide",), TIME, values, np.ones(shape, bool))

    channels = {"position": channel("position", "m", x, 2e-6), "torque": channel("torque", "N", force, 0.05)}
    return Recording("log", np.zeros(0), np.zeros((0, 0)), (), channels, TorqueConvention(side, True), qpos0={})


def another() -> Recording:
    """A log of another sensor, with an offset of 2 N."""
    recording = log(4)
    torque = recording.channels["torque"]
    channels = {**recording.channels, "torque": replace(torque, values=torque.values + 2.0)}
    return replace(recording, name="second", channels=channels)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(XML), "carriage", joints=["slide"])


@pytest.fixture(scope="module")
def space(scene: Scene) -> Space:
    mass = body_mass(scene, "carriage", std=3.0, high=50.0)
    return Space((mass, joint_damping(scene, "slide", std=10.0, high=100.0, unit="N s/m"))) + Space(
        (sensor_parameter(("slide",), "coulomb", "slide", std=2.0, high=20.0),)
    )


@pytest.fixture(scope="module")
def found(scene: Scene, space: Space) -> Identified:
    config = IdentifyConfig(search=CmaConfig(population=16, parents=None, generations=10), samples=4)
    return identify_parameters(scene, space, [log(1)], config=config)


def test_mass_and_friction_are_recovered(found: Identified):
    assert found.best == pytest.approx([MASS, DAMPING, COULOMB], rel=0.02)
    low, high = found.gaussian.interval(0.9)
    truth = np.array([MASS, DAMPING, COULOMB])
    # A replay's torques are read off along lines between rows of 8 ms: of a motion of 0.83 Hz that takes 1.6e-4.
    assert np.all((low < 1.0002 * truth) & (0.9998 * truth < high)), (low / truth - 1, high / truth - 1)
    assert np.all(high - low < 0.2 * truth)
    assert all(t.identifiable for t in found.identifiability)


def test_the_last_third_in_time_is_held_out(found: Identified):
    (fitted,), (held,) = found.fit.comparisons, found.heldout.comparisons
    assert fitted.channel("torque").span[1] < 8.0 < held.channel("torque").span[0]
    gap = found.heldout_distances["log"]
    assert gap.noise_floor is None and gap.closed is None
    assert gap.after < 0.1 * gap.before
    assert found.fit.comparisons[0].channel("torque").unit == "N"


def test_the_noise_of_one_repeat_is_estimated_from_the_residual(found: Identified):
    """It is estimated twice, so that independent whitened residuals have about unit size."""
    assert found.refined is not None
    assert 0.02 < np.mean(found.refined.residual**2) < 1.5


def test_repeats_are_split_by_number(scene: Scene, space: Space):
    recording = log(4)
    fitted, held, rows = split_repeats(recording, 0.3)
    assert (fitted.repeats, held.repeats, rows) == (3, 1, (3,))
    cost = make_cost(scene, space, [fitted])
    truth = space.values({"carriage_mass": MASS, "slide_damping": DAMPING, "coulomb[slide]": COULOMB})
    near, far = cost(np.stack([truth, space.mean]))
    assert near < 0.3 < far


def test_a_cost_of_two_recordings_is_that_of_each(scene: Scene, space: Space):
    first, second = log(3), another()
    both = make_cost(scene, space, [first, second])
    each = [make_cost(scene, space, [recording]) for recording in (first, second)]
    rows = np.stack([space.mean, space.values({"carriage_mass": MASS}), space.values({"slide_damping": DAMPING})])
    alone = np.stack([cost(rows) for cost in each])
    assert np.abs(alone[0] - alone[1]).min() > 0.01
    np.testing.assert_allclose(both(rows), alone.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(both.distances(rows), alone.T, rtol=1e-6)
    np.testing.assert_allclose(both.whitened(rows), np.hstack([cost.whitened(rows) for cost in each]), atol=1e-4)
    np.testing.assert_array_equal(both.first()(rows), alone[0])
    assert both.first().whitened(rows).shape == each[0].whitened(rows).shape


def test_every_recording_has_its_own_distance(scene: Scene, space: Space):
    config = IdentifyConfig(search=CmaConfig(population=8, parents=None, generations=2), samples=4)
    found = identify_parameters(scene, space, [log(3), another()], config=config)
    assert found.refined is not None and len(found.refined.residual) == found.fit.whitened(space.mean[None]).shape[1]
    for recording in (log(3), another()):
        held = make_cost(scene, space, [split_repeats(recording, config.heldout)[1]])
        before, after = held.distances(np.stack([space.mean, found.best]))[:, 0]
        gap = found.heldout_distances[recording.name]
        assert (gap.before, gap.after) == (pytest.approx(before, rel=1e-5), pytest.approx(after, rel=1e-3))


def test_another_motion_on_the_same_clock_compiles_no_replay(scene: Scene, space: Space):
    fitted, held, _ = split_repeats(log(4), 0.3)
    cost = make_cost(scene, space, [fitted])
    rows = np.stack([space.mean, space.values({"carriage_mass": MASS})])
    first = cost.whitened(rows)
    (along,) = cost._replays
    assert isinstance(along, Along)
    again = cost.against([held])  # its mean motion is another one
    assert again._replays[0].compiled is along.compiled
    np.testing.assert_allclose(
        again.rollouts(rows)[0].torque, make_cost(scene, space, [held]).rollouts(rows)[0].torque, atol=1e-5
    )
    assert np.abs(again.rollouts(rows)[0].position - cost.rollouts(rows)[0].position).max() > 1e-6
    np.testing.assert_array_equal(cost.whitened(rows), first)


def test_a_motion_on_another_clock_is_refused(scene: Scene, space: Space):
    cost = make_cost(scene, space, [log(1)])
    with pytest.raises(ValueError, match="other commands than 'log' had"):
        cost.against([log(1).window(0.0, 8.0)])


def test_plain_c_gives_the_same_cost(scene: Scene, space: Space):
    rows = np.stack([space.mean, space.values({"slide_damping": 15.0, "coulomb[slide]": 2.0})])
    mjx, c = (make_cost(scene, space, [log(3)], engine=engine) for engine in ("mjx", "mujoco"))
    np.testing.assert_allclose(c.distances(rows), mjx.distances(rows), rtol=1e-4)
    np.testing.assert_allclose(c.whitened(rows), mjx.whitened(rows), rtol=1e-4, atol=0.02)


def test_the_motion_filter_is_a_setting(scene: Scene, space: Space):
    slow, fast = (make_cost(scene, space, [log(1)], config=CompareConfig(motion_cutoff=c)) for c in (5.0, 30.0))
    assert slow.drives[0].timestep == pytest.approx(6 * fast.drives[0].timestep)


def test_sensor_parameters():
    names = joint_friction_space(["a", "b"]).names
    one = sensor_parameter(("a", "b"), "viscous", "b", std=0.5, high=2.0, nuisance=True)
    assert one.name in names and (one.low, one.mean, one.nuisance) == (-2.0, 0.0, True)
    with pytest.raises(ValueError, match="unknown sensor term 'stiction'; valid: viscous, coulomb, torque_offset"):
        sensor_parameter(("a",), "stiction", "a", std=1.0, high=2.0)
    with pytest.raises(ValueError, match="unknown joint 'c'; measured joints: a, b"):
        sensor_parameter(("a", "b"), "coulomb", "c", std=1.0, high=2.0)
