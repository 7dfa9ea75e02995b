"""The page of a search, and its figures."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from made_up_gap import CLOSER, CONFIG, LATCH, STRIBECK, cell, gap_json, make_gap, text
from made_up_run import make_run
from msgspec import structs
from reader import Page, read_page, spaced

from droid_jax.report import gap_figures, page, style
from droid_jax.report.gap_folder import Gap, Shift, Verdict, read_gap
from droid_jax.report.gap_page import gap_doubts, gap_next_step, groups, options, outcome, signatures, untrusted, where
from droid_jax.report.text import lines, percent, significant, spelled

VERDICTS = get_args(Verdict)
ROLES = ("train", "validation", "test")
BLOCKS = {"by": "blocks", "limits": "The validation blocks are of the same motion."}
HALVES = {"by": "repeats", "limits": "The validation repeats repeat the fitted motion."}
COULOMB = [{"effect": "joint_coulomb", "location": f"panda_joint{k}"} for k in (2, 3)]


@pytest.fixture
def made(tmp_path: Path, quick: None) -> Callable[..., tuple[Gap, Page]]:
    """A function of what `make_gap` takes: the search, and its page."""

    def make(verdict: str = "named", **changes: Any) -> tuple[Gap, Page]:
        folder = make_gap(tmp_path / "run", verdict, **changes)
        return read_gap(folder), read_page(page.write_report(folder))

    return make


def _shown(cell: dict[str, Any], value: float | None, written: Callable[..., str] = significant) -> bool:
    """Whether a cell holds this value, and shows it."""
    if value is None:
        return cell["text"].strip() == "–"
    return cell["values"] == [value] and cell["text"].strip() == written(value)


@pytest.mark.slow
@pytest.mark.parametrize("verdict", VERDICTS)
@pytest.mark.parametrize("split", [None, BLOCKS, HALVES])
def test_every_verdict_has_its_answer_and_what_to_do(made: Callable, verdict: str, split: dict | None) -> None:
    gap, written = made(verdict, test=verdict != "none", **({"split": split} if split else {}))
    answer = written.ids["gap-answer"]
    assert answer["data-verdict"] == verdict and spelled(gap.found.sentence) in spaced(answer["text"])
    assert "_" not in answer["text"]
    assert written.ids["gap-next"]["data-next"] == gap_next_step(gap)
    said = spaced(written.ids["gap-next"]["text"]).strip()
    assert said.startswith("Next: ") and len(said) > 30 and said.endswith(".") and ".." not in said
    assert "_" not in said.replace("droid_jax", "")
    assert list(written.doubts) == gap_doubts(gap) and all(spaced(t).strip() for t in written.doubts.values())
    assert ("limits" in written.doubts) == bool(split)
    assert ("validation_chose" in written.doubts) == (verdict == "none")
    assert ("discrepancy:train", "after") in written.cells or not gap.extended
    assert ("missing_remainder" in written.ids) == (verdict in ("unexplained", "partly explained"))


def test_the_first_screen_has_the_numbers_of_the_judging_recording(made: Callable) -> None:
    gap, written = made()
    of = gap.found.discrepancies["test"]
    expected = [gap.found.p, of.before, of.after, of.closed, gap.found.discretisation_error]
    keys = ("p", "before", "after", "closed", "discretisation_error")
    assert [float(written.keys[key]) for key in keys] == expected
    said = spaced(written.ids["gap-answer"]["text"])
    assert (
        f"U was {significant(of.before)} before and is {significant(of.after)} after: {percent(of.closed)} of" in said
    )


def test_the_tables_hold_the_numbers_of_the_file(made: Callable) -> None:
    gap, written = made()
    cells, found = written.cells, json.loads((gap.folder / "gap.json").read_text())
    for role, of in found["discrepancies"].items():
        for field in ("before", "after", "torque_before", "torque_after"):
            assert _shown(cells[f"discrepancy:{role}", field], of[field])
        assert _shown(cells[f"discrepancy:{role}", "closed"], of["closed"], percent)
    assert _shown(cells["discrepancy:error", "before"], found["discretisation_error"])
    for a in (*found["coefficients"], *found["shape_parameters"]):
        assert _shown(cells[f"coefficient:{a['name']}", "value"], a["value"])
        assert cells[f"coefficient:{a['name']}", "interval"]["values"] == [a["low"], a["high"]]
        assert a["what"] in cells[f"coefficient:{a['name']}", "effect"]["text"]
    for s in found["shifts"]:
        for field, key in (("before", "before"), ("after", "after"), ("deviation", "deviation_before")):
            assert _shown(cells[f"shift:{s['name']}", field], s[key])
    for t in found["validation_tests"]:
        row = f"test:{t['parts_before']}:{' + '.join(map(text, t['parts']))}"
        for field in ("discrepancy_train", "discrepancy_validation"):
            assert _shown(cells[row, field], t[field])
        assert _shown(cells[row, "chosen"], t["chosen"], percent) and _shown(
            cells[row, "p"], t["p"], lambda v: significant(v, 2)
        )
        assert written.rows[row]["data-reasons"] == " ".join(r["reason"] for r in t["reasons"])
        assert all(r["text"] in cells[row, "outcome"]["text"] for r in t["reasons"])
    for k, test in enumerate(found["score_tests"]):
        for entry in test["ranking"]:
            row = f"score:{k}:{text(entry)}"
            assert _shown(cells[row, "t"], entry["t"]) and _shown(cells[row, "explained"], entry["explained"], percent)
    (trend,) = found["trends"]
    assert _shown(
        cells[f"trend:{trend['coefficient']}", "per_repeat"], trend["per_repeat"], lambda v: significant(v, 2)
    )
    assert cells["threshold:selection.significance", "value"]["text"] == "0.01"


def test_settings_and_times_are_on_the_page(made: Callable) -> None:
    gap, written = made()
    facts = spaced(written.ids["gap-facts"]["text"])
    for stage, seconds in gap.found.seconds.items():
        assert f"{stage.replace('_', ' ')} {significant(seconds)} s" in facts
    assert "11 in the score test of the base model, 4 models validated" in facts
    assert "preset quick; fit a.npz; validation b.npz; recording a.npz" in facts
    assert "Not refitted" not in facts
    _, written = made(ruled_out=["drag at door hinge"])
    assert "drag at door hinge: too far from the best ones" in spaced(written.ids["gap-facts"]["text"])


def test_settings_are_those_that_a_person_reads(tmp_path: Path) -> None:
    """Hashes and the start of a base fit decide whether a run may be continued; the page does not show them."""
    asked = {"preset": "quick", "recording": ["a.npz", "b.npz"], "scene": None, "budget": 0.5}
    setup = {**asked, "command": "gap", "recordings_sha256": ["12ab"], "start": [0.1, 0.2], "synthetic_robot": False}
    gap = read_gap(make_gap(tmp_path / "run", setup=setup))
    assert options(gap) == {"preset": "quick", "recording": "a.npz, b.npz", "budget": "0.5"}


def test_the_page_says_what_to_look_for(made: Callable) -> None:
    """Of every effect of the answer its signature and what looks like it; of what is indistinguishable also what it
    is.
    """
    _, written = made("indistinguishable")
    latch = "signature:a magnetic catch or latch that holds the door in its first degrees"
    stribeck = "signature:dry friction of the hinge that falls with speed"
    assert written.cells[latch, "signature"]["text"] == "the first degrees of opening, and the last of closing"
    assert written.cells[stribeck, "confused_with"]["text"] == "latch, joint stribeck"
    assert written.rows[stribeck].get("class") == "alternative" and "class" not in written.rows[latch]


def test_a_signature_at_several_places_is_shown_once_and_none_where_nothing_is_known(tmp_path: Path) -> None:
    own = {"effect": "squeak", "location": "door_hinge"}
    step = {"what": "dry friction", "signature": "a step at every reversal.", "confused_with": []}
    about = {"joint_coulomb": step, "squeak": {"what": "", "signature": "", "confused_with": []}}
    effects, drag = [*COULOMB, own], {"effect": "drag", "location": "door_hinge"}
    gap = read_gap(make_gap(tmp_path, effects=effects, indistinguishable=[[[drag]], [], []], about=about))
    (one,) = signatures(gap.found)
    assert [p.text for p in one.places] == [text(p) for p in COULOMB]
    assert (one.alternative, one.about.signature) == (False, "a step at every reversal.")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verdict", "changes", "doubt", "said"),
    [
        ("none", {"not_tried": "pairs of effects"}, "not_tried", "pairs of effects"),
        ("named", {"discretisation_error": None}, "step_unknown", "not known"),
        ("named", {"discretisation_error": 0.3 * 4.213}, "coarse", "30 % of U of the base model on “A”"),
        ("named", {}, "trends", "joint coulomb at joint 2 changes by about −0.021 N m"),
        ("named", {}, "blown_up", "drag at door hinge"),
        ("named", {"test": False}, "validation_chose", "the validation recording also chose"),
        ("named", {"test": False, "failed": ["the fitted model on the test recording"]}, "test_lost", "replayed"),
        ("named", {"amendments": {"final_refit": "not made: it blew up"}}, "final_refit", "was not made: it blew up;"),
        ("named", {"amendments": {"experiments": "to be made"}}, "experiments", "the same command makes them"),
        ("named", {"remainder": 0.25 * 0.0213 * 1.31}, "within_fit", "75 % lies within the uncertainty"),
    ],
)
def test_what_to_doubt_is_said(made: Callable, verdict: str, changes: dict, doubt: str, said: str) -> None:
    _, written = made(verdict, **changes)
    assert said in spaced(written.doubts[doubt])


@pytest.mark.parametrize(
    ("changes", "doubt"),
    [
        ({"discretisation_error": 0.01 * 4.213}, "coarse"),
        ({"remainder": 0.9 * 0.0213 * 1.31}, "within_fit"),
        ({"failed": ["the fitted model on the test recording"], "test": False}, "validation_chose"),
        ({"amendments": {"experiments": "made", "final_refit": "not needed"}}, "final_refit"),
    ],
)
def test_what_is_no_doubt_is_not_said(made: Callable, changes: dict, doubt: str) -> None:
    _, written = made(**changes)
    assert doubt not in written.doubts
    assert "the fitted model on the test recording" not in written.text


def test_a_model_that_does_worse_on_the_test_recording_is_doubted(made: Callable) -> None:
    of = gap_json("named", ROLES)["discrepancies"]
    of["test"] |= {"after": 1.5 * of["test"]["before"], "closed": -0.5}
    gap, written = made("named", discrepancies=of)
    assert "test_worse" in gap_doubts(gap) and "larger with the effects than without" in spaced(
        written.doubts["test_worse"]
    )
    assert "50 % more" in spaced(written.text)
    assert "test_worse" not in gap_doubts(made("named")[0])


def test_friction_that_creeps_is_mended_in_the_mjcf(made: Callable) -> None:
    remedy = "take solimpfriction from extended.patch"
    about = {"soft_friction": {"what": "", "signature": "", "confused_with": [], "remedy": remedy}}
    gap, written = made("named", effects=[{"effect": "soft_friction", "location": "all joints"}], about=about)
    assert gap_next_step(gap) == "named in the simulator"
    assert "solimpfriction" in written.ids["gap-next"]["text"] and "hardware" in written.ids["gap-next"]["text"]


@pytest.mark.parametrize("after", [0.0, -0.006])
def test_no_share_of_nothing(tmp_path: Path, after: float) -> None:
    of = gap_json("named", ROLES)["discrepancies"]
    of["validation"]["after"] = after
    gap = read_gap(make_gap(tmp_path, discrepancies=of, remainder=-0.01))
    assert "within_fit" not in gap_doubts(gap)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verdict", "changes", "step", "said"),
    [
        ("indistinguishable", {}, "decisive experiment", "the same motion at 0.3 of the speed. There the alternatives"),
        (
            "indistinguishable",
            {"experiments": [{"what": "another pose", "distance": 2.5, "not_made": ""}]},
            "weak experiment",
            "only 2.50 standard deviations apart; ten repeats decide from 6 on",
        ),
        ("indistinguishable", {"experiments": []}, "no experiment", "No candidate experiment was computed"),
        (
            "indistinguishable",
            {"experiments": [{"what": "another pose", "distance": None, "not_made": "too long"}]},
            "no experiment",
            "None of the candidate experiments could be simulated",
        ),
        ("indistinguishable", {"discretisation_error": 0.0}, "record another motion", "record one that is slower"),
        ("named", {}, "named", "look for the latch at door hinge on the hardware"),
        ("named", {"doubts": ["its form does not fit"]}, "named", "take its numbers with care"),
        ("partly explained", {}, "keep", "joint 1 in opening, from 2.0 s on and object angle 0.00 to 0.14 rad"),
        ("partly explained", {"explained": 0.51}, "keep", "keep the latch at door hinge in the model"),
        ("partly explained", {"explained": 0.49}, "mostly open", "may only imitate it"),
        ("unexplained", {}, "none passed", "joint 1 in opening, from 2.0 s on"),
        ("fit not converged", {}, "fit not converged", "identify --preset standard --restarts 3"),
        ("fit not converged", {"split": BLOCKS}, "fit not converged", "Next: give the parameters tighter priors"),
        ("none", {"split": BLOCKS}, "none", "a smaller effect would need repeats, a longer log"),
        (
            "unexplained",
            {"split": BLOCKS},
            "none passed",
            "where the remaining discrepancy is largest, noise included: joint 1",
        ),
    ],
)
def test_what_to_do_next(made: Callable, verdict: str, changes: dict, step: str, said: str) -> None:
    gap, written = made(verdict, **changes)
    assert gap_next_step(gap) == step and said in spaced(written.ids["gap-next"]["text"])
    assert untrusted(gap) == (step in ("mostly open", "none passed", "fit not converged"))


def test_significant_but_small_is_said(made: Callable) -> None:
    _, written = made("none", p=0.002)
    assert "significant, but small: no larger than the discretisation error" in written.text
    _, written = made("none", p=0.002, discretisation_error=0.0)
    assert "significant, but small: U is not above zero" in written.text
    assert ("discrepancy:error", "before") not in written.cells  # an inverse replay has no time step


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_log_in_blocks_claims_nothing_that_takes_repeats(made: Callable, verdict: str) -> None:
    found = gap_json(verdict, ROLES)
    cells = {when: [{**c, "found": False} for c in found["cells"][when]] for when in ("before", "after")}
    _, written = made(verdict, split=BLOCKS, discretisation_error=0.0, cells=cells, experiments=[], trends=[])
    said = written.text
    assert BLOCKS["limits"] in said and "noise included" in said
    untrue = ("repeats' mean", "one repeat", "ten repeats", "more repeats", "Discretisation error U0", "Hatched")
    assert [words for words in (*untrue, "whole repeats", "no single place") if words in said] == []


def test_where_the_most_is_left(tmp_path: Path) -> None:
    """The largest significant cell, here of a joint's position; none where no cell is significant."""
    found = gap_json("unexplained", ROLES)["cells"]
    quiet = [{**c, "found": False} for c in found["after"]]
    one = cell("position", 3.0, "panda_joint2", low=0.1, high=0.2, unit="rad")
    gap = read_gap(make_gap(tmp_path / "one", "unexplained", cells={**found, "after": [*quiet, one]}))
    assert [(c.axis, c.joint, c.discrepancy) for c in where(gap)] == [("position", "panda_joint2", 3.0)]
    assert where(read_gap(make_gap(tmp_path / "none", "unexplained", cells={**found, "after": quiet}))) == []


