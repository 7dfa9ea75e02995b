"""A small search for a missing effect, for tests of the search, its command and its files.

The scene is experiments/bench.xml, an arm of two links and a driven door.  Motions are short.  A preload of the hinge
is hidden in the synthetic robot.
"""

from __future__ import annotations

import functools
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from droid_jax.discrepancy.candidate_fits import Problem
from droid_jax.discrepancy.candidates import directions_of
from droid_jax.discrepancy.case import Case, make_case
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import FinalModel, FittedModel, base_fit
from droid_jax.discrepancy.search import search_effects
from droid_jax.discrepancy.statistics import sign_flips, t_values
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effects.candidate import candidates
from droid_jax.model.effects.registry import library
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, load_scene
from droid_jax.recordings.recording import Phase, Recording, TorqueConvention, TorqueSide
from droid_jax.synthetic.hidden_effects import record_hidden
from droid_jax.synthetic.robot import SyntheticRobotConfig

SCENE = Path(__file__).resolve().parents[1] / "experiments" / "bench.xml"
JOINTS = ("shoulder", "elbow", "door")
SECONDS = 3.0
PARAMETERS = [
    {"field": "body_mass", "element": "forearm", "std": 0.2, "high": 3.0},
    {"field": "dof_damping", "element": "door", "unit": "N m s/rad", "std": 0.3, "high": 10.0, "scaling": "log",
     "log_offset": 0.05},
    {"field": "jnt_stiffness", "element": "door", "unit": "N m/rad", "std": 0.3, "high": 10.0},
    {"sensor": "torque_offset", "element": "elbow", "std": 0.1, "high": 2.0, "nuisance": True},
]  # fmt: skip
TRUTH = {"forearm_mass": 0.9, "door_damping": 0.6, "door_stiffness": 0.7, "torque_offset[elbow]": 0.03}
PRELOAD = 0.6  # N m
FLOOR = 0.01
EFFECTS = ("hinge_preload", "drag", "payload")
QUICK = DiscrepancyConfig(
    search=CmaConfig(population=12, parents=None, generations=4),
    refine=RefineConfig(iterations=20, basin_hops=0),
    refit=RefineConfig(iterations=6, basin_hops=0),
    max_effects=1,
)


def write_parameters(folder: Path) -> Path:
    """The parameter file of the small scene."""
    path = folder / "parameters.json"
    path.write_text(json.dumps(PARAMETERS))
    return path


def small_scene() -> tuple[Scene, Space]:
    """The scene and the parameters, as the command line makes them."""
    scene = load_scene(SCENE, object_joint="door")
    with tempfile.TemporaryDirectory() as folder:
        return scene, load_parameters(write_parameters(Path(folder)), scene)


def demonstration(name: str) -> Recording:
    """A motion that opens and closes the door; the three roles differ in speed and angle."""
    t = np.arange(0.0, SECONDS, 0.002)
    period, reach, pace = {"train": (1.5, 0.4, 2.0), "validation": (3.0, 0.35, 1.5), "test": (2.5, 0.3, 1.0)}[name]
    arm = [0.5 * np.sin(pace * t), 0.6 * np.sin(1.4 * pace * t)]
    command = np.stack([*arm, reach * (1 - np.cos(2 * np.pi * t / period))], axis=1)
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    phases = (Phase("first", 0.0, 0.5 * SECONDS), Phase("second", 0.5 * SECONDS, float(t[-1])))
    return Recording(name, t, command, JOINTS, {}, convention, qpos0=dict.fromkeys(JOINTS, 0.0), phases=phases)


@functools.cache
def record(name: str, repeats: int = 8, preload: float = PRELOAD, friction: float = 0.0) -> Recording:
    """A recording of the synthetic robot with hidden effects [N m]."""
    scene, space = small_scene()
    seed = 1 + ("train", "validation", "test").index(name)
    config = SyntheticRobotConfig(repeats=repeats, timestep=0.00025)
    hidden = {name: size for name, size in (("hinge_preload", preload), ("dry_friction[elbow]", friction)) if size}
    return record_hidden(scene, demonstration(name), TRUTH, hidden, seed=seed, config=config, name=name, space=space)


def quiet(stage: str, value: object) -> None:
    """Ignore progress."""


@dataclass(frozen=True, eq=False)
class Small:
    """A finished search."""

    scene: Scene
    recordings: dict[str, Recording]
    case: Case
    base: FittedModel
    verdict: Verdict

    @property
    def own(self) -> FinalModel:
        """The final model without a final refit."""
        return FinalModel(self.verdict.model, (self.case.train,))


@functools.cache
def small() -> Small:
    """The search, made once for all tests."""
    recordings = {name: record(name) for name in ("train", "validation")}
    scene, space = small_scene()
    case = make_case(scene, space, library(scene, EFFECTS), **recordings, config=QUICK)
    base = base_fit(case.train, case.base, case.config, quiet)
    return Small(scene, recordings, case, base, search_effects(case, base, FLOOR))


def problem_of(found: Small, deadline: float | None = None, progress: Progress = quiet) -> Problem:
    """The constants of the search, for single steps."""
    before = found.case.validation.discrepancy_at(found.base.values)
    asked = directions_of(candidates(found.case.effects))
    return Problem(found.case, found.base, before, FLOOR, asked, deadline, progress)


def largest_t(scores: np.ndarray) -> tuple[np.ndarray, float]:
    """[K] t of each of K directions with scores [K, N], and the p-value of the largest |t| among them.

    This is the textbook test, to which the tests of the search are compared.
    """
    t = t_values(scores, sign_flips(scores.shape[1]))
    largest = np.max(np.abs(t), axis=1)
    return t[0], float(np.mean(largest >= largest[0] * (1 - 1e-12)))
