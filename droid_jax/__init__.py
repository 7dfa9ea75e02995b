"""Physics parameters from one demonstration: MuJoCo MJX replays, joint torques, CMA-ES.

    import droid_jax

    droid_jax.tune()
    scene = droid_jax.load_scene("my_robot.xml")

Each public name is loaded when it is first used (PEP 562).  Importing the package therefore starts neither jax nor
mujoco, so that `tune` can be called first, and using the cost loads neither evosax nor brax.  docs/your-robot.md shows
examples.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from droid_jax.cost.cost import make_cost as make_cost
    from droid_jax.discrepancy.config import DiscrepancyConfig as DiscrepancyConfig
    from droid_jax.discrepancy.missing import find_missing_effects as find_missing_effects
    from droid_jax.door.scene import door_scene as door_scene
    from droid_jax.door.space import door_nuisances as door_nuisances
    from droid_jax.door.space import door_space as door_space
    from droid_jax.identify.extended_model import load_extended as load_extended
    from droid_jax.identify.gaussian import Gaussian as Gaussian
    from droid_jax.identify.gaussian import load_gaussian as load_gaussian
    from droid_jax.identify.pipeline import IdentifyConfig as IdentifyConfig
    from droid_jax.identify.pipeline import identify_parameters as identify_parameters
    from droid_jax.model.mjcf import fitted_mjcf as fitted_mjcf
    from droid_jax.model.parameter_file import load_parameters as load_parameters
    from droid_jax.model.parameters import Parameter as Parameter
    from droid_jax.model.parameters import Scaling as Scaling
    from droid_jax.model.parameters import Space as Space
    from droid_jax.model.scene import Scene as Scene
    from droid_jax.model.scene import load_scene as load_scene
    from droid_jax.policy.randomise import randomised as randomised
    from droid_jax.policy.randomise import randomised_model as randomised_model
    from droid_jax.recordings.formats import load_recording as load_recording
    from droid_jax.recordings.formats import save_recording as save_recording
    from droid_jax.recordings.recording import Recording as Recording
    from droid_jax.report.tables import frames as frames
    from droid_jax.runtime import tune as tune

__all__ = [
    "tune",
    "Parameter",
    "Space",
    "Scaling",
    "Scene",
    "door_scene",
    "load_scene",
    "load_parameters",
    "door_space",
    "door_nuisances",
    "Recording",
    "load_recording",
    "save_recording",
    "make_cost",
    "identify_parameters",
    "IdentifyConfig",
    "Gaussian",
    "load_gaussian",
    "fitted_mjcf",
    "find_missing_effects",
    "DiscrepancyConfig",
    "load_extended",
    "randomised",
    "randomised_model",
    "frames",
]

# Public name -> (module, name in it).
_HOMES = {
    "tune": ("runtime", "tune"),
    "Parameter": ("model.parameters", "Parameter"),
    "Space": ("model.parameters", "Space"),
    "Scaling": ("model.parameters", "Scaling"),
    "Scene": ("model.scene", "Scene"),
    "door_scene": ("door.scene", "door_scene"),
    "load_scene": ("model.scene", "load_scene"),
    "load_parameters": ("model.parameter_file", "load_parameters"),
    "door_space": ("door.space", "door_space"),
    "door_nuisances": ("door.space", "door_nuisances"),
    "Recording": ("recordings.recording", "Recording"),
    "load_recording": ("recordings.formats", "load_recording"),
    "save_recording": ("recordings.formats", "save_recording"),
    "make_cost": ("cost.cost", "make_cost"),
    "identify_parameters": ("identify.pipeline", "identify_parameters"),
    "IdentifyConfig": ("identify.pipeline", "IdentifyConfig"),
    "Gaussian": ("identify.gaussian", "Gaussian"),
    "load_gaussian": ("identify.gaussian", "load_gaussian"),
    "fitted_mjcf": ("model.mjcf", "fitted_mjcf"),
    "find_missing_effects": ("discrepancy.missing", "find_missing_effects"),
    "DiscrepancyConfig": ("discrepancy.config", "DiscrepancyConfig"),
    "load_extended": ("identify.extended_model", "load_extended"),
    "randomised": ("policy.randomise", "randomised"),
    "randomised_model": ("policy.randomise", "randomised_model"),
    "frames": ("report.tables", "frames"),
}


def __getattr__(name: str) -> Any:
    """A public name, loaded and stored on first use; AttributeError with all public names for an unknown one."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public: {', '.join(__all__)}")
    found = _load(*_HOMES[name])
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _load(module: str, name: str) -> Any:
    """A name from a module of this package."""
    from droid_jax.quiet import quiet

    with quiet():
        return getattr(importlib.import_module(f"{__name__}.{module}"), name)