def test_validation_tests_say_what_became_of_them(tmp_path: Path) -> None:
    found = read_gap(make_gap(tmp_path / "run", "partly explained")).found
    one, two = groups(found)
    assert [row.outcome for row in one.rows].count("selected") == 1 and one.rows[0].outcome == "selected"
    assert {row.outcome for row in (*one.rows[1:], *two.rows)} == {"failed"}
    before = [found.discrepancies[r].before for r in ("train", "validation")]
    assert [one.discrepancy_train, one.discrepancy_validation] == before
    assert [p.text for p in two.beside] == [text(LATCH)]
    (pair,) = two.rows
    assert (pair.t, two.discrepancy_train) == (2.4 * 0.8**2, found.validation_tests[0].discrepancy_train)
    alike = groups(read_gap(make_gap(tmp_path / "alike", "indistinguishable")).found)[0].rows
    assert [r.outcome for r in alike[:2]] == ["selected, indistinguishable", "indistinguishable"]


@pytest.mark.parametrize(
    ("verdict", "parts", "u", "expected"),
    [
        ("unexplained", [LATCH], 9.0, "larger discrepancy"),
        ("unexplained", [LATCH], 0.01, "simpler"),
        ("unexplained", [LATCH, CLOSER], 0.01, "small gain"),
        ("fit not converged", [LATCH], 0.01, "not converged"),
    ],
)
def test_what_passed_and_was_not_named_says_why(
    tmp_path: Path, verdict: str, parts: list, u: float, expected: str
) -> None:
    found = gap_json("unexplained", ROLES[:2]) | {"verdict": verdict}
    passed = {**found["validation_tests"][0], "parts": parts, "discrepancy_validation": u, "passed": True}
    passed |= {"reasons": [], "parts_before": len(parts) - 1}
    found["validation_tests"] = [*found["validation_tests"][1:], passed]
    gap = read_gap(make_gap(tmp_path / "run", **found))
    assert [r.outcome for g in groups(gap.found) for r in g.rows if r.test.passed] == [expected]
    assert gap_next_step(gap) == ("none passed clearly" if verdict == "unexplained" else verdict)


