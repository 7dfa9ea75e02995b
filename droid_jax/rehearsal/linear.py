"""A scene, its motion and its noise as a linear model: what each effect adds, and what it is taken for.

An effect adds its sensitivity times its size to the residual, and the base parameters absorb what they can of it.
Whitened noise has a deviation of one in each repeat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy.stats
from scipy.optimize import lsq_linear

from droid_jax.arguments import check_fields, number, weights, whole
from droid_jax.discrepancy.candidates import ScoreDirection, project
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.statistics import Blocks, Repeats, Resampling
from droid_jax.model.effects.candidate import EffectKey


def _assumed() -> dict[str, float]:
    return {"torque": 0.05, "position": 1e-4, "velocity": 0.01, "object_angle": 0.0035}


@dataclass(frozen=True)
class RehearsalConfig:
    """What counts as found, and what is assumed where nothing was measured.

    share: of rehearsals in which an effect must be found.
    draws: of noise, over which that share is taken.
    flips: sign flips of a score test at most; the search itself makes up to 4096.
    close: absolute cosine of two sensitivities from which one stands for both in the largest statistic.
    recovered: posterior deviation over prior deviation up to which a parameter counts as recovered; None: that of
      `IdentifiabilityConfig`.
    pooling: degrees of freedom with which the scatter of all directions counts in each one's own.
    noise: channel -> deviation of one sample, in its unit, where it was neither measured nor stated; torque,
      position and camera are those of a Panda.
    margin: times what the linear model predicts that a size must be; of ten effects on a lone hinge four were found at
      1.4 times that and not at it, since another robot's parameters and law are not quite the linear ones.
    faster: how many times as fast the other motion is.
    seed: of the draws.
    """

    share: float = 0.9
    draws: int = 40
    flips: int = 400
    close: float = 0.95
    recovered: float | None = None
    pooling: float = 12.0
    noise: dict[str, float] = field(default_factory=_assumed)
    margin: float = 1.4
    faster: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(
            self,
            share=partial(number, above=0, below=1),
            draws=partial(whole, least=8),
            flips=partial(whole, least=100),
            close=partial(number, above=0, most=1),
            pooling=partial(number, above=0),
            noise=weights,
            margin=partial(number, least=1),
            faster=partial(number, above=0),
            seed=partial(whole, least=0),
        )


@dataclass(frozen=True, eq=False)
class LinearPart:
    """One part of the recordings (training or validation) in a linear model.

    raw: [K, M] what a unit of each coefficient adds, in noise units of one repeat.  base: [M, D] what a search unit of
    each base parameter adds.  rows: what is resampled.  channel: [M] name of the channel of each residual.
    level: mean square of the residual where nothing is missing, of rows that are blocks.
    residual: [M] of the base model, whose colour the noise of blocks has; None: white noise of deviation one.
    column: [M] number of the compared column of each residual.
    step: [M] what a finer time step changes; None: not measured.
    """

    raw: np.ndarray
    base: np.ndarray
    rows: Resampling
    channel: np.ndarray
    level: float = 0.0
    step: np.ndarray | None = None
    residual: np.ndarray | None = None
    column: np.ndarray | None = None

    def of(self, channels: Sequence[str]) -> LinearPart:
        """The same of some channels."""
        kept = np.isin(self.channel, channels)
        rows = (
            Repeats(self.rows.deviations[:, kept]) if isinstance(self.rows, Repeats) else Blocks(self.rows.block[kept])  # type: ignore[attr-defined]
        )
        each = (None if a is None else a[kept] for a in (self.step, self.residual, self.column))
        return LinearPart(self.raw[:, kept], self.base[kept], rows, self.channel[kept], self.level, *each)

    def noise(self, draws: int, rng: np.random.Generator) -> np.ndarray:
        """[R, M] drawn noise of one log: the base residual with other phases, column by column, where it counts.

        So it is as large and as slow as what the base model leaves.  Source of the phases: Theiler et al., Testing for
        nonlinearity in time series, Physica D 1992.
        """
        counted = self.rows.counted
        if self.residual is None or self.column is None:
            return rng.normal(size=(draws, len(counted))) * counted
        out = np.zeros((draws, len(counted)))
        for column in np.unique(self.column):
            at = np.flatnonzero((self.column == column) & counted)
            spectrum = np.abs(np.fft.rfft(self.residual[at]))
            turned = spectrum * np.exp(2j * np.pi * rng.random((draws, len(spectrum))))
            turned[:, 0] = spectrum[0] * rng.choice([-1.0, 1.0], draws)
            out[:, at] = np.fft.irfft(turned, len(at), axis=1)
        return out


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A linear model of a search.

    directions: K coefficients.  train, validation: parts.  prior: [D] deviations of the base parameters' priors in a
    fit, search units.  slack: times these that the score test lets parameters move.  repeats: N that are rehearsed; of
    blocks how many times the recording's own length, times its blocks.
    minimum: [K] minimum effect size.  low, high: [K] bounds of each coefficient, from neutral on.
    """

    directions: tuple[ScoreDirection, ...]
    train: LinearPart
    validation: LinearPart
    prior: np.ndarray
    slack: float
    repeats: int
    minimum: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def room(self) -> np.ndarray:
        """[K] largest size of each coefficient: upwards, or downwards where neutral is the upper bound."""
        return np.where(self.high > 0, self.high, -self.low)

    @property
    def sign(self) -> np.ndarray:
        """[K] direction that a size counts in."""
        return np.where(self.high > 0, 1.0, -1.0)

    @property
    def repeated(self) -> bool:
        """Whether rows are repeats."""
        return self.train.rows.repeated

    def of(self, channels: Sequence[str]) -> LinearModel:
        """The same with some channels compared."""
        return replace(self, train=self.train.of(channels), validation=self.validation.of(channels))

    @property
    def step_error(self) -> float:
        """U0: what the base parameters cannot absorb of a finer time step's difference."""
        if self.train.step is None:
            return 0.0
        left = project(self.train.step[None], self.train.base, self.held(1.0))[0]
        return float(left @ left / self.train.rows.counted.sum())

    def projected(self) -> np.ndarray:
        """[K, M] sensitivities of the training part, as the score test has them."""
        return project(self.train.raw, self.train.base, self.held(self.slack))

    def unabsorbed(self) -> np.ndarray:
        """[K, M] what a unit adds to the validation part once the base is fitted to the training part."""
        base, held = self.train.base, self.held(1.0)
        normal = base.T @ base + np.diag(held**-2)
        absorbed = np.linalg.solve(normal, base.T @ self.train.raw.T)  # [D, K]
        return self.validation.raw - (self.validation.base @ absorbed).T

    def held(self, slack: float) -> np.ndarray:
        """[D] prior deviations beside the residual of one repeat, or of the whole log."""
        return self.prior * slack * (self.repeats**0.5 if self.repeated else 1.0)


