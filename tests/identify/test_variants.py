"""Recordings of one robot in other set-ups, whose MJCF has other numbers: an arm that is empty, loaded, or tilted."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pendulum as made
import pytest
from pendulum import MJCF, PARAMETERS, START, TRUE, swung

from droid_jax.cost.cost import make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.cost.windowed_log import windowed_log
from droid_jax.identify.evaluation import evaluate_on
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import Identified, IdentifyConfig, identify_parameters
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effect_interface import Effect, State
from droid_jax.model.effects.registry import effect_space, in_variant, library
from droid_jax.model.fields import body_mass, body_mass_scale, joint_damping, model_parameter
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.model.variant import numbers_that_differ, variant_scene
from droid_jax.preflight.inspect_log import inspect_log
from droid_jax.recordings.formats import load_recording, save_recording
from droid_jax.recordings.recording import Recording
from droid_jax.run import main
from droid_jax.simulate.c_engine import instrument
from droid_jax.simulate.windows import WindowConfig

LOAD, TILT = 0.3, 0.5  # kg, rad
PAYLOAD = (
    '<body name="payload" pos="0 0 -0.2"><inertial pos="0 0 0" mass="{0}" diaginertia="{1:g} {1:g} {1:g}"/></body>'
)
EMPTY, LOADED = PAYLOAD.format(1e-6, 1e-9), PAYLOAD.format(LOAD, 1e-9 * LOAD / 1e-6)


def arm(payload: str = EMPTY, tilt: float = 0.0) -> str:
    """The pendulum's MJCF with a body for a payload, its base tilted by an angle [rad] about the joint's axis."""
    quat = f"{np.cos(tilt / 2):.17g} 0 {np.sin(tilt / 2):.17g} 0"
    base = MJCF.replace(
        "<body>",
        f'<body name="base" quat="{quat}"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><body name="arm">',
    )
    return base.replace("</body>", payload + "</body></body>")


def scene_of(mjcf: str, name: str = "arm", **numbers: float) -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(mjcf.format(**START | numbers)), name)


@pytest.fixture(scope="module")
def setups() -> SimpleNamespace:
    """A scene, empty and upright, and logs of three set-ups that state what differs."""
    scene, logs = scene_of(arm()), dict[str, Recording]()
    with pytest.MonkeyPatch.context() as patch:
        for name, mjcf, frequency in (
            ("empty", arm(), 0.8), ("loaded", arm(LOADED), 1.1), ("tilted", arm(tilt=TILT), 0.6)
        ):  # fmt: skip
            patch.setattr(made, "MJCF", mjcf)
            log = swung(name, 1.0, frequency, ("position", "torque"))
            logs[name] = replace(log, variant=numbers_that_differ(scene, scene_of(mjcf)))
    space = Space(
        tuple(
            model_parameter(scene, unit="", **{k: v for k, v in entry.items() if k != "scaling"})
            for entry in PARAMETERS
        )
    )
    return SimpleNamespace(scene=scene, space=space, logs=logs)


def bare(log: Recording) -> Recording:
    """The log without its commands."""
    return replace(log, time=np.zeros(0), command=np.zeros((0, 0)), command_names=(), gains=None)


def fitted(setups: SimpleNamespace, logs: list[Recording], engine: str) -> Identified:
    search, still = CmaConfig(generations=2, population=4, parents=None), RefineConfig(basin_hops=0)
    config = IdentifyConfig(engine=engine, search=search, refine=still, samples=0, checks=False, channels=("position",))
    return identify_parameters(setups.scene, setups.space, logs, config=config)


def test_what_differs_is_stated_by_names(setups: SimpleNamespace):
    assert setups.logs["empty"].variant == {}
    assert setups.logs["loaded"].variant == {
        "body_mass": {"payload": [LOAD]}, "body_inertia": {"payload": [pytest.approx(3e-4)] * 3}
    }  # fmt: skip
    half = TILT / 2
    assert setups.logs["tilted"].variant == {"body_quat": {"base": pytest.approx([np.cos(half), 0, np.sin(half), 0])}}


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])
def test_parameters_come_back_from_an_empty_a_loaded_and_a_tilted_arm(setups: SimpleNamespace, engine: str):
    """Without what they state, one model for all three leaves much."""
    logs = list(setups.logs.values())
    found = fitted(setups, logs, engine)
    assert found.best[0] == pytest.approx(TRUE["damping"], rel=0.03)
    assert found.best[1] == pytest.approx(TRUE["armature"], abs=6e-4)  # plain C's time step adds 4e-4 of inertia
    if engine == "mujoco":
        pooled = fitted(setups, [replace(log, variant={}) for log in logs], engine)
        for name in ("loaded", "tilted"):
            assert found.heldout_distances[name].after < 2e-3 < 2e-2 < pooled.heldout_distances[name].after


@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_a_variant_is_replayed_as_the_known_value_that_it_stands_for(setups: SimpleNamespace, engine: str):
    """A payload, with commands and without, whose inertia goes with its mass in both."""
    scene, log, plain = setups.scene, setups.logs["loaded"], {"position": 1.0, "torque": 1.0}
    mass = body_mass(scene, "payload", mean=0.1, std=0.1, low=0.0, high=1.0, name="payload")
    known = setups.space + Space((mass,))
    rows = np.stack([setups.space.mean, setups.space.values(TRUE)])
    for one, channels in ((log, plain), (bare(log), {"torque": 1.0})):
        config, stated = CompareConfig(channels=channels), replace(one, variant={}, known={"payload": LOAD})
        cost = make_cost(scene, setups.space, one, engine=engine, config=config, check=False)
        other = make_cost(scene, known, stated, engine=engine, config=config, check=False)
        expected = other(known.embed(setups.space, rows))
        np.testing.assert_allclose(cost(rows), expected, rtol=2e-3)
        if engine == "mujoco":
            empty = make_cost(scene, setups.space, replace(one, variant={}), engine=engine, config=config, check=False)
            assert empty(rows)[1] > 5 * expected[1]
        with pytest.raises(ValueError, match="states another variant"):
            cost.against([replace(one, variant={})])
        np.testing.assert_allclose(cost.against([one])(rows), cost(rows), rtol=1e-6)


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_windows_and_whole_motions_have_the_numbers_of_their_log(setups: SimpleNamespace, whole: bool):
    config, logs = CompareConfig(channels={"position": 1.0}), [setups.logs[name] for name in ("empty", "loaded")]

    def off(logs: list[Recording]) -> float:
        cost = windowed_log(setups.scene, setups.space, logs, config, WindowConfig(), whole=whole)
        return float(np.sqrt(np.mean((cost.simulated(setups.space.values(TRUE)[None])[0] - cost.measured) ** 2)))

    assert 3 * off(logs) < off([replace(log, variant={}) for log in logs])


def test_a_tilted_base_is_replayed_as_another_direction_of_gravity(setups: SimpleNamespace):
    """That a variant states, and that the effect has as a known value."""
    scene, log = setups.scene, setups.logs["tilted"]
    (lean,) = library(scene, ["gravity_direction"])
    space, tilt = setups.space + effect_space([lean]), 0.08
    quat = [np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0]
    down = [9.81 * np.sin(tilt), 0.0, -9.81 * np.cos(tilt)]  # as seen from the base
    config = CompareConfig(channels={"position": 1.0})

    def cost(engine: str, effects: tuple[Effect, ...] = (), **stated: Any) -> float:
        of, full = replace(log, **{"variant": {}, **stated}), space if effects else setups.space
        made = make_cost(scene, full, of, engine=engine, config=config, effects=effects, check=False)
        return float(made(full.mean[None])[0])

    turned = cost("mujoco", variant={"body_quat": {"base": quat}})
    assert cost("mujoco", variant={"opt": {"gravity": down}}) == pytest.approx(turned, rel=1e-4)
    assert cost("mjx", variant={"body_quat": {"base": quat}}) == pytest.approx(turned, rel=0.01)
    assert cost("mjx", (lean,), known={lean.parameters[0].name: -tilt}) == pytest.approx(turned, rel=0.01)
    assert abs(cost("mujoco") - turned) > 0.04 * turned


def test_a_variant_equals_its_mjcf(setups: SimpleNamespace):
    """In what a body, a site's tendon, an equality and a servo do, bit for bit, and in all that is derived."""
    frame = (
        '<mujoco><worldbody><body name="a"><joint name="j1" axis="0 1 0"/>{inertia}<site name="s" pos="0.1 0 0"/>'
        '<geom type="box" pos="0.1 0 0" size=".1 .02 .03"/><body name="b" pos=".2 0 0"><joint name="j2" axis="0 1 0"/>'
        '<geom size=".05" pos="{at}"/><site name="t" pos="{at}"/></body></body><body name="c" pos="0 1 0">'
        '<joint name="j3" axis="0 1 0"/><geom size=".1"/></body></worldbody><equality>'
        '<joint joint1="j1" joint2="j3" polycoef="0 {ratio} 0 0 0"/><connect body1="b" body2="c" anchor="0.1 0 0"/>'
        '</equality><tendon><spatial stiffness="1"><site site="s"/><site site="t"/></spatial></tendon>'
        '<actuator><position joint="j1" kp="{kp}"/></actuator></mujoco>'
    )
    usual = {"inertia": "", "at": "0 0 0", "ratio": 1, "kp": 10}
    heavy = '<inertial pos="0.15 0 0.01" quat="1 .1 0 0" mass="2" diaginertia="1e-2 2e-2 2e-2"/>'

    def compiled(**numbers) -> Scene:
        spec = mujoco.MjSpec.from_string(frame.format(**usual | numbers))
        return compile_scene(spec, "frame", engine="mujoco")

    def state(model: mujoco.MjModel) -> np.ndarray:
        data = mujoco.MjData(model)
        data.qpos[:], data.ctrl[:] = (0.1, 0.2, 0.3), 0.1
        mujoco.mj_step(model, data, 50)
        return np.concatenate(
            [data.qpos, data.qvel, data.geom_xpos.ravel(), data.site_xpos.ravel(), data.geom_xmat.ravel()]
        )

    base = compiled()
    for numbers in ({"inertia": heavy}, {"at": "0.1 0 0"}, {"ratio": 2}, {"kp": 30}):
        other = compiled(**numbers)
        for one, two in ((base, other), (other, base)):
            own = variant_scene(one, numbers_that_differ(one, two))
            for model in (own.model, instrument(own)):
                np.testing.assert_array_equal(state(model), state(two.model))
            assert np.abs(state(one.model) - state(two.model)).max() > 1e-3
            assert variant_scene(own, numbers_that_differ(one, two)) is own


