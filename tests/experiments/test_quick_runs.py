"""Every script of experiments/ and benchmarks/ runs with --quick and ends with one line of JSON."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.common import commits

ROOT = Path(__file__).resolve().parents[2]
DATA = {  # folders of real logs
    "experiments/gap_xl330.py": "bam_xl330",
    "experiments/gap_door.py": "door_pr2_ikea",
    "experiments/gap_emps.py": "emps",
    "experiments/gap_panda.py": "franka_gaz2019",
    "experiments/real_emps.py": "emps",
    "experiments/real_go2.py": "go2_leg",
    "experiments/real_panda.py": "franka_gaz2019",
    "experiments/real_so101.py": "so101",
    "experiments/real_xl330.py": "bam_xl330",
    "benchmarks/peers.py": ".",
}
# Arguments before --quick --out, by script.
SCRIPTS: dict[str, tuple[str, ...]] = {
    "experiments/hidden_effects.py": ("all",),
    "experiments/null_calibration.py": (),
    "experiments/cone_mismatch.py": (),
    "experiments/identify_suite.py": ("--parts", "doors", "pose"),
    "experiments/population_curve.py": (),
    "experiments/search_figure.py": (),
    "experiments/effects_on_policy.py": (),
    "experiments/hidden_effect_policy.py": (),
    "experiments/door_work.py": (),
    "experiments/friction_at_rest.py": (),
    "experiments/pad_friction.py": (),
    "experiments/policy_parity.py": (),
    **dict.fromkeys(DATA, ()),
    "benchmarks/candidates.py": (),
    "benchmarks/check.py": (),
    "benchmarks/distributed.py": (),
    "benchmarks/gpu.py": (),
    "benchmarks/scaling.py": (),
    "benchmarks/stage_profile.py": (),
    "benchmarks/default_run.py": (),
    "benchmarks/durations.py": (),
    "benchmarks/excitation.py": (),
    "benchmarks/house.py": (),
    "benchmarks/kills.py": (),
    "benchmarks/lone_logs.py": (),
    "benchmarks/mujoco4.py": (),
    "benchmarks/neutral_result.py": (),
    "benchmarks/rehearse.py": (),
    "benchmarks/robustness.py": (),
    "benchmarks/step_accuracy.py": (),
    "benchmarks/time_to_fit.py": (),
    "benchmarks/training.py": (),
    "benchmarks/peer_sysid.py": (),
}
READERS = ("experiments/pose_figure.py", "experiments/table1.py")  # of what identify_suite.py has left
ELSEWHERE = {  # run by other tests, or with engines that are not installed here
    "benchmarks/archive.py",
    "benchmarks/batched_worlds.py",
    "experiments/table2.py",
    "experiments/knob_locations.py",
    "benchmarks/throughput.py",
}


def run(script: str, *arguments: str) -> dict:
    """The JSON object on a script's last line."""
    done = subprocess.run([sys.executable, script, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize(("script", "part", "case"), [("pose_figure", "pose", "pose_A"), ("table1", "doors", "door_1")])
def test_a_script_that_lacks_a_case_says_how_to_make_it(tmp_path: Path, script: str, part: str, case: str) -> None:
    command = [sys.executable, f"experiments/{script}.py", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode and f"there is no {tmp_path / 'identify_cases_quick' / case}.json" in done.stderr
    assert f"run experiments/identify_suite.py --parts {part} --quick --out {tmp_path}" in done.stderr


def test_the_poses_panels_say_their_units(monkeypatch: pytest.MonkeyPatch, archived: Callable[[str], Path]) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    figure = importlib.import_module("pose_figure")
    cases = [json.loads((archived("identify") / "identify_cases" / f"pose_{pose}.json").read_text()) for pose in "AB"]
    panels = [axes for axes in figure.densities(*(case["parameters"] for case in cases)).axes if axes.get_visible()]
    said = {axes.get_title("left"): axes.get_xlabel() for axes in panels}
    assert said["Hinge stiffness"] == "[N m/rad]" and all(said.values())


def test_table_one_says_its_units_and_is_that_of_its_json(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    script, folder = importlib.import_module("table1"), ROOT / "benchmarks/results"
    kept = json.loads((folder / "table1.json").read_text())
    text = script.as_markdown(
        kept["parameters"], script.units_of(), commits({"origin": o} for o in kept["origin"].values())
    )
    assert text == (folder / "table1.md").read_text()
    assert "| Hinge stiffness [N m/rad] | 0.01 ± 0.005 |" in text and "| Sliding friction left | 0.5 ± 0.25 |" in text
    assert "90 % interval" in text.split("| Door mass")[0]  # said before the numbers


def test_every_script_is_run_by_some_test() -> None:
    scripts = {str(p.relative_to(ROOT)) for f in ("experiments", "benchmarks") for p in (ROOT / f).glob("*.py")}
    commands = {s for s in scripts if "tyro.cli(" in (ROOT / s).read_text()}
    assert commands == {*SCRIPTS, *READERS, *ELSEWHERE}


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted(SCRIPTS))
def test_a_quick_run_ends_in_one_line_of_json(tmp_path: Path, script: str, shared_data: Callable[[str], Path]) -> None:
    arguments = list(SCRIPTS[script])
    if "peer" in script and not hasattr(pytest.importorskip("mujoco.sysid"), "optimize"):
        pytest.skip("mujoco.sysid has no extras here: pip install -e '.[peers]'")
    if script in DATA:
        arguments = ["--data", str(shared_data(DATA[script]))]
    assert run(script, *arguments, "--quick", "--out", str(tmp_path))
    written = [path.read_text() for path in tmp_path.glob("*.json")]
    assert any(all(f'"{word}":' in text for word in ("commit", "versions", "device")) for text in written)
    if script == "experiments/identify_suite.py":
        for reader in READERS:
            assert run(reader, "--quick", "--out", str(tmp_path))
