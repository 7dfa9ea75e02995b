"""Commanded logs with few repeats: initial states of windows, residuals, blocks, and a search in one log."""

from __future__ import annotations

import copy
import functools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pendulum as made
import pytest
from pendulum import TRUE, pendulum, swung
from two_link import JOINTS, arm, measured, recording

import droid_jax as dj
from droid_jax.cost.cost import Cost
from droid_jax.cost.log_piece import shared_steps
from droid_jax.cost.residuals import CompareConfig
from droid_jax.cost.windowed_log import WindowedLog, _whitener, windowed_log
from droid_jax.discrepancy import log_case
from droid_jax.discrepancy.candidates import observable_effects
from droid_jax.discrepancy.case import Case, block_residual_set
from droid_jax.discrepancy.config import BlocksConfig, DiscrepancyConfig, SelectionConfig
from droid_jax.discrepancy.log_case import planned
from droid_jax.discrepancy.statistics import OUTSIDE
from droid_jax.discrepancy.verdict import Conclusion
from droid_jax.model.effects.registry import joined, library
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, load_scene, with_options
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.simulate.windows import WindowConfig, _spread, fully_servoed, joint_states, why_no_windows

SHORT = WindowConfig(length=0.4, lead=0.1, history=0.05)
NOISE = 1e-4


@functools.cache
def scene() -> Scene:
    return pendulum()


@pytest.fixture(scope="module")
def space(tmp_path_factory: pytest.TempPathFactory) -> Space:
    path = tmp_path_factory.mktemp("swing") / "parameters.json"
    path.write_text(json.dumps(made.PARAMETERS))
    return load_parameters(path, scene())


@pytest.fixture
def seconds() -> Iterator[None]:
    """Longer logs for a test."""
    before, made.SECONDS = made.SECONDS, 26.0
    yield
    made.SECONDS = before


# ----- initial states of windows


def test_the_initial_state_of_a_window_is_that_of_the_motion():
    """The error for a sine is within its covariance."""
    time, rng = np.arange(0.0, 20.0, 0.005), np.random.default_rng(0)
    at, noise = np.linspace(0.5, 19.5, 400), 1e-3
    values = np.sin(3.0 * time) + rng.normal(0.0, noise, len(time))
    channel = Channel("position", "rad", ("j",), time, values[None, :, None], np.ones((1, len(time), 1), bool))
    state, root = joint_states(channel, 0, 0, at, 0.06)
    truth = np.stack([np.sin(3.0 * at), 3.0 * np.cos(3.0 * at)], axis=1)
    off = np.stack([np.linalg.solve(r, e) for r, e in zip(root, state - truth, strict=True)])
    assert np.mean(off**2) == pytest.approx(0.9, abs=0.4)  # the stated error of form is on the safe side
    assert np.std((state - truth)[:, 0]) < noise and np.std((state - truth)[:, 1]) < 0.05


def test_an_initial_state_that_was_not_measured_is_none():
    time = np.arange(0.0, 2.0, 0.01)
    mask = np.ones((1, len(time), 1), bool)
    mask[0, 50:90] = False
    channel = Channel("position", "rad", ("j",), time, np.where(mask, 0.3, np.nan), mask)
    state, _ = joint_states(channel, 0, 0, np.array([0.3, 0.7, 1.2]), 0.06)
    assert np.isfinite(state[[0, 2]]).all() and np.isnan(state[1]).all()
    np.testing.assert_allclose(state[0], [0.3, 0.0], atol=1e-12)


def test_motions_are_replayed_whole_if_a_servo_holds_every_joint():
    free = load_scene(Path(__file__).resolve().parents[2] / "experiments" / "xl330.xml")
    assert fully_servoed(scene()) and fully_servoed(free)
    model = copy.copy(free.model)
    model.actuator_biasprm[:, 1] = 0.0  # a motor's torque, which follows no position
    assert not fully_servoed(replace(free, model=model))


def test_windows_need_every_joint():
    recording = swung("a", 1.0, 1.0)
    assert why_no_windows(scene(), recording) == ""
    assert "no position of swing was measured" in why_no_windows(scene(), swung("a", 1.0, 1.0, ("torque",)))


