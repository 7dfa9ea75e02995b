"""Write a fitted model into the user's MJCF by replacing the numbers that differ, and nothing else.

Elements are found by their order in the file, in which MuJoCo compiles them, and by their names.  `NotInPlace` is
raised if replacing numbers cannot express a change: for elements that one tag makes several of (replicate, composite),
poses inside a frame, and actuator shortcuts without the attribute.  The caller compiles and compares the result.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from droid_jax.model.xml_text import Tag, Tree, read_tree, with_edits

MAKES_SEVERAL = ("replicate", "composite", "flexcomp", "attach")
TURNS = ("euler", "axisangle", "xyaxes", "zaxis")
# Attributes with a fixed count of numbers; of others, numbers up to the last changed one are written.
FIXED = ("range", "pos", "quat", "axis", "actuatorfrcrange", "ctrlrange", "forcerange")
TINY = 1e-9  # relative difference up to which the text of a number is not replaced


class NotInPlace(ValueError):
    """Replacing numbers in the user's file does not give the fitted model; the message says why."""


@dataclass(frozen=True)
class Change:
    """A number that a fit changed.

    Attributes:
        element: kind of the element, such as "joint".
        name: of the element.
        attribute, index: in the MJCF.
        field, entry: in the MuJoCo model.
        before, after: in the MJCF's unit (degrees if it uses them).
        file, line: of the tag; "" and 0 if the scene has no file.
        origin: of the old number; "" for the element, else its default class or MuJoCo's default.
    """

    element: str
    name: str
    attribute: str
    index: int
    field: str
    entry: tuple[int, ...]
    before: float
    after: float
    file: str = ""
    line: int = 0
    origin: str = ""


@dataclass(frozen=True)
class WantedNumber:
    """New numbers of an attribute of an element.

    Attributes:
        element: kind of the element.
        row: index of the element among its kind in the compiled model.
        attribute: in the MJCF.
        before, after: [n] all numbers of the attribute.
        field: in the MuJoCo model.
    """

    element: str
    row: int
    attribute: str
    before: np.ndarray
    after: np.ndarray
    field: str


@dataclass(frozen=True)
class PlacedNumber:
    """Where a number is written: attribute ("" if another one implies it); file, line and origin as in `Change`."""

    attribute: str
    file: str = ""
    line: int = 0
    origin: str = ""


@dataclass(frozen=True, eq=False)
class Edited:
    """The result of `edit`.

    Attributes:
        files: name -> text, for one folder, the main file first; paths in them are absolute.
        patch: the same changes to the user's files, as a unified diff.
        placed: for each `WantedNumber`.
        bodies: body with a new inertia -> file and line.
    """

    files: dict[str, str]
    patch: str
    placed: tuple[PlacedNumber, ...]
    bodies: dict[int, tuple[str, int]]


def edit(
    path: Path,
    spec: mujoco.MjSpec,
    wanted: Sequence[WantedNumber],
    new_inertia: Mapping[int, mujoco.MjModel],
    main: str,
) -> Edited:
    """The user's files with numbers replaced.

    Args:
        path: of the main file.
        spec: of that file, compiled so that its elements are numbered.
        wanted: the numbers.
        new_inertia: body -> model with its new mass, centre of mass and inertia.
        main: name of the main file in the result; changed included files go to a folder "STEM_parts" beside it.

    Returns:
        The files.

    Raises:
        NotInPlace: replacing numbers cannot express the changes.
        ValueError: a file is missing, or was changed since the spec was read.
    """
    tree = read_tree(path)
    if tree.root.name != "mujoco":
        raise NotInPlace(f"{path.name} is a <{tree.root.name}>, not an MJCF")
    tags = _elements(tree, spec)
    edits: dict[Tag, dict[str, str | None]] = {}
    inserted: dict[Tag, str] = {}
    placed: list[PlacedNumber] = []
    for want in wanted:
        tag = tags[want.element][want.row]
        attributes = _attribute(tag, want)
        name = next((k for k, v in attributes.items() if v is not None), "")
        origin = "" if not name or name in tag.attributes else _origin(tree, tag, name)
        placed.append(PlacedNumber(name, tag.file.name, tag.line, origin))
        edits.setdefault(tag, {}).update(attributes)
    for body, model in new_inertia.items():
        _write_inertia(tags["body"][body], body, model, edits, inserted)
    bodies = {body: (tags["body"][body].file.name, tags["body"][body].line) for body in new_inertia}
    changed = with_edits(tree, edits, inserted)
    names = _names(tree, main)
    paths = _absolute(tree, spec, changed, names)
    merged = {tag: {**edits.get(tag, {}), **paths.get(tag, {})} for tag in {**edits, **paths}}
    with_paths = with_edits(tree, merged, inserted)
    texts = {tree.root.file: tree.texts[tree.root.file].decode("utf-8"), **with_paths}
    files = {names[file]: text for file, text in texts.items()}
    return Edited(files, _patch(tree, changed), tuple(placed), bodies)


