"""The page of a search for a missing effect: its numbers are the files', and every verdict has its words."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_gap import CLOSER, LATCH, STRIBECK, gap_json, make_gap
from made_up_run import make_run
from markupsafe import Markup
from matplotlib.figure import Figure
from reader import read_page

from droid_jax.report import drawings, gap_drawings, gap_marks, gap_words, page, style
from droid_jax.report.drawings import Drawing
from droid_jax.report.gap_folder import VERDICTS, read_gap
from droid_jax.report.gap_parts import PARTS
from droid_jax.report.gap_tables import groups
from droid_jax.report.words import number, percent

NEXT = {
    "none": "go on with the base model",
    "named": "look for the latch at door hinge on the hardware",
    "tie": "Record this too and run again: the same motion at 0.3 of the speed. There the rivals are 14.3",
    "partly explained": "where the most is left: joint 1 in opening, from 2.0 s on and object angle 0.00 to 0.14 rad",
    "unexplained": "where the most is left: joint 1 in opening, from 2.0 s on",
    "fit not converged": "identify --preset standard --restarts 3",
}


def _made_only(folder: Path, stem: str, title: str, caption: str, make: Callable[..., Figure], *args: Any) -> Drawing:
    """A figure that is made, and neither saved nor put into the page, which would take seconds."""
    assert isinstance(make(*args, width=style.WIDE), Figure)
    return Drawing(folder / "figures", stem, title, caption, Markup(""), Markup(""))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (gap_drawings, drawings):
        monkeypatch.setattr(module, "drawing", _made_only)


@pytest.fixture
def named(tmp_path: Path, quick: None) -> Path:
    folder = make_gap(tmp_path / "named")
    page.write_report(folder)
    return folder


def _shown(cell: dict[str, Any], value: float | None, written: Callable[..., str] = number) -> bool:
    """Whether a cell holds this value, and shows it."""
    if value is None:
        return cell["text"].strip() == "–"
    return cell["values"] == [value] and cell["text"].strip() == written(value)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_has_its_words(tmp_path: Path, quick: None, verdict: str) -> None:
    sealed = verdict not in ("none", "tie")
    folder = make_gap(tmp_path / "run", verdict, sealed=sealed)
    text = read_page(page.write_report(folder)).text.replace("\u00a0", " ")
    gap = read_gap(folder)
    assert gap_words.readable(gap.found["sentence"], gap.found) in text and "_" not in text.split("Next:")[0]
    assert NEXT[verdict] in text
    blew_up = any(screen["failed"] for screen in gap.found["screens"])
    assert ("because the simulation blew up with it: drag at hinge." in text) == blew_up
    assert ("joint coulomb at joint 2 changes by about" in text) == (verdict == "named")
    assert ("U after" in text) == bool(gap.found["effects"])
    assert ("Descriptive only" in text) == (verdict in ("unexplained", "partly explained"))
    assert ("No recording was kept as test data" in text) == (not sealed)
    assert f"Torque over time, {gap.recording(gap.judge)} ({'test' if sealed else 'validation'})" in text


def test_the_page_says_what_to_look_for(tmp_path: Path, quick: None) -> None:
    """Beside every effect of the answer its mark and what looks like it; of what is equivalent also what it is."""
    folder = make_gap(tmp_path / "run", "tie")
    told = [
        "Latch at door hinge Its mark: the first degrees of opening, and the last of closing. Can look like: hinge "
        "stribeck, over centre spring.",
        "Hinge stribeck at door hinge is equivalent Dry friction of the hinge that falls with speed. Its mark: "
        "breakaway and reversals of the door. Can look like: latch, joint stribeck.",
    ]
    text = " ".join(read_page(page.write_report(folder)).text.split())
    assert [line for line in told if line not in text] == []
    found = json.loads((folder / "gap.json").read_text())
    del found["about"]  # as searches before did not tell it
    (folder / "gap.json").write_text(json.dumps(found))
    text = read_page(page.write_report(folder)).text
    assert "Its mark" not in text and "latch at door hinge" in text


def test_a_mark_at_several_places_is_told_once_and_none_where_nothing_is_known(tmp_path: Path) -> None:
    coulomb, own = ["joint_coulomb at panda_joint2", "joint_coulomb at panda_joint3"], "squeak at door_hinge"
    step = {"what": "dry friction", "mark": "a step at every reversal.", "confused_with": []}
    about = {"joint_coulomb": step, "squeak": {"what": "", "mark": "", "confused_with": []}}
    gap = read_gap(
        make_gap(tmp_path, effects=[*coulomb, own], indistinguishable=[["drag at door_hinge"], [], []], about=about)
    )
    told = "Joint coulomb at joint 2 and joint coulomb at joint 3"
    assert gap_marks.marks(gap) == [(told, False, "Its mark: a step at every reversal.")]


@pytest.mark.slow
@pytest.mark.parametrize("verdict", ["partly explained", "none"])
def test_the_page_loads_nothing_and_every_link_is_there(tmp_path: Path, verdict: str) -> None:
    folder = make_gap(tmp_path / "run", verdict)
    written = read_page(page.write_report(folder))
    assert all(source.startswith("data:") for source in written.loads)
    assert not [link for link in written.links if not (folder / link).is_file()]
    stems = {"gap", "cells", "state", "torque_train", "torque_validation", "torque_test"}
    stems |= {"shifts", "remainder"} if verdict == "partly explained" else set()
    names = {f"missing_{s}.{kind}" for s in stems for kind in ("png", "pdf")}
    assert {p.name for p in (folder / "figures").iterdir()} == names


def test_the_tables_hold_the_numbers_of_the_file(named: Path) -> None:
    cells, found = read_page(named / "report.html").cells, read_gap(named).found
    for role, gap in found["gaps"].items():
        for field in ("before", "after", "torque_before", "torque_after"):
            assert _shown(cells[f"gap:{role}", field], gap[field])
        assert _shown(cells[f"gap:{role}", "closed"], gap["closed"], percent)
    assert _shown(cells["gap:floor", "before"], found["floor"])
    for a in (*found["amplitudes"], *found["shapes"]):
        assert _shown(cells[f"size:{a['name']}", "value"], a["value"])
        assert cells[f"size:{a['name']}", "interval"]["values"] == [a["low"], a["high"]]
        assert a["what"] in cells[f"size:{a['name']}", "effect"]["text"]
    for s in found["shifts"]:
        for field, key in (("before", "before"), ("after", "after"), ("deviation", "deviation_before")):
            assert _shown(cells[f"shift:{s['name']}", field], s[key])
    for t in found["trials"]:
        row = f"candidate:{t['round']}:{gap_words.model_words(t['name'])}"
        assert _shown(cells[row, "discrepancy_train"], t["discrepancy_train"]) and _shown(
            cells[row, "discrepancy_validation"], t["discrepancy_validation"]
        )
        assert _shown(cells[row, "share"], t["chosen"], percent)
        assert _shown(cells[row, "p"], t["p"], lambda v: number(v, 2))
        assert all(gap_words.readable(r, found) in cells[row, "fate"]["text"] for r in t["reasons"])
    for entry in found["screens"][0]["ranking"]:
        row = f"candidate:0:{gap_words.effect_words(entry['candidate'])}"
        assert _shown(cells[row, "t"], entry["t"]) and _shown(cells[row, "explained"], entry["explained"], percent)


def test_the_summary_says_how_large_and_how_sure(named: Path) -> None:
    found, text = read_gap(named).found, read_page(named / "report.html").text.replace("\u00a0", " ")
    sealed = found["gaps"]["test"]
    assert f"was {number(sealed['before'])} before and is {number(sealed['after'])} after" in text
    assert f"numerical floor is {number(found['floor'])}" in text and f"p = {number(found['p'], 2)}" in text
    assert "11 candidate effects were screened" in text and "4 extended models" in text
    for stage, seconds in found["seconds"].items():
        assert f"{stage.replace('_', ' ')} {number(seconds)} s" in text
    assert "Settings preset quick; fit a.npz; validation b.npz; recording a.npz" in re.sub(r"\s+", " ", text)


def test_a_floor_that_is_much_of_the_gap_is_said(tmp_path: Path, quick: None) -> None:
    """A tenth is worth a word, a hundredth is not."""
    for share, said in ((0.3, True), (0.01, False)):
        folder = make_gap(tmp_path / str(said), floor=0.0)
        content = json.loads((folder / "gap.json").read_text())
        content["floor"] = share * content["gaps"]["train"]["before"]
        (folder / "gap.json").write_text(json.dumps(content))
        text = read_page(page.write_report(folder)).text.replace("\u00a0", " ")
        assert ("a finer timestep would tell more" in text) is said
        assert ("30 % of U of the base model on “A”: a finer" in text) is said


def test_what_was_cut_and_an_unknown_floor_are_said(tmp_path: Path, quick: None) -> None:
    folder = make_gap(tmp_path / "run", cut="pairs were not tried", floor=None)
    text = read_page(page.write_report(folder)).text
    assert "Left out for lack of time: pairs were not tried" in text
    assert "the numerical floor is not known" in text


def test_a_tie_that_nothing_on_the_menu_separates(tmp_path: Path) -> None:
    near = read_gap(make_gap(tmp_path / "near", "tie", experiments=[{"what": "another pose", "distance": 2.5}]))
    assert "another pose. There the rivals are only 2.50 standard deviations apart" in gap_words.gap_summary(near)[-1]
    none = read_gap(make_gap(tmp_path / "none", "tie", experiments=[]))
    assert "No experiment on the menu" in gap_words.gap_summary(none)[-1]


def test_significant_but_below_the_floor_is_said(tmp_path: Path) -> None:
    gap = read_gap(make_gap(tmp_path / "run", "none", p=0.002))
    assert "no larger than what the simulation's own time step may leave" in " ".join(gap_words.gap_summary(gap))


def test_what_the_fit_does_not_tell_is_said_where_it_is_much(tmp_path: Path) -> None:
    after = gap_json("named", ("train", "validation", "test"))["gaps"]["validation"]["after"]

    def said(name: str, **changes: Any) -> str:
        return " ".join(gap_words.gap_summary(read_gap(make_gap(tmp_path / name, "named", **changes))))

    assert "75 % lies within the uncertainty" in said("much", remainder=0.25 * after).replace("\u00a0", " ")
    for name, remainder in (("little", 0.9 * after), ("unknown", None)):
        assert "lies within the uncertainty" not in said(name, remainder=remainder)
    gaps = gap_json("named", ("train", "validation", "test"))["gaps"]
    for name, u in (("nothing", 0.0), ("below", -0.006)):  # nothing is left, so that no share of it is anything
        found = gaps | {"validation": gaps["validation"] | {"after": u}}
        assert "lies within the uncertainty" not in said(name, gaps=found, remainder=-0.01)


def test_what_leaves_most_of_the_gap_open_is_kept_by_nobody(tmp_path: Path) -> None:
    for explained, keeps in ((0.49, False), (0.51, True), (None, True)):
        folder = make_gap(tmp_path / f"run{explained}", "partly explained", explained=explained)
        said = gap_words.gap_summary(read_gap(folder))[-1]
        assert ("keep the latch at door hinge" in said) is keeps
        assert ("may only imitate what is there" in said) is not keeps
        assert NEXT["partly explained"] in said


BLOCKS = {"by": "blocks", "limits": "The validation blocks are of the same motion."}
HALVES = {"by": "repeats", "limits": "The validation repeats repeat the fitted motion."}


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_log_in_blocks_claims_nothing_that_takes_repeats(tmp_path: Path, quick: None, verdict: str) -> None:
    found = gap_json(verdict, ("train", "validation", "test"))
    cells = {when: [{**c, "found": False} for c in found["cells"][when]] for when in ("before", "after")}
    changes = {"split": BLOCKS, "floor": 0.0, "cells": cells, "experiments": [], "trends": []}
    folder = make_gap(tmp_path / "run", verdict, **changes)
    text = read_page(page.write_report(folder)).text.replace("\u00a0", " ")
    assert BLOCKS["limits"] in text and "noise included" in text and "there is no numerical floor" in text
    untrue = ("repeats' mean", "one repeat", "ten repeats", "more repeats", "Numerical floor", "Hatched", "other demon")
    assert [words for words in (*untrue, "whole repeats", "no single place") if words in text] == []
    expected = {
        "tie": "record one that is slower, faster or comes back",
        "unexplained": "where the most is left, noise included: joint 1 in opening",
        "none": "a smaller effect would need repeats, a longer log",
        "fit not converged": "Next: give the parameters tighter priors",  # its fit needs no search
    }
    assert expected.get(verdict, "Next:") in text
    assert ("not confirmed by the other blocks (p = 0.12)" in text) == (verdict not in ("none", "fit not converged"))


def test_a_log_is_drawn_in_order_of_time(tmp_path: Path) -> None:
    """Its turns are one trace, and a place that holds no instant is none."""
    folder = make_gap(tmp_path / "run", "unexplained", split=BLOCKS)
    arrays = dict(np.load(folder / "gap.npz"))
    whole = {key: arrays[f"train.{key}"] for key in ("time", "measured", "before")}
    for role, turn in (("train", 0), ("validation", 1)):
        arrays |= {key: arrays[key][turn::2] for key in arrays if key.startswith(f"{role}.")}
        arrays |= {f"{role}.{key}": values[turn::2] for key, values in whole.items()}
    np.savez(folder / "gap.npz", **arrays)
    sealed, (roles, drawn) = read_gap(folder).sheets
    assert (sealed[0], roles) == (("test",), ("train", "validation"))
    for key, values in whole.items():
        np.testing.assert_array_equal(drawn[key], values)
    gap = read_gap(folder)
    empty = {"variable": gap_words.TIME, "where": "elbow, later 9.0 s", "discrepancy": 0.0, "p": 1.0, "found": False}
    assert gap_drawings._shown(gap, [empty, {**empty, "discrepancy": 2.0}]) == [
        {**empty, "discrepancy": 2.0, "found": True}
    ]


def test_halves_of_the_repeats_say_what_they_cannot_tell(tmp_path: Path, quick: None) -> None:
    folder = make_gap(tmp_path / "run", "partly explained", sealed=False, split=HALVES)
    text = read_page(page.write_report(folder)).text.replace("\u00a0", " ")
    assert HALVES["limits"] in text and "No recording was kept as test data" in text and "Hatched" in text
    assert "not confirmed by the other repeats (p = 0.12)" in text and "other demonstration" not in text
    assert [r for r, _ in read_gap(folder).sheets] == [("validation",), ("train",)]


def test_an_inverse_replay_has_no_floor(tmp_path: Path, quick: None) -> None:
    folder = make_gap(tmp_path / "run", "none", floor=0.0, p=0.002)
    text = read_page(page.write_report(folder)).text.replace("\u00a0", " ")
    assert "but it is small: U is not above zero" in text and "Numerical floor" not in text


def test_a_sealed_recording_that_blew_up_was_kept_all_the_same(tmp_path: Path, quick: None) -> None:
    folder = make_gap(
        tmp_path / "run", "named", sealed=False, failed=["drag", "the fitted model on the test recording"]
    )
    text = read_page(page.write_report(folder)).text
    assert "since the test one could not be replayed" in text and "The test recording could not be replayed" in text
    assert "blew up with it: " in text and "the fitted model on the test recording" not in text
    assert "kept as test data" not in text


def test_what_is_left_at_some_position_alone_is_a_place_too(tmp_path: Path) -> None:
    """Of all cells the test finds that of a joint's position."""
    found = read_gap(make_gap(tmp_path / "made", "unexplained")).found["cells"]
    (cell,) = [c for c in found["after"] if c["variable"] == "position of panda_joint2"][:1] or [
        {**found["after"][-1], "variable": "position of panda_joint2", "where": "0.10 to 0.20 rad"}
    ]
    cells = [{**c, "found": False} for c in found["after"]] + [{**cell, "discrepancy": 3.0, "found": True}]
    folder = make_gap(tmp_path / "run", "unexplained", cells={**found, "after": cells})
    text = gap_words.gap_summary(read_gap(folder))[-1]
    assert f"where the most is left: position of joint 2 {gap_words.span_words(cell['where'])}." in text


