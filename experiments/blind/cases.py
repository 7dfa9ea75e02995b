"""The list of cases: what is hidden in which scene, how large, and what the search must do without.

Classes: "none"; "single", one effect of the library's at 1, 3 and 10 times its detection limit; "pair", two at
3 times; "outside", what no library entry is; "left_out", a single one whose library entries are taken away.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from droid_jax.synthetic.hidden_effects import HIDDEN, ON_HINGE, Applied
from experiments.blind.answers import ANSWERS, inside, targets
from experiments.blind.draws import seed_of
from experiments.blind.scenes import Setting

NAMELESS = 0.9  # share left over by a name that takes no fifth of the gap away: the search would not give it
FACTORS = (1.0, 3.0, 10.0)  # of the detection limit
SAFE = 2.0  # times the upper end of an effect's typical range: beyond it the synthetic robot may lose the door

Limits = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Plan:
    """One case before anything is drawn.

    name: "bench/single/closer/3x/0"; it stands in sealed files only.  factor: of the detection limit.
    """

    name: str
    scene: str
    kind: str
    effects: tuple[str, ...] = ()
    factor: float = 0.0


@dataclass(frozen=True)
class Counts:
    """Cases of each class in one scene; single and outside: of each effect at each factor."""

    none: int = 10
    single: int = 1
    pair: int = 10
    outside: int = 2
    left_out: int = 10


def plans(
    setting: Setting, counts: Counts, commit: str, limits: Limits, factors: Sequence[float] = FACTORS
) -> list[Plan]:
    """All cases of a scene.  Pairs and what is left out are drawn by the commit, among what is possible there.

    factors: of single effects, and (those above one) of effects that the library has no form of.
    """
    hidden = [n for n in ANSWERS if targets(setting, n)]
    named, strange = [(n,) for n in hidden if inside(n)], [(n,) for n in hidden if not inside(n)]

    def rng(kind: str) -> np.random.Generator:  # one for each class: how many pairs are asked for decides nothing else
        return np.random.default_rng(seed_of(commit, f"{setting.name}/plans/{kind}"))

    pairs = [(*a, *b) for a, b in itertools.combinations(named, 2) if _apart(*a, *b)]
    wanted = [("none", (), 0.0, k) for k in range(counts.none)]
    wanted += [("single", *one, k) for one in itertools.product(named, factors) for k in range(counts.single)]
    wanted += [("pair", *one) for one in _some(rng("pair"), setting, [(p, 3.0) for p in pairs], limits, counts.pair)]
    above = [f for f in factors if f > 1.0]
    wanted += [("outside", *one, k) for one in itertools.product(strange, above) for k in range(counts.outside)]
    left_out = list(itertools.product(named, FACTORS[1:]))
    wanted += [("left_out", *one) for one in _some(rng("left_out"), setting, left_out, limits, counts.left_out)]
    return [_plan(setting.name, *one) for one in wanted]


def _plan(scene: str, kind: str, effects: tuple[str, ...], factor: float, number: int) -> Plan:
    return Plan(f"{scene}/{kind}/{'+'.join(effects) or 'nothing'}/{factor:g}x/{number}", scene, kind, effects, factor)


def _apart(first: str, second: str) -> bool:
    """Whether no name is right for both, wherever they are: the answers to such a pair could not be told apart."""
    names = [{ON_HINGE.get(n, n) for n in (ANSWERS[e].exact, *ANSWERS[e].ties)} for e in (first, second)]
    return not names[0] & names[1]


def _some(
    rng: np.random.Generator, setting: Setting, wanted: list[tuple[tuple[str, ...], float]], limits: Limits, count: int
) -> list[tuple[tuple[str, ...], float, int]]:
    """`count` of the (effects, factor) that are possible, numbered, each as often as any other."""
    fit = [(names, f) for names, f in wanted if all(sizes(setting, n, f, limits) for n in names)]
    order = [i for _ in range(-(-count // len(fit))) for i in rng.permutation(len(fit))] if fit else []
    return [(*fit[i], k) for k, i in enumerate(order[:count])]


def applied(setting: Setting, plan: Plan, limits: Limits, rng: np.random.Generator) -> tuple[Applied, ...] | None:
    """The plan's effects with joints and amplitudes; None where no joint can have one that large.

    Only effects of the arm get a random sign: a door that swings open by itself cannot be grasped.
    """
    out = []
    for name in plan.effects:
        of_joints = sizes(setting, name, plan.factor, limits)
        if not of_joints:
            return None
        joint = list(of_joints)[int(rng.integers(len(of_joints)))]
        sign = rng.choice([-1.0, 1.0]) if HIDDEN[name].signed and HIDDEN[name].on == "arm" else 1.0
        out.append(Applied(name, float(sign * of_joints[joint]), joint))
    return tuple(out)


def sizes(setting: Setting, name: str, factor: float, limits: Limits) -> dict[str, float]:
    """Joint -> amplitude, of those on which it can be that large."""
    found = {joint: amplitude(name, joint, factor, limits) for joint in targets(setting, name)}
    return {joint: size for joint, size in found.items() if size is not None}


def amplitude(name: str, joint: str, factor: float, limits: Limits) -> float | None:
    """factor times the detection limit (or the size worth naming, where that is larger).

    None where that is not safe, or where no right name explains anything there.
    """
    entry = limits.get(key(name, joint), {})
    if entry.get("limit") is None or (entry["right"] and min(entry["right"].values()) >= NAMELESS):
        return None
    size = factor * max(entry["limit"], entry.get("worth", 0.0))
    return size if size <= SAFE * HIDDEN[name].typical[1] else None


def key(name: str, joint: str) -> str:
    """ "torque_ripple[elbow]", or the name alone."""
    return f"{name}[{joint}]" if joint else name


def keys(setting: Setting) -> Iterable[Applied]:
    """Everything that can be hidden in a scene, with amplitude 0."""
    return [Applied(name, 0.0, joint) for name in ANSWERS for joint in targets(setting, name)]
