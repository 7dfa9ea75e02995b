"""Physics parameters as one named vector: `Parameter` and `Space`.

A `Parameter` has a name, a unit, bounds, and an initial mean and deviation.  It writes fields of the MuJoCo model
(`writes`) or is one entry of `theta`, the dictionary of quantities outside the model (a time offset, a torque offset,
an effect's coefficient).  A `Space` is an ordered tuple of parameters.  A parameter vector is an array [..., D] of
physical values in that order.

Searches and Gaussians use search coordinates x [..., D], in which one unit is about one prior deviation.
`Scaling.LINEAR` is x = (v - mean) / std.  `Scaling.LOG` is x = (log(v + log_offset) - log(mean + log_offset)) / width.
It keeps positive parameters positive.  With log_offset > 0, zero can be reached (a door without friction loss).
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from droid_jax.arguments import (
    choice,
    flag,
    instances,
    mapping,
    name,
    number,
    numeric,
    set_field,
    several,
    shown,
    whole,
)

MOST_ROWS = 10**9  # largest index into a model's field
ROUNDING = 1e-6  # share of a parameter's range by which a value may exceed a bound


class Mode(enum.Enum):
    """How a value enters a model field, given the field's nominal number."""

    SET = "set"  # field = value
    NEGATIVE = "negative"  # field = -value
    SCALE = "scale"  # field = nominal * value
    DIVIDE = "divide"  # field = nominal / value
    ADD = "add"  # field = nominal + value


@dataclass(frozen=True)
class Write:
    """An assignment of a parameter's value to an entry of a model field.

    Attributes:
        field: name of an array of MjModel and mjx.Model, such as "dof_damping".
        index: numpy index into it, a tuple of integers.
        mode: how value and nominal number combine.
        gain: factor on the value, applied first (an inertia that scales with a mass uses SCALE with gain 1 / nominal
            mass).
        offset: added after the gain (a relative error e uses SCALE with offset 1).
        element: name of the MJCF element of the entry, "" if it has none; it detects parameters of another scene.
    """

    field: str
    index: tuple[int, ...]
    mode: Mode = Mode.SET
    gain: float = 1.0
    offset: float = 0.0
    element: str = dataclasses.field(default="", compare=False)

    def __post_init__(self) -> None:
        where = f"a write of {shown(self.field)}"
        set_field(self, "field", name(self.field, f"{where}: field"))
        index: Any = self.index
        if not isinstance(index, (tuple, list)) or not index:
            raise ValueError(f"{where}: index must be a tuple of whole numbers, got {shown(index)}")
        entries: list[Any] = list(index)  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
        set_field(self, "index", tuple(whole(i, f"{where}: index", least=0, most=MOST_ROWS) for i in entries))
        set_field(self, "mode", choice(self.mode, f"{where}: mode", Mode))
        set_field(self, "gain", number(self.gain, f"{where}: gain"))
        set_field(self, "offset", number(self.offset, f"{where}: offset"))
        name(self.element, f"{where}: element", empty=True)

    def new(self, nominal: Any, value: Any) -> Any:
        """The field's new number(s) for a value; numpy or jax."""
        value = value * self.gain + self.offset
        if self.mode is Mode.SET:
            return value
        if self.mode is Mode.NEGATIVE:
            return -value
        if self.mode is Mode.SCALE:
            return nominal * value
        if self.mode is Mode.DIVIDE:
            return nominal / value
        return nominal + value

    def neutral(self, nominal: Any) -> Any:
        """The value that leaves the field unchanged."""
        same = {Mode.SET: nominal, Mode.NEGATIVE: -nominal, Mode.ADD: 0.0}.get(self.mode, 1.0)
        return (same - self.offset) / self.gain


class Scaling(enum.Enum):
    """Search coordinate of a parameter: linear or logarithmic in its value (see the module's text)."""

    LINEAR = "linear"
    LOG = "log"


