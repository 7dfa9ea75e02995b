"""The registry: effects that a scene can have, names, and user effects."""

from __future__ import annotations

import copy
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from effect_bench import ARM, JOINTS, MECHANISM, MOTOR, Bench, make_bench, mechanism
from effect_oracles import OF_THEIR_OWN

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects import registry
from droid_jax.model.effects.registry import effect_space, library, ready, register, registered
from droid_jax.model.fields import body_mass
from droid_jax.model.mjcf import fitted_mjcf, native
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model, make_physics
from droid_jax.model.scene import HARD, TINY_FRICTIONLOSS, Scene, compile_scene, load_scene
from droid_jax.simulate.replay import Drive, servo_replay

OF_HINGES = {"angle_friction", "door_closer", "drag", "hardening_spring", "hinge_directional", "hinge_preload",
             "hinge_stribeck", "latch", "opening_check", "over_centre_spring", "tilted_frame"}  # fmt: skip
OF_ARMS = {"cable_pull", "encoder_offset", "free_payload", "gear_friction", "gravity_direction", "joint_backlash",
           "joint_compliance", "joint_coulomb", "joint_directional", "joint_stribeck", "load_friction", "payload",
           "profile_acceleration", "profile_speed", "servo_gain", "soft_friction", "torque_crosstalk",
           "torque_ripple", "torque_speed_line", "velocity_feedforward"}  # fmt: skip
OF_SERVOS = {"joint_backlash", "joint_compliance", "torque_speed_line"}
OF_GRIPS = {"contact_compliance", *OF_THEIR_OWN}  # neither is in the small scene


@pytest.fixture
def own_list(monkeypatch: pytest.MonkeyPatch) -> None:
    """Registrations of a test are removed after it."""
    registered()
    registry.registered()  # those of the library, which are registered once in a process
    monkeypatch.setattr(registry, "_MAKERS", copy.copy(registry._MAKERS))


def names(scene: Scene) -> set[str]:
    return {e.name for e in library(scene)}


def edited(old: str, new: str, **options) -> Scene:
    assert old in MECHANISM
    options = {"joints": JOINTS, "object_joint": "door", **options}
    return compile_scene(mujoco.MjSpec.from_string(MECHANISM.replace(old, new)), "edited", **options)


# ----- effects of your own


def grease_at(*joints: str, name: str = "grease", high: float = 9.0) -> Effect:
    """A force at each of these joints, as a user may write it: theta must contain all coefficients."""

    def force(theta, state):
        return sum((jnp.zeros_like(state.qvel).at[k].set(theta[f"grease[{j}]"]) for k, j in enumerate(joints)))

    coefficients = tuple(Parameter(f"grease[{j}]", "N m", 0.0, 1.0, -5.0, 5.0) for j in joints)
    shape = Parameter("thickness", "mm", 1.0, 1.0, 0.1, 5.0)
    places = {j: (p.name,) for j, p in zip(joints, coefficients, strict=True)}

    def native(values, model):
        return {("qpos_spring", k): 0.1 * values[f"grease[{j}]"] for k, j in enumerate(joints)}

    return Effect(
        name,
        (*coefficients, shape),
        force=force,
        native=native,
        locations=places,
        shape_parameters={"thickness": (1.0, high)},
    )


@pytest.mark.slow
def test_other_locations_of_an_extended_model_are_neutral():
    """An extended model has the parameters of one location, and the effect reads those of all."""
    scene = mechanism()
    grease = grease_at(*JOINTS, high=2.0)
    drive = Drive(np.zeros((40, 3)), scene.initial_qpos({}), 0.005, MOTOR)
    replay = servo_replay(scene, drive, [grease])
    whole = effect_space([grease])
    named = whole.select([f"grease[{JOINTS[1]}]"])
    torques = [
        replay(make_physics(scene, space, space.values({named.names[0]: 0.4}))).torque for space in (whole, named)
    ]
    np.testing.assert_array_equal(*torques)
    assert np.ptp(torques[0]) > 0.1
    added = [native(grease, space, space.values({named.names[0]: 0.4}), scene.model) for space in (whole, named)]
    assert added[0] == added[1] == {("qpos_spring", k): 0.1 * push for k, push in enumerate((0.0, 0.4, 0.0))}


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (grease_at("door", name="thick grease", high=2.0), "'grease' makes is called 'thick grease'"),
        (grease_at("door"), r"its shape parameter 'thickness' lie outside its bounds \[0.1, 5\]: 9"),
    ],
)
@pytest.mark.usefixtures("own_list")
def test_invalid_effects_are_refused(effect: Effect, said: str):
    @register
    def grease(scene):
        return effect

    with pytest.raises(ValueError, match=said):
        library(mechanism(), ["grease"])


# ----- what a scene can have


