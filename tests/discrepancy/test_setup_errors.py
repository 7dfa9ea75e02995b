"""A tilted base, an encoder offset and friction at rest, hidden in the synthetic robot and named by the search."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from small_log import CONFIG

import droid_jax as dj
from droid_jax.cost.cost import make_cost
from droid_jax.discrepancy.log_case import case_of
from droid_jax.discrepancy.verdict import Conclusion, Verdict
from droid_jax.identify.multistart import RefineConfig, refine
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effects.candidate import EffectKey
from droid_jax.model.effects.registry import effect_space, library
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.recordings.split import Split
from droid_jax.simulate.hand_path import minimum_jerk
from droid_jax.synthetic.hidden_effects import record_hidden
from droid_jax.synthetic.robot import SyntheticRobotConfig

ARM = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="column"><joint name="yaw" axis="0 0 1" armature="0.05" damping="10"/>
    <geom size="0.05 0.1" type="cylinder" mass="2" contype="0" conaffinity="0"/>
    <body name="upper" pos="0 0 0.1" gravcomp="SHARE"><joint name="shoulder" axis="0 1 0" armature="0.1" damping="20"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="3" contype="0" conaffinity="0"/>
      <body name="fore" pos="0.3 0 0" gravcomp="SHARE"><joint name="elbow" axis="0 1 0" armature="0.05" damping="10"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.4 0 0" mass="3" contype="0" conaffinity="0"/></body></body>
  </body></worldbody>
  <actuator><position joint="yaw" kp="400"/><position joint="shoulder" kp="900"/><position joint="elbow" kp="400"/>
  </actuator></mujoco>"""
JOINTS = ("yaw", "shoulder", "elbow")
ASKED = ("encoder_offset", "gravity_direction", "payload", "cable_pull", "torque_bias", "torque_gain", "joint_coulomb")
PARAMETERS = [
    *({"field": "dof_damping", "element": j, "unit": "N m s/rad", "std": 2.0, "high": 60.0} for j in JOINTS),
    {"field": "body_mass", "element": "fore", "std": 0.2, "high": 9.0},
    *({"sensor": "torque_offset", "element": j, "std": 0.1, "high": 1.0, "nuisance": True} for j in JOINTS),
]
# rad, rad/s, rad: two sines a joint and a phase, by role
WAVES = {
    "train": ((0.9, 1.1, 0.0), (0.5, 1.7, 0.3), (0.6, 2.3, 1.0)),
    "validation": ((0.7, 1.6, 1.2), (0.6, 1.2, 2.0), (0.5, 1.9, 0.1)),
    "test": ((0.8, 0.9, 2.1), (0.4, 2.0, 0.9), (0.7, 1.4, 1.7)),
}
SEARCH = replace(CONFIG, search=CmaConfig(population=8, parents=None, generations=2), max_effects=1)


@functools.cache
def arm(compensated: bool) -> Scene:
    mjcf = ARM.replace("SHARE", "1" if compensated else "0")
    return compile_scene(mujoco.MjSpec.from_string(mjcf), "arm", joints=JOINTS)


def space_of(scene: Scene, folder: Path, *more: Mapping[str, object]) -> Space:
    path = folder / "parameters.json"
    path.write_text(json.dumps([*PARAMETERS, *more]))
    return load_parameters(path, scene)


@functools.cache
def recorded(compensated: bool, hidden: tuple[tuple[str, float], ...]) -> dict[str, Recording]:
    """Role -> eight repeats with something hidden, as logs without commands."""
    scene, clock, found = arm(compensated), np.arange(0.0, 5.0, 0.004), {}
    for seed, (role, waves) in enumerate(WAVES.items()):
        swings = np.stack([size * np.sin(w * clock + phase) for size, w, phase in waves], axis=1)
        command = minimum_jerk(clock / 1.0)[:, None] * swings
        demonstration = Recording(
            role, clock, command, JOINTS, {}, TorqueConvention(TorqueSide.MOTOR, gravity=not compensated),
            qpos0=dict(zip(JOINTS, command[0].tolist(), strict=True)),
        )  # fmt: skip
        config = SyntheticRobotConfig(repeats=8, timestep=0.00025)
        recording = record_hidden(scene, demonstration, {}, dict(hidden), seed=seed, config=config)
        found[role] = replace(recording, time=np.zeros(0), command=np.zeros((0, 0)), command_names=())
    return found


def found_in(compensated: bool, folder: Path, **hidden: float) -> tuple[Verdict, dict[str, tuple[float, float, float]]]:
    """The verdict, and parameter -> value and 90 % interval for the effects."""
    scene = arm(compensated)
    named = tuple((f"{name}[elbow]" if name == "encoder_zero" else name, size) for name, size in hidden.items())
    recordings = list(recorded(compensated, named).values())
    verdict, model = dj.find_missing_effects(
        scene, space_of(scene, folder), recordings, effects=library(scene, ASKED), config=SEARCH
    )
    spans = {}
    for name in (n for part in model.parts for n in part.coefficients):
        k = model.space.index(name)
        wide = 1.645 * np.sqrt(model.gaussian.cov[k, k]) * model.space[name].std
        spans[name] = (model.values[k], model.values[k] - wide, model.values[k] + wide)
    return verdict, spans


