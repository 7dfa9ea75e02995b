"""Numbers, names and units as text, and the templates that put them into sentences and pages."""

from __future__ import annotations

import functools
import math
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

# Words before "joint" that name the arm as a whole: its number alone identifies a joint.
ARM = re.compile(r"panda|fr3|fer|(lbr_)?iiwa\d*|lbr|gen3|kinova|xarm\d*|ur\d+e?")
IDENTIFIER = re.compile(r"\b\w+_\w+(\[\w+\])?")
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")  # digits of an exponent


def label(name: str) -> str:
    """A name as a heading: "hinge_stiffness" -> "Hinge stiffness", "panda_joint3" -> "Joint 3".

    "torque_offset[panda_joint3]" -> "Torque offset, joint 3"; "thumb_joint3" stays "Thumb joint3".
    """
    indexed = re.fullmatch(r"(.+)\[(.+)\]", name)
    if indexed:
        return f"{label(indexed[1])}, {label(indexed[2]).lower()}"
    joint = re.fullmatch(r"(?:(\w+)_)?joint_?(\d+)", name)
    if joint and (joint[1] is None or ARM.fullmatch(joint[1])):
        return f"Joint {joint[2]}"
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]


def spelled(text: str) -> str:
    """A sentence with its identifiers as labels: "latch at door_hinge" -> "latch at door hinge"."""
    return IDENTIFIER.sub(lambda found: label(found[0]).lower(), text)


def significant(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits, a real minus sign, and a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    if size and not 1e-4 <= size < 1e5:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10".replace("-", "−") + str(int(exponent)).translate(RAISED)
    decimals = max(0, digits - 1 - math.floor(math.log10(size))) if size else 0
    return f"{value:.{decimals}f}".replace("-", "−")


def like(value: float | None, deviation: float) -> str:
    """A number with as many decimals as show two significant digits of its deviation."""
    if value is None or not math.isfinite(value) or not math.isfinite(deviation) or deviation <= 0:
        return significant(value)
    decimals = max(0, 1 - math.floor(math.log10(deviation)))
    if decimals > 6 or abs(value) >= 1e6:
        return significant(value)
    return f"{value:.{decimals}f}".replace("-", "−")


def percent(share: float | None) -> str:
    """A share as a whole percentage: 100 % only when it is all of it, 0 % only when it is nothing, a dash for none."""
    if share is None or not math.isfinite(100 * share):
        return "–"
    nearest = round(100 * share)
    if nearest == 100 and share < 1.0:
        nearest = 99
    if nearest == 0 and share > 0.0:
        return "< 1 %"
    return f"{nearest} %".replace("-", "−")


def unit_text(unit: str) -> str:
    """ "N m s^2/rad^2" -> "N m s²/rad²"; nothing for a number without a unit ("-")."""
    return "" if unit == "-" else unit.replace("^2", "²").replace("^3", "³")


def quantity(value: float | None, unit: str, digits: int = 3) -> str:
    """(0.7213, "N m") -> "0.721 N m"."""
    return f"{significant(value, digits)} {unit_text(unit)}".rstrip()


def listed(names: Sequence[str]) -> str:
    """ "a", "a and b", "a, b and c"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def counted(count: int, thing: str) -> str:
    """ "1 repeat", "2 repeats"."""
    return f"{count} {thing}{'' if count == 1 else 's'}"


def unbroken(text: str) -> str:
    """A text of which no line ends between a number and "N m" or "%"; Markup stays Markup."""
    return type(text)(re.sub(r"(?<=\d) (?=N m|%)", "\u00a0", str(text)).replace("N m", "N\u00a0m"))


def speak(text: str, robot: str) -> str:
    """A text of a file: "robot" becomes "synthetic robot" where a simulation was measured."""
    if robot == "robot":
        return text
    return re.sub(r"(?<!ynthetic )\b([rR])obot", lambda m: f"{'S' if m[1] == 'R' else 's'}ynthetic robot", text)


def oneline(text: str) -> str:
    """A text with single spaces."""
    return type(text)(" ".join(str(text).split()))


def nested(html: str) -> Markup:
    """A part of a page with several: its headings one level deeper."""
    return Markup(re.sub(r"(</?h)([2-5])\b", lambda found: f"{found[1]}{int(found[2]) + 1}", html))


FILTERS = {
    **{"number": significant, "like": like, "percent": percent, "label": label, "spelled": spelled, "listed": listed},
    **{
        "unit": unit_text,
        "counted": counted,
        "unbroken": unbroken,
        "speak": speak,
        "nested": nested,
        "oneline": oneline,
        "quantity": quantity,
    },
    "quote": lambda path: shlex.quote(str(path)),
}


@functools.cache
def _environment(html: bool) -> jinja2.Environment:
    """The templates of templates/, escaped for HTML or not."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=html,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= FILTERS
    return environment


def html(template: str, **context: Any) -> str:
    """A page; every value is escaped."""
    return _environment(True).get_template(template).render(context)


def lines(template: str, **context: Any) -> list[str]:
    """Lines for a terminal, with single spaces; empty ones are left out."""
    text = _environment(False).get_template(template).render(context)
    return [" ".join(line.split()) for line in text.splitlines() if line.strip()]
