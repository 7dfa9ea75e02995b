"""Table II: summaries agree with the trials, and intervals account for few policies with many trials."""

from __future__ import annotations

import contextlib
import functools
import importlib
import itertools
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from benchmarks.sharing import claimed
from droid_jax.door.environment import DoorEnv
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_nuisances, door_space
from droid_jax.door.task import Task
from droid_jax.files import GAUSSIAN, POLICY
from droid_jax.identify.gaussian import load_gaussian, prior
from droid_jax.policy.control import load_policy
from droid_jax.policy.train import TrainConfig
from droid_jax.policy.trials import Trials
from droid_jax.synthetic.hidden_effects import Applied, possible
from droid_jax.synthetic.policy_trials import transfer
from experiments.policies import store
from experiments.policies.cases import (
    RESULTS,
    TIMESTEP,
    Case,
    Options,
    finish,
    found_of,
    learned,
    made_by,
    run_all,
)
from experiments.policies.figure import OPENED_WORDS, as_text, histograms, knob_histograms, knobs_as_text
from experiments.policies.robots import fitted, robots_of, truth_of
from experiments.policies.settings import SETTINGS, Setting, setting_of
from experiments.policies.store import Doors, decided_by, place_of, trained
from experiments.policies.table import PLACES, apart, column, rate_interval, resampled, spread, summed_up

ROOT = Path(__file__).resolve().parents[2]
CODE = {"commit": "one"}


def case(
    method: str, seed: int, rate: float, count: int = 50, stopped: Sequence[str] = (), fit: str = "one"
) -> dict[str, Any]:
    """A policy that succeeds in some of its trials.  stopped: why the last ones were stopped."""
    won = np.arange(count) < rate * count
    why = np.array([""] * (count - len(stopped)) + list(stopped))
    found = Trials(won, np.deg2rad(np.where(won, 40.0, 10.0)), np.where(won, 100, 512), won + 0.0, why)
    return {
        "setting": {"name": "paper"},
        "method": method,
        "seed": seed,
        "doors_sha256": fit,
        "trained_by": {"commit": "an older one"},
        **{place: found.to_json() for place in ("simulation", "synthetic_robot", "slippery")},
    }


def percent_in(panels: Sequence[Any]) -> list[float]:
    """The bars of each panel of a histogram, added up."""
    return [sum(bar.get_height() for bar in panel.patches) for panel in panels]


def test_a_column_is_the_mean_over_all_trials():
    found = column([case("mean", 0, 0.2), case("mean", 1, 0.8)], "synthetic_robot")
    assert (found["policies"], found["trials"], found["seeds"]) == (2, 100, [0, 1])
    assert found["success_rate"] == pytest.approx(0.5) and found["success_of_each"] == pytest.approx([0.2, 0.8])
    assert found["angle_deg"]["mean"] == pytest.approx(25.0) and found["angle_deg"]["std"] == pytest.approx(15.0)
    assert found["steps"]["mean"] == 100.0  # of successes
    assert column([case("mean", 0, 0.0)], "synthetic_robot")["steps"] == {
        "mean": None,
        "std": None,
        "interval_95": None,
    }


def test_the_papers_success_is_an_angle_alone():
    """Three of four trials pass 30 degrees, one of them without a grip that lasts."""
    one = case("mean", 0, 0.5, 4)
    one["synthetic_robot"]["angle_deg"]["all"] = [40.0, 40.0, 31.0, 30.0]
    found = column([one], "synthetic_robot")
    assert (found["success_rate"], found["beyond_30_deg"]) == (0.5, 0.75)
    assert "| beyond 30 degrees, % (the paper's success) | 75.0 |" in as_text(summed_up([one], ["paper"]))