@pytest.mark.slow
@pytest.mark.parametrize("compensated", [False, True], ids=["weight", "compensated"])
def test_effects_of_the_library_match_the_hidden_effects(compensated: bool, tmp_path: Path):
    """With the hidden values the residual is no larger than that of a robot with nothing hidden."""
    scene = arm(compensated)
    effects = library(scene, ["encoder_offset", "gravity_direction"])
    space, cost, left = space_of(scene, tmp_path) + effect_space(effects), None, []
    hidden = {
        None: {},
        "encoder_zero[elbow]": {"encoder_offset[elbow]": 0.03},
        "tilted_base": {"gravity_about_x": 0.03 * np.cos(0.6), "gravity_about_y": 0.03 * np.sin(0.6)},
    }
    for name, truth in hidden.items():
        recording = recorded(compensated, ((name, 0.03),) if name else ())["train"]
        if cost is None:
            cost = make_cost(scene, space, [recording], effects=effects, config=SEARCH.compare)
        rows = np.array([space.mean, space.values(truth)])
        left.append(np.sqrt(np.mean(cost.against([recording]).whitened(rows) ** 2, axis=1)))
    nothing = left[0][0]
    assert nothing < 1.1
    for neutral, true in left[1:]:
        assert true < 1.02 * nothing and neutral > 2.0 * nothing


@pytest.mark.slow
@pytest.mark.parametrize("compensated", [False, True], ids=["weight", "compensated"])
def test_an_encoder_offset_is_named_with_its_size(compensated: bool, tmp_path: Path):
    verdict, spans = found_in(compensated, tmp_path, encoder_zero=0.03)
    assert (verdict.conclusion, verdict.effects) == (Conclusion.NAMED, (EffectKey("encoder_offset", "elbow"),)), verdict
    value, low, high = spans["encoder_offset[elbow]"]
    assert value == pytest.approx(0.03, abs=0.003) and low < 0.03 < high, spans
    assert all(verdict.closed(role) > 0.9 for role in ("train", "validation", "test"))


@pytest.mark.slow
@pytest.mark.parametrize("compensated", [False, True], ids=["weight", "compensated"])
def test_a_tilted_base_is_named_with_its_angle(compensated: bool, tmp_path: Path):
    verdict, spans = found_in(compensated, tmp_path, tilted_base=0.03)
    assert verdict.conclusion is Conclusion.NAMED, verdict
    assert verdict.effects == (EffectKey("gravity_direction", "base"),)
    for axis, size in (("x", np.cos(0.6)), ("y", np.sin(0.6))):
        value, low, high = spans[f"gravity_about_{axis}"]
        assert value == pytest.approx(0.03 * size, abs=0.003) and low < 0.03 * size < high, spans
    assert all(verdict.closed(role) > 0.9 for role in ("train", "validation", "test"))


@pytest.mark.slow
def test_sensor_gains_and_encoder_offsets_are_parameters_of_a_file(tmp_path: Path):
    """Hidden values are fitted as parameters, which are then not tested as effects."""
    scene = arm(False)
    sensors = [
        {"sensor": "encoder_offset", "element": "elbow", "std": 0.02, "high": 0.1},
        {"sensor": "torque_gain", "element": "shoulder", "std": 0.05, "high": 0.3},
    ]
    space = space_of(scene, tmp_path, *sensors)
    assert [(space[n].unit, space[n].mean) for n in ("encoder_offset[elbow]", "torque_gain[shoulder]")] == [
        ("rad", 0.0),
        ("-", 0.0),
    ]
    recordings = recorded(False, (("encoder_zero[elbow]", 0.03),))
    seen = recordings["train"].channel("torque")
    gained = replace(seen, values=seen.values * np.array([1.0, 1.1, 1.0], np.float32))
    fitted = replace(recordings["train"], channels={**recordings["train"].channels, "torque": gained})
    cost = make_cost(scene, space, [fitted])
    found = refine(cost.whitened, space, space.mean[None], RefineConfig(iterations=15, basin_hops=0))
    deviation = np.sqrt(np.diag(np.linalg.inv(found.hessian))) * space.std
    for name, truth in (("encoder_offset[elbow]", 0.03), ("torque_gain[shoulder]", 0.1)):
        k = space.index(name)
        assert abs(found.best[k] - truth) < 5 * deviation[k] < 0.1 * truth + 5e-3, (name, found.best[k], deviation[k])
    effects = library(scene, ["encoder_offset", "torque_gain", "payload"])
    case = case_of(Split.RECORDINGS, scene, space, effects, recordings, SEARCH)
    asked = {e.name: [*e.locations] for e in case.effects}
    assert asked == {"encoder_offset": ["shoulder"], "torque_gain": ["yaw", "elbow"], "payload": ["elbow"]}
    assert len({*case.full_space.names}) == len(case.full_space.names)
