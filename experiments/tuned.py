"""Importing this prepares jax for many replays; it must come before what starts jax (mjx, evosax)."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the checkout of the script, whatever is installed

from droid_jax import runtime

runtime.tune()
runtime.import_mjx()
