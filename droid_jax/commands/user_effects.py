"""Effects of your own on the command line: a Python file that registers them."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

from droid_jax.report.stages import setup


def load_effects(path: Path | None, *folders: Path | None) -> None:
    """Run a file of effects of your own, which are in the library from then on (docs/your-effect.md).

    folders: of runs that are read: one that was made with such effects needs them.  Its setup.json is not followed to
    the file: results that come from elsewhere run no code.
    Raises ValueError where the file is missing, fails, or a folder needs one and none is given.
    """
    if path is None:
        for folder in (f for f in folders if f is not None):
            if told := setup(folder).get("user_effects"):
                raise ValueError(f"{folder} was made with effects of your own: give --user-effects {told}")
        return
    if not path.is_file():
        raise ValueError(f"--user-effects: there is no file {path}")
    # One name for one file: read again by the next stage of `all`, it registers the same effects and no others.
    name = f"user_effects_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"--user-effects takes a Python file (.py), got {path}")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ValueError(f"--user-effects {path}: {type(error).__name__}: {error}") from error