def test_what_blew_up_is_counted_and_in_no_rate():
    """Ten trials of fifty: half of the others succeed, and one in eight of them was stopped by the control loop."""
    why = ["too fast: joint 1"] * 5 + ["the simulation blew up"] * 10
    found = column([case("mean", 0, 0.4, stopped=why)], "synthetic_robot")
    assert (found["trials"], found["blown_up"], found["success_rate"]) == (40, 10, pytest.approx(0.5))
    assert found["stopped"] == pytest.approx(5 / 40) and found["grip"]["mean"] == pytest.approx(0.5)
    whole = column([case("mean", 0, 0.4)], "synthetic_robot")
    assert (whole["trials"], whole["blown_up"], whole["stopped"]) == (50, 0, 0.0)
    lost, kept = case("mean", 3, 0.4, 2, why[-2:]), [case("mean", k, 0.5) for k in range(2)]
    found = column([lost, *kept], "synthetic_robot")
    assert (found["policies"], found["trials"], found["blown_up"]) == (3, 100, 2)
    assert found["success_of_each"] == [None, 0.5, 0.5] and found["success_rate"] == 0.5
    none = column([lost], "synthetic_robot")
    assert none["success_rate"] is none["stopped"] is none["success_interval_95"] is none["angle_deg"]["mean"] is None
    assert apart([lost], kept, "success")["difference"] is None
    lost["setting"] = kept[0]["setting"]
    text = as_text(summed_up([lost, case("fitted", 0, 0.5)], ["paper"]))
    assert "nothing to compare" in text and "| none |" in text
    json.dumps(summed_up([lost], ["paper"]), allow_nan=False)


def test_policies_that_differ_widen_the_interval():
    """With five policies of a hundred trials each, the interval is that of five draws."""
    alike = [case("mean", k, 0.5, 100) for k in range(5)]
    apart_ = [case("mean", k, float(k % 2), 100) for k in range(4)]
    narrow, wide = (column(own, "synthetic_robot")["success_interval_95"] for own in (alike, apart_))
    few = scipy.stats.t.ppf(0.975, 4) * np.sqrt(5 / 4)  # in place of 1.96: few policies
    assert narrow[1] - narrow[0] == pytest.approx(2 * few * 0.5 / np.sqrt(500), rel=0.1)
    assert wide == [0.0, 1.0]


@pytest.mark.slow
def test_intervals_of_five_policies_hold_the_truth_as_often_as_they_say():
    """Policies of rates between 0.4 and 1, forty trials each; plain quantiles hold the truth less often than that."""
    rng, held = np.random.default_rng(0), 0
    for _ in range(100):
        rates = rng.beta(8, 2, size=5)
        low, high = rate_interval([(rng.random(40) < r).astype(float) for r in rates])
        held += low <= 0.8 <= high
    assert 0.9 <= held / 100 <= 0.99


def test_where_all_succeed_the_interval_has_a_width():
    found = column([case("mean", k, 1.0) for k in range(5)], "synthetic_robot")
    assert found["success_rate"] == 1.0 and found["success_interval_95"] == pytest.approx([0.985, 1.0], abs=1e-3)
    both = apart([case("fitted", k, 1.0) for k in range(5)], [case("prior", k, 0.0) for k in range(5)], "success")
    assert both["difference"] == 1.0 and 0.97 < both["interval_95"][0] < 0.99 and both["welch_95"] is None


def test_the_mean_of_steps_is_inside_its_interval_where_successes_are_few():
    """One success at 400 steps beside a policy with a hundred at 100: weighed alike in the mean and in its interval."""
    each = [np.array([400.0]), np.full(100, 100.0), np.zeros(0)]
    found = spread(each)
    assert found["mean"] == pytest.approx(10400 / 101)
    low, high = found["interval_95"]
    assert low == 100.0 and high == 400.0 and np.mean(resampled(each) < 110) > 0.5


def test_a_difference_has_a_sign_and_an_interval():
    better, worse = [case("fitted", k, 0.9) for k in range(5)], [case("prior", k, 0.3) for k in range(5)]
    found = apart(better, worse, "success")
    assert found["difference"] == pytest.approx(0.6) and 0.4 < found["interval_95"][0] < 0.6 < found["interval_95"][1]
    same = apart(better, [case("prior", k, 0.9) for k in range(5)], "success")
    assert same["interval_95"][0] < 0 < same["interval_95"][1]


def test_steps_of_one_policy_among_several_have_no_interval():
    found = spread([np.array([100.0, 110.0, 120.0]), np.zeros(0), np.zeros(0)])
    assert found["mean"] == 110.0 and found["interval_95"] is None
    assert spread([np.array([100.0, 110.0, 120.0])])["interval_95"] is not None


