"""The page of an identification: its numbers are those of the run's files, and it states doubts."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import pytest
from made_up_gap import make_gap
from made_up_run import ROWS, make_run, parameters
from reader import Page, read_page, spaced

from droid_jax.preflight.findings import Finding
from droid_jax.report import page
from droid_jax.report.identify_folder import FittedParameter, Run, read_run
from droid_jax.report.identify_page import fit_doubts, needed, next_steps
from droid_jax.report.text import lines

WRONG = Finding("sign", "elbow", -0.99, 1.0, "certain", "recording 'x': the torque of <elbow> runs against its command")
CHECK = {
    "unit": "N m", "time_step": 0.1, "remaining": 0.05, "discretisation": 0.041, "parity_largest": 0.9,
    "parity_rms": 0.06, "parity_angle": 0.012, "unmeasured": "", "too_coarse": True, "engines_differ": False,
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, one_line: None) -> Path:
    folder = make_run(tmp_path_factory.mktemp("report") / "run")
    page.write_report(folder)
    return folder


@pytest.fixture(scope="module")
def written(run: Path) -> Page:
    return read_page(run / "report.html")


@pytest.fixture
def changed(tmp_path: Path, quick: None) -> Callable[..., tuple[Run, Page]]:
    """A function of changes to fit.json: the run with them, and its page."""

    def make(change: Callable[[dict[str, Any]], Any] = lambda fit: None, **options: Any) -> tuple[Run, Page]:
        folder = make_run(tmp_path / "run", **options)
        fit = json.loads((folder / "fit.json").read_text())
        change(fit)
        (folder / "fit.json").write_text(json.dumps(fit))
        return read_run(folder), read_page(page.write_report(folder))

    return make


def gap_of(**values: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda fit: fit["heldout_distances"]["open_close"].update(values)


def test_the_viewer_is_one_click_away_where_there_is_one(written: Page, tmp_path: Path, quick: None) -> None:
    """From the page of a folder of all stages too, which lies above it."""
    assert "identify-viewer" not in written.ids
    make_run(tmp_path / "identify")
    (tmp_path / "identify" / "viewer.html").write_text("moving")
    for folder, link in ((tmp_path / "identify", "viewer.html"), (tmp_path, "identify/viewer.html")):
        assert f'<p id="identify-viewer"><a href="{link}">' in page.write_report(folder).read_text(encoding="utf-8")


def test_the_table_holds_the_numbers_of_the_fit(written: Page) -> None:
    for p in parameters():
        for field in ("initial_mean", "initial_std", "mean", "std"):
            cell = written.cells[p["name"], field]
            assert cell["values"] == [p[field]]
            shown = float(cell["text"].strip().replace("−", "-"))
            assert shown == pytest.approx(p[field], rel=0.05, abs=0.05 * p["std"])
        assert written.cells[p["name"], "interval"]["values"] == p["interval"]
    names = list(dict.fromkeys(name for name, _ in written.cells if ":" not in name))
    assert names == [row[0] for row in ROWS]  # in the order of the paper's table


def test_truth_and_verdict_columns(written: Page) -> None:
    assert written.cells["hinge_stiffness", "truth"]["values"] == [1.06]
    assert "inside" in written.cells["hinge_stiffness", "truth"]["text"]
    assert "outside" in written.cells["joint_damping_4", "truth"]["text"]
    verdicts = {name: cell["data-verdict"] for (name, field), cell in written.cells.items() if field == "verdict"}
    assert {name for name, verdict in verdicts.items() if verdict != "identifiable"} == {"door_mass"}
    mass = written.cells["door_mass", "verdict"]
    assert mass["data-verdict"] == "not identifiable"
    assert "less than their noise" in mass["text"] and "Hinge damping (−0.93)" in mass["text"]
    friction = written.cells["hinge_friction_loss", "verdict"]
    assert friction["data-bound"] == "lower" and "on lower bound 0 N m" in spaced(friction["text"])
    assert ("door_x", "truth") not in written.cells  # nobody knows a nuisance's truth here


def test_the_result_in_mujocos_own_terms(written: Page) -> None:
    """Each changed number with interval and place, the lines, laws that MJCF lacks, and the difference from C."""
    row = "change:joint:hinge:stiffness:0"
    assert [written.cells[row, f]["values"] for f in ("before", "after", "interval")] == [
        [0.8],
        [1.049],
        [1.017, 1.087],
    ]
    assert "door.xml, line 12" in written.cells[row, "where"]["text"]
    assert "default class 'soft'" in written.cells[row, "where"]["text"].replace("’", "'")
    assert '+<joint name="hinge" stiffness="1.049"/>' in written.ids["identify-mjcf-patch"]["text"]
    assert "<recording>" in written.ids["identify-not-in-mjcf"]["text"]
    assert written.cells["law:latch:hinge", "axes"]["text"].strip() == "position"
    note = written.ids["identify-mjcf-note"]["text"].replace("\xa0", " ")
    assert "differ from this fit's replay by 0.010 N m" in note and "at most 0.040" in note


def test_a_fit_of_an_earlier_version_has_no_such_part(tmp_path: Path, quick: None) -> None:
    folder = make_run(tmp_path / "run")
    (folder / "fitted.json").unlink()
    assert "identify-mjcf" not in read_page(page.write_report(folder)).ids


def test_the_first_screen_has_the_answer_and_its_numbers(written: Page) -> None:
    answer = written.ids["identify-answer"]
    assert (answer["data-parameters"], answer["data-identifiable"]) == ("8", "7")
    assert [float(written.keys[k]) for k in ("before", "after", "noise_floor", "closed")] == [
        1.2234, 0.1187, 0.1012, 0.9844,
    ]  # fmt: skip
    said = spaced(answer["text"])
    assert "8 parameters and 2 nuisances were fitted" in said and "fell from 1.22 to 0.119 N m" in said
    assert "differ among themselves by 0.101 N m, so 98 % of what can be closed was closed" in said
    assert list(written.doubts) == ["unidentifiable", "on_bound"]
    assert "door mass" in written.doubts["unidentifiable"]
    assert "hinge friction loss (lower bound 0 N m)" in spaced(written.doubts["on_bound"])
    assert written.ids["identify-next"]["data-next"] == "bound motion"
    truth = written.ids["identify-truth"]
    assert (truth["data-known"], truth["data-inside"]) == ("7", "6")


@pytest.mark.parametrize("judged", ["repeats", "time", "same", "recordings"])
def test_the_page_says_what_the_fit_was_judged_on(changed: Callable, judged: str) -> None:
    said = {"repeats": "On repeats that", "time": "On the last part of the log", "same": "On its one repeat",
            "recordings": "On a recording that"}[judged]  # fmt: skip
    run, written = changed(gap_of(judged=judged))
    assert said in spaced(written.ids["identify-answer"]["text"])
    (line, *_) = lines(
        "identify.txt.jinja", fit=run.fit, seconds=1.0, asked="", far_off=False, lacks_something=False, needs=None
    )
    assert said[3:] in line and line.startswith("open_close: torque distance 1.22 -> 0.119 N m")


@pytest.mark.parametrize(
    ("change", "doubt", "step"),
    [
        (gap_of(after=2.5, closed=-1.1), "worse", "set_up"),
        (gap_of(after=1.05), "far_off", "set_up"),  # less than half of it closed, ten times the floor left
        (lambda fit: fit.update(converged=False), "not_converged", ""),
        (lambda fit: fit.update(converged=None), "not_judged", "preset"),
        (lambda fit: fit.update(checks={"open_close": CHECK}), "time_step", "time_step"),
        (
            lambda fit: fit.update(checks={"open_close": {**CHECK, "too_coarse": False, "engines_differ": True}}),
            "engine",
            "",
        ),
        (lambda fit: fit.update(mean_square=90.0), "noisy", "search"),
        (gap_of(noise_floor=None, closed=None, judged="same"), "one_repeat", "repeats"),
        (gap_of(noise_floor=None, closed=None, judged="time"), "one_repeat", "search_log"),
        (lambda fit: fit["parameters"][4].update(identifiable=False, moved=5.0, best=90.0), "moved", "motion"),
    ],
)
def test_what_to_doubt_and_what_to_do(changed: Callable, change: Callable, doubt: str, step: str) -> None:
    run, written = changed(change)
    assert doubt in fit_doubts(run.fit) and written.doubts[doubt].strip()
    assert list(written.doubts) == fit_doubts(run.fit)
    steps = next_steps(run, searched=False)
    assert (step in steps or not step) and written.ids["identify-next"]["data-next"].split() == steps
    assert spaced(written.ids["identify-next"]["text"]).count("; ") >= len(steps) - 1
    assert written.ids["identify-next"]["text"].strip().endswith(".")


def test_numbers_of_the_doubts(changed: Callable) -> None:
    def change(fit: dict[str, Any]) -> None:
        (at,) = (i for i, p in enumerate(fit["parameters"]) if p["name"] == "joint_damping_4")
        fit["parameters"][at] |= {"identifiable": False, "best": 90.0, "moved": 5.0, "reason": "the data leave 40%"}
        fit |= {"checks": {"open_close": CHECK}, "mean_square": 2.5}

    _, written = changed(change)
    assert "joint damping 4 moved from 40.0 to 90.0 N m s/rad (5.0 prior deviations)" in spaced(written.doubts["moved"])
    row = written.cells["joint_damping_4", "verdict"]
    assert row["data-verdict"] == "moved" and "the data leave 40%" in row["text"]
    assert "100 ms is too coarse" in spaced(written.doubts["time_step"]) and "0.0410" in written.doubts["time_step"]
    assert "Plain C MuJoCo differs by 0.900 N m and 0.0120 rad (or m) at most." in written.text
    assert "2.50" in written.doubts["noisy"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gap", "bounds", "doubted"),
    [
        ({"after": 1.05}, 1, True),
        ({"after": 0.5}, 5, False),  # most of it closed
        ({"before": 0.3, "after": 0.25}, 5, False),  # it began near
        ({"after": 1.05, "noise_floor": None}, 1, False),
        ({"after": 1.05, "noise_floor": None}, 2, True),
        ({"after": 1.3}, 0, True),
    ],
)
def test_a_fit_far_from_the_data_doubts_the_set_up_first(
    tmp_path: Path, quick: None, gap: dict, bounds: int, doubted: bool
) -> None:
    folder = make_run(tmp_path / "run")
    fit = json.loads((folder / "fit.json").read_text())
    fit["heldout_distances"]["open_close"] |= gap
    for k, p in enumerate(fit["parameters"]):
        p["on_bound"] = k < bounds
    (folder / "fit.json").write_text(json.dumps(fit))
    assert ("far_off" in fit_doubts(read_run(folder).fit)) == doubted
    assert (next_steps(read_run(folder), searched=False)[0] == "set_up") == doubted
    lead = read_page(page.write_report(make_gap(folder))).ids["lead-next"]  # a search beside it
    said = spaced(lead["text"]).strip()
    assert said.startswith("Next: check joint order, signs, units and servo gains") == doubted and "look for" in said


def test_a_search_alone_judges_no_parameter(changed: Callable) -> None:
    def change(fit: dict[str, Any]) -> None:
        for p in fit["parameters"]:
            p |= {"identifiable": False, "reason": "not judged: the search's covariance depends on when it stopped"}
        fit["converged"] = None

    run, written = changed(change)
    assert "unidentifiable" not in written.doubts and "motion" not in next_steps(run, searched=False)
    assert written.cells["hinge_stiffness", "verdict"]["data-verdict"] == "not judged"


def test_a_search_on_the_page_is_named_instead_of_its_command(changed: Callable) -> None:
    run, written = changed(lambda fit: fit.update(mean_square=90.0))
    said = spaced(written.ids["identify-next"]["text"])
    assert "droid_jax.run gap" in said and "(it takes a second motion, or 16 repeats of this one)" in said
    assert next_steps(run, searched=True)[-1] == "search_below"
    run, _ = changed(gap_of(noise_floor=None, closed=None, judged="time"))
    assert next_steps(run, searched=True)[-1] == "asked_below"


def test_a_fit_without_a_doubt_is_trained_on(changed: Callable) -> None:
    def change(fit: dict[str, Any]) -> None:
        for p in fit["parameters"]:
            p |= {"identifiable": True, "on_bound": False}

    run, written = changed(change)
    assert next_steps(run, searched=False) == ["train"] and not written.doubts
    assert "Every parameter of interest is identifiable" in written.text


@pytest.mark.parametrize(
    ("repeats", "needs"),
    [
        ([3], (8, 16, False)),
        ([8], (8, 16, True)),
        ([5, 9], (8, 16, False)),
        ([16], None),
        ([1], None),  # a log of which parts take the place of repeats
        ([8, 8], None),
    ],
)
def test_what_the_search_takes_is_what_it_asks_for(repeats: list[int], needs: tuple | None) -> None:
    assert needed(repeats) == needs


def test_one_of_a_thing_is_not_several(tmp_path: Path, quick: None) -> None:
    run = make_run(tmp_path / "run")
    fit, config = (json.loads((run / f"{name}.json").read_text()) for name in ("fit", "config"))
    fit["parameters"] = [p for p in fit["parameters"] if not p["nuisance"]][:1]
    config["recordings"][0]["repeats"] = 1
    (run / "fit.json").write_text(json.dumps(fit))
    (run / "config.json").write_text(json.dumps(config))
    written = read_page(page.write_report(run))
    assert spaced(written.ids["identify-answer"]["text"]).startswith("1 parameter was fitted to")
    assert "1 repeat of 7.68 s" in written.text


@pytest.mark.parametrize(
    ("best", "low", "bound", "said"),
    [
        (1.5, 0.5, "upper", "shoulder servo scale (more than 1.50, its upper bound)"),
        (0.5, 0.5, "lower", "shoulder servo scale (less than 0.500, its lower bound)"),
    ],
)
def test_a_factor_at_its_bound_lies_beyond_it(
    changed: Callable, best: float, low: float, bound: str, said: str
) -> None:
    """The robot's servo is fifty times as stiff as the model's, so that the factor ends at its bound."""
    factor = {"name": "shoulder_servo_scale", "unit": "-", "initial_mean": 1.0, "initial_std": 0.1, "low": low}
    entry = {**parameters()[4], **factor, "high": 1.5, "best": best, "on_bound": True}
    _, written = changed(lambda fit: fit["parameters"].append(entry))
    assert said in spaced(written.doubts["on_bound"])
    assert written.cells["shoulder_servo_scale", "verdict"]["data-bound"] == bound


def test_a_parameter_that_moved_says_how_far_and_why_it_is_uncertain(changed: Callable) -> None:
    moved = {
        **parameters()[4], "name": "elbow_frictionloss", "unit": "N m", "identifiable": False, "initial_mean": 0.1,
        "initial_std": 0.05, "best": 0.35, "low": 0.0, "high": 0.35, "on_bound": True, "moved": 5.0,
        "reason": "the data leave 40% of the prior's width",
        "partners": [{"name": "elbow_damping", "correlation": -0.93}],
    }  # fmt: skip
    run, _ = changed(lambda fit: fit["parameters"].append(moved))
    p = run.fit.parameters[-1]
    assert p.moved_far and p.deviations == 5.0 and p.bound == "upper" and p.bound_value == 0.35
    old = msgspec.convert({**moved, "moved": None}, FittedParameter)
    assert old.deviations == pytest.approx(5.0)
    assert not msgspec.convert({**moved, "moved": 0.2}, FittedParameter).moved_far
    said = lines(
        "identify.txt.jinja", fit=run.fit, seconds=1.0, asked="", far_off=False, lacks_something=False, needs=None
    )
    assert said[1] == "not identifiable from this demonstration: door_mass"
    assert said[2] == (
        "elbow_frictionloss moved from 0.100 to 0.350 N m (5.0 prior deviations), to its upper bound 0.350 N m, but "
        "its value is uncertain: the data leave 40% of the prior's width; it moves together with elbow damping "
        "(−0.93); the "
        "true value may lie beyond the bound"
    )


def test_a_synthetic_robot_is_never_called_a_robot(written: Page) -> None:
    assert len(re.findall("synthetic robot", written.text, flags=re.I)) > 5
    assert not re.findall(r"(?<!synthetic )robot", written.text, flags=re.I)


def test_a_robot_is_not_called_a_synthetic_robot(changed: Callable) -> None:
    _, written = changed(synthetic_robot=False)
    assert "that the robot measured" in written.text and "ynthetic robot" not in written.text


def test_the_page_loads_nothing_and_every_link_is_there(run: Path, written: Page) -> None:
    assert written.loads and all(source.startswith("data:") for source in written.loads)
    assert not [link for link in written.links if not (run / link).is_file()]
    assert "gaussian.json" in written.links and "fitted.xml" not in written.links


def test_ids_in_the_page_are_unique_and_references_resolve(run: Path) -> None:
    text = (run / "report.html").read_text(encoding="utf-8")
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))
    assert used and used <= set(ids)


def test_texts_of_the_run_are_escaped(run: Path) -> None:
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "cold &lt;1 h" in text and "cold <1 h" not in text


def test_no_name_of_a_fit_becomes_markup(changed: Callable, tmp_path: Path) -> None:
    evil = "<b>x</b>\"'"

    def change(fit: dict[str, Any]) -> None:
        for p in fit["parameters"][:5]:  # one of them on a bound, one not identifiable
            p |= {"name": f"{p['name']}{evil}", "unit": evil, "reason": evil}
        fit["parameters"][4] |= {"identifiable": False, "moved": 5.0, "partners": [{"name": evil, "correlation": 0.9}]}

    changed(change)
    text = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "<b>" not in text.lower() and text.lower().count("&lt;b&gt;") > 10


def test_two_kinds_of_torque_difference_are_distinguished(written: Page) -> None:
    """Equation 1 over all joints; beside it bars, each of one joint's smoothed torques."""
    assert "Euclidean norm over the joints of simulated minus measured torques, averaged over time" in written.text
    assert "RMS difference between the smoothed torques" in written.text and "RMS over all joints" not in written.text