def test_parameters_act_on_the_numbers_that_a_recording_states(setups: SimpleNamespace):
    """A share of its mass; one that would be the number itself is refused."""
    scene, stated = setups.scene, setups.logs["loaded"].variant
    share = Space((body_mass_scale(scene, "payload"),))
    model = make_c_model(variant_scene(scene, stated), share, np.array([1.2]))
    assert model.body("payload").mass[0] == pytest.approx(1.2 * LOAD)
    own = Space((body_mass(scene, "payload", mean=0.1, std=0.1, high=1.0),))
    for given, of, where in (
        (own, stated, "sets body_mass of 'payload'"),
        (Space((joint_damping(scene, "swing", std=0.1, high=1.0),)), {"dof_damping": {"swing": 0.2}}, "dof_damping"),
    ):
        for log in (replace(setups.logs["empty"], variant=of), bare(replace(setups.logs["empty"], variant=of))):
            config = CompareConfig(channels={"torque": 1.0})
            with pytest.raises(ValueError, match=f"'empty': .*{where}.*which the recording states.*let it scale"):
                make_cost(scene, given, log, engine="mujoco", config=config, check=False)
    user = Effect("user", own.parameters)
    with pytest.raises(ValueError, match=r"sets body_mass.*leave the effect out \(--without user\)"):
        config = CompareConfig(channels={"position": 1.0})
        make_cost(scene, own, setups.logs["loaded"], engine="mujoco", config=config, effects=[user], check=False)
    with pytest.raises(ValueError, match="numbers of another recording already"):
        variant_scene(variant_scene(scene, stated), setups.logs["tilted"].variant)


