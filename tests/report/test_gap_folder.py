"""Files of a search that are missing or damaged are named, with what to do; those that are whole are read."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from made_up_gap import cell, make_gap

from droid_jax.report import page
from droid_jax.report.gap_folder import LOST, CellEntry, Shift, SplitEntry, largest_shifts, read_answer, read_gap
from droid_jax.report.gap_page import _shown

BLOCKS = {"by": "blocks", "limits": ""}


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: f.pop("discretisation_error"), r"gap.json lacks 'discretisation_error'"),
        (lambda f: f["validation_tests"][2].pop("p"), r"gap.json: 'validation_tests', entry 2 lacks 'p'"),
        (lambda f: f["discrepancies"].pop("validation"), r"'discrepancies' lacks 'validation'"),
        (
            lambda f: f["discrepancies"]["train"].update(before="4"),
            r"'discrepancies', 'train', 'before' must be a number or null, got '4'",
        ),
        (lambda f: f["cells"].update(after={}), r"'cells', 'after' must be a list, got {}"),
        (lambda f: f["cells"]["after"][0].update(axis="x"), r"'axis' must be one of .*, got 'x'"),
        (lambda f: f.update(verdict="maybe"), r"'verdict' must be one of .*got 'maybe'"),
        (lambda f: f.update(remainder="much"), r"'remainder' must be a number or null, got 'much'"),
        (lambda f: f.update(split={"by": "halves", "limits": ""}), r"'by' must be one of .*got 'halves'"),
        (lambda f: f["about"]["latch"].pop("signature"), r"'about', 'latch' lacks 'signature'"),
        (lambda f: f.update(indistinguishable=[[], []]), r"'indistinguishable' has 2 lists for 1 effects"),
        (lambda f: f["config"]["selection"].pop("significance"), r"'selection' has no number 'significance'"),
        (lambda f: f.pop("version"), r"gap.json has version 1, this program reads version 2"),
    ],
)
def test_a_damaged_file_is_named(tmp_path: Path, break_it: Callable[[dict[str, Any]], Any], message: str) -> None:
    folder = make_gap(tmp_path / "run")
    found = json.loads((folder / "gap.json").read_text())
    break_it(found)
    (folder / "gap.json").write_text(json.dumps(found))
    with pytest.raises(ValueError, match=rf"{message}.*droid_jax\.run gap") as caught:
        page.write_report(folder)
    assert "gap.json" in str(caught.value) and not (folder / "report.html").exists()


@pytest.mark.parametrize("name", ["gap.json", "gap.npz"])
@pytest.mark.parametrize("content", [None, b"", b"{broken", b"[]"])
def test_a_missing_or_broken_file_is_named(tmp_path: Path, name: str, content: bytes | None) -> None:
    """Only a search without its gap.json goes on by itself: one that has it passes for whole."""
    folder = make_gap(tmp_path / "run")
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    begun = (name, content) == ("gap.json", None)
    how = "gap` again, or" if begun else "gap` again with the same options and --again, or"
    with pytest.raises(ValueError, match=rf"{re.escape(name)}.*droid_jax\.run {how}"):
        page.write_report(folder)


def test_a_wrong_shape_is_named(tmp_path: Path) -> None:
    folder = make_gap(tmp_path / "run")
    arrays = dict(np.load(folder / "gap.npz"))
    arrays["validation.after"] = arrays["validation.after"][:-1]
    np.savez(folder / "gap.npz", **arrays)
    with pytest.raises(ValueError, match=r"validation\.after must be .*\(204, 7\).*\(203, 7\)"):
        read_gap(folder)


def test_keys_that_are_not_known_are_ignored(tmp_path: Path) -> None:
    gap = read_gap(make_gap(tmp_path, later=1))
    assert gap.found.verdict == "named" and read_answer(tmp_path).sentence == gap.found.sentence


def test_what_is_said_agrees_with_the_search() -> None:
    from droid_jax.discrepancy import verdict
    from droid_jax.recordings import split

    assert {s.value for s in split.Split} == set(get_args(SplitEntry.__annotations__["by"])) or {
        s.value for s in split.Split
    } == {"recordings", "repeats", "blocks"}
    assert verdict.LOST == LOST


def test_a_log_is_drawn_in_order_of_time(tmp_path: Path) -> None:
    """Its turns are one trace, and a cell that holds no instant is none."""
    folder = make_gap(tmp_path / "run", "unexplained", split=BLOCKS)
    arrays = dict(np.load(folder / "gap.npz"))
    whole = {key: arrays[f"train.{key}"] for key in ("time", "measured", "before")}
    for role, turn in (("train", 0), ("validation", 1)):
        arrays |= {key: arrays[key][turn::2] for key in arrays if key.startswith(f"{role}.")}
        arrays |= {f"{role}.{key}": values[turn::2] for key, values in whole.items()}
    np.savez(folder / "gap.npz", **arrays)
    gap = read_gap(folder)
    test, (roles, drawn) = gap.sheets
    assert (test[0], roles) == (("test",), ("train", "validation"))
    for key, values in whole.items():
        np.testing.assert_array_equal(drawn[key], values)
    empty = CellEntry(**cell("phase", 0.0, "elbow", label="later", low=9.0))
    (shown,) = _shown(gap, [empty, CellEntry(**cell("phase", 0.01, "elbow"))])
    assert shown.found and shown.discrepancy == 0.01


def test_halves_of_the_repeats_are_drawn_apart(tmp_path: Path) -> None:
    gap = read_gap(make_gap(tmp_path, "named", test=False, split={"by": "repeats", "limits": ""}))
    assert [roles for roles, _ in gap.sheets] == [("validation",), ("train",)]


def test_an_object_on_a_slide_has_a_position_and_no_angle() -> None:
    slide, hinge = (CellEntry(**cell("object_angle", 1.0, low=0.0, high=0.14, unit=unit)) for unit in ("m", "rad"))
    assert (slide.name, hinge.name) == ("Object position", "Object angle")


def test_shifts_are_counted_in_deviations() -> None:
    shift = Shift("knob_mass", "kg", 2.6, 0.2, 0.4)
    unknown = [Shift("knob_mass", "kg", 2.6, 0.2, deviation) for deviation in (None, 0.0)]
    assert shift.deviations == pytest.approx(-6.0) and largest_shifts([*unknown, shift]) == [shift]