class Role(enum.Enum):
    """The role of a parameter, for code that treats some parameters specially.

    A replay reads parameters with roles of the first block from theta.  Their names there are the roles' values, with
    the joint in brackets if there is one for each joint (`in_theta`).
    """

    TIME_OFFSET = "time_offset"  # s, delay of the command
    TORQUE_OFFSET = "torque_offset"  # N m, constant error of a joint's torque sensor
    TORQUE_GAIN = "torque_gain"  # relative error of a joint's torque sensor
    VISCOUS = "viscous"  # N m s/rad, friction that a joint's torque sensor measures
    COULOMB = "coulomb"  # N m, likewise

    SLIDING_FRICTION = "sliding_friction"  # of a finger's contact
    TORSIONAL_FRICTION = "torsional_friction"  # likewise, m
    PAYLOAD_MASS = "payload_mass"  # kg, carried at the hand in addition to the model's masses
    OBJECT_TORQUE = "object_torque"  # N m (N for a slide), constant on the object's joint
    STANDS_FOR = "stands_for"  # replaces another parameter in recordings that say so (`Recording.known`)
    OTHER = "other"

    def in_theta(self, joint: str = "") -> str:
        """Name in theta, with the joint in brackets if one is given."""
        return f"{self.value}[{joint}]" if joint else self.value


OF_A_JOINT = (Role.VISCOUS, Role.COULOMB, Role.TORQUE_OFFSET, Role.TORQUE_GAIN)


def role_in_theta(name: str) -> Role:
    """The role of a parameter with this name in theta; OTHER if only effects read it."""
    if name == Role.TIME_OFFSET.value:
        return Role.TIME_OFFSET
    term, bracket, joint = name.partition("[")
    role = {role.value: role for role in OF_A_JOINT}.get(term, Role.OTHER)
    return role if bracket and joint.endswith("]") else Role.OTHER


@dataclass(frozen=True)
class Parameter:
    """One physics parameter.

    Attributes:
        name: unique within a space, e.g. "hinge_stiffness".
        unit: for tables and axes, e.g. "N m/rad".
        mean, std: initial Gaussian, in `unit` (Table I of the paper for the door).
        low, high: bounds, in `unit`; low <= mean <= high and low < high.
        writes: model fields that it sets; empty for a parameter in theta.
        nuisance: whether it is fitted and marginalised, but of no interest.
        group: heading in tables ("Door", "Robot", "Gripper", "Nuisance").
        scaling, log_offset: search coordinate, see the module's text.
        width: one unit of the search coordinate in log(v + log_offset) if scaling is LOG; None: from mean and std.
        role: for code that treats some parameters specially. That of a parameter in theta follows from its name.

    Raises:
        ValueError: an attribute is of the wrong type, the mean is out of bounds, or the numbers are too large or too
            small for the search coordinate.
    """

    name: str
    unit: str
    mean: float
    std: float
    low: float
    high: float
    writes: tuple[Write, ...] = ()
    nuisance: bool = False
    group: str = "Model"
    scaling: Scaling = Scaling.LINEAR
    log_offset: float = 0.0
    width: float | None = None
    role: Role = field(default=Role.OTHER, compare=False)

    def __post_init__(self) -> None:
        where = f"parameter {shown(self.name)}"
        name(self.name, f"{where}: its name")
        name(self.unit, f"{where}: unit", empty=True)
        name(self.group, f"{where}: group", empty=True)
        for key in ("mean", "std", "low", "high", "log_offset"):
            set_field(self, key, number(getattr(self, key), f"{where}: {key}"))
        set_field(self, "writes", instances(self.writes, f"{where}: writes", Write))
        set_field(self, "nuisance", flag(self.nuisance, f"{where}: nuisance"))
        set_field(self, "scaling", choice(self.scaling, f"{where}: scaling", Scaling))
        set_field(self, "role", choice(self.role, f"{where}: role", Role))
        if self.role is Role.OTHER and not self.writes:
            set_field(self, "role", role_in_theta(self.name))
        if self.width is not None:
            set_field(self, "width", number(self.width, f"{where}: width", above=0))
        if not self.low < self.high:
            raise ValueError(f"parameter {self.name!r}: low {self.low} must be below high {self.high}")
        if not self.low <= self.mean <= self.high:
            raise ValueError(
                f"parameter {self.name!r}: the start {self.mean} {self.unit} lies outside its "
                f"bounds [{self.low}, {self.high}]"
            )
        if self.std <= 0:
            raise ValueError(f"parameter {self.name!r}: std must be positive, got {self.std}")
        if self.scaling is Scaling.LOG and self.low + self.log_offset <= 0:
            raise ValueError(f"parameter {self.name!r}: log scaling needs low + log_offset > 0")
        if not (math.isfinite(self.high - self.low) and (self.scaling is Scaling.LINEAR or self._mapped())):
            raise ValueError(f"parameter {self.name!r}: its numbers are too large or too small to search among")

    def _mapped(self) -> bool:
        """Whether the logarithmic coordinate has a positive width and is finite at the bounds."""
        if not (self.high + self.log_offset < math.inf and self.log_width > 0):
            return False
        ends = (math.log((end + self.log_offset) / (self.mean + self.log_offset)) for end in (self.low, self.high))
        return all(math.isfinite(end / self.log_width) for end in ends)

    @property
    def log_width(self) -> float:
        """One unit of the search coordinate in log(v + log_offset)."""
        if self.width is not None:
            return self.width
        return math.log1p(self.std / (self.mean + self.log_offset))

    def to_search(self, value: Any) -> Any:
        """Physical value(s) -> search coordinate(s); numpy or jax."""
        if self.scaling is Scaling.LINEAR:
            return (value - self.mean) / self.std
        xp = _namespace(value)
        return (xp.log(value + self.log_offset) - math.log(self.mean + self.log_offset)) / self.log_width

    def from_search(self, x: Any) -> Any:
        """Search coordinate(s) -> physical value(s), clipped to the bounds; numpy or jax."""
        xp = _namespace(x)
        if self.scaling is Scaling.LINEAR:
            value = self.mean + self.std * x
        else:
            value = xp.exp(math.log(self.mean + self.log_offset) + self.log_width * x) - self.log_offset
        return xp.clip(value, self.low, self.high)