def test_resamples_of_one_policy_are_of_its_trials():
    draws = resampled([np.array([0.0] * 50 + [1.0] * 50)])
    assert draws.mean() == pytest.approx(0.5, abs=0.01) and draws.std() == pytest.approx(0.05, rel=0.1)


def test_the_table_holds_what_was_run_and_the_papers_own():
    cases = [case(m, 0, 0.5) for m in ("prior", "fitted")]
    found = summed_up(cases, ["paper", "dry"])
    assert set(found["table"]["paper"]["methods"]) == {"prior", "fitted"}
    assert set(found["table"]["paper"]["fitted_better_than"]) == {"prior"}
    assert found["paper"]["mean"]["robot"][0] == 86.7
    assert found["line"]["paper"]["fitted"]["synthetic_robot"] == 0.5
    json.dumps(found)
    text = as_text(found)
    assert "| synthetic robot: success, % (95 %) | 50.0 (36 to 64) | 50.0 (36 to 64) |" in text
    assert "| real robot: success, % | 20.0 | 86.7 | 80.0 |" in text
    assert "Fitted against prior, synthetic robot: +0 points of success (-2" in text
    assert "## Setting `paper`" in text and "`dry`" not in text  # which is still to be run
    panels = histograms(cases, ["paper", "dry"]).axes
    assert percent_in(panels) == pytest.approx([100, 0, 100])  # of each panel's trials
    assert panels[0].get_ylabel() == "trials [%]"
    lines = [line for line in panels[0].lines if line.get_label() == OPENED_WORDS]
    assert [np.asarray(line.get_xdata())[0] for line in lines] == [30.0] and "30°" in [
        t.get_text() for t in panels[0].texts
    ]


def test_the_table_shows_stops_slippery_pads_and_what_blew_up():
    text = as_text(summed_up([case("prior", 0, 0.5, stopped=["late: 9 ms"] * 5)], ["paper"]))
    assert "| stopped by the control loop, % | 10.0 |" in text and "| actions with the grip on, % | 50 |" in text
    assert "| synthetic robot, pads with a friction of 0.05: success, % (95 %) | 50.0 (36 to 64) |" in text
    assert "blew up" not in text
    blown = as_text(summed_up([case("prior", 0, 0.5, stopped=["the simulation blew up"])], ["paper"]))
    assert "| blew up, not counted above | 1 |" in blown


def test_a_hidden_effect_is_the_tables_last_part():
    cases = {model: [case("mean", 0, rate)] for model, rate in (("base", 0.2), ("extended", 0.6))}
    found = summed_up([case("prior", 0, 0.5)], ["paper"])
    found["hidden_effect"] = {
        "hidden": ["closer=3"],
        "sentence": "It lacks a closer.",
        "models": {m: {place: column(own, place) for place in PLACES} for m, own in cases.items()},
        "extended_better_than": {
            "base": {what: apart(cases["extended"], cases["base"], what) for what in ("success", "angle")}
        },
    }
    text = as_text(found)
    assert "## A robot that hides closer=3: prior, base fit and extended model" in text and "It lacks a closer." in text
    assert "| | base | extended |" in text and "Extended against base, synthetic robot: +40 points of success (" in text
    found["hidden_effect"]["models"] = {}  # nothing was named
    assert "It lacks a closer." in as_text(found) and "No policy was trained." in as_text(found)


def test_every_knob_place_has_a_column_and_a_panel():
    of = {"0.30 m": [case("fitted", 0, 1.0)], "0.25 m": [case("fitted", k, 0.5) for k in range(2)]}
    text = knobs_as_text({lever: {place: column(own, place) for place in PLACES} for lever, own in of.items()})
    assert "| | 0.30 m | 0.25 m |" in text and "| of each policy | 100 | 50, 50 |" in text
    panels = knob_histograms(of).axes
    assert [panel.get_title("left") for panel in panels] == [f"{lever} from the hinge" for lever in of]
    assert percent_in(panels) == pytest.approx([100, 100])


def test_a_summarys_figure_lies_beside_it_in_both_forms(tmp_path: Path):
    arguments = Options(out=tmp_path, robot=100, first=100)
    arguments.draw("table2", histograms([case("prior", 0, 0.5)], ["paper"]))
    both = sorted(path.name for path in tmp_path.iterdir())
    assert both == sorted(arguments.summary("table2", kind).name for kind in (".png", ".pdf"))


