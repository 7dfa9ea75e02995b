"""A fit in plain MuJoCo.  This file needs only numpy and mujoco.

    import mujoco, apply_fit

    fit = apply_fit.load("fitted.json")
    spec = mujoco.MjSpec.from_file("robot.xml")
    values = apply_fit.apply(spec, fit)                     # the fitted values; sample=7 takes draw number 7
    model = spec.compile()
    data = mujoco.MjData(model)
    laws = apply_fit.forces(model, fit, values)             # laws that MJCF cannot express, if there are any
    for command in commands:
        data.ctrl[:] = laws.control(data, command)          # a servo's ramps, a delay, an elastic gear
        laws(model, data)                                   # a latch, a friction that depends on the load
        mujoco.mj_step(model, data)

`mujoco.set_mjcb_control(laws)` can replace `laws(model, data)`.  `batch(model, fit, 4096)` returns draws as arrays by
field, for engines that step many worlds.  docs/results-folder.md of droid_jax describes the entries of fitted.json.
Draw `k` of a seed is the same in every call.
"""

from __future__ import annotations

import copy
import json
import math
import warnings
from pathlib import Path
from statistics import NormalDist
from typing import Any

import mujoco
import numpy as np

FORMAT, VERSION = "droid_jax fitted", 1
TRIES, SWEEPS = 2000, 40  # rows drawn until one is inside the bounds; then sweeps of Gibbs sampling
FIRST_TRIES = 20  # rows of the first block of these, which usually suffices
SHARES = 50  # of the way to the fitted values, tried where such a draw has an inertia that no body can have
SAME = 1e-9  # relative; mj_setConst reproduces a model's derived numbers up to rounding
TINY_FRICTION = 1e-6  # N m: gives a joint the constraint row that a law of friction needs
_AT_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_NAMED = ("table", "inertias")  # parts of fitted.json whose entries name an element
_UNIT = ("body_quat", "body_iquat", "jnt_axis", "geom_quat")  # fields of unit vectors
# Fields from which mj_setConst derives others.
_DERIVING = {"body_mass", "body_inertia", "body_pos", "body_quat", "body_ipos", "body_iquat", "dof_armature", "jnt_pos",
             "jnt_axis", "geom_pos", "geom_quat"}  # fmt: skip
_WEIGHT = {"body_mass", "body_inertia", "body_ipos", "body_iquat"}  # fields of a body's inertia
_PLACE = {"body_pos", "body_quat", "geom_pos", "geom_quat", "geom_size"}  # fields of a frame or a shape
# Prefixes of the fields of a model's elements.
_OF_ELEMENTS = ("body_", "jnt_", "dof_", "qpos", "geom_", "site_", "pair_", "actuator_", "tendon_", "eq_", "cam_",
                "light_")  # fmt: skip
_SHAPED = (int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_HFIELD))  # geoms with a frame of their data
# Fields that a compiled spec must reproduce.
_REPRODUCED = ("body_mass", "body_inertia", "jnt_stiffness", "dof_damping", "dof_frictionloss", "dof_armature",
               "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange")  # fmt: skip


def load(path: str | Path) -> dict[str, Any]:
    """Return the content of a fitted.json; ValueError for another file or version."""
    content = json.loads(Path(path).read_text(encoding="utf-8"))
    if not isinstance(content, dict) or (content.get("format"), content.get("version")) != (FORMAT, VERSION):
        raise ValueError(f"{path}: expected a JSON object with format {FORMAT!r}, version {VERSION}")
    return content


def apply(
    target: mujoco.MjSpec | mujoco.MjModel, fit: dict[str, Any] | str | Path, sample: int | None = None, seed: int = 0
) -> dict[str, float]:
    """Write the fitted values, or a draw, into a spec or a model; they replace those of an earlier call.

    Args:
        target: a spec or a compiled model, of the MJCF that was fitted or of fitted.xml.
        fit: content of fitted.json, or its path.
        sample: number of a draw; None for the fitted values.
        seed: of the draws.

    Returns:
        The values by parameter, for `forces`.

    Raises:
        ValueError: the target lacks an element of the fit, or a spec cannot express one of its numbers.
    """
    fit = fit if isinstance(fit, dict) else load(fit)
    values = fitted_values(fit) if sample is None else draw(fit, sample, seed)
    model = target if isinstance(target, mujoco.MjModel) else target.compile()
    _write(model, fit, values)
    if isinstance(target, mujoco.MjSpec):
        _write_spec(target, model, fit)
    return values


