"""The search as one call, and the amendments of its verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from small_gap import Small, record, small
from small_log import CONFIG, COULOMB, MJCF, elbow, elbow_log, elbow_space

import droid_jax as dj
from droid_jax.discrepancy import missing
from droid_jax.discrepancy.candidates import acts_on_commands_only, observable_effects
from droid_jax.discrepancy.fitting import FinalModel
from droid_jax.discrepancy.missing import EXPERIMENTS, MADE, NOT_NEEDED, REFIT, amended
from droid_jax.discrepancy.verdict import Conclusion, Experiment, Verdict
from droid_jax.files import NOT_MADE, TO_BE_MADE
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import EffectKey
from droid_jax.model.effects.registry import joined, library
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import compile_scene
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import Split

SEARCH = replace(CONFIG, search=CmaConfig(population=8, parents=None, generations=2), max_effects=1)
COULOMB_KEY = EffectKey("joint_coulomb", "elbow")

LATE = Effect("late", (Parameter("late", "s", 0.0, 0.01, -0.1, 0.1),), command=lambda theta, time, look: look(time),
              locations={"elbow": ("late",)})  # fmt: skip
THREE = [replace(elbow_log(COULOMB, 7.0, 8, pace), name=f"pace {pace:g}") for pace in (1.0, 0.8, 1.25)]


@pytest.mark.parametrize(
    ("recordings", "judged", "searched"),
    [
        pytest.param(THREE, ["train", "validation", "test"], True, marks=pytest.mark.slow),
        ([elbow_log(COULOMB, 7.0, repeats=16)], ["train", "validation"], True),
        ([elbow_log(COULOMB)], ["train", "validation", "test"], False),
    ],
    ids=["recordings", "repeats", "blocks"],
)
def test_hidden_friction_is_named_and_in_the_extended_model(
    recordings: Sequence[Recording], judged: list[str], searched: bool
):
    scene, stages = elbow(), []
    verdict, extended = dj.find_missing_effects(
        scene,
        elbow_space(scene),
        recordings,
        effects=library(scene, ["joint_coulomb", "cable_pull"]),
        config=SEARCH,
        progress=lambda stage, value: stages.append(stage),
    )
    assert (verdict.conclusion, verdict.effects) == (Conclusion.NAMED, (COULOMB_KEY,))
    assert list(verdict.discrepancies) == judged and all(verdict.closed(role) > 0.9 for role in judged)
    assert [part.key for part in extended.parts] == [COULOMB_KEY]
    assert extended.space.names == ("elbow_damping", "torque_offset[elbow]", "joint_coulomb[elbow]")
    np.testing.assert_allclose(extended.values, [0.6, 0.1, COULOMB], rtol=0.1, atol=0.02)
    assert ("search" in stages) is searched and {"score_test", "refit", "verdict"} <= set(stages)


def test_servo_effects_are_not_tested_in_a_log_without_commands():
    """Nor are gains, which are fields of the model without influence there; effects that read them are tested."""
    servo = '</worldbody><actuator><position name="servo" joint="elbow" kp="10"/></actuator>'
    scene = compile_scene(mujoco.MjSpec.from_string(MJCF.replace("</worldbody>", servo)), "elbow", joints=["elbow"])
    log = elbow_log(COULOMB)
    commanded = {e.name for e in observable_effects(scene, [replace(log, command=np.zeros((2, 1)))])}
    assert commanded - {e.name for e in observable_effects(scene, [log])} >= {"servo_gain", "command_delay"}
    assert {"payload", "joint_coulomb", "sensor_delay", "torque_gain"} <= {
        e.name for e in observable_effects(scene, [log])
    }
    (gain,) = library(scene, ["servo_gain"])
    assert acts_on_commands_only(gain) and not acts_on_commands_only(
        replace(gain, force=lambda theta, state: state.qvel)
    )
    assert not acts_on_commands_only(
        replace(gain, parameters=(*gain.parameters, *library(scene, ["payload"])[0].parameters))
    )


@pytest.mark.slow
def test_the_default_effects_are_all_that_can_change_the_compared_channels(monkeypatch: pytest.MonkeyPatch):
    scene, begin = elbow(), np.array([0.6, 0.1])

    def answer(split, case, fine, start, progress):
        assert split is Split.RECORDINGS and list(case.residual_sets) == ["train", "validation", "test"]
        assert fine is None  # a prescribed motion has no time step
        assert [e.name for e in case.effects] == [e.name for e in observable_effects(scene, THREE)] and len(
            case.effects
        ) > 5
        assert case.config == replace(dj.DiscrepancyConfig(), channels=("torque",))
        np.testing.assert_array_equal(start, begin)
        raise KeyboardInterrupt

    monkeypatch.setattr(missing, "search", answer)
    with pytest.raises(KeyboardInterrupt):
        dj.find_missing_effects(scene, elbow_space(scene), THREE, start=begin)


def test_a_parameter_with_the_name_of_an_effects_parameter_is_refused():
    """The mass of a body named payload and a parameter of the library are both called payload_mass."""
    scene = elbow()
    space = elbow_space(scene)
    taken = Space((*space.parameters[1:], replace(space.parameters[0], name="payload_mass[elbow]")))
    same = Effect(
        "same", (replace(space.parameters[0], name="payload_mass[elbow]", writes=()),), locations={"elbow": ()}
    )
    with pytest.raises(ValueError, match=r"'payload_mass\[elbow\]' \(of the effect same\); rename them"):
        joined(taken, (same,))
    assert joined(space, (same,)).names == (*space.names, "payload_mass[elbow]")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"recordings": []}, "no recording to fit: give one, or several"),
        ({"recordings": [elbow_log(0.0, 2.0, 8)] * 4}, "got 4"),
        ({"recordings": [elbow_log(0.0, 2.0, 15)]}, "is the only one and has 15 repeats"),
        ({"recordings": [elbow_log(0.0, 2.0, 8)] * 2}, "the train and the validation recording are the same"),
        ({"effects": ()}, "effects: there is none to test"),
        ({"effects": [Effect("late")]}, "none of the effects states its locations"),
        ({"effects": [LATE]}, "effects late change commands, which a prescribed motion"),
        ({"start": np.zeros(3)}, "expected parameter vectors [..., 2]"),
    ],
)
def test_invalid_arguments_are_refused_before_the_search(changes: dict[str, Any], said: str):
    scene = elbow()
    with pytest.raises(ValueError) as refused:
        dj.find_missing_effects(scene, elbow_space(scene), **{"recordings": [elbow_log(0.0, 2.0, 16)], **changes})
    assert said in str(refused.value)


# ----- amendments of a verdict: one after the other; a failure changes nothing else


FASTER = (Experiment("twice as fast", 8.5),)


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def with_an_alternative(found: Small) -> Verdict:
    """The verdict as if the base model were indistinguishable from its model."""
    return replace(found.verdict, indistinguishable_models=((found.verdict.model, found.base),))


def another_model(found: Small) -> FinalModel:
    """A final model other than that of the search."""
    return FinalModel(found.base, (found.case.train,))


def failing(error: BaseException) -> Callable[..., Any]:
    def fail(*arguments: Any) -> Any:
        raise error

    return fail


def test_the_verdict_comes_first_and_then_each_amendment(found: Small, monkeypatch: pytest.MonkeyPatch):
    open_verdict, refitted = with_an_alternative(found), another_model(found)
    monkeypatch.setattr(missing, "separating_experiments", lambda case, groups, recording: FASTER)
    monkeypatch.setattr(missing, "final_refit", lambda *arguments: refitted)
    first, second, third = amended(found.case, open_verdict, record("train"))
    assert first.states == {EXPERIMENTS: TO_BE_MADE, REFIT: TO_BE_MADE}
    assert (
        first.verdict is open_verdict
        and first.final.model is open_verdict.model
        and first.final.fitted_to == (found.case.train,)
    )
    assert second.verdict.experiments == FASTER and second.states == {EXPERIMENTS: MADE, REFIT: TO_BE_MADE}
    assert third.final is refitted and third.states == {EXPERIMENTS: MADE, REFIT: MADE}


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("the channel has a stretch that no repeat measured"), "the channel has a stretch that no repeat "),
        (MemoryError(), "MemoryError"),
        (RuntimeError("XLA gave up\nat length"), "RuntimeError: XLA gave up"),
    ],
)
def test_a_failed_amendment_is_reported_and_the_next_one_is_made(
    found: Small, monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
):
    open_verdict, refitted = with_an_alternative(found), another_model(found)
    monkeypatch.setattr(missing, "separating_experiments", failing(error))
    monkeypatch.setattr(missing, "final_refit", lambda *arguments: refitted)
    *_, last = amended(found.case, open_verdict, record("train"))
    assert last.states[EXPERIMENTS].startswith(f"{NOT_MADE}: {said}") and "\n" not in last.states[EXPERIMENTS]
    assert last.states[REFIT] == MADE and last.final is refitted and last.verdict.experiments == ()
    monkeypatch.setattr(missing, "final_refit", failing(error))
    *_, last = amended(found.case, open_verdict, record("train"))
    assert last.states[REFIT].startswith(f"{NOT_MADE}: {said}")
    assert last.final.model is open_verdict.model and last.final.fitted_to == (found.case.train,)


def test_a_refit_without_a_posterior_is_no_final_model(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(missing, "final_refit", lambda *arguments: another_model(found))
    monkeypatch.setattr(missing, "extended", failing(ValueError("its covariance is singular")))
    *_, last = amended(found.case, found.verdict, record("train"))
    assert last.states[REFIT] == f"{NOT_MADE}: its covariance is singular" and last.final.model is found.verdict.model


def test_a_refit_that_does_not_converge_is_reported(found: Small, monkeypatch: pytest.MonkeyPatch):
    short = replace(
        found.case, config=replace(found.case.config, refine=replace(found.case.config.refine, iterations=1))
    )
    *_, last = amended(short, found.verdict, record("train"))
    assert last.states == {
        EXPERIMENTS: NOT_NEEDED, REFIT: f"{NOT_MADE}: the fit to both motions did not converge"
    }  # fmt: skip


def test_there_are_no_amendments_if_none_is_due(found: Small):
    (only,) = amended(found.case, replace(found.verdict, model=found.base), record("train"))
    assert only.states == {EXPERIMENTS: NOT_NEEDED, REFIT: NOT_NEEDED}


def test_a_keyboard_interrupt_is_raised(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(missing, "final_refit", failing(KeyboardInterrupt()))
    steps = amended(found.case, found.verdict, record("train"))
    assert next(steps).states[REFIT] == TO_BE_MADE
    with pytest.raises(KeyboardInterrupt):
        next(steps)
