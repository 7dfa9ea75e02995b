"""What a search leaves in its folder: the verdict's own numbers, readable again, and none where there are none."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from small_gap import FLOOR, JOINTS, PRELOAD, Small, small

from droid_jax.discrepancy.results import gap_arrays, gap_json, write_gap
from droid_jax.discrepancy.verdict import Conclusion, Experiment, unnamed
from droid_jax.recordings.split import ROLES
from droid_jax.report.gap_folder import read_gap
from droid_jax.report.gap_words import deviations, largest_shifts

MORE = {"seconds": {"search": 1.0}, "versions": {}, "device": "test", "setup": {"recording": []}}


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def folder(found: Small, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gap")
    write_gap(path, found.case, found.verdict, found.own, MORE)
    return path


def test_what_was_hidden_is_in_the_file(found: Small, folder: Path):
    answer = read_gap(folder).found
    assert (
        answer["verdict"] == "named"
        and answer["effects"] == ["hinge_preload at door"]
        and answer["indistinguishable"] == [[]]
    )
    (amplitude,) = answer["amplitudes"]
    assert amplitude["low"] < PRELOAD < amplitude["high"]
    assert amplitude["value"] == pytest.approx(PRELOAD, rel=0.05)
    assert (amplitude["unit"], amplitude["effect"]) == ("N m", "hinge_preload at door")
    assert "constant torque" in amplitude["what"]
    (preload,) = (e for e in found.case.effects if e.name == "hinge_preload")
    told = {"what": preload.description, "mark": preload.signature, "confused_with": list(preload.confused_with)}
    assert answer["about"] == {"hinge_preload": told} and told["mark"] and told["confused_with"]
    assert answer["p"] == pytest.approx(1 / 128)  # the smallest that eight repeats allow
    assert answer["converged"] is True and answer["floor"] == FLOOR and answer["units"] == "N m"


def test_gaps_are_the_verdicts_and_distances_those_of_the_traces(found: Small, folder: Path):
    loaded = read_gap(folder)
    assert list(loaded.found["gaps"]) == ["train", "validation"]
    for role, gap in loaded.found["gaps"].items():
        assert (gap["before"], gap["after"]) == found.verdict.discrepancies[role]
        assert gap["recording"] == role and 0.95 < gap["closed"] <= 1.01
        traces = loaded.traces[role]
        for when in ("before", "after"):
            torque = found.recordings[role].channel("torque")
            noise = np.linalg.norm(torque.values - torque.values.mean(axis=0), axis=-1).mean()
            left = np.linalg.norm(traces[when] - traces["measured"], axis=-1).mean()
            assert gap[f"torque_{when}"] == pytest.approx(np.hypot(left, noise), rel=0.25)
        assert gap["torque_after"] < gap["torque_before"]


def test_traces_have_one_shape_and_their_clock(found: Small, folder: Path):
    loaded = read_gap(folder)
    for role, traces in loaded.traces.items():
        assert traces["joints"] == list(JOINTS)
        shape = (len(traces["time"]), len(JOINTS))
        assert all(traces[name].shape == shape for name in ("measured", "scatter", "before", "after"))
        recording = found.recordings[role]
        torque = recording.channel("torque")
        assert recording.time[0] <= traces["time"][0] < traces["time"][-1] <= recording.time[-1]
        at = np.searchsorted(torque.time, traces["time"])
        raw = torque.values.mean(axis=0)[np.clip(at, 0, len(torque.time) - 1)]
        inside = slice(2, -2)  # at the ends the filter sees one side only
        assert np.sqrt(np.mean((raw - traces["measured"])[inside] ** 2)) < 0.1  # it takes noise away, no more
        assert 0.001 < np.median(traces["scatter"]) < 0.1


def replace_own(residual_set):
    """Without nuisances of the recording's own."""
    return dataclasses.replace(residual_set, nuisances=(), nuisance_columns=None)


