"""The built-in MJCF files, and the names in them that the program uses."""

from __future__ import annotations

from pathlib import Path

ARM = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
HINGE = "hinge"


def mjcf_dir() -> Path:
    """Folder of the built-in MJCF files: inside the installed package, else beside it in a checkout.

    Raises FileNotFoundError when neither is there.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "mjcf", package.parent / "mjcf"):
        if (folder / "room.xml").is_file():
            return folder
    raise FileNotFoundError(f"the built-in MJCF files are neither in {package / 'mjcf'} nor beside the package")
