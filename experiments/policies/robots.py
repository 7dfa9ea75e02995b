"""The synthetic robot of a setting, and what identification makes of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from benchmarks.sharing import claimed
from droid_jax.door.environment import DoorEnv
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_nuisances, door_space
from droid_jax.files import GAUSSIAN
from droid_jax.identify.gaussian import Gaussian, load_gaussian
from droid_jax.identify.pipeline import identify_parameters
from droid_jax.storage import write_json
from droid_jax.synthetic.policy_trials import PolicyRobot, TransferConfig, synthetic_robot
from droid_jax.synthetic.robot import synthetic_truth
from experiments.identify_suite import describe, recordings, settings
from experiments.policies.cases import TIMESTEP, Options
from experiments.policies.settings import Setting
from experiments.policies.table import SLIPPERY

FIT = "fit.json"
SLIDING = 0.05  # friction of slippery pads
CONTACT = 0.005  # m over which a pad touches.  Table I's torsional friction would turn the door by twisting


def truth_of(setting: Setting) -> dict[str, float]:
    """The synthetic robot's hidden values."""
    return {**synthetic_truth(door_scene(), setting.springs, setting.robot), **setting.truth}


def pads_of(sliding: float) -> dict[str, float]:
    """Pads with a sliding friction, and the torsional friction in m that goes with it."""
    kinds = {"sliding": sliding, "torsional": CONTACT * sliding}
    return {f"{kind}_friction_{side}": mu for kind, mu in kinds.items() for side in ("left", "right")}


def robots_of(setting: Setting, env: DoorEnv, trials: int) -> dict[str, PolicyRobot]:
    """The setting's robot, and the same robot with slippery pads."""
    scene, truth, config = door_scene(limits=True), truth_of(setting), TransferConfig(trials=trials, seed=setting.robot)
    of = {"synthetic_robot": truth, SLIPPERY: {**truth, **pads_of(SLIDING)}}
    return {name: synthetic_robot(scene, env.start, hidden, (), env.task, config) for name, hidden in of.items()}


def fitted(setting: Setting, arguments: Options, code: Mapping[str, Any]) -> Gaussian:
    """What demonstrations A and C tell of the setting's robot; kept, with what it was made of and how good it is.

    Experiments share it, and another process that makes it is waited for.
    """
    folder, quick = arguments.cases(f"fit_{setting.name}"), arguments.quick
    path, made_of = folder / GAUSSIAN, {"setting": asdict(setting), "quick": quick}
    with claimed(path, wait=True):
        if path.is_file():
            known = json.loads((folder / FIT).read_text()) if (folder / FIT).is_file() else {}
            if {name: known.get(name) for name in made_of} != json.loads(json.dumps(made_of)):
                raise SystemExit(f"error: {folder} holds the fit of another robot: {known}; choose another --out")
        else:
            scene, truth = door_scene(timestep=TIMESTEP), truth_of(setting)
            recorded = recordings(scene, truth, "A" if quick else "AC", setting.robot)
            config = settings(quick, setting.robot)
            found = identify_parameters(
                scene, door_space(scene), recorded, nuisances=door_nuisances(scene), config=config
            )
            write_json(folder / FIT, {**made_of, "fit": describe(found, truth), "origin": dict(code)})
            found.full_gaussian.save(path)  # what the prior draws, nuisances too
    return load_gaussian(path)
