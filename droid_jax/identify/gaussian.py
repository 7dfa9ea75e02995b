"""The Gaussian over parameters, the result of an identification that training and the report use.

A `Gaussian` is a normal distribution in search or in physical coordinates.  In search coordinates (see
`droid_jax.model.parameters`) a log-scaled parameter is log-normal in its unit.  A `Gaussian` also holds the rule that
set its width, because covariances of different origin mean different things.  That of CMA-ES, for example, shrinks with
every generation and is no posterior.

Bounds.  Rows with a linearly scaled parameter outside its bounds (any parameter in physical coordinates) are drawn
again, as the paper redraws negative values.  If hardly any row is inside, Gibbs sampling draws from the same
distribution (`identify.truncated_normal`).  A log-scaled parameter in search coordinates is clipped by its map instead,
so that a bound of exactly zero holds the probability beyond it.

File format (JSON, version 2)::

    {"format": "droid_jax.gaussian", "version": 2, "coordinates": "search" | "physical",
     "rule": str, "mean": [D], "cov": [D][D],
     "space": [{"name", "unit", "mean", "std", "low", "high", "nuisance", "group",
                "scaling": "linear" | "log", "log_offset", "width": number | null,
                "writes": [{"field", "index": [...], "mode", "gain", "offset", "element"}]}]}
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast, get_args

import msgspec
import numpy as np
from scipy import special  # pyright: ignore[reportMissingTypeStubs]

from droid_jax.arguments import instance, name, note, number, numeric, one_of, path_of, several, shown, whole
from droid_jax.identify.truncated_normal import gibbs, quantiles
from droid_jax.model.parameters import Mode, Parameter, Role, Scaling, Space, Write, role_in_theta
from droid_jax.read_json import read_json, typed
from droid_jax.storage import write_json

Coordinates = Literal["search", "physical"]

FORMAT = "droid_jax.gaussian"
VERSION = 2
MIN_ACCEPTANCE = 1e-3  # share of draws inside the bounds below which Gibbs sampling replaces redraws
MOMENT_POINTS = 20_001  # equal-probability points behind physical_mean and physical_std


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A normal distribution over the parameters of a space.

    Attributes:
        space: meaning of the entries.
        mean: [D] in `coordinates`.
        cov: [D, D] in `coordinates`, symmetric and positive semi-definite.
        rule: how the width was set, e.g. "prior", "cma-es covariance".
        coordinates: "search" (unitless) or "physical" (each entry in its parameter's unit).

    Raises:
        ValueError: a wrong shape, a number that is not finite, or a cov that is no covariance.
    """

    space: Space
    mean: np.ndarray
    cov: np.ndarray
    rule: str
    coordinates: Coordinates = "search"

    def __post_init__(self) -> None:
        instance(self.space, "space", Space)
        note(self.rule, "rule")
        one_of(self.coordinates, "coordinates", get_args(Coordinates))
        d = len(self.space)
        mean, cov = _numbers("mean", self.mean, (d,)), _numbers("cov", self.cov, (d, d))
        _check_covariance(cov)
        for of, array in (("mean", mean), ("cov", (cov + cov.T) / 2)):
            array.setflags(write=False)
            object.__setattr__(self, of, array)

    def sample(self, seed: int | np.random.Generator, n: int) -> np.ndarray:
        """Return n draws [n, D] in physical units, all inside the bounds.

        seed: the same seed gives the same rows; or a generator.
        """
        n = whole(n, "n, the number of draws", least=0)
        rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(whole(seed, "seed", least=0))
        low, high = self._box()
        out, filled, drawn = np.empty((n, len(self.space))), 0, 0
        while filled < n:
            draws = self._draw(rng, max(n - filled, 256))
            inside = draws[np.all((draws >= low) & (draws <= high), axis=-1)][: n - filled]
            out[filled : filled + len(inside)] = inside
            filled, drawn = filled + len(inside), drawn + len(draws)
            if drawn >= 20_000 and filled < MIN_ACCEPTANCE * drawn:
                out[filled:] = gibbs(rng, n - filled, self.mean, self.cov, low, high)
                break
        return self._to_physical(out)

    def log_density(self, values: np.ndarray) -> np.ndarray:
        """Return the log density [...] at physical values [..., D], per unit of every parameter.

        It is -inf outside the bounds.  Inside it is the density of the untruncated normal.

        Raises:
            ValueError: values of another shape, or a singular `cov`.
        """
        values = numeric(values, "values")
        if values.shape[-1:] != (len(self.space),):
            raise ValueError(f"values must have shape [..., {len(self.space)}], got {values.shape}")
        try:
            root = np.linalg.cholesky(self.cov)
        except np.linalg.LinAlgError:
            raise ValueError("cov is singular and has no density; take marginal() of what varies") from None
        inside = np.all((values >= self.space.low) & (values <= self.space.high), axis=-1)
        safe = np.clip(values, self.space.low, self.space.high)
        y, log_slope = (safe, 0.0) if self.coordinates == "physical" else self._search_and_slope(safe)
        white = np.linalg.solve(root, (y - self.mean)[..., None])[..., 0]
        constant = np.log(np.diag(root)).sum() + 0.5 * len(self.space) * math.log(2 * math.pi)
        return np.where(inside, -0.5 * (white**2).sum(axis=-1) - constant + log_slope, -np.inf)

    def quantiles(self, q: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return marginal quantiles [Q, D] in physical units, for levels q [Q] between 0 and 1.

        A marginal is truncated (or clipped) at its own bounds only.  This is exact unless the bounds of another,
        strongly correlated parameter reject rows too.

        Raises:
            ValueError: levels outside of 0 to 1.
        """
        q = numeric(q, "q")
        if q.ndim != 1 or not np.all((q >= 0) & (q <= 1)):
            raise ValueError(f"q must be a list of levels between 0 and 1, got {q}")
        return self._to_physical(self._in_coordinates(q))

    def interval(self, level: float = 0.9) -> tuple[np.ndarray, np.ndarray]:
        """Return the central marginal interval of the normal, cut at the bounds: (low [D], high [D]) in physical units.

        It holds at least `level` of the probability inside the bounds, and always `centre`, the value that a fit
        reports.  Where the normal extends beyond a bound the interval ends there, since equal tails inside the bounds
        would exclude a value on a bound.  If the mean is outside of the bounds, the interval begins at the nearest one.

        Raises:
            ValueError: a level that is not between 0 and 1.
        """
        level = number(level, "level", above=0, below=1)
        half = float(special.ndtri((1 + level) / 2)) * np.sqrt(np.diag(self.cov))
        ends = np.stack([self.mean - half, self.mean + half])
        low, high = self._box()
        from_low, from_high = self.mean < low, self.mean > high
        if np.any(from_low | from_high):
            lower, upper = self._in_coordinates([1 - level, level])
            ends = np.where(from_low, [low, upper], np.where(from_high, [lower, high], ends))
        ends = self._to_physical(ends)
        return ends[0], ends[1]

    @property
    def centre(self) -> np.ndarray:
        """[D] the fitted values: the mean in physical units, clipped to the bounds.

        For a log-scaled parameter this is the median.  `physical_mean` is larger if the data do not constrain such a
        parameter: 5.9 times for the hinge stiffness of `door_space`'s prior.
        """
        values = self.space.from_search(self.mean) if self.coordinates == "search" else self.mean
        return np.clip(values, self.space.low, self.space.high)

    @cached_property
    def physical_mean(self) -> np.ndarray:
        """[D] marginal means in physical units, over a grid of quantiles of equal probability."""
        return self._grid.mean(axis=0)

    @cached_property
    def physical_std(self) -> np.ndarray:
        """[D] marginal deviations in physical units, over the same grid as `physical_mean`."""
        return self._grid.std(axis=0)

    def marginal(self, names: Iterable[str]) -> Gaussian:
        """Return the marginal of these parameters, in the given order."""
        names = several(name)(names, "names")
        index = [self.space.index(n) for n in names]
        cov = self.cov[np.ix_(index, index)]
        return Gaussian(self.space.select(names), self.mean[index], cov, self.rule, self.coordinates)

    def to_json(self) -> dict[str, Any]:
        """Return the content of the JSON file that the module's docstring describes."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "coordinates": self.coordinates,
            "rule": self.rule,
            "mean": self.mean.tolist(),
            "cov": self.cov.tolist(),
            "space": space_to_json(self.space),
        }

    def save(self, path: str | Path) -> None:
        """Write the JSON file that the module's docstring describes, atomically."""
        write_json(Path(path), self.to_json())

    @cached_property
    def _grid(self) -> np.ndarray:
        """[MOMENT_POINTS, D] physical values, quantiles of equal probability of each marginal."""
        return self.quantiles((np.arange(MOMENT_POINTS) + 0.5) / MOMENT_POINTS)

    def _in_coordinates(self, q: Sequence[float] | np.ndarray) -> np.ndarray:
        """[Q, D] marginal quantiles at levels q [Q] inside the box of `_box`, in `coordinates`."""
        q = np.asarray(q, dtype=np.float64)
        columns = [
            _truncated_quantiles(q, m, s, a, b)
            for m, s, a, b in zip(self.mean, np.sqrt(np.diag(self.cov)), *self._box(), strict=True)
        ]
        return np.stack(columns, axis=-1)

    def _draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """[n, D] draws in `coordinates`, without bounds."""
        variances, axes = np.linalg.eigh(self.cov)
        return self.mean + (rng.standard_normal((n, len(self.mean))) * np.sqrt(variances.clip(0))) @ axes.T

    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (low [D], high [D]) of draws in `coordinates`; infinite where the map clips."""
        if self.coordinates == "physical":
            return self.space.low, self.space.high
        return redraw_box(self.space)

    def _to_physical(self, y: np.ndarray) -> np.ndarray:
        """[..., D] in `coordinates` -> [..., D] physical values inside the bounds."""
        if self.coordinates == "search":
            return self.space.from_search(y)
        return np.clip(y, self.space.low, self.space.high)

    def _search_and_slope(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Search coordinates [..., D] of physical values, and log |dx/dv| summed over D, [...]."""
        slopes = [
            np.full(values.shape[:-1], -math.log(p.std))
            if p.scaling is Scaling.LINEAR
            else -np.log((values[..., i] + p.log_offset) * p.log_width)
            for i, p in enumerate(self.space.parameters)
        ]
        return self.space.to_search(values), np.sum(slopes, axis=0)


