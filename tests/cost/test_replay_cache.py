"""A function that remembers its results on disk: nothing is computed twice, and nothing damaged is believed."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from droid_jax.cost.replay_cache import Batched, cached

ROWS = np.array([[1.0, 2.0], [3.0, 4.0]])


def counted(counts: list[int]) -> Batched:
    """[P, 2] -> [P, 3], which counts how often it is asked."""

    def compute(rows: np.ndarray) -> np.ndarray:
        counts.append(len(rows))
        return np.asarray(rows, float) @ np.arange(6.0).reshape(2, 3)

    return compute


@pytest.fixture
def counts() -> list[int]:
    return []


def test_nothing_is_computed_twice(tmp_path: Path, counts: list[int]):
    once = cached(counted(counts), tmp_path / "train", "whitened")(ROWS)
    again = cached(counted(counts), tmp_path / "train", "whitened")(ROWS)
    np.testing.assert_array_equal(once, counted([])(ROWS))
    np.testing.assert_array_equal(again, once)
    assert counts == [2] and once.dtype == again.dtype
    cached(counted(counts), tmp_path / "train", "whitened")(ROWS[:1])
    assert counts == [2, 1]


def test_the_last_digits_of_a_double_are_not_another_row(tmp_path: Path, counts: list[int]):
    """A replay is given single precision."""
    remembered = cached(counted(counts), tmp_path / "train", "whitened")
    np.testing.assert_array_equal(remembered(ROWS), remembered(ROWS + 1e-12))
    remembered(ROWS + 1e-3)
    assert counts == [2, 2]


def test_recordings_and_functions_do_not_share_what_they_remember(tmp_path: Path, counts: list[int]):
    for role in ("train", "validation"):
        for what in ("whitened", "distances"):
            cached(counted(counts), tmp_path / role, what)(ROWS)
    assert counts == [2] * 4 and {p.name for p in tmp_path.iterdir()} == {"train", "validation"}


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:60] + b"??" + b[62:]])
def test_a_damaged_file_is_reported_and_computed_again(
    tmp_path: Path, counts: list[int], damage: Callable[[bytes], bytes]
):
    remembered = cached(counted(counts), tmp_path / "train", "whitened")
    whole = remembered(ROWS)
    (path,) = (tmp_path / "train").iterdir()
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match=f"{path.name} is damaged"):
        np.testing.assert_array_equal(remembered(ROWS), whole)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(remembered(ROWS), whole)
    assert counts == [2, 2]


def changed_rows(path: Path) -> None:
    with np.load(path) as file:
        np.savez(path, rows=file["rows"] + 1e-3, digest=file["digest"])


def of_another_row(path: Path) -> None:
    (other,) = (p for p in path.parent.iterdir() if p != path)
    path.write_bytes(other.read_bytes())


def of_another_recording(path: Path) -> None:
    cached(counted([]), path.parent.parent / "validation", "whitened")(ROWS)
    path.write_bytes((path.parent.parent / "validation" / path.name).read_bytes())


@pytest.mark.parametrize("change", [changed_rows, of_another_row, of_another_recording])
def test_a_file_of_something_else_is_computed_again(tmp_path: Path, counts: list[int], change: Callable[[Path], None]):
    """One that can be read, and is not what was written there."""
    remembered = cached(counted(counts), tmp_path / "train", "whitened")
    whole = remembered(ROWS)
    (path,) = (tmp_path / "train").iterdir()
    remembered(1.01 * ROWS)
    change(path)
    with pytest.warns(UserWarning, match=f"{path.name} is damaged"):
        np.testing.assert_array_equal(remembered(ROWS), whole)
    assert counts == [2, 2, 2]


def test_the_same_numbers_in_another_shape_are_another_question(tmp_path: Path):
    """As where other code asks about one parameter more: the bytes may agree."""
    sums = cached(lambda rows: np.asarray(rows, float).sum(axis=1), tmp_path / "train", "sums")
    wide = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(sums(wide), [3.0, 12.0])
    with pytest.warns(UserWarning, match="computed again"):
        np.testing.assert_array_equal(sums(wide.reshape(3, 2)), [1.0, 5.0, 9.0])
