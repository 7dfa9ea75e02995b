"""How scripts summarise their cases and keep them between runs; cases that do not belong together are refused."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.common import publish
from benchmarks.sharing import code_name, kept

ROOT = Path(__file__).resolve().parents[2]


def test_searches_of_several_machines_are_not_drawn_over_one_wall_time():
    module = importlib.import_module("experiments.population_curve")
    one, other = ({"origin": {"device": device}} for device in ("a CPU, 1 core", "a CPU, 2 cores"))
    assert module.one_device([one, one]) == "a CPU, 1 core"
    with pytest.raises(SystemExit, match="error: searches of several devices: a CPU, 1 core; a CPU, 2 cores"):
        module.one_device([one, other])


def test_a_script_ends_in_its_file_and_one_line_of_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    publish(tmp_path, "figures", False, 7, {"figure": 1.0, "more": [2]}, {"figure": 1.0})
    assert capsys.readouterr().out == '{"figure": 1.0}\n'
    publish(tmp_path, "figures", True, 8, {"figure": 3.0})
    kept, quick = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("figures", "figures_quick"))
    assert (kept["seed"], kept["figure"], kept["more"], quick["seed"], quick["figure"]) == (7, 1.0, [2], 8, 3.0)
    assert {"commit", "versions", "device"} <= set(kept) and json.loads(capsys.readouterr().out) == quick


def door(*inside: bool) -> dict[str, Any]:
    """A case of identification with so many identifiable parameters, and another that is not."""
    told = [{"inside": i, "identifiable": True, "nuisance": False} for i in inside]
    rest = {"inside": False, "identifiable": False, "nuisance": False}
    return {
        "parameters": {str(k): p for k, p in enumerate([*told, rest])},
        "converged": True,
        "origin": {"commit": "a"},
    }


def test_doors_that_tell_nothing_have_no_coverage():
    module = importlib.import_module("experiments.identify_suite")
    none = module.summarise({"calibration_00": door()})["calibration"]
    assert none == {"doors": 1, "converged": 1, "parameters": 0, "coverage": None, "coverage_interval_95": None}
    some = module.summarise({"calibration_00": door(), "calibration_01": door(True, False)})["calibration"]
    assert some["parameters"] == 2 and some["coverage"] == 0.5
    json.dumps(some, allow_nan=False)


def test_the_cones_are_compared_on_the_robot_that_is_searched(monkeypatch: pytest.MonkeyPatch):
    """Not on the first one drawn, which may lose its door."""
    module, seen = importlib.import_module("experiments.cone_mismatch"), list[Any]()

    def of(value: float) -> dict[str, Any]:
        return {"train": SimpleNamespace(channels={"torque": SimpleNamespace(values=np.full((2, 4, 1), value))})}

    monkeypatch.setattr(module, "elliptic", lambda where: f"{where}, elliptic")
    monkeypatch.setattr(module, "recorded", lambda where, *_: seen.append(where) or (3, "the fourth", of(1.5)))
    monkeypatch.setattr(module, "record", lambda where, drawn, roles: seen.append((where, drawn)) or of(1.0))
    assert module.between_cones("door", 0) == [0.5]
    assert seen == ["door, elliptic", ("door", "the fourth")]
    monkeypatch.setattr(module, "recorded", lambda *_: "never held its door")
    with pytest.raises(SystemExit, match="error: case door/cone/0: never held its door"):
        module.between_cones("door", 0)


@pytest.mark.parametrize("folder", ["experiments", "benchmarks"])
def test_every_script_is_in_the_list_of_its_folder(folder: str):
    """And nothing else is; helpers are named below the table."""
    text = (ROOT / folder / "README.md").read_text()
    listed = re.findall(r"^\| `(\w+\.py)` \|", text, re.MULTILINE)
    scripts = {p.name for p in (ROOT / folder).glob("*.py") if "tyro.cli(" in p.read_text()} - {"archive.py"}
    assert len(listed) == len(set(listed)) and set(listed) == scripts
    helpers = {p.name for p in (ROOT / folder).glob("*.py")} - scripts
    assert [name for name in sorted(helpers) if f"`{name}`" not in text] == []


def test_what_is_kept_is_made_once(tmp_path: Path):
    made = list[int]()

    def make() -> dict[str, int]:
        made.append(1)
        return {"made": len(made)}

    path = tmp_path / "cases" / "a.json"
    assert kept(path, make) == kept(path, make) == {"made": 1}
    path.unlink()
    assert kept(path, make) == {"made": 2}


def test_what_fails_is_not_kept(tmp_path: Path):
    def fail() -> dict[str, int]:
        raise ValueError("no replay")

    with pytest.raises(ValueError, match="no replay"):
        kept(tmp_path / "a.json", fail)
    assert kept(tmp_path / "a.json", lambda: {"made": 1}) == {"made": 1}


def test_uncommitted_code_finds_nothing_again():
    assert code_name("a" * 40) == code_name("a" * 40) == "a" * 40
    assert code_name("a" * 40 + "-dirty") != code_name("a" * 40 + "-dirty")
    assert code_name(None) != code_name(None)
