"""`check`: content of recordings and probable errors in them, before a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from droid_jax.identify.additions import MotionProposal
    from droid_jax.identify.excitation import Excitation
    from droid_jax.model.scene import Scene
    from droid_jax.preflight.findings import Finding
    from droid_jax.preflight.inspect_log import Signal
    from droid_jax.recordings.recording import Recording

ADDITION = "addition.csv"  # in the folder: commands of the additional motion
COLOURS = {"certain": "bold red", "likely": "yellow", "note": "cyan"}


@dataclass(frozen=True)
class CheckCommand:
    """Check recordings before a fit: rates, gaps, ranges, and probable errors. Takes seconds and fits nothing.

    With --scene it also checks units, signs, order of joints, weight, gains, delays and limits. A finding is certain (a
    fit would be meaningless), likely, or a note. With --parameters it also says which of them are identifiable from
    these recordings together, and proposes a motion for the others.
    """

    recording: tuple[Path, ...] = ()
    """Recordings, as `convert` writes them."""
    scene: Path | None = None
    """MJCF of the robot, with its nominal values."""
    parameters: Path | None = None
    """JSON list of the parameters that are to be fitted (docs/your-robot.md)."""
    joints: tuple[str, ...] = ()
    """Measured joints of the scene; default: all driven ones."""
    object_joint: str | None = None
    """Joint of the object that is moved."""
    motion_cutoff: float | None = None
    """Logs without commands: cutoff of the filter of the measured positions, Hz; default: 20."""
    out: Path = Path("runs/check")
    """Folder of check.html and check.json, and of addition.csv if a motion is proposed."""


def run(command: CheckCommand) -> None:
    """Print the tables, and write page and JSON."""
    from droid_jax import runtime
    from droid_jax.commands.options import compared, needs_log, recording_at

    if command.parameters is not None and command.scene is not None:
        runtime.start()  # before what is imported below starts jax
    from droid_jax.preflight.inspect_log import contents, inspect_log
    from droid_jax.report.check_page import check_page
    from droid_jax.storage import refuse_special, write_own

    if not command.recording:
        raise ValueError("check needs --recording, the recordings to check (`convert` makes recordings of other logs)")
    if command.scene is None and (command.joints or command.object_joint or command.parameters):
        raise ValueError("--joints, --object-joint and --parameters refer to a scene: give --scene too")
    refuse_special(command.out, "a folder")
    recordings = [recording_at(path) for path in command.recording]
    needs_log(command.motion_cutoff, recordings)
    cutoff = compared(command.motion_cutoff).motion_cutoff
    checked = []
    for recording in recordings:
        scene, notes = (None, ()) if command.scene is None else _scene(command.scene, command, recording)
        checked.append((recording, contents(recording), (*inspect_log(recording, scene, cutoff), *notes)))
    for recording, tracks, findings in checked:
        _show(recording, tracks, findings)
    excited, why = None, ""
    if any(finding.severity == "certain" for _, _, findings in checked for finding in findings):
        why = "a finding is certain"
    elif command.parameters is not None:
        try:
            excited = _excitation(command, recordings)
        except ValueError as error:  # of the replay; the findings above are printed anyway
            why = str(error)
    if command.parameters is not None and why:
        print(f"identifiability was not checked: {why}")
    if excited is not None:
        _show_excitation(*excited)
    page = check_page(checked, None if command.scene is None else command.scene.stem, excited)
    files = {"check.json": _json(command, checked, excited), "check.html": page.encode()}
    if excited is not None and excited[1].chosen:
        files[ADDITION] = _csv(excited[1])
        print(f"commands of the motion: {command.out / ADDITION}; make sure that its way is free")
    write_own(command.out, files)
    print(f"page: {command.out / 'check.html'}")


def _scene(
    path: Path, command: CheckCommand, recording: Recording, friction_joints: Sequence[str] = ()
) -> tuple[Scene, tuple[Finding, ...]]:
    """The scene of a recording, with a note if only plain C can replay it."""
    from droid_jax.model.scene import load_scene
    from droid_jax.preflight.findings import Finding

    # The scene of a log without commands may have no actuators.
    joints = command.joints or (() if recording.command.size else _measured(recording))
    load = partial(
        load_scene, path, joints=joints or None, object_joint=command.object_joint, friction_joints=friction_joints,
        hold=True,
    )  # fmt: skip
    try:
        return load(), ()
    except ValueError as error:
        scene = load(engine="mujoco")
        note = f"only `identify --engine mujoco` takes this scene: {error}"
        return scene, (Finding("scene", "", 0.0, 0.0, "note", note),)


def _excitation(command: CheckCommand, recordings: Sequence[Recording]) -> tuple[Excitation, MotionProposal] | None:
    """Identifiability of the parameters, and the motion proposed for the others; None without --parameters."""
    if command.parameters is None or command.scene is None:
        return None
    from droid_jax.commands.options import compared
    from droid_jax.identify.additions import propose
    from droid_jax.identify.excitation import ExcitationConfig, excitation
    from droid_jax.model.parameter_file import friction_joints, load_parameters

    scene, _ = _scene(command.scene, command, recordings[0], friction_joints(command.parameters))
    space = load_parameters(command.parameters, scene)
    config = ExcitationConfig(compare=compared(command.motion_cutoff))
    found = excitation(scene, space, recordings, config)
    return found, propose(scene, space, found, recordings[0])


def _show_excitation(found: Excitation, proposal: MotionProposal) -> None:
    """Print the table of parameters and the proposed motion."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    table = Table(title=Text("Identifiability of the parameters from these recordings, before a fit"))
    for name in ("parameter", "unit", "posterior width, of the prior's", "identifiable", "correlated with"):
        table.add_column(name, overflow="fold")
    for parameter, verdict in zip(found.space.parameters, found.identifiability, strict=True):
        partners = ", ".join(f"{name} ({value:+.2f})" for name, value in verdict.partners)
        cells = (
            parameter.name,
            parameter.unit,
            f"{100 * verdict.shrinkage:.0f} %",
            "yes" if verdict.identifiable else "no",
        )
        table.add_row(*map(Text, (*cells, partners)))
    console.print(table)
    console.print(Text(proposal.sentence))


