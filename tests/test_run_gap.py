"""The command `gap`: bad input ends in one sentence, a stopped run can be continued, and its folder is complete."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import EFFECTS, FLOOR, JOINTS, PRELOAD, QUICK, SCENE, record, small, small_scene, write_parameters

from droid_jax.commands import gap
from droid_jax.commands.synthetic import hidden_effects, record_synthetic
from droid_jax.discrepancy import fitting, log_case, missing, results
from droid_jax.discrepancy.verdict import Experiment
from droid_jax.door.scene import door_scene
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import registry
from droid_jax.model.parameters import Parameter, Scaling
from droid_jax.preflight.search_inputs import check_recordings, lags
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.report import page
from droid_jax.report.gap_folder import read_gap
from droid_jax.run import main

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.usefixtures("tuned")


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with parameters.json, train.npz and validation.npz."""
    write_parameters(tmp_path)
    for name in ("train", "validation"):
        save_recording(record(name), tmp_path / f"{name}.npz")
    return tmp_path


def arguments(
    place: Path, *options: str | Path, recordings: tuple[str, ...] = ("train.npz", "validation.npz")
) -> list[str]:
    """A whole command line in the small scene."""
    files = [place / name for name in recordings]
    own = ("--scene", SCENE, "--parameters", place / "parameters.json", "--object-joint", "door")
    own = (*own, "--joint-friction", "scene")  # what was recorded is the scene's own model in plain C
    return [str(a) for a in ("gap", "--recording", *files, *own, "--out", place / "run", *options)]


