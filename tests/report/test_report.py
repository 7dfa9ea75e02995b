"""The report: what the page says equals what the run's files hold, and it says what is missing."""

from __future__ import annotations

import io
import itertools
import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from made_up_gap import make_gap
from made_up_run import JOINTS, ROWS, make_run, parameters
from matplotlib.figure import Figure
from reader import Page, read_page

from droid_jax.report import page, render, search_figures, torque_figures
from droid_jax.report.export import SVG_LIMIT, inline_svg, settled
from droid_jax.report.gap_folder import read_gap
from droid_jax.report.lead import lead
from droid_jax.report.run_folder import read_run
from droid_jax.report.style import BEFORE, NARROW, WIDE
from droid_jax.report.words import JUDGED, label, like, needed, number, percent, summary


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_run(tmp_path_factory.mktemp("report") / "run")
    page.write_report(folder)
    return folder


@pytest.fixture(scope="module")
def written(run: Path) -> Page:
    return read_page(run / "report.html")


def test_the_table_holds_the_numbers_of_the_fit(written: Page) -> None:
    for p in parameters():
        for field in ("initial_mean", "initial_std", "mean", "std"):
            cell = written.cells[p["name"], field]
            assert cell["values"] == [p[field]]
            shown = float(cell["text"].strip().replace("−", "-"))
            assert shown == pytest.approx(p[field], rel=0.05, abs=0.05 * p["std"])
        assert written.cells[p["name"], "interval"]["values"] == p["interval"]
        assert written.cells[p["name"], "initial_mean"]["values"] == [p["initial_mean"]]


def test_truth_and_verdict_columns(written: Page) -> None:
    assert written.cells["hinge_stiffness", "truth"]["values"] == [1.06]
    assert "inside" in written.cells["hinge_stiffness", "truth"]["text"]
    assert "outside" in written.cells["joint_damping_4", "truth"]["text"]
    assert "identifiable" in written.cells["hinge_stiffness", "verdict"]["text"]
    untold = written.cells["door_mass", "verdict"]["text"]
    assert "this demonstration does not tell" in untold and "less than their noise" in untold
    assert "Hinge damping (−0.93)" in untold
    assert "on lower bound 0 N m" in written.cells["hinge_friction_loss", "verdict"]["text"]
    assert ("door_x", "truth") not in written.cells  # nobody knows a nuisance's truth here


def test_groups_come_in_the_order_of_the_papers_table(written: Page) -> None:
    names = list(dict.fromkeys(name for name, _ in written.cells))
    assert names == [row[0] for row in ROWS]


def test_summary_is_made_from_the_numbers(run: Path) -> None:
    text = " ".join(summary(read_run(run)))
    assert "8 parameters (4 of the door, 2 of the synthetic robot and 2 of the gripper)" in text
    assert "2 nuisances" in text and "1.22 N m before the fit" in text and "0.119 N m after it" in text
    assert "98 % of what can be closed" in text
    assert "does not tell door mass;" in text
    assert "the true value is known for 7; for 6 of them it lies in the 90 % interval" in text
    assert "hinge friction loss (lower bound 0 N m)" in text
    assert "Next:" in text and "droid_jax.run gap" not in text


@pytest.mark.parametrize("judged", [None, *JUDGED])
def test_the_page_says_what_the_fit_was_judged_on(tmp_path: Path, judged: str | None) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    if judged:
        fit["gap"]["open_close"]["judged"] = judged
        (run / "fit.json").write_text(json.dumps(fit))
    said = JUDGED[judged or "repeats"]
    loaded = read_run(run)
    assert said in " ".join(summary(loaded)).replace("On ", "on ") and said in lead(loaded, None, None)[0]
    assert "fell from 1.22 to 0.119 N m" in lead(loaded, None, None)[0]
    fit["gap"]["open_close"]["after"] = 2.0
    (run / "fit.json").write_text(json.dumps(fit))
    assert "went from 1.22 to 2.00 N m" in lead(read_run(run), None, None)[0]


