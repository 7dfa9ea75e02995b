"""Randomised physics: each row is a draw applied to the scene, and nothing else is batched."""

from __future__ import annotations

import functools
import warnings
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from small_gap import small_scene

from droid_jax.commands import train
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_space
from droid_jax.identify.gaussian import Gaussian, load_gaussian, prior
from droid_jax.model.effects.registry import effect_space, library
from droid_jax.model.fields import (
    body_mass,
    body_position,
    body_yaw,
    joint_damping,
    joint_frictionloss,
    model_parameter,
)
from droid_jax.model.parameters import Space
from droid_jax.model.physics import Physics, make_physics, written_fields
from droid_jax.model.scene import Scene, compile_scene, load_scene
from droid_jax.policy.randomise import axes, fixed, of_method, physics_of, randomised, randomised_model

ENVS = 5


@pytest.fixture(scope="module")
def scene():
    return door_scene(timestep=0.004, limits=True)


@pytest.fixture(scope="module")
def gaussian(scene) -> Gaussian:
    return prior(door_space(scene))


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(3), ENVS)


@pytest.fixture(scope="module")
def bench() -> tuple[Scene, Space]:
    """A small scene whose parameters, also a mass, are all in the model."""
    scene, space = small_scene()
    return scene, Space(tuple(p for p in space.parameters if p.writes))


def rows(physics: Physics, batched: Physics, k: int) -> Physics:
    """Row k, as vmap gives it."""
    leaves, tree = jax.tree.flatten(physics)
    at = jax.tree.leaves(batched, is_leaf=lambda leaf: leaf is None)
    return jax.tree.unflatten(tree, [leaf if axis is None else leaf[k] for leaf, axis in zip(leaves, at, strict=True)])


@pytest.mark.parametrize(
    ("of", "joint", "damping"),
    [("bench", "door", "door_damping"), pytest.param("door", "hinge", "hinge_damping", marks=pytest.mark.slow)],
)
def test_every_row_is_its_draw(request: pytest.FixtureRequest, keys, of: str, joint: str, damping: str):
    """The door's physics compiles for half a minute in both ways that are compared, the small scene's for seconds."""
    if of == "bench":
        scene, space = request.getfixturevalue("bench")
        gaussian = prior(space + effect_space(library(scene, ["latch"])))
    else:
        scene, gaussian = (request.getfixturevalue(name) for name in ("scene", "gaussian"))
    physics, batched = randomised(scene, gaussian)(Physics(scene.mjx, {}), keys)
    if of == "bench":  # effects ride in theta
        assert physics.theta["latch_torque"].shape == (ENVS,) and batched.theta["latch_torque"] == 0
    seen = np.asarray(physics.model.dof_damping)[:, scene.dof(joint)]
    assert len(np.unique(seen)) == ENVS
    low, high = gaussian.space[damping].low, gaussian.space[damping].high
    assert np.all((seen >= low) & (seen <= high))
    values = gaussian.sample(np.random.default_rng(np.asarray(jax.random.key_data(keys)).ravel().tolist()), ENVS)
    made = jax.jit(lambda row: make_physics(scene, gaussian.space, row))
    for k in range(ENVS):
        expected, found = made(values[k]), rows(physics, batched, k)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=2e-4, atol=1e-5)


def test_only_what_is_written_is_batched(scene, gaussian):
    """On the door, by shapes, without compilation."""
    batched = axes(scene, gaussian.space)
    values = jax.ShapeDtypeStruct((ENVS, len(gaussian.space)), jnp.float32)
    physics = jax.eval_shape(lambda rows: physics_of(scene, gaussian.space, rows), values)
    varied = {f for f in ("dof_damping", "body_mass", "pair_friction", "geom_size", "jnt_range", "qpos0", "body_pos")
              if getattr(batched.model, f, None) is not None}  # fmt: skip
    assert varied == set(written_fields(gaussian.space)) & {
        "dof_damping", "body_mass", "pair_friction", "geom_size", "jnt_range", "qpos0", "body_pos"
    }  # fmt: skip
    assert physics.model.qpos0.shape == scene.mjx.qpos0.shape
    assert physics.model.dof_damping.shape == (ENVS, *scene.mjx.dof_damping.shape)


