"""The figures of a search for a missing effect draw what they are given."""

from __future__ import annotations

import io

import numpy as np
import pytest
from made_up_gap import make_gap
from msgspec import structs

from droid_jax.report import gap_figures, style
from droid_jax.report.gap_folder import Gap, Shift, read_gap
from droid_jax.report.text import significant


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
    """Of the base model, in both models alike; a curve over a joint's load says that it is that joint's."""
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
    """A scene of one parameter: a row of its own height alone left none for the axes."""
    shifts = [Shift(f"p{k}", "kg", 1.0, 2.0, 0.4) for k in range(count)]
    gap_figures.base_shifts(shifts, width=width).savefig(io.BytesIO(), format="png")