def test_windows_of_a_long_log_lie_one_in_each_stretch_and_at_different_phases():
    config = WindowConfig().sampled(480.0)
    assert config.every == 480.0 / config.samples and config.length == config.sample_length
    assert WindowConfig().sampled(10.0).every == config.sample_length  # a short one is not thinned out
    last, least, every = 12000, 350, 600.0
    places = _spread(last, least, every)
    assert len(places) == 20 and places.min() >= 0 and places.max() <= last
    np.testing.assert_array_equal(places // 600, np.arange(20))
    assert np.diff(places).min() >= least and len(np.unique(places % 600)) == 20
    np.testing.assert_array_equal(_spread(90, 40, 200.0), [55])
    crowded = _spread(2300, 1500, 1500.0)  # 2300 / 1500 rounds up
    assert len(crowded) == 1 or np.diff(crowded).min() >= 1500


def test_windows_that_are_left_out_are_not_compared(space: Space):
    """The others are the same at a finer time step, with residuals as small at the truth."""
    config, windows = CompareConfig(channels={"position": 1.0}), replace(SHORT, every=0.8)
    log = windowed_log(scene(), space, [swung("a", 1.0, 0.7, noise=NOISE)], config, windows)
    assert log.unit.max() + 1 == 2 and log.unit_seconds == SHORT.length
    gaps = np.diff(log.pieces[0].windows.begin)
    assert gaps.min() >= SHORT.length
    assert np.sqrt(np.mean(log.residual(space.values(TRUE)) ** 2)) < 2 * NOISE
    finer = log.finer(with_options(scene(), timestep=0.002), space)
    np.testing.assert_allclose(finer.pieces[0].windows.begin, log.pieces[0].windows.begin)


def test_short_logs_have_windows_at_different_places_and_some_are_test_data(space: Space):
    """Each log gave one window at its beginning, all for training, and a log that was too short raised an error."""
    config, windows = CompareConfig(channels={"position": 1.0}), replace(SHORT, length=1.0, every=1.0)
    logs = [replace(swung("a", 1.0, 0.7), name=name) for name in "abc"]
    stub = replace(logs[0].window(0.0, 1.0), name="stub")
    log = windowed_log(scene(), space, [logs[0], stub, *logs[1:]], config, windows, fitted_share=2 / 3)
    begin = np.concatenate([piece.windows.begin for piece in log.pieces])
    assert len(begin) == 3 and np.diff(np.sort(begin)).min() > 0.1 and begin.max() > 0.6
    assert (log.fitted, log.unit.max() + 1) == (2, 3) and log.too_short == ("stub",)
    assert log.comparisons[0].name == "a and b and c"
    with pytest.raises(ValueError, match="'stub' of 1 s is shorter than one window"):
        windowed_log(scene(), space, [stub], config, windows)


class Caught(Exception):
    """Arguments with which a log was to be made."""


@pytest.mark.parametrize(
    ("replay", "longest", "how"),
    [
        ("auto", 3.0, (False, 0.8)),
        ("auto", 4.0, (True, None)),
        ("whole", 3.0, (True, None)),
        ("windows", 3.0, (False, None)),
    ],
)
def test_long_motions_of_held_joints_are_sampled(
    space: Space, monkeypatch: pytest.MonkeyPatch, replay: Any, longest: float, how: tuple[bool, float | None]
):
    """Two logs of almost two seconds each, unless `replay` is set."""

    def catch(*given: Any, whole: bool) -> None:
        raise Caught(whole, given[4].every)

    monkeypatch.setattr(log_case, "windowed_log", catch)
    windows = WindowConfig(longest=longest, samples=5, sample_length=0.4)
    config = DiscrepancyConfig(channels=("position",), replay=replay, windows=windows)
    train, test = [swung("a", 1.0, 0.7), swung("b", 1.0, 0.9)], [swung("c", 1.0, 0.5)]
    with pytest.raises(Caught) as caught:
        log_case.windowed_case(scene(), space, library(scene(), ["joint_coulomb"]), train, test, config)
    assert caught.value.args == (how[0], pytest.approx(how[1], rel=0.01) if how[1] else None)


def test_the_fit_of_a_log_begins_at_given_values(space: Space, monkeypatch: pytest.MonkeyPatch):
    """They are clipped to the bounds.  Without them it begins at the best of some draws."""
    begun = list[np.ndarray]()

    def caught(log: WindowedLog, base: Space, effects: Any, end: float, config: Any, first: Any, *more: Any) -> None:
        begun.append(log.space.select(base.names).to_search(first[log.space.columns(base)]))
        raise Caught

    monkeypatch.setattr(log_case, "noise_of", caught)
    monkeypatch.setattr(log_case, "_first_values", lambda log, *given: log.space.mean)
    monkeypatch.setattr(WindowedLog, "about", lambda log, values: log)
    asked = library(scene(), ["joint_coulomb"]), [swung("a", 1.0, 0.7)]
    found = np.array([0.2, 1.0])  # the armature may not be so large
    config = DiscrepancyConfig(compare=CompareConfig(channels={"position": 1.0}))
    for start in (None, found):
        with pytest.raises(Caught):
            log_case.windowed_case(scene(), space, *asked, (), config, start)
    expected = [space.to_search(v) for v in (space.mean, np.array([0.2, 0.1]))]
    np.testing.assert_allclose(begun, expected)


def test_mj_step_is_refused_for_windows(space: Space):
    """The replay has steps of second order and would ignore the setting."""
    config = CompareConfig(channels={"position": 1.0}, mj_step=True)
    with pytest.raises(ValueError, match=r"mj_step is for repeats .* leave mj_step out"):
        windowed_log(scene(), space, [swung("a", 1.0, 0.7)], config, SHORT)


def test_logs_may_have_their_joints_in_different_order():
    """Logs of one robot were refused if a program wrote its joints in another order."""
    space = Space((joint_damping(arm(), "elbow", std=0.1, high=50.0),))
    first = recording(channels={"position": measured(0.0)["position"]}).repeats_subset([0])
    position, config = first.channels["position"], CompareConfig(channels={"position": 1.0})
    turned = replace(position, columns=JOINTS[::-1], values=position.values[..., ::-1], mask=position.mask[..., ::-1])
    second = replace(first, name="turned", channels={"position": turned})
    log = windowed_log(arm(), space, [first, second], config, SHORT)
    assert [piece.columns["position"].tolist() for piece in log.pieces] == [[0, 1], [0, 1]]
    np.testing.assert_allclose(log.pieces[0].measured, log.pieces[1].measured)
    alone = replace(position, columns=JOINTS[:1], values=position.values[..., :1], mask=position.mask[..., :1])
    one = replace(first, name="one", channels={"position": alone})
    with pytest.raises(ValueError, match=r"different joints: wave of shoulder, elbow; one of shoulder; .*--joints sho"):
        windowed_log(arm(), space, [first, one], config, SHORT, whole=True)


# ----- residuals of windows


def log_of(space: Space, recordings: list[Recording], **changes: Any) -> WindowedLog:
    config = CompareConfig(channels={"position": 1.0})
    return windowed_log(scene(), space, recordings, config, SHORT, **changes)


def whole_log(space: Space, recordings: list[Recording], **changes: Any) -> WindowedLog:
    config, windows = CompareConfig(channels={"position": 1.0}), WindowConfig(lead=0.0)
    return windowed_log(scene(), space, recordings, config, windows, whole=True, **changes)


def test_the_residual_of_windows_is_noise_at_the_truth(space: Space):
    """For recordings of different gains; the noise includes the spread of the initial states."""
    log = log_of(space, [swung("a", 1.0, 0.7, noise=NOISE), swung("soft", 0.6, 1.1, noise=NOISE)], fitted_share=0.7)
    truth = space.values(TRUE)
    assert log.unit.max() + 1 == 8 and log.fitted == 6 and log.whole == ""
    left, wrong = log.residual(truth), log.residual(space.mean)
    assert np.sqrt(np.mean(left**2)) < 2 * NOISE < 0.1 * np.sqrt(np.mean(wrong**2))
    noise = np.full(1, 0.4 * NOISE)  # about what the low pass leaves of it
    everywhere = np.ones(len(log.clock), bool)
    plain, aware = (of.with_noise(noise, everywhere).whitened(truth[None])[0] for of in (log, log.about(truth)))
    assert np.mean(aware**2) < np.mean(plain**2) and 0.2 < np.mean(aware**2) < 2.0
    some = log.unit == 2
    part = log.with_noise(noise, some)
    np.testing.assert_allclose(part.whitened(truth[None])[0], np.where(some, plain, 0.0), atol=1e-4)
    assert part.distances(truth[None])[0, 0] == pytest.approx(np.mean(np.abs(left[some])), rel=1e-3)
    (rollout,) = log.rollouts(truth[None])
    assert np.abs(rollout.position[0] - log.measured).max() < 0.02 and rollout.position.shape == (1, 64, 1)


def test_a_log_of_windows_is_no_cost(space: Space):
    """As a `Cost` it had methods that raised obscure errors or returned an empty cost (`against`, `alone`)."""
    log = log_of(space, [swung("a", 1.0, 0.7)])
    assert not isinstance(log, Cost) and not hasattr(log, "alone")
    rows = block_residual_set(log.with_noise(np.ones(1), np.ones(len(log.clock), bool)), log.unit, least=1)
    assert rows.cost.comparisons == log.comparisons
    case = Case(rows, rows, None, space, (), DiscrepancyConfig())
    with pytest.raises(ValueError, match="a case of windows has no repeats to replace"):
        case.against({"train": swung("a", 1.0, 0.7)})


def test_windows_hold_the_servo_path_before_them(space: Space):
    """A goal that may move by 0.7 rad/s lags for longer than delays do: it began at rest on the last goals alone.

    The size is that of the score test, at which slow commands must be limited.
    """
    effects = library(scene(), ["profile_speed"])
    step = SelectionConfig().sensitivity_step * effects[0].parameters[0].std
    whole, theta = joined(space, effects), {"profile_speed[swing]": step}
    assert effects[0].profile is not None and theta["profile_speed[swing]"] == pytest.approx(1.5)
    log = log_of(whole, [swung("a", 1.0, 0.7)], effects=effects)
    windows, command = log.pieces[0].windows, log.drives[0].command
    path = np.asarray(effects[0].profile(theta, jnp.asarray(command), 0.004))
    assert np.abs(path - command).max() > 0.2
    for begin, table in zip(windows.begin, windows.table, strict=True):
        first = round(begin / 0.004)
        drawn = effects[0].profile(theta, jnp.asarray(table), 0.004)[windows.earlier :]
        np.testing.assert_allclose(drawn, path[first : first + windows.steps], atol=1e-4)


@pytest.mark.slow
def test_a_motion_that_is_replayed_whole_has_stretches(space: Space):
    """The stretches make blocks, as windows do."""
    log = whole_log(space, [swung("a", 1.0, 0.7, noise=NOISE)], fitted_share=0.5)
    assert log.whole and log.unit.max() + 1 == 3 and log.fitted == 2 and log.unit_seconds == 0.5
    left = log.residual(space.values(TRUE))
    assert np.sqrt(np.mean(left**2)) < 2 * NOISE
    white = log.with_noise(np.full(1, NOISE), log.unit < 2).whitened(space.values(TRUE)[None])[0]
    np.testing.assert_allclose(white, np.where(log.unit < 2, -left[:, 0] / NOISE, 0.0), atol=1e-3)
    again = whole_log(space, [with_a_gap()], fitted_share=0.5)
    instants = [set(np.round(of.pieces[0].at.ravel(), 6)) for of in (again, log)]
    assert instants[0] < instants[1] and len(instants[0]) > 0.5 * len(instants[1])
    assert np.sqrt(np.mean(again.residual(space.values(TRUE)) ** 2)) < 2 * NOISE


def of_two_lengths() -> list[Recording]:
    first, second = swung("a", 1.0, 0.7), swung("soft", 0.6, 1.1)
    return [first, second.window(0.0, 0.9 * second.duration)]


def test_motions_of_about_one_length_are_replayed_together(space: Space):
    """A much shorter motion is not in their batch."""
    assert shared_steps([400, 100, 380, 390]) == [400, 100, 400, 400] and shared_steps([7]) == [7]
    both = whole_log(space, of_two_lengths())
    assert both.pieces[0].program is both.pieces[1].program


def test_a_drift_is_centred_on_the_motion_itself(space: Space):
    """It is not centred on the longer motion with the same program, where it would add an offset."""
    drift = library(scene(), ["torque_drift"])
    log = whole_log(joined(space, drift), of_two_lengths(), effects=drift)
    lasting = [len(drive.command) for drive in log.drives]
    assert [piece.windows.steps for piece in log.pieces] == lasting and lasting[1] < 0.95 * lasting[0]


@pytest.mark.slow
def test_a_motion_is_the_same_alone_and_in_a_batch_with_another(space: Space):
    logs = of_two_lengths()
    rows, both = np.stack([space.mean, space.values(TRUE)]), whole_log(space, logs)
    alone = [whole_log(space, [log]).simulated(rows) for log in logs]
    np.testing.assert_allclose(both.simulated(rows), np.concatenate(alone, axis=1), atol=1e-5)


def with_a_gap() -> Recording:
    whole = swung("a", 1.0, 0.7, noise=NOISE)
    channel = whole.channel("position")
    mask = channel.mask.copy()
    mask[0, 90:120] = False  # 0.72 to 0.96 s
    return replace(whole, channels={"position": replace(channel, mask=mask)})


def test_a_masked_stretch_leaves_its_windows_out(space: Space):
    log, full = log_of(space, [with_a_gap()]), log_of(space, [swung("a", 1.0, 0.7, noise=NOISE)])
    assert full.unit.max() + 1 == 4 and log.unit.max() + 1 == 2
    assert set(np.round(log.pieces[0].at.ravel(), 6)) < set(np.round(full.pieces[0].at.ravel(), 6))


def half_measured() -> Recording:
    """Two repeats, the second of which has hardly a measured sample."""
    both = swung("a", 1.0, 0.7, noise=NOISE, repeats=2)
    channel = both.channel("position")
    mask = channel.mask.copy()
    mask[1, 3:] = False
    return replace(both, channels={"position": replace(channel, mask=mask)})


def test_a_repeat_that_was_not_measured_is_left_out(space: Space):
    log, full = log_of(space, [half_measured()]), log_of(space, [swung("a", 1.0, 0.7, noise=NOISE)])
    assert [piece.count for piece in log.pieces] == [piece.count for piece in full.pieces]


def test_a_finer_time_step_is_compared_at_the_same_instants(space: Space):
    """The motions end between two steps, some just after an instant that a finer step still reaches."""
    first = swung("a", 1.0, 0.7, noise=NOISE)
    for end in np.linspace(1.501, 1.603, 35):
        commanded = first.time < end - 1e-6
        time = np.r_[first.time[commanded], end]
        cut = replace(first, time=time, command=np.r_[first.command[commanded], first.command[commanded][-1:]])
        log = whole_log(space, [cut])
        finer = log.finer(with_options(scene(), timestep=float(scene().model.opt.timestep) / 4), space)
        np.testing.assert_allclose(finer.pieces[0].at, log.pieces[0].at)


def test_effects_over_time_are_not_tested_in_windows(space: Space):
    """A clock rate is tested in whole motions alone."""
    effects = library(scene(), ["clock_rate", "joint_coulomb"])
    assert {e.name for e in effects if e.over_time} == {"clock_rate"}
    asked = list[set[str]]()

    def catch(of: Scene, over: Space, recordings: Any, compare: Any, windows: Any, effects: Any, *_: Any, **__: Any):
        asked.append({e.name for e in effects})
        raise Caught

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_case, "windowed_log", catch)
        for replay in ("windows", "whole"):
            config = DiscrepancyConfig(channels=("position",), replay=replay)
            with pytest.raises(Caught):
                log_case.windowed_case(scene(), space, effects, [swung("a", 1.0, 0.7)], [], config)
    assert asked == [{"joint_coulomb"}, {"clock_rate", "joint_coulomb"}]


