"""A scene of your own and recordings in it, as `identify` and `gap` take them from the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from droid_jax.cost.residuals import CompareConfig
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording


class OwnScene(Protocol):
    """The options that describe it, and what was measured in it."""

    @property
    def recording(self) -> tuple[Path, ...]: ...
    @property
    def scene(self) -> Path | None: ...
    @property
    def parameters(self) -> Path | None: ...
    @property
    def joints(self) -> tuple[str, ...]: ...
    @property
    def object_joint(self) -> str | None: ...


def needs_scene(options: OwnScene) -> None:
    """ValueError for options that describe a scene of your own where none is given."""
    for name in ("parameters", "joints", "object_joint"):
        if options.scene is None and getattr(options, name):
            raise ValueError(f"--{name.replace('_', '-')} is for a scene of your own: give --scene too")


def needs_recording(options: OwnScene) -> None:
    """ValueError for a scene of your own in which nothing was measured."""
    if options.scene is not None and not options.recording:
        raise ValueError("--scene needs --recording: the synthetic robot only knows the built-in door")


def needs_log(motion_cutoff: float | None, recordings: Sequence[Recording]) -> None:
    """ValueError for a --motion-cutoff that is none, or that filters nothing: a synthetic robot has commands."""
    if motion_cutoff is None:
        return
    if not motion_cutoff > 0:
        raise ValueError(f"--motion-cutoff must be above 0 Hz, got {motion_cutoff:g}")
    if all(recording.command_names for recording in recordings):
        raise ValueError("--motion-cutoff is for logs without commands, and no recording is one")


def compared(motion_cutoff: float | None, **changes: Any) -> CompareConfig:
    """How recordings are compared, with what the command line says of it."""
    from droid_jax.cost.residuals import CompareConfig

    usual = CompareConfig(**changes)
    return usual if motion_cutoff is None else replace(usual, motion_cutoff=motion_cutoff)


def own_scene(options: OwnScene, *, engine: str = "mjx", mj_step: bool = False) -> tuple[Scene, Space]:
    """The scene and its listed parameters, nuisances among them; ValueError for what the files or names lack.

    engine, mj_step: of the replays.
    """
    from droid_jax.model.parameter_file import friction_joints, load_parameters
    from droid_jax.model.scene import load_scene

    if options.scene is None or options.parameters is None:
        raise ValueError("--scene needs --parameters FILE.json, the list of what to fit (docs/your-robot.md)")
    scene = load_scene(
        options.scene,
        joints=options.joints or None,
        object_joint=options.object_joint,
        friction_joints=friction_joints(options.parameters),
        engine=engine,
        mj_step=mj_step,
    )
    return scene, load_parameters(options.parameters, scene)


def recording_at(path: Path) -> Recording:
    """A recording; ValueError for ROS bags, which do not say what a fit must know of them."""
    from droid_jax.recordings.formats import bags_at, load_recording

    if bags_at(path):
        raise ValueError(
            f"{path}: a ROS bag does not say which joints to read or what its efforts are; "
            "`python -m droid_jax.run convert BAGS --joints ... --torque ...` makes a recording of it"
        )
    return load_recording(path)
