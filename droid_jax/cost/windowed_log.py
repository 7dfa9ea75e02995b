"""The cost of commanded logs with few repeats: their windows, or their full motions, as one sequence of instants.

Its noise is stated, not estimated from repeats, and its residuals are whitened on the host, as for a `LoneLog`.  The
state at the start of a window is measured.  Its uncertainty is propagated through the simulation into the covariance of
the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from droid_jax.cost.channels import check_channels
from droid_jax.cost.cost import check_friction_rows, check_read, followed
from droid_jax.cost.log_piece import STRETCH_SECONDS, TRACES, Piece, as_full_motion, in_windows, replayed, shared_steps
from droid_jax.cost.noise import Noise
from droid_jax.cost.observation import Measured, ShortFilter, least_noise
from droid_jax.cost.residuals import CompareConfig, Comparison
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.fields import check_space
from droid_jax.model.inertia import check_inertia
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.recordings.recording import Phase, Recording
from droid_jax.simulate.compiled import check_variant
from droid_jax.simulate.replay import Drive
from droid_jax.simulate.windows import TooShort, WindowConfig, why_no_windows


@dataclass(frozen=True, eq=False)
class PooledComparison(Comparison):
    """The comparison of a `WindowedLog`: one repeat, which has no scatter between repeats."""

    def deviations(self) -> np.ndarray:
        """Return [1, M] zeros."""
        return np.zeros((1, sum(c.noise.mean.size for c in self.channels)))


@dataclass(frozen=True, eq=False)
class Whitener:
    """The inverse square root of a piece's covariance diag(deviation^2) + S S^T.

    With S / deviation = U diag(s) V^T it is (I - U diag(shrink) U^T) / deviation, shrink = 1 - 1 / sqrt(1 + s^2).

    deviation: [C] standard deviation of the white noise.
    basis: [W, K C, R] U, with rows column by column.  None where the start states have no spread.
    shrink: [W, R], see above.  None with `basis`.
    """

    deviation: np.ndarray
    basis: np.ndarray | None = None
    shrink: np.ndarray | None = None

    def __call__(self, residuals: np.ndarray) -> np.ndarray:
        """Return residuals [P, W, K, C], whitened."""
        white = np.swapaxes(residuals / self.deviation, 2, 3)
        if self.basis is not None and self.shrink is not None:
            flat = white.reshape(*residuals.shape[:2], -1)
            coordinates = self.shrink * np.einsum("wir,pwi->pwr", self.basis, flat, optimize=True)
            white = (flat - np.einsum("wir,pwr->pwi", self.basis, coordinates, optimize=True)).reshape(white.shape)
        return np.swapaxes(white, 2, 3)


@dataclass(frozen=True, eq=False)
class WindowedLog:
    """The cost of pooled logs: called like a `Cost`, without what a `Cost` can do with other repeats or comparisons.

    scene, space: what is simulated, and the meaning of the vectors [D].  comparisons: one, of all logs.  drives: one
    for each recording.
    pieces: repeats of recordings.  order: [K] number of each instant of the log among those of all pieces.
    unit: [K] number of the window (or stretch) of each instant, in the log's order.
    fitted: number of units before the test data.  whole: why full motions are replayed; empty for windows.
    unit_seconds: length of a unit.  instants: [K] bool, those with a weight.
    again: returns the same log for another scene and space, with windows on a grid [s] of time steps.
    whitener: of each piece; None before `with_noise`.
    spreads: change of each piece's simulation by the spread of its start states; see `about`.
    too_short: names of recordings that are shorter than a window.
    """

    scene: Scene
    space: Space
    comparisons: tuple[Comparison, ...]
    drives: tuple[Drive, ...]
    pieces: tuple[Piece, ...]
    order: np.ndarray
    unit: np.ndarray
    fitted: int
    whole: str
    unit_seconds: float
    instants: np.ndarray
    again: Callable[[Scene, Space, float], WindowedLog]
    whitener: tuple[Whitener, ...] | None = None
    spreads: tuple[np.ndarray | None, ...] = field(default=())
    too_short: tuple[str, ...] = ()

    def __call__(self, values: Any) -> np.ndarray:
        """[P, D] -> [P] cost; never NaN."""
        return self.distances(values)[:, 0]

    def simulated(self, values: Any) -> np.ndarray:
        """Return the compared channels [P, K, C] at values [P, D], through the filter of their data, in their units.

        A sample is NaN throughout if one of its windows blew up.  Windows without a weighted instant are not replayed;
        the result holds the measurement there.
        """
        values, parts = self.space.check(values), list[np.ndarray]()
        active = [np.asarray(c[0, :, :, 0].any(axis=1)) for c in self._by_piece(self.instants[None, :, None])]
        each = zip(self.pieces, active, replayed(self.pieces, values, Piece.smoothed, active), strict=True)
        for piece, some, simulated in each:
            part = np.repeat(piece.measured[None], len(values), axis=0)
            if simulated:
                part[:, some] = simulated["smooth"]
            parts.append(part)
        out = self._joined(parts)
        out[np.isnan(out).any(axis=(1, 2))] = np.nan
        return out

    def _joined(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """[P, W, k, ...] of every piece -> [P, K, ...] in the log's order."""
        flat = [part.reshape(part.shape[0], -1, *part.shape[3:]) for part in parts]
        return np.concatenate(flat, axis=1)[:, self.order]

    def _by_piece(self, rows: np.ndarray) -> list[np.ndarray]:
        """[P, K, C] in the log's order -> [P, W, k, C] of every piece."""
        natural = np.empty_like(rows)
        natural[:, self.order] = rows
        sizes = np.cumsum([piece.at.size for piece in self.pieces])[:-1]
        parts = np.split(natural, sizes, axis=1)
        return [part.reshape(len(rows), *piece.at.shape, -1) for part, piece in zip(parts, self.pieces, strict=True)]

    def whitened(self, values: Any) -> np.ndarray:
        """Return residuals [P, M] at values [P, D], in units of the stated noise; zero at instants without weight."""
        assert self.whitener is not None
        residuals = self.simulated(values) - self.measured
        white = [whiten(part) for part, whiten in zip(self._by_piece(residuals), self.whitener, strict=True)]
        rows = self._joined(white) * self.instants[:, None]
        return np.swapaxes(rows, 1, 2).reshape(len(rows), -1)

    def distances(self, values: Any) -> np.ndarray:
        """Return equation 1 [P, 1] at values [P, D], of the filtered channels over the instants with a weight."""
        comparison = self.comparisons[0]
        residuals, first = (self.simulated(values) - self.measured)[:, self.instants], 0
        total = np.zeros(len(residuals))
        for channel in comparison.channels:
            columns = slice(first, first + len(channel.columns))
            total += channel.weight * np.mean(np.linalg.norm(residuals[..., columns], axis=2), axis=1)
            first += len(channel.columns)
        return np.where(np.isfinite(total), total, comparison.penalty)[:, None]

    def smoothed(self, values: Any) -> tuple[np.ndarray, ...]:
        """Return one array [P, K, C] at values [P, D], the simulated leading channel through the data's filter."""
        names = [c.name for c in self.comparisons[0].channels]
        leading = names.index(self.comparisons[0].leading.name)
        ends = np.cumsum([0, *(len(c.columns) for c in self.comparisons[0].channels)])
        return (self.simulated(values)[..., ends[leading] : ends[leading + 1]],)

    def rollouts(self, values: Any) -> tuple[Rollout, ...]:
        """Return one Rollout of the instants at values [P, D], host arrays [P, K, ...]."""
        values = self.space.check(values)
        parts = replayed(self.pieces, values, Piece.traces)
        traces = {name: self._joined([part[name] for part in parts]) for name in TRACES}
        finite = np.all(np.concatenate([part["finite"] for part in parts], axis=1), axis=1)
        count, size = len(values), len(self.order)
        time = np.repeat(self.comparisons[0].clock[None], count, axis=0)
        return (Rollout(time, **traces, contact=np.zeros((count, size, 0), bool), finite=finite),)

    def failed(self, values: Any) -> np.ndarray:
        """Return [P] bool at values [P, D]: a replay blew up."""
        return np.asarray(np.isnan(self.simulated(values)).any(axis=(1, 2)))

    def penalties(self, values: Any) -> np.ndarray:
        """Return [P, 1] zeros: a log has no penalty for a lost grasp."""
        return np.zeros((len(np.atleast_2d(values)), 1))

    def part(self, name: str) -> WindowedLog:
        """Return the same log under another name, that of a part of it."""
        return replace(self, comparisons=(replace(self.comparisons[0], name=name),))

    @property
    def columns(self) -> list[tuple[str, int]]:
        """[C] channel, and number in the simulated channel, of each compared column."""
        return [(c.name, column) for c in self.comparisons[0].channels for column in c.columns.tolist()]

    @property
    def measured(self) -> np.ndarray:
        """[K, C] measured channels, filtered."""
        return np.concatenate([c.noise.mean for c in self.comparisons[0].channels], axis=1)

    @property
    def clock(self) -> np.ndarray:
        """[K] s: the recording's clock for one log without gaps, else a clock of the concatenated instants."""
        return self.comparisons[0].clock

    @property
    def moves(self) -> np.ndarray:
        """[K, C] bool, True throughout: residuals of a replay with commands are informative at rest too."""
        return np.ones(self.measured.shape, bool)

    def residual(self, values: np.ndarray) -> np.ndarray:
        """Return measured minus simulated channels [K, C] at one vector [D]."""
        return self.measured - self.simulated(values[None])[0]

    def least_noise(self) -> np.ndarray:
        """Return the smallest standard deviation [C] of the noise (`observation.least_noise`)."""
        comparison = self.comparisons[0]
        return np.concatenate([least_noise(c.name, c.noise.mean, comparison.config.noise) for c in comparison.channels])

    def about(self, values: np.ndarray) -> WindowedLog:
        """Return the log with the spread of the start states, propagated through the simulation at `values` [D]."""
        return replace(self, spreads=tuple(piece.spread(values) for piece in self.pieces))

    def finer(self, scene: Scene, space: Space) -> WindowedLog:
        """Return the log with the same instants and noise, of a scene with a finer time step and another space."""
        log = self.again(scene, space, float(self.scene.model.opt.timestep))
        assert np.array_equal(log.order, self.order)
        return replace(log, whitener=self.whitener, instants=self.instants)

    def with_noise(self, deviation: np.ndarray, instants: np.ndarray) -> WindowedLog:
        """Return the log with white noise and the spread of `about`, and weight at some instants only.

        deviation: [C] standard deviation in the columns' units.  instants: [K] bool, those with a weight.
        """
        deviation = np.maximum(deviation, self.least_noise())
        weighted = self._by_piece(instants[None, :, None])
        spreads = self.spreads or (None,) * len(self.pieces)
        whitener = tuple(_whitener(deviation, s, w[0]) for s, w in zip(spreads, weighted, strict=True))
        return replace(self, whitener=whitener, instants=instants)


