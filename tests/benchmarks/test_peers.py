"""What is ours in the comparison with mujoco.sysid: priors as rows of its residual."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.peers import springs, sysid
from droid_jax.model.parameters import Parameter, Space
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide


def space() -> Space:
    return Space(
        (
            Parameter("mass", "kg", 1.0, 0.5, 0.1, 5.0),
            Parameter("offset", "N m", 0.2, 0.1, -1.0, 1.0, nuisance=True),
        )
    )


def line(x: np.ndarray, parameters: None) -> tuple[list[np.ndarray], list, list]:
    """A residual as the library hands it on: rows by columns of finite differences, which sees the mass alone."""
    return [np.outer(np.arange(3.0), np.atleast_2d(x.T)[:, 0]).reshape(3, *x.shape[1:])], [], []


def test_a_prior_is_a_row_for_each_nuisance_and_weighs_like_the_noise():
    whole = sysid.with_priors(line, space(), noise=0.01)
    (data, prior), *_ = whole(np.array([2.0, 0.5]), None)
    assert data.shape == (3,)
    assert prior == pytest.approx([0.03])  # three deviations off
    (data, prior), *_ = whole(np.array([[2.0, 2.1], [0.5, 0.2]]), None)
    assert data.shape == (3, 2) and prior == pytest.approx(np.array([[0.03, 0.0]]))


def test_the_noise_is_of_the_repeats_mean_in_rows_of_the_residual():
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 1.0, 501)
    clean = np.stack([np.sin(6 * time), 5 * np.cos(6 * time)], axis=1)
    values = clean + 0.1 * rng.normal(size=(10, *clean.shape))
    torque = Channel("torque", "N m", ("a", "b"), time, values, np.ones(values.shape, bool))
    recording = Recording(
        name="wave", time=time, command=clean, command_names=("a", "b"), channels={"torque": torque},
        torque=TorqueConvention(TorqueSide.MOTOR, gravity=True), qpos0={},
    )  # fmt: skip
    size = np.linalg.norm(clean, axis=0) / np.sqrt(2)  # as the library normalises
    expected = np.sqrt(np.mean((0.1 / np.sqrt(10) / size) ** 2))
    assert sysid._noise(recording) == pytest.approx(expected, rel=0.05)


def test_an_interval_without_end_is_written_as_none():
    found = springs.half_widths({"mass": 0.1, "stiffness": 2.0, "damping": 1.0}, np.array([0.2, np.inf, 0.0]))
    assert found["half_width_95"] == {"mass": 0.2, "stiffness": None, "damping": 0.0}
    assert found["error_in_half_widths"] == {"mass": 0.5, "stiffness": None, "damping": None}
    json.dumps(found, allow_nan=False)
