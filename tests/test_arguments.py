"""Arguments are checked like files: one sentence names the argument, its place and its value."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import droid_jax as dj
from droid_jax import arguments
from droid_jax.arguments import check_fields, number, whole
from droid_jax.cost.noise import NoiseConfig
from droid_jax.cost.residuals import CompareConfig
from droid_jax.discrepancy.config import BlocksConfig, DiscrepancyConfig, SelectionConfig
from droid_jax.errors import faults, named
from droid_jax.identify.identifiability import IdentifiabilityConfig
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import IdentifyConfig
from droid_jax.identify.search import CmaConfig
from droid_jax.model.parameters import Mode, Parameter, Scaling, Space, Write
from droid_jax.policy.train import TrainConfig
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.simulate.initial_state import StartConfig
from droid_jax.simulate.rest import RestConfig
from droid_jax.synthetic.policy_trials import TransferConfig
from droid_jax.synthetic.robot import SyntheticRobotConfig

GOOD = {"name": "a", "unit": "kg", "mean": 1.0, "std": 0.5, "low": 0.1, "high": 5.0}


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: IdentifyConfig(heldout=math.nan), "heldout must be finite, got nan"),
        (lambda: IdentifyConfig(heldout=-0.1), "heldout must be at least 0, got -0.1"),
        (lambda: IdentifyConfig(heldout=1.0), "heldout must be below 1, got 1.0"),
        (lambda: IdentifyConfig(heldout="0.3"), "heldout must be a number, got '0.3'"),  # pyright: ignore
        (lambda: IdentifyConfig(heldout=True), "heldout must be a number, got True"),
        (lambda: IdentifyConfig(engine="mjxx"), "engine must be one of auto, mjx, mujoco, got 'mjxx'"),
        (lambda: IdentifyConfig(search={}), "search must be a CmaConfig, got a dict"),  # pyright: ignore
        (lambda: IdentifyConfig(samples=-1), "samples must be at least 0, got -1"),
        (lambda: CompareConfig(motion_cutoff=0.0), "motion_cutoff must be above 0, got 0.0"),
        (lambda: CompareConfig(motion_cutoff=math.inf), "motion_cutoff must be finite, got inf"),
        (lambda: CompareConfig(channels={"torque": -1.0}), "channels, 'torque' must be at least 0, got -1.0"),
        (lambda: CompareConfig(channels={"torque": "1"}), "channels, 'torque' must be a number"),  # pyright: ignore
        (lambda: CompareConfig(channels={"torque": 0.0}), "channels must have a weight above 0"),
        (lambda: CompareConfig(channels={"torque": 1.0, "position": 0.0}), "channels: position has weight 0"),
        (lambda: CompareConfig(channels=["torque"]), "channels must map names to weights"),  # pyright: ignore
        (lambda: CompareConfig(whitened="yes"), "whitened must be True or False, got 'yes'"),  # pyright: ignore
        (lambda: CompareConfig(grip_share=1.5), "grip_share must be at most 1, got 1.5"),
        (lambda: NoiseConfig(cutoff=0.0), "cutoff must be above 0, got 0.0"),
        (lambda: NoiseConfig(cutoff=10.0), "rate must be above twice the cutoff of 10 Hz (Nyquist), got 20 Hz"),
        (lambda: NoiseConfig(trend_repeats=2), "trend_repeats must be at least 3, got 2"),
        (lambda: NoiseConfig(minimum={"torque": 0.1}), "minimum must give each of torque, position, velocity"),
        (lambda: RestConfig(speed=-1.0), "speed must be at least 0, got -1.0"),
        (lambda: RestConfig(stop=0.0), "stop must be above 0, got 0.0"),
        (lambda: StartConfig(scatter=-0.1), "scatter must be at least 0, got -0.1"),
        (lambda: CompareConfig(noise=8.0), "noise must be a NoiseConfig, got 8.0"),  # pyright: ignore
        (lambda: IdentifiabilityConfig(partner=1.5), "partner must be at most 1, got 1.5"),
        (lambda: IdentifyConfig(checks="yes"), "checks must be True or False, got 'yes'"),  # pyright: ignore
        (lambda: CmaConfig(redraws=0), "redraws must be at least 1, got 0"),
        (lambda: CmaConfig(population=2.5), "population must be a whole number, got 2.5"),  # pyright: ignore
        (lambda: CmaConfig(sigma=math.nan), "sigma must be finite, got nan"),
        (lambda: CmaConfig(tol_cost=-1.0), "tol_cost must be at least 0, got -1.0"),
        (lambda: CmaConfig(max_seconds=math.inf), "max_seconds must be finite, got inf"),
        (lambda: RefineConfig(iterations=-1), "iterations must be at least 0, got -1"),
        (lambda: RefineConfig(give_up=0.0), "give_up must be above 0, got 0.0"),
        (lambda: RefineConfig(chords=0), "chords must be at least 1, got 0"),
        (lambda: RefineConfig(step=0.0), "step must be above 0, got 0.0"),
        (lambda: RefineConfig(pruning_ratio=3.0), "pruning_ratio must be a list, got 3.0"),  # pyright: ignore
        (lambda: RefineConfig(pruning_ratio=()), "pruning_ratio must have one or more entries, got 0"),
        (lambda: RefineConfig(pruning_ratio=(3.0, math.nan)), "pruning_ratio, entry 1 must be finite, got nan"),
        (lambda: RefineConfig(tolerance=math.nan), "tolerance must be finite, got nan"),
        (lambda: RefineConfig(target_objective=math.nan), "target_objective must be finite, got nan"),
        (lambda: DiscrepancyConfig(one_step_fits=0), "one_step_fits must be at least 1, got 0"),
        (lambda: DiscrepancyConfig(budget_minutes=-1.0), "budget_minutes must be at least 0, got -1.0"),
        (lambda: SelectionConfig(minimum_closed="0.4"), "minimum_closed must be a number"),  # pyright: ignore
        (lambda: DiscrepancyConfig(refine=None), "refine must be a RefineConfig, got None"),  # pyright: ignore
        (lambda: TrainConfig(learning_rate=-1.0), "learning_rate must be above 0, got -1.0"),
        (lambda: TrainConfig(hidden=(0,)), "hidden, entry 0 must be at least 1, got 0"),
        (lambda: TransferConfig(timestep=0.0), "timestep must be above 0, got 0.0"),
        (lambda: SyntheticRobotConfig(torque_noise=(0.1,)), "torque_noise must have 2 entries"),  # pyright: ignore
        (lambda: SyntheticRobotConfig(side="joint"), "side must be one of motor, link"),  # pyright: ignore
        (lambda: TorqueConvention("joint", True), "side must be one of motor, link, got 'joint'"),  # pyright: ignore
        (lambda: TorqueConvention(TorqueSide.LINK, "yes"), "gravity must be True or False"),  # pyright: ignore
        (lambda: TorqueConvention(TorqueSide.LINK, 1), "gravity must be True or False, got 1"),  # pyright: ignore
        (lambda: Parameter(**{**GOOD, "scaling": "cubic"}), "parameter 'a': scaling must be one of linear, log"),
        (lambda: Parameter(**{**GOOD, "mean": "1"}), "parameter 'a': mean must be a number, got '1'"),
        (lambda: Parameter(**{**GOOD, "std": True}), "parameter 'a': std must be a number, got True"),
        (lambda: Parameter(**{**GOOD, "high": 10**400}), "parameter 'a': high must be a number"),
        (lambda: Parameter(**{**GOOD, "name": "a\0"}), "its name holds the character U+0000"),
        (lambda: Parameter(**{**GOOD, "name": "a\u202ecba"}), "its name holds the character U+202E"),
        (lambda: Parameter(**{**GOOD, "name": 3}), "its name must be text, got 3"),
        (lambda: Parameter(**{**GOOD, "writes": ["x"]}), "writes, entry 0 must be a Write, got 'x'"),
        (lambda: Parameter(**{**GOOD, "high": 1e308, "low": -1e308}), "too large or too small to search among"),
        (lambda: Parameter(**{**GOOD, "scaling": "log", "std": 1e-320}), "too large or too small to search among"),
        (lambda: Write("dof_damping", (-1,)), "index must be at least 0, got -1"),
        (lambda: Write("dof_damping", (0.5,)), "index must be a whole number, got 0.5"),  # pyright: ignore
        (lambda: Write("dof_damping", 0), "index must be a tuple of whole numbers, got 0"),  # pyright: ignore
        (lambda: Write("dof_damping", (0,), "cube"), "mode must be one of set, "),  # pyright: ignore
        (lambda: Space("ab"), "the parameters of a space must be a list of Parameter objects"),  # pyright: ignore
        (lambda: Space((1,)), "the parameters of a space, entry 0 must be a Parameter, got 1"),  # pyright: ignore
        (lambda: dj.door_scene(springs=True), "springs must be a whole number, got True"),
        (lambda: dj.door_scene(timestep=math.nan), "timestep must be finite, got nan"),
        (lambda: dj.load_scene(3), "the path of an MJCF must be text or a Path, got 3"),  # pyright: ignore
        (lambda: dj.load_recording("a\0b.npz"), "the path of a recording holds the character U+0000"),
        (lambda: dj.load_recording("a.npz", resample=1), "resample must be True or False, got 1"),  # pyright: ignore
    ],
)
def test_a_wrong_argument_is_one_sentence(make: Any, said: str) -> None:
    with pytest.raises(ValueError) as caught:
        make()
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_texts_that_stand_for_a_choice_are_converted() -> None:
    assert TorqueConvention("link", True) == TorqueConvention(TorqueSide.LINK, True)  # pyright: ignore
    assert Parameter(**{**GOOD, "scaling": "log"}).scaling is Scaling.LOG
    assert Write("dof_damping", [0], "add") == Write("dof_damping", (0,), Mode.ADD)  # pyright: ignore


def test_numbers_of_numpy_become_pythons() -> None:
    made = Parameter(**{**GOOD, "mean": np.float32(0.5), "nuisance": np.bool_(True)})
    assert type(made.mean) is float and made.nuisance is True
    assert type(CmaConfig(population=np.int64(8)).population) is int  # pyright: ignore


def test_two_joints_of_one_name_and_a_text_for_a_list(tmp_path: Path) -> None:
    path = tmp_path / "hinge.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size="0.1"/></body></worldbody>'
        '<actuator><position joint="j" kp="10" kv="1"/></actuator></mujoco>'
    )
    for joints, said in ((["j", "j"], "joints must be unique, repeated: j"), ("j", "joints must be a list of names")):
        with pytest.raises(ValueError, match=said):
            dj.load_scene(path, joints=joints)
    with pytest.raises(ValueError, match="friction_joints must be a list of names, got 'j'"):
        dj.load_scene(path, friction_joints="j")
    scene = dj.load_scene(path)
    with pytest.raises(ValueError, match="space must be a Space, got a list"):
        dj.make_cost(scene, [], [])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="scene must be a Scene, got a PosixPath"):
        dj.load_parameters(_json(tmp_path), path)  # pyright: ignore[reportArgumentType]


def _json(folder: Path) -> Path:
    (folder / "p.json").write_text('[{"field": "dof_damping", "element": "j", "std": 1, "high": 2}]')
    return folder / "p.json"


@dataclass(frozen=True)
class Config:
    size: float
    count: int = 1

    def __post_init__(self) -> None:
        check_fields(self, size=partial(number, above=0, most=3), count=partial(whole, least=1))


def test_fields_are_kept_as_the_checks_return_them() -> None:
    assert Config(np.float32(2.0), np.int8(3)) == Config(2.0, 3)  # pyright: ignore
    with pytest.raises(ValueError, match="size must be at most 3, got 4"):
        Config(4)


def test_what_is_shown_of_a_value_is_one_short_line() -> None:
    class Rude:
        def __repr__(self) -> str:
            raise RuntimeError("no")

    assert arguments.shown(Rude()) == "a Rude"
    assert arguments.shown("\x1b[2J\ud800\n") == r"'\x1b[2J\ud800\n'"
    assert len(arguments.shown(np.zeros((50, 50)))) == 80


def test_arrays_without_axes_are_no_lists() -> None:
    for value in (np.array(1.0), np.array("j"), Path("j"), "j", b"j", 3):
        assert not arguments.is_list(value)
    assert all(map(arguments.is_list, ([], (), {"a"}, np.zeros(2), (x for x in "ab"))))
    with pytest.raises(ValueError, match="joints must be a list of names"):
        arguments.names(np.array("j"), "joints")


@pytest.mark.parametrize("text", ["a\ud800", "a\0", "y" * 100_000])
def test_a_path_that_no_file_can_have_is_told_in_one_short_line(text: str) -> None:
    with pytest.raises(ValueError, match=r"^path ") as refused:
        arguments.path_of(text, "path")
    assert str(refused.value).isprintable() and len(str(refused.value)) < 300


def test_what_another_library_says_is_one_printable_line() -> None:
    assert arguments.said(ValueError("line 1\n  line 2\x1b")) == "line 1 line 2?"
    assert len(arguments.said(ValueError("y" * 5000))) == 300


def test_names_of_a_file_are_told_printable_and_cut():
    assert named(["a", "b"]) == "a, b"
    assert named(map(str, range(25))).endswith("18, 19 and 5 more")
    told = faults({"unknown:": ["z" * 100_000, "\x1b[31m"], "missing:": []})
    assert told.startswith("unknown: zzz") and len(told) < 200 and told.isprintable()


# Thresholds of the search for missing effects ----------------------------------------------

FROM_ONE = {"nuisance_bound", "prior_slack", "equivalence_factor", "simplest_factor"}  # factors
SHARES = {f.name for f in fields(SelectionConfig)} - FROM_ONE - {"resamples", "sensitivity_step"}


def changed(name: str, value: Any) -> dict[str, Any]:
    return {name: value}


@pytest.mark.parametrize("name", sorted(SHARES))
def test_shares_and_levels_are_between_zero_and_one(name: str):
    for value in (0.0, 0.5, 1.0):
        assert getattr(SelectionConfig(**changed(name, value)), name) == value
    for value in (-0.01, 1.01, float("nan"), "0.5", None, True):
        with pytest.raises(ValueError, match=name):
            SelectionConfig(**changed(name, value))


@pytest.mark.parametrize("name", sorted(FROM_ONE))
def test_factors_are_no_less_than_one(name: str):
    assert getattr(SelectionConfig(**changed(name, 7.5)), name) == 7.5
    for value in (0.99, -1.0, float("inf"), float("nan"), "3"):
        with pytest.raises(ValueError, match=name):
            SelectionConfig(**changed(name, value))


def test_a_sensitivity_needs_a_step():
    with pytest.raises(ValueError, match="sensitivity_step must be above 0"):
        SelectionConfig(sensitivity_step=0.0)


@pytest.mark.parametrize("value", [0, -1, 1.5, "400"])
def test_resamples_are_a_whole_number(value: Any):
    with pytest.raises(ValueError, match="resamples"):
        SelectionConfig(resamples=value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"correlation_times": -1.0}, "correlation_times"),
        ({"shortest": -0.1}, "shortest"),
        ({"fitted_share": 1.1}, "fitted_share"),
        ({"noise_share": -0.1}, "noise_share"),
        ({"equivalence_factor": 0.9}, "equivalence_factor"),
        ({"prior_slack": 0.5}, "prior_slack"),
        ({"least_test": 0}, "least_test"),
    ],
)
def test_blocks_that_no_log_could_have_are_refused(changes: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said):
        BlocksConfig(**changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"max_effects": 0}, "max_effects must be at least 1, got 0"),
        ({"pair_refits": 0}, "pair_refits must be at least 1, got 0"),
        ({"budget_minutes": -1.0}, "budget_minutes"),
        ({"selection": 0.01}, "selection"),
        ({"blocks": SelectionConfig()}, "blocks"),
        ({"polish": 12}, "polish"),
        ({"channels": ("torque", "current")}, "current"),
    ],
)
def test_settings_that_no_search_could_use_are_refused(changes: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said):
        dj.DiscrepancyConfig(**changes)


def test_thresholds_do_not_change_once_set():
    config = dj.DiscrepancyConfig()
    with pytest.raises(FrozenInstanceError):
        config.selection.significance = 0.5  # pyright: ignore[reportAttributeAccessIssue]
    other = replace(config, selection=replace(config.selection, significance=0.5))
    assert (config.selection.significance, other.selection.significance) == (0.01, 0.5)


def test_the_thresholds_are_those_of_the_published_runs():
    """A changed default changes verdicts: then the documents' tables are of another program."""
    assert SelectionConfig() == SelectionConfig(
        significance=0.01, nuisance_bound=3.0, prior_slack=3.0, sensitivity_step=0.3, collinear=0.9, confirmation=0.05,
        least_gain=0.2, least_further_gain=0.4, least_share=0.05, stability=0.8, resamples=400, interval_level=0.9,
        bound_margin=0.02,
        equivalence_factor=3.0, equivalence_doubt=0.05, equal_fit=0.05, simplest_factor=1.25, simplest_share=0.01,
        generality_factor=0.9, open_share=0.1, minimum_closed=0.4, mostly_explained=0.5, shape_interval_share=0.5,
        false_discovery_rate=0.1,
    )  # fmt: skip
    assert BlocksConfig() == BlocksConfig(1.5, 0.5, 2 / 3, 0.2, 0.3, 0.08, 2, 1.5, 30.0, 4, 31, 1)