def batch(
    model: mujoco.MjModel, fit: dict[str, Any] | str | Path, count: int, seed: int = 0, prefix: str = ""
) -> dict[str, np.ndarray]:
    """Return draws as arrays by field of the model, for engines that step many worlds with different numbers.

    Args:
        model: compiled, of the MJCF that was fitted or of a scene that contains it.  It is not changed.
        fit: content of fitted.json, or its path.
        count: number of draws, at least 1; row k is what `apply(model, fit, sample=k, seed=seed)` writes.
        seed: of the draws.
        prefix: of the names of the fitted MJCF's elements in this scene, for example "robot/".

    Returns:
        {field: [count, *shape of the field]} of the fields that differ from the model's in some draw: those that the
        fit writes, and those that MuJoCo derives from them (`dof_invweight0`).  The laws of `forces` are not fields.

    Raises:
        ValueError: count is below 1, or the model lacks an element of the fit.
    """
    fit = fit if isinstance(fit, dict) else load(fit)
    if count < 1:
        raise ValueError(f"batch: count must be at least 1, got {count}")
    if prefix:
        if nameless := sorted({f"{row['element']} {row['id']}" for row in fit["table"] if not row["name"]}):
            raise ValueError(f"{', '.join(nameless)}: give it a name in the MJCF and fit again to find it by a prefix")
        prefixed = {part: [{**e, "name": prefix + e["name"]} for e in fit.get(part, ())] for part in _NAMED}
        fit = {**fit, **prefixed}
    written, names = copy.copy(model), [p["name"] for p in fit["parameters"]]
    old = {field: getattr(model, field) for field in dir(model) if field.startswith(_OF_ELEMENTS)}
    old = {field: array for field, array in old.items() if np.asarray(array).dtype.kind == "f"}
    new = {field: np.empty((count, *array.shape)) for field, array in old.items()}
    for k, row in enumerate(draws(fit, range(count), seed).tolist()):
        _write(written, fit, dict(zip(names, row, strict=True)))
        for field, rows in new.items():
            rows[k] = getattr(written, field)
    return {field: rows for field, rows in new.items() if not np.allclose(rows, old[field], rtol=SAME, atol=1e-12)}


def fitted_values(fit: dict[str, Any]) -> dict[str, float]:
    """Return the fitted values by parameter."""
    return {p["name"]: p["value"] for p in fit["parameters"]}


def draw(fit: dict[str, Any], sample: int, seed: int = 0) -> dict[str, float]:
    """Return draw number `sample` of the Gaussian inside the bounds, by parameter."""
    return dict(zip((p["name"] for p in fit["parameters"]), draws(fit, [sample], seed)[0].tolist(), strict=True))


def draws(fit: dict[str, Any], samples: Any, seed: int = 0) -> np.ndarray:
    """Return draws [n, D] of these numbers, in physical units and the order of fit["parameters"]."""
    gaussian, parameters = fit["gaussian"], fit["parameters"]
    mean, cov = np.array(gaussian["mean"]), np.array(gaussian["cov"])
    physical = gaussian["coordinates"] == "physical"
    low, high = np.array([_box(p, physical) for p in parameters]).T
    variances, axes = np.linalg.eigh(cov)
    root = axes * np.sqrt(variances.clip(0.0))
    out, unchecked = np.empty((len(samples), len(mean))), list[int]()
    for i, sample in enumerate(samples):
        rng = np.random.default_rng([seed, sample])
        for tries in (FIRST_TRIES, TRIES - FIRST_TRIES):
            rows = mean + rng.standard_normal((tries, len(mean))) @ root.T
            inside = np.flatnonzero(np.all((rows >= low) & (rows <= high), axis=1)).tolist()
            first = next((k for k in inside if _possible(fit, rows[k], physical)), None)
            if first is not None:
                out[i] = rows[first]
                break
        else:
            out[i] = _gibbs(rng, mean, cov, low, high)
            unchecked.append(i)
    out = np.stack([_physical(p, out[:, i], physical) for i, p in enumerate(parameters)], axis=1)
    for i in unchecked:
        out[i] = _made_possible(fit, out[i])
    return out