def test_a_door_that_opens_to_its_stop_is_in_the_histogram():
    wide = case("prior", 0, 0.5)
    wide["synthetic_robot"]["angle_deg"]["all"] = [100.3] * 50
    assert percent_in(histograms([wide], ["paper"]).axes[:1]) == pytest.approx([100])


@pytest.mark.parametrize(
    ("setting", "far"),
    [
        (
            "paper",
            {"hinge_damping": -3.7, "torsional_friction_right": 2.6, "knob_mass": 2.4, "link_mass_scale_2": -3.0},
        ),
        ("dry", {"hinge_frictionloss": 5.5, "hinge_stiffness": 3.5, "knob_mass": 2.6, "link_mass_scale_5": 2.7}),
    ],
)
def test_the_hidden_values_lie_as_far_from_the_prior_as_the_paper_page_says(setting: str, far: dict[str, float]):
    scene = door_scene()
    space, truth = door_space(scene) + door_nuisances(scene), truth_of(SETTINGS[setting])
    found = dict(zip(space.names, space.to_search(np.array([truth[name] for name in space.names])), strict=True))
    assert {name: round(float(found[name]), 1) for name in far} == far
    inside = {name for name, distance in found.items() if abs(distance) < 2.6}
    assert inside.isdisjoint(far.keys() - {"knob_mass"})


def test_slippery_pads_are_all_that_differs_from_the_settings_robot():
    env: Any = SimpleNamespace(start=door_scene().initial_qpos({}), task=Task())
    robots = robots_of(SETTINGS["paper"], env, 100)
    usual, slippery = (robots[name].scene.model for name in ("synthetic_robot", "slippery"))
    assert usual.pair_friction[:, 0].min() > 0.4 and not np.array_equal(usual.pair_friction, slippery.pair_friction)
    fingers = np.concatenate(door_scene().finger_pairs)
    np.testing.assert_allclose(slippery.pair_friction[fingers, :2], 0.05)
    assert usual.pair_friction[fingers, 2].min() > 0.5  # m: by torsion alone such pads turn the door
    np.testing.assert_allclose(slippery.pair_friction[fingers, 2], 0.05 * 0.005)
    np.testing.assert_array_equal(slippery.pair_friction[:, 3:], usual.pair_friction[:, 3:])
    np.testing.assert_array_equal(slippery.dof_damping, usual.dof_damping)
    assert robots["slippery"].config == robots["synthetic_robot"].config


@pytest.mark.slow
@pytest.mark.parametrize("door", SETTINGS)
def test_a_trained_policy_opens_by_its_grip(door: str, archived: Callable[[str], Path]):
    """A reported policy of each door, tried again: with slippery pads a hook or a push would still open it."""
    results = archived("policies")
    kept = json.loads((results / "table2_cases" / door / "prior_0.json").read_text())
    policy = load_policy(results / "trained_cases" / kept["trained"] / POLICY)
    env = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), Task())
    rates = {name: transfer(policy, robot).rate for name, robot in robots_of(SETTINGS[door], env, 10).items()}
    assert rates["synthetic_robot"] >= 0.8 and rates["slippery"] < 0.2


WITHOUT_A_GRIP = {"paper/mean_4", "paper/fitted_3", "paper/fitted_4"}  # docs/history/policy-experiments.md


def test_which_reported_policies_open_without_a_grip(archived: Callable[[str], Path]):
    """Every reported policy should fail with slippery pads; those that do not are known by name, and no others."""
    files = sorted((archived("policies") / "table2_cases").glob("*/*.json"))
    rates = {f"{f.parent.name}/{f.stem}": json.loads(f.read_text())["slippery"]["success_rate"] for f in files}
    assert len(rates) >= 30 and {name for name, rate in rates.items() if rate >= 0.2} == WITHOUT_A_GRIP


def test_settings_have_their_names():
    assert all(name == setting.name and isinstance(setting, Setting) for name, setting in SETTINGS.items())


