"""One round of the search: its budget, its aim, and what is taken out again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from droid_jax.discrepancy.search_state import Budget

from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.discrepancy.search import SearchState, pruned, without
from droid_jax.discrepancy.statistics import OUTSIDE, Blocks
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import Candidate
from droid_jax.model.parameters import Parameter, Space


def test_a_shape_stays_where_its_effect_does() -> None:
    """A ripple asked about elsewhere has the count of the one in the model, and keeps it when that one goes."""
    first = Candidate("ripple", "elbow", ("ripple_elbow",), {"periods": 48.0})
    second, drag = Candidate("ripple", "wrist", ("ripple_wrist",)), Candidate("drag", "hinge", ("drag",))
    assert without(first, (first, drag, second)) == (
        drag,
        Candidate("ripple", "wrist", ("ripple_wrist",), {"periods": 48.0}),
    )
    assert without(second, (first, drag, second)) == (first, drag)
    assert without(drag, (first, drag)) == (first,)


def test_a_part_that_the_replay_cannot_do_without_stays() -> None:
    """A damper keeps the simulation whole; drag takes next to nothing away and goes."""
    damper, drag = Candidate("closer", "hinge", ("closer",)), Candidate("drag", "hinge", ("drag",))

    def refit(parts: Any, start: Any, config: Any, note: str) -> Any:
        if damper not in parts:
            raise NotReplayed("none of the starts could be replayed")
        return SimpleNamespace(parts=parts, values=start, left=1.01)

    whole = Space(tuple(Parameter(name, "N m", 0.0, 1.0, -5.0, 5.0) for name in ("closer", "drag")))
    case = SimpleNamespace(full_space=whole, config=SimpleNamespace(refit=None))
    state: Any = SimpleNamespace(case=case, refit=refit, discrepancy=lambda model: model.left, base_discrepancy=10.0)
    model: Any = SimpleNamespace(parts=(damper, drag), values=np.array([2.0, 1.0]), left=1.0)
    assert pruned(state, model).parts == (damper,)


def test_a_budget_says_what_it_left_out() -> None:
    tight = Budget(1e-9)
    assert list(tight.within("candidates not refitted", "abc")) == ["a"] and tight.spent
    tight.skip("pairs of effects not tried")
    assert tight.cut == "2 of 3 candidates not refitted; pairs of effects not tried"
    free = Budget(None)
    assert list(free.within("candidates not refitted", "abc")) == ["a", "b", "c"] and free.cut == ""


@pytest.mark.parametrize("blocks", [False, True])
def test_the_aim_is_the_objective_of_half_the_share_that_an_effect_must_take(blocks: bool) -> None:
    """U of 4, a fifth of which an effect must take away: the objective falls by a tenth of it."""
    cost, nothing, none = SimpleNamespace(), np.zeros((1, 30)), np.zeros(30)
    block = np.array([0] * 6 + [1] * 6 + [OUTSIDE] * 18)
    known: Any = (cost, nothing, none, none)
    residual_set = Blocks(*known, block) if blocks else ResidualSet(*known)
    count = 12 if blocks else 30
    fitted: Any = SimpleNamespace(parts=(), discrepancy=4.0, refined=SimpleNamespace(objective=0.5 * count * 4.0))
    state: Any = SimpleNamespace(case=SimpleNamespace(train=residual_set))
    assert SearchState.target_objective(state, fitted) == pytest.approx(0.9 * fitted.refined.objective)
