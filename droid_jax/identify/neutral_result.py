"""A fit for programs that have MuJoCo and not this one: the user's MJCF, fitted.json and apply_fit.py.

fitted.json holds every number that the fit changed, the laws that no MJCF can hold as tables, and the Gaussian;
docs/results-folder.md lists its entries.  apply_fit.py reads it with numpy and mujoco alone.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from droid_jax.files import APPLY_FIT, FITTED_JSON, MJLAB_TERMS
from droid_jax.identify import apply_fit
from droid_jax.identify.gaussian import Gaussian, prior
from droid_jax.model.effect_interface import Effect
from droid_jax.model.inertia import PSEUDO_INERTIA, TERMS, WEIGHTS, root_of
from droid_jax.model.law_tables import LawTable, NoTable, law_tables
from droid_jax.model.mjcf import FittedFiles, field_unit, fitted_files, is_angle, mjcf_attribute, native, unwritten
from droid_jax.model.parameters import Parameter, Role, Space
from droid_jax.model.physics import entries_written, make_c_model
from droid_jax.model.scene import Scene
from droid_jax.storage import write_bytes, write_text

DIGITS = 7  # of the tables' numbers
DRAWS = 1000  # behind the interval of a number that several parameters write
OF_RECORDING = "belongs to the recording, not to the machine"
WHY = {
    Role.TIME_OFFSET: f"delay of the commands against the measurement's clock; {OF_RECORDING}",
    Role.TORQUE_OFFSET: "offset of a torque sensor: it changes what is read, not what moves",
    Role.TORQUE_GAIN: "gain of a torque sensor: it changes what is read, not what moves",
    Role.VISCOUS: "friction behind a torque sensor: it changes what is read, not what moves",
    Role.COULOMB: "friction behind a torque sensor: it changes what is read, not what moves",
}


def write_neutral(
    folder: Path,
    scene: Scene,
    gaussian: Gaussian,
    values: np.ndarray,
    effects: Sequence[Effect] = (),
    *,
    main: str,
    checks: Mapping[str, Any] | None = None,
) -> str:
    """Write the MJCF with the fitted values, fitted.json, apply_fit.py and mjlab_terms.py into a folder.

    Args:
        folder: of the results.
        scene: that was fitted.
        gaussian: over all fitted parameters.
        values: [D] fitted values over its space.
        effects: of the model, with functions of their own or without.
        main: name of the MJCF, "fitted.xml".
        checks: by recording, how far plain C MuJoCo is from the replay at the fitted values.

    Returns:
        Why there is no MJCF, empty where there is one.
    """
    space, error, made = gaussian.space, "", None
    try:
        made = fitted_files(scene, space, values, effects, main)
    except ValueError as fault:  # the fit itself is whole
        error = str(fault)
    parts, patch = folder / f"{Path(main).stem}_parts", folder / f"{Path(main).stem}.patch"
    shutil.rmtree(parts, ignore_errors=True)  # of a fit before
    for path in (patch, folder / main):
        path.unlink(missing_ok=True)
    for name, text in (made.files if made else {}).items():
        write_text(folder / name, text)
    if made is not None and made.in_place:
        write_text(patch, made.patch)
    content = neutral_json(scene, gaussian, values, effects, made, error, checks or {})
    write_text(folder / FITTED_JSON, _lines(content))
    own = Path(apply_fit.__file__)
    write_bytes(folder / APPLY_FIT, own.read_bytes())
    write_bytes(folder / MJLAB_TERMS, own.with_name(MJLAB_TERMS).read_bytes())  # read, since few have what it imports
    return error


def _lines(content: Mapping[str, Any]) -> str:
    """JSON with a line for each entry, and for each in a list of objects: tables are long, and diffs are read."""

    def text(value: Any) -> str:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return "[\n  " + ",\n  ".join(text(each) for each in value) + "\n ]"
        return json.dumps(value, allow_nan=False)

    return "{\n " + ",\n ".join(f"{json.dumps(key)}: {text(value)}" for key, value in content.items()) + "\n}\n"


def neutral_json(
    scene: Scene,
    gaussian: Gaussian,
    values: np.ndarray,
    effects: Sequence[Effect],
    made: FittedFiles | None,
    error: str,
    checks: Mapping[str, Any],
) -> dict[str, Any]:
    """The content of fitted.json (docs/results-folder.md)."""
    space = gaussian.space
    named = dict(zip(space.names, np.asarray(values, float).tolist(), strict=True))
    intervals = dict(zip(space.names, np.stack(gaussian.interval(0.9), axis=1).tolist(), strict=True))
    priors = dict(zip(space.names, np.stack(prior(space).interval(0.9), axis=1).tolist(), strict=True))
    deviations = dict(zip(space.names, gaussian.physical_std.tolist(), strict=True))
    laws = [e for e in effects if e.profile or e.command or e.servo or e.force or e.frictionloss]
    fitted = with_numbers(scene, space, np.asarray(values)) if laws else None  # not of a scene that MJX has not
    tables = list(law_tables(scene, fitted, laws, named, deviations))
    dry = [t.joint for t in tables if isinstance(t, LawTable) and t.acts == "frictionloss"]
    rows = _rows(scene, space, effects, np.asarray(values), made, dry)
    drawn = [dict(zip(space.names, row, strict=True)) for row in gaussian.sample(0, DRAWS).tolist()]
    inertias = _inertias(scene, space)
    for row in rows:
        row |= {"value": apply_fit.number_of(row, named), "interval": _interval(row, intervals, drawn)}
        row["prior"] = _interval(row, priors, [])
    for inertia in inertias:
        _weigh(rows, inertia, named, drawn)
    at = {(row["field"], *row["own"]): row for row in rows}
    changes = [
        {**asdict(c), "interval": None, "unit": ""} | _of_row(at.get((c.field, *c.entry)), c.before, c.after)
        for c in (made.changes if made else ())
    ]
    return {
        "format": apply_fit.FORMAT,
        "version": apply_fit.VERSION,
        "mujoco": mujoco.__version__,
        "scene": {
            "name": scene.name,
            "file": None if scene.path is None else str(scene.path),
            "timestep": float(scene.model.opt.timestep),
            "joints": list(scene.joints),
        },
        "parameters": [_parameter(p, named[p.name], intervals[p.name]) for p in space.parameters],
        "table": [{k: v for k, v in row.items() if k != "own"} for row in rows],
        "inertias": inertias,
        "laws": [_law(law) for law in tables if isinstance(law, LawTable)],
        "drives": _drives(scene, make_c_model(scene, space, np.asarray(values))),
        "not_in_mjcf": _lacking(scene, space, effects, tables),
        "mjcf": {
            "file": None if made is None else next(iter(made.files)),
            "error": error,
            "in_place": bool(made and made.in_place),
            "reason": made.reason if made else "",
            "changes": [{k: v for k, v in c.items() if k not in ("field", "entry")} for c in changes],
        },
        "engines": {name: _check(check) for name, check in checks.items() if check.parity_rms is not None},
        "gaussian": {
            "coordinates": gaussian.coordinates,
            "rule": gaussian.rule,
            "mean": gaussian.mean.tolist(),
            "cov": gaussian.cov.tolist(),
        },
    }


def _drives(scene: Scene, model: mujoco.MjModel) -> list[dict[str, Any]]:
    """The position servo of each driven joint in the terms that Isaac Lab and Newton have for it, all at the joint."""
    out: list[dict[str, Any]] = []
    for joint in scene.driven_joints:
        u, j, d = scene.command_names.index(joint), scene.id("joint", joint), scene.dof(joint)
        gear, bias = float(model.actuator_gear[u, 0]), model.actuator_biasprm[u]
        ends = [abs(gear) * np.abs(model.actuator_forcerange[u]).max()] if model.actuator_forcelimited[u] else []
        ends += [np.abs(model.jnt_actfrcrange[j]).max()] if model.jnt_actfrclimited[j] else []
        out.append({
            "joint": joint, "unit": scene.torque_unit([joint]), "stiffness": -float(bias[1]) * gear**2,
            "damping": abs(float(bias[2])) * gear**2, "viscous_friction": float(model.dof_damping[d]),
            "friction": float(model.dof_frictionloss[d]), "armature": float(model.dof_armature[d]),
            "effort_limit": float(min(ends)) if ends else None, "velocity_limit": None,
        })  # fmt: skip
    return out


def with_numbers(scene: Scene, space: Space, values: np.ndarray) -> Any:
    """The mjx.Model with the numbers that parameters write; what MuJoCo derives from them is the scene's."""
    model = make_c_model(scene, space, values)
    fields = {field for field, _ in entries_written(space)}
    return scene.mjx.replace(**{f: np.asarray(getattr(model, f), np.float32) for f in sorted(fields)})


