"""Numerical errors of the fitted simulation: of its time step, and between MJX and plain C MuJoCo.

Both are measured once, at the fitted values, along the recordings' commands.  A log without commands is replayed by
inverse dynamics, without time steps or contacts, so there is nothing to measure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax import runtime
from droid_jax.arguments import check_fields, number, whole
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

BLOWN = "blows up"  # in the reason why something was not measured


@dataclass(frozen=True)
class SolutionCheckConfig:
    """Settings of the checks.

    tolerance: share of the remaining error.  A time step that changes the channel by more is too coarse, and engines
      that differ by more differ too much; a design choice.
    step_factor: times the change at half the time step, the difference of engines that the time step explains; 2 for an
      error of first order.
    finest: largest factor by which C MuJoCo divides the time step; cost.
    c_steps: largest number of steps of C MuJoCo in one replay, some ten seconds; cost.
    """

    tolerance: float = 0.1
    step_factor: float = 2.0
    finest: int = 8
    c_steps: int = 400_000

    def __post_init__(self) -> None:
        check_fields(
            self,
            tolerance=partial(number, above=0),
            step_factor=partial(number, least=0),
            finest=partial(whole, least=1),
            c_steps=partial(whole, least=1),
        )


DEFAULT_CHECKS = SolutionCheckConfig()


@dataclass(frozen=True)
class SolutionCheck:
    """Numerical errors of one recording's replay at the fitted values, of a channel through its data's filter.

    unit: of the channel.  time_step: s.
    remaining: root mean square residual of the channel over joints and time, at least the smallest noise.
    discretisation: root mean square change of the channel at half the time step.  It is `parity_rms` if that is below
      the tolerance, since the difference to C with a vanishing time step includes the time step's error.
    parity_largest, parity_rms: largest and root mean square difference of the channel to the other engine.  A fit in
      MJX is compared with plain C MuJoCo with a vanishing time step, a fit in C with MJX.
    parity_angle: largest difference of a position, rad or m.
    unmeasured: why something was not measured; empty if all was.  What was not measured is None.
    channel: the leading one of those compared.  config: tolerances.
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
    config: SolutionCheckConfig = DEFAULT_CHECKS

    @property
    def too_coarse(self) -> bool:
        """Whether the time step changes the channel by more than the tolerance."""
        return self.discretisation is not None and self.discretisation > self.config.tolerance * self.remaining

    @property
    def engines_differ(self) -> bool:
        """Whether MJX and C differ by more than the tolerance, and by more than the time step explains."""
        if self.parity_rms is None:
            return False
        by_step = self.config.step_factor * (self.discretisation or 0.0)
        return self.parity_rms > max(self.config.tolerance * self.remaining, by_step)


def check_solution(
    cost: Cost,
    recordings: Sequence[Recording],
    best: np.ndarray,
    engine: str,
    effects: Sequence[Effect] = (),
    compiles: bool = True,
    config: SolutionCheckConfig = DEFAULT_CHECKS,
) -> tuple[dict[str, SolutionCheck], np.ndarray]:
    """Measure the numerical errors of all recordings with commands.

    MJX is compiled once more at most.

    Args:
        cost: the fitted one, over the recordings.
        recordings: in the cost's order.
        best: [D] fitted values over the cost's space.
        engine: "mjx" or "mujoco", that the cost was made with.
        effects: of the cost, in addition to the scene.
        compiles: whether MJX may be compiled; if not, a fit in plain C is not compared with it.
        config: settings.

    Returns:
        The checks by recording name; and [M] the change of the cost's residuals with a vanishing time step, zero where
        it was not measured.
    """
    checks, compiled = dict[str, SolutionCheck](), not compiles
    rollouts = cost.rollouts(best[None])
    limits = list(rollouts)
    parts = zip(cost.comparisons, cost.drives, recordings, rollouts, strict=True)
    for row, (comparison, drive, recording, rollout) in enumerate(parts):
        if isinstance(drive, Drive):
            sample = jax.tree.map(lambda a: a[0], rollout)
            values = cost.space.with_known(drive.known, best)
            replayed = _Replayed(cost, comparison, drive, recording, values, tuple(effects), sample, config)
            checks[comparison.name], limit, again = replayed.checked(engine, may_compile=not compiled)
            compiled = compiled or again
            if limit is not None:
                limits[row] = jax.tree.map(lambda a: np.asarray(a)[None], limit)
    change = cost.whitened_of(limits)[0].astype(np.float64) - cost.whitened_of(rollouts)[0]
    return checks, np.where(np.isfinite(change), change, 0.0)


