"""`check`: what recordings hold and what looks wrong with them, before a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from droid_jax.preflight.findings import Finding
    from droid_jax.preflight.inspect_log import Signal
    from droid_jax.recordings.recording import Recording

COLOURS = {"certain": "bold red", "likely": "yellow", "note": "cyan"}


@dataclass(frozen=True)
class CheckCommand:
    """Look at recordings before fitting them: rates, gaps, ranges, and what can hardly be right. No fit, seconds.

    With --scene also units, signs, order of joints, weight, gains, delays and limits are judged. A finding is certain
    (no fit means anything), likely (something is wrong most often) or a note.
    """

    recording: tuple[Path, ...] = ()
    """Recordings, as `convert` writes them."""
    scene: Path | None = None
    """MJCF that they are meant for, with its nominal values."""
    joints: tuple[str, ...] = ()
    """Measured joints of the scene; default: all driven ones."""
    object_joint: str | None = None
    """Joint of the object that is moved."""
    out: Path = Path("runs/check")
    """Folder of check.html and check.json."""


def run(command: CheckCommand) -> None:
    """Print the tables, and write page and JSON."""
    from droid_jax.commands.options import recording_at
    from droid_jax.model.scene import load_scene
    from droid_jax.preflight.inspect_log import contents, inspect_log
    from droid_jax.report.check_page import check_page
    from droid_jax.storage import refuse_special, write_own

    if not command.recording:
        raise ValueError("check needs --recording, the recordings to look at (`convert` makes some of other logs)")
    if command.scene is None and (command.joints or command.object_joint):
        raise ValueError("--joints and --object-joint are of a scene: give --scene too")
    refuse_special(command.out, "a folder")
    recordings = [recording_at(path) for path in command.recording]
    checked = []
    for recording in recordings:
        scene = None
        if command.scene is not None:
            # A log without commands may have been measured on a robot that the scene drives with nothing.
            joints = command.joints or (() if recording.command.size else _measured(recording))
            scene = load_scene(command.scene, joints=joints or None, object_joint=command.object_joint, hold=True)
        checked.append((recording, contents(recording), inspect_log(recording, scene)))
    for recording, tracks, findings in checked:
        _show(recording, tracks, findings)
    page = check_page(checked, None if command.scene is None else command.scene.stem)
    write_own(command.out, {"check.json": _json(command, checked), "check.html": page.encode()})
    print(f"page: {command.out / 'check.html'}")


def _measured(recording: Recording) -> tuple[str, ...]:
    """Joints of a log without commands."""
    return tuple(dict.fromkeys(j for key, c in recording.channels.items() if key != "object_angle" for j in c.columns))


def _show(recording: Recording, tracks: Sequence[Signal], findings: Sequence[Finding]) -> None:
    """The tables of one recording on the terminal."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    head = f"{recording.name}: {recording.repeats} x {recording.duration:.4g} s"
    table = Table(title=Text(head))
    for name in ("signal", "column", "unit", "lowest", "highest", "measured", "rate, Hz", "longest step, s"):
        table.add_column(name, overflow="fold")  # a name that is too long goes on below, none is cut
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


def _json(command: CheckCommand, checked: Sequence[tuple[Recording, Sequence[Signal], Sequence[Finding]]]) -> bytes:
    """The content of check.json."""
    import json

    from droid_jax.storage import finite

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
    whole = {"format": "droid_jax check 1", "scene": None if command.scene is None else str(command.scene)}
    return (json.dumps({**whole, "recordings": recordings}, indent=1, allow_nan=False) + "\n").encode()
