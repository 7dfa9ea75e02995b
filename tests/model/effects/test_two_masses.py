"""Motor and link as two masses, against a C model in which the motor is a body of its own."""

from __future__ import annotations

import copy
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from droid_jax.model.effect_interface import State
from droid_jax.model.effects.registry import library
from droid_jax.model.effects.two_masses import BACKLASH, DAMPING, RESONANCE
from droid_jax.model.fields import time_offset
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_physics
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.simulate.c_engine import instrument, split
from droid_jax.simulate.compiled import compiled_replay, window_program
from droid_jax.simulate.replay import Drive, servo_replay
from droid_jax.synthetic import hooks
from droid_jax.synthetic.drive_effects import GEAR_DAMPING
from droid_jax.synthetic.hidden_effects import HIDDEN, LONGEST_STEP
from droid_jax.synthetic.hooks import Influence, Live, Place, SensorInput
from droid_jax.synthetic.robot import set_engine

KP, ROTOR, LINK, REACH = 40.0, 0.02, 0.3, 0.25  # N m/rad, kg m^2, kg, m
DAMPED = 0.05  # N m s/rad, of the joint
FINE = 2e-5  # s, of the C model
SECONDS, STEP = 1.6, 0.002


def rigid(kv: float, limit: float = 1e3, rotor: float = ROTOR) -> Scene:
    """A pendulum with a position servo and the motor's inertia as its armature."""
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body name="link">
        <joint name="j" axis="0 1 0" armature="{rotor}" damping="{DAMPED}"/>
        <geom type="sphere" size="0.02" pos="{REACH} 0 0" mass="{LINK}" contype="0" conaffinity="0"/></body></worldbody>
        <actuator><position name="j" joint="j" kp="{KP}" kv="{kv}" forcerange="{-limit} {limit}"/>
        </actuator></mujoco>"""
    )
    return compile_scene(spec, "pendulum", joints=("j",))


def in_c(command: np.ndarray, twist: str, kv: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles of motor and link and the motor's torque, at the rows of the command, by small steps of two bodies.

    twist: attributes of the joint between them.
    """
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler angle="radian"/><option timestep="{FINE}" integrator="implicitfast"/>
        <worldbody><body name="motor">
        <joint name="motor" axis="0 1 0"/><inertial pos="0 0 0" mass="1e-6" diaginertia="{ROTOR} {ROTOR} {ROTOR}"/>
        <body name="link"><joint name="twist" axis="0 1 0" {twist}/>
        <geom type="sphere" size="0.02" pos="{REACH} 0 0" mass="{LINK}" contype="0" conaffinity="0"/></body>
        </body></worldbody><actuator><position joint="motor" kp="{KP}" kv="{kv}"/></actuator></mujoco>"""
    )
    data, rows, every = mujoco.MjData(model), list[tuple[float, float, float]](), round(STEP / FINE)
    data.ctrl[0] = data.qpos[0] = command[0]
    for _ in range(200_000):  # to rest
        mujoco.mj_step(model, data)
        data.qvel *= 0.999
    for now, following in zip(command, [*command[1:], command[-1]], strict=True):
        rows.append((data.qpos[0], data.qpos[0] + data.qpos[1], data.actuator_force[0]))
        for part in range(every):
            data.ctrl[0] = now + (following - now) * (part + 0.5) / every
            data.qfrc_applied[:] = -DAMPED * (data.qvel[0] + data.qvel[1])  # the joint's damping acts on the link
            mujoco.mj_step(model, data)
    motor, link, torque = np.array(rows).T
    return motor, link, torque


def smooth_steps(about: float = 0.0) -> np.ndarray:
    """[T] rad, goals that change within 60 ms."""
    time = np.arange(round(SECONDS / STEP)) * STEP
    ramps = [(0.2, 0.5), (0.8, -0.8), (1.2, 0.3)]
    parts = [size * 0.5 * (1 - np.cos(np.pi * np.clip((time - at) / 0.06, 0, 1))) for at, size in ramps]
    return about + np.sum(parts, axis=0)


def two_masses(scene: Scene) -> Space:
    """Parameters of both effects."""
    return Space(tuple(p for e in library(scene, [RESONANCE, BACKLASH]) for p in e.parameters))


def positions(scene: Scene, space: Space, rows: np.ndarray, command: np.ndarray) -> np.ndarray:
    """[P, T] recorded positions."""
    drive = Drive(command[:, None], np.zeros(1), STEP, TorqueConvention(TorqueSide.MOTOR, gravity=True))
    batch = compiled_replay("mjx", scene, space, drive, library(scene, [RESONANCE, BACKLASH]))
    return np.asarray(batch(rows).position)[..., 0]


def replayed(
    scene: Scene, values: dict[str, float], command: np.ndarray, start: float, side: TorqueSide = TorqueSide.MOTOR
) -> tuple[np.ndarray, np.ndarray]:
    """Recorded position and torque [T] with these coefficients."""
    effects, space = library(scene, [RESONANCE, BACKLASH]), two_masses(scene)
    drive = Drive(command[:, None], np.array([start]), STEP, TorqueConvention(side, gravity=True))
    rollout = compiled_replay("mjx", scene, space, drive, effects)(np.tile(space.values(values), (2, 1)))
    return np.asarray(rollout.position)[0, :, 0], np.asarray(rollout.torque)[0, :, 0]


@pytest.mark.parametrize(
    ("compliance", "ratio", "kv"),
    [(0.02, 0.05, 0.6), (0.05, 0.02, 0.0), (0.004, 0.1, 0.6)],  # resonances near 10, 7 and 22 Hz
)
def test_a_resonance_is_that_of_two_bodies_in_c(compliance: float, ratio: float, kv: float):
    command, damper = smooth_steps(), 2.0 * ratio * np.sqrt(ROTOR / compliance)
    motor, link, torque = in_c(command, f'stiffness="{1.0 / compliance}" damping="{damper}"', kv)
    values = {f"{RESONANCE}[j]": compliance, DAMPING: ratio}
    got, force = replayed(rigid(kv), values, command, start=motor[0])
    stiff, _ = replayed(rigid(kv), {}, command, start=motor[0])
    assert np.ptp(motor - link) > 0.03  # rad: it vibrates
    assert np.abs(got - motor).max() < 0.025 * np.abs(stiff - motor).max()
    assert np.abs(force - torque).max() < 0.025 * np.abs(torque).max()
    _, spring = replayed(rigid(kv), values, command, start=motor[0], side=TorqueSide.LINK)
    reaching = (motor - link) / compliance + damper * np.gradient(motor - link, STEP) - DAMPED * np.gradient(link, STEP)
    assert np.abs(spring - reaching).max() < 0.02 * np.ptp(reaching)


@pytest.mark.parametrize(("gap", "kv"), [(0.03, 0.6), (0.08, 0.0)])
def test_backlash_is_that_of_two_bodies_in_c(gap: float, kv: float):
    """About the hanging pose, where the load changes its sign."""
    command = smooth_steps(0.5 * np.pi)
    ends = f'range="{-gap / 2} {gap / 2}" limited="true" solreflimit="5e-5 1" solimplimit="0.99 0.9999 1e-4"'
    motor, link, torque = in_c(command, ends, kv)
    got, force = replayed(rigid(kv), {f"{BACKLASH}[j]": gap}, command, start=link[0])
    stiff, _ = replayed(rigid(kv), {}, command, start=link[0])
    assert np.ptp(motor - link) > 0.9 * gap and np.abs(stiff - link).max() > 0.02

    def rms(error: np.ndarray) -> float:
        return float(np.sqrt(np.mean(error**2)))

    # A contact begins and ends at a time step.
    assert rms(got - link) < 0.1 * rms(stiff - link)
    assert rms(force - torque) < 0.03 * rms(torque)


@pytest.mark.parametrize("ratio", [0.02, 0.1])
def test_every_compliance_is_stable_and_a_small_one_nearly_rigid(ratio: float):
    """Of light and heavy links, at time steps far above the period of the vibration."""
    command, space = smooth_steps(), two_masses(rigid(0.0))
    for inertia in (0.002, 0.02, 0.2):
        scene = rigid(0.0, rotor=inertia)
        compliances = np.geomspace(1e-8, 1e-2, 48)
        rows = np.stack([space.values({f"{RESONANCE}[j]": c, DAMPING: ratio}) for c in [0.0, 0.0, *compliances]])
        position = positions(scene, space, rows, command)
        assert np.isfinite(position).all() and np.abs(position).max() < 3.0
        off = np.abs(position[2:] - position[0]).max(axis=1)
        small = compliances < 1e-5
        assert (off[small] < 300.0 * compliances[small] + 3e-6).all()  # in proportion, without a band that rings


def test_neutral_is_the_rigid_gear_and_both_act():
    """Without an effect, at its neutral, and with it."""
    scene, command = rigid(0.6), smooth_steps()
    drive = Drive(command[:, None], np.zeros(1), STEP, TorqueConvention(TorqueSide.MOTOR, gravity=True))
    base = Space((time_offset(),))
    bare = compiled_replay("mjx", scene, base, drive, ())(np.zeros((2, 1)))
    space = two_masses(scene)
    rows = [space.mean, space.values({f"{RESONANCE}[j]": 1e-3}), space.values({f"{BACKLASH}[j]": 4e-3})]
    neutral, elastic, loose = positions(scene, space, np.stack([*rows, rows[0]]), command)[:3]
    np.testing.assert_allclose(neutral, np.asarray(bare.position)[0, :, 0], atol=2e-6)
    assert np.abs(elastic - neutral).max() > 1e-3 < np.abs(loose - neutral).max()


def test_a_motion_that_begins_at_the_servos_limit_begins_with_its_twist():
    """The gear carries the limit and not what the servo is asked for."""
    scene = rigid(0.0, limit=1.0)
    (effect,) = library(scene, [RESONANCE])
    assert effect.gear is not None and effect.twist is not None
    still = jnp.zeros(1)
    state = State(jnp.float32(0.0), still, still, still, scene.mjx, motors=jnp.zeros((3, 1)))
    of_start = {f"{RESONANCE}[j]": jnp.float32(2e-3)}, state, jnp.array([0.5])
    motors, ahead = effect.gear.start(*of_start), effect.twist(*of_start)
    np.testing.assert_allclose([motors[0, 0], ahead[0]], 2e-3 * 1.0, rtol=1e-6)


@pytest.mark.parametrize("values", [{f"{RESONANCE}[j]": 5e-3}, {f"{BACKLASH}[j]": 0.02}])
def test_a_window_begins_where_the_motion_is(values: dict[str, float]):
    """From recorded positions and speeds: the state of the gear follows from the servo's torque."""
    scene, time = rigid(0.6), np.arange(800) * STEP
    command, first, steps = 0.4 * np.sin(6.0 * time), 300, 200
    effects, space = library(scene, [RESONANCE, BACKLASH]), two_masses(scene)
    drive = Drive(command[:, None], np.zeros(1), STEP, TorqueConvention(TorqueSide.MOTOR, gravity=True))
    rows = np.tile(space.values(values), (2, 1))
    whole = compiled_replay("mjx", scene, space, drive, effects)(rows)
    position, velocity = (np.asarray(trace)[0, :, 0] for trace in (whole.position, whole.velocity))
    window = window_program(scene, space, drive, effects, 0, steps)
    early = 0.5 * (velocity[first - 1] + velocity[first])  # half a step before the position
    begin, speed = np.full((2, 1), position[first]), np.full((2, 1), early)
    table = np.tile(command[first : first + steps, None], (2, 1, 1))
    found = window(rows, table, begin, np.ones((2, 1, 2)), speed, np.full(2, time[first]))
    twist = values.get(f"{RESONANCE}[j]", 0.0) * np.abs(np.asarray(whole.torque)[0]).max()
    off = np.abs(np.asarray(found.position)[0, :, 0] - position[first : first + steps]).max()
    assert off < 0.1 * max(twist, values.get(f"{BACKLASH}[j]", 0.0))


