"""What is drawn for a case: its seed, the name of its folder, and the robot's hidden values in each recording."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

import numpy as np

from droid_jax.model.parameters import Space
from droid_jax.synthetic.robot import synthetic_truth
from experiments.blind.scenes import ROLES, Setting

DEVELOPMENT = "development"  # in place of a commit: cases to tune with, which prove nothing
FAR = 2.5  # prior deviations from which on a nuisance is drawn no further
SPREAD = 0.5  # prior deviations of what is fitted and no nuisance
HINGE = ("hinge_stiffness", "hinge_frictionloss", "hinge_damping")

Truth = dict[str, float]


def commit_of(name: str) -> str:
    """The full hash of a commit of this checkout, or "development" itself; ValueError for an unknown one."""
    if name == DEVELOPMENT:
        return name
    run = subprocess.run(["git", "rev-parse", name], cwd=Path(__file__).parent, capture_output=True, text=True)
    if run.returncode:
        raise ValueError(f"git knows no commit {name!r}: {run.stderr.strip()}")
    return run.stdout.strip()


def seed_of(commit: str, name: str) -> int:
    """Seed of a case: nobody could choose it before the commit that froze the method existed."""
    return int(_digest(commit, name)[:8], 16)


def folder_of(commit: str, name: str) -> str:
    """Name of a case's folder: its scene, and digits that say nothing about what is hidden (nor about the seed)."""
    return f"{name.split('/')[0]}_{_digest(commit, name)[8:16]}"


def _digest(commit: str, name: str) -> str:
    return hashlib.sha256((commit + name).encode()).hexdigest()


def draw_truths(setting: Setting, rng: np.random.Generator) -> dict[str, Truth]:
    """Role -> hidden values: one robot and door, whose torque sensors have another offset in each recording."""
    space = setting.base
    truth = _door_truth(setting, rng) if setting.name == "door" else _truth(setting, rng)
    offsets = [p for p in space.parameters if p.name.startswith("torque_offset[")]
    own = [{p.name: float(rng.normal(p.mean, p.std)) for p in offsets} for _ in ROLES]
    return {role: _near(space, {**truth, **mine}) for role, mine in zip(ROLES, own, strict=True)}


def _near(space: Space, truth: Truth) -> Truth:
    """The truth with no nuisance further from its prior's mean than FAR deviations: beyond three it is an effect."""
    reach = {p.name: (p.mean - FAR * p.std, p.mean + FAR * p.std) for p in space.parameters if p.nuisance}
    return {name: float(np.clip(value, *reach[name])) if name in reach else value for name, value in truth.items()}


def _truth(setting: Setting, rng: np.random.Generator) -> Truth:
    """Around the priors.  Friction that only a sensor sees stays zero: the synthetic robot has its own in its
    joints.
    """
    space = setting.base
    values = rng.normal(space.mean, np.where(space.nuisance, space.std, SPREAD * space.std))
    values = np.clip(values, space.low, space.high)
    theta = [not p.writes and not p.nuisance for p in space.parameters]
    return dict(zip(space.names, np.where(theta, space.mean, values).tolist(), strict=True))


def _door_truth(setting: Setting, rng: np.random.Generator) -> Truth:
    """A door of Table I, its hinge varied by a third, with one draw of damping and nuisances."""
    truth = synthetic_truth(setting.scene, int(rng.integers(3)), int(rng.integers(1 << 30)))
    return truth | {name: float(truth[name] * np.exp(rng.normal(0, 0.3))) for name in HINGE}
