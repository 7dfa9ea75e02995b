"""Choose the engine of a fit: plain C if it supports the replay and batches are small, else MJX.

On a CPU plain C steps an arm without contacts at least as fast as a compiled batch of MJX, and needs no compilation.
The first 30 s of a log of an SO-101 (six joints, 64 samples, one core) take 4.2 s in C; MJX compiles for 40 s and runs
for 6.1 s.  But C's steps are of first order (docs/simulation-step.md).  The mean of repeats is precise enough to
resolve their error.

A GPU is faster than the C engine on its host from about 16 samples per core on, and compiles for a minute
(`benchmarks/results/gpu.json`: 256 samples of the door on an H200 and on 16 cores).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax

from droid_jax import distributed, runtime
from droid_jax.model.effect_interface import Effect
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.c_reference import why_not_in_c
from droid_jax.simulate.replay import replayed_torque

ENGINES = ("mjx", "mujoco")
CHOICES = ("auto", *ENGINES)
PER_CORE = 16  # samples per core up to which C is faster than a GPU


@dataclass(frozen=True)
class EngineChoice:
    """An engine ("mjx" or "mujoco") and why it was chosen, for messages."""

    engine: str
    why: str


def choose_engine(
    scene: Scene, space: Space, recordings: Sequence[Recording], effects: Sequence[Effect] = (), samples: int = 1
) -> EngineChoice:
    """The engine for a fit of `space` to recordings, if the user names none.

    Args:
        scene: what is simulated.
        space: the parameters and nuisances that are fitted.
        recordings: to be replayed.
        effects: in the model.
        samples: parameter vectors of a batch.

    Returns:
        Plain C ("mujoco") in one process, for commanded motions of one repeat in a scene without contact pairs, if C
        supports the replay.  On a machine with a GPU also the batch must be small (PER_CORE).  Else MJX.
    """
    accelerated = (backend := jax.default_backend()) != "cpu"
    if accelerated and samples > PER_CORE * runtime.cores():
        return EngineChoice("mjx", f"jax runs on {backend}, {samples} samples at a time")
    if distributed.count() > 1:
        return EngineChoice("mjx", "several processes share the samples")
    if any(not recording.command.size for recording in recordings):
        return EngineChoice("mjx", "a log without commands is replayed by inverse dynamics")
    if any(recording.repeats > 1 for recording in recordings):
        return EngineChoice("mjx", "repeats resolve the error of C's first-order steps")
    if scene.has_contacts:
        return EngineChoice("mjx", "contact pairs need its second-order step")
    reasons = [
        why_not_in_c(variant_scene(scene, r.variant, r.name), space, replayed_torque(r), effects) for r in recordings
    ]
    if reason := next(filter(None, reasons), None):
        return EngineChoice("mjx", reason)
    case = f"for {samples} samples a batch" if accelerated else "on a CPU"
    return EngineChoice("mujoco", f"{case} it is as fast and compiles nothing")