@pytest.mark.parametrize("off", [0.15, 0.8])
def test_a_recordings_own_offset_is_no_gap_of_the_traces(found: Small, off: float):
    """A sensor that was off on the second day, in units of its prior by 1.5 and by 8: U fits that, and so do traces."""
    recording = found.recordings["validation"]
    torque = recording.channel("torque")
    shifted = dataclasses.replace(torque, values=torque.values + np.float32([0.0, off, 0.0]))
    validation = dataclasses.replace(recording, channels={**recording.channels, "torque": shifted})
    case = found.case.against({"train": found.recordings["train"], "validation": validation})
    arrays = gap_arrays(case, found.verdict)
    left = (arrays["validation.after"] - arrays["validation.measured"]).mean(axis=0)
    np.testing.assert_allclose(left, 0.0, atol=0.02)
    values = found.verdict.model.values
    assert case.validation.discrepancy_at(values) == pytest.approx(
        found.case.validation.discrepancy_at(values), abs=0.05
    )
    assert replace_own(case.validation).discrepancy_at(values) > 1.0  # the offset is no small thing
    before = gap_json(found.case, found.verdict)["gaps"]["validation"]["torque_after"]
    assert gap_json(case, found.verdict)["gaps"]["validation"]["torque_after"] == pytest.approx(before, rel=0.05)


def test_joints_keep_one_order_whatever_the_recordings_have(found: Small):
    """A recording whose channels come in another order ends up in the order of the first."""
    case = found.case
    channel = case.validation.cost.comparisons[0].channels[0]
    order = [2, 0, 1]
    turned = dataclasses.replace(
        channel,
        columns=channel.columns[order],
        noise=dataclasses.replace(
            channel.noise, mean=channel.noise.mean[:, order], repeats=channel.noise.repeats[:, :, order]
        ),
    )
    comparison = dataclasses.replace(case.validation.cost.comparisons[0], channels=(turned,))

    class Turned:
        comparisons = (comparison,)
        scene, space = case.validation.cost.scene, case.validation.cost.space
        whitened = staticmethod(case.validation.cost.whitened)

        def smoothed(self, values):
            return tuple(s[:, :, order] for s in case.validation.cost.smoothed(values))

    other = dataclasses.replace(case, validation=dataclasses.replace(case.validation, cost=Turned()))
    plain, again = gap_arrays(case, found.verdict), gap_arrays(other, found.verdict)
    for key in plain:
        if key == "joints":
            np.testing.assert_array_equal(plain[key], again[key])
        else:
            np.testing.assert_allclose(plain[key], again[key], rtol=1e-9)


def test_grounds_are_all_there(found: Small, folder: Path):
    answer = read_gap(folder).found
    first = answer["screens"][0]["ranking"]
    assert first[0]["candidate"] == "hinge_preload at door"
    assert len({r["candidate"] for r in first}) == len(first) == 3
    assert [r["explained"] for r in first] == sorted((r["explained"] for r in first), reverse=True)
    assert [t["name"] for t in answer["trials"]] == [t.name for t in found.verdict.validation_tests]
    assert all(t["round"] == 0 and t["passed"] == (not t["reasons"]) for t in answer["trials"])
    (interval,) = answer["trials"][0]["interval"].values()
    assert interval[0] < interval[1]
    where = [c for c in answer["cells"]["before"] if c["variable"] == "joint x phase"]
    assert len(where) == 6 and [c["found"] for c in where if c["where"].startswith("door")] == [True, True]
    assert answer["phases"]["train"][1] == {"name": "second", "start": 1.5, "end": pytest.approx(2.998)}


def test_shifts_are_in_deviations_of_the_base_fit(folder: Path):
    answer = read_gap(folder).found
    names = ["forearm_mass", "door_damping", "door_stiffness", "torque_offset[elbow]"]
    assert [s["name"] for s in answer["shifts"]] == names
    assert all(s["deviation_before"] > 0 for s in answer["shifts"])
    most = largest_shifts(answer["shifts"])[0]
    assert most["name"] == "door_stiffness" and abs(deviations(most)) > 1  # a spring had stood in for the preload
    wound = PRELOAD / 5  # N m/rad, what the hidden spring has that a preload has not
    truth = {"door_stiffness": 0.7 + wound, "forearm_mass": 0.9, "door_damping": 0.6}
    for shift in answer["shifts"][:3]:
        assert shift["after"] == pytest.approx(truth[shift["name"]], rel=0.15)


def test_the_report_reads_it(folder: Path):
    assert read_gap(folder).roles == ["train", "validation"]


