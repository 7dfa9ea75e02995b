"""Files of an identification or a search that are missing or damaged are named, with what to do."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from made_up_gap import cell, make_gap
from made_up_run import make_run

from droid_jax.report import page
from droid_jax.report.gap_folder import LOST, CellEntry, Shift, SplitEntry, largest_shifts, read_answer, read_gap
from droid_jax.report.gap_page import _shown
from droid_jax.report.identify_folder import read_run

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
    """Only a search without gap.json is continued by the same command; with it, the run counts as complete."""
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

    assert {s.value for s in split.Split} == set(get_args(get_type_hints(SplitEntry)["by"]))
    assert verdict.LOST == LOST


def test_a_log_is_drawn_in_order_of_time(tmp_path: Path) -> None:
    """Its alternating blocks are one trace, and cells without instants are not drawn."""
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


@pytest.mark.parametrize("name", ["config.json", "fit.json", "history.npz", "traces.npz", "correlation.npz"])
@pytest.mark.parametrize("content", [None, b"", b"{broken"])
def test_a_required_file_that_is_missing_or_broken_is_named(tmp_path: Path, name: str, content: bytes | None) -> None:
    run = make_run(tmp_path / "run")
    (run / name).unlink()
    if content is not None:
        (run / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{re.escape(name)}.*droid_jax\.run identify"):
        page.write_report(run)
    assert not (run / "report.html").exists()


def test_a_missing_key_and_a_wrong_shape_are_named(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    del fit["parameters"][2]["truth"]
    (run / "fit.json").write_text(json.dumps(fit))
    with pytest.raises(ValueError, match=r"fit\.json: 'parameters', entry 2 lacks 'truth'; run .*identify"):
        read_run(run)
    run = make_run(tmp_path / "other")
    arrays = dict(np.load(run / "traces.npz"))
    arrays["open_close/after"] = arrays["open_close/after"][:-1]
    np.savez(run / "traces.npz", **arrays)
    with pytest.raises(ValueError, match=r"open_close/after must be .*\(3840, 7\).*\(3839, 7\); run .*identify"):
        read_run(run)


def test_a_name_too_long_to_draw_is_refused(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    arrays = dict(np.load(run / "traces.npz"))
    arrays["open_close/joints"] = np.array(["y" * 100_000, *arrays["open_close/joints"][1:]])
    np.savez(run / "traces.npz", **arrays)
    with pytest.raises(ValueError, match=r"holds a name of 100000 characters, at most 200 are read; run .*identify"):
        read_run(run)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda fit: fit.update(parameters=-0.0), r"fit\.json: 'parameters' must be a list, got -0\.0"),
        (lambda fit: fit.update(parameters=[]), r"fit\.json, 'parameters' is empty"),
        (lambda fit: fit.update(heldout_distances={}), r"fit\.json, 'heldout_distances' is empty"),
        (
            lambda fit: fit["heldout_distances"].update(other=fit["heldout_distances"].pop("open_close")),
            "of which fit.json has no 'heldout_distances'",
        ),
        (lambda fit: fit["heldout_distances"]["open_close"].update(judged="x"), "'judged' must be one of"),
        (lambda fit: fit["cost"].pop("best"), "'cost' lacks 'best'"),
        (
            lambda fit: fit["heldout_distances"].update(open_close=0.1),
            r"'heldout_distances', 'open_close' must be an object, got 0\.1",
        ),
        (lambda fit: fit["parameters"][2].update(initial_mean=10**400), r"a whole number beyond 2\^63"),
        (lambda fit: fit["parameters"][2].update(low=float("inf")), "Infinity is no number of JSON"),
        (lambda fit: fit["parameters"][2].update(name="a\0"), r"U\+0000"),
        (lambda fit: fit["parameters"].append(fit["parameters"][0]), "holds hinge_stiffness more than once"),
        (lambda fit: fit["parameters"][0].update(interval=[1.0]), "'interval' must be a list of length 2"),
        (lambda fit: fit.update(notes="cold"), "'notes' must be a list, got 'cold'"),
    ],
)
def test_a_damaged_fit_is_one_sentence(tmp_path: Path, change, said: str) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    change(fit)
    (run / "fit.json").write_text(json.dumps(fit))
    with pytest.raises(ValueError, match=said) as caught:
        page.write_report(run)
    assert "fit.json" in str(caught.value) and "run identify` again" in str(caught.value)