@dataclass(frozen=True)
class Space:
    """An ordered set of parameters, which gives a vector's entries their meaning.

    Attributes:
        parameters: [D] of unique names.

    Raises:
        ValueError: two parameters share a name, or none is given.
    """

    parameters: tuple[Parameter, ...]
    _index: dict[str, int] = field(init=False, repr=False, compare=False, hash=False, default_factory=dict[str, int])

    def __post_init__(self) -> None:
        set_field(self, "parameters", instances(self.parameters, "the parameters of a space", Parameter))
        names = [p.name for p in self.parameters]
        if not names:
            raise ValueError("a space needs at least one parameter")
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"parameter names must be unique; repeated: {', '.join(twice)}")
        self._index.update({n: i for i, n in enumerate(names)})

    def __len__(self) -> int:
        return len(self.parameters)

    def __getitem__(self, name: str) -> Parameter:
        return self.parameters[self.index(name)]

    def __add__(self, other: Space) -> Space:
        return Space(self.parameters + other.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._index)

    def index(self, name: str) -> int:
        """Index of a parameter; an unknown name raises ValueError, which lists the valid ones."""
        try:
            return self._index[name]
        except (KeyError, TypeError):
            raise ValueError(f"unknown parameter {shown(name)}; this space has: {', '.join(self.names)}") from None

    def _array(self, attribute: str) -> np.ndarray:
        return np.array([getattr(p, attribute) for p in self.parameters], dtype=np.float64)

    @property
    def mean(self) -> np.ndarray:
        """[D] initial mean, physical units."""
        return self._array("mean")

    @property
    def std(self) -> np.ndarray:
        """[D] initial deviation, physical units."""
        return self._array("std")

    @property
    def low(self) -> np.ndarray:
        """[D] lower bounds, physical units."""
        return self._array("low")

    @property
    def high(self) -> np.ndarray:
        """[D] upper bounds, physical units."""
        return self._array("high")

    @property
    def nuisance(self) -> np.ndarray:
        """[D] bool, True where a parameter is a nuisance."""
        return np.array([p.nuisance for p in self.parameters], dtype=bool)

    def select(self, names: Iterable[str]) -> Space:
        """The sub-space of these names, in the order given."""
        return Space(tuple(self[n] for n in several(name)(names, "names")))

    def of_role(self, *roles: Role) -> tuple[Parameter, ...]:
        """The parameters with one of these roles, in the space's order."""
        return tuple(p for p in self.parameters if p.role in roles)

    def with_prior(self, **prior: tuple[float, float]) -> Space:
        """A copy with other priors (mean, std) of some parameters."""
        changed = list(self.parameters)
        for parameter, pair in prior.items():
            i, given = self.index(parameter), cast(Any, pair)
            if not isinstance(given, (tuple, list)) or len(pair) != 2:
                raise ValueError(f"the prior of {parameter!r} must be its mean and deviation, got {shown(given)}")
            changed[i] = replace(changed[i], mean=pair[0], std=pair[1])
        return Space(tuple(changed))

    def linear(self) -> Space:
        """A copy with linear search coordinates, as in the paper."""
        return Space(tuple(replace(p, scaling=Scaling.LINEAR) for p in self.parameters))

    def values(self, values: dict[str, float] | None = None) -> np.ndarray:
        """[D] the means, with some entries replaced by name."""
        out = self.mean
        for parameter, value in mapping({} if values is None else values, "values").items():
            out[self.index(parameter)] = number(value, f"the value of {parameter!r}")
        return out

    def columns(self, part: Space) -> list[int]:
        """Indices in this space of another space's parameters."""
        return [self.index(n) for n in part.names]

    def embed(self, part: Space, rows: Any, values: np.ndarray | None = None) -> np.ndarray:
        """[P, D] copies of `values` [D] (None: the means) with the entries of `part` replaced by rows [P, F]."""
        out = np.tile(self.mean if values is None else values, (len(rows), 1))
        out[:, self.columns(part)] = np.asarray(rows)
        return out

    def unknown_names(self, known: Mapping[str, float | str]) -> list[str]:
        """Names in what a recording states (`Recording.known`) that are no parameters of this space, sorted."""
        names = {*known, *(value for value in known.values() if isinstance(value, str))}
        return sorted(names - {*self.names})

    def with_known(self, known: Mapping[str, float | str], values: Any) -> Any:
        """Vectors [..., D] in which known values replace those of some parameters.

        Args:
            known: parameter -> its known value, or the parameter whose value it has (`Recording.known`).
            values: [..., D].

        Raises:
            ValueError: a name is unknown, or a value is outside the parameter's bounds.
        """
        if not known:
            return values
        if unknown := self.unknown_names(known):
            raise ValueError(
                f"a recording states {', '.join(unknown)} (known), which is no parameter here: list it, give the "
                "effect that has it (--effects), or convert without --known; there are: " + ", ".join(self.names)
            )
        out = np.array(values)
        for parameter, value in known.items():
            p = self[parameter]
            if isinstance(value, str):
                out[..., self.index(parameter)] = np.asarray(values)[..., self.index(value)]
                continue
            if not p.low <= value <= p.high:
                raise ValueError(
                    f"a recording states {parameter!r} to be {value:g} {p.unit}, outside its bounds [{p.low}, {p.high}]"
                )
            out[..., self.index(parameter)] = value
        return out

    def check(self, values: np.ndarray) -> np.ndarray:
        """Values [..., D] as float64; ValueError says which entry is wrong and how.

        A value that exceeds a bound by rounding to single precision is returned as the bound.
        """
        values = numeric(values, "parameter vectors")
        if values.shape[-1:] != (len(self),):
            raise ValueError(
                f"expected parameter vectors [..., {len(self)}] ({', '.join(self.names)}), got shape {values.shape}"
            )
        rows = values.reshape(-1, len(self))
        for i, p in enumerate(self.parameters):
            slack = ROUNDING * (p.high - p.low)
            bad = rows[:, i][~((rows[:, i] >= p.low - slack) & (rows[:, i] <= p.high + slack))]
            if bad.size:
                raise ValueError(
                    f"parameter {p.name!r}: {bad[0]} {p.unit} is not inside its bounds [{p.low}, {p.high}]"
                )
        return np.clip(values, self.low, self.high)

    def to_search(self, values: Any) -> Any:
        """[..., D] physical values -> [..., D] search coordinates (numpy or jax)."""
        return self._columns(values, Parameter.to_search)

    def from_search(self, x: Any) -> Any:
        """[..., D] search coordinates -> [..., D] physical values inside the bounds."""
        return self._columns(x, Parameter.from_search)

    def _columns(self, array: Any, function: Callable[[Parameter, Any], Any]) -> Any:
        xp = _namespace(array)
        array = numeric(array, "parameter vectors") if xp is np else array
        if array.shape[-1:] != (len(self),):
            raise ValueError(f"expected parameter vectors [..., {len(self)}], got shape {array.shape}")
        columns = [function(p, array[..., i]) for i, p in enumerate(self.parameters)]
        return xp.stack(columns, axis=-1)


def _namespace(array: Any) -> Any:
    """numpy for host arrays, jax.numpy for arrays and tracers of jax."""
    if type(array).__module__.split(".")[0] not in ("jax", "jaxlib"):  # does not import jax, which takes a second
        return np
    import jax.numpy as jnp

    return jnp
