"""Rehearsals: predicted sizes against the search's own tests on drawn residuals of a linear model; a driven hinge.

On the hinge, effects with a signal are found and others are not; page, JSON and complete rehearsals.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from benchmarks.rehearse import measured_size, next_step, summary
from droid_jax.commands.rehearse import plain
from droid_jax.discrepancy.candidates import ScoreDirection, project
from droid_jax.discrepancy.config import BlocksConfig, DiscrepancyConfig, SelectionConfig
from droid_jax.discrepancy.statistics import Blocks, Repeats, Resampling, one_sided_p, sign_flips
from droid_jax.discrepancy.step_error import with_finer_step, with_step_difference
from droid_jax.identify.levenberg_marquardt import DampedProblem, LevenbergMarquardtConfig
from droid_jax.identify.pipeline import IdentifyConfig
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import Candidate
from droid_jax.model.effects.registry import library
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene, load_scene
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.rehearsal.config import DEFAULT_REHEARSAL, RehearsalConfig
from droid_jax.rehearsal.full import (
    FullRehearsal,
    HiddenCase,
    hidden_cases,
    hidden_form,
    run_case,
    scores,
    synthetic_log,
)
from droid_jax.rehearsal.imitations import alternatives_of
from droid_jax.rehearsal.linear import LinearModel, LinearPart, unabsorbed
from droid_jax.rehearsal.linearised import fine_steps, rehearsed
from droid_jax.rehearsal.plan import RehearsalPlan, faster_motion, sample_noise
from droid_jax.rehearsal.power import _some_flips, smallest_sizes
from droid_jax.rehearsal.quick import _of_longer_log, quick_rehearsal
from droid_jax.report.rehearsal_page import rehearsal_sentences
from droid_jax.report.text import quantity
from droid_jax.run import main

REPEATS, LENGTH, DIRECTIONS, BASE = 10, 160, 12, 4
CONFIG, CASES = RehearsalConfig(draws=64, margin=1.0), 60  # the linear model is the oracle
WIDE = np.full(BASE, 10.0)
HINGE = Path(__file__).resolve().parents[2] / "experiments" / "hinge.xml"
JOINTS, SECONDS, REACH = ("door",), 3.0, 0.25
EFFECTS = ("hinge_preload", "drag", "opening_check", "over_centre_spring")
PARAMETERS = [
    {"field": "dof_damping", "element": "door", "unit": "N m s/rad", "std": 0.3, "high": 10.0},
    {"field": "body_mass", "element": "panel", "std": 0.1, "high": 5.0},
]
PLAN = RehearsalPlan(repeats=10, noise={"torque": 0.5}, channels=("torque",))


def waves(rng: np.random.Generator, count: int) -> np.ndarray:
    """Slow random waves [count, LENGTH], similar to sensitivities of a torque."""
    time = np.arange(LENGTH) / 20.0
    rates, starts = rng.uniform(0.05, 1.5, (5, count, 1)), rng.uniform(0, 2 * np.pi, (5, count, 1))
    return np.sin(2 * np.pi * rates * time + starts).sum(axis=0)


def directions(count: int) -> tuple[ScoreDirection, ...]:
    return tuple(ScoreDirection(Candidate(f"effect{k}", "joint", (f"c{k}",)), f"c{k}") for k in range(count))


def linear(rows: Resampling, level: float = 0.0, repeats: int = 1, **changes) -> LinearModel:
    rng = np.random.default_rng(3)
    raw, base, channel = waves(rng, DIRECTIONS), waves(rng, BASE).T, np.full(LENGTH, "torque")
    part = LinearPart(raw, base, rows, channel, level)
    usual = dict(
        directions=directions(DIRECTIONS), train=part, validation=part, prior=WIDE, slack=3.0, repeats=repeats,
        minimum=np.zeros(DIRECTIONS), low=np.full(DIRECTIONS, -np.inf),
        high=np.full(DIRECTIONS, np.inf),
    )  # fmt: skip
    return LinearModel(**{**usual, **changes})


def of_repeats(**changes) -> LinearModel:
    deviations = np.random.default_rng(4).normal(size=(REPEATS, LENGTH))
    return linear(Repeats(deviations - deviations.mean(axis=0)), repeats=REPEATS, **changes)


def of_blocks(**changes) -> LinearModel:
    return linear(Blocks(np.arange(LENGTH) * REPEATS // LENGTH), level=1.0, **changes)


def found(model: LinearModel, k: int, size: float, seed: int) -> bool:
    """Whether the search's score test, and its validation test on other noise, find direction k of a size."""
    rng, count = np.random.default_rng(seed), model.repeats if model.repeated else 1
    part = model.train
    held = model.prior * count**0.5
    gone = np.linalg.solve(part.base.T @ part.base + np.diag(held**-2), part.base.T)

    def residuals() -> tuple[np.ndarray, Resampling]:
        repeats = rng.normal(size=(count, LENGTH)) + size * part.raw[k]
        common = repeats.mean(axis=0)
        rows = Repeats(repeats - common) if model.repeated else part.rows
        common = common - part.base @ (gone @ common)
        return common, rows

    common, rows = residuals()
    projected = project(part.raw, part.base, held * model.slack)
    scores = projected @ rows.residuals(common).T
    _, p = rows.largest_score(scores, projected, part.base, held * model.slack)
    if p >= SelectionConfig().significance:
        return False
    common, rows = residuals()
    before, after = (
        rows.residuals(common),
        rows.residuals(common - size * (part.raw[k] - part.base @ (gone @ part.raw[k]))),
    )
    gains = 0.5 * (np.sum(before**2, axis=1) - np.sum(after**2, axis=1))
    if model.repeated:
        return rows.gain_p_value(gains) < SelectionConfig().confirmation
    less = rows.discrepancy(after) <= (1 - BlocksConfig().least_gain) * rows.discrepancy(before)
    return bool(less) and one_sided_p(gains) < SelectionConfig().confirmation


