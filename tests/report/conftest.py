"""What the tests of the report share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

from droid_jax.report import style


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made, and neither saved nor put into the page, which would take seconds."""

    def made_only(folder: Path, stem: str, title: str, make: Callable[..., Figure], *args: Any) -> style.Drawing:
        assert isinstance(make(*args, width=style.WIDE), Figure)
        return style.Drawing(folder / "figures", stem, title, Markup(""), Markup(""))

    monkeypatch.setattr(style, "drawing", made_only)