def test_the_noise_of_a_window_includes_the_spread_of_its_state():
    rng = np.random.default_rng(1)
    spread = rng.normal(size=(3, 5, 2, 4))  # windows, instants, columns, directions
    deviation, counted = np.array([0.3, 2.0]), np.ones((3, 5, 1), bool)
    counted[2, 3:] = False
    each = np.broadcast_to(np.eye(10).reshape(10, 1, 5, 2), (10, 3, 5, 2))  # one residual after the other
    matrices = _whitener(deviation, spread, counted)(each).reshape(10, 3, 10)
    for matrix, s in zip(np.moveaxis(matrices, 0, 2), spread * counted[..., None], strict=True):
        covariance = np.diag(np.tile(deviation, 5) ** 2) + s.reshape(10, 4) @ s.reshape(10, 4).T
        np.testing.assert_allclose(matrix @ covariance @ matrix.T, np.eye(10), atol=1e-9)


def test_the_start_of_a_whole_motion_is_uncertain(space: Space):
    """The noise includes the effect of a wrong start, computed from the compared instants alone."""
    truth, right = space.values(TRUE), swung("a", 1.0, 0.7, noise=NOISE)
    off = replace(right, qpos0={joint: start + 20 * NOISE for joint, start in right.measured_start().items()})
    log, noise = whole_log(space, [off]).about(truth), np.full(1, NOISE)
    half = log.unit < 2
    without = replace(log, spreads=())
    plain, aware = (of.with_noise(noise, half).whitened(truth[None])[0][half] for of in (without, log))
    assert np.mean(plain**2) > 3.0 and np.mean(aware**2) < 1.0
    later = log.measured + np.where(half, 0.0, 1.0)[:, None]
    (channel,) = log.comparisons[0].channels
    moved = replace(channel, noise=replace(channel.noise, mean=later))
    other = replace(log, comparisons=(replace(log.comparisons[0], channels=(moved,)),))
    np.testing.assert_allclose(other.with_noise(noise, half).whitened(truth[None])[0][half], aware, atol=1e-9)