def prior(space: Space) -> Gaussian:
    """Return the prior of a space: uncorrelated, of one deviation per parameter, in search coordinates."""
    return Gaussian(space, space.to_search(space.mean), np.eye(len(space)), rule="prior")


def load_gaussian(path: str | Path) -> Gaussian:
    """Read a file written by `Gaussian.save`.

    Args:
        path: of the file, as gaussian.json of a run's folder.

    Returns:
        The distribution.

    Raises:
        ValueError: there is no such file, or something in it is wrong; the message names both.
    """
    path = path_of(path, "the path of a Gaussian")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; a run keeps its Gaussian in gaussian.json there")
    try:
        given = read_json(path)
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file") from None
    content: dict[str, Any] = cast(dict[str, Any], given) if isinstance(given, dict) else {}
    if content.get("format") != FORMAT:
        raise ValueError(f"{path}: expected a JSON object with format {FORMAT!r}")
    if content.get("version") != VERSION:
        raise ValueError(f"{path}: expected version {VERSION}, got {shown(content.get('version'))}")
    file = typed(content, _File, str(path))
    try:
        space = space_of(file.space)
        return Gaussian(space, matrix("mean", file.mean), matrix("cov", file.cov), file.rule, file.coordinates)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def space_to_json(space: Space) -> list[dict[str, Any]]:
    """Return a space as JSON values, one object per parameter with its writes."""
    out: list[dict[str, Any]] = []
    for p in space.parameters:
        entry = asdict(p) | {"scaling": p.scaling.value, "role": p.role.value}
        if p.role is (Role.OTHER if p.writes else role_in_theta(p.name)):
            del entry["role"]  # it follows from the name; files of earlier versions have no roles
        entry["writes"] = [asdict(w) | {"mode": w.mode.value, "index": list(w.index)} for w in p.writes]
        out.append(entry)
    return out


