"""The contract of all effects: no change at neutral, a change otherwise, and no more than they declare."""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effect_bench import Bench, bare, coefficients, door, door_bench, everywhere, make_bench, mechanism, typical
from effect_oracles import OF_THEIR_OWN

from droid_jax.model.effect_interface import LAWS, Effect, Rollout, State
from droid_jax.model.effects.registry import library, registered
from droid_jax.model.gravity import placed
from droid_jax.model.parameters import Space
from droid_jax.model.physics import DERIVED, Physics, make_physics, written_fields
from droid_jax.model.scene import Scene

EFFECTS = registered()
NEUTRAL = 1e-3  # N m: what a program compiled with the effects may differ by from one without
# N m, worst moment: above what two programs differ by, and less than any effect does.
SEEN = 2e-3
FAINT = {"soft_friction": 3e-4}  # of these less: no joint of the scenes rests under load (see test_soft_friction.py)
# N m: a torque that goes up and down again from step to step.  The bare scenes stay below 0.02.
CHATTER = 0.1


@pytest.fixture(scope="session", params=["mechanism", "door"])
def scene(request: pytest.FixtureRequest) -> Scene:
    return mechanism() if request.param == "mechanism" else door()


@pytest.fixture(params=EFFECTS)
def effect(request: pytest.FixtureRequest, scene: Scene) -> Effect:
    """Each effect on each scene that can have it."""
    made = library(scene, [request.param])
    if not made:
        where = scene.name.split(" (")[0]
        weightless = {(name, of) for name in OF_THEIR_OWN for of in ("mechanism", "door")}
        assert (request.param, where) in {("contact_compliance", "mechanism"), ("soft_friction", "door"), *weightless}
        pytest.skip("nothing is gripped here, no friction could be soft, or weight is compensated (test_two_masses.py)")
    return made[0]


def having(part: str) -> list[str]:
    """Names of the effects of the small scene with shape parameters, or with a friction loss."""
    return [effect.name for effect in library(mechanism()) if getattr(effect, part)]


ELSEWHERE = ("contact_compliance", *OF_THEIR_OWN)  # effects that the small scene does not have


@pytest.fixture(params=[n for n in EFFECTS if n not in ELSEWHERE])
def built_in(request: pytest.FixtureRequest, small: Bench) -> Effect:
    """Each effect of the small scene, as in its compiled replay."""
    return small.effect(request.param)


# ----- what is declared


def test_the_name_is_the_registered_one(effect: Effect, request: pytest.FixtureRequest):
    assert effect.name == request.node.callspec.params["effect"]


def test_parameters_are_coefficients_and_shapes(effect: Effect):
    """A coefficient belongs to one location and is zero at neutral."""
    named = [n for place in effect.locations.values() for n in place]
    assert named and all(effect.locations.values())
    assert sorted([*named, *effect.shape_parameters]) == sorted(p.name for p in effect.parameters)
    for parameter in coefficients(effect):
        assert parameter.mean == 0.0
        assert 0 < effect.minimum_size < parameter.high
        assert parameter.mean + parameter.std <= parameter.high
        assert not parameter.nuisance and parameter.unit


def test_shapes_start_at_one_of_the_values_to_try(effect: Effect):
    space = Space(effect.parameters)
    for name, values in effect.shape_parameters.items():
        assert len(values) > 1 and list(values) == sorted(set(values))
        assert space[name].mean in values
        assert space[name].low <= values[0] and values[-1] <= space[name].high
        assert not space[name].writes


def test_descriptions_are_there(effect: Effect):
    for words in (effect.description, effect.signature):
        assert len(words.split()) >= 3 and words == words.strip() and not words.endswith(".")


def test_effects_it_is_confused_with_exist(effect: Effect):
    assert effect.confused_with
    assert set(effect.confused_with) <= set(EFFECTS) - {effect.name}
    assert len(set(effect.confused_with)) == len(effect.confused_with)


def test_special_cases_are_among_effects_it_is_confused_with(effect: Effect):
    assert set(effect.special_cases) <= set(effect.confused_with)


def test_it_has_a_function_or_writes_the_model(effect: Effect):
    assert any(getattr(effect, law) is not None for law in LAWS) or all(p.writes for p in effect.parameters)


# ----- neutral, by each function alone


