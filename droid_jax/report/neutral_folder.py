"""fitted.json and the patch beside it, as the page of a fit shows them."""

from __future__ import annotations

from pathlib import Path

from msgspec import Struct, field

from droid_jax.files import FITTED_JSON
from droid_jax.report.reading import Reader


class ChangeEntry(Struct, frozen=True, kw_only=True):
    """A number of the MJCF that the fit changed; interval: 90 %, None where no single parameter says it."""

    element: str
    name: str
    attribute: str
    index: int
    before: float
    after: float
    interval: tuple[float, float] | None = None
    unit: str = ""
    file: str = ""
    line: int = 0
    origin: str = ""


class MjcfEntry(Struct, frozen=True, kw_only=True):
    """The fitted MJCF: its file, whether it is the user's own with numbers changed, and if not why."""

    file: str | None = None
    error: str = ""
    in_place: bool = False
    reason: str = ""
    changes: list[ChangeEntry] = field(default_factory=list)


class AxisEntry(Struct, frozen=True):
    """The variable of a law's table."""

    name: str
    unit: str
    nodes: list[float]


class LawEntry(Struct, frozen=True, kw_only=True):
    """A law that MJCF cannot express."""

    effect: str
    description: str
    acts: str
    joint: str
    unit: str
    error: float
    axes: list[AxisEntry]


class LackingEntry(Struct, frozen=True):
    """A parameter for which the MJCF has no number."""

    parameter: str
    why: str


class EngineEntry(Struct, frozen=True, kw_only=True):
    """Difference of plain C MuJoCo from the replay of a recording at the fitted values."""

    channel: str
    unit: str
    parity_rms: float
    parity_largest: float | None = None
    parity_angle: float | None = None


class Neutral(Struct, frozen=True, kw_only=True):
    """The parts of fitted.json that the page shows; patch: text of the patch file."""

    mjcf: MjcfEntry
    laws: list[LawEntry] = field(default_factory=list)
    not_in_mjcf: list[LackingEntry] = field(default_factory=list)
    engines: dict[str, EngineEntry] = field(default_factory=dict)
    patch: str = ""


def read_neutral(folder: Path, read: Reader) -> Neutral | None:
    """The fitted MJCF of a folder of results; None where an older version wrote no such file."""
    if not (folder / FITTED_JSON).is_file():
        return None
    content = read.json(folder / FITTED_JSON)
    content.pop("patch", None)
    found = read.typed(content, Neutral, str(folder / FITTED_JSON))
    patch = folder / f"{Path(found.mjcf.file or 'none').stem}.patch"
    text = patch.read_text(encoding="utf-8", errors="replace") if found.mjcf.in_place and patch.is_file() else ""
    return Neutral(mjcf=found.mjcf, laws=found.laws, not_in_mjcf=found.not_in_mjcf, engines=found.engines, patch=text)
