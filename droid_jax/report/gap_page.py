"""The page of a search for a missing effect: its tables, doubts, next step and figures.

templates/gap.html.jinja lays it out, templates/gap_sentences.jinja has the sentences.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from matplotlib.figure import Figure
from msgspec import structs

from droid_jax.report import gap_figures, style
from droid_jax.report.gap_folder import (
    About,
    CellEntry,
    EffectPlace,
    ExperimentEntry,
    Found,
    Gap,
    Role,
    TrendEntry,
    ValidationEntry,
    largest_shifts,
)
from droid_jax.report.style import Drawing

NAME_WIDTH = 18  # characters in a line of a recording's name under its bars
DECISIVE = 6.0  # standardised difference from which ten repeats decide between indistinguishable models
LARGE_DISCRETISATION = 0.1  # share of the discretisation error in U, above which the page warns
BEYOND_UNCERTAINTY = 0.8  # share of U after on the validation recording that the fit's uncertainty does not explain;
# below it the page warns
ROLES: dict[Role, str] = {"train": "training", "validation": "validation", "test": "test"}
UNREAD = ("command", "start", "synthetic_robot", "robot", "hidden")  # entries of setup.json that the page does not show


def gap_view(gap: Gap) -> dict[str, Any]:
    """The values that the templates show of a search.

    Args:
        gap: folder of the search.

    Returns:
        The context of gap.html.jinja.
    """
    return {
        "gap": gap,
        "found": gap.found,
        "neutral": gap.neutral,
        "roles": ROLES,
        "decisive": DECISIVE,
        "significance": gap.found.threshold("significance"),
        "doubts": gap_doubts(gap),
        "coarse": coarse_share(gap),
        "within_fit": within_uncertainty(gap),
        "trends": trends(gap),
        "next": gap_next_step(gap),
        "where": where(gap),
        "best": best_experiment(gap),
        "groups": groups(gap.found),
        "signatures": signatures(gap.found),
        "drawings": _draw(gap),
        "options": options(gap),
        "thresholds": dict(flat(gap.found.config)),
    }


def gap_doubts(gap: Gap) -> list[str]:
    """The doubts about a search, by their names in gap_sentences.jinja."""
    asked = {
        "validation_chose": "test" not in gap.roles and not gap.lost,
        "test_lost": gap.lost,
        "test_worse": worse_on_test(gap),
        "limits": bool(gap.found.split.limits),
        "coarse": coarse_share(gap) is not None,
        "step_unknown": gap.found.discretisation_error is None,
        "within_fit": within_uncertainty(gap) is not None,
        "trends": bool(trends(gap)),
        "blown_up": bool(gap.blown_up),
        "not_tried": bool(gap.found.not_tried),
        **{name: name in gap.found.missing_amendments for name in ("experiments", "final_refit")},
    }
    return [name for name, holds in asked.items() if holds]


def worse_on_test(gap: Gap) -> bool:
    """Whether a model with effects has a larger U on the test recordings than the base model."""
    test = gap.found.discrepancies.get("test")
    return gap.extended and test is not None and test.closed is not None and test.closed < 0


def coarse_share(gap: Gap) -> float | None:
    """Share of the discretisation error in U of the base model (train recording); None where it is small."""
    error, before = gap.discretisation_error, gap.found.discrepancies["train"].before
    return error / before if error is not None and before and error > LARGE_DISCRETISATION * before > 0 else None


def within_uncertainty(gap: Gap) -> float | None:
    """Share of U after, on the validation recording, that the fit's uncertainty explains; None where it is small."""
    unexplained, after = gap.found.remainder, gap.found.discrepancies["validation"].after
    if unexplained is None or after is None or not gap.extended:
        return None
    if after <= max(gap.discretisation_error or 0.0, 0.0) or unexplained > BEYOND_UNCERTAINTY * after:
        return None
    return 1.0 - max(unexplained, 0.0) / after


def trends(gap: Gap) -> list[TrendEntry]:
    """The coefficients that change significantly from repeat to repeat."""
    return [t for t in gap.found.trends if t.p is not None and t.p < gap.found.threshold("significance")]


def gap_next_step(gap: Gap) -> str:
    """The next step, by its name in gap_sentences.jinja."""
    verdict = gap.found.verdict
    if verdict == "indistinguishable":
        if gap.timeless or not gap.repeated:
            return "record another motion"
        best = best_experiment(gap)
        return "no experiment" if best is None else "decisive experiment" if decisive(best) else "weak experiment"
    if verdict == "partly explained":
        return "mostly open" if mostly_open(gap) else "keep"
    if verdict == "unexplained":
        if gap.found.hints:
            return "hints"
        return "none passed clearly" if any(t.passed for t in gap.found.validation_tests) else "none passed"
    return "named in the simulator" if verdict == "named" and in_the_simulator(gap) else verdict


