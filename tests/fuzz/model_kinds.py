"""Scenes, and what is said of their parameters: MJCF, parameter files, Gaussians, extended models."""

from __future__ import annotations

import contextlib
import functools
import json
import tempfile
from pathlib import Path

import numpy as np
from kinds import ROOT, Kind, use

from droid_jax.files import EXTENDED, GAUSSIAN
from droid_jax.identify.extended_model import Extended, load_extended, save_extended
from droid_jax.identify.gaussian import Gaussian, load_gaussian, prior
from droid_jax.model.effects.candidate import Candidate
from droid_jax.model.effects.registry import effect_space, library, ready
from droid_jax.model.mjcf import fitted_mjcf
from droid_jax.model.parameter_file import friction_joints, load_parameters
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, load_scene

SCENE = ROOT / "experiments" / "bench.xml"
OUTSIDE = Space((Parameter("outside", "", 0.0, 1.0, -1.0, 1.0),))  # a parameter that writes nothing into a model


@functools.cache
def scene() -> Scene:
    return load_scene(SCENE, object_joint="door")


def make_parameters(folder: Path) -> None:
    entries = [
        {"field": "body_mass", "element": "forearm", "std": 0.2, "high": 3.0, "unit": "kg"},
        {"field": "dof_damping", "element": "door", "unit": "N m s/rad", "std": 0.3, "high": 10.0, "scaling": "log",
         "log_offset": 0.05, "low": 0.0, "mean": 0.5, "width": 1.0, "group": "Door"},
        {"field": "body_ipos", "element": "forearm", "column": 2, "std": 0.01, "high": 0.1, "low": -0.3, "mode": "set"},
        {"field": "dof_frictionloss", "element": "elbow", "std": 0.1, "high": 2.0, "mean": 0.1},
        {"sensor": "torque_offset", "element": "elbow", "std": 0.1, "high": 2.0, "nuisance": True},
        {"sensor": "time_offset", "std": 0.001, "high": 0.05},
        {"servo": "elbow", "std": 0.03},
    ]  # fmt: skip
    (folder / "parameters.json").write_text(json.dumps(entries))


def use_parameters(folder: Path) -> None:
    path = folder / "parameters.json"
    friction_joints(path)
    found = load_parameters(path, scene())
    found.from_search(found.to_search(found.mean))
    make_c_model(scene(), found, found.mean)
    prior(found).interval()


@functools.cache
def space() -> Space:
    with tempfile.TemporaryDirectory() as folder:
        make_parameters(Path(folder))
        return load_parameters(Path(folder) / "parameters.json", scene())


def make_gaussian(folder: Path) -> None:
    of, rng = space(), np.random.default_rng(0)
    root = 0.1 * rng.normal(size=(len(of), len(of)))
    Gaussian(of, of.to_search(of.mean), root @ root.T, "prior").save(folder / GAUSSIAN)


def use_gaussian(folder: Path) -> None:
    gaussian = load_gaussian(folder / GAUSSIAN)
    gaussian.space.check(gaussian.sample(0, 16))
    use(gaussian.interval(), gaussian.centre, gaussian.marginal(gaussian.space.names[:1]))
    gaussian.save(folder / "again.json")
    if not np.array_equal(load_gaussian(folder / "again.json").cov, gaussian.cov):
        raise RuntimeError("a Gaussian changed by being saved")


def make_extended(folder: Path) -> None:
    effects = library(scene(), ("hinge_preload",))
    own = effect_space(effects)
    part = Candidate("hinge_preload", "door", own.names, {})
    whole = space() + own
    gaussian = Gaussian(whole, whole.to_search(whole.mean), 0.01 * np.eye(len(whole)), "made up")
    save_extended(folder, Extended(ready(scene()), (part,), effects, whole.mean, gaussian))


def use_extended(folder: Path) -> None:
    model = load_extended(folder / EXTENDED, scene())
    use(model.lacking, model.gaussian.interval(), model.effect_space if model.parts else None)
    with contextlib.suppress(ValueError):  # of values with which MuJoCo makes no body
        fitted_mjcf(model.scene, model.space, model.values, model.effects)


RICH = """<mujoco model="rich">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 -9.81"/>
  <default><geom contype="0" conaffinity="0"/>
    <default class="arm"><joint damping="1" armature="0.05"/></default></default>
  <asset><texture name="t" type="2d" builtin="checker" width="16" height="16"/><material name="m" texture="t"/>
    <mesh name="tetra" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 .1" name="floor"/><light pos="0 0 2"/><camera name="c" pos="0 -1 1"/>
    <body name="upper" childclass="arm"><joint name="shoulder" axis="0 1 0" range="-2 2"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1.5" material="m"/>
      <body name="fore" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" frictionloss="0.1" solreffriction="0.01 1"/>
        <inertial pos="0 0 -0.1" mass="0.8" diaginertia="0.01 0.01 0.002"/>
        <geom name="tip" type="mesh" mesh="tetra"/><site name="s" pos="0 0 -.2"/>
        <body name="finger"><joint name="slide" type="slide" axis="0 0 1" stiffness="5" range="0 0.1"/>
          <geom type="box" size="0.01 0.01 0.02" mass="0.1"/></body></body></body>
  </worldbody>
  <contact><pair geom1="tip" geom2="floor" friction="1 1 .01 .001 .001"/>
    <exclude body1="upper" body2="finger"/></contact>
  <equality><joint joint1="slide" joint2="elbow" polycoef="0 0.01 0 0 0"/></equality>
  <tendon><fixed name="f"><joint joint="elbow" coef="1"/><joint joint="slide" coef="2"/></fixed></tendon>
  <actuator><position name="a1" joint="shoulder" kp="80" kv="2" ctrlrange="-2 2" forcerange="-50 50"/>
    <position name="a2" joint="elbow" kp="40"/></actuator>
  <sensor><jointpos joint="elbow"/><force site="s"/></sensor>
  <keyframe><key name="home" qpos="0 0.1 0.001"/></keyframe>
</mujoco>
"""


def make_scenes(folder: Path) -> None:
    (folder / "bench.xml").write_text(SCENE.read_text())
    (folder / "rich.xml").write_text(RICH)


def use_scene(folder: Path) -> None:
    changed = [p for p in sorted(folder.glob("*.xml")) if p.read_bytes() != _valid_scenes()[p.name]]
    for path in changed:
        loaded = load_scene(path)
        use(loaded.sha256, loaded.joint_dofs, loaded.of_joint)
        make_c_model(loaded, OUTSIDE, OUTSIDE.mean)


@functools.cache
def _valid_scenes() -> dict[str, bytes]:
    return {"bench.xml": SCENE.read_bytes(), "rich.xml": RICH.encode()}


KINDS = (
    Kind("parameters.json", "parameters.json", make_parameters, use_parameters, 5),
    Kind("gaussian.json", GAUSSIAN, make_gaussian, use_gaussian, 5),
    Kind("extended.json", EXTENDED, make_extended, use_extended, 4),
    Kind("MJCF", "*.xml", make_scenes, use_scene, 8),
)