@pytest.mark.parametrize("make", [of_repeats, of_blocks])
def test_the_smallest_size_is_found_in_nine_of_ten_cases_and_half_of_it_rarely(make: Callable[..., LinearModel]):
    """The oracle is the search's score and validation test on drawn residuals (60 draws: 4 % deviation)."""
    model = make()
    (size,) = smallest_sizes(model, [2], CONFIG)
    at = np.mean([found(model, 2, size.size, seed) for seed in range(CASES)])
    below = np.mean([found(model, 2, 0.5 * size.size, seed) for seed in range(CASES)])
    assert 0.78 <= at <= 1.0
    assert below < 0.5


def test_more_repeats_find_smaller_effects():
    """The noncentrality grows with the root of their number, and the threshold falls."""
    few, many = of_repeats(), of_repeats()
    (one,), (four,) = (smallest_sizes(m, [5], CONFIG) for m in (few, linear(few.train.rows, repeats=4 * REPEATS)))
    assert 1.9 < one.size / four.size < 3.2
    assert many.repeats == REPEATS


def test_bounds_minimum_sizes_and_the_time_step_limit_what_is_found():
    (plain,) = smallest_sizes(of_repeats(), [1], CONFIG)
    (least,) = smallest_sizes(of_repeats(minimum=np.full(DIRECTIONS, 100.0)), [1], CONFIG)
    (bound,) = smallest_sizes(of_repeats(high=np.full(DIRECTIONS, 0.5 * plain.size)), [1], CONFIG)
    assert least.size > 100.0 and least.limit == "minimum effect size"
    assert np.isinf(bound.size) and bound.limit == "beyond its bounds"
    part = replace(of_repeats().train, step=np.random.default_rng(0).normal(0, 7.0, LENGTH))
    (step,) = smallest_sizes(of_repeats(train=part), [1], CONFIG)
    assert step.limit == "time step" and step.size > plain.size


