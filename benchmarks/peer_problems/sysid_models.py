"""The two models of mujoco.sysid's own tests, and its fit of them: without anything of this program, nor jax.

    python -m benchmarks.peer_problems.sysid_models FOLDER

fits the log in FOLDER/fit.npz and writes FOLDER/sysid.json, as a process of its own whose time counts.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks.peer_problems import sysid as peer

FINE = 0.00001  # s: a step short enough to stand for continuous time


def library_tests() -> Any:
    """The module of mujoco.sysid's tests that holds its models."""
    peer.library()
    from mujoco.sysid.tests import test_integration

    return test_integration


def spring_force(frequencies: Sequence[float]) -> Callable[[np.ndarray], np.ndarray]:
    """[T] s -> [T, 1] N: two sines of 5 and 3 N; its test has 1.5 and 3.7 Hz."""
    slow, fast = frequencies
    return lambda t: (5.0 * np.sin(2 * np.pi * slow * t) + 3.0 * np.sin(2 * np.pi * fast * t))[:, None]


def arm_torques(pace: float) -> Callable[[np.ndarray], np.ndarray]:
    """[T] s -> [T, 5] N m: five sines, `pace` times as fast as in its test."""
    amplitudes, frequencies = (5.0, 4.0, 3.0, 2.0, 1.0), (0.5, 0.7, 0.4, 0.9, 0.6)
    pairs = list(zip(amplitudes, frequencies, strict=True))
    return lambda t: np.column_stack([a * np.sin(2 * np.pi * pace * f * t + 0.5 * i) for i, (a, f) in enumerate(pairs)])


# What drives each model: in its test, and where the fit is judged; and for how long, s.
FORCES = {"spring": (spring_force((1.5, 3.7)), spring_force((0.9, 2.3)), 3.0),
          "arm": (arm_torques(1.0), arm_torques(0.7), 2.0)}  # fmt: skip
# Where its tests start and how far they may go: a parameter file.
PARAMETERS: dict[str, list[dict[str, Any]]] = {
    "spring": [{"field": "body_mass", "element": "ball", "name": "mass", "unit": "kg", "mean": 2.0, "std": 1.0,
                "low": 0.3, "high": 3.0}],
    "arm": [{"field": "dof_armature", "element": "*", "name": "armature", "unit": "kg m^2", "mean": 0.01, "std": 0.3,
             "low": 0.001, "high": 1.0}],
}  # fmt: skip


def spec_of(name: str) -> mujoco.MjSpec:
    """Its model "spring" or "arm"."""
    tests = library_tests()
    return mujoco.MjSpec.from_string({"spring": tests.SPRING_MASS_XML, "arm": tests.ARM_XML}[name])


def motion(model: mujoco.MjModel, control: np.ndarray, timestep: float) -> tuple[np.ndarray, np.ndarray]:
    """[T, nq], [T, nv] states of the model before each step, from rest at zero; control [T, U]."""
    model.opt.timestep = timestep
    data = mujoco.MjData(model)
    position, velocity = np.empty((len(control), model.nq)), np.empty((len(control), model.nv))
    for k, row in enumerate(control):
        position[k], velocity[k] = data.qpos, data.qvel
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
    return position, velocity


def log_of(name: str, judge: bool, data_step: float, fit_step: float) -> dict[str, np.ndarray]:
    """time [T] s, force [T, U], position and velocity [T, nq] of a model's motion, a row for each step of a fit."""
    first, other, duration = FORCES[name]
    clock = np.arange(round(duration / data_step)) * data_step
    force = (other if judge else first)(clock)
    position, velocity = motion(spec_of(name).compile(), force, data_step)
    every = round(fit_step / data_step)
    return {"time": clock[::every], "force": force[::every], "position": position[::every],
            "velocity": velocity[::every]}  # fmt: skip


def modifier(name: str) -> Callable[..., None]:
    """How a parameter of these models enters an MjSpec."""
    if name == "mass":
        return lambda spec, p: setattr(spec.body("ball"), "mass", p.value[0])
    if name.endswith("_armature"):
        return lambda spec, p: setattr(spec.joint(name.removesuffix("_armature")), "armature", p.value[0])
    return lambda spec, p: _set_slide(spec.joint("slide"), name, p.value[0])


def _set_slide(joint: Any, name: str, value: float) -> None:
    """Stiffness and damping of a spec's joint are polynomials there: the first coefficient is meant."""
    now = getattr(joint, name)
    setattr(joint, name, value if np.ndim(now) == 0 else np.r_[value, np.asarray(now)[1:]])


def fitted(
    spec: mujoco.MjSpec,
    starts: Mapping[str, tuple[float, float, float]],
    clock: np.ndarray,
    force: np.ndarray,
    sensed: Mapping[str, np.ndarray],
) -> peer.PeerFit:
    """Its fit as its test does it, from rest at zero.

    Its rollout gives the first step's sensors the time after that step; measured rows are labelled alike.

    Args:
        spec: the model.
        starts: of each parameter where it starts, and its bounds.
        clock: [T] s.
        force: [T, U], drives it.
        sensed: sensors by name [T], compared.
    """
    sysid = peer.library()
    model = spec.compile()
    names = {name: (sysid.SignalType.MjSensor, np.array([i])) for i, name in enumerate(sensed)}
    sensors = sysid.TimeSeries(clock[1:], np.stack(list(sensed.values()), axis=1)[:-1], signal_mapping=names)
    state = sysid.create_initial_state(model, np.zeros(model.nq), np.zeros(model.nv))
    drive = sysid.TimeSeries(clock, force)
    group = sysid.ModelSequences("model", spec, "log", state, drive, sensors, allow_missing_sensors=True)
    residual = sysid.build_residual_fn(models_sequences=[group])
    parameters = sysid.ParameterDict()
    for name, (mean, low, high) in starts.items():
        parameters.add(sysid.Parameter(name, nominal=mean, min_value=low, max_value=high, modifier=modifier(name)))
    return peer.minimise(parameters, residual)


def sensors_of(model: mujoco.MjModel, position: np.ndarray, velocity: np.ndarray) -> dict[str, np.ndarray]:
    """Its models' sensors: positions of all joints [T, nq] before velocities [T, nv]."""
    names = [model.sensor(i).name for i in range(model.nsensor)]
    return dict(zip(names, np.hstack([position, velocity]).T, strict=True))


def starts_of(name: str, joints: Sequence[str]) -> dict[str, tuple[float, float, float]]:
    """Start and bounds of each parameter of a model with these joints."""
    (entry,) = PARAMETERS[name]
    names = [entry["name"]] if name == "spring" else [f"{joint}_armature" for joint in joints]
    return dict.fromkeys(names, (entry["mean"], entry["low"], entry["high"]))


def main(folder: Path) -> None:
    """Fit the log of a folder that is named after its model."""
    log = dict(np.load(folder / "fit.npz"))
    spec = spec_of(folder.name)
    spec.option.timestep = float(log["time"][1] - log["time"][0])
    model = spec.compile()
    joints = [model.joint(i).name for i in range(model.njnt)]
    began = time.perf_counter()
    found = fitted(
        spec, starts_of(folder.name, joints), log["time"], log["force"],
        sensors_of(model, log["position"], log["velocity"]),
    )  # fmt: skip
    result = {"values": found.values.tolist(), "fit_seconds": time.perf_counter() - began}
    (folder / "sysid.json").write_text(json.dumps(result))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
