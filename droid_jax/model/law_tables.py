"""Tables of effects' laws over the variables on which they depend, for programs without this package.

The law's function is that of the replay.  It is probed for the variables on which it depends, and then tabulated.  So
user effects have tables too.  A law that depends on more than position, speed and load of one joint (such as that of a
tilted base) has no table; the reason is given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.effect_interface import Effect, State, complete
from droid_jax.model.scene import Scene
from droid_jax.model.table_grid import ROUNDING, GridAxis, differences, first_nodes, on_grid, refined

SPEED, ANGLE, TRAVEL = 20.0, 2 * np.pi, 2.0  # rad/s or m/s, rad, m: ranges of tables without a limit in the model
LOAD = 2000.0  # N m, likewise without a force limit; nodes are denser about zero, so a wide range costs nothing
LEAST_LOAD = 20.0  # N m, least torque relative to which float32 rounding of a servo's feedback is judged
BASE_FRICTION = 64.0  # N m of friction to which a law is added, so that no part is clipped at zero (float32: 4e-6)
SMALLEST_BATCH = 2048  # states of a batch; a program is compiled for each size, so there are few sizes
PROBES, CHANGE = 12, 1e-6  # states at which a dependence is tested; relative change that counts as one
LARGEST_ERROR = 0.1  # of a table at the fitted values, as a share of its largest value,
ERROR_QUANTILE = 0.95  # in this share of random points, since a law may jump in a cell
NARROW = 1e-3  # smallest share of the probed range for PROBES further states, for laws that act in a small part of it
VARIABLES = ("position", "speed", "load")
UNIT = {"position": ("rad", "m"), "speed": ("rad/s", "m/s"), "load": ("N m", "N"), "torque": ("N m", "N")}


@dataclass(frozen=True, eq=False)
class LawTable:
    """A law on one joint: the sum over terms of a parameter (or 1) times its table.

    Attributes:
        effect: its name.
        location: of the effect.
        description: of the effect.
        acts: "force" (added to qfrc_applied), "frictionloss" (added to the joint's), "servo" (added to the torque of
            the position servo), "command" (delay of the command, s), "acceleration" or "speed" (one over the limit of
            the servo's profile).
        joint: on which it acts.
        unit: of the law.
        axes: shape parameters first, then variables: "position", "speed", "load" or "torque" (the servo's without the
            law).
        terms: (parameter or None for 1, table over the axes).
        error: largest interpolation error at the fitted values, `unit`.
        error_of_draws: largest interpolation error anywhere, `unit`.
    """

    effect: str
    location: str
    description: str
    acts: str
    joint: str
    unit: str
    axes: tuple[GridAxis, ...]
    terms: tuple[tuple[str | None, np.ndarray], ...]
    error: float
    error_of_draws: float


@dataclass(frozen=True)
class NoTable:
    """A law without a table, and the reason."""

    effect: str
    location: str
    description: str
    why: str


def law_tables(
    scene: Scene, model: Any, effects: Sequence[Effect], values: dict[str, float], spread: dict[str, float]
) -> Iterator[LawTable | NoTable]:
    """Yield the tables of all laws that act in a simulation, not of sensor models and changed model fields.

    Args:
        scene: of the fit.
        model: mjx.Model with the fitted numbers, for laws that read the servos' gains.
        effects: of the model.
        values: fitted values by parameter.
        spread: standard deviations of the parameters that vary.  Tables cover shape parameters within four of them.
    """
    for effect in effects:
        for location, coefficients in (effect.locations or {"": tuple(p.name for p in effect.parameters)}).items():
            if not any(values[name] or spread.get(name) for name in coefficients if name in values):
                continue
            law = _Law(scene, model, effect, location, coefficients, values, spread)
            try:
                tables = list(_tables(law))
            except Exception as error:  # a user's law may raise anything; the fit is still valid
                tables = [law.no_table(f"no table could be made of it ({type(error).__name__}: {error})")]
            yield from tables


def _tables(law: _Law) -> Iterator[LawTable | NoTable]:
    effect = law.effect
    if effect.profile is not None:
        yield law.limit()
    if effect.command is not None:
        yield law.delay()
    for acts, function in (("force", effect.force), ("frictionloss", effect.frictionloss)):
        if function is not None:
            yield from law.of_state(acts)
    if effect.servo is not None:
        yield law.of_servo()
    if effect.limits is not None:
        yield law.no_table("a limit of the servo's torque that depends on speed")
    if effect.gear is not None:
        yield law.no_table("the motor behind the gear has a state of its own")
    elif effect.twist is not None and effect.servo is None:
        yield law.no_table("a replay begins with the links behind their encoders")


@dataclass(frozen=True, eq=False)
class _Law:
    """An effect at a location, at its fitted values."""

    scene: Scene
    model: Any
    effect: Effect
    location: str
    coefficients: tuple[str, ...]
    values: dict[str, float]
    spread: dict[str, float]

    @property
    def parameters(self) -> list[str]:
        """Fitted parameters that it reads: its coefficients at this location, and its shape parameters."""
        of_effect = {p.name for p in self.effect.parameters if not p.writes}
        others = {n for at, names in self.effect.locations.items() if at != self.location for n in names}
        return [n for n in self.values if n in of_effect and (n in self.coefficients or n not in others)]

    def probe(self, name: str) -> float:
        """A value at which the law acts: the fitted one, or its deviation if that is zero."""
        return self.values[name] or self.spread.get(name, 0.0)

    def no_table(self, why: str) -> NoTable:
        """The law without a table."""
        return NoTable(self.effect.name, self.location, self.effect.description, why)

    def theta(self, given: dict[str, Any]) -> dict[str, Any]:
        """theta for given parameters, with neutral values at other locations."""
        return dict(complete({n: jnp.float32(given[n]) for n in self.parameters}, [self.effect]))

    def limit(self) -> LawTable | NoTable:
        """One over the limit of acceleration or speed of a servo's profile (`Effect.profile_limits`)."""
        effect, unit = self.effect, {p.name: p.unit for p in self.effect.parameters}
        if not effect.profile_limits or self.location not in self.scene.driven_joints or len(self.parameters) != 1:
            return self.no_table("it draws its own path between two goals")
        (name,) = self.parameters
        acts, terms = effect.profile_limits, ((name, np.array(1.0)),)
        return LawTable(
            effect.name, self.location, effect.description, acts, self.location, unit[name], (), terms, 0.0, 0.0
        )

    def delay(self) -> LawTable | NoTable:
        """Delay of the command, s."""
        if self.effect.over_time:
            return self.no_table("it depends on the time since the recording began")
        command = self.effect.command
        assert command is not None

        names, at = self.parameters, {n: self.values[n] for n in self.parameters}
        reason = "it does more to the command than to delay it"
        if np.ndim(command(self.theta(at), jnp.float32(1.0), lambda t: t)):  # different for each actuator
            return self.no_table(reason)

        def response(given: dict[str, float], power: int) -> float:
            """What the law makes of the command t^power at 1 s."""
            return float(command(self.theta(given), jnp.float32(1.0), lambda t: t**power))

        delays = [1.0 - response({**dict.fromkeys(names, 0.0), n: 1e-3}, 1) for n in names]
        total = 1.0 - response(at, 1)
        slopes = np.array(delays) / 1e-3
        is_delay = abs((1 - total) ** 2 - response(at, 2)) < 1e-5
        if not (is_delay and abs(float(slopes @ [at[n] for n in names]) - total) < 1e-5):
            return self.no_table(reason)
        terms = tuple((n, np.array(float(f"{s:.3g}"))) for n, s in zip(names, slopes, strict=True) if s)
        return LawTable(
            self.effect.name, self.location, self.effect.description, "command", "", "s", (), terms, 0.0, 0.0
        )

    def of_state(self, acts: str) -> Iterator[LawTable | NoTable]:
        """Force or friction loss, for each joint on which it acts."""
        scene, nv = self.scene, self.scene.model.nv
        if self.effect.over_time:
            yield self.no_table("it depends on the time since the recording began")
            return
        function = self._batched(acts)
        rng = np.random.default_rng(0)
        scale = np.concatenate([np.ones(PROBES), np.geomspace(NARROW, 1.0, PROBES)])
        base = np.tile(np.concatenate([scene.model.qpos0, np.zeros(2 * nv)]), (len(scale), 1))
        base = base + scale[:, None] * rng.uniform(-0.5, 0.5, base.shape)
        at = {n: np.full(len(scale), self.probe(n)) for n in self.parameters}
        now = function(at, base)
        if np.any(function(at, np.concatenate([base, rng.uniform(-0.5, 0.5, (len(scale), 2 * nv))], axis=1)) != now):
            yield self.no_table("it depends on the torques of motor and links on the gear")
            return
        if not np.abs(now).max() > 0:
            yield self.no_table("it does not act near the scene's reference pose, where its table would be made")
            return
        touched: dict[int, set[tuple[str, int]]] = {}
        for column, variable, row in self._columns():
            other = base.copy()
            other[:, column] += rng.uniform(0.1, 0.6, len(scale)) * rng.choice([-1, 1], len(scale))
            moved = np.abs(function(at, other) - now).max(axis=0) > CHANGE * max(np.abs(now).max(), 1e-9)
            for dof in np.flatnonzero(moved):
                touched.setdefault(int(dof), set()).add((variable, row))
        for dof in np.flatnonzero(np.abs(now).max(axis=0) > 0):
            of = touched.get(int(dof), set())
            rows = {row for _, row in of}
            if len(rows) > 1 or len(of) > 2:
                yield self.no_table("it depends on the state of several joints")
                return
            if rows - {int(dof)}:  # the table has no name for it
                yield self.no_table("it depends on the state of another joint")
                return
        for dof in np.flatnonzero(np.abs(now).max(axis=0) > 0):
            of = touched.get(int(dof), set())
            names = [v for v in VARIABLES if (v, int(dof)) in of] or ["position"]
            yield self._table(acts, int(dof), names, function)

    def of_servo(self) -> LawTable | NoTable:
        """The torque that is added to a servo's, over the servo's torque."""
        joint = self.location
        if joint not in self.scene.driven_joints:
            return self.no_table("it is no law of one joint's servo")
        u, model = self.scene.command_names.index(joint), self.model
        gear = float(np.asarray(model.actuator_gear)[u, 0])
        gain, bias = float(model.actuator_gainprm[u, 0]), np.asarray(model.actuator_biasprm)[u]
        servo, scene = self.effect.servo, self.scene
        assert servo is not None
        if self.effect.over_time:
            return self.no_table("it depends on the time since the recording began")
        # The servo is asked for torques at positions that its range of commands may not reach.
        unlimited = model.replace(actuator_ctrllimited=np.zeros_like(np.asarray(model.actuator_ctrllimited)))

        def one(given: dict[str, Any], torque: Any, q: Any, v: Any) -> Any:
            zero = jnp.zeros(scene.model.nv, jnp.float32)
            qpos = jnp.asarray(scene.model.qpos0, jnp.float32).at[scene.qpos(joint)].set(q)
            state = State(jnp.float32(0), qpos, zero.at[scene.dof(joint)].set(v), zero, unlimited)
            feedback = bias[0] + bias[1] * gear * q + bias[2] * gear * v
            ctrl = jnp.zeros(scene.model.nu, jnp.float32).at[u].set((torque / gear - feedback) / gain)
            return gear * (gain * servo(self.theta(given), state, ctrl)[u] + feedback) - torque

        batch = _padded(one)

        def of_torque(given: dict[str, np.ndarray], x: np.ndarray, q: float = 0.0, v: float = 0.0) -> np.ndarray:
            return batch(given, x, np.full(len(x), q), np.full(len(x), v))

        reach = self._load_reach(joint)
        half = reach * np.geomspace(1e-3, 1.0, 20)
        probes = np.concatenate([-half, [0.0], half])
        at = {n: np.full(len(probes), self.probe(n)) for n in self.parameters}
        rounding = 1e-4 * np.maximum(np.abs(probes), min(reach, LEAST_LOAD))
        if np.any(np.abs(of_torque(at, probes) - of_torque(at, probes, 0.4, 1.0)) > rounding):
            return self.no_table("it depends on more than the servo's torque")
        unit = UNIT["torque"][self.scene.slides(joint)]
        return self._made("servo", joint, unit, [GridAxis("torque", unit, first_nodes(-reach, reach))],
                          lambda given, x: of_torque(given, x[:, 0]))  # fmt: skip

    def _table(self, acts: str, dof: int, names: list[str], function: Callable[..., np.ndarray]) -> LawTable | NoTable:
        scene, model = self.scene, self.scene.model
        acting = model.joint(int(model.dof_jntid[dof])).name
        slides = model.jnt_type[model.dof_jntid[dof]] == mujoco.mjtJoint.mjJNT_SLIDE
        columns = {v: c for c, v, r in self._columns() if r == dof}
        axes = [GridAxis(v, UNIT[v][slides], first_nodes(*self._reach(acting, v))) for v in names]
        base = np.concatenate([model.qpos0, np.zeros(2 * model.nv)])

        def at(given: dict[str, np.ndarray], x: np.ndarray) -> np.ndarray:
            states = np.tile(base, (len(x), 1))
            states[:, [columns[v] for v in names]] = x
            return function(given, states)[:, dof]

        return self._made(acts, acting, UNIT["torque"][scene.slides(acting)], axes, at)

    def _made(
        self, acts: str, joint: str, unit: str, axes: list[GridAxis], at: Callable[..., np.ndarray]
    ) -> LawTable | NoTable:
        """The table: linear coefficients are terms, other parameters are axes."""
        names, values = self.parameters, self.values
        linear = [n for n in names if n in self.coefficients and self._linear(n, axes, at)]
        shapes = [n for n in names if n not in linear]
        deviation = {n: 4.0 * self.spread.get(n, 0.0) for n in shapes}
        bounds = {p.name: (p.low, p.high) for p in self.effect.parameters}
        shape_axes = [
            GridAxis(n, next(p.unit for p in self.effect.parameters if p.name == n),
                 np.unique(np.clip([values[n] - deviation[n], values[n], values[n] + deviation[n]], *bounds[n])))
            for n in shapes
        ]  # fmt: skip

        def term(name: str | None) -> Callable[[np.ndarray], np.ndarray]:
            def of(x: np.ndarray) -> np.ndarray:  # [K, shapes + variables]
                given = {n: np.full(len(x), 1.0 if n == name else 0.0) for n in linear}
                given |= {n: x[:, i] for i, n in enumerate(shapes)}
                return at(given, x[:, len(shapes) :])

            return of

        functions = [(n, term(n)) for n in linear] or [(None, term(None))]
        fitted = [values[n] for n in shapes]
        every = refined([*shape_axes, *axes], [f for _, f in functions], fitted)
        tables = tuple((n, on_grid(every, f)) for n, f in functions)
        sizes = [abs(values[n]) if n else 1.0 for n, _ in functions]
        pairs = list(zip(tables, functions, strict=True))
        worst = float(np.dot(sizes, [differences(every, f, t).max() for (_, t), (_, f) in pairs]))
        here = tuple(int(np.abs(a.nodes - v).argmin()) for a, v in zip(every, fitted, strict=False))
        fixed = [
            *(replace(a, nodes=a.nodes[i : i + 1]) for a, i in zip(every, here, strict=False)),
            *every[len(here) :],
        ]
        errors = [differences(fixed, f, t[here].reshape([len(a.nodes) for a in fixed])) for (_, t), (_, f) in pairs]
        largest, usual = (
            float(np.dot(sizes, [np.quantile(each, q) for each in errors])) for q in (1.0, ERROR_QUANTILE)
        )
        if usual > LARGEST_ERROR * float(np.dot(sizes, [np.abs(t[here]).max() for _, t in tables])):
            return self.no_table(f"a table of {len(every[-1].nodes)} nodes is too coarse for it")
        effect = self.effect
        return LawTable(
            effect.name, self.location, effect.description, acts, joint, unit, tuple(every), tables, largest, worst
        )

    def _linear(self, name: str, axes: list[GridAxis], at: Callable[..., np.ndarray]) -> bool:
        """Whether the law is linear in this coefficient, and additive to the parts of the others."""
        x = np.stack(np.meshgrid(*(a.nodes for a in axes), indexing="ij"), axis=-1).reshape(-1, len(axes))
        count = len(x)
        given = {n: np.full(count, self.values[n]) for n in self.parameters}
        zero = {n: (np.zeros(count) if n in self.coefficients else v) for n, v in given.items()}
        size = self.values[name] or 1.0
        none, one, two = (at({**zero, name: np.full(count, k * size)}, x) for k in (0.0, 1.0, 2.0))
        others = at({**given, name: np.zeros(count)}, x)
        slack = 1e-4 * max(np.abs(two).max(), 1e-12) + ROUNDING
        interaction = np.abs(at({**given, name: np.full(count, size)}, x) - others - one).max()
        return bool(np.abs(none).max() <= slack and np.abs(two - 2 * one).max() <= slack and interaction <= slack)

    def _batched(self, acts: str) -> Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray]:
        """(parameters [K] each, states [K, nq + 2 nv] or [K, nq + 4 nv] with the gears' torques) -> [K, nv]."""
        nq, nv, model = self.scene.model.nq, self.scene.model.nv, self.model
        base = jnp.full(nv, BASE_FRICTION, jnp.float32)

        def one(given: dict[str, Any], row: Any) -> Any:
            position, speed, load, gear = jnp.split(row, (nq, nq + nv, nq + 2 * nv))
            state = State(jnp.float32(0), position, speed, load, model, gear=gear.reshape(2, nv))
            theta = self.theta(given)
            if acts == "force":
                assert self.effect.force is not None
                return self.effect.force(theta, state)
            assert self.effect.frictionloss is not None
            return self.effect.frictionloss(theta, state, base) - base

        batch, wide = _padded(one), nq + 4 * nv

        def of(given: dict[str, np.ndarray], states: np.ndarray) -> np.ndarray:
            return batch(given, np.pad(states, ((0, 0), (0, wide - states.shape[1]))))

        return of

    def _columns(self) -> Iterator[tuple[int, str, int]]:
        """(column of a state, variable, degree of freedom) for hinges and slides."""
        model = self.scene.model
        single = np.isin(model.jnt_type, (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)))
        for joint in np.flatnonzero(single):
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            yield from zip((q, model.nq + v, model.nq + model.nv + v), VARIABLES, (v, v, v), strict=True)

    def _reach(self, joint: str, variable: str) -> tuple[float, float]:
        """Range of a table's axis."""
        model, row = self.scene.model, self.scene.id("joint", joint)
        if variable == "load":
            return -self._load_reach(joint), self._load_reach(joint)
        if variable == "speed":
            return -SPEED, SPEED
        low, high = model.jnt_range[row]
        if low < high:
            return float(low - 0.1 * (high - low)), float(high + 0.1 * (high - low))
        reach = TRAVEL if self.scene.slides(joint) else ANGLE
        return -reach, reach

    def _load_reach(self, joint: str) -> float:
        """N m (N), largest load of a joint, from the limits of its actuators."""
        model = self.scene.model
        ends = [model.jnt_actfrcrange[self.scene.id("joint", joint)]]
        if joint in self.scene.driven_joints:
            u = self.scene.command_names.index(joint)
            ends.append(model.actuator_forcerange[u] * abs(model.actuator_gear[u, 0]))
        most = [float(np.abs(e).max()) for e in ends if np.abs(e).max() > 0]
        return 1.2 * min(most) if most else LOAD


def _padded(one: Callable[..., Any]) -> Callable[..., np.ndarray]:
    """A function of (parameters, *numbers) for batches, compiled for a few batch sizes."""
    batch = jax.jit(jax.vmap(one))

    def many(given: dict[str, np.ndarray], *rows: np.ndarray) -> np.ndarray:
        count = len(rows[0])
        size = SMALLEST_BATCH * 8 ** max(0, math.ceil(math.log(count / SMALLEST_BATCH, 8)))

        def filled(x: Any) -> jax.Array:
            return jnp.asarray(np.resize(x, (size, *np.shape(x)[1:])), jnp.float32)

        out = batch({name: filled(v) for name, v in given.items()}, *map(filled, rows))
        return np.asarray(out, float)[:count]

    return many
