"""How far the fitted simulation may be trusted as a simulation: its time step, and MJX against plain C MuJoCo.

Both are measured once, at the fitted values, along the recordings' commands.  Logs without commands have no time step
and no contacts that an engine could treat otherwise: there is nothing to measure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax import runtime
from droid_jax.cost.cost import Cost
from droid_jax.cost.residuals import Comparison
from droid_jax.identify.holdout import unit_of
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model, make_physics
from droid_jax.model.scene import Scene, with_options
from droid_jax.model.variant import variant_scene
from droid_jax.preflight.creep import creep_note
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.c_reference import c_replay
from droid_jax.simulate.compiled import with_sensors
from droid_jax.simulate.replay import TORQUE_OFFSETS, Drive, make_drive, servo_replay

LARGE = 0.1  # share of the remaining error from which on a time step is too coarse, or two engines too far apart
EXPLAINED = 2.0  # times what half a time step changes: of an error of first order all of it
FINEST = 8  # times finer than the scene's own are the steps of the C engine, at most, and half of that
BLOWN = "blows up"
C_STEPS = 400_000  # of the C engine at most, some ten seconds


@dataclass(frozen=True)
class SolutionCheck:
    """What was measured of one recording's replay at the fitted values; of a channel through its data's filter.

    channel: the leading one of those compared.  unit: of it.  time_step: s.  remaining: root mean square over joints
    and time of simulated less measured channel, and no less than noise can be.
    parity_largest, parity_rms: largest and root mean square difference of the channel to the other engine (of a fit in
    MJX plain C MuJoCo as its time step goes to zero, of one in C MJX); parity_angle: largest difference of a position,
    rad or m; None where it cannot run the replay.
    discretisation: root mean square by which the channel changes at half the time step; parity_rms where that is small
    enough already (a difference to C without a time step holds the step's error), None where it was not measured.
    unmeasured: why something was not measured, empty where all was.
    """

    unit: str
    time_step: float
    remaining: float
    discretisation: float | None = None
    parity_largest: float | None = None
    parity_rms: float | None = None
    parity_angle: float | None = None
    unmeasured: str = ""
    channel: str = "torque"

    @property
    def too_coarse(self) -> bool:
        """Whether the time step changes the channel by more than LARGE of what the fit leaves."""
        return self.discretisation is not None and self.discretisation > LARGE * self.remaining

    @property
    def engines_differ(self) -> bool:
        """Whether MJX and C differ by more than LARGE of what the fit leaves, and than the time step explains."""
        if self.parity_rms is None:
            return False
        step = EXPLAINED * (self.discretisation or 0.0)
        return self.parity_rms > max(LARGE * self.remaining, step)


def check_solution(
    cost: Cost,
    recordings: Sequence[Recording],
    best: np.ndarray,
    engine: str,
    effects: Sequence[Effect] = (),
    compiles: bool = True,
) -> tuple[dict[str, SolutionCheck], np.ndarray]:
    """The checks by recording name, of all recordings with commands, and what the time step does.

    MJX is compiled once more at most.

    Args:
        cost: the fitted one, over the recordings.
        recordings: in the cost's order.
        best: [D] fitted values over the cost's space.
        engine: "mjx" or "mujoco", that the cost was made with.
        effects: beside the scene's own, as the cost was given them.
        compiles: whether MJX may be compiled; without, a fit in plain C is not compared with it.

    Returns:
        No checks of logs without commands; and [M] what a vanishing time step would change of the cost's residuals, as
        far as was measured, zero elsewhere.
    """
    found, compiled = dict[str, SolutionCheck](), not compiles
    rollouts = cost.rollouts(best[None])
    limits = list(rollouts)
    parts = zip(cost.comparisons, cost.drives, recordings, rollouts, strict=True)
    for number, (comparison, drive, recording, rollout) in enumerate(parts):
        if isinstance(drive, Drive):
            own = jax.tree.map(lambda a: a[0], rollout)
            here = cost.space.with_known(drive.known, best)
            replayed = _Replayed(cost, comparison, drive, recording, here, tuple(effects), own)
            found[comparison.name], limit, again = replayed.checked(engine, may_compile=not compiled)
            compiled = compiled or again
            if limit is not None:
                limits[number] = jax.tree.map(lambda a: np.asarray(a)[None], limit)
    off = cost.whitened_of(limits)[0].astype(np.float64) - cost.whitened_of(rollouts)[0]
    return found, np.where(np.isfinite(off), off, 0.0)


def solution_notes(found: Mapping[str, SolutionCheck], scene: str) -> list[str]:
    """What is to be known of a time step that is too coarse, and of engines that differ."""
    said = []
    for name, check in found.items():
        channel = check.channel.replace("_", " ")
        left = f"the {check.remaining:.2g} {check.unit} that the fit leaves"
        if check.too_coarse:
            said.append(
                f"the time step of scene {scene!r} is too coarse: at half of its {1e3 * check.time_step:g} ms the "
                f"fitted {channel}s of {name!r} change by {check.discretisation:.2g} {check.unit} (root mean square), "
                f"{_share(check.discretisation, check.remaining)} of {left}, and the fitted values make up for it: "
                "give <option> a smaller timestep and fit again"
            )
        if check.engines_differ:
            said.append(
                f"MJX and plain C MuJoCo differ at the fitted values of scene {scene!r}: {channel}s of {name!r} by "
                f"{check.parity_rms:.2g} {check.unit} (root mean square; {check.parity_largest:.2g} at most, positions "
                f"by {check.parity_angle:.2g} rad or m), {_share(check.parity_rms, check.remaining)} of {left}: a fit "
                "or a policy may not carry over from one engine to the other"
            )
        if BLOWN in check.unmeasured:
            said.append(f"recording {name!r} of scene {scene!r}: {check.unmeasured}; do not trust the fitted values")
    return said


def creep_of_fit(scene: Scene, space: Space, best: np.ndarray, recordings: Sequence[Recording]) -> list[str]:
    """What is to be known of joints that creep with the fitted values `best` [D] and did not with the scene's own."""
    said = list[str]()
    for recording in recordings:
        own = variant_scene(scene, recording.variant)
        fitted = make_c_model(own, space, space.with_known(recording.known, best))
        if not creep_note(own, recording) and (text := creep_note(own, recording, fitted)):
            said.append(text)
    return said


def _share(part: float | None, whole: float) -> str:
    share = 100.0 * (part or 0.0) / whole
    return f"{share:.0f} %" if share < 1000 else f"{share / 100:.0f} times"


@dataclass(frozen=True, eq=False)
class _Replayed:
    """One recording, and its replay at the fitted values."""

    cost: Cost
    comparison: Comparison
    drive: Drive
    recording: Recording
    best: np.ndarray
    effects: tuple[Effect, ...]
    rollout: Rollout

    def checked(self, engine: str, may_compile: bool) -> tuple[SolutionCheck, Rollout | None, bool]:
        """The checks, the replay as its time step goes to zero or None, and whether they took a compilation."""
        mj_step, channel = self.comparison.config.mj_step, self.comparison.leading
        left = max(
            _rms(self._filtered(self.rollout) - channel.noise.mean),
            self.comparison.config.noise.minimum[channel.name],
        )
        unit = unit_of(self.cost.scene, channel)
        check, limit = SolutionCheck(unit, self.drive.timestep, left, channel=channel.name), None
        if engine == "mujoco":
            if not mj_step:
                check, limit = self._with_step(check, self._in_c(2))
            if may_compile:
                check = self._with_parity(check, self._in_mjx(1, mj_step))
            return check, limit, may_compile
        other = self._in_c(1) if mj_step else self._converged_c()
        check = self._with_parity(check, other)
        if mj_step:  # the data were made with this very step
            return check, None, False
        if check.parity_rms is not None and check.parity_rms <= LARGE * check.remaining:
            assert not isinstance(other, str)
            return replace(check, discretisation=check.parity_rms), other, False
        if may_compile:
            check, limit = self._with_step(check, self._in_mjx(2))
        return check, limit, may_compile

    def _with_step(self, check: SolutionCheck, half: Rollout | str) -> tuple[SolutionCheck, Rollout | None]:
        """The check with the time step's part, and the replay without one: its error is of first order."""
        if isinstance(half, str):
            return replace(check, unmeasured="; ".join(filter(None, (check.unmeasured, half)))), None
        check = replace(check, discretisation=_rms(self._filtered(half) - self._filtered(self.rollout)))
        return check, _limit(half, self.rollout)

    def _with_parity(self, check: SolutionCheck, other: Rollout | str) -> SolutionCheck:
        if isinstance(other, str):
            return replace(check, unmeasured="; ".join(filter(None, (check.unmeasured, other))))
        off = self._filtered(other) - self._filtered(self.rollout)
        largest = float(np.abs(off).max())
        return replace(check, parity_largest=largest, parity_rms=_rms(off), parity_angle=self._angle(other))

    def _filtered(self, rollout: Rollout) -> np.ndarray:
        """[K, C] through the data's filter."""
        return np.asarray(self.comparison.smoothed(rollout), np.float64)

    def _angle(self, other: Rollout) -> float:
        pairs = ((other.position, self.rollout.position), (other.object_angle, self.rollout.object_angle))
        return max(float(np.abs(np.asarray(a) - np.asarray(b)).max(initial=0.0)) for a, b in pairs)

    def _finer(self, times: int) -> tuple[Scene, Drive]:
        """The scene with a finer time step, and the same commands on it."""
        finer = with_options(self.cost.scene, timestep=self.drive.timestep / times)
        scene = variant_scene(finer, self.recording.variant)
        return scene, replace(make_drive(scene, self.recording, weigh=False), qpos0=self.drive.qpos0)

    def _in_mjx(self, times: int, mj_step: bool = False) -> Rollout | str:
        """The replay in MJX with a finer time step, at the rows of the own one; or why there is none."""
        scene, drive = self._finer(times)
        space = self.cost.space
        effects = with_sensors(scene, space, drive, self.effects)
        try:
            replay = servo_replay(scene, drive, effects, parity=mj_step, late=0.0 if mj_step else 0.5)
            one = jax.jit(
                lambda values: replay(make_physics(scene, space, values)), compiler_options=runtime.compiler_options()
            )
            return self._at_own_rows(one(jnp.asarray(self.best, jnp.float32)), times, "MJX")
        except ValueError as error:
            return f"not compared with MJX: {error}"

    def _converged_c(self) -> Rollout | str:
        """The replay in plain C as its time step goes to zero, from two: its error is of first order in it."""
        times = _finer(len(self.drive.command))
        fine = self._in_c(times)
        if isinstance(fine, str) or times == 1:
            return fine
        coarse = self._in_c(times // 2)
        return coarse if isinstance(coarse, str) else _limit(fine, coarse)

    def _in_c(self, times: int) -> Rollout | str:
        """The replay in plain C with a finer time step, at the rows of the own one; or why there is none."""
        scene, drive = self._finer(times)
        late = 0.0 if self.comparison.config.mj_step else 0.5
        effects = [e for e in with_sensors(scene, self.cost.space, drive, self.effects) if e.name != TORQUE_OFFSETS]
        try:
            replayed = c_replay(scene, self.cost.space, drive, effects, late=late)(self.best[None])
        except ValueError as error:
            return f"not compared with plain C MuJoCo: {error}"
        return self._at_own_rows(jax.tree.map(lambda a: a[0], replayed), times, "plain C MuJoCo")

    def _at_own_rows(self, rollout: Rollout, times: int, where: str) -> Rollout | str:
        if not bool(rollout.finite):
            step = 1e3 * self.drive.timestep / times
            return f"the simulation {BLOWN} at the fitted values with a time step of {step:.3g} ms in {where}"
        rows, count = slice(None, None, times), len(self.drive.command)

        def own(traced: jax.Array) -> np.ndarray:
            array = np.asarray(traced)
            if array.ndim == 0:
                return array
            kept = array[rows][:count]
            missing = count - len(kept)  # rounding of the last row
            return np.concatenate([kept, np.repeat(kept[-1:], missing, axis=0)]) if missing else kept

        return jax.tree.map(own, rollout)


def _limit(half: Rollout, whole: Rollout) -> Rollout:
    """A replay as its time step goes to zero, from two of which one has half the other's."""
    return jax.tree.map(lambda a, b: a if a.dtype == bool else 2 * np.asarray(a) - np.asarray(b), half, whole)


def _finer(rows: int) -> int:
    """How many times finer the C engine steps: a power of two, FINEST at most, C_STEPS in all."""
    times = FINEST
    while times > 1 and times * rows > C_STEPS:
        times //= 2
    return times


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