def test_the_replay_has_forward_derivatives():
    scene = rigid(0.6)
    effects = library(scene, [RESONANCE, BACKLASH])
    space = Space(tuple(p for e in effects for p in e.parameters))
    command = smooth_steps()[:200]
    drive = Drive(command[:, None], np.zeros(1), STEP, TorqueConvention(TorqueSide.MOTOR, gravity=True))
    replay = servo_replay(scene, drive, effects)
    at = jnp.asarray(space.values({f"{RESONANCE}[j]": 5e-3}), jnp.float32)
    slope = jax.jacfwd(lambda values: replay(make_physics(scene, space, values)).position[:, 0])(at)[:, 0]
    more, less = (replay(make_physics(scene, space, at.at[0].add(s))).position[:, 0] for s in (1e-4, -1e-4))
    np.testing.assert_allclose(slope, (more - less) / 2e-4, atol=0.02 * np.abs(slope).max())


@pytest.mark.parametrize("kv", [0.0, 0.5, 4.0])
def test_a_servo_at_its_limit_turns_its_motor_with_that_torque(kv: float):
    """In the backlash, where nothing else acts on the motor; a servo at its limit does not damp."""
    scene = rigid(kv, limit=2.0)
    command = np.full(round(0.1 / STEP), 0.5 * np.pi)  # hanging at rest
    begin = len(command) // 2
    command[begin:] += 0.4  # kp times 0.4 rad is far above the limit
    position, torque = replayed(scene, {f"{BACKLASH}[j]": 0.05}, command, start=0.5 * np.pi)
    np.testing.assert_allclose(torque[begin:], 2.0, rtol=0.03)
    # From the middle of the gap, half of it at limit / ROTOR: until then the link rests.
    crossing = begin + round(np.sqrt(2 * 0.025 * ROTOR / 2.0) / STEP)
    assert np.ptp(position[: crossing - 1]) < 1e-6 < np.ptp(position[: crossing + 4])


