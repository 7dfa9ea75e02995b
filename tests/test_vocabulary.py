"""Words of this project's past that the field has a word for: none comes back."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# What a name or a phrase was -> what it is now.
RENAMED = {
    r"(?i:stand[-_]ins?)(?=\b|_)|\bStandIn\b|\bSurrogateConfig\b|\bTrialRobot\b": "synthetic robot",
    r"\bdroid_jax[./](measure|compare|gap)\b": "recordings, simulate, preflight, cost, discrepancy",
    r"\bGapConfig\b": "DiscrepancyConfig",
    r"\bfind_missing\b": "find_missing_effects",
    r"\btwin_replay\b": "c_replay",
    r"\brubbing\b|\bservo_given\b": "apply_friction, servo_input",
    r"\buntrended\b|\bsteady_": "detrend",
    r"\bHunt\b(?! and Crossley)|\bhunt\b": "SearchState",
    r"\bEvidence\b": "ResidualSet",
    r"[\"'](confirm|sealed)[\"'](?=[:\]])|\[SEALED\]": "validation, test",
    r"\bgap_(fit|confirm)\b": "discrepancy_train, discrepancy_validation",
    r"\bown[-_]effects\b": "user effects",
    r"\bhanded_on\(|\bHandedOn\b": "final_model",
    r"\bwith_own\b|\bown_columns\b|\bown_nuisances\b": "per-recording nuisances",
    r"\bgone_on_with\b|\bplainest\b|\bwithout_idle\b|\bfitted_anew\b": "polished, simplest, without_dominated, ...",
    r"\bhops=|\bhop_generations=(?<!basin_hop_generations=)|\brough=(?!rough)": "basin_hops, coarse tolerance",
    r"(?<!data-)\bdoubt=(?!0\.6)": "misfit_threshold",  # but of the page's attribute and of the models' comparison
    r"\ba\.(amplitude|places)\(|\bshape_told\b|\btold_start\b": "coefficient, locations, shape_interval_share, ...",
    r"\bgeoms_among_looks\b|\blook_geoms\b|\bwithout_looks\b": "full_geom_ids, visual_geoms, without_visual_geoms",
    r"of one's own|worth a name\b|does as well\b": "your own, minimum effect size, equivalent",
}
ENDINGS = (".py", ".md", ".jinja", ".ipynb", ".toml", ".css")
HISTORY = ("docs/history/", "benchmarks/results/", "CHANGELOG.md", "tests/test_vocabulary.py")


def texts() -> list[Path]:
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    return [ROOT / name for name in tracked if name.endswith(ENDINGS) and not name.startswith(HISTORY)]


@pytest.mark.parametrize("old", RENAMED)
def test_no_old_word_comes_back(old: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:80]}"
        for path in texts()
        if path.exists()
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if re.search(old, line)
    ]
    assert not found, f"say {RENAMED[old]}: {found}"


def test_the_search_for_old_words_finds_one() -> None:
    assert len(texts()) > 300 and any(re.search(old, "a stand-in for Evidence") for old in RENAMED)


# What docstrings name with a dot that is no module of the package: values, files and other libraries.
OTHERS = re.compile(r"(found|motion|config|data|env|sys|time|jax|torch|droid_jax)\.|\w+\.py$")


def test_modules_that_docstrings_name_are_there() -> None:
    root, unknown = ROOT / "droid_jax", list[str]()
    named = {
        (path, match[1])
        for path in root.rglob("*.py")
        for match in re.finditer(r"`([a-z_]+\.[A-Za-z_]+)(?:\.[A-Za-z_]+)*`", path.read_text())
    }
    for path, name in sorted(named):
        first, second = name.split(".")
        of_package = [*root.rglob(f"{first}/{second}.py")]
        holds = [p for p in root.rglob(f"{first}.py") if re.search(rf"\b{second}\b", p.read_text())]
        if not (of_package or holds or OTHERS.match(name)):
            unknown.append(f"{path.relative_to(ROOT)}: {name}")
    assert len(named) > 50 and unknown == []


def test_the_files_that_contributing_names_are_there() -> None:
    named = re.findall(r"`([\w./]+\.(?:py|md))`", (ROOT / "CONTRIBUTING.md").read_text())
    assert len(named) > 30 and [name for name in named if not (ROOT / name).is_file()] == []