def test_ties_experiments_and_cuts_come_along(found: Small):
    verdict = dataclasses.replace(
        found.verdict, kind=Conclusion.INDISTINGUISHABLE, indistinguishable=(("drag at door",),),
        experiments=(Experiment("open further", 7.5),),
        not_tried="two candidates were not tried",
    )  # fmt: skip
    answer = gap_json(found.case, verdict)
    assert set(answer["about"]) == {"hinge_preload", "drag"}
    assert answer["indistinguishable"] == [["drag at door"]] and answer["cut"] == "two candidates were not tried"
    assert answer["experiments"] == [{"what": "open further", "distance": 7.5, "not_made": ""}]


def test_hints_and_the_threshold_that_made_them_are_in_the_file(found: Small):
    hinted = unnamed(found.case, dataclasses.replace(found.verdict, indistinguishable=(("drag at door",),)))
    answer = gap_json(found.case, hinted)
    closed = {"validation": found.verdict.closed("validation")}
    assert answer["hints"] == [
        {"effects": ("hinge_preload at door",), "indistinguishable": (("drag at door",),), "closed": closed}
    ]
    assert answer["thresholds"] == {"least_closed": found.case.config.minimum_closed}
    assert answer["verdict"] == "unexplained" and answer["effects"] == [] and answer["explained"] is None
    assert set(answer["about"]) == {"hinge_preload", "drag"}
    assert all(gap["closed"] == 0.0 and gap["before"] == gap["after"] for gap in answer["gaps"].values())


def test_shapes_come_once_with_their_intervals(found: Small):
    """An effect's shape is one at all its places; a nuisance plays one here."""
    name, (part,) = "torque_offset[elbow]", found.verdict.model.parts
    shaped = dataclasses.replace(part, shape_parameters={name: 0.0})
    twice = (shaped, dataclasses.replace(shaped, location="elsewhere", coefficients=()))
    model = dataclasses.replace(found.verdict.model, parts=twice)
    answer = gap_json(found.case, dataclasses.replace(found.verdict, model=model))
    assert [a["name"] for a in answer["amplitudes"]] == list(part.coefficients)
    (shape,) = answer["shapes"]
    assert (shape["name"], shape["unit"], shape["effect"]) == (name, "N m", part.name)
    assert shape["low"] < shape["value"] == model.values[found.case.full_space.index(name)] < shape["high"]


def test_where_nothing_was_asked_or_found_there_are_no_numbers(found: Small):
    """An unconverged fit, and a gap below the floor: null, never a made-up share."""
    nothing = dataclasses.replace(
        found.verdict, kind=Conclusion.UNCONVERGED, effects=(), indistinguishable=(), model=found.base,
        score_tests=(), validation_tests=(), discretisation_error=1e4,
        discrepancies={role: (e.discrepancy_at(found.base.values),) * 2 for role, e in found.case.held_sets.items()},
    )  # fmt: skip
    answer = json.loads(json.dumps(gap_json(found.case, nothing), allow_nan=False))
    assert (
        answer["about"] == {}
        and answer["p"] is None
        and answer["screens"] == answer["trials"] == answer["amplitudes"] == []
    )
    assert all(gap["closed"] is None for gap in answer["gaps"].values())
    assert all(s["before"] == s["after"] for s in answer["shifts"])


def test_the_sealed_recording_is_a_role_like_the_others(found: Small):
    case = dataclasses.replace(found.case, test=found.case.validation)
    gaps = {**found.verdict.discrepancies, "test": found.verdict.discrepancies["validation"]}
    verdict = dataclasses.replace(found.verdict, discrepancies=gaps)
    answer, arrays = gap_json(case, verdict), gap_arrays(case, verdict)
    assert tuple(answer["gaps"]) == tuple(answer["phases"]) == ROLES
    np.testing.assert_array_equal(arrays["test.after"], arrays["validation.after"])


def test_it_is_written_whole_or_not_at_all(found: Small, tmp_path: Path):
    """gap.json comes last: where writing fails before it, no run looks finished."""
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_gap(tmp_path, found.case, found.verdict, found.own, {"seconds": float("nan")})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["extended.json", "extended.xml", "gap.npz"]
