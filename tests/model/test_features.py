"""Features of a scene: those that MJX ignores are refused by name, and supported ones agree with C."""

from __future__ import annotations

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import types

from droid_jax.model.scene import compile_scene, load_scene
from droid_jax.model.step import simulate_step
from droid_jax.model.unsupported_features import IGNORED, refuse_ignored

ARM = """<mujoco><option integrator="implicitfast" {option}><flag {flag}/></option><extension>{extension}</extension>
  <worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" {joint}/>
    <geom type="capsule" size=".02 .2" mass="2" {geom}/><site name="tip"/>{body}</body></worldbody>
  <actuator>{actuator}</actuator>{more}</mujoco>"""
SLOTS = ("option", "flag", "extension", "joint", "geom", "body", "actuator", "more")
CABLE = """<composite prefix="c" type="cable" count="5 1 1" size="0.3" curve="s 0 0" initial="none">
  <plugin plugin="mujoco.elasticity.cable"><config key="bend" value="1e6"/><config key="twist" value="1e6"/></plugin>
  <joint kind="main" damping="0.01"/><geom type="capsule" size=".005" density="1000"/></composite>"""
PID = """<plugin plugin="mujoco.pid"><instance name="loop"><config key="kp" value="40"/></instance></plugin>"""


def arm(**filled: str) -> mujoco.MjSpec:
    slots = {**dict.fromkeys(SLOTS, ""), "flag": 'warmstart="enable"', **filled}
    if not filled.get("actuator"):
        slots["actuator"] = '<position joint="shoulder" kp="80"/>'
    return mujoco.MjSpec.from_string(ARM.format(**slots))


@pytest.mark.parametrize(
    ("filled", "says"),
    [
        (
            dict(extension='<plugin plugin="mujoco.elasticity.cable"/>', body=CABLE),
            "accepts but ignores: the plugin mujoco.elasticity.cable",
        ),
        (
            dict(extension=PID, actuator='<plugin joint="shoulder" plugin="mujoco.pid" instance="loop"/>'),
            "accepts but ignores: the plugin mujoco.pid",
        ),
        (
            dict(actuator='<dcmotor name="m" joint="shoulder" motorconst="0.5" resistance="1.2"/>'),
            r"actuator 'm' of scene 'arm' is a <dcmotor>.*gear K/R on a joint with K\^2/R more damping",
        ),
        (
            dict(actuator='<pid name="p" joint="shoulder" kp="80" kv="4"/>'),
            "actuator 'p' of scene 'arm' is a <pid>.*equivalent to <position> with its kp and kv",
        ),
        (dict(actuator='<pid joint="shoulder" kp="80" kv="4" ki="1"/>'), "actuator 0 of scene 'arm' is a <pid>"),
        (dict(actuator='<adhesion name="pad" body="upper" ctrlrange="0 1"/>'), "actuator 'pad'.*is a <adhesion>"),
        (dict(actuator='<general name="own" joint="shoulder" gaintype="user"/>'), "'own'.*with a callback"),
        (dict(flag='sleep="enable"'), "sleeping of bodies"),
        (dict(flag='energy="enable"'), "MJX does not support: the flag energy"),
        (dict(option='solver="PGS"'), r"MJX does not support: the solver PGS \(set <option solver=\"Newton\">\)"),
        (dict(option='cone="elliptic" impratio="10"'), "pyramidal friction cones.* up to 29 % smaller.*impratio"),
        (dict(option='density="1.2"', geom='fluidshape="ellipsoid"'), "fluid model of ellipsoids"),
        (dict(option='density="1.2"'), "no air or water"),
        (dict(joint='range="-9 9" limited="true" margin="0.2"'), "two limits that act at once \\(shoulder:"),
        (dict(more='<deformable/><equality><connect body1="upper" anchor="0 0 1"/></equality>'), None),
    ],
)
def test_unsupported_features_are_refused_at_loading(filled: dict, says: str | None):
    if says is None:
        assert compile_scene(arm(**filled), "arm").model.neq == 1
        return
    with pytest.raises(ValueError, match=says):
        compile_scene(arm(**filled), "arm")


@pytest.mark.parametrize("integrator", ["RK4", "implicit"])
def test_unsupported_integrators_are_refused_at_loading(integrator: str, tmp_path: Path):
    file = tmp_path / "arm.xml"
    file.write_text(ARM.format(**dict.fromkeys(SLOTS, "")).replace("implicitfast", integrator).replace("<flag />", ""))
    with pytest.raises(ValueError, match=r"arm.xml: .*integrates with Euler or implicitfast"):
        load_scene(file)
    assert load_scene(file, engine="mujoco").model.opt.integrator == getattr(
        mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}"
    )