def test_an_object_on_a_slide_has_a_position_and_no_angle() -> None:
    slide, hinge = ({"variable": "object angle", "where": f"0.00 to 0.14 {unit}"} for unit in ("m", "rad"))
    assert gap_words.place_words(slide) == "object position 0.00 to 0.14 m"
    assert gap_words.place_words(hinge) == "object angle 0.00 to 0.14 rad"


def test_a_synthetic_robot_is_said(tmp_path: Path, quick: None) -> None:
    folder = make_gap(tmp_path / "run", "none", setup={"recording": []})
    assert "synthetic robot" in read_page(page.write_report(folder)).text


def test_candidates_say_what_became_of_them(tmp_path: Path) -> None:
    found = read_gap(make_gap(tmp_path / "run", "partly explained")).found
    one, two = groups(found)
    assert [r.name for r in one.tried][:2] == ["latch at door hinge", "hinge stribeck at door hinge"]
    assert one.tried[0].kept and one.tried[0].fate == "in the model"
    assert not any(r.kept for r in (*one.tried[1:], *two.tried))
    assert (one.discrepancy_train, one.discrepancy_validation) == tuple(
        found["gaps"][r]["before"] for r in ("train", "validation")
    )
    assert two.beside == "latch at door hinge"
    assert [r.name for r in two.tried] == ["latch at door hinge + door closer at door hinge"]
    assert (two.tried[0].t, two.discrepancy_train, two.p) == (
        2.4 * 0.8**2,
        found["trials"][0]["discrepancy_train"],
        0.412,
    )
    assert (len(one.others), len(two.others)) == (7, 9)
    ties = groups(read_gap(make_gap(tmp_path / "tie", "tie")).found)[0].tried
    assert [r.fate for r in ties[:2]] == ["in the model, and others do as well", "is equivalent: a tie"]