def test_an_effect_that_the_base_parameters_absorb_is_not_found():
    """The direction is a column of the Jacobian, so only its prior limits the absorption."""
    model = of_repeats()
    raw = model.train.raw.copy()
    raw[0] = model.train.base[:, 0]
    part = LinearPart(raw, model.train.base, model.train.rows, model.train.channel)
    absorbed = of_repeats(train=part, validation=part)
    (gone,), (kept,) = (smallest_sizes(absorbed, [k], CONFIG) for k in (0, 1))
    assert gone.size > 100 * kept.size


def test_a_parameter_absorbs_an_effect_only_as_far_as_its_bounds():
    """The oracle is a bounded least-squares fit of base parameters and priors to the effect."""
    model = of_repeats(base_low=np.full(BASE, -3.0), base_high=np.full(BASE, 3.0))
    raw = model.train.raw.copy()
    raw[0] = 10.0 * model.train.base[:, 0] + 0.3 * raw[0]
    part = LinearPart(raw, model.train.base, model.train.rows, model.train.channel)
    near = of_repeats(train=part, validation=part, base_low=np.full(BASE, -3.0), base_high=np.full(BASE, 3.0))
    part_of_effect, prior = unabsorbed(near, 0), near.prior_of_repeat(1.0)
    assert len(part_of_effect.begins) > 1
    for size in (0.1, 0.5, 2.0):
        columns, target = np.vstack([part.base, np.diag(1 / prior)]), np.r_[size * raw[0], np.zeros(BASE)]
        fit = lsq_linear(columns, target, bounds=(-3.0, 3.0)).x
        residual = size * raw[0] - part.base @ fit
        assert np.linalg.norm(part_of_effect.at(size)[1] - residual) < 1e-3 * np.linalg.norm(residual)
        norm = np.array([np.linalg.norm(residual)])
        assert part_of_effect.size_of(norm, "validation")[0] == pytest.approx(size, rel=0.02)
    unbounded = of_repeats(train=part, validation=part)
    (loose,), (tight,) = (smallest_sizes(m, [0], CONFIG) for m in (unbounded, near))
    assert tight.size < 0.8 * loose.size


def test_alternatives_are_the_collinear_candidates():
    """Two directions with a cosine of 0.99 are not distinguishable up to a size; the others are."""
    model = of_repeats()
    raw = model.train.raw.copy()
    raw[1] = raw[0] + 0.1 * raw[2] * np.linalg.norm(raw[0]) / np.linalg.norm(raw[2])
    part = LinearPart(raw, model.train.base, model.train.rows, model.train.channel)
    near = of_repeats(train=part, validation=part)
    (size,) = smallest_sizes(near, [0], CONFIG)
    others = alternatives_of(near, 0, size.size, DiscrepancyConfig(), CONFIG.share)
    assert others[0].key.effect == "effect1" and others[0].share > 0.9
    assert size.size < others[0].distinguishable_from < np.inf
    twice = 2 * others[0].distinguishable_from
    assert "effect1" not in [r.key.effect for r in alternatives_of(near, 0, twice, DiscrepancyConfig(), CONFIG.share)]
    one_way = np.zeros(DIRECTIONS)
    low = of_repeats(train=part, validation=part, low=one_way, high=np.where(np.arange(DIRECTIONS) == 1, 1e-9, np.inf))
    assert "effect1" not in [
        r.key.effect for r in alternatives_of(low, 0, size.size, DiscrepancyConfig(), 0.9) if r.share > 0.9
    ]


def motion(name: str = "train", period: float = 1.5, seconds: float = SECONDS) -> Recording:
    """Commands that open the door by REACH and close it; the measured positions are the commands."""
    time = np.arange(0.0, seconds, 0.004)
    angle = 0.5 * REACH * (1 - np.cos(2 * np.pi * time / period))[:, None]
    position = Channel("position", "rad", JOINTS, time, angle[None], np.ones((1, *angle.shape), bool))
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    return Recording(name, time, angle, JOINTS, {"position": position}, convention, qpos0={"door": 0.0})


@pytest.fixture(scope="module")
def hinge() -> tuple[Scene, Space]:
    scene = load_scene(HINGE, object_joint="door")
    return scene, Space((joint_damping(scene, "door", std=0.3, high=10.0),))


