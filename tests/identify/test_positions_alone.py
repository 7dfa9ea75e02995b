"""Commanded logs of one repeat, positions alone, at several servo gains: fitted, judged and evaluated by commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pendulum as made
import pytest
from pendulum import MJCF, PARAMETERS, RATE, START, TRUE, pendulum, swung, write_pendulum

from droid_jax.commands.fitted import fitted_folder
from droid_jax.cost.channels import in_noise_units
from droid_jax.cost.cost import make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.cost.windowed_log import WindowedLog, windowed_log
from droid_jax.identify.evaluation import evaluate_on
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import Identified, IdentifyConfig, identify_parameters, prepare
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effects.registry import effect_space, library
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Role, Space
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Recording
from droid_jax.run import main
from droid_jax.simulate.windows import WindowConfig


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    folder = tmp_path_factory.mktemp("logs")
    options = write_pendulum(folder)
    paths = {}
    for name, kp, frequency in (("soft", 1.0, 0.8), ("stiff", 3.0, 1.1), ("judge", 2.0, 0.6)):
        paths[name] = folder / f"{name}.npz"
        save_recording(swung(name, kp, frequency), paths[name])
    return SimpleNamespace(folder=folder, options=options, **paths)


@pytest.fixture(scope="module")
def fitted(logs: SimpleNamespace, one_line: None) -> Path:
    out = logs.folder / "fit"
    words = ["identify", *logs.options, "--recording", str(logs.soft), str(logs.stiff), "--judge-on", str(logs.judge)]
    assert main([*words, "--generations", "4", "--out", str(out)]) == 0
    return out


@pytest.mark.slow
def test_parameters_are_recovered_from_positions_at_two_gains(fitted: Path):
    """The scene has a third gain: replayed with it, no damping and armature would fit both logs."""
    fit = json.loads((fitted / "fit.json").read_text())
    assert fit["compared"] == {"position": 1.0} and fit["distance_unit"] == "rad"
    for parameter in fit["parameters"]:
        assert parameter["best"] == pytest.approx(TRUE[parameter["name"]], rel=0.03)
        assert parameter["identifiable"]


@pytest.mark.slow
def test_the_fit_is_evaluated_on_a_held_out_recording(fitted: Path):
    fit = json.loads((fitted / "fit.json").read_text())
    ((name, judged),) = fit["heldout_distances"].items()
    errors = judged["errors"]["position"]
    assert name == "judge" and judged["judged"] == "recordings" and errors["unit"] == "rad"
    assert errors["mae_after"][0] < 1e-3 < 0.03 < errors["mae_before"][0]
    config = json.loads((fitted / "config.json").read_text())
    assert [r["name"] for r in config["recordings"]] == ["soft", "stiff"]
    assert [r["name"] for r in config["judged_on"]] == ["judge"]
    page = (fitted / "report.html").read_text()
    assert "fitted to the joint positions" in page and "Position distance before" in page
    assert 'data-judge="judge"' in page and 'data-channel="position"' in page


@pytest.mark.slow
def test_a_fit_is_evaluated_on_any_recording(logs: SimpleNamespace, fitted: Path, capsys: pytest.CaptureFixture[str]):
    """The errors of the held-out recording equal those in the fit's file; a fitted recording is marked."""
    out = logs.folder / "evaluation"
    save_recording(swung("torques", 2.0, 0.6, ("torque", "position")), torques := logs.folder / "torques.npz")
    given = [str(logs.judge), str(logs.soft), str(torques)]
    assert main(["evaluate-fit", "--fit", str(fitted), "--recording", *given, "--out", str(out)]) == 0
    found = json.loads((out / "evaluation.json").read_text())
    own = json.loads((fitted / "fit.json").read_text())["heldout_distances"]["judge"]["errors"]["position"]
    assert found["errors"]["judge"]["position"]["mae_after"] == pytest.approx(own["mae_after"], rel=1e-3)
    assert {r["name"]: r["fitted"] for r in found["recordings"]} == {"judge": False, "soft": True, "torques": False}
    assert found["errors"]["torques"]["torque"]["unit"] == "N m"
    assert set(found["mean_mae"]) == {"position", "torque"}
    assert "judge: mean absolute position error" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert "Evaluation of a fit: pendulum" in page and 'data-doubt="fitted"' in page
    assert main(["report", str(out)]) == 0


