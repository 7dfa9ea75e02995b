"""Experiments that distinguish indistinguishable models whose difference is known; a motion on another clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from small_gap import record, small

from droid_jax.cost.observation import TooLong
from droid_jax.discrepancy import missing
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.discrepancy.missing import IN_THE_AIR, WEIGHT, separating_experiments, untouched
from droid_jax.door.demonstration import PLANS, grasp_pose
from droid_jax.door.scene import door_scene
from droid_jax.model.scene import Grip
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.time_scaling import STOP, TIME_SCALINGS, time_scaled
from droid_jax.simulate.hand_path import solve_pose
from droid_jax.simulate.workspace_extrapolation import FURTHER


@pytest.fixture(scope="module")
def demonstration():
    return record("train")


def model(name: str, value: float) -> FittedModel:
    """The base model with one effect of a given size."""
    found = small()
    values = found.base.values.copy()
    values[found.case.full_space.index(name)] = value
    return replace(found.base, values=values)


def test_another_speed_distinguishes_drag_from_a_preload(demonstration, monkeypatch):
    """The models differ in a torque that grows with speed, so their distance does too."""
    monkeypatch.setattr(missing, "TIME_SCALINGS", TIME_SCALINGS[:2])
    models = (model("drag", 0.0), model("drag", 0.8))
    found = {e.what: e.distance or 0.0 for e in separating_experiments(small().case, [models], demonstration)}
    slower, faster = (found[entry.what] for entry in TIME_SCALINGS[:2])
    assert faster > 3.0 * slower > 0.0
    weighed = next(apart for what, apart in found.items() if "weighed" in what)
    assert slower < weighed < faster


def test_an_experiment_that_fails_states_the_reason_and_does_not_end_the_search(demonstration, monkeypatch):
    """Experiments that can be simulated come first."""
    make, raised = missing.make_cost, [TooLong("needs 9.0 GB"), RuntimeError("RESOURCE_EXHAUSTED\nout of memory")]

    def short_of_memory(scene, space, recordings, **options):
        if recordings[0].time[-1] > demonstration.time[-1] + 0.1:
            raise raised.pop(0)
        return make(scene, space, recordings, **options)

    monkeypatch.setattr(missing, "TIME_SCALINGS", TIME_SCALINGS[:3])
    monkeypatch.setattr(missing, "make_cost", short_of_memory)
    found = separating_experiments(small().case, [(model("drag", 0.0), model("drag", 0.8))], demonstration)
    said = {e.what: (e.distance is None, e.not_made) for e in found}
    assert said[TIME_SCALINGS[0].what] == (True, "needs 9.0 GB")
    assert said[TIME_SCALINGS[1].what] == (False, "")
    assert said[TIME_SCALINGS[2].what] == (True, "RuntimeError: RESOURCE_EXHAUSTED")
    assert [e.distance is None for e in found] == sorted(e.distance is None for e in found)


def dropped(recording: Recording, seconds: float) -> Recording:
    """A recording with a dropout of the torque sensor in all repeats."""
    channel = recording.channels["torque"]
    mask = channel.mask.copy()
    mask[:, (channel.time > 1.0) & (channel.time < 1.0 + seconds)] = False
    return replace(recording, channels={**recording.channels, "torque": replace(channel, mask=mask)})


@pytest.mark.slow
def test_a_dropout_that_is_too_long_in_a_slower_motion_is_reported(demonstration):
    """A gap of 60 ms is interpolated; three times slower it is too long for that."""
    models = (model("drag", 0.0), model("drag", 0.8))
    found = {e.what: e for e in separating_experiments(small().case, [models], dropped(demonstration, 0.06))}
    slower, faster = (found[entry.what] for entry in TIME_SCALINGS[:2])
    assert slower.distance is None and "a stretch that no repeat measured" in slower.not_made
    assert faster.distance is not None and faster.distance > 0.0


def test_a_known_weight_does_not_distinguish_payloads_or_preloads(demonstration, monkeypatch):
    """The distance of two payloads, and of two preloads, is the same with and without the weight."""
    monkeypatch.setattr(missing, "TIME_SCALINGS", ())
    case = small().case
    models = (model("payload_mass", 0.0), model("payload_mass", 0.2))
    (found,) = separating_experiments(case, [models], demonstration)
    plain = case.train.cost.whitened(np.stack([m.values for m in models])).astype(float)
    assert f"{WEIGHT:g} kg" in found.what
    assert found.distance == pytest.approx(np.linalg.norm(plain[0] - plain[1]), rel=0.2)


def gripping(case: Case) -> Case:
    """The small scene with a grip by contact, although its hand holds nothing."""
    cost = replace(case.train.cost, scene=replace(case.train.cost.scene, grip=Grip(())))
    return replace(case, train=replace(case.train, cost=cost))


def test_in_the_air_the_object_has_no_part_and_a_hand_that_reaches_no_further_is_reported(demonstration, monkeypatch):
    """The distance of two payloads is that of the unchanged scene, since the small scene's hand holds nothing."""
    monkeypatch.setattr(missing, "TIME_SCALINGS", ())
    monkeypatch.setattr(missing, "opened_further", lambda *arguments: None)
    case = small().case
    models = (model("payload_mass", 0.0), model("payload_mass", 0.2))
    found = {e.what: e for e in separating_experiments(gripping(case), [models], demonstration)}
    plain = case.train.cost.whitened(np.stack([m.values for m in models])).astype(float)
    assert found[IN_THE_AIR].distance == pytest.approx(np.linalg.norm(plain[0] - plain[1]), rel=0.2)
    assert found[FURTHER].distance is None and "does not reach further" in found[FURTHER].not_made
    assert IN_THE_AIR not in {e.what for e in separating_experiments(case, [models], demonstration)}


