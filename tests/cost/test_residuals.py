"""Residuals, and replays kept on disk."""

from __future__ import annotations

import copy
import tracemalloc
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from droid_jax.cost import observation as measured
from droid_jax.cost.replay_cache import Batched, cached
from droid_jax.cost.residuals import CompareConfig, Comparison, make_comparison, with_estimated_noise
from droid_jax.door.scene import door_scene
from droid_jax.identify.fit import search_cost
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Phase, Recording, TorqueConvention, TorqueSide

JOINTS = ("a", "b", "c")
STEP, STEPS = 0.002, 1001
CLOCK = STEP * np.arange(STEPS)
XML = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size=".1"/>
  <body pos="0 0 1"><joint name="b" axis="0 1 0"/><geom size=".1"/>
  <body pos="0 0 1"><joint name="c" axis="0 1 0"/><geom size=".1"/></body></body></body></worldbody>
  <actuator><position joint="a"/><position joint="b"/><position joint="c"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(XML), "chain")


@pytest.fixture(scope="module")
def door() -> Scene:
    return door_scene()


def smooth_traces(columns: int, seed: int, clock: np.ndarray = CLOCK) -> np.ndarray:
    """[T, C] sums of sines below 3 Hz with an amplitude of about 3."""
    rng = np.random.default_rng(seed)
    waves = [
        rng.normal(0, 1.5, columns)
        * np.sin(2 * np.pi * rng.uniform(0.2, 3, columns) * clock[:, None] + rng.normal(size=columns))
        for _ in range(4)
    ]
    return np.sum(waves, axis=0) + rng.normal(0, 2, columns)


def rollout(**parts) -> Rollout:
    start = dict(
        time=CLOCK,
        torque=smooth_traces(3, 1),
        position=smooth_traces(3, 2),
        velocity=smooth_traces(3, 3),
        object_angle=np.linspace(0, 0.8, STEPS),
        contact=np.ones((STEPS, 2), bool),
        finite=np.array(True),
    )
    return Rollout(**{**start, **parts})


def channel(name: str, time: np.ndarray, values: np.ndarray, columns=JOINTS, mask: np.ndarray | None = None) -> Channel:
    unit = {"torque": "N m", "velocity": "rad/s"}.get(name, "rad")
    return Channel(name, unit, tuple(columns), time, values, np.ones(values.shape, bool) if mask is None else mask)


def recording(*channels: Channel, start: float = 0.0, phases: tuple[Phase, ...] = ()) -> Recording:
    return Recording(
        name="test",
        time=start + CLOCK,
        command=np.zeros((STEPS, 3)),
        command_names=JOINTS,
        channels={c.name: c for c in channels},
        torque=TorqueConvention(TorqueSide.MOTOR, False),
        qpos0={},
        phases=phases,
    )


def rows(data: Recording) -> np.ndarray:
    """[STEPS] s, the replay's clock."""
    return data.time[0] + STEP * np.arange(STEPS)


def compare(scene: Scene, data: Recording, **config) -> Comparison:
    return make_comparison(scene, data, rows(data), CompareConfig(**config))


def equation_1(channels: Mapping[str, tuple[Channel, float, np.ndarray]], clock: np.ndarray) -> float:
    """sum over channels of w * 1/N sum_r 1/T_r sum_t ||tau_s(t) - tau_r(t)||, one number at a time."""
    total = 0.0
    for c, weight, simulated in channels.values():
        repeats = []
        for n in range(len(c.values)):
            norms = []
            for k, at in enumerate(c.time):
                if not clock[0] <= at <= clock[-1]:
                    continue
                squares = [
                    (np.interp(at, clock, simulated[:, JOINTS.index(j)]) - c.values[n, k, i]) ** 2
                    for i, j in enumerate(c.columns)
                    if c.mask[n, k, i]
                ]
                if squares:
                    norms.append(np.sqrt(sum(squares)))
            repeats.append(np.mean(norms))
        total += weight * np.mean(repeats)
    return float(total)


