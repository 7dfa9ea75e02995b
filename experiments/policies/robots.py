"""The stand-in robot of a setting, and what identification makes of it."""

from __future__ import annotations

from pathlib import Path

from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.gaussian import load as load_gaussian
from droid_jax.identify.pipeline import identify
from droid_jax.measure.surrogate import stand_in_truth
from droid_jax.model.door import door_nuisances, door_space
from droid_jax.model.door_scene import door_scene
from experiments.identify_suite import recordings, settings
from experiments.policies.cases import TIMESTEP
from experiments.policies.settings import Setting

GAUSSIAN = "gaussian.json"


def truth_of(setting: Setting) -> dict[str, float]:
    """The stand-in's hidden values."""
    return {**stand_in_truth(door_scene(), setting.springs, setting.robot), **setting.truth}


def fitted(setting: Setting, folder: Path, quick: bool) -> Gaussian:
    """What demonstrations A and C tell of the setting's robot; kept in the folder."""
    path = folder / GAUSSIAN
    if not path.is_file():
        scene = door_scene(timestep=TIMESTEP)
        recorded = recordings(scene, truth_of(setting), "A" if quick else "AC", setting.robot)
        config = settings(quick, setting.robot)
        found = identify(scene, door_space(scene), recorded, nuisances=door_nuisances(scene), config=config)
        found.gaussian.save(path)
    return load_gaussian(path)
