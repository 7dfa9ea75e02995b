"""mujoco.sysid's own test problems, and its spring with a mass where dry friction is hidden in the data.

Its tests hold the models; they are read from the installed package.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks.peers import sysid as peer
from benchmarks.peers.gap import run_gap
from droid_jax.cost.cost import ENGINES, make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.files import EXTENDED
from droid_jax.identify.extended_model import load_extended
from droid_jax.identify.multistart import RefineConfig, refine
from droid_jax.model.fields import model_parameter
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene, load_scene
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.storage import finite

FORCE_NOISE, POSITION_NOISE = 0.02, 1e-5  # N and m, white, of the measured log
RATE = 500.0  # Hz of that log
FINE = 0.00001  # s: a step short enough to stand for continuous time
LOG_STEP = 0.0001  # s: of what makes the long logs
FRICTION = 0.5  # N, hidden


def problems() -> Any:
    """The module of mujoco.sysid's tests that holds its models."""
    peer.library()
    from mujoco.sysid.tests import test_integration

    return test_integration


def spring_force(frequencies: Sequence[float]) -> Callable[[np.ndarray], np.ndarray]:
    """[T] s -> [T, 1] N: two sines of 5 and 3 N; its test has 1.5 and 3.7 Hz."""
    slow, fast = frequencies
    return lambda t: (5.0 * np.sin(2 * np.pi * slow * t) + 3.0 * np.sin(2 * np.pi * fast * t))[:, None]


def arm_torques(t: np.ndarray) -> np.ndarray:
    """[T] s -> [T, 5] N m: five sines."""
    amplitudes, frequencies = (5.0, 4.0, 3.0, 2.0, 1.0), (0.5, 0.7, 0.4, 0.9, 0.6)
    return np.column_stack(
        [a * np.sin(2 * np.pi * f * t + 0.5 * i) for i, (a, f) in enumerate(zip(amplitudes, frequencies, strict=True))]
    )


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


# Recovery ----------------------------------------------------------------------------------


def recover(name: str, data_step: float, fit_step: float) -> dict[str, Any]:
    """Both programs on one of its test problems, without noise; errors of the recovered values.

    data_step, fit_step: s, of the simulation that makes the data and of both fits; the log has a row for each
    step of the fit.  In its test both are 2 ms, and the program that fits the data made them with the same
    steps; with FINE they stand for a real system.
    """
    tests = problems()
    xml, force, duration = {
        "spring": (tests.SPRING_MASS_XML, spring_force((1.5, 3.7)), 3.0),
        "arm": (tests.ARM_XML, arm_torques, 2.0),
    }[name]
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.timestep = fit_step
    model = spec.compile()
    joints = [model.joint(i).name for i in range(model.njnt)]
    clock = np.arange(round(duration / data_step)) * data_step
    position, velocity = motion(model, force(clock), data_step)
    every = round(fit_step / data_step)
    rows = clock[::every], force(clock)[::every], position[::every], velocity[::every]
    scene = _scene(spec)
    space, truth = _unknowns(name, scene)
    log, how = _log(joints, *rows), {"": False, "_mj_step": True}
    ours = {f"{e}{suffix}": _ours(scene, space, log, e, steps) for e in ENGINES for suffix, steps in how.items()}
    theirs = _theirs(spec, space, rows[0], rows[1], _sensors(model, *rows[2:]))
    found = {**ours, "sysid": (theirs.values, theirs.seconds)}
    return {
        "data_step": data_step,
        "fit_step": fit_step,
        "truth": truth.tolist(),
        **{
            program: {
                "values": values.tolist(),
                "largest_error": float(np.max(np.abs(values - truth))),
                "seconds": seconds,
            }
            for program, (values, seconds) in found.items()
        },
    }


def _sensors(model: mujoco.MjModel, position: np.ndarray, velocity: np.ndarray) -> dict[str, np.ndarray]:
    """Its models' sensors: positions of all joints [T, nq] before velocities [T, nv]."""
    names = [model.sensor(i).name for i in range(model.nsensor)]
    return dict(zip(names, np.hstack([position, velocity]).T, strict=True))


def _scene(spec: mujoco.MjSpec) -> Scene:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.xml"
        path.write_text(spec.to_xml())
        return load_scene(path)