@dataclass(frozen=True)
class Rival:
    """A candidate that an effect may be taken for.

    key: of it.  share: of the effect's squared sensitivity that it takes too, within its bounds.  apart: size of the
    effect from which the search distinguishes them; inf where it never does.
    """

    key: EffectKey
    share: float
    apart: float


def rivals_of(model: LinearModel, k: int, size: float, config: DiscrepancyConfig, share: float) -> list[Rival]:
    """The candidates that the search would not distinguish from direction k at some size, the nearest first.

    By the search's own criterion: the worse of two models is worse in nearly all resamples of the validation
    recording, and leaves so many times the U that the better one leaves.

    Args:
        model: the linear model.
        k: the direction.
        size: of the effect, where its rivals' bounds are looked at.
        config: of the search.
        share: of rehearsals in which they must be distinguished.
    """
    if not np.isfinite(size):
        return []
    needed = _needed(model, config, share)
    out = []
    for imitation in imitations(model, k, size):
        left = max(1.0 - imitation.share, 0.0)
        strength = left * imitation.strength
        apart = float(np.sqrt(needed / strength)) if left > 1e-9 else np.inf
        if apart > size:
            out.append(Rival(imitation.key, imitation.share, apart if apart <= model.room[k] else np.inf))
    return sorted(out, key=lambda r: -r.share)


