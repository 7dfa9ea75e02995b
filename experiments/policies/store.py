"""The policies that experiments share: one that two of them need is trained once.

A policy lies in a folder of its own, and beside it, in `of.json`, all that decided what training came to.  A folder is
found by that, and not by its name: what is computed on the way (the arm's pose before the knob, the fitted Gaussian)
differs in its last digit between machines, and a training begun anew with it ends in another policy.
"""

from __future__ import annotations

import hashlib
import json
import math
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.sharing import claimed, code_name
from droid_jax.door.environment import DoorEnv
from droid_jax.files import GAUSSIAN, POLICY, TRAINING
from droid_jax.identify.gaussian import Gaussian
from droid_jax.model.mjcf import unwrapped
from droid_jax.model.scene import Scene
from droid_jax.policy.network import save_policy
from droid_jax.policy.randomise import of_method
from droid_jax.policy.train import TrainConfig, train
from droid_jax.storage import write_json

OF = "of.json"
# Hash of a scene -> that of the text in which MuJoCo 3.17 wrote it, by which policies in results/archive go.
AS_STORED = {
    "8f69a809eeba10c51c48e25214dff62b022579412005fdd8456910299fea18f3": (
        "f8b901835c8e4140157be3c833b4b8cc387a67c6f8be2170e060c6e254591aee"
    )
}
SAME = 1e-9  # numbers nearer than that, in shares of themselves, are the same
NOTHING = 1e-12  # and what is smaller than that is zero
NAMES = frozenset({"element", "role"})  # what a Gaussian says of its parameters for people and code: older ones do not


@dataclass(frozen=True)
class Doors:
    """What a policy is trained on: draws of a Gaussian, or its mean alone where the method is "mean"."""

    gaussian: Gaussian
    method: str = "fitted"


def trained(
    store: Path, env: DoorEnv, doors: Doors, config: TrainConfig, code: Mapping[str, Any]
) -> tuple[Path, dict[str, Any]]:
    """Folder of the policy that training comes to, and what is known of the training.

    Another process that trains the same is waited for; what a stopped one of the same code left is continued.
    """
    of = decided_by(env, doors, config)
    place = place_of(store, of)
    with claimed(place, wait=True):
        if not (place / TRAINING).is_file():
            drawn = of_method(doors.method, env.scene, doors.gaussian)
            # What other code left half done is not gone on with.
            checkpoints = place / "checkpoints" / code_name(code["commit"])
            found = train(env, drawn, config, checkpoints=checkpoints, fingerprint={"key": place.name})
            place.mkdir(exist_ok=True)
            write_json(place / OF, of)
            save_policy(place / POLICY, found.policy)
            doors.gaussian.save(place / GAUSSIAN)
            history = [asdict(now) for now in found.history]
            write_json(place / TRAINING, {"trained": place.name, "history": history, "trained_by": dict(code)})
        return place, json.loads((place / TRAINING).read_text())


def decided_by(env: DoorEnv, doors: Doors, config: TrainConfig) -> dict[str, Any]:
    """All that decides what training comes to, as plain data."""
    unused = () if config.held else ("enough", "held")
    of = {
        "scene": _scene(env.scene),
        "effects": [effect.name for effect in env.effects],
        "start": env.start.tolist(),
        "task": asdict(env.task),
        "doors": "mean" if doors.method == "mean" else "draws",
        "gaussian": doors.gaussian.to_json(),
        "config": {name: value for name, value in asdict(config).items() if name not in unused},
    }
    return json.loads(json.dumps(of))


def place_of(store: Path, of: Mapping[str, Any]) -> Path:
    """The folder of the policy that this decides: the one that is there, or where it shall be."""
    there = (path.parent for path in sorted(store.glob(f"*/{OF}")) if alike(json.loads(path.read_text()), of))
    return next(there, store / sha256(json.dumps(of))[:16])


def alike(one: Any, other: Any) -> bool:
    """Whether plain data says the same, but for the last digits of its numbers."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        names = (one.keys() | other.keys()) - NAMES
        return all(name in one and name in other and alike(one[name], other[name]) for name in names)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=SAME, abs_tol=NOTHING)
    return one == other


def _scene(scene: Scene) -> str:
    """SHA-256 of the scene as MJCF, whose numbers have six digits; the compiled model has them all, machine by machine.

    Of a form that MuJoCo 3 and 4, which nest defaults otherwise, share; stored policies go by the text of 3.17.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Attaching a spec with an empty prefix")  # told of every door
        text = ElementTree.canonicalize(unwrapped(scene.spec.to_xml()), strip_text=True)
    return AS_STORED.get(sha256(text), sha256(text))


def sha256(text: str) -> str:
    """Of a text, in hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()
