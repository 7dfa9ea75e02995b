"""Going on after a stop: the base fit, its floor and every single replay of a search are kept on disk.

The search is the same computation every time, so one that was killed is simply run again: what it
asks of a cost the second time is read instead of replayed, up to where it was stopped.
"""

from __future__ import annotations

import dataclasses
import hashlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.cost.cost import Cost
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.identify.checkpoints import Checkpoints, Tree
from droid_jax.identify.multistart import Refined
from droid_jax.model.parameters import Space
from droid_jax.read_npz import read_npz
from droid_jax.storage import write_npz


def with_replay_cache(case: Case, folder: Path) -> Case:
    """The case with costs that keep what they computed below `folder`, which belongs to this case alone."""

    def kept(role: str, residual_set: ResidualSet) -> ResidualSet:
        cost = residual_set.cost
        each = {f.name: getattr(cost, f.name) for f in dataclasses.fields(Cost)}
        return replace(residual_set, cost=CachedCost(**each, plain=cost, folder=folder / role))

    return replace(case, **{role: kept(role, residual_set) for role, residual_set in case.held_sets.items()})


@dataclass(frozen=True, eq=False)
class CachedCost(Cost):
    """The cost `plain` over one recording, which looks in its folder before it replays."""

    plain: Cost
    folder: Path

    def distances(self, values: Any) -> np.ndarray:
        """Like `Cost.distances`."""
        return self._kept("distances", values, self.plain.distances)

    def whitened(self, values: Any) -> np.ndarray:
        """Like `Cost.whitened`."""
        return self._kept("whitened", values, self.plain.whitened)

    def first(self) -> Cost:
        """Itself: there is one recording."""
        return self

    def _kept(self, what: str, values: Any, compute: Callable[[Any], np.ndarray]) -> np.ndarray:
        rows = np.asarray(values, np.float32)  # what a replay is given; the last digits of a double may vary
        path = self.folder / f"{what}_{hashlib.sha256(rows.tobytes()).hexdigest()[:32]}.npz"
        try:
            found = read_npz(path, ("rows", "digest"))
            kept, digest = found["rows"], str(found["digest"])
            if digest != _digest(self.folder.name, what, rows, kept):
                raise ValueError("its content is not what was written")
            return kept
        except FileNotFoundError:
            pass
        except (ValueError, OSError) as error:
            warnings.warn(f"{path} is damaged and is computed again: {error}", stacklevel=3)
        out = compute(values)
        write_npz(path, {"rows": out, "digest": np.array(_digest(self.folder.name, what, rows, out))})
        return out


def _digest(role: str, what: str, rows: np.ndarray, out: np.ndarray) -> str:
    """sha256 over what was asked for, in which recording, and what came of it."""
    sha = hashlib.sha256(f"{role} {what} {rows.shape}".encode())
    sha.update(np.ascontiguousarray(rows).tobytes())
    sha.update(f"{out.dtype.str} {out.shape}".encode())
    sha.update(np.ascontiguousarray(out).tobytes())
    return sha.hexdigest()


def cached_model(folder: Path | None, base: Space, whole: Space, fit: Callable[[], FittedModel]) -> FittedModel:
    """The base model over the space `base`, from its folder or, where that holds none that is whole, fitted now.

    None: nothing is kept.  One that is not over the space `whole`, as where other code asked about other effects, is
    warned of and fitted anew.
    """

    def over(tree: Tree) -> bool:
        return np.shape(tree["values"]) == (len(whole),)

    return _model(base, _kept(folder, lambda: _tree(fit()), over))


def cached_number(folder: Path | None, compute: Callable[[], float]) -> float:
    """A number from its folder, computed now where that holds none that is whole; None: nothing is kept."""
    return float(_kept(folder, lambda: {"value": np.array(compute())})["value"])


def _kept(folder: Path | None, make: Callable[[], Tree], fits: Callable[[Tree], bool] = lambda tree: True) -> Tree:
    """Damage, and what does not fit, is reported as a warning that names the checkpoint."""
    if folder is None:
        return make()
    with Checkpoints(folder, keep=1, fingerprint={"what": folder.name}) as checkpoints:
        found = checkpoints.restore()
        if found is not None:
            if fits(found[1]):
                return found[1]
            warnings.warn(f"checkpoint {folder} is of other effects and is computed again", stacklevel=3)
        checkpoints.save(0, tree := make())
        return tree


# what a base model holds beside its space, which the caller knows: numbers and arrays, and those of its refinement
_PLAIN = tuple(f.name for f in dataclasses.fields(FittedModel) if f.name not in ("parts", "space", "refined"))
_REFINED = tuple(f.name for f in dataclasses.fields(Refined) if f.name != "space")


def _tree(model: FittedModel) -> Tree:
    """A base model as arrays."""
    refined = {name: np.asarray(getattr(model.refined, name)) for name in _REFINED}
    return {**{name: np.asarray(getattr(model, name)) for name in _PLAIN}, "refined": refined}


def _model(base: Space, tree: Tree) -> FittedModel:
    """Inverse of `_tree`."""
    refined = Refined(base, **{name: _value(tree["refined"][name]) for name in _REFINED})
    return FittedModel(parts=(), space=base, refined=refined, **{name: _value(tree[name]) for name in _PLAIN})


def _value(array: Any) -> Any:
    """An array, or the number of one without axes."""
    array = np.asarray(array)
    return array.item() if array.ndim == 0 else array
