"""Checks, before MuJoCo is imported, that all its files are of one version: a mixture may crash.

MuJoCo 4 consists of three distributions (mujoco-core, mujoco-studio, mujoco), which share the folder of MuJoCo 3's
only distribution.  An installer that puts one over the other leaves files of both.
Source: MuJoCo's release notes of 4.0.0, which name the commands that mend it.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
from pathlib import Path

PARTS = ("mujoco", "mujoco-core", "mujoco-studio")  # of MuJoCo 4; MuJoCo 3 is the first alone
REINSTALL = 'python -m pip uninstall -y mujoco mujoco-core mujoco-studio && python -m pip install "mujoco>=3.17,<5"'
_LIBRARY = re.compile(r"mujoco\D*?(\d+\.\d+\.\d+)")


class MixedInstallation(ImportError, ValueError):
    """Files of two versions of MuJoCo; the message says which, where, and how to reinstall."""


def check_mujoco() -> None:
    """Look at the installed MuJoCo.

    Raises:
        MixedInstallation: its distributions are of two versions, or its folder holds a library of another one.
    """
    found = importlib.util.find_spec("mujoco")
    if found is None or not found.submodule_search_locations:
        return  # importing it raises the error
    check_files_of(Path(found.submodule_search_locations[0]), installed())


def installed() -> dict[str, str]:
    """Version of each installed distribution of MuJoCo."""
    out: dict[str, str] = {}
    for name in PARTS:
        try:
            out[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return out


def check_files_of(folder: Path, versions: dict[str, str]) -> None:
    """MixedInstallation where distributions differ in version, or the C library has a version that none of them has.

    Args:
        folder: the package `mujoco`.
        versions: of the distributions; without any (a checkout on the path), nothing is checked.
    """
    stated = {version.split("+")[0] for version in versions.values()}
    libraries = {m[1] for path in folder.glob("*mujoco*") if (m := _LIBRARY.match(path.name.removeprefix("lib")))}
    old = stated and min(int(version.split(".")[0]) for version in stated) < 4
    parts = [name for name in versions if name != "mujoco"]
    if len(stated) > 1 or (old and parts):
        said = ", ".join(f"{name} {version}" for name, version in versions.items())
        raise MixedInstallation(f"{folder} holds files of two versions of MuJoCo ({said}); reinstall with: {REINSTALL}")
    if stated and libraries - stated:
        said = ", ".join(sorted(libraries - stated))
        raise MixedInstallation(
            f"{folder} holds files of MuJoCo {said} beside those of {', '.join(sorted(stated))}, which is installed; "
            f"reinstall with: {REINSTALL}"
        )