def test_effects_have_the_laws_of_the_variant(setups: SimpleNamespace):
    """A load's moment hangs along the gravity that the recording states."""
    stated = {"opt": {"gravity": [0.0, 0.0, -1.62]}}
    own, effects = variant_scene(setups.scene, stated), library(setups.scene, ["payload"])
    state = State(jnp.float32(0), jnp.array([0.3]), jnp.zeros(1), jnp.zeros(1), own.mjx)
    theta = {p.name: jnp.float32(0.1) for p in effects[0].parameters}
    (moved,) = in_variant(own, effects)
    assert in_variant(setups.scene, effects) is effects and moved.parameters is effects[0].parameters
    assert effects[0].force is not None and moved.force is not None
    on_earth = np.asarray(effects[0].force(theta, state))
    np.testing.assert_allclose(np.asarray(moved.force(theta, state)), on_earth * 1.62 / 9.81, rtol=1e-5)


def test_relative_effects_act_on_the_gain_that_a_recording_states(setups: SimpleNamespace):
    scene, kp = setups.scene, 2.0
    stated = numbers_that_differ(scene, scene_of(arm(), kp=kp))
    effects = library(scene, ["servo_gain"])
    space = effect_space(effects)
    log = replace(setups.logs["empty"], variant=stated, gains=None)
    make_cost(scene, space, log, engine="mujoco", config=CompareConfig(channels={"position": 1.0}), effects=effects)
    model = make_c_model(variant_scene(scene, stated), space, np.array([0.1]))
    assert model.actuator_gainprm[0, 0] == -model.actuator_biasprm[0, 1] == pytest.approx(1.1 * kp)


