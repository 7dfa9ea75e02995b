"""The stand-in robot of a setting, and what identification makes of it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.gaussian import load as load_gaussian
from droid_jax.identify.pipeline import identify
from droid_jax.measure.surrogate import stand_in_truth
from droid_jax.model.door import door_nuisances, door_space
from droid_jax.model.door_scene import door_scene
from droid_jax.policy.door_env import DoorEnv
from droid_jax.policy.transfer import StandIn, TransferConfig, stand_in
from droid_jax.storage import write_json
from experiments.identify_suite import recordings, settings
from experiments.policies.cases import TIMESTEP
from experiments.policies.settings import Setting
from experiments.policies.table import SLIPPERY

GAUSSIAN, SETTING = "gaussian.json", "setting.json"
PADS = {"sliding_friction_left": 0.05, "sliding_friction_right": 0.05}  # the least that a search allows


def truth_of(setting: Setting) -> dict[str, float]:
    """The stand-in's hidden values."""
    return {**stand_in_truth(door_scene(), setting.springs, setting.robot), **setting.truth}


def robots_of(setting: Setting, env: DoorEnv, trials: int) -> dict[str, StandIn]:
    """The setting's robot, and the same robot with slippery pads."""
    scene, truth, config = door_scene(limits=True), truth_of(setting), TransferConfig(trials=trials, seed=setting.robot)
    of = {"stand_in": truth, SLIPPERY: {**truth, **PADS}}
    return {name: stand_in(scene, env.start, hidden, (), env.task, config) for name, hidden in of.items()}


def fitted(setting: Setting, folder: Path, quick: bool) -> Gaussian:
    """What demonstrations A and C tell of the setting's robot; kept in the folder, with what it was made of."""
    path, made_of = folder / GAUSSIAN, {"setting": asdict(setting), "quick": quick}
    if path.is_file():
        known = json.loads((folder / SETTING).read_text()) if (folder / SETTING).is_file() else None
        if known != json.loads(json.dumps(made_of)):
            raise SystemExit(f"error: {folder} holds the fit of another robot: {known}; choose another --out")
    else:
        scene = door_scene(timestep=TIMESTEP)
        recorded = recordings(scene, truth_of(setting), "A" if quick else "AC", setting.robot)
        config = settings(quick, setting.robot)
        found = identify(scene, door_space(scene), recorded, nuisances=door_nuisances(scene), config=config)
        write_json(folder / SETTING, made_of)
        found.gaussian.save(path)
    return load_gaussian(path)
