"""Every effect against plain C MuJoCo: a feature of MuJoCo if there is one, else a formula before each mj_step."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effect_bench import JOINTS, MECHANISM, Bench, bare, make_bench, mechanism_bench
from effect_oracles import ORACLES, STIFFNESS, Now, Oracle

from droid_jax.model.scene import TINY_FRICTIONLOSS
from droid_jax.simulate.replay import Drive

TIMESTEP = 0.001  # s
# At the same time step both engines do the same arithmetic, C in float64.  float32 resolves an angle of 1 rad to
# 6e-8, which a servo of 80 N m/rad turns into 5e-6 N m a step; over 4000 steps 4e-5 N m were seen at most.
PARITY = 1e-4  # N m
FAINT = {"soft_friction": 5}  # by how many tolerances it is seen at least, of other effects by 20
# Friction that depends on the speed closes a loop: while a joint nearly sticks, rounding of the speed comes back.
# 2e-4 N m were seen at most.
PARITY_RUBBING = 5e-4  # N m
# A goal on a ramp is a sum of small steps: in float32 some 2e-6 rad are lost over it, of 80 N m/rad.  The speed of a
# command is a difference of such numbers: 1.03e-4 N m were seen at most.
ROUNDED = {"profile_speed": 5e-4, "velocity_feedforward": 2e-4}  # N m
# The replay's own step is second order, but what depends on the speed sees it half a step before the angle, and the
# load a whole one: at 5 ms some hundredths of such an effect.
SECOND_ORDER = 0.01  # N m, of the bare scene
LATE = 0.05  # of an effect


def in_c(drive: Drive, oracle: Oracle, *, late: float) -> np.ndarray:
    """[T, J] N m by mj_step at the drive's time step, with commands delayed by `late` steps."""
    v = oracle.values
    spec = mujoco.MjSpec.from_string(MECHANISM)
    spec.option.timestep = drive.timestep
    for joint in spec.joints:
        joint.frictionloss = max(joint.frictionloss, TINY_FRICTIONLOSS)
    if oracle.edit:
        oracle.edit(spec, v)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = drive.qpos0
    dofs = {j: int(model.joint(j).dofadr[0]) for j in JOINTS}
    servos = {a.target: row for row, a in enumerate(spec.actuators)}
    losses = model.dof_frictionloss.copy()
    by_hand = oracle.edit is None
    at = drive.time - late * drive.timestep - (oracle.late(v) if oracle.late else 0.0)

    def look(time: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(time, drive.time, column) for column in drive.command.T], axis=1)

    command = oracle.sent(v, at, look, servos) if oracle.sent else look(at)
    read = {j: float(command[0, row] - data.qpos[dofs[j]]) for j, row in servos.items()}
    for joint, twist in (oracle.twist(v, read) if oracle.twist else {}).items():
        data.qpos[dofs[joint]] -= twist
    torque = np.empty((len(command), len(JOINTS)))
    for k, ctrl in enumerate(command):
        q, w, load = ({j: float(a[d]) for j, d in dofs.items()} for a in (data.qpos, data.qvel, data.qfrc_actuator))
        motor = data.qfrc_actuator + data.qfrc_gravcomp - model.dof_damping * data.qvel
        links = data.qfrc_spring - data.qfrc_bias + data.qfrc_applied  # nothing touches, no limit is reached
        gear = ({j: float(a[d]) for j, d in dofs.items()} for a in (motor, links))
        now = Now(q, w, load, {j: ctrl[row] - q[j] for j, row in servos.items()}, *gear)
        data.ctrl[:] = ctrl
        for joint, lead in (oracle.lead(v, now) if oracle.lead else {}).items():
            data.ctrl[servos[joint]] -= lead
        pushes = oracle.force if by_hand else oracle.beside
        for joint, push in (pushes(v, now) if pushes else {}).items():
            data.qfrc_applied[dofs[joint]] = push
        for joint, more in (oracle.loss(v, now) if oracle.loss and by_hand else {}).items():
            model.dof_frictionloss[dofs[joint]] = max(losses[dofs[joint]] + more, 0.0)
        mujoco.mj_step(model, data)
        torque[k] = [data.qfrc_actuator[dofs[j]] for j in JOINTS]
    return oracle.read(v, drive.time, torque) if oracle.read else torque


def columns(oracle: Oracle) -> list[int]:
    return [JOINTS.index(j) for j in oracle.joints]