def test_what_is_there_is_not_made_again(tmp_path: Path):
    made = list[str]()

    def planned(**of: Any) -> list[Case]:
        return [
            Case(tmp_path / f"{n}.json", lambda n=n: made.append(n) or case("mean", 0, 0.5), of, "fit") for n in "abc"
        ]

    run_all(planned(budget={"steps": 1000}), 2, CODE)
    assert made == ["a", "b"] and len(found_of(planned(budget={"steps": 1000}))) == 2
    (tmp_path / "pilot_100.json").write_text("{}")  # lies beside them and is none of them
    run_all(planned(budget={"steps": 1000}), 9, {"commit": "another"})
    assert made == ["a", "b", "c"]
    assert made_by(found_of(planned(budget={"steps": 1000}))) == {
        "cases_from_commits": ["another", "one"],
        "policies_from_commits": ["an older one"],
    }


def test_a_case_that_fails_holds_up_no_other_and_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def fail() -> dict[str, Any]:
        raise ValueError("lost the grasp")

    made = {"a": lambda: case("mean", 0, 0.5), "b": fail, "c": lambda: case("mean", 2, 0.5)}
    planned = [Case(tmp_path / "dry" / f"{n}.json", make, {}, "fit") for n, make in made.items()]
    failed = run_all(planned, 9, CODE)
    assert failed == ["dry/b"] and len(found_of(planned)) == 2
    told = capsys.readouterr().err
    assert "dry/b failed" in told and "ValueError: lost the grasp" in told
    with pytest.raises(SystemExit, match="1 failed and can be tried again: dry/b"):
        finish(failed)
    finish([])


def test_policies_of_different_fits_are_not_summed(tmp_path: Path):
    """The fitted Gaussian and its mean must be of one fit; the prior belongs to none."""
    made = {"mean_0": ("fit", "one"), "fitted_0": ("fit", "one"), "prior_0": ("prior", "none")}
    planned = [
        Case(tmp_path / f"{name}.json", functools.partial(case, "mean", 0, 0.5, fit=fit), {}, doors)
        for name, (doors, fit) in made.items()
    ]
    assert run_all(planned, 9, CODE) == [] and len(found_of(planned)) == 3
    other = Case(tmp_path / "fitted_1.json", functools.partial(case, "mean", 1, 0.5, fit="two"), {}, "fit")
    run_all([other], 9, CODE)
    with pytest.raises(SystemExit, match=r"fitted_1.json and .*mean_0.json were trained on different fits"):
        found_of([*planned, other])


@pytest.mark.parametrize(
    ("script", "which"),
    [("table2", ("mean", 0, "dry")), ("knob_locations", (1, 0)), ("hidden_effect_policy", ("base", 0))],
)
def test_pilots_on_another_robot_never_mix_with_what_is_reported(script: str, which: tuple[Any, ...]):
    module = importlib.import_module(f"experiments.{script}")
    usual, pilot = (module.planned_case(*which, module.Arguments(robot=robot), CODE) for robot in (None, 100))
    assert usual.of != pilot.of and usual.path.parent != pilot.path.parent
    assert usual.of["task"] == asdict(Task()) and usual.of["budget"]["evaluations"] == 8
    assert pilot.of == json.loads(json.dumps(pilot.of))


def test_an_effect_that_no_policy_can_be_tried_with_is_refused_before_the_search():
    module = importlib.import_module("experiments.hidden_effect_policy")
    module.playable(module.Arguments())
    with pytest.raises(SystemExit, match="error: hidden effects command_delay change whole traces"):
        module.playable(module.Arguments(hide=("command_delay=0.01",)))


@pytest.mark.parametrize(
    ("options", "kept"),
    [
        ({}, True),
        ({"hide": ("closer=2",)}, False),
        ({"policy": Path("policy.npz")}, False),
        ({"hide": ("closer=2",), "out": Path("mine")}, True),
        ({"hide": ("closer=2",), "quick": True}, True),
    ],
)
def test_another_table_of_felt_effects_is_not_written_over_the_pilots(options: dict[str, Any], kept: bool):
    module = importlib.import_module("experiments.effects_on_policy")
    with contextlib.nullcontext() if kept else pytest.raises(SystemExit, match="give --out DIR"):
        module.needs_out(module.Arguments(**options))


