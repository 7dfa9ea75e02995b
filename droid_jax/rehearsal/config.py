"""Settings of a rehearsal."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

from droid_jax.arguments import check_fields, number, several, weights, whole


def _assumed() -> dict[str, float]:
    return {"torque": 0.05, "position": 1e-4, "velocity": 0.01, "object_angle": 0.0035}


@dataclass(frozen=True)
class RehearsalConfig:
    """Settings of a rehearsal: when an effect counts as found, and what is assumed where nothing was measured.

    share: share of rehearsals in which an effect must be found.
    draws: number of draws of noise for that share.
    flips: largest number of sign flips of a score test; the search itself makes up to 4096.
    close: absolute cosine of two sensitivities above which one represents both in the largest statistic; cost.
    unrelated: cosine below which an effect does not change the score of another direction; cost.
    least_noncentrality, most_noncentrality: range in which the noncentrality of a test's threshold is searched.  An
      effect whose threshold is above it is not found.
    typical_noncentrality: of a score test's threshold, at which the test's direction is evaluated.
    recovered: posterior over prior deviation, below which a parameter counts as recovered; None for
      `IdentifiabilityConfig.identifiable`.
    pooling: degrees of freedom of the scatter over all directions, which each direction's own scatter is shrunk
      towards.
    noise: channel -> standard deviation of one sample, in its unit, where it was neither measured nor stated; those of
      torque, position and camera are of a Panda.
    smooth: share of the assumed noise; a channel of one repeat with less noise is taken for a command, not for a
      measurement.
    margin: factor on the size that the linear model predicts.  Four of ten effects on a single hinge were found at 1.4
      times that size and not at it, since the parameters and laws of another robot differ from the linear model.
    promise: factor on the smallest size from which the page says that an effect would surely be found; of an effect
      whose bound is smaller it says that it would not.
    known: share of the unabsorbed part of an effect that the library's law must explain for the effect to be found.
    faster: speed of the faster motion, over that of the given one.
    samples, sample_length: number and length, s, of the windows of long logs of held joints (`WindowConfig`); the
      search uses more and longer ones, which takes ten minutes instead of two.
    base_iterations: largest number of iterations of a fit of the base model to windows; cost.
    step_divisors: two divisors of the time step, for an extrapolation of its error to zero.
    rate: Hz, of simulated channels that were not measured.
    robot_rate, robot_timestep: Hz, s, of the synthetic robot.
    spread: prior deviations by which parameters of interest of a synthetic robot are drawn.
    farthest: largest draw of a synthetic robot's parameter, in units of its deviation.
    times: factors on the predicted size, which the hidden effects have in turn.
    empty_every: one of so many complete rehearsals has no hidden effect.
    strongest: largest factor between the size of the synthetic robot's law and that of the library's, either way.
    interval_level: level of the intervals that are compared with a synthetic robot's parameters.
    seed: of the draws.
    """

    share: float = 0.9
    draws: int = 40
    flips: int = 400
    close: float = 0.95
    unrelated: float = 0.05
    least_noncentrality: float = 0.2
    most_noncentrality: float = 80.0
    typical_noncentrality: float = 7.0
    recovered: float | None = None
    pooling: float = 12.0
    noise: dict[str, float] = field(default_factory=_assumed)
    smooth: float = 0.1
    margin: float = 1.4
    promise: float = 1.4
    known: float = 0.5
    faster: float = 1.5
    samples: int = 24
    sample_length: float = 1.5
    base_iterations: int = 5
    step_divisors: tuple[int, ...] = (8, 32)
    rate: float = 200.0
    robot_rate: float = 1000.0
    robot_timestep: float = 0.00025
    spread: float = 0.5
    farthest: float = 2.5
    times: tuple[float, ...] = (1.0, 0.5, 2.0)
    empty_every: int = 5
    strongest: float = 10.0
    interval_level: float = 0.9
    seed: int = 0

    def __post_init__(self) -> None:
        above, share = partial(number, above=0), partial(number, above=0, below=1)
        check_fields(
            self,
            share=share,
            draws=partial(whole, least=8),
            flips=partial(whole, least=100),
            close=partial(number, above=0, most=1),
            unrelated=partial(number, least=0, below=1),
            **dict.fromkeys(("least_noncentrality", "most_noncentrality", "typical_noncentrality"), above),
            pooling=above,
            noise=weights,
            smooth=partial(number, least=0),
            **dict.fromkeys(("margin", "promise"), partial(number, least=1)),
            known=partial(number, least=0, below=1),
            faster=above,
            samples=partial(whole, least=1),
            sample_length=above,
            base_iterations=partial(whole, least=0),
            step_divisors=several(partial(whole, least=2), 2),
            **dict.fromkeys(("rate", "robot_rate", "robot_timestep", "farthest"), above),
            spread=partial(number, least=0),
            times=several(above),
            empty_every=partial(whole, least=1),
            strongest=partial(number, least=1),
            interval_level=share,
            seed=partial(whole, least=0),
        )
        if self.step_divisors[0] >= self.step_divisors[1]:
            raise ValueError(f"step_divisors must increase, got {self.step_divisors}")


DEFAULT_REHEARSAL = RehearsalConfig()
