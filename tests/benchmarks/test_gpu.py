"""The GPU script's bookkeeping, and the scenes and the figure of the scaling script; nothing is timed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import gpu, scaling


def test_a_part_keeps_what_it_has_and_leaves_out_what_there_is_no_time_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr(gpu.time, "time", lambda: clock[0])
    monkeypatch.setattr(gpu.time, "monotonic", lambda: clock[0])
    now = gpu.Measuring(gpu.Arguments(part="jax", kept=tmp_path / "kept.json", until=100.0 + gpu.LEAVING + 50.0))
    done = []
    for item in now.while_there_is_time([1, 2, 3, 4]):
        done.append(item)
        clock[0] += 20.0
        now.keep(done=list(done))
    assert done == [1, 2]  # 10 s are left, and one takes 20
    assert json.loads((tmp_path / "kept.json").read_text()) == {"done": [1, 2], "no_time_for": [3, 4]}


def test_what_was_not_measured_is_none_and_errors_are_named() -> None:
    parts = {"c": {"steps_per_s": 2e6, "cores": 16}, "jax": {"steps_per_s": 5e7}, "gap": {"error": "stopped after 9 s"}}
    line = gpu.headline(parts)
    assert line["ratio_to_c"] == 25.0 and line["c_cores"] == 16
    assert line["warp_ratio_to_c"] is None and line["fit_after_compilation_s"] is None
    assert line["errors"] == {"gap": "stopped after 9 s"}


def test_a_search_that_was_cut_short_gives_no_time_of_a_whole_one() -> None:
    fit = {"after_compilation_s": 3.0, "generation_s": 0.1, "whole": False}
    line = gpu.headline({"fit": fit})
    assert line["fit_after_compilation_s"] is None and line["fit_generation_s"] == 0.1


def test_other_parts_and_axes_are_refused() -> None:
    with pytest.raises(SystemExit, match="there is no part tpu; there are c, jax"):
        gpu.Arguments(only=("c", "tpu"))
    with pytest.raises(SystemExit, match="there is no axis speed"):
        scaling.Arguments(only=("speed",))


@pytest.mark.parametrize("joints", [1, 3])
def test_the_chain_has_so_many_joints_and_begins_at_rest(joints: int) -> None:
    scene, space, (recording,), effects = scaling._chain({**scaling.BASE, "joints": joints, "duration": 0.3})
    assert len(scene.joints) == joints and len(space) == joints + 1 and effects == ()
    assert recording.channel("torque").values.shape[2] == joints
    assert abs(recording.command[:2]).max() < 1e-5


def test_the_figure_has_a_column_for_each_axis_that_was_measured() -> None:
    points = [
        {"axis": axis, axis: value, "seconds": 1.0 + value, "gib": 0.5}
        for axis in ("population", "joints") for value in (1, 2)
    ]  # fmt: skip
    drawn = scaling.figure([*points, {"axis": "effects", "effects": 1, "error": "not done"}])
    assert [plot.get_xlabel() for plot in drawn.axes[2:]] == ["samples", "joints of a chain"]
    assert drawn.axes[0].lines[0].get_ydata().tolist() == [2.0, 3.0]
