"""Import mujoco.mjx without the two lines that it prints if warp is not installed."""

from droid_jax.quiet import import_mjx

import_mjx()
# isort: split
import mujoco.mjx as mjx  # noqa: E402

__all__ = ["mjx"]