def changed(recording: Recording, name: str, function: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """A recording with other values [N, Tc, C] in one channel."""
    channel = recording.channels[name]
    values = function(channel.values.astype(float)).astype(np.float32)
    return replace(recording, channels={**recording.channels, name: replace(channel, values=values)})


# ----- recordings


def test_four_recordings_are_pooled_once_each(place: Path, refused):
    said = refused(*arguments(place, recordings=("train.npz", "validation.npz", "train.npz", "validation.npz")))
    assert "the train and the train 3 recording are the same ('train')" in said


def test_too_few_repeats_say_what_can_still_be_concluded(place: Path, refused):
    for name in ("train", "validation"):  # with positions they are searched by windows
        few = record(name).repeats_subset(range(5))
        torques = {key: channel for key, channel in few.channels.items() if key != "position"}
        save_recording(replace(few, channels=torques), place / f"{name}.npz")
    said = refused(*arguments(place))
    assert "the train recording 'train' has 5 repeats" in said and "fewer than 8" in said
    assert "droid_jax.run identify" in said and "in which joint and phase" in said


def test_the_same_recording_twice(place: Path, refused):
    said = refused(*arguments(place, recordings=("train.npz", "train.npz")))
    assert "the train and the validation recording are the same" in said and "another motion" in said


def test_two_recordings_of_one_name(place: Path, refused):
    other = place / "day2"
    other.mkdir()
    save_recording(replace(record("validation"), name="train"), other / "train.npz")
    said = refused(*arguments(place, recordings=("train.npz", "day2/train.npz")))
    assert "the train and the validation recording have one name, 'train'" in said


def test_the_sealed_recording_once_more(place: Path, refused):
    said = refused(*arguments(place, recordings=("train.npz", "validation.npz", "validation.npz")))
    assert "the validation and the test recording are the same" in said


def test_a_repeat_that_runs_late(place: Path, refused):
    def late(values: np.ndarray) -> np.ndarray:
        values[3] = np.roll(values[3], 75, axis=0)  # 500 Hz
        values[3, :75] = values[3, 75]
        return values

    save_recording(changed(record("validation"), "position", late), place / "validation.npz")
    said = refused(*arguments(place))
    assert "the validation recording 'validation': repeat 3 runs 0.1" in said and "behind the others" in said


def test_repeats_with_clocks_of_their_own(place: Path, refused):
    save_recording(record("validation"), place / "csv")
    path = place / "csv" / "torque_02.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-20]))
    said = refused(*arguments(place, recordings=("train.npz", "csv")))
    assert "torque_02.csv: repeat 2 has another clock than repeat 0" in said


def test_a_robot_that_never_moves(place: Path, refused):
    still = changed(record("train"), "position", lambda v: v[:, :1] + 1e-4 * np.sin(np.arange(v.shape[1]))[:, None])
    save_recording(still, place / "train.npz")
    said = refused(*arguments(place))
    assert "the train recording 'train' never moves" in said and "0.0002" in said


def test_a_door_that_never_opens(place: Path, refused):
    save_recording(changed(record("validation"), "object_angle", lambda v: 0.02 * v), place / "validation.npz")
    said = refused(*arguments(place))
    assert "the object joint 'door' moves by 0.0" in said and "record a motion that opens it" in said


def test_one_repeat_that_missed_its_grasp(place: Path, refused):
    def missed(values: np.ndarray) -> np.ndarray:
        values[4] *= 0.1
        return values

    save_recording(changed(record("validation"), "object_angle", missed), place / "validation.npz")
    said = refused(*arguments(place))
    assert "in repeat 4 the object joint 'door' moves by 0.0" in said and "leave that repeat away" in said


@pytest.mark.parametrize(
    ("turned", "said"), [(lambda v: 0.02 * v, "moves by 0.0"), (lambda v: v, "in repeat 4 the object joint 'door'")]
)
def test_an_angle_that_one_repeat_did_not_measure_hides_no_other_fault(place: Path, refused, turned, said: str):
    recording = record("validation")
    position = recording.channels["position"]
    mask = position.mask.copy()
    mask[1, :, position.columns.index("door")] = False
    values = position.values.copy()
    values[..., position.columns.index("door")] = turned(values[..., position.columns.index("door")])
    values[4, :, position.columns.index("door")] *= 0.1
    channels = {"torque": recording.channels["torque"], "position": replace(position, values=values, mask=mask)}
    save_recording(replace(recording, channels=channels), place / "validation.npz")
    assert said in refused(*arguments(place))


def test_a_sensor_that_is_dead_in_one_repeat(place: Path, refused):
    def dead(values: np.ndarray) -> np.ndarray:
        values[2, :, 1] = 0.25
        return values

    save_recording(changed(record("train"), "torque", dead), place / "train.npz")
    said = refused(*arguments(place))
    assert "never changes in repeat 2 (0.25 N m)" in said and "leave that repeat out" in said


def test_a_dead_sensor(place: Path, refused):
    def dead(values: np.ndarray) -> np.ndarray:
        values[..., 1] = 1.5
        return values

    save_recording(changed(record("train"), "torque", dead), place / "train.npz")
    said = refused(*arguments(place, "--effects", "hinge_preload"))
    assert "channel 'torque', column 'elbow' never changes (1.5 N m)" in said


def test_recordings_of_different_joints(place: Path, refused):
    recording = record("validation")
    torque = recording.channels["torque"]
    fewer = replace(torque, columns=JOINTS[:2], values=torque.values[..., :2], mask=torque.mask[..., :2])
    save_recording(replace(recording, channels={**recording.channels, "torque": fewer}), place / "validation.npz")
    said = refused(*arguments(place))
    assert "different joints" in said and "train shoulder, elbow, door; validation shoulder, elbow" in said


def test_good_recordings_are_not_refused():
    scene, _ = small_scene()
    roles = {name: record(name) for name in ("train", "validation")}
    check_recordings(replace(scene, object_joint="door"), roles)


def test_a_hinge_that_opens_downwards_is_refused():
    """Half of the library would have no effect on it, without a message."""
    scene, recording = replace(small_scene()[0], object_joint="door"), record("train")
    angle = recording.channels["object_angle"]
    turned = replace(recording, channels={**recording.channels, "object_angle": replace(angle, values=-angle.values)})
    with pytest.raises(ValueError, match=r"'door' opens towards negative angles .* turn the joint's axis and range"):
        check_recordings(scene, {"train": turned, "validation": record("validation")})


def test_lags_are_measured_in_seconds():
    time = np.arange(0.0, 5.0, 0.01)
    delays = np.array([0.0, 0.0, 0.03, -0.02, 0.0])
    values = np.stack([np.sin(1.3 * (time - d)) for d in delays])[..., None]
    channel = Channel("position", "rad", ("a",), time, values, np.ones(values.shape, bool))
    np.testing.assert_allclose(lags(channel), delays, atol=1e-3)
    masked = channel.mask.copy()
    masked[2, 100:200] = False
    with_gap = replace(channel, mask=masked, values=np.where(masked, values, np.nan))
    np.testing.assert_allclose(lags(with_gap)[2], 0.03, atol=0.01)
    alternating = np.zeros((5, len(time), 2), bool)
    alternating[:, ::2, 0] = alternating[:, 1::2, 1] = True
    with pytest.raises(ValueError, match="no two instants at which every column was measured"):
        lags(replace(channel, columns=("a", "b"), values=np.repeat(values, 2, axis=2), mask=alternating))


# ----- effects and options


@pytest.mark.parametrize("option", ["--effects", "--without"])
def test_unknuser_effects_list_the_valid_ones(place: Path, refused, option: str):
    said = refused(*arguments(place, option, "gravity_waves"))
    assert "unknown effects gravity_waves; valid: " in said and "hinge_preload" in said


def test_an_effect_that_the_scene_cannot_have(place: Path, refused):
    said = refused(*arguments(place, "--effects", "contact_compliance", "payload"))
    assert "cannot have contact_compliance" in said and "payload" in said.split("it can have:")[1]


def test_no_effect_left(place: Path, refused):
    said = refused(*arguments(place, "--effects", "payload", "--without", "payload"))
    assert "is left without any effect" in said


def test_effects_are_restricted_and_left_out():
    scene = door_scene()
    everything = gap.chosen_effects(gap.GapCommand(), scene, [])
    assert {e.name for e in everything} == {e.name for e in registry.library(scene)}
    fewer = gap.chosen_effects(gap.GapCommand(without=("latch", "payload")), scene, [])
    assert {e.name for e in everything} - {e.name for e in fewer} == {"latch", "payload"}
    chosen = gap.chosen_effects(gap.GapCommand(effects=("latch", "drag"), without=("drag",)), scene, [])
    assert [e.name for e in chosen] == ["latch"]


def test_effects_of_a_larger_machine():
    (usual,), (large,) = (
        gap.chosen_effects(gap.GapCommand(effects=("joint_coulomb",), effect_scale=k), door_scene(), [])
        for k in (1.0, 20.0)
    )
    assert [p.high for p in large.parameters] == [20.0 * p.high for p in usual.parameters]
    with pytest.raises(ValueError, match="the scale of the effects must be above 0, got -1"):
        gap.chosen_effects(gap.GapCommand(effect_scale=-1.0), door_scene(), [])


def test_a_log_without_commands_has_no_servo_to_suspect():
    scene = door_scene()
    log = replace(record("train"), time=np.zeros(0), command=np.zeros((0, 0)), command_names=())
    names = {e.name for e in gap.chosen_effects(gap.GapCommand(), scene, [log])}
    assert "torque_bias" in names and not names & {"command_delay", "joint_backlash", "joint_compliance"}
    with pytest.raises(ValueError, match="cannot have command_delay"):
        gap.chosen_effects(gap.GapCommand(effects=("command_delay",)), scene, [log])


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: Parameter("gasket", "N m", 0.0, 0.5, 0.1, 5.0), "parameter 'gasket': the start 0.0 N m lies outside"),
        (lambda: Parameter("gasket", "N m", 0.5, 0.5, 0.1, 5.0), "neutral at 0, but 'gasket' starts at 0.5 N m"),
        (
            lambda: Parameter("gasket", "N m", 0.0, 0.5, 0.0, 5.0, scaling=Scaling.LOG, log_offset=0.05),
            "'gasket' must be scaled linearly",
        ),
        (lambda: Parameter("seal", "N m", 0.0, 0.5, 0.0, 5.0), "names a parameter 'gasket' that it does not have"),
    ],
)
def test_an_effect_that_cannot_be_neutral(
    place: Path, refused, monkeypatch: pytest.MonkeyPatch, make: Callable[[], Parameter], expected: str
):
    registry.registered()  # those of the library, which are registered once in a process
    monkeypatch.setattr(registry, "_MAKERS", dict(registry._MAKERS))

    @registry.register
    def gasket(scene):
        return Effect("gasket", (make(),), force=lambda theta, state: state.qvel, locations={"door": ("gasket",)})

    assert expected in refused(*arguments(place, "--effects", "gasket"))


