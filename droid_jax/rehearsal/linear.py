"""A linear model of a search: effects, base parameters and noise.

An effect adds its sensitivity times its size to the residual, and the base parameters absorb a part of that.  Whitened
noise has standard deviation one in each repeat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from droid_jax.discrepancy.candidates import ScoreDirection, project
from droid_jax.discrepancy.statistics import Blocks, Repeats, Resampling, in_turns

LARGEST_NORM = 1e3  # noise deviations, more than any test needs
SIZES_PER_PIECE = 24  # of an effect, at which the norm of its unabsorbed part is tabulated


@dataclass(frozen=True, eq=False)
class LinearPart:
    """One part of the recordings (training or validation) in a linear model.

    raw: [K, M] sensitivity to each coefficient, in noise units of one repeat; zero where its replay blew up.
    base: [M, D] Jacobian of the base parameters, per search unit.  rows: units of the resampling, repeats or blocks.
    channel: [M] name of the channel of each residual.
    level: mean square of the residual without a missing effect, for blocks.
    step: [M] change by a finer time step; None if not measured.
    residual: [M] of the base model, whose spectrum the noise of blocks has; None for white noise of deviation one.
    column: [M] number of the compared column of each residual.
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
        """Return the part with some channels only."""
        some = np.isin(self.channel, channels)
        rows = (
            Repeats(self.rows.deviations[:, some]) if isinstance(self.rows, Repeats) else Blocks(self.rows.block[some])  # type: ignore[attr-defined]
        )
        each = (None if a is None else a[some] for a in (self.step, self.residual, self.column))
        return LinearPart(self.raw[:, some], self.base[some], rows, self.channel[some], self.level, *each)

    def quieter(self, share: float) -> LinearPart:
        """Return the part with its residual multiplied by `share`, for blocks."""
        assert self.residual is not None
        return replace(self, residual=share * self.residual, level=share**2 * self.level)

    def noise(self, draws: int, rng: np.random.Generator) -> np.ndarray:
        """Return drawn noise [R, M] of one log: the base residual with random phases, column by column.

        So it has the size and the spectrum of the base residual.  It is zero at instants without weight.
        Source: Theiler et al., Testing for nonlinearity in time series, Physica D 1992.
        """
        counted = self.rows.counted
        if self.residual is None or self.column is None:
            return rng.normal(size=(draws, len(counted))) * counted
        out = np.zeros((draws, len(counted)))
        for column in np.unique(self.column):
            at = np.flatnonzero((self.column == column) & counted)
            spectrum = np.abs(np.fft.rfft(self.residual[at]))
            drawn = spectrum * np.exp(2j * np.pi * rng.random((draws, len(spectrum))))
            drawn[:, 0] = spectrum[0] * rng.choice([-1.0, 1.0], draws)
            out[:, at] = np.fft.irfft(drawn, len(at), axis=1)
        return out


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A linear model of a search.

    directions: K coefficients.  train, validation: the parts.  prior: [D] prior deviations of the base parameters in a
    fit, search units.
    slack: factor on these deviations in the score test.  repeats: number N of rehearsed repeats; 1 for blocks.
    minimum: [K] minimum effect size.  low, high: [K] bounds of each coefficient, relative to neutral.
    base_low, base_high: [D] bounds of the base parameters' changes, search units; None for none.
    bound_margin: [K] distance from its bound that a coefficient needs to be named.
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
        """[K] largest size at which a coefficient is named, in the direction of `sign`."""
        return np.where(self.high > 0, self.high, -self.low) - self.bound_margin

    @property
    def sign(self) -> np.ndarray:
        """[K] 1, or -1 if neutral is the upper bound: the direction in which sizes are positive."""
        return np.where(self.high > 0, 1.0, -1.0)

    @cached_property
    def tested(self) -> LinearPart:
        """The part that the score test uses: the training part, or for blocks those of both parts."""
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
        """Whether the resampled units are repeats."""
        return self.train.rows.repeated

    def of(self, channels: Sequence[str]) -> LinearModel:
        """Return the model with some channels only."""
        return replace(self, train=self.train.of(channels), validation=self.validation.of(channels))

    def alone(self, rows: Sequence[int]) -> LinearModel:
        """Return the model of some directions, with the training part used for validation too."""
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
        """Number of repeats of the validation part, if the training part has `repeats` of them; 1 for blocks."""
        return self.repeats * self.validation.rows.units / self.train.rows.units if self.repeated else 1.0

    @property
    def step_error(self) -> float:
        """U0: mean square of the part of a finer time step's change that the base parameters do not absorb."""
        if self.train.step is None:
            return 0.0
        residual = project(self.train.step[None], self.train.base, self.prior_of_repeat(1.0))[0]
        return float(residual @ residual / self.train.rows.counted.sum())

    def projected(self) -> np.ndarray:
        """Return the sensitivities [K, M] of the score test, without the part that base parameters absorb."""
        return project(self.tested.raw, self.tested.base, self.prior_of_repeat(self.slack))

    @cached_property
    def absorbed(self) -> np.ndarray:
        """[D, K] change of the base parameters, fitted to the training part, per unit of a coefficient; no bounds."""
        base, prior = self.train.base, self.prior_of_repeat(1.0)
        return np.linalg.solve(base.T @ base + np.diag(prior**-2), base.T @ self.train.raw.T)

    def inside(self, change: np.ndarray) -> bool:
        """Return whether the base parameters are within their bounds after a change [D]."""
        if self.base_low is None or self.base_high is None:
            return True
        return bool(np.all((change >= self.base_low) & (change <= self.base_high)))

    @cached_property
    def projected_by_prior(self) -> np.ndarray:
        """[K, M] sensitivities without the part that base parameters absorb within their priors (no slack)."""
        return project(self.train.raw, self.train.base, self.prior_of_repeat(1.0))

    @cached_property
    def added(self) -> np.ndarray:
        """[K, M] change of the validation residual per unit of a coefficient, with the base fitted to the training."""
        return self.validation.raw - (self.validation.base @ self.absorbed).T

    @cached_property
    def gram(self) -> np.ndarray:
        """[K, K] scalar products of the rows of `added`."""
        return self.added @ self.added.T

    @cached_property
    def _projected_with(self) -> dict[bytes, tuple[np.ndarray, np.ndarray]]:
        return {}

    def projected_with(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return sensitivities [K, M] without the part that some base parameters absorb, and their products [K, K].

        free: [D] bool, the base parameters that absorb.
        """
        key = free.tobytes()
        if key not in self._projected_with:
            columns = project(self.train.raw, self.train.base[:, free], self.prior_of_repeat(self.slack)[free])
            self._projected_with[key] = columns, columns @ columns.T
        return self._projected_with[key]

    @cached_property
    def shaped(self) -> tuple[np.ndarray, ...]:
        """Numbers of the directions of each candidate with each of its shapes."""
        groups: dict[object, list[int]] = {}
        for k, direction in enumerate(self.directions):
            groups.setdefault(direction.candidate.shaped_key, []).append(k)
        return tuple(map(np.array, groups.values()))

    def prior_of_repeat(self, slack: float) -> np.ndarray:
        """Return prior deviations [D] times `slack`, relative to the residual of one repeat, or of the full log."""
        return self.prior * slack * (self.repeats**0.5 if self.repeated else 1.0)


@dataclass(frozen=True, eq=False)
class Unabsorbed:
    """The part of one effect that the base parameters do not absorb, as a function of the effect's size.

    It is piecewise linear in the size: the pieces end where one more base parameter reaches a bound.

    begins: [P] size at the start of each piece, the first 0.
    train, validation: [P, 2, M] value at size 0, and slope, of each piece: of the score test's residual, and of the
      validation residual of a model that was fitted without the effect.
    free: [P, D] bool, the base parameters that are not on a bound.  largest: of the sizes.
    """

    begins: np.ndarray
    train: np.ndarray
    validation: np.ndarray
    free: np.ndarray
    largest: float

    def at(self, size: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals [M] of the training part, and of the validation part, at a size."""
        piece = max(int(np.searchsorted(self.begins, size, side="right")) - 1, 0)
        powers = np.array([1.0, size])
        return powers @ self.train[piece], powers @ self.validation[piece]

    @cached_property
    def norms(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sizes, and the norms of the training and the validation residual at them, made monotonic."""
        slope = max(float(np.linalg.norm(self.train[-1, 1])), 1e-30)
        ends = np.append(self.begins[1:], max(min(self.largest, LARGEST_NORM / slope), 2 * self.begins[-1]))
        sizes = np.concatenate([np.linspace(a, b, SIZES_PER_PIECE) for a, b in zip(self.begins, ends, strict=True)])
        pieces = np.repeat(np.arange(len(ends)), SIZES_PER_PIECE)
        out = []
        for part in (self.train, self.validation):
            gram = np.einsum("pam,pbm->pab", part, part)[pieces]
            squares = gram[:, 0, 0] + 2 * sizes * gram[:, 0, 1] + sizes**2 * gram[:, 1, 1]
            out.append(np.maximum.accumulate(np.sqrt(np.maximum(squares, 0.0))))
        return sizes, *out

    def size_of(self, norm: np.ndarray, part: Literal["train", "validation", "both"] = "train") -> np.ndarray:
        """Return the sizes at which the residual has these norms; inf if the largest size has a smaller norm."""
        sizes, train, validation = self.norms
        tabulated = {"train": train, "validation": validation, "both": np.hypot(train, validation)}[part]
        return np.where(norm <= tabulated[-1], np.interp(norm, tabulated, sizes), np.inf)


def unabsorbed(model: LinearModel, k: int) -> Unabsorbed:
    """Return the part of direction k that the base parameters do not absorb."""
    raw, other = (model.sign[k] * part.raw[k] for part in (model.train, model.validation))
    return unabsorbed_part(model, raw, other, float(model.largest[k]))


def unabsorbed_part(model: LinearModel, raw: np.ndarray, other: np.ndarray, largest: float) -> Unabsorbed:
    """Return the part of an effect that the base parameters do not absorb, as its size grows.

    The base parameters are fitted to the effect with their priors and within their bounds.  As the size grows, one
    after the other reaches a bound and is fixed there.  So a nuisance that could explain an effect absorbs it only as
    far as its bounds allow.

    Args:
        model: the linear model.
        raw: [M] of the training part, per unit of size.
        other: [M] the same of the validation part.
        largest: of the sizes.
    """
    train, validation = model.train, model.validation
    prior, loose = model.prior_of_repeat(1.0), model.prior_of_repeat(model.slack)
    count = len(model.prior)
    low = np.full(count, -np.inf) if model.base_low is None else np.minimum(model.base_low, 0.0)
    high = np.full(count, np.inf) if model.base_high is None else np.maximum(model.base_high, 0.0)
    normal, toward = train.base.T @ train.base + np.diag(prior**-2), train.base.T @ raw
    free, at_bound, begins = np.ones(count, bool), np.zeros(count), [0.0]
    pieces, frees = list[tuple[np.ndarray, np.ndarray]](), list[np.ndarray]()
    while True:
        frees.append(free.copy())
        offset, slope = at_bound.copy(), np.zeros(count)  # of the base parameters, as functions of the size
        of_free = normal[np.ix_(free, free)]
        offset[free] = np.linalg.solve(of_free, -normal[np.ix_(free, ~free)] @ at_bound[~free]) if free.any() else 0.0
        slope[free] = np.linalg.solve(of_free, toward[free]) if free.any() else 0.0
        changes = np.stack([offset, slope])
        on_train = np.stack([np.zeros(len(raw)), raw]) - changes @ train.base.T
        on_validation = np.stack([np.zeros(len(other)), other]) - changes @ validation.base.T
        pieces.append((project(on_train, train.base[:, free], loose[free]), on_validation))
        bound = np.where(slope > 0, high, low)
        with np.errstate(divide="ignore", invalid="ignore"):
            reached = np.where(slope != 0, (bound - offset) / slope, np.inf)
        reached[~free] = np.inf
        reached = np.where(reached > begins[-1] * (1 + 1e-9), reached, np.inf)
        k_next = int(np.argmin(reached)) if count else 0
        if not count or not reached[k_next] < largest:
            break
        free[k_next], at_bound[k_next] = False, bound[k_next]
        begins.append(float(reached[k_next]))
    on_train, on_validation = (np.stack(part) for part in zip(*pieces, strict=True))
    return Unabsorbed(np.array(begins), on_train, on_validation, np.array(frees), largest)
