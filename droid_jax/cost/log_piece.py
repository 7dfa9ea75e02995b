"""One repeat of a commanded recording as part of a `WindowedLog`: its windows, or its full motion.

A full motion is one window of the motion's length.  Pieces with one compiled program are replayed in one batch.
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

STRETCH_SECONDS = 0.5  # length of the stretches of a full motion, which are units of the tests as windows are
# Motions of different lengths share one compiled program of the longest one.  A motion may be replayed for at most so
# many times its own duration.
LONGEST_RATIO = 1.25
LONGEST_RATIO_OVER_TIME = (
    1.01  # for sensor errors that vary with time about the replay's middle: longer ones add offset
)
MANY_WINDOWS = 8  # windows of a sample from which on blocks of rows are large also for few samples
TRACES = ("torque", "position", "velocity", "object_angle")  # channels of a Rollout


@dataclass(frozen=True, eq=False)
class Piece:
    """One repeat of one recording: W windows, or its full motion as one window.

    name: of the recording, and the number of the repeat.  windows: their commands and start states.
    program: replays the windows (`compiled.window_program`).
    kernels: by channel [W, 1 or C, K, T], the filter of the windows' data; empty for a full motion.
    filters: by channel 1 or C matrices [K, T], the same of a full motion; empty for windows.
    columns: by channel [C] of the simulated channel.  measured: [W, K, all C] filtered data of all channels.
    at: [W, K] s, the instants on the recording's clock.  rows: [W, K] nearest rows of the replay.
    unit: [W, K] number of the window, or of the stretch of a full motion, of each instant.
    stated: vectors [..., D] -> the same with the values that this recording states (`Space.with_known`).
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
        """Number W of windows."""
        return len(self.at)

    @property
    def full_motion(self) -> bool:
        """Whether the motion is replayed as a whole from its beginning."""
        return bool(self.filters)

    def smoothed(self, rollout: Rollout, window: np.ndarray) -> dict[str, np.ndarray]:
        """Return {"smooth": [R, K, all C]}, the compared channels through the filter of their data.

        NaN where the replay blew up.

        rollout: [R, T, ...].  window: [R] number of each row's window.
        """
        parts = []
        for name, columns in self.columns.items():
            trace = getattr(rollout, name)
            trace = (trace[..., None] if trace.ndim == 2 else trace)[..., columns]
            if self.full_motion:
                each = self.filters[name] * (trace.shape[2] if len(self.filters[name]) == 1 else 1)
                parts.append(np.stack([(f @ trace[:, :, c].T).T for c, f in enumerate(each)], axis=2))
                continue
            kernels = self.kernels[name][window]  # [R, 1 or C, K, T]
            parts.append(
                kernels[:, 0] @ trace
                if kernels.shape[1] == 1
                else np.einsum("rckt,rtc->rkc", kernels, trace, optimize=True)
            )
        smooth = np.concatenate(parts, axis=2).astype(np.float64)
        smooth[~rollout.finite.astype(bool)] = np.nan
        return {"smooth": smooth}

    def traces(self, rollout: Rollout, window: np.ndarray) -> dict[str, np.ndarray]:
        """Return the simulated channels at the instants by name, [R, K, ...], and "finite" [R].

        rollout: [R, T, ...].  window: [R] number of each row's window.
        """
        rows = self.rows[window]
        index = np.arange(len(rows))[:, None]
        return {**{name: getattr(rollout, name)[index, rows] for name in TRACES}, "finite": rollout.finite.astype(bool)}

    def spread(self, values: np.ndarray) -> np.ndarray | None:
        """Return the change [W, K, all C, 2 nv] of the simulation by each column of the start states' spread.

        The columns of `Windows.spread` are a square root of the covariance of the start states.  The changes are
        central differences at `values` [D].  None where the start states have no spread.
        """
        windows = self.windows
        if not windows.spread.any():
            return None
        dofs, positions = windows.speed.shape[1], windows.start.shape[1]
        assert dofs == positions  # only hinges and slides, whose positions and speeds have the same order
        columns = 2 * dofs
        window = np.repeat(np.arange(self.count), columns)
        step = np.swapaxes(windows.spread, 1, 2).reshape(-1, columns)  # a row for each window and column
        rows, every = np.repeat(self.stated(values)[None], len(window), axis=0), np.arange(len(window))
        ends = list[np.ndarray]()
        for sign in (1.0, -1.0):
            start = windows.start[window] + sign * step[:, :dofs]
            speed = windows.speed[window] + sign * step[:, dofs:]
            inputs = [
                (windows.table, window), (start, every), (windows.gains, window), (speed, every),
                (windows.begin, window),
            ]  # fmt: skip
            blocks = _blocks(self.program, rows, inputs, self.count)
            ends.append(np.concatenate([self.smoothed(rollout, window[of])["smooth"] for rollout, of in blocks]))
        change = np.nan_to_num(0.5 * (ends[0] - ends[1])).reshape(self.count, columns, *ends[0].shape[1:])
        return np.moveaxis(change, 1, -1)


