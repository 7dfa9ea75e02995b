"""The stand-in robot of a setting, and what identification makes of it."""

from __future__ import annotations

from pathlib import Path

from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.gaussian import load as load_gaussian
from droid_jax.identify.pipeline import IdentifyConfig, identify
from droid_jax.identify.refine import RefineConfig
from droid_jax.identify.search import SearchConfig
from droid_jax.measure.demonstration import demonstration_path
from droid_jax.measure.formats import load
from droid_jax.measure.surrogate import record, stand_in_truth
from droid_jax.model.door import door_nuisances, door_space
from droid_jax.model.door_scene import door_scene
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
        truth = truth_of(setting)
        recordings = [
            record(scene, load(demonstration_path(name)), truth, seed=setting.robot + k, name=name)
            for k, name in enumerate("A" if quick else "AC")
        ]
        config = IdentifyConfig(
            search=SearchConfig(population=30, parents=None, generations=3 if quick else 20, seed=setting.robot),
            refine=RefineConfig(iterations=2 if quick else 30),
            seed=setting.robot,
        )
        found = identify(scene, door_space(scene), recordings, nuisances=door_nuisances(scene), config=config)
        found.gaussian.save(path)
    return load_gaussian(path)
