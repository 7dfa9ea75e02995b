"""A fitted model in the user's own MJCF: the numbers that differ are changed where they stand, and nothing else.

Elements are found by their order in the file, which MuJoCo compiles them in, and their names.  What a change of numbers
alone cannot say raises `NotInPlace`: elements that a tag makes several of (replicate, composite), places inside a
frame, kinds of actuators that are short for more.  Whoever calls compiles the result and compares.
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
# Attributes with as many numbers as they always have; of others those up to the last one that changed are written.
FIXED = ("range", "pos", "quat", "axis", "actuatorfrcrange", "ctrlrange", "forcerange")
TINY = 1e-9  # relative: numbers that are closer are the one that stands there


class NotInPlace(ValueError):
    """Changed numbers alone do not make the fitted model of the user's file; the message says why."""


@dataclass(frozen=True)
class Change:
    """A number that a fit changed.

    element, name: "joint", "elbow".  attribute, index: of the MJCF.  field, entry: of the MuJoCo model.  before, after:
    as the MJCF has them (degrees where it says so).  file, line: where the tag stands, empty and 0 where the scene is
    no file.  origin: what the number came from, "" for the element itself, else its default class or MuJoCo's own.
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
    """New numbers of an attribute of an element, the `row`-th of its kind in the compiled model.

    before, after: [n] all its numbers.  field: of the MuJoCo model.
    """

    element: str
    row: int
    attribute: str
    before: np.ndarray
    after: np.ndarray
    field: str


@dataclass(frozen=True)
class PlacedNumber:
    """Where a number stands: the attribute that says it, "" where another one does; file, line and origin as in
    `Change`."""

    attribute: str
    file: str = ""
    line: int = 0
    origin: str = ""


@dataclass(frozen=True, eq=False)
class Edited:
    """files: name -> text, to lie in one folder, the main one first: paths in them are absolute.  patch: the same
    changes to the user's own files, as a unified diff.  placed: of each `WantedNumber`.  bodies: file and line of each
    that was weighed."""

    files: dict[str, str]
    patch: str
    placed: tuple[PlacedNumber, ...]
    bodies: dict[int, tuple[str, int]]


def edit(
    path: Path, spec: mujoco.MjSpec, wanted: Sequence[WantedNumber], weighed: Mapping[int, mujoco.MjModel], main: str
) -> Edited:
    """The user's file with numbers changed.

    Args:
        path: of the main file.
        main: what it is called in the result; changed files that it includes go to a folder "STEM_parts" beside it.
        spec: of it, compiled, so that its elements are numbered.
        wanted: the numbers.
        weighed: body -> model, of which it shall have mass, centre and inertia.

    Raises:
        NotInPlace: they cannot be written as changed numbers.
        ValueError: a file is gone, or no longer what the spec was made of.
    """
    tree = read_tree(path)
    if tree.root.name != "mujoco":
        raise NotInPlace(f"{path.name} is a <{tree.root.name}>, not an MJCF")
    places = _elements(tree, spec)
    edits: dict[Tag, dict[str, str | None]] = {}
    inserted: dict[Tag, str] = {}
    placed: list[PlacedNumber] = []
    for want in wanted:
        tag = places[want.element][want.row]
        said = _attribute(tag, want)
        name = next((k for k, v in said.items() if v is not None), "")
        origin = "" if not name or name in tag.attributes else _origin(tree, tag, name)
        placed.append(PlacedNumber(name, tag.file.name, tag.line, origin))
        edits.setdefault(tag, {}).update(said)
    for body, model in weighed.items():
        _weigh(places["body"][body], body, model, edits, inserted)
    bodies = {body: (places["body"][body].file.name, places["body"][body].line) for body in weighed}
    changed = with_edits(tree, edits, inserted)
    names = _names(tree, main)
    paths = _absolute(tree, spec, changed, names)
    merged = {tag: {**edits.get(tag, {}), **paths.get(tag, {})} for tag in {**edits, **paths}}
    standing = with_edits(tree, merged, inserted)
    texts = {tree.root.file: tree.texts[tree.root.file].decode("utf-8"), **standing}
    files = {names[file]: text for file, text in texts.items()}
    return Edited(files, _patch(tree, changed), tuple(placed), bodies)


def _elements(tree: Tree, spec: mujoco.MjSpec) -> dict[str, list[Tag]]:
    """The tags of each kind in the order of the compiled model; NotInPlace where they are not the spec's."""
    several = next((tag for tag in tree.root.walk() if tag.name in MAKES_SEVERAL), None)
    if several is not None:
        raise NotInPlace(f"{several.file.name}, line {several.line}: <{several.name}> makes elements of its own")
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
    """Bodies below a tag, each before those in it, as MuJoCo numbers them."""
    for child in tag.children:
        if child.name == "body":
            yield child
        if child.name in ("body", "frame"):
            yield from _bodies(child)


