"""Functions of the experiments on real logs: filter, inverse-mode cost, fit, figures, results.

A log without commands is replayed in inverse mode: its measured motion is prescribed, and the torque that this motion
needs is compared with the measured one.  The filters were fixed beforehand:

1. Motion: the measured position, zero-phase Butterworth of order 4 at the experiment's cutoff, then
   central differences at the log's own rate (`droid_jax.simulate.measured_motion`).
2. Torque: measured and simulated pass through the program's own low-pass (`droid_jax.cost.noise`,
   windowed sinc, 8 Hz, read off at 20 Hz), the same kernel for both.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tuned  # noqa: F401  before anything that imports jax

# isort: split
import numpy as np
from matplotlib.figure import Figure

from benchmarks import common
from droid_jax.cost import noise
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.identify.fit import Fit
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.identifiability import calibrated, identifiability, time_blocks
from droid_jax.identify.multistart import Refined, refine
from droid_jax.identify.search import CmaConfig, cma_search
from droid_jax.model.effect_interface import Effect
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene
from droid_jax.recordings.checks import validate
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention
from droid_jax.report import style
from droid_jax.report.style import png_bytes
from droid_jax.simulate.measured_motion import Motion
from droid_jax.simulate.rest import RestConfig
from droid_jax.storage import write_bytes

RESULTS = Path(__file__).parent / "results"
LEVEL = 0.9  # of all intervals


# Measurement -------------------------------------------------------------------------------


def read_npz(folder: Path, name: str, keys: Sequence[str], source: str) -> dict[str, np.ndarray]:
    """Arrays of one npz file; the error for a missing file or array says where the data come from."""
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
    """Values [T, C] interpolated to a clock [Tc] s, as [Tc, C]; rows that repeat the previous row are left out.

    A repeated row is a lost packet, not a robot that stood still for a millisecond.
    """
    fresh = np.r_[True, np.any(np.diff(values, axis=0) != 0, axis=1)]
    return interpolate(clock, time[fresh], values[fresh])


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


# Comparison --------------------------------------------------------------------------------


# Dry friction is loss * sgn(speed) at every sample, at rest too: the law with which published values were fitted.
SIGN_LAW = RestConfig(speed=0.0, noise=0.0, share=0.0)


def inverse_cost(
    scene: Scene,
    space: Space,
    recording: Recording,
    motion_cutoff: float,
    effects: Sequence[Effect] = (),
    rest: RestConfig = SIGN_LAW,
) -> Cost:
    """The inverse-mode cost of a log: root mean square of the residuals in units of the noise stated."""
    config = CompareConfig(whitened=True, motion_cutoff=motion_cutoff, rest=rest)
    return make_cost(scene, space, [recording], config=config, effects=effects)


def share_at_rest(cost: Cost) -> float:
    """Share of the motion's samples, over all joints, at which friction is an interval."""
    (motion,) = cost.drives
    assert isinstance(motion, Motion) and motion.rest is not None
    return round(float(np.mean(motion.rest)), 3)


def measured_torque(cost: Cost) -> np.ndarray:
    """[K, C] measured torque, filtered, in the channel's unit."""
    return cost.comparisons[0].channel("torque").noise.mean


def clock_of(cost: Cost) -> np.ndarray:
    """[K] s of `measured_torque` and `residual`."""
    return cost.comparisons[0].channel("torque").clock


def residual(cost: Cost, values: np.ndarray) -> np.ndarray:
    """[K, C] measured minus simulated torque of one vector [D], filtered, in the channel's unit."""
    (simulated,) = cost.smoothed(values[None])
    return measured_torque(cost) - simulated[0].astype(np.float64)


def rms(residuals: np.ndarray) -> np.ndarray:
    """[C] root mean square over time of residuals [K, C]."""
    return np.sqrt(np.mean(residuals**2, axis=0))


# Fit ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of one fit: best [D] physical values, the calibrated Gaussian around it and the refinement."""

    space: Space
    best: np.ndarray
    gaussian: Gaussian
    refined: Refined