def replayed(bench: Bench) -> dict[str, np.ndarray]:
    """The replay of all oracles' values, and of neutral, in one batch."""
    rows = {"": Oracle({}), **ORACLES}
    return dict(zip(rows, bench.torque(*(o.values for o in rows.values())), strict=True))


@pytest.fixture(scope="module")
def exact() -> Bench:
    return mechanism_bench(TIMESTEP, parity=True)


@pytest.fixture(scope="module")
def torques(exact: Bench) -> dict[str, np.ndarray]:
    return replayed(exact)


def test_every_effect_has_an_oracle_for_all_its_parameters(exact: Bench):
    declared = {e.name: {p.name for p in e.parameters} for e in exact.effects}
    assert {name: set(oracle.values) for name, oracle in ORACLES.items()} == declared
    exact.space.check(np.array([exact.space.values(oracle.values) for oracle in ORACLES.values()]))


def test_the_bare_scene_is_what_c_does(exact: Bench, torques: dict[str, np.ndarray]):
    np.testing.assert_allclose(torques[""], in_c(exact.drive, Oracle({}), late=0.5), atol=PARITY)


@pytest.mark.parametrize("name", ORACLES)
def test_the_effect_is_what_c_does(exact: Bench, torques: dict[str, np.ndarray], name: str):
    oracle = ORACLES[name]
    expected = in_c(exact.drive, oracle, late=0.5)[:, columns(oracle)]
    tolerance = PARITY_RUBBING if oracle.loss else ROUNDED.get(name, PARITY)
    np.testing.assert_allclose(torques[name][:, columns(oracle)], expected, atol=tolerance)
    places = [j for j in exact.effect(name).locations if j in oracle.joints] or oracle.joints
    apart = np.abs(torques[name] - torques[""]).max(axis=0)
    assert (apart[[JOINTS.index(j) for j in places]] > FAINT.get(name, 20) * tolerance).all()


def test_a_compliant_joint_that_begins_under_load_is_what_c_does(exact: Bench):
    """The recorded start is the encoder's: the servo holds the arm there, and the link is behind it."""
    oracle, start = ORACLES["joint_compliance"], exact.drive.qpos0.copy()
    for joint, load in (("shoulder", -8.0), ("elbow", 6.0)):  # N m
        start[exact.scene.qpos(joint)] -= load / STIFFNESS[joint]
    drive = replace(exact.drive, qpos0=start)
    bench = make_bench(exact.scene, drive, [exact.effect("joint_compliance")], parity=True)
    neutral, got = bench.torque({}, oracle.values)
    np.testing.assert_allclose(got, in_c(drive, oracle, late=0.5), atol=PARITY)
    np.testing.assert_allclose(neutral, bare(bench, parity=True).torque, atol=PARITY)
    from_link = in_c(drive, replace(oracle, twist=None), late=0.5)
    assert np.abs(got - from_link).max() > 20 * PARITY


@pytest.mark.parametrize("name", ["hinge_preload", "joint_coulomb", "tilted_frame"])
def test_the_formulas_agree_with_the_features(exact: Bench, name: str):
    """If MuJoCo has the effect, the formula of the other tests must agree with it."""
    oracle = ORACLES[name]
    by_hand = Oracle(oracle.values, force=oracle.force, loss=oracle.loss)
    off = in_c(exact.drive, oracle, late=0.5) - in_c(exact.drive, by_hand, late=0.5)
    np.testing.assert_allclose(off[:, columns(oracle)], 0.0, atol=1e-9)


@pytest.mark.slow
def test_at_the_usual_step_the_effects_are_near_the_continuous_ones(small: Bench):
    """Against C with a fiftieth of the step."""
    fine = mechanism_bench(small.drive.timestep / 50).drive
    got = replayed(small)

    def off(name: str, oracle: Oracle) -> np.ndarray:
        continuous = in_c(fine, oracle, late=0.0)[::50]
        return np.sqrt(np.mean((got[name] - continuous) ** 2, axis=0))[columns(oracle)]

    floor = off("", Oracle({}))
    assert (floor < SECOND_ORDER).all()
    for name, oracle in ORACLES.items():
        size = np.sqrt(np.mean((got[name] - got[""]) ** 2, axis=0))[columns(oracle)]
        assert (off(name, oracle) < SECOND_ORDER + LATE * size).all(), (name, off(name, oracle), size)
