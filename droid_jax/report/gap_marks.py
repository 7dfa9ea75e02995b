"""What a search says of the effects that it found: where the mark of each should appear, and what looks like it."""

from __future__ import annotations

from droid_jax.report.gap_folder import Gap
from droid_jax.report.gap_words import BETWEEN, effect_words, readable
from droid_jax.report.words import listed


def marks(gap: Gap) -> list[tuple[str, bool, str]]:
    """What to look for: effects of the answer by name, whether these do only as well as others, and their mark.

    What lies at several places is told of once.
    """
    named = gap.found["effects"]
    tied = [part for rivals in gap.found["indistinguishable"] for model in rivals for part in model.split(BETWEEN)]
    alike: dict[tuple[bool, str], list[str]] = {}
    for name in dict.fromkeys([*named, *tied]):
        if text := _mark(gap, name, name not in named):
            alike.setdefault((name not in named, text), []).append(effect_words(name))
    return [(listed(names).capitalize(), rival, text) for (rival, text), names in alike.items()]


def _mark(gap: Gap, name: str, rival: bool) -> str:
    """ "Its mark: the first degrees of opening. Can look like: drag.", and before it of a rival what it is."""
    effect = name.partition(" at ")[0]
    if effect not in gap.about:
        return ""
    one = gap.about[effect]
    others = ", ".join(effect_words(other) for other in one["confused_with"])
    said = (
        one["what"][:1].upper() + one["what"][1:] if rival else "",
        f"Its mark: {one['mark']}" if one["mark"] else "",
        f"Can look like: {others}" if others else "",
    )
    return readable(" ".join(f"{text.rstrip('.')}." for text in said if text), gap.found)