def test_the_small_scene_has_all_but_the_grip():
    assert names(mechanism()) == set(registered()) - OF_GRIPS


def test_a_scene_without_an_object_has_no_effects_of_hinges():
    assert names(edited("", "", object_joint=None)) == set(registered()) - OF_GRIPS - OF_HINGES


def test_a_drawer_has_no_effects_of_hinges():
    assert names(edited('"door" axis', '"door" type="slide" axis')) == set(registered()) - OF_GRIPS - OF_HINGES


def test_a_door_alone_has_no_effects_of_arms():
    assert names(edited("", "", joints=["door"])) == set(registered()) - OF_GRIPS - OF_ARMS


def test_motors_have_no_elasticity():
    """Their torque is the command, whatever their position is."""
    motors = edited('"s" joint="shoulder" kp="80"', '"s" joint="shoulder" kp="0"')
    compliant = library(motors, sorted(OF_SERVOS))
    assert [list(e.locations) for e in compliant] == [["elbow"]] * len(OF_SERVOS)
    for effect in compliant:
        of_joints = [p.name for p in effect.parameters if p.name not in effect.shape_parameters]
        assert of_joints == [f"{effect.name}[elbow]"]


def test_a_joint_without_armature_has_no_motor_of_its_own():
    weights = mechanism().spec.copy()
    for body in weights.bodies:
        body.gravcomp = 0.0
    weights.joint("elbow").armature = 0.0
    effects = library(compile_scene(weights, "light", joints=ARM), list(OF_THEIR_OWN))
    assert [list(effect.locations) for effect in effects] == [["shoulder"]] * 2


def test_a_weight_that_is_compensated_does_not_pass_the_gear():
    assert not library(mechanism(), list(OF_THEIR_OWN))


def test_joints_without_servos_have_no_servo_effects():
    passive = edited('<position name="s" joint="shoulder" kp="80"/>', "")
    assert list(library(passive, ["servo_gain"])[0].locations) == ["elbow"]
    assert list(library(passive, ["joint_coulomb"])[0].locations) == list(ARM)


def test_the_payload_hangs_on_the_end_of_the_chain():
    """The order of the channels, which is that of the actuators, differs."""
    scene = edited("", "", joints=None)
    assert scene.joints == ("elbow", "door", "shoulder")
    (payload,) = library(scene, ["payload"])
    assert list(payload.locations) == ["elbow"]
    assert {w.index for p in payload.parameters for w in p.writes} == {(scene.id("body", "hand"),)}


# ----- names


def test_the_library_is_in_the_order_of_names_or_as_requested():
    scene = mechanism()
    assert [e.name for e in library(scene)] == sorted(names(scene))
    assert registered() == tuple(sorted(registered()))
    assert [e.name for e in library(scene, ["latch", "drag"])] == ["latch", "drag"]
    assert library(scene, []) == ()
    assert library(scene, ["contact_compliance"]) == ()


def test_unknown_names_are_listed_with_the_valid_ones():
    with pytest.raises(ValueError, match=r"unknown effects lath, dragg; valid: angle_friction, .*, velocity_f\w+$"):
        library(mechanism(), ["lath", "latch", "dragg"])


def test_no_two_effects_share_a_parameter():
    assert len(effect_space(library(mechanism()))) == sum(len(e.parameters) for e in library(mechanism()))


# ----- sizes


def test_scaling_changes_torques_only():
    """Masses, gains, delays and neutral values are unchanged."""
    usual, large = (effect_space(library(mechanism(), scale=k)) for k in (1.0, 30.0))
    assert usual.names == large.names
    torques = np.array([p.unit.startswith("N m") for p in usual.parameters])
    assert torques.any() and not torques.all()
    factor = np.where(torques, 30.0, 1.0)
    np.testing.assert_allclose(large.std, factor * usual.std)
    np.testing.assert_allclose(large.low, factor * usual.low)
    np.testing.assert_allclose(large.high, factor * usual.high)
    np.testing.assert_array_equal(large.mean, usual.mean)
    for before, after in zip(library(mechanism()), library(mechanism(), scale=30.0), strict=True):
        grows = any(p.unit.startswith("N m") for p in before.parameters)
        assert after.minimum_size == pytest.approx((30.0 if grows else 1.0) * before.minimum_size)