def solution_notes(checks: Mapping[str, SolutionCheck], scene: str) -> list[str]:
    """Return notes about a time step that is too coarse, engines that differ, and replays that blow up.

    checks: by recording name.  scene: its name.
    """
    notes = []
    for name, check in checks.items():
        channel = check.channel.replace("_", " ")
        error = f"the remaining error of {check.remaining:.2g} {check.unit}"
        if check.too_coarse:
            notes.append(
                f"the time step of scene {scene!r} is too coarse: at half of its {1e3 * check.time_step:g} ms the "
                f"fitted {channel}s of {name!r} change by {check.discretisation:.2g} {check.unit} (root mean square), "
                f"{_share(check.discretisation, check.remaining)} of {error}, and the fitted values compensate for it: "
                "give <option> a smaller timestep and fit again"
            )
        if check.engines_differ:
            notes.append(
                f"MJX and plain C MuJoCo differ at the fitted values of scene {scene!r}: {channel}s of {name!r} by "
                f"{check.parity_rms:.2g} {check.unit} (root mean square; {check.parity_largest:.2g} at most, positions "
                f"by {check.parity_angle:.2g} rad or m), {_share(check.parity_rms, check.remaining)} of {error}: a fit "
                "or a policy may not carry over from one engine to the other"
            )
        if BLOWN in check.unmeasured:
            notes.append(f"recording {name!r} of scene {scene!r}: {check.unmeasured}; do not trust the fitted values")
    return notes


