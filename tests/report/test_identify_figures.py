"""The figures of an identification draw their data."""

from __future__ import annotations

import io
import itertools
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import msgspec
import numpy as np
import pytest
from made_up_run import JOINTS, make_run, parameters
from matplotlib.figure import Figure

from droid_jax.report import identify_figures, torque_figures
from droid_jax.report.identify_folder import CostEntry, FittedParameter, read_run
from droid_jax.report.reading import PhaseEntry
from droid_jax.report.style import BEFORE, NARROW, SVG_LIMIT, WIDE, inline_svg, settled
from droid_jax.report.text import label


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("report") / "run")


def test_names_with_dollars_are_written_as_they_are() -> None:
    """MuJoCo allows them; as mathematics the first ends the drawing, and the second loses its dollars."""
    gaps = np.ones(2)
    for names in (["x$\\foo$", "y"], ["a$b$c", "k_$x_{1$"]):
        figure = settled(torque_figures.distance_per_joint(names, gaps, gaps, None))
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
    figure = settled(torque_figures.distance_per_joint(names, gaps, gaps, None, width=width))
    short = settled(torque_figures.distance_per_joint(["a"], [1.0], [1.0], None, width=width))
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
    keys = ("measured_mean", "measured_low", "measured_high", "before", "after")
    lines = {name: np.sin(time)[:, None] for name in keys}
    figure = torque_figures.torque_traces({"time": time, "joints": ["a"], **lines})
    assert figure.axes[0].get_legend_handles_labels()[1] == ["measured", "before the fit", "after the fit"]


def test_drawing_leaves_the_callers_matplotlib_alone() -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    torque_figures.distance_per_joint(JOINTS, np.ones(7), np.ones(7), None)
    assert dict(matplotlib.rcParams) == before


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
    phases = [PhaseEntry("opening", 0.0, 0.97 * end), PhaseEntry("hold", 0.97 * end, end)]
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
    assert isinstance(identify_figures.cost_history(history, CostEntry(1.0, 0.5, None)), Figure)
    costs = np.array([np.inf, 1.0, 2.0])
    legend = identify_figures.cost_histograms(costs, costs[1:]).legends[0]
    assert any("1 without a finite cost" in t.get_text() for t in legend.get_texts())
    with pytest.raises(ValueError, match="no finite cost"):
        identify_figures.cost_histograms(np.array([np.inf]), np.array([np.nan]))


def test_the_best_identified_parameters_are_chosen() -> None:
    made = [msgspec.convert(p, FittedParameter) for p in parameters()]
    chosen = identify_figures.most_identifiable(made, {p.name: 0 for p in made})
    ratio = {p.name: p.std / p.initial_std for p in made}
    assert chosen[0] == "hinge_stiffness" and "door_mass" not in chosen and "door_x" not in chosen
    assert [ratio[n] for n in chosen] == sorted(ratio[n] for n in chosen) and 3 <= len(chosen) <= 6
    few = made[3:4] + made[8:]
    assert len(identify_figures.most_identifiable(few, {"door_mass": 0, "door_x": 1})) == 2


def test_inline_svg_is_well_formed_and_follows_the_pages_colours() -> None:
    figure = torque_figures.distance_per_joint(JOINTS, np.ones(7), 0.1 * np.ones(7), 0.05)
    svg = inline_svg(figure, "x")
    root = ElementTree.fromstring(svg)
    assert root.tag.endswith("svg") and "var(--before)" in svg and "var(--after)" in svg
    assert BEFORE not in svg
    assert svg == inline_svg(torque_figures.distance_per_joint(JOINTS, np.ones(7), 0.1 * np.ones(7), 0.05), "x")


@pytest.mark.parametrize("width", [7.0, 4.0])
@pytest.mark.parametrize("format", ["svg", "pdf", "png"])
def test_the_labels_of_a_correlation_map_lie_inside_of_it(width: float, format: str) -> None:
    names = ("torsional_friction_right", "hinge_friction", "a_long_name_that_someone_gave")
    figure = identify_figures.correlation_map(names, np.eye(3), width)
    figure.savefig(io.BytesIO(), format=format)
    box, (right, top) = figure.get_tightbbox().extents, figure.get_size_inches()
    assert min(box[:2]) > 0 and box[2] < right and box[3] < top