def test_no_time_is_no_budget(place: Path, refused):
    assert "--budget must be above 0 minutes, got 0" in refused(*arguments(place, "--budget", "0"))


# ----- the synthetic robot


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--hide", "closer"], "--hide takes name=amplitude"),
        (["--hide", "closer=much"], "got 'closer=much'. There are: hinge_preload"),
        (["--hide", "poltergeist=1"], "unknown hidden effect 'poltergeist'; there are: air_drag"),
        (["--hide", "none", "closer=1"], "got 'none'"),
    ],
)
def test_what_cannot_be_hidden(tmp_path: Path, refused, options: list[str], expected: str):
    assert expected in refused("gap", *options, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()  # nothing was begun


def test_hiding_is_for_the_synthetic_robot(place: Path, refused):
    assert "--hide is for the synthetic robot" in refused(*arguments(place, "--hide", "closer=1"))


def test_effects_of_ones_own_are_asked_about_like_the_others(place: Path, refused, monkeypatch: pytest.MonkeyPatch):
    """The effect of docs/your-effect.md."""
    registry.registered()
    monkeypatch.setattr(registry, "_MAKERS", dict(registry._MAKERS))
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "your-effect.md").read_text(), re.M | re.S)
    (place / "gasket.py").write_text(code)
    options = ("--user-effects", place / "gasket.py", "--effects", "gasket", "nothing")
    assert "unknown effects nothing; valid:" in (said := refused(*arguments(place, *options))) and "gasket" in said
    chosen = gap.chosen_effects(gap.GapCommand(effects=("gasket",)), small_scene()[0], [])
    assert [e.name for e in chosen] == ["gasket"] and "door" in chosen[0].locations


