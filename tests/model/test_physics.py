"""Applying parameter values equals compiling an MJCF with them, in C and in MJX."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from droid_jax.door.scene import ARM, door_scene
from droid_jax.door.space import door_nuisances, door_space
from droid_jax.model.fields import body_mass, check_space, model_parameter, servo_scale
from droid_jax.model.parameters import Mode, Parameter, Space, Write
from droid_jax.model.physics import derive, make_c_model, make_physics, theta_of, written_fields
from droid_jax.model.scene import Scene, compile_scene, load_scene
from droid_jax.model.visual_geoms import LOOK_GROUP

# The compiler's bounding-volume tree: explicit contact pairs never look at it.
NOT_DERIVED = {"bvh_aabb", "oct_aabb"}
# Body sizes, the scene's extent, cameras and lights: for the eye only.
EYE_ONLY = {"meansize", "extent", "center", "dof_length"}
# Boxes and radii, which MJX does not read for the door's pairs, and the scale of muscles.
C_ONLY = {"geom_rbound", "geom_aabb", "geom_rbound_hfield", "actuator_acc0"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return door_scene(springs=1)


@pytest.fixture(scope="module")
def space(scene: Scene) -> Space:
    return door_space(scene) + door_nuisances(scene)


@pytest.fixture(scope="module")
def vectors(space: Space) -> np.ndarray:
    """Draws of twice the prior's width."""
    rng = np.random.default_rng(7)
    x = np.array([2.0 * rng.normal(size=len(space)) for _ in range(3)])
    return space.from_search(x)


def edited(scene: Scene, space: Space, values: np.ndarray) -> mujoco.MjModel:
    """The same values written into the MJCF by its attributes, and compiled."""
    v = dict(zip(space.names, values.tolist(), strict=True))
    spec = scene.spec.copy()
    for geom in list(spec.geoms):
        if geom.group == LOOK_GROUP:
            spec.delete(geom)
    for name in ARM:
        spec.joint(name).limited = False
    spec.geom("panel").mass = v["door_mass"]
    knob = spec.body("knob")
    knob.inertia = np.array(knob.inertia) * v["knob_mass"] / knob.mass
    knob.mass = v["knob_mass"]
    hinge = spec.joint("hinge")
    hinge.frictionloss = v["hinge_frictionloss"]
    hinge.stiffness = [v["hinge_stiffness"], 0, 0]
    hinge.damping = [v["hinge_damping"], 0, 0]
    for side in ("left", "right"):
        for rail in ("near", "far"):
            slide, twist = v[f"sliding_friction_{side}"], v[f"torsional_friction_{side}"]
            spec.pair(f"{side}_{rail}").friction = [slide, slide, twist, 1e-4, 1e-4]
    cabinet = spec.body("cabinet")
    cabinet.pos = np.add(cabinet.pos, [v["door_x"], v["door_y"], v["door_z"]])
    cabinet.quat = [np.cos(v["door_yaw"] / 2), 0, 0, np.sin(v["door_yaw"] / 2)]
    knob.pos = np.add(knob.pos, [0, v["knob_lever"], 0])
    knob_geom = spec.geom("knob")
    knob_geom.size = np.add(knob_geom.size, [v["knob_radius"], 0, 0])
    for i in range(2, 8):
        link, scale = spec.body(f"link{i}"), v[f"link_mass_scale_{i}"]
        link.mass *= scale
        link.fullinertia = np.array(link.fullinertia) * scale
        link.gravcomp /= scale
    for i, name in enumerate(ARM, 1):
        spec.joint(name).damping = [v[f"joint_damping_{i}"], 0, 0]
        actuator = spec.actuator(name)
        gain = actuator.gainprm[0] * v[f"servo_scale_{i}"]
        actuator.gainprm[0], actuator.biasprm[1] = gain, -gain
    return spec.compile()


def float_fields(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    out = {}
    for name in dir(model):
        value = getattr(model, name, None) if not name.startswith("_") else None
        if isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.floating):
            out[name] = value
    for part in ("opt", "stat"):
        for name in dir(getattr(model, part)):
            value = getattr(getattr(model, part), name) if not name.startswith("_") else None
            if isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f"):
                out[f"{part}.{name}"] = np.asarray(value)
    return out


def skipped(name: str) -> bool:
    return name in NOT_DERIVED or name.split(".")[-1] in EYE_ONLY or name.startswith(("cam_", "light_"))