def test_units_at_slides_are_those_of_forces():
    scene = edited('"elbow" axis', '"elbow" type="slide" axis', joints=["elbow"], object_joint=None)
    names = ["cable_pull", "joint_coulomb", "torque_drift", "torque_gain", "torque_ripple"]
    space = effect_space(library(scene, [*names, "joint_stribeck", "joint_compliance", "joint_backlash"]))
    assert {p.name.split("[")[0]: p.unit for p in space.parameters} == {
        "joint_backlash": "m",
        "joint_compliance": "m/N",
        "joint_stribeck": "N",
        "joint_stribeck_exponent": "-",
        "joint_stribeck_speed": "m/s",
        "ripple_cosine": "N",
        "ripple_periods": "1/(2 pi m)",
        "ripple_sine": "N",
        "cable_stiffness": "N/m",
        "cable_pull": "N",
        "joint_coulomb": "N",
        "torque_drift": "N/s",
        "torque_gain": "-",
    }


@pytest.mark.parametrize("scale", [0.0, -1.0, np.inf, np.nan])
def test_a_scale_is_a_positive_number(scale: float):
    with pytest.raises(ValueError, match=r"the scale of the effects must be above 0, got"):
        library(mechanism(), scale=scale)


# ----- effects of your own


def test_a_taken_name_is_refused(own_list: None):
    def drag(scene: Scene) -> Effect | None:
        return None

    with pytest.raises(ValueError, match=r"'drag' is registered already, by droid_jax\.model\.effects\.hinge_dampers"):
        register(drag)
    assert [e.name for e in library(mechanism(), ["drag"])] == ["drag"]


def test_the_same_function_may_be_registered_again(own_list: None):
    """Such as when its file is run twice in one session."""
    before = registered()
    register(registry._MAKERS["drag"])
    assert registered() == before


@pytest.mark.slow
def test_a_user_effect_is_part_of_the_library(own_list: None, small: Bench):
    """A wind that opens the door is the opposite of a preload."""

    @register
    def wind(scene: Scene) -> Effect | None:
        joint = a.hinge(scene)
        if joint is None:
            return None
        return Effect(
            "wind",
            (a.coefficient("wind", "N m", 0.5, 5.0),),
            force=lambda theta, state: jnp.zeros_like(state.qvel).at[scene.dof(joint)].set(theta["wind"]),
            locations={joint: ("wind",)},
            minimum_size=0.1,
        )

    assert "wind" in registered()
    assert [e.name for e in library(small.scene)] == sorted([*(e.name for e in small.effects), "wind"])
    assert "wind" not in names(edited("", "", object_joint=None))
    assert "wind" in effect_space(library(small.scene)).names
    blown = make_bench(small.scene, small.drive, library(small.scene, ["wind"]))
    np.testing.assert_allclose(blown.torque({"wind": 0.8}), small.torque({"hinge_preload": -0.8}), atol=1e-3)
    assert np.abs(blown.torque({"wind": 0.8}) - blown.torque({})).max() > 0.5


def test_a_user_effect_is_removed_after_its_test():
    assert "wind" not in registered()


def test_a_payload_adds_to_a_fitted_mass():
    """In MJX, in C, and in the MJCF."""
    scene = edited(MECHANISM, MECHANISM.replace(' gravcomp="1"', ""))
    (payload,) = library(scene, ["payload"])
    space = Space((body_mass(scene, "hand", std=0.1, high=2.0),)) + effect_space([payload])
    values, hand = space.values({"hand_mass": 0.9, "payload_mass": 0.25}), scene.id("body", "hand")
    made = make_physics(scene, space, jnp.asarray(values, jnp.float32)).model, make_c_model(scene, space, values)
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, values, [payload]))
    np.testing.assert_allclose([model.body_mass[hand] for model in (*made, written)], 1.15, rtol=1e-6)


# ----- rows of friction


def test_a_ready_scene_has_a_friction_row_for_every_joint():
    bare = edited("", "")
    losses = bare.model.dof_frictionloss.copy()
    made = ready(bare)
    np.testing.assert_array_equal(bare.model.dof_frictionloss, losses)
    assert losses.min() == 0.0
    np.testing.assert_array_equal(made.model.dof_frictionloss, np.maximum(losses, TINY_FRICTIONLOSS))
    assert made.joints == bare.joints and made.object_joint == "door"


def test_friction_of_effects_is_hard_if_the_scene_holds_friction(tmp_path: Path):
    """At joints and at the object, whose MJCF has no friction."""
    path = tmp_path / "mechanism.xml"
    path.write_text(MECHANISM.replace(' frictionloss="0.2"', ""))
    given, held = (ready(load_scene(path, joints=ARM, object_joint="door", hold=h)) for h in (False, True))
    dofs = [held.dof(j) for j in JOINTS]
    np.testing.assert_array_equal(held.model.dof_solimp[dofs, :2], HARD)
    assert set(held.held) == {*JOINTS} and given.held == ()
    assert given.model.dof_solimp[given.dof("door"), 0] == 0.9
    again = ready(held)
    assert again.held == held.held and again.spec is held.spec
    assert held.spec.joint("door").solimp_friction[0] == HARD  # of which the fitted MJCF is written