@pytest.mark.slow
def test_a_scene_that_changed_since_the_fit_is_noticed(
    logs: SimpleNamespace, fitted: Path, capsys: pytest.CaptureFixture[str]
):
    scene = logs.folder / "pendulum.xml"
    text = scene.read_text()
    words = ["evaluate-fit", "--fit", str(fitted), "--recording", str(logs.judge), "--out", str(logs.folder / "no")]
    try:
        scene.write_text(text.replace('mass="0.5"', 'mass="0.6"'))
        assert main(words) == 2
        assert "is another model than" in capsys.readouterr().err
        scene.unlink()
        assert main(words) == 2
        assert "give its new path (--scene)" in capsys.readouterr().err
    finally:
        scene.write_text(text)
    assert main([*words[:2], str(logs.folder), *words[3:]]) == 2
    assert "holds no finished fit" in capsys.readouterr().err


def test_a_fit_without_its_nuisances_is_evaluated(logs: SimpleNamespace, tmp_path: Path, one_line: None):
    """The scene was compiled for the friction of a nuisance that was not fitted."""
    friction = {"field": "dof_frictionloss", "element": "swing", "mean": 0.01, "std": 0.01, "high": 0.1}
    listed = [*PARAMETERS, friction | {"nuisance": True}]
    (tmp_path / "parameters.json").write_text(json.dumps(listed))
    words = [*logs.options[:2], "--parameters", str(tmp_path / "parameters.json"), "--recording", str(logs.soft)]
    few = ["--no-nuisances", "--engine", "mujoco", "--generations", "1", "--population", "4"]
    assert main(["identify", *words, *few, "--out", str(tmp_path / "fit")]) == 0
    evaluate = ["evaluate-fit", "--fit", str(tmp_path / "fit"), "--recording", str(logs.judge)]
    assert main([*evaluate, "--out", str(tmp_path / "evaluation")]) == 0
    errors = json.loads((tmp_path / "evaluation" / "evaluation.json").read_text())["errors"]["judge"]["position"]
    assert errors["mae_after"][0] < 0.3 * errors["mae_before"][0]


def test_an_extended_model_of_other_recordings_is_no_part_of_a_fit(tmp_path: Path):
    """The folder of `all` may hold a search of an earlier run."""
    for stage, last in (("identify", "fit.json"), ("gap", "gap.json")):
        (tmp_path / stage).mkdir()
        for name in (last, "config.json"):
            (tmp_path / stage / name).write_text("{}")
        (tmp_path / stage / "setup.json").write_text(json.dumps({"recordings_sha256": ["a"], "scene_sha256": "s"}))
    assert fitted_folder(tmp_path) == ("gap", tmp_path / "gap")
    for stale in ({"recordings_sha256": ["b"]}, {"scene_sha256": "t"}):
        search = {"recordings_sha256": ["a"], "scene_sha256": "s"} | stale
        (tmp_path / "gap" / "setup.json").write_text(json.dumps(search))
        assert fitted_folder(tmp_path) == ("identify", tmp_path / "identify")


def test_several_channels_count_in_units_of_their_noise(logs: SimpleNamespace):
    """The noise is estimated from two repeats, or from the residual at the start for one repeat."""
    scene, noise = pendulum(), 2e-3
    space = load_parameters(logs.folder / "parameters.json", scene)
    repeated = swung("ab", 1.0, 0.8, ("torque", "position"), noise, repeats=6)
    problem = prepare(scene, space, repeated, config=IdentifyConfig(channels=("position", "torque")))
    weights = problem.fit.comparisons[0].config.channels
    assert weights["position"] == pytest.approx(1 / noise, rel=0.1)  # of 4 fitted repeats
    assert weights["torque"] == pytest.approx(1 / 0.01)  # no sensor is believed to be better
    alone = make_cost(
        scene, space, repeated.repeats_subset([0]), config=CompareConfig(channels={"position": 1.0, "torque": 1.0})
    )
    (start,) = alone.comparisons
    left = alone.smoothed(space.mean[None])[0][0] - start.channel("torque").noise.mean
    assert in_noise_units(alone, space.mean)["torque"] == pytest.approx(1 / np.sqrt(np.mean(left**2)), rel=1e-3)


