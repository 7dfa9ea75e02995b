"""The commands of the pages on real robots run as they stand there, where their data are at hand."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = {  # page -> folder of its data
    "so101": "so101",
    "go2": "go2_leg",
    "xl330": "bam_xl330",
    "panda": "franka_gaz2019",
    "door": "door_pr2_ikea",
}
IN_N_M = ("panda", "door")  # torques are compared, else positions


def commands(page: str) -> str:
    """Its shell blocks, one after the other."""
    return "\n".join(re.findall(r"^```sh\n(.*?)^```", (ROOT / "docs" / f"{page}.md").read_text(), re.M | re.S))


@pytest.mark.parametrize("page", PAGES)
def test_files_that_a_page_names_are_there(page: str) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text()
    named = re.findall(r"experiments/[\w./]+\w", commands(page) + text)
    assert named and all((ROOT / name).is_file() for name in named)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_run(page: str, shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    environment = {**os.environ, "DATA": str(shared_data(PAGES[page])), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-e", "-c", commands(page)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    fit = json.loads((tmp_path / "runs" / page / "fit" / "fit.json").read_text())
    channel = "torque" if page in IN_N_M else "position"
    errors = [distance["errors"][channel] for distance in fit["heldout_distances"].values()]
    for error in errors:
        assert sum(error["mae_after"]) < sum(error["mae_before"])