def test_effects_on_torque_sensors_are_not_tested_in_positions():
    recording = swung("a", 1.0, 1.0, ("position", "torque"))
    asked = [{e.name for e in observable_effects(scene(), [recording], channels=c)} for c in (["position"], ["torque"])]
    assert asked[1] - asked[0] == {"torque_bias", "torque_gain", "torque_drift", "sensor_delay"}
    assert "command_delay" in asked[0] and asked[0] < asked[1]


# ----- blocks of windows


def plan_of(units: int, fitted: int, length: float, with_test: bool = True) -> Any:
    """Blocks of a log whose units last a second and hold four instants each."""
    log: Any = SimpleNamespace(
        unit=np.repeat(np.arange(units), 4), fitted=fitted, unit_seconds=1.0, comparisons=[SimpleNamespace(name="log")]
    )
    return planned(log, length, BlocksConfig(), with_test)


def test_blocks_of_whole_windows_alternate():
    plan = plan_of(60, 40, 1.9)
    train, validation, test = plan.blocks
    assert not plan.limits and train.max() == validation.max() == 9 and test.max() == 7
    assert not np.any((train != OUTSIDE) & (validation != OUTSIDE))
    assert np.all((train != OUTSIDE) | (validation != OUTSIDE) == (np.arange(240) < 160))
    assert np.all((test != OUTSIDE) == (np.arange(240) >= 160))
    for block in range(10):
        assert np.all(np.diff(np.flatnonzero(train == block)) == 1) and np.sum(train == block) == 8


