"""A fit in plain MuJoCo: numbers, draws and laws of fitted.json are the program's own, without jax."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from small_gap import SCENE, demonstration, small_scene

from droid_jax import runtime
from droid_jax.identify import apply_fit
from droid_jax.identify.gaussian import Gaussian, prior
from droid_jax.identify.neutral_result import neutral_json, with_numbers, write_neutral
from droid_jax.model.effect_interface import Effect, State, complete
from droid_jax.model.effects.registry import effect_space, joined, library, ready
from droid_jax.model.fields import joint_damping
from droid_jax.model.law_tables import LawTable, NoTable, law_tables
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model, make_physics, theta_of
from droid_jax.model.scene import Scene, compile_scene, load_scene
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.simulate.replay import make_drive, servo_replay
from droid_jax.simulate.servo_gains import servo_factors

ROOT = Path(__file__).resolve().parents[2]
FORCES = {"latch_torque": 1.5, "latch_width": 0.05, "latch_exponent": 1.4, "tilt_sine": 0.3, "drag": 0.4}
FRICTIONS = {"load_friction[elbow]": 0.1, "joint_stribeck[shoulder]": 0.2, "joint_directional[elbow]": -0.05}
OTHERS = {"command_delay": 0.007, "joint_backlash[shoulder]": 0.004, "torque_bias[elbow]": 0.1, "hinge_preload": 0.4}
VALUES = {**FORCES, **FRICTIONS, **OTHERS}
EFFECTS = ("command_delay", "drag", "hinge_preload", "joint_backlash", "joint_directional", "joint_stribeck", "latch",
           "load_friction", "tilted_frame", "torque_bias")  # fmt: skip
FIELDS = ("body_mass", "body_inertia", "dof_damping", "jnt_stiffness", "dof_frictionloss", "actuator_gainprm",
          "actuator_biasprm", "qpos_spring", "body_gravcomp")  # fmt: skip


class Made:
    """A made-up fit of the bench, and its folder."""

    def __init__(self, folder: Path, values: Mapping[str, float]) -> None:
        scene, base = small_scene()
        self.effects: tuple[Effect, ...] = library(scene, EFFECTS)
        self.scene: Scene = ready(scene)
        self.space: Space = base + effect_space(self.effects).select(values)
        self.values = self.space.values({"forearm_mass": 1.1, "door_stiffness": 0.65, **values})
        rng = np.random.default_rng(0)
        root = 0.2 * np.eye(len(self.space)) + 0.02 * rng.normal(size=(len(self.space),) * 2)
        self.gaussian = Gaussian(self.space, self.space.to_search(self.values), root @ root.T, "made up")
        self.folder = folder
        write_neutral(folder, self.scene, self.gaussian, self.values, self.effects, main="fitted.xml")
        self.fit = apply_fit.load(folder / "fitted.json")

    def at(self, values: Mapping[str, float]) -> np.ndarray:
        return np.array([values[name] for name in self.space.names])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp("neutral"), VALUES)


def test_the_file_is_that_of_the_user(made: Made):
    mjcf = made.fit["mjcf"]
    assert mjcf["in_place"], mjcf["reason"]
    own, text = SCENE.read_text().splitlines(), (made.folder / "fitted.xml").read_text().splitlines()
    assert 1 <= len({*own} - {*text}) <= len(mjcf["changes"])  # all other lines are there
    assert len(text) <= len(own) + 2  # a mass that geoms made up is a line of its own
    stiffness = next(c for c in mjcf["changes"] if (c["name"], c["attribute"]) == ("door", "stiffness"))
    low, high = made.gaussian.interval(0.9)
    k = made.space.index("door_stiffness")
    assert stiffness["after"] == pytest.approx(0.65) and stiffness["interval"] == pytest.approx([low[k], high[k]])
    assert 'name="door"' in own[stiffness["line"] - 1] and own[stiffness["line"] - 1] not in text


@pytest.mark.parametrize("sample", [None, 3])
@pytest.mark.parametrize("file", ["own", "fitted"])
def test_numbers_are_written_into_spec_and_model(made: Made, sample: int | None, file: str):
    """The target is the user's file or the fitted one, which may express a law as a number already."""
    path = SCENE if file == "own" else made.folder / "fitted.xml"
    spec, model = mujoco.MjSpec.from_file(str(path)), mujoco.MjModel.from_xml_path(str(path))
    values = apply_fit.apply(spec, made.fit, sample)
    assert apply_fit.apply(model, made.fit, sample) == values
    assert sample is not None or made.at(values) == pytest.approx(made.values)
    expected = make_c_model(made.scene, made.space, made.at(values))
    for name in FIELDS:
        for written in (model, spec.compile()):
            np.testing.assert_allclose(
                getattr(written, name), getattr(expected, name), rtol=1e-6, atol=2e-6, err_msg=name
            )
    np.testing.assert_allclose(model.dof_invweight0, expected.dof_invweight0, rtol=1e-6)


