"""mujoco.sysid behind one function: our scene, our parameters and our recordings, its residual and its optimiser.

What is ours here is what a user would have to write: how values enter the model, and where a time offset
and torque offsets enter a prediction.  Rollouts, residual, least squares, intervals and what its report
says about the result are its own.  What imports jax is imported where it is used: its own models are fitted without.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording


@dataclass(frozen=True, eq=False)
class PeerFit:
    """What it found.

    values, half_width: [D] physical values and half of its 95 % intervals (inf where it sees nothing).
    seconds: of the optimisation; says: its report's insights, in its words.
    """

    values: np.ndarray
    half_width: np.ndarray
    seconds: float
    says: tuple[str, ...]

    @property
    def interval(self) -> tuple[np.ndarray, np.ndarray]:
        """[D], [D] ends of the 95 % intervals."""
        return self.values - self.half_width, self.values + self.half_width


def library() -> Any:
    """mujoco.sysid; without its extras the module is silently empty, which is said here."""
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):
        raise ImportError("mujoco.sysid needs its extras: pip install -c constraints.txt -e '.[peers]'")
    return sysid


def minimise(parameters: Any, residual: Any, **options: Any) -> PeerFit:
    """Its least squares from where `parameters` stand, intervals at the end, and its insights."""
    sysid = library()
    from mujoco.sysid.report.sections.insights import AutomatedInsights

    began = time.perf_counter()
    found, result = sysid.optimize(initial_params=parameters, residual_fn=residual, verbose=False, **options)
    seconds = time.perf_counter() - began
    values = found.as_vector()
    _, half = sysid.calculate_intervals(residual(values, found)[0], np.asarray(result.jac))
    insights = AutomatedInsights("insights", found).get_context()["insights"]
    return PeerFit(values, np.asarray(half), seconds, tuple(f"{i['title']}: {i['message']}" for i in insights))


def fit(
    scene: Scene,
    space: Space,
    recordings: Sequence[Recording],
    *,
    channel: str = "torque",
    off_bounds: bool = False,
    priors: bool = False,
    **options: Any,
) -> PeerFit:
    """Fit all of `space`, from its means and within its bounds, to the mean of recordings with commands.

    channel: "torque" or "position"; each recording has the servo gains that it states.
    off_bounds: move what starts near a bound inwards, as its own warning advises.
    priors: of the nuisances, as rows of the residual (`with_priors`).
    options: of its optimiser (max_iters, x_scale, optimizer, ...).
    """
    from droid_jax.simulate.c_engine import instrument

    plain = replace(scene, model=instrument(scene))
    each = [_residual(plain, space, recording, channel) for recording in recordings]

    def residual(x: np.ndarray, parameters: Any, **more: Any) -> Any:
        found = [one(x, parameters, **more) for one in each]
        return tuple([part for parts in kind for part in parts] for kind in zip(*found, strict=True))

    if priors:
        residual = with_priors(residual, space, float(np.mean([_noise(r) for r in recordings])))
    parameters = parameters_of(space)
    return minimise(parameters.move_off_bounds() if off_bounds else parameters, residual, **options)


def _residual(plain: Scene, space: Space, recording: Recording, channel: str) -> Callable[..., Any]:
    """Its residual function of one recording; plain: the scene with its sensors."""
    from droid_jax.model.physics import make_c_model
    from droid_jax.simulate.replay import make_drive
    from droid_jax.simulate.servo_gains import scale_gains, servo_factors

    sysid = library()
    drive = make_drive(plain, recording)
    factors = servo_factors(plain, drive)
    state = sysid.create_initial_state(plain.model, drive.qpos0)
    control = sysid.TimeSeries(drive.time, drive.command)
    measured = _measured(recording, channel, plain.joints)
    sequences = sysid.ModelSequences(
        recording.name, plain.spec, "repeats", state, control, measured, allow_missing_sensors=True
    )
    return sysid.build_residual_fn(
        models_sequences=[sequences],
        build_model=lambda parameters, spec: scale_gains(make_c_model(plain, space, parameters.as_vector()), factors),
        modify_residual=_difference(plain, space, channel),
        resample_true=False,
    )


def parameters_of(space: Space) -> Any:
    """Its parameters at our means and within our bounds."""
    sysid = library()
    parameters = sysid.ParameterDict()
    for p in space.parameters:
        parameters.add(sysid.Parameter(p.name, nominal=p.mean, min_value=p.low, max_value=p.high))
    return parameters


def with_priors(residual: Callable[..., Any], space: Space, noise: float) -> Callable[..., Any]:
    """Its residual function with one more row for each nuisance: how many prior deviations it is off its mean.

    noise: size of a row of the measurement's where nothing but noise is left, so that both weigh alike.
    """
    rows = [i for i, p in enumerate(space.parameters) if p.nuisance]
    mean, std = space.mean[rows], space.std[rows]

    def whole(x: np.ndarray, parameters: Any, **more: Any) -> Any:  # x: [D], or [D, n] of finite differences
        parts, *rest = residual(x, parameters, **more)
        return [*parts, noise * ((x[rows].T - mean) / std).T], *rest

    return whole


def _torques(recording: Recording) -> np.ndarray:
    """[N, T, J] N m, NaN where none was measured."""
    channel = recording.channel("torque")
    return np.where(channel.mask, channel.values, np.nan)


def _noise(recording: Recording) -> float:
    """RMS of what the mean torque's noise is in rows of `normalize_residual`."""
    values = _torques(recording)
    mean = np.nanmean(values, axis=0)
    scatter = np.nanstd(values, axis=0, ddof=1) / np.sqrt(recording.repeats)
    return float(np.sqrt(np.nanmean((scatter / (np.linalg.norm(mean, axis=0) / np.sqrt(2))) ** 2)))


def _measured(recording: Recording, name: str, joints: Sequence[str]) -> Any:
    """Its time series of a channel's mean over the repeats, of these joints."""
    sysid = library()
    channel = recording.channel(name)
    columns = [channel.columns.index(joint) for joint in joints]
    mean = np.nanmean(np.where(channel.mask, channel.values, np.nan), axis=0)[:, columns]
    names = {name: (sysid.SignalType.CustomObs, np.array([i])) for i, name in enumerate(joints)}
    return sysid.TimeSeries(channel.time - recording.time[0], mean, signal_mapping=names)


def _difference(scene: Scene, space: Space, channel: str) -> Any:
    """Its residual of one rollout: offsets in time and torque applied, at the times of the measurement.

    Rows of sensors belong to the state before a step, its clock to the state after it.
    """
    from droid_jax.recordings.clocks import interpolate

    sysid = library()
    joints = len(scene.joints)
    first = joints if channel == "position" else 0  # column of the sensors: torques, then positions
    offsets = [space.names.index(n) if n in space.names and not first else None for n in _offsets(scene)]
    late = space.names.index("time_offset") if "time_offset" in space.names else None

    def modify(parameters, predicted, measured, model, return_pred_all, state=None, sensor_weights=None):
        x = parameters.as_vector()
        at = measured.times - (0.0 if late is None else x[late])
        clock = predicted.times - model.opt.timestep
        values = interpolate(at, clock, predicted.data[:, first : first + joints])
        values += [0.0 if i is None else x[i] for i in offsets]
        trace = sysid.TimeSeries(measured.times, values, measured.signal_mapping)
        error = sysid.weighted_diff(predicted_data=values, measured_data=measured.data, model=model)
        return sysid.normalize_residual(error, measured.data), trace, measured

    return modify


def _offsets(scene: Scene) -> list[str]:
    return [f"torque_offset[{joint}]" for joint in scene.joints]
