"""Hidden effects: no change at zero, the right joints, and an independent computation of each."""

from __future__ import annotations

import ast
import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.scene import door_scene
from droid_jax.model.scene import Grip, Scene, compile_scene
from droid_jax.recordings.checks import validate
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.c_engine import instrument
from droid_jax.synthetic import arm_effects, friction_effects, hinge_effects, hooks
from droid_jax.synthetic.hidden_effects import HIDDEN, LONGEST_STEP, Applied, hidden_effect, possible, record_hidden
from droid_jax.synthetic.hooks import Influence, Live, Place, SensorInput
from droid_jax.synthetic.robot import SyntheticRobotConfig, record, synthetic_truth

# A two-link arm and a servo-driven flap with a knob that the arm never touches.
XML = """
<mujoco>
  <option integrator="implicitfast"/>
  <worldbody>
    <body name="flap" pos="1 0 0">
      <joint name="flap" axis="0 0 -1" damping="0.6" frictionloss="0.1"/>
      <geom type="box" size="0.009 0.175 0.22" pos="0 -0.175 0" mass="1.5" contype="0" conaffinity="0"/>
      <body name="knob" pos="-0.035 -0.3 0">
        <geom name="knob" type="sphere" size="0.01" mass="0.2" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" armature="0.05" damping="5"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1.5" contype="0" conaffinity="0"/>
      <body name="fore" pos="0 0 -0.3" gravcomp="1">
        <joint name="elbow" axis="0 1 0" armature="0.02" damping="2"/>
        <geom name="pad" type="capsule" size="0.02" fromto="0 0.01 0 0 0 -0.25" mass="0.8" contype="0" conaffinity="0"/>
        PAYLOAD
      </body>
    </body>
  </worldbody>
  <contact><pair name="pad" geom1="pad" geom2="knob"/></contact>
  <actuator>
    <position joint="flap" kp="60"/><position joint="shoulder" kp="200"/><position joint="elbow" kp="100"/>
  </actuator>
</mujoco>
"""
ARM = ("shoulder", "elbow")
CONFIG = SyntheticRobotConfig(repeats=1, timestep=LONGEST_STEP)
LARGER = {"torque_line": 30.0}  # times the typical amplitude: the small arm needs little torque
SENSORS = ("sensor_delay", "torque_bias", "torque_gain", "torque_drift", "crosstalk")


def small_scene(payload: str = "") -> Scene:
    scene = compile_scene(
        mujoco.MjSpec.from_string(XML.replace("PAYLOAD", payload)),
        "small",
        joints=("flap", "shoulder", "elbow"),
        object_joint="flap",
        grip=Grip((("pad",),)),
    )
    return replace(scene, model=instrument(scene))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return small_scene()


@pytest.fixture(scope="module")
def demonstration(scene: Scene) -> Recording:
    """0.8 s: the flap opens to 0.8 rad and half closes again while the arm moves; flap, shoulder, elbow."""
    clock = np.arange(401) / 500
    flap = 0.4 * (1 - np.cos(2 * np.pi * clock / 0.8))
    command = np.stack([flap, 0.4 - 0.3 * np.sin(4 * clock), 0.5 * clock], axis=1)
    at = Channel("position", "rad", scene.joints, clock, command[None], np.ones((1, *command.shape), bool))
    return Recording(
        "swing",
        clock,
        command,
        scene.joints,
        {"position": at},
        TorqueConvention(TorqueSide.MOTOR, gravity=True),
        {"flap": 0.0, "shoulder": 0.4, "elbow": 0.0},
    )


@pytest.fixture(scope="module")
def plain(scene: Scene, demonstration: Recording) -> Recording:
    return record(scene, demonstration, {}, seed=4, config=CONFIG)


def hidden(scene: Scene, demonstration: Recording, *effects: Applied, **changes) -> Recording:
    return record_hidden(scene, demonstration, {}, effects, seed=4, config=replace(CONFIG, **changes))


def live_at(scene: Scene, q: Sequence[float] = (0, 0, 0), v: Sequence[float] = (0, 0, 0)) -> Live:
    """The small scene in a state: flap, shoulder, elbow."""
    model = scene.model.__copy__()
    model.opt.timestep = LONGEST_STEP
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    return Live.of(model, data)


def made(scene: Scene, name: str, amplitude: float, joints: Sequence[str] | None = None, repeat: int = 0) -> Influence:
    place = Place(scene, tuple(joints or scene.joints), repeat, 10.0)
    return HIDDEN[name].make(place, amplitude)