@pytest.mark.slow
def test_without_randomisation_all_are_alike(scene, gaussian, keys):
    values = gaussian.space.values({"hinge_damping": 3.3})
    physics, _ = fixed(scene, gaussian.space, values)(Physics(scene.mjx, {}), keys)
    hinge = np.asarray(physics.model.dof_damping)[:, scene.dof("hinge")]
    np.testing.assert_allclose(hinge, np.full(ENVS, 3.3), rtol=1e-6)


@pytest.mark.slow
def test_the_three_methods_are_prior_mean_and_posterior(scene, gaussian, keys):
    """With a fit far from its prior."""
    at = gaussian.space.index("hinge_damping")
    fit = replace(gaussian, mean=gaussian.mean + 3.0 * np.eye(len(gaussian.mean))[at], cov=gaussian.cov / 100)
    middle = fit.centre[at]
    assert middle > 2.0 * gaussian.space.mean[at]

    def hinge(method: str) -> np.ndarray:
        of = train._chosen(train.Train(method=method), fit)  # type: ignore[arg-type]
        physics, _ = of_method(method, scene, of)(Physics(scene.mjx, {}), keys)
        return np.asarray(physics.model.dof_damping)[:, scene.dof("hinge")]

    np.testing.assert_allclose(hinge("mean"), middle, rtol=1e-5)
    drawn = hinge("fitted")
    assert len(np.unique(drawn)) == ENVS and np.abs(np.log(drawn / middle)).max() < 0.5
    assert np.median(hinge("prior")) < 0.7 * middle


@pytest.mark.slow
def test_parameters_outside_the_model_are_warned_of(scene, gaussian, keys):
    space = gaussian.space + effect_space(library(scene, ["latch"]))
    with pytest.warns(UserWarning, match=r"cannot vary .*latch_torque, latch_width"):
        randomise = randomised_model(scene, prior(space))
    model, batched = randomise(scene.mjx, keys)
    assert model.dof_damping.shape == (ENVS, scene.model.nv) and batched.dof_damping == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        randomised_model(scene, gaussian)


def test_the_environments_numbers_are_kept_except_for_parameters(bench, keys):
    scene, space = bench
    gaussian = prior(space)
    own = scene.mjx.replace(qpos0=scene.mjx.qpos0 + 0.125)
    model, batched = randomised_model(scene, gaussian)(own, keys)
    np.testing.assert_array_equal(model.qpos0, own.qpos0)
    assert batched.qpos0 is None and model.body_mass.shape == (ENVS, scene.model.nbody)
    with pytest.raises(ValueError, match=r"has dof_damping of shape \(2,\).*must be of the environment's MJCF"):
        randomised_model(scene, gaussian)(own.replace(dof_damping=own.dof_damping[:2]), keys)


