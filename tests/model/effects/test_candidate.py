"""Candidates: effects at locations with shapes, and the keys that name them."""

from __future__ import annotations

import pytest

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import Candidate, EffectKey, candidates, keys_of, names_of
from droid_jax.model.parameters import Parameter


def test_candidates_are_effects_at_locations_with_shapes():
    made = Effect(
        "ripple",
        tuple(Parameter(n, "-", 0.0, 1.0, -1.0, 1.0) for n in ("s[a]", "c[a]", "s[b]", "c[b]", "n")),
        locations={"a": ("s[a]", "c[a]"), "b": ("s[b]", "c[b]")},
        shape_parameters={"n": (1.0, 2.0, 3.0)},
    )
    found = candidates([made, Effect("plain", locations={"hinge": ("x",)})])
    assert len(found) == 7
    assert set(keys_of(found)) == {EffectKey("ripple", "a"), EffectKey("ripple", "b"), EffectKey("plain", "hinge")}
    assert found[0].free == ("s[a]", "c[a]", "n") and found[-1].free == ("x",)
    assert len({c.shaped_key for c in found}) == 7
    assert found[0].shaped_key == EffectKey("ripple", "a", (("n", 1.0),)) and found[-1].shaped_key == found[-1].key


def test_effects_without_locations_are_refused():
    with pytest.raises(ValueError, match="none of the effects states its locations"):
        candidates([Effect("nowhere")])


def test_keys_are_ordered_by_effect_location_and_shape():
    ordered = [
        EffectKey("drag", "door"),
        EffectKey("latch", "door"),
        EffectKey("latch", "door", (("width", 0.1),)),
        EffectKey("latch", "door", (("width", 0.2),)),
        EffectKey("latch", "drawer"),
    ]
    assert sorted(reversed(ordered)) == ordered and len(set(ordered)) == 5
    assert EffectKey("drag", "door") == EffectKey("drag", "door", ()) and EffectKey("drag", "door") in {*ordered}


def test_the_shape_of_a_key_does_not_depend_on_the_order_of_its_parameters():
    one, other = (
        Candidate("latch", "door", ("torque",), dict(pairs))
        for pairs in ([("width", 0.1), ("exponent", 2.0)], [("exponent", 2.0), ("width", 0.1)])
    )
    assert one.shaped_key == other.shaped_key and hash(one.shaped_key) == hash(other.shaped_key)
    assert one.key == EffectKey("latch", "door")


def test_keys_in_words():
    """The text does not contain the shape."""
    latch, drag = EffectKey("latch", "door_hinge", (("width", 0.1),)), EffectKey("drag", "door_hinge")
    assert str(latch) == "latch at door_hinge"
    assert names_of([latch, drag]) == "latch at door_hinge + drag at door_hinge"
    assert names_of([]) == ""