def test_a_batch_holds_the_draws_that_apply_writes(made: Made):
    """Row by row, in every field; fields that no draw changes are missing, and the model is unchanged."""
    model = mujoco.MjModel.from_xml_path(str(SCENE))
    damping = model.dof_damping.copy()
    fields = apply_fit.batch(model, made.fit, 5, seed=2)
    assert {"body_mass", "dof_damping", "dof_invweight0"} <= set(fields) and "geom_size" not in fields
    np.testing.assert_array_equal(model.dof_damping, damping)
    for k in range(5):
        one = mujoco.MjModel.from_xml_path(str(SCENE))
        apply_fit.apply(one, made.fit, sample=k, seed=2)
        for name in (n for n in dir(one) if n.startswith(("body_", "jnt_", "dof_", "geom_", "actuator_", "tendon_"))):
            written = fields[name][k] if name in fields else getattr(model, name)
            np.testing.assert_allclose(written, getattr(one, name), rtol=1e-9, atol=1e-12, err_msg=name)
    assert np.ptp(fields["body_mass"], axis=0).max() > 0.1


def test_a_batch_finds_the_robot_in_a_larger_scene(made: Made):
    """Names have a prefix there.  An element without a name is refused, since its number differs."""
    scene, robot = mujoco.MjSpec(), mujoco.MjSpec.from_file(str(SCENE))
    scene.option = robot.option
    scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1])
    scene.attach(robot, prefix="robot/", frame=scene.worldbody.add_frame(pos=[2, 0, 0]))
    model, alone = scene.compile(), mujoco.MjModel.from_xml_path(str(SCENE))
    there, here = apply_fit.batch(model, made.fit, 3, prefix="robot/"), apply_fit.batch(alone, made.fit, 3)
    joint, own = model.joint("robot/door").dofadr[0], alone.joint("door").dofadr[0]
    np.testing.assert_array_equal(there["dof_damping"][:, joint], here["dof_damping"][:, own])
    with pytest.raises(ValueError, match="has no body 'arm/forearm'"):
        apply_fit.batch(model, made.fit, 1, prefix="arm/")
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        apply_fit.batch(model, made.fit, 0)
    nameless = {**made.fit, "table": [{**made.fit["table"][0], "name": ""}]}
    with pytest.raises(ValueError, match="give it a name in the MJCF"):
        apply_fit.batch(model, nameless, 1, prefix="robot/")


def test_draws_are_those_of_the_gaussian(made: Made):
    """Mean and covariance of 100 draws agree within four sampling errors; draw 7 is the same in every call."""
    few = made.space.to_search(apply_fit.draws(made.fit, range(100), seed=1))
    many = made.space.to_search(made.gaussian.sample(0, 20_000))
    spread = many.std(axis=0)
    assert np.all(np.abs(few.mean(axis=0) - many.mean(axis=0)) < 4 * spread / 10)
    assert np.all(np.abs(few.var(axis=0) / spread**2 - 1) < 4 * np.sqrt(2 / 100))
    apart = np.arctanh(np.corrcoef(few.T) - 1e-9) - np.arctanh(np.corrcoef(many.T) - 1e-9)
    assert np.all(np.abs(apart[np.triu_indices(len(spread), 1)]) < 4.2 / np.sqrt(97))
    assert (
        apply_fit.draw(made.fit, 7, seed=1)["drag"]
        == apply_fit.draws(made.fit, [3, 7], seed=1)[1][made.space.index("drag")]
    )