def _elements(tree: Tree, spec: mujoco.MjSpec) -> dict[str, list[Tag]]:
    """The tags of each kind in the order of the compiled model; NotInPlace if they do not agree with the spec."""
    several = next((tag for tag in tree.root.walk() if tag.name in MAKES_SEVERAL), None)
    if several is not None:
        raise NotInPlace(f"{several.file.name}, line {several.line}: <{several.name}> makes further elements")
    sections = {
        name: [t for t in tree.root.children if t.name == name] for name in ("worldbody", "actuator", "contact")
    }
    bodies = [None, *(tag for world in sections["worldbody"] for tag in _bodies(world))]
    found: dict[str, list[Tag]] = {"body": [tree.root], "joint": [], "geom": []}
    for body in bodies:
        for owner in [body] if body is not None else sections["worldbody"]:
            found["joint"] += _own(owner, ("joint", "freejoint"))
            found["geom"] += _own(owner, ("geom",))
        found["body"] += [] if body is None else [body]
    found["actuator"] = [tag for section in sections["actuator"] for tag in section.children]
    pairs = [tag for section in sections["contact"] for tag in section.children if tag.name == "pair"]
    named = {
        _pair_key(t.attributes.get("name", ""), t.attributes.get("geom1"), t.attributes.get("geom2")): t for t in pairs
    }
    found["pair"] = [
        tag
        for p in sorted(spec.pairs, key=lambda p: p.id)
        if (tag := named.get(_pair_key(p.name, p.geomname1, p.geomname2)))
    ]
    of_spec = {
        "body": spec.bodies,
        "joint": spec.joints,
        "geom": spec.geoms,
        "actuator": spec.actuators,
        "pair": spec.pairs,
    }
    for kind, elements in of_spec.items():
        expected = [e.name for e in sorted(elements, key=lambda e: e.id)]
        names = [tag.attributes.get("name", "") for tag in found[kind]]
        if kind == "body":
            names[0] = expected[0]
        if names != expected:
            raise NotInPlace(f"the {kind} elements of {tree.root.file.name} are not in the order of the model")
    return found


def _pair_key(name: str, one: str | None, two: str | None) -> tuple[str, ...]:
    return (name,) if name else ("", one or "", two or "")


def _bodies(tag: Tag) -> Iterator[Tag]:
    """Yield the bodies below a tag in MuJoCo's order, each before its children."""
    for child in tag.children:
        if child.name == "body":
            yield child
        if child.name in ("body", "frame"):
            yield from _bodies(child)


def _own(tag: Tag, names: tuple[str, ...]) -> Iterator[Tag]:
    """Yield the elements of a body, including those in its frames."""
    for child in tag.children:
        if child.name in names:
            yield child
        elif child.name == "frame":
            yield from _own(child, names)


def _origin(tree: Tree, tag: Tag, attribute: str) -> str:
    """The default that sets a number which the element does not state, for messages."""
    classes = {t.attributes.get("class", "main"): t for t in tree.root.walk() if t.name == "default"}
    given = tag.attributes.get("class") or next(
        (
            t.attributes["childclass"]
            for t in tag.within()
            if t.name in ("body", "frame") and "childclass" in t.attributes
        ),
        "main",
    )
    default: Tag | None = classes.get(given)
    while default is not None:
        of_kind = next((c for c in default.children if c.name == tag.name and attribute in c.attributes), None)
        if of_kind is not None:
            named = default.attributes.get("class", "main")
            return f"default class {named!r}, {of_kind.file.name} line {of_kind.line}"
        default = default.parent if default.parent is not None and default.parent.name == "default" else None
    return "MuJoCo's default"