def test_a_search_alone_judges_no_parameter(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    for p in fit["parameters"]:
        p |= {"identifiable": False, "reason": "not judged: the search's covariance depends on when it stopped"}
    (run / "fit.json").write_text(json.dumps({**fit, "converged": None}))
    text = " ".join(summary(read_run(run)))
    assert "was not judged" in text and "does not tell" not in text and "record a motion" not in text
    (run / "fit.json").write_text(json.dumps({**fit, "converged": False}))
    assert "The refinement did not converge" in " ".join(summary(read_run(run)))


def test_what_gap_needs_is_said_and_not_where_it_ran(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    (run / "fit.json").write_text(json.dumps({**fit, "mean_square": 90.0}))
    assert "(it takes a second motion, or 16 repeats of this one)" in summary(read_run(run))[-1]
    assert "droid_jax.run gap" not in summary(read_run(run), searched=True)[-1]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("panda_joint3", "Joint 3"), ("joint_3", "Joint 3"), ("panda_finger_joint1", "Panda finger joint1"),
        ("arm2_joint2", "Arm2 joint2"), ("fr3_joint2", "Joint 2"), ("left_joint3", "Left joint3"),
        ("thumb_joint1", "Thumb joint1"), ("torso_joint_1", "Torso joint 1"), ("lbr_iiwa_joint_1", "Joint 1"),
        ("torque_offset[panda_joint3]", "Torque offset, joint 3"),
    ],
)  # fmt: skip
def test_joints_of_different_names_have_different_labels(name: str, words: str) -> None:
    assert label(name) == words


@pytest.mark.parametrize(
    ("repeats", "said"),
    [
        ([3], "8 repeats of each of two motions, or 16 of one"),
        ([8], "a second motion, or 16 repeats of this one"),
        ([5, 9], "8 repeats of each of two motions, or 16 of one"),
        ([16], ""),
        ([1], ""),  # a log of which parts take the place of repeats
        ([8, 8], ""),
    ],
)
def test_what_the_search_takes_is_what_it_asks_for(repeats: list[int], said: str) -> None:
    assert needed(repeats) == (f" (it takes {said})" if said else "")


@pytest.mark.parametrize(("judged", "next_step"), [("time", "droid_jax.run gap ask"), ("same", "record repeats")])
def test_a_single_repeat_does_not_say_that_the_model_is_whole(tmp_path: Path, judged: str, next_step: str) -> None:
    """Its noise is what the fit left, so nothing is ever above it."""
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    fit["gap"]["open_close"] |= {"noise_floor": None, "closed": None, "judged": judged}
    (run / "fit.json").write_text(json.dumps(fit))
    last = summary(read_run(run))[-1]
    assert next_step in last and "draw the simulations" not in last
    assert "asked by the search below" in summary(read_run(run), searched=True)[-1]