def test_c_model_equals_compilation_field_by_field(scene: Scene, space: Space, vectors: np.ndarray):
    for values in vectors:
        applied = float_fields(make_c_model(scene, space, values))
        compiled = float_fields(edited(scene, space, values))
        assert len(applied) > 100 and applied.keys() == compiled.keys()
        # The yaw's quaternion is right to third order in the angle.
        yaw = values[space.index("door_yaw")]
        for name, array in compiled.items():
            if skipped(name):
                continue
            if name in ("body_ipos", "body_iquat"):  # the compiler writes anything there where there is no mass
                heavy = scene.model.body_mass > 0
                array, applied[name] = array[heavy], applied[name][heavy]
            atol = 1e-12 + (abs(yaw) ** 3 / 20 if name == "body_quat" else 0.0)
            # Geometry enters the derived fields too, as everything hangs on the cabinet.
            rtol = 1e-9 + (abs(yaw) ** 3 if "invweight" in name or "M0" in name or "inertia" in name else 0.0)
            np.testing.assert_allclose(applied[name], array, rtol=rtol, atol=atol, err_msg=name)


def test_the_oracle_really_changes_the_model(scene: Scene, space: Space, vectors: np.ndarray):
    """The comparison above would pass for two unchanged models, so every declared field must differ here."""
    nominal, compiled = float_fields(scene.model), float_fields(edited(scene, space, vectors[0]))
    for name in written_fields(space):
        if name in ("stat", "tendon_length0", "tendon_invweight0", "eq_data"):
            continue
        assert np.abs(compiled[name] - nominal[name]).max() > 0, name
    assert compiled["stat.meaninertia"] != nominal["stat.meaninertia"]


def mjx_fields(model: Any, path: str = "") -> dict[str, np.ndarray]:
    """All floating-point arrays of an mjx.Model and its parts."""
    out = {}
    for field in dataclasses.fields(model):
        value = getattr(model, field.name)
        if dataclasses.is_dataclass(value):
            out.update(mjx_fields(value, f"{path}{field.name}."))
        elif isinstance(value, (np.ndarray, jax.Array, float)) and np.issubdtype(np.asarray(value).dtype, np.floating):
            out[f"{path}{field.name}"] = np.asarray(value, dtype=float)
    return out


@pytest.fixture(scope="module")
def apply(scene: Scene, space: Space):
    return jax.jit(lambda values: make_physics(scene, space, values))


def test_mjx_model_equals_compilation_field_by_field(scene: Scene, space: Space, vectors: np.ndarray, apply):
    for values in vectors:
        applied = mjx_fields(apply(values.astype(np.float32)).model)
        compiled = mjx_fields(mjx.put_model(edited(scene, space, values)))
        yaw = values[space.index("door_yaw")]
        compared = 0
        for name, array in compiled.items():
            short = name.split(".")[-1]
            if skipped(short) or short in C_ONLY:
                continue
            if short in ("body_ipos", "body_iquat"):
                heavy = scene.model.body_mass > 0
                array, applied[name] = array[heavy], applied[name][heavy]
            # float32: 6e-8 in each number, times the conditioning of M's inverse in the inverse weights.
            rtol = 5e-4 if "invweight" in short else 3e-6
            atol = 1e-7 + (abs(yaw) ** 3 / 20 if short == "body_quat" else 0.0)
            np.testing.assert_allclose(applied[name], array, rtol=rtol + abs(yaw) ** 3, atol=atol, err_msg=name)
            compared += 1
        assert compared > 60


def test_only_declared_fields_change(scene: Scene, space: Space, vectors: np.ndarray, apply):
    declared = set(written_fields(space))
    nominal, applied = float_fields(scene.model), float_fields(make_c_model(scene, space, vectors[0]))
    changed = {n.split(".")[0] for n in nominal if not np.array_equal(nominal[n], applied[n])}
    # mj_setConst refreshes quantities that no replay reads: camera offsets and the scale of muscles.
    assert {c for c in changed if not skipped(c)} - {"actuator_acc0"} <= declared
    before, after = mjx_fields(scene.mjx), mjx_fields(apply(vectors[0].astype(np.float32)).model)
    changed = {n.split(".")[0] for n in before if not np.array_equal(before[n], after[n])}
    assert changed <= declared
    assert {"body_mass", "dof_damping", "pair_friction", "body_quat", "dof_invweight0"} <= changed