def _possible(fit: dict[str, Any], x: np.ndarray, physical: bool) -> bool:
    """Whether some body can have the moments of a draw, which MuJoCo's compiler wants too."""
    if not any(row["field"] == "body_inertia" for row in fit["table"]):
        return True
    return _has_body(fit, [float(_physical(p, x[i], physical)) for i, p in enumerate(fit["parameters"])])


def _made_possible(fit: dict[str, Any], row: np.ndarray) -> np.ndarray:
    """A row of values; its moments move towards the fitted ones as far as needed for some body to have them."""
    of_moments = {w["parameter"] for r in fit["table"] if r["field"] == "body_inertia" for w in r["writes"]}
    fitted = np.array(
        [p["value"] if p["name"] in of_moments else v for p, v in zip(fit["parameters"], row, strict=True)]
    )
    between = (fitted + share * (row - fitted) for share in np.linspace(1.0, 0.0, SHARES, endpoint=False))
    return next((values for values in between if _has_body(fit, values.tolist())), fitted)


def _has_body(fit: dict[str, Any], numbers: list[float]) -> bool:
    """Whether some body can have the moments at these values, in the order of fit["parameters"]."""
    values = dict(zip((p["name"] for p in fit["parameters"]), numbers, strict=True))
    moments: dict[Any, dict[int, float]] = {}
    for row in fit["table"]:
        if row["field"] == "body_inertia":
            moments.setdefault(row["id"], {})[row["column"]] = number_of(row, values)
    for each in moments.values():
        if len(each) == 3 and not 0 < 2 * max(each.values()) <= sum(each.values()) * (1 + 1e-5):
            return False
    return True


def _box(p: dict[str, Any], physical: bool) -> tuple[float, float]:
    """Bounds of a draw, in the Gaussian's coordinates."""
    if physical:
        return p["low"], p["high"]
    if p["scaling"] == "log":  # its map clips
        return -math.inf, math.inf
    prior = p["prior"]
    return (p["low"] - prior["mean"]) / prior["std"], (p["high"] - prior["mean"]) / prior["std"]


def _physical(p: dict[str, Any], x: np.ndarray, physical: bool) -> np.ndarray:
    """Coordinates of the Gaussian -> the parameter's unit."""
    prior, offset = p["prior"], p["log_offset"]
    if physical:
        value = x
    elif p["scaling"] == "log":
        width = math.log1p(prior["std"] / (prior["mean"] + offset)) if p["width"] is None else p["width"]
        value = (prior["mean"] + offset) * np.exp(width * x) - offset
    else:
        value = prior["mean"] + prior["std"] * x
    return np.clip(value, p["low"], p["high"])


def _gibbs(
    rng: np.random.Generator, mean: np.ndarray, cov: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """A draw of a normal distribution with little probability inside the bounds, by Gibbs sampling."""
    normal, precision = NormalDist(), np.linalg.pinv(cov, hermitian=True)
    x = np.clip(mean, low, high)
    for _ in range(SWEEPS):
        for i in range(len(x)):
            if precision[i, i] <= 0:
                continue
            std = precision[i, i] ** -0.5
            centre = mean[i] - (precision[i] @ (x - mean) - precision[i, i] * (x[i] - mean[i])) / precision[i, i]
            sign = -1.0 if low[i] > centre else 1.0  # the tail whose probabilities are accurate
            ends = sorted(sign * (end - centre) / std for end in (low[i], high[i]))
            first, last = (0.5 * math.erfc(-end / math.sqrt(2.0)) for end in ends)
            share = min(max(first + rng.uniform() * (last - first), 1e-300), 1 - 1e-15)
            x[i] = np.clip(centre + sign * std * normal.inv_cdf(share), low[i], high[i])
    return x


def _id(model: mujoco.MjModel, row: dict[str, Any]) -> int:
    """Id of a row's element, by its name if it has one."""
    if not row["name"]:
        return int(row["id"])
    kind = getattr(mujoco.mjtObj, f"mjOBJ_{row['element'].upper()}")
    found = mujoco.mj_name2id(model, kind, row["name"])
    if found < 0 and row["element"] == "actuator":  # an actuator without a name has the name of its joint
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, row["name"])
        drives = np.flatnonzero((model.actuator_trnid[:, 0] == joint) & (model.actuator_trntype == 0))
        found = int(drives[0]) if joint >= 0 and len(drives) else -1
    if found < 0:
        raise ValueError(f"the model has no {row['element']} {row['name']!r}, which was fitted")
    return found


