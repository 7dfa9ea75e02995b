"""The page of `rehearse`: from which size effects would be found, and what would help; from rehearsal.json alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from droid_jax.report.style import AFTER, BEFORE, MUTED, WIDE, inline_svg, settled, styled
from droid_jax.report.text import counted, html, label, listed, percent, quantity

Result = Mapping[str, Any]
MOST_ALTERNATIVES = 3
MOST, MOST_PAIRS, MOST_NAMES = 6, 3, 3  # effects or parameters, pairs, and recordings that a sentence lists
FAMILIAR_UNITS = ("N m", "N", "kg", "m", "rad", "s")  # of the effects that the first sentence prefers
NEAR_MINIMUM = 2.0  # times the minimum effect size: effects found below it are counted apart
WORTH_MENTION = 1.1  # times smaller sizes, from which a sentence recommends a change


def rehearsal_page(result: Result) -> str:
    """HTML of a rehearsal from the content of its JSON file."""
    figure = Markup(inline_svg(settled(smallest_figure(result)), "sizes"))
    return html(
        "rehearsal.html.jinja",
        result=result,
        recordings=motions_of(result),
        sentences=rehearsal_sentences(result),
        parameters=parameter_rows(result),
        effects=effect_rows(result),
        noise=noise_rows(result),
        helps=help_rows(result),
        how=how_sentences(result),
        full=full_rows(result),
        figure=figure,
    )


def motions_of(result: Result) -> str:
    """Names of the recordings; of many, their number and the first and last name."""
    names = list(result["recordings"])
    return (
        listed(names) if len(names) <= MOST_NAMES else f"{counted(len(names), 'recording')}, {names[0]} to {names[-1]}"
    )


def best_of(result: Result) -> list[dict[str, Any]]:
    """For each effect and place, the coefficient found at the smallest multiple of its minimum effect size."""
    best: dict[tuple[str, str], dict[str, Any]] = {}
    for entry in result["effects"]:
        key = (entry["effect"], entry["location"])
        if key not in best or _multiple(entry) < _multiple(best[key]):
            best[key] = entry
    return sorted(best.values(), key=lambda e: (e["location"], _multiple(e), e["effect"]))


def _multiple(entry: Mapping[str, Any]) -> float:
    """Smallest size over the minimum effect size, or over the bound where there is no minimum."""
    if entry["smallest"] is None:
        return float("inf")
    return entry["smallest"] / (entry["minimum"] or entry["bound"])


def effect_rows(result: Result) -> list[tuple[str, ...]]:
    """Effect, place, smallest size, the test that limits it, and the effects it is confused with; sorted by place."""
    rows = []
    for e in best_of(result):
        size = "not found" if e["smallest"] is None else quantity(e["smallest"], e["unit"], 2)
        size = size if _sure(e) else f"{size}, doubtful"
        rows.append((label(e["effect"]), label(e["location"]), size, e["limit"], _alternatives(e)))
    return rows


def _alternatives(entry: Mapping[str, Any]) -> str:
    said = []
    law = entry.get("law") or {}
    if law.get("other"):
        other = law["other"]
        why = "beyond small sizes" if law["law"] == "the library's" else "with another law"
        said.append(f"{_thing(other)} ({why})")
    for other in entry["taken_for"][:MOST_ALTERNATIVES]:
        name = f"{label(other['effect']).lower()} at {label(other['location']).lower()}"
        below = other["below"]
        said.append(f"{name} (at any size)" if below is None else f"{name} (below {quantity(below, entry['unit'], 2)})")
    more = len(entry["taken_for"]) - MOST_ALTERNATIVES
    return ", ".join(said) + (f" and {more} more" if more > 0 else "")


def parameter_rows(result: Result) -> list[tuple[str, ...]]:
    """Name, posterior width as a share of the prior's, recovered or not, correlated parameters; without nuisances."""
    return [
        (
            label(p["name"]),
            percent(min(p["shrinkage"], 1.0)),
            "yes" if p["recovered"] else "no",
            listed([f"{label(n).lower()} ({c:+.2f})" for n, c in p["partners"]]),
        )
        for p in result["parameters"]
        if not p["nuisance"]
    ]


def noise_rows(result: Result) -> list[tuple[str, ...]]:
    """Channel, column, noise of one sample (standard deviation), its source."""
    return [
        (n["channel"].replace("_", " "), label(n["column"]), quantity(n["deviation"], n["unit"], 2), n["source"])
        for n in result["how"]["noise"]
    ]


