"""`record`: recordings of the synthetic robot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Record:
    """Record the synthetic robot (plain C MuJoCo with hidden physics): repeats of a demonstration, as an npz file."""

    demonstration: str = "A"
    """Demonstration: A, B or C."""
    springs: Literal[0, 1, 2] = 1
    """Springs on the door."""
    repeats: int = 10
    """Number of repeats."""
    seed: int = 0
    """Seed of the robot's hidden errors and of its noise."""
    gains: Literal["impedance", "paper"] = "impedance"
    """Servo gains."""
    out: Path = Path("runs/recording.npz")
    """File (npz) or folder (CSV) to write."""


def run(command: Record) -> None:
    """Record the synthetic robot and save the recording."""
    from droid_jax.door.demonstration import PLANS, demonstration_path
    from droid_jax.door.scene import door_scene
    from droid_jax.recordings.formats import check_target, load_recording, save_recording
    from droid_jax.synthetic.robot import SyntheticRobotConfig, record, synthetic_truth

    check_target(command.out)
    scene = door_scene(springs=command.springs, gains=command.gains)
    demonstration = load_recording(demonstration_path(command.demonstration, gains=command.gains))
    truth = synthetic_truth(scene, command.springs, command.seed)
    # One robot; each demonstration has its own noise and grasp errors.
    seed = 1000 * command.seed + sorted(PLANS).index(command.demonstration)
    recording = record(scene, demonstration, truth, seed=seed, config=SyntheticRobotConfig(repeats=command.repeats))
    of = {"springs": str(command.springs), "robot": str(command.seed)}
    recording = replace(recording, meta={**recording.meta, **of})
    path = save_recording(recording, command.out)
    print(f"synthetic robot recorded {recording.repeats} repeats of {recording.duration:.1f} s: {path}")