@pytest.mark.parametrize(
    ("verdict", "name", "gap", "fate"),
    [
        ("unexplained", LATCH, 9.0, "passed, but another leaves less"),
        ("unexplained", LATCH, 0.01, "passed, but a plainer one leaves about as much"),
        ("unexplained", f"{LATCH} + {CLOSER}", 0.01, "passed, but takes too little more away than fewer effects do"),
        ("fit not converged", LATCH, 0.01, "passed, but a fit did not converge"),
    ],
)
def test_what_passed_and_was_not_named_says_why(tmp_path: Path, verdict: str, name: str, gap: float, fate: str) -> None:
    found = gap_json("unexplained", ("train", "validation")) | {"verdict": verdict}
    passed = {**found["trials"][0], "name": name, "discrepancy_validation": gap, "passed": True, "reasons": []}
    found["trials"] = [*found["trials"][1:], {**passed, "round": name.count(" + ")}]
    read = read_gap(make_gap(tmp_path / "run", **found))
    assert [r.fate for g in groups(read.found) for r in g.tried if r.trial and r.trial["passed"]] == [fate]
    said = gap_words.gap_summary(read)[-1]
    assert ("No effect of the library passed clearly enough" in said) == (verdict == "unexplained")


def test_pairs_tried_from_scratch_stand_beside_those_that_grew(tmp_path: Path) -> None:
    found = gap_json("partly explained", ("train", "validation"))
    grown = next(t for t in found["trials"] if t["round"] == 1)
    other = {**grown, "name": f"{STRIBECK} + {CLOSER}", "passed": True, "reasons": []}
    found["trials"] += [{**grown, "passed": True, "reasons": [], "discrepancy_validation": 0.5}, other]
    found["screens"].append(found["screens"][0])
    found |= {"effects": [LATCH, CLOSER], "indistinguishable": [[STRIBECK], []]}
    one, two = groups(read_gap(make_gap(tmp_path / "run", **found)).found)
    assert [(r.fate, r.trial["discrepancy_validation"]) for r in two.tried if r.trial] == [
        ("in the model, and others do as well", 0.5),
        ("is equivalent: a tie", 2.4),
    ]
    assert two.tried[1].name == "hinge stribeck at door hinge + door closer at door hinge" and two.tried[1].t is None
    assert one.tried[0].kept and two.tried[0].kept and not two.tried[1].kept
    whole = {**found, "indistinguishable": [[f"{STRIBECK} + {CLOSER}"], []]}
    text = gap_words.readable(f"one of: {LATCH} or {STRIBECK} + {CLOSER}", whole)
    assert text == "one of: latch at door hinge or hinge stribeck at door hinge + door closer at door hinge"