def test_a_gaussian_beyond_its_bounds_is_drawn_inside(made: Made):
    """Hardly any row of the normal is inside the bounds."""
    fit = json.loads(json.dumps(made.fit))
    k, p = made.space.index("drag"), made.space["drag"]
    fit["gaussian"]["mean"][k] = -9.0 * p.std
    few, many = apply_fit.draws(fit, range(40)), replace(made.gaussian, mean=np.array(fit["gaussian"]["mean"]))
    assert np.all((few >= made.space.low) & (few <= made.space.high))
    assert few[:, k].mean() == pytest.approx(many.sample(0, 200)[:, k].mean(), rel=0.6)


def laws_of(made: Made, sample: int | None) -> tuple[apply_fit.Laws, mujoco.MjModel, dict[str, float]]:
    model = mujoco.MjModel.from_xml_path(str(SCENE))
    values = apply_fit.apply(model, made.fit, sample)
    return apply_fit.forces(model, made.fit, values), model, values


@pytest.mark.parametrize("sample", [None, 5])
def test_laws_are_those_of_the_effects(made: Made, sample: int | None):
    """Forces and frictions at random states, at the fitted values and at a draw."""
    laws, model, values = laws_of(made, sample)
    fitted, theta = with_numbers(made.scene, made.space, made.at(values)), theta_of(made.space, made.at(values))
    theta = complete({name: jnp.float32(value) for name, value in theta.items()}, made.effects)
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    base = jnp.asarray(laws._base, jnp.float32)
    for _ in range(20):
        data.qpos[:], data.qvel[:] = rng.uniform(-0.2, 0.5, model.nq), rng.normal(0.0, 0.5, model.nv)
        data.qfrc_actuator[:] = rng.normal(0.0, 2.0, model.nv)
        state = State(jnp.float32(0), *map(jnp.float32, (data.qpos, data.qvel, data.qfrc_actuator)), fitted)
        force, loss = jnp.zeros(model.nv), base
        for effect in made.effects:
            force = force if effect.force is None else force + effect.force(theta, state)
            loss = loss if effect.frictionloss is None else effect.frictionloss(theta, state, loss)
        np.testing.assert_allclose(laws.force(data), force, atol=5e-3 if sample is None else 0.04)
        np.testing.assert_allclose(laws.frictionloss(data), loss, atol=2e-3)


def test_drives_are_the_servos_at_their_joints(made: Made):
    model = make_c_model(made.scene, made.space, made.values)
    for drive in made.fit["drives"]:
        u, d = made.scene.command_names.index(drive["joint"]), made.scene.dof(drive["joint"])
        assert drive["stiffness"] == pytest.approx(model.actuator_gainprm[u, 0] * model.actuator_gear[u, 0] ** 2)
        assert (drive["armature"], drive["friction"]) == (model.dof_armature[d], model.dof_frictionloss[d])
    assert [drive["joint"] for drive in made.fit["drives"]] == list(made.scene.driven_joints)
    left_out = {drive["joint"]: drive["left_out"] for drive in made.fit["drives"]}
    assert left_out["elbow"] == ["joint_directional", "load_friction"]
    assert left_out["shoulder"] == ["joint_backlash", "joint_stribeck"]


def test_drives_hold_constant_friction_of_effects_and_the_damping_of_all_actuators():
    """A <velocity> beside the servo damps with a gear of its own; a limit that falls with speed is left out."""
    scene = ready(compile_scene(mujoco.MjSpec.from_string("""<mujoco><worldbody><body>
      <joint name="j" axis="0 1 0" damping="0.3" frictionloss="0.2"/><geom size=".1" pos=".3 0 0"/></body></worldbody>
      <actuator><position name="p" joint="j" kp="50" kv="1" gear="2"/><velocity name="d" joint="j" kv="2" gear="3"/>
      </actuator></mujoco>"""), "damped"))  # fmt: skip
    effects = library(scene, ["joint_coulomb", "torque_speed_line"])
    space = effect_space(effects).select(["joint_coulomb[j]", "torque_speed_line[j]"])
    values, gaussian = np.array([0.5, 0.1]), Gaussian(space, np.zeros(2), 0.01 * np.eye(2), "made up")
    (drive,) = neutral_json(scene, gaussian, values, effects, None, "", {})["drives"]
    assert (drive["stiffness"], drive["damping"]) == (50 * 2**2, 1 * 2**2 + 2 * 3**2)
    assert (drive["friction"], drive["viscous_friction"]) == (pytest.approx(0.7), 0.3)
    assert drive["left_out"] == ["torque_speed_line"]


