"""`check`: its output and files, with a scene and without."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from two_link import ARM, JOINTS, MOTOR, arm, measured, motion, recording

from benchmarks.check_cases import RATE, played
from benchmarks.check_cases import measured as recorded_channels
from droid_jax.cost.cost import make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.identify.additions import Addition, MotionProposal, additions, motion_recording, propose
from droid_jax.identify.excitation import Excitation, ExcitationConfig, excitation, identifiability_of
from droid_jax.identify.holdout import beginning
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.preflight.inspect_log import contents
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Channel, Recording, ServoGains
from droid_jax.run import main


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(gravcomp='gravcomp="1"', friction="", sensor=""))
    return path


def wave(**changes: object) -> Recording:
    return recording(channels=measured(0.0), qpos0={}, **changes)


def found(folder: Path) -> list[tuple[str, str]]:
    """(kind, severity) of what check.json holds of its first recording."""
    whole = json.loads((folder / "check.json").read_text())
    assert whole["format"] == "droid_jax check 1"
    return [(f["kind"], f["severity"]) for f in whole["recordings"][0]["findings"]]


def test_contents():
    log = wave()
    position = replace(log.channels["position"], time=np.delete(np.arange(502) * 0.002, 200)[:501])
    position.mask[0, :100, 1] = False
    command, torque, channel = contents(replace(log, channels={**log.channels, "position": position}))
    assert (command.name, command.rows, command.gaps) == ("command", 501, 0) and command.rate == pytest.approx(500)
    assert torque.columns[0].unit == "N m" and torque.columns[0].measured == 1.0
    assert channel.longest == pytest.approx(0.004) and channel.jitter == pytest.approx(1.0)
    assert channel.columns[1].measured == pytest.approx(1 - 100 / 1002)
    seen = position.values[..., 1][position.mask[..., 1]]
    assert (channel.columns[1].low, channel.columns[1].high) == (seen.min(), seen.max())


def test_a_wrong_unit_is_on_the_terminal_in_the_page_and_in_the_json(
    tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]
):
    wrong = {**measured(0.0)}
    wrong["position"] = replace(wrong["position"], values=np.rad2deg(wrong["position"].values))
    path = save_recording(wave().__class__(**{**vars(wave()), "channels": wrong}), tmp_path / "wave.npz")
    out = tmp_path / "check"
    assert main(["check", "--recording", str(path), "--scene", str(scene), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "certain: " in said and "degrees" in said and f"page: {out / 'check.html'}" in said
    assert ("units", "certain") in found(out)
    page = (out / "check.html").read_text()
    assert "in degrees" in page and "<svg" in page and "shoulder" in page
    assert main(["check", "--recording", str(path), "--out", str(out)]) == 0  # again, without a scene
    assert ("units", "certain") not in found(out)
    assert "Without a scene: units, signs and gains were not checked" in (out / "check.html").read_text()


def test_commands_that_the_scene_lacks_are_said(tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]):
    names = {"shoulder": "lift", "elbow": "elbow"}
    log = wave(command_names=tuple(names.values()), gains=None)
    channels = {k: replace(c, columns=tuple(names[j] for j in c.columns)) for k, c in log.channels.items()}
    path = save_recording(replace(log, channels=channels), tmp_path / "wave.npz")
    assert main(["check", "--recording", str(path), "--scene", str(scene), "--out", str(tmp_path / "check")]) == 0
    assert "has no commands for shoulder" in " ".join(capsys.readouterr().out.split())


def test_a_scene_for_plain_c_alone_is_looked_at_too(tmp_path: Path, scene: Path):
    """Regression: it was refused, although `identify --engine mujoco` accepts it."""
    scene.write_text(scene.read_text().replace("<option ", '<option cone="elliptic" '))
    path = save_recording(wave(), tmp_path / "wave.npz")
    out = tmp_path / "check"
    assert main(["check", "--recording", str(path), "--scene", str(scene), "--out", str(out)]) == 0
    assert ("scene", "note") in found(out) and "--engine mujoco" in (out / "check.json").read_text()


def test_a_note_that_fails_is_a_finding_beside_the_others(tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch):
    wrong = {**measured(0.0)}
    wrong["position"] = replace(wrong["position"], values=np.rad2deg(wrong["position"].values))
    log = Recording(**{**vars(wave()), "channels": wrong})
    path, out = save_recording(log, tmp_path / "wave.npz"), tmp_path / "check"

    def failing(scene: Scene, recording: Recording) -> list[str]:
        warnings.warn("a limit is odd", stacklevel=2)
        raise ValueError("the gains cannot be compared")

    monkeypatch.setattr("droid_jax.preflight.inspect_log.command_notes", failing)
    assert main(["check", "--recording", str(path), "--scene", str(scene), "--out", str(out)]) == 0
    findings = json.loads((out / "check.json").read_text())["recordings"][0]["findings"]
    said = {f["sentence"]: f["severity"] for f in findings}
    assert said["the gains cannot be compared"] == "certain" and said["a limit is odd"] == "likely"
    assert ("units", "certain") in found(out) and "the gains cannot be compared" in (out / "check.html").read_text()


PARAMETERS = [
    *({"field": "dof_damping", "element": j, "unit": "N m s/rad", "std": 1.0, "high": 20.0} for j in JOINTS),
    *({"field": "dof_frictionloss", "element": j, "mean": 0.1, "std": 0.1, "high": 2.0} for j in JOINTS),
]


@pytest.fixture
def parameters(tmp_path: Path) -> Path:
    (tmp_path / "parameters.json").write_text(json.dumps(PARAMETERS))
    return tmp_path / "parameters.json"


@pytest.mark.parametrize(
    ("command", "next_step"),
    [("identify", "droid_jax.identify.pipeline.prepare"), ("gap", "droid_jax.preflight.search_inputs.assigned_roles")],
)
def test_a_certain_finding_stops_a_fit_before_anything_is_compiled(
    command: str, next_step: str, tmp_path: Path, scene: Path, parameters: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    log = wave()
    turned = replace(log.channels["position"], values=-log.channels["position"].values)
    path = save_recording(replace(log, channels={**log.channels, "position": turned}), tmp_path / "wave.npz")
    files = ["--recording", str(path), "--scene", str(scene), "--parameters", str(parameters)]
    call = [command, *files, "--out", str(tmp_path / "run")]

    def reached(*_: object, **__: object) -> None:
        raise ValueError("the fit would begin here")

    monkeypatch.setattr(next_step, reached)
    assert main(call) == 2
    said = capsys.readouterr()
    assert "runs against its command" in said.err and "or go on with --force" in said.err
    assert "compiling" not in said.out and not (tmp_path / "run").exists()
    assert main([*call, "--force"]) == 2
    assert "the fit would begin here" in capsys.readouterr().err


def poor() -> Recording:
    """The elbow stands still: its damping and friction are not identifiable."""
    time, command = motion(3.0, RATE)
    command = command * [0.2, 0.0] + [0.0, -0.3]
    model = mujoco.MjModel.from_xml_string(
        ARM.format(gravcomp='gravcomp="1"', friction='frictionloss="0.2"', sensor="")
    )
    model.opt.timestep = 1.0 / (4 * RATE)
    torque, position = played(model, command[:, ::-1], command[0])
    channels = recorded_channels(time, torque, position, 1, np.random.default_rng(0))
    start = dict(zip(JOINTS, command[0].tolist(), strict=True))
    return recording(time=time, command=command, channels={"position": channels["position"]}, qpos0=start)


def test_what_a_motion_tells_and_what_would_tell_the_rest(
    tmp_path: Path, scene: Path, parameters: Path, capsys: pytest.CaptureFixture[str]
):
    path = save_recording(poor(), tmp_path / "wave.npz")
    out = tmp_path / "check"
    files = ["--recording", str(path), "--scene", str(scene), "--parameters", str(parameters)]
    assert main(["check", *files, "--out", str(out)]) == 0
    excitation = json.loads((out / "check.json").read_text())["excitation"]
    assert excitation["engine"] == "mujoco"
    open_ones = {p["name"] for p in excitation["parameters"] if not p["identifiable"]}
    assert open_ones == {"elbow_damping"} == {*excitation["identifiable_by_it"]} and excitation["left_open"] == []
    assert excitation["addition"]
    said = " ".join(capsys.readouterr().out.split())
    assert "Identifiability of the parameters" in said and "also record" in said
    assert excitation["sentence"] in (out / "check.html").read_text()
    table = np.genfromtxt(out / "addition.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time", *JOINTS)
    assert np.all(np.diff(table["time"]) > 0) and np.ptp([*table["shoulder"], *table["elbow"] + 0.3]) > 0.05
    assert [table[j][k] for j in JOINTS for k in (0, -1)] == pytest.approx([0.0, 0.0, -0.3, -0.3])


def test_a_motion_that_is_proposed_several_times_is_said_once():
    ramp, steps = (Addition(what, "elbow", np.arange(7.0), np.zeros(7)) for what in ("a slow ramp", "steps"))
    proposal = MotionProposal((ramp, steps, ramp), (), ("mass",), (), ("elbow",), np.zeros(1), 2)
    assert proposal.sentence == "To make mass identifiable, also record 2 times a slow ramp, steps: 18 s."


def with_open_parameters(scene: Scene) -> tuple[Space, Excitation]:
    """Damping of the arm's joints, of which nothing is known."""
    space = Space(tuple(joint_damping(scene, j, std=1.0, high=20.0) for j in JOINTS))
    config, none = ExcitationConfig(), np.zeros((2, 2))
    verdicts = identifiability_of(space, none, config.identifiability)
    return space, Excitation(space, space.mean, none, np.ones(2), verdicts, {}, config, "mujoco", 0.0)