def _own(tag: Tag, names: tuple[str, ...]) -> Iterator[Tag]:
    """Elements of a body itself, those in its frames included."""
    for child in tag.children:
        if child.name in names:
            yield child
        elif child.name == "frame":
            yield from _own(child, names)


def _origin(tree: Tree, tag: Tag, attribute: str) -> str:
    """Where a number that the element does not state comes from, in words."""
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
    """Attributes of a tag that say the new numbers."""
    name, before, after = want.attribute, want.before, want.after
    if name in ("gainprm", "biasprm") and tag.name != "general":
        return _servo(tag, want)
    if want.element in ("body", "geom") and name in ("pos", "quat", "size"):
        if name != "size" and (tag.parent is not None and tag.parent.name == "frame"):
            raise NotInPlace(f"{tag.file.name}, line {tag.line}: the place of a {tag.name} inside a frame")
        if "fromto" in tag.attributes and (name != "size" or np.any(before[1:] != after[1:])):
            raise NotInPlace(f"{tag.file.name}, line {tag.line}: a geom that is given by its ends")
    out: dict[str, str | None] = {}
    if name == "quat":
        out = {turn: None for turn in TURNS if turn in tag.attributes}
    tokens = tag.attributes.get(name, "").split()
    last = int(np.flatnonzero(before != after)[-1]) + 1
    count = len(after) if name in FIXED else max(len(tokens), last)
    out[name] = " ".join(_token(after[i], tokens[i] if i < len(tokens) else None) for i in range(count))
    return out


def _servo(tag: Tag, want: WantedNumber) -> dict[str, str | None]:
    """Gains of an actuator that is short for a general one: kp, kv."""
    after, field = want.after, want.attribute
    if tag.name == "position" and field == "gainprm" and not after[1:].any():
        return {"kp": _token(after[0], tag.attributes.get("kp"))}
    if tag.name == "position" and field == "biasprm" and not after[0] and not after[3:].any():
        if want.before[2] == after[2]:
            return {}  # -kp, which the gain says
        return {"kv": _token(-after[2], tag.attributes.get("kv")), "dampratio": None}
    if tag.name == "velocity" and field == "gainprm" and not after[1:].any():
        return {"kv": _token(after[0], tag.attributes.get("kv"))}
    if tag.name == "velocity" and field == "biasprm":
        return {}
    raise NotInPlace(f"{tag.file.name}, line {tag.line}: <{tag.name}> has no attribute for its {field}")


def _token(number: float, old: str | None) -> str:
    """A number as text, the one that stands there where it is the same."""
    try:
        if old is not None and abs(float(old) - number) <= TINY * abs(number):
            return old
    except ValueError:
        pass
    return f"{number:.8g}"