def test_pairs_tried_from_scratch_stand_beside_those_that_grew(tmp_path: Path) -> None:
    found = gap_json("partly explained", ROLES[:2])
    grown = next(t for t in found["validation_tests"] if t["parts_before"] == 1)
    other = {**grown, "parts": [STRIBECK, CLOSER], "passed": True, "reasons": []}
    found["validation_tests"] += [{**grown, "passed": True, "reasons": [], "discrepancy_validation": 0.5}, other]
    found |= {"effects": [LATCH, CLOSER], "indistinguishable": [[[STRIBECK]], []]}
    one, two = groups(read_gap(make_gap(tmp_path / "run", **found)).found)
    assert [(r.outcome, r.test.discrepancy_validation) for r in two.rows] == [
        ("selected, indistinguishable", 0.5),
        ("indistinguishable", 2.4),
    ]
    assert two.rows[1].t is None and one.rows[0].outcome.startswith("selected")


def test_an_alternative_of_several_effects_is_one_model(made: Callable) -> None:
    pair = gap_json("named", ROLES)["validation_tests"][0]
    alone = {**pair, "parts": [STRIBECK, CLOSER], "parts_before": 1}
    tests = [*gap_json("named", ROLES)["validation_tests"], alone]
    gap, _ = made("indistinguishable", indistinguishable=[[[STRIBECK, CLOSER]]], validation_tests=tests)
    assert outcome(gap.found, gap.found.validation_tests[-1]) == "indistinguishable"