@pytest.mark.parametrize(
    ("units", "fitted", "length", "blocks", "said"),
    [
        (30, 20, 3.0, [8, 8, 8], ["Blocks of 1.2 s are shorter than the 3 s"]),
        (23, 15, 1.0, [8, 8, 7], []),
        (18, 12, 1.0, [8, 8], ["too short to keep a part of it as test data"]),
        (9, 6, 0.5, [4, 4], ["too short to keep"]),
        (
            6,
            4,
            0.5,
            [3, 3],
            ["too short to keep", "Only 6 blocks train and validate", "no effect stands out from chance"],
        ),
    ],
)
def test_a_short_log_has_shorter_blocks_then_no_test_part_then_fewer_blocks(
    units: int, fitted: int, length: float, blocks: list[int], said: list[str]
):
    plan = plan_of(units, fitted, length)
    assert [int(b.max()) + 1 for b in plan.blocks] == blocks
    assert all(any(words in limit for limit in plan.limits) for words in said) and bool(plan.limits) == bool(said)
    with pytest.raises(ValueError, match="record for 16 s or longer"):
        plan_of(3, 2, 0.5)


# ----- a search


@pytest.mark.slow
@pytest.mark.usefixtures("seconds")
def test_nothing_is_named_in_a_log_of_positions_with_nothing_missing(space: Space):
    effects = library(scene(), ["joint_coulomb", "cable_pull", "command_delay"])
    log = swung("a", 1.0, 0.31, noise=NOISE)
    verdict, _ = dj.find_missing_effects(scene(), space, [log], effects=effects)
    assert verdict.conclusion is Conclusion.NONE


@pytest.mark.slow
@pytest.mark.usefixtures("seconds")
def test_friction_explains_a_log_of_positions(space: Space):
    """Friction of 0.02 N m explains the log.  It is not named, since it is below the minimum effect size."""
    effects = library(scene(), ["joint_coulomb", "cable_pull", "command_delay"])
    stuck = swung("rubs", 1.0, 0.31, noise=NOISE, friction=0.02)
    verdict, _ = dj.find_missing_effects(scene(), space, [stuck], effects=effects)
    assert verdict.score_tests[0].p < 0.01 and verdict.conclusion is Conclusion.UNEXPLAINED
    best = next(t for t in verdict.validation_tests if [k.effect for k in t.keys] == ["joint_coulomb"])
    assert best.weak and best.discrepancy_validation < 0.01 * verdict.discrepancies["validation"][0]
    assert "joint_coulomb at swing, below the minimum effect size" in verdict.sentence
