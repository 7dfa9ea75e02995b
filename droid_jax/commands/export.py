"""`export`: the files of a trained policy for a robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from droid_jax.commands.folder import stage_folder
from droid_jax.commands.writer import writes
from droid_jax.files import POLICY


@dataclass(frozen=True)
class Export:
    """Write a trained policy for a robot's computer: ONNX (checked against JAX), npz, and a control loop that needs
    only numpy (docs/policy-on-a-robot.md)."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of `train` or of `all`. Default: runs/train where it holds a policy, else runs/all."""
    out: Path | None = None
    """Folder to write; default: RUN/export."""


@writes(None, lambda command: command.out or _policy_folder(command) / "export")
def run(command: Export) -> None:
    """Write policy.npz, policy.onnx and control.py."""
    from droid_jax.policy.control import load_policy
    from droid_jax.policy.export import export

    folder = _policy_folder(command)
    out = command.out or folder / "export"
    apart = export(out, load_policy(folder / POLICY))
    print(f"policy.npz, policy.onnx and control.py: {out}; ONNX and JAX differ by at most {apart:.1e} in an action")


def _policy_folder(command: Export) -> Path:
    return stage_folder(command.run, "train", POLICY)