def in_the_simulator(gap: Gap) -> bool:
    """Whether every named effect is an error of the model, for which the library has a remedy."""
    return all((about := gap.found.about.get(e.effect)) and about.remedy for e in gap.found.effects)


def best_experiment(gap: Gap) -> ExperimentEntry | None:
    """The candidate experiment of the largest distance."""
    known = [e for e in gap.found.experiments if e.distance is not None]
    return max(known, key=lambda e: e.distance or 0.0, default=None)


def decisive(experiment: ExperimentEntry) -> bool:
    """Whether ten repeats of an experiment decide between the alternatives."""
    return (experiment.distance or 0.0) >= DECISIVE


def mostly_open(gap: Gap) -> bool:
    """Whether the effects explain less than half of the discrepancy."""
    share, enough = gap.found.explained, gap.found.threshold("mostly_explained")
    return gap.found.verdict == "partly explained" and share is not None and share < enough


def untrusted(gap: Gap) -> bool:
    """Whether nothing should be trained on the model: no fit converged, or most of the discrepancy is open."""
    return gap.found.verdict in ("unexplained", "fit not converged") or mostly_open(gap)


def where(gap: Gap) -> list[CellEntry]:
    """The largest cell by joint and phase, and by the object's state, of the final model's discrepancy.

    Only significant cells are considered; all cells where there are no repeats to test with.
    """
    cells = [c for c in gap.found.cells.after if c.discrepancy is not None and (c.found or not gap.repeated)]
    kinds = [[c for c in cells if c.axis == "phase"], [c for c in cells if c.axis.startswith("object")]]
    chosen = [kind for kind in kinds if kind] or ([cells] if cells else [])
    return [max(kind, key=lambda c: c.discrepancy or 0.0) for kind in chosen]


@dataclass(frozen=True)
class Row:
    """A validation test, with the score test's statistic and explained share where its new effect was ranked.

    outcome: "selected", "selected, indistinguishable", "indistinguishable", "hint", "not converged",
    "larger discrepancy", "small gain", "simpler", "failed" or "failed alone" (though in the final model with others).
    """

    test: ValidationEntry
    t: float | None
    explained: float | None
    outcome: str


@dataclass(frozen=True)
class Group:
    """Validation tests of models that add one effect, or a pair, to the same model.

    beside: effects of that model.
    discrepancy_train, discrepancy_validation: U of that model.
    """

    beside: tuple[EffectPlace, ...]
    discrepancy_train: float | None
    discrepancy_validation: float | None
    rows: tuple[Row, ...]


def groups(found: Found) -> list[Group]:
    """The validation tests by the number of effects before, the smallest discrepancy first."""
    counts = sorted({t.parts_before for t in found.validation_tests})
    return [_group(found, count) for count in counts]


def _group(found: Found, count: int) -> Group:
    tests: dict[tuple[EffectPlace, ...], ValidationEntry] = {}
    for t in found.validation_tests:
        parts = tuple(t.parts)
        if t.parts_before == count and (parts not in tests or t.passed):  # a pair may be tried twice
            tests[parts] = t
    ranked = {r.place: r for r in found.score_tests[count].ranking} if count < len(found.score_tests) else {}
    beside = Counter(parts[:count] for parts in tests).most_common(1)[0][0]
    rows = []
    for parts, t in tests.items():
        entry = ranked.get(parts[-1]) if parts[:count] == beside else None
        statistics = (entry.t, entry.explained) if entry else (None, None)
        rows.append(Row(t, *statistics, outcome(found, t)))
    order = sorted(rows, key=lambda r: (r.test.discrepancy_validation is None, r.test.discrepancy_validation or 0.0))
    if not beside:
        before = (found.discrepancies["train"].before, found.discrepancies["validation"].before)
    else:
        model = next((t for t in found.validation_tests if tuple(t.parts) == beside), None)
        before = (model.discrepancy_train, model.discrepancy_validation) if model else (None, None)
    return Group(beside, *before, tuple(order))