def test_distance_is_equation_1(scene: Scene):
    """Three repeats with different clocks and orders of columns, gaps, and NaN where nothing was measured."""
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0, 2.0, 150))
    values = rng.normal(0, 2, (3, 150, 2))
    mask = rng.random(values.shape) > 0.3
    mask[1, 20:60] = False
    torque = channel("torque", time, np.where(mask, values, np.nan), ("c", "a"), mask)
    slow = np.arange(0, 2.0, 1 / 30)
    position = channel("position", slow, rng.normal(size=(3, len(slow), 3)))
    weights = {"torque": 0.7, "position": 4.0}
    # the holes of `torque` are too long to be whitened: the loop must agree before any of that
    mask[0, :, :] |= True
    torque.values[:] = np.where(mask, values, np.nan)
    comparison = compare(scene, recording(torque, position), channels=weights)
    simulated = rollout()
    expected = equation_1(
        {"torque": (torque, 0.7, simulated.torque), "position": (position, 4.0, simulated.position)}, CLOCK
    )
    assert float(comparison.distance(simulated)) == pytest.approx(expected, rel=1e-5)


def test_the_origin_of_the_clock_does_not_matter(scene: Scene):
    """Recording and channel share an arbitrary origin of time."""
    values = np.random.default_rng(0).normal(size=(2, STEPS, 3))
    now = compare(scene, recording(channel("torque", CLOCK, values)))
    later = compare(scene, recording(channel("torque", 100.0 + CLOCK, values), start=100.0))
    assert float(later.distance(rollout())) == pytest.approx(float(now.distance(rollout())), rel=1e-5)
    expected = np.mean(np.linalg.norm(values - rollout().torque, axis=-1))
    assert float(now.distance(rollout())) == pytest.approx(expected, rel=1e-5)


def test_samples_beyond_the_replay_are_left_out(scene: Scene):
    time = np.arange(-0.5, 3.0, 0.01)
    inside = (time >= 0) & (time <= CLOCK[-1] + 1e-9)
    values = np.random.default_rng(1).normal(size=(1, len(time), 3))
    values[:, ~inside] = 1e6
    simulated = np.stack([np.interp(time[inside], CLOCK, c) for c in rollout().torque.T], axis=1)
    expected = np.mean(np.linalg.norm(values[0, inside] - simulated, axis=-1))
    got = compare(scene, recording(channel("torque", time, values))).distance(rollout())
    assert float(got) == pytest.approx(expected, rel=1e-5)


def test_a_repeat_that_was_not_measured_is_in_no_mean(scene: Scene):
    simulated = rollout()
    values = np.stack([np.asarray(simulated.torque) + np.array([1.0, 0.0, 0.0])] * 4)
    mask = np.ones(values.shape, bool)
    mask[3] = False
    measured = recording(channel("torque", CLOCK, values, mask=mask))
    assert float(compare(scene, measured).distance(simulated)) == pytest.approx(1.0, rel=1e-5)


# ----- beta


PHASES = (Phase("approach", 0.0, 0.4), Phase("grasp", 0.4, 0.6), Phase("opening", 0.6, 1.8))


def door_comparison(door: Scene, *, angle: np.ndarray | None = None, phases=PHASES, **config) -> Comparison:
    values = np.random.default_rng(0).normal(size=(2, STEPS, 7))
    channels = [channel("torque", CLOCK, values, [f"panda_joint{i}" for i in range(1, 8)])]
    if angle is not None:
        channels.append(channel("object_angle", CLOCK, np.tile(angle[:, None], (2, 1, 1)), ["hinge"]))
    data = recording(*channels, phases=phases)
    return make_comparison(door, data, rows(data), CompareConfig(**config))


def door_rollout(**parts) -> Rollout:
    return rollout(torque=smooth_traces(7, 1), **parts)


def contact(*gaps: tuple[float, float, int]) -> np.ndarray:
    """Both fingers touch from 0.5 s on, except in gaps (start, end, finger)."""
    out = np.zeros((STEPS, 2), bool)
    out[CLOCK >= 0.5] = True
    for start, end, finger in gaps:
        out[(start <= CLOCK) & (end > CLOCK), finger] = False
    return out


@pytest.mark.parametrize(
    ("gaps", "lost"),
    [
        ((), False),
        (((0.8, 0.85, 0),), False),  # a bounce: 3.6 % of the gripping time
        (((0.8, 0.95, 1),), True),
        (((0.8, 0.84, 0), (1.0, 1.04, 1)), True),  # 2.9 % each, 5.7 % together
        (((1.99, 2.1, 0),), True),  # lost at the very end
        (((0.0, 0.55, 0),), False),  # before the grasp has ended nothing is asked
    ],
)
def test_a_lost_grasp_costs_c(door: Scene, gaps: tuple, lost: bool):
    comparison = door_comparison(door)
    held = door_rollout(contact=contact())
    tried = door_rollout(contact=contact(*gaps))
    assert bool(comparison.failed(tried)) is lost
    extra = float(comparison.distance(tried)) - float(comparison.distance(held))
    assert extra == pytest.approx(10.0 if lost else 0.0, abs=1e-4)


