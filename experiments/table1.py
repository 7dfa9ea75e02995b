"""Table I: initial and fitted distributions of the three doors, the paper's beside this program's.

    python experiments/table1.py [--quick] [--out DIR]

Reads the cases door_0, door_1 and door_2 of `identify_suite.py` in DIR/identify_cases (that script makes them);
writes DIR/table1.md and DIR/table1.json.  The paper's fitted means are the hidden truth of the synthetic robot (its
recordings are not public), except the joints' damping, which here is the servo's (docs/paper.md).  The program's best
fit should therefore be near the paper's mean.  Widths cannot be compared directly: the paper gives a deviation, this
program the ends of the 90 % interval, which is asymmetric for a value that is fitted in its logarithm.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tyro  # noqa: E402
from identify_suite import kept_cases  # noqa: E402

from benchmarks.common import commits, stem  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_space  # noqa: E402
from droid_jax.report.text import label, like, significant  # noqa: E402
from droid_jax.storage import write_json, write_text  # noqa: E402

# Table I of the paper: mean and diag(Sigma), initial and for the doors with 0, 1 and 2 springs.
PAPER: dict[str, tuple[tuple[float, float], ...]] = {
    "door_mass": ((1.144, 0.5), (1.50, 0.73), (0.92, 0.52), (2.54, 1.23)),
    "knob_mass": ((0.199, 0.1), (1.98, 1.86), (2.31, 0.42), (3.99, 1.29)),
    "hinge_frictionloss": ((0.05, 0.025), (0.10, 0.02), (0.0, 0.0), (0.56, 0.05)),
    "hinge_stiffness": ((0.01, 0.005), (0.002, 0.008), (1.06, 0.0), (1.24, 0.06)),
    "hinge_damping": ((2.0, 1.0), (0.10, 0.19), (0.71, 0.01), (0.6, 0.18)),
    "joint_damping_1": ((100, 2.0), (101.35, 1.06), (98.11, 0.41), (98.63, 1.23)),
    "joint_damping_2": ((100, 2.0), (100.06, 1.83), (98.69, 0.63), (99.28, 0.71)),
    "joint_damping_3": ((100, 2.0), (100.08, 0.67), (100.38, 0.65), (95.83, 1.42)),
    "joint_damping_4": ((100, 2.0), (99.61, 0.41), (99.64, 0.15), (100.12, 0.81)),
    "joint_damping_5": ((100, 2.0), (99.14, 0.68), (101.01, 0.96), (95.71, 0.77)),
    "joint_damping_6": ((10, 1.0), (10.05, 0.64), (9.72, 0.04), (11.55, 0.46)),
    "joint_damping_7": ((0.4, 0.2), (0.83, 0.57), (1.17, 1.19), (1.54, 0.67)),
    "sliding_friction_left": ((0.5, 0.25), (0.47, 0.70), (1.37, 0.35), (3.04, 0.46)),
    "sliding_friction_right": ((0.5, 0.25), (1.78, 0.86), (0.76, 0.39), (2.68, 0.54)),
    "torsional_friction_left": ((0.5, 0.25), (1.38, 0.66), (0.79, 0.42), (1.04, 0.72)),
    "torsional_friction_right": ((0.5, 0.25), (1.84, 0.92), (2.29, 0.80), (2.0, 0.83)),
}


@dataclass(frozen=True)
class Arguments:
    """Where the cases are and the table goes."""

    out: Path = ROOT / "benchmarks" / "results"
    """Folder with identify_cases."""
    quick: bool = False
    """Read the cases of a quick suite, which has only the door with one spring."""


def table(cases: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Parameter -> the paper's (mean, deviation) and, by door, truth, best fit, 90 % interval, whether that holds the
    truth, and whether the parameter is identifiable.

    cases: by number of springs, "parameters" of the suite's cases.
    """
    rows = {}
    for name, paper in PAPER.items():
        doors = {}
        for springs, parameters in cases.items():
            kept = ("truth", "best", "interval", "inside", "identifiable")
            doors[str(springs)] = {"paper": list(paper[springs + 1]), **{key: parameters[name][key] for key in kept}}
        rows[name] = {"initial": list(paper[0]), "doors": doors}
    return rows


CAPTION = """# Table I: initial and fitted distributions of the three doors

- **Paper**: its mean ± its `diag(Sigma)`, read as a deviation. The paper gives no unit but kg; the others are a
  reading ([paper.md](../../docs/paper.md)).
- **Truth here**: the hidden value of the synthetic robot. For door and fingers it is the paper's fitted mean; joint
  damping is that of the servo used here, not the paper's.
- **Best here**: the fit to demonstrations A and C with its 90 % interval. *Italics*: the motion does not constrain the
  parameter; take no number from it.
- Fits of commit {commits}; all numbers in [table1.json](table1.json). Sliding friction has no unit.
"""


def as_markdown(rows: Mapping[str, Any], units: Mapping[str, str], commits: Sequence[str]) -> str:
    """The table as text, with its caption; italics mark what the motion does not constrain.

    rows: of `table`.  units: by parameter, "-" for none.  commits: that made the fits.
    """
    doors = list(next(iter(rows.values()))["doors"])
    springs = {"0": "no spring", "1": "one spring", "2": "two springs"}
    columns = ("{}, paper", "truth here", "best here (90 %)")
    head = ["", "initial, paper", *(column.format(springs[d]) for d in doors for column in columns)]
    listed = ", ".join(f"`{commit[:7]}`" for commit in commits)
    lines = [CAPTION.format(commits=listed)]
    lines += ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, row in rows.items():
        unit = "" if units[name] == "-" else f" [{units[name]}]"
        cells = [label(name) + unit, _pair(*row["initial"])]
        for door in row["doors"].values():
            low, high = door["interval"]
            best, *ends = (like(value, 0.5 * (high - low)) for value in (door["best"], low, high))
            found = f"{best} ({' to '.join(ends)})"
            cells += [
                _pair(*door["paper"]),
                significant(door["truth"]),
                found if door["identifiable"] else f"*{found}*",
            ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def units_of() -> dict[str, str]:
    """Unit of each parameter of Table I, as the door's space has it."""
    return {p.name: p.unit for p in door_space(door_scene()).parameters}


def _pair(mean: float, deviation: float) -> str:
    return f"{mean:g} ± {deviation:g}"


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    doors = (1,) if arguments.quick else (0, 1, 2)
    found = kept_cases(arguments.out, arguments.quick, "doors", [f"door_{k}" for k in doors])
    cases = dict(zip(doors, found, strict=True))
    rows = table({k: case["parameters"] for k, case in cases.items()})
    name = stem("table1", arguments.quick)
    origins = {str(k): case["origin"] for k, case in cases.items()}
    write_text(arguments.out / f"{name}.md", as_markdown(rows, units_of(), commits(found)))
    write_json(arguments.out / f"{name}.json", {"parameters": rows, "origin": origins}, indent=2)
    identifiable = [d for r in rows.values() for d in r["doors"].values() if d["identifiable"]]
    inside = sum(bool(d["inside"]) for d in identifiable)
    table_file = str(arguments.out / f"{name}.md")
    print(json.dumps({"identifiable": len(identifiable), "inside_90": inside, "table": table_file}))


if __name__ == "__main__":
    main()
