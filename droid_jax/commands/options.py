"""Options that several commands share: presets, your own scene and recordings, your own effects."""

from __future__ import annotations

import functools
import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

import tyro

from droid_jax.report.stages import setup

if TYPE_CHECKING:
    from droid_jax.cost.residuals import CompareConfig
    from droid_jax.identify.multistart import RefineConfig
    from droid_jax.identify.search import CmaConfig
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording

Channel = Literal["torque", "position", "velocity", "object_angle"]
Preset = Literal["quick", "standard", "paper", "gpu"]
JointFriction = Literal["held", "scene"]
# Kept as the field `judge_on`, by which setup.json of earlier runs knows it; --judge-on is its earlier name.
TestRecordings = Annotated[tuple[Path, ...], tyro.conf.arg(name="test-recording", aliases=("--judge-on",))]
TIMESTEP: dict[Preset, float] = {"quick": 0.004, "standard": 0.002, "paper": 0.002, "gpu": 0.002}  # s, built-in door


@functools.cache
def warn_of_cpu(preset: str) -> None:
    """Warn once if the preset for a GPU runs on a CPU; jax must be tuned already."""
    import jax

    if preset == "gpu" and jax.default_backend() == "cpu":
        print(
            "warning: --preset gpu, but jax finds no GPU: on a CPU it takes hours (docs/ten-minutes.md: jax with CUDA)",
            file=sys.stderr,
        )


def search_config(preset: Preset, seed: int, **changes: int | None) -> CmaConfig:
    """The preset's search; changes: fields of CmaConfig given by options, None if not given."""
    from droid_jax.identify.search import CmaConfig

    chosen: dict[str, int | None] = {
        "quick": dict(population=30, parents=None, generations=20),
        "standard": dict(population=30, parents=None, generations=100),
        "paper": dict(population=30, parents=5, generations=100),
        "gpu": dict(population=1024, parents=None, generations=60, restarts=2),
    }[preset]
    asked = {name: value for name, value in changes.items() if value is not None}
    return CmaConfig(**{**chosen, **asked}, seed=seed)  # type: ignore[arg-type]


def refine_config(preset: Preset) -> RefineConfig | None:
    """The preset's refinement; None: the paper has none."""
    from droid_jax.identify.multistart import RefineConfig

    if preset == "paper":
        return None
    return RefineConfig(basin_hop_generations=12) if preset == "quick" else RefineConfig()


def quick_settings(preset: Preset) -> dict[str, Any]:
    """Further fields of IdentifyConfig of preset "quick"."""
    return {"samples": 64, "generations_in_c": 5} if preset == "quick" else {}


class OwnScene(Protocol):
    """The options that describe your own scene, and its recordings."""

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
    @property
    def joint_friction(self) -> JointFriction: ...


def needs_scene(options: OwnScene) -> None:
    """ValueError for options of your own scene without --scene."""
    given = {name: getattr(options, name) for name in ("parameters", "joints", "object_joint")}
    for name, value in {**given, "joint_friction": options.joint_friction != "held"}.items():
        if options.scene is None and value:
            raise ValueError(f"--{name.replace('_', '-')} is for your own scene: give --scene too")


def needs_recording(options: OwnScene) -> None:
    """ValueError for your own scene without recordings."""
    if options.scene is not None and not options.recording:
        raise ValueError("--scene needs --recording: the synthetic robot only knows the built-in door")


def needs_log(motion_cutoff: float | None, recordings: Sequence[Recording]) -> None:
    """ValueError for an invalid --motion-cutoff, or one without a log to filter."""
    if motion_cutoff is None:
        return
    if not motion_cutoff > 0:
        raise ValueError(f"--motion-cutoff must be above 0 Hz, got {motion_cutoff:g}")
    if all(recording.command_names for recording in recordings):
        raise ValueError("--motion-cutoff is for logs without commands, and no recording is one")


def compared(motion_cutoff: float | None, **changes: Any) -> CompareConfig:
    """Configuration of the comparison with the given options."""
    from droid_jax.cost.residuals import CompareConfig

    usual = CompareConfig(**changes)
    return usual if motion_cutoff is None else replace(usual, motion_cutoff=motion_cutoff)


def own_scene(options: OwnScene, *, engine: str = "mjx", mj_step: bool = False) -> tuple[Scene, Space]:
    """Your own scene and the parameters of its list, including nuisances; ValueError for invalid files or names.

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
        hold=options.joint_friction == "held",
        engine=engine,
        mj_step=mj_step,
    )
    return scene, load_parameters(options.parameters, scene)


def recording_at(path: Path) -> Recording:
    """The recording in a file; ValueError for ROS bags, which lack information that a fit needs."""
    from droid_jax.recordings.formats import bags_at, load_recording

    if bags_at(path):
        raise ValueError(
            f"{path}: a ROS bag does not say which joints to read or what its efforts are; "
            "`python -m droid_jax.run convert BAGS --joints ... --torque ...` makes a recording of it"
        )
    return load_recording(path)


def load_effects(path: Path | None, *folders: Path | None) -> None:
    """Execute a file that registers your own effects in the library (docs/your-effect.md).

    folders: of runs that are read.  A run with such effects needs the file.  Its path in setup.json is not used, so
    that results from elsewhere execute no code. Raises ValueError if the file is missing, fails, or is needed by a
    folder and not given.
    """
    if path is None:
        for folder in (f for f in folders if f is not None):
            if file := setup(folder).get("user_effects"):
                raise ValueError(f"{folder} was made with your own effects: give --user-effects {file}")
        return
    if not path.is_file():
        raise ValueError(f"--user-effects: there is no file {path}")
    # One module name per file: the next stage of `all` registers the same effects again.
    name = f"user_effects_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"--user-effects takes a Python file (.py), got {path}")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ValueError(f"--user-effects {path}: {type(error).__name__}: {error}") from error
