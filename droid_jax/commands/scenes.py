"""A scene of one's own, as `identify` and `gap` take it from the command line."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene


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


def needs_recording(options: OwnScene) -> None:
    """ValueError for a scene of one's own in which nothing was measured."""
    if options.scene is not None and not options.recording:
        raise ValueError("--scene needs --recording: the stand-in robot only knows the built-in door")


def own_scene(options: OwnScene) -> tuple[Scene, Space]:
    """The scene and its listed parameters, nuisances among them; ValueError for what the files or names lack."""
    from droid_jax.model.own import friction_joints, load_parameters
    from droid_jax.model.scene import load_scene

    if options.scene is None or options.parameters is None:
        raise ValueError("--scene needs --parameters FILE.json, the list of what to fit (docs/own-robot.md)")
    scene = load_scene(
        options.scene,
        joints=options.joints or None,
        object_joint=options.object_joint,
        friction_joints=friction_joints(options.parameters),
    )
    return scene, load_parameters(options.parameters, scene)
