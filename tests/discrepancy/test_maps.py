"""Maps of the discrepancy: three parts along and across the hinge, and cells over the state of the motion."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from small_gap import Small, small

from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.maps import Axis, CellKey, Localisation, localise
from droid_jax.discrepancy.statistics import Repeats, benjamini_hochberg
from droid_jax.model.parameters import Parameter, Role, Space
from droid_jax.model.scene import compile_scene

REPEATS, COLUMNS, INSTANTS, FREE = 10, 3, 80, 30
SPACE = Space(
    (
        Parameter("mass", "kg", 1.0, 0.1, 0.0, 9.0),
        Parameter("hinge_preload", "N m", 0.0, 1.0, -5.0, 5.0, role=Role.OBJECT_TORQUE),
    ),
)
CLOCK = np.linspace(0.0, 1.0, INSTANTS)


@pytest.fixture(scope="module")
def unit() -> np.ndarray:
    """[C, K] direction of a hinge torque in the measured joints, which changes with the motion."""
    drawn = np.random.default_rng(0).normal(size=(COLUMNS, 1)) + 0.5 * np.sin(np.arange(INSTANTS) / 9.0)
    return drawn / np.linalg.norm(drawn, axis=0)


def residual_set(common: Callable[[np.ndarray], np.ndarray], object_joint: str = "hinge") -> Any:
    """Residual set of three joints at rest with known residuals."""
    path = np.zeros((1, INSTANTS, COLUMNS))
    rollout = SimpleNamespace(object_angle=np.zeros((1, INSTANTS)), position=path, velocity=path, torque=path)
    channel = SimpleNamespace(name="torque", columns=np.arange(COLUMNS))
    scene = SimpleNamespace(
        object_joint=object_joint, joints=("a", "b", "c"), position_unit=lambda joints: "rad",
        torque_unit=lambda joints: "N m",
    )  # fmt: skip
    return SimpleNamespace(
        cost=SimpleNamespace(space=SPACE, scene=scene, rollouts=lambda values: (rollout,)),
        comparison=SimpleNamespace(clock=CLOCK, phases=(), channels=(channel,), channel=lambda name: channel),
        resampling=Repeats(np.zeros((REPEATS, COLUMNS * INSTANTS))), config=SelectionConfig(),
        column=np.repeat(np.arange(COLUMNS), INSTANTS), time=np.tile(CLOCK, COLUMNS), common=common,
    )  # fmt: skip


@pytest.fixture(scope="module")
def pushed(unit: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """[P, D] -> [P, M]: a preload acts along the hinge while the door is held."""
    size = np.where(np.arange(INSTANTS) < FREE, 0.0, 7.0)
    return lambda values: -values[:, 1:] * (unit * size).ravel()


def residuals(shared: np.ndarray) -> np.ndarray:
    """[N, M] residuals of repeats with a common part `shared` [C, K] and noise of one."""
    return shared.ravel() + np.random.default_rng(1).normal(size=(REPEATS, shared.size))


NOTHING = np.zeros((COLUMNS, INSTANTS))


def hinge_parts(of: Any, shared: np.ndarray, values: np.ndarray = SPACE.mean) -> Localisation:
    cells = localise(of, values, residuals(shared), values)
    return tuple(cell for cell in cells if cell.key.axis is Axis.HINGE_FORCE)


@pytest.mark.parametrize(
    ("where", "label"),
    [("along", "along the hinge"), ("across", "door held, other directions"), ("free", "door not held")],
)
def test_each_part_holds_the_discrepancy_that_was_put_there(
    pushed: Callable[[np.ndarray], np.ndarray], unit: np.ndarray, where: str, label: str
) -> None:
    held = np.arange(INSTANTS) >= FREE
    turned = np.stack([-unit[1], unit[0], np.zeros(INSTANTS)])
    across = turned / np.linalg.norm(turned, axis=0)
    shared = {"along": 2.0 * unit * held, "across": 2.0 * across * held, "free": 2.0 * across * ~held}[where]
    cells = hinge_parts(residual_set(pushed), shared)
    assert [c.key.label for c in cells] == ["along the hinge", "door held, other directions", "door not held"]
    assert all(c.key == CellKey(Axis.HINGE_FORCE, label=c.key.label) for c in cells)
    degrees = {"along": 1, "across": COLUMNS - 1, "free": COLUMNS}[where]
    for cell in cells:
        assert cell.found == (cell.key.label == label)
        assert cell.discrepancy == pytest.approx(4.0 / degrees if cell.found else 0.0, abs=0.25)


def test_the_parts_are_computed_for_a_preload_near_its_bound(pushed: Callable[[np.ndarray], np.ndarray]) -> None:
    """The step is taken away from the bound, which no replay may cross."""
    checked = residual_set(lambda values: pushed(SPACE.check(values)))
    for preload in (4.9, -4.9):
        assert len(hinge_parts(checked, NOTHING, SPACE.values({"hinge_preload": preload}))) == 3


def test_a_hinge_with_a_sensor_has_no_parts(pushed: Callable[[np.ndarray], np.ndarray]) -> None:
    assert hinge_parts(residual_set(pushed, object_joint="c"), NOTHING) == ()


MIXED = """<mujoco><worldbody>
  <body><joint name="pan"/><geom size="1"/><body><joint name="extend" type="slide"/><geom size="1"/></body></body>
  <body pos="9 0 0"><joint name="drawer" type="slide"/><geom size="1"/></body></worldbody>
  <actuator><position joint="pan"/><position joint="extend"/></actuator></mujoco>"""


def moving(path: np.ndarray, noise: float = 1.0, angle: np.ndarray | None = None) -> tuple[Any, np.ndarray]:
    """A pan and an extending arm that follow `path` [K], a drawer at `angle`, and residuals of noise alone."""
    scene = compile_scene(mujoco.MjSpec.from_string(MIXED), "mixed", object_joint="drawer")
    clock = np.linspace(0.0, 1.0, len(path))
    both = np.stack([path, path], axis=1)[None]
    opened = (clock**2 if angle is None else angle)[None]
    rollout = SimpleNamespace(object_angle=opened, position=both, velocity=both, torque=both)
    channel = SimpleNamespace(name="torque", columns=np.array([0, 1]), unit="N m")
    comparison = SimpleNamespace(clock=clock, phases=(), channels=(channel,), channel=lambda name: channel)
    cost = SimpleNamespace(scene=scene, space=Space(SPACE.parameters[:1]), rollouts=lambda values: (rollout,))
    deviations = noise * np.random.default_rng(2).normal(size=(REPEATS, 2 * len(path)))
    deviations -= deviations.mean(axis=0)
    made: Any = SimpleNamespace(
        cost=cost, comparison=comparison, config=SelectionConfig(), resampling=Repeats(deviations),
        time=np.tile(clock, 2), column=np.repeat([0, 1], len(path)),
    )  # fmt: skip
    return made, deviations


def keys(of: Any, rows: np.ndarray) -> list[CellKey]:
    return [cell.key for cell in localise(of, SPACE.mean[:1], rows, SPACE.mean[:1])]


def test_a_cell_has_the_unit_of_its_joints_type() -> None:
    """Not that of the whole channel: an arm of hinges and slides, and a drawer."""
    made, rows = moving(np.linspace(0.0, 1.0, 40))
    units = {(k.axis, k.joint): k.unit for k in keys(made, rows)}
    assert (units[Axis.POSITION, "pan"], units[Axis.LOAD, "pan"]) == ("rad", "N m")
    assert (units[Axis.POSITION, "extend"], units[Axis.LOAD, "extend"]) == ("m", "N")
    assert (units[Axis.OBJECT_ANGLE, None], units[Axis.OBJECT_SPEED, None]) == ("m", "m/s")
    assert units[Axis.PHASE, "pan"] == "s" and units[Axis.DIRECTION, "pan"] == ""
    scene = made.cost.scene
    assert (scene.torque_unit(["pan"]), scene.torque_unit(scene.joints)) == ("N m", "N m or N")


def test_ranges_cover_the_motion_of_a_joint() -> None:
    """Six equal ranges from the smallest value to the largest; none for a joint at rest up to rounding."""
    made, rows = moving(np.linspace(-1.0, 2.0, 60))
    found = [k for k in keys(made, rows) if (k.axis, k.joint) == (Axis.POSITION, "pan")]
    assert len(found) == 6 and found[0].low == -1.0
    most = found[-1].high
    assert most == pytest.approx(2.0) and most is not None and most > 2.0  # the largest value is inside
    assert all(a.high == b.low for a, b in itertools.pairwise(found))
    widths = [k.high - k.low for k in found if k.high is not None and k.low is not None]
    assert widths == pytest.approx([0.5] * 6)
    still, rows = moving(0.1 + 1e-6 * np.linspace(0.0, 1.0, 60))
    assert {k.axis for k in keys(still, rows)} & {Axis.POSITION, Axis.LOAD} == set()
    shut, rows = moving(np.linspace(-1.0, 2.0, 60), angle=np.zeros(60))
    assert not {k.axis for k in keys(shut, rows)} & {Axis.OBJECT_ANGLE, Axis.OBJECT_SPEED, Axis.OBJECT_DIRECTION}


def test_a_cell_holds_the_residuals_of_its_range() -> None:
    """A common residual while the pan is between 0.5 and 1 rad is in that cell, with its mean square."""
    path = np.linspace(-1.0, 2.0, 300)
    made, rows = moving(path)
    here = (path >= 0.5) & (path < 1.0)
    rows = rows + np.r_[2.0 * here, np.zeros(300)]
    cells = {c.key: c for c in localise(made, SPACE.mean[:1], rows, SPACE.mean[:1]) if c.key.axis is Axis.POSITION}
    for key, cell in cells.items():
        mine = key.joint == "pan" and key.low == pytest.approx(0.5)
        assert cell.found is mine and cell.discrepancy == pytest.approx(4.0 if mine else 0.0, abs=0.3)


def test_cells_are_found_at_the_configured_rate() -> None:
    made, rows = moving(np.linspace(-1.0, 2.0, 300))
    rows = rows + 0.08
    for rate in (0.01, 0.1, 0.9):
        made.config = SelectionConfig(false_discovery_rate=rate)
        cells = [c for c in localise(made, SPACE.mean[:1], rows, SPACE.mean[:1]) if c.p < 1.0]  # those tested
        expected = benjamini_hochberg(np.array([c.p for c in cells]), rate)
        assert [c.found for c in cells] == expected.tolist()


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.mark.slow
def test_the_search_maps_both_models_over_one_motion(found: Small) -> None:
    verdict, train = found.verdict, found.case.train
    assert [c.key for c in verdict.before] == [c.key for c in verdict.after]
    again = localise(train, found.base.values, found.base.residuals, verdict.model.values)
    assert verdict.before == again
    where = [c for c in verdict.before if c.key.axis is Axis.PHASE]
    assert [(c.key.joint, c.key.label) for c in where] == [
        (joint, phase) for joint in ("shoulder", "elbow", "door") for phase in ("first", "second")
    ]
    assert [c.found for c in where if c.key.joint == "door"] == [True, True]
    assert not any(c.found for c in verdict.after if c.key.axis is Axis.HINGE_FORCE)