def _entry(model: mujoco.MjModel, row: dict[str, Any]) -> tuple[int, ...]:
    """Index of a row's number in its field."""
    number = _id(model, row)
    if row["field"].startswith("dof_"):
        number = int(model.jnt_dofadr[number]) + row["offset"]
    elif row["field"].startswith("qpos"):
        number = int(model.jnt_qposadr[number])
    return (number,) if row["column"] is None else (number, row["column"])


def number_of(row: dict[str, Any], values: dict[str, float]) -> float:
    """Return a row's number for parameter values: the nominal one, modified by each parameter in turn."""
    number = row["nominal"]
    for write in row["writes"]:
        w = write["gain"] * values[write["parameter"]] + write["offset"]
        mode = write["mode"]
        number = {"set": w, "negative": -w, "scale": number * w, "add": number + w}.get(mode, number)
        if mode == "divide":
            number = number / w
    return number


def inertia_of(inertia: dict[str, Any], values: dict[str, float]) -> dict[str, np.ndarray]:
    """Return mass, centre, orientation and moments of a body of `inertias` for parameter values.

    The pseudo-inertia is (U A)(U A)^T with U the `root`, and A upper triangular: e^mass times stretches, shears and
    shifts.  Source: Rucker and Wensing, IEEE RA-L 2022.
    """
    size, x, y, z, xy, yz, xz, *shift = (
        0.0 if write is None else write["gain"] * values[write["parameter"]] + write["offset"]
        for write in inertia["terms"]
    )
    factor = np.array([
        [np.exp(x), xy, xz, shift[0]], [0, np.exp(y), yz, shift[1]], [0, 0, np.exp(z), shift[2]], [0, 0, 0, 1],
    ])  # fmt: skip
    scaled = np.array(inertia["root"]) @ factor * np.exp(size)
    pseudo = scaled @ scaled.T
    mass, centre = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
    second_moments, axes = np.linalg.eigh(pseudo[:3, :3] - mass * np.outer(centre, centre))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    orientation = np.zeros(4)
    mujoco.mju_mat2Quat(orientation, axes.ravel())
    return {
        "body_mass": np.array(mass), "body_ipos": centre, "body_iquat": orientation,
        "body_inertia": second_moments.sum() - second_moments,
    }  # fmt: skip


def _write(model: mujoco.MjModel, fit: dict[str, Any], values: dict[str, float]) -> None:
    """Write the numbers into a compiled model, and update those that MuJoCo derives from them."""
    fields, moved_frames = set(), set()
    for row in fit["table"]:
        getattr(model, row["field"])[_entry(model, row)] = number_of(row, values)
        fields.add(row["field"])
        if row["field"] in ("body_ipos", "body_iquat"):
            moved_frames.add(_id(model, row))
        elif row["field"] in ("jnt_pos", "jnt_axis"):
            moved_frames.add(int(model.jnt_bodyid[_id(model, row)]))
    for inertia in fit.get("inertias", ()):
        body = _id(model, {"element": "body", **inertia})
        for field, number in inertia_of(inertia, values).items():
            getattr(model, field)[body] = number
        moved_frames.add(body)
    for body in moved_frames:  # the shortcuts of C for aligned frames do not apply any more
        if model.body_simple[body]:
            model.dof_simplenum[:] = 0
        model.body_sameframe[body] = model.body_simple[body] = 0
    for field in fields.intersection(_UNIT):
        array = getattr(model, field)
        array /= np.linalg.norm(array, axis=1, keepdims=True)
    if fields & _DERIVING:
        mujoco.mj_setConst(model, mujoco.MjData(model))
        model.stat.meaninertia = model.dof_M0.mean()
        model.stat.meanmass = model.body_subtreemass[0] / max(model.nbody - 1, 1)
    for geom in {_id(model, row) for row in fit["table"] if row["field"] == "geom_size"}:
        _bound(model, geom)
    if fields & {"geom_pos", "geom_quat", "geom_size"}:  # bounding volumes of several geoms are not updated
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE


