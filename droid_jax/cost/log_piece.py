"""One repeat of a commanded recording as part of a `WindowedLog`: its windows, or its motion whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

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
from droid_jax.simulate.batching import block_size, in_blocks
from droid_jax.simulate.compiled import compiled_replay, window_program
from droid_jax.simulate.replay import Drive
from droid_jax.simulate.windows import WindowConfig, Windows, cut

STRETCH = 0.5  # s: what a motion that is replayed whole is divided into, as others are into windows
TRACES = ("torque", "position", "velocity", "object_angle")


@dataclass(frozen=True, eq=False)
class Piece:
    """One repeat of one recording: W windows, or one that is the whole motion.

    windows: None for a whole motion, of which `whole` makes batches.  program: of the windows.
    kernels: of windows, by channel [W, 1 or C, K, T], what its data went through.  filters: of a whole motion the same,
    1 or C of [K, T].  columns: by channel [C] of the simulated one.
    measured: [W, K, all C].  at: [W, K] s, the instants on the recording's clock.  rows: [W, K] of the replay, nearest.
    unit: [W, K] window, or stretch of a whole motion, that an instant is in.
    """

    name: str
    windows: Windows | None
    program: Callable[..., Rollout] | None
    whole: Callable[[np.ndarray], Rollout] | None
    kernels: dict[str, np.ndarray]
    filters: dict[str, tuple[sparse.csr_array, ...]]
    columns: dict[str, np.ndarray]
    measured: np.ndarray
    at: np.ndarray
    rows: np.ndarray
    unit: np.ndarray

    @property
    def count(self) -> int:
        """W."""
        return len(self.at)

    def replayed(
        self, values: np.ndarray, reduce: Callable[[Rollout, np.ndarray], Any], active: np.ndarray | None = None
    ) -> Any:
        """What `reduce` makes of every window's Rollout [R, T, ...] and its number [R], for samples [P, D]: arrays
        [P, W, ...], of active windows [W] bool alone.
        """
        chosen = np.arange(self.count) if active is None else np.flatnonzero(active)

        def samples(rows: np.ndarray) -> Any:
            which = np.tile(chosen, len(rows))
            found = self._run(np.repeat(rows, len(chosen), axis=0), which, *self._state(which), reduce)
            return {key: a.reshape(len(rows), len(chosen), *a.shape[1:]) for key, a in found.items()}

        if self.windows is not None:
            return distributed.over_processes(samples, values)
        assert self.whole is not None
        whole = self.whole
        found = in_blocks(lambda block: reduce(_host(whole(block)), np.zeros(len(block), int)), values)
        return {key: a[:, None] for key, a in found.items()}

    def _state(self, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert self.windows is not None
        return self.windows.start[which], self.windows.speed[which]

    def _run(
        self,
        values: np.ndarray,
        which: np.ndarray,
        start: np.ndarray,
        speed: np.ndarray,
        reduce: Callable[[Rollout, np.ndarray], dict[str, np.ndarray]],
    ) -> dict[str, np.ndarray]:
        """Rows [R] of windows `which` from states of their own, block by block."""
        assert self.windows is not None and self.program is not None
        size, found = block_size(len(values)), list[dict[str, np.ndarray]]()
        gains = np.repeat(self.windows.gains[None], size, axis=0)
        for first in range(0, len(values), size):
            mine = np.minimum(np.arange(first, first + size), len(values) - 1)  # the last block repeats its last row
            of = which[mine]
            given = self.windows.table[of], start[mine], gains, speed[mine], self.windows.begin[of]
            rollout = self.program(values[mine], *(np.asarray(a, np.float32) for a in given))
            count = min(size, len(values) - first)
            found.append({k: a[:count] for k, a in reduce(_host(rollout), of).items()})
        return {key: np.concatenate([part[key] for part in found]) for key in found[0]}

    def smoothed(self, rollout: Rollout, which: np.ndarray) -> dict[str, np.ndarray]:
        """ "smooth": [R, K, all C] the compared channels through the filter of their data; NaN where it blew up."""
        parts = []
        for name, columns in self.columns.items():
            trace = getattr(rollout, name)
            trace = (trace[..., None] if trace.ndim == 2 else trace)[..., columns]
            if self.windows is None:
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
        """[W, K, all C, 2 nv] what each column of the states' spread does to the simulation at `values` [D]."""
        windows = self.windows
        if windows is None:
            return None
        dofs, positions = windows.speed.shape[1], windows.start.shape[1]
        assert dofs == positions  # joints of one degree, in one order
        columns = 2 * dofs
        which = np.repeat(np.arange(self.count), columns)
        step = np.swapaxes(windows.spread, 1, 2).reshape(-1, columns)  # one row for each column
        rows = np.repeat(values[None], len(which), axis=0)
        start, speed = windows.start[which], windows.speed[which]
        ends = [
            self._run(rows, which, start + s * step[:, :dofs], speed + s * step[:, dofs:], self.smoothed)["smooth"]
            for s in (1.0, -1.0)
        ]
        found = np.nan_to_num(0.5 * (ends[0] - ends[1])).reshape(self.count, columns, *ends[0].shape[1:])
        return np.moveaxis(found, 1, -1)


