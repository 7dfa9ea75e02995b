"""A search in one or two logs without repeats, whose blocks of time train and validate in turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from small_log import ASKED, CONFIG, COULOMB, MJCF, NOISE, elbow, elbow_log, elbow_space

from droid_jax.cost.lone_log import LoneLog
from droid_jax.discrepancy import log_noise
from droid_jax.discrepancy.candidates import directions_of, score_test
from droid_jax.discrepancy.case import ResidualSet, block_residual_set, make_case
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import at_values, base_model
from droid_jax.discrepancy.log_case import make_log, single_case
from droid_jax.discrepancy.log_noise import noise_residual, refitted_residual
from droid_jax.discrepancy.search import search_effects
from droid_jax.discrepancy.statistics import Blocks
from droid_jax.discrepancy.verdict import Conclusion
from droid_jax.model.effects.candidate import EffectKey, candidates
from droid_jax.model.effects.registry import library
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Recording


@pytest.fixture(scope="module")
def log() -> LoneLog:
    scene = elbow()
    return make_log(scene, elbow_space(scene), library(scene, ASKED), elbow_log(COULOMB), CONFIG)


@pytest.mark.slow
def test_dry_friction_is_found_in_one_log(log: LoneLog):
    scene = elbow()
    effects, base = library(scene, ASKED), elbow_space(scene)
    case = single_case(log, base, effects, config=CONFIG)
    train, validation = case.train.resampling, case.validation.resampling
    assert isinstance(train, Blocks) and isinstance(validation, Blocks)
    assert train.units == validation.units >= 8 and not np.any(train.counted & validation.counted)
    assert case.both is not None and isinstance(both := case.both.resampling, Blocks)
    assert both.units == 2 * train.units and np.array_equal(both.counted, train.counted | validation.counted)
    assert case.train.equivalence_factor == CONFIG.blocks.equivalence_factor
    assert case.train.prior_slack == CONFIG.blocks.prior_slack
    model = base_model(case)
    verdict = search_effects(case, model, 0.0)
    assert verdict.conclusion is Conclusion.NAMED and verdict.effects == (EffectKey("joint_coulomb", "elbow"),)
    asked = directions_of(candidates(effects))
    assert verdict.score_tests[0].p == score_test(case.both, at_values(case.both, model), asked, CONFIG.seed).p
    at = case.full_space.index("joint_coulomb[elbow]")
    assert verdict.model.values[at] == pytest.approx(COULOMB, rel=0.1)
    before, after = verdict.discrepancies["test"]
    assert after < 0.1 * before
    assert all(cell.p == 1.0 and not cell.found for cell in verdict.before)


@pytest.mark.slow
def test_nothing_is_named_where_nothing_is_missing(log: LoneLog):
    scene = elbow()
    effects, base = library(scene, ASKED), elbow_space(scene)
    case = single_case(log.with_torques(elbow_torque(log)), base, effects, config=CONFIG)
    assert search_effects(case, base_model(case), 0.0).conclusion is Conclusion.NONE


def elbow_torque(log: LoneLog) -> np.ndarray:
    """[K, 1] torques of the log without its dry friction."""
    values = np.stack([log.space.mean, log.space.values({"joint_coulomb[elbow]": COULOMB})])
    without, with_it = log.simulated(values)
    return log.measured - (with_it - without)


@pytest.mark.slow
def test_each_joint_of_a_test_log_has_its_own_noise():
    """In any order of its columns."""
    scene = two_joints()
    base = Space(tuple(joint_damping(scene, joint, std=0.4, high=10.0) for joint in scene.joints))
    effects = library(scene, ["joint_coulomb"])
    fitted, other = (
        make_log(scene, base, effects, two_joint_log(order), CONFIG)
        for order in (("elbow", "wrist"), ("wrist", "elbow"))
    )
    case = single_case(fitted, base, effects, other, CONFIG)

    def deviations(residual_set: ResidualSet) -> dict[int, float]:
        torque = residual_set.comparison.channel("torque")
        return dict(zip(torque.columns.tolist(), 1 / torque.noise.weight.max(axis=0), strict=True))

    assert case.test is not None and list(deviations(case.test)) == list(deviations(case.train)) == [0, 1]
    assert deviations(case.test) == deviations(case.validation) == deviations(case.train)
    assert deviations(case.train)[1] > 1.5 * deviations(case.train)[0]


def test_noise_is_the_residual_of_candidates_in_columns_that_they_explain():
    """The noise of one sensor does not hide an effect in another column."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(200, 2)) * [1.0, 0.1]
    whole = noise + np.sin(np.linspace(0.0, 9.0, 200))[:, None] * [0.0, 1.0]
    left = noise_residual(whole, noise, 0.2)
    assert np.array_equal(left, noise)
    assert np.array_equal(noise_residual(whole, 0.5 * whole, 0.2), whole)