def test_laws_name_their_variables(made: Made):
    by = {(law["effect"], law["joint"]): law for law in made.fit["laws"]}
    axes = {key: [a["name"] for a in law["axes"]] for key, law in by.items()}
    assert axes["latch", "door"] == ["latch_width", "latch_exponent", "position"]
    assert axes["drag", "door"] == ["speed"] and axes["load_friction", "elbow"] == ["load"]
    assert axes["joint_backlash", "shoulder"] == ["joint_backlash[shoulder]", "torque"]
    assert by["command_delay", ""]["terms"] == [{"parameter": "command_delay", "table": 1.0}]
    assert "torque_bias" not in {law["effect"] for law in made.fit["laws"]}  # of the sensor
    lacking = {each["parameter"] for each in made.fit["not_in_mjcf"]}
    assert {"latch_torque", "torque_bias[elbow]", "torque_offset[elbow]"} <= lacking
    assert all(law["error"] < 5e-3 for law in made.fit["laws"] if law["effect"] != "drag")
    drag = made.fit["laws"][[law["effect"] for law in made.fit["laws"]].index("drag")]
    assert drag["error"] < 1e-3 * made.values[made.space.index("drag")] * drag["axes"][0]["nodes"][-1] ** 2


def test_a_law_without_a_table_is_listed_and_the_others_are_written(made: Made):
    """One that depends on two joints, one that depends on another joint, and one that fails."""

    def of_two(theta: Any, state: Any) -> Any:
        return jnp.zeros_like(state.qvel).at[0].set(theta["size"] * state.qpos[0] * state.qpos[1])

    def failing(theta: Any, state: Any) -> Any:
        raise RuntimeError("no such thing")

    parameter = Parameter("size", "N m", 0.0, 1.0, -1.0, 1.0)

    def of_another(theta: Any, state: Any) -> Any:
        return jnp.zeros_like(state.qvel).at[0].set(theta["size"] * state.qpos[1])

    failures = (of_two, "several joints"), (of_another, "another joint"), (failing, "RuntimeError: no such thing")
    for force, said in failures:
        effect = Effect("own", (parameter,), force=force, locations={"elbow": ("size",)})
        (found,) = law_tables(made.scene, made.scene.mjx, [effect], {"size": 0.5}, {"size": 0.1})
        assert isinstance(found, NoTable) and said in found.why


def table_of(made: Made, name: str, values: dict[str, float]) -> LawTable | NoTable:
    """The table of an effect of the library at one joint, at given values."""
    found = list(law_tables(made.scene, made.scene.mjx, library(made.scene, [name]), values, {}))
    assert len(found) == 1
    return found[0]


def test_the_table_of_a_law_of_load_covers_the_loads(made: Made):
    """There is no force limit that sets the range."""
    table = table_of(made, "load_friction", {"load_friction[elbow]": 0.1})
    assert isinstance(table, LawTable) and table.axes[0].name == "load" and table.error < 1e-3
    np.testing.assert_allclose(np.interp([0.05, 300.0], table.axes[0].nodes, table.terms[0][1]), [0.05, 300.0])


STRIBECK = {"joint_stribeck[shoulder]": 0.2, "joint_stribeck_speed": 0.005, "joint_stribeck_exponent": 2.0}
LATCH = {"latch_torque": 0.2, "latch_width": 0.01, "latch_exponent": 2.5}


@pytest.mark.parametrize(
    ("name", "values", "variable"), [("joint_stribeck", STRIBECK, "speed"), ("latch", LATCH, "position")]
)
def test_a_law_that_acts_in_a_narrow_range_has_a_table(made: Made, name: str, values: dict[str, float], variable: str):
    """Friction within some mrad/s, a latch within a hundredth of a radian."""
    table = table_of(made, name, values)
    assert isinstance(table, LawTable) and table.axes[-1].name == variable