def moments(scene: Scene) -> list[State]:
    """States in motion, creeping and at rest."""
    rng = np.random.default_rng(4)
    model = scene.model

    def draw(size: int, scale: float) -> jax.Array:
        return jnp.asarray(scale * rng.normal(size=size), jnp.float32)

    return [
        State(
            jnp.float32(time),
            draw(model.nq, 1.0),
            draw(model.nv, speed),
            draw(model.nv, 5.0),
            scene.mjx,
            gear=jnp.stack([draw(model.nv, 5.0), draw(model.nv, 5.0)]),
        )
        for time, speed in ((0.0, 1.0), (0.3, 0.01), (0.6, 0.0))
    ]


def trace(scene: Scene) -> Rollout:
    rng = np.random.default_rng(5)
    time = jnp.linspace(0.0, 1.0, 11)
    torque, position, velocity = (jnp.asarray(rng.normal(size=(11, len(scene.joints))), jnp.float32) for _ in range(3))
    return Rollout(time, torque, position, velocity, position[:, 0], jnp.zeros((11, 0), bool), jnp.array(True))


# On the door some functions and physics compile for ten seconds each.
OF_BOTH = pytest.mark.parametrize("scene", ["mechanism", pytest.param("door", marks=pytest.mark.slow)], indirect=True)


@OF_BOTH
def test_each_function_changes_nothing_at_neutral(effect: Effect, scene: Scene):
    """Exactly, with the means in theta and with an empty theta."""
    thetas = ({p.name: jnp.float32(p.mean) for p in effect.parameters if not p.writes}, {})
    # In one program: some compile for seconds.
    forces = jax.jit(lambda state: [effect.force(theta, state) for theta in thetas]) if effect.force else None
    for state in moments(scene):
        for force in forces(state) if forces else ():
            np.testing.assert_array_equal(force, np.zeros(scene.model.nv))
        for theta in thetas:
            if effect.frictionloss:
                base = jnp.asarray(scene.model.dof_frictionloss, jnp.float32)
                np.testing.assert_array_equal(effect.frictionloss(theta, state, base), base)
            if effect.servo:
                ctrl = jnp.cos(jnp.arange(scene.model.nu, dtype=jnp.float32))
                np.testing.assert_array_equal(effect.servo(theta, state, ctrl), ctrl)
            if effect.twist:
                np.testing.assert_array_equal(effect.twist(theta, state, 1.0 + 0.0 * state.qvel), 0.0 * state.qvel)
            if effect.profile:
                given = jnp.sin(jnp.arange(3.0 * scene.model.nu)).reshape(3, -1)
                np.testing.assert_array_equal(effect.profile(theta, given, 0.002), given)
            if effect.command:
                np.testing.assert_array_equal(effect.command(theta, state.time, jnp.sin), jnp.sin(state.time))
    if effect.observe:
        rollout = trace(scene)
        for theta in thetas:
            jax.tree.map(np.testing.assert_array_equal, effect.observe(theta, rollout), rollout)


NO_KERNEL = {"sort", "lu", "eigh", "qr", "svd", "cholesky", "triangular_solve"}  # that XLA keeps out of a loop's kernel


def primitives(jaxpr: Any) -> set[str]:
    """Names of all operations of a jaxpr, those inside its loops and calls too."""
    inner = (each for eqn in jaxpr.eqns for each in jax.core.jaxprs_in_params(eqn.params))
    return {eqn.primitive.name for eqn in jaxpr.eqns}.union(*map(primitives, inner))


@functools.lru_cache(maxsize=2)
def within_a_step(scene: Scene) -> State:
    """A state with its pose."""
    state = moments(scene)[0]
    return dataclasses.replace(state, pose=placed(scene.mjx, state.qpos))


def test_its_laws_in_a_time_step_need_no_library(effect: Effect, scene: Scene):
    """A single sort or library call would slow the replays of every model with the effect by half."""
    theta = {p.name: jnp.float32(p.mean) for p in effect.parameters if not p.writes}
    state = within_a_step(scene)
    ctrl, loss = jnp.zeros(scene.model.nu), jnp.asarray(scene.model.dof_frictionloss, jnp.float32)
    laws: dict[str, tuple[Any, ...]] = {"force": (), "frictionloss": (loss,), "servo": (ctrl,), "limits": ()}
    within = [(getattr(effect, name), more) for name, more in laws.items() if getattr(effect, name)]
    within += [(effect.gear.step, (ctrl,))] if effect.gear else []
    for law, more in within:
        made = jax.make_jaxpr(lambda s, law=law, more=more: law(theta, s, *more))(state)
        assert not primitives(made.jaxpr) & NO_KERNEL