def test_what_failed_by_itself_and_is_in_the_model_beside_others_is_no_contradiction(tmp_path: Path) -> None:
    """Its interval excludes zero in the final model, but not in the model without the other effects."""
    found = gap_json("named", ROLES[:2]) | {"effects": [LATCH, CLOSER], "indistinguishable": [[], []]}
    reason = {"reason": "may be zero", "text": "its coefficient may be zero (90 % interval 0 to 0.9 N m)"}
    found["validation_tests"] = [{**found["validation_tests"][0], "passed": False, "reasons": [reason]}]
    (row,) = (r for g in groups(read_gap(make_gap(tmp_path, **found)).found) for r in g.rows)
    assert row.outcome == "failed alone"


def test_a_value_at_its_bound_is_said_to_lie_there(made: Callable) -> None:
    doubt = "the form of latch at door_hinge does not fit: latch_width at its lower bound, 0.01 rad"
    bounded = {"value": 0.01, "low": 0.01, "high": 0.0143, "bound": "lower"}
    shapes = [{**gap_json("named", ROLES)["shape_parameters"][0], **bounded}]
    gap, written = made(sentence=f"It lacks: {text(LATCH)}. But {doubt}.", doubts=[doubt], shape_parameters=shapes)
    assert "latch width at its lower bound, 0.01 rad" in spaced(written.ids["gap-answer"]["text"])
    width = written.cells["coefficient:latch_width", "value"]
    assert (width["data-bound"], width["values"]) == ("lower", [0.01]) and "lower bound" in width["text"]
    said = lines("gap.txt.jinja", gap=gap, found=gap.found, shifted=None)
    assert said[2] == "latch at door_hinge: latch width 0.0100 rad (at its lower bound), 0.0100 to 0.0143 rad " + (
        "(90 % interval)"
    )