def test_after_the_release_nothing_is_held(door: Scene):
    phases = (*PHASES, Phase("release", 1.8, 2.0))
    let_go = contact((1.8, 2.1, 0), (1.8, 2.1, 1))
    assert not door_comparison(door, phases=phases).failed(door_rollout(contact=let_go))
    assert door_comparison(door).failed(door_rollout(contact=let_go))


def test_without_phases_no_grasp_is_required(door: Scene):
    nothing = door_rollout(contact=np.zeros((STEPS, 2), bool))
    assert not door_comparison(door, phases=()).failed(nothing)


@pytest.mark.parametrize(("opened", "shut"), [(0.05, True), (0.086, True), (0.09, False), (0.5, False)])
def test_a_door_that_stays_shut_costs_c(door: Scene, opened: float, shut: bool):
    """The least angle is five degrees."""
    tried = door_rollout(object_angle=np.linspace(0, opened, STEPS))
    comparison = door_comparison(door, failure_cost=3.0)
    assert bool(comparison.failed(tried)) is shut
    extra = float(comparison.distance(tried)) - float(comparison.distance(door_rollout()))
    assert extra == pytest.approx(3.0 if shut else 0.0, abs=1e-4)


def test_a_door_must_open_half_as_far_as_the_measured_one(door: Scene):
    comparison = door_comparison(door, angle=np.linspace(0, 0.8, STEPS))
    for opened, shut in ((0.39, True), (0.41, False)):
        assert bool(comparison.failed(door_rollout(object_angle=np.linspace(0, opened, STEPS)))) is shut


def test_a_lid_may_open_downwards_from_anywhere(door: Scene):
    """Its angle decreases: the travel counts, not the position."""
    comparison = door_comparison(door, angle=np.linspace(-0.3, -1.1, STEPS))
    for opened, shut in ((0.39, True), (0.41, False)):
        assert bool(comparison.failed(door_rollout(object_angle=np.linspace(-0.3, -0.3 - opened, STEPS)))) is shut


def test_the_travel_of_a_drawer_is_compared_with_the_measured_one_only(door: Scene):
    """The least angle does not apply to a slide."""
    model = copy.copy(door.model)
    model.jnt_type[door.id("joint", "hinge")] = mujoco.mjtJoint.mjJNT_SLIDE
    drawer = replace(door, model=model)
    assert not door_comparison(drawer).failed(door_rollout(object_angle=np.zeros(STEPS)))
    comparison = door_comparison(drawer, angle=np.linspace(0, 0.06, STEPS))
    for opened, shut in ((0.025, True), (0.035, False)):
        assert bool(comparison.failed(door_rollout(object_angle=np.linspace(0, opened, STEPS)))) is shut


def test_a_part_of_a_motion_in_which_nothing_opens_does_not_fail(door: Scene):
    """Neither five degrees nor a grip at the last row are required, since the measured door stays shut."""
    still = door_rollout(object_angle=np.zeros(STEPS), contact=contact())
    assert not door_comparison(door, angle=np.linspace(0, 0.01, STEPS)).failed(still)
    later = np.where(CLOCK < 1.99, 0.0, 0.8)  # of the replay's own time alone
    values = np.tile(later[:, None], (2, 1, 1))
    data = recording(channel("object_angle", CLOCK, values, ["hinge"]), phases=PHASES)
    torque = channel("torque", CLOCK, np.random.default_rng(0).normal(size=(2, STEPS, 1)), ["panda_joint1"])
    data = replace(data, channels={**data.channels, "torque": torque})
    assert make_comparison(door, data, CLOCK, CompareConfig()).failed(still)
    assert not make_comparison(door, data, CLOCK[:900], CompareConfig()).failed(still)
    shut = door_rollout(object_angle=np.zeros(STEPS), contact=np.zeros((STEPS, 2), bool))
    to_the_grasp = (Phase("approach", 0.0, 0.4), Phase("grasp", 0.4, CLOCK[-1]))
    assert not door_comparison(door, phases=to_the_grasp).failed(shut)
    assert not door_comparison(door, phases=to_the_grasp[:1]).failed(shut)
    assert door_comparison(door).failed(still)