def find(cost: Cost, space: Space, config: CmaConfig) -> Fit:
    """CMA-ES from the prior; the noise is estimated from the residuals at the prior's mean."""
    fit = cma_search(cost.with_estimated_noise(space.mean), space, config)
    print(f"  CMA-ES: cost {fit.best_cost:.4f} after {len(fit.history.sigma)} generations ({fit.stop})", flush=True)
    return fit


def estimate(cost: Cost, space: Space, start: np.ndarray, block: float) -> Estimate:
    """Gauss-Newton from a fitted vector [D], its width calibrated over contiguous blocks of `block` s.

    The noise and its correlation in time are estimated from the residuals at `start`.  Raises ValueError where the
    correlation time exceeds a block.
    """
    left = residual(cost, start)
    longest = noise.correlation_time(left).max()
    if longest > block:
        raise ValueError(f"block: residuals stay correlated for {longest:.2f} s, got {block} s")
    refined = refine(cost.with_estimated_noise(start).whitened, space, start)
    samples, columns = left.shape
    blocks = time_blocks([(columns, samples)], [samples / noise.DEFAULT_NOISE.rate], block)
    return Estimate(space, refined.best, calibrated(refined, (), blocks), refined)  # one repeat: no scatter


def possible_bodies(scene: Scene, space: Space, draws: np.ndarray, links: Sequence[str]) -> dict[str, int]:
    """Number of draws [N, D], and of those whose links have an inertia that a body can have, in compiled models."""
    rows, possible = [scene.id("body", link) for link in links], 0
    for values in draws:
        model = make_c_model(scene, space, values)
        moments = np.sort(model.body_inertia[rows], axis=1)
        positive = (model.body_mass[rows] > 0) & (moments[:, 0] > 0)
        possible += bool(np.all(positive & (moments[:, 2] <= moments[:, :2].sum(axis=1) * (1 + 1e-9))))
    return {"draws": len(draws), "possible": possible}


def table(result: Estimate) -> list[dict[str, Any]]:
    """One entry per parameter: value, interval, and whether this recording identifies it."""
    low, high = result.gaussian.interval(LEVEL)
    verdicts = identifiability(result.gaussian, np.ones(len(result.space)))
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
            "identifiable": verdicts[i].identifiable,
            "why": verdicts[i].reason,
        }
        for i, p in enumerate(result.space.parameters)
    ]


# Output ------------------------------------------------------------------------------------


def rounded(values: Any, digits: int = 4) -> list[float]:
    """A list of plain numbers for a result file."""
    return [round(float(v), digits) for v in np.atleast_1d(values)]


@style.styled
def draw_fit(
    time: np.ndarray,
    titles: Sequence[str],
    measured: np.ndarray,
    lines: Mapping[str, tuple[np.ndarray, str]],
    ylabel: str,
) -> Figure:
    """One panel per column: measured [T, C] in black and every line [T, C] in its colour over time [T] s."""
    width, height = (style.WIDE, 1.8) if len(titles) > 1 else (6.0, 2.8)  # 6: the widest with one column
    figure, panels = style.panel_grid(len(titles), width, height)
    for c, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        axes.plot(time, measured[:, c], color=style.MEASURED, linewidth=1.8, label="measured")
        for name, (line, colour) in lines.items():
            axes.plot(time, line[:, c], color=colour, linewidth=1.1, label=name)
        axes.set(title=title, xlim=(time[0], time[-1]), ylabel="" if c % style.panel_columns(width) else ylabel)
    style.label_bottom(panels, width, "Time [s]")
    style.legend(figure, panels[0], width, 1 + len(lines))
    return figure


def publish(folder: Path, name: str, quick: bool, seed: int, result: Mapping[str, Any], figure: Figure) -> None:
    """Write folder/name.png and folder/name.json, with the origin of the result; print the JSON as the last line."""
    path = folder / f"{common.stem(name, quick)}.png"
    write_bytes(path, png_bytes(figure))
    print(f"  writes {path} and .json")
    common.publish(folder, name, quick, seed, result)


def run(experiment: Callable[[], None]) -> None:
    """Run an experiment; bad input ends in one line on stderr and exit code 2."""
    try:
        experiment()
    except (FileNotFoundError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