def test_a_hint_is_no_name(made: Callable) -> None:
    """An effect that closes only a third is a hint, in the next step and in its validation test."""
    hints = [{"effects": [LATCH], "indistinguishable": [[]], "closed": {"validation": 0.31}}]
    tests = gap_json("partly explained", ROLES[:2])["validation_tests"]
    gap, written = made("unexplained", hints=hints, validation_tests=tests)
    assert gap_next_step(gap) == "hints" and untrusted(gap)
    assert "Latch at door hinge passed, but closes less than 40 %" in spaced(written.ids["gap-next"]["text"])
    assert written.rows[f"test:0:{text(LATCH)}"]["data-outcome"] == "hint"


def test_an_experiment_that_was_not_made_says_why(made: Callable) -> None:
    experiments = [
        {"what": "the same motion twice as fast", "distance": 7.1, "not_made": ""},
        {"what": "three times slower", "distance": None, "not_made": "a stretch that no repeat measured"},
    ]
    _, written = made("indistinguishable", experiments=experiments)
    assert written.cells["experiment:0", "distance"]["values"] == [7.1]
    assert _shown(written.cells["experiment:1", "distance"], None)
    assert "not made: a stretch that no repeat measured" in written.text


def test_the_final_model_says_what_it_is_fitted_to(made: Callable) -> None:
    _, written = made(final_model={"fitted_to": ["A", "B"], "discrepancies": {"test": 0.025}})
    final = written.ids["final-model"]
    assert final["data-value"] == "0.025" and "“A” and “B” together" in spaced(final["text"])
    _, written = made(final_model={"fitted_to": ["A"], "discrepancies": {}})
    assert "final-model" not in written.ids


