"""Identification from recordings to a Gaussian: split, search, refine, calibrate, judge on held-out repeats."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.compare.cost import Cost, make_cost
from droid_jax.compare.residuals import CompareConfig
from droid_jax.identify.fit import Fit
from droid_jax.identify.gaussian import Gaussian, prior
from droid_jax.identify.refine import RefineConfig, Refined, refine
from droid_jax.identify.search import SearchConfig, search
from droid_jax.identify.uncertainty import Identifiability, identifiability, not_judged, posterior
from droid_jax.measure.recording import Recording
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect


@dataclass(frozen=True)
class IdentifyConfig:
    """Settings of an identification.

    engine: "mjx" or "mujoco" (plain C, all cores).
    heldout: share of each recording's repeats that the fit does not see (at least one where there are two).
    search: CMA-ES settings; it sees the first recording alone, the refinement sees all of them.
    refine: refinement settings, or None: the search's own covariance is the distribution, as in the paper.
    samples: replays drawn from the initial and from the fitted Gaussian to compare their costs.
    seed: of the split and of those samples (the search has its own).
    compare: how simulation and measurement are compared.
    """

    engine: str = "mjx"
    heldout: float = 0.3
    search: SearchConfig = field(default_factory=SearchConfig)
    refine: RefineConfig | None = field(default_factory=RefineConfig)
    samples: int = 200
    seed: int = 0
    compare: CompareConfig = field(default_factory=CompareConfig)


@dataclass(frozen=True)
class Gap:
    """Disagreement with held-out repeats of one recording, N m, before and after the fit.

    before, after, floor: equation 1 without penalty terms; floor is what a perfect model would
    leave, estimated from the repeats' scatter about their mean.  closed: share of the way from
    before to floor.  Floors and closed are None where there is one repeat only.
    per_joint_*: [J] root mean square of the smoothed traces' difference.
    """

    before: float
    after: float
    floor: float | None
    closed: float | None
    per_joint_before: tuple[float, ...]
    per_joint_after: tuple[float, ...]
    per_joint_floor: tuple[float, ...] | None


@dataclass(frozen=True, eq=False)
class Identified:
    """Everything an identification found.

    space: what was searched; full: with the nuisances (the same where nothing was refined).
    best: [F] physical values over `full`.  gaussian: over `space`, the one to hand on; full_gaussian
    over `full`.  search: the CMA-ES part.  refined: or None.  tells: per parameter of `full`.
    gaps: by recording name.  fit, heldout: costs over `full` on the fitted and the held-out repeats.
    heldout_repeats: by recording name.  seconds: by stage.
    """

    scene: Scene
    space: Space
    full: Space
    best: np.ndarray
    gaussian: Gaussian
    full_gaussian: Gaussian
    search: Fit
    refined: Refined | None
    tells: tuple[Identifiability, ...]
    gaps: dict[str, Gap]
    fit: Cost
    heldout: Cost
    heldout_repeats: dict[str, tuple[int, ...]]
    seconds: dict[str, float]

    @property
    def start(self) -> np.ndarray:
        """[F] the initial means over `full`."""
        return self.full.mean


Progress = Callable[[str, Any], None]


def split(recording: Recording, share: float) -> tuple[Recording, Recording, tuple[int, ...]]:
    """Fitted and held-out repeats (the last ones), and the latter's indices.

    Of one repeat without commands the last part in time is held out; with commands, one serves as both.
    """
    count = recording.repeats
    if count == 1 and not recording.command.size:
        first, last = recording.span
        cut = last - max(share, 1 / 3) * (last - first)
        return recording.window(first, cut), recording.window(cut, last), (0,)
    held = min(count - 1, max(1, round(share * count))) if count > 1 else 0
    if held == 0:
        return recording, recording, tuple(range(count))
    rows = tuple(range(count - held, count))
    return recording.repeats_subset(range(count - held)), recording.repeats_subset(rows), rows


def identify(
    scene: Scene,
    space: Space,
    recordings: Sequence[Recording],
    *,
    nuisances: Space | None = None,
    config: IdentifyConfig | None = None,
    effects: Sequence[Effect] = (),
    checkpoints: Path | None = None,
    progress: Progress | None = None,
) -> Identified:
    """Fit `space` to one or several recordings of the same robot and object.

    nuisances: fitted and marginalised beside it in the refinement; None for none.
    effects: in the model beside what the scene has; their parameters are in `space` or stay at neutral.
    checkpoints: folder where the search saves itself and from which it resumes.
    progress: called with a stage's name and its progress value.
    """
    config = config or IdentifyConfig()
    report = progress or (lambda stage, value: None)
    names = [r.name for r in recordings]
    if len(set(names)) != len(names):
        raise ValueError(f"recordings need different names, got {', '.join(names)}")
    parts = [split(r, config.heldout) for r in recordings]
    fitted, held = [p[0] for p in parts], [p[1] for p in parts]
    full = space if nuisances is None or config.refine is None else space + nuisances
    seconds: dict[str, float] = {}

    began = time.monotonic()
    base = make_cost(scene, full, fitted, engine=config.engine, config=config.compare, effects=effects)
    first = base.first()
    found = search(
        lambda rows: first(full.embed(space, rows)),
        space,
        config.search,
        checkpoint_dir=checkpoints,
        fingerprint=fitted[0].sha256 + config.engine,
        progress=lambda p: report("search", p),
    )
    seconds["search"] = time.monotonic() - began

    began = time.monotonic()
    refined = None
    if config.refine is not None:
        base, refined = _refined(base, starts(full, space, found), config.refine, lambda p: report("refine", p))
    best = found.best if refined is None else refined.best
    full_gaussian = found.gaussian() if refined is None else posterior(refined, base.comparisons)
    seconds["refine"] = time.monotonic() - began

    began = time.monotonic()
    report("judge", None)
    plain = replace(config.compare, whitened=False)
    commanded = all(r.command.size for r in recordings)
    heldout = base.against(held, plain) if commanded else make_cost(scene, full, held, config=plain, effects=effects)
    gaps = _gaps(heldout, full.mean, best)
    seconds["judge"] = time.monotonic() - began
    return Identified(
        scene=scene,
        space=space,
        full=full,
        best=best,
        gaussian=full_gaussian.marginal(space.names),
        full_gaussian=full_gaussian,
        search=found,
        refined=refined,
        tells=not_judged(full_gaussian) if refined is None else identifiability(full_gaussian, refined.prior),
        gaps=dict(zip(names, gaps, strict=True)),
        fit=base,
        heldout=heldout,
        heldout_repeats={n: p[2] for n, p in zip(names, parts, strict=True)},
        seconds=seconds,
    )


def _refined(
    base: Cost, begin: np.ndarray, config: RefineConfig, report: Callable[[Any], None]
) -> tuple[Cost, Refined]:
    """The refinement from starts [S, F], and the cost it ended on.

    The noise of a single repeat is not known: it is stated twice, from what the search and then from
    what a first refinement leaves unexplained.
    """

    def run(cost: Cost, begin: np.ndarray) -> Refined:
        hypotheses = grip_hypotheses(cost.space)
        rough = cost.first().whitened
        return refine(cost.whitened, cost.space, begin, config, first=rough, hypotheses=hypotheses, progress=report)

    if all(c.repeats > 1 for c in base.comparisons):
        return base, run(base, begin)
    base = base.restated(begin[0])
    base = base.restated(run(base, begin).best)
    return base, run(base, begin)


def starts(full: Space, space: Space, found: Fit) -> np.ndarray:
    """[3, F] where the refinement begins: the search's best, the initial means, and these with a firm grip.

    A grip that slips and one that never does are different basins, and neither start finds the other's.
    """
    searched = full.embed(space, found.best[None])[0]
    firm = {p.name: min(p.high, 4.0 * p.mean) for p in space.parameters if p.name.startswith(("sliding", "torsional"))}
    return np.stack([searched, full.mean, full.values(firm)])


def grip_hypotheses(space: Space) -> list[dict[str, float]]:
    """Which fingers slip: each sliding friction alone, and all, at its initial mean.

    Slip is a basin of its own: from a sticking finger no derivative sees it.
    """
    sliding = {p.name: p.mean for p in space.parameters if p.name.startswith("sliding_friction")}
    alone = [{name: mean} for name, mean in sliding.items()]
    return [*alone, sliding] if len(sliding) > 1 else alone


def _gaps(cost: Cost, before: np.ndarray, after: np.ndarray) -> list[Gap]:
    """The gap of each recording's held-out repeats at two parameter vectors."""
    penalty_free = cost.distances(np.stack([before, after])) - cost.penalties(np.stack([before, after]))
    smoothed = cost.smoothed(np.stack([before, after]))
    out = []
    for i, comparison in enumerate(cost.comparisons):
        torque = comparison.channel("torque")
        mean = torque.noise.mean
        rms = np.sqrt(np.mean((smoothed[i] - mean) ** 2, axis=1))
        floor = _floor(torque.values, torque.mask)
        first, last = penalty_free[0, i], penalty_free[1, i]
        out.append(
            Gap(
                before=float(first),
                after=float(last),
                floor=floor,
                closed=None if floor is None else float(1 - (last - floor) / max(first - floor, 1e-12)),
                per_joint_before=tuple(rms[0].tolist()),
                per_joint_after=tuple(rms[1].tolist()),
                per_joint_floor=_smooth_floor(torque.noise.repeats),
            )
        )
    return out