@pytest.fixture(scope="module")
def effects(hinge) -> tuple[Effect, ...]:
    """Shared by all tests, since each set of effects is compiled."""
    return library(hinge[0], EFFECTS)


@pytest.fixture(scope="module")
def result(hinge, effects: tuple[Effect, ...]) -> dict[str, Any]:
    scene, space = hinge
    recordings = [motion(), motion("validation", 1.0, 2.5)]
    return quick_rehearsal(scene, space, effects, recordings, PLAN, step_error=False)[1]


def entry(result: dict[str, Any], effect: str) -> dict[str, Any]:
    return next(e for e in result["effects"] if e["effect"] == effect)


def test_effects_with_a_signal_are_found_and_others_are_not(result):
    """A preload of about the noise of one sample is found; a check beyond the motion is not."""
    assert 0 < entry(result, "hinge_preload")["smallest"] < 1.0
    assert not np.isfinite(entry(result, "opening_check")["smallest"])
    (damping,) = result["parameters"]
    assert damping["recovered"] and damping["shrinkage"] < 0.25


def test_an_effect_whose_other_law_looks_like_another_effect_is_doubtful(result):
    """The synthetic robot's over-centre spring pulls hardest at the closed door, as a preload does."""
    spring, preload = entry(result, "over_centre_spring")["law"], entry(result, "hinge_preload")["law"]
    assert not spring["sure"] and spring["law"] == "the synthetic robot's"
    assert preload["sure"] and preload["own"] > 0.9
    assert any("over centre spring" in s and "not named" in s for s in rehearsal_sentences(plain(result)))


def test_the_first_sentence_promises_more_than_the_smallest_size(result):
    shown = plain(result)
    first = rehearsal_sentences(shown)[0]
    sizes = [e["smallest"] for e in shown["effects"] if e["smallest"] is not None and e["unit"] == "N m"]
    assert any(f"from {quantity(DEFAULT_REHEARSAL.promise * size, 'N m', 2)}" in first for size in sizes)
    assert not any(f"from {quantity(size, 'N m', 2)}" in first for size in sizes)
    bounded = [{**e, "bound": e["smallest"] or e["bound"]} for e in shown["effects"]]  # found at the bound itself
    said = rehearsal_sentences({**shown, "effects": bounded})
    assert "no effect would surely be found" in said[0] and any("close to the bounds" in s for s in said)
    of_before = {**shown, "how": {**shown["how"], "rehearsal": {}}}  # without the factor
    assert any(f"from {quantity(size, 'N m', 2)}" in rehearsal_sentences(of_before)[0] for size in sizes)


def test_one_batch_gives_the_jacobian_of_two_batches():
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(7, 2))
    space = Space(tuple(Parameter(n, "-", 0.0, 1.0, -0.5, 9.0) for n in "ab"))
    problem = DampedProblem(lambda rows: rows @ matrix.T + 1.0, space, LevenbergMarquardtConfig())
    x = np.array([[-0.5, 1.0]])
    (one, slopes), two = problem.start_with_slopes(x), problem.start(x)
    np.testing.assert_allclose(slopes, problem.jacobian(two))
    np.testing.assert_allclose(slopes[0], matrix)
    np.testing.assert_allclose(one.residual, two.residual)
    assert one.objective == pytest.approx(two.objective)


@pytest.mark.slow
def test_plain_c_with_fine_steps_gives_the_time_steps_error(hinge, effects: tuple[Effect, ...]):
    """It is of the same size as the search's, which replays at a quarter of the time step."""
    scene, space = hinge
    recordings = [motion(), motion("validation", 1.0)]
    asked = (scene, space, effects, recordings, PLAN, DiscrepancyConfig(), CONFIG)
    of = rehearsed(*asked, step_error=False)
    train, roles = of.case.train, of.roles
    known = fine_steps(train, of.base, of.case.base, roles["train"])
    own = with_step_difference(train, of.base, with_finer_step(train, of.case.base, roles["train"])).step_difference
    assert known is not None and own is not None
    assert known @ own > 0.9 * np.linalg.norm(known) * np.linalg.norm(own)
    assert 0.9 < np.linalg.norm(known) / np.linalg.norm(own) < 1.6  # a quarter of the step has an error too