@pytest.mark.slow
def test_one_page_for_a_folder_with_both(tmp_path: Path) -> None:
    folder = make_gap(make_run(tmp_path / "run"), "named")
    html = page.write_report(folder).read_text(encoding="utf-8")
    written = read_page(folder / "report.html")
    assert ("hinge_stiffness", "mean") in written.cells and ("gap:test", "after") in written.cells
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', html))
    assert {"identification", "missing"} <= used <= set(ids)
    assert {link for link in written.links if link.startswith("gap.")} == {"gap.json", "gap.npz"}


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: f.pop("floor"), r"gap.json lacks 'floor'"),
        (lambda f: f["trials"][2].pop("p"), r"gap.json: 'trials', entry 2 lacks 'p'"),
        (lambda f: f["gaps"].pop("validation"), r"'gaps' lacks 'validation'"),
        (
            lambda f: f["gaps"]["train"].update(before="4"),
            r"'gaps', 'train', 'before' must be a number or null, got '4'",
        ),
        (lambda f: f["cells"].update(after={}), r"'cells', 'after' must be a list, got {}"),
        (lambda f: f.update(verdict="maybe"), r"'verdict' must be one of none, named.*got 'maybe'"),
        (lambda f: f.update(remainder="much"), r"'remainder' must be a number or null, got 'much'"),
        (lambda f: f.update(split={"by": "halves", "limits": ""}), r"'by' must be one of recordings.*got 'halves'"),
        (lambda f: f["about"]["latch"].pop("mark"), r"'about', 'latch' lacks 'mark'"),
        (lambda f: f.update(split={"by": "blocks"}), r"'split' lacks 'limits'"),
        (lambda f: f.update(indistinguishable=[[], []]), r"'indistinguishable' has 2 lists for 1 effects"),
    ],
)
def test_a_damaged_file_is_named(tmp_path: Path, break_it: Callable[[dict[str, Any]], Any], message: str) -> None:
    folder = make_gap(tmp_path / "run")
    found = json.loads((folder / "gap.json").read_text())
    break_it(found)
    (folder / "gap.json").write_text(json.dumps(found))
    with pytest.raises(ValueError, match=rf"gap\.json.*{message}.*droid_jax\.run gap|{message}.*droid_jax\.run gap"):
        page.write_report(folder)
    assert not (folder / "report.html").exists()