def test_a_log_without_commands_grips_and_opens_nothing(door: Scene):
    """Its replay has no grip and no object that could fail."""
    values = np.random.default_rng(0).normal(size=(2, STEPS, 7))
    joints = [f"panda_joint{i}" for i in range(1, 8)]
    log = recording(channel("torque", CLOCK, values, joints), phases=PHASES)
    log = replace(log, time=np.zeros(0), command=np.zeros((0, 0)), command_names=())
    comparison = make_comparison(door, log, CLOCK, CompareConfig())
    assert not comparison.failed(door_rollout(object_angle=np.zeros(STEPS), contact=np.zeros((STEPS, 0), bool)))


# ----- replays that blew up


@pytest.mark.parametrize("whitened", [False, True])
def test_a_replay_that_blew_up_has_finite_costs(scene: Scene, whitened: bool):
    values = np.random.default_rng(0).normal(size=(2, STEPS, 3))
    comparison = compare(scene, recording(channel("torque", CLOCK, values)), whitened=whitened)
    for bad in (np.nan, np.inf, 1e38):
        torque = smooth_traces(3, 1)
        torque[400:] = bad
        tried = rollout(torque=torque, finite=np.array(bool(np.isfinite(torque).all())))
        cost = float(comparison.distance(tried))
        assert np.isfinite(cost) and cost >= 999.9
        assert np.isnan(np.asarray(comparison.whitened(tried))).all()


@pytest.mark.parametrize("config", [{"whitened": True}, {"channels": {"torque": 50.0}}], ids=["whitened", "weighed"])
def test_a_replay_that_blew_up_costs_more_than_one_that_is_far_off(scene: Scene, config: dict):
    """In noise units too, where an error of 100 N m costs more than 1000."""
    values = np.random.default_rng(0).normal(0, 0.02, size=(4, STEPS, 3))
    comparison = compare(scene, recording(channel("torque", CLOCK, values)), **config)
    far, blown = rollout(torque=100.0 + 0 * smooth_traces(3, 1)), rollout(finite=np.array(False))
    assert (
        1000.0
        < float(comparison.distance(far))
        < float(comparison.distance(blown))
        == pytest.approx(comparison.penalty)
    )
    space = Space((Parameter("x", "-", 0.0, 1.0, -1.0, 1.0),))
    costs = np.array([comparison.distance(far), comparison.distance(blown)])
    searched = search_cost(lambda rows: costs, comparison.penalty, space, space)(np.zeros((2, 1)))
    assert np.isfinite(searched).tolist() == [True, False]


# ----- whitened residuals


def noisy(truth: np.ndarray, rng: np.random.Generator, repeats: int) -> np.ndarray:
    """White and first-order autoregressive noise of every repeat, [N, T, C]."""
    out = np.empty((repeats, *truth.shape))
    for n in range(repeats):
        slow = np.zeros(truth.shape)
        for t in range(1, len(truth)):
            slow[t] = 0.987 * slow[t - 1] + 0.16 * 0.03 * rng.normal(size=truth.shape[1])
        out[n] = truth + slow + 0.05 * rng.normal(size=truth.shape)
    return out


def test_the_truth_has_residuals_of_one(scene: Scene):
    truth, rng = smooth_traces(3, 1), np.random.default_rng(8)
    squares, other = [], []
    for _ in range(6):
        data = recording(channel("torque", CLOCK, noisy(truth, rng, 10)))
        comparison = compare(scene, data)
        squares.append(np.mean(np.asarray(comparison.whitened(rollout(torque=truth))) ** 2))
        other.append(np.mean(np.asarray(comparison.whitened(rollout(torque=truth + 0.2))) ** 2))
    # Ten repeats know their own noise to a quarter; shrinking towards white noise errs on the large side.
    assert 0.5 < np.mean(squares) < 1.3
    assert np.mean(other) > 3 * np.mean(squares)


