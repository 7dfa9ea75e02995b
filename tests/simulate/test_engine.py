"""The choice of the engine of a fit."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from two_link import JOINTS, MOTOR, arm, measured, recording

from droid_jax import distributed, runtime
from droid_jax.cost.cost import make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.identify.excitation import engine_for
from droid_jax.model.effects.registry import effect_space, library
from droid_jax.model.fields import joint_damping
from droid_jax.model.joint_friction import joint_friction_effect, joint_friction_space
from droid_jax.model.parameters import Space
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.engine import choose_engine
from droid_jax.simulate.replay import make_drive

ONE = recording().repeats_subset([0])
SPACE = Space((joint_damping(arm(), "shoulder", std=1.0, high=20.0),))


def test_a_log_of_one_repeat_is_replayed_in_c():
    assert choose_engine(arm(), SPACE, [ONE]).engine == "mujoco"


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (recording(), "repeats"),
        (replace(ONE, torque=TorqueConvention(TorqueSide.LINK, gravity=False)), "motor-side"),
        (replace(ONE, time=np.zeros(0), command=np.zeros((0, 0)), command_names=()), "inverse dynamics"),
    ],
)
def test_features_that_c_lacks_are_replayed_in_mjx(given: Recording, why: str):
    choice = choose_engine(arm(), SPACE, [ONE, given])
    assert choice.engine == "mjx" and why in choice.why


def test_the_convention_of_torques_that_were_not_measured_is_no_reason_for_mjx():
    """Regression: positions alone, declared link-side, were refused by C."""
    channels = {"position": measured(0.0)["position"]}
    alone = recording(channels=channels, torque=TorqueConvention(TorqueSide.LINK, True)).repeats_subset([0])
    assert choose_engine(arm(), SPACE, [alone]).engine == "mujoco"
    assert make_drive(arm(), alone).torque == make_drive(arm(), replace(alone, torque=MOTOR)).torque


def test_parameters_and_effects_of_sensors_are_replayed_in_mjx():
    assert choose_engine(arm(), SPACE + joint_friction_space(JOINTS), [ONE]).engine == "mjx"
    assert choose_engine(arm(), SPACE, [ONE], [joint_friction_effect(JOINTS)]).engine == "mjx"
    assert engine_for(arm(), SPACE + joint_friction_space(JOINTS), [ONE]) == "mjx"
    assert engine_for(arm(), SPACE, [ONE]) == "mujoco"


def test_other_machines_are_mjx(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(distributed, "count", lambda: 2)
    assert choose_engine(arm(), SPACE, [ONE]).engine == "mjx"


def test_a_gpu_replays_batches_that_are_large_for_the_cpu(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(runtime, "cores", lambda: 4)
    few, many = (choose_engine(arm(), SPACE, [ONE], samples=samples) for samples in (64, 65))
    assert (few.engine, many.engine) == ("mujoco", "mjx") and "gpu" in many.why and "64 samples" in few.why
    assert choose_engine(arm(), SPACE, [recording()], samples=1).engine == "mjx"


def test_c_supports_servo_profiles():
    """Both engines replay a goal with limited acceleration; MJX is the reference."""
    scene = arm()
    effects = library(scene, ["profile_acceleration"])
    space = SPACE + effect_space(effects)
    assert choose_engine(scene, space, [ONE], effects).engine == "mujoco"
    values = np.stack([space.mean, space.values({"profile_acceleration[shoulder]": 0.05})])
    config = CompareConfig(channels={"torque": 1.0})
    mjx, c = (
        make_cost(scene, space, [ONE], engine=engine, config=config, effects=effects).rollouts(values)[0]
        for engine in ("mjx", "mujoco")
    )
    drawn, expected = (rollout.position[1] - rollout.position[0] for rollout in (c, mjx))
    np.testing.assert_allclose(drawn, expected, atol=1e-3)  # what the profile changes; C's steps are of first order
    assert np.abs(expected).max() > 0.1