def stepped(influence: Influence, live: Live, times: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Applied torque, friction loss and command of one effect in the last of some steps in one state."""
    loss, control = live.loss.copy(), live.control.copy()
    if influence.begin:
        influence.begin(live)
    for _ in range(times):
        live.applied[:], live.loss[:], live.control[:] = 0, loss, control
        assert influence.step
        influence.step(live)
    return live.applied.copy(), live.loss - loss, live.control - control


# ----- all of them


def test_no_effects_are_the_synthetic_robot_itself_bit_for_bit(
    scene: Scene, demonstration: Recording, plain: Recording
):
    assert hidden(scene, demonstration).sha256 == plain.sha256


def test_the_small_scene_can_have_every_effect(scene: Scene):
    assert possible(scene) == tuple(HIDDEN)


@pytest.mark.parametrize("name", HIDDEN)
def test_zero_is_exactly_no_effect(scene: Scene, demonstration: Recording, plain: Recording, name: str):
    assert hidden(scene, demonstration, Applied(name, 0.0)).sha256 == plain.sha256


@pytest.mark.parametrize("name", [n for n in HIDDEN if n != "grip_compliance"])
def test_a_typical_amplitude_changes_a_valid_recording(
    scene: Scene, demonstration: Recording, plain: Recording, name: str
):
    """The scene's pair has no contact, so the grip has its own test."""
    effect = HIDDEN[name]
    assert 0 < effect.typical[0] < effect.typical[1]
    recording = validate(hidden(scene, demonstration, Applied(name, LARGER.get(name, 1.0) * effect.typical[1])))
    assert recording.meta == plain.meta  # without what was hidden
    torque, none = recording.channel("torque").values, plain.channel("torque").values
    assert np.isfinite(torque).all()
    assert 1e-3 < np.abs(torque - none).max() < 40.0
    same = np.array_equal(recording.channel("position").values, plain.channel("position").values)
    assert same == (name in SENSORS)


@pytest.mark.parametrize("name", [h.name for h in HIDDEN.values() if h.on == "hinge"])
def test_hinge_effects_act_on_the_hinge_only(scene: Scene, name: str):
    live = live_at(scene, (0.3, 0.5, -0.2), (0.2, -0.4, 0.3))
    applied, loss, control = stepped(made(scene, name, 1.0), live)
    assert not applied[1:].any() and not loss[1:].any() and not control.any()


@pytest.mark.parametrize(
    "name", [h.name for h in HIDDEN.values() if h.on in ("arm", "joint") and h.name != "firm_friction"]
)
def test_joint_effects_act_on_their_joint_only(scene: Scene, demonstration: Recording, plain: Recording, name: str):
    """The flap is not coupled to the arm, so its torque, including noise, is equal to the bit.

    Only the flap has friction, so firm friction has its own tests.
    """
    amplitude = LARGER.get(name, 1.0) * HIDDEN[name].typical[1]
    recording = hidden(scene, demonstration, Applied(name, amplitude, "elbow"))
    difference = np.abs(recording.channel("torque").values - plain.channel("torque").values)[0].max(axis=0)
    assert difference[0] == 0.0 and difference[2] > 1e-4


def test_effects_add_up_and_repeats_differ(scene: Scene, demonstration: Recording):
    both = {"torque_bias[elbow]": 0.5, "torque_gain[shoulder]": 0.1}
    by_name = record_hidden(scene, demonstration, {}, both, seed=4, config=replace(CONFIG, repeats=2))
    by_list = hidden(
        scene, demonstration, Applied("torque_bias", 0.5, "elbow"), Applied("torque_gain", 0.1, "shoulder"), repeats=2
    )
    assert by_name.sha256 == by_list.sha256
    values = by_name.channel("torque").values
    assert not np.array_equal(values[0], values[1])
    plain = record(scene, demonstration, {}, seed=4, config=replace(CONFIG, repeats=2)).channel("torque").values
    added = values - plain
    assert not added[..., 0].any()
    assert np.all(added[..., 1] * plain[..., 1] >= -1e-2) and np.abs(added[..., 2] - 0.57).max() < 0.12


def test_the_default_step_is_the_longest_allowed(scene: Scene, demonstration: Recording):
    with pytest.raises(ValueError, match=r"at most 0\.00025 s, got 0\.001"):
        hidden(scene, demonstration, timestep=0.001)


def test_what_cannot_be_is_refused(scene: Scene, demonstration: Recording):
    with pytest.raises(ValueError, match=r"unknown hidden effect 'closr'; there are: .*closer.*warm_up_friction"):
        record_hidden(scene, demonstration, {}, {"closr": 1.0}, seed=0)
    with pytest.raises(ValueError, match=r"unknown hidden effect 'a\[b'"):
        record_hidden(scene, demonstration, {}, {"a[b": 1.0}, seed=0)
    with pytest.raises(ValueError, match="joint 'wrist'; it can on: flap, shoulder, elbow"):
        record_hidden(scene, demonstration, {}, {"dry_friction[wrist]": 1.0}, seed=0)
    with pytest.raises(ValueError, match="'closer' cannot act on joint 'elbow'; it can on: none"):
        record_hidden(scene, demonstration, {}, {"closer[elbow]": 1.0}, seed=0)
    with pytest.raises(ValueError, match="not negative amplitude, got -1"):
        record_hidden(scene, demonstration, {}, {"closer": -1.0}, seed=0)
    with pytest.raises(ValueError, match="a finite amplitude, got nan"):
        record_hidden(scene, demonstration, {}, {"torque_bias": math.nan}, seed=0)
    with pytest.raises(ValueError, match="unknown parameter 'door_mass'"):
        record_hidden(scene, demonstration, {"door_mass": 1.0}, {}, seed=0)
    with pytest.raises(ValueError, match="unstable"):
        hidden(scene, demonstration, Applied("hinge_preload", 1e9))
    alone = compile_scene(mujoco.MjSpec.from_string(XML.replace("PAYLOAD", "")), "arm", joints=ARM)
    assert {HIDDEN[n].on for n in HIDDEN} - {HIDDEN[n].on for n in possible(alone)} == {"hinge", "grip"}
    with pytest.raises(ValueError, match="needs a scene with an object joint; 'arm' has none"):
        record_hidden(alone, demonstration, {}, {"closer": 1.0}, seed=0)
    with pytest.raises(ValueError, match="needs a scene with a grip"):
        record_hidden(alone, demonstration, {}, {"grip_compliance": 0.001}, seed=0)


def test_every_effect_says_what_it_is():
    for name, effect in HIDDEN.items():
        assert effect is hidden_effect(name) and effect.what and effect.unit
        assert effect.on in ("hinge", "arm", "joint", "hand", "base", "grip")


def test_the_hidden_effects_know_nothing_of_the_programs_library():
    folder = Path(hooks.__file__).parent
    files = [*sorted(folder.glob("*_effects.py")), folder / "hooks.py"]
    assert len(files) == 8
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, file.name
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                continue
            for name in names:
                assert not name.startswith(("droid_jax.model.effects", "droid_jax.discrepancy", "importlib")), file.name


# ----- the hinge


@pytest.mark.parametrize(
    ("name", "q", "v", "expected"),
    [
        ("hinge_preload", 0.0, 0.0, -2.0),
        ("hinge_preload", 0.5, 9.0, -2.2),
        ("binding_spring", 0.45, 0.0, -2 * 0.02 * math.log(2)),
        ("binding_spring", 0.9, 0.0, -2 * 0.45),
        ("over_centre", 0.0, 0.0, -2.0),
        ("over_centre", 0.4, 0.0, 0.0),
        ("over_centre", 0.8, 0.0, 2.0),
        ("magnetic_catch", -0.01, 0.0, -2.0),
        ("magnetic_catch", 0.03, 0.0, -1.0 + 0.24 * math.exp(-(2.75**2))),
        ("magnetic_catch", 0.14, 0.0, -2 / (1 + 196 / 9) + 0.24),
        ("closer", 0.5, 0.3, 0.0),
        ("closer", 0.5, -0.3, 2.0),
        ("closer", 0.5, -0.6, 2.0 * 3.031433),
        ("closer", 0.15, -0.3, 2.0 * 0.675),
        ("closer", -0.5, -0.3, 2.0 * 0.35),
        ("opening_check", 0.7, -0.3, 0.0),
        ("opening_check", 0.3, 0.3, 0.0),
        ("opening_check", 0.525, 0.6, -4.0),
        ("opening_check", 1.2, 0.3, -2.0),
        ("air_drag", 2.0, 0.5, -0.5),
        ("air_drag", 0.0, -0.5, 1.25),
        ("air_drag", 0.12, 1.0, -2.0 * (1 + 1.5 / math.e)),
        ("detent", 0.5, 0.0, 0.0),
        ("detent", 0.46, 0.0, 2.0),
        ("detent", 0.56, 0.0, -2.0),
        ("detent", 0.62, 0.0, -4.0 * math.exp(-1.5)),
        ("neighbour_door", 0.54, 1.0, 0.0),
        ("neighbour_door", 0.65, 0.0, -2.0),
        ("neighbour_door", 0.65, 0.5, -2.8),
        ("neighbour_door", 0.65, -2.0, 0.0),
    ],
)  # fmt: skip
def test_hinge_torques_by_hand(scene: Scene, name: str, q: float, v: float, expected: float):
    applied, loss, _ = stepped(made(scene, name, 2.0), live_at(scene, (q, 0, 0), (v, 0, 0)))
    assert applied[0] == pytest.approx(expected, rel=1e-6, abs=2e-3 if name in ("closer", "binding_spring") else 1e-4)
    assert not loss.any()


@pytest.mark.parametrize("q", [0.05, 0.3, 0.7, 1.2])
def test_the_over_centre_spring_is_the_slope_of_its_energy(q: float):
    def energy(angle: float) -> float:
        case, door = np.array([0.034, 0.0]), -0.022 * np.array([math.cos(angle - 0.4), math.sin(angle - 0.4)])
        return 0.5 * (np.linalg.norm(case - door) - 0.030) ** 2

    def slope(angle: float) -> float:
        return (energy(angle + 1e-6) - energy(angle - 1e-6)) / 2e-6

    assert hinge_effects.over_centre(1.5, q, 0.0) == pytest.approx(-1.5 * slope(q) / slope(0.0), rel=1e-4)


@pytest.mark.parametrize(
    ("name", "q", "expected"),
    [
        ("floor_friction", 0.0, 0.0),
        ("floor_friction", 0.30, 0.6),
        ("floor_friction", 0.60, 1.6),
        ("floor_friction", 1.0, 2.0),
        ("pin_wobble", -0.35 / 5.5, 2.0),
        ("pin_wobble", (math.pi / 4 - 0.35) / 5.5, 0.5),
        ("pin_wobble", (math.pi / 2 - 0.35) / 5.5, 0.0),
    ],
)
def test_hinge_friction_by_hand(scene: Scene, name: str, q: float, expected: float):
    applied, loss, _ = stepped(made(scene, name, 2.0), live_at(scene, (q, 0, 0), (0.3, 0, 0)))
    assert loss[0] == pytest.approx(expected, abs=2e-3)
    assert not applied.any()


@pytest.mark.parametrize("start", [0.0, 0.35])
def test_the_tilted_frame_turns_gravity(scene: Scene, start: float):
    """Against MuJoCo's gravity, turned for the flap, with misaligned hinges."""
    influence, lean = made(scene, "tilted_frame", 0.12), 0.12
    live = live_at(scene, (start, 0, 0))
    assert influence.begin
    influence.begin(live)
    line = np.array([-math.sqrt(3) / 2, -0.5, 0.0])
    turn, quaternion = np.zeros(3), np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, line, lean)
    mujoco.mju_rotVecQuat(turn, np.array([0.0, 0.0, -9.81]), quaternion)
    size = np.hypot(*hinge_effects.lean_torque(live.model, live.data, scene.id("joint", "flap"), lean))
    for q in (0.0, 0.4, 0.9):
        live.position[0] = q
        live.applied[:] = 0
        influence.step(live)  # type: ignore[misc]
        leaning = live_at(scene, (q, 0, 0))
        leaning.model.opt.gravity[:] = turn
        mujoco.mj_forward(leaning.model, leaning.data)
        bent = 0.25 * size * math.sin(3 * (q - start))
        assert live.applied[0] - bent == pytest.approx(-leaning.data.qfrc_bias[0], rel=1e-9)
        assert abs(live.applied[0]) > 0.05