def _check(check: Any) -> dict[str, Any]:
    """How far plain C MuJoCo is from the replay."""
    kept = ("channel", "unit", "parity_rms", "parity_largest", "parity_angle", "discretisation")
    return {key: getattr(check, key) for key in kept}


def _parameter(p: Parameter, value: float, interval: list[float]) -> dict[str, Any]:
    return {
        "name": p.name, "unit": p.unit, "value": value, "interval": interval,
        "prior": {"mean": p.mean, "std": p.std}, "low": p.low, "high": p.high, "nuisance": p.nuisance,
        "scaling": p.scaling.value, "log_offset": p.log_offset, "width": p.width,
    }  # fmt: skip


def _rows(
    scene: Scene,
    space: Space,
    effects: Sequence[Effect],
    values: np.ndarray,
    made: FittedFiles | None,
    dry: Sequence[str],
) -> list[dict[str, Any]]:
    """A row for every number of the model that parameters write, those in which an MJCF states a law, and those that a
    fit changed besides; dry: joints with a law of friction.
    """
    writes: dict[tuple[str, tuple[int, ...]], list[dict[str, Any]]] = {}
    for p in space.parameters:
        for w in p.writes:
            if w.field == PSEUDO_INERTIA:
                own = [(f, k) for f in WEIGHTS for k in np.ndindex(getattr(scene.model, f)[w.index[0]].shape)]
                writes.update({(f, (w.index[0], *k)): [] for f, k in own})
                continue
            one = {"parameter": p.name, "mode": w.mode.value, "gain": w.gain, "offset": w.offset}
            writes.setdefault((w.field, w.index), []).append(one)
    model = make_c_model(scene, space, values)
    for effect in effects:  # its law has a table; the number that the MJCF has for it goes back
        for field, row in native(effect, space, values, model) or {}:
            writes.setdefault((field, (int(row),)), [])
    for joint in scene.held:  # whose friction the fit held, and creeps as the MJCF has it
        for dof in np.flatnonzero(scene.model.dof_jntid == scene.id("joint", joint)).tolist():
            for k in range(2):
                writes.setdefault(("dof_solimp", (dof, k)), [])
    for joint in dry:  # `Laws` works on this number, and starts from the fit's each time
        writes.setdefault(("dof_frictionloss", (scene.dof(joint),)), [])
    said = {(c.field, c.entry): (c.attribute, c.index) for c in (made.changes if made else ())}
    return [_row(scene, field, index, of, said) for (field, index), of in writes.items()]