def test_other_entries_of_a_written_field_are_kept(keys):
    xml = """<mujoco><worldbody><body><joint name="a" damping="1"/><geom size=".1"/>
      <body pos="0 0 1"><joint name="b" damping="2"/><geom size=".1"/></body></body></worldbody></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "two", joints=("a", "b"))
    own = mjx.put_model(mujoco.MjModel.from_xml_string(xml))
    own = own.replace(dof_damping=own.dof_damping.at[1].set(7.0))  # as environments do after loading
    model, _ = randomised_model(scene, prior(Space((joint_damping(scene, "a", std=0.1, high=5.0),))))(own, keys)
    assert len(np.unique(model.dof_damping[:, 0])) == ENVS
    np.testing.assert_array_equal(model.dof_damping[:, 1], 7.0)


def test_a_friction_loss_without_a_row_is_refused(keys, tmp_path: Path):
    """Draws would have no effect."""
    path = tmp_path / "dry.xml"
    path.write_text(
        "<mujoco><worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody>"
        "<actuator><position joint='j' kp='9'/></actuator></mujoco>"
    )
    scene = load_scene(path, friction_joints=["j"])
    randomise = randomised_model(scene, prior(Space((joint_frictionloss(scene, "j", std=0.1, high=2.0),))))
    dry = mjx.put_model(mujoco.MjModel.from_xml_path(str(path)))
    for model in (dry, dry.replace(dof_frictionloss=jnp.full(1, 0.1))):  # set after compilation: still without a row
        with pytest.raises(ValueError, match="no friction loss at j"):
            randomise(model, keys)
    randomise(scene.mjx.replace(dof_frictionloss=jnp.zeros(1)), keys)


def test_an_environment_with_visual_geoms_is_supported(keys):
    """The scene has no visual geoms, so its geom ids differ."""
    xml = """<mujoco><worldbody><body><joint name="j"/>
      <geom name="shell" type="box" size=".1 .1 .1" group="2" contype="0" conaffinity="0" mass="0"/>
      <geom name="tip" size=".1" friction="0.7"/></body></worldbody>
      <actuator><position name="j" joint="j" kp="9"/></actuator></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "covered")
    grip = model_parameter(scene, "geom_friction", "tip", 0, unit="-", std=0.2, high=4.0)
    own = mjx.put_model(mujoco.MjModel.from_xml_string(xml))
    model, batched = randomised_model(scene, prior(Space((grip,))))(own, keys)
    assert batched.geom_friction == 0 and model.geom_friction.shape == (ENVS, 2, 3)
    np.testing.assert_array_equal(model.geom_friction[:, 0], np.tile(own.geom_friction[0], (ENVS, 1)))
    assert len(np.unique(model.geom_friction[:, 1, 0])) == ENVS
    more = xml.replace('<geom name="tip"', '<geom size=".2"/><geom name="tip"')
    other = mjx.put_model(mujoco.MjModel.from_xml_string(more))
    with pytest.raises(ValueError, match="must be of the environment's MJCF"):
        randomised_model(scene, prior(Space((grip,))))(other, keys)


@pytest.mark.slow
def test_mujoco_playground_is_supported():
    """Through its wrapper: each environment has another damping and mass, the rest is shared."""
    pytest.importorskip("mujoco_playground")
    from mujoco_playground import registry, wrapper

    env = registry.load("CartpoleBalance", config_overrides={"impl": "jax"})
    pole = load_scene(env.xml_path)
    space = Space((joint_damping(pole, "hinge_1", std=0.1, high=1.0), body_mass(pole, "pole_1", std=0.05, high=1.0)))
    keys = jax.random.split(jax.random.key(0), ENVS)
    randomise = functools.partial(randomised_model(pole, prior(space)), rng=keys)
    wrapped = wrapper.wrap_for_brax_training(env, episode_length=20, action_repeat=1, randomization_fn=randomise)
    state = jax.jit(wrapped.reset)(jnp.tile(jax.random.key_data(jax.random.key(1)), (ENVS, 1)))
    for _ in range(10):
        state = jax.jit(wrapped.step)(state, jnp.full((ENVS, 1), 0.3))
    assert np.isfinite(state.reward).all()
    assert len(np.unique(np.asarray(state.data.qpos)[:, 1])) == ENVS  # alike at the start, but not their physics


@pytest.mark.slow
def test_an_environment_of_brax_is_supported():
    """A stock environment with MJX, through brax's wrapper."""
    envs = pytest.importorskip("brax.envs")
    scene = load_scene(Path(envs.__file__).with_name("assets") / "inverted_pendulum.xml")
    space = Space((joint_damping(scene, "hinge", std=0.5, high=5.0), body_mass(scene, "pole", std=1.0, high=10.0)))
    keys = jax.random.split(jax.random.key(0), ENVS)
    randomise = functools.partial(randomised_model(scene, prior(space)), rng=keys)
    env = envs.get_environment("inverted_pendulum", backend="mjx")
    wrapped = envs.training.wrap(env, episode_length=20, action_repeat=1, randomization_fn=randomise)
    state = jax.jit(wrapped.reset)(jnp.tile(jax.random.key_data(jax.random.key(1)), (ENVS, 1)))
    assert len(np.unique(np.asarray(state.obs)[:, 1])) == 1
    step = jax.jit(wrapped.step)
    for _ in range(5):
        state = step(state, jnp.full((ENVS, 1), 0.3))
    assert np.isfinite(state.obs).all()
    assert len(np.unique(np.asarray(state.obs)[:, 1])) == ENVS  # the pole's angle: alike at the start alone