def help_rows(result: Result) -> list[tuple[str, ...]]:
    """The change, the factor by which sizes shrink, and how many more effects and parameters are found."""
    return [
        (
            h["what"],
            f"{h['times_smaller']:.2f}",
            f"{h['newly_found'] - h['lost']:+d}",
            f"{h['recovered_more']:+d}",
        )
        for h in result["helps"]
    ]


def full_rows(result: Result) -> list[tuple[str, ...]]:
    """Of the complete rehearsals: effect, place, number found at each size, effects named instead, hidden law."""
    rows = []
    for e in result.get("full", {}).get("effects", ()):
        unit = next((q["unit"] for q in result["effects"] if q["coefficient"] == e["coefficient"]), "-")
        sizes = ", ".join(f"{quantity(s['size'], unit, 2)}: {s['found']} of {s['cases']}" for s in e["sizes"])
        law = "the library's" if e["same_law"] else "the synthetic robot's"
        rows.append((label(e["effect"]), label(e["location"]), sizes, ", ".join(e["taken_for"]), law))
    return rows


def rehearsal_sentences(result: Result) -> list[str]:
    """Sentences that the user can act on, the most important first."""
    best = best_of(result)
    promise = result["how"]["rehearsal"].get("promise", 1.0)
    found = [e for e in best if e["smallest"] is not None and _sure(e)]
    promised = [e for e in found if promise * e["smallest"] <= e["bound"]]
    doubtful = [e for e in best if e["smallest"] is not None and not _sure(e)]
    lost = [e for e in best if e["smallest"] is None]
    out = []
    if promised:
        ranked = sorted([e for e in promised if e["unit"] in FAMILIAR_UNITS] or promised, key=_multiple)
        first, last = next((e for e in ranked if e["unit"] == "N m"), ranked[0]), ranked[-1]
        sizes = [quantity(promise * e["smallest"], e["unit"], 2) for e in (first, last)]
        sentence = f"With this motion {_thing(first)} would surely be found from {sizes[0]}"
        if last is not first:
            sentence += f", {_thing(last)} only from {sizes[1]}"
        out.append(f"{sentence}.")
    else:
        out.append("With this motion no effect would surely be found.")
    out += _help(result)
    near = [e for e in found if _multiple(e) <= NEAR_MINIMUM]
    out.append(
        f"Of {counted(len(best), 'effect')}, counted at each place, {len(near)} would be found below "
        f"{NEAR_MINIMUM:g} times the minimum effect size, {len(found) - len(near)} only when larger, "
        f"{len(lost)} at no size within bounds" + (f"; {len(doubtful)} doubtful." if doubtful else ".")
    )
    if doubtful:
        out.append(f"These would be seen, but probably not named correctly: {_doubts(doubtful)}.")
    if at_bounds := [e for e in found if e not in promised]:
        out.append(f"Only close to the bounds of the search, and so not surely: {_by_effect(at_bounds, best)}.")
    if lost:
        out.append(f"At no size: {_by_effect(lost, best)}.")
    if alike := _alike(found):
        out.append(f"In this motion these act alike, and the search will name both: {alike}.")
    main = [p for p in result["parameters"] if not p["nuisance"]]
    missed = [label(p["name"]).lower() for p in main if not p["recovered"]]
    out.append(
        f"{counted(len(main) - len(missed), 'parameter')} of {len(main)} would be recovered"
        + (f"; not {listed(missed[:MOST])}{' and others' if len(missed) > MOST else ''}." if missed else ".")
    )
    return out


def _help(result: Result) -> list[str]:
    """A sentence about the most helpful change; none where no change was tried."""
    if not result["helps"]:
        return []
    h = result["helps"][0]
    if not (h["times_smaller"] > WORTH_MENTION or h["newly_found"] > h["lost"] or h["recovered_more"] > 0):
        return ["More repeats, other channels or a faster motion would help little."]
    more = [f"sizes {h['times_smaller']:.1f} times smaller"] if h["times_smaller"] > WORTH_MENTION else []
    if h["newly_found"] > h["lost"]:
        more.append(f"{counted(h['newly_found'] - h['lost'], 'more effect')} found")
    if h["recovered_more"] > 0:
        more.append(f"{counted(h['recovered_more'], 'more parameter')} recovered")
    return [f"What would help most: {h['what']} ({', '.join(more)})."]


