"""The cost of commanded logs with few repeats: their windows, or their motions whole, as one sequence of instants.

Its noise is stated, not estimated, and its residuals are whitened on the host, as those of a `LoneLog`.  Where a window
begins is measured, and how well enters the noise: what the spread of its state does to the simulation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from droid_jax.cost.channels import check_channels
from droid_jax.cost.cost import Cost, check_friction_rows, check_read, followed
from droid_jax.cost.log_piece import STRETCH, TRACES, Piece, as_a_whole, in_windows, replayed, shared_steps
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
from droid_jax.simulate.replay import Drive
from droid_jax.simulate.windows import TooShort, WindowConfig, why_whole


@dataclass(frozen=True, eq=False)
class PooledComparison(Comparison):
    """The comparison of a `WindowedLog`: one repeat, which tells nothing of its scatter."""

    def deviations(self) -> np.ndarray:
        """[1, M] zeros."""
        return np.zeros((1, sum(c.noise.mean.size for c in self.channels)))


@dataclass(frozen=True, eq=False)
class Whitener:
    """The inverse root of a piece's covariance, diag(deviation^2) + s s': I - left shrink left' over the deviation.

    deviation: [C].  left: [W, K C, R], column by column, orthonormal in units of it; shrink: [W, R].  None: no spread.
    """

    deviation: np.ndarray
    left: np.ndarray | None = None
    shrink: np.ndarray | None = None

    def __call__(self, left: np.ndarray) -> np.ndarray:
        """[P, W, K, C] residuals, whitened."""
        flat = np.swapaxes(left / self.deviation, 2, 3)
        if self.left is not None and self.shrink is not None:
            white = flat.reshape(*left.shape[:2], -1)
            taken = self.shrink * np.einsum("wir,pwi->pwr", self.left, white, optimize=True)
            flat = (white - np.einsum("wir,pwr->pwi", self.left, taken, optimize=True)).reshape(flat.shape)
        return np.swapaxes(flat, 2, 3)


@dataclass(frozen=True, eq=False)
class WindowedLog(Cost):
    """The cost of pooled logs.

    pieces: repeats of recordings.  order: [K] their instants one after the other, as the log has them.
    unit: [K] number of the window (or stretch) of each, counted in the log's order.
    fitted: how many of these units come before those that are kept as test data.  whole: why motions are replayed
    whole, empty where they are not.
    instants: [K] bool, those that count.  again: makes the same of another scene and space, with windows on a grid [s]
    of time steps.  whitener: [windows, K C, K C] of each piece, None: not stated yet.
    spreads: what the states' spread does, of each piece; see `about`.
    too_short: recordings that no window fits into.
    """

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

    def simulated(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, K, C] compared channels through the filter of their data, in their units; NaN throughout where
        a window blew up.  Windows without an instant that counts are not replayed: what was measured stands there."""
        values, parts = self.space.check(values), list[np.ndarray]()
        active = [np.asarray(c[0, :, :, 0].any(axis=1)) for c in self._apart(self.instants[None, :, None])]
        each = zip(self.pieces, active, replayed(self.pieces, values, Piece.smoothed, active), strict=True)
        for piece, some, found in each:
            part = np.repeat(piece.measured[None], len(values), axis=0)
            if found:
                part[:, some] = found["smooth"]
            parts.append(part)
        found = self._joined(parts)
        found[np.isnan(found).any(axis=(1, 2))] = np.nan
        return found

    def _joined(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """[P, W, k, ...] of every piece -> [P, K, ...] in the log's order."""
        flat = [part.reshape(part.shape[0], -1, *part.shape[3:]) for part in parts]
        return np.concatenate(flat, axis=1)[:, self.order]

    def _apart(self, rows: np.ndarray) -> list[np.ndarray]:
        """[P, K, C] in the log's order -> [P, W, k, C] of every piece."""
        natural = np.empty_like(rows)
        natural[:, self.order] = rows
        sizes = np.cumsum([piece.at.size for piece in self.pieces])[:-1]
        parts = np.split(natural, sizes, axis=1)
        return [part.reshape(len(rows), *piece.at.shape, -1) for part, piece in zip(parts, self.pieces, strict=True)]

    def whitened(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, M] residuals in units of the noise stated, zero at instants left out."""
        assert self.whitener is not None
        left = self.simulated(values) - self.measured
        white = [make(part) for part, make in zip(self._apart(left), self.whitener, strict=True)]
        rows = self._joined(white) * self.instants[:, None]
        return np.swapaxes(rows, 1, 2).reshape(len(rows), -1)

    def distances(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, 1] equation 1 over the instants that count, of filtered channels."""
        comparison = self.comparisons[0]
        left, first = (self.simulated(values) - self.measured)[:, self.instants], 0
        total = np.zeros(len(left))
        for channel in comparison.channels:
            columns = slice(first, first + len(channel.columns))
            total += channel.weight * np.mean(np.linalg.norm(left[..., columns], axis=2), axis=1)
            first += len(channel.columns)
        return np.where(np.isfinite(total), total, comparison.penalty)[:, None]

    def smoothed(self, values: Any) -> tuple[np.ndarray, ...]:
        """[P, D] -> one array [P, K, C], the leading channel."""
        names = [c.name for c in self.comparisons[0].channels]
        lead = names.index(self.comparisons[0].leading.name)
        ends = np.cumsum([0, *(len(c.columns) for c in self.comparisons[0].channels)])
        return (self.simulated(values)[..., ends[lead] : ends[lead + 1]],)

    def rollouts(self, values: Any) -> tuple[Rollout, ...]:
        """[P, D] -> one Rollout of the instants, host arrays [P, K, ...]."""
        values = self.space.check(values)
        parts = replayed(self.pieces, values, Piece.traces)
        traces = {name: self._joined([part[name] for part in parts]) for name in TRACES}
        finite = np.all(np.concatenate([part["finite"] for part in parts], axis=1), axis=1)
        count, size = len(values), len(self.order)
        time = np.repeat(self.comparisons[0].clock[None], count, axis=0)
        return (Rollout(time, **traces, contact=np.zeros((count, size, 0), bool), finite=finite),)

    def failed(self, values: Any) -> np.ndarray:
        """[P, D] -> [P] bool: a replay blew up."""
        return np.asarray(np.isnan(self.simulated(values)).any(axis=(1, 2)))

    def penalties(self, values: Any) -> np.ndarray:
        """[P, D] -> [P, 1] zeros: nothing is gripped in a window."""
        return np.zeros((len(np.atleast_2d(values)), 1))

    def part(self, name: str) -> WindowedLog:
        """The same log under a name for one part of it."""
        return replace(self, comparisons=(replace(self.comparisons[0], name=name),))

    @property
    def columns(self) -> list[tuple[str, int]]:
        """[C] channel and simulated column of each compared column."""
        return [(c.name, column) for c in self.comparisons[0].channels for column in c.columns.tolist()]

    @property
    def measured(self) -> np.ndarray:
        """[K, C] measured channels, filtered."""
        return np.concatenate([c.noise.mean for c in self.comparisons[0].channels], axis=1)

    @property
    def clock(self) -> np.ndarray:
        """[K] s: of one log without gaps its own clock, else that of the instants one after the other."""
        return self.comparisons[0].clock

    @property
    def moves(self) -> np.ndarray:
        """[K, C] bool, true: a replay with commands tells at rest too."""
        return np.ones(self.measured.shape, bool)

    def residual(self, values: np.ndarray) -> np.ndarray:
        """[K, C] measured minus simulated channels of one vector [D]."""
        return self.measured - self.simulated(values[None])[0]

    def least_noise(self) -> np.ndarray:
        """[C] deviation below which the noise is never believed."""
        comparison = self.comparisons[0]
        return np.concatenate([least_noise(c.name, c.noise.mean, comparison.config.noise) for c in comparison.channels])

    def about(self, values: np.ndarray) -> WindowedLog:
        """The same, with what the spread of the windows' first states does to the simulation at `values` [D]."""
        return replace(self, spreads=tuple(piece.spread(values) for piece in self.pieces))

    def finer(self, scene: Scene, space: Space) -> WindowedLog:
        """The same instants and noise of a scene with a finer time step, over another space."""
        made = self.again(scene, space, float(self.scene.model.opt.timestep))
        assert np.array_equal(made.order, self.order)
        return replace(made, whitener=self.whitener, instants=self.instants)

    def with_noise(self, deviation: np.ndarray, instants: np.ndarray) -> WindowedLog:
        """With white noise of a deviation [C], in the columns' units, and the spread of `about`, at some instants [K]
        bool; the rest does not count."""
        deviation = np.maximum(deviation, self.least_noise())
        counted = self._apart(instants[None, :, None])
        spreads = self.spreads or (None,) * len(self.pieces)
        whitener = tuple(_whitener(deviation, s, c[0]) for s, c in zip(spreads, counted, strict=True))
        return replace(self, whitener=whitener, instants=instants)


def _whitener(deviation: np.ndarray, spread: np.ndarray | None, counted: np.ndarray) -> Whitener:
    """Of a deviation [C] and the spread [W, K, C, R] of a piece at the instants that count, [W, K, 1] bool.

    What does not count must not tell where a motion began.
    """
    if spread is None:
        return Whitener(deviation)
    s = np.swapaxes(spread * counted[..., None] / deviation[:, None], 1, 2)
    left, size, _ = np.linalg.svd(s.reshape(len(s), -1, s.shape[3]), full_matrices=False)
    return Whitener(deviation, left, 1.0 - 1.0 / np.sqrt(1.0 + size**2))


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
    """The cost of the repeats of commanded recordings over a space.

    Args:
        scene: what is simulated.
        space: meaning of the vectors [D].
        recordings: of the same channels and columns, each of one repeat or several.
        config: how simulation and measurement are compared.
        windows: how recordings are cut.
        effects: in the replays.
        fitted_share: of each repeat, whose first windows come before all that is kept as test data.
        grid: s, time steps that windows begin on; None: the scene's.
        whole: replay motions whole, as they are where `why_whole` says why.

    Raises:
        ValueError: what `make_cost` refuses, `mj_step`, recordings that are all shorter than a window, or no window of
            which enough was measured.
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
    scenes = [variant_scene(scene, recording.variant) for recording in recordings]
    reasons = [why_whole(scene, recording) for recording in recordings]
    why = "motions were asked for whole" if whole else next((r for r in reasons if r), "")
    drives = list[Drive]()
    for own, recording in zip(scenes, recordings, strict=True):
        drive = followed(own, recording, config)
        assert isinstance(drive, Drive)
        drives.append(drive)
    lasting = shared_steps([len(drive.command) for drive in drives], effects)
    made, short = list[Piece | None](), dict[str, TooShort]()
    for own, recording, drive, steps in zip(scenes, recordings, drives, lasting, strict=True):
        for repeat in range(recording.repeats):
            of = own, space, recording, repeat, drive, config, windows, effects
            number = sum(piece.count for piece in made if piece is not None)
            try:
                made.append(as_a_whole(*of, steps, grid) if why else in_windows(*of, grid, number))
            except TooShort as error:
                short[recording.name] = error
    pieces = [piece for piece in made if piece is not None and piece.at.size]
    if not pieces and short:
        raise next(iter(short.values()))
    if not pieces:
        raise ValueError(f"recordings {', '.join(r.name for r in recordings)}: no window was measured throughout")
    order, unit, fitted = _order(pieces, fitted_share)
    comparison = _comparison(scene, [r for r in recordings if r.name not in short], pieces, order, config)
    return WindowedLog(
        scene, space, (comparison,), tuple(drives), (), (), (), (), (), (),
        tuple(pieces), order, unit, fitted, why, STRETCH if why else windows.length,
        np.ones(len(order), bool),
        lambda of, over, step: windowed_log(of, over, recordings, config, windows, (), fitted_share, step, whole=whole),
        too_short=tuple(short),
    )  # fmt: skip


def _check_same_joints(scene: Scene, recordings: Sequence[Recording], config: CompareConfig) -> None:
    """Raise ValueError where recordings measure a compared channel of different joints; their order does not matter."""
    for name in config.channels:
        of = {r.name: [j for j in scene.joints if j in r.channel(name).columns] for r in recordings}
        shared = [j for j in scene.joints if all(j in joints for joints in of.values())]
        if any(joints != shared for joints in of.values()):
            raise ValueError(
                f"the recordings measure {name} of different joints: "
                + "; ".join(f"{recording} of {', '.join(joints)}" for recording, joints in of.items())
                + f"; leave some away, or compare the joints that all of them hold (--joints {' '.join(shared)})"
            )


def _order(pieces: Sequence[Piece], share: float) -> tuple[np.ndarray, np.ndarray, int]:
    """The pieces' instants [K] in the log's order, the unit [K] of each, and how many units come first.

    The first part of every piece, then the rest of every piece; of pieces of one unit, the share of them.
    """
    groups: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    first = single = 0
    for piece in pieces:
        unit = np.unique(piece.unit.ravel(), return_inverse=True)[1].ravel()
        count = int(unit.max()) + 1
        fitted = min(count, max(1, round(share * count)))
        if count == 1:  # in turns
            fitted = math.ceil(share * (single + 1) - 1e-9) - math.ceil(share * single - 1e-9)
            single += 1
        numbers = np.arange(len(unit)) + first
        for group, inside in zip(groups, (range(fitted), range(fitted, count)), strict=True):
            group += [numbers[unit == u] for u in inside]
        first += len(unit)
    units = [*groups[0], *groups[1]]
    unit = np.repeat(np.arange(len(units)), [len(u) for u in units])
    return np.concatenate(units), unit, len(groups[0])


def _comparison(
    scene: Scene, recordings: Sequence[Recording], pieces: Sequence[Piece], order: np.ndarray, config: CompareConfig
) -> Comparison:
    """All instants as one measured motion of one repeat."""
    values = np.concatenate([piece.measured.reshape(-1, piece.measured.shape[2]) for piece in pieces])[order]
    at = np.concatenate([piece.at.ravel() for piece in pieces])[order]
    rate, alone = config.noise.rate, len(pieces) == 1
    gapless = alone and np.allclose(np.diff(at), np.diff(at).mean(), rtol=0.01)
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
    """The pieces, where they come in the log's order."""
    of = np.repeat(np.arange(len(pieces)), [piece.at.size for piece in pieces])[order]
    changes = np.flatnonzero(np.diff(of)) + 1
    starts, ends = np.r_[0, changes], np.r_[changes, len(of)]
    return tuple(
        Phase(pieces[int(of[a])].name, float(a) / rate, float(b) / rate)
        for a, b in zip(starts.tolist(), ends.tolist(), strict=True)
    )