def test_elliptic_cones_are_allowed_where_supported():
    for engine, mj_step in (("mujoco", False), ("mjx", True)):
        scene = compile_scene(arm(option='cone="elliptic"'), "arm", engine=engine, mj_step=mj_step)
        assert scene.model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC


def test_plugins_are_refused_for_every_engine():
    spec = arm(extension='<plugin plugin="mujoco.elasticity.cable"/>', body=CABLE)
    with pytest.raises(ValueError, match=r"the plugin mujoco.elasticity.cable"):
        compile_scene(spec, "arm", engine="mujoco")


def test_a_callback_of_the_process_is_refused():
    model = arm().compile()
    mujoco.set_mjcb_passive(lambda model, data: None)
    try:
        with pytest.raises(ValueError, match="callbacks of this process \\(mjcb_passive\\)"):
            refuse_ignored(model, "arm")
    finally:
        mujoco.set_mjcb_passive(None)


def test_every_number_of_a_model_that_mjx_does_not_take_is_known():
    """A new field of another MuJoCo version fails here: it must be refused, or have no effect."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    taken = {f.name for kind in (types.Model, types.ModelJAX) for f in types.Model.fields() + kind.fields()}
    here = {
        name
        for name in dir(model)
        if isinstance(array := getattr(model, name, None), np.ndarray) and array.dtype.kind == "f" and name not in taken
    }
    by_kind = {n for n in here if n.startswith(("bvh", "oct_", "flex", "skin", "mesh_", "efm0_", "mat_", "light_"))}
    harmless = {
        "D_diag", "sensor_interval", "sensor_noise", "cam_ipd", "actuator_history", "actuator_length0", "dof_length",
        "site_rgba", "tendon_rgba", "tendon_width",
        *(n for n in here if n.endswith("_user")),
    }  # fmt: skip
    assert here - by_kind - harmless <= {field for field, _ in IGNORED}


# ----- what is kept does the same as in C

WORLD = """<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.002" {option}/>
  <worldbody><geom name="floor" type="plane" size="5 5 .1" {floor}/><site name="hook" pos=".5 .1 1.2"/>{world}
    <body name="upper" pos="0 0 1"><joint name="a" axis="0 1 0" damping="0.3" {a}/>
      <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0" contype="0" conaffinity="0"/>
      <site name="s1" pos=".2 0 .05"/>
      <body name="fore" pos=".3 0 0" {fore}><joint name="b" axis="0 1 .2" {b}/>
        <geom type="capsule" size=".03" fromto="0 0 0 .25 .02 0" contype="0" conaffinity="0"/>
        <site name="s2" pos=".2 0 .02"/></body></body>
    <body name="ball" pos="1 0 1"><joint name="ball" type="ball" damping=".02" {ball}/>
      <geom type="capsule" size=".03 .1" pos="0 0 -.15" contype="0" conaffinity="0"/><site name="s3" pos=".02 0 -.2"/>
    </body>
    <body name="free" pos="2 0 .095"><freejoint name="free"/><geom name="thing" mass="1" {thing}/></body>
    <body name="mocap" mocap="true" pos="3 0 0"><geom size=".1" contype="0" conaffinity="0"/></body></worldbody>
  {more}</mujoco>"""
FREE_SPHERE = 'type="sphere" size=".1"'
KEPT = {
    "joints": dict(
        option='integrator="implicitfast"',
        a='frictionloss="0.5" stiffness="3" springref="0.4" armature=".1" ref=".1"',
        b='frictionloss=".2" solimpfriction="0.9999 0.9999 0.001 0.5 2" solreffriction="0.01 1.2" range="-.2 .2"',
        ball='range="0 .1" frictionloss=".1" stiffness="1" armature=".01"',
        fore='gravcomp="0.7"',
        more='<actuator><motor joint="b"/></actuator>',
    ),
    "limits": dict(a='range="-.5 .5" margin=".4"', ball='range="0 1" margin=".8"', thing=FREE_SPHERE),
    "servos": dict(
        option='integrator="implicitfast"',
        a='actuatorfrcrange="-.5 .5"',
        b='actuatorgravcomp="true"',
        fore='gravcomp="0.7"',
        more="""<actuator><position joint="a" kp="50" kv="2" ctrlrange="-.05 .05"/><velocity joint="b" kv="3"/>
          <position joint="b" kp="50" forcerange="-.4 .4" gear="7"/><damper joint="b" kv=".1" ctrlrange="0 1"/>
          <motor jointinparent="ball" gear="1 2 3"/><motor joint="free" gear="1 2 3 .1 .2 .3"/>
          <position site="s2" refsite="s1" kp="3" gear="1 0 1 0 0 0"/><motor site="s3" gear="0 0 0 1 2 3"/>
          </actuator>""",
    ),
    "tendons": dict(
        option='integrator="implicitfast"',
        world="""<geom name="wrap" type="sphere" size=".08" pos=".35 .05 1.08" contype="0" conaffinity="0"/>""",
        more="""<tendon><fixed name="t" stiffness="3" damping="1" springlength="-.1 .1" frictionloss=".1" range="-.2 .2"
            margin=".1" armature=".05" actuatorfrcrange="-.3 .3"><joint joint="a" coef="1"/>
            <joint joint="b" coef="-.5"/></fixed><fixed name="u"><joint joint="b" coef="1"/></fixed>
          <spatial name="w" stiffness="3" armature=".5"><site site="hook"/><site site="s2"/></spatial>
          <spatial name="v" stiffness="30" damping="5" springlength=".1"><site site="hook"/>
            <geom geom="wrap"/><site site="s1"/><pulley divisor="2"/><site site="hook"/><site site="s2"/></spatial>
          </tendon>
          <equality><tendon tendon1="t" tendon2="u" polycoef="0 .5"/></equality>
          <actuator><position tendon="t" kp="50" kv="1"/><motor tendon="v"/></actuator>""",
    ),
    "equalities": dict(
        more="""<equality><joint joint1="a" joint2="b" polycoef=".1 .5 .2 0 0"/><joint joint1="b" polycoef=".1"/>
          <connect site1="s2" site2="s3" solref=".05 1" solimp=".8 .9 .01"/>
          <weld body1="free" body2="mocap" torquescale="2" solref=".5 1"/>
          <connect body1="fore" body2="ball" anchor=".2 0 0" active="false"/></equality>"""
    ),
    "contacts": dict(
        option='impratio="2"',
        thing="""type="sphere" size=".08" condim="4" friction="1 .02 .001" margin=".03" gap=".01" solmix="3"
          priority="1" """,
        floor='solref=".01 1" solimp=".8 .9 .01" margin=".01"',
    ),
    "pairs": dict(
        thing='type="sphere" size=".1" condim="1"',
        more="""<contact><pair geom1="thing" geom2="floor" condim="6" friction=".8 .6 .02 .001 .001" solref="-900 -30"
          margin=".02"/></contact>""",
    ),
    "without dampers": dict(
        a='stiffness="3"', more='<option><flag spring="disable" damper="disable" limit="disable"/></option>'
    ),
    "elliptic": dict(option='cone="elliptic" impratio="5"', thing='type="sphere" size=".1" condim="3"'),
}


# One program holds two; the others are the same test, and compile as long.  test_step.py has contacts.
KEPT["joints and equalities"] = {
    **KEPT["joints"], "more": KEPT["joints"]["more"] + KEPT["equalities"]["more"]
}  # fmt: skip
QUICK = ("joints and equalities",)


@pytest.mark.parametrize("kept", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in KEPT])
def test_supported_features_give_the_same_step_as_c(kept: str):
    slots = {**dict.fromkeys(("option", "floor", "world", "a", "b", "fore", "ball", "more"), ""), "thing": FREE_SPHERE}
    model = mujoco.MjModel.from_xml_string(WORLD.format(**{**slots, **KEPT[kept]}))
    refuse_ignored(model, kept)
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    data.qpos[:6] = [0.3, 0.25, *(np.array([1.0, 0.2, -0.1, 0.3]) / np.linalg.norm([1.0, 0.2, -0.1, 0.3]))]
    data.qvel[:], data.ctrl[:] = rng.normal(0, 0.3, model.nv), rng.normal(0, 1, model.nu)
    taken = mjx.put_model(model)
    state = mjx.make_data(taken).replace(
        qpos=jnp.asarray(data.qpos), qvel=jnp.asarray(data.qvel), ctrl=jnp.asarray(data.ctrl)
    )
    model.opt.iterations, model.opt.tolerance = 100, 1e-12
    before = data.qvel.copy()
    mujoco.mj_step(model, data)
    stepped = jax.jit(functools.partial(simulate_step, parity=True))(taken, state)
    after = np.asarray(stepped.qvel, np.float64)
    accelerations = [(velocity - before) / model.opt.timestep for velocity in (data.qvel, after)]
    largest = 1.0 + np.abs(accelerations[0]).max()
    np.testing.assert_allclose(accelerations[1], accelerations[0], rtol=2e-3, atol=2e-4 * largest)