@pytest.mark.parametrize("name", ["gap.json", "gap.npz"])
@pytest.mark.parametrize("content", [None, b"", b"{broken", b"[]"])
def test_a_missing_or_broken_file_is_named(tmp_path: Path, name: str, content: bytes | None) -> None:
    """Only a search without its gap.json goes on by itself: one that has it passes for whole."""
    folder = make_gap(tmp_path / "run")
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    how = (
        "gap` again, or"
        if (name, content) == ("gap.json", None)
        else "gap` again with the same options and --again, or"
    )
    with pytest.raises(ValueError, match=rf"{re.escape(name)}.*droid_jax\.run {how}"):
        page.write_report(folder)


def test_a_wrong_shape_is_named(tmp_path: Path) -> None:
    folder = make_gap(tmp_path / "run")
    arrays = dict(np.load(folder / "gap.npz"))
    arrays["validation.after"] = arrays["validation.after"][:-1]
    np.savez(folder / "gap.npz", **arrays)
    with pytest.raises(ValueError, match=r"validation\.after must be .*\(204, 7\).*\(203, 7\)"):
        read_gap(folder)


def test_words_agree_with_the_search() -> None:
    from droid_jax.discrepancy import select
    from droid_jax.discrepancy.verdict import Conclusion
    from droid_jax.recordings.split import Split

    assert {k.value for k in Conclusion} == set(VERDICTS)
    assert {s.value for s in Split} == set(PARTS)
    assert gap_words.OTHER in Path(select.__file__).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("where", "parts"),
    [
        ("panda_joint2, opening 2.0 s", ("panda_joint2", "opening", "2.0")),
        ("elbow, slow, then fast 12.5 s", ("elbow", "slow, then fast", "12.5")),
        ("nonsense", ("nonsense", "", "")),
    ],
)
def test_places_are_read(where: str, parts: tuple[str, str, str]) -> None:
    assert gap_words.joint_phase(where) == parts
    bins = {"variable": "object angle", "where": "-0.00 to 0.15 rad"}
    assert gap_words.place_words(bins) == "object angle 0.00 to 0.15 rad"
    assert gap_words.place_words({"variable": gap_words.TIME, "where": "elbow, all 0.0 s"}) == "elbow"