def test_noise_and_thresholds_are_stated(result):
    how = result["how"]
    assert how["repeats"] == 10 and how["simulated"] and how["compared"] == ["torque"]
    assert how["noise"] == [
        {"channel": "torque", "column": "door", "unit": "N m", "deviation": 0.5, "source": "stated"}
    ]
    assert how["significance"] == DiscrepancyConfig().selection.significance


def test_more_repeats_help_and_are_compared_with_other_channels(result):
    helps = {h["what"]: h for h in result["helps"]}
    assert {"2 times as many repeats", "4 times as many repeats", "position compared too", "the faster motion"} <= set(
        helps
    )
    assert helps["4 times as many repeats"]["times_smaller"] >= helps["2 times as many repeats"]["times_smaller"] > 1.1


def test_a_faster_motion_lasts_as_long_and_ends_where_it_did():
    slow = motion()
    fast = faster_motion(slow, 1.5)
    assert fast.time[-1] == pytest.approx(slow.time[-1]) and fast.command[-1] == pytest.approx(slow.command[-1])
    assert np.abs(np.diff(fast.command[:, 0])).max() == pytest.approx(
        1.5 * np.abs(np.diff(slow.command[:, 0])).max(), rel=0.02
    )


def test_the_noise_of_a_log_is_estimated_from_second_differences():
    clean = motion().channel("position")
    rng = np.random.default_rng(0)
    noisy = replace(clean, values=clean.values + rng.normal(0, 1e-3, clean.values.shape))
    assert sample_noise(noisy)[0] == pytest.approx(1e-3, rel=0.15)


def test_hidden_forms_are_those_of_the_synthetic_robot(hinge):
    scene, _ = hinge
    assert hidden_form(scene, "hinge_preload", "door", "N m") == ("hinge_preload", "")
    assert hidden_form(scene, "hinge_stribeck", "door", "N m") == ("stribeck_friction", "door")
    assert hidden_form(scene, "mine", "door", "N m") == ("", "")
    assert hidden_form(scene, "tilted_frame", "door", "N m") == ("", "")  # of another unit


@pytest.mark.parametrize(
    ("found", "measured"),
    [
        ({1.0: True, 0.7: False}, 1.0),
        ({1.0: False, 1.4: True}, 1.4),
        ({1.0: True}, None),
        ({0.5: True, 0.7: True}, 0.5),
        ({1.0: False, 2.0: False}, np.inf),
        ({1.0: False}, None),
        ({0.9: True, 1.2: False, 1.5: True}, 1.5),
    ],
)
def test_the_measured_size_is_the_smallest_from_which_all_are_found(found: dict[float, bool], measured: float | None):
    cases = [{"size": 3.0 * t, "found": f} for t, f in found.items()]
    assert measured_size({"smallest": 3.0}, cases) == measured


def test_advice_is_wrong_if_an_effect_was_not_found():
    """At the size that the page promises; a miss at the predicted size alone is counted apart."""
    usual = {"within": True, "not_found_at_twice": False, "found": {"1": [1, 1]}}
    usual |= {"missed": False, "missed_at_promised": False, "promised": True}
    of = [
        {**usual, "sure": True, "measured_over_predicted": 0.7},
        {**usual, "sure": True, "measured_over_predicted": 1.4, "missed": True},
        {**usual, "sure": True, "missed": True, "missed_at_promised": True, "within": None, "found": {"2": [0, 1]}},
        {
            **usual,
            "sure": False,
            "missed": True,
            "missed_at_promised": True,
            "not_found_at_twice": True,
            "within": False,
        },
        {**usual, "sure": True, "missed": True, "promised": False, "within": None},
    ]
    result = summary({"hinge": of})
    assert (
        result["wrong_advice_rate"] == pytest.approx(1 / 3)
        and result["missed_at_predicted_rate"] == pytest.approx(2 / 3)
        and result["advised"] == 3
        and result["within_factor"] == pytest.approx(2 / 3)
    )
    assert result["within_factor_of_sure"] == 1.0 and result["unsure_not_found"] == 1