def test_effects_that_the_scene_of_a_variant_would_not_get(setups: SimpleNamespace):
    """Without weight an encoder's zero changes nothing; without stiffness a gear's compliance has no servo."""
    own = variant_scene(setups.scene, {"opt": {"gravity": [0.0, 0.0, 0.0]}})
    offset, gear = library(setups.scene, ["encoder_offset", "joint_compliance"])
    assert library(own, ["encoder_offset"]) == () and in_variant(own, (offset,)) == (offset,)
    own = variant_scene(setups.scene, numbers_that_differ(setups.scene, scene_of(arm(), kp=0.0)))
    with pytest.raises(ValueError, match=r"'joint_compliance': leave it out \(--without joint_compliance\)"):
        in_variant(own, (gear,))


def law_in(setups: SimpleNamespace, name: str, stated: dict[str, Any], values: dict[str, float], law: str, q: float):
    """A law of an effect in a variant, at a position q [rad] and 1 rad/s."""
    own, effects = variant_scene(setups.scene, stated), library(setups.scene, [name])
    (effect,) = in_variant(own, effects)
    theta = {p.name: jnp.float32(values[p.name.split("[")[0]]) for p in effect.parameters}
    state = State(jnp.float32(0), jnp.array([q]), jnp.ones(1), jnp.zeros(1), own.mjx)
    return np.asarray(getattr(effect, law)(theta, state)).ravel()


