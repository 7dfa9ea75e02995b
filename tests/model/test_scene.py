"""The built-in scene and users' scenes: kinematics, limits, variants, and refused features."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from droid_jax.door.scene import ARM, FINGERS, LEVERS, door_scene
from droid_jax.door.space import door_space, truth
from droid_jax.model.fields import body_mass, joint_damping, joint_frictionloss, model_parameter, servo_scale
from droid_jax.model.scene import TINY_FRICTIONLOSS, Grip, Scene, compile_scene, load_scene, with_options
from droid_jax.model.visual_geoms import LOOK_GROUP
from droid_jax.simulate.c_engine import instrument

# Franka's documentation, "Denavit-Hartenberg parameters" (Craig's convention): a, d [m], alpha [rad].
DH = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -np.pi / 2),
    (0.0, 0.316, np.pi / 2),
    (0.0825, 0.0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.088, 0.0, np.pi / 2),
)
FLANGE = 0.107  # m
LOW = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
HIGH = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
TORQUE = np.array([87.0, 87, 87, 87, 12, 12, 12])


@pytest.fixture(scope="module")
def door() -> Scene:
    return door_scene()


def craig(a: float, d: float, alpha: float, theta: float) -> np.ndarray:
    """Frame i in frame i - 1 (Craig, Introduction to Robotics, eq. 3.6)."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0, 0, 0, 1]])