def test_the_scene_is_unchanged_and_applying_twice_is_applying_once(
    scene: Scene, space: Space, vectors: np.ndarray, apply
):
    before = {k: v.copy() for k, v in float_fields(scene.model).items()}
    once = float_fields(make_c_model(scene, space, vectors[0]))
    make_c_model(scene, space, vectors[1])
    again = float_fields(make_c_model(scene, space, vectors[0]))
    for name, array in before.items():
        np.testing.assert_array_equal(float_fields(scene.model)[name], array, err_msg=name)
        np.testing.assert_array_equal(again[name], once[name], err_msg=name)
    first, second = (mjx_fields(apply(vectors[0].astype(np.float32)).model) for _ in range(2))
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def test_the_means_give_the_scene_back(scene: Scene):
    """The nuisances' means are neutral: in C to the last digits."""
    space = door_nuisances(scene)
    applied, nominal = float_fields(make_c_model(scene, space, space.mean)), float_fields(scene.model)
    for name, array in nominal.items():
        if not skipped(name):
            np.testing.assert_allclose(applied[name], array, rtol=1e-12, atol=1e-14, err_msg=name)


def test_a_first_use_inside_jit_leaves_the_scene_usable():
    """The mjx.Model is cached and must not contain values of a trace."""
    fresh = door_scene()
    space = door_space(fresh).select(["hinge_damping"])
    traced = jax.jit(lambda values: make_physics(fresh, space, values).model.dof_damping)
    assert float(traced(np.array([3.0], np.float32))[fresh.dof("hinge")]) == 3.0
    np.testing.assert_allclose(np.asarray(fresh.mjx.dof_damping), fresh.model.dof_damping, rtol=1e-6)


@pytest.mark.slow
def test_values_outside_the_model_are_in_theta(scene: Scene, space: Space, vectors: np.ndarray, apply):
    expected = {"time_offset", *(f"torque_offset[{j}]" for j in ARM)}
    theta = apply(vectors[0].astype(np.float32)).theta
    assert set(theta) == set(theta_of(space, vectors[0])) == expected
    for name, value in theta_of(space, vectors[0]).items():
        assert float(theta[name]) == pytest.approx(value, rel=1e-6)
        assert value == vectors[0][space.index(name)]


# ----- what the compiler derives, on mechanisms with other joints

MECHANISMS = {
    "free and ball": """
      <body name="a" pos="0 0 1"><freejoint/><geom size=".1 .2 .3" type="box" mass="2"/>
        <body name="b" pos=".3 0 0" quat="1 .2 .1 0"><joint type="ball" armature=".01"/>
          <geom size=".05 .2" type="capsule" pos=".1 .1 0" mass="1"/>
          <body name="c" pos="0 .3 .1"><joint axis="0 1 1" armature=".02"/>
            <geom size=".04 .06 .05" type="box" pos=".02 .03 .1" mass=".5"/></body></body></body>
      <body name="fixed" pos="3 0 0"><geom size=".1" mass="1"/></body>""",
    "lone slide": '<body name="a"><joint type="slide" axis="1 0 0"/><geom size=".1" mass="2"/></body>',
    "slide with armature": '<body name="a"><joint type="slide" armature="3"/><geom size=".1" mass="2"/></body>',
    "two slides": """<body name="a"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
      <geom size=".1" mass="2"/></body>""",
    "slide and hinge": """<body name="a"><joint type="slide" axis="1 0 0"/><joint axis="0 0 1"/>
      <geom size=".1 .2 .3" type="box" mass="2"/></body>""",
    "central hinge": '<body name="a"><joint axis="0 0 1"/><geom size=".1 .2 .3" type="box" mass="2"/></body>',
    "finger": """<body name="a"><joint axis="0 1 0"/><geom size=".1 .2 .3" type="box" pos=".2 0 0" mass="2"/>
      <body name="b" pos=".3 0 0"><joint type="slide" axis="0 1 0" armature=".3"/><geom size=".1" mass=".2"/></body>
      </body>""",
    "tendons": """<body name="a" pos="0 0 1"><joint name="a" axis="0 1 0"/>
      <geom size=".1 .2 .3" type="box" pos=".3 .1 0" mass="2"/><site name="sa" pos=".2 0 .1"/>
      <body name="b" pos=".3 0 0"><joint axis="0 1 1" name="b"/><geom size=".05 .2" type="capsule" mass="1"/>
      <site name="sb" pos=".2 0 .1"/></body></body></worldbody>
      <tendon><fixed armature="3"><joint joint="a" coef=".7"/><joint joint="b" coef="-1.2"/></fixed>
      <spatial><site site="sa"/><site site="sb"/></spatial></tendon><worldbody>""",
    "connected and welded": """<body name="a" pos="0 0 1" euler="0 10 0"><joint axis="0 1 0"/>
      <geom size=".1 .2 .3" type="box" pos=".3 .1 0" mass="2"/>
      <body name="b" pos=".3 0 .2" euler="20 0 30"><joint type="ball"/>
      <geom size=".05 .2" type="capsule" mass="1"/></body></body>
      <body name="c" pos=".1 .2 .3"><freejoint/><geom size=".1" mass="1"/></body></worldbody>
      <equality><connect body1="a" body2="b" anchor=".1 .02 .03"/><weld body1="b" body2="c"/><connect body1="b"
      anchor=".1 0 0"/><weld body1="a" body2="b" anchor=".1 .02 .03"/>
      <weld body1="a" body2="c" relpose=".4 .1 .1 1 0 0 0"/></equality><worldbody>""",
}
DERIVED = (
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0"),
    *("tendon_length0", "tendon_invweight0", "eq_data"),
)


