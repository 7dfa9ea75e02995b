"""Table II: what is summed up is what the trials were, and the intervals know policies from trials."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from droid_jax.policy.trials import Trials
from experiments.policies.cases import Budget, Options, run_all
from experiments.policies.settings import SETTINGS, Setting
from experiments.policies.table import apart, column, resampled, summed_up

ROOT = Path(__file__).resolve().parents[2]


def case(method: str, seed: int, rate: float, count: int = 50) -> dict[str, Any]:
    """A policy that succeeds in so many of its trials."""
    won = np.arange(count) < rate * count
    found = Trials(won, np.deg2rad(np.where(won, 40.0, 10.0)), np.where(won, 100, 512), won + 0.0, np.full(count, ""))
    return {
        "setting": "paper",
        "method": method,
        "seed": seed,
        "simulation": found.to_json(),
        "stand_in": found.to_json(),
    }


def test_a_column_is_the_mean_over_all_trials():
    found = column([case("mean", 0, 0.2), case("mean", 1, 0.8)], "stand_in")
    assert (found["policies"], found["trials"], found["seeds"]) == (2, 100, [0, 1])
    assert found["success_rate"] == pytest.approx(0.5) and found["success_of_each"] == pytest.approx([0.2, 0.8])
    assert found["angle_deg"]["mean"] == pytest.approx(25.0) and found["angle_deg"]["std"] == pytest.approx(15.0)
    assert found["steps"]["mean"] == 100.0  # of successes
    assert column([case("mean", 0, 0.0)], "stand_in")["steps"] == {"mean": None, "std": None, "interval_95": None}


def test_policies_that_differ_widen_the_interval():
    """A hundred trials of each say little where there are five policies: the interval is that of five draws."""
    alike = [case("mean", k, 0.5, 100) for k in range(5)]
    apart_ = [case("mean", k, float(k % 2), 100) for k in range(4)]
    narrow, wide = (column(own, "stand_in")["success_interval_95"] for own in (alike, apart_))
    assert narrow[1] - narrow[0] == pytest.approx(2 * 1.96 * 0.5 / np.sqrt(500), rel=0.1)
    assert wide == [0.0, 1.0]


def test_a_difference_has_a_sign_and_an_interval():
    better, worse = [case("fitted", k, 0.9) for k in range(5)], [case("prior", k, 0.3) for k in range(5)]
    found = apart(better, worse, "success")
    assert found["difference"] == pytest.approx(0.6) and 0.4 < found["interval_95"][0] < 0.6 < found["interval_95"][1]
    same = apart(better, [case("prior", k, 0.9) for k in range(5)], "success")
    assert same["interval_95"][0] < 0 < same["interval_95"][1]


def test_resamples_of_one_policy_are_of_its_trials():
    draws = resampled([np.array([0.0] * 50 + [1.0] * 50)])
    assert draws.mean() == pytest.approx(0.5, abs=0.01) and draws.std() == pytest.approx(0.05, rel=0.1)


def test_the_table_holds_what_was_run_and_the_papers_own():
    found = summed_up([case(m, 0, 0.5) for m in ("prior", "fitted")], {"paper": SETTINGS["paper"]})
    assert set(found["table"]["paper"]["methods"]) == {"prior", "fitted"}
    assert set(found["table"]["paper"]["fitted_better_than"]) == {"prior"}
    assert found["paper"]["mean"]["robot"][0] == 86.7
    assert found["line"]["paper"]["fitted"]["stand_in"] == 0.5
    json.dumps(found)


def test_settings_have_their_names():
    assert all(name == setting.name and isinstance(setting, Setting) for name, setting in SETTINGS.items())


def test_what_is_there_is_not_made_again_and_another_budget_is_refused(tmp_path: Path):
    made = list[str]()
    budget = Options(steps=1000, trials=2).budget

    def make(name: str, of: Budget) -> dict[str, Any]:
        made.append(name)
        return {**case("mean", 0, 0.5), "budget": of.to_json()}

    planned = {tmp_path / f"{n}.json": functools.partial(make, n, budget) for n in "abc"}
    assert len(run_all(planned, budget, 2)) == 2 and made == ["a", "b"]
    (tmp_path / "pilot_100.json").write_text("{}")  # lies beside them and is none of them
    assert len(run_all(planned, budget, 9)) == 3 and made == ["a", "b", "c"]
    with pytest.raises(ValueError, match=r"a.json was made with another budget: .*choose another --out"):
        run_all(planned, Options(steps=2000, trials=2).budget, 0)


@pytest.mark.slow
@pytest.mark.parametrize(("script", "line"), [("table2", {"paper"}), ("knob_locations", {"0.15 m"})])
def test_the_experiments_run_quick(tmp_path: Path, script: str, line: set[str]):
    command = [sys.executable, f"experiments/{script}.py", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(json.loads(done.stdout.splitlines()[-1])) == line
    assert (tmp_path / f"{script}_quick.json").is_file()
