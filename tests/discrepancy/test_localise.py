"""Three parts of a gap: along the hinge, across it, and where the door is not held."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from droid_jax.discrepancy.localise import _bins, _cells, _parts

from droid_jax.discrepancy.statistics import detrended_discrepancy_p_values, discrepancy
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import compile_scene

REPEATS, COLUMNS, INSTANTS, FREE = 10, 3, 80, 30
SPACE = Space(
    (Parameter("mass", "kg", 1.0, 0.1, 0.0, 9.0), Parameter("hinge_preload", "N m", 0.0, 1.0, -5.0, 5.0)),
)


@pytest.fixture(scope="module")
def unit() -> np.ndarray:
    """[C, K] direction in which the hinge shows, which turns with the motion."""
    drawn = np.random.default_rng(0).normal(size=(COLUMNS, 1)) + 0.5 * np.sin(np.arange(INSTANTS) / 9.0)
    return drawn / np.linalg.norm(drawn, axis=0)


@pytest.fixture(scope="module")
def residual_set(unit: np.ndarray) -> Any:
    size = np.where(np.arange(INSTANTS) < FREE, 0.0, 7.0)

    def common(values: np.ndarray) -> np.ndarray:
        return -values[:, 1:] * (unit * size).ravel()

    return SimpleNamespace(
        cost=SimpleNamespace(space=SPACE, scene=SimpleNamespace(object_joint="hinge", joints=("a", "b", "c"))),
        repeated=True, column=np.repeat(np.arange(COLUMNS), INSTANTS), common=common, discrepancy=discrepancy,
        cell_p_values=detrended_discrepancy_p_values,
    )  # fmt: skip


def residuals(shared: np.ndarray) -> np.ndarray:
    """[N, M] of repeats that all hold `shared` [C, K], and noise of one."""
    return shared.ravel() + np.random.default_rng(1).normal(size=(REPEATS, shared.size))


@pytest.mark.parametrize(
    ("where", "name"),
    [("along", "along the hinge"), ("across", "door held, other directions"), ("free", "door not held")],
)
def test_each_part_holds_what_was_put_there(residual_set: Any, unit: np.ndarray, where: str, name: str) -> None:
    held = np.arange(INSTANTS) >= FREE
    turned = np.stack([-unit[1], unit[0], np.zeros(INSTANTS)])
    across = turned / np.linalg.norm(turned, axis=0)
    shared = {"along": 2.0 * unit * held, "across": 2.0 * across * held, "free": 2.0 * across * ~held}[where]
    cells = {c.where: c for c in _parts(residual_set, SPACE.mean, residuals(shared))}
    assert list(cells) == ["along the hinge", "door held, other directions", "door not held"]
    degrees = {"along": 1, "across": COLUMNS - 1, "free": COLUMNS}[where]
    for cell in cells.values():
        assert cell.variable == "force"
        assert cell.found == (cell.where == name)
        assert cell.discrepancy == pytest.approx(4.0 / degrees if cell.where == name else 0.0, abs=0.25)


def test_the_parts_are_told_where_a_preload_stands_near_its_bound(residual_set: Any) -> None:
    """Its push goes the other way there: beyond the bound nothing may be replayed."""

    def common(values: np.ndarray) -> np.ndarray:
        return residual_set.common(SPACE.check(values))

    checked = SimpleNamespace(**{**vars(residual_set), "common": common})
    shared = residuals(np.zeros((COLUMNS, INSTANTS)))
    for preload in (4.9, -4.9):
        assert len(_parts(checked, SPACE.values({"hinge_preload": preload}), shared)) == 3  # type: ignore[arg-type]


def test_a_hinge_with_a_sensor_of_its_own_needs_no_parts(residual_set: Any) -> None:
    cost = SimpleNamespace(space=SPACE, scene=SimpleNamespace(object_joint="c", joints=("a", "b", "c")))
    one = SimpleNamespace(**{**vars(residual_set), "cost": cost})
    assert _parts(one, SPACE.mean, residuals(np.zeros((COLUMNS, INSTANTS)))) == ()  # type: ignore[arg-type]


MIXED = """<mujoco><worldbody>
  <body><joint name="pan"/><geom size="1"/><body><joint name="extend" type="slide"/><geom size="1"/></body></body>
  <body pos="9 0 0"><joint name="drawer" type="slide"/><geom size="1"/></body></worldbody>
  <actuator><position joint="pan"/><position joint="extend"/></actuator></mujoco>"""


def test_a_place_has_the_unit_of_its_joints_type():
    """Whatever unit the whole channel states: an arm of hinges and slides, and a drawer."""
    scene = compile_scene(mujoco.MjSpec.from_string(MIXED), "mixed", object_joint="drawer")
    clock = np.linspace(0.0, 1.0, 40)
    path = np.stack([clock, clock], axis=1)[None]
    rollout = SimpleNamespace(object_angle=clock[None] ** 2, position=path, velocity=path, torque=path)
    channel = SimpleNamespace(columns=np.array([0, 1]), unit="N m")
    comparison = SimpleNamespace(clock=clock, phases=(), channel=lambda name: channel)
    cost = SimpleNamespace(comparisons=(comparison,), scene=scene, rollouts=lambda values: (rollout,))
    residual_set: Any = SimpleNamespace(cost=cost, time=np.tile(clock, 2), column=np.repeat([0, 1], 40))
    units = {variable: where.split(maxsplit=3)[-1] for (variable, where), _ in _cells(residual_set, SPACE.mean)}
    assert (units["position of pan"], units["load of pan"]) == ("rad", "N m")
    assert (units["position of extend"], units["load of extend"]) == ("m", "N")
    assert (units["object angle"], units["object speed"]) == ("m", "m/s")
    assert (scene.torque_unit(["pan"]), scene.torque_unit(scene.joints)) == ("N m", "N m or N")


def test_bins_cover_a_cell_and_nothing_else():
    x, mine = np.array([0.0, 1.0, 2.0, 3.0, 9.0]), np.array([True, True, True, True, False])
    names, masks = zip(*_bins("load of a", x, "N m", mine), strict=True)
    assert np.array_equal(np.sum(masks, axis=0), mine)
    assert names[0] == ("load of a", "0.00 to 0.50 N m") and names[-1] == ("load of a", "2.50 to 3.00 N m")
    assert _bins("load of a", x, "N m", np.array([True, False, False, False, False])) == []
    assert _bins("object speed", 0.1 + 1e-6 * x, "rad/s") == []  # constant, but for rounding
    fine = _bins("position of a", 1e-3 * x, "rad")
    assert [where for (_, where), _ in fine][:2] == ["0.0000 to 0.0015 rad", "0.0015 to 0.0030 rad"]