def test_one_of_a_thing_is_not_several(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    fit, config = (json.loads((run / f"{name}.json").read_text()) for name in ("fit", "config"))
    fit["parameters"] = [p for p in fit["parameters"] if not p["nuisance"]][:1]
    config["recordings"][0]["repeats"] = 1
    (run / "fit.json").write_text(json.dumps(fit))
    (run / "config.json").write_text(json.dumps(config))
    assert summary(read_run(run))[0].startswith("1 parameter (1 of the door) was fitted so that")
    assert lead(read_run(run), None, None)[0].startswith("1 parameter was fitted to")
    assert "1 repeat of 7.68 s" in read_page(page.write_report(run)).text


def test_names_with_dollars_are_written_as_they_are() -> None:
    """MuJoCo allows them; as mathematics the first ends the drawing, and the second loses its dollars."""
    gaps = np.ones(2)
    for names in (["x$\\foo$", "y"], ["a$b$c", "k_$x_{1$"]):
        figure = settled(torque_figures.gap_per_joint(names, gaps, gaps, None))
        assert [t.get_text() for t in figure.axes[0].get_xticklabels()] == [label(name) for name in names]
        figure.savefig(io.BytesIO())


@pytest.mark.parametrize("width", [WIDE, NARROW])
@pytest.mark.parametrize(
    "names",
    [
        [f"{a}_joint" for a in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")],
        [f"joint_{i}" for i in range(30)],
    ],
)
def test_names_below_an_axis_do_not_overlap(names: list[str], width: float) -> None:
    gaps = np.ones(len(names))
    figure = settled(torque_figures.gap_per_joint(names, gaps, gaps, None, width=width))
    short = settled(torque_figures.gap_per_joint(["a"], [1.0], [1.0], None, width=width))
    heights = [f.axes[0].get_window_extent().height for f in (figure, short)]
    assert heights[0] > 0.9 * heights[1]  # the names take nothing from the panel
    texts = figure.axes[0].get_xticklabels()
    if texts[0].get_rotation():  # turned, they lie side by side where their lines do not touch
        starts = np.diff([text.get_window_extent().x1 for text in texts])
        height = texts[0].get_fontsize() * figure.dpi / 72
        assert starts.min() > 0.8 * height
    else:
        boxes = [text.get_window_extent() for text in texts]
        assert all(left.x1 <= right.x0 for left, right in itertools.pairwise(boxes))


def test_a_lone_log_has_no_band_of_repeats() -> None:
    time = np.linspace(0.0, 1.0, 50)
    lines = {name: np.sin(time)[:, None] for name in torque_figures._TRACES}
    figure = torque_figures.torque_traces({"time": time, "joints": ["a"], **lines})
    assert figure.axes[0].get_legend_handles_labels()[1] == ["measured", "before the fit", "after the fit"]


def test_summary_says_when_the_fit_made_it_worse(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    fit["gap"]["open_close"] |= {"after": 2.5, "closed": -1.1}
    (run / "fit.json").write_text(json.dumps(fit))
    text = " ".join(summary(read_run(run)))
    assert "the fit made it worse" in text and "do not train on this fit" in text
    assert (
        "what is left is well above noise, so the model lacks something, or its timestep is too coarse: "
        "see below in which joint and phase"
    ) in text
    assert "these values may be bent by it: go on with the search for it, below." in summary(read_run(run), True)[-1]


@pytest.mark.parametrize(
    ("gap", "bounds", "doubted"),
    [
        ({"after": 1.05}, 1, True),  # less than half of it closed, ten times the floor left
        ({"after": 0.5}, 5, False),  # most of it closed
        ({"before": 0.3, "after": 0.25}, 5, False),  # it began near
        ({"after": 1.05, "noise_floor": None}, 1, False),
        ({"after": 1.05, "noise_floor": None}, 2, True),
        ({"after": 1.3}, 0, True),
    ],
)
def test_a_fit_far_from_the_data_doubts_the_set_up_first(tmp_path: Path, gap: dict, bounds: int, doubted: bool) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    fit["gap"]["open_close"] |= gap
    for k, p in enumerate(fit["parameters"]):
        p["on_bound"] = k < bounds
    (run / "fit.json").write_text(json.dumps(fit))
    said = "Next: do not train on this fit: check joint order, signs, units and servo gains before anything else"
    assert summary(read_run(run))[-1].startswith(said) == doubted
    searched = read_gap(make_gap(tmp_path / "gap"))
    last = lead(read_run(run), searched, None)[-1]
    assert last.startswith("Next: check joint order, signs, units and servo gains") == doubted and "look for" in last


def test_residuals_far_above_noise_point_to_the_gap_command(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    for mean_square, said in ((1.4, False), (2.5, True)):
        (run / "fit.json").write_text(json.dumps({**fit, "mean_square": mean_square}))
        assert ("droid_jax.run gap" in summary(read_run(run))[-1]) is said


def test_a_synthetic_robot_is_never_called_a_robot(written: Page) -> None:
    assert len(re.findall("synthetic robot", written.text, flags=re.I)) > 5
    assert not re.findall(r"(?<!synthetic )robot", written.text, flags=re.I)


def test_a_robot_is_not_called_a_synthetic_robot(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", synthetic_robot=False))
    assert "which the robot measured" in summary(run)[0]
    assert "synthetic robot" not in " ".join(summary(run))


def test_the_page_loads_nothing_and_every_link_is_there(run: Path, written: Page) -> None:
    assert written.loads and all(source.startswith("data:") for source in written.loads)
    missing = [link for link in written.links if not (run / link).is_file()]
    assert not missing
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


def test_two_kinds_of_torque_difference_are_told_apart(written: Page) -> None:
    """Equation 1 over all joints; beside it bars, each of one joint's smoothed torques."""
    assert "Euclidean norm over the joints of simulated minus measured torques, averaged over time" in written.text
    assert "before the fit (norm over the joints, averaged over time)" in written.text
    assert "RMS difference between the smoothed torques" in written.text and "RMS over all joints" not in written.text


def test_several_recordings_each_have_their_own_gap_and_figure(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", recordings=("slow", "fast"))
    text = page.write_report(run).read_text(encoding="utf-8")
    assert "In “slow”, on repeats that" in text and "In “fast”, on repeats that" in text
    assert (run / "figures" / "torque_0.pdf").read_bytes().startswith(b"%PDF")
    assert (run / "figures" / "torque_1.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_optional_is_left_out_and_said(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    (run / "distribution.npz").unlink()
    for picture in (run / "frames").glob("*"):
        picture.unlink()
    text = read_page(page.write_report(run)).text
    assert "distribution.npz is not there" in text and "No pictures: a log without commands has no replay" in text
    assert "The two Gaussians, replayed" not in text
    (run / "replay.npz").write_bytes(b"")  # there was something to draw
    assert "apt-get install libegl1 libgl1-mesa-dri" in read_page(page.write_report(run)).text


def test_drawing_leaves_the_callers_matplotlib_alone() -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    torque_figures.gap_per_joint(JOINTS, np.ones(7), np.ones(7), None)
    assert dict(matplotlib.rcParams) == before


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
        (lambda fit: fit.update(gap={}), r"fit\.json, 'gap' is empty"),
        (lambda fit: fit["gap"].update(other=fit["gap"].pop("open_close")), "of which fit.json has no 'gap'"),
        (lambda fit: fit["gap"]["open_close"].update(judged="x"), "'judged' must be one of"),
        (lambda fit: fit["cost"].pop("best"), "'cost' lacks 'best'"),
        (lambda fit: fit["gap"].update(open_close=0.1), r"'gap', 'open_close' must be an object, got 0\.1"),
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


@pytest.mark.parametrize(
    ("value", "shown"),
    [(1.0, "1.00"), (-0.05, "−0.0500"), (0.0, "0"), (12345.6, "12346"), (2e-6, "2.00·10⁻⁶"), (-3.5e12, "−3.50·10¹²"),
     (None, "–"), (float("nan"), "–")],
)  # fmt: skip
def test_numbers_are_written_with_three_digits(value: float | None, shown: str) -> None:
    assert number(value) == shown


def test_numbers_follow_their_deviation() -> None:
    assert like(1.23456, 0.021) == "1.235"
    assert like(52.31, 0.83) == "52.31"
    assert like(-1234.5, 40.0) == "−1234"  # half to even, and no digits that mean nothing
    assert percent(0.999) == "99 %" and percent(1.0) == "100 %"
    assert percent(0.837) == "84 %" and percent(0.001) == "< 1 %" and percent(0.0) == "0 %"
    assert percent(float("inf")) == percent(1e307) == "–"


def test_long_traces_are_thinned_without_losing_a_spike() -> None:
    time = np.arange(20_000) * 0.001
    value = np.sin(time)
    value[7_777] = 50.0
    thin_time, thin = torque_figures.thin(time, value)
    assert len(thin) < 500 and thin.max() == 50.0 and (np.diff(thin_time) > 0).all()
    _, low, high = torque_figures.band(time, value - 1, value + 1)
    assert low.min() == (value - 1).min() and high.max() == 51.0


def test_torque_figure_draws_the_given_traces(run: Path) -> None:
    traces = read_run(run).traces["open_close"]
    figure = torque_figures.torque_traces(traces, traces["phases"])
    panels = [a for a in figure.axes if a.get_visible()]
    upper = [a for a in panels if a.get_title("left")]
    lower = [a for a in panels if not a.get_title("left")]
    assert [a.get_title("left") for a in upper] == [f"Joint {i}" for i in range(1, 8)] and len(lower) == 7
    time, measured = traces["time"], np.asarray(traces["measured_mean"])
    for j, (axes, below) in enumerate(zip(upper, lower, strict=True)):
        own, residual = (panel.lines for panel in (axes, below))
        for name, key in (("before the fit", "before"), ("after the fit", "after")):
            line, left = ({one.get_label(): one for one in lines}[name] for lines in (own, residual))
            rows = np.searchsorted(time, line.get_xdata())
            np.testing.assert_array_equal(line.get_ydata(), traces[key][rows, j])
            rows = np.searchsorted(time, left.get_xdata())
            np.testing.assert_array_equal(left.get_ydata(), (measured[:, j] - traces[key][:, j])[rows])


def test_the_name_of_a_short_last_phase_is_not_cut(run: Path) -> None:
    traces = read_run(run).traces["open_close"]
    end = float(traces["time"][-1])
    phases = [{"name": "opening", "start": 0.0, "end": 0.97 * end}, {"name": "hold", "start": 0.97 * end, "end": end}]
    figure = settled(torque_figures.torque_traces(traces, phases))
    name = next(text for text in figure.axes[0].texts if text.get_text() == "hold")
    assert name.get_window_extent().x1 <= figure.axes[0].get_window_extent().x1 + 0.5  # pixels


def test_a_long_torque_figure_stays_a_drawing_on_the_page(run: Path) -> None:
    traces = read_run(run).traces["open_close"]
    for width in (WIDE, NARROW):
        figure = settled(torque_figures.torque_traces(traces, traces["phases"], width=width))
        assert len(inline_svg(figure, "torque")) < SVG_LIMIT  # beyond, the page shows pixels


def test_figures_survive_failed_replays() -> None:
    history = {"generation": np.arange(4), "best_cost": [np.inf, 2.0, 1.0, 0.5], "median_cost": [np.inf] * 4}
    assert isinstance(search_figures.cost_history(history, {"best": 0.5, "noise_floor": None}), Figure)
    costs = np.array([np.inf, 1.0, 2.0])
    legend = search_figures.cost_histograms(costs, costs[1:]).legends[0]
    assert any("1 without a finite cost" in t.get_text() for t in legend.get_texts())
    with pytest.raises(ValueError, match="no finite cost"):
        search_figures.cost_histograms(np.array([np.inf]), np.array([np.nan]))


def test_the_best_told_parameters_are_chosen() -> None:
    chosen = search_figures.most_identifiable(parameters(), {p["name"]: 0 for p in parameters()})
    ratio = {p["name"]: p["std"] / p["initial_std"] for p in parameters()}
    assert chosen[0] == "hinge_stiffness" and "door_mass" not in chosen and "door_x" not in chosen
    assert [ratio[n] for n in chosen] == sorted(ratio[n] for n in chosen) and 3 <= len(chosen) <= 6
    few = parameters()[3:4] + parameters()[8:]
    assert len(search_figures.most_identifiable(few, {"door_mass": 0, "door_x": 1})) == 2


def test_inline_svg_is_well_formed_and_follows_the_pages_colours() -> None:
    figure = torque_figures.gap_per_joint(JOINTS, np.ones(7), 0.1 * np.ones(7), 0.05)
    svg = inline_svg(figure, "x")
    root = ElementTree.fromstring(svg)
    assert root.tag.endswith("svg") and "var(--before)" in svg and "var(--after)" in svg
    assert BEFORE not in svg
    assert svg == inline_svg(torque_figures.gap_per_joint(JOINTS, np.ones(7), 0.1 * np.ones(7), 0.05), "x")


XML = """<mujoco><visual><global offwidth="64" offheight="48"/></visual><worldbody>
<light pos="0 0 3"/><camera name="front" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>
<body><joint name="slide" type="slide" axis="1 0 0"/><geom type="sphere" size="0.2" rgba="1 0 0 1"/></body>
</worldbody></mujoco>"""


def _backend() -> str:
    try:
        return render.working_backend()
    except render.NoOpenGL as error:
        pytest.skip(str(error))


@pytest.mark.gl
def test_frames_show_where_the_body_is() -> None:
    import mujoco

    _backend()
    model = mujoco.MjModel.from_xml_string(XML)
    qpos = np.array([[-0.5], [0.0], [0.5]])
    images = render.frames(model, qpos, [0, 1, -1], size=(48, 64))
    centres = []
    for image in images:
        assert image.shape == (48, 64, 3) and image.dtype == np.uint8
        red = image[..., 0].astype(int) - image[..., 1] > 60
        centres.append(np.flatnonzero(red.any(axis=0)).mean())
    assert centres[0] < centres[1] - 10 and centres[2] > centres[1] + 10
    assert centres[1] == pytest.approx(31.5, abs=1.5)


def test_frames_refuse_what_does_not_fit_the_model() -> None:
    import mujoco

    model = mujoco.MjModel.from_xml_string(XML)
    with pytest.raises(ValueError, match=r"\[T, 1\].*\(3, 2\)"):
        render.frames(model, np.zeros((3, 2)), [0], size=(48, 64))
    with pytest.raises(ValueError, match="index 3 is outside"):
        render.frames(model, np.zeros((3, 1)), [3], size=(48, 64))
    with pytest.raises(ValueError, match="row 1 is not finite"):
        render.frames(model, np.array([[0.0], [np.nan]]), [0, 1], size=(48, 64))
    with pytest.raises(ValueError, match="no camera 'back'; this model has: front"):
        render.frames(model, np.zeros((1, 1)), [0], camera="back", size=(48, 64))
    with pytest.raises(ValueError, match=r"\(48, 64\), got \(480, 640\)"):
        render.frames(model, np.zeros((1, 1)), [0])


def test_without_opengl_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setenv("MUJOCO_GL", "none_such")  # what it finds is kept, and no other test asks about this one
    monkeypatch.setattr(
        render, "_child", lambda backend, *_: asked.append(backend) or "the process died with signal 11"
    )
    for _ in range(2):
        with pytest.raises(render.NoOpenGL, match=r"egl \(the process died with signal 11\).*libosmesa6"):
            render.working_backend()
    assert asked == ["none_such", "egl", "osmesa"]
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(render.NoOpenGL, match="turns drawing off"):
        render.working_backend()


def test_a_backend_that_cannot_draw_is_a_message_not_a_crash() -> None:
    assert "invalid value" in render._child("nonsense", None, 60.0)
    assert render._candidates("glfw", "linux") == ["glfw", "egl", "osmesa"]
    assert render._candidates("", "linux") == ["egl", "osmesa"]


def test_a_time_step_that_is_too_coarse_leads_and_is_on_the_page(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    fit = json.loads((folder / "fit.json").read_text())
    check = {
        "unit": "N m", "time_step": 0.1, "remaining": 0.05, "discretisation": 0.041, "parity_torque": 0.9,
        "parity_rms": 0.06, "parity_angle": 0.012, "unmeasured": "", "too_coarse": True, "engines_differ": False,
    }  # fmt: skip
    fit["checks"] = {"open_close": check}
    (folder / "fit.json").write_text(json.dumps(fit))
    said = " ".join(summary(read_run(folder)))
    assert "The time step of 100 ms is too coarse for this scene" in said and "change by 0.0410 N m" in said
    assert "Next: give the scene a smaller timestep and fit again" in said
    page.write_report(folder)
    text = " ".join((folder / "report.html").read_text().split())
    assert "The time step of 100 ms changes the fitted torques by 0.0410 N m" in text
    assert "Plain C MuJoCo differs by 0.900 N m and 0.0120 rad (or m) at most." in text
    fit["checks"]["open_close"] |= {"too_coarse": False, "engines_differ": True}
    (folder / "fit.json").write_text(json.dumps(fit))
    assert "MJX and plain C MuJoCo differ at the fitted values by 0.0600 N m" in " ".join(summary(read_run(folder)))
