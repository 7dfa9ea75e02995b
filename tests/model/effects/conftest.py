"""Compiled replays that the tests of the effects share."""

from __future__ import annotations

import pytest
from effect_bench import Bench, bare, door_bench, mechanism_bench

from droid_jax.model.effect_interface import Rollout


@pytest.fixture(scope="session")
def small() -> Bench:
    """The small scene with all its effects."""
    return mechanism_bench()


@pytest.fixture(scope="session")
def small_bare(small: Bench) -> Rollout:
    """The small scene without effects."""
    return bare(small)


@pytest.fixture(scope="session")
def real() -> Bench:
    """The door scene with all its effects; for slow tests."""
    return door_bench()