@dataclass(frozen=True)
class Imitation:
    """How well another candidate takes the place of an effect on the validation part.

    share: of the effect's square that it takes.  strength: squared noncentrality of a unit of the effect there.
    over: size of the effect from which the imitation is above its minimum effect size.
    """

    key: EffectKey
    share: float
    strength: float
    over: float


def imitations(model: LinearModel, k: int, size: float | None = None) -> list[Imitation]:
    """Of every other candidate, in its best shape, how it takes the place of direction k.

    size: of the effect, at which bounds of the others count; None: only their signs do.
    """
    added = np.nan_to_num(model.unabsorbed())
    target = model.sign[k] * added[k]
    whole = float(target @ target)
    if whole <= 0:
        return []
    groups: dict[EffectKey, list[int]] = {}
    for i, direction in enumerate(model.directions):
        if direction.candidate.key != model.directions[k].candidate.key:
            groups.setdefault(direction.candidate.shaped_key, []).append(i)
    best: dict[EffectKey, Imitation] = {}
    for rows in groups.values():
        low, high = model.low[rows], model.high[rows]
        if size is None:
            low, high = np.where(low < 0, -np.inf, 0.0), np.where(high > 0, np.inf, 0.0)
        taken, coefficients = _taken(added[rows], (size or 1.0) * target, low, high)
        least = model.minimum[rows] / np.maximum(np.abs(coefficients) / (size or 1.0), 1e-30)
        strength = whole * (model.repeats if model.repeated else 1)
        key = model.directions[rows[0]].candidate.key
        found = Imitation(key, taken / ((size or 1.0) ** 2 * whole), strength, float(least.min()))
        if key not in best or found.share > best[key].share:
            best[key] = found
    return list(best.values())


def unhindered(model: LinearModel, k: int, share: float) -> float:
    """Size of direction k from which no imitation below its own minimum effect size stands in its way.

    Where one leaves less on the validation recording, the search names nothing at all.  By chance it does in more than
    1 - share of the rehearsals up to a distance of two such deviations.
    """
    aside = 2 * max(float(scipy.stats.norm.ppf(share)), 0.0)
    return max(
        (min(i.over, aside / np.sqrt(max((1 - i.share) * i.strength, 1e-30))) for i in imitations(model, k)),
        default=0.0,
    )


def _taken(columns: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[float, np.ndarray]:
    """What coefficients with columns [C, M] within bounds take of the square of a target [M], and they [C]."""
    seen, coefficients = np.linalg.norm(columns, axis=1) > 1e-12, np.zeros(len(columns))
    if not seen.any():
        return 0.0, coefficients
    q, triangle = np.linalg.qr(columns[seen].T)
    bounds = (low[seen] - 1e-12, high[seen] + 1e-12)
    coefficients[seen] = lsq_linear(triangle, q.T @ target, bounds=bounds).x
    left = target - columns.T @ coefficients
    return float(target @ target - left @ left), coefficients


def _needed(model: LinearModel, config: DiscrepancyConfig, share: float) -> float:
    """Squared noncentrality that must stand between two models for the search to distinguish them."""
    selection = config.selection
    aside = float(scipy.stats.norm.isf(selection.equivalence_doubt) + abs(scipy.stats.norm.isf(share)))
    by_resamples = (2 * aside) ** 2
    counted = float(model.validation.rows.counted.sum())
    if model.repeated:  # U of the better one is noise about zero, of deviation sqrt(2 M) in these units
        often = abs(float(scipy.stats.norm.isf(share)))
        return max(by_resamples, (selection.equivalence_factor - 1) * often * (2 * counted) ** 0.5)
    return max(by_resamples, (config.blocks.equivalence_factor - 1) * model.validation.level * counted)