def test_the_gasket_holds_while_opening_and_detaches():
    s, fine, h = 0.0, 0.0, 0.001
    for k in range(100):  # 0.1 s at 0.2 rad/s
        s = hinge_effects.suction(s, 0.02, 0.2, h)
        for _ in range(20):
            fine += h / 20 * (0.2 / 0.015 * (1 - fine) - fine / 0.5)
        assert s == pytest.approx(fine, rel=2e-3), k
    assert 0.6 < s < 1.0
    assert hinge_effects.suction(s, 0.02, -1.0, 0.5) == pytest.approx(s / math.e)
    assert hinge_effects.suction(s, 0.06, 0.2, 0.008) == pytest.approx(s / math.e)


def test_the_closer_changes_nothing_before_the_door_closes(scene: Scene, demonstration: Recording, plain: Recording):
    closed, none = (r.channel("torque") for r in (hidden(scene, demonstration, Applied("closer", 2.0)), plain))
    difference = np.abs(closed.values - none.values)[0]
    assert not difference[none.time < 0.4].any()
    assert difference[none.time > 0.5, 0].max() > 0.5 and not difference[:, 1:].any()


# ----- friction


def test_friction_losses_by_hand():
    v = np.array([0.0, 0.04, -0.08])
    np.testing.assert_allclose(friction_effects.stribeck_loss(2.0, np.zeros(3), v), [2, 1, 0.4])
    assert friction_effects.stribeck_loss(2.0, np.pi / 16, 0.0) == pytest.approx(2.3)  # type: ignore[arg-type]
    np.testing.assert_allclose(friction_effects.directional_loss(2.0, np.array([-1, 0, 0.01, 1])), [0, 1, 1.7615942, 2])
    q = np.array([-0.25, (math.pi / 2 - 0.5) / 2])
    np.testing.assert_allclose(friction_effects.dry_loss(2.0, q), [2.0, 2.4])
    np.testing.assert_allclose(friction_effects.load_loss(0.1, np.array([0.0, 2.0, -2.0])), [0, 0.1, 0.1])
    assert friction_effects.warm_up_loss(2.0, 45.0) == pytest.approx(2 / math.e)


