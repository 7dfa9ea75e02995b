"""The screening on linear problems, where everything is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from droid_jax.gap.candidates import Candidate, candidates
from droid_jax.gap.screen import Question, project, screen
from droid_jax.gap.select import Trial, one_sided_p, resampled, tied
from droid_jax.model.parameters import Parameter
from droid_jax.model.seam import Effect

REPEATS, SIZE = 10, 400
RNG = np.random.default_rng(0)
BASE = RNG.normal(size=(SIZE, 6))
MARKS = RNG.normal(size=(5, SIZE))
QUESTIONS = tuple(Question(Candidate(f"effect{k}", "hinge", (f"a{k}",)), f"a{k}") for k in range(5))
LOOSE = np.full(6, 1e3)


def repeats(seed: int, **amplitudes: float) -> np.ndarray:
    """[N, M] noise and the marks times their amplitudes, with what the base absorbs taken out."""
    common = sum((size * MARKS[int(name[1:])] for name, size in amplitudes.items()), np.zeros(SIZE))
    left = project(common[None], BASE, LOOSE)[0]
    return left + np.random.default_rng(seed).normal(size=(REPEATS, SIZE))


def test_the_projection_leaves_nothing_of_a_base_column():
    np.testing.assert_allclose(project(BASE.T, BASE, LOOSE), 0.0, atol=1e-6)
    once = project(MARKS, BASE, LOOSE)
    np.testing.assert_allclose(once @ BASE, 0.0, atol=1e-3)
    np.testing.assert_allclose(project(once, BASE, LOOSE), once, atol=1e-6)


def test_a_tight_prior_lets_a_base_column_explain_little():
    """A parameter known to be where it is cannot take the blame for a missing effect."""
    np.testing.assert_allclose(project(BASE.T, BASE, np.full(6, 1e-4)), BASE.T, rtol=1e-3)


def test_the_missing_effect_is_found_with_its_size():
    found = screen(repeats(1, a3=0.7), QUESTIONS, project(MARKS, BASE, LOOSE))
    assert found.best()[0] == 3 and found.p == pytest.approx(1 / 512)
    assert found.size[3] == pytest.approx(0.7, abs=0.05)
    assert found.explained[3] > 0.5 > 10 * np.delete(found.explained, 3).max()


def test_nothing_missing_names_nothing():
    p = [screen(repeats(seed), QUESTIONS, project(MARKS, BASE, LOOSE)).p for seed in range(300)]
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.09


def test_what_the_base_can_absorb_is_no_effect():
    marks = np.concatenate([MARKS[:4], (BASE @ np.arange(6.0))[None]])
    found = screen(repeats(2, a1=0.5), QUESTIONS, project(marks, BASE, LOOSE))
    assert found.best()[0] == 1
    assert abs(found.explained[4]) < 1e-2


def test_resamples_agree_on_a_clear_winner_and_split_over_twins():
    clear = screen(repeats(3, a2=0.6), QUESTIONS, project(MARKS, BASE, LOOSE))
    assert resampled(clear, repeats(3, a2=0.6))["effect2 at hinge"] == 1.0
    twin = MARKS.copy()
    twin[4] = twin[2] + 0.02 * MARKS[0]
    data = repeats(4, a2=0.6)
    shares = resampled(screen(data, QUESTIONS, project(twin, BASE, LOOSE)), data)
    assert shares["effect2 at hinge"] + shares["effect4 at hinge"] == pytest.approx(1.0)
    assert sum(shares.values()) == pytest.approx(1.0)


def test_one_sided_p():
    assert one_sided_p(np.full(10, 2.0) + np.linspace(-0.1, 0.1, 10)) == pytest.approx(1 / 512)
    assert one_sided_p(-np.arange(1.0, 11.0)) > 0.9


def test_rivals_that_do_as_well_are_ties():
    def trial(name: str, left: float, *reasons: str) -> Trial:
        return Trial(name, left, left, 0.002, {}, 1.0, reasons)

    best, near, far, failed = trial("a", 1.0), trial("b", 1.8), trial("c", 2.5), trial("d", 1.0, "on its bound")
    assert tied([best, near, far, failed], best, before=10.0) == [near]


def test_candidates_are_effects_at_places_with_shapes():
    made = Effect(
        "ripple",
        tuple(Parameter(n, "-", 0.0, 1.0, -1.0, 1.0) for n in ("s[a]", "c[a]", "s[b]", "c[b]", "n")),
        places={"a": ("s[a]", "c[a]"), "b": ("s[b]", "c[b]")},
        shapes={"n": (1.0, 2.0, 3.0)},
    )
    found = candidates([made, Effect("plain", places={"hinge": ("x",)})])
    assert len(found) == 7
    assert {c.name for c in found} == {"ripple at a", "ripple at b", "plain at hinge"}
    assert found[0].free == ("s[a]", "c[a]", "n") and found[-1].free == ("x",)
    assert len({c.key for c in found}) == 7
