"""The blind suite: does the search find the hidden effect, and nothing where nothing is hidden?

    python experiments/hidden_effects.py limits --scenes hinge bench   # once, before the method is frozen
    python experiments/hidden_effects.py make --scenes hinge bench     # recordings and, elsewhere, the truth
    python experiments/hidden_effects.py search                        # sees recordings only; can be continued
    python experiments/hidden_effects.py oracle                        # the best result that the right names allow
    python experiments/hidden_effects.py score                         # opens the seals
    python experiments/hidden_effects.py all --quick                   # make, search and score a few cases

The package `blind` describes how the search is kept blind.  Each command ends with one line of JSON.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402
import subprocess  # noqa: E402

import tyro  # noqa: E402

from benchmarks.common import CODE, origin, stem  # noqa: E402
from droid_jax.storage import write_json, write_text  # noqa: E402
from experiments.blind.cases import FACTORS, Counts, plans  # noqa: E402
from experiments.blind.draws import commit_of, folder_of  # noqa: E402
from experiments.blind.limits import scene_limits  # noqa: E402
from experiments.blind.make import make  # noqa: E402
from experiments.blind.oracle import oracle_all  # noqa: E402
from experiments.blind.scenes import setting  # noqa: E402
from experiments.blind.score import score_folder  # noqa: E402
from experiments.blind.search import Bench, search_all  # noqa: E402
from experiments.blind.table import score_table  # noqa: E402

SceneName = Literal["hinge", "bench", "arm", "door"]
RUNS = ROOT / "runs" / "hidden_effects"
LIMITS = ROOT / "benchmarks" / "results" / "detection_limits.json"
QUICK = Counts(none=1, single=1, pair=0, outside=0, left_out=0)
QUICK_EFFECTS = ("hinge_preload",)


@dataclass(frozen=True)
class Limits:
    """Compute detection limits of every hidden effect, by scene; entries of other scenes stay in the file."""

    scenes: tuple[SceneName, ...] = ("hinge", "bench")
    """Scenes."""
    effects: tuple[str, ...] = ()
    """Hidden effects; default: all that a scene can have."""
    draws: int = 3
    """Robots drawn; the median of their limits counts."""
    out: Path = LIMITS
    """File for the limits."""
    kept: Path = RUNS / "limits"
    """Folder of the results so far, from which a stopped run is continued."""
    quick: bool = False
    """One robot, one effect; writes another file."""


@dataclass(frozen=True)
class Make:
    """Record cases: recordings for the search go to OUT/cases, the truth to OUT/sealed."""

    scenes: tuple[SceneName, ...] = ("hinge", "bench")
    """Scenes."""
    commit: str = "HEAD"
    """Commit that froze the method: all seeds derive from its hash.  "development" draws cases to tune with."""
    counts: Counts = field(default_factory=Counts)
    """Cases of each class."""
    classes: tuple[str, ...] = ()
    """Classes; default: all."""
    effects: tuple[str, ...] = ()
    """Only cases with one of these hidden effects (and none)."""
    factors: tuple[float, ...] = ()
    """Only these multiples of the detection limit (and none); default: 1, 3 and 10."""
    limits: Path = LIMITS
    """Detection limits, see the command limits."""
    out: Path = RUNS
    """Folder of cases and seals."""
    unsearched: bool = False
    """Only cases without a file in OUT/results, to continue a run elsewhere."""
    quick: bool = False
    """The lone hinge, without a hidden effect and with a preload.  The default folder ends with _quick."""


@dataclass(frozen=True)
class Search:
    """Search case folders that have no result yet, one after the other in this process."""

    cases: Annotated[tuple[Path, ...], tyro.conf.Positional] = (RUNS / "cases",)
    """Case folders, or one that holds them.  Nothing else is read."""
    scenes: tuple[SceneName, ...] = ()
    """Only cases of these scenes."""
    at_most: int = 1000000
    """Stop after this number of cases."""
    results: Path | None = None
    """Folder of the results, one file per case; default: `results` beside the folder of the cases."""


@dataclass(frozen=True)
class Oracle:
    """Fit the library's form of the hidden effect, starting from the truth: the best possible result of a search."""

    cases: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names of cases; default: all in OUT/cases."""
    out: Path = RUNS
    """Folder of cases and seals; results go to its subfolder `oracle`."""


@dataclass(frozen=True)
class Score:
    """Open the seals of all cases that have a result."""

    out: Path = RUNS
    """Folder of cases and seals."""
    limits: Path = LIMITS
    """Detection limits, which convert a hidden amplitude to that of the library's effect."""
    results: Path | None = None
    """Folder of hidden_effects.json and of its table, hidden_effects.md; default: OUT."""


@dataclass(frozen=True)
class All(Make):
    """make, search in a process of its own, oracle, score."""


Command = Limits | Make | Search | Oracle | Score | All


def run_limits(command: Limits) -> dict[str, Any]:
    """Write every scene's limits as soon as they are known."""
    out = command.out.with_stem(stem(command.out.stem, command.quick))
    effects = QUICK_EFFECTS if command.quick else command.effects
    for name in command.scenes:
        where = setting(name, command.kept / "door")
        found = scene_limits(where, 1 if command.quick else command.draws, command.kept, effects, _tell)
        known = json.loads(out.read_text()) if out.is_file() else {"scenes": {}}
        of = {effect: {**entry, "commit": CODE.get("git")} for effect, entry in found.items()}
        scenes = {**known["scenes"], name: {**known["scenes"].get(name, {}), **of}}
        write_json(out, {"origin": {**known.get("origin", {}), name: origin(0)}, "scenes": scenes})
    return {"file": out.name, "limits": {n: len(scenes[n]) for n in command.scenes}}