def test_a_ripple_has_a_table_where_its_periods_have_nodes(made: Made):
    """Two nodes per period are too few: a ripple may be zero at all of them."""
    ripple = {"ripple_sine[elbow]": 0.3, "ripple_periods": 64.0}
    table = table_of(made, "torque_ripple", ripple)
    assert isinstance(table, LawTable) and table.error < 0.03

    def made_of(shape: Any) -> LawTable | NoTable:
        def force(theta: Any, state: Any) -> Any:
            return jnp.zeros_like(state.qvel).at[0].set(theta["size"] * shape(state.qpos[0]))

        effect = Effect("shaped", (Parameter("size", "N m", 0.0, 1.0, -1.0, 1.0),), force=force)
        return next(iter(law_tables(made.scene, made.scene.mjx, [effect], {"size": 0.5}, {})))

    none = made_of(lambda q: jnp.sin(3000.0 * q))
    assert isinstance(none, NoTable) and "too coarse" in none.why
    assert isinstance(made_of(jnp.sign), LawTable)  # misses its law next to the jump alone


GEARED = {"gear_motor[elbow]": 0.2, "gear_links[elbow]": 0.1, "gear_at_rest[elbow]": 0.0, "gear_speed": 0.7}


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        ("velocity_feedforward", {"velocity_feedforward[elbow]": 0.02}, "more to the command than to delay it"),
        ("gear_friction", GEARED, "the torques of motor and links on the gear"),
    ],
)
def test_the_reason_why_a_law_has_no_table_is_stated(made: Made, name: str, values: dict[str, float], why: str):
    """The reason is a sentence, not an exception's text."""
    none = table_of(made, name, values)
    assert isinstance(none, NoTable) and why in none.why


def test_commands_come_late(made: Made):
    laws, model, _ = laws_of(made, None)
    data, got = mujoco.MjData(model), []
    for k in range(40):
        data.time = 0.002 * k
        got.append(laws.control(data, np.full(model.nu, data.time))[2])
    expected = np.maximum(0.002 * np.arange(40) - 0.007, 0.0)
    np.testing.assert_allclose(got, expected, atol=1e-12)


@pytest.mark.parametrize(("name", "size"), [("profile_acceleration", 0.05), ("profile_speed", 0.9)])
def test_a_servo_follows_its_profile(made: Made, tmp_path: Path, name: str, size: float):
    """The goal equals that of the effect in a replay, also after the simulation is reset."""
    (effect,) = effects = library(made.scene, [name])
    space = effect_space(effects).select([f"{name}[elbow]"])
    write_neutral(tmp_path, made.scene, prior(space), np.array([size]), effects, main="fitted.xml")
    fit = apply_fit.load(tmp_path / "fitted.json")
    (law,), (lacking,) = fit["laws"], fit["not_in_mjcf"]
    assert law["joint"] == "elbow" and "has its law" in lacking["why"]
    model = mujoco.MjModel.from_xml_path(str(SCENE))
    laws, data, clock = apply_fit.forces(model, fit), mujoco.MjData(model), 0.002 * np.arange(400)
    command = np.where(clock < 0.3, 0.2, -0.5)[:, None] + 0.3 * np.sin(9.0 * clock)[:, None] * np.ones(model.nu)
    assert effect.profile is not None
    theta = complete({f"{name}[elbow]": jnp.float32(size)}, effects)
    expected = np.asarray(effect.profile(theta, jnp.asarray(command, jnp.float32), 0.002))
    u = made.scene.command_names.index("elbow")
    assert np.abs(expected[:, u] - command[:, u]).max() > 0.2
    for _ in range(2):
        got = np.empty_like(command)
        for k, at in enumerate(clock.tolist()):
            data.time = at
            got[k] = laws.control(data, command[k])
            np.testing.assert_array_equal(laws.control(data, command[k]), got[k])  # asked twice in a step
        np.testing.assert_allclose(got, expected, atol=2e-3)


def replayed(made: Made, folder: Path, **ask: Any) -> tuple[Any, Any]:
    """In plain C, in a process without jax, and the drive."""
    motor = replace(demonstration("test"), torque=TorqueConvention(TorqueSide.MOTOR, gravity=True))
    drive = make_drive(made.scene, motor, weigh=False)
    gains = servo_factors(made.scene, drive)
    given = dict(command=drive.command, timestep=drive.timestep, qpos0=drive.qpos0, gains=gains, time_offset=0.0)
    np.savez(folder / "ask.npz", **{**given, "fine": 1, "laws": 1, "spec": 0, **ask})
    script = ROOT / "benchmarks" / "neutral_replay.py"
    paths = (made.folder, SCENE, folder / "ask.npz", folder / "answer.npz")
    subprocess.run([sys.executable, script, *paths], check=True)
    return dict(np.load(folder / "answer.npz")), drive