@pytest.mark.slow
def test_a_motion_opened_further_is_an_experiment(demonstration, monkeypatch):
    """Its distance is that of the models on the longer motion (here the same motion again)."""
    monkeypatch.setattr(missing, "TIME_SCALINGS", ())
    monkeypatch.setattr(missing, "opened_further", lambda scene, recording, replayed: replace(recording, name=FURTHER))
    case = small().case
    models = (model("drag", 0.0), model("drag", 0.8))
    found = {e.what: e.distance or 0.0 for e in separating_experiments(gripping(case), [models], demonstration)}
    assert FURTHER not in {e.what for e in separating_experiments(case, [models], demonstration)}
    plain = case.train.cost.whitened(np.stack([m.values for m in models])).astype(float)
    assert found[FURTHER] == pytest.approx(np.linalg.norm(plain[0] - plain[1]), rel=1e-3)


def test_an_untouched_scene_has_no_contact():
    """In the C engine closed fingers press on the knob with contacts, and pass through it without."""
    scene, plan = door_scene(springs=1), PLANS["A"]
    alone = untouched(scene)
    assert alone.grip is None and scene.grip is not None
    touching = []
    for each in (scene, alone):
        data = mujoco.MjData(each.model)  # fingers shut
        data.qpos[each.joint_qpos] = solve_pose(each, np.array(plan.pose), *grasp_pose(each, 0.0, 0.0, plan.roll))
        mujoco.mj_forward(each.model, data)
        touching.append(data.ncon)
    assert touching[0] > 0 and touching[1] == 0


def weighed(case: Case, whitened: Callable[[np.ndarray], np.ndarray], failed: bool = False) -> Case:
    """The case with a given cost, for the experiment with a weight, which needs no other."""
    cost: Any = SimpleNamespace(
        scene=case.train.cost.scene, space=case.full_space, comparisons=case.train.cost.comparisons,
        whitened=whitened, failed=lambda rows: np.array([failed, *[False] * (len(rows) - 1)]),
    )  # fmt: skip
    return replace(case, train=replace(case.train, cost=cost))


def test_the_distance_is_that_of_the_two_nearest_models(demonstration, monkeypatch):
    """Three models."""
    monkeypatch.setattr(missing, "TIME_SCALINGS", ())
    case, at = small().case, {0.0: 0.0, 0.1: 1.0, 0.2: 6.0}
    column = case.full_space.index("drag")
    known = weighed(case, lambda rows: np.array([[at[row[column]], 0.0] for row in rows]))
    models = tuple(model("drag", drag) for drag in (0.2, 0.0, 0.1))
    (found,) = separating_experiments(known, [models], demonstration)
    assert (found.distance, found.not_made) == (1.0, "")
    (found,) = separating_experiments(known, [models[:2], models[::2]], demonstration)
    assert found.distance == 5.0  # models of different groups are not compared


def test_an_experiment_on_which_a_model_fails_has_no_distance(demonstration, monkeypatch):
    """Its distance would be NaN."""
    monkeypatch.setattr(missing, "TIME_SCALINGS", ())
    known = weighed(small().case, lambda rows: pytest.fail("one of the models fails"), failed=True)
    (found,) = separating_experiments(known, [(model("drag", 0.0), model("drag", 0.1))], demonstration)
    assert found.distance is None and "fails on this motion" in found.not_made


def test_a_log_without_commands_has_no_experiments(demonstration):
    log = replace(demonstration, command=np.zeros((0, 0)), command_names=())
    assert separating_experiments(small().case, [(model("drag", 0.0), model("drag", 0.8))], log) == ()


def test_the_best_experiment_comes_first(demonstration, monkeypatch):
    monkeypatch.setattr(missing, "TIME_SCALINGS", TIME_SCALINGS[:2])
    found = separating_experiments(small().case, [(model("drag", 0.0), model("drag", 0.8))], demonstration)
    apart = [e.distance or 0.0 for e in found]
    assert apart == sorted(apart, reverse=True) and apart[0] > apart[-1]


def test_one_model_needs_no_experiment(demonstration):
    assert separating_experiments(small().case, [(model("drag", 0.0),)], demonstration) == ()


@pytest.mark.parametrize(
    ("number", "seconds", "at"),
    [
        (0, lambda d: 3 * d, {0.9: 0.3, 6.0: 2.0}),
        (1, lambda d: d / 2, {0.5: 1.0, 1.2: 2.4}),
        (2, lambda d: 2 * d, {1.0: 1.0, 5.0: 0.996}),
        (3, lambda d: d + STOP, {1.0: 1.0, 2.5: 1.499, 4.5: 2.5}),
    ],
)
def test_a_motion_on_another_clock(
    demonstration: Recording, number: int, seconds: Callable[[float], float], at: dict[float, float]
):
    """`at`: instants of the new motion and of the demonstration (2.998 s long) that have the same command."""
    new = time_scaled(demonstration, TIME_SCALINGS[number])
    assert new.duration == pytest.approx(seconds(demonstration.duration), abs=0.005)
    for later, before in at.items():
        expected = [np.interp(before, demonstration.time, c) for c in demonstration.command.T]
        found = [np.interp(later, new.time, c) for c in new.command.T]
        np.testing.assert_allclose(found, expected, atol=2e-3)
    for channel in new.channels.values():
        assert channel.values.shape[1] == len(channel.time) == channel.mask.shape[1]
        assert channel.time[-1] <= new.time[-1] + 0.1