def _attribute(tag: Tag, want: WantedNumber) -> dict[str, str | None]:
    """Attributes of a tag with the new numbers; None removes an attribute."""
    name, before, after = want.attribute, want.before, want.after
    if name in ("gainprm", "biasprm") and tag.name != "general":
        return _servo(tag, want)
    if want.element in ("body", "geom") and name in ("pos", "quat", "size"):
        if name != "size" and (tag.parent is not None and tag.parent.name == "frame"):
            raise NotInPlace(f"{tag.file.name}, line {tag.line}: the pose of a {tag.name} inside a frame")
        if "fromto" in tag.attributes and (name != "size" or np.any(before[1:] != after[1:])):
            raise NotInPlace(f"{tag.file.name}, line {tag.line}: a geom that is given by fromto")
    out: dict[str, str | None] = {}
    if name == "quat":
        out = {turn: None for turn in TURNS if turn in tag.attributes}
    tokens = tag.attributes.get(name, "").split()
    last = int(np.flatnonzero(before != after)[-1]) + 1
    count = len(after) if name in FIXED else max(len(tokens), last)
    out[name] = " ".join(_token(after[i], tokens[i] if i < len(tokens) else None) for i in range(count))
    return out


def _servo(tag: Tag, want: WantedNumber) -> dict[str, str | None]:
    """Attributes kp and kv of an actuator shortcut (<position>, <velocity>)."""
    after, field = want.after, want.attribute
    if tag.name == "position" and field == "gainprm" and not after[1:].any():
        return {"kp": _token(after[0], tag.attributes.get("kp"))}
    if tag.name == "position" and field == "biasprm" and not after[0] and not after[3:].any():
        if want.before[2] == after[2]:
            return {}  # -kp, which kp implies
        return {"kv": _token(-after[2], tag.attributes.get("kv")), "dampratio": None}
    if tag.name == "velocity" and field == "gainprm" and not after[1:].any():
        return {"kv": _token(after[0], tag.attributes.get("kv"))}
    if tag.name == "velocity" and field == "biasprm":
        return {}
    raise NotInPlace(f"{tag.file.name}, line {tag.line}: <{tag.name}> has no attribute for its {field}")


def _token(number: float, old: str | None) -> str:
    """A number as text; the old text if it is the same number."""
    try:
        if old is not None and abs(float(old) - number) <= TINY * abs(number):
            return old
    except ValueError:
        pass
    return f"{number:.8g}"


def _write_inertia(
    tag: Tag, body: int, model: mujoco.MjModel, edits: dict[Tag, dict[str, str | None]], inserted: dict[Tag, str]
) -> None:
    """Add the edits that state a body's mass, centre of mass and inertia of a model."""
    mass, centre = float(model.body_mass[body]), model.body_ipos[body]
    inertia, orientation = model.body_inertia[body], model.body_iquat[body]

    def numbers(values: np.ndarray) -> str:
        return " ".join(f"{v:.8g}" for v in values)

    inertial = next((c for c in tag.children if c.name == "inertial"), None)
    if inertial is None:
        if tag.empty:
            raise NotInPlace(f"{tag.file.name}, line {tag.line}: an empty body")
        inserted[tag] = (
            f'<inertial pos="{numbers(centre)}" quat="{numbers(orientation)}" mass="{mass:.8g}" '
            f'diaginertia="{numbers(inertia)}"/>'
        )
        return
    out: dict[str, str | None] = {"mass": _token(mass, inertial.attributes.get("mass"))}
    tokens = inertial.attributes.get("pos", "").split() or ["0", "0", "0"]
    out["pos"] = " ".join(_token(v, t) for v, t in zip(centre, tokens, strict=True))
    stated = {
        k: np.array(v.split(), float) for k, v in inertial.attributes.items() if k in ("diaginertia", "fullinertia")
    }
    scaled = _scaled(inertia, stated)
    if scaled is not None:
        attribute, values = scaled
        out[attribute] = numbers(values)
    else:
        out |= {"fullinertia": None, "diaginertia": numbers(inertia), "quat": numbers(orientation)}
        out |= {turn: None for turn in TURNS}
    edits.setdefault(inertial, {}).update({k: v for k, v in out.items() if v is not None or k in inertial.attributes})