def _whitener(deviation: np.ndarray, spread: np.ndarray | None, weighted: np.ndarray) -> Whitener:
    """The whitener of a piece, from a standard deviation [C] and the spread [W, K, C, R] of its start states.

    weighted: [W, K, 1] bool.  Other instants must not constrain the start states.
    """
    if spread is None:
        return Whitener(deviation)
    s = np.swapaxes(spread * weighted[..., None] / deviation[:, None], 1, 2)
    basis, size, _ = np.linalg.svd(s.reshape(len(s), -1, s.shape[3]), full_matrices=False)
    return Whitener(deviation, basis, 1.0 - 1.0 / np.sqrt(1.0 + size**2))


def windowed_log(
    scene: Scene,
    space: Space,
    recordings: Sequence[Recording],
    config: CompareConfig,
    windows: WindowConfig,
    effects: Sequence[Effect] = (),
    fitted_share: float = 1.0,
    grid: float | None = None,
    *,
    whole: bool = False,
) -> WindowedLog:
    """Return the cost of the repeats of commanded recordings over a space.

    Args:
        scene: what is simulated.
        space: meaning of the vectors [D].
        recordings: with the same channels and columns, each of one repeat or several.
        config: how simulation and measurement are compared.
        windows: how recordings are cut.
        effects: in the replays.
        fitted_share: share of each repeat's windows that come before the test data.
        grid: s, time step that windows begin on; None for the scene's.
        whole: replay full motions, also where `why_no_windows` gives no reason to.

    Raises:
        ValueError: what `make_cost` refuses, `mj_step`, recordings that are all shorter than a window, or no window
            without missing samples.
    """
    if config.mj_step:
        raise ValueError(
            "mj_step is for repeats and for `make_cost`: logs of few repeats are replayed by steps of second order; "
            "leave mj_step out, and let the program that made the logs take finer steps (0.1 ms)"
        )
    check_space(scene, space)
    check_channels(recordings, config.channels)
    _check_same_joints(scene, recordings, config)
    check_read(scene, space, effects)
    check_friction_rows(scene, space, effects)
    check_inertia(scene, space)
    scenes = [variant_scene(scene, recording.variant, recording.name) for recording in recordings]
    reasons = [why_no_windows(scene, recording) for recording in recordings]
    why = "motions were asked for whole" if whole else next((r for r in reasons if r), "")
    drives = list[Drive]()
    for own, recording in zip(scenes, recordings, strict=True):
        check_variant(own, space, effects, recording.name)
        drive = followed(own, recording, config)
        assert isinstance(drive, Drive)
        drives.append(drive)
    replay_steps = shared_steps([len(drive.command) for drive in drives], effects)
    candidates, short = list[Piece | None](), dict[str, TooShort]()
    for own, recording, drive, steps in zip(scenes, recordings, drives, replay_steps, strict=True):
        for repeat in range(recording.repeats):
            of = own, space, recording, repeat, drive, config, windows, effects
            number = sum(piece.count for piece in candidates if piece is not None)
            try:
                candidates.append(as_full_motion(*of, steps, grid) if why else in_windows(*of, grid, number))
            except TooShort as error:
                short[recording.name] = error
    pieces = [piece for piece in candidates if piece is not None and piece.at.size]
    if not pieces and short:
        raise next(iter(short.values()))
    if not pieces:
        raise ValueError(f"recordings {', '.join(r.name for r in recordings)}: no window was measured throughout")
    order, unit, fitted = _order(pieces, fitted_share)
    comparison = _comparison([r for r in recordings if r.name not in short], pieces, order, config)
    return WindowedLog(
        scene, space, (comparison,), tuple(drives),
        tuple(pieces), order, unit, fitted, why, STRETCH_SECONDS if why else windows.length,
        np.ones(len(order), bool),
        lambda of, over, step: windowed_log(of, over, recordings, config, windows, (), fitted_share, step, whole=whole),
        too_short=tuple(short),
    )  # fmt: skip