def _bound(model: mujoco.MjModel, geom: int) -> None:
    """Set the bounding sphere and box of a geom of a primitive shape, as MuJoCo compiles them."""
    x, y, z = model.geom_size[geom]
    around = {
        mujoco.mjtGeom.mjGEOM_SPHERE: ((x, x, x), x),
        mujoco.mjtGeom.mjGEOM_CAPSULE: ((x, x, x + y), x + y),
        mujoco.mjtGeom.mjGEOM_CYLINDER: ((x, x, y), math.hypot(x, y)),
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: ((x, y, z), max(x, y, z)),
        mujoco.mjtGeom.mjGEOM_BOX: ((x, y, z), math.sqrt(x**2 + y**2 + z**2)),
    }.get(mujoco.mjtGeom(int(model.geom_type[geom])))
    if around is not None:
        model.geom_aabb[geom, 3:], model.geom_rbound[geom] = around


def _write_spec(spec: mujoco.MjSpec, model: mujoco.MjModel, fit: dict[str, Any]) -> None:
    """Write the numbers of a compiled model into the elements of its spec."""
    bodies = set()
    if any(row["field"] in _WEIGHT for row in fit["table"]):  # the compiler would bound or scale the masses again
        spec.compiler.boundmass, spec.compiler.boundinertia, spec.compiler.settotalmass = 0.0, 0.0, -1.0
    _state_derived(spec, model)
    for row in fit["table"]:
        number, field = _id(model, row), row["field"]
        element = _element(spec, row["element"], number)
        if field in _WEIGHT:
            bodies.add(number)
        elif row["spec"]:
            entry = _entry(model, row)
            numbers = np.atleast_1d(getattr(model, field)[entry[0]])
            if field in _PLACE:
                if row["element"] == "geom":
                    if model.geom_type[number] in _SHAPED:
                        raise ValueError(
                            f"geom {row['name'] or number!r} has the frame of its mesh: write into its compiled MjModel"
                        )
                    if model.geom_bodyid[number]:  # the compiler would derive its body's inertia from the geoms
                        bodies.add(int(model.geom_bodyid[number]))
                _unplace(element)
                for each in ("pos", "quat", "size"):
                    if hasattr(element, each):
                        _set(element, each, getattr(model, f"{row['element']}_{each}")[number])
                continue
            if row["angle"] and element.type != mujoco.mjtJoint.mjJNT_SLIDE and element.compiler.degree:
                numbers = np.degrees(numbers)
            _set(element, row["spec"], numbers)
    if bodies and spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO  # it ignores what is stated
        bodies |= set(np.flatnonzero(model.body_mass > 0).tolist())
    for body in bodies:
        element = _element(spec, "body", body)
        element.explicitinertial, element.mass = True, float(model.body_mass[body])
        element.ipos, element.iquat = model.body_ipos[body].tolist(), model.body_iquat[body].tolist()
        element.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        element.inertia, element.fullinertia = model.body_inertia[body].tolist(), [np.nan] * 6
    compiled = spec.compile()
    different = [
        f for f in _REPRODUCED if not np.allclose(getattr(compiled, f), getattr(model, f), rtol=1e-4, atol=1e-7)
    ]
    if different:
        raise ValueError(f"the spec compiles to another {', '.join(different)}: write into its compiled MjModel")