def test_one_case_of_five_has_nothing_hidden_and_sizes_stay_inside_bounds(hinge):
    scene, _ = hinge
    usual = {"effect": "drag", "location": "door", "coefficient": "c", "unit": "-", "shape": {}, "smallest": 2.0}
    known = [{**usual, "bound": 3.0}, {**usual, "effect": "latch", "smallest": None, "bound": 3.0}]
    cases = hidden_cases(scene, known, 10)
    assert [bool(c.effect) for c in cases] == [n % 5 > 0 for n in range(10)]
    assert {c.effect for c in cases} == {"", "drag"} and max(c.size for c in cases) <= 3.0
    assert len({c.name for c in cases}) == 10


def test_scores_take_the_size_from_which_all_are_found():
    usual = {
        "effect": "drag",
        "location": "door",
        "coefficient": "c",
        "verdict": "named",
        "taken_for": [],
        "same_law": False,
    }
    of = [{**usual, "size": s, "found": s > 1.0} for s in (0.5, 1.0, 2.0, 4.0)]
    empty = {**usual, "effect": "", "effects": ["a"], "parameters": [{"name": "m", "recovered": True, "holds": False}]}
    result = scores([*of, empty, {**empty, "verdict": "error"}], 0.9)
    assert result["effects"][0]["smallest"] == 2.0 and result["failed"] == 1
    assert result["nothing_hidden"] == {"cases": 1, "named": 1}
    assert result["parameters"] == [{"name": "m", "cases": 1, "recovered": 1, "holds": 0}]


def test_a_synthetic_log_holds_what_was_hidden_and_the_stated_noise(hinge):
    """The synthetic robot's preload is constant near the closed door."""
    scene, space = hinge
    asked = (scene, space, library(scene, EFFECTS), motion(), space.mean)
    rest = (PLAN, DiscrepancyConfig(channels=("torque",)), RehearsalConfig(), 3)
    with_it, without = (
        synthetic_log(*asked, HiddenCase(0, hidden=hidden, amplitude=0.5), *rest) for hidden in ("hinge_preload", "")
    )
    torque, plain = (r.channel("torque").values for r in (with_it, without))
    assert torque.shape == (10, *motion().time.shape, 1)[:1] + plain.shape[1:]
    assert plain.std(axis=0).mean() == pytest.approx(0.5, rel=0.1)
    assert 0.2 < abs(torque.mean() - plain.mean()) < 0.6


def test_page_and_json_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], hinge, result, monkeypatch):
    """The answer itself is patched with that of this module."""
    monkeypatch.setattr("droid_jax.rehearsal.quick.quick_rehearsal", lambda *args, **kwargs: (None, dict(result)))
    save_recording(motion(), tmp_path / "log.npz")
    (tmp_path / "parameters.json").write_text(json.dumps(PARAMETERS))
    options = ["--scene", HINGE, "--object-joint", "door", "--parameters", tmp_path / "parameters.json",
               "--recording", tmp_path / "log.npz", "--effects", *EFFECTS, "--compare", "torque", "--repeats", "10",
               "--out", tmp_path / "run"]  # fmt: skip
    assert main(["rehearse", *map(str, options)]) == 0
    kept = json.loads((tmp_path / "run" / "rehearsal.json").read_text())
    assert kept["format"] == "droid_jax rehearsal 1" and kept["setup"]["command"] == "rehearse"
    assert entry(kept, "opening_check")["smallest"] is None
    page = (tmp_path / "run" / "rehearsal.html").read_text()
    assert "<svg" in page and "Hinge preload" in page and "would be found" in page
    assert "would be found" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "said"), [("torque", "--noise takes"), ("torque=-1", "--noise takes"), ("sound=1", "channels:")]
)
def test_invalid_noise_options_are_refused(refused, tmp_path: Path, given: str, said: str):
    assert said in refused("rehearse", "--noise", given, "--out", tmp_path / "run")


