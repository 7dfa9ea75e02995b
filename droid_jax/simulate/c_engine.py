"""Many rollouts in plain C MuJoCo at once, on all cores.  The synthetic robot and the replays in C use them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from droid_jax import runtime
from droid_jax.model.scene import Scene
from droid_jax.model.visual_geoms import without_visual_geoms


@dataclass(frozen=True, eq=False)
class Trace:
    """Sensor values of a batch of C rollouts, each at the time of the state before the step.

    Attributes:
        torque: [P, T, J] N m (N for slides), of the actuators.
        position: [P, T, J] rad (m).
        velocity: [P, T, J] rad/s (m/s).
        object_angle: [P, T] rad (m), of the object's joint; 0 without one.
        object_velocity: [P, T] rad/s (m/s).
        contact: [P, T, F] bool, whether a finger touches the object.
    """

    torque: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    object_angle: np.ndarray
    object_velocity: np.ndarray
    contact: np.ndarray


def instrument(scene: Scene) -> mujoco.MjModel:
    """The scene's C model with sensors for everything in `Trace`.

    It is compiled from the scene's spec, then takes over the numbers of the scene's model.  So options and fields that
    were changed after compilation keep their values.
    """
    spec = without_visual_geoms(scene.spec)
    for sensor in list(spec.sensors):  # `split` counts on the order of the sensors that are added here
        spec.delete(sensor)
    for kind in ("JOINTACTFRC", "JOINTPOS", "JOINTVEL"):
        for joint in scene.joints:
            _add(spec, kind, joint)
    if scene.object_joint:
        for kind in ("JOINTPOS", "JOINTVEL"):
            _add(spec, kind, scene.object_joint)
    for pairs in scene.grip.fingers if scene.grip else ():
        for pair in pairs:
            found = spec.pair(pair)
            spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=found.geomname1,
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname=found.geomname2,
                intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1],
            )
    model = spec.compile()
    _copy_numbers(scene.model, model)
    return model


def _add(spec: mujoco.MjSpec, kind: str, joint: str) -> None:
    spec.add_sensor(type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"), objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)


_COPIED = ("body_", "jnt_", "dof_", "geom_", "site_", "pair_", "actuator_", "eq_", "tendon_", "qpos")  # of an MjModel


def _copy_numbers(source: mujoco.MjModel, target: mujoco.MjModel) -> None:
    for name in (n for n in dir(source.opt) if not n.startswith("_")):
        setattr(target.opt, name, getattr(source.opt, name))
    for name in dir(source):
        if name.startswith(_COPIED):
            array = getattr(source, name)
            if isinstance(array, np.ndarray) and array.size and np.issubdtype(array.dtype, np.number):
                copied = getattr(target, name)
                if copied.shape == array.shape and not name.endswith(("adr", "id", "num")):
                    copied[:] = array
    target.jnt_limited[:] = source.jnt_limited
    target.stat.meaninertia, target.stat.meanmass = source.stat.meaninertia, source.stat.meanmass


def simulate(
    scene: Scene,
    models: Sequence[mujoco.MjModel],
    qpos0: np.ndarray,
    control: np.ndarray,
) -> Trace:
    """Roll out instrumented models [P] from qpos0 [P or 1, nq] under control [P or 1, T, U].

    From the step at which a rollout diverges, its values are NaN and its contacts False.
    """
    threads = min(runtime.cores(), len(models))
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    states = np.zeros((len(models), mujoco.mj_stateSize(models[0], kind)))
    data = mujoco.MjData(models[0])
    for i, model in enumerate(models):
        data.qpos[:] = qpos0[i % len(qpos0)]
        data.qvel[:] = 0
        mujoco.mj_getState(model, data, states[i], kind)
    with rollout.Rollout(nthread=threads) as pool:
        datas = [mujoco.MjData(models[0]) for _ in range(threads)]
        after, sensors = pool.rollout(list(models), datas, states, np.ascontiguousarray(control))
    # A rollout that diverges repeats its last valid state or starts again.  Either way its clock is wrong.
    steps = np.array([m.opt.timestep for m in models])[:, None]
    diverged = np.abs(after[..., 0] - np.arange(1, after.shape[1] + 1) * steps) > 0.5 * steps
    return split(scene, np.where(np.logical_or.accumulate(diverged, axis=1)[..., None], np.nan, sensors))


def split(scene: Scene, sensors: np.ndarray) -> Trace:
    """Sensor values [P, T, S] of an instrumented model as a Trace."""
    count = len(scene.joints)
    torque, position, velocity = (sensors[..., k * count : (k + 1) * count] for k in range(3))
    rest = sensors[..., 3 * count :]
    nothing = np.zeros(sensors.shape[:2])
    angle, speed = (rest[..., 0], rest[..., 1]) if scene.object_joint else (nothing, nothing)
    rest = rest[..., 2:] if scene.object_joint else rest
    fingers, start = [], 0
    for pairs in scene.grip.fingers if scene.grip else ():
        fingers.append(np.any(rest[..., start : start + len(pairs)] > 0, axis=-1))
        start += len(pairs)
    contact = np.stack(fingers, axis=-1) if fingers else np.zeros((*sensors.shape[:2], 0), bool)
    return Trace(torque, position, velocity, angle, speed, contact)


def poses(model: mujoco.MjModel, qpos0: np.ndarray, control: np.ndarray) -> np.ndarray:
    """[T, nq] positions of all joints in one C rollout from qpos0 [nq] under control [T, U], for drawing."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos0
    out = np.empty((len(control), model.nq))
    for k, ctrl in enumerate(control):
        out[k] = data.qpos
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)
    return out
