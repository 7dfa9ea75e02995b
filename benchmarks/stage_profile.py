"""Time of the default command by stage: compiling, replaying, training, and the rest.

    python benchmarks/stage_profile.py [--warm] [--quick] [--out DIR]

Runs `python -m droid_jax.run` in this process, with an empty compilation cache unless --warm.  jax reports how long
it traces, lowers and compiles; the remaining time of a batch of replays, or of a call of brax's PPO, is counted as
computing.  The rest of a stage is work of the host: recordings, statistics, pictures, files.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

import tyro  # noqa: E402

from benchmarks.common import origin, stem  # noqa: E402
from droid_jax import runtime  # noqa: E402
from droid_jax.commands import evaluate, gap, identify, train  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402

EVENTS = {  # of jax.monitoring: what we call them
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}
STAGES = {"identify": identify, "gap": gap, "train": train, "evaluate": evaluate}


@dataclass(frozen=True)
class Arguments:
    """Options."""

    warm: bool = False
    """Keep this machine's compilation cache, as in a second run."""
    quick: bool = False
    """The stage identify alone."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of stage_profile.json."""


@dataclass
class Times:
    """Seconds by stage and kind.

    Time of a kind that runs within another kind is not counted in the other.
    """

    stage: str = "start"
    seconds: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(lambda: defaultdict(float)))
    _within: list[float] = field(default_factory=lambda: [0.0])
    _ended: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])

    def add(self, kind: str, seconds: float) -> None:
        """Add seconds of a kind, which end now, without time inside them that was already counted."""
        began, inside = time.perf_counter() - seconds, 0.0
        while self._ended and self._ended[-1][0] >= began:
            inside += self._ended.pop()[1]
        self._ended.append((began, seconds))
        self.seconds[self.stage][kind] += seconds - inside
        self._within[-1] += seconds - inside

    def timed(self, kind: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its time counted as a kind."""

        def call(*arguments: Any, **named: Any) -> Any:
            began = time.perf_counter()
            self._within.append(0.0)
            try:
                return function(*arguments, **named)
            finally:
                whole, inside = time.perf_counter() - began, self._within.pop()
                self.seconds[self.stage][kind] += whole - inside
                self._within[-1] += whole

        return call

    def staged(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function as a stage, the rest of whose time is the host's."""
        whole = self.timed("host", function)

        def call(*arguments: Any, **named: Any) -> Any:
            before, self.stage = self.stage, stage
            try:
                return whole(*arguments, **named)
            finally:
                self.stage = before

        return call


def profiled(arguments: list[str]) -> Times:
    """Seconds of a command by stage and kind."""
    import jax
    from brax.training.agents.ppo import train as ppo

    from droid_jax import distributed
    from droid_jax.commands import all_stages
    from droid_jax.run import main as command

    times = Times()

    def compiled(event: str, duration_secs: float, **of: Any) -> None:
        if event in EVENTS:
            times.add(EVENTS[event], duration_secs)

    jax.monitoring.register_event_duration_secs_listener(compiled)
    timed = [(distributed, "over_processes", "replay"), (ppo, "train", "training")]
    staged = [(module, "run", stage) for stage, module in STAGES.items()]
    staged.append((all_stages, "record_synthetic", "record"))
    with contextlib.ExitStack() as stack:
        for wrap, of in ((times.timed, timed), (times.staged, staged)):
            for module, name, what in of:
                stack.enter_context(mock.patch.object(module, name, wrap(what, getattr(module, name))))
        if code := times.staged("other", command)(arguments):
            raise SystemExit(f"error: the command ended with exit code {code}")
    return times


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    with tempfile.TemporaryDirectory() as folder:
        if not arguments.warm:
            os.environ[runtime.CACHE_VARIABLE] = f"{folder}/cache"
        runtime.start()
        stages = ["--stages", "identify"] if arguments.quick else []
        began = time.perf_counter()
        times = profiled(["all", "--again", "--out", f"{folder}/run", *stages])
        whole = time.perf_counter() - began
    seconds = {
        stage: {kind: round(s, 1) for kind, s in times.seconds[stage].items()}
        for stage in ("record", *STAGES, "other")
        if stage in times.seconds
    }
    result = {"whole_s": round(whole, 1), "warm": arguments.warm, "seconds": seconds, **origin(0)}
    write_json(arguments.out / f"{stem('stage_profile', arguments.quick)}.json", result, indent=2)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