def without_noise(scene: Scene, time: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Whitened residuals of a simulation that equals the data, in units of 0.01 N m white noise."""
    truth = smooth_traces(3, 1)
    data = np.stack([np.interp(time, CLOCK, c) for c in truth.T], axis=1)[None]
    values = np.repeat(data, 2, axis=0)
    comparison = compare(scene, recording(channel("torque", time, values, mask=mask)))
    return np.asarray(comparison.whitened(rollout(torque=truth)))


def test_equal_traces_have_no_residual(scene: Scene):
    assert np.abs(without_noise(scene, CLOCK)).max() < 0.02


def test_other_clocks_have_no_residual(scene: Scene):
    """At 1 kHz and 200 Hz the filter is the same, with other samples."""
    for rate in (1000.0, 200.0):
        time = np.arange(0, CLOCK[-1] + 1e-9, 1 / rate)
        assert np.abs(without_noise(scene, time)).max() < 1.0, rate


def test_a_channel_that_covers_part_of_the_motion_has_no_residual(scene: Scene):
    """The filter is truncated at the ends of the data, and must be truncated equally for the simulation."""
    time = np.arange(0.5, 1.5, STEP)
    assert np.abs(without_noise(scene, time)).max() < 1.0


def test_holes_in_the_data_make_no_residual(scene: Scene):
    """Single samples and stretches of 50 ms that were not measured, in either repeat."""
    mask = np.random.default_rng(5).random((2, STEPS, 3)) > 0.05
    mask[0, 300:325] = False
    mask[1, 600:625] = False
    assert np.abs(without_noise(scene, CLOCK, mask)).max() < 3.0


def test_holes_do_not_multiply_the_memory(scene: Scene):
    """One filter per column serves all repeats; there is no array of repeats x columns x samples x samples."""
    values = np.random.default_rng(0).normal(size=(12, STEPS, 3))
    mask = np.random.default_rng(1).random(values.shape) > 0.05
    tracemalloc.start()
    comparison = compare(scene, recording(channel("torque", CLOCK, values, mask=mask)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    instants = len(comparison.channels[0].clock)
    assert peak < 4 * 8 * 3 * instants * STEPS  # bytes of four filters written out for three columns


def test_the_noise_of_a_single_repeat_is_estimated_for_every_channel(scene: Scene):
    """It is the residual of a replay, in the channel's unit."""
    values = rollout().torque[None], rollout().position[None]
    channels = [channel(n, CLOCK, v) for n, v in zip(("torque", "position"), values, strict=True)]
    comparison = compare(scene, recording(*channels), channels={"torque": 1.0, "position": 1.0})
    wave = np.sin(2 * np.pi * 1.5 * CLOCK)[:, None]
    tried = rollout(torque=rollout().torque + 0.5 * wave, position=rollout().position + 0.02 * wave)
    (stated,) = with_estimated_noise([comparison], [tried])
    torque, position = (1 / stated.channel(n).noise.weight[0] for n in ("torque", "position"))
    np.testing.assert_allclose(torque / position, 25.0, rtol=0.01)
    assert np.all(torque > 0.3)
    assert np.mean(np.asarray(stated.whitened(tried)) ** 2) < 1.0
    assert stated.channel("position").noise.weight.shape[1] == 3


def test_recordings_of_the_same_columns_share_an_estimated_noise(scene: Scene):
    """It is the geometric mean of the own and the shared noise."""
    logs = [compare(scene, recording(channel("torque", CLOCK, rollout().torque[None]))) for _ in range(3)]
    repeated = compare(scene, recording(channel("torque", CLOCK, np.repeat(rollout().torque[None], 2, axis=0))))
    wave = np.sin(2 * np.pi * 1.5 * CLOCK)[:, None]
    tried = [rollout(torque=rollout().torque + size * wave) for size in (0.1, 0.5, 0.7, 0.7)]
    *of_logs, untouched = with_estimated_noise([*logs, repeated], tried)
    weights = [c.channel("torque").noise.weight for c in of_logs]
    alone = [
        1 / with_estimated_noise([c], [t])[0].channel("torque").noise.weight[0]
        for c, t in zip(logs, tried, strict=False)
    ]
    assert alone[0] == pytest.approx(alone[2] / 7, rel=0.05)
    shared = np.sqrt(np.mean(np.square(alone), axis=0))
    for weight, own in zip(weights, alone, strict=True):
        np.testing.assert_allclose(1 / weight[0], np.sqrt(own * shared), rtol=0.02)
    assert untouched is repeated


def test_a_log_whose_simulation_blew_up_does_not_change_the_noise_of_others(scene: Scene):
    """The noise of the others is as without it, and its own noise is unchanged."""
    logs = [compare(scene, recording(channel("torque", CLOCK, rollout().torque[None]))) for _ in range(3)]
    wave = np.sin(2 * np.pi * 1.5 * CLOCK)[:, None]
    tried = [rollout(torque=rollout().torque + size * wave) for size in (0.1, 0.5)]
    blown = rollout(torque=np.full_like(rollout().torque, np.nan), finite=np.array(False))
    *both, kept = with_estimated_noise(logs, [*tried, blown])
    alone = with_estimated_noise(logs[:2], tried)
    for one, other in zip(both, alone, strict=True):
        np.testing.assert_array_equal(one.channel("torque").noise.whitener, other.channel("torque").noise.whitener)
    assert kept is logs[2]


def test_repeats_deviate_as_they_are_whitened(scene: Scene):
    """The residual of a model that equals one repeat is that of the mean, plus the repeat's deviation."""
    clean = smooth_traces(3, 2)
    values = clean + np.array([0.2, -0.5, 0.3])[:, None, None] * smooth_traces(3, 5) + 0.01
    comparison = compare(scene, recording(channel("torque", CLOCK, values)))
    mean = np.asarray(comparison.whitened(rollout(torque=values.mean(axis=0))))
    deviations = comparison.deviations()
    assert np.abs(deviations).max() > 1.0
    for n in range(3):
        own = np.asarray(comparison.whitened(rollout(torque=values[n])))
        np.testing.assert_allclose(deviations[n], own - mean, atol=0.02 * np.abs(deviations).max())


@pytest.mark.parametrize("start", [0.0, 100.0])
def test_the_grasp_is_checked_on_the_clock_of_the_recording(door: Scene, start: float):
    phases = tuple(Phase(p.name, p.start + start, p.end + start) for p in PHASES)
    values = np.random.default_rng(0).normal(size=(2, STEPS, 7))
    torque = channel("torque", start + CLOCK, values, [f"panda_joint{i}" for i in range(1, 8)])
    data = recording(torque, start=start, phases=phases)
    found = make_comparison(door, data, rows(data), CompareConfig())
    assert found.grip_rows == door_comparison(door).grip_rows


# ----- what is refused


def test_a_dead_channel_is_refused(scene: Scene):
    values = np.random.default_rng(0).normal(size=(2, STEPS, 3))
    values[:, :, 1] = 0.0
    with pytest.raises(ValueError, match=r"'torque', column 'b' never changes \(0 N m\)"):
        compare(scene, recording(channel("torque", CLOCK, values)))


@pytest.mark.parametrize(("repeats", "dead", "do"), [(3, 3, "leave the joint out"), (3, 1, "mask it out there, or le"),
                                                     (2, 1, "leave that repeat out")])  # fmt: skip
def test_the_advice_for_a_dead_column_works(scene: Scene, repeats: int, dead: int, do: str):
    """Masking is advised only if two repeats remain that measured the column."""
    values = np.random.default_rng(0).normal(size=(repeats, STEPS, 3))
    values[:dead, :, 1] = 0.0
    with pytest.raises(ValueError, match=rf"a dead sensor\? {do}"):
        compare(scene, recording(channel("torque", CLOCK, values)))
    if "mask" in do:
        mask = np.ones(values.shape, bool)
        mask[0, :, 1] = False
        compare(scene, recording(channel("torque", CLOCK, values, mask=mask)))


def test_unknown_channels_and_joints_are_named(scene: Scene):
    values = np.random.default_rng(0).normal(size=(2, STEPS, 3))
    torque = channel("torque", CLOCK, values)
    with pytest.raises(ValueError, match=r"unknown channel 'velocity'.*has: torque"):
        compare(scene, recording(torque), channels={"velocity": 1.0})
    current = Channel("current", "A", JOINTS, CLOCK, values, np.ones(values.shape, bool))
    with pytest.raises(ValueError, match="'current' has no simulated counterpart"):
        compare(scene, recording(current), channels={"current": 1.0})
    with pytest.raises(ValueError, match="unknown joints d; valid: a, b, c"):
        compare(scene, recording(channel("torque", CLOCK, values, ("a", "b", "d"))))
    with pytest.raises(ValueError, match="'position' is not compared; compared: torque"):
        compare(scene, recording(torque)).channel("position")


def test_joints_that_were_left_out_are_not_compared(scene: Scene):
    """One of them may be a dead sensor."""
    values = np.random.default_rng(0).normal(size=(2, STEPS, 3))
    values[:, :, 1] = 0.0
    of = compare(replace(scene, joints=("c", "a")), recording(channel("torque", CLOCK, values)))
    measured = of.channel("torque")
    np.testing.assert_array_equal(measured.columns, [0, 1])  # c and a, in the scene's order
    alone = compare(scene, recording(channel("torque", CLOCK, values[:, :, [0, 2]], ("a", "c"))))
    np.testing.assert_allclose(measured.noise.mean[:, ::-1], alone.channel("torque").noise.mean)


def test_a_stretch_that_no_repeat_measured_is_refused(scene: Scene):
    values = np.random.default_rng(0).normal(size=(2, STEPS, 3))
    mask = np.ones(values.shape, bool)
    mask[:, 200:600, 1] = False
    with pytest.raises(ValueError, match=r"'torque', column 'b' has a stretch that no repeat measured, at 0\.45 s"):
        compare(scene, recording(channel("torque", CLOCK, values, mask=mask)))


@pytest.mark.parametrize("stamps", [True, False], ids=["masked", "without stamps"])
def test_a_dropout_of_one_repeat_is_left_out(scene: Scene, stamps: bool):
    """Five lost samples of a 50 Hz log are accepted.

    A trace's size is fitted: with the dropout as without, whatever stands there, and with an estimated noise too.
    """
    slow = np.arange(0.0, 2.0, 0.02)
    shape = smooth_traces(3, 1)
    at = np.stack([np.interp(slow, CLOCK, column) for column in shape.T], axis=1)
    values = (2.0 * at + np.random.default_rng(0).normal(0, 0.05, at.shape))[None]
    lost = np.zeros(len(slow), bool)
    lost[40:45] = True

    def sizes(data: Channel) -> tuple[list[float], list[int]]:
        found, zeros = [], []
        made = compare(scene, recording(data))
        for one in (made, made.stated({"torque": np.full(3, 0.3)})):
            ends = [np.asarray(one.whitened(rollout(torque=size * shape)), float) for size in (0.0, 1.0)]
            found.append(float(-ends[0] @ (ends[1] - ends[0]) / np.sum((ends[1] - ends[0]) ** 2)))
            zeros.append(int(np.sum(ends[0] == 0)))
        return found, zeros

    whole, none = sizes(channel("torque", slow, values))
    tries = []
    for there in (np.nan, 0.0, 1e6):
        data = np.where(lost[:, None], there, values)
        mask = np.broadcast_to(~lost[:, None], values.shape)
        kept = np.ones(len(slow), bool) if stamps else ~lost
        tries.append(sizes(channel("torque", slow[kept], data[:, kept], mask=mask[:, kept])))
    assert none == [0, 0] and all(part[1][0] == part[1][1] > 0 for part in tries)
    assert all(part == tries[0] for part in tries)
    np.testing.assert_allclose(tries[0][0], whole, atol=5e-3)
    np.testing.assert_allclose(whole, 2.0, atol=0.02)


def test_a_column_that_one_repeat_hardly_measured_is_refused(scene: Scene):
    values = np.random.default_rng(0).normal(size=(1, STEPS, 3))
    mask = np.ones(values.shape, bool)
    mask[:, 60:, 1] = False
    with pytest.raises(ValueError, match="'torque', column 'b' was measured for less than 10 % of the time"):
        compare(scene, recording(channel("torque", CLOCK, values, mask=mask)))


def test_a_channel_outside_the_replay_is_refused(scene: Scene):
    values = np.random.default_rng(0).normal(size=(2, 100, 3))
    with pytest.raises(ValueError, match="torque"):
        compare(scene, recording(channel("torque", 50.0 + 0.01 * np.arange(100), values)))


def test_an_angle_without_an_object_is_refused(scene: Scene):
    values = np.random.default_rng(0).normal(size=(2, STEPS, 1))
    with pytest.raises(ValueError, match="object_angle"):
        compare(scene, recording(channel("object_angle", CLOCK, values, ["hinge"])), channels={"object_angle": 1.0})


def test_columns_with_the_same_gaps_share_a_filter(scene: Scene):
    values = np.stack([smooth_traces(3, 1)] * 3) + np.random.default_rng(0).normal(0, 0.05, (3, STEPS, 3))
    mask = np.ones(values.shape, bool)
    mask[1, 300:420] = False
    together = make_comparison(
        scene, recording(channel("torque", CLOCK, values, mask=mask)), CLOCK, CompareConfig()
    ).channel("torque")
    mask[1, 420, 0] = False  # and apart
    apart = make_comparison(
        scene, recording(channel("torque", CLOCK, values, mask=mask)), CLOCK, CompareConfig()
    ).channel("torque")
    assert len(together.kernel.weights) == 1 and len(apart.kernel.weights) == 3
    np.testing.assert_array_equal(apart.kernel.begin, together.kernel.begin)
    np.testing.assert_allclose(apart.kernel.weights[1], together.kernel.weights[0], atol=1e-12)


def test_a_recording_that_does_not_fit_into_memory_is_refused(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    given = recording(channel("torque", CLOCK, np.stack([smooth_traces(3, 1)] * 2)))
    sizes = {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 10}
    monkeypatch.setattr(measured.os, "sysconf", sizes.__getitem__)
    with pytest.raises(ValueError, match=r"'torque' of 2 s needs 0\.0 GB.*convert --start S --end S"):
        make_comparison(scene, given, CLOCK, CompareConfig())


# ----- a function that remembers its results on disk: nothing is computed twice, and nothing damaged is believed


ROWS = np.array([[1.0, 2.0], [3.0, 4.0]])


def counted(counts: list[int]) -> Batched:
    """A function [P, 2] -> [P, 3] that counts its calls."""

    def compute(rows: np.ndarray) -> np.ndarray:
        counts.append(len(rows))
        return np.asarray(rows, float) @ np.arange(6.0).reshape(2, 3)

    return compute


@pytest.fixture
def counts() -> list[int]:
    return []


def test_nothing_is_computed_twice(tmp_path: Path, counts: list[int]):
    once = cached(counted(counts), tmp_path / "train", "whitened")(ROWS)
    again = cached(counted(counts), tmp_path / "train", "whitened")(ROWS)
    np.testing.assert_array_equal(once, counted([])(ROWS))
    np.testing.assert_array_equal(again, once)
    assert counts == [2] and once.dtype == again.dtype
    cached(counted(counts), tmp_path / "train", "whitened")(ROWS[:1])
    assert counts == [2, 1]


def test_the_last_digits_of_a_double_are_not_another_row(tmp_path: Path, counts: list[int]):
    """Replays have single precision."""
    remembered = cached(counted(counts), tmp_path / "train", "whitened")
    np.testing.assert_array_equal(remembered(ROWS), remembered(ROWS + 1e-12))
    remembered(ROWS + 1e-3)
    assert counts == [2, 2]


def test_recordings_and_functions_do_not_share_cached_results(tmp_path: Path, counts: list[int]):
    for role in ("train", "validation"):
        for what in ("whitened", "distances"):
            cached(counted(counts), tmp_path / role, what)(ROWS)
    assert counts == [2] * 4 and {p.name for p in tmp_path.iterdir()} == {"train", "validation"}


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:60] + b"??" + b[62:]])
def test_a_damaged_file_is_reported_and_computed_again(
    tmp_path: Path, counts: list[int], damage: Callable[[bytes], bytes]
):
    remembered = cached(counted(counts), tmp_path / "train", "whitened")
    whole = remembered(ROWS)
    (path,) = (tmp_path / "train").iterdir()
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match=f"{path.name} is damaged"):
        np.testing.assert_array_equal(remembered(ROWS), whole)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(remembered(ROWS), whole)
    assert counts == [2, 2]