def test_it_runs_without_jax_and_the_laws_act(made: Made, tmp_path: Path):
    answer, _ = replayed(made, tmp_path, spec=1)
    without, _ = replayed(made, tmp_path, laws=0)
    assert not len(answer["foreign"]) and np.isfinite(answer["qpos"]).all()
    assert np.abs(answer["qpos"] - without["qpos"]).max() > 0.003


@pytest.mark.slow
def test_the_motion_equals_that_of_the_replay(made: Made, tmp_path: Path):
    """The replay in MJX with first-order steps agrees with C up to float32."""
    answer, drive = replayed(made, tmp_path)
    seen = tuple(replace(e, observe=None) for e in made.effects)
    replay = servo_replay(made.scene, drive, seen, parity=True, late=0.0)

    def run(values: Any) -> Any:
        return replay(make_physics(made.scene, made.space, values))

    own = jax.jit(run, compiler_options=runtime.compiler_options())(jnp.asarray(made.values, jnp.float32))
    scene = made.scene
    np.testing.assert_allclose(answer["qpos"][:, scene.joint_qpos], own.position, atol=1e-3)
    np.testing.assert_allclose(answer["torque"][:, scene.joint_dofs], own.torque, atol=0.05)


def test_a_friction_law_starts_from_the_fits_number_each_time(made: Made):
    """It does not depend on what an earlier law wrote into the model."""
    model = mujoco.MjModel.from_xml_path(str(SCENE))
    data = mujoco.MjData(model)
    data.qvel[:] = 1.0
    mujoco.mj_forward(model, data)
    left = []
    for _ in range(3):
        laws = apply_fit.forces(model, made.fit, apply_fit.apply(model, made.fit))
        laws(model, data)
        left.append(model.dof_frictionloss.copy())
    np.testing.assert_allclose(left[1:], [left[0]] * 2, rtol=1e-12)


ROD = """<mujoco><compiler angle="radian"/><option timestep="0.002"/><worldbody>
<geom name="table" type="plane" size="1 1 .1" pos="0 0 -.5"/>
<body name="rod"><joint name="turn" axis="0 1 0" frictionloss="0.3" armature="0.01"/>
<geom name="tip" size=".05" pos="0 0 -.3" mass="0.4"/>
<geom name="bar" type="capsule" size=".02 .1" pos="0 0 -.1"/></body>
</worldbody><actuator>{motor}<position name="turn" joint="turn" kp="20"/></actuator></mujoco>"""


def fit_of_rod(
    folder: Path, entries: list[dict[str, Any]], motor: str = "", effects: Sequence[str] = (), xml: str = ROD
) -> Any:
    """fitted.json of a rod half a deviation from its prior mean, and its scene."""
    (folder / "rod.xml").write_text(xml.format(motor=motor))
    (folder / "parameters.json").write_text(json.dumps(entries))
    scene = load_scene(folder / "rod.xml", hold=True)
    chosen = library(scene, effects)
    space = load_parameters(folder / "parameters.json", scene)
    space = joined(space, chosen) if chosen else space
    values = np.clip(space.mean + 0.5 * space.std, space.low, space.high)
    assert write_neutral(folder, ready(scene), prior(space), values, chosen, main="fitted.xml") == ""
    return apply_fit.load(folder / "fitted.json"), scene


DAMPING = {"field": "dof_damping", "element": "turn", "std": 0.1, "high": 2.0}


def test_friction_that_the_fit_held_is_held_where_it_is_applied(tmp_path: Path):
    fit, scene = fit_of_rod(tmp_path, [DAMPING])
    assert scene.held == ("turn",)
    applied, written = (mujoco.MjModel.from_xml_path(str(tmp_path / n)) for n in ("rod.xml", "fitted.xml"))
    assert applied.dof_solimp[0, 0] < 0.99
    apply_fit.apply(applied, fit)
    np.testing.assert_allclose(applied.dof_solimp, written.dof_solimp, rtol=1e-6)
    spec = mujoco.MjSpec.from_file(str(tmp_path / "rod.xml"))
    apply_fit.apply(spec, fit)
    np.testing.assert_allclose(spec.compile().dof_solimp, written.dof_solimp, rtol=1e-6)


