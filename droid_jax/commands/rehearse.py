"""`rehearse`: predicts what a search with these motions would find."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from droid_jax.commands.folder import fingerprints, setup_of, stage_folder
from droid_jax.commands.gap import GapCommand, chosen_effects, effect_scale, gap_config, gap_model, values_of
from droid_jax.commands.options import (
    Channel,
    JointFriction,
    load_effects,
    needs_recording,
    needs_scene,
    quick_settings,
    recording_at,
    refine_config,
    search_config,
    warn_of_cpu,
)
from droid_jax.commands.writer import writes
from droid_jax.files import FIT, REHEARSAL, REHEARSAL_PAGE
from droid_jax.storage import finite, refuse_special, write_own

if TYPE_CHECKING:
    from droid_jax.discrepancy.config import DiscrepancyConfig
    from droid_jax.model.effect_interface import Effect
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording
    from droid_jax.rehearsal.config import RehearsalConfig
    from droid_jax.rehearsal.linearised import Rehearsed
    from droid_jax.rehearsal.plan import RehearsalPlan

DOOR_MOTIONS, DOOR_REPEATS = ("C", "B"), 10  # train and validation motion if no recording is given


@dataclass(frozen=True)
class Rehearse:
    """Predict which parameters would be identifiable and which effects would be found, from which size, with these
    motions.

    Quick, without fits: from the sensitivity of the replay to each parameter and effect, and the noise. --full makes
    synthetic logs with hidden effects, and fits and searches them.
    """

    recording: tuple[Path, ...] = ()
    """Recordings as in `gap`. Their commands and noise are used, or only their commands (--repeats). Default: two
    motions of the built-in door."""
    repeats: int | None = None
    """Number of repeats of each motion. The measurements are then replaced by simulated ones."""
    noise: tuple[str, ...] = ()
    """Noise deviation of one sample, CHANNEL=DEVIATION, for example torque=0.05 position=1e-4, in N m, rad, m or per
    second. Default: estimated from the scatter of the repeats, otherwise that of a Panda."""
    fit: Path | None = None
    """Folder of a finished `identify`, whose values are used instead of the initial means."""
    full: int = 0
    """Number of complete rehearsals: synthetic logs, fitted and searched. Each takes as long as `gap`."""
    compare: tuple[Channel, ...] = ()
    """Measured channels to compare; default: as in gap."""
    preset: Literal["quick", "standard", "gpu"] = "quick"
    """Preset of the fits of --full, as in identify."""
    scene: Path | None = None
    """Your own MJCF instead of the built-in door."""
    parameters: Path | None = None
    """JSON list of the parameters of your own scene (docs/your-robot.md)."""
    joints: tuple[str, ...] = ()
    """Measured joints of your own scene; default: all driven joints."""
    object_joint: str | None = None
    """Joint of the object that is moved, in your own scene."""
    joint_friction: JointFriction = "held"
    """Dry friction of your own scene's joints, as in gap."""
    effects: tuple[str, ...] = ()
    """Effects of the library to hide; default: all that the scene can have."""
    without: tuple[str, ...] = ()
    """Effects of the library to leave out."""
    effect_scale: float | None = None
    """Forces and torques of the library's effects, as in gap."""
    user_effects: Path | None = None
    """Python file that registers your own effects (docs/your-effect.md); it is executed."""
    seed: int = 0
    """Seed of the drawn noise and of the hidden robots."""
    out: Path = Path("runs/rehearse")
    """Folder of rehearsal.html and rehearsal.json. Existing rehearsals of --full are not repeated."""


@writes(None)
def run(command: Rehearse) -> None:
    """Rehearse, write page and JSON, and print the summary."""
    from droid_jax import runtime

    needs_scene(command)
    needs_recording(command)
    if command.full < 0 or (command.repeats is not None and command.repeats < 1):
        raise ValueError("--full and --repeats must be whole numbers above 0")
    runtime.start()
    if command.full:
        warn_of_cpu(command.preset)
    from droid_jax.rehearsal.config import RehearsalConfig
    from droid_jax.rehearsal.quick import quick_rehearsal

    refuse_special(command.out, "a folder")
    fit = None if command.fit is None else stage_folder(command.fit, "identify", FIT)
    load_effects(command.user_effects, fit)
    gap = as_gap(command)
    scene, base = gap_model(gap)
    recordings = rehearsed_recordings(command)
    plan = plan_of(command, base, fit)
    effects = chosen_effects(gap, scene, recordings, plan.channels or ())
    config, rehearsal = gap_config(gap), RehearsalConfig(seed=command.seed)
    found, result = quick_rehearsal(scene, base, effects, recordings, plan, config, rehearsal, _print_stage)
    setup = {**setup_of(command), "command": "rehearse", **fingerprints(scene, base, recordings)}
    setup["effect_scale"] = effect_scale(gap, scene, recordings)
    if plan.values:  # from a fit, whose folder may later hold another one
        setup["values"] = dict(plan.values)
    if command.full:
        result |= _full(command, scene, base, effects, recordings, plan, config, rehearsal, found, result, setup)
    result |= {"scene": scene.name, "setup": setup, "versions": runtime.versions(), "device": runtime.device()}
    from droid_jax.report.rehearsal_page import rehearsal_page

    text = json.dumps(plain(result), indent=1, allow_nan=False) + "\n"
    page = rehearsal_page(json.loads(text))
    write_own(command.out, {REHEARSAL: text.encode(), REHEARSAL_PAGE: page.encode()})
    _show(json.loads(text))
    print(f"page: {command.out / REHEARSAL_PAGE}")