def test_a_policy_that_another_process_trains_is_waited_for(tmp_path: Path):
    module = importlib.import_module("experiments.effects_on_policy")
    arguments, setting = module.Arguments(out=tmp_path), setting_of("paper", module.PILOT)
    path = arguments.cases("effects_on_policy") / f"prior_{module.PILOT}.json"
    taken, seen = threading.Event(), list[Path]()

    def other() -> None:
        with claimed(path, wait=False):
            taken.set()
            time.sleep(0.3)
            path.write_text('{"trained": "there"}')

    thread = threading.Thread(target=other)
    thread.start()
    taken.wait()
    seen.append(module.trained(arguments, setting, CODE))
    thread.join()
    assert seen == [arguments.trained / "there" / POLICY]


def test_each_policys_doors_are_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Otherwise two policies of one Gaussian would be compared on the same doors, which would count twice."""
    module, seeds = importlib.import_module("experiments.policy_parity"), list[int]()
    found = {"difference_deg": {"largest": 1.0, "within_target": 1.0}, "angles_deg": {"mjx": [1.0], "c": [1.0]}}
    monkeypatch.setattr(module, "trained", lambda *_: (None, None, None))
    monkeypatch.setattr(module, "named", lambda path: {"file": path.name})
    monkeypatch.setattr(module, "compared", lambda *given: seeds.append(given[-1]) or found)
    words = ["--policies", "a/policy.npz", "b/policy.npz", "--seed", "7", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["policy_parity.py", *words])
    module.main()
    assert seeds == [7, 8]


def test_a_policy_is_tried_with_every_effect_that_a_closed_loop_can_have():
    module, scene = importlib.import_module("experiments.effects_on_policy"), door_scene()
    found = module.applicable(scene, module.Arguments())
    names = {one.name for one in found}
    on_traces = {"command_delay", "sensor_delay", "backlash", "torque_bias", "torque_gain", "torque_drift"}
    assert names <= set(possible(scene)) - on_traces and {"closer", "payload", "grip_compliance"} <= names
    assert [o.amplitude for o in found if o == replace(o, name="dry_friction", joint="hinge")] == [1.5, 4.5]
    assert module.applicable(scene, module.Arguments(hide=("closer=2", "dry_friction[hinge]=1"))) == [
        Applied("closer", 2.0),
        Applied("dry_friction", 1.0, "hinge"),
    ]
    with pytest.raises(ValueError, match="unknown hidden effect 'magic'"):
        module.applicable(scene, module.Arguments(hide=("magic=1",)))


def test_where_the_search_names_nothing_no_policy_is_trained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    module = importlib.import_module("experiments.hidden_effect_policy")
    verdict = {"hidden": ["none"], "verdict": "none", "sentence": "It lacks nothing.", "effects": []}
    monkeypatch.setattr(module, "search", lambda *_: verdict)
    monkeypatch.setattr(module, "run_all", lambda *a: pytest.fail("a policy was trained"))
    monkeypatch.setattr(sys, "argv", ["hidden_effect_policy.py", "--out", str(tmp_path)])
    module.main()
    found = json.loads((tmp_path / "hidden_effect_policy.json").read_text())
    assert found["effects"] == [] and found["models"] == {} and found["commit"]


def made_up(planned: Case, rate: float) -> None:
    """Write a planned policy's file, as if it had succeeded in so many of its trials."""
    planned.path.parent.mkdir(parents=True, exist_ok=True)
    planned.path.write_text(json.dumps({**case("any", 0, rate), "origin": CODE, **planned.of}))


