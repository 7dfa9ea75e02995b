"""A folder of `all` with made-up numbers."""

from __future__ import annotations

from pathlib import Path

from made_up_gap import make_gap
from made_up_policy import make_policy
from made_up_run import make_run


def make_whole(folder: Path) -> None:
    """Every stage in its folder, with a policy to export; no page yet."""
    make_run(folder / "identify")
    make_gap(folder / "gap")
    make_policy(folder / "train")
    (folder / "train" / "policy.npz").write_bytes(b"")
