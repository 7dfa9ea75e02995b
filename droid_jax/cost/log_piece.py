"""One repeat of a commanded recording as part of a `WindowedLog`: its windows, or its motion whole.

A whole motion is one window that lasts as long.  What shares a program is replayed in one batch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy import sparse

from droid_jax import distributed
from droid_jax.cost.noise import coarse_clock
from droid_jax.cost.observation import compared_columns, in_window
from droid_jax.cost.residuals import CompareConfig
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.batching import block_size
from droid_jax.simulate.compiled import window_program
from droid_jax.simulate.replay import Drive, end_on
from droid_jax.simulate.servo_gains import servo_factors
from droid_jax.simulate.windows import WindowConfig, Windows, cut_windows, start_spread

STRETCH = 0.5  # s: what a motion that is replayed whole is divided into, as others are into windows
LONGER = 1.25  # times its own duration that a motion is replayed for, to share a program and a batch with longer ones
ALIKE = 1.01  # the same where sensors err with time, centred on the replay's clock: what is added would be an offset
MANY = 8  # windows of a sample from which its batches always have many rows
TRACES = ("torque", "position", "velocity", "object_angle")


@dataclass(frozen=True, eq=False)
class Piece:
    """One repeat of one recording: W windows, or one that is the whole motion.

    program: of the windows (`compiled.window_program`).
    kernels: of windows, by channel [W, 1 or C, K, T], what its data went through.  filters: of a whole motion the same,
    1 or C of [K, T].  columns: by channel [C] of the simulated one.
    measured: [W, K, all C].  at: [W, K] s, the instants on the recording's clock.  rows: [W, K] of the replay, nearest.
    unit: [W, K] window, or stretch of a whole motion, that an instant is in.
    stated: rows [..., D] with what is known in this recording in place (`Space.with_known`).
    """

    name: str
    windows: Windows
    program: Callable[..., Rollout]
    kernels: dict[str, np.ndarray]
    filters: dict[str, tuple[sparse.csr_array, ...]]
    columns: dict[str, np.ndarray]
    measured: np.ndarray
    at: np.ndarray
    rows: np.ndarray
    unit: np.ndarray
    stated: Callable[[np.ndarray], np.ndarray]

    @property
    def count(self) -> int:
        """W."""
        return len(self.at)

    @property
    def whole(self) -> bool:
        """Whether its motion is replayed from its beginning."""
        return bool(self.filters)

    def smoothed(self, rollout: Rollout, which: np.ndarray) -> dict[str, np.ndarray]:
        """ "smooth": [R, K, all C] the compared channels through the filter of their data; NaN where it blew up."""
        parts = []
        for name, columns in self.columns.items():
            trace = getattr(rollout, name)
            trace = (trace[..., None] if trace.ndim == 2 else trace)[..., columns]
            if self.whole:
                each = self.filters[name] * (trace.shape[2] if len(self.filters[name]) == 1 else 1)
                parts.append(np.stack([(f @ trace[:, :, c].T).T for c, f in enumerate(each)], axis=2))
                continue
            own = self.kernels[name][which]  # [R, 1 or C, K, T]
            parts.append(
                own[:, 0] @ trace if own.shape[1] == 1 else np.einsum("rckt,rtc->rkc", own, trace, optimize=True)
            )
        smooth = np.concatenate(parts, axis=2).astype(np.float64)
        smooth[~rollout.finite.astype(bool)] = np.nan
        return {"smooth": smooth}

    def traces(self, rollout: Rollout, which: np.ndarray) -> dict[str, np.ndarray]:
        """The simulated channels at the instants, [R, K, ...], and "finite" [R]."""
        rows = self.rows[which]
        of = np.arange(len(rows))[:, None]
        return {**{name: getattr(rollout, name)[of, rows] for name in TRACES}, "finite": rollout.finite.astype(bool)}

    def spread(self, values: np.ndarray) -> np.ndarray | None:
        """[W, K, all C, 2 nv] what each column of the states' spread does to the simulation at `values` [D].

        None where there is none.
        """
        windows = self.windows
        if not windows.spread.any():
            return None
        dofs, positions = windows.speed.shape[1], windows.start.shape[1]
        assert dofs == positions  # joints of one degree, in one order
        columns = 2 * dofs
        which = np.repeat(np.arange(self.count), columns)
        step = np.swapaxes(windows.spread, 1, 2).reshape(-1, columns)  # one row for each column
        rows, own = np.repeat(self.stated(values)[None], len(which), axis=0), np.arange(len(which))
        ends = list[np.ndarray]()
        for s in (1.0, -1.0):
            start, speed = windows.start[which] + s * step[:, :dofs], windows.speed[which] + s * step[:, dofs:]
            given = [(windows.table, which), (start, own), (windows.gains, which), (speed, own), (windows.begin, which)]
            parts = [self.smoothed(r, which[of])["smooth"] for r, of in _blocks(self.program, rows, given, self.count)]
            ends.append(np.concatenate(parts))
        found = np.nan_to_num(0.5 * (ends[0] - ends[1])).reshape(self.count, columns, *ends[0].shape[1:])
        return np.moveaxis(found, 1, -1)


def replayed(
    pieces: Sequence[Piece],
    values: np.ndarray,
    reduce: Callable[[Piece, Rollout, np.ndarray], dict[str, np.ndarray]],
    active: Sequence[np.ndarray] | None = None,
) -> list[dict[str, np.ndarray]]:
    """What `reduce` makes of a piece's Rollout [R, T, ...] and the windows [R] it is of, for samples [P, D].

    active: by piece, windows [W] bool that are replayed; None: all.  Pieces that share a program share its blocks.
    Returns, by piece, arrays [P, active windows, ...]; nothing for a piece without any.
    """
    shared = dict[int, list[int]]()
    for i, piece in enumerate(pieces):
        shared.setdefault(id(piece.program), []).append(i)
    found = list[dict[str, np.ndarray]]({} for _ in pieces)
    for members in shared.values():
        chosen = [np.arange(pieces[i].count) if active is None else np.flatnonzero(active[i]) for i in members]
        if not sum(map(len, chosen)):
            continue
        run = functools.partial(_together, [pieces[i] for i in members], chosen, reduce)
        for i, part in zip(members, distributed.over_processes(run, values), strict=True):
            found[i] = part
    return found


def _together(
    pieces: Sequence[Piece],
    chosen: Sequence[np.ndarray],
    reduce: Callable[[Piece, Rollout, np.ndarray], dict[str, np.ndarray]],
    values: np.ndarray,
) -> list[dict[str, np.ndarray]]:
    """As `replayed`, of pieces of one program and their chosen windows."""
    count, each = len(values), sum(map(len, chosen))
    piece, window = np.repeat(np.arange(len(pieces)), list(map(len, chosen))), np.concatenate(chosen)
    piece, window = np.tile(piece, count), np.tile(window, count)
    first = np.cumsum([0, *(p.count for p in pieces)])[:-1]
    names, pick = ("table", "start", "gains", "speed", "begin"), first[piece] + window
    given = [(np.concatenate([getattr(p.windows, name) for p in pieces]), pick) for name in names]
    parts = list[list[dict[str, np.ndarray]]]([] for _ in pieces)
    rows = np.repeat(values, each, axis=0)
    for i, one in enumerate(pieces):
        rows[piece == i] = one.stated(rows[piece == i])
    for rollout, of in _blocks(pieces[0].program, rows, given, each):
        for i in np.unique(piece[of]).tolist():
            mine = piece[of] == i
            some = rollout if mine.all() else Rollout(*(getattr(rollout, f.name)[mine] for f in fields(rollout)))
            parts[i].append(reduce(pieces[i], some, window[of][mine]))
    return [
        {k: np.concatenate([p[k] for p in part]).reshape(count, len(w), *part[0][k].shape[1:]) for k in part[0]}
        if part
        else {}
        for part, w in zip(parts, chosen, strict=True)
    ]


def _blocks(
    program: Callable[..., Rollout], values: np.ndarray, given: Sequence[tuple[np.ndarray, np.ndarray]], each: int
) -> Iterator[tuple[Rollout, np.ndarray]]:
    """The Rollouts of rows [R, D] and of what else a program takes, block by block, on the host, and which they are.

    given: arrays, and which of their entries [R] the rows take: a table for each would not fit into memory.
    each: rows that every sample has.
    """
    size = block_size(len(values), each >= MANY)
    for first in range(0, len(values), size):
        rows = np.minimum(np.arange(first, first + size), len(values) - 1)  # the last block repeats its last row
        count = min(size, len(values) - first)
        rollout = program(values[rows], *(np.asarray(a[pick[rows]], np.float32) for a, pick in given))
        yield Rollout(*(np.asarray(getattr(rollout, f.name))[:count] for f in fields(rollout))), rows[:count]


def shared_steps(steps: Sequence[int], effects: Sequence[Effect] = ()) -> list[int]:
    """How long each of some motions is replayed, at least its own steps: few different numbers."""
    longer = ALIKE if any(e.over_time and e.observe is not None for e in effects) else LONGER
    found, longest = [0] * len(steps), 0
    for i in sorted(range(len(steps)), key=lambda i: -steps[i]):
        longest = longest if steps[i] <= longest <= longer * steps[i] else steps[i]
        found[i] = longest
    return found


def in_windows(
    scene: Scene,
    space: Space,
    recording: Recording,
    repeat: int,
    drive: Drive,
    config: CompareConfig,
    windows: WindowConfig,
    effects: Sequence[Effect],
    grid: float | None,
    number: int = 0,
) -> Piece | None:
    """A repeat in windows, without those in which something was not measured; see `windowed_log`.  None: in all."""
    if any(effect.profile is not None for effect in effects):
        windows = replace(windows, history=max(windows.history, windows.past))
    made = cut_windows(scene, recording, drive, repeat, windows, grid, number)
    if not len(made.begin):
        return None
    instants = (np.arange(max(1, round(windows.length * config.noise.rate))) + 0.5) / config.noise.rate
    clocks, at = made.begin[:, None] + np.arange(made.steps) * drive.timestep, made.begin[:, None] + windows.lead
    at = at + instants
    values, passed, columns = _measured(scene, recording, repeat, config, clocks, at)
    kept = np.asarray(~np.isnan(values).any(axis=(1, 2)))
    program = window_program(scene, space, drive, effects, made.earlier, made.steps)
    kernels = {key: _dense(each)[kept] for key, each in passed.items()}
    unit = np.repeat(np.arange(len(at))[:, None], at.shape[1], axis=1)
    cut_to = (a[kept] for a in (values, at, _nearest(at, clocks, drive), unit))
    stated = functools.partial(space.with_known, drive.known)
    stated(space.mean)  # refused here, not at the first call
    return Piece(_name(recording, repeat), made.subset(kept), program, kernels, {}, columns, *cut_to, stated=stated)


def as_a_whole(
    scene: Scene,
    space: Space,
    recording: Recording,
    repeat: int,
    drive: Drive,
    config: CompareConfig,
    windows: WindowConfig,
    effects: Sequence[Effect],
    steps: int,
    grid: float | None,
) -> Piece:
    """A repeat from its beginning, without instants that were not measured.

    steps: how many are replayed.  grid: s, the time step whose last instant is the last one compared; None: its
    own.  windows: `lead` of the beginning is not compared; `reach` tells how far the start may be off, but not where an
    object is gripped, whose contacts change with it.
    """
    begin = float(recording.time[0])
    end = end_on(recording, grid or drive.timestep)
    last = min(begin + end, *(float(recording.channel(n).time[-1]) for n in config.channels))
    clocks, at = (
        begin + np.arange(steps)[None] * drive.timestep,
        coarse_clock(begin + windows.lead, last, config.noise.rate)[None],
    )
    values, passed, columns = _measured(scene, recording, repeat, config, clocks, at)
    kept = ~np.isnan(values[0]).any(axis=1)
    unit = np.floor((at - at[0, 0]) / STRETCH).astype(int)
    unit = np.minimum(unit, max(int((at[0, -1] - at[0, 0]) / STRETCH) - 1, 0))
    filters = {key: tuple(f[kept] for f in each[0]) for key, each in passed.items()}
    table = np.concatenate([drive.command, np.repeat(drive.command[-1:], steps - len(drive.command), axis=0)])
    size = scene.model.nv
    spread = np.zeros((2 * size, 2 * size))
    if scene.grip is None:
        spread = start_spread(scene, recording, drive.qpos0, repeat, drive.timestep, windows)
    motion = Windows(
        np.zeros(1), table[None], servo_factors(scene, drive)[None], drive.qpos0[None], np.zeros((1, size)),
        spread[None], 0, steps,
    )  # fmt: skip
    program = window_program(scene, space, drive, effects, 0, steps)
    cut_to = (a[:, kept] for a in (values, at, _nearest(at, clocks, drive), unit))
    stated = functools.partial(space.with_known, drive.known)
    stated(space.mean)  # refused here, not at the first call
    return Piece(_name(recording, repeat), motion, program, {}, filters, columns, *cut_to, stated=stated)


def _measured(
    scene: Scene, recording: Recording, repeat: int, config: CompareConfig, clocks: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, dict[str, list[tuple[sparse.csr_array, ...]]], dict[str, np.ndarray]]:
    """[W, K, all C] what was measured at instants `at` [W, K]; its filters for replays with rows `clocks` [W, T], and
    the simulated columns, by channel.  NaN where too little was measured."""
    columns, measured = dict[str, np.ndarray](), list[np.ndarray]()
    passed = dict[str, list[tuple[sparse.csr_array, ...]]]()
    for name in config.channels:
        channel, columns[name] = compared_columns(scene, recording.channel(name), config.noise)
        each = [in_window(channel, repeat, *both, config.noise) for both in zip(clocks, at, strict=True)]
        measured.append(np.stack([values for values, _ in each]))
        passed[name] = [filters for _, filters in each]
    return np.concatenate(measured, axis=2), passed, columns


def _name(recording: Recording, repeat: int) -> str:
    return recording.name if recording.repeats == 1 else f"{recording.name}, repeat {repeat}"


def _nearest(at: np.ndarray, clocks: np.ndarray, drive: Drive) -> np.ndarray:
    return np.clip(np.rint((at - clocks[:, :1]) / drive.timestep).astype(int), 0, clocks.shape[1] - 1)


def _dense(each: Sequence[tuple[sparse.csr_array, ...]]) -> np.ndarray:
    """[W, 1 or C, K, T] of every window's filters."""
    wide = max(len(filters) for filters in each)
    written = [np.stack([f.toarray() for f in filters]) for filters in each]
    return np.stack([np.broadcast_to(w, (wide, *w.shape[1:])) for w in written]).astype(np.float32)