def test_friction_is_loss_on_its_joint_and_can_be_the_hinge(scene: Scene):
    for name, at in (("dry_friction", ("elbow",)), ("stribeck_friction", ("flap",)), ("directional_friction", ARM)):
        applied, loss, _ = stepped(made(scene, name, 0.7, at), live_at(scene, (0.1, 0.2, 0.3), (0.02, 0.02, 0.02)))
        assert [j for j, x in zip(scene.joints, loss, strict=True) if x > 0] == list(at)
        assert not applied.any()


def test_warm_up_goes_on_from_repeat_to_repeat(scene: Scene):
    live = live_at(scene)
    live.data.time = 3.0
    _, loss, _ = stepped(made(scene, "warm_up_friction", 2.0, ("elbow",), repeat=4), live)
    np.testing.assert_allclose(loss, [0, 0, 2 * math.exp(-43 / 45)])


def test_load_friction_follows_the_motor_with_a_lag(scene: Scene):
    live = live_at(scene)
    live.motor[:] = [0.0, 2.0, -3.6]
    influence = made(scene, "load_friction", 0.1, ARM)
    _, loss, _ = stepped(influence, live, 80)  # one lag of 20 ms
    filtered = 2.0 * (1 - (1 - 1 / 80) ** 80)
    assert loss[1] == pytest.approx(0.1 * (math.hypot(filtered, 1.5) - 1.5))
    _, loss, _ = stepped(influence, live, 4000)
    np.testing.assert_allclose(loss, [0, 0.1, 0.1 * (3.9 - 1.5)], rtol=1e-6)


