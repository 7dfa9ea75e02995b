"""Importing this prepares jax for many replays; it must come before what starts jax (mjx, evosax)."""

from droid_jax import runtime

runtime.tune()
runtime.import_mjx()
