"""The synthetic robot: its options, and its recordings with a hidden effect for `gap` without --recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from droid_jax.commands.folder import kept_recordings
from droid_jax.files import SYNTHETIC_ROBOT
from droid_jax.read_json import read_json, typed
from droid_jax.report.stages import Robot

if TYPE_CHECKING:
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording

DEMONSTRATIONS = {"train": "C", "validation": "B", "test": "A"}
HIDE = ("magnetic_catch=1.5",)  # N m
# Defaults of the options of a synthetic robot.
OPTIONS = {"hide": None, "springs": 1, "demonstrations": ("A", "C")}

T = TypeVar("T")


def with_robot_options(command: T) -> T:
    """The command with defaults for the options of its synthetic robot, if it records one.

    Raises ValueError if such options and --recording are both given.
    """
    usual = {name: value for name, value in OPTIONS.items() if hasattr(command, name)}
    if "demonstrations" in usual and command.preset == "paper":  # type: ignore[attr-defined]
        usual["demonstrations"] = ("A",)  # the paper fits one demonstration
    given = [name for name in usual if getattr(command, name) is not None]
    if not command.recording:  # type: ignore[attr-defined]
        return replace(command, **{k: v for k, v in usual.items() if k not in given})  # type: ignore[type-var]
    if given:
        raise ValueError(f"--{given[0]} is for the synthetic robot, which is not recorded with --recording")
    return command


def hidden_effects(entries: Sequence[str] | None, scene: Scene) -> dict[str, float]:
    """The hidden effects of --hide: name or name[joint] -> coefficient.

    entries: "name=coefficient" each, or only "none"; None: the default effect.
    Raises ValueError for invalid entries, listing the valid names, and for effects that the scene cannot have.
    """
    from droid_jax.synthetic.hidden_effects import as_applied, check, hidden_effect, possible

    entries = HIDE if entries is None else tuple(entries)
    if entries in ((), ("none",)):
        return {}
    found = {}
    for entry in entries:
        name, _, amplitude = entry.partition("=")
        try:
            found[name] = float(amplitude)
        except ValueError:
            raise ValueError(
                f"--hide takes name=amplitude, for example {HIDE[0]}, or none; got {entry!r}. "
                f"There are: {', '.join(possible(scene))}"
            ) from None
        hidden_effect(name.partition("[")[0])
    for one in as_applied(found):
        check(one, scene)
    return found


def record_synthetic(
    scene: Scene, hidden: Mapping[str, float], out: Path, springs: int, seed: int, again: bool
) -> dict[str, Recording]:
    """Role -> recording of the synthetic robot, stored in the run's folder.

    They are recorded again with `again`, or if the folder is not known to have recordings of this robot.
    """
    from droid_jax.door.demonstration import demonstration_path
    from droid_jax.recordings.formats import load_recording
    from droid_jax.storage import write_json
    from droid_jax.synthetic.hidden_effects import record_hidden
    from droid_jax.synthetic.robot import synthetic_truth

    truth = synthetic_truth(scene, springs, seed)

    names = list(DEMONSTRATIONS.values())

    def recorded(name: str) -> Recording:
        demonstration = load_recording(demonstration_path(name))
        return record_hidden(scene, demonstration, truth, hidden, seed=1000 * seed + names.index(name), name=name)

    files = kept_at(out)
    paths = dict(zip(names, files, strict=True))
    this = robot_json(hidden, springs, seed)
    if again or known_robot(files) != this:
        for path in paths.values():
            path.unlink(missing_ok=True)
    # Written before the first recording, so that a stop leaves no recordings of an unknown robot.
    write_json(out / "recordings" / SYNTHETIC_ROBOT, this)
    found = kept_recordings(paths, False, recorded)
    return {role: found[name] for role, name in DEMONSTRATIONS.items()}


def kept_at(out: Path) -> tuple[Path, ...]:
    """Files of the synthetic robot's motions in a run's folder: train, validation, test."""
    return tuple(out / "recordings" / f"{name}.npz" for name in DEMONSTRATIONS.values())


def robot_json(hidden: Mapping[str, float], springs: int, seed: int) -> dict[str, Any]:
    """Content of synthetic_robot.json: springs, seed and hidden effects."""
    return {"springs": springs, "seed": seed, "hide": [f"{name}={amplitude:g}" for name, amplitude in hidden.items()]}


def known_robot(recordings: Sequence[str | Path]) -> dict[str, Any]:
    """Springs, seed and hidden effects of the synthetic robot that made these files; empty if unknown."""
    folders = {Path(path).resolve().parent for path in recordings}
    try:
        at = folders.pop() / SYNTHETIC_ROBOT
        return dict(typed(read_json(at), Robot, str(at))) if not folders else {}
    except (OSError, ValueError):
        return _of_meta(recordings)


def _of_meta(recordings: Sequence[str | Path]) -> dict[str, Any]:
    """The same from the `meta` that `record` writes, if all files agree."""
    from droid_jax.recordings.formats import load_recording

    try:
        metas = [load_recording(path).meta for path in recordings]
        said = {(int(meta["springs"]), int(meta["robot"])) for meta in metas}
    except (OSError, ValueError, KeyError):
        return {}
    return robot_json({}, *said.pop()) if len(said) == 1 else {}
