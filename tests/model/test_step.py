"""The constraint solver and the step against the C engine, and the order of the step's error."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from droid_jax.model.mjx_internals import CONSTRAINT_LAW, constraint_rows, exact_segments, midpoint_law, private
from droid_jax.model.normal_equations import UNROLLED, normal_equations
from droid_jax.model.step import simulate_step, solve
from droid_jax.model.unsupported_features import check_options

# A three-link arm over a floor: contacts, limits, dry friction, a coupled and a pinned joint.
ARM = """
<mujoco><compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" cone="pyramidal" iterations="100" ls_iterations="50"
          tolerance="1e-12"/>
  <default><geom type="capsule" contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="post" size=".03" fromto=".25 -.3 .22 .25 .3 .22"/>
    <geom name="rail" size=".05" fromto=".42 -.3 .05 .42 .3 .05"/>
    <body name="a" pos="0 0 .5">
      <joint name="a" axis="0 1 0" range="-.4 1.5" limited="true" frictionloss=".8" damping=".5"/>
      <geom name="ga" size=".03" fromto="0 0 0 .3 0 0"/>
      <body name="b" pos=".3 0 0">
        <joint name="b" axis="0 1 0" range="-1 1" limited="true" frictionloss=".3" damping=".2"/>
        <geom name="gb" size=".025" fromto="0 0 0 .25 0 0"/>
        <body name="c" pos=".25 0 0"><joint name="c" axis="0 0 1" damping=".1" armature=".01"/>
          <geom name="gc" size=".02" fromto="0 0 0 .2 0 0"/>{tip}</body></body></body>
    <body name="d" pos="0 .4 .5"><joint name="d" axis="0 1 0" frictionloss="1e-6" damping=".1"/>
      <geom name="gd" size=".02" fromto="0 0 0 .2 0 0"/></body>
  </worldbody>
  <contact>
    <pair geom1="post" geom2="ga" condim="3" friction=".7 .7 .01 .001 .001"/>
    <pair geom1="post" geom2="gb" condim="4" friction=".5 .5 .5 .001 .001"/>
    <pair geom1="rail" geom2="gc" condim="1"/>
  </contact>
  <equality>{equality}</equality>
</mujoco>
"""
EQUALITIES = {
    "none": "",
    "joint": '<joint joint1="d" joint2="a" polycoef="0.1 0.7 0.2 0 0"/>',
    "connect": '<connect body1="d" body2="a" anchor=".2 0 0"/>',
}


def arm(equality: str = "none", tip: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM.format(equality=EQUALITIES[equality], tip=tip))


def smooth(model: Any, data: Any) -> Any:
    """The quantities before the constraint solver."""
    with exact_segments():
        data = mjx.fwd_position(model, data)
    return mjx.fwd_acceleration(model, mjx.fwd_actuation(model, mjx.fwd_velocity(model, data)))


def solver(model: mujoco.MjModel, firm: bool = False) -> Callable[..., tuple[Any, dict[str, jax.Array]]]:
    """Batched: (qpos, qvel, warm start) -> the solved data and the problem."""
    on_device = mjx.put_model(model)
    template = mjx.make_data(on_device)

    def one(qpos, qvel, warm):
        data = smooth(on_device, template.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warm))
        inertia, rows = mjx.full_m(on_device, data), constraint_rows(data)
        solved = solve(inertia, data, firm)
        problem = dict(M=inertia, f=data.qfrc_smooth, J=rows.jacobian, D=rows.weight, aref=rows.reference,
                       dry=rows.friction)  # fmt: skip
        return (solved.qacc, solved.qfrc_constraint), problem

    return jax.jit(jax.vmap(one))


def minimum(problem: dict[str, np.ndarray], equalities: int, dry: int, start: np.ndarray) -> np.ndarray:
    """The same convex problem in float64, by damped Newton on the cost."""
    M, f, J, D, aref, loss = (np.asarray(problem[k], float) for k in ("M", "f", "J", "D", "aref", "dry"))
    kind = np.full(len(D), 2)
    kind[:equalities], kind[equalities : equalities + dry] = 0, 1

    def parts(a: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        r = J @ a - aref
        inside = (kind == 0) | ((kind == 1) & (np.abs(D * r) < loss)) | ((kind == 2) & (r < 0))
        outside = (kind == 1) & ~inside
        cost = np.where(inside, D * r**2 / 2, 0.0)
        cost[outside] = (loss * np.abs(r) - loss**2 / (2 * D))[outside]
        slope = np.where(inside, D * r, np.where(outside, loss * np.sign(r), 0.0))
        value = a @ M @ a / 2 - a @ f + cost.sum()
        return value, M @ a - f + J.T @ slope, M + J.T @ (np.where(inside, D, 0.0)[:, None] * J)

    a = start.copy()
    for _ in range(60):
        value, gradient, hessian = parts(a)
        change, share = -np.linalg.solve(hessian, gradient), 1.0
        while parts(a + share * change)[0] > value + 1e-4 * share * (gradient @ change) and share > 1e-9:
            share /= 2
        a = a + share * change
    return a


def states(model: mujoco.MjModel, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random states as float32 numbers, with all kinds of active constraints."""
    rng = np.random.default_rng(seed)
    qpos = np.stack(
        [rng.uniform(-0.45, 1.55, count), rng.uniform(-1.05, 1.05, count), rng.normal(0, 0.5, count),
         rng.normal(0, 0.5, count)], axis=1
    )  # fmt: skip
    qvel = rng.normal(0, 1.0, (count, model.nv)) * (rng.random((count, 1)) > 0.2)  # a fifth of them rest
    return qpos.astype(np.float32).astype(float), qvel.astype(np.float32).astype(float)