def compiled(name: str, *, scale: float = 1.0, move: float = 0.0) -> mujoco.MjModel:
    """A mechanism whose geoms have `scale` times their mass, and whose bodies are moved."""
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{MECHANISMS[name]}</worldbody></mujoco>")
    for geom in spec.geoms:
        geom.mass *= scale
    for body in spec.bodies[1:]:
        body.pos = np.add(body.pos, [0.0, move, 0.0])
    return spec.compile()


@pytest.mark.slow
@pytest.mark.parametrize("name", MECHANISMS)
def test_derived_quantities_equal_the_compiler(name: str):
    target = compiled(name, scale=2.5, move=0.07)
    changed = copy.copy(compiled(name))
    changed.body_mass[:] *= 2.5
    changed.body_inertia[:] *= 2.5
    changed.body_pos[1:, 1] += 0.07
    free = changed.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    changed.qpos0[changed.jnt_qposadr[free] + 1] += 0.07  # where the compiler lets such a body begin
    model = jax.jit(derive)(mjx.put_model(changed))
    for field in DERIVED:
        # float32 inverse of an inertia matrix of a few rows
        np.testing.assert_allclose(getattr(model, field), getattr(target, field), rtol=2e-4, atol=1e-5, err_msg=field)
    assert float(model.stat.meaninertia) == pytest.approx(target.stat.meaninertia, rel=1e-5)
    assert float(model.stat.meanmass) == pytest.approx(target.stat.meanmass, rel=1e-5)


def heavier(name: str) -> tuple[Scene, Space]:
    """A mechanism and the mass of its first body."""
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{MECHANISMS[name]}</worldbody></mujoco>")
    spec.add_actuator(name="drive", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="a")
    scene = compile_scene(spec, "mechanism", joints=["a"])
    return scene, Space((body_mass(scene, "a", std=1.0, high=9.0),))


def test_the_c_model_has_the_armature_of_tendons():
    """A mass at its nominal value changes nothing."""
    scene, space = heavier("tendons")
    assert scene.model.stat.meaninertia > 1.5  # mostly the tendon's
    same = make_c_model(scene, space, space.mean)
    assert same.stat.meaninertia == pytest.approx(scene.model.stat.meaninertia, rel=1e-9)


def rests(xml: str, field: str, column: int, value: float) -> tuple[float, float, float]:
    """m, resting height of a body: in the C model, in MJX and in the compiled model with that number."""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "fall", joints=["z"])
    space = Space((model_parameter(scene, field, "ball", column, unit="m", std=0.1, low=-1.0, high=1.0),))
    spec = mujoco.MjSpec.from_string(xml)
    attribute = list(getattr(spec.geom("ball"), field.removeprefix("geom_")))
    attribute[column] = value
    setattr(spec.geom("ball"), field.removeprefix("geom_"), attribute)
    heights = []
    for model in (make_c_model(scene, space, np.array([value])), spec.compile()):
        data = mujoco.MjData(model)
        while data.time < 1.5:
            mujoco.mj_step(model, data)
        heights.append(float(data.qpos[0]))
    model = make_physics(scene, space, jnp.asarray([value], jnp.float32)).model
    data = jax.jit(lambda d: jax.lax.fori_loop(0, 750, lambda _, d: mjx.step(model, d), d))(mjx.make_data(model))
    return heights[0], float(data.qpos[0]), heights[1]