def _state_derived(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """State numbers of actuators that the compiler would derive from others: damping ratios, inherited ranges."""
    for actuator in spec.actuators:
        if actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE and actuator.biasprm[2] > 0:
            _set(actuator, "biasprm", model.actuator_biasprm[actuator.id])
        if actuator.inheritrange:  # from its joint, whose range the fit may have moved
            actuator.inheritrange = 0.0
            _set(actuator, "ctrlrange", model.actuator_ctrlrange[actuator.id])


def _element(spec: mujoco.MjSpec, kind: str, number: int) -> Any:
    return next(e for e in getattr(spec, "bodies" if kind == "body" else f"{kind}s") if e.id == number)


def _unplace(element: Any) -> None:
    """Take an element out of its frame, and clear alternative attributes of its pose."""
    if element.frame is not None:
        element.set_frame(element.parent.add_frame())
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if hasattr(element, "fromto"):
        element.fromto = [np.nan] * 6


def _set(element: Any, attribute: str, numbers: np.ndarray) -> None:
    old = np.array(getattr(element, attribute), dtype=float)
    if old.ndim == 0:
        setattr(element, attribute, float(numbers[0]))
    else:
        old[: len(numbers)] = numbers
        setattr(element, attribute, old.tolist())


def forces(model: mujoco.MjModel, fit: dict[str, Any] | str | Path, values: dict[str, float] | None = None) -> Laws:
    """Return the laws that MJCF cannot express, at these values (None: the fitted ones); call it after `apply`."""
    fit = fit if isinstance(fit, dict) else load(fit)
    return Laws(model, fit, fitted_values(fit) if values is None else values)


class Laws:
    """The laws of a fit on a model: call `laws(model, data)` before each step, or use it as MuJoCo's control callback.

    It sets `qfrc_applied` and the friction loss of the joints that have a law.  Add your own forces on these joints to
    `own` [nv].  `control` returns the controls of the actuators for a command.
    """

    def __init__(self, model: mujoco.MjModel, fit: dict[str, Any], values: dict[str, float]) -> None:
        self.model, self.own = model, np.zeros(model.nv)
        self._force, self._friction, self._servo, self._goals, self.delay = [], [], [], [], 0.0
        self._now = math.inf
        for law in fit["laws"]:
            tables = [(values[t["parameter"]] if t["parameter"] else 1.0, np.array(t["table"])) for t in law["terms"]]
            if law["acts"] == "command":
                self.delay += float(sum(size * table for size, table in tables))
                continue
            joint = model.joint(law["joint"]).id
            if law["acts"] in ("acceleration", "speed"):
                inverse = float(sum(size * table for size, table in tables))
                if inverse > 0:
                    u = _drive(model, joint)
                    self._goals.append(_Goal(u, law["acts"], abs(float(model.actuator_gear[u, 0])) / inverse))
                continue
            shapes = [a for a in law["axes"] if a["name"] in values]
            table = sum(size * _at(table, shapes, values) for size, table in tables)
            axes = [(a["name"], np.array(a["nodes"])) for a in law["axes"] if a["name"] not in values]
            made = _Table(joint, int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint]), axes, table)
            {"force": self._force, "frictionloss": self._friction, "servo": self._servo}[law["acts"]].append(made)
        if self.delay < 0:
            warnings.warn(
                f"the fitted delay of the command is {self.delay:.4g} s; a negative delay is not applied", stacklevel=3
            )
            self.delay = 0.0
        self._friction_dofs = np.array(sorted({t.dof for t in self._friction}), dtype=int)
        rubbed = self._friction_dofs
        model.dof_frictionloss[rubbed] = np.maximum(model.dof_frictionloss[rubbed], TINY_FRICTION)
        self._base = model.dof_frictionloss.copy()
        self._force_dofs = np.array(sorted({t.dof for t in self._force}), dtype=int)
        self._sent: list[tuple[float, np.ndarray]] = []

    def force(self, data: mujoco.MjData) -> np.ndarray:
        """Return the generalised force [nv] of the laws in this state."""
        out = np.zeros(self.model.nv)
        for table in self._force:
            out[table.dof] += table(data)
        return out

    def frictionloss(self, data: mujoco.MjData) -> np.ndarray:
        """Return the friction loss [nv] with the laws in this state; the load is the actuators' last torque."""
        out = self._base.copy()
        for table in self._friction:
            before = out[table.dof]
            out[table.dof] = max(before + table(data), min(before, 0.0))
        return out

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Set the forces and friction losses of this state."""
        forced, rubbed = self._force_dofs, self._friction_dofs
        if len(forced):
            data.qfrc_applied[forced] = (self.force(data) + self.own)[forced]
        if len(rubbed):
            loss = self.frictionloss(data)
            model.dof_frictionloss[rubbed] = np.maximum(loss[rubbed], TINY_FRICTION)
            rows = np.flatnonzero(data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
            rows = rows[np.isin(data.efc_id[rows], rubbed)]  # in a callback the constraint rows exist already
            data.efc_frictionloss[rows] = loss[data.efc_id[rows]]

    def control(self, data: mujoco.MjData, command: Any) -> np.ndarray:
        """Return the actuators' controls [nu] for a command [nu] at data.time.

        The servos' profiles, the delay and the elastic gears are applied, in this order.
        """
        ctrl = np.array(command, dtype=float)
        if self._goals:
            step, self._now = float(data.time) - self._now, float(data.time)
            for goal in self._goals:
                ctrl[goal.actuator] = goal(ctrl[goal.actuator], step)
        if self.delay > 0:
            if self._sent and data.time < self._sent[-1][0]:
                self._sent.clear()  # the simulation started over
            self._sent.append((float(data.time), ctrl))
            while len(self._sent) > 2 and self._sent[1][0] <= data.time - self.delay:
                self._sent.pop(0)
            ctrl = self._late(data.time - self.delay)
        return self._geared(data, ctrl) if self._servo else ctrl

    def _late(self, time: float) -> np.ndarray:
        """The controls that were sent at a time, interpolated."""
        (t0, first), (t1, second) = self._sent[0], self._sent[min(1, len(self._sent) - 1)]
        share = 1.0 if t1 == t0 else min(max((time - t0) / (t1 - t0), 0.0), 1.0)
        return first + share * (second - first) if t1 != t0 else first

    def _geared(self, data: mujoco.MjData, ctrl: np.ndarray) -> np.ndarray:
        """Controls with which the servos' torques equal those of elastic gears."""
        m, out = self.model, ctrl.copy()
        for table in self._servo:
            u = _drive(m, table.joint)
            gear, gain, bias = m.actuator_gear[u, 0], m.actuator_gainprm[u, 0], m.actuator_biasprm[u]
            length, speed = gear * data.qpos[table.qpos], gear * data.qvel[table.dof]
            rigid = gear * (gain * out[u] + bias[0] + bias[1] * length + bias[2] * speed)
            out[u] += table.at([rigid]) / (gear * gain)
        return out


