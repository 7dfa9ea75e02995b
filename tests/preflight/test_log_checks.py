"""Wrong units, signs, orders, clocks and copies are named; correct logs give no findings."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from two_link import arm

from benchmarks.check_cases import JOINTS, RATE, magnitude, measured, played
from droid_jax.cost.cost import make_cost
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.preflight.check_log import check_alone, check_log
from droid_jax.preflight.torques import fitting_order
from droid_jax.recordings.recording import Channel, Recording, ServoGains, TorqueConvention, TorqueSide

REPEATS = 3
SIZE = 0.12  # rad, of the small motion: seven degrees
SENT = np.array([[0.21, 0.47], [0.33, 0.59]])  # Hz, of two sines for each joint


@functools.cache
def scene(gravcomp: bool = False) -> Scene:
    return arm(gravcomp=gravcomp)


def path(seconds: float, size: float = SIZE) -> tuple[np.ndarray, np.ndarray]:
    time = np.arange(0.0, seconds, 1.0 / RATE)
    ease = np.clip(time / 1.0, 0, 1)[:, None] ** 2
    waves = np.sin(2 * np.pi * SENT[:, :, None] * time + np.array([0.0, 0.7])[:, None]) - np.sin(
        np.array([0.0, 0.7])[:, None] * np.ones((2, 2, 1))
    )
    return time, size * ease * waves.sum(axis=1).T + np.array([0.1, -0.3])


@functools.cache
def recording(gravcomp: bool = False, commands: bool = True, size: float = SIZE, seconds: float = 12.0) -> Recording:
    """The arm with other masses, damping and friction than the scene's, in C, with noise; motor side."""
    model = mujoco.MjModel.from_xml_string(scene(gravcomp).spec.to_xml())
    model.body_mass[1:] *= np.array([1.3, 0.8])
    model.body_inertia[1:] *= np.array([1.3, 0.8])[:, None]
    model.dof_damping[:] = 2.0, 1.6
    model.dof_frictionloss[:] = 0.1, 0.2
    model.opt.timestep = 1.0 / (RATE * 4)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    time, command = path(seconds, size)
    control = command[:, ::-1]  # the scene's actuators stand in the other order
    channels = measured(time, *played(model, control, command[0]), REPEATS, np.random.default_rng(4))
    gains = ServoGains(np.array([60.0, 25.0]), np.zeros(2)) if commands else None
    none = np.zeros((0, 0))
    return Recording(
        "log",
        time if commands else np.zeros(0),
        command if commands else none,
        JOINTS if commands else (),
        channels,
        TorqueConvention(TorqueSide.MOTOR, gravity=not gravcomp),
        qpos0={},
        gains=gains,
    )


Change = Callable[[Recording], Recording]


