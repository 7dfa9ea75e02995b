"""A fit to a recording with an effect recovers the effect's parameters."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import pytest
from effect_bench import Bench
from effect_oracles import ORACLES

from droid_jax.identify.fit import with_acting
from droid_jax.identify.multistart import RefineConfig, refine
from droid_jax.model.effect_interface import Effect
from droid_jax.model.parameters import Space

NOISE = 0.003  # N m: a sensor's 0.01, the mean of ten repeats
FAR = 5.0  # posterior deviations: 52 parameters stay inside unless something is wrong
KNOWN = 0.15  # relative width of a posterior up to which a parameter counts as identifiable
LEFT_OVER = 1.05  # mean square of the residuals in units of the noise, which is 1 but for its own scatter of 0.01


def starts(effect: Effect, free: Space) -> np.ndarray:
    """[S, D] neutral, with all combinations of shape values."""
    combinations = itertools.product(*effect.shape_parameters.values())
    return np.array([free.values(dict(zip(effect.shape_parameters, c, strict=True))) for c in combinations])


def check_recovery(bench: Bench, name: str, truth: Mapping[str, float]) -> None:
    """From neutral and the library's shape values, none of which is true; all other effects stay at neutral."""
    free = bench.space.select(truth)
    columns = [bench.space.index(n) for n in truth]
    clean = bench.torque(truth)[0]
    measured = clean + np.random.default_rng(0).normal(0, NOISE, clean.shape)

    def residuals(values: np.ndarray) -> np.ndarray:
        whole = np.tile(bench.space.mean, (len(values), 1))
        whole[:, columns] = values
        return ((bench.run(whole).torque - measured) / NOISE).reshape(len(values), -1)

    start = starts(bench.effect(name), free)
    # As `identify` does: an effect of one sign that reaches no limit at first has no slope there.
    start = np.stack([*start, *with_acting(free, start[0], [*truth])])
    true = np.array(list(truth.values()))
    assert (start != true).all() and (np.mean(residuals(start) ** 2, axis=1) > 2.0).all()
    fit = refine(residuals, free, start, RefineConfig(basin_hops=0))
    deviation = np.sqrt(np.diag(np.linalg.inv(fit.hessian))) * free.std
    assert np.mean(fit.residual**2) < LEFT_OVER
    assert (np.abs(fit.best - true) < FAR * deviation).all(), (fit.best, true, deviation)
    assert (deviation < KNOWN * np.abs(true)).all(), (true, deviation)


# One before the simulation and one after it; the others, which enter it, are slow.
QUICK = ("command_delay", "torque_bias")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in ORACLES
        if name != "soft_friction"  # which test_soft_friction.py has
    ],
)
def test_the_effects_parameters_are_recovered(small: Bench, name: str):
    check_recovery(small, name, ORACLES[name].values)


@pytest.mark.slow
def test_the_grips_softness_is_recovered(real: Bench):
    """The only effect that the small scene cannot have."""
    check_recovery(real, "contact_compliance", {"contact_softness": 0.7})