# ----- the hidden effects of the synthetic robot, by the same C model


def hidden(command: np.ndarray, name: str, amplitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Recorded position and torque [T] of the synthetic robot's hidden effect, at its own time step."""
    scene = rigid(0.0)
    model = set_engine(copy.copy(scene.model), LONGEST_STEP)
    scene = replace(scene, model=instrument(replace(scene, model=model)))
    every = round(STEP / LONGEST_STEP)
    fine = np.interp(np.arange(len(command) * every) / every, np.arange(len(command)), command)
    rest = 8000  # rows before the log
    influence = HIDDEN[name].make(Place(scene, ("j",)), amplitude)
    edited = hooks.edited(scene.model, [influence])
    edited.dof_damping[:] = 3.0  # to rest
    control = np.concatenate([np.full(rest, command[0]), fine])[:, None]
    rows = []

    def loosen(live: Live) -> None:
        rows.append(live.position.copy())
        if len(rows) == rest:
            live.model.dof_damping[:] = DAMPED

    traces = hooks.step_through(edited, np.array([command[0]]), control, [Influence(step=loosen), influence])
    sensed = split(scene, traces[None])
    clock = np.arange(len(control)) * LONGEST_STEP
    assert influence.sense is not None
    signals = influence.sense(SensorInput(clock, sensed.torque[0], sensed.position[0]))
    return signals.position[rest::every, 0], signals.torque[rest::every, 0]


def test_the_hidden_free_play_is_backlash_of_two_bodies_in_c():
    command, gap = smooth_steps(0.5 * np.pi), 0.05
    ends = f'range="{-gap / 2} {gap / 2}" limited="true" solreflimit="5e-5 1" solimplimit="0.99 0.9999 1e-4"'
    _, link, torque = in_c(command, ends, 0.0)
    got, force = hidden(command, "free_play", gap)
    assert np.sqrt(np.mean((got - link) ** 2)) < 0.15 * gap
    assert np.sqrt(np.mean((force - torque) ** 2)) < 0.1 * np.sqrt(np.mean(torque**2))


def test_the_hidden_resonance_is_that_of_two_bodies_in_c():
    """Small twists: the hidden gear stiffens."""
    command, compliance = 0.1 * smooth_steps(), 0.002
    damper = 2.0 * GEAR_DAMPING * np.sqrt(ROTOR / compliance)
    motor, _, torque = in_c(command, f'stiffness="{1.0 / compliance}" damping="{damper}"', 0.0)
    got, force = hidden(command, "resonance", compliance)
    stiff, _ = replayed(rigid(0.0), {}, command, start=motor[0])
    assert np.abs(got - motor).max() < 0.1 * np.abs(stiff - motor).max()
    assert np.abs(force - torque).max() < 0.05 * np.abs(torque).max()
