"""Our `gap` on recordings, in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.common import ROOT
from droid_jax.files import GAP
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Recording


def run_gap(recordings: Sequence[Recording], folder: Path, arguments: Sequence[str] = ()) -> dict[str, Any]:
    """What it says (of gap.json) and its seconds; its results stay in folder / "run".

    Raises RuntimeError with its last line where it fails.
    """
    paths = [str(folder / f"{r.name}.npz") for r in recordings]
    for recording, path in zip(recordings, paths, strict=True):
        save_recording(recording, path)
    out = folder / "run"
    command = [sys.executable, "-m", "droid_jax.run", "gap", *arguments, "--recording", *paths, "--out", str(out)]
    began = time.perf_counter()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}  # this checkout, and not what may be installed
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    seconds = time.perf_counter() - began
    if done.returncode:
        raise RuntimeError(f"gap ended with {done.returncode}: {' '.join(done.stderr.strip().splitlines()[-1:])}")
    found = json.loads((out / GAP).read_text())
    return {
        **{
            k: found[k] for k in ("verdict", "sentence", "effects", "indistinguishable", "p", "discrepancies", "shifts")
        },
        "seconds": seconds,
    }
