"""Which engine replays a fit: plain C where it can and a batch is not too large for it, else MJX.

On a CPU plain C steps an arm without contacts at least as fast as a compiled batch of MJX, and compiles nothing.  The
first 30 s of a log of an SO-101 (six joints, 64 samples, one core): MJX 40 s of compilation and 6.1 s, C 4.2 s.  Its
steps are of first order, though (docs/simulation-step.md): repeats, whose mean is precise, resolve their error.

A GPU overtakes the C engine on the processor beside it at some 16 samples per core, and compiles for a minute
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

ENGINES = ("mjx", "mujoco")
CHOICES = ("auto", *ENGINES)
PER_CORE = 16  # samples of a batch up to which C is the faster one beside a GPU


@dataclass(frozen=True)
class EngineChoice:
    """engine: "mjx" or "mujoco"; why: it was chosen, to be shown."""

    engine: str
    why: str


def choose_engine(
    scene: Scene, space: Space, recordings: Sequence[Recording], effects: Sequence[Effect] = (), samples: int = 1
) -> EngineChoice:
    """The engine for a fit of `space` to recordings, where the caller has no wish.

    Args:
        scene: what is simulated.
        space: the parameters and nuisances that are fitted.
        recordings: to be replayed.
        effects: in the model.
        samples: parameter vectors that are replayed at a time.

    Returns:
        Plain C ("mujoco") in one process, for commanded motions of one repeat in a scene without contact pairs, where C
        has all that the replay needs, and on a machine with a GPU for batches of few samples; else MJX.
    """
    accelerated = (backend := jax.default_backend()) != "cpu"
    if accelerated and samples > PER_CORE * runtime.cores():
        return EngineChoice("mjx", f"jax runs on {backend}, {samples} samples at a time")
    if distributed.count() > 1:
        return EngineChoice("mjx", "several processes share the samples")
    if any(not recording.command.size for recording in recordings):
        return EngineChoice("mjx", "a log without commands is replayed by inverse dynamics")
    if any(recording.repeats > 1 for recording in recordings):
        return EngineChoice("mjx", "repeats resolve the error of C's steps of first order")
    if scene.grip is not None or scene.model.npair:
        return EngineChoice("mjx", "contact pairs need its second-order step")
    reasons = [why_not_in_c(variant_scene(scene, r.variant), space, r.torque, effects) for r in recordings]
    if reason := next(filter(None, reasons), None):
        return EngineChoice("mjx", reason)
    place = f"for {samples} samples a batch" if accelerated else "on a CPU"
    return EngineChoice("mujoco", f"{place} it is as fast and compiles nothing")