def replayed(
    pieces: Sequence[Piece],
    values: np.ndarray,
    reduce: Callable[[Piece, Rollout, np.ndarray], dict[str, np.ndarray]],
    active: Sequence[np.ndarray] | None = None,
) -> list[dict[str, np.ndarray]]:
    """Replay the windows of all pieces for samples [P, D], and return a reduction of the rollouts of each piece.

    Pieces that share a program share its blocks of rows.

    Args:
        pieces: of a log.
        values: [P, D].
        reduce: (piece, Rollout [R, T, ...], numbers [R] of the rows' windows) -> named arrays [R, ...].
        active: by piece, windows [W] bool to replay; None for all.

    Returns:
        By piece, named arrays [P, active windows, ...]; empty for a piece without active windows.
    """
    of_program = dict[int, list[int]]()
    for i, piece in enumerate(pieces):
        of_program.setdefault(id(piece.program), []).append(i)
    out = list[dict[str, np.ndarray]]({} for _ in pieces)
    for members in of_program.values():
        chosen = [np.arange(pieces[i].count) if active is None else np.flatnonzero(active[i]) for i in members]
        if not sum(map(len, chosen)):
            continue
        run = functools.partial(_replayed_together, [pieces[i] for i in members], chosen, reduce)
        for i, part in zip(members, distributed.over_processes(run, values), strict=True):
            out[i] = part
    return out


def _replayed_together(
    pieces: Sequence[Piece],
    chosen: Sequence[np.ndarray],
    reduce: Callable[[Piece, Rollout, np.ndarray], dict[str, np.ndarray]],
    values: np.ndarray,
) -> list[dict[str, np.ndarray]]:
    """The same as `replayed` for pieces of one program; chosen: numbers of the active windows of each."""
    count, each = len(values), sum(map(len, chosen))
    piece, window = np.repeat(np.arange(len(pieces)), list(map(len, chosen))), np.concatenate(chosen)
    piece, window = np.tile(piece, count), np.tile(window, count)
    first = np.cumsum([0, *(p.count for p in pieces)])[:-1]
    names, pick = ("table", "start", "gains", "speed", "begin"), first[piece] + window
    inputs = [(np.concatenate([getattr(p.windows, name) for p in pieces]), pick) for name in names]
    parts = list[list[dict[str, np.ndarray]]]([] for _ in pieces)
    rows = np.repeat(values, each, axis=0)
    for i, one in enumerate(pieces):
        rows[piece == i] = one.stated(rows[piece == i])
    for rollout, block in _blocks(pieces[0].program, rows, inputs, each):
        for i in np.unique(piece[block]).tolist():
            mine = piece[block] == i
            own = rollout if mine.all() else Rollout(*(getattr(rollout, f.name)[mine] for f in fields(rollout)))
            parts[i].append(reduce(pieces[i], own, window[block][mine]))
    return [
        {k: np.concatenate([p[k] for p in part]).reshape(count, len(w), *part[0][k].shape[1:]) for k in part[0]}
        if part
        else {}
        for part, w in zip(parts, chosen, strict=True)
    ]


def _blocks(
    program: Callable[..., Rollout], values: np.ndarray, inputs: Sequence[tuple[np.ndarray, np.ndarray]], each: int
) -> Iterator[tuple[Rollout, np.ndarray]]:
    """Replay rows block by block; yield each block's Rollout on the host, and the numbers of its rows.

    values: [R, D].  inputs: the program's other arrays, each with the number [R] of the entry that a row takes, since
    a copy for each row would not fit into memory.  each: number of rows of a sample.
    """
    size = block_size(len(values), each >= MANY_WINDOWS)
    for first in range(0, len(values), size):
        rows = np.minimum(np.arange(first, first + size), len(values) - 1)  # the last block repeats its last row
        count = min(size, len(values) - first)
        rollout = program(values[rows], *(np.asarray(a[pick[rows]], np.float32) for a, pick in inputs))
        yield Rollout(*(np.asarray(getattr(rollout, f.name))[:count] for f in fields(rollout))), rows[:count]