def _weigh(
    tag: Tag, body: int, model: mujoco.MjModel, edits: dict[Tag, dict[str, str | None]], inserted: dict[Tag, str]
) -> None:
    """Have a body say mass, centre and inertia of a model."""
    mass, centre = float(model.body_mass[body]), model.body_ipos[body]
    inertia, turned = model.body_inertia[body], model.body_iquat[body]

    def numbers(values: np.ndarray) -> str:
        return " ".join(f"{v:.8g}" for v in values)

    own = next((c for c in tag.children if c.name == "inertial"), None)
    if own is None:
        if tag.empty:
            raise NotInPlace(f"{tag.file.name}, line {tag.line}: a body without anything in it")
        inserted[tag] = (
            f'<inertial pos="{numbers(centre)}" quat="{numbers(turned)}" mass="{mass:.8g}" '
            f'diaginertia="{numbers(inertia)}"/>'
        )
        return
    out: dict[str, str | None] = {"mass": _token(mass, own.attributes.get("mass"))}
    tokens = own.attributes.get("pos", "").split() or ["0", "0", "0"]
    out["pos"] = " ".join(_token(v, t) for v, t in zip(centre, tokens, strict=True))
    said = {k: np.array(v.split(), float) for k, v in own.attributes.items() if k in ("diaginertia", "fullinertia")}
    share = _scaled(own, inertia, said)
    if share is not None:
        kind, numbers_now = share
        out[kind] = numbers(numbers_now)
    else:
        out |= {"fullinertia": None, "diaginertia": numbers(inertia), "quat": numbers(turned)}
        out |= {turn: None for turn in TURNS}
    edits.setdefault(own, {}).update({k: v for k, v in out.items() if v is not None or k in own.attributes})


def _scaled(own: Tag, inertia: np.ndarray, said: Mapping[str, np.ndarray]) -> tuple[str, np.ndarray] | None:
    """The attribute and its numbers where all of a stated inertia grew by one factor; None otherwise."""
    if "diaginertia" in said:
        stated = np.sort(said["diaginertia"])
    elif "fullinertia" in said:
        xx, yy, zz, xy, xz, yz = said["fullinertia"]
        stated = np.sort(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    else:
        return None
    shares = np.sort(inertia) / stated
    kind = "diaginertia" if "diaginertia" in said else "fullinertia"
    return (kind, said[kind] * shares.mean()) if np.ptp(shares) <= 1e-6 * abs(shares.mean()) else None


def _names(tree: Tree, main: str) -> dict[Path, str]:
    """Name of each file in the folder of the result."""
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
    """Paths of included files, meshes and textures, so that the files can lie anywhere."""
    folder, out = tree.root.file.parent, dict[Tag, dict[str, str | None]]()
    compilers = [tag for tag in tree.root.walk() if tag.name == "compiler"]
    for tag in compilers:
        dirs = {k: v for k, v in tag.attributes.items() if k in ("meshdir", "texturedir", "assetdir")}
        out[tag] = {k: str((folder / v).resolve()) for k, v in dirs.items()}
    files = [a.file for kind in (spec.meshes, spec.textures, spec.hfields, spec.skins) for a in kind if a.file]
    stated = {k for changes in out.values() for k in changes}
    if any(not os.path.isabs(file) for file in files) and not stated:
        if not compilers:
            raise NotInPlace(f"{tree.root.file.name} has meshes or textures and no <compiler> to say where they lie")
        out[compilers[0]] |= {"meshdir": str(folder), "texturedir": str(folder)}
    own = {tag.file for tag, changes in out.items() if changes} | set(changed) | {tag.file for tag, _ in tree.includes}
    for tag, file in tree.includes:
        out[tag] = {"file": names[file] if file in own else str(file)}
    return {tag: changes for tag, changes in out.items() if changes}


def _patch(tree: Tree, changed: Mapping[Path, str]) -> str:
    """A unified diff of the user's own files, to be applied in the folder of the main one."""
    out = ""
    for file, text in changed.items():
        name = os.path.relpath(file, tree.root.file.parent)
        before, after = (t.splitlines(keepends=True) for t in (tree.texts[file].decode("utf-8"), text))
        out += "".join(difflib.unified_diff(before, after, f"a/{name}", f"b/{name}", n=2))
    return out
