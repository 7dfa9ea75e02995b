"""What the search for a missing effect ends with."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass

from droid_jax.discrepancy.discretisation_error import above
from droid_jax.discrepancy.localise import Localisation
from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.screen import ScoreTest
from droid_jax.discrepancy.select import AT_BOUND, TOO_SMALL, UNCONFIRMED, ValidationTest
from droid_jax.discrepancy.trend import Trend

HALF = 0.5  # share of the gap: an effect that explains less may only imitate what is missing


def open_share(left: float, before: float, floor: float) -> float:
    """Share of a gap that is left open: of U before and U left, both above the floor."""
    return (left - floor) / max(before - floor, 1e-12)


def _beyond(reasons: Iterable[str]) -> str:
    """ " (servo_gain[elbow] more than 0.5)" of reasons that name an amplitude and its bound; empty where none does."""
    told = [r.replace(f" {AT_BOUND}:", "") for r in reasons if f"{AT_BOUND}:" in r]
    return f" ({' and '.join(told)})" if told else ""


class Conclusion(enum.Enum):
    """The answers there are."""

    NONE = "none"  # nothing is missing that these recordings could tell
    NAMED = "named"  # these effects are missing
    INDISTINGUISHABLE = "tie"  # one of these; an experiment that would tell them apart is named
    PARTLY = "partly explained"  # these, and a remainder that nothing in the library explains
    UNEXPLAINED = "unexplained"  # something is missing, and nothing in the library is it
    UNCONVERGED = "fit not converged"  # of the base model or of the extended one; nothing can be concluded


@dataclass(frozen=True)
class Experiment:
    """Something to record that would tell tied effects apart.

    what: in words.  distance: standardised difference of the rivals' simulated torques there, after each was
    refitted to what is recorded already; above about 6 ten repeats decide.  None where it could not be made:
    not_made says why.
    """

    what: str
    distance: float | None
    not_made: str = ""


@dataclass(frozen=True)
class Hint:
    """Effects that passed their trials and close too little to be named: they may only imitate what is missing.

    effects, indistinguishable: as of a verdict.  closed: share of U beyond the floor by held-out role, "validation"
    and "test".
    """

    effects: tuple[str, ...]
    indistinguishable: tuple[tuple[str, ...], ...]
    closed: dict[str, float]

    @property
    def words(self) -> str:
        """ "a (closes 31 %)", "a or b (closes 31 %)": the least that it closes on a held-out recording."""
        each = [" or ".join((e, *ties)) for e, ties in zip(self.effects, self.indistinguishable, strict=True)]
        return f"{' and '.join(each)} (closes {max(min(self.closed.values()), 0.0):.0%})"


LOST = "the fitted model on the test recording"  # among what failed


@dataclass(frozen=True, eq=False)
class Verdict:
    """The answer and its grounds.

    kind; effects: names of what is in the model; indistinguishable: for each of them the names that do as well.
    base, model: before and after.  discretisation_error: U0, what the simulation's own step leaves.
    discrepancies: "train", "validation", "test" -> (U before, U after).  remainder: U on the validation demonstration
    that neither
    `model` nor the uncertainty of its fit explains (`transfer.beyond_fit_uncertainty`), None where no fit converged.
    score_tests, validation_tests:
    the grounds, in the order they were made.  failed: models whose replay blew up where their refit was to begin, or
    on the test recording, which then is not in gaps.
    before, after: where the gap lives on the fitted recording.  rivals: models that do as well as `model`, refitted;
    experiments: what would tell them apart, the best first.  not_tried: in words what the budget left out, empty for
    nothing. trend: what changes from repeat to repeat, None where nothing was asked.
    hints: effects that close too little to be named, see `workflow.unnamed`; the model is without them.
    doubts: what is to be doubted of the effects in the model (`doubts.doubts`).
    """

    kind: Conclusion
    effects: tuple[str, ...]
    indistinguishable: tuple[tuple[str, ...], ...]
    base: FittedModel
    model: FittedModel
    discretisation_error: float
    discrepancies: dict[str, tuple[float, float]]
    score_tests: tuple[ScoreTest, ...]
    validation_tests: tuple[ValidationTest, ...]
    before: Localisation
    after: Localisation
    remainder: float | None = None
    failed: tuple[str, ...] = ()
    indistinguishable_models: tuple[FittedModel, ...] = ()
    experiments: tuple[Experiment, ...] = ()
    not_tried: str = ""
    trend: Trend | None = None
    hints: tuple[Hint, ...] = ()
    doubts: tuple[str, ...] = ()

    def closed(self, role: str) -> float:
        """1 - (U_after - U0) / (U_before - U0) on "train", "validation" or "test"."""
        before, after = self.discrepancies[role]
        return 1.0 - open_share(after, before, self.discretisation_error)

    def closed_held_out(self) -> dict[str, float]:
        """`closed` of the held-out roles that show a discrepancy at all."""
        held_out = {role: before for role, (before, _) in self.discrepancies.items() if role != "train"}
        return {
            role: self.closed(role) for role, before in held_out.items() if above(before, self.discretisation_error)
        }

    @property
    def explained(self) -> float:
        """Share of the gap on the validation demonstration that the model, or its fit's uncertainty, explains."""
        before, after = self.discrepancies["validation"]
        left = after if self.remainder is None else self.remainder
        return 1.0 - open_share(left, before, self.discretisation_error)

    @property
    def _unsettled(self) -> str:
        return "the model with the effects" if self.base.refined.converged else "the base model"

    @property
    def _lacking(self) -> str:
        """ "a and b", "a, and one of: b or c"."""
        both = list(zip(self.effects, self.indistinguishable, strict=True))
        certain = " and ".join(e for e, ties in both if not ties)
        open_ones = [f"one of: {' or '.join((e, *ties))}" for e, ties in both if ties]
        return ", and ".join([certain, *open_ones] if certain else open_ones)

    @property
    def _or_lost(self) -> str:
        """Where a candidate lost for its size or its significance alone, it may be all there is."""
        lost = [t for t in self.validation_tests if t.reasons]
        small = dict.fromkeys(t.name for t in lost if t.reasons == (TOO_SMALL,))
        large = {t.name: _beyond(t.reasons) for t in lost if all(AT_BOUND in r for r in t.reasons)}
        chance = dict.fromkeys(t.name for t in lost if all(r.startswith(UNCONFIRMED) for r in t.reasons))
        return "".join(
            f", or {' or '.join(names)}, {why}"
            for names, why in (
                (small, TOO_SMALL),
                ([f"{name}{beyond}" for name, beyond in large.items()], "larger than its bounds allow"),
                (chance, UNCONFIRMED),
            )
            if names
        )

    @property
    def _partly(self) -> str:
        if self.explained >= HALF:
            return f"The model lacks {self._lacking}; a remainder is unexplained."
        return (
            "Most of what the model lacks is not in the library; what there is explains or imitates "
            f"{max(self.explained, 0.0):.0%} of it: {self._lacking}."
        )

    @property
    def _hinted(self) -> str:
        if not self.hints:
            return ""
        return f" Hints, not names, since they may only imitate it: {'; '.join(h.words for h in self.hints)}."

    @property
    def sentence(self) -> str:
        """The answer in words, and what is to be doubted of it."""
        doubted = [f" But {doubt}." for doubt in self.doubts]
        return "".join([self._answer, *doubted])

    @property
    def _answer(self) -> str:
        return {
            Conclusion.NONE: "Nothing is missing that these recordings could tell.",
            Conclusion.NAMED: f"The model lacks: {self._lacking}.",
            Conclusion.INDISTINGUISHABLE: f"The model lacks {self._lacking}.",
            Conclusion.PARTLY: self._partly,
            Conclusion.UNEXPLAINED: "The model lacks something that is not in the library"
            f"{self._or_lost}.{self._hinted}",
            Conclusion.UNCONVERGED: f"The fit of {self._unsettled} did not converge; nothing can be concluded.",
        }[self.kind]