def test_why_no_motion_is_proposed_is_said(monkeypatch: pytest.MonkeyPatch):
    """Regression: a grasped object was given as the reason in any case, and a failed replay lost all findings."""
    servos = arm()
    space, found = with_open_parameters(servos)
    spec = servos.spec.copy()
    for actuator in spec.actuators:
        actuator.biasprm[1] = 0.0
    motors = compile_scene(spec, "motors", joints=JOINTS)
    bare = wave(command=np.zeros((0, 0)), command_names=(), time=np.zeros(0), gains=None)
    unmeasured = replace(bare, channels={"torque": bare.channels["torque"]})
    for scene, log, why in (
        (motors, wave(), "the commands go to no position servo"),
        (servos, unmeasured, "no joint's position was measured where the recording begins"),
        (replace(servos, object_joint="elbow"), wave(), "a hand holds an object"),
    ):
        said = propose(scene, space, found, log).sentence
        assert said.startswith(f"Not identifiable: {', '.join(found.open)}. No motion is proposed: {why}")

    def failing(*_: object, **__: object) -> None:
        raise ValueError("the time step is too long")

    monkeypatch.setattr("droid_jax.identify.additions.make_cost", failing)
    proposal = propose(servos, space, found, wave())
    assert "cannot be replayed (the time step is too long)" in proposal.sentence and proposal.left == found.open