@pytest.mark.parametrize(("size", "fitted"), [(1.0, True), (0.3, False)])  # of the effect; noise is 1
def test_a_candidate_that_explains_much_of_a_column_is_refitted(
    monkeypatch: pytest.MonkeyPatch, size: float, fitted: bool
):
    """It explains a ninth of six columns, and half of one of them."""
    columns, count, rng = 6, 500, np.random.default_rng(1)
    mark = np.zeros((columns, count))
    mark[4] = np.sqrt(2) * np.sin(np.linspace(0, 60, count))
    left = (rng.normal(size=(columns, count)) + size * mark).ravel()
    candidate: Any = SimpleNamespace(shaped_key="right")
    best: Any = SimpleNamespace(parts=(candidate,), sizes={"a": size}, start=lambda space, values: values)
    other: Any = SimpleNamespace(parts=(SimpleNamespace(shaped_key="wrong"),), sizes={"b": 0.1}, start=best.start)
    found: Any = SimpleNamespace(
        directions=[
            SimpleNamespace(candidate=SimpleNamespace(shaped_key=k), coefficient=c)
            for k, c in (("wrong", "b"), ("right", "a"))
        ],
        sensitivities=np.stack([rng.normal(size=columns * count), mark.ravel()]),
    )
    asked = list[Any]()

    def refit(train: Any, base: Any, parts: Any, *rest: Any, **more: Any) -> Any:
        asked.append(parts)
        return SimpleNamespace(residuals=np.tile(left - size * mark.ravel(), (3, 1)))

    monkeypatch.setattr(log_noise, "proposals", lambda *given: [other, best])
    monkeypatch.setattr(log_noise, "refit", refit)
    case: Any = SimpleNamespace(train=None, base=None, full_space=None, config=DiscrepancyConfig())
    model: Any = SimpleNamespace(residuals=np.tile(left, (3, 1)), values=np.zeros(2))
    got = refitted_residual(case, model, found, columns)
    assert asked == ([(candidate,)] if fitted else [])
    assert got is None if not fitted else got == pytest.approx(left - size * mark.ravel())


def two_joints() -> Scene:
    """The elbow, and a wrist like it."""
    elbow_body = MJCF[MJCF.index("<body") : MJCF.index("</body>") + len("</body>")]
    wrist_body = elbow_body.replace("forearm", "hand").replace("elbow", "wrist")
    both = MJCF.replace("</worldbody>", f"{wrist_body}</worldbody>")
    return compile_scene(mujoco.MjSpec.from_string(both), "two", joints=["elbow", "wrist"])


def two_joint_log(joints: Sequence[str]) -> Recording:
    """Both move alike; the wrist's sensor is three times as noisy.  joints: in the order of the columns."""
    one = elbow_log(0.0)
    position, torque = one.channel("position"), one.channel("torque")
    white = np.random.default_rng(4).normal(0.0, 3 * NOISE, len(torque.time) + 19)
    more = np.convolve(white, np.ones(20) / np.sqrt(20), "valid")[None, :, None]
    noise = {"elbow": 0.0 * more, "wrist": more}
    channels = {
        "position": replace(position, columns=tuple(joints), **_stacked([position.values] * 2)),
        "torque": replace(torque, columns=tuple(joints), **_stacked([torque.values + noise[j] for j in joints])),
    }
    return replace(one, name=" and ".join(joints), channels=channels)


def _stacked(columns: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    values = np.concatenate(columns, axis=2)
    return {"values": values, "mask": np.ones(values.shape, bool)}


def offset_by(recording: Recording, torque: float, name: str) -> Recording:
    """A recording with a torque offset [N m]."""
    channel = recording.channel("torque")
    shifted = replace(channel, values=channel.values + torque)
    return replace(recording, name=name, channels={**recording.channels, "torque": shifted})


@pytest.mark.slow
@pytest.mark.parametrize("off", [0.0, 0.4, 3.0])
def test_torque_offsets_of_a_test_log_are_fitted_to_it(off: float):
    """U of the test data is that of noise for offsets of 0 to 10 prior deviations, as for recordings with repeats."""
    scene = elbow()
    damping, offset = elbow_space(scene).parameters
    base = Space((damping, replace(offset, nuisance=True)))
    effects, log = library(scene, ["joint_coulomb"]), elbow_log(COULOMB)
    other = offset_by(elbow_log(COULOMB, 30.0), off, "another day")
    logs = [make_log(scene, base, effects, each, CONFIG) for each in (log, other)]
    case = single_case(logs[0], base, effects, logs[1], CONFIG)
    assert (
        case.test is not None and case.test.nuisances == ("torque_offset[elbow]",) and case.validation.nuisances == ()
    )
    truth = case.full_space.values({"elbow_damping": 0.6, "torque_offset[elbow]": 0.1, "joint_coulomb[elbow]": COULOMB})
    least = case.validation.discrepancy_at(truth)
    assert case.test.discrepancy_at(truth) == pytest.approx(least, rel=0.3)
    best = case.test.at_best_nuisances(truth)[0]
    assert best[case.full_space.index("torque_offset[elbow]")] == pytest.approx(0.1 + off, abs=0.03)
    assert single_case(logs[0], base, effects, None, CONFIG).test.nuisances == ()  # pyright: ignore
    if off:
        assert replace(case.test, nuisances=(), nuisance_columns=None).discrepancy_at(truth) > 2.0 * least


def test_repeats_are_refused_as_blocks():
    scene = elbow()
    with pytest.raises(ValueError, match="'elbow' has 2 repeats, and a log in blocks has one"):
        make_log(scene, elbow_space(scene), library(scene, ASKED), elbow_log(COULOMB, 8.0, 2), CONFIG)
    few = {"train": elbow_log(COULOMB, 8.0, 5), "validation": replace(elbow_log(COULOMB, 9.0, 5), name="other")}
    with pytest.raises(ValueError, match="recordings elbow, other: at least 8 repeats are needed"):
        make_case(scene, elbow_space(scene), library(scene, ASKED), **few, config=CONFIG)


def test_too_few_blocks_are_refused(log: LoneLog):
    with pytest.raises(ValueError, match="3 blocks, at least 8"):
        block_residual_set(log, np.minimum(np.arange(len(log.clock)) // 100, 2))