def test_numbers_that_the_compiler_derives_are_those_of_the_fit_in_a_spec_too(tmp_path: Path):
    """Regressions: a damping ratio, an inherited range and the inertias of `inertiafromgeom` were computed again."""
    entries = [
        {"field": "dof_armature", "element": "turn", "mean": 0.02, "std": 0.01, "high": 0.5},
        {"field": "jnt_range", "element": "turn", "column": 0, "std": 0.1, "low": -1.5, "high": -0.5},
        {"field": "body_mass", "element": "rod", "std": 0.2, "high": 9.0},
    ]
    limited = ROD.replace('kp="20"', 'kp="20" dampratio="1" inheritrange="1"')
    limited = limited.replace("frictionloss", 'range="-1 1" frictionloss')
    of_geoms = limited.replace('angle="radian"', 'angle="radian" inertiafromgeom="true"')
    bounded = limited.replace('angle="radian"', 'angle="radian" boundmass="0.9"')  # the rod weighs less
    for xml, asked in ((limited, entries), (of_geoms, entries), (bounded, entries[:2])):
        fit, _ = fit_of_rod(tmp_path, asked, xml=xml)
        kinds = mujoco.MjModel.from_xml_path, mujoco.MjSpec.from_file
        model, spec = (kind(str(tmp_path / "rod.xml")) for kind in kinds)
        apply_fit.apply(model, fit, sample=3)
        apply_fit.apply(spec, fit, sample=3)
        again = spec.compile()
        for name in ("body_mass", "actuator_biasprm", "actuator_ctrlrange", "jnt_range", "dof_armature"):
            np.testing.assert_allclose(getattr(again, name), getattr(model, name), rtol=1e-6, err_msg=name)


def test_draws_are_inertias_that_a_body_can_have(tmp_path: Path):
    """Regression: draws of one moment broke A + B >= C, which MuJoCo's compiler refuses."""
    rod = ROD.replace("<joint ", '<inertial pos="0 0 .1" mass="1" diaginertia=".01 .008 .004"/><joint ', 1)
    moment = {"field": "body_inertia", "element": "rod", "column": 0, "std": 0.004, "high": 0.1}
    fit, _ = fit_of_rod(tmp_path, [moment], xml=rod)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "rod.xml"))
    found = apply_fit.batch(model, fit, 40)["body_inertia"][:, -1]
    assert np.ptp(found[:, 0]) > 0.004
    assert np.all(2 * found.max(axis=1) <= found.sum(axis=1) * (1 + 1e-5))


def test_a_draw_that_no_try_made_possible_moves_towards_the_fit(tmp_path: Path):
    """All rows have a moment that no body can have, and so has what Gibbs sampling gives."""
    rod = ROD.replace("<joint ", '<inertial pos="0 0 .1" mass="1" diaginertia=".01 .008 .004"/><joint ', 1)
    moment = {"field": "body_inertia", "element": "rod", "column": 0, "std": 0.002, "high": 0.1}
    fit, _ = fit_of_rod(tmp_path, [moment, DAMPING], xml=rod)
    fit["gaussian"]["mean"][0] = 20.0  # prior deviations: 0.05 kg m^2, where the other two moments allow 0.012
    drawn = apply_fit.draws(fit, range(8))
    assert np.all((drawn[:, 0] > 0.011) & (drawn[:, 0] <= 0.012 * (1 + 1e-5)))
    assert np.std(drawn[:, 1]) > 0.03  # other parameters are drawn as before
    for sample in range(2):  # the compiler takes them
        apply_fit.apply(mujoco.MjSpec.from_file(str(tmp_path / "rod.xml")), fit, sample)


def test_a_batch_finds_full_inertias_by_their_prefix(tmp_path: Path):
    fit, _ = fit_of_rod(tmp_path, [{"inertia": "rod", "std": 0.2}])
    house = mujoco.MjSpec()
    frame = house.worldbody.add_frame()
    frame.attach_body(mujoco.MjSpec.from_file(str(tmp_path / "rod.xml")).body("rod"), "robot/", "")
    found = apply_fit.batch(house.compile(), fit, 3, prefix="robot/")
    alone = apply_fit.batch(mujoco.MjModel.from_xml_path(str(tmp_path / "rod.xml")), fit, 3)
    np.testing.assert_allclose(found["body_mass"][:, -1], alone["body_mass"][:, -1])