def test_steps_are_no_larger_than_said_and_stay_within_the_torque_limit():
    """Regression: the largest step was 1.5 times the stated one, and torque limits were ignored."""

    def jump(scene: Scene, log: Recording) -> float:
        (steps,) = (a for a in additions(scene, log) if a.what.startswith("steps of elbow"))
        assert f"({np.abs(np.diff(steps.path)).max():.2g} rad)" in steps.what
        return float(np.abs(np.diff(steps.path)).max())

    spec = arm().spec.copy()
    for actuator in spec.actuators:
        actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-5.0, 5.0]
    limited = compile_scene(spec, "limited", joints=JOINTS)
    assert jump(arm(), wave()) == pytest.approx(0.3)
    assert jump(limited, wave(gains=None)) == pytest.approx(0.5 * 5.0 / 25.0)
    assert jump(limited, wave(gains=ServoGains(np.array([60.0, 50.0]), np.zeros(2)))) == pytest.approx(0.05)


def test_a_beginning_that_stands_still_is_looked_at_for_longer():
    """Regression: of a log that begins at rest, only motion up to half of its range was used."""
    time = np.arange(0.0, 60.0, 0.01)
    went = 0.3 * np.sin(np.maximum(time - 19.0, 0.0))[:, None] * np.ones(2)
    log = recording(time=time, command=went, channels=recording().channels)
    assert beginning(log, 20.0).duration == pytest.approx(39.0, abs=0.05)
    moving = recording(time=time, command=0.3 * np.sin(time)[:, None] * np.ones(2), channels=recording().channels)
    assert beginning(moving, 20.0).duration == pytest.approx(20.0, abs=0.05)


def test_a_slide_goes_as_far_as_its_own_motion_beside_a_sample_that_is_missing():
    """Regression: it was moved through 90 % of its whole range."""
    xml = """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" range="-2 2" limited="true"/>
    <geom size=".1" mass="1"/></body></worldbody></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "slide", joints=["x"])
    time = np.arange(0.0, 5.0, 0.01)
    values, mask = 0.05 * (1 - np.cos(time))[None, :, None], np.ones((1, len(time), 1), bool)
    values[0, 50], mask[0, 50] = np.nan, False
    position = Channel("position", "m", ("x",), time, values, mask)
    log = Recording("slide", np.zeros(0), np.zeros((0, 0)), (), {"position": position}, MOTOR)
    assert max(np.abs(a.path).max() for a in additions(scene, log)) < 0.1


GANTRY = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0" range="0 0.4"
  limited="true"/><geom size=".1" mass="1"/><body><joint name="tool" axis="0 0 1" damping="1"/><geom size=".05"
  pos=".1 0 0" mass=".1"/></body></body></worldbody><actuator><position name="x" joint="x" kp="500" gear="50"/>
  <motor name="tool" joint="tool"/></actuator></mujoco>"""


