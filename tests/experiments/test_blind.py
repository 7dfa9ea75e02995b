"""The blind suite: no truth in a recording, seeds from the commit, an answer for everything, rates that are right."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from droid_jax.model.effects.registry import registered
from droid_jax.model.parameters import Parameter, Space
from droid_jax.recordings.formats import load_recording
from droid_jax.synthetic.hidden_effects import HIDDEN, LIBRARY, ON_HINGE, Applied, possible
from experiments import hidden_effects, null_calibration
from experiments.blind import limits, marks, oracle, score
from experiments.blind import rates as summing
from experiments.blind.answers import ANSWERS, inside, parts, right, targets, without
from experiments.blind.baselines import bic_outcome
from experiments.blind.cases import Counts, Plan, amplitude, key, keys, plans
from experiments.blind.draws import commit_of, draw_truths, folder_of, seed_of
from experiments.blind.make import Drawn, make, record
from experiments.blind.marks import Ground, ground
from experiments.blind.quiet import QUIET, around
from experiments.blind.scenes import ROLES, Setting, setting
from experiments.blind.search import Bench
from experiments.blind.table import score_table

CHEAP = ("hinge", "bench", "arm")
COMMIT = "0" * 40
LIMITS = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "detection_limits.json"


@pytest.fixture(scope="module")
def hinge() -> Setting:
    """The lone hinge with motions of a quarter of a second."""
    whole = setting("hinge")
    short = {role: r.window(0.0, 0.25) for role, r in whole.demonstrations.items()}
    return replace(whole, motions=lambda: short)


def limits_of(where: Setting) -> dict[str, dict[str, Any]]:
    return {key(e.name, e.joint): entry(limit=1e-4, worth=0.0, right={}) for e in keys(where)}


def entry(**changes: Any) -> dict[str, Any]:
    return {"limit": 0.1, "unit": "N m", "right": {"door_closer at door": 0.3}, "worth": 0.02, **changes}


# ----- what is made


def test_a_recording_holds_nothing_of_the_truth(hinge: Setting, tmp_path: Path):
    (plan,) = [p for p in plans(hinge, Counts(), COMMIT, {}) if p.name == "hinge/single/closer/3x/0"]
    cases, sealed = tmp_path / "cases", tmp_path / "sealed"
    assert make(hinge, plan, COMMIT, {"closer": entry()}, cases, sealed) == "made"
    assert make(hinge, plan, COMMIT, {"closer": entry()}, cases, sealed) == "there"
    (folder,) = cases.iterdir()
    (seal,) = sealed.iterdir()
    truth = json.loads(seal.read_text())
    assert truth["hidden"] == [{"name": "closer", "amplitude": pytest.approx(0.3), "joint": ""}]
    files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    assert files == ["case.json", *(f"recordings/{role}.npz" for role in sorted(ROLES))]
    assert json.loads((folder / "case.json").read_text()) == {"scene": "hinge", "without": []}
    words = {"closer", "single", "3x", str(truth["seed"]), *(str(s) for s in truth["seeds"].values())}
    for role in ROLES:
        recording = load_recording(folder / "recordings" / f"{role}.npz")
        assert recording.name == role and not recording.meta and recording.repeats == 10
        with np.load(folder / "recordings" / f"{role}.npz") as file:
            assert not any(word in str(file["metadata"]) for word in words)
    assert not any(word in folder.name for word in (*words, f"{truth['seed']:x}"))
    offsets = [truth["truths"][role]["torque_offset[door]"] for role in ROLES]
    assert len(set(offsets)) == 3
    assert len({truth["truths"][role]["door_damping"] for role in ROLES}) == 1


def test_what_is_left_out_is_all_that_would_be_right(hinge: Setting, tmp_path: Path):
    known = limits_of(hinge)
    left = next(
        p for p in plans(hinge, Counts(left_out=99), COMMIT, known) if p.name.startswith("hinge/left_out/hinge_p")
    )
    assert make(hinge, left, COMMIT, known, tmp_path / "cases", tmp_path / "sealed") == "made"
    (folder,) = (tmp_path / "cases").iterdir()
    told = json.loads((folder / "case.json").read_text())["without"]
    assert {"hinge_preload", "tilted_frame"} <= set(told)
    assert not set(told) & {e.name for e in hinge.effects(told)}


def test_seeds_and_folders_come_from_the_commit():
    name = "bench/none/nothing/0x/0"
    assert seed_of("a", name) == seed_of("a", name) != seed_of("b", name)
    assert 0 <= seed_of("a", name) < 1 << 32
    assert folder_of("a", name).startswith("bench_") and folder_of("a", name) != folder_of("b", name)
    assert commit_of("development") == "development"
    with pytest.raises(ValueError, match="no commit"):
        commit_of("no such thing")


def test_truths_are_the_robots_own_in_all_recordings_but_for_the_sensors():
    bench = setting("bench")
    truths = draw_truths(bench, np.random.default_rng(3))
    assert set(truths) == set(ROLES) and set(truths["train"]) == set(bench.base.names)
    apart = {n for n in bench.base.names if truths["train"][n] != truths["validation"][n]}
    assert apart == {n for n in bench.base.names if n.startswith("torque_offset[")}
    for seed in range(40):  # none so far out that the search would have to call it an effect
        truth = draw_truths(bench, np.random.default_rng(seed))["train"]
        nuisances = [p for p in bench.base.parameters if p.nuisance]
        assert all(abs(truth[p.name] - p.mean) <= 2.5001 * p.std for p in nuisances)


@pytest.mark.parametrize("name", CHEAP)
def test_motions_differ_and_begin_at_rest(name: str):
    motions = setting(name).demonstrations
    assert tuple(motions) == ROLES
    for motion in motions.values():
        assert np.all(np.abs(motion.command[1] - motion.command[0]) < 1e-4)
        assert motion.command[0].tolist() == list(motion.qpos0.values())
    assert not np.allclose(motions["train"].command, motions["validation"].command, atol=0.05)


# ----- what is right


def test_every_hidden_effect_has_an_answer():
    assert set(ANSWERS) == set(HIDDEN)
    assert {name: answer.exact for name, answer in ANSWERS.items() if answer.exact} == LIBRARY  # what users are told
    known = set(registered())
    assert {*ON_HINGE, *ON_HINGE.values()} <= known
    for name, answer in ANSWERS.items():
        assert {n for n in (answer.exact, *answer.ties) if n} <= known, name
        assert answer.exact or (answer.why and not answer.ties), name


@pytest.mark.parametrize("name", CHEAP)
def test_targets_can_be_hidden_and_named(name: str):
    where = setting(name)
    offered = {f"{e.name} at {place}" for e in where.effects() for place in e.locations}
    for hidden in keys(where):
        assert hidden.name in possible(where.scene)
        names = right(where.scene, hidden)
        assert bool(names) == inside(hidden.name)
        assert not names or names[0] in offered, (hidden, names)
        assert set(without(where.scene, [hidden])) == {n.split(" at ")[0] for n in names}


def test_places_of_answers():
    bench = setting("bench")
    assert right(bench.scene, Applied("stribeck_friction", 1.0, "elbow")) == ("joint_stribeck at elbow",)
    assert right(bench.scene, Applied("stribeck_friction", 1.0, "door")) == ("hinge_stribeck at door",)
    assert right(bench.scene, Applied("torque_bias", 1.0, "elbow")) == ("torque_bias at elbow", "cable_pull at elbow")
    assert right(bench.scene, Applied("detent", 1.0)) == ()
    assert right(bench.scene, Applied("held_thing", 1.0)) == tuple(
        f"{name} at {bench.scene.joints[-1]}" for name in ("free_payload", "payload")
    )
    assert "elbow" not in targets(bench, "dry_friction")  # its friction is a base parameter


def test_plans_are_of_all_classes_and_drawn_by_the_commit():
    bench = setting("bench")
    known, counts = limits_of(bench), Counts(none=2, single=1, pair=5, outside=1, left_out=4)
    made = plans(bench, counts, COMMIT, known)
    kinds = [p.kind for p in made]
    assert {k: kinds.count(k) for k in ("none", "pair", "left_out")} == {"none": 2, "pair": 5, "left_out": 4}
    assert len({p.name for p in made}) == len(made)
    assert made == plans(bench, counts, COMMIT, known)
    other = plans(bench, counts, "1" * 40, known)
    assert [p.effects for p in made if p.kind == "pair"] != [p.effects for p in other if p.kind == "pair"]
    few = {"closer": entry(), "air_drag": entry(), "detent": entry()}
    assert {p.effects for p in plans(bench, counts, COMMIT, few) if p.kind == "pair"} == {("closer", "air_drag")}


@pytest.mark.parametrize("name", ["hinge", "bench", "door"])
def test_no_pair_shares_a_right_name(name: str):
    where = setting(name)
    wanted = plans(where, Counts(none=0, single=0, pair=1000, outside=0, left_out=0), COMMIT, limits_of(where))
    names = {e: {n for joint in targets(where, e) for n in right(where.scene, Applied(e, 1.0, joint))} for e in ANSWERS}
    pairs = {plan.effects for plan in wanted}
    assert len(pairs) > 20 and [pair for pair in pairs if names[pair[0]] & names[pair[1]]] == []


def test_amplitudes_are_multiples_of_what_can_be_told_and_is_worth_it():
    known = {"closer": entry(), "air_drag": entry(limit=0.01), "detent": entry(right={}), "payload": entry(limit=None)}
    assert amplitude("closer", "", 3.0, known) == pytest.approx(0.3)
    assert amplitude("air_drag", "", 3.0, known) == pytest.approx(0.06)  # worth naming only from there
    assert amplitude("detent", "", 1.0, known) == pytest.approx(0.1)
    assert amplitude("closer", "", 1000.0, known) is None  # no door withstands it
    assert amplitude("payload", "", 1.0, known) is None
    assert amplitude("closer", "", 1.0, {"closer": entry(right={"door_closer at door": 0.95})}) is None


# ----- detection limits


class Stage:
    """A ground of three candidates, one of them absorbed by the only base parameter."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.noise = rng.normal(size=(limits.REPEATS * 4, 40))

    def asked(self, columns: np.ndarray, free: np.ndarray) -> np.ndarray:
        return columns * (np.arange(40) >= 10)

    def left(self, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return column * (np.arange(40) >= 10), np.ones(1, bool)


def test_limits_scale_with_the_effect():
    rng = np.random.default_rng(1)
    stage: Any = Stage()
    marks = rng.normal(size=(3, 40))
    power = limits.Power(stage, marks, rng.permuted(np.tile(np.arange(40), (60, 1)), axis=1)[:, :10], {})
    added = np.tile(marks[1], (limits.REPEATS, 1))
    found = power.limit(added, 10.0)
    assert found is not None
    assert power.at(2 * found, added) > limits.POWER > power.at(found / 2, added)
    twice = power.limit(2 * added, 10.0)
    assert twice == pytest.approx(found / 2, rel=0.05)
    assert power.limit(added * (np.arange(40) < 10), 10.0) is None  # nothing of it is left


def test_a_form_that_blows_up_hides_no_limit(monkeypatch: pytest.MonkeyPatch):
    """Its score is NaN, with which every p would be zero and every limit the smallest."""
    monkeypatch.setattr(marks, "sensitivities", lambda *_: np.array([[1.0, 2.0], [np.nan, np.nan]]))
    seen: Any = SimpleNamespace(evidence=None, model=SimpleNamespace(values=None))
    np.testing.assert_array_equal(Ground.added(seen, ()), [[1.0, 2.0], [0.0, 0.0]])
    stage: Any = Stage()
    raw = np.stack([np.random.default_rng(1).normal(size=40), np.zeros(40)])
    power = limits.Power(stage, raw, np.tile(np.arange(10), (5, 1)), {})
    assert power.limit(np.tile(raw[0], (limits.REPEATS, 1)), 10.0) == pytest.approx(
        limits.Power(stage, raw[:1], power.chosen, {}).limit(np.tile(raw[0], (limits.REPEATS, 1)), 10.0)
    )


def test_a_limit_says_at_which_size_its_effect_was_recorded():
    """Also where the last recording was not close enough to the limit."""
    recorded = list[float]()

    def hidden(effect: Applied) -> np.ndarray:
        recorded.append(effect.amplitude)
        return np.zeros((limits.REPEATS, 1))

    where: Any = SimpleNamespace(hidden=hidden, left=lambda column: (column, np.ones(1, bool)))
    power: Any = SimpleNamespace(limit=lambda added, largest: 0.1 * recorded[-1])  # smaller with every recording
    forms: Any = SimpleNamespace(of=lambda *_: {})
    found = limits.limit_of(where, power, forms, Applied("closer", 1.0))
    assert len(recorded) == limits.RECORDED and len(set(recorded)) == limits.RECORDED
    assert found["recorded_at"] == recorded[-1]


def test_bounds_hold_what_the_base_model_absorbs():
    """Of a change twice as large as a parameter's range, half remains, and the parameter counts as stuck."""
    space = Space((Parameter("a", "-", 0.0, 1.0, -1.0, 1.0), Parameter("b", "-", 0.0, 1.0, -9.0, 9.0)))
    slopes = np.zeros((6, 2))
    slopes[0, 0] = slopes[1, 1] = 100.0
    refined: Any = type("Refined", (), {"x": np.zeros(2), "jacobian": slopes, "prior": np.full(2, 10.0)})
    model: Any = type("Model", (), {"space": space, "refined": refined})
    seen: Any = type("Seen", (), {"repeats": 1})
    ground = Ground(setting("hinge"), {}, 0, seen, model, slopes, np.zeros((1, 6)))
    left, free = ground.left(np.array([200.0, 200.0, 5.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(left, [100.0, 0.0, 5.0, 0.0, 0.0, 0.0], atol=0.01)
    assert free.tolist() == [False, True]


@pytest.mark.slow
def test_what_an_effect_adds_is_taken_on_the_same_robot_with_the_same_noise(hinge: Setting):
    """It is proportional to an offset, and differs between repeats for a drift."""
    where = ground(hinge, draw_truths(hinge, np.random.default_rng(3))["train"], 7)
    one, two = (where.hidden(Applied("torque_bias", size)) for size in (0.1, 0.2))
    assert one.shape[0] == 10 and np.abs(one).max() > 1.0
    np.testing.assert_allclose(two, one, atol=0.02 * np.abs(one).max())
    assert np.ptp(one, axis=0).max() == 0.0 < np.ptp(where.hidden(Applied("torque_drift", 0.5)), axis=0).max()


def test_the_synthetic_robot_is_no_mirror_of_the_library():
    """The library's form of a hidden effect leaves a residual of at least 5 % of the effect's root mean square."""
    scenes = json.loads(LIMITS.read_text())["scenes"]
    assert {"hinge", "door"} <= set(scenes)
    for scene, effects in scenes.items():
        left = {name: e["form"]["left"] for name, e in effects.items() if "form" in e}
        assert len(left) > 10 and min(left.values()) >= 0.05, (scene, sorted(left.items(), key=lambda e: e[1])[:3])


# ----- scoring


def case(
    kind: str, verdict: str, effects: list[str], right_names: list[list[str]], tied: Any = None, **more: Any
) -> Any:
    hidden = [{"name": f"h{k}", "joint": "", "amplitude": 2.0} for k in range(len(right_names))]
    truth = {"name": f"{kind}", "scene": "s", "kind": kind, "factor": 3.0, "hidden": hidden, "commit": COMMIT}
    gaps = {"validation": [11.0, 2.0], "test": [11.0, 1.5]}
    result = {
        "verdict": verdict, "effects": effects, "indistinguishable": tied or [[] for _ in effects],
        "p": 0.002, "discrepancies": gaps,
        "discretisation_error": 1.0, "seconds": {"base": 2.0, "find": 3.0}, **more,
    }  # fmt: skip
    return {"truth": truth, "result": result, "right": right_names, "parts": [], "oracle": None}


def reached(validation: float, converged: bool = True) -> Any:
    """An oracle."""
    return {"discrepancies": {"validation": validation}, "settled": None, "converged": converged}


def rates(*cases: Any, known: Any = None) -> dict[str, Any]:
    return summing.summarise([score.judge(c, known or {}) for c in cases])


def test_rates_of_what_is_named():
    latch, closer = "latch at door", "door_closer at door"
    found = rates(
        case("single", "named", [latch], [[latch]]),
        case("single", "indistinguishable", [closer], [[latch]], tied=[[latch]]),
        case("single", "partly explained", [latch], [[latch]]),
        case("single", "named", [closer], [[latch]]),
        case("single", "unexplained", [], [[latch]]),
        case("pair", "named", [latch], [[latch], [closer]]),
        case("pair", "named", [latch, closer], [[latch], [closer]]),
        case("outside", "partly explained", [closer], [[]]),
        case("outside", "named", [closer], [[]]),
        case("left_out", "named", [latch], [[latch]]),
        case("none", "none", [], []),
        case("none", "named", [latch], []),
    )
    expected = {
        "named_up_to_tie": (3, 5), "named_alone": (2, 5), "named_exactly": (1, 5), "partly": (1, 5),
        "wrong_name_rate": (3, 10),
        "false_names": (4, 10), "pair_one_named_none_false": (2, 2), "pair_both_named": (1, 2),
        "unexplained_recall": (1, 3),
        "false_alarm_rate": (1, 2), "false_names_where_nothing": (1, 2), "detected": (7, 7),
    }  # fmt: skip
    for name, (hits, of) in expected.items():
        assert (found[name]["hits"], found[name]["of"]) == (hits, of), name
        low, high = found[name]["interval_95"]
        assert 0 <= low <= hits / of <= high <= 1
    assert found["gap_closed_validation"]["median"] == pytest.approx(0.9)
    assert found["gap_closed"]["median"] == pytest.approx(0.95)
    assert found["within_floor"]["rate"] == 1.0 and found["seconds"]["whole"] == 5.0


def test_cases_are_nameable_where_right_names_close_half_of_the_gap():
    latch = "latch at door"
    good, poor = ({"oracle": reached(u)} for u in (5.0, 7.0))  # of 10 above the floor they close 6 and 4
    shut = case("single", "none", [], [[latch]], discrepancies={"validation": [1.01, 1.01], "test": [1.0, 1.0]})
    found = rates(
        {**case("single", "named", [latch], [[latch]]), **good},
        {**case("single", "named", [latch], [[latch]]), **poor},  # named or not: the oracle alone counts
        {**case("single", "unexplained", [], [[latch]]), **good},
        {**case("single", "unexplained", [], [[latch]]), **poor},
        {**case("single", "unexplained", [], [[latch]]), "oracle": reached(7.0, converged=False)},  # not known
        {**case("single", "unexplained", [], [[latch]]), "oracle": reached(5.0, converged=False)},  # known to be enough
        case("single", "named", [latch], [[latch]]),  # not known either
        {**shut, **good},
        {**case("pair", "named", [latch, "drag at door"], [[latch], ["drag at door"]]), **good},
    )
    hits = {name: (found[name]["hits"], found[name]["of"]) for name in found if name.startswith("nameable")}
    assert hits == {
        "nameable": (4, 7), "nameable_unknown": (2, 9),
        "nameable_named_up_to_tie": (1, 3), "nameable_named_exactly": (1, 3),
        "nameable_pair_one_named_none_false": (1, 1), "nameable_pair_both_named": (1, 1),
    }  # fmt: skip
    assert score.judge({**shut, **good}, {})["reachable"] == 0.0  # no gap to speak of


def test_effects_larger_than_their_factor_says_are_counted_apart():
    latch = "latch at door"
    limits = [{"s": {"h0": {"limit": limit}}} for limit in (2.0 / 3.0, 0.1)]  # 2.0 hidden: 3 and 20 times
    given = (case("single", "named", [latch], [[latch]]), case("single", "unexplained", [], [[latch]]))
    judged = [
        score.judge(c, known) for c, known in zip((given[0], given[1], given[0]), (*limits, limits[1]), strict=True)
    ]
    found = summing.summarise(judged)
    assert [j["larger"] for j in judged] == [False, True, True]
    assert (found["named_alone_at_the_multiple"]["hits"], found["named_alone_at_the_multiple"]["of"]) == (1, 1)
    assert (found["named_up_to_tie_larger"]["hits"], found["named_up_to_tie_larger"]["of"]) == (1, 2)


def test_a_part_of_what_was_hidden_is_no_false_name_beside_it_but_alone():
    whole, part = "joint_directional at j", "joint_coulomb at j"
    both, alone = case("single", "named", [whole, part], [[whole]]), case("single", "named", [part], [[whole]])
    judged = [score.judge({**c, "parts": [[part]]}, {}) for c in (both, alone)]
    assert [j["named"] for j in judged] == [True, False]
    assert [j["false_names"] for j in judged] == [[], [[part]]]
    assert [j["wrong_confident"] for j in judged] == [False, True]
    assert parts(setting("arm").scene, Applied("directional_friction", 1.0, "panda_joint2")) == (
        "joint_coulomb at panda_joint2",
        "joint_stribeck at panda_joint2",
    )


def test_without_noise_a_recording_keeps_its_scatter_and_gets_another_mean(hinge: Setting):
    truths = draw_truths(hinge, np.random.default_rng(3))
    drawn = Drawn((Applied("hinge_preload", 0.5),), truths, dict.fromkeys(ROLES, 7))
    (noisy,), (plain,) = (record(hinge, drawn, ("train",), *config).values() for config in ((), (QUIET,)))
    moved = around(plain, noisy)
    for name, channel in moved.channels.items():
        quiet, rough = plain.channels[name].values, noisy.channels[name].values
        assert np.ptp(quiet, axis=0).max() == 0.0 < np.ptp(rough, axis=0).max(), name
        np.testing.assert_allclose(channel.values.mean(axis=0), quiet[0], atol=1e-6)
        np.testing.assert_allclose(channel.values - quiet[0], rough - rough.mean(axis=0), atol=1e-6)


def measured(low: float, high: float) -> Any:
    span = {"latch_torque": {"value": 3.0, "interval": [low, high]}}
    return case("single", "named", ["latch at door"], [["latch at door"]], coefficients=span)


def test_intervals_are_compared_with_where_the_model_settles_without_noise():
    without_noise = {"oracle": {**reached(2.0), "settled": {"latch_torque": 3.2}}}
    found = rates(*({**measured(*span), **without_noise} for span in ((2.9, 3.3), (3.0, 3.1), (3.1, 3.3))))
    assert (found["amplitude_coverage"]["hits"], found["amplitude_coverage"]["of"]) == (2, 3)
    assert "amplitude_coverage" not in rates({**measured(2.9, 3.1), "oracle": reached(2.0)}, measured(2.9, 3.1))


def test_intervals_are_compared_with_what_the_library_form_should_take():
    form = {"name": "latch at door", "per_unit": {"latch_torque": 1.5}, "left_after_refit": 0.1}
    known = {"s": {"h0": {"form": form}}}
    found = rates(measured(2.9, 3.1), measured(3.1, 3.3), known=known)
    counted = found["amplitude_counterpart_coverage"]
    assert (counted["hits"], counted["of"]) == (1, 2)
    far = {"s": {"h0": {"form": {**form, "left_after_refit": 0.9}}}}
    assert "amplitude_counterpart_coverage" not in rates(measured(2.9, 3.1), known=far)


def test_where_there_is_no_gap_no_share_of_it_is_closed():
    gaps = {"validation": [11.0, 2.0], "test": [1.01, 0.99]}
    judged = score.judge(case("single", "named", ["latch at door"], [["latch at door"]], discrepancies=gaps), {})
    assert judged["closed"] == {"validation": pytest.approx(0.9)}


def test_search_and_black_box_are_compared_on_the_same_gaps():
    box = {"bic": [], "black_box": {"validation": [11.0, 6.0], "test": [11.0, 1.0]}}
    named = case("single", "named", ["latch at door"], [["latch at door"]], baselines=box)
    gaps = {"validation": [11.0, 11.0], "test": [1.0, 1.0]}  # the test motion shows none
    silent = case("single", "unexplained", [], [["latch at door"]], baselines=box, discrepancies=gaps)
    found = rates(named, silent)["baselines"]
    assert found["search_closed_validation"]["median"] == pytest.approx(0.45)  # 0.9 and 0
    assert found["black_box_closed_validation"]["median"] == pytest.approx(0.5)
    assert found["search_closed_test"]["at_least"]["of"] == found["black_box_closed_test"]["at_least"]["of"] == 1


def test_confusion_tells_ties_from_swaps_and_right_effects_in_wrong_places():
    right_names = [["latch at door", "preload at door"]]
    answers = (["preload at door"], ["latch at elbow"], ["closer at door"])
    judged = [score.judge(case("single", "named", names, right_names), {}) for names in answers]
    judged.append(
        score.judge(case("single", "indistinguishable", ["closer at door"], right_names, tied=[["latch at door"]]), {})
    )
    assert summing.confusion(judged) == {"h0": {"latch": 2, "latch (elsewhere)": 1, "closer": 1}}
    pair, ties = [["tilt at door"], ["delay at door"]], [["delay at door + tilt at door"], ["tilt at door"]]
    both = score.judge(case("pair", "indistinguishable", ["drag at door", "delay at door"], pair, tied=ties), {})
    assert both["said"] == ["drag", "delay"]


def test_confusion_and_errors():
    judged = [
        score.judge(c, {})
        for c in (
            case("single", "named", ["latch at door"], [["latch at door"]]),
            case("single", "unexplained", [], [["latch at door"]]),
            {**case("single", "error", [], [["latch at door"]]), "result": {"verdict": "error", "error": "no replay"}},
        )
    ]
    assert summing.confusion(judged) == {"h0": {"latch": 1, "(unexplained)": 1, "(error)": 1}}
    assert summing.summarise(judged)["unconverged_or_error"]["hits"] == 1


def test_bic_is_judged_by_the_same_answers():
    def outcome(named: list[str], right: list[list[str]], parts: list[list[str]] | None = None) -> dict[str, bool]:
        return bic_outcome(named, right, parts or [])

    assert outcome(["a"], [["a", "b"]]) == {"all": True, "false": False}
    assert outcome(["a", "c"], [["a", "b"]]) == {"all": True, "false": True}
    assert outcome(["a", "c"], [["a", "b"]], [["c"]]) == {"all": True, "false": False}
    assert outcome(["c"], [["a", "b"]], [["c"]]) == {"all": False, "false": True}
    assert outcome(["a"], [["a"], ["b"]]) == {"all": False, "false": False}
    assert outcome(["b"], [["a", "b"], ["b"]]) == {"all": False, "false": False}
    assert outcome(["a"], []) == {"all": False, "false": True}


def test_one_tie_does_not_name_both_effects_of_a_pair():
    right_names = [["check", "preload"], ["tilt", "preload"]]
    one = score.judge(case("pair", "indistinguishable", ["preload"], right_names, tied=[["check", "tilt"]]), {})
    two = score.judge(case("pair", "indistinguishable", ["preload", "check"], right_names, tied=[["tilt"], []]), {})
    assert sum(one["met"]) == 1 and not one["named"] and not one["false_names"]
    assert two["met"] == [True, True] and two["named"]


def test_a_tie_of_two_effects_at_once_names_both():
    """ "a, or b and c together": the hidden pair b and c is named, and where only b is hidden c is a false name."""
    found = case("pair", "indistinguishable", ["a"], [["b"], ["c"]], tied=[["b + c"]])
    judged = score.judge(found, {})
    assert judged["met"] == [True, True] and judged["named"] and not judged["wrong_confident"] and not judged["alone"]
    other = score.judge(case("single", "indistinguishable", ["a"], [["b"]], tied=[["b + c"]]), {})
    assert other["met"] == [False] and other["false_names"]


def test_two_names_for_one_effect_are_not_named_alone():
    given = {**case("single", "named", ["bias", "drift"], [["bias"]]), "parts": [["drift"]]}
    judged = score.judge(given, {})
    assert judged["named"] and not judged["alone"] and not judged["exact"]


def test_an_effects_own_name_is_told_from_an_equivalents():
    """As an effect or as indistinguishable, also among several effects; of a pair both must be named."""
    names = [["latch", "preload"]]
    one = [
        case("single", "named", ["latch"], names),
        case("single", "indistinguishable", ["drag"], names, tied=[["latch"]]),
        case("single", "named", ["preload"], names),
        case("single", "named", ["latch", "drag"], names),  # with a false name it is not named
        case("left_out", "named", ["latch"], names),
    ]
    judged = [score.judge(c, {}) for c in one]
    assert [j["named"] for j in judged] == [True, True, True, False, False]
    assert [j["own"] for j in judged] == [True, True, False, False, False]
    found = summing.summarise(judged)["named_by_its_own_name"]
    assert (found["hits"], found["of"]) == (2, 4)
    assert "| one at 3 times: the same, by its own name" in score_table(judged, {})
    pair = [["latch", "preload"], ["tilt", "spring"]]
    two = [
        case("pair", "named", ["tilt", "preload"], pair),
        case("pair", "named", ["tilt", "latch"], pair),
        case("pair", "indistinguishable", ["drag"], pair, tied=[["preload + tilt", "latch + tilt"]]),
    ]
    judged = [score.judge(c, {}) for c in two]
    assert [(j["named"], j["own"]) for j in judged] == [(True, False), (True, True), (True, True)]


def test_no_answer_is_no_alarm_and_the_limit_is_counted_apart():
    at_limit = case("single", "unexplained", [], [["latch"]])
    at_limit["truth"]["factor"] = 1.0
    found = rates(
        case("none", "none", [], []),
        case("none", "fit not converged", [], []),
        case("single", "named", ["latch"], [["latch"]]),
        at_limit,
    )
    assert (found["false_alarm_rate"]["hits"], found["false_alarm_rate"]["of"]) == (0, 1)
    assert found["named_up_to_tie"]["of"] == 1 and found["unconverged_or_error"]["hits"] == 1


def test_the_table_says_how_many_were_not_searched():
    judged = [score.judge(case("single", "named", ["latch"], [["latch"]]), {})]
    assert "| s (1 of 3 cases) |" in score_table(judged, {"s": ["s_1", "s_2"]}) and "| s (1 cases) |" in score_table(
        judged, {}
    )


def test_how_many_pairs_are_asked_for_decides_nothing_else(hinge: Setting):
    limits = json.loads(LIMITS.read_text())["scenes"]["hinge"]
    few, many = (plans(hinge, Counts(pair=n), COMMIT, limits) for n in (2, 10))
    left = [[p.name for p in found if p.kind == "left_out"] for found in (few, many)]
    assert left[0] == left[1] and left[0]
    pairs = [[p.name for p in found if p.kind == "pair"] for found in (few, many)]
    assert pairs[1][:2] == pairs[0]


def test_a_case_tells_its_multiple_of_the_limit_and_whose_code_searched():
    known = {"s": {"h0": {"limit": 0.5}}}
    given = case("single", "named", ["latch at door"], [["latch at door"]])
    judged = score.judge(given, known)
    assert judged["times_limit"] == {"h0": abs(given["truth"]["hidden"][0]["amplitude"]) / 0.5}
    codes = (COMMIT, "f" * 40, None)  # None: the folder was no checkout any more
    searched = [{**given, "result": {**given["result"], "code": code}} for code in codes]
    assert [score.code_of(c) for c in searched] == ["frozen", "other", "unknown"]


def test_limits_of_another_run_are_refused():
    hidden = {"name": "closer", "joint": "", "amplitude": -0.3}
    truth = {"name": "s/single/closer/3x/0", "scene": "s", "factor": 3.0, "hidden": [hidden]}
    score.refuse_other_limits([truth], {"s": {"closer": entry(limit=0.1)}})
    score.refuse_other_limits([truth], {"s": {"closer": entry(limit=0.01, worth=0.1)}})
    for limit in (0.05, 0.2, None):
        with pytest.raises(
            ValueError, match=r"closer/3x/0 hides 0.3 of closer, by these limits it would be .*--limits"
        ):
            score.refuse_other_limits([truth], {"s": {"closer": entry(limit=limit)}})


def test_a_null_that_was_made_in_pieces_is_summed_up_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Scene by scene, in any order; cases of another commit are refused, and --quick has a separate summary."""
    made = list[str]()

    def case_of(plan: Any, commit: str, bench: Any) -> dict[str, Any]:
        made.append(plan.name)
        return {
            "scene": plan.scene,
            "p": 0.5,
            "discrepancy": 0.0,
            "converged": True,
            "seconds": {"base": 1.0},
            "code": commit,
        }

    def run(*words: str) -> dict[str, Any]:
        monkeypatch.setattr("sys.argv", ["null_calibration.py", "--out", str(tmp_path), *words])
        null_calibration.main()
        return json.loads((tmp_path / "null_calibration.json").read_text())

    def counts(hinge: int, bench: int) -> list[str]:
        given = {"hinge": hinge, "bench": bench, "arm": 0, "door": 0}
        return [word for name, n in given.items() for word in (f"--counts.{name}", str(n))]

    monkeypatch.setattr(null_calibration, "case_of", case_of)
    monkeypatch.setattr(null_calibration, "commit_of", lambda name: name)
    run("--commit", COMMIT, *counts(3, 0))
    with pytest.raises(SystemExit, match=f"of {COMMIT}, not of {'b' * 40}"):
        run("--commit", "b" * 40, *counts(0, 2))
    run("--commit", "b" * 40, "--quick")
    found = run("--commit", COMMIT, *counts(0, 2))
    assert {scene: of["cases"] for scene, of in found["scenes"].items()} == {"hinge": 3, "bench": 2}
    assert found["all"]["cases"] == 5 and found["by_other_code"] == 0 and len(made) == 7
    assert run("--commit", COMMIT, "--sum-only")["all"] == found["all"] and len(made) == 7


def test_a_null_that_fails_after_its_screening_keeps_its_p(monkeypatch: pytest.MonkeyPatch):
    """Otherwise failed cases would be missing from the count of rejections, since only those continue."""

    def run_case(plan: Any, commit: str, bench: Any, watch: Any) -> Any:
        watch.seconds["base"] = 1.0
        yield {"p": 0.001, "discrepancy": 0.1, "converged": True}
        raise ValueError("no replay")

    monkeypatch.setattr(null_calibration, "run_case", run_case)
    case = null_calibration.case_of(Plan("hinge/null/0", "hinge", "none"), COMMIT, Bench())
    other = {"p": 0.5, "discrepancy": 0.0, "converged": True, "seconds": {"base": 1.0}}
    found = null_calibration.summarise([case, other])
    assert case["p"] == 0.001 and case["error"] == "no replay" and case["verdict"] == "error"
    assert (found["screening_rejects"]["hits"], found["screening_rejects"]["of"]) == (1, 2)
    assert (found["alarms"]["hits"], found["rejected_then_failed"], found["errors"]) == (0, 1, 1)


def test_a_case_that_runs_out_of_memory_is_no_result(monkeypatch: pytest.MonkeyPatch):
    """As a result, it would never be tried again."""

    def run_case(*given: Any) -> Any:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(null_calibration, "run_case", run_case)
    with pytest.raises(RuntimeError, match="out of memory"):
        null_calibration.case_of(Plan("hinge/null/0", "hinge", "none"), COMMIT, Bench())


def test_a_quick_suite_has_a_folder_of_its_own(tmp_path: Path):
    placed, runs = hidden_effects.placed, hidden_effects.RUNS
    assert placed(hidden_effects.All(quick=True)).out == placed(hidden_effects.Make(quick=True)).out
    assert placed(hidden_effects.All(quick=True)).out == runs.with_name("hidden_effects_quick")
    assert placed(hidden_effects.All()).out == placed(hidden_effects.Score()).out == runs
    assert placed(hidden_effects.All(quick=True, out=tmp_path)).out == tmp_path


def test_cases_of_two_commits_do_not_mix_where_make_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def stopped(*given: Any) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(hidden_effects, "make", stopped)
    monkeypatch.setattr(hidden_effects, "commit_of", lambda name: name)
    command = hidden_effects.Make(quick=True, out=tmp_path, limits=LIMITS)
    with pytest.raises(KeyboardInterrupt):
        hidden_effects.run_make(replace(command, commit=COMMIT))
    with pytest.raises(SystemExit, match=f"holds cases of {COMMIT}"):
        hidden_effects.run_make(replace(command, commit="b" * 40))


def test_a_search_is_given_the_cases_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """No folder that the process gets contains a seal."""
    told: list[str] = []
    (tmp_path / "sealed").mkdir()
    for name in ("run_make", "run_oracle", "run_score"):
        monkeypatch.setattr(hidden_effects, name, lambda command: {})
    monkeypatch.setattr(hidden_effects.subprocess, "run", lambda command, check: told.extend(command))
    hidden_effects.run_all(hidden_effects.All(out=tmp_path))
    given = [Path(word) for word in told if word.startswith(str(tmp_path))]
    assert given == [tmp_path / "cases", tmp_path / "results"]
    with pytest.raises(SystemExit, match="no case below"):
        hidden_effects.run_search(hidden_effects.Search((tmp_path,), results=tmp_path / "results"))


def test_what_a_killed_make_left_half_written_is_no_case(tmp_path: Path):
    for name in ("hinge_1", ".hinge_0.3fa9/new"):
        (tmp_path / ".runs" / "cases" / name).mkdir(parents=True)
        (tmp_path / ".runs" / "cases" / name / "case.json").write_text("{}")
    assert hidden_effects.case_folders(tmp_path / ".runs" / "cases") == [tmp_path / ".runs" / "cases" / "hinge_1"]


def test_an_oracle_is_of_the_result_that_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Without a result there is none; each result gets one; a failed case stores its error."""
    asked: list[Any] = []

    def one(folder: Path, truth: Any, result: dict[str, Any], bench: Any) -> dict[str, Any]:
        asked.append(result["n"])
        if result["n"] == 3:
            raise FloatingPointError("no replay")
        return {"model": "latch", "discrepancies": {"train": 1.0}}

    monkeypatch.setattr(oracle, "oracle", one)
    for folder in ("sealed", "results"):
        (tmp_path / folder).mkdir()
    for name in ("a", "b"):
        (tmp_path / "sealed" / f"{name}.json").write_text('{"kind": "single"}')
    for number in (1, 1, 2, 3):
        (tmp_path / "results" / "a.json").write_text(json.dumps({"n": number}))
        oracle.oracle_all(tmp_path, ("a", "b"), Bench(), lambda line: None)
    assert asked == [1, 2, 3]
    assert json.loads((tmp_path / "oracle" / "a.json").read_text())["error"] == "no replay"
    given = {**case("single", "unexplained", [], [["latch at door"]]), "oracle": {"error": "no replay"}}
    assert score.judge(given, {})["reachable"] is None


def test_only_unsearched_cases_are_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    plans = [
        SimpleNamespace(name=name, kind="none", effects=(), factor=0.0) for name in ("hinge/none/0", "hinge/none/1")
    ]
    asked: list[str] = []
    monkeypatch.setattr(hidden_effects, "setting", lambda *_: None)
    monkeypatch.setattr(hidden_effects, "commit_of", lambda name: name)
    monkeypatch.setattr(hidden_effects, "plans", lambda *_: plans)
    monkeypatch.setattr(hidden_effects, "make", lambda where, plan, *_: asked.append(plan.name) or "made")
    (tmp_path / "limits.json").write_text('{"scenes": {}}')
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / f"{folder_of(COMMIT, plans[0].name)}.json").write_text("{}")
    options = {"commit": COMMIT, "limits": tmp_path / "limits.json", "out": tmp_path, "scenes": ("hinge",)}
    assert hidden_effects.run_make(hidden_effects.Make(**options, unsearched=True)) == {
        "hinge": {"there": 1, "made": 1}
    }
    assert asked == ["hinge/none/1"]
    assert hidden_effects.run_make(hidden_effects.Make(**options)) == {"hinge": {"made": 2}}


@pytest.mark.parametrize(("quick", "name"), [(True, "limits_quick.json"), (False, "limits.json")])
def test_a_quick_limit_is_not_written_among_those_that_count(tmp_path: Path, monkeypatch, quick: bool, name: str):
    module = hidden_effects
    monkeypatch.setattr(module, "setting", lambda *_: None)
    monkeypatch.setattr(module, "scene_limits", lambda *_: {"closer": {"limit": 1.0}})
    module.run_limits(module.Limits(("hinge",), out=tmp_path / "limits.json", kept=tmp_path, quick=quick))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    entry = json.loads((tmp_path / name).read_text())["scenes"]["hinge"]["closer"]
    assert entry == {"limit": 1.0, "commit": hidden_effects.CODE.get("git")}  # others of the file may be older