def _inertias(scene: Scene, space: Space) -> list[dict[str, Any]]:
    """Bodies whose whole inertia is a parameter: the root of their pseudo-inertia, and what sets its ten terms."""
    found = dict[int, list[dict[str, Any] | None]]()
    for p in space.parameters:
        for w in p.writes:
            if w.field == PSEUDO_INERTIA:
                terms = found.setdefault(w.index[0], [None] * len(TERMS))
                terms[w.index[1]] = {"parameter": p.name, "gain": w.gain, "offset": w.offset}
    return [
        {
            "name": scene.model.body(body).name,
            "id": body,
            "root": root_of(*(np.asarray(getattr(scene.model, f)[body], float) for f in WEIGHTS)).tolist(),
            "terms": terms,
        }
        for body, terms in found.items()
    ]


def _weigh(
    rows: Sequence[dict[str, Any]], inertia: dict[str, Any], values: dict[str, float], drawn: list[dict[str, float]]
) -> None:
    """Values and intervals of the rows of a body whose whole inertia is a parameter, by its draws."""
    best, draws = apply_fit.inertia_of(inertia, values), [apply_fit.inertia_of(inertia, each) for each in drawn]
    for row in rows:
        if row["field"] in WEIGHTS and row["own"][0] == inertia["id"]:
            at = row["own"][1:]
            row["value"] = float(best[row["field"]][at])
            if row["field"] != "body_iquat":  # nearly equal moments change places from draw to draw, and axes with them
                row["interval"] = np.quantile([d[row["field"]][at] for d in draws], [0.05, 0.95]).tolist()