def _check_same_joints(scene: Scene, recordings: Sequence[Recording], config: CompareConfig) -> None:
    """Raise ValueError if recordings measure a compared channel of different joints; their order does not matter."""
    for name in config.channels:
        each = {r.name: [j for j in scene.joints if j in r.channel(name).columns] for r in recordings}
        shared = [j for j in scene.joints if all(j in joints for joints in each.values())]
        if any(joints != shared for joints in each.values()):
            raise ValueError(
                f"the recordings measure {name} of different joints: "
                + "; ".join(f"{recording} of {', '.join(joints)}" for recording, joints in each.items())
                + f"; leave some out, or compare the joints that all of them hold (--joints {' '.join(shared)})"
            )


def _order(pieces: Sequence[Piece], share: float) -> tuple[np.ndarray, np.ndarray, int]:
    """The pieces' instants [K] in the log's order, the unit [K] of each, and the number of units before the test data.

    The log holds the first `share` of every piece, then the remainders.  Pieces of one unit are not divided: the share
    of them goes first.
    """
    groups: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    first = single = 0
    for piece in pieces:
        unit = np.unique(piece.unit.ravel(), return_inverse=True)[1].ravel()
        count = int(unit.max()) + 1
        fitted = min(count, max(1, round(share * count)))
        if count == 1:
            fitted = math.ceil(share * (single + 1) - 1e-9) - math.ceil(share * single - 1e-9)
            single += 1
        numbers = np.arange(len(unit)) + first
        for group, members in zip(groups, (range(fitted), range(fitted, count)), strict=True):
            group += [numbers[unit == u] for u in members]
        first += len(unit)
    units = [*groups[0], *groups[1]]
    unit = np.repeat(np.arange(len(units)), [len(u) for u in units])
    return np.concatenate(units), unit, len(groups[0])