def _unknowns(name: str, scene: Scene) -> tuple[Space, np.ndarray]:
    """Where its test starts, and the truth: the mass from 2 kg, or five rotor inertias from 0.01 kg m^2."""
    if name == "spring":
        mass = model_parameter(scene, "body_mass", "ball", name="mass", unit="kg", mean=2.0, std=1.0, low=0.3, high=3.0)
        return Space((mass,)), np.array([1.0])
    joints = scene.joints
    rotors = [
        model_parameter(
            scene, "dof_armature", j, name=f"{j}_armature", unit="kg m^2", mean=0.01, std=0.3, low=0.001, high=1.0
        )
        for j in joints
    ]
    return Space(tuple(rotors)), np.array([scene.model.dof_armature[scene.dof(j)] for j in joints])


def _log(
    joints: Sequence[str], clock: np.ndarray, force: np.ndarray, position: np.ndarray, velocity: np.ndarray
) -> Recording:
    """Two equal repeats, as without noise all are."""
    names = tuple(joints)

    def channel(name: str, unit: str, values: np.ndarray) -> Channel:
        both = np.stack([values, values])
        return Channel(name, unit, names, clock, both, np.ones_like(both, dtype=bool))

    channels = {
        "torque": channel("torque", "N m", force),
        "position": channel("position", "rad", position),
        "velocity": channel("velocity", "rad/s", velocity),
    }
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=False)  # not compared, and all that the C twin can
    return Recording("log", clock, force, names, channels, convention, qpos0=dict.fromkeys(names, 0.0))


def _ours(scene: Scene, space: Space, recording: Recording, engine: str, mj_step: bool) -> tuple[np.ndarray, float]:
    """Values [D] and s of the refinement alone, from the same start, compared in position and velocity."""
    began = time.perf_counter()
    config = CompareConfig(channels={"position": 1.0, "velocity": 1.0}, whitened=True, mj_step=mj_step)
    cost = make_cost(scene, space, [recording], engine=engine, config=config)
    found = refine(cost.whitened, space, space.mean[None], RefineConfig(basin_hops=0, spreads=0))
    return found.best, time.perf_counter() - began


def _theirs(
    spec: mujoco.MjSpec, space: Space, clock: np.ndarray, force: np.ndarray, sensed: Mapping[str, np.ndarray]
) -> peer.PeerFit:
    """Its fit as its test does it, from rest at zero; force [T, U] drives, sensors by name [T] are compared.

    Its rollout gives the first step's sensors the time after that step; measured rows are labelled alike.
    """
    sysid = peer.library()
    model = spec.compile()
    names = {name: (sysid.SignalType.MjSensor, np.array([i])) for i, name in enumerate(sensed)}
    sensors = sysid.TimeSeries(clock[1:], np.stack(list(sensed.values()), axis=1)[:-1], signal_mapping=names)
    state = sysid.create_initial_state(model, np.zeros(model.nq), np.zeros(model.nv))
    drive = sysid.TimeSeries(clock, force)
    group = sysid.ModelSequences("model", spec, "log", state, drive, sensors, allow_missing_sensors=True)
    residual = sysid.build_residual_fn(models_sequences=[group])
    return peer.minimise(peer.parameters_of(space, _modifier), residual)


def _modifier(parameter: Parameter) -> Callable[..., None]:
    """How a parameter of these problems enters an MjSpec."""
    if parameter.name == "mass":
        return lambda spec, p: setattr(spec.body("ball"), "mass", p.value[0])
    if parameter.name.endswith("_armature"):
        joint = parameter.name.removesuffix("_armature")
        return lambda spec, p: setattr(spec.joint(joint), "armature", p.value[0])
    name = parameter.name
    return lambda spec, p: _set_slide(spec.joint("slide"), name, p.value[0])


def _set_slide(joint: Any, name: str, value: float) -> None:
    """Stiffness and damping of a spec's joint are polynomials there: the first coefficient is meant."""
    now = getattr(joint, name)
    setattr(joint, name, value if np.ndim(now) == 0 else np.r_[value, np.asarray(now)[1:]])


# Hidden friction ---------------------------------------------------------------------------