def creep_of_fit(scene: Scene, space: Space, best: np.ndarray, recordings: Sequence[Recording]) -> list[str]:
    """Return notes about joints that creep with the fitted values `best` [D] but not with the scene's values."""
    notes = list[str]()
    for recording in recordings:
        own = variant_scene(scene, recording.variant, recording.name)
        fitted = make_c_model(own, space, space.with_known(recording.known, best))
        if not creep_note(own, recording) and (text := creep_note(own, recording, fitted)):
            notes.append(text)
    return notes


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
    config: SolutionCheckConfig

    def checked(self, engine: str, may_compile: bool) -> tuple[SolutionCheck, Rollout | None, bool]:
        """Return the check, the replay with a vanishing time step or None, and whether MJX was compiled."""
        mj_step, channel = self.comparison.config.mj_step, self.comparison.leading
        remaining = max(
            _rms(self._filtered(self.rollout) - channel.noise.mean),
            self.comparison.config.noise.minimum[channel.name],
        )
        unit = unit_of(self.cost.scene, channel)
        check = SolutionCheck(unit, self.drive.timestep, remaining, channel=channel.name, config=self.config)
        limit = None
        if engine == "mujoco":
            if not mj_step:
                check, limit = self._with_step(check, self._in_c(2))
            if may_compile:
                check = self._with_parity(check, self._in_mjx(1, mj_step))
            return check, limit, may_compile
        other = self._in_c(1) if mj_step else self._converged_c()
        check = self._with_parity(check, other)
        if mj_step:  # the data were made with this time step
            return check, None, False
        if check.parity_rms is not None and check.parity_rms <= self.config.tolerance * check.remaining:
            assert not isinstance(other, str)
            return replace(check, discretisation=check.parity_rms), other, False
        if may_compile:
            check, limit = self._with_step(check, self._in_mjx(2))
        return check, limit, may_compile

    def _with_step(self, check: SolutionCheck, half: Rollout | str) -> tuple[SolutionCheck, Rollout | None]:
        """The check with the time step's error, and the replay extrapolated to a vanishing time step."""
        if isinstance(half, str):
            return replace(check, unmeasured="; ".join(filter(None, (check.unmeasured, half)))), None
        check = replace(check, discretisation=_rms(self._filtered(half) - self._filtered(self.rollout)))
        return check, _limit(half, self.rollout)

    def _with_parity(self, check: SolutionCheck, other: Rollout | str) -> SolutionCheck:
        if isinstance(other, str):
            return replace(check, unmeasured="; ".join(filter(None, (check.unmeasured, other))))
        difference = self._filtered(other) - self._filtered(self.rollout)
        largest = float(np.abs(difference).max())
        return replace(check, parity_largest=largest, parity_rms=_rms(difference), parity_angle=self._angle(other))

    def _filtered(self, rollout: Rollout) -> np.ndarray:
        """[K, C] the leading channel through the data's filter."""
        return np.asarray(self.comparison.smoothed(rollout), np.float64)

    def _angle(self, other: Rollout) -> float:
        """Largest difference of a position, rad or m."""
        pairs = ((other.position, self.rollout.position), (other.object_angle, self.rollout.object_angle))
        return max(float(np.abs(np.asarray(a) - np.asarray(b)).max(initial=0.0)) for a, b in pairs)

    def _finer(self, times: int) -> tuple[Scene, Drive]:
        """The scene with a finer time step, and the same commands on it."""
        finer = with_options(self.cost.scene, timestep=self.drive.timestep / times)
        scene = variant_scene(finer, self.recording.variant)
        return scene, replace(make_drive(scene, self.recording, weigh=False), qpos0=self.drive.qpos0)

    def _in_mjx(self, times: int, mj_step: bool = False) -> Rollout | str:
        """The replay in MJX with a finer time step, at the rows of the fitted one; or why there is none."""
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
        """The replay in plain C extrapolated to a vanishing time step, from two: the error is of first order in it."""
        times = self._refinement(len(self.drive.command))
        fine = self._in_c(times)
        if isinstance(fine, str) or times == 1:
            return fine
        coarse = self._in_c(times // 2)
        return coarse if isinstance(coarse, str) else _limit(fine, coarse)

    def _in_c(self, times: int) -> Rollout | str:
        """The replay in plain C with a finer time step, at the rows of the fitted one; or why there is none."""
        scene, drive = self._finer(times)
        late = 0.0 if self.comparison.config.mj_step else 0.5
        effects = [e for e in with_sensors(scene, self.cost.space, drive, self.effects) if e.name != TORQUE_OFFSETS]
        try:
            replayed = c_replay(scene, self.cost.space, drive, effects, late=late)(self.best[None])
        except ValueError as error:
            return f"not compared with plain C MuJoCo: {error}"
        return self._at_own_rows(jax.tree.map(lambda a: a[0], replayed), times, "plain C MuJoCo")

    def _refinement(self, rows: int) -> int:
        """Factor by which C MuJoCo divides the time step of a replay of so many rows: a power of two."""
        times = 2 ** int(np.log2(self.config.finest))
        while times > 1 and times * rows > self.config.c_steps:
            times //= 2
        return times

    def _at_own_rows(self, rollout: Rollout, times: int, where: str) -> Rollout | str:
        """The rows of a replay with a finer time step that the fitted one has; or that it blew up."""
        if not bool(rollout.finite):
            step = 1e3 * self.drive.timestep / times
            return f"the simulation {BLOWN} at the fitted values with a time step of {step:.3g} ms in {where}"
        rows, count = slice(None, None, times), len(self.drive.command)

        def own(traced: jax.Array) -> np.ndarray:
            array = np.asarray(traced)
            if array.ndim == 0:
                return array
            coarse = array[rows][:count]
            missing = count - len(coarse)  # by rounding, the last row may be missing
            return np.concatenate([coarse, np.repeat(coarse[-1:], missing, axis=0)]) if missing else coarse

        return jax.tree.map(own, rollout)


def _limit(half: Rollout, whole: Rollout) -> Rollout:
    """A replay extrapolated to a vanishing time step (Richardson), from one with half the time step of the other."""
    return jax.tree.map(lambda a, b: a if a.dtype == bool else 2 * np.asarray(a) - np.asarray(b), half, whole)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