def test_several_recordings_each_have_their_own_distance_and_figure(tmp_path: Path, one_line: None) -> None:
    run = make_run(tmp_path / "run", recordings=("slow", "fast"))
    text = page.write_report(run).read_text(encoding="utf-8")
    assert 'data-recording="slow"' in text and 'data-recording="fast"' in text
    assert "In “slow”, on repeats that" in spaced(text) and "In “fast”, on repeats that" in spaced(text)
    assert (run / "figures" / "torque_0.pdf").read_bytes().startswith(b"%PDF")
    assert (run / "figures" / "torque_1.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_optional_is_left_out_and_said(tmp_path: Path, quick: None) -> None:
    run = make_run(tmp_path / "run")
    assert "identify-missing" not in read_page(page.write_report(run)).ids
    (run / "distribution.npz").unlink()
    for picture in (run / "frames").glob("*"):
        picture.unlink()
    written = page.write_report(run).read_text()
    assert 'data-missing="distribution"' in written and 'data-missing="replay"' in written
    assert 'id="cost_distribution"' not in written
    (run / "replay.npz").write_bytes(b"")  # there was something to draw
    assert 'data-missing="pictures"' in page.write_report(run).read_text()


@pytest.mark.parametrize(("make", "name"), [(make_run, "fit.json"), (make_gap, "gap.json")])
def test_a_failed_check_is_on_the_page(make: Callable, name: str, tmp_path: Path, quick: None) -> None:
    folder = make(tmp_path / "run")
    assert 'class="checks"' not in page.write_report(folder).read_text()
    content = json.loads((folder / name).read_text())
    (folder / name).write_text(json.dumps({**content, "findings": [asdict(WRONG)]}))
    html = page.write_report(folder).read_text()
    assert 'class="checks"' in html and 'data-kind="sign" data-column="elbow"' in html
    assert "the torque of &lt;elbow&gt; runs against its command" in html
    (folder / name).write_text(json.dumps({**content, "findings": [{"kind": 3}]}))
    with pytest.raises(ValueError, match=rf"{name}: 'findings', entry 0"):
        page.write_report(folder)


def test_what_to_do_next_begins_with_a_failed_check(changed: Callable) -> None:
    run, written = changed(lambda fit: fit.update(findings=[asdict(WRONG)]))
    assert next_steps(run, searched=False)[0] == "mend"
    assert "mend the sign of the recording" in spaced(written.ids["identify-next"]["text"])


def test_a_fit_of_positions_speaks_of_positions(changed: Callable) -> None:
    errors = {"unit": "rad", "joints": ["joint1"], "mae_before": [0.05], "mae_after": [0.01], "rms_before": [0.06],
              "rms_after": [None]}  # fmt: skip
    positions = {"channels": ["position"], "per_joint_unit": "rad", "errors": {"position": errors}}

    def of_positions(fit: dict[str, Any]) -> None:
        fit["heldout_distances"]["open_close"] |= positions
        fit |= {"distance_unit": "rad", "compared": {"position": 1.0}}

    run, written = changed(of_positions)
    answer = spaced(written.ids["identify-answer"]["text"])
    assert "fitted to the joint positions that" in answer and "position distance fell from 1.22 to 0.119 rad" in answer
    assert "orque" not in answer and "Positions: simulation against" in written.text
    assert "simulated minus measured positions" in written.text
    assert "Joint 1 0.0500 0.0100 0.0600 –" in spaced(written.ids["errors"]["text"])
    said = lines(
        "identify.txt.jinja", fit=run.fit, seconds=1.0, asked="", far_off=False, lacks_something=False, needs=None
    )
    assert said[0].startswith("open_close: position distance 1.22 -> 0.119 rad")
    assert said[1].strip() == "position: mean absolute error 0.0500 -> 0.0100 rad"