def test_names_and_units_are_written_as_they_are_read(tmp_path: Path) -> None:
    found = read_gap(make_gap(tmp_path / "run")).found
    said = "wins only 3% of the resamples; joint_coulomb at panda_joint2 does better"
    assert gap_words.readable(said, found).endswith("; joint coulomb at joint 2 does better")
    assert gap_words.readable("torque_gain[panda_joint2] ran into", found) == "torque gain, joint 2 ran into"
    assert gap_words.unit_words("N m s^2/rad^2") == "N m s²/rad²"
    assert gap_words.quantity(0.5, "-") == "0.500"


def test_a_value_at_its_bound_is_said_to_lie_there() -> None:
    """And its interval holds it, also of an older search, whose intervals had equal tails inside the bounds."""
    size = {"name": "latch_exponent", "unit": "-", "value": 0.5, "low": 0.5, "high": 0.606, "bound": "lower"}
    assert gap_words.size_words(size) == "latch exponent 0.500 (at its lower bound), 0.500 to 0.606"
    assert gap_words.size_words({**size, "bound": ""}) == "latch exponent 0.500, 0.500 to 0.606"
    old = {k: v for k, v in size.items() if k != "bound"}
    assert gap_words.size_words({**old, "low": 0.503}) == "latch exponent 0.500 (at its lower bound), 0.500 to 0.606"
    assert gap_words.size_words(old) == "latch exponent 0.500, 0.500 to 0.606"
    assert gap_words.size_words({**old, "low": None, "high": None}) == "latch exponent 0.500, – to –"