def of_channel(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def changed(r: Recording) -> Recording:
        channel = replace(r.channels[name], values=change(r.channels[name].values))
        return replace(r, channels={**r.channels, name: channel})

    return changed


def sign(name: str, column: int) -> Change:
    turn = np.where(np.arange(2) == column, -1.0, 1.0)
    if name == "command":
        return lambda r: replace(r, command=r.command * turn)
    return of_channel(name, lambda v: v * turn)


def degrees(r: Recording) -> Recording:
    wrong = of_channel("position", np.rad2deg)(r)
    return replace(wrong, command=np.rad2deg(r.command)) if r.command.size else wrong


def found(r: Recording, gravcomp: bool = False) -> list[tuple[str, str]]:
    return [(f.kind, f.column) for f in check_log(scene(gravcomp), r)]


@pytest.mark.parametrize("gravcomp", [False, True])
@pytest.mark.parametrize("commands", [True, False])
@pytest.mark.parametrize("size", [SIZE, 5 * SIZE])
def test_what_is_right_raises_nothing(gravcomp: bool, commands: bool, size: float):
    """Masses, damping and friction differ from the scene's."""
    fine = recording(gravcomp, commands, size)
    assert check_log(scene(gravcomp), fine) == ()
    alone = fine.repeats_subset([0])
    assert check_log(scene(gravcomp), alone) == ()
    if commands:
        blind = replace(
            fine, channels={"torque": fine.channels["torque"]}, qpos0=dict(zip(JOINTS, (0.1, -0.3), strict=True))
        )
        assert check_log(scene(gravcomp), blind) == ()


@pytest.mark.parametrize("commands", [True, False])
@pytest.mark.parametrize("size", [0.3 * SIZE, SIZE])
def test_degrees_of_a_small_motion(commands: bool, size: float):
    """The larger position is 14 degrees at most: below four turns if it were radians, and slow."""
    findings = check_log(scene(), degrees(recording(commands=commands, size=size)))
    assert findings and findings[0].kind == "units"
    assert any("degrees" in f.sentence for f in findings)


@pytest.mark.parametrize("factor", [1000.0, 0.1, 1 / 12, 1 / 8])
@pytest.mark.parametrize("commands", [True, False])
def test_torques_in_another_unit(commands: bool, factor: float):
    findings = check_log(scene(), of_channel("torque", lambda v: factor * v)(recording(commands=commands)))
    assert findings and {f.kind for f in findings} == {"units"}
    assert all(0.5 < f.value / factor < 2.0 for f in findings)
    assert any(("milliamperes" if factor > 1 else "amperes") in f.sentence for f in findings)
    assert "--torque-constant" in findings[0].sentence


def test_each_joints_own_torque_constant():
    constants = np.array([1 / 8, 1 / 12])
    findings = check_log(scene(), of_channel("torque", lambda v: v * constants)(recording()))
    assert {f.column for f in findings} == set(JOINTS)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("what", ["torque", "position", "command"])
def test_one_joints_wrong_sign(what: str, joint: int):
    assert found(sign(what, joint)(recording())) == [("sign", JOINTS[joint])]


@pytest.mark.parametrize("joint", [0, 1])
def test_one_joints_wrong_sign_in_a_log_without_commands(joint: int):
    assert ("sign", JOINTS[joint]) in found(sign("torque", joint)(recording(commands=False)))


def test_all_torques_of_the_other_sign():
    assert found(of_channel("torque", np.negative)(recording())) == [("sign", j) for j in JOINTS]


@pytest.mark.parametrize("what", ["torque", "position", "command"])
def test_columns_in_another_order(what: str):
    if what == "command":
        wrong = replace(recording(), command=recording().command[:, ::-1])
    else:
        wrong = of_channel(what, lambda v: v[..., ::-1])(recording())
    assert [kind for kind, _ in found(wrong)] == ["order"]


@pytest.mark.parametrize("what", ["torque", "position"])
def test_columns_in_another_order_of_a_log_without_commands(what: str):
    wrong = of_channel(what, lambda v: v[..., ::-1])(recording(commands=False, size=5 * SIZE))
    (finding,) = check_log(scene(), wrong)
    assert finding.kind == "order" and "exchanged" in finding.sentence


def test_an_order_that_fits_better_is_named_of_three_joints():
    """Column i holds joint i + 1: exchanging two columns does not correct that."""
    left = {
        "a": {"a": 0.9, "b": 0.02, "c": 0.8},
        "b": {"a": 0.7, "b": 0.9, "c": 0.03},
        "c": {"a": 0.01, "b": 0.9, "c": 1},
    }
    assert fitting_order(left) == {"a": "b", "b": "c", "c": "a"}


@pytest.mark.parametrize("size", [1.0, 200.0])
def test_a_load_register_for_a_torque(size: float):
    """With the other sign, and possibly in per mille."""
    register = of_channel("torque", lambda v: -size * v)(recording(size=5 * SIZE))
    findings = check_log(scene(), register)
    assert findings and all(f.kind == "sign" and "load register" in f.sentence for f in findings)
    one = sign("torque", 1)(recording(size=5 * SIZE))
    assert not any("load register" in f.sentence for f in check_log(scene(), one))


@pytest.mark.parametrize("commands", [True, False])
def test_a_recording_in_which_nothing_moves(commands: bool):
    fine = recording(commands=commands)
    still = {k: replace(c, values=c.values - c.values.mean(axis=0) + c.values[:, :1]) for k, c in fine.channels.items()}
    wrong = replace(fine, channels=still, command=np.repeat(fine.command[:1], len(fine.command), axis=0))
    (finding,) = [f for f in check_alone(wrong) if f.kind == "motion"]
    assert finding.severity == "certain" and "nothing moves" in finding.sentence
    moving = replace(wrong, channels=fine.channels)
    assert not any(f.kind == "motion" for r in (fine, moving) for f in check_alone(r))


def test_stamps_that_are_no_seconds_and_gaps_in_them():
    fine = recording()
    stretched = {k: replace(c, time=125.0 * c.time) for k, c in fine.channels.items()}  # milliseconds of 2 kHz
    (finding,) = check_alone(replace(fine, channels=stretched, time=125.0 * fine.time))
    assert (finding.kind, finding.severity) == ("clock", "certain") and "milliseconds" in finding.sentence
    c = fine.channels["position"]
    keep = np.abs(c.time - 6.0) > 0.05
    silent = replace(c, time=c.time[keep], values=c.values[:, keep], mask=c.mask[:, keep])
    (gap,) = check_alone(replace(fine, channels={**fine.channels, "position": silent}))
    assert gap.severity == "note" and "'position' has a gap in time, the longest of 0.1 s at 5.9" in gap.sentence


def test_slow_clocks_beside_a_usual_one_are_no_milliseconds():
    """Regression: set-points half a second apart, and a temperature, were certain to be in milliseconds."""
    fine = recording()
    rows = np.arange(0.0, 11.9, 0.5)
    slow = Channel(
        "temperature", "K", JOINTS, rows, np.ones((REPEATS, len(rows), 2)), np.ones((REPEATS, len(rows), 2), bool)
    )
    sparse = replace(fine, time=rows, command=fine.command[:: round(RATE / 2)][: len(rows)])
    warm = replace(fine, channels={**fine.channels, "temperature": slow})
    for valid in (sparse, warm):
        assert not [f for f in check_alone(valid) if f.kind == "clock"]
    for wrong in (replace(fine, time=1e3 * fine.time), replace(sparse, time=1e3 * rows)):
        (finding,) = [f for f in check_alone(wrong) if f.kind == "clock"]
        assert "the steps of the commands" in finding.sentence and "milliseconds" in finding.sentence


@pytest.mark.parametrize("gravcomp", [False, True])
@pytest.mark.parametrize("commands", [True, False])
def test_weight_that_the_torque_does_not_hold_or_does(gravcomp: bool, commands: bool):
    fine = recording(gravcomp, commands, 5 * SIZE)
    wrong = replace(fine, torque=replace(fine.torque, gravity=not fine.torque.gravity))
    if commands and not gravcomp:  # refused: nothing in the scene would carry it
        with pytest.raises(ValueError, match="excludes gravity"):
            make_cost(scene(), space(), [wrong])
        return
    assert [kind for kind, _ in found(wrong, gravcomp)] == ["gravity"]


def space() -> Space:
    return Space((joint_damping(scene(), "elbow", name="elbow_damping", std=0.1, high=50.0),))


def test_copies_of_one_repeat():
    copies = recording().repeats_subset([0, 1, 0, 2, 1])
    (finding,) = check_log(scene(), copies)
    assert finding.kind == "repeats" and "repeats 0 and 2, 1 and 4 are identical: are they copies" in finding.sentence
    single = {k: replace(c, values=c.values.astype(np.float32)) for k, c in recording().channels.items()}
    assert found(replace(recording(), channels=single)) == []


def test_a_position_that_does_not_move():
    dead = of_channel("position", lambda v: np.where(np.arange(2) == 1, 0.0, v))(recording())
    assert ("sensor", "elbow") in found(dead)
    coarse = of_channel("torque", lambda v: np.round(v / 4.0) * 4.0)(recording())
    assert ("sensor", "elbow") in found(coarse)


TURNING = np.arange(0.0, 12.0, 0.01)


def wheel() -> Scene:
    xml = """<mujoco><worldbody><body><joint name="wheel" axis="0 0 1" armature="0.01" damping="1"/>
    <geom size=".1" mass="0.1"/></body></worldbody><actuator><position joint="wheel" kp="50"/></actuator></mujoco>"""
    return compile_scene(mujoco.MjSpec.from_string(xml), "wheel", joints=["wheel"])


def turning(sent: np.ndarray, went: np.ndarray) -> Recording:
    position = Channel("position", "rad", ("wheel",), TURNING, went[None, :, None], np.ones((1, len(TURNING), 1), bool))
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    return Recording("turns", TURNING, sent[:, None], ("wheel",), {"position": position}, convention)


@pytest.mark.parametrize("what", ["position", "command"])
def test_an_angle_that_counts_within_one_turn(what: str):
    """Regression: the position was found to have the wrong sign."""
    signals = {"command": np.pi + 0.3 * np.sin(2 * np.pi * 0.2 * TURNING)}
    signals["position"] = np.interp(TURNING - 0.02, TURNING, signals["command"])
    assert not any(f.kind == "units" for f in check_log(wheel(), turning(signals["command"], signals["position"])))
    signals[what] = (signals[what] + np.pi) % (2 * np.pi) - np.pi
    (finding,) = check_log(wheel(), turning(signals["command"], signals["position"]))
    assert finding.severity == "certain" and f"the {what} of wheel jumps by one turn" in finding.sentence


def test_a_command_that_turns_once_is_no_jump_of_the_log():
    went = 2 * np.pi * np.clip((TURNING - 5.0) / 1.0, 0.0, 1.0)
    found = check_log(wheel(), turning(np.where(TURNING < 5.0, 0.0, 2 * np.pi), went))
    assert not any(f.kind == "units" for f in found)


def test_a_nominal_rate_beside_stamps():
    """Positions at 4.012 ms, commands played back at the nominal 4 ms."""
    fine = recording(seconds=60.0)
    stamped = {k: replace(c, time=1.003 * c.time) for k, c in fine.channels.items()}
    (finding,) = check_log(scene(), replace(fine, channels=stamped))
    assert finding.kind == "clock" and "4.012 ms where these are at 4 ms, 0.18 s apart" in finding.sentence
    cut = {k: replace(c, time=c.time[:-9], values=c.values[:, :-9], mask=c.mask[:, :-9]) for k, c in stamped.items()}
    (finding,) = check_log(scene(), replace(fine, channels=cut))
    assert finding.kind == "clock" and "0.18 s" in finding.sentence.replace("0.17 s", "0.18 s")
    noted = replace(fine, meta={"rate_hz": "249"})
    (finding,) = check_log(scene(), noted)
    assert finding.kind == "clock" and "stated 249 Hz; the stamps are used" in finding.sentence


def test_a_cost_warns_of_it_and_goes_on():
    with pytest.warns(UserWarning, match="position of elbow runs against its command") as said:
        make_cost(scene(), space(), [sign("position", 1)(recording())])
    assert len([w for w in said if "runs against" in str(w.message)]) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_cost(scene(), space(), [sign("position", 1)(recording())], check=False)
        make_cost(scene(), space(), [recording()])


def positions_alone(r: Recording) -> Recording:
    """The log without its torques."""
    return replace(r, channels={"position": r.channels["position"]})


@pytest.mark.parametrize("gravcomp", [False, True])
@pytest.mark.parametrize("size", [SIZE, 5 * SIZE])
def test_what_is_right_raises_nothing_without_torques(gravcomp: bool, size: float):
    assert check_log(scene(gravcomp), positions_alone(recording(gravcomp, size=size))) == ()


def test_degrees_of_positions_and_commands_without_torques():
    """The servo's torque at the tracking error would be sixty times that of the arm's motion."""
    (finding,) = check_log(scene(), degrees(positions_alone(recording(size=0.3 * SIZE))))
    assert finding.kind == "units" and "are these degrees?" in finding.sentence


def stronger(factor: float) -> Scene:
    """The arm with other servo gains than the robot had."""
    spec = scene().spec.copy()
    for actuator in spec.actuators:
        actuator.gainprm[0] *= factor
        actuator.biasprm[1] *= factor
    return compile_scene(spec, "other", joints=JOINTS)


@pytest.mark.parametrize("factor", [200.0, 10.0])
def test_gains_that_the_recording_states_count(factor: float):
    """Regression: the scene's gains were used, so that correct torques were found to be wrong."""
    fine = recording(size=5 * SIZE)
    for log in (fine, positions_alone(fine)):
        assert check_log(stronger(factor), log) == ()
        assert check_log(stronger(factor), replace(log, gains=None)) != ()


@pytest.mark.parametrize("factor", [10.0, 0.1])
def test_gains_of_another_robot_without_torques(factor: float):
    unstated = replace(positions_alone(recording(size=5 * SIZE)), gains=None)
    (finding,) = check_log(stronger(factor), unstated)
    assert finding.kind == "gains" and 0.5 < finding.value / factor < 2.0
    assert "are these gains the robot's?" in finding.sentence


@pytest.mark.parametrize("late", [0.04, 0.08])
def test_a_delay_is_said(late: float):
    shifted = {k: replace(c, time=c.time + late) for k, c in recording().channels.items()}
    (finding,) = check_log(scene(), replace(recording(), channels=shifted))
    assert (finding.kind, finding.severity) == ("delay", "note") and finding.value == pytest.approx(late, abs=0.01)


def test_a_torque_at_its_limit_is_said():
    limit = 0.6 * float(recording().channels["torque"].values[..., 1].max())
    cut = of_channel("torque", lambda v: np.clip(v, -np.inf, [np.inf, limit]))(recording())
    (finding,) = [f for f in check_log(scene(), cut) if f.kind == "saturation"]
    assert (finding.column, finding.value) == ("elbow", limit) and "stays at" in finding.sentence
    assert [f for f in check_log(scene(), recording()) if f.kind == "saturation"] == []


def test_torques_without_their_sign_are_a_load_register():
    unsigned = of_channel("torque", magnitude)(recording(True, size=5 * SIZE))
    (finding,) = check_alone(unsigned)
    assert (finding.kind, finding.severity) == ("sign", "likely") and "load register" in finding.sentence
    assert finding.sentence.count("shoulder, elbow") == 1


def test_a_dead_column_of_a_log_without_commands():
    still = of_channel("position", lambda v: v * np.array([1.0, 0.0]))(recording(commands=False))
    said = [f for f in check_alone(still) if f.kind == "sensor"]
    assert [f.column for f in said] == ["elbow"] and "the position of elbow does not move" in said[0].sentence
    silent = of_channel("torque", lambda v: v * np.array([0.0, 1.0]))(recording(commands=False))
    (finding,) = check_alone(silent)
    assert "the torque of shoulder does not move" in finding.sentence and finding.severity == "likely"


def hinge(spring: float = 0.0, mass: float = 0.01) -> Scene:
    """A door: friction holds it back, its weight does not act."""
    xml = f"""<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="hinge" axis="0 0 1" frictionloss="1"
    stiffness="{spring}"/><geom type="box" pos=".15 0 0" size=".15 .01 .2" mass="{mass}"/></body></worldbody>
    </mujoco>"""
    return compile_scene(mujoco.MjSpec.from_string(xml), "door", joints=["hinge"])


def opened(factor: float, inertia: float = 0.0, uneven: float = 1.2) -> Recording:
    """It is opened slowly against an uneven friction, and closed; the torque times a factor, with noise."""
    time = np.arange(0.0, 10.0, 0.01)
    w, swing = 0.2 * np.pi, 0.5
    angle, speed = swing * (1 - np.cos(w * time)), swing * w * np.sin(w * time)
    force = np.sign(speed) * (1.0 + uneven * np.sin(20.0 * angle)) + inertia * swing * w**2 * np.cos(w * time)
    rng = np.random.default_rng(0)
    columns = (("position", "rad", angle, 1e-4), ("torque", "N m", force, 0.05))
    channels = {
        name: Channel(
            name, unit, ("hinge",), time, (clean + rng.normal(0, noise, len(time)))[None, :, None] * size,
            np.ones((1, len(time), 1), bool),
        )
        for (name, unit, clean, noise), size in zip(columns, (1.0, factor), strict=True)
    }  # fmt: skip
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    return Recording("door", np.zeros(0), np.zeros((0, 0)), (), channels, convention, qpos0={})


def test_friction_takes_work():
    assert check_log(hinge(), opened(1.0)) == ()
    assert check_log(hinge(), opened(9.0)) == ()  # the scene's friction is a guess
    (turned,) = check_log(hinge(), opened(-1.0))
    assert (turned.kind, turned.column, turned.severity) == ("sign", "hinge", "likely")
    assert "works against the motion" in turned.sentence
    assert check_log(hinge(spring=5.0), opened(-1.0)) == ()  # a spring may drive it


def test_a_torque_a_thousand_times_the_friction():
    (milli,) = check_log(hinge(), opened(1000.0))
    assert (milli.kind, milli.severity) == ("units", "likely") and "milliamperes" in milli.sentence


def test_a_small_inertia_beside_friction_in_another_unit():
    """Friction is a free parameter, and the remaining torque is too small to count as unexplained."""
    heavy = hinge(mass=3.0 / 0.03)
    assert check_log(heavy, opened(1.0, 3.0, 0.05)) == ()
    (milli,) = check_log(heavy, opened(1000.0, 3.0, 0.05))
    assert milli.kind == "units" and "times what the motion needs: are these milliamperes" in milli.sentence


def test_a_column_that_was_never_measured_is_no_dead_one():
    """A driver without that sensor writes nothing there; the joint's other channels move."""
    right = recording()
    torque = right.channels["torque"]
    mask = torque.mask.copy()
    mask[..., 0] = False
    found = check_alone(replace(right, channels={**right.channels, "torque": replace(torque, mask=mask)}))
    assert not [f for f in found if f.kind == "sensor"]
