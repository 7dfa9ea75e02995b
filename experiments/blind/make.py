"""Recording the cases: what the search may see into one folder, the truth into another.

* CASES/<scene>_<digits>/case.json: the scene, and which effects the search must do without
* CASES/<scene>_<digits>/recordings/<role>.npz: fit, confirm, sealed
* SEALED/<scene>_<digits>.json: everything else
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Recording
from droid_jax.storage import new_folder, write_json
from droid_jax.synthetic.hidden_effects import Applied, record_hidden
from droid_jax.synthetic.robot import SyntheticRobotConfig
from experiments.blind.answers import without
from experiments.blind.cases import Limits, Plan, applied
from experiments.blind.draws import Truth, draw_truths, folder_of, seed_of
from experiments.blind.scenes import ROLES, Setting

ATTEMPTS = 8  # draws of a robot that keeps hold of its door with this effect


@dataclass(frozen=True)
class Drawn:
    """A case with everything drawn: hidden effects, and every recording's hidden values and seed."""

    hidden: tuple[Applied, ...]
    truths: Mapping[str, Truth]
    seeds: Mapping[str, int]


def make(setting: Setting, plan: Plan, commit: str, limits: Limits, cases: Path, sealed: Path) -> str:
    """Record one case; "there" where that was done before, "made", or in a word why it cannot be."""
    folder = folder_of(commit, plan.name)
    if (cases / folder).is_dir() and (sealed / f"{folder}.json").is_file():
        return "there"
    seed = seed_of(commit, plan.name)
    found = recorded(setting, plan, limits, seed)
    if isinstance(found, str):
        return found
    attempt, drawn, recordings = found
    left_out = without(setting.scene, drawn.hidden) if plan.kind == "left_out" else ()
    origin = {"without": left_out, "commit": commit, "seed": seed, "attempt": attempt}
    write_json(sealed / f"{folder}.json", {**asdict(plan), **_plain(drawn), **origin})
    write_case(cases / folder, setting.name, left_out, recordings)
    return "made"


def recorded(
    setting: Setting, plan: Plan, limits: Limits, seed: int
) -> tuple[int, Drawn, dict[str, Recording]] | Literal["not possible", "never held its door"]:
    """The first robot drawn that keeps hold of its door in all motions: number of the attempt, robot, recordings."""
    for attempt in range(ATTEMPTS):
        drawn = draw(setting, plan, limits, np.random.default_rng([seed, attempt]))
        if drawn is None:
            return "not possible"
        try:
            return attempt, drawn, record(setting, drawn)
        except ValueError as error:  # this robot loses its door: a demonstration is safe by definition
            if "grasp" not in str(error) and "unstable" not in str(error):
                raise
    return "never held its door"


def draw(setting: Setting, plan: Plan, limits: Limits, rng: np.random.Generator) -> Drawn | None:
    """Everything random of a case but the sensors' noise."""
    hidden = applied(setting, plan, limits, rng)
    if hidden is None:
        return None
    seeds = {role: int(rng.integers(1 << 31)) for role in ROLES}
    return Drawn(hidden, draw_truths(setting, rng), seeds)


def record(
    setting: Setting, drawn: Drawn, roles: tuple[str, ...] = ROLES, config: SyntheticRobotConfig | None = None
) -> dict[str, Recording]:
    """Role -> recording.  Raises ValueError where the synthetic robot loses the door."""
    out = {}
    for role in roles:
        made = record_hidden(
            setting.scene, setting.demonstrations[role], drawn.truths[role], drawn.hidden,
            seed=drawn.seeds[role], config=config, name=role, space=setting.base,
        )  # fmt: skip
        out[role] = _without_commands(made) if setting.prescribed else made
    return out


def write_case(folder: Path, scene: str, left_out: tuple[str, ...], recordings: Mapping[str, Recording]) -> None:
    """What the search is given: recordings without notes on how they were made."""
    with new_folder(folder) as new:
        write_json(new / "case.json", {"scene": scene, "without": list(left_out)})
        for role, recording in recordings.items():
            save_recording(replace(recording, meta={}), new / "recordings" / f"{role}.npz")


def _without_commands(recording: Recording) -> Recording:
    """A log of the motion alone."""
    return replace(recording, time=np.empty(0), command=np.empty((0, 0)), command_names=(), gains=None)


def _plain(drawn: Drawn) -> dict[str, Any]:
    return {
        "hidden": [asdict(a) for a in drawn.hidden],
        "truths": {role: dict(t) for role, t in drawn.truths.items()},
        "seeds": dict(drawn.seeds),
    }