def shared_steps(steps: Sequence[int], effects: Sequence[Effect] = ()) -> list[int]:
    """Return the number of steps to replay each motion for, at least its own, so that few numbers are different.

    steps: of each motion.  effects: in the replays.
    """
    over_time = any(e.over_time and e.observe is not None for e in effects)
    ratio = LONGEST_RATIO_OVER_TIME if over_time else LONGEST_RATIO
    out, longest = [0] * len(steps), 0
    for i in sorted(range(len(steps)), key=lambda i: -steps[i]):
        longest = longest if steps[i] <= longest <= ratio * steps[i] else steps[i]
        out[i] = longest
    return out


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
    """Return a repeat in windows, without windows in which a sample is missing; None if no window remains.

    number: of the first window among those of all pieces, which sets where sampled windows lie.  For the other
    arguments see `windowed_log`.
    """
    if any(effect.profile is not None for effect in effects):
        windows = replace(windows, history=max(windows.history, windows.past))
    every = cut_windows(scene, recording, drive, repeat, windows, grid, number)
    if not len(every.begin):
        return None
    instants = (np.arange(max(1, round(windows.length * config.noise.rate))) + 0.5) / config.noise.rate
    clocks, at = every.begin[:, None] + np.arange(every.steps) * drive.timestep, every.begin[:, None] + windows.lead
    at = at + instants
    values, filters, columns = _measured(scene, recording, repeat, config, clocks, at)
    complete = np.asarray(~np.isnan(values).any(axis=(1, 2)))
    program = window_program(scene, space, drive, effects, every.earlier, every.steps)
    kernels = {key: _dense(each)[complete] for key, each in filters.items()}
    unit = np.repeat(np.arange(len(at))[:, None], at.shape[1], axis=1)
    of_windows = (a[complete] for a in (values, at, _nearest(at, clocks, drive), unit))
    stated = functools.partial(space.with_known, drive.known)
    stated(space.mean)  # raises here for wrong stated values, not at the first replay
    return Piece(
        _name(recording, repeat), every.subset(complete), program, kernels, {}, columns, *of_windows, stated=stated
    )


def as_full_motion(
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
    """Return a repeat's full motion from its beginning, without instants at which a sample is missing.

    Args:
        scene: what is simulated.
        space: meaning of the vectors [D].
        recording: with commands.
        repeat: its number.
        drive: what the replay follows.
        config: how simulation and measurement are compared.
        windows: the first `lead` seconds are not compared.  `reach` sets the spread of the start state, which is zero
            where an object is gripped, since its contacts change with it.
        effects: in the replay.
        steps: number of replayed steps.
        grid: s, time step whose last instant is the last one compared; None for the scene's.
    """
    begin = float(recording.time[0])
    end = end_on(recording, grid or drive.timestep)
    last = min(begin + end, *(float(recording.channel(n).time[-1]) for n in config.channels))
    clocks, at = (
        begin + np.arange(steps)[None] * drive.timestep,
        coarse_clock(begin + windows.lead, last, config.noise.rate)[None],
    )
    values, of_channels, columns = _measured(scene, recording, repeat, config, clocks, at)
    complete = ~np.isnan(values[0]).any(axis=1)
    unit = np.floor((at - at[0, 0]) / STRETCH_SECONDS).astype(int)
    unit = np.minimum(unit, max(int((at[0, -1] - at[0, 0]) / STRETCH_SECONDS) - 1, 0))
    filters = {key: tuple(f[complete] for f in each[0]) for key, each in of_channels.items()}
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
    of_motion = (a[:, complete] for a in (values, at, _nearest(at, clocks, drive), unit))
    stated = functools.partial(space.with_known, drive.known)
    stated(space.mean)  # raises here for wrong stated values, not at the first replay
    return Piece(_name(recording, repeat), motion, program, {}, filters, columns, *of_motion, stated=stated)


def _measured(
    scene: Scene, recording: Recording, repeat: int, config: CompareConfig, clocks: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, dict[str, list[tuple[sparse.csr_array, ...]]], dict[str, np.ndarray]]:
    """The smoothed measurement of a repeat's windows, with the filters of the simulated traces.

    clocks: [W, T] s, times of the replays' rows.  at: [W, K] s, instants.
    Returns values [W, K, all C], NaN where too little was measured; by channel the filters of each window; and by
    channel the simulated columns [C].
    """
    columns, measured = dict[str, np.ndarray](), list[np.ndarray]()
    filters = dict[str, list[tuple[sparse.csr_array, ...]]]()
    for name in config.channels:
        channel, columns[name] = compared_columns(scene, recording.channel(name), config.noise)
        each = [in_window(channel, repeat, *both, config.noise) for both in zip(clocks, at, strict=True)]
        measured.append(np.stack([values for values, _ in each]))
        filters[name] = [of_window for _, of_window in each]
    return np.concatenate(measured, axis=2), filters, columns


def _name(recording: Recording, repeat: int) -> str:
    return recording.name if recording.repeats == 1 else f"{recording.name}, repeat {repeat}"


def _nearest(at: np.ndarray, clocks: np.ndarray, drive: Drive) -> np.ndarray:
    """[W, K] rows of the replays that are nearest to instants `at` [W, K]."""
    return np.clip(np.rint((at - clocks[:, :1]) / drive.timestep).astype(int), 0, clocks.shape[1] - 1)


def _dense(each: Sequence[tuple[sparse.csr_array, ...]]) -> np.ndarray:
    """[W, 1 or C, K, T] dense array of every window's filters."""
    count = max(len(filters) for filters in each)
    dense = [np.stack([f.toarray() for f in filters]) for filters in each]
    return np.stack([np.broadcast_to(d, (count, *d.shape[1:])) for d in dense]).astype(np.float32)
