"""A fit for programs without this package: the user's MJCF, fitted.json and apply_fit.py.

fitted.json holds all numbers that the fit changed, tables of the laws that MJCF cannot express, and the Gaussian;
docs/results-folder.md lists its entries.  apply_fit.py reads it and needs only numpy and mujoco.
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
from droid_jax.model.actuators import drives_joint
from droid_jax.model.effect_interface import MOVING, Effect, has_law
from droid_jax.model.inertia import PSEUDO_INERTIA, TERMS, WEIGHTS, root_of
from droid_jax.model.law_tables import LawTable, NoTable, law_tables
from droid_jax.model.mjcf import FittedFiles, field_unit, fitted_files, is_angle, mjcf_attribute, native, unwritten
from droid_jax.model.parameters import Parameter, Role, Space
from droid_jax.model.physics import entries_written, make_c_model
from droid_jax.model.scene import Scene
from droid_jax.storage import write_bytes, write_text

DIGITS = 7  # significant digits of the tables
LOSS = "dof_frictionloss"
DRAWS = 1000  # for the interval of a number that several parameters write
# Why a parameter of a role is not in the MJCF.
NOT_IN_MJCF = {
    Role.TIME_OFFSET: "delay of the commands against the measurement's clock; a property of the recording, not of the "
    "machine",
    Role.TORQUE_OFFSET: "offset of a torque sensor: it changes the reading, not the motion",
    Role.TORQUE_GAIN: "gain of a torque sensor: it changes the reading, not the motion",
    Role.VISCOUS: "friction behind a torque sensor: it changes the reading, not the motion",
    Role.COULOMB: "friction behind a torque sensor: it changes the reading, not the motion",
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
        effects: of the model.
        main: name of the MJCF, "fitted.xml".
        checks: by recording, difference of plain C MuJoCo from the replay at the fitted values.

    Returns:
        Why there is no MJCF; empty if there is one.
    """
    space, error, mjcf = gaussian.space, "", None
    try:
        mjcf = fitted_files(scene, space, values, effects, main)
    except ValueError as fault:  # the other files are still written
        error = str(fault)
    parts, patch = folder / f"{Path(main).stem}_parts", folder / f"{Path(main).stem}.patch"
    shutil.rmtree(parts, ignore_errors=True)  # of an earlier fit
    for path in (patch, folder / main):
        path.unlink(missing_ok=True)
    for name, text in (mjcf.files if mjcf else {}).items():
        write_text(folder / name, text)
    if mjcf is not None and mjcf.in_place:
        write_text(patch, mjcf.patch)
    content = neutral_json(scene, gaussian, values, effects, mjcf, error, checks or {})
    write_text(folder / FITTED_JSON, _lines(content))
    source = Path(apply_fit.__file__)
    write_bytes(folder / APPLY_FIT, source.read_bytes())
    write_bytes(folder / MJLAB_TERMS, source.with_name(MJLAB_TERMS).read_bytes())  # not imported: it needs mjlab
    return error