def _sure(entry: Mapping[str, Any]) -> bool:
    return bool((entry.get("law") or {"sure": True})["sure"])


def _doubts(entries: list[dict[str, Any]]) -> str:
    said = []
    for e in entries[:MOST]:
        other = (e.get("law") or {}).get("other")
        said.append(_thing(e) + (f" (more like {_thing(other)})" if other else ""))
    return listed(said) + (" and others" if len(entries) > MOST else "")


def _by_effect(entries: list[dict[str, Any]], every: list[dict[str, Any]]) -> str:
    """Effects with their places: "encoder offset at 2 of 7 places, opening check at door"."""
    said = []
    for effect in dict.fromkeys(e["effect"] for e in entries):
        mine, of = ([e for e in some if e["effect"] == effect] for some in (entries, every))
        several = f"{label(effect).lower()} at {len(mine)} of {len(of)} places"
        said.append(several if len(of) > 1 else _thing(mine[0]))
    return listed(said[:MOST]) + (" and others" if len(said) > MOST else "")


def _alike(found: list[dict[str, Any]]) -> str:
    pairs = dict[frozenset[str], str]()
    for e in found:
        for other in e["taken_for"]:
            if other["below"] is None:
                both = frozenset((_thing(e), _thing(other)))
                pairs.setdefault(both, f"{_thing(e)} as {_thing(other)}")
    return "; ".join(list(pairs.values())[:MOST_PAIRS]) + (" and others" if len(pairs) > MOST_PAIRS else "")


def how_sentences(result: Result) -> list[str]:
    """Sentences about how the rehearsal was computed."""
    how = result["how"]
    rows = counted(how["repeats"], "repeat") if how["repeats"] else f"{how['blocks']} blocks of time"
    share = how["rehearsal"]["share"]
    out = [
        f"Compared: {listed([c.replace('_', ' ') for c in how['compared']])}, {rows} in each part.",
        f"Found means in {share:.0%} of {how['rehearsal']['draws']} drawn noises: the score test over "
        f"{how['directions']} coefficients has p < {how['significance']:g}, and the validation test p < "
        f"{how['confirmation']:g}.",
        "The residual is assumed to be linear in parameters and effects.",
        "Then each effect was simulated at the size that is found. An effect whose law has a shape was also simulated "
        "with the law of the synthetic robot. Doubtful: the library's effect explains less than "
        f"{percent(how['rehearsal'].get('known', 0.5))} of that residual, or another effect explains clearly more.",
        f"The first sentence adds a factor of {how['rehearsal'].get('promise', 1.0):g} to the sizes of the table.",
        f"Recovered means that the posterior width is less than {percent(how['recovered_below'])} of the prior's.",
    ]
    if not result.get("full"):
        out.append("Nothing was fitted: these sizes are predictions. Complete rehearsals (--full) check them.")
    if how["simulated"]:
        out.append("Measurements are replaced by a simulation of the commands in the scene, with this noise.")
    return out


def _thing(entry: Mapping[str, Any]) -> str:
    return f"{label(entry['effect']).lower()} at {label(entry['location']).lower()}"


@styled
def smallest_figure(result: Result, width: float = WIDE) -> Figure:
    """The smallest size of each effect, over its minimum effect size; one row an effect, one mark a place.

    Args:
        result: of the rehearsal.
        width: inches.
    """
    places: dict[str, list[dict[str, Any]]] = {}
    for entry in best_of(result):
        places.setdefault(entry["effect"], []).append(entry)
    figure = Figure(figsize=(width, 0.9 + 0.22 * max(len(places), 3)), layout="constrained")
    axes = figure.subplots()
    shown = [e for some in places.values() for e in some if e["smallest"] is not None]
    far = max([_multiple(e) for e in shown], default=1.0) * 2.0
    for row, some in enumerate(places.values()):
        known = [_multiple(e) for e in some if e["smallest"] is not None]
        if known:
            axes.plot([min(known), max(known)], [row, row], color=AFTER, linewidth=1.0)
            axes.plot(known, [row] * len(known), "o", color=AFTER, markersize=4, linestyle="none")
        if len(known) < len(some):
            axes.plot([far], [row], marker=">", color=BEFORE, markersize=5, linestyle="none")
    axes.axvline(1.0, color=MUTED, linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yticks(range(len(places)), [label(name) for name in places])
    axes.invert_yaxis()
    axes.set_xlabel("smallest size that is found, times the minimum effect size (triangle: not found)")
    return figure