def test_a_synthetic_robot_is_said(made: Callable) -> None:
    _, written = made("none", setup={"recording": []})
    assert "synthetic robot" in written.text


def test_no_name_of_a_search_becomes_markup(made: Callable, tmp_path: Path) -> None:
    evil = "<b>x</b>\"'"
    place = {"effect": f"latch{evil}", "location": evil}
    found = gap_json("indistinguishable", ROLES)
    changes: dict[str, Any] = {
        "sentence": evil, "effects": [place], "indistinguishable": [[[{"effect": evil, "location": evil}]]],
        "about": {place["effect"]: {"what": evil, "signature": evil, "confused_with": [evil]}},
        "coefficients": [{**found["coefficients"][0], **place, "name": evil, "unit": evil, "what": evil}],
        "shifts": [{**found["shifts"][0], "name": evil, "unit": evil}], "not_tried": evil, "failed": [evil],
        "ruled_out": [evil],
        "experiments": [{"what": evil, "distance": 9.0, "not_made": evil}],
        "trends": [{**found["trends"][0], **place, "coefficient": evil, "p": 0.001}],
        "score_tests": [{"p": 0.001, "ranking": [{**place, "t": 1.0, "explained": 0.5}], "failed": [place]}],
        "validation_tests": [
            {**found["validation_tests"][0], "parts": [place], "reasons": [{"reason": evil, "text": evil}], "passed": 0}
            | {"passed": False}
        ],
        "amendments": {"final_refit": f"not made: {evil}"}, "split": {"by": "recordings", "limits": evil},
        "config": {**CONFIG, evil: evil}, "device": evil, "versions": {evil: evil}, "seconds": {evil: 1.0},
        "setup": {"recording": [evil], evil: evil},
        "discrepancies": {r: {**d, "recording": evil} for r, d in found["discrepancies"].items()},
    }  # fmt: skip
    made("indistinguishable", **changes)
    html = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "<b>" not in html.lower() and html.lower().count("&lt;b&gt;") > 30


@pytest.mark.slow
@pytest.mark.parametrize("verdict", ["partly explained", "none"])
def test_the_page_loads_nothing_and_every_link_is_there(tmp_path: Path, verdict: str) -> None:
    folder = make_gap(tmp_path / "run", verdict)
    written = read_page(page.write_report(folder))
    assert all(source.startswith("data:") for source in written.loads)
    assert not [link for link in written.links if not (folder / link).is_file()]
    stems = {"gap", "cells", "state", "torque_train", "torque_validation", "torque_test"}
    stems |= {"shifts", "remainder"} if verdict == "partly explained" else set()
    names = {f"missing_{s}.{kind}" for s in stems for kind in ("png", "pdf", "json")}
    assert {p.name for p in (folder / "figures").iterdir()} == names


@pytest.mark.slow
def test_one_page_for_a_folder_with_both(tmp_path: Path) -> None:
    folder = make_gap(make_run(tmp_path / "run"), "named")
    html = page.write_report(folder).read_text(encoding="utf-8")
    written = read_page(folder / "report.html")
    assert ("hinge_stiffness", "mean") in written.cells and ("discrepancy:test", "after") in written.cells
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', html))
    assert {"identification", "missing"} <= used <= set(ids)
    assert {link for link in written.links if link.startswith("gap.")} == {"gap.json", "gap.npz"}