def _drive(model: mujoco.MjModel, joint: int) -> int:
    """The actuator of a joint; if there are several, the one with position feedback."""
    at_joint = (model.actuator_trnid[:, 0] == joint) & np.isin(model.actuator_trntype, _AT_JOINT)
    servo = (model.actuator_biastype != mujoco.mjtBias.mjBIAS_NONE) & (model.actuator_biasprm[:, 1] != 0)
    return int(np.flatnonzero(at_joint & servo if (at_joint & servo).any() else at_joint)[0])


class _Goal:
    """The control that a servo follows instead of its command, with limited speed or acceleration."""

    def __init__(self, actuator: int, acts: str, limit: float) -> None:
        self.actuator, self.acts, self.limit = actuator, acts, limit
        self.position, self.speed = 0.0, 0.0

    def __call__(self, command: float, step: float) -> float:
        """Return the goal `step` s after the last one; it starts at the command and at rest, also if time goes back."""
        if step <= 0:
            self.position, self.speed = (self.position, self.speed) if step == 0 else (command, 0.0)
            return self.position
        distance = command - self.position
        if self.acts == "speed":
            self.speed = min(max(distance / step, -self.limit), self.limit)
        else:  # no faster than it can brake
            wanted = math.copysign(min(abs(distance) / step, math.sqrt(2 * self.limit * abs(distance))), distance)
            self.speed += min(max(wanted - self.speed, -self.limit * step), self.limit * step)
        self.position += self.speed * step
        return self.position


class _Table:
    """A law on one joint, piecewise linear between nodes and constant beyond them."""

    def __init__(self, joint: int, dof: int, qpos: int, axes: list[tuple[str, np.ndarray]], table: Any) -> None:
        self.joint, self.dof, self.qpos, self.axes, self.table = joint, dof, qpos, axes, np.asarray(table)

    def __call__(self, data: mujoco.MjData) -> float:
        state = {
            "position": (data.qpos, self.qpos),
            "speed": (data.qvel, self.dof),
            "load": (data.qfrc_actuator, self.dof),
        }
        return self.at([float(state[name][0][state[name][1]]) for name, _ in self.axes])

    def at(self, x: list[float]) -> float:
        """Return the law at values of its variables."""
        table = self.table
        for value, (_, nodes) in zip(x, self.axes, strict=True):
            table = _between(table, nodes, value)
        return float(table)


def _between(table: np.ndarray, nodes: np.ndarray, x: float) -> np.ndarray:
    """A table interpolated at a value of its first axis."""
    if len(nodes) == 1:
        return table[0]
    low = min(max(int(np.searchsorted(nodes, x)) - 1, 0), len(nodes) - 2)
    share = min(max((x - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0), 1.0)
    return table[low] + share * (table[low + 1] - table[low])


def _at(table: np.ndarray, shapes: list[dict[str, Any]], values: dict[str, float]) -> np.ndarray:
    """A table interpolated at values of its shape parameters, which are its first axes."""
    for axis in shapes:
        table = _between(table, np.array(axis["nodes"]), values[axis["name"]])
    return table