def reference(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray, set[int]]:
    """qacc and constraint forces of the C engine at 100 iterations, and the kinds of its rows."""
    qacc, force, kinds = np.empty_like(qvel), np.empty_like(qvel), set()
    data = mujoco.MjData(model)
    for i, (q, v) in enumerate(zip(qpos, qvel, strict=True)):
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(model, data)
        qacc[i], force[i] = data.qacc, data.qfrc_constraint
        kinds |= set(data.efc_type[: data.nefc].tolist())
    return qacc, force, kinds


KINDS = mujoco.mjtConstraint
EXPECTED_KINDS = {
    int(k)
    for k in (
        KINDS.mjCNSTR_FRICTION_DOF,
        KINDS.mjCNSTR_LIMIT_JOINT,
        KINDS.mjCNSTR_CONTACT_PYRAMIDAL,
        KINDS.mjCNSTR_CONTACT_FRICTIONLESS,
    )
}


@pytest.fixture(
    scope="module",
    params=["joint", pytest.param("none", marks=pytest.mark.slow), pytest.param("connect", marks=pytest.mark.slow)],
)
def case(request) -> tuple:
    model = arm(request.param)
    qpos, qvel = states(model, 200, seed=5)
    if request.param == "connect":  # C adds the anchor's centripetal acceleration (J' v), MJX leaves it out
        qvel *= 0
    return request.param, model, qpos, qvel, solver(model), reference(model, qpos, qvel)


