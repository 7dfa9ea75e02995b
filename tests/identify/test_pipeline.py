"""What an identification says beside its fit: floors and what was closed, against closed forms; and when it resumes."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from small_log import COULOMB, elbow, elbow_log, elbow_space

from droid_jax.commands.identify import _summary
from droid_jax.cost.residuals import CompareConfig, make_comparison
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_space
from droid_jax.identify import neutral_result, pipeline
from droid_jax.identify.fit import grip_hypotheses, on_bound, starts
from droid_jax.identify.gaussian import prior
from droid_jax.identify.holdout import WORTH, _closed, _floor, _scatter, judged_on, split_repeats
from droid_jax.identify.multistart import RefineConfig, refine
from droid_jax.identify.pipeline import Identified, IdentifyConfig, cost_samples, identify_parameters
from droid_jax.identify.results import traces, write_run
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Channel
from droid_jax.report.identify_folder import FitFile
from droid_jax.storage import config_json

QUICK = IdentifyConfig(search=CmaConfig(population=8, parents=None, generations=2), refine=None, samples=2)


def repeats(count: int, seed: int = 0, noise: float = 0.3) -> np.ndarray:
    """[N, T, 2] noise about a wave."""
    wave = 5.0 * np.sin(np.linspace(0, 20, 4000))[:, None]
    return wave + np.random.default_rng(seed).normal(0, noise, (count, 4000, 2))


def test_values_that_are_no_recording_are_refused():
    scene = elbow()
    with pytest.raises(ValueError, match="no recording to fit"):
        identify_parameters(scene, elbow_space(scene), [])
    with pytest.raises(ValueError, match=r"expected a Recording, got 'log\.npz'; load_recording reads one"):
        identify_parameters(scene, elbow_space(scene), ["log.npz"])  # pyright: ignore[reportArgumentType]


NORM = 0.3 * np.sqrt(np.pi / 2)  # mean norm of two normal numbers of deviation 0.3


@pytest.mark.parametrize("count", [2, 3, 10])
def test_the_noise_floor_is_the_distance_of_the_truth(count: int):
    values = repeats(count)
    assert _scatter(values, np.ones(values.shape, bool)) == pytest.approx(NORM, rel=0.02)


def test_missing_samples_do_not_lower_the_noise_floor():
    """Stretches of single repeats and half of all samples are missing; one repeat has no floor."""
    values = repeats(4)
    mask = np.repeat(np.random.default_rng(1).random((4, 4000, 1)) > 0.5, 2, axis=2)
    mask[0, :2000] = False
    mask[1:, 3000:] = False
    assert _scatter(np.where(mask, values, np.nan), mask) == pytest.approx(NORM, rel=0.03)
    alone = np.zeros_like(mask)
    alone[2] = True
    assert _scatter(values, alone) is None


def test_the_noise_floor_includes_every_compared_channel():
    scene, recording = elbow(), elbow_log(0.0, seconds=8.0, repeats=5)
    torque = recording.channels["torque"]
    fast = np.random.default_rng(3).normal(0, 0.02, torque.values.shape) + np.sin(torque.time)[:, None]
    velocity = Channel("velocity", "rad/s", ("elbow",), torque.time, fast, torque.mask)
    both = dataclasses.replace(recording, channels={**recording.channels, "velocity": velocity})
    config = CompareConfig(channels={"torque": 1.0, "velocity": 50.0})
    alone = make_comparison(scene, recording, torque.time, CompareConfig())
    together = make_comparison(scene, both, torque.time, config)
    share = 50.0 * 0.02 * np.sqrt(2 / np.pi)  # 50 times the mean size of a normal number
    assert _floor(together) == pytest.approx(_floor(alone) + share, rel=0.02)


def test_the_closed_share_is_undefined_close_to_the_noise_floor():
    assert _closed(2.0, 1.0, 1.0) == 1.0 and _closed(2.0, 1.5, 1.0) == 0.5
    for before in (1.0, 1.0 + 0.5 * WORTH, 0.3):
        assert _closed(before, 0.9, 1.0) is None
    assert _closed(2.0, 1.0, None) is None


@pytest.fixture(scope="module")
def scene() -> Scene:
    return elbow()


@pytest.fixture(scope="module")
def found(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Identified:
    """A fit of one of two repeats, with whitened residuals; the other is held out."""
    config = dataclasses.replace(QUICK, compare=CompareConfig(whitened=True))
    folder = tmp_path_factory.mktemp("checkpoints")
    return identify_parameters(
        scene, elbow_space(scene), [elbow_log(COULOMB, 10.0, 2)], config=config, checkpoints=folder
    )


def test_two_repeats_have_a_noise_floor(found: Identified):
    gap = found.heldout_distances["elbow"]
    recording = elbow_log(COULOMB, 10.0, 2)
    torque = recording.channels["torque"].values[:, :, 0]
    assert gap.noise_floor == pytest.approx(np.mean(np.abs(torque[0] - torque[1])) / np.sqrt(2), rel=0.05)
    assert gap.per_joint_noise_floor is not None and gap.before > gap.noise_floor


def test_traces_and_joints_are_of_the_held_out_repeat(found: Identified):
    held = found.heldout.comparisons[0].channel("torque")
    before, after = found.heldout.smoothed(np.stack([found.start, found.best]))[0]
    kept = traces(found)
    np.testing.assert_allclose(kept["elbow/before"], before, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(kept["elbow/after"], after, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(kept["elbow/measured_mean"], held.noise.mean)
    gap = found.heldout_distances["elbow"]
    for curve, size in ((before, gap.per_joint_before), (after, gap.per_joint_after)):
        assert size == pytest.approx(np.sqrt(np.mean((curve - held.noise.mean) ** 2, axis=0)), rel=1e-5)
    assert gap.per_joint_before[0] > 1.1 * gap.per_joint_after[0]
    everything = make_comparison(elbow(), elbow_log(COULOMB, 10.0, 2), held.clock, CompareConfig(whitened=True))
    apart = np.diff(everything.channel("torque").noise.repeats[..., 0], axis=0)  # of two, one of which is held out
    assert gap.per_joint_noise_floor == pytest.approx([np.sqrt(np.mean(apart**2) / 2)], rel=0.02)


def test_the_settings_are_in_the_result(found: Identified, tmp_path: Path):
    write_run(tmp_path, found, {"recordings": []})
    config = json.loads((tmp_path / "fit.json").read_text())["config"]
    assert config == config_json(found.config) and config["search"]["population"] == 8
    assert config["compare"]["noise"]["cutoff"] == 8.0 and config["identifiability"]["identifiable"] == 0.25


def test_the_command_prints_the_result_and_advice(found: Identified, tmp_path: Path, capsys):
    write_run(tmp_path, found, {"recordings": []})
    fit = json.loads((tmp_path / "fit.json").read_text())
    (name,) = fit["heldout_distances"]
    fit["heldout_distances"][name]["after"] = fit["heldout_distances"][name]["noise_floor"]
    alone = {name: {**fit["heldout_distances"][name], "noise_floor": None, "judged": "time"}}
    for changes, repeats, said in (
        ({"mean_square": 90.0}, [8], "gap` searches for what the model lacks (it takes a second motion, or 16 repeats"),
        ({"mean_square": 90.0}, [16], "gap` searches for what the model lacks\n"),
        (
            {"mean_square": 1.0, "heldout_distances": alone},
            [1],
            "one repeat does not separate noise from what the model lacks: let",
        ),
    ):
        _summary(found, msgspec.convert({**fit, **changes}, FitFile), repeats)
        assert said in capsys.readouterr().out
        _summary(found, msgspec.convert({**fit, "mean_square": 1.0}, FitFile), repeats)
        assert said not in capsys.readouterr().out


def test_samples_are_of_both_gaussians_with_the_cost_of_each(found: Identified):
    drawn = cost_samples(found, 40, 3)
    names = drawn["names"].tolist()
    assert names == list(found.space.names)
    for which, gaussian in (("initial", prior(found.space)), ("fitted", found.gaussian)):
        low, high = gaussian.interval(0.998)
        assert np.mean((drawn[which] >= low) & (drawn[which] <= high)) > 0.95
        again = found.heldout(found.full.embed(found.space, drawn[which]))
        np.testing.assert_allclose(drawn[f"{which}_cost"], again, rtol=1e-4)
    assert np.median(drawn["fitted_cost"]) < np.median(drawn["initial_cost"])


def test_the_refinement_has_a_start_with_a_firm_grip_and_hypotheses_of_slip():
    scene = door_scene()
    space = door_space(scene)
    searched: Any = SimpleNamespace(best=space.mean * 1.1)
    begin = starts(space, space, searched)
    np.testing.assert_allclose(begin[:2], [space.mean * 1.1, space.mean])
    pads = [n for n in space.names if n.startswith(("sliding_friction", "torsional_friction"))]
    assert len(pads) == 4
    for i, p in enumerate(space.parameters):
        assert begin[2, i] == pytest.approx(min(p.high, 4.0 * p.mean) if p.name in pads else p.mean)
    sliding = [n for n in pads if n.startswith("sliding")]
    slips = [set(h) for h in grip_hypotheses(space)]
    assert slips == [{sliding[0]}, {sliding[1]}, set(sliding)]
    assert all(h[n] == space[n].mean for h in grip_hypotheses(space) for n in h)
    rest = space.select([n for n in space.names if n not in pads])
    searched.best = rest.mean
    assert len(starts(rest, rest, searched)) == 2 and grip_hypotheses(rest) == []


def test_an_active_limit_is_a_start_since_its_derivative_at_zero_vanishes():
    limit = Parameter("limit", "s^2/rad", 0.0, 0.02, 0.0, 1.0)
    short, pull = replace(limit, name="short", mean=1.0), replace(limit, name="pull", low=-1.0)
    space = Space((replace(limit, name="damping", mean=0.5), limit, short, pull))
    searched: Any = SimpleNamespace(best=np.array([0.3, 0.0, 1.0, 0.1]))
    begin = starts(space, space, searched, ["limit", "short", "pull"])
    np.testing.assert_allclose(begin, np.stack([searched.best, space.mean, [0.3, 0.02, 0.98, 0.1]]))

    def residuals(rows: np.ndarray) -> np.ndarray:  # below 0.01 the limit is out of reach; its truth is 0.03
        return np.stack([100 * (np.maximum(rows[:, 1], 0.01) - 0.03), rows[:, 0] - 0.3, rows[:, 3] - 0.1], axis=1) * 100

    settings = RefineConfig(basin_hops=0)
    assert refine(residuals, space, begin[:2], settings).best[1] == 0.0
    assert refine(residuals, space, begin, settings).best[1] == pytest.approx(0.03, rel=0.01)


def test_files_are_written_before_samples_are_drawn(found: Identified, tmp_path: Path):
    """A run whose samples fail keeps its fit, but is not complete."""

    def fails() -> dict[str, np.ndarray]:
        raise ValueError("no samples")

    with pytest.raises(ValueError, match="no samples"):
        write_run(tmp_path, found, {}, samples=fails)
    assert (tmp_path / "fit.json").is_file() and (tmp_path / "fitted.xml").is_file()
    assert not (tmp_path / "config.json").exists()
    fit = json.loads((tmp_path / "fit.json").read_text())
    assert fit["mjcf_lacks"] == ["torque_offset[elbow]"]
    assert [p["name"] for p in fit["parameters"] if p["on_bound"]] == list(on_bound(found.full, found.best))


def test_a_fit_without_an_mjcf_writes_all_other_files(
    found: Identified, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuses(*_: object) -> str:
        raise ValueError("the fitted values make no MJCF: inertia must satisfy A + B >= C")

    monkeypatch.setattr(neutral_result, "fitted_files", refuses)
    write_run(tmp_path, found, {}, notes=["a note"])
    fit = json.loads((tmp_path / "fit.json").read_text())
    assert fit["notes"] == [
        "a note",
        "fitted.xml is not written: " + "the fitted values make no MJCF: inertia must satisfy A + B >= C",
    ]
    assert (tmp_path / "config.json").is_file() and not (tmp_path / "fitted.xml").exists()


def test_a_cost_in_noise_units_has_no_noise_floor_in_newton_metres(found: Identified, tmp_path: Path):
    write_run(tmp_path, found, {})
    fit = json.loads((tmp_path / "fit.json").read_text())
    assert fit["cost"]["unit"] == "noise units" and fit["cost"]["noise_floor"] is None
    assert fit["heldout_distances"]["elbow"]["noise_floor"] == found.heldout_distances["elbow"].noise_floor


@pytest.mark.slow
def test_a_search_of_another_cost_is_not_resumed(scene: Scene, tmp_path: Path):
    """The scene, its measured joints, the comparison, or the prior of a nuisance differs."""
    recording, space = elbow_log(COULOMB, 10.0, 2), elbow_space(scene)
    main, offset = space.select(["elbow_damping"]), space.select(["torque_offset[elbow]"])

    def run(config: IdentifyConfig = QUICK, **changes) -> None:
        given = {"scene": scene, "nuisances": None, **changes}
        identify_parameters(
            given["scene"], main, [recording], nuisances=given["nuisances"], config=config, checkpoints=tmp_path
        )

    run()
    heavier = elbow()
    heavier.model.body_mass[1] *= 2.0
    refined = dataclasses.replace(QUICK, refine=IdentifyConfig().refine)
    for changes in (
        {"config": dataclasses.replace(QUICK, compare=CompareConfig(whitened=True))},
        {"scene": heavier},
        {"scene": dataclasses.replace(elbow(), object_joint="elbow")},
        {"config": refined, "nuisances": offset},
    ):
        with pytest.raises(ValueError, match="belongs to another run: it differs in fingerprint"):
            run(**changes)
    run()


def test_positions_of_a_log_without_commands_are_refused_at_once(scene: Scene):
    """Its replay follows the measured positions, which would fit with any parameters."""
    config = dataclasses.replace(QUICK, compare=CompareConfig(channels={"position": 1.0}))
    with pytest.raises(ValueError, match=r"'elbow' holds no commands: .* only torques are simulated, so position"):
        identify_parameters(scene, elbow_space(scene), [elbow_log(0.0, 10.0, 2)], config=config)


def test_errors_in_held_out_data_are_raised_before_the_search(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    recording = elbow_log(0.0, 10.0, 2)
    torque = recording.channels["torque"]
    (held,) = split_repeats(recording, QUICK.heldout)[2]
    mask = torque.mask.copy()
    mask[held, 40:] = False
    faulty = dataclasses.replace(
        recording, channels={**recording.channels, "torque": dataclasses.replace(torque, mask=mask)}
    )
    monkeypatch.setattr(pipeline, "cma_search", lambda *a, **k: pytest.fail("the search began"))
    with pytest.raises(ValueError, match="'elbow' was measured for less than 10 % of the time"):
        identify_parameters(scene, elbow_space(scene), [faulty], config=QUICK)


def test_a_replay_that_blows_up_is_never_a_parent(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    """The other rows cost more than a replay that blew up: their forces are kilonewtons."""
    asked = list[np.ndarray]()

    def search(cost, space, *_, **__):
        asked.append(cost(np.stack([space.mean, space.mean])))
        raise KeyboardInterrupt

    class Costs:
        comparisons = (SimpleNamespace(penalty=1000.0),)

        def __call__(self, rows):
            return np.array([5000.0, 1000.0])

    def cost_of(*_, **__):
        return SimpleNamespace(first=Costs, against=lambda *a: None, comparisons=(), rollouts=lambda rows: ())

    monkeypatch.setattr(pipeline, "cma_search", search)
    monkeypatch.setattr(pipeline, "make_cost", cost_of)
    with pytest.raises(KeyboardInterrupt):
        identify_parameters(scene, elbow_space(scene), [elbow_log(0.0, 10.0, 2)], config=QUICK)
    np.testing.assert_array_equal(asked[0], [5000.0, np.inf])


def test_means_that_cannot_be_simulated_are_refused_before_the_search(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    path = np.zeros((2, 50, 1))
    path[:, 20:] = np.nan  # two rows, [T, J] each
    rows, none = path[..., 0], np.zeros((2, 50, 0), bool)
    blown = Rollout(np.tile(0.01 * np.arange(50), (2, 1)), path, path, path, rows, none, np.array([False, False]))
    cost = SimpleNamespace(
        scene=scene,
        first=lambda: None,
        against=lambda *a: None,
        comparisons=(SimpleNamespace(name="elbow"),),
        rollouts=lambda rows: (blown,),
    )
    monkeypatch.setattr(pipeline, "make_cost", lambda *_, **__: cost)
    monkeypatch.setattr(pipeline, "cma_search", lambda *a, **k: pytest.fail("the search began"))
    with pytest.raises(ValueError, match=r"'elbow' blows up .* means \(elbow leaves its range at step 20 \(0\.2 s\)"):
        identify_parameters(scene, elbow_space(scene), [elbow_log(0.0, 10.0, 2)], config=QUICK)


def test_without_the_refinement_one_recording_is_fitted(scene: Scene):
    both = [elbow_log(0.0, 10.0, 2), dataclasses.replace(elbow_log(0.0, 12.0, 2), name="other")]
    with pytest.raises(ValueError, match="one recording is fitted, got 2: elbow, other"):
        identify_parameters(scene, elbow_space(scene), both, config=dataclasses.replace(QUICK, refine=None))


@pytest.mark.slow
@pytest.mark.parametrize(("repeats", "runs"), [(1, 2), (3, 1)])
def test_every_replay_of_the_refinement_is_counted(
    scene: Scene, repeats: int, runs: int, monkeypatch: pytest.MonkeyPatch
):
    """The noise of a single repeat is estimated twice, with a refinement in between."""
    counted = []

    def counting(*args, **options):
        counted.append(refine(*args, **options))
        return counted[-1]

    monkeypatch.setattr(pipeline, "refine", counting)
    config = dataclasses.replace(QUICK, refine=RefineConfig(iterations=3, basin_hops=0))
    found = identify_parameters(scene, elbow_space(scene), [elbow_log(COULOMB, 10.0, repeats)], config=config)
    assert len(counted) == runs and found.refined is not None
    assert found.refined.evaluations == sum(one.evaluations for one in counted)


@pytest.mark.parametrize(("repeats", "judged"), [(1, "time"), (3, "repeats")])
def test_a_fit_states_its_held_out_data(scene: Scene, repeats: int, judged: str):
    log = elbow_log(0.0, 9.0, repeats)
    assert judged_on(log, split_repeats(log, 0.3)[1]) == judged
    commanded = dataclasses.replace(log, time=np.arange(3.0), command=np.zeros((3, 1)), command_names=("elbow",))
    assert judged_on(commanded, split_repeats(commanded, 0.3)[1]) == ("repeats" if repeats > 1 else "same")


def test_a_search_imports_no_optional_modules():
    """Checkpoints and distributions of scipy take seconds to import."""
    seen = "print('orbax' in sys.modules, 'scipy.stats' in sys.modules)"
    code = f"import sys, droid_jax.identify.search, droid_jax.identify.gaussian; {seen}"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.stdout.splitlines()[-1] == "False False", run.stderr


@pytest.mark.parametrize(
    ("engine", "contacts", "refined", "most", "generations"),
    [
        ("mujoco", False, True, 5, 5),
        ("mujoco", False, True, 50, 20),
        ("mujoco", False, True, None, 20),
        ("mujoco", False, False, 5, 20),
        ("mujoco", True, True, 5, 20),
        ("mjx", False, True, 5, 20),
    ],
)
def test_the_search_in_plain_c_is_short_before_a_refinement(
    engine: str, contacts: bool, refined: bool, most: int | None, generations: int
):
    config = IdentifyConfig(
        search=CmaConfig(generations=20), generations_in_c=most, refine=RefineConfig() if refined else None
    )
    scene = door_scene() if contacts else elbow()
    assert pipeline._search_settings(config, engine, scene).generations == generations