# ----- the figures of a search for a missing effect draw what they are given


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> Gap:
    return read_gap(make_gap(tmp_path_factory.mktemp("gap") / "named"))


def test_overlays_draw_the_given_torques(named: Gap) -> None:
    traces = named.traces["test"]
    figure = gap_figures.torque_overlays(traces, named.found.units)
    panels = [a for a in figure.axes if a.get_visible() and a.get_title("left")]
    assert [a.get_title("left") for a in panels] == [f"Joint {i}" for i in range(1, 8)]
    for j, axes in enumerate(panels):
        drawn = {line.get_label(): line for line in axes.lines}
        for name, key in (("base model", "before"), ("final model", "after"), ("measured, mean", "measured")):
            rows = np.searchsorted(traces["time"], drawn[name].get_xdata())
            np.testing.assert_array_equal(drawn[name].get_ydata(), traces[key][rows, j])
    (base,) = gap_figures.torque_overlays(traces, "N m", extended=False).legends
    assert "final model" not in [t.get_text() for t in base.get_texts()]


def test_the_maps_share_one_scale_and_leave_out_what_is_not_found(named: Gap) -> None:
    cells = named.found.cells
    first, second, *_ = gap_figures.cell_maps(cells.before, cells.after).axes
    before, after = first.collections[0], second.collections[0]
    assert before.get_clim() == after.get_clim()
    found = [c.found for c in cells.after if c.axis == "phase"]
    np.testing.assert_array_equal(~np.ma.getmaskarray(np.ma.asarray(after.get_array())).ravel(), found)
    largest = max(c.discrepancy or 0.0 for c in cells.before if c.axis == "phase")
    assert np.max(np.asarray(before.get_array())) == largest
    assert significant(largest, 2) in {t.get_text() for t in first.texts}


def test_figures_survive_odd_numbers(named: Gap) -> None:
    found = named.found
    sizes = [structs.replace(d, after=-0.001, torque_after=None) for d in found.discrepancies.values()]
    gap_figures.discrepancy_bars(["A", "B", "C"], sizes, 0.0, ("Torque distance", "N m"))
    unknown = structs.replace(sizes[0], before=None, after=None, torque_before=None)
    gap_figures.discrepancy_bars(["A"], [unknown], None, ("Torque distance", "N m"))
    silent = [structs.replace(c, found=False, discrepancy=-0.01) for c in found.cells.before]
    gap_figures.cell_maps(silent, silent)
    gap_figures.state_bars(silent, None)
    traces = named.traces["train"]
    assert len(gap_figures.remainder(traces, silent, "N m").axes) == 1  # no bin is found, time alone is drawn
    gap_figures.remainder(traces, [], "N m")


def test_position_and_load_are_shown_of_the_joint_with_the_most(named: Gap) -> None:
    """The joint is that of the base model, for both models; a curve over load names its joint."""
    cells = named.found.cells
    joint = gap_figures.most_at(cells.before)
    loudest = max((c for c in cells.before if c.axis == "position"), key=lambda c: c.discrepancy or 0.0)
    assert loudest.joint == joint
    shown = [a.get_xlabel() for a in gap_figures.state_bars(cells.before, cells.after).axes if a.get_visible()]
    assert [name for name in shown if " of " in name] == ["Position of joint 1 [rad]", "Load of joint 1 [N m]"]
    assert "Hinge force" in shown
    some = [c for c in cells.before if c.axis == "phase" or (c.axis == "load" and c.joint == joint)]
    curve = gap_figures.remainder(named.traces["train"], some, "N m").axes[-1]
    assert (curve.get_title("left"), curve.get_xlabel()) == ("That joint alone", "Load of joint 1 [N m]")


@pytest.mark.parametrize("width", [style.WIDE, style.NARROW])
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.filterwarnings("error")
def test_one_parameter_has_room_for_its_axes(width: float, count: int):
    """A scene of one parameter: with the height of one row there was no space for the axes."""
    shifts = [Shift(f"p{k}", "kg", 1.0, 2.0, 0.4) for k in range(count)]
    gap_figures.base_shifts(shifts, width=width).savefig(io.BytesIO(), format="png")