def gantry_log() -> Recording:
    """A geared slide that moves from 0.1 to 0.2 m, and a motor whose command is a torque."""
    time = np.arange(0.0, 5.0, 0.01)
    moved = 0.15 - 0.05 * np.cos(time)
    command = np.column_stack([50 * moved, np.full(len(time), 20.0)])
    values = np.column_stack([moved, 0.01 * time])[None]
    position = Channel("position", "rad or m", ("x", "tool"), time, values, np.ones(values.shape, bool))
    return Recording(
        "gantry", time, command, ("x", "tool"), {"position": position}, MOTOR, qpos0={"x": 0.1, "tool": 0.0}
    )


def test_proposed_motions_of_a_geared_slide_are_in_its_own_unit():
    """Regressions: they were longer by the gear, and a motor's command became the position that a replay begins at."""
    scene = compile_scene(mujoco.MjSpec.from_string(GANTRY), "gantry", joints=["x", "tool"])
    log = gantry_log()
    tried = additions(scene, log)
    assert {a.joint for a in tried} == {"x"} and max(np.ptp(a.path) for a in tried) < 50 * 0.25
    made = motion_recording(scene, log, tried[0], "made")
    assert made.qpos0 == pytest.approx({"x": 0.1, "tool": 0.0})
    space = Space((joint_damping(scene, "x", std=1.0, high=9.0), joint_damping(scene, "tool", std=0.5, high=9.0)))
    positions = CompareConfig(channels={"position": 1.0})
    cost = make_cost(scene, space, made, config=positions, check=False)  # its placeholders are inside the ranges
    assert np.isfinite(cost(space.mean[None])).all()


def test_a_proposed_motion_may_leave_a_torque_constant():
    """Regression: the torque of a vertical slide beside one that moves was taken for a dead sensor."""
    xml = """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
    <geom size=".1" mass="1"/><body><joint name="z" type="slide" axis="0 0 1" range="-1 1" limited="true"/>
    <geom size=".1" mass=".7"/></body></body></worldbody></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "gantry", joints=["x", "z"])
    time = np.arange(0.0, 5.0, 0.01)
    moved = np.column_stack([0.1 * (1 - np.cos(time)), 0.1 * (1 - np.cos(2 * time))])[None]
    force = np.column_stack([0.17 * np.cos(time), 6.87 + 0.28 * np.cos(2 * time)])[None]
    force = force + np.random.default_rng(0).normal(scale=0.01, size=force.shape)
    every = np.ones(moved.shape, bool)
    channels = {
        "position": Channel("position", "m", ("x", "z"), time, moved, every),
        "torque": Channel("torque", "N", ("x", "z"), time, force, every),
    }
    log = Recording("gantry", np.zeros(0), np.zeros((0, 0)), (), channels, replace(MOTOR, gravity=True))
    space = Space((joint_damping(scene, "x", std=1.0, high=9.0), joint_damping(scene, "z", std=1.0, high=9.0)))
    found = excitation(scene, space, [log])
    nothing = identifiability_of(space, np.zeros((2, 2)), found.config.identifiability)
    proposal = propose(scene, space, replace(found, identifiability=nothing), log)
    assert proposal.tried > 0 and proposal.why == ""


def test_a_beginning_ends_when_the_last_joint_has_moved():
    """Regression: it ended at the command's step, so that the joint's position was constant, which is refused."""
    time = np.arange(0.0, 60.0, 0.01)
    command = np.column_stack([0.3 * np.sin(time), np.where(time < 30.0, 0.0, 0.5)])
    values = np.where(np.arange(2) == 0, command, np.roll(command, 5, axis=0))[None]
    late = time[time >= 35.0]
    channels = {
        "position": Channel("position", "rad", JOINTS, time, values, np.ones(values.shape, bool)),
        "torque": Channel("torque", "N m", JOINTS, late, np.ones((1, len(late), 2)), np.ones((1, len(late), 2), bool)),
    }
    log = recording(time=time, command=command, channels={"position": channels["position"]})
    assert np.ptp(beginning(log, 20.0).channels["position"].values[0, :, 1]) == pytest.approx(0.5)
    assert beginning(replace(log, channels=channels), 20.0).span[1] == pytest.approx(36.0)


def test_bad_calls(tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]):
    path = save_recording(wave(), tmp_path / "wave.npz")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "check.json").write_text("dear")
    for arguments, said in (
        ([], "check needs --recording"),
        (["--recording", str(path), "--joints", "elbow"], "give --scene too"),
        (["--recording", str(tmp_path / "no.npz")], "there is no such file or folder"),
        (["--recording", str(path), "--out", str(tmp_path / "mine")], "was not written by this program"),
    ):
        assert main(["check", *arguments]) == 2
        assert said in capsys.readouterr().err