def _lines(content: Mapping[str, Any]) -> str:
    """JSON with a line for each entry and each object of a list, which keeps diffs of long tables readable."""

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
    mjcf: FittedFiles | None,
    error: str,
    checks: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of fitted.json (docs/results-folder.md).

    mjcf: the files of the MJCF, or None, with the reason in `error`.  For the other arguments see `write_neutral`.
    """
    space = gaussian.space
    named = dict(zip(space.names, np.asarray(values, float).tolist(), strict=True))
    intervals = dict(zip(space.names, np.stack(gaussian.interval(0.9), axis=1).tolist(), strict=True))
    priors = dict(zip(space.names, np.stack(prior(space).interval(0.9), axis=1).tolist(), strict=True))
    deviations = dict(zip(space.names, gaussian.physical_std.tolist(), strict=True))
    laws = [e for e in effects if has_law(e, MOVING)]
    fitted = (
        with_numbers(scene, space, np.asarray(values)) if laws else None
    )  # MJX may not support a scene without laws
    tables = list(law_tables(scene, fitted, laws, named, deviations))
    friction_joints = [t.joint for t in tables if isinstance(t, LawTable) and t.acts == "frictionloss"]
    rows = _rows(scene, space, effects, np.asarray(values), mjcf, friction_joints)
    drawn = [dict(zip(space.names, row, strict=True)) for row in gaussian.sample(0, DRAWS).tolist()]
    inertias = _inertias(scene, space)
    for row in rows:
        row |= {"value": apply_fit.number_of(row, named), "interval": _interval(row, intervals, drawn)}
        row["prior"] = _interval(row, priors, [])
    for inertia in inertias:
        _set_inertia_rows(rows, inertia, named, drawn)
    by_entry = {(row["field"], *row["own"]): row for row in rows}
    changes = [
        {**asdict(c), "interval": None, "unit": ""} | _of_row(by_entry.get((c.field, *c.entry)), c.after)
        for c in (mjcf.changes if mjcf else ())
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
        "drives": _drives(scene, space, effects, np.asarray(values), tables),
        "not_in_mjcf": _lacking(scene, space, effects, tables),
        "mjcf": {
            "file": None if mjcf is None else next(iter(mjcf.files)),
            "error": error,
            "in_place": bool(mjcf and mjcf.in_place),
            "reason": mjcf.reason if mjcf else "",
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


def _drives(
    scene: Scene, space: Space, effects: Sequence[Effect], values: np.ndarray, tables: Sequence[LawTable | NoTable]
) -> list[dict[str, Any]]:
    """The position servo of each driven joint in the terms of Isaac Lab and Newton, all at the joint's side.

    The damping is that of all actuators of the joint, the friction with the constant one of effects.  Other laws of
    effects on the joint are named.
    """
    model, out = make_c_model(scene, space, values), list[dict[str, Any]]()
    friction, rigid = model.dof_frictionloss.copy(), set[str]()  # rigid: effects that a number expresses
    for effect in effects:
        added = {row: by for (field, row), by in (native(effect, space, values, model) or {}).items() if field == LOSS}
        friction[list(added)] += list(added.values())
        rigid |= {effect.name} if added else set()
    damping = np.where(drives_joint(model), -model.actuator_biasprm[:, 2] * model.actuator_gear[:, 0] ** 2, 0.0)
    damping[model.actuator_biastype != mujoco.mjtBias.mjBIAS_AFFINE] = 0.0
    for joint in scene.driven_joints:
        u, j, d = scene.command_names.index(joint), scene.id("joint", joint), scene.dof(joint)
        gear, bias = float(model.actuator_gear[u, 0]), model.actuator_biasprm[u]
        ends = [abs(gear) * np.abs(model.actuator_forcerange[u]).max()] if model.actuator_forcelimited[u] else []
        ends += [np.abs(model.jnt_actfrcrange[j]).max()] if model.jnt_actfrclimited[j] else []
        out.append({
            "joint": joint, "unit": scene.torque_unit([joint]), "stiffness": -float(bias[1]) * gear**2,
            "damping": float(damping[drives_joint(model) & (model.actuator_trnid[:, 0] == j)].sum()),
            "viscous_friction": float(model.dof_damping[d]), "friction": max(float(friction[d]), 0.0),
            "armature": float(model.dof_armature[d]), "effort_limit": float(min(ends)) if ends else None,
            "velocity_limit": None,
            "left_out": sorted({t.effect for t in tables if joint in _joints_of(t) and t.effect not in rigid}),
        })  # fmt: skip
    return out


def _joints_of(law: LawTable | NoTable) -> tuple[str, ...]:
    """The joint on which a law acts; where it has no table, its location, which may be a joint."""
    return (law.joint,) if isinstance(law, LawTable) else (law.location,)


def with_numbers(scene: Scene, space: Space, values: np.ndarray) -> Any:
    """Return the scene's mjx.Model with the fields that parameters write; derived fields are not updated."""
    model = make_c_model(scene, space, values)
    fields = {field for field, _ in entries_written(space)}
    return scene.mjx.replace(**{f: np.asarray(getattr(model, f), np.float32) for f in sorted(fields)})


def _check(check: Any) -> dict[str, Any]:
    """Difference of plain C MuJoCo from the replay."""
    keys = ("channel", "unit", "parity_rms", "parity_largest", "parity_angle", "discretisation")
    return {key: getattr(check, key) for key in keys}


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
    mjcf: FittedFiles | None,
    friction_joints: Sequence[str],
) -> list[dict[str, Any]]:
    """A row for every number of the model that `apply_fit` sets.

    These are the numbers that parameters write, that express an effect's law in the MJCF, or that the fit changed in
    the scene.

    friction_joints: joints with a law of friction.
    """
    writes: dict[tuple[str, tuple[int, ...]], list[dict[str, Any]]] = {}
    for p in space.parameters:
        for w in p.writes:
            if w.field == PSEUDO_INERTIA:
                entries = [(f, k) for f in WEIGHTS for k in np.ndindex(getattr(scene.model, f)[w.index[0]].shape)]
                writes.update({(f, (w.index[0], *k)): [] for f, k in entries})
                continue
            write = {"parameter": p.name, "mode": w.mode.value, "gain": w.gain, "offset": w.offset}
            writes.setdefault((w.field, w.index), []).append(write)
    model = make_c_model(scene, space, values)
    for effect in effects:  # the table holds its law, so the number that expresses it in the MJCF is set to nominal
        for field, row in native(effect, space, values, model) or {}:
            writes.setdefault((field, (int(row),)), [])
    for joint in scene.held:  # the fit changed solimp so that these joints do not creep
        for dof in np.flatnonzero(scene.model.dof_jntid == scene.id("joint", joint)).tolist():
            for k in range(2):
                writes.setdefault(("dof_solimp", (dof, k)), [])
    for joint in friction_joints:  # `Laws` changes this number in every step
        writes.setdefault(("dof_frictionloss", (scene.dof(joint),)), [])
    for body in {index[0] for field, index in writes if field == "body_inertia"}:  # a draw needs all three moments
        for k in range(3):
            writes.setdefault(("body_inertia", (body, k)), [])
    attributes = {(c.field, c.entry): (c.attribute, c.index) for c in (mjcf.changes if mjcf else ())}
    return [_row(scene, field, index, of, attributes) for (field, index), of in writes.items()]