@pytest.mark.slow
@pytest.mark.parametrize(("field", "column", "value"), [("geom_pos", 2, -0.1), ("geom_size", 0, 0.15)])
def test_a_geom_that_was_moved_or_enlarged_touches_in_both_engines(field: str, column: int, value: float):
    xml = """<mujoco><worldbody><geom type="plane" size="5 5 1"/><body pos="0 0 .3"><joint name="z" type="slide"
      damping="30" axis="0 0 1"/><geom name="ball" size=".05" mass="1"/></body></worldbody>
      <actuator><motor joint="z"/></actuator></mujoco>"""
    in_c, mjx_, compiled_ = rests(xml, field, column, value)
    assert compiled_ > -0.2  # 0.05 would lie at -0.25
    np.testing.assert_allclose([in_c, mjx_], compiled_, atol=1e-3)


def test_a_moved_joint_axis_is_derived_too():
    """jnt_pos and jnt_axis change the inertia about a joint."""
    xml = """<mujoco><worldbody><body><joint name="j" axis="0 0 1"/><geom size=".1 .2 .3" type="box" pos=".1 0 0"/>
      </body></worldbody><actuator><position joint="j" kp="1"/></actuator></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "rod")
    space = Space((model_parameter(scene, "jnt_pos", "j", 0, unit="m", std=0.1, low=-1, high=1),))
    applied = make_c_model(scene, space, np.array([0.4]))
    spec = mujoco.MjSpec.from_string(xml)
    spec.joint("j").pos = [0.4, 0, 0]
    expected = spec.compile()
    assert expected.dof_M0[0] != pytest.approx(scene.model.dof_M0[0])
    assert applied.dof_M0[0] == pytest.approx(expected.dof_M0[0])
    for field in ("dof_M0", "dof_invweight0"):
        assert getattr(expected, field)[0] != pytest.approx(getattr(scene.model, field)[0])
    moved = jax.jit(lambda values: make_physics(scene, space, values).model)(np.array([0.4], np.float32))
    np.testing.assert_allclose(moved.dof_M0, expected.dof_M0, rtol=1e-6)
    np.testing.assert_allclose(moved.dof_invweight0, expected.dof_invweight0, rtol=1e-6)


@pytest.mark.slow
def test_a_tilted_axis_stays_a_unit_vector():
    """(0, 0, 1) with x set to a half is normalised, as by the compiler."""
    xml = """<mujoco><worldbody><body><joint name="j" axis="0 0 1"/><geom size=".1 .2 .3" type="box" pos=".1 0 0"/>
      </body></worldbody><actuator><position joint="j" kp="1"/></actuator></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "rod")
    space = Space((model_parameter(scene, "jnt_axis", "j", 0, unit="-", std=0.1, low=-1, high=1),))
    spec = mujoco.MjSpec.from_string(xml)
    spec.joint("j").axis = [0.5, 0, 1]
    expected = spec.compile()
    model = make_physics(scene, space, np.array([0.5], np.float32)).model
    for applied in (make_c_model(scene, space, np.array([0.5])), model):
        np.testing.assert_allclose(applied.jnt_axis, expected.jnt_axis, rtol=1e-6)
        np.testing.assert_allclose(applied.dof_M0, expected.dof_M0, rtol=1e-6)


def test_parameters_without_masses_derive_nothing(scene: Scene):
    space = Space((model_parameter(scene, "dof_damping", "hinge", unit="-", std=1.0, high=5.0, mode=Mode.SET),))
    assert written_fields(space) == ("dof_damping",)
    assert "dof_M0" in written_fields(Space((body_mass(scene, "door", std=1.0, high=5.0),)))