TRUTH = {"mass": 1.0, "stiffness": 100.0, "damping": 5.0}
PARAMETERS = [
    {"field": "body_mass", "element": "ball", "name": "mass", "mean": 2.0, "std": 1.0, "low": 0.1, "high": 5.0},
    {"field": "jnt_stiffness", "element": "slide", "name": "stiffness", "unit": "N/m", "mean": 60.0, "std": 40.0,
     "high": 300.0},
    {"field": "dof_damping", "element": "slide", "name": "damping", "unit": "N s/m", "mean": 2.0, "std": 3.0,
     "high": 20.0},
]  # fmt: skip


def hidden_friction(seconds: float, seed: int) -> dict[str, Any]:
    """Its spring and mass with dry friction in the data and not in the model: what does each program say?

    seconds: of each of two logs of position and force; the second is only judged on.
    """
    xml = problems().SPRING_MASS_XML
    logs = {
        name: _measured(xml, spring_force(f), seconds, seed + i)
        for i, (name, f) in enumerate({"log": (0.43, 1.27), "other": (0.31, 0.83)}.items())
    }
    with tempfile.TemporaryDirectory() as folder:
        space, ours = _gap(Path(folder), xml, [_position_log(n, *log) for n, log in logs.items()])
    clock, force, position = logs["log"]
    theirs = _theirs(mujoco.MjSpec.from_string(xml), space, clock, force[:, None], {"position": position})
    errors = {n: abs(v - TRUTH[n]) for n, v in zip(TRUTH, theirs.values, strict=True)}
    return {
        "hidden": f"dry friction of {FRICTION} N",
        "truth": TRUTH,
        "sysid": {
            "values": dict(zip(TRUTH, theirs.values.tolist(), strict=True)),
            **half_widths(errors, theirs.half_width),
            "says": list(theirs.says),
            "seconds": theirs.seconds,
        },
        "ours": ours,
    }


def half_widths(errors: Mapping[str, float], half_width: np.ndarray) -> dict[str, Any]:
    """Half widths [D] of 95 % intervals, and errors in units of them; None where a fit tells nothing of a value."""
    each = {n: finite(h) for n, h in zip(errors, half_width.tolist(), strict=True)}
    return {
        "half_width_95": each,
        "error_in_half_widths": {n: finite(errors[n] / h) if h else None for n, h in each.items()},
    }


def _measured(
    xml: str, force: Callable[[np.ndarray], np.ndarray], seconds: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clock [T] s, force [T] N and position [T] m as measured, noise on."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.joint("slide").frictionloss = FRICTION
    every = round(1 / (RATE * LOG_STEP))
    clock = np.arange(round(seconds / LOG_STEP)) * LOG_STEP
    position, _ = motion(spec.compile(), force(clock), LOG_STEP)
    rng = np.random.default_rng([seed, 5])
    clock, position = clock[::every], position[::every, 0]
    measured = force(clock)[:, 0] + rng.normal(0, FORCE_NOISE, len(clock))
    return clock, measured, position + rng.normal(0, POSITION_NOISE, len(clock))


def _position_log(name: str, clock: np.ndarray, force: np.ndarray, position: np.ndarray) -> Recording:
    """A log without commands: the measured motion is prescribed, the force it takes is compared."""

    def channel(kind: str, unit: str, values: np.ndarray) -> Channel:
        rows = values[None, :, None]
        return Channel(kind, unit, ("slide",), clock, rows, np.ones_like(rows, dtype=bool))

    channels = {"torque": channel("torque", "N", force), "position": channel("position", "m", position)}
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    return Recording(name, np.zeros(0), np.zeros((0, 0)), (), channels, convention, qpos0={"slide": 0.0})


def _gap(folder: Path, xml: str, recordings: Sequence[Recording]) -> tuple[Space, dict[str, Any]]:
    """The parameters, and our command on the same two logs, with the fitted values."""
    scene, parameters = folder / "spring.xml", folder / "parameters.json"
    scene.write_text(xml)
    parameters.write_text(json.dumps(PARAMETERS))
    found = run_gap(recordings, folder, ["--scene", str(scene), "--parameters", str(parameters)])
    loaded = load_scene(scene)
    model = load_extended(folder / "run" / EXTENDED, loaded)
    values = dict(zip(model.space.names, model.values.tolist(), strict=True))
    return load_parameters(parameters, loaded), {**found, "values": values}