def _csv(proposal: MotionProposal) -> bytes:
    """A proposal's commands as CSV: time in s, and a column for each joint in rad or m."""
    time, rows = proposal.commands()
    lines = [",".join(("time", *proposal.joints))]
    lines += [",".join(f"{value:.6g}" for value in (t, *row)) for t, row in zip(time, rows, strict=True)]
    return ("\n".join(lines) + "\n").encode()


def _measured(recording: Recording) -> tuple[str, ...]:
    """Measured joints of a log without commands."""
    return tuple(dict.fromkeys(j for key, c in recording.channels.items() if key != "object_angle" for j in c.columns))


def _show(recording: Recording, tracks: Sequence[Signal], findings: Sequence[Finding]) -> None:
    """Print the table and the findings of one recording."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    head = f"{recording.name}: {recording.repeats} x {recording.duration:.4g} s"
    table = Table(title=Text(head))
    for name in ("signal", "column", "unit", "lowest", "highest", "measured", "rate, Hz", "longest step, s"):
        # Long names wrap instead of being cut.
        table.add_column(name, overflow="fold", min_width=8 if name == "signal" else None)
    for track in tracks:
        for i, column in enumerate(track.columns):
            clock = (f"{track.rate:.5g}", f"{track.longest:.3g}") if i == 0 else ("", "")
            numbers = (f"{column.low:.4g}", f"{column.high:.4g}", f"{100 * column.measured:.0f} %")
            cells = (track.name if i == 0 else "", column.name, column.unit, *numbers, *clock)
            table.add_row(*map(Text, cells))
    console.print(table)
    if not findings:
        console.print("nothing looks wrong", style="green")
    for finding in findings:
        console.print(Text.assemble((f"{finding.severity}: ", COLOURS[finding.severity]), finding.sentence))


def _json(
    command: CheckCommand,
    checked: Sequence[tuple[Recording, Sequence[Signal], Sequence[Finding]]],
    excited: tuple[Excitation, MotionProposal] | None,
) -> bytes:
    """The content of check.json."""
    import json

    from droid_jax.storage import config_json, finite

    def column(entry: dict[str, object]) -> dict[str, object]:
        return {k: finite(v) if isinstance(v, float) else v for k, v in entry.items()}

    recordings = [
        {
            "file": str(path),
            "name": recording.name,
            "sha256": recording.sha256,
            "repeats": recording.repeats,
            "signals": [{**asdict(t), "columns": [column(asdict(c)) for c in t.columns]} for t in tracks],
            "findings": [column(asdict(f)) for f in findings],
        }
        for path, (recording, tracks, findings) in zip(command.recording, checked, strict=True)
    ]
    whole: dict[str, object] = {
        "format": "droid_jax check 1",
        "scene": None if command.scene is None else str(command.scene),
    }
    if excited is not None:
        found, proposal = excited
        whole["excitation"] = {
            "parameters": [column(asdict(t)) for t in found.identifiability],
            "engine": found.engine,
            "config": config_json(found.config),
            "seconds": found.seconds,
            "sentence": proposal.sentence,
            "addition": [a.what for a in proposal.chosen],
            "identifiable_by_it": list(proposal.opened),
            "left_open": list(proposal.left),
        }
    return (json.dumps({**whole, "recordings": recordings}, indent=1, allow_nan=False) + "\n").encode()
