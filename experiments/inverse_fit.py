"""What the experiments on real logs share: filter, inverse-mode cost, fit, figures, results.

A log without commands is replayed in inverse mode: its measured motion is prescribed and the torque
that this takes is compared with the measured one.  One filter chain, fixed beforehand:

1. Motion: the measured position, zero-phase Butterworth of order 4 at the experiment's `cutoff`, then
   central differences at the log's own rate.  Measured velocities are not used.
2. Torque: measured and simulated pass through the program's own low-pass (`droid_jax.measure.noise`,
   windowed sinc, 8 Hz, read off at 20 Hz), the same kernel for both.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tuned  # noqa: F401  before anything that imports jax

# isort: split
import numpy as np
from matplotlib.figure import Figure
from scipy import signal

from droid_jax.compare.cost import Cost, assemble, batch_replay
from droid_jax.compare.replay import Motion, inverse_replay
from droid_jax.compare.residuals import CompareConfig, Comparison, make_comparison
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.refine import Refined, refine
from droid_jax.identify.search import Fit, SearchConfig, search
from droid_jax.identify.uncertainty import calibrated, identifiability, time_blocks
from droid_jax.measure import noise
from droid_jax.measure.recording import Channel, Recording, TorqueConvention, validate
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect
from droid_jax.report import figures

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from common import origin, write_json  # pyright: ignore[reportMissingImports]

RESULTS = Path(__file__).parent / "results"
LEVEL = 0.9  # of all intervals


# Measurement -------------------------------------------------------------------------------


def read_npz(folder: Path, name: str, keys: Sequence[str], source: str) -> dict[str, np.ndarray]:
    """Arrays of one npz file; FileNotFoundError or ValueError says what is missing and where it comes from."""
    path = Path(folder) / name
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; --data is the folder that holds it. {source}")
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = [k for k in keys if k not in file.files]
            found = {k: np.asarray(file[k], dtype=np.float64) for k in keys if k in file.files}
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{path} is no readable npz file ({error})") from None
    if missing:
        raise ValueError(f"{path}: expected arrays {', '.join(keys)}; missing: {', '.join(missing)}")
    for key, array in found.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: array {key!r} holds numbers that are not finite")
    return found


def resampled(time: np.ndarray, values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """[Tc, C] values [T, C] interpolated to a clock [Tc] s; rows that only repeat the one before are left out.

    A repeated row is a packet that did not arrive, not a robot that stood still for a millisecond.
    """
    fresh = np.r_[True, np.any(np.diff(values, axis=0) != 0, axis=1)]
    return np.stack([np.interp(clock, time[fresh], values[fresh, c]) for c in range(values.shape[1])], axis=1)


def make_recording(
    name: str,
    joints: Sequence[str],
    time: np.ndarray,
    position: np.ndarray,
    torque: np.ndarray,
    convention: TorqueConvention,
    unit: tuple[str, str] = ("rad", "N m"),
) -> Recording:
    """A recording of one repeat without commands: position and torque [T, J] at regular times [T] s."""
    mask = np.ones((1, *position.shape), dtype=bool)
    channels = {
        "position": Channel("position", unit[0], tuple(joints), time, position[None], mask),
        "torque": Channel("torque", unit[1], tuple(joints), time, torque[None], mask),
    }
    none = np.zeros((0, 0))
    return validate(Recording(name, np.zeros(0), none, (), channels, convention, qpos0={}))


def filtered_motion(recording: Recording, cutoff: float) -> Motion:
    """The recording's motion at its own rate: position [T, J] low-passed at `cutoff` Hz, and its differences."""
    channel = recording.channel("position")
    rate = (len(channel.time) - 1) / (channel.time[-1] - channel.time[0])
    sections = signal.butter(4, cutoff, fs=rate, output="sos")
    q = signal.sosfiltfilt(sections, channel.values[0], axis=0)
    qd = np.gradient(q, 1 / rate, axis=0)
    return Motion(channel.time, q, qd, np.gradient(qd, 1 / rate, axis=0), recording.torque)