def flange_pose(q: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    for (a, d, alpha), theta in zip(DH, q, strict=True):
        pose = pose @ craig(a, d, alpha, theta)
    return pose @ craig(0.0, FLANGE, 0.0, 0.0)


def test_an_mjcf_whose_files_are_given(tmp_path: Path):
    """As environments have them: includes and meshes by name, without a folder."""
    mesh = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    arm = (
        "<mujoco><asset><mesh name='box' file='box.obj'/></asset><worldbody><body><joint name='elbow'/>"
        "<geom type='mesh' mesh='box' mass='1'/></body></worldbody></mujoco>"
    )
    path = tmp_path / "scene.xml"
    path.write_text("<mujoco><include file='arm.xml'/><actuator><position joint='elbow' kp='9'/></actuator></mujoco>")
    assets = {"arm.xml": arm.encode(), "box.obj": mesh.encode()}
    assert load_scene(path, assets=assets).joints == ("elbow",)
    with pytest.raises(ValueError, match=r"scene.xml: .*arm.xml"):
        load_scene(path)


def test_flange_follows_the_dh_table(door: Scene):
    rng = np.random.default_rng(0)
    data = mujoco.MjData(door.model)
    turn = np.pi / 4  # Franka mounts the hand at -45 degrees on the flange
    hand_to_flange = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    for q in rng.uniform(LOW, HIGH, (50, 7)):
        data.qpos[door.joint_qpos] = q
        mujoco.mj_kinematics(door.model, data)
        expected = flange_pose(q)
        hand = data.body("hand")
        np.testing.assert_allclose(hand.xpos, expected[:3, 3], atol=1e-9)
        np.testing.assert_allclose(hand.xmat.reshape(3, 3) @ hand_to_flange, expected[:3, :3], atol=1e-7)


def test_joint_and_torque_limits(door: Scene):
    ids = [door.id("joint", j) for j in ARM]
    np.testing.assert_allclose(door.model.jnt_range[ids], np.stack([LOW, HIGH], axis=1))
    np.testing.assert_allclose(door.model.jnt_actfrcrange[ids], np.stack([-TORQUE, TORQUE], axis=1))
    assert door.model.jnt_actfrclimited[ids].all()
    actuators = [door.id("actuator", j) for j in ARM]
    np.testing.assert_allclose(door.model.actuator_ctrlrange[actuators], np.stack([LOW, HIGH], axis=1))
    assert not door.model.jnt_limited[ids].any()
    assert door_scene(limits=True).model.jnt_limited[ids].all()


def test_gravity_of_the_robot_is_compensated(door: Scene):
    """Without actuator torque the arm and the fingers stay where they are, anywhere in the workspace."""
    model, data = door.model.__copy__(), mujoco.MjData(door.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    robot = [door.dof(j) for j in (*ARM, *FINGERS)]
    assert model.opt.gravity[2] == pytest.approx(-9.81)
    for q in np.random.default_rng(1).uniform(LOW, HIGH, (20, 7)):
        mujoco.mj_resetData(model, data)
        data.qpos[door.joint_qpos] = q
        data.qpos[[door.qpos(j) for j in FINGERS]] = 0.04
        mujoco.mj_forward(model, data)
        assert np.abs(data.qfrc_bias[robot]).max() > 1.0  # there is something to compensate
        np.testing.assert_allclose(data.qacc[robot], 0.0, atol=1e-9)


def test_springs_stiffen_the_hinge():
    for springs, stiffness in {0: 0.01, 1: 1.06, 2: 1.24}.items():
        scene = door_scene(springs=springs)
        assert scene.model.jnt_stiffness[scene.id("joint", "hinge")] == stiffness
        assert (scene.visual_model().geom_group == LOOK_GROUP).sum() > 0
        assert not (scene.model.geom_group == LOOK_GROUP).any()
    assert door_scene(springs=2).visual_model().ngeom == door_scene().visual_model().ngeom + 16


@pytest.mark.parametrize(("size", "expected"), [((320, 240), (640, 480)), ((1920, 240), (1920, 480))])
def test_the_offscreen_buffer_is_large_enough(size, expected):
    asked = f'<mujoco><visual><global offwidth="{size[0]}" offheight="{size[1]}"/></visual><worldbody>'
    body = '<body name="arm"><joint name="elbow"/><geom size="0.1"/></body>'
    spec = mujoco.MjSpec.from_string(f"{asked}{body}</worldbody></mujoco>")
    buffer = compile_scene(spec, "small", joints=["elbow"]).visual_model().vis.global_
    assert (buffer.offwidth, buffer.offheight) == expected


def test_knob_locations_are_five_centimetres_apart():
    distance = []
    for knob in range(4):
        scene = door_scene(knob=knob)
        data = mujoco.MjData(scene.model)
        mujoco.mj_kinematics(scene.model, data)
        distance.append(data.joint("hinge").xanchor[1] - data.site("knob").xpos[1])
    np.testing.assert_allclose(distance, LEVERS, atol=1e-12)
    np.testing.assert_allclose(np.diff(distance), -0.05, atol=1e-12)


def test_the_knob_swings_out_towards_the_robot(door: Scene):
    data = mujoco.MjData(door.model)
    mujoco.mj_kinematics(door.model, data)
    closed = data.site("knob").xpos.copy()
    data.qpos[door.qpos("hinge")] = 0.5
    mujoco.mj_kinematics(door.model, data)
    assert data.site("knob").xpos[0] < closed[0] - 0.1
    assert data.site("knob").xpos[2] == pytest.approx(closed[2])


def test_paper_gains_are_those_of_table_i():
    scene = door_scene(gains="paper")
    actuators = [scene.id("actuator", j) for j in ARM]
    np.testing.assert_array_equal(
        scene.model.actuator_gainprm[actuators, 0], [4500, 4500, 3500, 3500, 2000, 2000, 2000]
    )
    np.testing.assert_array_equal(
        scene.model.actuator_biasprm[actuators, 1], [-4500, -4500, -3500, -3500] + [-2000] * 3
    )
    np.testing.assert_array_equal(scene.model.dof_damping[scene.joint_dofs], [100, 100, 100, 100, 100, 10, 0.4])


def test_door_starts_at_the_means_of_table_i(door: Scene):
    """diag(Sigma_init) and mu_init of Table I, door and fingers."""
    space = door_space(door, preset="paper")
    table = dict(door_mass=(1.144, 0.5), knob_mass=(0.199, 0.1), hinge_frictionloss=(0.05, 0.025),
                 hinge_stiffness=(0.01, 0.005), hinge_damping=(2.0, 1.0), sliding_friction_left=(0.5, 0.25),
                 sliding_friction_right=(0.5, 0.25), torsional_friction_left=(0.5, 0.25),
                 torsional_friction_right=(0.5, 0.25), joint_damping_1=(100, 2), joint_damping_6=(10, 1),
                 joint_damping_7=(0.4, 0.2))  # fmt: skip
    assert len(space) == 16
    for name, (mean, std) in table.items():
        assert (space[name].mean, space[name].std) == (pytest.approx(mean), pytest.approx(std)), name
    own = door_space(door)
    m = door.model
    assert m.body_mass[door.id("body", "door")] == pytest.approx(own["door_mass"].mean)
    assert m.body_mass[door.id("body", "knob")] == pytest.approx(own["knob_mass"].mean)
    assert m.dof_damping[door.dof("hinge")] == own["hinge_damping"].mean
    assert m.dof_frictionloss[door.dof("hinge")] == own["hinge_frictionloss"].mean


@pytest.mark.parametrize("springs", [0, 1, 2])
def test_the_fitted_columns_lie_inside_the_space(door: Scene, springs: int):
    column = truth(springs)
    assert len(column) == 9
    door_space(door).check(door_space(door).values(column))


def test_unknown_scene_variants_are_refused():
    for wrong, says in (
        (dict(springs=3), "springs must be at most 2, got 3"),
        (dict(knob=4), "knob must be at most 3, got 4"),
        (dict(gains="stiff"), "must be one of impedance, paper, got 'stiff'"),
    ):
        with pytest.raises(ValueError, match=says):
            door_scene(**wrong)
    with pytest.raises(ValueError, match="got 3"):
        truth(3)
    with pytest.raises(ValueError, match="got 'stiff'"):
        door_space(door_scene(), preset="stiff")


def test_options_change_a_copy_only(door: Scene):
    before = door.model.opt.iterations
    fine = with_options(door, timestep=0.001, iterations=before + 7)
    assert (fine.model.opt.timestep, fine.model.opt.iterations) == (0.001, before + 7)
    assert (door.model.opt.timestep, door.model.opt.iterations) == (0.002, before)
    with pytest.raises(ValueError, match="unknown option 'time_step'"):
        with_options(door, time_step=0.001)


@pytest.mark.parametrize(
    ("kind", "name", "valid"),
    [
        ("joint", "elbow", "hinge.*panda_joint1"),
        ("body", "handle", "cabinet, door, knob"),
        ("geom", "pad", "left_rail_near"),
        ("pair", "middle", "left_near, left_far, right_near, right_far"),
        ("actuator", "motor", "panda_joint7, panda_finger_joint1"),
        ("site", "tip", "pinch"),
    ],
)
def test_unknown_names_list_the_valid_ones(door: Scene, kind: str, name: str, valid: str):
    with pytest.raises(ValueError, match=rf"unknown {kind} '{name}'.*{valid}"):
        door.id(kind, name)


def test_field_helpers_name_what_is_wrong(door: Scene):
    with pytest.raises(ValueError, match=r"unknown body 'panel'.*door"):
        body_mass(door, "panel", std=1.0, high=2.0)
    with pytest.raises(ValueError, match=r"unknown joint 'elbow'.*hinge"):
        joint_damping(door, "elbow", std=1.0, high=2.0)
    with pytest.raises(ValueError, match="no actuator drives 'hinge'; driven joints: panda_joint1"):
        servo_scale(door, "hinge")
    with pytest.raises(ValueError, match="'tendon_stiffness' is not a model field"):
        model_parameter(door, "tendon_stiffness", "x", unit="-", std=1.0, high=2.0)
    with pytest.raises(ValueError, match="'dof_dumping' is not a model field"):
        model_parameter(door, "dof_dumping", "hinge", unit="-", std=1.0, high=2.0)
    with pytest.raises(ValueError, match="body 'cabinet' has no mass"):
        body_mass(door, "cabinet", std=1.0, high=2.0)


def test_positions_and_commands_are_matched_by_name(door: Scene):
    qpos = door.initial_qpos({"panda_joint3": 0.4, "hinge": 0.1})
    assert qpos[door.qpos("panda_joint3")] == 0.4 and qpos[door.qpos("hinge")] == 0.1
    names = tuple(reversed((*ARM, *FINGERS)))
    np.testing.assert_array_equal(door.command_index(names), np.arange(8, -1, -1))
    with pytest.raises(ValueError, match="missing: panda_joint5, panda_finger_joint2"):
        door.command_index([n for n in names if n not in ("panda_joint5", "panda_finger_joint2")])
    with pytest.raises(ValueError, match="unknown joint 'elbow'"):
        door.initial_qpos({"elbow": 0.0})


# ----- users' own scenes

TEMPLATE = """<mujoco>
  <option {option}/>
  <worldbody>
    <body name="arm"><joint name="j" {joint}/><geom name="rod" size=".02 .2" type="capsule" {geom}/></body>
    <body name="box" pos="1 0 0"><freejoint name="free"/><geom name="box" size=".1"/></body>
  </worldbody>
  <contact><pair name="touch" geom1="rod" geom2="box" {pair}/></contact>
  <tendon><fixed name="t" {tendon}><joint joint="j" coef="1"/></fixed></tendon>
  <actuator><position name="servo" joint="j" kp="10" {actuator}/></actuator>
  <sensor><jointpos joint="j" {sensor}/></sensor>
</mujoco>"""


def mechanism(**filled: str) -> mujoco.MjSpec:
    slots = dict.fromkeys(("option", "joint", "geom", "pair", "tendon", "actuator", "sensor"), "")
    return mujoco.MjSpec.from_string(TEMPLATE.format(**{**slots, **filled}))


def test_unlimited_joints_are_given_by_name():
    """All named joints, also from a generator."""
    xml = """<mujoco><compiler autolimits="true"/><worldbody>
      <body><joint name="a" range="-9 9"/><geom size=".1"/><body pos="0 0 1"><joint name="b" range="-9 9"/>
      <geom size=".1"/><body pos="0 0 1"><joint name="c" range="-9 9"/><geom size=".1"/></body></body></body>
      </worldbody>
      <actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/></actuator></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "chain", unlimited=(name for name in ("a", "b")))
    assert scene.model.jnt_limited.tolist() == [0, 0, 1]


def test_table_i_needs_fingers():
    with pytest.raises(ValueError, match="scene 'rod' has no grip"):
        door_space(compile_scene(mechanism(), "rod"))


def test_a_plain_mechanism_is_accepted():
    scene = compile_scene(mechanism(joint='stiffness="2" damping="3"', tendon='stiffness="1"'), "rod")
    assert scene.joints == scene.command_names == ("j",)


@pytest.mark.parametrize(
    ("filled", "says"),
    [
        (dict(joint='stiffness="1 2 3"'), "polynomial joint stiffness"),
        (dict(joint='damping="1 0.5 0"'), "polynomial joint damping"),
        (dict(tendon='stiffness="1 0 3"'), "polynomial tendon stiffness"),
        (dict(tendon='damping="1 2 0"'), "polynomial tendon damping"),
        (dict(actuator='delay="0.01" nsample="20"'), "actuator delay"),
        (dict(actuator='damping="1"'), "actuator damping"),
        (dict(actuator='damping="1 2 3"'), "polynomial actuator damping"),
        (dict(actuator='armature="0.1"'), "actuator armature"),
        (dict(sensor='delay="0.01" nsample="20"'), "sensor delay"),
        (dict(geom='adhesion="1"'), "adhesion of geoms"),
        (dict(option='noslip_iterations="3"'), "noslip solver"),
    ],
)
def test_features_that_mjx_ignores_are_refused_by_name(filled: dict, says: str):
    with pytest.raises(ValueError, match=rf"scene 'rod' uses features.*{says}"):
        compile_scene(mechanism(**filled), "rod")


def test_all_ignored_features_are_listed_at_once():
    with pytest.raises(ValueError, match="polynomial joint stiffness, actuator delay"):
        compile_scene(mechanism(joint='stiffness="1 2 3"', actuator='delay="0.01" nsample="20"'), "rod")


def test_ball_and_free_joints_are_refused():
    for wrong in (dict(joints=["free"]), dict(object_joint="free")):
        with pytest.raises(ValueError, match="joint 'free' of scene 'rod' must be a hinge or a slide"):
            compile_scene(mechanism(), "rod", **wrong)


def test_actuators_that_drive_no_joint_have_their_own_name():
    spec = mechanism()
    pull = spec.add_actuator(name="pull", target="t", trntype=mujoco.mjtTrn.mjTRN_TENDON)
    scene = compile_scene(spec, "rod")
    assert scene.command_names[-1] == "pull" and "pull" not in (*scene.joints, *scene.driven_joints)
    assert "pull" not in scene.needs_command
    for name, said in (("", "actuator"), ("j", "actuator 'j'")):
        pull.name = name
        with pytest.raises(ValueError, match=rf"{said}.* drives no joint: give it a name that no joint has"):
            compile_scene(spec, "rod")


def test_friction_loss_rows_exist_only_where_requested(tmp_path: Path):
    file = tmp_path / "rod.xml"
    file.write_text(
        TEMPLATE.format(**dict.fromkeys(("option", "joint", "geom", "pair", "tendon", "actuator", "sensor"), ""))
    )
    with pytest.raises(ValueError, match=r"'j' was compiled with friction loss 0.*friction_joints"):
        joint_frictionloss(load_scene(file), "j", std=1.0, high=2.0)
    scene = load_scene(file, friction_joints=["j"])
    assert scene.model.dof_frictionloss[scene.dof("j")] == TINY_FRICTIONLOSS
    joint_frictionloss(scene, "j", std=1.0, mean=0.1, high=2.0)
    with pytest.raises(ValueError, match=r"unknown joint 'k'.*has: free, j"):
        load_scene(file, friction_joints=["k"])
    urdf = tmp_path / "rod.urdf"
    urdf.write_text('<robot name="rod"><link name="rod"/></robot>')
    with pytest.raises(ValueError, match=r"rod\.urdf has no joints at all"):
        load_scene(urdf, friction_joints=["k"])


def test_visual_geoms_are_removed_without_a_change_of_mass():
    """Only geoms of group 2 that cannot collide are removed; their mass stays with their body."""
    xml = """<mujoco>{compiler}<worldbody><geom name="floor" type="plane" size="1 1 1"/>
      <body name="arm" pos="0 0 1"><joint name="swing" axis="0 1 0"/>
        <geom name="bone" type="capsule" size=".02 .2"/>
        <geom name="cover" type="box" size=".1 .05 .05" pos=".1 0 0" group="2" contype="0" conaffinity="0" mass="0.7"/>
        <geom name="bumper" type="sphere" size=".03" group="2"/>
        <geom name="paired" type="sphere" size=".02" group="2" contype="0" conaffinity="0"/>
        <geom name="drum" type="cylinder" size=".03 .05" group="2" contype="0" conaffinity="0"/><site name="end"/>
        <geom name="seen" type="sphere" size=".02" group="2" contype="0" conaffinity="0"/></body><site name="fixed"/>
      <body name="painted"><joint name="turn"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <geom type="sphere" size=".1" group="2" contype="0" conaffinity="0"/></body></worldbody>
      <contact><pair geom1="paired" geom2="floor"/></contact>
      <sensor><framepos objtype="geom" objname="seen"/></sensor>
      <tendon><spatial><site site="fixed"/><geom geom="drum"/><site site="end"/></spatial></tendon>
      <actuator><position name="swing" joint="swing" kp="9"/></actuator></mujoco>"""
    kept = ["floor", "bone", "bumper", "paired", "drum", "seen"]  # the last three are named by a pair and so on
    for compiler in ("", '<compiler inertiafromgeom="true"/>'):
        whole = mujoco.MjModel.from_xml_string(xml.format(compiler=compiler))
        scene = compile_scene(mujoco.MjSpec.from_string(xml.format(compiler=compiler)), "covered")
        assert [whole.geom(int(i)).name for i in scene.full_geom_ids] == kept
        for model in (scene.model, instrument(scene)):
            assert [model.geom(i).name for i in range(model.ngeom)] == kept
            for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_M0"):
                np.testing.assert_allclose(getattr(model, field), getattr(whole, field), rtol=1e-12)


@pytest.mark.parametrize("compiler", ["", '<compiler inertiafromgeom="true"/>'])
def test_a_body_may_have_visual_geoms_only(compiler: str):
    xml = f"""<mujoco>{compiler}<worldbody><body name="a"><joint name="j"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="1" group="2" contype="0" conaffinity="0"/>
      <body name="b" pos=".3 0 0"><joint name="k"/><geom size=".1" density="500"/></body></body></worldbody>
      <actuator><position name="j" joint="j" kp="9"/></actuator></mujoco>"""
    whole, scene = (f(xml) for f in (mujoco.MjModel.from_xml_string, mujoco.MjSpec.from_string))
    model = compile_scene(scene, "looks").model
    assert model.ngeom == 1
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_allclose(getattr(model, field), getattr(whole, field), rtol=1e-12)


@pytest.mark.parametrize("option", ['integrator="implicit"', 'solver="PGS"'])  # a scene for the C engine alone
def test_features_that_mjx_lacks_are_refused_in_a_sentence(option: str):
    xml = f"""<mujoco><option {option}/><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
      <actuator><position name="j" joint="j" kp="9"/></actuator></mujoco>"""
    with pytest.raises(ValueError, match="scene 'new' uses something that MJX does not support"):
        compile_scene(mujoco.MjSpec.from_string(xml), "new", engine="mujoco").mjx  # noqa: B018


def test_a_file_that_is_missing_or_broken_is_named(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"nothing.xml"):
        load_scene(tmp_path / "nothing.xml")
    with pytest.raises(FileNotFoundError, match="is a folder, not an MJCF file"):
        load_scene(tmp_path)
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><body></worldbody></mujoco>")
    with pytest.raises(ValueError, match=r"broken.xml"):
        load_scene(broken)
    lost = '<asset><mesh name="m" file="lost.stl"/></asset><worldbody><geom type="mesh" mesh="m"/></worldbody>'
    broken.write_text(f"<mujoco>{lost}</mujoco>")
    with pytest.raises(ValueError, match=r"broken.xml: .*lost.stl"):
        load_scene(broken)


def test_a_scene_without_elements_of_a_kind_says_so():
    scene = compile_scene(mujoco.MjSpec.from_string("<mujoco/>"), "empty")
    with pytest.raises(ValueError, match="unknown pair 'grip'; this scene has no pair with a name"):
        scene.id("pair", "grip")


SERVO_AND_DAMPER = """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size=".1" pos="0 0 .2"/>
  <body name="b" pos="0 0 .3"><joint name="k" axis="0 1 0"/><geom size=".1" pos="0 0 .2"/></body></body></worldbody>
  <actuator>{}<position joint="k" kp="9"/></actuator></mujoco>"""


@pytest.mark.parametrize("turned", [False, True])
def test_the_position_servo_of_several_actuators_has_the_joints_name(turned: bool):
    pair = ['<position name="p" joint="j" kp="100"/>', '<velocity name="damper" joint="j" kv="5"/>']
    text = SERVO_AND_DAMPER.format("".join(reversed(pair) if turned else pair))
    scene = compile_scene(mujoco.MjSpec.from_string(text), "two")
    servo, damper = (1, 0) if turned else (0, 1)
    assert scene.command_names[servo] == "j" and scene.command_names[damper] == "damper"
    assert scene.joints == scene.driven_joints == scene.needs_command == ("j", "k")
    assert scene.command_index(("k", "j"))[[servo, damper]].tolist() == [1, -1]


@pytest.mark.parametrize(
    "actuators",
    [
        '<motor name="a" joint="j"/><velocity name="b" joint="j" kv="1"/>',
        '<position name="a" joint="j"/><position name="b" joint="j"/>',
    ],
)
def test_several_actuators_without_a_single_servo_have_their_own_names(actuators: str):
    scene = compile_scene(mujoco.MjSpec.from_string(SERVO_AND_DAMPER.format(actuators)), "two")
    assert scene.command_names == ("a", "b", "k") and scene.joints == scene.needs_command == ("k",)


@pytest.mark.parametrize(
    ("actuators", "said"),
    [
        (
            '<position joint="j"/><velocity joint="j" kv="1"/>',
            "actuator 1 shares its joint with another one: give it a name",
        ),
        (
            '<position joint="j"/><velocity name="k" joint="j"/>',
            "'k' shares its joint with another one: give it a name that",
        ),
    ],
)
def test_actuators_beside_a_servo_need_names(actuators: str, said: str):
    with pytest.raises(ValueError, match=said):
        compile_scene(mujoco.MjSpec.from_string(SERVO_AND_DAMPER.format(actuators)), "two")


def test_a_damper_in_addition_to_a_servo_needs_no_command():
    pair = '<position name="p" joint="j" kp="100"/><velocity name="damper" joint="j" kv="5"/>'
    scene = compile_scene(mujoco.MjSpec.from_string(SERVO_AND_DAMPER.format(pair)), "two", grip=Grip(()))
    assert scene.needs_command == ("j", "k")


def test_joints_that_carry_measured_joints():
    spec = mujoco.MjSpec.from_string("""<mujoco><worldbody>
      <body name="base"><freejoint name="root"/><geom size=".1"/>
        <body name="hip"><joint axis="0 1 0"/><geom size=".1"/>
          <body name="leg"><joint name="knee" axis="0 1 0"/><geom size=".1"/></body></body></body>
      <body name="ball"><freejoint name="free"/><geom size=".1"/></body></worldbody>
      <actuator><position joint="knee"/></actuator></mujoco>""")
    scene = compile_scene(spec, "legs")
    assert scene.carriers(scene.joints) == ("the joint of body 'hip'", "knee")
    assert scene.floating(scene.joints) == ("root",)


@pytest.mark.parametrize(
    "text",
    [
        "<mujoco><worldbody><geom size='1'></worldbody></mujoco>",
        "<mujoco><asset><asset/></asset></mujoco>",
        "<mujoco><worldbody><geom size='1' material='none'/></worldbody></mujoco>",
        "<mujoco><worldbody><body name='\u202ea\u2028b'><geom size='0'/></body></worldbody></mujoco>",
    ],
)
def test_mujocos_message_about_a_file_is_one_line(tmp_path, text):
    path = tmp_path / "own.xml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError) as refused:
        load_scene(path)
    assert str(refused.value).startswith(f"{path}: ") and len(str(refused.value).splitlines()) == 1


def test_dry_friction_is_hardened_unless_the_mjcf_sets_its_impedance(tmp_path: Path):
    joint = '<joint name="{0}" axis="0 1 0" {1}/><inertial pos="0 0 0.1" mass="1" diaginertia="1 1 1"/>'
    rubs = 'frictionloss="0.3"'
    own, slow = f'{rubs} solimpfriction="0.99 0.99"', f'{rubs} solreffriction="0.1 1"'
    joints = {"plain": rubs, "asked": "", "free": "", "own": own, "slow": slow}
    bodies = "".join(f"<body>{joint.format(name, with_)}</body>" for name, with_ in joints.items())
    path = tmp_path / "five.xml"
    path.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    given, held = (load_scene(path, joints=[*joints], friction_joints=["asked"], hold=hold) for hold in (False, True))
    assert (given.held, held.held) == ((), ("plain", "asked"))
    first = {name: held.model.dof_solimp[held.dof(name), 0] for name in joints}
    assert first == {"plain": 0.9999, "asked": 0.9999, "free": 0.9, "own": 0.99, "slow": 0.9}
    np.testing.assert_array_equal(given.model.dof_solimp[[0, 1, 2, 4], 0], 0.9)
    assert mujoco.MjSpec.from_string(held.spec.to_xml()).joint("plain").solimp_friction[1] == 0.9999
