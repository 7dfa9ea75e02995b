"""What the presets of `identify` and `gap` stand for."""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from droid_jax.identify.multistart import RefineConfig
    from droid_jax.identify.search import CmaConfig

Preset = Literal["quick", "standard", "paper", "gpu"]
TIMESTEP: dict[Preset, float] = {"quick": 0.004, "standard": 0.002, "paper": 0.002, "gpu": 0.002}  # s, built-in door


@functools.cache
def warn_of_cpu(preset: str) -> None:
    """Say once where the preset for a GPU runs on a CPU; jax must be tuned already."""
    import jax

    if preset == "gpu" and jax.default_backend() == "cpu":
        print(
            "warning: --preset gpu, but jax finds no GPU: on a CPU it takes hours (docs/ten-minutes.md: jax with CUDA)",
            file=sys.stderr,
        )


def search_config(preset: Preset, seed: int, **changes: int | None) -> CmaConfig:
    """The preset's search; changes: fields of CmaConfig that were asked for, None for those that were not."""
    from droid_jax.identify.search import CmaConfig

    chosen: dict[str, int | None] = {
        "quick": dict(population=30, parents=None, generations=20),
        "standard": dict(population=30, parents=None, generations=100),
        "paper": dict(population=30, parents=5, generations=100),
        "gpu": dict(population=1024, parents=None, generations=60, restarts=2),
    }[preset]
    asked = {name: value for name, value in changes.items() if value is not None}
    return CmaConfig(**{**chosen, **asked}, seed=seed)  # type: ignore[arg-type]


def refine_config(preset: Preset) -> RefineConfig | None:
    """The preset's refinement; None: the paper has none."""
    from droid_jax.identify.multistart import RefineConfig

    if preset == "paper":
        return None
    return RefineConfig(basin_hop_generations=12) if preset == "quick" else RefineConfig()