# Comparison --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a recording ready to be replayed: motion on the simulation's clock and what was measured."""

    motion: Motion
    comparison: Comparison


def make_stretch(
    scene: Scene, recording: Recording, motion: Motion, window: tuple[float, float], rate: float
) -> Stretch:
    """The stretch from window[0] to window[1] s, simulated at `rate` Hz."""
    part = recording.window(*window)
    first, last = part.span
    clock = first + np.arange(int(np.floor((last - first) * rate + 1e-6)) + 1) / rate
    moved = {
        key: np.stack([np.interp(clock, motion.time, column) for column in getattr(motion, key).T], axis=1)
        for key in ("position", "velocity", "acceleration")
    }
    comparison = make_comparison(scene, part, 1 / rate, len(clock), CompareConfig(whitened=True))
    return Stretch(Motion(time=clock, torque=recording.torque, **moved), comparison)


def inverse_cost(scene: Scene, space: Space, stretch: Stretch, effects: Sequence[Effect]) -> Cost:
    """The inverse-mode cost of one stretch: root mean square of the residuals in noise units."""
    replay = batch_replay(scene, space, inverse_replay(scene, stretch.motion, effects))
    return assemble(scene, space, (stretch.comparison,), (replay,))


@dataclass(frozen=True, eq=False)
class Stated:
    """A cost whose noise is stated: `deviation` [C], in the channel's unit, of each torque column.

    One repeat does not tell its own noise, and what the model cannot explain is far larger anyway.
    """

    cost: Cost
    deviation: np.ndarray

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, M] residuals in units of the stated noise."""
        assumed = self.cost.comparisons[0].channel("torque").noise.whitener  # [C, K, K]: one repeat makes it diagonal
        scale = 1 / (self.deviation * assumed[:, 0, 0])
        return self.cost.whitened(values) * np.repeat(scale, assumed.shape[1])

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P] root mean square of the residuals in units of the stated noise."""
        return np.sqrt(np.mean(self.whitened(values) ** 2, axis=1))


def measured_torque(cost: Cost) -> np.ndarray:
    """[K, C] measured torque, filtered, in the channel's unit."""
    return cost.comparisons[0].channel("torque").noise.mean


def clock_of(cost: Cost) -> np.ndarray:
    """[K] s of `measured_torque` and `residual`."""
    return noise.coarse_clock(*cost.comparisons[0].channel("torque").span)


def residual(cost: Cost, values: np.ndarray) -> np.ndarray:
    """[K, C] measured minus simulated torque of one vector [D], filtered, in the channel's unit."""
    (simulated,) = cost.smoothed(values[None])
    return measured_torque(cost) - simulated[0].astype(np.float64)


def rms(residuals: np.ndarray) -> np.ndarray:
    """[C] root mean square over time of residuals [K, C]."""
    return np.sqrt(np.mean(residuals**2, axis=0))


def correlation_time(residuals: np.ndarray) -> np.ndarray:
    """[C] s, how long the residuals [K, C] stay correlated: sum of the autocorrelation up to its first zero.

    Two-sided, so that K / (RATE * this) is about the number of independent samples.
    """
    times = []
    for column in (residuals - residuals.mean(axis=0)).T:
        lags = np.correlate(column, column, "full")[len(column) - 1 :]
        lags = lags / lags[0]
        end = int(np.argmax(lags <= 0)) or len(lags)
        times.append((2 * lags[:end].sum() - 1) / noise.RATE)
    return np.array(times)


def discrepancy(residuals: np.ndarray) -> np.ndarray:
    """[C] deviation to state as noise so that correlated residuals [K, C] count as often as they are independent."""
    return rms(residuals) * np.sqrt(np.maximum(1.0, correlation_time(residuals) * noise.RATE))


# Fit ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of one fit: best [D] physical values, the calibrated Gaussian around it and the refinement."""

    space: Space
    best: np.ndarray
    gaussian: Gaussian
    refined: Refined