def test_policies_of_the_extended_model_are_compared_with_both_others(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    module = importlib.import_module("experiments.hidden_effect_policy")
    verdict = {"hidden": ["it"], "verdict": "named", "sentence": "It lacks a catch.", "effects": ["latch[hinge]"]}
    monkeypatch.setattr(module, "search", lambda *_: verdict)
    arguments = module.Arguments(out=tmp_path, at_most=0)
    for seed, (model, rate) in itertools.product(range(5), {"prior": 0.3, "base": 0.5, "extended": 0.9}.items()):
        made_up(module.planned_case(model, seed, arguments, CODE), rate)
    monkeypatch.setattr(sys, "argv", ["hidden_effect_policy.py", "--out", str(tmp_path), "--at-most", "0"])
    module.main()
    found = json.loads((tmp_path / "hidden_effect_policy.json").read_text())
    assert {m: c["synthetic_robot"]["trials"] for m, c in found["models"].items()} == dict.fromkeys(module.MODELS, 250)
    better = {m: what["success"] for m, what in found["extended_better_than"].items()}
    assert [better[m]["difference"] for m in ("base", "prior")] == pytest.approx([0.4, 0.6])
    assert all(what["interval_95"][0] > 0.1 for what in better.values())


def test_knob_places_are_summed_up_each_for_itself(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    module = importlib.import_module("experiments.knob_locations")
    arguments = module.Arguments(out=tmp_path, at_most=0)
    for seed, (knob, rate) in itertools.product(range(2), enumerate((1.0, 0.8, 0.6))):  # the fourth is not made yet
        made_up(module.planned_case(knob, seed, arguments, CODE), rate)
    monkeypatch.setattr(sys, "argv", ["knob_locations.py", "--out", str(tmp_path), "--at-most", "0"])
    module.main()
    levers = json.loads((tmp_path / "knob_locations.json").read_text())["levers"]
    assert [c["synthetic_robot"]["success_rate"] for c in levers.values()] == pytest.approx([1.0, 0.8, 0.6])
    assert list(levers) == [f"{lever:.2f} m" for lever in module.LEVERS[:3]]
    assert (tmp_path / "knob_locations.png").is_file()


def test_quick_runs_the_setting_that_is_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    module, planned = importlib.import_module("experiments.table2"), list[Case]()
    monkeypatch.setattr(module, "run_all", lambda cases, *_: planned.extend(cases) or [])
    monkeypatch.setattr(sys, "argv", ["table2.py", "--quick", "--settings", "dry", "--out", str(tmp_path)])
    module.main()
    assert [c.of["setting"]["name"] for c in planned] == ["dry"] * 3


def test_what_was_made_with_something_else_is_refused_before_anything_is_made(tmp_path: Path):
    made = list[str]()

    def planned(steps: int) -> list[Case]:
        def make(name: str) -> dict[str, Any]:
            made.append(name)
            return case("mean", 0, 0.5)

        of = {"budget": {"steps": steps}}
        return [Case(tmp_path / f"{n}.json", functools.partial(make, n), of, "fit") for n in "ab"]

    run_all(planned(1000), 1, CODE)
    with pytest.raises(SystemExit, match=r"a.json was made with another budget: .*1000.*, now .*2000.*choose another"):
        run_all(planned(2000), 9, CODE)
    assert made == ["a"]


@pytest.mark.parametrize("option", ["seeds", "trials"])
def test_nothing_to_sum_up_is_refused(option: str):
    with pytest.raises(SystemExit, match=f"--{option} must be 1 or more, got 0"):
        _ = (options := Options(**{option: 0})).budget, options.policies


def test_a_training_that_has_not_learned_is_made_anew_with_twice_the_actions(tmp_path: Path):
    made = list[tuple[int, int]]()

    def training(rates: Sequence[float]):
        def train(config: TrainConfig) -> tuple[Path, dict[str, Any]]:
            made.append((config.seed, config.steps))
            return tmp_path, {"history": [{"success": 0.0}, {"success": rates[len(made) - 1]}, {"success": 0.5}]}

        made.clear()
        return train

    for again, rates, steps in [
        (0, [0.0], [1]),
        (1, [0.95], [1]),
        (1, [0.94, 0.0], [1, 2]),
        (2, [0.0, 0.0, 0.0], [1, 2, 4]),
        (2, [0.0, 1.0], [1, 2]),
    ]:
        budget = Options(again=again).budget
        learned(budget, 7, training(rates))
        assert made == [(7, n * budget.config.steps) for n in steps]
    once, twice = Options().budget.to_json(), Options(again=1).budget.to_json()
    assert twice == {**once, "again": 1}, "files that were made before the rule stay valid"


def test_pilots_have_a_summary_of_their_own(tmp_path: Path):
    assert Options(out=tmp_path).summary("table2").name == "table2.json"
    assert Options(out=tmp_path, first=100).summary("table2", ".md").name == "table2_from_100.md"
    other = Options(out=tmp_path, first=100, robot=100)
    assert other.summary("table2").name == "table2_robot_100_from_100.json"
    assert other.cases("table2").name == "table2_robot_100_cases"
    assert setting_of("dry", 100) == replace(SETTINGS["dry"], robot=100) and setting_of("dry", None) == SETTINGS["dry"]


def test_the_fit_of_another_setting_is_not_taken(tmp_path: Path):
    options = Options(out=tmp_path)
    folder = options.cases("fit_paper")
    folder.mkdir()
    (folder / "gaussian.json").write_text("{}")
    (folder / "fit.json").write_text(json.dumps({"setting": asdict(SETTINGS["paper"]), "quick": False}))
    with pytest.raises(SystemExit, match="holds the fit of another robot"):
        fitted(replace(SETTINGS["paper"], robot=99), options, CODE)


def test_what_another_process_makes_is_left_to_it(tmp_path: Path):
    made = list[str]()
    planned = [
        Case(tmp_path / f"{n}.json", lambda n=n: made.append(n) or case("mean", 0, 0.5), {}, "fit") for n in "abc"
    ]
    holds = (
        "import sys, time; from pathlib import Path; from benchmarks.sharing import claimed\n"
        f"with claimed(Path({str(tmp_path / 'a.json')!r}), wait=False) as mine: print(mine, flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", holds], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None and other.stdout.readline() == "True\n"
        run_all(planned, 1, CODE)
        assert made == ["b"]
        with claimed(tmp_path / "a.json", wait=False) as mine:
            assert not mine
    finally:
        other.kill()
        other.wait()
    run_all(planned, 9, CODE)  # a claim ends with its process
    assert made == ["b", "a", "c"]


def test_a_policy_that_two_experiments_need_is_trained_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Named after all that decides it: doors, method, seed, task; not after who asks."""
    scene = door_scene(timestep=0.004, limits=True)
    env: Any = SimpleNamespace(scene=scene, start=scene.initial_qpos({}), effects=(), task=Task())
    seeds = list[int]()

    def train(env: Any, randomise: Any, config: TrainConfig, **_: Any) -> Any:
        seeds.append(config.seed)
        return SimpleNamespace(policy="policy", history=())

    monkeypatch.setattr(store, "train", train)
    monkeypatch.setattr(store, "save_policy", lambda path, policy: path.write_text(policy))
    known, config = Doors(prior(door_space(scene)), "prior"), TrainConfig()
    first, made = trained(tmp_path, env, known, config, CODE)
    assert trained(tmp_path, env, replace(known, method="fitted"), config, {"commit": "two"}) == (first, made)
    assert made["trained_by"] == CODE and made["trained"] == first.name and seeds == [0]
    wider = replace(known.gaussian, cov=2 * known.gaussian.cov)
    near: Any = SimpleNamespace(**{**vars(env), "start": np.nextafter(env.start, 9.0)})  # another machine's
    assert trained(tmp_path, near, known, config, CODE) == (first, made) and seeds == [0]
    others: list[Any] = [
        (SimpleNamespace(**{**vars(env), "start": env.start + 1e-6}), known, config),
        (env, known, replace(config, seed=1)),
        (env, replace(known, method="mean"), config),
        (env, Doors(wider), config),
        (SimpleNamespace(**{**vars(env), "task": Task(steps=100)}), known, config),
    ]
    assert len({trained(tmp_path, *other, CODE)[0] for other in others} | {first}) == 6


@pytest.mark.parametrize(("name", "method"), [("paper", "prior"), ("paper", "fitted"), ("dry", "mean")])
def test_the_reported_policies_are_found_by_what_decided_them(name: str, method: str, archived: Callable[[str], Path]):
    case = json.loads((archived("policies") / "table2_cases" / name / f"{method}_3.json").read_text())
    task, options = Task(**setting_of(name, None).task), Options(out=archived("policies"))
    env = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), task)
    space = door_space(env.scene) + door_nuisances(env.scene)
    gaussian = prior(space) if method == "prior" else load_gaussian(RESULTS / f"fit_{name}_cases" / GAUSSIAN)
    of = decided_by(env, Doors(gaussian, method), replace(options.budget.config, seed=3))
    assert place_of(options.trained, of).name == case["trained"]


@pytest.mark.slow
@pytest.mark.parametrize(("script", "line"), [("table2", {"paper"}), ("knob_locations", {"0.15 m"})])
def test_the_experiments_run_quick(tmp_path: Path, script: str, line: set[str]):
    command = [sys.executable, f"experiments/{script}.py", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(json.loads(done.stdout.splitlines()[-1])) == line
    assert (tmp_path / f"{script}_quick.json").is_file()