@pytest.mark.parametrize(
    ("known", "next_one"),
    [({}, 1.0), ({1.0: True}, 0.7), ({1.0: True, 0.7: False}, None), ({1.0: True, 0.7: True, 0.5: True}, None),
     ({1.0: False}, 1.4), ({1.0: False, 1.4: True}, None), ({1.0: False, 1.4: False, 2.0: False}, None)],
)  # fmt: skip
def test_the_benchmark_looks_for_the_smallest_size_that_is_found(known: dict[float, bool], next_one: float | None):
    assert next_step(known) == next_one


@pytest.mark.slow
def test_complete_rehearsals_resume_and_name_a_large_effect(tmp_path: Path, hinge):
    scene, space = hinge
    config = DiscrepancyConfig(search=CmaConfig(population=12, parents=None, generations=4), channels=("torque",))
    recordings, asked = (motion(), motion("validation", 1.0)), library(scene, EFFECTS[:2])
    found = rehearsed(scene, space, asked, recordings, PLAN, config, RehearsalConfig(), step_error=False)
    of = FullRehearsal(
        scene, space, asked, recordings, PLAN, config,
        IdentifyConfig(search=config.search, samples=0, checks=False), RehearsalConfig(), found,
    )  # fmt: skip
    case = HiddenCase(1, "hinge_preload", "door", "hinge_preload", {}, 1.0, 1.0, "hinge_preload", "", 1.0)
    answer = run_case(of, case, tmp_path)
    assert answer["found"] and not answer["same_law"] and answer["form"] > 0.9
    assert answer["amplitude"] == pytest.approx(1.0, rel=0.1)
    assert run_case(of, case, tmp_path) == json.loads((tmp_path / case.name / "result.json").read_text())
    nothing = run_case(of, HiddenCase(0), tmp_path)
    assert nothing["effects"] == [] and [p["name"] for p in nothing["parameters"]] == ["door_damping"]


def test_a_longer_log_lowers_all_limits_but_the_minimum_effect_size():
    entry = {"minimum": 0.3, "limits": {"score test": 1.0, "minimum effect size": 0.5}}
    assert _of_longer_log(entry, 4.0) == pytest.approx(0.5)
    assert _of_longer_log(entry, 1e6) == pytest.approx(0.3, rel=1e-2)


@pytest.mark.parametrize("count", [8, 11, 12, 30])
def test_a_subset_of_the_sign_flips_flips_every_unit(count: int):
    flips = _some_flips(count, CONFIG)
    assert len(flips) <= CONFIG.flips and np.all(flips[0] == flips[0, 0])
    some, every = (np.mean(of == flips[0, 0], axis=0) for of in (flips, sign_flips(count, CONFIG.seed)))
    np.testing.assert_allclose(some, every, atol=0.12)


def test_the_validation_part_has_its_own_number_of_repeats():
    few = Repeats(np.random.default_rng(5).normal(size=(4, LENGTH)))
    model = of_repeats()
    other = replace(model, validation=replace(model.validation, rows=few))
    assert model.judging_repeats == REPEATS and other.judging_repeats == 4
    (alike,), (less,) = (smallest_sizes(m, [1], CONFIG) for m in (model, other))
    assert less.limits["time step"] > 1.3 * alike.limits["time step"]  # the square root of 10 / 4 is 1.6


def test_an_effect_at_its_bound_is_not_found():
    (plain,) = smallest_sizes(of_repeats(), [1], CONFIG)
    high = np.full(DIRECTIONS, 1.01 * plain.size)
    (inside,), (beyond,) = (
        smallest_sizes(of_repeats(high=high, bound_margin=margin), [1], CONFIG) for margin in (0.0, 0.02 * high)
    )
    assert np.isfinite(inside.size) and not np.isfinite(beyond.size)