def as_gap(command: Rehearse) -> GapCommand:
    """The options of the search that is rehearsed."""
    channels = command.compare
    if not command.recording and not channels:
        channels = ("torque",)
    return GapCommand(
        recording=command.recording,
        compare=channels,
        preset=command.preset,
        scene=command.scene,
        parameters=command.parameters,
        joints=command.joints,
        object_joint=command.object_joint,
        joint_friction=command.joint_friction,
        effects=command.effects,
        without=command.without,
        effect_scale=command.effect_scale,
        seed=command.seed,
    )


def rehearsed_recordings(command: Rehearse) -> list[Recording]:
    """The given recordings, or two motions of the built-in door."""
    if command.recording:
        return [recording_at(path) for path in command.recording]
    from droid_jax.door.demonstration import demonstration_path
    from droid_jax.recordings.formats import load_recording

    return [load_recording(demonstration_path(name)) for name in DOOR_MOTIONS]


def plan_of(command: Rehearse, base: Space, fit: Path | None) -> RehearsalPlan:
    """The plan that the options describe: noise, repeats, channels and values."""
    from droid_jax.cost.channels import SIMULATED
    from droid_jax.rehearsal.plan import RehearsalPlan

    noise = dict[str, float]()
    for entry in command.noise:
        name, _, text = entry.partition("=")
        try:
            deviation = float(text)
        except ValueError:
            deviation = math.nan
        if name not in SIMULATED or not (math.isfinite(deviation) and deviation > 0):
            raise ValueError(
                f"--noise takes channel=deviation above 0, for example torque=0.05, got {entry!r}; channels: "
                f"{', '.join(SIMULATED)}"
            )
        noise[name] = deviation
    values = None
    if fit is not None:
        values = dict(zip(base.names, values_of(fit, base).tolist(), strict=True))
    gap = as_gap(command)
    repeats = command.repeats or (None if command.recording else DOOR_REPEATS)
    return RehearsalPlan(repeats, noise or None, values, gap.compare or None)


def _full(
    command: Rehearse,
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
    plan: RehearsalPlan,
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
    found: Rehearsed,
    quick: Mapping[str, Any],
    setup: Mapping[str, Any],
) -> dict[str, Any]:
    """Results and scores of the complete rehearsals."""
    from droid_jax.identify.pipeline import IdentifyConfig
    from droid_jax.rehearsal.full import FullRehearsal, hidden_cases, run_cases, scores

    if not all(r.command.size for r in recordings):
        raise ValueError("--full needs recordings with commands: without them the motion cannot be simulated")
    identify = IdentifyConfig(
        search=search_config(command.preset, command.seed),
        refine=refine_config(command.preset),
        **{**quick_settings(command.preset), "samples": 0},
    )
    of = FullRehearsal(
        scene, base, tuple(effects), tuple(recordings), plan, config, identify, rehearsal, found,
        command.seed,
    )  # fmt: skip
    decides = {k: v for k, v in setup.items() if k != "full"}
    name = hashlib.sha256(json.dumps(plain(decides), sort_keys=True).encode()).hexdigest()[:12]
    if any(p.name != name for p in (command.out / "rehearsals").glob("*")):
        print(f"{command.out / 'rehearsals'} also holds rehearsals of other settings or another fit, which are ignored")
    cases = hidden_cases(scene, quick["effects"], command.full, rehearsal)
    results = run_cases(of, cases, command.out / "rehearsals" / name, lambda said: print(said, flush=True))
    return {"form": "full", "full": scores(results, rehearsal.share), "cases": results}


def plain(value: Any) -> Any:
    """The value as plain data for JSON, without infinities and arrays."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    return finite(value) if isinstance(value, float) else value


def _print_stage(stage: str) -> None:
    print(f"{stage} ...", flush=True)


def _show(result: Mapping[str, Any]) -> None:
    """Print the tables and the sentences."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from droid_jax.report.rehearsal_page import effect_rows, parameter_rows, rehearsal_sentences

    console = Console()
    for title, head, rows in (
        (
            "parameters",
            ("parameter", "posterior width, of the prior's", "recovered", "correlated with"),
            parameter_rows(result),
        ),
        ("effects", ("effect", "location", "found from", "limited by", "confused with"), effect_rows(result)),
    ):
        table = Table(title=title)
        for name in head:
            table.add_column(name, overflow="fold")
        for row in rows:
            table.add_row(*map(Text, row))
        console.print(table)
    for sentence in rehearsal_sentences(result):
        console.print(Text(sentence))