def run_make(command: Make) -> dict[str, Any]:
    """Record every planned case that is not there."""
    if not command.limits.is_file():
        raise SystemExit(f"error: no detection limits at {command.limits}; run the command limits first")
    known = json.loads(command.limits.read_text())["scenes"]
    commit = commit_of(command.commit)
    counts = QUICK if command.quick else command.counts
    effects = QUICK_EFFECTS if command.quick else command.effects
    path, made = command.out / "made.json", dict[str, dict[str, list[str]]]()
    if path.is_file():
        known_cases = json.loads(path.read_text())
        if known_cases["commit"] != commit:
            raise SystemExit(f"error: {command.out} holds cases of {known_cases['commit']}; choose another --out")
        made = known_cases["scenes"]
    write_json(path, {"commit": commit, "scenes": made})  # before the first case: no other commit's come beside it
    for name in ("hinge",) if command.quick else command.scenes:
        where, outcomes = setting(name, command.out / "door"), dict[str, str]()
        for plan in plans(where, counts, commit, known.get(name, {}), command.factors or FACTORS):
            if command.classes and plan.kind not in command.classes:
                continue
            if command.factors and plan.effects and plan.factor not in command.factors:
                continue
            if effects and plan.effects and not set(effects) & set(plan.effects):
                continue
            if command.unsearched and (command.out / "results" / f"{folder_of(commit, plan.name)}.json").is_file():
                outcomes[plan.name] = "there"
                continue
            outcome = make(where, plan, commit, known.get(name, {}), command.out / "cases", command.out / "sealed")
            outcomes[plan.name] = outcome
            _tell(f"{plan.name}: {outcome}")
        made[name] = _with(made.get(name, {}), outcomes)
        write_json(path, {"commit": commit, "scenes": made})
    _tell(f"cases in {command.out / 'cases'}")
    return {scene: {outcome: len(names) for outcome, names in found.items()} for scene, found in made.items()}


def _with(known: Mapping[str, list[str]], found: Mapping[str, str]) -> dict[str, list[str]]:
    """Outcome -> names, of the plans made before and of those made now."""
    out: dict[str, list[str]] = {o: [n for n in names if n not in found] for o, names in known.items()}
    for name, outcome in found.items():
        out.setdefault(outcome, []).append(name)
    return {outcome: names for outcome, names in out.items() if names}


def case_folders(given: Path) -> list[Path]:
    """Folders of cases at or below a path, but what a killed `make` left half written, whose name begins with a dot."""
    found = [case.parent for case in given.rglob("case.json")]
    return [f for f in found if not any(part.startswith(".") for part in f.relative_to(given).parts)]


def run_search(command: Search) -> dict[str, Any]:
    """All folders, those of one scene after each other."""
    folders = sorted(folder for given in command.cases for folder in case_folders(given))
    if not folders:
        raise SystemExit(f"error: no case below {', '.join(map(str, command.cases))}; the command make records some")
    chosen = [f for f in folders if not command.scenes or f.name.split("_")[0] in command.scenes]
    wanted = [(f, command.results or f.parent.parent / "results") for f in chosen]
    open_ones = [(f, results) for f, results in wanted if not (results / f"{f.name}.json").is_file()]
    return {"searched": search_all(open_ones[: command.at_most], Bench(), _tell), "cases": len(chosen)}


def run_oracle(command: Oracle) -> dict[str, Any]:
    """Every case that the library has forms of."""
    folder = command.out / "cases"
    if not folder.is_dir():
        raise SystemExit(f"error: {folder} is not there; make of that commit's own code records them again")
    names = command.cases or tuple(sorted(p.name for p in case_folders(folder)))
    return {"oracles": oracle_all(command.out, names, Bench(), _tell)}


def run_score(command: Score) -> dict[str, Any]:
    """Write hidden_effects.json and hand its headline figures on."""
    if not command.limits.is_file():
        raise SystemExit(f"error: no detection limits at {command.limits}: give the file of this run (--limits)")
    limits = json.loads(command.limits.read_text())["scenes"]
    try:
        result = score_folder(command.out / "results", command.out / "sealed", limits, command.out / "oracle")
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    folder = command.results or command.out
    planned = (
        json.loads((command.out / "made.json").read_text())["scenes"] if (command.out / "made.json").is_file() else {}
    )
    unmade = {s: {o: names for o, names in found.items() if o not in ("made", "there")} for s, found in planned.items()}
    seeds = "each case's own, of the frozen commit's hash and its name"
    write_json(folder / "hidden_effects.json", {**origin(0), "seed": seeds, "not_made": unmade, **result})
    write_text(folder / "hidden_effects.md", score_table(result["cases"], result["not_searched"]))
    return result["summary"]


def run_all(command: All) -> dict[str, Any]:
    """The search gets a process of its own, which is given the cases alone."""
    made = run_make(command)
    script = [sys.executable, str(Path(__file__).resolve()), "search"]
    subprocess.run([*script, str(command.out / "cases"), "--results", str(command.out / "results")], check=True)
    run_oracle(Oracle(out=command.out))
    return {"made": made, **run_score(Score(out=command.out, limits=command.limits))}


def placed(command: Any) -> Any:
    """A command whose --quick, where no folder is named, has one of its own: never that of the full run."""
    if isinstance(command, Make) and command.quick and command.out == RUNS:
        return replace(command, out=RUNS.with_name(stem(RUNS.name, True)))
    return command


def _tell(line: str) -> None:
    print(line, flush=True)


def main() -> None:
    command = placed(tyro.cli(Command, description=__doc__))  # pyright: ignore[reportArgumentType]
    run = {
        Limits: run_limits, Make: run_make, Search: run_search, Oracle: run_oracle, Score: run_score, All: run_all,
    }[type(command)]  # fmt: skip
    print(json.dumps(run(command)))  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main()