def _host(rollout: Rollout) -> Rollout:
    return Rollout(*(np.asarray(getattr(rollout, f.name)) for f in fields(rollout)))


def make_piece(
    scene: Scene,
    space: Space,
    recording: Recording,
    *,
    repeat: int,
    drive: Drive,
    config: CompareConfig,
    windows: WindowConfig | None,
    effects: Sequence[Effect],
    grid: float | None,
) -> Piece:
    """A repeat in windows, or whole (windows: None), without what was not measured; see `windowed_log`."""
    made = None if windows is None else cut(scene, recording, drive, repeat, windows, grid)
    clocks, at = _clocks(recording, drive, config, windows, made)
    columns, measured = dict[str, np.ndarray](), list[np.ndarray]()
    passed = dict[str, list[tuple[sparse.csr_array, ...]]]()
    for name in config.channels:
        channel, columns[name] = compared_columns(scene, recording.channel(name), config.noise)
        each = [
            in_window(channel, repeat, clock, coarse, config.noise) for clock, coarse in zip(clocks, at, strict=True)
        ]
        measured.append(np.stack([values for values, _ in each]))
        passed[name] = [filters for _, filters in each]
    values = np.concatenate(measured, axis=2)
    rows = np.clip(np.rint((at - clocks[:, :1]) / drive.timestep).astype(int), 0, clocks.shape[1] - 1)
    seen = ~np.isnan(values).any(axis=2)  # [W, K]
    name = recording.name if recording.repeats == 1 else f"{recording.name}, repeat {repeat}"
    if made is None:
        kept = seen[0]
        unit = np.floor((at - at[0, 0]) / STRETCH).astype(int)
        unit = np.minimum(unit, max(int((at[0, -1] - at[0, 0]) / STRETCH) - 1, 0))
        filters = {key: tuple(f[kept] for f in each[0]) for key, each in passed.items()}
        whole = compiled_replay("mjx", scene, space, drive, effects)
        cut_to = (a[:, kept] for a in (values, at, rows, unit))
        return Piece(name, None, None, whole, {}, filters, columns, *cut_to)
    kept = np.asarray(seen.all(axis=1))
    program = window_program(scene, space, drive, effects, made.earlier, made.steps)
    kernels = {key: _dense(each)[kept] for key, each in passed.items()}
    unit = np.repeat(np.arange(len(at))[:, None], at.shape[1], axis=1)
    cut_to = (a[kept] for a in (values, at, rows, unit))
    return Piece(name, made.kept(kept), program, None, kernels, {}, columns, *cut_to)


def _clocks(
    recording: Recording, drive: Drive, config: CompareConfig, windows: WindowConfig | None, made: Windows | None
) -> tuple[np.ndarray, np.ndarray]:
    """[W, T] s of the replays' rows, and [W, K] s of the instants that are compared."""
    rate, begin = config.noise.rate, float(recording.time[0])
    if windows is None or made is None:
        clock = begin + drive.time
        last = min(clock[-1], *(recording.channel(n).time[-1] for n in config.channels))
        return clock[None], coarse_clock(float(clock[0]), float(last), rate)[None]
    instants = (np.arange(max(1, round(windows.length * rate))) + 0.5) / rate
    return made.begin[:, None] + np.arange(made.steps) * drive.timestep, made.begin[:, None] + windows.lead + instants


def _dense(each: Sequence[tuple[sparse.csr_array, ...]]) -> np.ndarray:
    """[W, 1 or C, K, T] of every window's filters."""
    wide = max(len(filters) for filters in each)
    written = [np.stack([f.toarray() for f in filters]) for filters in each]
    return np.stack([np.broadcast_to(w, (wide, *w.shape[1:])) for w in written]).astype(np.float32)
