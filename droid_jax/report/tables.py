"""The tables of a fit as pandas DataFrames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from droid_jax.errors import lacking
from droid_jax.files import HISTORY_TABLE, SAMPLES
from droid_jax.report.reading import Reader
from droid_jax.report.stages import needs_whole

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Frames:
    """samples: a row for each draw of the fitted Gaussian, a column for each parameter in its unit.

    history: by generation, the search's costs (best_cost, median_cost), sigma [deviations], and mean_NAME and std_NAME
    of each parameter in its unit.
    """

    samples: pd.DataFrame
    history: pd.DataFrame


def frames(folder: str | Path) -> Frames:
    """The tables in a folder of `identify`, or of `all`.

    Raises ImportError where pandas is not installed, ValueError where the folder holds no whole fit.
    """
    if told := lacking("droid_jax.frames needs", "frames", "pandas"):
        raise ImportError(told)
    import pandas as pd

    folder = Path(folder)
    at = next((f for f in (folder, folder / "identify") if (f / SAMPLES).is_file()), folder)
    needs_whole(at)
    try:
        return Frames(pd.read_csv(at / SAMPLES), pd.read_csv(at / HISTORY_TABLE, index_col="generation"))
    except (OSError, ValueError) as error:
        raise Reader("identify").fault(f"{at} holds no tables of a fit ({error})") from None