def test_the_unit_of_a_slope_is_the_same_in_all_recordings(setups: SimpleNamespace):
    """A limit falls by the same N m per rad/s on an empty arm and on a loaded one, whose usual torque is larger."""
    values = {"torque_speed_line": 0.1, "torque_speed_slope": 0.2}
    empty, loaded = (
        law_in(setups, "torque_speed_line", setups.logs[name].variant, values, "limits", 0.0)
        for name in ("empty", "loaded")
    )
    assert np.isfinite(empty).all() and not np.allclose(empty, [-10.0, 10.0])
    np.testing.assert_allclose(loaded, empty, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("payload", {"payload_mass": 0.0, "payload_moment": 0.1}),
        ("free_payload", {"load_mass": 0.0, "load_moment_x": 0.1, "load_moment_z": 0.05}),
    ],
)
def test_a_load_hangs_at_the_same_place_in_all_recordings(setups: SimpleNamespace, name: str, values: dict[str, float]):
    """Also on an arm whose heaviest body, or centre of mass, is another one with the recording's numbers."""
    plain = law_in(setups, name, {}, values, "force", 0.3)
    assert abs(plain[0]) > 1e-3
    heavy = {"body_mass": {"payload": [5.0]}, "body_quat": {"payload": [0.6, 0.0, 0.8, 0.0]}}
    aside = {"body_ipos": {"arm": [0.1, 0.0, 0.0]}}
    for stated in (heavy, aside):
        np.testing.assert_allclose(law_in(setups, name, stated, values, "force", 0.3), plain, rtol=1e-5)
    weightless = law_in(setups, name, {"opt": {"gravity": [0.0, 0.0, 0.0]}}, values, "force", 0.3)
    assert weightless == pytest.approx(0.0, abs=1e-9)


def test_gravity_leans_about_the_same_axes_in_all_recordings(setups: SimpleNamespace):
    """The recordings share the angle about y, although x and z are nearer to perpendicular to this gravity."""
    stated, values = {"opt": {"gravity": [0.0, 9.0, 3.0]}}, {"gravity_about_y": 0.1}
    assert abs(law_in(setups, "gravity_direction", stated, values, "force", 0.3)[0]) > 1e-2


def test_findings_and_evaluations_are_of_the_variant(setups: SimpleNamespace):
    scene, space, log = setups.scene, setups.space, setups.logs["loaded"]
    said = " ".join(finding.sentence for finding in inspect_log(log, scene))
    assert (
        "has numbers of its own (variant): body_inertia of payload 0.0003 0.0003 0.0003, body_mass of payload" in said
    )
    (strange, *_) = inspect_log(replace(log, variant={"body_mass": {"hand": 1.0}}), scene)
    assert strange.severity == "certain" and "has no such body" in strange.sentence
    best = space.values(TRUE)
    (own,) = evaluate_on(scene, space, [log], before=space.mean, after=best, engine="mujoco")
    (plain,) = evaluate_on(scene, space, [replace(log, variant={})], before=space.mean, after=best, engine="mujoco")
    assert 5 * own.errors["position"].mae_after[0] < plain.errors["position"].mae_after[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: m.replace('name="arm"', 'name="forearm"'), "the same bodies.*lacks arm, and it has also forearm"),
        (lambda m: m.replace('"swing"', '"swung"'), "the same joints.*lacks swing, and it has also swung"),
        (lambda m: m.replace(EMPTY, ""), "the same bodies.*lacks payload.*a payload that is not there a mass of 1e-6"),
        (
            lambda m: m.replace(EMPTY, EMPTY.replace("<inertial", '<joint name="wrist"/><inertial')),
            "the same joints.*has also wrist",
        ),
        (lambda m: m.replace('"0.004"', '"0.002"'), r"differs from 'arm' in option timestep \(0.004 and 0.002\)"),
        (
            lambda m: m.replace('axis="0 1 0"', 'axis="0 1 0" range="-1 1"'),
            "in jnt_limited of swing, which.*cannot state",
        ),
        (lambda m: m.replace('name="payload"', 'name="payload" gravcomp="1"'), "compensates no weight"),
    ],
)
def test_what_is_no_variant_is_refused(setups: SimpleNamespace, change, said: str):
    with pytest.raises(ValueError, match=said):
        numbers_that_differ(setups.scene, scene_of(change(arm()), "other"))


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (
            {"body_mass": {"hand": 1.0}},
            "recording 'empty': states body_mass of 'hand'.*no such body; it has: world, base, arm, payload",
        ),
        ({"body_mass": {"arm": [1.0, 2.0]}}, "states 2 numbers of body_mass of 'arm'"),
        ({"body_subtreemass": {"arm": 1.0}}, "'body_subtreemass'.*is no number"),
        ({"body_quat": {"base": [0, 0, 0, 0]}}, "body_quat of 'base' .*length 0"),
        ({"jnt_limited": {"swing": 1.0}}, "'jnt_limited'.*is no number"),
        ({"opt": {"timestep": 0.001}}, "of the options it can only gravity"),
        ({"body_mass": {"arm": "heavy"}}, "body_mass of 'arm' must be a number"),
        ({"body_mass": 1.0}, "'body_mass' must map elements to their numbers"),
    ],
)
def test_what_a_recording_cannot_state_is_refused(setups: SimpleNamespace, stated: dict, said: str):
    with pytest.raises(ValueError, match=said):
        make_cost(setups.scene, setups.space, replace(setups.logs["empty"], variant=stated), engine="mujoco")