def test_parameters_of_one_entry_act_one_after_the_other():
    """A nuisance that scales a gain and an effect that scales it again both act."""
    scene = door_scene()
    first, second = (servo_scale(scene, ARM[2], name=n) for n in ("first", "second"))
    space = Space((first, second))
    values = np.array([1.1, 0.9])
    expected = scene.model.actuator_gainprm[2, 0] * 1.1 * 0.9
    in_mjx = make_physics(scene, space, jnp.asarray(values, jnp.float32)).model
    in_c = make_c_model(scene, space, values)
    np.testing.assert_allclose(in_mjx.actuator_gainprm[2, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(in_c.actuator_gainprm[2, 0], expected, rtol=1e-12)
    np.testing.assert_allclose(in_c.actuator_biasprm[2, 1], -expected, rtol=1e-12)


@pytest.mark.parametrize("flag", ["spring", "damper"])
def test_disabling_springs_only_is_refused(flag: str):
    xml = f"""<mujoco><option><flag {flag}="disable"/></option><worldbody><body><joint name="j" damping="1"/>
      <geom size=".1"/></body></worldbody><actuator><motor joint="j"/></actuator></mujoco>"""
    with pytest.raises(ValueError, match="springs without dampers, or dampers without springs"):
        compile_scene(mujoco.MjSpec.from_string(xml), "flagged")
    both = xml.replace(f'{flag}="disable"', 'spring="disable" damper="disable"')
    compile_scene(mujoco.MjSpec.from_string(both), "flagged")


def test_fields_that_mjx_ignores_are_refused(scene: Scene):
    """Also of a write that was made by hand."""
    for field, says in (("actuator_damping", "does not simulate it"), ("geom_fluid", "takes it as fixed")):
        write = Write(field, (0,) if field == "actuator_damping" else (0, 0))
        unread = Space((Parameter("unread", "-", 0.5, 0.1, 0.0, 1.0, writes=(write,)),))
        with pytest.raises(ValueError, match=says):
            make_physics(scene, unread, jnp.asarray([0.5]))
    xml = "<mujoco><worldbody><body name='b'><joint name='j'/><geom size='.1'/></body></worldbody></mujoco>"
    bare = compile_scene(mujoco.MjSpec.from_string(xml), "bare")
    lift = Space((Parameter("lift", "-", 0.5, 0.1, 0.0, 1.0, writes=(Write("body_gravcomp", (1,)),)),))
    with pytest.raises(ValueError, match="compiled without gravity compensation"):
        make_physics(bare, lift, jnp.asarray([0.5]))


SIMPLE = """<mujoco><compiler angle="radian"/><worldbody><body name="cart">{slide}
<joint name="y" axis="0 1 0" pos="0 0 {joint}"/>
<inertial mass="1" pos="0 0 {centre}" diaginertia=".01 .017 .02"/><geom size=".1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><position joint="y" kp="1"/></actuator></mujoco>"""
PLAIN = {"joint": 0.0, "centre": 0.0, "slide": ""}
SLIDE = '<joint name="x" type="slide" axis="1 0 0"/>'
MOVED = [("body_ipos", "cart", {"centre": 0.3}), ("jnt_pos", "y", {"joint": 0.3})]


def moved(folder: Path, field: str, element: str, **changes: Any) -> tuple[Scene, Space]:
    """The cart, with its centre of mass or its joint as a parameter."""
    (folder / "cart.xml").write_text(SIMPLE.format(**{**PLAIN, **changes}))
    scene = load_scene(folder / "cart.xml")
    return scene, Space((model_parameter(scene, field, element, 2, name="z", unit="m", std=0.1, low=-1.0, high=1.0),))


@pytest.mark.parametrize(("field", "element", "as_compiled"), MOVED)
def test_shortcuts_of_c_are_disabled_for_a_moved_centre(
    tmp_path: Path, field: str, element: str, as_compiled: dict[str, float]
):
    """The inertial frame was the body's frame before."""
    scene, space = moved(tmp_path, field, element)
    assert scene.model.body_simple[1]
    check_space(scene, space)
    expected = mujoco.MjModel.from_xml_string(SIMPLE.format(**{**PLAIN, **as_compiled}))
    written, other = (mujoco.MjData(m) for m in (make_c_model(scene, space, np.array([0.3])), expected))
    written.qpos[:] = other.qpos[:] = 0.4
    for model, data in ((make_c_model(scene, space, np.array([0.3])), written), (expected, other)):
        mujoco.mj_forward(model, data)
    np.testing.assert_allclose(written.qacc, other.qacc, rtol=1e-9)


@pytest.mark.parametrize(("field", "element"), [each[:2] for each in MOVED])
def test_joints_that_c_compiled_without_coupling_are_refused(tmp_path: Path, field: str, element: str):
    with pytest.raises(ValueError, match="without coupling between its 2 degrees of freedom"):
        check_space(*moved(tmp_path, field, element, slide=SLIDE))
    check_space(*moved(tmp_path, field, element, slide=SLIDE, centre=1e-6))  # as the message has it