def error(got: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """[N] largest error of each state, relative to the scale of its accelerations."""
    return np.abs(got - expected).max(axis=1) / (1.0 + np.abs(expected).max(axis=1))


# float32 kinematics put 1e-7 m into a contact's depth; solref 0.02 and dr of a millimetre turn
# that into a relative 1e-4 of the contact's acceleration, and light links make it larger.
QACC_TOLERANCE = 2e-3


def test_the_states_have_every_kind_of_constraint(case):
    name, _, _, _, _, (_, _, kinds) = case
    wanted = EXPECTED_KINDS | ({int(KINDS.mjCNSTR_EQUALITY)} if name != "none" else set())
    assert kinds >= wanted


def test_accelerations_are_those_of_the_c_engine(case):
    _, _, qpos, qvel, run, (qacc, force, _) = case
    (got, got_force), _ = run(qpos, qvel, np.zeros_like(qvel))
    off = error(np.asarray(got), qacc)
    assert off.max() < QACC_TOLERANCE, f"worst state {off.argmax()}: {off.max():.1e}"
    assert np.median(off) < 2e-5
    assert error(np.asarray(got_force), force).max() < QACC_TOLERANCE


def test_the_minimum_is_that_of_a_float64_newton(case):
    """With MJX's rows, so that only the solver is tested; float32 keeps five digits."""
    _, model, qpos, qvel, run, (qacc, _, _) = case
    rows = constraint_rows(mjx.make_data(mjx.put_model(model)))
    (got, _), problems = run(qpos, qvel, np.zeros_like(qvel))
    exact = np.array(
        [
            minimum({k: v[i] for k, v in problems.items()}, rows.equalities, rows.frictions, qacc[i])
            for i in range(len(qpos))
        ]
    )
    assert error(np.asarray(got), exact).max() < 1e-5


def test_any_warm_start_gives_the_same_solution(case):
    _, _, qpos, qvel, run, (qacc, _, _) = case
    rng = np.random.default_rng(11)
    for scale in (1.0, 100.0):
        warm = (qacc + scale * rng.normal(size=qacc.shape)).astype(np.float32)
        off = error(np.asarray(run(qpos, qvel, warm)[0][0]), qacc)
        assert off.max() < QACC_TOLERANCE, f"scale {scale}, worst state {off.argmax()}: {off.max():.1e}"


@pytest.mark.slow
def test_the_solution_as_warm_start_is_kept(case):
    _, _, qpos, qvel, run, (qacc, _, _) = case
    assert error(np.asarray(run(qpos, qvel, qacc.astype(np.float32))[0][0]), qacc).max() < QACC_TOLERANCE


@pytest.mark.parametrize("size", [1, 3, 8, UNROLLED, UNROLLED + 1])
def test_a_gpu_solves_the_same_systems(monkeypatch, size: int):
    """The GPU's implementation, run on a CPU, against float64, with stiff and soft rows."""
    rng = np.random.default_rng(size)
    jacobian, weights = rng.normal(size=(5, 20, size)), 10.0 ** rng.uniform(-2, 3, (5, 20))
    inertia, right = np.eye(size) * rng.uniform(0.1, 2.0, size), rng.normal(size=(5, size))
    matrix = inertia + np.einsum("bri,br,brj->bij", jacobian, weights, jacobian)

    def change(jacobian: jax.Array, weights: jax.Array, right: jax.Array) -> tuple[jax.Array, jax.Array]:
        of_weights, solved = normal_equations(jacobian)
        whole = jnp.asarray(inertia, jnp.float32) + of_weights(weights)
        return whole, solved(whole, right)

    for backend in ("cpu", "gpu"):
        with monkeypatch.context() as patch:
            patch.setattr(jax, "default_backend", lambda backend=backend: backend)
            built, found = jax.vmap(change)(*(jnp.asarray(a, jnp.float32) for a in (jacobian, weights, right)))
        np.testing.assert_allclose(built, matrix, rtol=1e-5, atol=1e-5 * np.abs(matrix).max())
        left = np.einsum("bij,bj->bi", np.asarray(built, float), np.asarray(found, float)) - right
        assert np.abs(left).max() < 2e-3 * np.abs(right).max(), backend


# ----- firm friction: its part of the slope along a step is steep and narrow, and many rows have such a part

LIGHT = """<mujoco><compiler angle="radian"/>
<option timestep="0.004" integrator="implicitfast" iterations="100" ls_iterations="50" tolerance="1e-12"/>
<default><joint axis="0 1 0" frictionloss="0.3" damping="1" armature="0.03" solimpfriction="0.9999 0.9999"/></default>
<worldbody>{links}</worldbody><actuator>{servos}</actuator></mujoco>"""


def light_arm(joints: int, timestep: float = 0.004) -> mujoco.MjModel:
    """An arm of short, light links, each with a servo."""
    links = servos = ""
    for k in reversed(range(joints)):
        joint = f'<joint name="j{k}"/><inertial pos="0.06 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>'
        links = f'<body pos="{0.12 * (k > 0)} 0 0">{joint}{links}</body>'
        servos = f'<position joint="j{k}" kp="12"/>{servos}'
    model = mujoco.MjModel.from_xml_string(LIGHT.format(links=links, servos=servos))
    model.opt.timestep = timestep
    return model


@pytest.mark.parametrize("joints", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_firm_friction_of_many_joints_is_that_of_the_c_engine(joints: int):
    """With fewer and more rows than EXACT_ROWS."""
    model, rng = light_arm(joints), np.random.default_rng(3)
    qpos = rng.uniform(-0.5, 0.5, (100, joints)).astype(np.float32).astype(float)
    qvel = (rng.normal(0, 0.5, qpos.shape) * (rng.random(qpos.shape) > 0.5)).astype(np.float32).astype(float)
    expected, _, _ = reference(model, qpos, qvel)
    warm = (expected + rng.normal(0, 3.0, expected.shape)).astype(np.float32)
    got = np.asarray(solver(model, firm=True)(qpos, qvel, warm)[0][0])
    assert error(got, expected).max() < QACC_TOLERANCE


@pytest.mark.slow
def test_a_light_arm_that_steps_and_holds_agrees_with_c():
    """Five joints, 6 s of steps, against C with an eighth of the step, compared while the arm holds.

    Velocities are half a step before positions, so a command that jumps acts half a step early: 8 mrad while the arm
    moves.  A replay compensates that (`late` of `servo_replay`), a single step does not.
    """
    goals = 0.5 * np.random.default_rng(1).uniform(-1, 1, (4, 5))

    def goal(time: float) -> np.ndarray:
        return goals[min(int(time / 1.5), 3)]

    fine, coarse = light_arm(5, 0.0005), mjx.put_model(light_arm(5))
    data, expected = mujoco.MjData(fine), []
    for k in range(12_000):
        if k % 8 == 0:
            expected.append(data.qpos.copy())
        data.ctrl[:] = goal(k * 0.0005)
        mujoco.mj_step(fine, data)
    table = jnp.asarray([goal(0.004 * k) for k in range(1500)], jnp.float32)

    def advance(data, ctrl):
        return simulate_step(coarse, data.replace(ctrl=ctrl), parity=False), data.qpos

    got = jax.jit(lambda d: jax.lax.scan(advance, d, table)[1])(mjx.make_data(coarse))
    holds = np.arange(1500) * 0.004 % 1.5 > 1.0  # s after a step
    off = np.abs(np.asarray(got) - np.array(expected))
    assert off[holds].max() < 3e-4, off[holds].max(axis=0)
    assert off.max() < 1e-2
    assert np.ptp(expected, axis=0).min() > 0.1


# ----- single rows, against what can be written on paper

SPINNER = """<mujoco><compiler angle="radian"/>
<option timestep="0.002" gravity="0 0 0" integrator="implicitfast"/><worldbody>
  <body><joint name="j" axis="0 0 1" frictionloss="0.5" {joint}/>
  <inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/><geom size=".1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor joint="j"/></actuator></mujoco>"""


@functools.cache
def spinner(joint: str, steps: int, parity: bool) -> Callable[[float, float], tuple[jax.Array, jax.Array]]:
    """(torque, initial speed) -> position and velocity [steps], compiled once."""
    on_device = mjx.put_model(mujoco.MjModel.from_xml_string(SPINNER.format(joint=joint)))
    start = mjx.make_data(on_device)

    def advance(data, _):
        data = simulate_step(on_device, data, parity=parity)
        return data, (data.qpos[0], data.qvel[0])

    def run(torque, speed):
        begin = start.replace(ctrl=jnp.stack([torque]), qvel=jnp.stack([speed]))
        return jax.lax.scan(advance, begin, None, length=steps)[1]

    return jax.jit(run)


def run_spinner(
    joint: str, *, torque: float, speed: float, steps: int, parity: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    position, velocity = spinner(joint, steps, parity)(torque, speed)
    return np.asarray(position), np.asarray(velocity)


@pytest.mark.parametrize("parity", [pytest.param(True, marks=pytest.mark.slow), False])
def test_dry_friction_decelerates_by_its_torque(parity: bool):
    """I dv/dt = -0.5 N m until the joint stops: v = v0 - 5 t, from either side."""
    for sign in (1.0, -1.0):
        _, velocity = run_spinner("", torque=0.0, speed=sign * 1.0, steps=200, parity=parity)
        t = 0.002 * np.arange(1, 201)
        moving = t < 0.19
        np.testing.assert_allclose(velocity[moving], sign * (1.0 - 5.0 * t[moving]), atol=1e-3)
        assert np.abs(velocity[t > 0.3]).max() < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("parity", [True, False])
def test_dry_friction_transmits_the_excess_torque_only(parity: bool):
    _, velocity = run_spinner("", torque=0.8, speed=0.0, steps=200, parity=parity)
    # a = (0.8 - 0.5) / 0.1 = 3 rad/s^2, after a short creep while the friction builds up
    assert np.diff(velocity[100:]).mean() / 0.002 == pytest.approx(3.0, rel=1e-3)
    _, velocity = run_spinner("", torque=0.4, speed=0.0, steps=200, parity=parity)
    assert np.abs(velocity).max() < 0.05


def test_a_limit_holds():
    position, velocity = run_spinner('range="-1 0.05" limited="true"', torque=2.0, speed=0.0, steps=600)
    assert 0.05 < position.max() < 0.06
    assert np.abs(velocity[-50:]).max() < 1e-3


# ----- the step


def rollout_c(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, steps: int) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos, data.qvel = qpos, qvel
    out = np.empty((steps, model.nq))
    for k in range(steps):
        mujoco.mj_step(model, data)
        out[k] = data.qpos
    return out


def rollout_mjx(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, steps: int, parity: bool) -> np.ndarray:
    on_device = mjx.put_model(model)
    data = mjx.make_data(on_device).replace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))

    def advance(data, _):
        data = simulate_step(on_device, data, parity=parity)
        return data, data.qpos

    return np.asarray(jax.jit(lambda d: jax.lax.scan(advance, d, None, length=steps)[1])(data))


@pytest.mark.slow  # quick ones are in tests/simulate: of an arm, of the door
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_parity_steps_are_those_of_the_c_engine(integrator: str):
    """A second of falling, hitting the post and sliding over it."""
    model = arm("joint")
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    qpos, qvel = np.array([-0.1, 0.2, 0.3, 0.0]), np.zeros(4)
    expected = rollout_c(model, qpos, qvel, 500)
    got = rollout_mjx(model, qpos, qvel, 500, True)
    assert np.ptp(expected[:, 0]) > 0.3  # it moves
    # An impact multiplies float32's 1e-7 by a few hundred.
    np.testing.assert_allclose(got, expected, atol=5e-4)


def test_the_default_step_is_of_second_order():
    """Halving the step quarters the error of a damped pendulum; C's implicitfast only halves it."""
    xml = """<mujoco><option timestep="{h}" integrator="implicitfast"/><worldbody><body>
      <joint name="j" axis="0 1 0" damping="2"/><inertial mass="1" pos=".5 0 0" diaginertia=".1 .1 .1"/>
      <geom size=".1" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
    truth = rollout_c(mujoco.MjModel.from_xml_string(xml.format(h=1e-5)), np.array([0.3]), np.zeros(1), 60_000)
    steps = {0.02: 30, 0.01: 60}
    models = {h: mujoco.MjModel.from_xml_string(xml.format(h=h)) for h in steps}

    def errors(parity: bool) -> tuple[float, float]:
        """At both steps, in one program: the step is an input of it."""
        on_device = mjx.put_model(models[0.01])
        start = mjx.make_data(on_device).replace(qpos=jnp.array([0.3]))

        def path(h, velocity):
            model = on_device.tree_replace({"opt.timestep": h})

            def advance(data, _):
                data = simulate_step(model, data, parity=parity)
                return data, data.qpos[0]

            return jax.lax.scan(advance, start.replace(qvel=velocity), None, length=max(steps.values()))[1]

        run, worst = jax.jit(path), []
        for h, count in steps.items():
            got = np.asarray(run(h, jnp.asarray(_half_back(models[h], h))))[:count]
            worst.append(float(np.abs(got - truth[round(h / 1e-5) - 1 :: round(h / 1e-5), 0]).max()))
        return worst[0], worst[1]

    (rough, fine), (rough_parity, fine_parity) = errors(False), errors(True)
    assert 3.3 < rough / fine < 5.0
    assert rough_parity / fine_parity < 2.6
    assert fine < 0.2 * fine_parity


def _half_back(model: mujoco.MjModel, h: float) -> np.ndarray:
    """The velocity half a step before the start, as the leapfrog needs it: from rest, -h/2 a."""
    data = mujoco.MjData(model)
    data.qpos[0] = 0.3
    mujoco.mj_forward(model, data)
    return -0.5 * h * data.qacc


def test_midpoint_law_follows_its_equation():
    """J a = (-b v - k d r - R f) / (1 + b h / 2): damping, stiffness x impedance and R."""
    model, own_law = mjx.put_model(arm()), getattr(private(CONSTRAINT_LAW[0]), CONSTRAINT_LAW[1])
    solref, solimp, position = jnp.array([0.02, 1.0]), jnp.array([0.9, 0.95, 0.001, 0.5, 2.0]), jnp.array(-4e-4)
    k, b, d = own_law(model, solref, solimp, position)
    new_k, new_b, new_d = midpoint_law(own_law)(model, solref, solimp, position)
    share = 1.0 / (1.0 + 0.5 * 0.002 * b)
    assert float(new_b) == pytest.approx(float(share * b), rel=1e-5)
    assert float(new_k * new_d) == pytest.approx(float(share * k * d), rel=1e-5)
    assert float((1 - new_d) / new_d) == pytest.approx(float(share * (1 - d) / d), rel=1e-4)


@pytest.mark.parametrize(
    ("option", "parity", "says"),
    [
        ('integrator="RK4"', True, "integrates with Euler or implicitfast"),
        ('integrator="RK4"', False, "integrates with Euler or implicitfast"),
        ('cone="elliptic"', False, "pyramidal friction cones"),
        ('density="1.2" viscosity="1.8e-5"', False, "no air or water"),
    ],
)
def test_other_options_are_refused(option: str, parity: bool, says: str):
    given = mujoco.MjModel.from_xml_string(f"<mujoco><option {option}/></mujoco>")
    model = mjx.put_model(given)
    for refuse in (
        lambda: simulate_step(model, mjx.make_data(model), parity=parity),
        lambda: check_options(given, parity),
    ):
        with pytest.raises(ValueError, match=says):
            refuse()