class WriteEntry(msgspec.Struct, forbid_unknown_fields=True):
    """A write of a parameter in a file; files of earlier versions have no offset and no element."""

    field: str
    index: list[int]
    mode: Mode
    gain: float
    offset: float = 0.0
    element: str = ""


class ParameterEntry(msgspec.Struct, forbid_unknown_fields=True):
    """A parameter in a file; the role is missing if it follows from the name."""

    name: str
    unit: str
    mean: float
    std: float
    low: float
    high: float
    writes: list[WriteEntry]
    nuisance: bool
    group: str
    scaling: Scaling
    log_offset: float
    width: float | None
    role: Role = Role.OTHER


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The content of a file of `Gaussian.save`."""

    format: str
    version: int
    coordinates: Coordinates
    rule: str
    mean: list[float]
    cov: list[list[float]]
    space: list[ParameterEntry]


def space_of(entries: Iterable[ParameterEntry]) -> Space:
    """Return the space of a file's entries."""
    return Space(tuple(_parameter(entry) for entry in entries))


def _parameter(entry: ParameterEntry) -> Parameter:
    fields = msgspec.structs.asdict(entry)
    try:
        writes: list[dict[str, Any]] = [msgspec.structs.asdict(w) | {"index": tuple(w.index)} for w in entry.writes]
        fields["writes"] = tuple(Write(**w) for w in writes)
    except ValueError as error:
        raise ValueError(f"parameter {shown(entry.name)}: {error}") from None
    return Parameter(**fields)