def test_mesh_friction_is_of_motor_and_load_and_more_when_slow(scene: Scene):
    live = live_at(scene, v=(0.0, 0.3, 30.0))
    live.motor[:], live.data.qfrc_bias[:] = [0.0, 2.0, -3.0], [0.0, -1.0, -2.0]
    influence = made(scene, "mesh_friction", 0.1, ARM)
    _, loss, _ = stepped(influence, live, 4000)
    np.testing.assert_allclose(loss, [0, 0.1 * (1.2 + 0.4) * 1.25, 0.1 * (1.8 + 0.8)], rtol=1e-4)


def test_the_bristle_is_dahls(scene: Scene):
    """Against the differential equation in small steps, through a reversal."""
    force = fine = np.zeros(1)
    for v in (*[0.02] * 400, *[-0.03] * 100):
        force = friction_effects.bristle(force, 1.2, np.array([v]), 0.001)
        for _ in range(50):
            fine = fine + v * 0.001 / 50 * 1.2 / 0.003 * (1 - fine / 1.2 * np.sign(v))
        np.testing.assert_allclose(force, fine, atol=2e-3)
    assert force[0] == pytest.approx(-1.2 + 1.2 * (2 - math.exp(-8 / 3)) / math.e)
    applied, loss, _ = stepped(made(scene, "bristle_friction", 1.2, ("elbow",)), live_at(scene, v=(0, 0, 0.5)), 200)
    np.testing.assert_allclose(applied, [0, 0, -1.2], rtol=1e-3)
    assert not loss.any()


@pytest.mark.parametrize("name", [None, "dry_friction", "bristle_friction", "torque_ripple", "payload"])
def test_link_side_torques_exclude_the_gears(scene: Scene, demonstration: Recording, name: str | None):
    """The torque equals mj_inverse of the recorded motion without rotors, dampers and friction.

    A payload is beyond the sensor.
    """
    effects = [Applied(name, 1.0)] if name else []
    smooth = copy.copy(scene.model)
    smooth.dof_frictionloss[:] = 0  # no sensor of C MuJoCo measures it
    scene = replace(scene, model=smooth)
    quiet = dict(torque_noise=(0.0, 0.0), torque_drift=(0.0, 0.0), position_noise=0.0, start_noise=0.0)
    recording = hidden(scene, demonstration, *effects, side=TorqueSide.LINK, rate=4000.0, **quiet)
    motor = hidden(scene, demonstration, *effects, rate=4000.0, **quiet)
    torque = recording.channel("torque").values[0, 200:-200:40].astype(float)
    at = motor.channel("position").values[0].astype(float)
    mujoco_model = live_at(scene).model
    mujoco_model.dof_armature[:] = mujoco_model.dof_damping[:] = mujoco_model.dof_frictionloss[:] = 0
    mujoco.mj_setConst(mujoco_model, mujoco.MjData(mujoco_model))
    data, wide, expected = mujoco.MjData(mujoco_model), 40, []
    for k in range(200, len(at) - 200, 40):  # differences over 10 ms: positions are stored as float32
        data.qpos[:] = at[k]
        data.qvel[:] = (at[k + wide] - at[k - wide]) / (2 * wide * LONGEST_STEP)
        data.qacc[:] = (at[k + wide] - 2 * at[k] + at[k - wide]) / (wide * LONGEST_STEP) ** 2
        mujoco.mj_inverse(mujoco_model, data)
        expected.append(data.qfrc_inverse.copy())
    rms = np.sqrt(np.mean((torque[: len(expected), 1:] - np.array(expected)[:, 1:]) ** 2))
    assert (rms < 0.03) == (name != "payload"), rms


# ----- the arm


def test_the_payload_is_a_body_welded_to_the_hand(scene: Scene):
    """Inertia matrix and forces against a compiled scene with the mass as a separate body."""
    at = scene.model.body_ipos[scene.id("body", "fore")] + arm_effects.PAYLOAD_AT
    inertia = " ".join(["0.00063"] * 3)  # 0.7 kg, 3 cm
    tool = f'<body><inertial mass="0.7" pos="{" ".join(map(repr, at.tolist()))}" diaginertia="{inertia}"/></body>'
    carrying = live_at(small_scene(tool), q := (0.2, 0.7, -0.9), v := (0.4, 1.0, -2.0))
    mujoco.mj_forward(carrying.model, carrying.data)
    influence = made(scene, "payload", 0.7)
    live = live_at(scene, q, v)
    influence.edit(live.model)  # type: ignore[misc]
    stepped(influence, live)
    mujoco.mj_forward(live.model, live.data)
    mass, expected = np.zeros((3, 3)), np.zeros((3, 3))
    mujoco.mj_fullM(live.model, live.data, mass)
    mujoco.mj_fullM(carrying.model, carrying.data, expected)
    np.testing.assert_allclose(mass, expected, rtol=1e-6)
    np.testing.assert_allclose(live.data.qacc, carrying.data.qacc, rtol=1e-6)
    assert live.model.body_mass.sum() == pytest.approx(scene.model.body_mass.sum() + 0.7)