def find(cost: Cost, space: Space, config: SearchConfig) -> Fit:
    """CMA-ES from the prior, each torque column counted in units of its residual before the fit."""
    fit = search(Stated(cost, rms(residual(cost, space.mean))), space, config)
    print(f"  CMA-ES: cost {fit.best_cost:.4f} after {len(fit.history.sigma)} generations ({fit.stop})", flush=True)
    return fit


def estimate(cost: Cost, space: Space, start: np.ndarray, block: float) -> Estimate:
    """Gauss-Newton from a fitted vector [D], its width calibrated over contiguous blocks of `block` s.

    The noise stated is what `start` leaves unexplained, with its correlation in time.  Raises ValueError
    where that correlation outlasts a block.
    """
    left = residual(cost, start)
    if correlation_time(left).max() > block:
        raise ValueError(f"block: residuals stay correlated for {correlation_time(left).max():.2f} s, got {block} s")
    refined = refine(Stated(cost, discrepancy(left)).whitened, space, start)
    samples, columns = left.shape
    blocks = time_blocks([(columns, samples)], [samples / noise.RATE], block)
    return Estimate(space, refined.best, calibrated(refined, (), blocks), refined)  # one repeat: no scatter


def table(result: Estimate) -> list[dict[str, Any]]:
    """One entry per parameter: value, interval, and what this recording tells about it."""
    low, high = result.gaussian.interval(LEVEL)
    told = identifiability(result.gaussian, np.ones(len(result.space)))
    return [
        {
            "name": p.name,
            "unit": p.unit,
            "nuisance": p.nuisance,
            "prior_mean": p.mean,
            "prior_std": p.std,
            "value": float(result.best[i]),
            "interval": [float(low[i]), float(high[i])],
            "excludes_zero": bool(low[i] > 0 or high[i] < 0),
            "identifiable": told[i].identifiable,
            "why": told[i].reason,
        }
        for i, p in enumerate(result.space.parameters)
    ]


# Output ------------------------------------------------------------------------------------


def rounded(values: Any, digits: int = 4) -> list[float]:
    """A list of plain numbers for a result file."""
    return [round(float(v), digits) for v in np.atleast_1d(values)]


def draw_fit(
    time: np.ndarray,
    titles: Sequence[str],
    measured: np.ndarray,
    lines: Mapping[str, tuple[np.ndarray, str]],
    ylabel: str,
) -> Figure:
    """One panel per column: measured [T, C] in black and every line [T, C] in its colour over time [T] s."""
    columns = 2 if len(titles) > 1 else 1
    rows = -(-len(titles) // columns)
    figure = Figure(figsize=(figures.WIDE, 0.7 + (1.8 if columns > 1 else 2.8) * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for unused in panels[len(titles) :]:
        unused.set_visible(False)
    for c, (axes, title) in enumerate(zip(panels, titles, strict=False)):
        axes.plot(time, measured[:, c], color=figures.MEASURED, linewidth=1.8, label="measured")
        for name, (line, colour) in lines.items():
            axes.plot(time, line[:, c], color=colour, linewidth=1.1, label=name)
        axes.set(title=title, xlim=(time[0], time[-1]))
        axes.set_ylabel(ylabel if c % columns == 0 else "")
        axes.grid(color=figures.LINE, linewidth=0.6)
        if c >= len(titles) - columns:
            axes.set_xlabel("Time [s]")
            axes.tick_params(labelbottom=True)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=len(labels), frameon=False)
    return figure


def publish(folder: Path, stem: str, seed: int, result: Mapping[str, Any], figure: Figure) -> None:
    """Write folder/stem.json, with its origin, and folder/stem.png; print the JSON as one last line."""
    whole = {**origin(seed), **result}
    write_json(folder / f"{stem}.json", whole)
    figures.write_atomically(folder / f"{stem}.png", figures.png_bytes(figure))
    print(f"  wrote {folder / stem}.json and .png")
    print(json.dumps(whole))


def run(experiment: Callable[[], None]) -> None:
    """Run an experiment; bad input ends in one line on stderr and exit code 2."""
    try:
        experiment()
    except (FileNotFoundError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