def _scaled(inertia: np.ndarray, stated: Mapping[str, np.ndarray]) -> tuple[str, np.ndarray] | None:
    """The attribute and its numbers if the stated inertia is scaled by one factor; else None."""
    if "diaginertia" in stated:
        moments = np.sort(stated["diaginertia"])
    elif "fullinertia" in stated:
        xx, yy, zz, xy, xz, yz = stated["fullinertia"]
        moments = np.sort(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    else:
        return None
    factors = np.sort(inertia) / moments
    attribute = "diaginertia" if "diaginertia" in stated else "fullinertia"
    same = np.ptp(factors) <= 1e-6 * abs(factors.mean())
    return (attribute, stated[attribute] * factors.mean()) if same else None


def _names(tree: Tree, main: str) -> dict[Path, str]:
    """File -> its name in the folder of the result."""
    out = {tree.root.file: main}
    for file in tree.texts:
        name, k = f"{Path(main).stem}_parts/{file.name}", 2
        while file not in out and name in out.values():
            name, k = f"{Path(main).stem}_parts/{file.stem}_{k}{file.suffix}", k + 1
        out.setdefault(file, name)
    return out


def _absolute(
    tree: Tree, spec: mujoco.MjSpec, changed: Mapping[Path, str], names: Mapping[Path, str]
) -> dict[Tag, dict[str, str | None]]:
    """Edits that make the paths of included files, meshes and textures absolute."""
    folder, out = tree.root.file.parent, dict[Tag, dict[str, str | None]]()
    compilers = [tag for tag in tree.root.walk() if tag.name == "compiler"]
    for tag in compilers:
        dirs = {k: v for k, v in tag.attributes.items() if k in ("meshdir", "texturedir", "assetdir")}
        out[tag] = {k: str((folder / v).resolve()) for k, v in dirs.items()}
    files = [a.file for kind in (spec.meshes, spec.textures, spec.hfields, spec.skins) for a in kind if a.file]
    stated = {k for changes in out.values() for k in changes}
    unstated = {"meshdir", "texturedir"} - stated if "assetdir" not in stated else set()
    if any(not os.path.isabs(file) for file in files) and unstated:
        if not compilers:
            raise NotInPlace(f"{tree.root.file.name} has meshes or textures and no <compiler> for their folder")
        out[compilers[0]] |= dict.fromkeys(sorted(unstated), str(folder))
    edited = {tag.file for tag, changes in out.items() if changes} | set(changed)
    edited |= {tag.file for tag, _ in tree.includes}
    for tag, file in tree.includes:
        out[tag] = {"file": names[file] if file in edited else str(file)}
    return {tag: changes for tag, changes in out.items() if changes}


def _patch(tree: Tree, changed: Mapping[Path, str]) -> str:
    """A unified diff of the user's files, to be applied in the folder that holds all of them.

    That is the main file's folder, unless an included file lies outside of it.
    """
    places = {file: Path(os.path.normpath(file.absolute())) for file in (tree.root.file, *changed)}
    out, folder = "", os.path.commonpath([place.parent for place in places.values()])
    for file, text in changed.items():
        name = places[file].relative_to(folder).as_posix()
        before, after = (t.splitlines(keepends=True) for t in (tree.texts[file].decode("utf-8"), text))
        # A tab ends a name that contains spaces.
        names = (f"{side}/{name}" + "\t" * (" " in name) for side in "ab")
        lines = difflib.unified_diff(before, after, *names, n=2)
        out += "".join(line if line.endswith("\n") else f"{line}\n\\ No newline at end of file\n" for line in lines)
    return out