def test_an_effect_that_forgot_its_places_is_not_left_out_in_silence(monkeypatch: pytest.MonkeyPatch):
    registry.registered()
    monkeypatch.setattr(registry, "_MAKERS", dict(registry._MAKERS))

    @registry.register
    def lost(scene: Any) -> Effect:
        return Effect("lost", (Parameter("lost", "N m", 0.0, 1.0, 0.0, 5.0),), force=lambda theta, state: state.qvel)

    scene = small_scene()[0]
    with pytest.raises(ValueError, match="effects lost state no locations"):
        gap.chosen_effects(gap.GapCommand(effects=("lost", "latch")), scene, [])
    with pytest.warns(UserWarning, match="effects lost state no locations .*: they are left out"):
        assert len(gap.chosen_effects(gap.GapCommand(), scene, [])) > 5


def test_a_scene_of_ones_own_needs_recordings(tmp_path: Path, refused):
    command = ["gap", "--scene", str(SCENE), "--parameters", str(write_parameters(tmp_path)), "--out", str(tmp_path)]
    assert "--scene needs --recording" in refused(*command)


def test_what_is_hidden():
    scene = door_scene()
    assert hidden_effects(None, scene) == {"magnetic_catch": 1.5}
    assert hidden_effects(["none"], scene) == hidden_effects([], scene) == {}
    entries = ["closer=1", "torque_gain[panda_joint4]=-0.05"]
    assert hidden_effects(entries, scene) == {"closer": 1.0, "torque_gain[panda_joint4]": -0.05}


def test_the_synthetic_robot_records_each_demonstration_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """C trains, B validates, A is the test recording; no file shows the hidden effect."""
    from droid_jax.synthetic import hidden_effects as hidden

    asked = []

    def instead(scene, demonstration, truth, effects, *, seed, name):
        asked.append((demonstration.name, dict(effects), seed))
        return replace(record("train"), name=name)

    monkeypatch.setattr(hidden, "record_hidden", instead)
    roles = record_synthetic(door_scene(), {"closer": 1.0}, tmp_path, 1, 3, False)
    assert {role: r.name for role, r in roles.items()} == {"train": "C", "validation": "B", "test": "A"}
    assert asked == [("C", {"closer": 1.0}, 3000), ("B", {"closer": 1.0}, 3001), ("A", {"closer": 1.0}, 3002)]
    record_synthetic(door_scene(), {"closer": 1.0}, tmp_path, 1, 3, False)
    assert len(asked) == 3
    assert sorted(p.name for p in (tmp_path / "recordings").iterdir()) == [
        "A.npz", "B.npz", "C.npz", "synthetic_robot.json",
    ]  # fmt: skip