def changed_rows(path: Path) -> None:
    with np.load(path) as file:
        np.savez(path, rows=file["rows"] + 1e-3, digest=file["digest"])


def of_another_row(path: Path) -> None:
    (other,) = (p for p in path.parent.iterdir() if p != path)
    path.write_bytes(other.read_bytes())


def of_another_recording(path: Path) -> None:
    cached(counted([]), path.parent.parent / "validation", "whitened")(ROWS)
    path.write_bytes((path.parent.parent / "validation" / path.name).read_bytes())


@pytest.mark.parametrize("change", [changed_rows, of_another_row, of_another_recording])
def test_a_file_of_something_else_is_computed_again(tmp_path: Path, counts: list[int], change: Callable[[Path], None]):
    """The file can be read, but its content was not written there."""
    remembered = cached(counted(counts), tmp_path / "train", "whitened")
    whole = remembered(ROWS)
    (path,) = (tmp_path / "train").iterdir()
    remembered(1.01 * ROWS)
    change(path)
    with pytest.warns(UserWarning, match=f"{path.name} is damaged"):
        np.testing.assert_array_equal(remembered(ROWS), whole)
    assert counts == [2, 2, 2]


def test_the_same_bytes_in_another_shape_are_another_key(tmp_path: Path):
    """With another number of parameters the bytes may be equal."""
    sums = cached(lambda rows: np.asarray(rows, float).sum(axis=1), tmp_path / "train", "sums")
    wide = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(sums(wide), [3.0, 12.0])
    with pytest.warns(UserWarning, match="computed again"):
        np.testing.assert_array_equal(sums(wide.reshape(3, 2)), [1.0, 5.0, 9.0])
