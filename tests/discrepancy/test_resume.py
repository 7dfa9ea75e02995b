"""Going on after a stop: what was computed is read, what is damaged is computed again."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from droid_jax.discrepancy.resume import CachedCost, cached_model, cached_number, with_replay_cache
from small_gap import FLOOR, Small, small

from droid_jax.discrepancy.search import search_effects


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def never() -> None:
    raise AssertionError("this was computed before")


def counted(case, counts: list[int]):
    """The case with replays that are counted."""

    def of(residual_set):
        replay = residual_set.cost._replays[0]

        def count(values):
            counts.append(len(values))
            return replay(values)

        return dataclasses.replace(residual_set, cost=dataclasses.replace(residual_set.cost, _replays=(count,)))

    return dataclasses.replace(case, train=of(case.train), validation=of(case.validation))


def test_a_remembered_cost_replays_nothing_twice(found: Small, tmp_path: Path):
    counts: list[int] = []
    rows = found.case.full_space.mean + 0.1 * np.arange(3.0)[:, None] * np.eye(len(found.case.full_space))[0]
    first = with_replay_cache(counted(found.case, counts), tmp_path).train.cost
    once = (first(rows), first.distances(rows), first.whitened(rows))
    assert len(counts) == 2  # distances and residuals; the call is the distances' mean
    again = with_replay_cache(counted(found.case, counts), tmp_path).train.cost
    for a, b in zip(once, (again(rows), again.distances(rows), again.whitened(rows)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(counts) == 2
    np.testing.assert_array_equal(once[0], found.case.train.cost(rows))
    assert isinstance(again.first(), CachedCost)


def test_recordings_do_not_share_what_they_remember(found: Small, tmp_path: Path):
    case = with_replay_cache(found.case, tmp_path)
    row = found.case.full_space.mean[None]
    assert case.train.cost(row)[0] != case.validation.cost(row)[0]
    assert {p.name for p in tmp_path.iterdir()} == {"train", "validation"}


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:60] + b"??" + b[62:]])
def test_a_damaged_memory_is_reported_and_computed_again(found: Small, tmp_path: Path, damage):
    case = with_replay_cache(found.case, tmp_path)
    row = found.case.full_space.mean[None]
    whitened = case.train.cost.whitened(row)
    (path,) = (tmp_path / "train").iterdir()
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match=f"{path.name} is damaged"):
        np.testing.assert_array_equal(case.train.cost.whitened(row), whitened)
    np.testing.assert_array_equal(case.train.cost.whitened(row), whitened)


def changed_rows(path: Path) -> None:
    with np.load(path) as file:
        np.savez(path, rows=file["rows"] + 1e-3, digest=file["digest"])


def of_another_row(path: Path) -> None:
    (other,) = (p for p in path.parent.iterdir() if p != path)
    path.write_bytes(other.read_bytes())


@pytest.mark.parametrize("change", [changed_rows, of_another_row])
def test_a_memory_of_something_else_is_computed_again(found: Small, tmp_path: Path, change: Callable[[Path], None]):
    """A file that can be read, and is not what was written there."""
    case = with_replay_cache(found.case, tmp_path)
    row = found.case.full_space.mean[None]
    whitened = case.train.cost.whitened(row)
    (path,) = (tmp_path / "train").iterdir()
    case.train.cost.whitened(1.01 * row)
    change(path)
    with pytest.warns(UserWarning, match=f"{path.name} is damaged"):
        np.testing.assert_array_equal(case.train.cost.whitened(row), whitened)


def test_a_floor_is_no_base_fit(tmp_path: Path):
    cached_number(tmp_path / "floor", lambda: 0.125)
    shutil.copytree(tmp_path / "floor", tmp_path / "other")
    with pytest.raises(ValueError, match="belongs to another run: it differs in what"):
        cached_number(tmp_path / "other", lambda: 0.25)


def test_a_search_that_is_run_again_replays_nothing_and_ends_alike(found: Small, tmp_path: Path):
    """What a killed run does when the same command is given once more."""
    counts: list[int] = []
    search_effects(with_replay_cache(found.case, tmp_path), found.base, FLOOR)
    again = search_effects(with_replay_cache(counted(found.case, counts), tmp_path), found.base, FLOOR)
    assert again.effects == found.verdict.effects
    for role, gaps in found.verdict.discrepancies.items():
        assert again.discrepancies[role] == pytest.approx(gaps, rel=1e-4)
    np.testing.assert_allclose(again.model.values, found.verdict.model.values, rtol=1e-6)
    # localisation alone looks at whole rollouts, which are not kept
    assert sum(counts) <= 4 * 32


def test_a_base_model_over_other_effects_is_fitted_again(found: Small, tmp_path: Path):
    """What a search that was stopped finds where other code asks about one effect less."""
    case, fewer = found.case, dataclasses.replace(found.base, values=found.base.values[:-1])
    cached_model(tmp_path / "base", case.base, case.full_space, lambda: fewer)
    with pytest.warns(UserWarning, match="of other effects"):
        back = cached_model(tmp_path / "base", case.base, case.full_space, lambda: found.base)
    np.testing.assert_array_equal(back.values, found.base.values)
    np.testing.assert_array_equal(
        cached_model(tmp_path / "base", case.base, case.full_space, never).values, back.values
    )


def test_a_base_model_comes_back_as_it_was(found: Small, tmp_path: Path):
    cached_model(tmp_path / "base", found.case.base, found.case.full_space, lambda: found.base)
    back = cached_model(tmp_path / "base", found.case.base, found.case.full_space, never)
    assert (back.parts, back.discrepancy, back.name) == ((), found.base.discrepancy, "base")
    assert back.space is found.case.base
    np.testing.assert_array_equal(back.values, found.base.values)
    np.testing.assert_array_equal(back.residuals, found.base.residuals)
    for field in dataclasses.fields(back.refined):
        if field.name != "space":
            mine, own = (getattr(r, field.name) for r in (back.refined, found.base.refined))
            np.testing.assert_array_equal(mine, own)
            assert isinstance(mine, np.ndarray) == isinstance(own, np.ndarray), field.name
    verdict = search_effects(with_replay_cache(found.case, tmp_path / "replays"), back, FLOOR)
    assert verdict.effects == found.verdict.effects


def test_a_floor_comes_back(tmp_path: Path):
    assert cached_number(tmp_path / "floor", lambda: 0.125) == 0.125
    assert cached_number(tmp_path / "floor", never) == 0.125


def test_a_damaged_checkpoint_is_reported_and_redone(found: Small, tmp_path: Path):
    cached_number(tmp_path / "floor", lambda: 0.125)
    files = [p for p in (tmp_path / "floor").rglob("*") if p.is_file() and p.stat().st_size > 0]
    for file in files:
        file.write_bytes(b"\x00" * file.stat().st_size)
    with pytest.warns(UserWarning, match="is damaged and was passed over"):
        assert cached_number(tmp_path / "floor", lambda: 0.25) == 0.25
    assert cached_number(tmp_path / "floor", never) == 0.25
