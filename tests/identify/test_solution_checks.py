"""The time step and the engine, measured at the fitted values; what is said of a replay that gives no numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import mujoco
import numpy as np
import pytest

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.identify.divergence import blow_up
from droid_jax.identify.identifiability import posterior
from droid_jax.identify.pipeline import IdentifyConfig, identify_parameters
from droid_jax.identify.search import CmaConfig
from droid_jax.identify.solution_checks import SolutionCheck, check_solution, creep_of_fit, solution_notes
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.fields import joint_damping, joint_frictionloss
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide

QUICK = IdentifyConfig(search=CmaConfig(population=8, parents=None, generations=2), samples=2)
HINGE = """<mujoco><option integrator="implicitfast" timestep="{step}"/><worldbody><body><joint name="j" axis="0 1 0"
    damping="0.9" frictionloss="1e-6" armature="0.02"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/>
  </body></worldbody><actuator><position joint="j" kp="30" kv="1"/></actuator></mujoco>"""


def hinge(step: float) -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(HINGE.format(step=step)), "swing", joints=["j"])


def recorded(side: TorqueSide = TorqueSide.MOTOR) -> Recording:
    """A log of plain C with a time step of 0.1 ms, with a little noise."""
    fine = hinge(1e-4)
    time, data, rng = np.arange(0.0, 4.0, 0.01), mujoco.MjData(fine.model), np.random.default_rng(0)
    command, torque = 0.5 * np.sin(2 * np.pi * 0.7 * time), []
    for k in range(len(time) * 100):
        data.ctrl[0] = np.interp(k * 1e-4, time, command)
        mujoco.mj_step1(fine.model, data)
        mujoco.mj_step2(fine.model, data)
        if k % 100 == 0:
            torque.append(float(data.qfrc_actuator[0]))
    values = np.array(torque)[None, :, None] + rng.normal(0, 0.005, (3, len(time), 1))
    channel = Channel("torque", "N m", ("j",), time, values, np.ones(values.shape, bool))
    convention = TorqueConvention(side, True)
    return Recording("swing", time, command[:, None], ("j",), {"torque": channel}, convention, {"j": 0.0})


def cost_of(scene: Scene, recording: Recording, engine: str = "mjx", **config) -> tuple[Cost, np.ndarray]:
    space = Space((joint_damping(scene, "j", std=0.5, high=10.0),))
    return make_cost(scene, space, [recording], engine=engine, config=CompareConfig(**config)), space.mean


def checked(step: float, engine: str = "mjx", side: TorqueSide = TorqueSide.MOTOR) -> SolutionCheck:
    recording = recorded(side)
    cost, values = cost_of(hinge(step), recording, engine)
    return check_solution(cost, [recording], values, engine)[0]["swing"]


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "step"), [("mjx", 0.002), ("mujoco", 0.0002)])
def test_a_fine_time_step_is_measured_and_gives_no_note(engine: str, step: float):
    check = checked(step, engine)
    assert check.remaining == 0.01  # no less than noise can be
    assert check.discretisation is not None and check.discretisation < 1e-3
    assert check.parity_largest is not None and check.parity_largest < 0.02 and not check.unmeasured
    assert check.parity_angle is not None and check.parity_angle < 1e-3
    assert not solution_notes({"swing": check}, "swing")


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_a_coarse_time_step_gives_a_note(engine: str):
    check = checked(0.1, engine)
    assert check.too_coarse
    said = solution_notes({"swing": check}, "swing")
    assert "the time step of scene 'swing' is too coarse: at half of its 100 ms the fitted torques" in said[0]
    assert "give <option> a smaller timestep" in said[0]


@pytest.mark.slow
def test_half_a_step_is_taken_in_mjx_where_c_cannot_run_the_replay():
    check = checked(0.05, side=TorqueSide.LINK)
    assert check.parity_rms is None and "plain C MuJoCo: the C engine cannot replay" in check.unmeasured
    assert check.discretisation is not None and 0.01 < check.discretisation < 0.1


@pytest.mark.slow
def test_engines_that_differ_give_a_note():
    """A polynomial stiffness, which loading would refuse: C applies it, MJX does not."""
    scene, recording = hinge(0.002), recorded()
    scene.model.jnt_stiffnesspoly[0] = [0.0, 30.0]
    cost, values = cost_of(scene, recording)
    check = check_solution(cost, [recording], values, "mjx")[0]["swing"]
    assert check.engines_differ and not check.too_coarse
    said = solution_notes({"swing": check}, "swing")
    assert len(said) == 1 and "MJX and plain C MuJoCo differ at the fitted values of scene 'swing'" in said[0]


@pytest.mark.slow
def test_data_of_mj_step_have_no_error_of_its_step():
    recording = recorded()
    cost, values = cost_of(hinge(0.02), recording, mj_step=True)
    check = check_solution(cost, [recording], values, "mjx")[0]["swing"]
    assert check.discretisation is None and check.parity_rms is not None and check.parity_rms < 1e-3


@pytest.mark.parametrize(("engine", "step"), [pytest.param("mjx", 0.02, marks=pytest.mark.slow), ("mujoco", 0.05)])
def test_an_interval_includes_the_error_of_the_time_step(engine: Literal["mjx", "mujoco"], step: float):
    """The robot's time step is 0.1 ms: the fit compensates the scene's with another damping."""
    scene, recording, truth = hinge(step), recorded(), 0.9
    space = Space((joint_damping(scene, "j", std=0.5, high=10.0),))
    found = identify_parameters(scene, space, recording, config=replace(QUICK, engine=engine))
    assert found.refined is not None
    (blind_low,), (blind_high,) = posterior(found.refined, found.fit.comparisons).interval()
    (low,), (high,) = found.full_gaussian.interval()
    assert low < truth < high and high - low > 1.2 * (blind_high - blind_low)
    assert engine == "mujoco" or not blind_low < truth < blind_high
    assert "by what the time step moves it" in found.full_gaussian.rule


@pytest.mark.slow
def test_a_log_without_commands_has_no_time_step():
    recording = recorded()
    position = replace(recording.channels["torque"], name="position", unit="rad")
    bare = replace(
        recording, time=np.zeros(0), command=np.zeros((0, 0)), command_names=(), qpos0={},
        channels={**recording.channels, "position": position},
    )  # fmt: skip
    cost, values = cost_of(hinge(0.002), bare)
    checks, off = check_solution(cost, [bare], values, "mjx")
    assert checks == {} and not off.any()


def test_a_replay_that_blows_up_at_half_its_step_gives_a_note():
    check = SolutionCheck(
        "N m", 0.1, 0.1, unmeasured="the simulation blows up at the fitted values with a step of 50 ms"
    )
    assert "do not trust the fitted values" in solution_notes({"a": check}, "swing")[0]


def test_a_joint_that_creeps_only_with_the_fitted_friction_gives_a_note():
    spec = mujoco.MjSpec.from_string(HINGE.format(step=0.002))
    spec.actuators[0].set_to_motor()
    scene = compile_scene(spec, "swing", joints=["j"])
    space = Space((joint_frictionloss(scene, "j", std=0.1, mean=0.1, high=2.0),))
    time = np.arange(0.0, 10.0, 0.01)
    held = np.full((1, len(time), 1), 0.2) + 1e-6 * np.sin(time)[None, :, None]
    channel = Channel("torque", "N m", ("j",), time, held, np.ones(held.shape, bool))
    recording = replace(recorded(), time=time, command=held[0], channels={"torque": channel})
    assert "j by " in creep_of_fit(scene, space, np.array([0.3]), [recording])[0]
    assert not creep_of_fit(scene, space, np.array([1e-6]), [recording])


ARM = """<mujoco><compiler autolimits="true"/><option timestep="0.002" integrator="Euler"/><worldbody><body>
  <joint name="shoulder" axis="0 1 0" range="-90 90"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="2"/>
  <body pos="0 0 -.4"><joint name="wrist" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.05" size=".01" mass=".05"/>
  </body></body></worldbody><actuator><position joint="shoulder" kp="50" kv="5"/>
  <position joint="wrist" kp="2000" kv="0"/></actuator></mujoco>"""


def arm() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(ARM), "arm")


def rollout(position: np.ndarray) -> Rollout:
    time = 0.002 * np.arange(len(position))
    velocity = np.gradient(position, time, axis=0)
    still = np.zeros(len(time))
    return Rollout(time, position, position, velocity, still, np.zeros((len(time), 0), bool), np.array(False))


def test_the_joint_that_leaves_its_range_first_is_named_with_its_stability_limit():
    path = np.zeros((50, 2))
    path[12:, 1] = 1e3
    path[20:] = np.nan
    said = blow_up(arm(), rollout(path))
    assert said.startswith("wrist leaves its range at step 12 (0.024 s), where its servo's 2e+03 N m/rad on")
    assert "need a time step well below" in said and "armature well above 0.002 kg m2" in said


def test_a_joint_with_a_stable_servo_is_named_without_a_limit():
    path = np.zeros((50, 2))
    path[30:, 0] = 6.0
    assert blow_up(arm(), rollout(path)) == "shoulder leaves its range at step 30 (0.06 s)"


def test_a_position_that_is_not_finite_counts_as_out_of_range():
    path = np.zeros((50, 2))
    path[7:, 1] = np.nan
    assert blow_up(arm(), rollout(path)).startswith("wrist leaves its range at step 6")


def test_a_replay_within_its_ranges_is_not_explained():
    assert blow_up(arm(), rollout(np.zeros((5, 2)))) == ""
