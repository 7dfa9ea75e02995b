"""A scene, its motion and its noise as a linear model: what each effect adds, and what it is taken for.

An effect adds its sensitivity times its size to the residual, and the base parameters absorb what they can of it.
Whitened noise has a deviation of one in each repeat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
import scipy.stats
from scipy.optimize import lsq_linear

from droid_jax.arguments import check_fields, number, weights, whole
from droid_jax.discrepancy.candidates import ScoreDirection, project
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.statistics import Blocks, Repeats, Resampling, in_turns
from droid_jax.model.effects.candidate import EffectKey

FAR = 1e3  # deviations of the noise: more than any test asks for
POINTS = 24  # sizes at which each piece of what is left of a direction is worked out


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
    known: share of what is left of an effect that the library's own must take, for it to be said to be found.
    faster: how many times as fast the other motion is.
    samples, sample_length: windows, and s of each, of long logs of held joints (`WindowConfig`): a search replays more
      and longer ones, for ten minutes and not for two, and what these show it sees too.
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
    known: float = 0.5
    faster: float = 1.5
    samples: int = 24
    sample_length: float = 1.5
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
            known=partial(number, least=0, below=1),
            faster=partial(number, above=0),
            samples=partial(whole, least=1),
            sample_length=partial(number, above=0),
            seed=partial(whole, least=0),
        )


@dataclass(frozen=True, eq=False)
class LinearPart:
    """One part of the recordings (training or validation) in a linear model.

    raw: [K, M] what a unit of each coefficient adds, in noise units of one repeat; zero where its replay blew up.
    base: [M, D] what a search unit of each base parameter adds.  rows: what is resampled.  channel: [M] name of the
    channel of each residual.
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

    def quieter(self, share: float) -> LinearPart:
        """The same with so much of its residual, of blocks."""
        assert self.residual is not None
        return replace(self, residual=share * self.residual, level=share**2 * self.level)

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
    base_low, base_high: [D] by how much the base parameters may move, search units; None: without bounds.
    bound_margin: [K] how far from its bound a coefficient must end to be named.
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
    base_low: np.ndarray | None = None
    base_high: np.ndarray | None = None
    bound_margin: np.ndarray | float = 0.0

    @property
    def largest(self) -> np.ndarray:
        """[K] largest size of a coefficient that is named: upwards, or downwards where neutral is the upper bound."""
        return np.where(self.high > 0, self.high, -self.low) - self.bound_margin

    @property
    def sign(self) -> np.ndarray:
        """[K] direction that a size counts in."""
        return np.where(self.high > 0, 1.0, -1.0)

    @cached_property
    def tested(self) -> LinearPart:
        """What the score test is of: the training part, of blocks those of both parts."""
        train, validation = self.train, self.validation
        if not (isinstance(train.rows, Blocks) and isinstance(validation.rows, Blocks)) or train is validation:
            return train
        assert train.residual is not None and validation.residual is not None
        return replace(
            train, raw=train.raw + validation.raw, base=train.base + validation.base,
            rows=Blocks(in_turns([train.rows.block, validation.rows.block])),
            residual=train.residual + validation.residual,
        )  # fmt: skip

    @property
    def repeated(self) -> bool:
        """Whether rows are repeats."""
        return self.train.rows.repeated

    def of(self, channels: Sequence[str]) -> LinearModel:
        """The same with some channels compared."""
        return replace(self, train=self.train.of(channels), validation=self.validation.of(channels))

    def alone(self, rows: Sequence[int]) -> LinearModel:
        """Of some directions, with the training part as validation part too."""
        some = np.array(rows, int)
        train = replace(self.train, raw=self.train.raw[some])
        directions = tuple(self.directions[k] for k in some)
        minimum, low, high = (a[some] for a in (self.minimum, self.low, self.high))
        margin = np.broadcast_to(self.bound_margin, self.low.shape)[some]
        return replace(
            self, directions=directions, train=train, validation=train, minimum=minimum, low=low, high=high,
            bound_margin=margin,
        )  # fmt: skip

    @property
    def judging_repeats(self) -> float:
        """N of the validation part, where that of the training part is `repeats`: recordings may have other numbers."""
        return self.repeats * self.validation.rows.units / self.train.rows.units if self.repeated else 1.0

    @property
    def step_error(self) -> float:
        """U0: what the base parameters cannot absorb of a finer time step's difference."""
        if self.train.step is None:
            return 0.0
        left = project(self.train.step[None], self.train.base, self.held(1.0))[0]
        return float(left @ left / self.train.rows.counted.sum())

    def projected(self) -> np.ndarray:
        """[K, M] sensitivities as the score test has them."""
        return project(self.tested.raw, self.tested.base, self.held(self.slack))

    @cached_property
    def absorbed(self) -> np.ndarray:
        """[D, K] by how much a unit moves the base parameters that are fitted to the training part, without bounds."""
        base, held = self.train.base, self.held(1.0)
        return np.linalg.solve(base.T @ base + np.diag(held**-2), base.T @ self.train.raw.T)

    def inside(self, moved: np.ndarray) -> bool:
        """Whether base parameters that moved by so much [D] are within their bounds."""
        if self.base_low is None or self.base_high is None:
            return True
        return bool(np.all((moved >= self.base_low) & (moved <= self.base_high)))

    @cached_property
    def loosest(self) -> np.ndarray:
        """[K, M] what the base parameters, with their priors alone, leave of each sensitivity."""
        return project(self.train.raw, self.train.base, self.held(1.0))

    @cached_property
    def added(self) -> np.ndarray:
        """[K, M] what a unit adds to the validation part once the base is fitted to the training part."""
        return self.validation.raw - (self.validation.base @ self.absorbed).T

    @cached_property
    def products(self) -> np.ndarray:
        """[K, K] products of the rows of `added`."""
        return self.added @ self.added.T

    @cached_property
    def _beside(self) -> dict[bytes, tuple[np.ndarray, np.ndarray]]:
        return {}

    def beside(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[K, M] what base parameters free [D] leave of each sensitivity, and the products [K, K] of these."""
        key = free.tobytes()
        if key not in self._beside:
            columns = project(self.train.raw, self.train.base[:, free], self.held(self.slack)[free])
            self._beside[key] = columns, columns @ columns.T
        return self._beside[key]

    @cached_property
    def shaped(self) -> tuple[np.ndarray, ...]:
        """Indices of the directions of each candidate in each of its shapes."""
        groups: dict[object, list[int]] = {}
        for k, direction in enumerate(self.directions):
            groups.setdefault(direction.candidate.shaped_key, []).append(k)
        return tuple(map(np.array, groups.values()))

    def held(self, slack: float) -> np.ndarray:
        """[D] prior deviations beside the residual of one repeat, or of the whole log."""
        return self.prior * slack * (self.repeats**0.5 if self.repeated else 1.0)


@dataclass(frozen=True, eq=False)
class Leftover:
    """What the base parameters leave of one direction, as its size grows.

    begins: [P] sizes at which one more of the parameters has come to a bound, the first 0.
    train, validation: [P, 2, M] of each piece what is left at size 0 and what each unit adds: of the score test's
      residual, and on the validation part of a model that was fitted without the effect.
    free: [P, D] bool, the parameters that are not at a bound.  largest: of the sizes.
    """

    begins: np.ndarray
    train: np.ndarray
    validation: np.ndarray
    free: np.ndarray
    largest: float

    def at(self, size: float) -> tuple[np.ndarray, np.ndarray]:
        """[M] of the training part, and of the validation part."""
        piece = max(int(np.searchsorted(self.begins, size, side="right")) - 1, 0)
        of = np.array([1.0, size])
        return of @ self.train[piece], of @ self.validation[piece]

    @cached_property
    def norms(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sizes, and how large what is left is on each part at these; never smaller than at a smaller size."""
        slope = max(float(np.linalg.norm(self.train[-1, 1])), 1e-30)
        ends = np.append(self.begins[1:], max(min(self.largest, FAR / slope), 2 * self.begins[-1]))
        sizes = np.concatenate([np.linspace(a, b, POINTS) for a, b in zip(self.begins, ends, strict=True)])
        pieces = np.repeat(np.arange(len(ends)), POINTS)
        out = []
        for part in (self.train, self.validation):
            gram = np.einsum("pam,pbm->pab", part, part)[pieces]
            squares = gram[:, 0, 0] + 2 * sizes * gram[:, 0, 1] + sizes**2 * gram[:, 1, 1]
            out.append(np.maximum.accumulate(np.sqrt(np.maximum(squares, 0.0))))
        return sizes, *out

    def size_of(self, norm: np.ndarray, part: Literal["train", "validation", "both"] = "train") -> np.ndarray:
        """Sizes from which so much is left; inf where none within the effect's bounds leaves it."""
        sizes, train, validation = self.norms
        known = {"train": train, "validation": validation, "both": np.hypot(train, validation)}[part]
        return np.where(norm <= known[-1], np.interp(norm, known, sizes), np.inf)


def leftover(model: LinearModel, k: int) -> Leftover:
    """What the base parameters leave of direction k (`leftover_of`)."""
    raw, other = (model.sign[k] * part.raw[k] for part in (model.train, model.validation))
    return leftover_of(model, raw, other, float(model.largest[k]))


def leftover_of(model: LinearModel, raw: np.ndarray, other: np.ndarray, largest: float) -> Leftover:
    """What the base parameters leave of something that adds raw [M] to the training part and other [M] to the other.

    They are fitted to it with their priors and within their bounds, along the way on which one after the other stops at
    a bound: a nuisance that could stand for all of an effect does so only as far as it may move.
    """
    train, validation = model.train, model.validation
    held, loose = model.held(1.0), model.held(model.slack)
    count = len(model.prior)
    low = np.full(count, -np.inf) if model.base_low is None else np.minimum(model.base_low, 0.0)
    high = np.full(count, np.inf) if model.base_high is None else np.maximum(model.base_high, 0.0)
    normal, toward = train.base.T @ train.base + np.diag(held**-2), train.base.T @ raw
    free, at, begins = np.ones(count, bool), np.zeros(count), [0.0]
    pieces, frees = list[tuple[np.ndarray, np.ndarray]](), list[np.ndarray]()
    while True:
        frees.append(free.copy())
        there, grows = at.copy(), np.zeros(count)
        inside = normal[np.ix_(free, free)]
        there[free] = np.linalg.solve(inside, -normal[np.ix_(free, ~free)] @ at[~free]) if free.any() else 0.0
        grows[free] = np.linalg.solve(inside, toward[free]) if free.any() else 0.0
        moves = np.stack([there, grows])
        left = np.stack([np.zeros(len(raw)), raw]) - moves @ train.base.T
        beside = np.stack([np.zeros(len(other)), other]) - moves @ validation.base.T
        pieces.append((project(left, train.base[:, free], loose[free]), beside))
        bound = np.where(grows > 0, high, low)
        with np.errstate(divide="ignore", invalid="ignore"):
            reached = np.where(grows != 0, (bound - there) / grows, np.inf)
        reached[~free] = np.inf
        reached = np.where(reached > begins[-1] * (1 + 1e-9), reached, np.inf)
        k_next = int(np.argmin(reached)) if count else 0
        if not count or not reached[k_next] < largest:
            break
        free[k_next], at[k_next] = False, bound[k_next]
        begins.append(float(reached[k_next]))
    left, beside = (np.stack(part) for part in zip(*pieces, strict=True))
    return Leftover(np.array(begins), left, beside, np.array(frees), largest)


def taken_by(model: LinearModel, left: np.ndarray, free: np.ndarray) -> dict[EffectKey, float]:
    """Share of the square of a training residual [M] that each candidate takes linearly, in its best shape.

    free: [D] base parameters that absorb.
    """
    columns, products = model.beside(free)
    along = columns @ left
    whole, out = max(float(left @ left), 1e-30), dict[EffectKey, float]()
    for rows in model.shaped:
        key = model.directions[rows[0]].candidate.key
        low, high = np.where(model.low[rows] < 0, -np.inf, 0.0), np.where(model.high[rows] > 0, np.inf, 0.0)
        gram = products[np.ix_(rows, rows)]
        coefficients = _within(gram, along[rows], low, high)
        share = float(coefficients @ (2 * along[rows] - gram @ coefficients)) / whole
        out[key] = max(share, out.get(key, 0.0))
    return out


@dataclass(frozen=True)
class Alternative:
    """A candidate that an effect may be taken for.

    key: of it.  share: of the effect's squared sensitivity that it takes too, within its bounds.  apart: size of the
    effect from which the search distinguishes them; inf where it never does.
    """

    key: EffectKey
    share: float
    apart: float


def alternatives_of(
    model: LinearModel, k: int, size: float, config: DiscrepancyConfig, share: float
) -> list[Alternative]:
    """The candidates that the search would not distinguish from direction k at some size, the nearest first.

    By the search's own criterion: the worse of two models is worse in nearly all resamples of the validation
    recording, and leaves so many times the U that the better one leaves.

    Args:
        model: the linear model.
        k: the direction.
        size: of the effect, where the alternatives' bounds are looked at.
        config: of the search.
        share: of rehearsals in which they must be distinguished.
    """
    if not np.isfinite(size):
        return []
    needed = distinguishable(model, config, share)
    out = []
    for imitation in imitations(model, k, size):
        left = max(1.0 - imitation.share, 0.0)
        strength = left * imitation.strength
        apart = float(np.sqrt(needed / strength)) if left > 1e-9 else np.inf
        if apart > size:
            out.append(Alternative(imitation.key, imitation.share, apart if apart <= model.largest[k] else np.inf))
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
    own, times = model.directions[k].candidate.key, size or 1.0
    free = times * model.sign[k] * model.added[k]
    targets = [free] if size is None or model.base_low is None else [free, leftover(model, k).at(size)[1]]
    alongs = [model.added @ target for target in targets]
    if min(float(target @ target) for target in targets) <= 0:
        return []
    best: dict[EffectKey, Imitation] = {}
    for rows in model.shaped:
        key = model.directions[rows[0]].candidate.key
        if key == own:
            continue
        low, high = model.low[rows], model.high[rows]
        if size is None:
            low, high = np.where(low < 0, -np.inf, 0.0), np.where(high > 0, np.inf, 0.0)
        gram = model.products[np.ix_(rows, rows)]
        for tried, along in zip(targets, alongs, strict=True):
            coefficients, whole = _within(gram, along[rows], low, high), float(tried @ tried)
            moved = times * model.sign[k] * model.absorbed[:, k] - model.absorbed[:, rows] @ coefficients
            if size is None or model.inside(moved):
                break  # beside this candidate the base parameters may take what is left
        share = float(coefficients @ (2 * along[rows] - gram @ coefficients)) / whole
        if key not in best or share > best[key].share:
            least = model.minimum[rows] / np.maximum(np.abs(coefficients) / times, 1e-30)
            strength = whole / times**2 * model.judging_repeats
            best[key] = Imitation(key, share, strength, float(least.min()))
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


def _within(gram: np.ndarray, toward: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[C] coefficients within bounds that take most of the square of a target.

    gram: [C, C] products of their columns.  toward: [C] products of the columns and the target.
    """
    seen, coefficients = np.diag(gram) > 1e-24, np.zeros(len(toward))
    count = int(seen.sum())
    if not count:
        return coefficients
    gram, toward, low, high = gram[np.ix_(seen, seen)], toward[seen], low[seen], high[seen]
    scale = 1.0 / np.sqrt(np.diag(gram))
    gram = scale[:, None] * gram * scale + 1e-12 * np.eye(count)
    free = scale * (np.linalg.solve(gram, scale * toward) if count > 1 else scale * toward)
    if count == 1:
        free = np.clip(free, low, high)
    elif np.any((free < low) | (free > high)):
        factor = np.linalg.cholesky(gram)
        bounds = ((low - 1e-12) / scale, (high + 1e-12) / scale)
        free = scale * lsq_linear(factor.T, np.linalg.solve(factor, scale * toward), bounds=bounds).x
    coefficients[seen] = free
    return coefficients


def distinguishable(model: LinearModel, config: DiscrepancyConfig, share: float) -> float:
    """Squared noncentrality that must stand between two models for the search to distinguish them."""
    selection = config.selection
    aside = float(scipy.stats.norm.isf(selection.equivalence_doubt) + abs(scipy.stats.norm.isf(share)))
    by_resamples = (2 * aside) ** 2
    counted = float(model.validation.rows.counted.sum())
    if model.repeated:  # U of the better one is noise about zero, of deviation sqrt(2 M) in these units
        often = abs(float(scipy.stats.norm.isf(share)))
        return max(by_resamples, (selection.equivalence_factor - 1) * often * (2 * counted) ** 0.5)
    return max(by_resamples, (config.blocks.equivalence_factor - 1) * model.validation.level * counted)
