"""The figures of a search for a missing effect draw what they are given."""

from __future__ import annotations

import io

import numpy as np
import pytest
from made_up_gap import make_gap

from droid_jax.report import gap_figures, gap_maps, gap_torques, gap_words, style
from droid_jax.report.gap_folder import Gap, read_gap
from droid_jax.report.words import number


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> Gap:
    return read_gap(make_gap(tmp_path_factory.mktemp("gap") / "named"))


def test_overlays_draw_the_given_torques(named: Gap) -> None:
    traces = named.traces["test"]
    figure = gap_torques.torque_overlays(traces, named.unit)
    panels = [a for a in figure.axes if a.get_visible() and a.get_title("left")]
    assert [a.get_title("left") for a in panels] == [f"Joint {i}" for i in range(1, 8)]
    for j, axes in enumerate(panels):
        drawn = {line.get_label(): line for line in axes.lines}
        for name, key in (("base model", "before"), ("with what was missing", "after"), ("measured, mean", "measured")):
            rows = np.searchsorted(traces["time"], drawn[name].get_xdata())
            np.testing.assert_array_equal(drawn[name].get_ydata(), traces[key][rows, j])


def test_the_maps_share_one_scale_and_leave_out_what_is_not_found(named: Gap) -> None:
    cells = named.found["cells"]
    first, second, *_ = gap_maps.cell_maps(cells["before"], cells["after"]).axes
    before, after = first.collections[0], second.collections[0]
    assert before.get_clim() == after.get_clim()
    found = [c["found"] for c in cells["after"] if c["variable"] == gap_words.TIME]
    np.testing.assert_array_equal(~np.ma.getmaskarray(np.ma.asarray(after.get_array())).ravel(), found)
    largest = max(c["discrepancy"] for c in cells["before"] if c["variable"] == gap_words.TIME)
    assert np.max(np.asarray(before.get_array())) == largest
    assert number(largest, 2) in {t.get_text() for t in first.texts}


def test_figures_survive_odd_numbers(named: Gap) -> None:
    found = named.found
    gaps = [{**g, "after": -0.001, "torque_after": None} for g in found["gaps"].values()]
    gap_figures.gap_bars(["A", "B", "C"], gaps, 0.0, "N m")
    gap_figures.gap_bars(["A"], [{k: None for k in gaps[0]}], None, "N m")
    silent = [{**c, "found": False, "discrepancy": -0.01} for c in found["cells"]["before"]]
    gap_maps.cell_maps(silent, silent)
    gap_maps.state_bars(silent, None)
    traces = named.traces["train"]
    assert len(gap_torques.remainder(traces, silent, "N m").axes) == 1  # no variable is located, time alone is drawn
    gap_torques.remainder(traces, [], "N m")


def test_shifts_are_counted_in_deviations() -> None:
    shift = {"name": "knob_mass", "unit": "kg", "before": 2.6, "after": 0.2, "deviation_before": 0.4}
    assert gap_words.deviations(shift) == pytest.approx(-6.0)
    unknown = [{**shift, "deviation_before": d} for d in (None, 0.0)]
    assert gap_words.largest_shifts([*unknown, shift]) == [shift]


def test_position_and_load_are_shown_of_the_joint_with_the_most(named: Gap) -> None:
    """Of the base model, in both models alike; a curve over a joint's load says that it is that joint's."""
    cells = named.found["cells"]
    joint = gap_maps.most_at(cells["before"])
    loudest = max(
        (c for c in cells["before"] if c["variable"].startswith("position of ")), key=lambda c: c["discrepancy"]
    )
    assert loudest["variable"] == f"position of {joint}"
    shown = [a.get_xlabel() for a in gap_maps.state_bars(cells["before"], cells["after"]).axes if a.get_visible()]
    assert [name for name in shown if " of " in name] == ["Position of joint 1 [rad]", "Load of joint 1 [N m]"]
    some = [c for c in cells["before"] if c["variable"] in (gap_words.TIME, f"load of {joint}")]
    curve = gap_torques.remainder(named.traces["train"], some, "N m").axes[-1]
    assert (curve.get_title("left"), curve.get_xlabel()) == ("That joint alone", "Load of joint 1 [N m]")


@pytest.mark.parametrize("width", [style.WIDE, style.NARROW])
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.filterwarnings("error")
def test_one_parameter_has_room_for_its_axes(width: float, count: int):
    """A scene of one parameter: a row of its own height alone left none for the axes."""
    shifts = [
        {"name": f"p{k}", "unit": "kg", "before": 1.0, "after": 2.0, "deviation_before": 0.4} for k in range(count)
    ]
    gap_figures.base_shifts(shifts, width=width).savefig(io.BytesIO(), format="png")
