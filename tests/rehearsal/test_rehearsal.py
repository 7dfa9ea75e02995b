"""Rehearsals of a driven hinge: what has signal is said to be found, what has none is not; page, JSON, full form."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.rehearse import next_step
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.identify.pipeline import IdentifyConfig
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effects.registry import library
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, load_scene
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.rehearsal.full import (
    FullRehearsal,
    HiddenCase,
    hidden_cases,
    hidden_form,
    run_case,
    scores,
    synthetic_log,
)
from droid_jax.rehearsal.linear import RehearsalConfig
from droid_jax.rehearsal.plan import RehearsalPlan, faster_motion, sample_noise
from droid_jax.rehearsal.quick import quick_rehearsal, rehearsed
from droid_jax.run import main

HINGE = Path(__file__).resolve().parents[2] / "experiments" / "hinge.xml"
JOINTS, SECONDS, REACH = ("door",), 3.0, 0.25
EFFECTS = ("hinge_preload", "drag", "opening_check")
PARAMETERS = [
    {"field": "dof_damping", "element": "door", "unit": "N m s/rad", "std": 0.3, "high": 10.0},
    {"field": "body_mass", "element": "panel", "std": 0.1, "high": 5.0},
]
PLAN = RehearsalPlan(repeats=10, noise={"torque": 0.5}, channels=("torque",))


def motion(name: str = "train", period: float = 1.5) -> Recording:
    """Commands that open the door by REACH and close it; the measured positions are the commands."""
    time = np.arange(0.0, SECONDS, 0.004)
    angle = 0.5 * REACH * (1 - np.cos(2 * np.pi * time / period))[:, None]
    position = Channel("position", "rad", JOINTS, time, angle[None], np.ones((1, *angle.shape), bool))
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    return Recording(name, time, angle, JOINTS, {"position": position}, convention, qpos0={"door": 0.0})


@pytest.fixture(scope="module")
def hinge() -> tuple[Scene, Space]:
    scene = load_scene(HINGE, object_joint="door")
    return scene, Space((joint_damping(scene, "door", std=0.3, high=10.0),))


@pytest.fixture(scope="module")
def result(hinge) -> dict[str, Any]:
    scene, space = hinge
    recordings = [motion(), motion("validation", 1.0)]
    return quick_rehearsal(scene, space, library(scene, EFFECTS), recordings, PLAN, faster=False, step_error=False)


def entry(result: dict[str, Any], effect: str) -> dict[str, Any]:
    return next(e for e in result["effects"] if e["effect"] == effect)


def test_what_has_signal_is_found_and_what_has_none_is_not(result):
    """A preload of about the noise of one sample shows in ten repeats; a check beyond the motion in none."""
    assert 0 < entry(result, "hinge_preload")["smallest"] < 1.0
    assert not np.isfinite(entry(result, "opening_check")["smallest"])
    (damping,) = result["parameters"]
    assert damping["recovered"] and damping["shrinkage"] < 0.25


def test_noise_and_thresholds_are_stated(result):
    how = result["how"]
    assert how["repeats"] == 10 and how["simulated"] and how["compared"] == ["torque"]
    assert how["noise"] == [
        {"channel": "torque", "column": "door", "unit": "N m", "deviation": 0.5, "source": "stated"}
    ]
    assert how["significance"] == DiscrepancyConfig().selection.significance


def test_more_repeats_help_and_are_compared_with_other_channels(result):
    helps = {h["what"]: h for h in result["helps"]}
    assert {"2 times as many repeats", "4 times as many repeats", "position compared too"} <= set(helps)
    assert helps["4 times as many repeats"]["times_smaller"] >= helps["2 times as many repeats"]["times_smaller"] > 1.1


def test_a_faster_motion_lasts_as_long_and_ends_where_it_did():
    slow = motion()
    fast = faster_motion(slow, 1.5)
    assert fast.time[-1] == pytest.approx(slow.time[-1]) and fast.command[-1] == pytest.approx(slow.command[-1])
    assert np.abs(np.diff(fast.command[:, 0])).max() == pytest.approx(
        1.5 * np.abs(np.diff(slow.command[:, 0])).max(), rel=0.02
    )


def test_noise_of_a_log_is_read_from_row_to_row():
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
    told = scores([*of, empty, {**empty, "verdict": "error"}], 0.9)
    assert told["effects"][0]["smallest"] == 2.0 and told["failed"] == 1
    assert told["nothing_hidden"] == {"cases": 1, "named": 1}
    assert told["parameters"] == [{"name": "m", "cases": 1, "recovered": 1, "holds": 0}]


def test_a_synthetic_log_holds_what_was_hidden_and_the_stated_noise(hinge):
    """Of the synthetic robot's own preload, which is constant near the closed door."""
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
    """The files; the answer itself is the module's."""
    monkeypatch.setattr("droid_jax.rehearsal.quick.quick_rehearsal", lambda *args, **kwargs: dict(result))
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
def test_noise_that_is_none(refused, tmp_path: Path, given: str, said: str):
    assert said in refused("rehearse", "--noise", given, "--out", tmp_path / "run")


@pytest.mark.parametrize(
    ("known", "next_one"),
    [({}, 1.0), ({1.0: True}, 0.7), ({1.0: True, 0.7: False}, None), ({1.0: True, 0.7: True, 0.5: True}, None),
     ({1.0: False}, 1.4), ({1.0: False, 1.4: True}, None), ({1.0: False, 1.4: False, 2.0: False}, None)],
)  # fmt: skip
def test_the_benchmark_looks_for_the_smallest_size_that_is_found(known: dict[float, bool], next_one: float | None):
    assert next_step(known) == next_one


@pytest.mark.slow
def test_complete_rehearsals_go_on_and_name_what_is_large(tmp_path: Path, hinge):
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