def test_cable_ripple_and_twist_by_hand(scene: Scene):
    np.testing.assert_allclose(
        arm_effects.cable(3.0, np.array([0.0, 1.0, -0.5]), np.zeros(3)),
        [0, -3, 3 * (math.e - 1 / math.e) / (math.e**2 - math.e**-2)],
    )
    np.testing.assert_allclose(arm_effects.cable(3.0, np.ones(2), np.array([1.0, -1.0])), [-3.3, -2.7])
    applied, _, _ = stepped(made(scene, "cable_pull", 3.0, ARM), live_at(scene, (0.5, 1.0, 0.0)))
    np.testing.assert_allclose(applied, [0, -3, 0], atol=1e-12)
    panda, (low, high) = door_scene(), (-3.0718, -0.0698)  # joint 4
    place = Place(replace(panda, model=instrument(panda)), ("panda_joint4",))
    live = Live.of(place.scene.model, mujoco.MjData(place.scene.model))
    live.data.qpos[place.qpos] = (low + high) / 2 - 1.0
    applied, _, _ = stepped(HIDDEN["cable_pull"].make(place, 3.0), live)
    assert applied[place.dofs[0]] == pytest.approx(3.0) and np.count_nonzero(applied) == 1
    q = np.array([-0.4 / 18, 0.3])
    expected = [0.7 * math.sin(1.9 - 0.4 * 44 / 18), 2 * (math.sin(5.8) + 0.35 * math.sin(15.1))]
    np.testing.assert_allclose(arm_effects.ripple(2.0, q), expected)
    turn = arm_effects.twist(1e-3, np.array([0.0, 1e-3, 15 * math.sinh(1.0), -15 * math.sinh(1.0)]))
    np.testing.assert_allclose(turn, [0, 1e-6, 0.015, -0.015], rtol=1e-6)


def test_an_elastic_joint_at_rest_balances_servo_and_spring(scene: Scene, demonstration: Recording):
    """Held against its weight: torque = stiffness (command - motor angle), and the encoder reads the motor."""
    still = replace(demonstration, command=np.tile([0.0, 0.9, 0.3], (401, 1)))
    still = replace(still, qpos0={"flap": 0.0, "shoulder": 0.9, "elbow": 0.3})
    quiet = dict(torque_noise=(0.0, 0.0), torque_drift=(0.0, 0.0), position_noise=0.0, start_noise=0.0)
    recording = hidden(scene, still, Applied("joint_elasticity", 1e-3, "shoulder"), **quiet)
    none = hidden(scene, still, **quiet)
    torque = recording.channel("torque").values[0, -1, 1]
    position = recording.channel("position").values[0, -1, 1]
    assert abs(torque) > 1.0
    assert torque == pytest.approx(200 * (0.9 - position), rel=1e-3)
    sag = none.channel("position").values[0, -1, 1]
    assert position == pytest.approx(sag, abs=1e-4)  # the link, not the motor, has sunk


@pytest.mark.parametrize("name", ["joint_elasticity", "resonance"])
def test_an_elastic_joint_that_holds_a_weight_begins_at_rest(scene: Scene, demonstration: Recording, name: str):
    """The start is the encoder's reading: the link begins behind it, where its gear carries the servo's torque."""
    command = np.tile([0.0, 0.9, 0.3], (401, 1))
    quiet = dict(torque_noise=(0.0, 0.0), torque_drift=(0.0, 0.0), position_noise=0.0, start_noise=0.0)

    def held(qpos0: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        still = replace(demonstration, command=command, qpos0=qpos0)
        found = hidden(scene, still, Applied(name, 1e-3, "shoulder"), **quiet)
        return found.channel("position").values[0], found.channel("torque").values[0]

    fallen, _ = held({"flap": 0.0, "shoulder": 0.9, "elbow": 0.3})
    position, torque = held(dict(zip(scene.joints, fallen[-1].astype(float).tolist(), strict=True)))
    assert abs(torque[0, 1]) > 1.0  # N m, which twist the gear by more than 1 mrad
    np.testing.assert_allclose(position[0, 1:], fallen[-1, 1:], atol=1e-7)
    assert np.ptp(position[:, 1:], axis=0).max() < 3e-5
    assert np.ptp(torque[:, 1:], axis=0).max() < 0.01 * abs(torque[0, 1])


def test_play_by_hand():
    values = np.array([0.0, 0.4, 1.0, 0.6, -0.2, -0.1, 0.9])[:, None]
    np.testing.assert_allclose(arm_effects.play(values, 1.0)[:, 0], [0, 0, 0.5, 0.5, 0.3, 0.3, 0.4])
    np.testing.assert_array_equal(arm_effects.play(values, 0.0), values)


def test_servo_gains_change_their_own_servo(scene: Scene):
    model = live_at(scene).model
    made(scene, "servo_gains", 0.21, ("elbow",)).edit(model)  # type: ignore[misc]
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], [60, 200, 121])
    np.testing.assert_allclose(model.actuator_biasprm[:, 1], [-60, -200, -121])
    np.testing.assert_allclose(model.dof_damping, [0.6, 5, 2.2])
    with pytest.raises(ValueError, match="above -1"):
        made(scene, "servo_gains", -1.0)