@pytest.mark.parametrize("effect", having("shape_parameters"), indirect=True)
def test_a_missing_shape_parameter_has_its_mean(effect: Effect, scene: Scene):
    loud = {p.name: jnp.float32(typical(p)) for p in coefficients(effect)}
    stated = loud | {name: jnp.float32(Space(effect.parameters)[name].mean) for name in effect.shape_parameters}
    base = jnp.asarray(scene.model.dof_frictionloss, jnp.float32)
    for state in moments(scene):
        if effect.force:
            np.testing.assert_array_equal(effect.force(loud, state), effect.force(stated, state))
        if effect.frictionloss:
            given, absent = (effect.frictionloss(theta, state, base) for theta in (stated, loud))
            np.testing.assert_array_equal(given, absent)


@pytest.mark.parametrize("effect", having("frictionloss"), indirect=True)
def test_friction_loss_is_never_negative(effect: Effect, scene: Scene):
    """At both bounds of each parameter, in several states."""
    assert effect.frictionloss
    base = jnp.asarray(scene.model.dof_frictionloss, jnp.float32)
    for bound in ("low", "high"):
        theta = {p.name: jnp.float32(getattr(p, bound)) for p in effect.parameters}
        losses = np.array([effect.frictionloss(theta, state, base) for state in moments(scene)])
        assert (losses >= 0).all()
        assert bound == "low" or not np.array_equal(losses[1], base)


# ----- the model


def numbers(model: Any, path: str = "") -> dict[str, np.ndarray]:
    """All arrays of an mjx.Model and its parts."""
    out = {}
    for field in dataclasses.fields(model):
        value = getattr(model, field.name)
        if dataclasses.is_dataclass(value):
            out.update(numbers(value, f"{path}{field.name}."))
        elif isinstance(value, (np.ndarray, jax.Array, float)):
            out[f"{path}{field.name}"] = np.asarray(value)
    return out


def differing(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> set[str]:
    assert a.keys() == b.keys() and len(a) > 60
    return {n.split(".")[0] for n in a if not np.array_equal(a[n], b[n], equal_nan=a[n].dtype.kind == "f")}


@functools.cache
def physics_of(scene: Scene, name: str) -> Callable[[np.ndarray], Physics]:
    """Values [D] of an effect's parameters -> physics; compiled once for all tests."""
    space = Space(library(scene, [name])[0].parameters)
    make = functools.partial(make_physics, scene, space)
    make = jax.jit(make) if written_fields(space) else make  # op by op, what is derived would take seconds
    return lambda values: make(jnp.asarray(values, jnp.float32))


@pytest.fixture
def apply(scene: Scene, effect: Effect) -> Callable[[np.ndarray], Physics]:
    return physics_of(scene, effect.name)


@OF_BOTH
def test_only_declared_fields_of_the_model_change(effect: Effect, scene: Scene, apply):
    physics = apply(np.array([typical(p) for p in effect.parameters]))
    named = {w.field for p in effect.parameters for w in p.writes}
    changed = differing(numbers(physics.model), numbers(scene.mjx))
    assert named <= changed <= set(written_fields(Space(effect.parameters))) <= named | set(DERIVED)
    outside = {p.name: typical(p) for p in effect.parameters if not p.writes}
    assert {n: float(v) for n, v in physics.theta.items()} == pytest.approx(outside)


@OF_BOTH
def test_applying_twice_is_applying_once(effect: Effect, scene: Scene, apply):
    values = np.array([typical(p) for p in effect.parameters])
    before = numbers(scene.mjx)
    once = apply(values)
    apply(np.array([p.high for p in effect.parameters]))
    assert not differing(numbers(once.model), numbers(apply(values).model))
    assert not differing(numbers(scene.mjx), before)


def test_contact_compliance_writes_all_pairs_of_a_grip():
    scene = door()
    (effect,) = library(scene, ["contact_compliance"])
    model = make_physics(scene, Space(effect.parameters), jnp.array([0.5])).model
    assert scene.model.npair == 4 and sum(map(len, scene.finger_pairs)) == 4
    np.testing.assert_allclose(model.pair_solref, scene.model.pair_solref * [1.5, 1.0], rtol=1e-6)


# ----- the replay


def check_neutral(bench: Bench, base: Rollout) -> None:
    neutral = jax.tree.map(lambda array: array[0], bench.run(bench.space.mean[None]))
    np.testing.assert_allclose(neutral.torque, base.torque, atol=NEUTRAL)
    np.testing.assert_allclose(neutral.position, base.position, atol=1e-5)
    np.testing.assert_allclose(neutral.object_angle, base.object_angle, atol=1e-5)
    assert neutral.finite and np.abs(base.torque).max() > 100 * NEUTRAL


def check_coefficients(bench: Bench, effect: Effect) -> None:
    """Each coefficient changes the replay at a typical value and at its bounds, which stays finite."""
    rows = [{}]
    for p in coefficients(effect):
        rows += [{p.name: value} for value in (typical(p), p.high, p.low) if value != p.mean]
    got = bench.run(np.array([bench.space.values(row) for row in rows]))
    assert got.finite.all() and np.isfinite(got.torque).all()
    change = np.abs(got.torque[1:] - got.torque[0]).max(axis=(1, 2))
    assert not [row for row, seen in zip(rows[1:], change > FAINT.get(effect.name, SEEN), strict=True) if not seen]


def check_shapes(bench: Bench, effect: Effect) -> None:
    """Shape parameters have no effect alone, and each of their values is another effect with a coefficient."""
    for name, values in effect.shape_parameters.items():
        shape = bench.space[name]
        tried = [{name: v} for v in sorted({*values, shape.low, shape.high})]
        # Row by row: a batch's last rows may be rounded another way than its first.
        np.testing.assert_array_equal(bench.torque(*tried), bench.torque(*({} for _ in tried)))
        loud = bench.torque(*({**everywhere(effect), **row} for row in tried))
        assert np.isfinite(loud).all()
        apart = np.abs(loud[:, None] - loud[None]).max(axis=(2, 3))
        assert (apart[~np.eye(len(tried), dtype=bool)] > SEEN).all(), apart


def check_no_chatter(bench: Bench, effect: Effect) -> None:
    """No effect makes the torque alternate from one step to the next, or diverge."""
    for torque in bench.torque(everywhere(effect), everywhere(effect, lambda p: p.high)):
        change = np.diff(torque, axis=0)
        turns = change[1:] * change[:-1] < 0
        assert np.where(turns, np.minimum(np.abs(change[1:]), np.abs(change[:-1])), 0.0).max() < CHATTER


def test_neutral_is_the_scene_without_effects(small: Bench, small_bare: Rollout):
    check_neutral(small, small_bare)


def test_every_coefficient_changes_the_replay(small: Bench, built_in: Effect):
    check_coefficients(small, built_in)


def test_shapes_act_with_a_coefficient(small: Bench, built_in: Effect):
    check_shapes(small, built_in)


def test_nothing_chatters(small: Bench, built_in: Effect):
    check_no_chatter(small, built_in)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in EFFECTS if n not in ELSEWHERE])
