"""Importing this module prepares jax for many replays; import it before modules that start jax (mjx, evosax)."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # use the checkout of the script, not an installed package

from droid_jax import runtime
from droid_jax.quiet import import_mjx

runtime.tune()
import_mjx()