def _floor(values: np.ndarray, mask: np.ndarray) -> float | None:
    """Equation 1 of a perfect model: the repeats' distance to their mean, corrected for the mean's own noise."""
    count = len(values)
    if count < 2:
        return None
    filled = np.where(mask, values, np.nan)
    error = np.nan_to_num(filled - np.nanmean(filled, axis=0))
    return float(np.mean(np.linalg.norm(error, axis=-1)) / np.sqrt(1 - 1 / count))


def _smooth_floor(repeats: np.ndarray) -> tuple[float, ...] | None:
    """[J] what the noise of the repeats' mean leaves of a smoothed difference, N m."""
    count = len(repeats)
    if count < 2:
        return None
    variance = np.var(repeats, axis=0, ddof=1).mean(axis=0)
    return tuple(np.sqrt(variance / count).tolist())


def cost_samples(found: Identified, count: int, seed: int) -> dict[str, np.ndarray]:
    """Costs on held-out repeats of samples from the initial and from the fitted Gaussian.

    initial, fitted: [n, D] values; initial_cost, fitted_cost: [n] N m, failed replays carry their penalty.
    """
    first = prior(found.space).sample(seed, count)
    last = found.full_gaussian.sample(seed, count)
    return {
        "initial": first,
        "fitted": last[:, found.full.columns(found.space)],
        "initial_cost": found.heldout(found.full.embed(found.space, first)),
        "fitted_cost": found.heldout(last),
        "names": np.array(found.space.names),
    }