def _row(
    scene: Scene,
    field: str,
    index: tuple[int, ...],
    writes: list[dict[str, Any]],
    said: Mapping[tuple[str, tuple[int, ...]], tuple[str, int]],
) -> dict[str, Any]:
    model, kind = scene.model, field.split("_")[0].rstrip("0")
    first, rest, offset = index[0], index[1:], 0
    number, column = first, rest[0] if rest else None
    if kind == "dof":
        number = int(model.dof_jntid[first])
        offset = first - int(model.jnt_dofadr[number])
    elif kind == "qpos":
        number = int(np.searchsorted(model.jnt_qposadr, first, side="right")) - 1
    element = {"dof": "joint", "jnt": "joint", "qpos": "joint"}.get(kind, kind)
    spec, attribute = mjcf_attribute(field)
    attribute, place = said.get((field, index), (attribute, column or 0))
    slides = element == "joint" and model.jnt_type[number] == mujoco.mjtJoint.mjJNT_SLIDE
    return {
        "element": element,
        "name": getattr(model, element)(number).name,
        "id": int(scene.full_geom_ids[number]) if element == "geom" else int(number),
        "attribute": attribute,
        "index": place,
        "unit": field_unit(field, bool(slides)),
        "field": field,
        "column": column,
        "offset": offset,
        "own": tuple(int(i) for i in index),
        "spec": spec,
        "angle": is_angle(field),
        "nominal": float(getattr(model, field)[index]),
        "writes": writes,
    }


def _interval(
    row: Mapping[str, Any], intervals: Mapping[str, list[float]], drawn: list[dict[str, float]]
) -> list[float] | None:
    """90 % interval of a row's number: of its parameter, or of draws where several write it."""
    names = {w["parameter"] for w in row["writes"]}
    if len(names) == 1:
        (name,) = names
        return sorted(apply_fit.number_of(dict(row), {name: end}) for end in intervals[name])
    if not names or not drawn:
        return None
    return np.quantile([apply_fit.number_of(dict(row), values) for values in drawn], [0.05, 0.95]).tolist()


def _of_row(row: Mapping[str, Any] | None, before: float, after: float) -> dict[str, Any]:
    """Interval and unit of a changed number, in the words of the MJCF: of another sign, or in degrees."""
    if row is None or row["interval"] is None:
        return {}
    number, ends = row["value"], row["interval"]
    factor = after / number if number else 1.0
    unit = row["unit"] if abs(factor - 1.0) < 1e-6 else "degree" if abs(factor - 180 / np.pi) < 1e-3 else row["unit"]
    return {"interval": sorted(factor * end for end in ends), "unit": unit}


def _law(law: LawTable) -> dict[str, Any]:
    return {
        "effect": law.effect, "location": law.location, "description": law.description, "acts": law.acts,
        "joint": law.joint, "unit": law.unit, "error": law.error, "error_of_draws": law.error_of_draws,
        "axes": [{"name": a.name, "unit": a.unit, "nodes": _short(a.nodes)} for a in law.axes],
        "terms": [{"parameter": name, "table": _short(table)} for name, table in law.terms],
    }  # fmt: skip


def _short(numbers: np.ndarray) -> Any:
    """Numbers of a table with as many digits as they are worth."""
    if numbers.ndim == 0:
        return float(f"{float(numbers):.{DIGITS}g}")
    return [_short(part) for part in numbers]


def _lacking(
    scene: Scene, space: Space, effects: Sequence[Effect], tables: Sequence[LawTable | NoTable]
) -> list[dict[str, str]]:
    """What the MJCF does not hold, each with what to do about it."""
    owner = {p.name: e for e in effects for p in e.parameters}
    out: list[dict[str, str]] = []
    for name in unwritten(scene, space):
        p, effect = space[name], owner.get(name)
        if effect is not None and not p.writes:
            mine = [t for t in tables if t.effect == effect.name]
            table = any(isinstance(t, LawTable) for t in mine)
            without = next((t.why for t in mine if isinstance(t, NoTable)), "")
            why = (
                "`forces` of apply_fit.py has its law" + (", but not what is read otherwise" if effect.observe else "")
                if table
                else without or ("it changes what is read, not what moves" if effect.observe else "it has no table")
            )
            why = f"{effect.description}; {why}"
        elif p.writes:
            why = "MJCF has no attribute for it; `apply` of apply_fit.py writes it into a compiled MjModel"
        else:
            why = WHY.get(p.role, "it lives outside the model")
        out.append({"parameter": name, "why": why})
    return out