def test_the_place_of_a_body_on_a_free_joint_is_in_no_variant():
    free = MJCF.replace("<body>", '<body name="base"><freejoint/><geom size="0.1"/><body name="arm">')
    scene = scene_of(free.replace("</body>", "</body></body>"))
    with pytest.raises(ValueError, match="on a free joint: take mocap or that joint out"):
        variant_scene(scene, {"body_pos": {"base": [0.0, 0.0, 1.0]}})


def test_convert_states_a_variant_and_the_pose_of_the_base(
    setups: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for name, mjcf in (("arm", arm()), ("loaded", arm(LOADED))):
        (tmp_path / f"{name}.xml").write_text(mjcf.format(**START))
    save_recording(replace(setups.logs["loaded"], variant={}), tmp_path / "log.npz")
    words = ["convert", str(tmp_path / "log.npz"), "--out", str(tmp_path / "out.npz")]
    mjcf = ["--scene", str(tmp_path / "arm.xml"), "--variant", str(tmp_path / "loaded.xml")]
    pose = ["--base-pose", "base", "0", "-0.1", "0.5", "0.8", "0", "0.6", "0"]
    assert main([*words, *mjcf]) == 0
    assert "numbers of this recording alone: body_inertia of payload" in capsys.readouterr().out
    found = load_recording(tmp_path / "out.npz")
    assert found.variant == setups.logs["loaded"].variant and found.sha256 == setups.logs["loaded"].sha256
    assert main([*words, *mjcf, *pose]) == 0
    expected = {"body_pos": {"base": [0.0, -0.1, 0.5]}, "body_quat": {"base": [0.8, 0.0, 0.6, 0.0]}}
    assert load_recording(tmp_path / "out.npz").variant == {**setups.logs["loaded"].variant, **expected}
    assert "dropped" not in capsys.readouterr().out
    save_recording(load_recording(tmp_path / "out.npz"), tmp_path / "log.npz")
    assert main([*words, *mjcf]) == 0
    assert "earlier, which are dropped: body_pos of base 0 -0.1 0.5, body_quat of base 0.8" in capsys.readouterr().out
    for wrong, said in (
        (mjcf[2:], "--variant and --scene go together"),
        (["--base-pose", "world", *pose[2:]], "the world does not move: name the robot's first body"),
        ([*pose[:5], "0", "0", "0", "0"], "the quaternion w x y z has length 0"),
    ):
        assert main([*words, *wrong]) == 2
        assert re.search(said, capsys.readouterr().err)