def test_a_gaussian_of_another_scene_is_refused(scene, gaussian):
    first = gaussian.space.parameters[0]
    write = replace(first.writes[0], index=(99,))
    other = Space((replace(first, writes=(write,)), *gaussian.space.parameters[1:]))
    with pytest.raises(ValueError, match=rf"{first.name}.*\[99\].*belongs to another scene"):
        randomised(scene, prior(other))


def test_a_gaussian_of_a_scene_of_the_same_shapes_is_refused_by_its_names(tmp_path: Path):
    """Two arms with two joints: a damping of one arm's elbow is not that of the other's wrist."""
    scenes = {}
    for name in ("elbow", "wrist"):
        joint = f'<joint name="{name}" axis="0 1 0" damping="1"/><geom size=".05" mass="1"/>'
        path = tmp_path / f"{name}.xml"
        path.write_text(
            f'<mujoco><worldbody><body name="link">{joint}</body></worldbody><actuator><position joint="{name}" '
            'kp="5"/></actuator></mujoco>'
        )
        scenes[name] = load_scene(path)
    fitted = prior(Space((joint_damping(scenes["elbow"], "elbow", std=0.1, high=5.0),)))
    fitted.save(tmp_path / "gaussian.json")
    kept = load_gaussian(tmp_path / "gaussian.json")
    randomised(scenes["elbow"], kept)
    with pytest.raises(ValueError, match=r"of 'elbow', but in 'wrist' that entry is of 'wrist'.*another scene"):
        randomised(scenes["wrist"], kept)


def test_unit_vectors_are_replaced_as_a_whole(keys):
    """Normalisation also changes components that are not written."""
    xml = """<mujoco><worldbody><body name="arm" pos="0 0 1"><joint name="a" axis="0 1 0"/><geom size=".1"/>
      </body></worldbody></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "one", joints=("a",))
    axis = model_parameter(scene, "jnt_axis", "a", 0, unit="-", std=0.3, low=-1.0, high=1.0)
    gaussian = prior(Space((body_yaw(scene, "arm", std=0.3, limit=1.0), axis)))
    model, _ = randomised_model(scene, gaussian)(mjx.put_model(mujoco.MjModel.from_xml_string(xml)), keys)
    drawn, _ = randomised(scene, gaussian)(Physics(scene.mjx, {}), keys)
    for field in ("body_quat", "jnt_axis"):
        np.testing.assert_allclose(np.linalg.norm(getattr(model, field)[:, -1], axis=-1), 1.0, rtol=1e-6)
        np.testing.assert_array_equal(getattr(model, field), getattr(drawn.model, field))


def test_constraints_of_an_environment_are_kept_and_anchors_derived(keys):
    """Of a coupling of joints nothing is derived, of a weld all but its torque scale."""
    xml = """<mujoco><worldbody><body name="a"><joint name="a"/><geom size=".1" mass="1"/>
      <body name="b" pos="0 0 1"><joint name="b"/><geom size=".1" mass="1"/></body></body></worldbody><equality>
      <joint joint1="a" joint2="b"/><weld body1="a" body2="b"/><connect body1="a" body2="b" anchor="0 0 .5"/>
      </equality></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "joined", joints=("a", "b"))
    own = mjx.put_model(mujoco.MjModel.from_xml_string(xml))
    own = own.replace(eq_data=own.eq_data.at[0, 1].set(0.5).at[1, 10].set(7.0))
    space = Space((body_position(scene, "b", 2, std=0.1, limit=0.5),))
    model, _ = randomised_model(scene, prior(space))(own, keys)
    moved = np.asarray(model.body_pos[:, -1, 2]) - 1.0
    assert np.all(np.abs(moved) > 0)
    np.testing.assert_array_equal(model.eq_data[:, 0, 1], 0.5)
    np.testing.assert_array_equal(model.eq_data[:, 1, 10], 7.0)
    np.testing.assert_allclose(model.eq_data[:, 1, 5], 1.0 + moved, rtol=1e-6)
    np.testing.assert_allclose(model.eq_data[:, 2, 5], -0.5 - moved, rtol=1e-5)