PAYLOAD = '<body name="payload" pos="0 0 -0.2"><inertial pos="0 0 0" mass="{}" diaginertia="1e-9 1e-9 1e-9"/></body>'


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A pendulum with a body for a payload, its parameters, and logs of it empty and with 0.3 kg."""
    logs = list[Recording]()
    with pytest.MonkeyPatch.context() as patch:
        for name, mass, frequency in (("empty", 1e-6, 0.8), ("loaded", 0.3, 1.1)):
            patch.setattr(made, "MJCF", MJCF.replace("</body>", PAYLOAD.format(mass) + "</body>"))
            logs.append(replace(swung(name, 1.0, frequency), known={"payload": mass}))
        patch.setattr(made, "MJCF", MJCF.replace("</body>", PAYLOAD.format(1e-6) + "</body>"))
        scene = pendulum()
    entry = {
        "field": "body_mass",
        "element": "payload",
        "name": "payload",
        "mean": 0.1,
        "std": 0.1,
        "low": 0.0,
        "high": 1.0,
    }
    file = tmp_path_factory.mktemp("loaded") / "parameters.json"
    file.write_text(json.dumps([*PARAMETERS, entry | {"low": 0.0}]))
    return SimpleNamespace(scene=scene, space=load_parameters(file, scene), logs=logs)


def test_a_payload_that_each_log_states_is_used(loaded: SimpleNamespace):
    """Without it one mass is fitted to both logs, with a large residual for the loaded one."""

    def fitted(logs: list[Recording]) -> Identified:
        search, still = CmaConfig(generations=2, population=4, parents=None), RefineConfig(basin_hops=0)
        config = IdentifyConfig(engine="mujoco", search=search, refine=still, samples=0, checks=False)
        return identify_parameters(loaded.scene, loaded.space, logs, config=config)

    found, pooled = fitted(loaded.logs), fitted([replace(log, known={}) for log in loaded.logs])
    assert found.best[0] == pytest.approx(TRUE["damping"], rel=0.03)
    assert found.best[1] == pytest.approx(TRUE["armature"], abs=6e-4)  # plain C's time step adds 4e-4 of inertia
    assert found.heldout_distances["loaded"].after < 2e-3 < 2e-2 < pooled.heldout_distances["loaded"].after


@pytest.mark.parametrize("whole", [False, True])
def test_windows_and_full_motions_use_the_values_that_their_log_states(loaded: SimpleNamespace, whole: bool):
    def made_of(logs: list[Recording]) -> WindowedLog:
        config = CompareConfig(channels={"position": 1.0})
        return windowed_log(loaded.scene, loaded.space, logs, config, WindowConfig(), whole=whole)

    def off(rows: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean((rows - cost.measured) ** 2, axis=(1, 2)))

    cost, best = made_of(loaded.logs), loaded.space.values(TRUE)
    rows = np.stack([best, [*best[:2], 0.9]])
    simulated, without = cost.simulated(rows), made_of([replace(log, known={}) for log in loaded.logs]).simulated(rows)
    np.testing.assert_array_equal(*simulated)
    assert (3 * off(simulated) < off(without)).all()
    (one, _), (other, _) = (cost.about(row).spreads for row in rows)
    np.testing.assert_array_equal(one, other)


def test_a_parameter_stands_for_another_in_one_recording(loaded: SimpleNamespace):
    """The payload of the loaded log is fitted.  A parameter that no log refers to is refused."""
    empty, full = loaded.logs
    space = Space(
        (*loaded.space.parameters, replace(loaded.space["payload"], name="tool", writes=(), role=Role.STANDS_FOR))
    )
    search, still = CmaConfig(generations=2, population=4, parents=None), RefineConfig(basin_hops=0)
    config = IdentifyConfig(engine="mujoco", search=search, refine=still, samples=0, checks=False)
    found = identify_parameters(loaded.scene, space, [empty, replace(full, known={"payload": "tool"})], config=config)
    assert found.best[space.index("tool")] == pytest.approx(0.3, rel=0.06)  # as above
    with pytest.raises(ValueError, match=r"parameters tool stand for others .* and no fitted one does"):
        prepare(loaded.scene, space, loaded.logs, config=config)


def test_stated_values_must_be_of_parameters_and_within_bounds(loaded: SimpleNamespace):
    log = loaded.logs[0]
    for known, said in (
        ({"load": 1.0}, "states load"),
        ({"payload": 3.0}, "outside its bounds"),
        ({"payload": "tool"}, "states tool"),
    ):
        with pytest.raises(ValueError, match=said):
            make_cost(loaded.scene, loaded.space, replace(log, known=known), engine="mujoco")
    with pytest.raises(ValueError, match="known value of 'payload'"):
        make_cost(loaded.scene, loaded.space, replace(log, known={"payload": np.nan}), engine="mujoco")


def test_a_limit_that_acts_at_the_end_of_a_log_is_found(tmp_path: Path):
    """The search and the first refinement use the slow beginning, which does not reach the servo's limit."""
    write_pendulum(tmp_path)
    scene, clock = pendulum(), np.arange(0.0, 4.0, 1 / RATE)
    waves = (
        size * np.sin(np.pi * f * clock) * np.abs(np.sin(np.pi * f * clock)) for size, f in ((0.8, 0.5), (0.4, 5.0))
    )
    log = swung("chirp", START["kp"], 0.0, command=np.concatenate([*waves]), steepest=16.0)
    effects = library(scene, ["profile_acceleration"])
    space = load_parameters(tmp_path / "parameters.json", scene) + effect_space(effects)
    search = CmaConfig(generations=1, population=4, parents=None)
    still = RefineConfig(basin_hops=0)  # a hop may come upon it by chance
    config = IdentifyConfig(beginning=3.0, search=search, refine=still, samples=0, checks=False)
    found = identify_parameters(scene, space, [log], config=config, effects=effects)
    assert found.best == pytest.approx([*TRUE.values(), 1 / 16.0], rel=0.05)