def matrix(name: str, rows: list[Any]) -> np.ndarray:
    """Return the rows of a file as an array; ValueError if their lengths differ."""
    if len({len(cast(list[Any], row)) for row in rows if isinstance(row, list)}) > 1:
        raise ValueError(f"{name} must have rows of one length")
    return np.array(rows, dtype=np.float64)


def redraw_box(space: Space) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds (low [D], high [D]) in search coordinates, outside of which a draw is drawn again.

    They are the parameter's bounds if it is scaled linearly, and infinite if it is log-scaled, since its map clips.
    """
    linear = np.array([p.scaling is Scaling.LINEAR for p in space.parameters])
    low, high = space.to_search(space.low), space.to_search(space.high)
    return np.where(linear, low, -np.inf), np.where(linear, high, np.inf)


def _numbers(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A float64 copy of an array; ValueError for another shape or entries that are not finite."""
    array = numeric(values, f"{name} [{', '.join(map(str, shape))}]").copy()
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has {int((~np.isfinite(array)).sum())} entries that are not finite")
    return array


def _check_covariance(cov: np.ndarray) -> None:
    """Raise ValueError unless cov [D, D] is symmetric and positive semi-definite up to rounding."""
    scale = np.sqrt(np.abs(np.diag(cov)))
    tolerance = 1e-6 * np.outer(scale, scale) + 1e-300
    if not np.all(np.abs(cov - cov.T) <= tolerance):
        raise ValueError("cov must be symmetric")
    # Checked as a correlation matrix: variances of parameters in different units differ by decades.
    unit = np.where(scale > 0, scale, 1.0)
    lowest = float(np.linalg.eigvalsh((cov + cov.T) / 2 / np.outer(unit, unit))[0])
    if lowest < -1e-6 * len(cov):
        raise ValueError(f"cov must be positive semi-definite; its correlation has an eigenvalue {lowest:.3g}")


def _truncated_quantiles(q: np.ndarray, mean: float, std: float, low: float, high: float) -> np.ndarray:
    """[Q] quantiles of a normal truncated to [low, high]; with std 0 all of them are the mean."""
    if std == 0:
        return np.full(q.shape, mean)
    return mean + std * quantiles(q, np.asarray((low - mean) / std), np.asarray((high - mean) / std))
