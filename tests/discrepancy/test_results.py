"""Files of a search: the numbers of the verdict, and null for those that were not computed."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_gap import FLOOR, JOINTS, PRELOAD, Small, small

from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.results import FORMAT, VERSION, _reached, gap_arrays, gap_json, write_gap
from droid_jax.discrepancy.verdict import Conclusion, Experiment, unnamed
from droid_jax.files import GAP, GAP_TRACES
from droid_jax.model.effects.candidate import EffectKey
from droid_jax.model.parameters import Parameter
from droid_jax.recordings.split import ROLES
from droid_jax.report.gap_folder import largest_shifts, read_gap

MORE = {"seconds": {"search": 1.0}, "versions": {}, "device": "test", "setup": {"recording": []}}
PRELOAD_ENTRY = {"effect": "hinge_preload", "location": "door"}
DRAG_ENTRY = {"effect": "drag", "location": "door"}
DRAG = EffectKey("drag", "door")


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def folder(found: Small, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gap")
    write_gap(path, found.case, found.verdict, found.own, MORE)
    return path


@pytest.fixture(scope="module")
def answer(folder: Path) -> dict[str, Any]:
    return json.loads((folder / GAP).read_text())


@pytest.fixture(scope="module")
def arrays(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / GAP_TRACES) as file:
        return dict(file)


def test_the_hidden_effect_is_in_the_file(found: Small, answer: dict[str, Any]):
    assert (answer["format"], answer["version"]) == (FORMAT, VERSION)
    assert answer["verdict"] == Conclusion.NAMED.value
    assert answer["effects"] == [PRELOAD_ENTRY] and answer["indistinguishable"] == [[]]
    (coefficient,) = answer["coefficients"]
    assert coefficient["low"] < PRELOAD < coefficient["high"]
    assert coefficient["value"] == pytest.approx(PRELOAD, rel=0.05)
    assert PRELOAD_ENTRY.items() <= coefficient.items() and coefficient["unit"] == "N m"
    (preload,) = (e for e in found.case.effects if e.name == "hinge_preload")
    assert coefficient["what"] == preload.description
    about = {
        "what": preload.description, "signature": preload.signature, "confused_with": list(preload.confused_with)
    }  # fmt: skip
    assert answer["about"] == {"hinge_preload": about} and about["signature"] and about["confused_with"]
    assert answer["p"] == pytest.approx(1 / 128)  # the smallest that eight repeats allow
    assert answer["converged"] is True and answer["discretisation_error"] == FLOOR and answer["units"] == "N m"
    assert MORE.items() <= answer.items()


def test_discrepancies_are_those_of_the_verdict_and_distances_those_of_the_traces(
    found: Small, answer: dict[str, Any], arrays: dict[str, np.ndarray]
):
    assert list(answer["discrepancies"]) == ["train", "validation"]
    for role, entry in answer["discrepancies"].items():
        assert (entry["before"], entry["after"]) == found.verdict.discrepancies[role]
        assert entry["recording"] == role and 0.95 < entry["closed"] <= 1.01
        for when in ("before", "after"):
            torque = found.recordings[role].channel("torque")
            noise = np.linalg.norm(torque.values - torque.values.mean(axis=0), axis=-1).mean()
            left = np.linalg.norm(arrays[f"{role}.{when}"] - arrays[f"{role}.measured"], axis=-1).mean()
            assert entry[f"torque_{when}"] == pytest.approx(np.hypot(left, noise), rel=0.25)
        assert entry["torque_after"] < entry["torque_before"]


def test_traces_have_one_shape_and_a_clock(found: Small, arrays: dict[str, np.ndarray]):
    assert arrays["joints"].tolist() == list(JOINTS)
    for role, recording in found.recordings.items():
        traces = {name: arrays[f"{role}.{name}"] for name in ("time", "measured", "scatter", "before", "after")}
        shape = (len(traces["time"]), len(JOINTS))
        assert all(traces[name].shape == shape for name in ("measured", "scatter", "before", "after"))
        torque = recording.channel("torque")
        assert recording.time[0] <= traces["time"][0] < traces["time"][-1] <= recording.time[-1]
        at = np.searchsorted(torque.time, traces["time"])
        raw = torque.values.mean(axis=0)[np.clip(at, 0, len(torque.time) - 1)]
        inside = slice(2, -2)  # at the ends the filter sees one side only
        assert np.sqrt(np.mean((raw - traces["measured"])[inside] ** 2)) < 0.1  # it takes noise away, no more
        assert 0.001 < np.median(traces["scatter"]) < 0.1


def without_nuisances(residual_set: ResidualSet) -> ResidualSet:
    """The residual set without per-recording nuisances."""
    return dataclasses.replace(residual_set, nuisances=(), nuisance_columns=None)


@pytest.mark.parametrize("off", [0.15, 0.8])
def test_a_torque_offset_of_one_recording_is_no_discrepancy_of_the_traces(found: Small, off: float):
    """U and the traces have a fitted torque offset of the second recording, of 1.5 or 8 prior deviations."""
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
    assert without_nuisances(case.validation).discrepancy_at(values) > 1.0  # the offset is no small thing
    before = gap_json(found.case, found.verdict)["discrepancies"]["validation"]["torque_after"]
    assert gap_json(case, found.verdict)["discrepancies"]["validation"]["torque_after"] == pytest.approx(
        before, rel=0.05
    )


def test_joints_have_the_order_of_the_first_recording(found: Small):
    """The columns of another recording are in another order."""
    case = found.case
    channel = case.validation.comparison.channels[0]
    order = [2, 0, 1]
    turned = dataclasses.replace(
        channel,
        columns=channel.columns[order],
        noise=dataclasses.replace(
            channel.noise, mean=channel.noise.mean[:, order], repeats=channel.noise.repeats[:, :, order]
        ),
    )
    comparison = dataclasses.replace(case.validation.comparison, channels=(turned,))

    class Turned:
        comparisons = (comparison,)
        scene, space = case.validation.cost.scene, case.validation.cost.space

        def smoothed(self, values):
            return tuple(s[:, :, order] for s in case.validation.cost.smoothed(values))

    cost: Any = Turned()
    other = dataclasses.replace(case, validation=dataclasses.replace(case.validation, cost=cost))
    plain, again = gap_arrays(case, found.verdict), gap_arrays(other, found.verdict)
    for key in plain:
        if key == "joints":
            np.testing.assert_array_equal(plain[key], again[key])
        else:
            np.testing.assert_allclose(plain[key], again[key], rtol=1e-9)


def test_all_tests_are_in_the_file(found: Small, answer: dict[str, Any]):
    first = answer["score_tests"][0]["ranking"]
    assert PRELOAD_ENTRY.items() <= first[0].items()
    assert len({(r["effect"], r["location"]) for r in first}) == len(first) == 3
    assert [r["explained"] for r in first] == sorted((r["explained"] for r in first), reverse=True)
    tests = found.verdict.validation_tests
    for entry, test in zip(answer["validation_tests"], tests, strict=True):
        assert entry["parts"] == [{"effect": k.effect, "location": k.location} for k in test.keys]
        assert entry["parts_before"] == test.before == 0
        assert entry["passed"] == test.passed == (not entry["reasons"])
        assert [(r["reason"], r["text"]) for r in entry["reasons"]] == [(r.reason.value, r.text) for r in test.reasons]
        assert entry["discrepancy_validation"] == test.discrepancy_validation
        assert list(entry["interval"]) == list(test.interval)
    (interval,) = answer["validation_tests"][0]["interval"].values()
    assert interval[0] < interval[1]
    assert answer["phases"]["train"][1] == {"name": "second", "start": 1.5, "end": pytest.approx(2.998)}


def test_cells_are_those_of_the_verdict(found: Small, answer: dict[str, Any]):
    for when, cells in (("before", found.verdict.before), ("after", found.verdict.after)):
        for entry, cell in zip(answer["cells"][when], cells, strict=True):
            key = cell.key
            assert entry == {
                "axis": key.axis.value, "joint": key.joint, "label": key.label, "low": key.low, "high": key.high,
                "unit": key.unit, "discrepancy": cell.discrepancy, "p": cell.p, "found": cell.found,
            }  # fmt: skip


def test_trends_are_those_of_the_verdict(found: Small, answer: dict[str, Any]):
    trend, (entry,) = found.verdict.trend, answer["trends"]
    assert trend is not None
    assert (entry["effect"], entry["location"]) == (trend.key.effect, trend.key.location)
    assert (entry["coefficient"], entry["per_repeat"], entry["p"]) == (trend.coefficient, trend.per_repeat, trend.p)
    assert entry["unit"] == found.case.full_space[trend.coefficient].unit


def test_shifts_are_in_deviations_of_the_base_fit(answer: dict[str, Any]):
    names = ["forearm_mass", "door_damping", "door_stiffness", "torque_offset[elbow]"]
    shifts = {shift["name"]: shift for shift in answer["shifts"]}
    assert list(shifts) == names and all(s["deviation_before"] > 0 for s in shifts.values())
    moved = {name: (s["after"] - s["before"]) / s["deviation_before"] for name, s in shifts.items()}
    most = max(moved, key=lambda name: abs(moved[name]))
    assert most == "door_stiffness" and abs(moved[most]) > 1  # a spring had served as the preload
    wound = PRELOAD / 5  # N m/rad, what the hidden spring has that a preload has not
    truth = {"door_stiffness": 0.7 + wound, "forearm_mass": 0.9, "door_damping": 0.6}
    for name, value in truth.items():
        assert shifts[name]["after"] == pytest.approx(value, rel=0.15)


def test_the_report_reads_the_file(folder: Path):
    gap = read_gap(folder)
    assert gap.roles == ["train", "validation"]
    assert largest_shifts(gap.found.shifts)[0].name == "door_stiffness"


def test_alternatives_experiments_and_skipped_fits_are_in_the_file(found: Small):
    verdict = dataclasses.replace(
        found.verdict, conclusion=Conclusion.INDISTINGUISHABLE,
        indistinguishable=(((DRAG,), (DRAG, EffectKey("payload", "elbow"))),),
        experiments=(Experiment("open further", 7.5),),
        not_tried=("two candidates were not tried", "pairs of effects not tried"),
        ruled_out=("closer at hinge",),
    )  # fmt: skip
    answer = gap_json(found.case, verdict)
    assert set(answer["about"]) == {"hinge_preload", "drag", "payload"}
    payload = {"effect": "payload", "location": "elbow"}
    assert answer["indistinguishable"] == [[[DRAG_ENTRY], [DRAG_ENTRY, payload]]]
    assert answer["not_tried"] == "; ".join(verdict.not_tried)
    assert answer["ruled_out"] == ["closer at hinge"]
    assert answer["experiments"] == [{"what": "open further", "distance": 7.5, "not_made": ""}]


def test_hints_are_in_the_file(found: Small):
    hinted = unnamed(found.case, dataclasses.replace(found.verdict, indistinguishable=(((DRAG,),),)))
    answer = gap_json(found.case, hinted)
    closed = {"validation": found.verdict.closed("validation")}
    assert answer["hints"] == [{"effects": [PRELOAD_ENTRY], "indistinguishable": [[[DRAG_ENTRY]]], "closed": closed}]
    assert answer["verdict"] == Conclusion.UNEXPLAINED.value
    assert answer["effects"] == [] and answer["explained"] is None
    assert set(answer["about"]) == {"hinge_preload", "drag"}
    assert all(each["closed"] == 0.0 and each["before"] == each["after"] for each in answer["discrepancies"].values())


def test_every_threshold_is_in_the_file(found: Small, answer: dict[str, Any]):
    """So are the settings of the search and of its blocks."""
    config = found.case.config
    assert set(answer["config"]) == {f.name for f in dataclasses.fields(DiscrepancyConfig)}
    for name in ("selection", "blocks"):
        assert answer["config"][name] == dataclasses.asdict(getattr(config, name))
    assert answer["config"]["max_effects"] == config.max_effects
    assert answer["config"]["refit"]["iterations"] == config.refit.iterations
    selection = dataclasses.replace(found.case.config.selection, minimum_closed=0.3, significance=0.02)
    other = dataclasses.replace(found.case, config=dataclasses.replace(found.case.config, selection=selection))
    written = gap_json(other, found.verdict)["config"]["selection"]
    assert (written["minimum_closed"], written["significance"]) == (0.3, 0.02)


def test_shape_parameters_are_listed_once_with_their_intervals(found: Small):
    """All locations of an effect share a shape parameter; a nuisance serves as one here."""
    name, (part,) = "torque_offset[elbow]", found.verdict.model.parts
    shaped = dataclasses.replace(part, shape_parameters={name: 0.0})
    twice = (shaped, dataclasses.replace(shaped, location="elsewhere", coefficients=()))
    model = dataclasses.replace(found.verdict.model, parts=twice)
    answer = gap_json(found.case, dataclasses.replace(found.verdict, model=model))
    assert [a["name"] for a in answer["coefficients"]] == list(part.coefficients)
    (shape,) = answer["shape_parameters"]
    assert (shape["name"], shape["unit"]) == (name, "N m") and PRELOAD_ENTRY.items() <= shape.items()
    assert shape["low"] < shape["value"] == model.values[found.case.full_space.index(name)] < shape["high"]


def test_numbers_that_were_not_computed_are_null(found: Small):
    """A fit that did not converge, and a discrepancy below the discretisation error."""
    nothing = dataclasses.replace(
        found.verdict, conclusion=Conclusion.UNCONVERGED, effects=(), indistinguishable=(), model=found.base,
        score_tests=(), validation_tests=(), discretisation_error=1e4, trend=None,
        discrepancies={
            role: (e.discrepancy_at(found.base.values),) * 2 for role, e in found.case.residual_sets.items()
        },
    )  # fmt: skip
    answer = json.loads(json.dumps(gap_json(found.case, nothing), allow_nan=False))
    assert answer["about"] == {} and answer["p"] is None
    assert all(answer[name] == [] for name in ("score_tests", "validation_tests", "coefficients", "trends"))
    assert all(each["closed"] is None for each in answer["discrepancies"].values())
    assert all(s["before"] == s["after"] for s in answer["shifts"])


def test_the_test_recording_is_a_role_like_the_others(found: Small):
    case = dataclasses.replace(found.case, test=found.case.validation)
    discrepancies = {**found.verdict.discrepancies, "test": found.verdict.discrepancies["validation"]}
    verdict = dataclasses.replace(found.verdict, discrepancies=discrepancies)
    answer, arrays = gap_json(case, verdict), gap_arrays(case, verdict)
    assert tuple(answer["discrepancies"]) == tuple(answer["phases"]) == ROLES
    np.testing.assert_array_equal(arrays["test.after"], arrays["validation.after"])


def test_gap_json_is_written_last(found: Small, tmp_path: Path):
    """If writing an earlier file fails, the run does not look finished."""
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_gap(tmp_path, found.case, found.verdict, found.own, {"seconds": float("nan")})
    written = ["apply_fit.py", "extended.json", "extended.xml", "fitted.json", "gap.npz", "mjlab_terms.py"]
    assert sorted(p.name for p in tmp_path.iterdir() if p.suffix != ".patch") == written


def test_a_value_near_a_bound_is_at_it_if_its_interval_reaches_it():
    """Dry friction of 0.0496 N m in a range up to 5 was reported at its lower bound, far outside its interval."""
    p = Parameter("friction", "N m", 0.0, 0.3, 0.0, 5.0)
    assert _reached(p, 0.0496, (0.0465, 0.0526), "lower") == ""
    assert _reached(p, 0.0496, (0.0, 0.1), "lower") == _reached(p, 0.0, (0.003, 0.1), "lower") == "lower"
    assert _reached(p, 4.98, (4.9, 5.0), "upper") == _reached(p, 5.0, (4.9, 4.99), "upper") == "upper"
    assert _reached(p, 2.0, (1.0, 3.0), "") == ""
