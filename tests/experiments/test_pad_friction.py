"""Parts of the pads' torque: they add up to the engine's, and each has the meaning of its name."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np
import pytest

from droid_jax.door.demonstration import PLANS, joint_path
from droid_jax.door.scene import door_scene
from droid_jax.door.task import Task
from droid_jax.synthetic.policy_trials import PolicyRobot, TransferConfig, synthetic_robot
from droid_jax.synthetic.robot import synthetic_truth
from experiments.pad_friction import NEEDED, PARTS, Arguments, Opening, hinge_torques, made, needless
from experiments.policies.robots import pads_of
from experiments.policies.settings import SETTINGS, setting_of

EXACT = 1e-9  # N m and J, of sums of a few N m
CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL)
SHUT, PULL = 15, 60  # actions: the fingers close, the hand follows the door's arc by 20 degrees and turns with it
KNOB = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="hinge" type="hinge" axis="0 0 -1" stiffness="500" damping="50"/>
      <geom name="knob" type="capsule" fromto="-0.022 -0.3 0 0.028 -0.3 0" size="0.012" mass="0.2"/>
    </body>
    <body pos="{pos}">
      <joint name="finger" type="slide" axis="{axis}" damping="20"/>
      <geom type="{shape}" size="0.0005 0.0005 0.0005" mass="0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


def around_the_knob(pads: dict[str, float]) -> PolicyRobot:
    """A robot whose open hand is around the knob."""
    scene, task = door_scene(limits=True), Task(opened=float(np.deg2rad(10.0)))
    arm = dict(zip(scene.joints, joint_path(scene, PLANS["A"], np.zeros(1), np.zeros(1))[0], strict=True))
    start = scene.initial_qpos({**arm, **dict.fromkeys(scene.finger_joints, 0.02)})
    return synthetic_robot(scene, start, {**synthetic_truth(scene, 0, 0), **pads}, (), task, TransferConfig())


def of_contacts(model: mujoco.MjModel, data: mujoco.MjData, dof: int) -> float:
    """N m of all constraints on a joint without its own, friction loss and limit."""
    own = np.zeros(model.nv)
    mujoco.mj_mulJacTVec(model, data, own, np.where(data.efc_type == CONTACT, 0.0, data.efc_force))
    return float(data.qfrc_constraint[dof] - own[dof])


def opened(pads: dict[str, float]) -> tuple[Opening, np.ndarray, np.ndarray]:
    """A scripted opening; [T] N m of the pads on the hinge as found and as the engine has it until the door is open."""
    robot = around_the_knob(pads)
    model, scene = robot.scene.model, robot.scene
    knob, hinge, q = scene.id("geom", "knob"), scene.id("joint", "hinge"), scene.qpos("hinge")
    data, opening = mujoco.MjData(model), Opening(robot)
    data.qpos[:] = robot.start
    mujoco.mj_forward(model, data)
    opening(data)
    angles = np.concatenate([np.zeros(SHUT), np.linspace(0.0, np.deg2rad(20.0), PULL)])
    seen: list[tuple[float, float, float]] = []
    for arm in joint_path(scene, PLANS["A"], angles, np.zeros(SHUT + PULL)):
        data.ctrl[:] = np.append(arm, [0.0, 0.0])
        for _ in range(40):
            before = data.qpos[q]
            mujoco.mj_step(model, data)
            moved = 0.0 if before >= robot.task.opened else data.qpos[q] - before
            found = hinge_torques(model, data, knob, hinge).sum()
            seen.append((found, of_contacts(model, data, model.jnt_dofadr[hinge]), moved))
        opening(data)
    found, engine, moved = np.array(seen).T
    assert opening.work.sum() == pytest.approx((engine * moved).sum(), abs=EXACT)
    return opening, found, engine


@pytest.mark.slow
@pytest.mark.parametrize("pads", [{}, pads_of(0.05)], ids=["own", "slippery"])
def test_the_parts_add_up_to_the_torque_of_the_engines_contacts(pads):
    opening, found, engine = opened(pads)
    assert np.abs(engine).max() > 0.2
    np.testing.assert_allclose(found, engine, rtol=0.0, atol=EXACT)
    assert opening.opened and opening.way >= np.deg2rad(10.0)
    assert opening.held == pytest.approx(opening.way, rel=0.05)


def test_a_hand_that_turns_with_the_door_opens_it_without_friction():
    """It turns the knob between the pads, by normal forces of the grip alone."""
    opening, _, _ = opened(pads_of(0.005))
    work = dict(zip(PARTS, opening.work, strict=True))
    assert opening.opened and opening.held == pytest.approx(opening.way, rel=0.05)
    assert work["across"] > 0.9 * sum(work.values()) > 0.01
    assert max(abs(work[part]) for part in ("along", "sliding", "torsional")) < 0.1 * work["across"]


@pytest.mark.parametrize("shape", ["sphere", "box"])  # in a contact a box comes after the knob
@pytest.mark.parametrize(
    ("part", "pos", "axis", "torque"),
    [("along", "0.05 -0.3 0", "-1 0 0", 10.0 * 0.3), ("across", "-0.02 -0.32 0", "0 1 0", 10.0 * 0.02)],
)
def test_a_finger_pushes_the_knob_on_its_lever(shape: str, part: str, pos: str, axis: str, torque: float):
    model = mujoco.MjModel.from_xml_string(KNOB.format(shape=shape, pos=pos, axis=axis))
    data = mujoco.MjData(model)
    data.qfrc_applied[model.joint("finger").dofadr] = 10.0
    mujoco.mj_step(model, data, nstep=2000)
    found = dict(zip(PARTS, hinge_torques(model, data, model.geom("knob").id, 0), strict=True))
    assert found.pop(part) == pytest.approx(torque, rel=0.03)
    assert max(abs(rest) for rest in found.values()) < 0.03 * torque
    assert 500 * data.joint("hinge").qpos[0] == pytest.approx(torque, rel=0.03)


def test_a_copy_that_leaves_the_trial_is_no_measurement():
    robot = around_the_knob({})
    data, opening = mujoco.MjData(robot.scene.model), Opening(robot)
    data.qpos[:] = robot.start
    opening(data)
    data.qpos[0] += 0.01
    with pytest.raises(RuntimeError, match="the copy has left the trial"):
        opening(data)


def test_policies_of_another_robot_are_no_cases_of_the_setting(tmp_path: Path):
    folder = tmp_path / "table2_cases" / "paper"
    folder.mkdir(parents=True)
    for seed, robot in enumerate((None, 100)):
        case = {"method": "mean", "seed": seed, "setting": asdict(setting_of("paper", robot))}
        (folder / f"mean_{seed}.json").write_text(json.dumps(case))
    with pytest.raises(SystemExit, match=r"error: .* another setting than .*: mean 1$"):
        made(Arguments(policies=tmp_path))
    (folder / "mean_1.json").unlink()
    assert [case["seed"] for case in made(Arguments(policies=tmp_path))] == [0]
    assert made(Arguments())[0]["setting"]["robot"] == SETTINGS["paper"].robot  # those that are kept


def test_where_all_trials_blew_up_a_grip_is_needed():
    assert [needless({"success_rate": rate}) for rate in (None, 0.0, NEEDED)] == [False, False, True]