def test_torques_without_the_links_weight_are_left_out_of_an_evaluation(logs: SimpleNamespace):
    """They cannot be compared if the joint carries a weight; the positions can."""
    scene = pendulum()
    space = load_parameters(logs.folder / "parameters.json", scene)
    both = swung("both", 1.0, 0.8, ("torque", "position"))
    light = replace(both, torque=replace(both.torque, gravity=False))
    of = {"before": space.mean, "after": space.mean, "engine": "mujoco"}
    (whole,) = evaluate_on(scene, space, both, **of)
    with pytest.warns(UserWarning, match="torques are left out of the errors: .* excludes gravity"):
        (found,) = evaluate_on(scene, space, light, **of)
    assert set(whole.errors) == {"torque", "position"} and set(found.errors) == {"position"}
    assert found.errors["position"] == whole.errors["position"] and found.recording.sha256 == light.sha256
    alone = replace(light, channels={"torque": light.channels["torque"]})
    with pytest.raises(ValueError, match="says that its torque excludes gravity"):
        evaluate_on(scene, space, alone, **of)


def test_the_pendulum_of_the_test_differs_from_the_scenes():
    assert {p["name"] for p in PARAMETERS} == set(TRUE) and all(TRUE[n] != START[n] for n in TRUE)


def test_a_held_out_recording_whose_simulation_blows_up_is_refused_before_the_fit(logs: SimpleNamespace):
    soft = swung("soft", 1.0, 0.8)
    assert soft.gains is not None
    wild = replace(soft, name="wild", gains=replace(soft.gains, stiffness=soft.gains.stiffness * 1e9))
    (logs.folder / "own.json").write_text(json.dumps(PARAMETERS))
    space = load_parameters(logs.folder / "own.json", pendulum())
    config = IdentifyConfig(compare=CompareConfig(channels={"position": 1.0}), engine="mujoco")
    with pytest.raises(ValueError, match="the simulation of 'wild' blows up"):
        prepare(pendulum(), space, [soft], judge_on=[wild], config=config)