def outcome(found: Found, test: ValidationEntry) -> str:
    """The outcome of a validated model, see `Row`."""
    parts, effects = set(test.parts), set(found.effects)
    if not test.passed:
        return "failed alone" if parts < effects else "failed"
    if parts <= effects:
        pairs = zip(found.effects, found.indistinguishable, strict=True)
        tied = any(others for effect, others in pairs if effect in parts)
        return "selected, indistinguishable" if tied else "selected"
    if parts <= effects | set(alternatives(found)):
        return "indistinguishable"
    if any(parts <= set(hint.effects) for hint in found.hints):
        return "hint"
    if found.verdict == "fit not converged":
        return "not converged"
    validation = [found.discrepancies["validation"].after, *(t.discrepancy_validation for t in found.validation_tests)]
    if (test.discrepancy_validation or 0.0) > min(u for u in validation if u is not None):
        return "larger discrepancy"
    return "small gain" if len(test.parts) > 1 else "simpler"


def alternatives(found: Found) -> list[EffectPlace]:
    """The effects of all alternatives to the answer, each once."""
    models = (model for others in found.indistinguishable for model in others)
    return list(dict.fromkeys(place for model in models for place in model))


@dataclass(frozen=True)
class Signature:
    """The signature of an effect of the answer, or of an alternative to it, with all places of the effect."""

    places: tuple[EffectPlace, ...]
    alternative: bool
    about: About


def signatures(found: Found) -> list[Signature]:
    """One for each effect of the answer and of its alternatives, with all its places."""
    out: dict[tuple[bool, str], Signature] = {}
    for place in dict.fromkeys([*found.effects, *alternatives(found)]):
        key = (place not in found.effects, place.effect)
        about = found.about.get(place.effect)
        if key in out:
            out[key] = replace(out[key], places=(*out[key].places, place))
        elif about and (about.signature or about.confused_with):
            out[key] = Signature((place,), key[0], about)
    return list(out.values())


def options(gap: Gap) -> dict[str, str]:
    """The options of the run as text, without those that the page does not show."""
    return {
        name.replace("_", " "): ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        for name, value in gap.options.items()
        if value not in (None, [], "") and name not in UNREAD and not name.endswith("_sha256")
    }


def flat(config: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Settings of nested objects, each with the names above it: "selection.significance"."""
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def _draw(gap: Gap) -> dict[str, list[Drawing]]:
    """Figures by section of the page; PNG and PDF copies go to FOLDER/figures/."""
    found, extended, unit = gap.found, gap.extended, gap.found.units
    sections: dict[str, list[Drawing]] = {"size": [], "torque": [], "place": [], "shifts": [], "remainder": []}
    before, after = (_shown(gap, cells) for cells in (found.cells.before, found.cells.after))
    cells = (before, after if extended else None)

    def add(section: str, stem: str, title: str, make: Callable[..., Figure], *args: Any) -> None:
        sections[section].append(style.drawing(gap.folder, f"missing_{stem}", title, make, *args))

    lines = [textwrap.fill(gap.recording(role), NAME_WIDTH, max_lines=3, placeholder=" …") for role in gap.roles]
    names = [f"{name}\n{ROLES[role]}" for name, role in zip(lines, gap.roles, strict=True)]
    sizes = [found.discrepancies[role] for role in gap.roles]
    bars = (names, sizes, gap.discretisation_error, found.distance, extended)
    add("size", "gap", f"Discrepancy and {found.distance[0].lower()}", gap_figures.discrepancy_bars, *bars)
    for roles, traces in gap.sheets:
        title = f"{found.quantity} over time, " + " and ".join(
            f"{gap.recording(role)} ({ROLES[role]})" for role in roles
        )
        add("torque", f"torque_{roles[0]}", title, gap_figures.torque_overlays, traces, unit, extended, found.quantity)
    if any(c.axis == "phase" for c in before):
        add("place", "cells", "Discrepancy by joint and phase", gap_figures.cell_maps, *cells)
    if any(c.axis != "phase" for c in before):
        add("place", "state", "Discrepancy over the state of the motion", gap_figures.state_bars, *cells)
    if extended and largest_shifts(found.shifts):
        add("shifts", "shifts", "Shifts of the base parameters", gap_figures.base_shifts, found.shifts)
    if found.verdict in ("unexplained", "partly explained"):
        curve = (gap.sheets[-1][1], found.cells.after, unit)
        add("remainder", "remainder", "Remaining discrepancy", gap_figures.remainder, *curve)
    return sections


def _shown(gap: Gap, cells: Sequence[CellEntry]) -> Sequence[CellEntry]:
    """Cells to draw; without repeats, which the significance test needs, all of them count as significant."""
    if gap.repeated:
        return cells
    return [structs.replace(c, found=True) for c in cells if c.discrepancy]