def test_grip_compliance_softens_the_grips_pairs(scene: Scene):
    model = live_at(scene).model
    made(scene, "grip_compliance", 0.001).edit(model)  # type: ignore[misc]
    assert model.pair_solimp[0, 2] == pytest.approx(0.002) and model.pair_solref[0, 0] == pytest.approx(0.02 * 1.4)


# ----- the base and the encoders


def compensated(scene: Scene, share: float) -> Scene:
    """The small scene with gravcomp of all bodies set to that share."""
    model = copy.copy(scene.model)
    model.body_gravcomp[:] = share
    return replace(scene, model=model)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_tilted_base_turns_gravity_but_not_its_compensation(scene: Scene, share: float):
    """Against MuJoCo's gravity with the compensation as explicit forces; gravity on the flap is upright."""
    q, v, lean = (0.3, 0.7, -0.9), (0.2, 1.0, -2.0), 0.03
    scene = compensated(scene, share)
    live, influence = live_at(scene, q, v), made(scene, "tilted_base", lean)
    influence.edit(live.model)  # type: ignore[misc]
    stepped(influence, live)
    mujoco.mj_forward(live.model, live.data)
    got = live.data.qfrc_applied + live.data.qfrc_passive - live.data.qfrc_bias

    line, turned, quaternion = np.array([math.cos(0.6), math.sin(0.6), 0.0]), np.zeros(3), np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, line, lean)
    mujoco.mju_rotVecQuat(turned, np.array([0.0, 0.0, -9.81]), quaternion)
    upright = live_at(scene, q, v)
    mujoco.mj_forward(upright.model, upright.data)
    leaning = live_at(compensated(scene, 0.0), q, v)
    leaning.model.opt.gravity[:] = turned
    mujoco.mj_forward(leaning.model, leaning.data)
    expected = leaning.data.qfrc_passive - leaning.data.qfrc_bias + upright.data.qfrc_gravcomp
    np.testing.assert_allclose(got[1:], expected[1:], atol=1e-12)
    as_it_hangs = upright.data.qfrc_passive - upright.data.qfrc_bias
    assert got[0] == pytest.approx(as_it_hangs[0], abs=1e-12)
    assert np.abs(got - as_it_hangs).max() > 0.05


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_an_encoder_offset_shifts_position_and_compensation(scene: Scene, demonstration: Recording, share: float):
    """At rest the servo's torque is the weight in the true pose minus the compensation in the pose that is read."""
    scene, off = compensated(scene, share), 0.05
    still = replace(demonstration, command=np.tile([0.0, 0.9, 0.3], (401, 1)))
    still = replace(still, qpos0={"flap": 0.0, "shoulder": 0.9, "elbow": 0.3})
    quiet = dict(torque_noise=(0.0, 0.0), torque_drift=(0.0, 0.0), position_noise=0.0, start_noise=0.0)
    recording = hidden(scene, still, Applied("encoder_zero", off, "elbow"), **quiet)
    torque, read = (recording.channel(name).values[0, -1].astype(float) for name in ("torque", "position"))
    true = live_at(compensated(scene, 0.0), np.add(read, [0.0, 0.0, off]).tolist())
    seen = live_at(scene, read)
    for live in (true, seen):
        mujoco.mj_forward(live.model, live.data)
    np.testing.assert_allclose(torque, true.data.qfrc_bias - seen.data.qfrc_gravcomp, atol=0.01)
    np.testing.assert_allclose(torque, [60, 200, 100] * (np.array([0.0, 0.9, 0.3]) - read), atol=1e-3)
    assert recording.channel("position").values[0, 0, 2] == pytest.approx(0.3, abs=1e-6)


@pytest.mark.parametrize("other", ["tilted_base", "payload"])
def test_an_encoder_offset_misplaces_the_compensation_with_other_effects(scene: Scene, other: str):
    """Other effects apply the compensation as forces and remove the model's."""
    scene, state = compensated(scene, 1.0), ((0.0, 0.9, 0.3), (0.0, 0.0, 0.0))
    off = made(scene, "encoder_zero", 0.05, ["elbow"])
    (alone, *_), first = stepped(off, live_at(scene, *state)), made(scene, other, 0.03)
    live = live_at(scene, *state)
    first.edit(live.model)  # type: ignore[misc]
    np.testing.assert_allclose(stepped(off, live)[0], alone, atol=1e-12)
    assert np.abs(alone).max() > 0.01


def test_firm_friction_does_not_creep():
    """0.2 of 0.3 N m at an inertia of 0.03 kg m2 creep with 7 mrad/s in MuJoCo."""
    mjcf = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" armature="0.03" frictionloss="0.3"/>
      <inertial pos="0 0 0" mass="1e-3" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>
      <actuator><motor joint="j"/></actuator></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(mjcf), "held")
    clock = np.arange(1001) / 500
    push = Recording("push", clock, np.full((1001, 1), 0.2), ("j",), {}, TorqueConvention(TorqueSide.MOTOR, True))
    push = replace(push, qpos0={"j": 0.0})
    quiet = dict(torque_noise=(0.0, 0.0), torque_drift=(0.0, 0.0), position_noise=0.0, start_noise=0.0)

    def path(share: float) -> np.ndarray:
        """[T] rad at 500 Hz."""
        return hidden(scene, push, Applied("firm_friction", share), **quiet).channel("position").values[0, :, 0]

    creep = 0.2 * (0.1 / 0.9) / (2 / 0.95 / 0.02) / 0.03  # rad/s
    assert path(0.0)[-1] == pytest.approx(2.0 * creep, rel=0.02)
    firm, half = path(1.0), path(0.5)
    assert 0.0 < firm[500] < 0.002 and firm[-1] - firm[500] < 1e-6
    assert 0.0 < half[-1] - half[500] < 0.6 * creep
    with pytest.raises(ValueError, match="at most 1"):
        path(1.5)