# ----- the run


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A case compiled already, of small budgets; no replays at a quarter of the time step, and no page."""
    monkeypatch.setattr(gap, "gap_config", lambda command: QUICK)
    monkeypatch.setattr(log_case, "make_case", lambda *arguments, **roles: small().case)
    monkeypatch.setattr(missing, "with_step_differences", lambda case, *_: case)
    monkeypatch.setattr(missing, "discretisation_error", lambda *arguments: FLOOR)
    monkeypatch.setattr(page, "write_report", lambda folder: folder / "report.html")


def fit_json(folder: Path, **values: float) -> Path:
    """A folder of `identify` with these best values."""
    folder.mkdir(parents=True, exist_ok=True)
    parameters = [{"name": name, "best": value} for name, value in values.items()]
    (folder / "fit.json").write_text(json.dumps({"parameters": parameters}))
    return folder


def test_the_base_fit_begins_at_an_earlier_fit(place: Path, quick: None, monkeypatch: pytest.MonkeyPatch):
    """No search; the only start has the known values (within bounds), and other parameters at their means.

    The folder may be one of `all`.
    """
    base = small().case.base
    monkeypatch.setattr(fitting, "cma_search", lambda *a, **k: pytest.fail("there is nothing to search for"))
    begun = []

    def refit(evidence, space, parts, starts, *rest, **more):
        begun.append(starts)
        raise KeyboardInterrupt

    monkeypatch.setattr(fitting, "refit", refit)
    known = {p.name: 0.5 * (p.mean + p.high) for p in base.parameters if not p.nuisance}
    first = next(iter(known))
    folder = fit_json(place / "all" / "identify", **{**known, first: 1e9, "of_another_model": 1.0})
    assert main(arguments(place, "--fit", folder.parent)) == 130
    (start,) = begun[0]
    space = small().case.full_space
    assert start[space.index(first)] == base[first].high
    for p in base.parameters:
        assert p.name == first or start[space.index(p.name)] == pytest.approx(known.get(p.name, p.mean))


def test_a_fit_that_is_none_or_of_another_model(place: Path, quick: None, refused):
    said = refused(*arguments(place, "--fit", place / "nowhere"))
    assert "nowhere is no folder of a finished `identify`" in said
    said = refused(*arguments(place, "--fit", fit_json(place / "other", door_mass=1.0)))
    assert "is of another model: it lacks" in said and "door_damping" in said


def test_a_run_goes_on_after_a_stop_and_is_whole(
    place: Path, quick: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], refused
):
    """Killed in the search; then started again without replays of the base fit; then finished."""
    pytest.importorskip("tensorboardX")
    command = arguments(place, "--effects", *EFFECTS, "--tensorboard")
    find = missing.search_effects

    def killed(case, base, floor, progress):
        find(case, base, floor, progress)  # what it computed is remembered
        raise KeyboardInterrupt

    monkeypatch.setattr(missing, "search_effects", killed)
    assert main(command) == 130
    assert "the same command goes on from here" in capsys.readouterr().err
    out = place / "run"
    assert sorted(p.name for p in out.iterdir()) == ["checkpoints", "setup.json", "tensorboard"]
    (events,) = (out / "tensorboard").iterdir()
    assert b"refine/mean_square" in events.read_bytes()

    setup = json.loads((out / "setup.json").read_text())
    (out / "setup.json").write_text(json.dumps({**setup, "versions": {**setup["versions"], "jax": "0.0.1"}}))
    monkeypatch.setattr(missing, "search_effects", find)
    fit, replays = missing.base_fit, out / "checkpoints" / "replays"

    def remembered(*given):
        before = sorted(replays.rglob("*.npz"))
        model = fit(*given)
        assert before and sorted(replays.rglob("*.npz")) == before  # every replay of it was kept
        return model

    monkeypatch.setattr(missing, "base_fit", remembered)
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "holds this run unfinished; going on with other code than it was begun with (jax 0.0.1 -> " in said
    lines = said.splitlines()[-6:]
    assert lines[0] == "The model lacks: hinge_preload at door."
    assert re.fullmatch(r"hinge_preload at door: hinge preload \S+ N m, \S+ to \S+ N m \(90 % interval\)", lines[1])
    assert lines[2] == "p = 0.0078 if nothing were missing; base fit converged: yes"
    assert lines[3].startswith("discrepancy U: train ") and " % closed), validation " in lines[3]
    assert lines[4].startswith("shifted most: door_stiffness ") and lines[4].endswith(" deviations)")
    assert lines[5] == f"report: {out / 'report.html'}"
    files = {p.name for p in out.iterdir()}
    written = {"gap.json", "gap.npz", "extended.json", "extended.xml"}
    neutral = {"fitted.json", "apply_fit.py", "mjlab_terms.py", "extended.patch"}
    assert files == {"checkpoints", "setup.json", "tensorboard", *neutral, *written}
    assert not (out / "checkpoints" / "replays").exists()
    answer = read_gap(out).found
    assert answer.coefficients[0].value == pytest.approx(PRELOAD, rel=0.05)
    assert {"search", "refine", "discretisation_error", "score_test", "refit"} <= set(answer.seconds)
    assert answer.setup.synthetic_robot is True and read_gap(out).options["command"] == "gap"
    before, after = (
        [(c.axis, c.joint, c.label, c.low, c.high) for c in cells]
        for cells in (answer.cells.before, answer.cells.after)
    )
    assert before == after
    assert answer.versions["jax"] and answer.device

    monkeypatch.setattr(missing, "search_effects", lambda *a: pytest.fail("this run is whole"))
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "holds this run already" in said and said.splitlines()[-6:] == lines

    before = (out / "gap.json").read_bytes()
    assert "other settings (seed)" in refused(*command, "--seed", "1")
    save_recording(record("test"), place / "validation.npz")
    assert "other settings (recordings)" in refused(*command)
    assert (out / "gap.json").read_bytes() == before


def tied(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that ends with a tie at once."""
    done = small()
    monkeypatch.setattr(missing, "base_fit", lambda *a: done.base)
    verdict = replace(done.verdict, indistinguishable_models=((done.verdict.model, done.base),))
    monkeypatch.setattr(missing, "search_effects", lambda *a: verdict)