def _comparison(
    recordings: Sequence[Recording], pieces: Sequence[Piece], order: np.ndarray, config: CompareConfig
) -> Comparison:
    """The comparison of all instants, as one measured motion of one repeat."""
    values = np.concatenate([piece.measured.reshape(-1, piece.measured.shape[2]) for piece in pieces])[order]
    at = np.concatenate([piece.at.ravel() for piece in pieces])[order]
    rate = config.noise.rate
    gapless = len(pieces) == 1 and np.allclose(np.diff(at), np.diff(at).mean(), rtol=0.01)
    start = float(at[0]) if gapless else 0.0
    span = (start, float(at[-1]) if gapless else (len(at) - 1) / rate)
    channels, first = list[Measured](), 0
    for name, weight in config.channels.items():
        columns = pieces[0].columns[name]
        mean = values[:, first : first + len(columns)]
        first += len(columns)
        noise = Noise(mean, np.zeros((len(columns), 0, 0)), mean[None], np.ones(mean.shape))
        channels.append(
            Measured(
                name,
                recordings[0].channel(name).unit,
                np.arange(len(mean), dtype=float),
                mean[None],
                np.ones((1, *mean.shape), bool),
                columns,
                ShortFilter(np.zeros(0, int), np.zeros((1, 0, 0))),
                noise,
                span,
                weight,
                np.ones(mean.shape, bool),
            )
        )
    phases = recordings[0].phases if gapless else _phases(pieces, order, rate)
    names = " and ".join(dict.fromkeys(r.name for r in recordings))
    return PooledComparison(names, channels[0].clock, tuple(channels), None, None, phases, config)


def _phases(pieces: Sequence[Piece], order: np.ndarray, rate: float) -> tuple[Phase, ...]:
    """A phase for each stretch of the log's order that belongs to one piece."""
    owner = np.repeat(np.arange(len(pieces)), [piece.at.size for piece in pieces])[order]
    changes = np.flatnonzero(np.diff(owner)) + 1
    starts, ends = np.r_[0, changes], np.r_[changes, len(owner)]
    return tuple(
        Phase(pieces[int(owner[a])].name, float(a) / rate, float(b) / rate)
        for a, b in zip(starts.tolist(), ends.tolist(), strict=True)
    )