def test_each_effect_at_neutral_is_the_scene_without_effects(small: Bench, small_bare: Rollout, name: str):
    check_neutral(make_bench(small.scene, small.drive, [small.effect(name)]), small_bare)


@pytest.mark.slow
def test_neutral_is_the_door_without_effects(real: Bench):
    base = bare(real)
    assert np.rad2deg(base.object_angle.max()) > 45
    check_neutral(real, base)


# Its arm has no friction of its own that could be soft, and its slow motions reach no limit of a servo's goal.
NOT_ON_THE_DOOR = ("soft_friction", "profile_acceleration", "profile_speed", *OF_THEIR_OWN)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in EFFECTS if n not in NOT_ON_THE_DOOR])
def test_on_the_door(real: Bench, name: str):
    # A only opens the door, which says nothing of a closer; C closes it again.
    bench = door_bench(names=[name], motion="C") if name == "door_closer" else real
    effect = bench.effect(name)
    check_coefficients(bench, effect)
    check_shapes(bench, effect)
    check_no_chatter(bench, effect)


@pytest.mark.slow
def test_soft_contacts_are_contacts_of_another_time_constant(real: Bench):
    """The only effect that the small scene cannot have, against a compiled model."""
    model = copy.copy(real.scene.model)
    model.pair_solref[:, 0] *= 1.5
    soft = bare(dataclasses.replace(real, scene=dataclasses.replace(real.scene, model=model)))
    neutral, got = real.torque({}, {"contact_softness": 0.5})
    np.testing.assert_allclose(got, soft.torque, atol=NEUTRAL)
    assert np.abs(got - neutral).max() > 20 * NEUTRAL


@pytest.mark.slow
def test_soft_gears_do_not_chatter_with_a_stiff_servo():
    """A servo of 4500 N m/rad with half a thousandth of a rad/(N m) has a loop gain above two."""
    bench = door_bench("paper", ["joint_backlash", "joint_compliance"])
    for effect in bench.effects:
        check_no_chatter(bench, effect)
