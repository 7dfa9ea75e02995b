"""Files of two versions of MuJoCo in one folder are found before anything is imported from there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from droid_jax.installation import REINSTALL, MixedInstallation, check_files_of, check_mujoco

ROOT = Path(__file__).resolve().parents[1]
THREE, FOUR = {"mujoco": "3.17.0"}, {"mujoco": "4.0.0", "mujoco-core": "4.0.0", "mujoco-studio": "4.0.0"}


def library(folder: Path, version: str) -> None:
    (folder / f"libmujoco.so.{version}").touch()


def test_this_installation_is_whole():
    check_mujoco()


@pytest.mark.parametrize(("versions", "files"), [(THREE, ["3.17.0"]), (FOUR, ["4.0.0"]), ({}, ["3.17.0"]), (FOUR, [])])
def test_one_version_is_fine(tmp_path: Path, versions: dict[str, str], files: list[str]):
    for version in files:
        library(tmp_path, version)
    check_files_of(tmp_path, versions)


@pytest.mark.parametrize(
    ("versions", "files", "said"),
    [
        (FOUR, ["3.17.0", "4.0.0"], "3.17.0 beside those of 4.0.0"),  # pip install -U mujoco
        (THREE, ["3.17.0", "4.0.0"], "4.0.0 beside those of 3.17.0"),  # and back
        ({**FOUR, "mujoco": "3.17.0"}, ["4.0.0"], "mujoco 3.17.0, mujoco-core 4.0.0"),
        ({**THREE, "mujoco-core": "3.17.0"}, ["3.17.0"], "two versions"),  # there is no such thing
    ],
)
def test_two_versions_are_named_with_the_command_that_mends_it(
    tmp_path: Path, versions: dict[str, str], files: list[str], said: str
):
    for version in files:
        library(tmp_path, version)
    with pytest.raises(MixedInstallation, match=said) as error:
        check_files_of(tmp_path, versions)
    assert REINSTALL in str(error.value) and str(tmp_path) in str(error.value)


def test_a_command_ends_with_that_sentence(tmp_path: Path):
    """Without importing what lies there, which may crash."""
    package = tmp_path / "mujoco"
    package.mkdir()
    (package / "__init__.py").write_text("raise SystemExit('imported')")
    library(package, "9.9.9")
    command = [sys.executable, "-m", "droid_jax.run", "identify"]
    environment = {"PYTHONPATH": f"{tmp_path}:{ROOT}", "PATH": ""}
    run = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 2 and "9.9.9" in run.stderr and REINSTALL in run.stderr
    assert "Traceback" not in run.stderr and "imported" not in run.stderr
