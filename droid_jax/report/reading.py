"""Files of a run's folder, read with messages that name the file and the command that writes it again."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Reader:
    """Reads what one command wrote; every fault is a ValueError that names the file.

    command: "identify", "gap", "train" or "evaluate", to run again where something is missing or broken.
    option: what it then needs beside the same options ("--again").
    """

    command: str
    option: str = ""

    def fault(self, what: str) -> ValueError:
        """The error for a fault, with what to do about it."""
        how = f" with the same options and {self.option}" if self.option else ""
        return ValueError(
            f"{what}; run `python -m droid_jax.run {self.command}` again{how}, or pass the folder that it wrote"
        )

    def json(self, path: Path) -> dict[str, Any]:
        """A JSON object."""
        try:
            value = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise self.fault(f"{path} is missing") from None
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise self.fault(f"{path} cannot be read ({error})") from None
        if not isinstance(value, dict):
            raise self.fault(f"{path} must hold a JSON object, got {type(value).__name__}")
        return value

    def arrays(self, path: Path, keys: Iterable[str] = ()) -> dict[str, np.ndarray]:
        """The arrays of an npz file, of which `keys` must be there."""
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {k: file[k] for k in file.files}
        except FileNotFoundError:
            raise self.fault(f"{path} is missing") from None
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise self.fault(f"{path} cannot be read ({error})") from None
        self.need(arrays, keys, path.name)
        return arrays

    def need(self, table: Mapping[str, Any], keys: Iterable[str], where: str) -> None:
        """Fault where a key is absent."""
        absent = [k for k in keys if k not in table]
        if absent:
            raise self.fault(f"{where} lacks {', '.join(map(repr, absent))}")

    def check(self, value: Any, schema: Any, where: str) -> None:
        """Fault at the first place where a value read from JSON is not as its schema says.

        schema: a type or tuple of types; {"key": schema} for an object with these keys (more may be
        there); {str: schema} for one with keys of any name; [schema] for a list.
        """
        if isinstance(schema, list):
            self._type(value, list, where)
            for i, item in enumerate(value):
                self.check(item, schema[0], f"{where}, entry {i}")
        elif isinstance(schema, dict):
            self._type(value, dict, where)
            keyed = {k: schema[str] for k in value} if str in schema else schema
            self.need(value, keyed, where)
            for key, inner in keyed.items():
                self.check(value[key], inner, f"{where}, {key!r}")
        else:
            self._type(value, schema, where)

    def _type(self, value: Any, kind: type | tuple[type, ...], where: str) -> None:
        if not isinstance(value, kind):
            kinds = kind if isinstance(kind, tuple) else (kind,)
            wanted = " or ".join(dict.fromkeys(_JSON_NAMES[k] for k in kinds))
            raise self.fault(f"{where} must be {wanted}, got {type(value).__name__}")


_JSON_NAMES = {
    **{dict: "an object", list: "a list", str: "a text", bool: "true or false"},
    **{int: "a number", float: "a number", type(None): "null"},
}