def test_a_form_that_does_not_fit_is_said_with_the_answer(tmp_path: Path, quick: None) -> None:
    """A width at its bound: in the sentence, in the table with an interval that holds the value, and in what to do."""
    doubt = "the form of latch at door_hinge does not fit: latch_width at its lower bound, 0.01 rad"
    sentence = f"The model lacks: {LATCH}. But {doubt}."
    shapes = [
        {**gap_json("named", ("train",))["shapes"][0], "value": 0.01, "low": 0.01, "high": 0.0143, "bound": "lower"}
    ]
    text = page.write_report(make_gap(tmp_path, sentence=sentence, doubts=[doubt], shapes=shapes)).read_text()
    assert "the form of latch at door hinge does not fit: latch width at its lower bound, 0.01 rad" in text
    assert "at its lower bound</span>" in text and "take its numbers with care" in text


def test_what_failed_by_itself_and_is_in_the_model_beside_others_is_no_contradiction(tmp_path: Path) -> None:
    """Its interval in the final model leaves zero out, and in the model without the others it did not."""
    found = gap_json("named", ("train", "validation")) | {"effects": [LATCH, CLOSER], "indistinguishable": [[], []]}
    alone = {
        **found["trials"][0],
        "passed": False,
        "reasons": ["its amplitude may be zero (90 % interval 0 to 0.9 N m)"],
    }
    found["trials"] = [alone]
    (row,) = (r for g in groups(read_gap(make_gap(tmp_path, **found)).found) for r in g.tried)
    assert row.fate == "without the model's other effects: its amplitude may be zero (90 % interval 0 to 0.9 N m)"


