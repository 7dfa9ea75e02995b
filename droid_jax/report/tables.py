"""The tables of a fit as pandas DataFrames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from droid_jax.arguments import path_of, said
from droid_jax.errors import lacking, named
from droid_jax.files import HISTORY_TABLE, SAMPLES
from droid_jax.report.reading import Reader
from droid_jax.report.stages import needs_whole
from droid_jax.storage import check_size

if TYPE_CHECKING:
    import pandas as pd

COSTS = ("best_cost", "median_cost", "sigma")  # columns of the history's table
MOST_BYTES = 256 * 2**20  # of a table


@dataclass(frozen=True, eq=False)
class Frames:
    """The tables of a fit.

    samples: a row for each draw of the fitted Gaussian, a column for each parameter in its unit.
    history: by generation, the search's costs (best_cost, median_cost), sigma [deviations], and mean_NAME and std_NAME
        of each parameter in its unit.
    """

    samples: pd.DataFrame
    history: pd.DataFrame


def frames(folder: str | Path) -> Frames:
    """Read the tables of a fit as pandas data frames.

    Args:
        folder: of a finished `identify`, or of `all`.

    Returns:
        Samples of the Gaussian, each parameter in its unit, and the search's history by generation.

    Raises:
        ImportError: pandas is not installed.
        ValueError: the folder holds no complete fit.
    """
    if missing := lacking("droid_jax.frames needs", "frames", "pandas"):
        raise ImportError(missing)
    folder = path_of(folder, "the folder of a fit")
    at = next((f for f in (folder, folder / "identify") if (f / SAMPLES).is_file()), folder)
    needs_whole(at)
    read = Reader("identify")
    try:
        samples, history = (_table(at / name) for name in (SAMPLES, HISTORY_TABLE))
    except (OSError, ValueError) as error:
        raise read.fault(f"{at} holds no tables of a fit ({said(error)})") from None
    expected = ["generation", *COSTS, *(f"{of}_{name}" for of in ("mean", "std") for name in samples.columns)]
    if list(history.columns) != expected:
        raise read.fault(f"{at / HISTORY_TABLE} must have the columns {named(expected)}")
    return Frames(samples, history.set_index("generation"))


def _table(path: Path) -> pd.DataFrame:
    """A table of numbers with named columns; ValueError or OSError where there is none."""
    import pandas as pd

    check_size(path, MOST_BYTES)
    table = pd.read_csv(path)
    if not isinstance(table.index, pd.RangeIndex):  # pandas uses surplus cells as row names
        raise ValueError(f"{path}: its rows are longer than its header")
    numeric = table.select_dtypes("number").columns
    if other := [str(column) for column in table.columns if column not in numeric]:
        raise ValueError(f"{path}: the columns {named(other)} do not hold numbers")
    if table.isna().to_numpy().any():
        raise ValueError(f"{path}: has empty cells")
    return table