def _inertias(scene: Scene, space: Space) -> list[dict[str, Any]]:
    """Bodies whose full inertia is fitted: the root of their pseudo-inertia, and the parameters of its ten terms."""
    bodies = dict[int, list[dict[str, Any] | None]]()
    for p in space.parameters:
        for w in p.writes:
            if w.field == PSEUDO_INERTIA:
                terms = bodies.setdefault(w.index[0], [None] * len(TERMS))
                terms[w.index[1]] = {"parameter": p.name, "gain": w.gain, "offset": w.offset}
    return [
        {
            "name": scene.model.body(body).name,
            "id": body,
            "root": root_of(*(np.asarray(getattr(scene.model, f)[body], float) for f in WEIGHTS)).tolist(),
            "terms": terms,
        }
        for body, terms in bodies.items()
    ]


def _set_inertia_rows(
    rows: Sequence[dict[str, Any]], inertia: dict[str, Any], values: dict[str, float], drawn: list[dict[str, float]]
) -> None:
    """Set values and intervals of the rows of a body whose full inertia is fitted; the intervals are of draws."""
    best, draws = apply_fit.inertia_of(inertia, values), [apply_fit.inertia_of(inertia, each) for each in drawn]
    for row in rows:
        if row["field"] in WEIGHTS and row["own"][0] == inertia["id"]:
            at = row["own"][1:]
            row["value"] = float(best[row["field"]][at])
            if row["field"] != "body_iquat":  # the order of nearly equal moments, and so the axes, differ between draws
                row["interval"] = np.quantile([d[row["field"]][at] for d in draws], [0.05, 0.95]).tolist()


def _row(
    scene: Scene,
    field: str,
    index: tuple[int, ...],
    writes: list[dict[str, Any]],
    attributes: Mapping[tuple[str, tuple[int, ...]], tuple[str, int]],
) -> dict[str, Any]:
    """The row of a number of the model; attributes: MJCF attribute, and index in it, of the numbers of the MJCF."""
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
    attribute, position = attributes.get((field, index), (attribute, column or 0))
    slides = element == "joint" and model.jnt_type[number] == mujoco.mjtJoint.mjJNT_SLIDE
    return {
        "element": element,
        "name": getattr(model, element)(number).name,
        "id": int(scene.full_geom_ids[number]) if element == "geom" else int(number),
        "attribute": attribute,
        "index": position,
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
    """90 % interval of a row's number: of its parameter, or of draws if several parameters write it."""
    names = {w["parameter"] for w in row["writes"]}
    if len(names) == 1:
        (name,) = names
        return sorted(apply_fit.number_of(dict(row), {name: end}) for end in intervals[name])
    if not names or not drawn:
        return None
    return np.quantile([apply_fit.number_of(dict(row), values) for values in drawn], [0.05, 0.95]).tolist()


def _of_row(row: Mapping[str, Any] | None, after: float) -> dict[str, Any]:
    """Interval and unit of a changed number as the MJCF states it, which may have another sign or be in degrees."""
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
    """Numbers of a table, rounded to DIGITS."""
    if numbers.ndim == 0:
        return float(f"{float(numbers):.{DIGITS}g}")
    return [_short(part) for part in numbers]


def _lacking(
    scene: Scene, space: Space, effects: Sequence[Effect], tables: Sequence[LawTable | NoTable]
) -> list[dict[str, str]]:
    """Parameters that the MJCF does not hold, each with the reason and what applies it instead."""
    owner = {p.name: e for e in effects for p in e.parameters}
    out: list[dict[str, str]] = []
    for name in unwritten(scene, space):
        p, effect = space[name], owner.get(name)
        if effect is not None and not p.writes:
            of_effect = [t for t in tables if t.effect == effect.name]
            has_table = any(isinstance(t, LawTable) for t in of_effect)
            without = next((t.why for t in of_effect if isinstance(t, NoTable)), "")
            why = (
                "`forces` of apply_fit.py has its law" + (", but not its effect on readings" if effect.observe else "")
                if has_table
                else without or ("it changes the reading, not the motion" if effect.observe else "it has no table")
            )
            why = f"{effect.description}; {why}"
        elif p.writes:
            why = "MJCF has no attribute for it; `apply` of apply_fit.py writes it into a compiled MjModel"
        else:
            why = NOT_IN_MJCF.get(p.role, "it lives outside the model")
        out.append({"parameter": name, "why": why})
    return out