def test_ties_come_with_an_experiment(place: Path, quick: None, monkeypatch: pytest.MonkeyPatch):
    """The command computes which experiment would distinguish the alternatives, on the fitted recording."""
    asked = []

    def apart(case, groups, recording):
        asked.append(([m.name for group in groups for m in group], recording.name))
        return (Experiment("the same motion twice as fast", 8.5), Experiment("slower", None, "too long"))

    tied(monkeypatch)
    monkeypatch.setattr(missing, "separating_experiments", apart)
    assert main(arguments(place, "--effects", *EFFECTS)) == 0
    assert asked == [(["hinge_preload at door", "base"], "train")]
    found = read_gap(place / "run").found
    assert [(e.what, e.distance, e.not_made) for e in found.experiments] == [
        ("the same motion twice as fast", 8.5, ""),
        ("slower", None, "too long"),
    ]
    assert found.amendments == {"experiments": "made", "final_refit": "made"}


def test_the_verdict_is_there_whatever_becomes_of_what_is_added_to_it(
    place: Path, quick: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Stopped during the candidate experiments; then continued, where these fail and the final refit is made."""
    command, out = arguments(place, "--effects", *EFFECTS), place / "run"
    tied(monkeypatch)

    def stopped(*arguments: Any) -> Any:
        raise KeyboardInterrupt

    def failing(*arguments: Any) -> Any:
        assert read_gap(out).found.verdict == "named"  # it stayed there while the run went on
        raise ValueError("no motion can be asked for")

    monkeypatch.setattr(missing, "separating_experiments", stopped)
    assert main(command) == 130
    said = capsys.readouterr()
    assert f"the verdict is in {out / 'gap.json'}: The model lacks: hinge_preload at door." in said.out
    first = read_gap(out)
    assert first.found.amendments == {"experiments": "to be made", "final_refit": "to be made"}
    assert first.found.verdict == "named" and first.found.final_model.fitted_to == ["train"]
    assert {"gap.npz", "extended.json", "checkpoints"} <= {p.name for p in out.iterdir()}

    monkeypatch.setattr(missing, "separating_experiments", failing)
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "holds this run unfinished; going on" in said
    assert (
        "would distinguish the alternatives were not made: no motion can be asked for; the alternatives stand" in said
    )
    last = read_gap(out)
    assert last.found.amendments == {"experiments": "not made: no motion can be asked for", "final_refit": "made"}
    assert last.found.final_model.fitted_to == ["train", "validation"] and last.found.effects == first.found.effects

    monkeypatch.setattr(missing, "search_effects", lambda *a: pytest.fail("this run is whole"))
    assert main(command) == 0


def test_the_verdict_is_written_before_whole_motions_are_replayed(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Of commanded logs in windows.  Errors of the motions come into the file when they are known."""
    model, events, stops = SimpleNamespace(values=None), list[str](), True
    verdict = SimpleNamespace(sentence="", base=model)
    made = SimpleNamespace(verdict=verdict, final=SimpleNamespace(model=model), states={})

    def searched(split: Any, case: Any, roles: Any, checkpoints: Any, start: Any, board: Any, keep: Any) -> None:
        keep(case, made, {})
        keep(case, made, {})  # an amendment

    def writing(out: Path, case: Any, verdict: Any, final: Any, described: dict[str, Any], states: Any) -> None:
        events.append("written with errors" if "open_loop" in described else "written")

    def errors(*arguments: Any) -> dict[str, Any]:
        events.append("replayed")
        if stops:
            raise KeyboardInterrupt
        return {}

    for name in ("train", "validation"):
        save_recording(record(name).repeats_subset(range(5)), place / f"{name}.npz")
    monkeypatch.setattr(log_case, "case_of", lambda *a: SimpleNamespace(limits=()))
    monkeypatch.setattr(log_case, "open_loop_errors", errors)
    monkeypatch.setattr(gap, "searched", searched)
    monkeypatch.setattr(gap, "_done", lambda out: None)
    for name in ("write_gap", "write_amended"):
        monkeypatch.setattr(results, name, writing)
    for stops, expected in (
        (True, ["written", "replayed"]),
        (False, ["written", "replayed", "written with errors", "replayed", "written with errors"]),
    ):
        events.clear()
        assert main(arguments(place, "--again")) == (130 if stops else 0)
        assert events == expected
        assert ("the verdict is in" in capsys.readouterr().out) == stops


@pytest.mark.slow
def test_the_command_as_a_user_runs_it(place: Path):
    """In a separate process: every file and the page; then the parameters once more, with the effect in the model."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}

    def run(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "droid_jax.run", *words],
            env=environment,
            capture_output=True,
            text=True,
            timeout=900,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    said = run(*arguments(place, "--effects", *EFFECTS))
    assert "hinge_preload" in said and (place / "run" / "report.html").stat().st_size > 10_000
    own = ("--scene", SCENE, "--parameters", place / "parameters.json", "--object-joint", "door",
           "--joint-friction", "scene")  # fmt: skip
    again = ("identify", "--recording", place / "train.npz", *own, "--extended", place / "run" / "extended.json",
             "--generations", "4", "--population", "10", "--out", place / "identified")  # fmt: skip
    run(*(str(w) for w in again))
    fitted = json.loads((place / "identified" / "fit.json").read_text())
    found = {p["name"]: p for p in fitted["parameters"]}
    low, high = found["hinge_preload"]["interval"]
    assert low < PRELOAD < high and not found["hinge_preload"]["nuisance"]
    wound = PRELOAD / 5  # N m/rad: the hidden coil, wound up by 5 rad, is wound further as the door opens
    assert found["door_stiffness"]["best"] == pytest.approx(0.7 + wound, rel=0.03)


def test_help_is_quick():
    """It imports nothing that takes time."""
    code = (
        "import sys\nfrom droid_jax.run import main\n"
        "try:\n    main(['gap', '--help'])\nexcept SystemExit as stop:\n    assert stop.code == 0\n"
        "heavy = [m for m in ('jax', 'mujoco', 'numpy', 'scipy', 'matplotlib', 'evosax') if m in sys.modules]\n"
        "assert not heavy, heavy"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    for option in ("--recording", "--hide", "--budget", "--effects", "--without", "--again"):
        assert option in run.stdout