def test_a_larger_geom_makes_contacts(tmp_path: Path):
    """Its bounding box is that of the compiler, and the body keeps its fitted mass."""
    size = {
        "field": "geom_size",
        "element": "tip",
        "column": 0,
        "std": 0.3,
        "high": 1.0,
        "name": "tip_size",
        "unit": "m",
    }
    fit, _ = fit_of_rod(tmp_path, [size])
    model, spec = (kind(str(tmp_path / "rod.xml")) for kind in (mujoco.MjModel.from_xml_path, mujoco.MjSpec.from_file))
    apply_fit.apply(model, fit)
    mass = float(model.body_mass[-1])
    apply_fit.apply(spec, fit)
    compiled = spec.compile()
    tip = model.geom("tip").id
    assert model.geom_size[tip, 0] == pytest.approx(0.2) and compiled.body_mass[-1] == pytest.approx(mass)
    np.testing.assert_allclose(model.geom_rbound, compiled.geom_rbound)
    contacts = []
    for each in (model, compiled):
        data = mujoco.MjData(each)
        mujoco.mj_forward(each, data)
        contacts.append(data.ncon)
    assert contacts == [1, 1]


def test_a_law_of_a_servo_finds_it_behind_a_motor(tmp_path: Path):
    motor = '<motor name="ahead" joint="turn"/>'
    fit, _ = fit_of_rod(tmp_path, [DAMPING], motor, ["profile_speed"])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "rod.xml"))
    laws, data = apply_fit.forces(model, fit), mujoco.MjData(model)
    laws.control(data, [0.0, 0.0])
    data.time = 0.01
    assert laws.control(data, [1.0, 1.0])[0] == 1.0 and laws.control(data, [1.0, 1.0])[1] < 1.0


def test_a_law_over_time_is_no_delay(tmp_path: Path):
    fit, _ = fit_of_rod(tmp_path, [DAMPING], effects=["clock_rate"])
    assert not fit["laws"]
    assert "time since the recording began" in next(e["why"] for e in fit["not_in_mjcf"] if "clock" in e["parameter"])


def test_another_file_is_refused(tmp_path: Path, made: Made):
    (tmp_path / "other.json").write_text('{"format": "droid_jax fit", "version": 3}')
    with pytest.raises(ValueError, match="droid_jax fitted"):
        apply_fit.load(tmp_path / "other.json")
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ValueError, match="has no body 'forearm'"):
        apply_fit.apply(other, made.fit)


def test_a_prior_of_the_built_in_door_has_its_table(tmp_path: Path):
    """A scene without a file: the MJCF is complete, and rows have the ids of its geoms."""
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_nuisances, door_space

    scene = door_scene()
    space = door_space(scene) + door_nuisances(scene)
    values = np.clip(space.mean + 0.3 * space.std, space.low, space.high)
    assert write_neutral(tmp_path, scene, prior(space), values, main="fitted.xml") == ""
    fit = apply_fit.load(tmp_path / "fitted.json")
    assert not fit["mjcf"]["in_place"] and "memory" in fit["mjcf"]["reason"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "fitted.xml"))
    apply_fit.apply(model, fit)
    expected = make_c_model(scene, space, values)
    np.testing.assert_allclose(model.geom_size[scene.full_geom_ids], expected.geom_size, rtol=1e-4)
    np.testing.assert_allclose(model.body_mass, expected.body_mass, rtol=1e-6)


def test_a_scene_that_only_plain_c_supports_is_written_too(tmp_path: Path):
    """An integrator that MJX lacks."""
    text = SCENE.read_text().replace('integrator="implicitfast"', 'integrator="RK4" cone="elliptic"')
    (tmp_path / "bench.xml").write_text(text)
    scene = load_scene(tmp_path / "bench.xml", object_joint="door", engine="mujoco")
    space = Space((joint_damping(scene, "door", std=0.3, high=5.0),))
    assert write_neutral(tmp_path, scene, prior(space), np.array([0.7]), main="fitted.xml") == ""
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "fitted.xml"))
    assert model.dof_damping[scene.dof("door")] == pytest.approx(0.7)
    assert apply_fit.load(tmp_path / "fitted.json")["laws"] == []
