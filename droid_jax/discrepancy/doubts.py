"""What is to be doubted of the effects in a final model: a form that does not fit, a size that may be zero."""

from __future__ import annotations

from collections.abc import Collection

from droid_jax.discrepancy.refit import FittedModel, intervals, zero_warning
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.discrepancy.select import past_bound
from droid_jax.identify.fit import bound_of

# Share of a shape's range.  Where its interval is wider, the recordings hardly tell the shape, and that it sits on a
# bound says nothing about the form.
OPEN = 0.5


def doubts(residual_set: ResidualSet, model: FittedModel, ends: Collection[str] = ()) -> tuple[str, ...]:
    """One text for each: "the form of latch at door does not fit: latch_width at its lower bound, 0.01 rad".

    A shape is bounded by what such a thing can be.  One that the recordings tell, and that wants beyond, says that the
    library's form is not the robot's, although its place and kind may be right.  ends: amplitudes that may stand at
    their bound.
    """
    out = []
    for part in model.parts:
        wrong = [said for name in part.shape_parameters if (said := _misfit(residual_set, model, name))]
        if wrong:
            out.append(f"the form of {part.name} does not fit: {' and '.join(wrong)}")
        if zero := zero_warning(residual_set, model, part) if part.coefficients else "":
            out.append(f"of {part.name}, {zero}")
        large = [
            f"{a} {said}" for a in part.coefficients if a not in ends and (said := past_bound(residual_set, model, a))
        ]
        if large:
            out.append(f"{part.name} is larger than its bounds allow: {' and '.join(large)}")
    return tuple(out)


def bound_at(residual_set: ResidualSet, model: FittedModel, name: str) -> str:
    """ "lower" or "upper": the bound that a free parameter sits on; empty for none."""
    space = residual_set.cost.space
    return bound_of(space[name], float(model.values[space.index(name)]))


def _misfit(residual_set: ResidualSet, model: FittedModel, name: str) -> str:
    p, side = residual_set.cost.space[name], bound_at(residual_set, model, name)
    low, high = intervals(residual_set, model, [name])[name]
    if not side or high - low > OPEN * (p.high - p.low):
        return ""
    return f"{name} at its {side} bound, {p.low if side == 'lower' else p.high:g} {p.unit}".removesuffix(" -")
