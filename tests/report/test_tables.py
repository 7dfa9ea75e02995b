"""A fit's tables as DataFrames, read back from what the run's writer writes."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

import droid_jax as dj
from droid_jax.storage import write_csv

HISTORY = ["generation", "best_cost", "median_cost", "sigma", "mean_mass", "mean_damping", "std_mass", "std_damping"]


def fit(folder: Path) -> Path:
    write_csv(folder / "samples.csv", ["mass", "damping"], [[1.0, 2.0], [1.5, 2.5], [1.25, 2.25]])
    write_csv(
        folder / "history.csv",
        HISTORY,
        [[1, 0.5, 0.7, 1.0, 1.2, 2.0, 0.3, 0.1], [2, 0.4, 0.5, 0.8, 1.3, 2.1, 0.2, 0.1]],
    )
    return folder


@pytest.mark.parametrize("below", ["", "identify"])
def test_the_tables_of_a_fit(tmp_path: Path, below: str):
    pytest.importorskip("pandas")
    fit(tmp_path / below)
    found = dj.frames(tmp_path)
    assert list(found.samples.columns) == ["mass", "damping"] and found.samples["mass"].mean() == 1.25
    assert found.history.loc[2, "best_cost"] == 0.4 and list(found.history.columns) == HISTORY[1:]


def test_tables_of_an_earlier_run_are_not_those_of_one_that_is_not_whole(tmp_path: Path):
    pytest.importorskip("pandas")
    (fit(tmp_path) / "setup.json").write_text('{"preset": "quick"}')
    with pytest.raises(ValueError, match="holds a run that is not whole"):
        dj.frames(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    assert len(dj.frames(tmp_path).samples) == 3


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("mean_damping,std_mass", "mean_damping$std_mass", "must have the columns generation, best_cost"),
        ("0.5,0.7", "0.5,0.7,0.9", "holds no tables of a fit"),
        ("0.5,0.7", "0.5,x", "the columns median_cost do not hold numbers"),
        ("0.5,0.7", "0.5,", "has empty cells"),
        ("generation", "", "must have the columns"),
    ],
)
def test_damaged_tables_are_refused(tmp_path: Path, old: str, new: str, said: str):
    pytest.importorskip("pandas")
    path = fit(tmp_path) / "history.csv"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ValueError, match=said):
        dj.frames(tmp_path)


def test_what_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ValueError, match=r"holds no tables of a fit .*run `python -m droid_jax.run identify` again"):
        dj.frames(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"droid_jax.frames needs pandas: in the checkout, pip install"):
        dj.frames(tmp_path)