def test_firm_friction_is_a_share_of_the_joints_friction_only(scene: Scene):
    """Friction that other effects add is not part of it."""
    live, firm = live_at(scene), made(scene, "firm_friction", 0.8)
    firm.begin(live)  # type: ignore[misc]
    own = live.loss.copy()
    live.loss[:] = own + 0.5
    firm.step(live)  # type: ignore[misc]
    np.testing.assert_allclose(live.loss, 0.2 * own + 0.5)
    assert own.max() == pytest.approx(0.1)


# ----- signals


def test_a_ramp_is_delayed_by_the_amplitude():
    """Dead time and lag both delay a ramp by their length, after the lag has settled."""
    clock = np.arange(4001) * 0.00025
    late = hooks.lagged(np.stack([clock, np.full(4001, 3.0)], axis=1), clock, 0.014, 0.006)
    np.testing.assert_allclose(late[2000:, 0], clock[2000:] - 0.02, atol=2e-4)
    assert not late[:56, 0].any()
    np.testing.assert_allclose(late[:, 1], 3.0)


def test_signals_by_hand(scene: Scene):
    clock, torque = np.array([0.0, 60.0]), np.array([[1.0, -20.0, 2.0], [0.5, 40.0, 2.0]])
    seen = SensorInput(clock, torque, np.full((2, 3), math.pi / 2))

    def sensed(name: str, amplitude: float, repeat: int = 0) -> np.ndarray:
        after = made(scene, name, amplitude, ("shoulder",), repeat).sense(seen)  # type: ignore[misc]
        np.testing.assert_array_equal(after.torque[:, [0, 2]], torque[:, [0, 2]])
        assert after.position is seen.position
        return after.torque[:, 1] - torque[:, 1]

    np.testing.assert_allclose(sensed("torque_bias", 0.5), [0.75, 0.6])
    first, last = -2 * math.tanh(1), 2 * math.tanh(2)  # 60 s apart: the creep has settled
    np.testing.assert_allclose(sensed("torque_gain", 0.1), [first, last])
    close = replace(seen, clock=np.array([0.0, 0.5]))
    crept = made(scene, "torque_gain", 0.1, ("shoulder",)).sense(close).torque[1, 1] - 40.0  # type: ignore[misc]
    assert crept == pytest.approx(0.7 * last + 0.3 * (first / math.e + last * (1 - 1 / math.e)))
    np.testing.assert_allclose(sensed("torque_drift", 2.0), [0, 2 * (1 - 1 / math.e)])
    np.testing.assert_allclose(sensed("torque_drift", 2.0, repeat=6)[0], 2 * (1 - 1 / math.e))  # period 10 s
    assert torque[0, 1] == -20.0  # the input is left alone


def test_a_command_delay_moves_its_own_column(scene: Scene):
    clock = np.arange(2000) * LONGEST_STEP
    control = np.repeat(np.sin(5 * clock)[:, None], 3, axis=1)
    late = made(scene, "command_delay", 0.01, ("elbow",)).command(clock, control)  # type: ignore[misc]
    np.testing.assert_array_equal(late[:, :2], control[:, :2])
    np.testing.assert_allclose(late[400:, 2], np.sin(5 * (clock[400:] - 0.01)), atol=1e-3)


# ----- the door


@pytest.fixture(scope="module")
def door() -> tuple[Scene, Recording, dict[str, float]]:
    scene = door_scene()
    return scene, load_recording(demonstration_path("C")), synthetic_truth(scene, 1, 5)


@pytest.fixture(scope="module")
def bare(door: tuple[Scene, Recording, dict[str, float]]) -> Recording:
    return record_hidden(*door, {}, seed=3, config=CONFIG)


@pytest.mark.slow
def test_the_door_without_effects_is_the_synthetic_robots(
    door: tuple[Scene, Recording, dict[str, float]], bare: Recording
):
    assert record(*door, seed=3, config=CONFIG).sha256 == bare.sha256


# Its arm has no friction that could be firm, and a hand that stands a degree off misses the knob.
NOT_ON_THE_DOOR = ("firm_friction", "encoder_zero")


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in HIDDEN if name not in NOT_ON_THE_DOOR])
def test_the_door_opens_with_every_effect(door: tuple[Scene, Recording, dict[str, float]], bare: Recording, name: str):
    """With the largest typical amplitude on the whole motion the effect is noticeable and the grasp holds."""
    amplitude = HIDDEN[name].typical[1]
    recording = record_hidden(*door, {name: amplitude}, seed=3, config=CONFIG)
    change = np.abs(recording.channel("torque").values - bare.channel("torque").values)
    assert 0.05 < np.max(change) < 30.0