def test_settings_are_those_that_a_person_reads(tmp_path: Path) -> None:
    """Fingerprints and the start of a base fit tell whether a run may go on; on the page they would be a wall."""
    asked = {"preset": "quick", "recording": ["a.npz", "b.npz"], "scene": None, "budget": 0.5}
    setup = {**asked, "command": "gap", "recordings_sha256": ["12ab"], "start": [0.1, 0.2], "synthetic_robot": False}
    folder = make_gap(tmp_path / "run", "named", setup=setup)
    assert gap_words.settings(read_gap(folder)) == ["preset quick", "recording a.npz, b.npz", "budget 0.5"]


def test_a_hint_is_no_name(tmp_path: Path, quick: None) -> None:
    """What closes a third and leaves the rest is told as a hint, on the page and of its trial."""
    said = f"The model lacks something that is not in the library. Hints, not names: {LATCH} (closes 31%)."
    hints = [{"effects": [LATCH], "indistinguishable": [[]], "closed": {"validation": 0.31}}]
    trials = gap_json("partly explained", ("train", "validation"))["trials"]
    folder = make_gap(
        tmp_path, "unexplained", sentence=said, hints=hints, thresholds={"least_closed": 0.4}, trials=trials
    )
    text = page.write_report(folder).read_text()
    assert "latch at door hinge (closes 31%)" in text
    assert "Latch at door hinge passed, but closes less than 40\u00a0% on a held-out recording" in text
    assert "passed, but closes too little for a name: a hint" in text
    assert gap_words.untrusted(read_gap(folder))


def test_an_amendment_that_is_not_there_is_said(tmp_path: Path, quick: None) -> None:
    experiments = [
        {"what": "the same motion twice as fast", "distance": 7.1, "not_made": ""},
        {
            "what": "the same motion three times slower",
            "distance": None,
            "not_made": "a stretch that no repeat measured",
        },
    ]
    states = {"experiments": "made", "final_refit": "not made: the fit to both motions did not converge"}
    folder = make_gap(tmp_path, "tie", experiments=experiments, amendments=states)
    text = page.write_report(folder).read_text()
    assert "not made: a stretch that no repeat measured" in text and "the same motion twice as fast" in text
    assert (
        "The final refit to both motions was not made: the fit to both motions did not converge; extended.json" in text
    )
    states = {"experiments": "to be made", "final_refit": "made"}
    text = page.write_report(make_gap(tmp_path, "tie", experiments=[], amendments=states)).read_text()
    assert "were not made yet, since the run was stopped: the same command makes" in text and "final refit" not in text
