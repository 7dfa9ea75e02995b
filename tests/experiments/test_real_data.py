"""The experiments on real logs: known friction comes back from synthetic logs, and the real ones reach their targets.

Oracle of the synthetic Panda: C MuJoCo's mj_inverse, with friction added in numpy.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest

from droid_jax.door.scene import ARM, FINGERS, panda_arm_scene
from droid_jax.model.joint_friction import joint_friction_space

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
VISCOUS = np.array([0.08, 0.2, 0.05, 0.22, 0.1, 0.03, 0.06])  # N m s/rad
COULOMB = np.array([0.25, 0.15, 0.2, 0.36, 0.27, 0.16, 0.21])  # N m
OFFSET = np.array([-0.1, -0.16, 0.07, -0.25, 0.01, 0.09, -0.01])  # N m


@pytest.fixture
def experiment(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Import a script of experiments/ by name."""

    def load(name: str) -> ModuleType:
        monkeypatch.setattr(sys, "path", [str(EXPERIMENTS), *sys.path])
        return importlib.import_module(name)

    return load


def synthetic_motion(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, qd, qdd [T, 7] of two sines a joint, well below the filter, about a pose inside the ranges."""
    centre = np.array([0.0, 0.2, 0.1, -1.8, 0.2, 1.6, 0.3])
    q, qd, qdd = np.tile(centre, (len(time), 1)), np.zeros((len(time), 7)), np.zeros((len(time), 7))
    for j in range(7):
        for frequency, size in ((0.21 + 0.03 * j, 0.4), (0.5 - 0.02 * j, 0.12)):
            w, phase = 2 * np.pi * frequency, j + frequency
            q[:, j] += size * np.sin(w * time + phase)
            qd[:, j] += size * w * np.cos(w * time + phase)
            qdd[:, j] -= size * w**2 * np.sin(w * time + phase)
    return q, qd, qdd


def rigid_torque(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """[T, 7] N m on the link side, gravity in, by C MuJoCo's inverse dynamics."""
    model = panda_arm_scene().model.__copy__()
    model.dof_armature[:] = model.dof_damping[:] = model.dof_frictionloss[:] = 0
    model.body_gravcomp[:] = 0
    data, torque = mujoco.MjData(model), np.empty_like(q)
    for i in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[i], qd[i], qdd[i]
        mujoco.mj_inverse(model, data)
        torque[i] = data.qfrc_inverse
    return torque


def write_panda(folder: Path, seconds: float = 9.0) -> None:
    """A synthetic log in the data set's layout: jittered clock, repeated rows, sensor noise."""
    rng = np.random.default_rng(0)
    time = np.arange(0, seconds, 1e-3) + rng.uniform(-2e-4, 2e-4, round(seconds * 1e3))
    q, qd, qdd = synthetic_motion(time)
    torque = rigid_torque(q, qd, qdd) + VISCOUS * qd + COULOMB * np.sign(qd) + OFFSET
    torque += rng.normal(0, 0.05, torque.shape)
    for lost in np.flatnonzero(rng.random(len(time)) < 0.06)[1:]:
        q[lost], torque[lost] = q[lost - 1], torque[lost - 1]
    np.savez(folder / "panda_exciting_traj1.npz", t=time, q=q.astype(np.float32), tau=torque.astype(np.float32))
    published = {f"{k}_{rule}": v.tolist() for rule in ("OSI", "CLS")
                 for k, v in (("fv", VISCOUS), ("fc", COULOMB), ("fo", OFFSET))}  # fmt: skip
    (folder / "reference_values.json").write_text(json.dumps({"gaz2019_linear_from_THIS_trajectory": published}))


def write_emps(folder: Path, mass: float, damping: float, friction: float, offset: float) -> None:
    """Two synthetic runs in the benchmark's layout, by the carriage's equation of motion."""
    gain = 35.15
    for name, frequencies in (("DATA_EMPS", (0.23, 1.1)), ("DATA_EMPS_PULSES", (0.31, 0.9))):
        time = np.arange(0, 12, 1e-3)
        w = 2 * np.pi * np.array(frequencies)[:, None]
        size = np.array([[0.06], [0.01]])
        x, v = (size * np.sin(w * time)).sum(0), (size * w * np.cos(w * time)).sum(0)
        a = -(size * w**2 * np.sin(w * time)).sum(0)
        force = mass * a + damping * v + friction * np.sign(v) + offset
        np.savez(folder / f"{name}.npz", t=time, qm=x, vir=force / gain, gtau=gain)


@pytest.mark.slow
def test_arm_is_the_panda_without_its_hand() -> None:
    scene = panda_arm_scene()
    assert scene.joints == ARM == scene.command_names
    assert (scene.model.nq, scene.model.nu, scene.model.npair) == (7, 7, 0)
    # the seven links of Gaz et al., RA-L 2019
    masses = [4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522]
    assert scene.model.body_mass.sum() == pytest.approx(sum(masses), abs=1e-9)
    with pytest.raises(ValueError, match="unknown body 'hand'"):
        scene.id("body", "hand")
    with pytest.raises(ValueError, match="unknown joint"):
        scene.id("joint", FINGERS[0])


def test_friction_space_starts_at_no_friction() -> None:
    space = joint_friction_space(["a", "b"])
    assert space.names == (
        "viscous[a]",
        "viscous[b]",
        "coulomb[a]",
        "coulomb[b]",
        "torque_offset[a]",
        "torque_offset[b]",
    )
    assert np.all(space.mean == 0) and np.all(space.low < 0) and np.all(space.high > 0)


@pytest.mark.slow
def test_known_friction_comes_back(experiment: Callable[[str], ModuleType], tmp_path: Path) -> None:
    panda, fit = experiment("real_panda"), experiment("inverse_fit")
    write_panda(tmp_path)
    recording = panda.load_panda(tmp_path)
    scene = panda_arm_scene()
    part, _ = panda.cut(recording)
    space = panda.model_space(scene, "friction")
    cost = fit.inverse_cost(scene, space, part, panda.MOTION_CUTOFF)
    before = fit.rms(fit.residual(cost, space.mean))
    truth = np.concatenate([VISCOUS, COULOMB, OFFSET])
    # 50 ms filter kernels and 20 ms steps blur the jump of the sign: that is what is left at the truth
    assert np.all(fit.rms(fit.residual(cost, truth)) < 0.03)
    found = fit.estimate(cost, space, truth + 0.05, block=2.0)
    assert np.all(fit.rms(fit.residual(cost, found.best)) < 0.15 * before)
    np.testing.assert_allclose(found.best[:7], VISCOUS, atol=0.02)
    np.testing.assert_allclose(found.best[7:14], COULOMB, atol=0.01)
    np.testing.assert_allclose(found.best[14:], OFFSET, atol=0.005)
    low, high = found.gaussian.interval(0.9)
    assert np.mean((low <= truth) & (truth <= high)) >= 0.7


def test_repeated_rows_are_left_out(experiment: Callable[[str], ModuleType]) -> None:
    fit = experiment("inverse_fit")
    time = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    held = np.array([[0.0], [1.0], [1.0], [3.0], [4.0]])  # row 2 did not arrive
    np.testing.assert_allclose(fit.resampled(time, held, time), time[:, None])


@pytest.mark.slow
def test_where_no_spring_was_named_none_is_asked_for_again(experiment: Callable[[str], ModuleType]) -> None:
    """Otherwise the same search would be repeated and counted as "not named again"."""
    door = experiment("gap_door")
    assert door.with_known([], lambda known: pytest.fail("searched")) is None


@pytest.mark.slow
def test_carriage_comes_back(experiment: Callable[[str], ModuleType], tmp_path: Path) -> None:
    emps = experiment("real_emps")
    write_emps(tmp_path, 88.0, 150.0, 25.0, 4.0)
    emps.main(emps.RealEmps(data=tmp_path, out=tmp_path / "out"))
    result = json.loads((tmp_path / "out" / "real_emps.json").read_text())
    found = {name: p["value"] for name, p in result["parameters"].items()}
    assert found["carriage_mass"] == pytest.approx(88.0, rel=0.005)
    assert found["slide_damping"] == pytest.approx(150.0, rel=0.02)
    assert found["slide_frictionloss"] == pytest.approx(25.0, rel=0.02)
    assert found["torque_offset[slide]"] == pytest.approx(4.0, abs=0.1)
    assert result["after"]["DATA_EMPS_PULSES"]["relative_error"] < 0.03
    assert {"commit", "versions", "device", "seed"} <= set(result)
    assert (tmp_path / "out" / "real_emps.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize("script", ["real_panda", "real_emps"])
def test_missing_data_ends_in_one_line(
    experiment: Callable[[str], ModuleType], script: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module = experiment(script)
    config = {"real_panda": "RealPanda", "real_emps": "RealEmps"}[script]
    with pytest.raises(SystemExit) as stopped:
        module.run(lambda: module.main(getattr(module, config)(data=tmp_path, out=tmp_path / "out")))
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert str(tmp_path) in error and "--data" in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_broken_logs_are_refused(experiment: Callable[[str], ModuleType], tmp_path: Path) -> None:
    panda, emps = experiment("real_panda"), experiment("real_emps")
    log = tmp_path / "panda_exciting_traj1.npz"
    log.write_bytes(b"PK no archive")
    with pytest.raises(ValueError, match="no readable npz"):
        panda.load_panda(tmp_path)
    np.savez(log, t=np.arange(9.0), q=np.zeros((9, 7)))
    with pytest.raises(ValueError, match="missing: tau"):
        panda.load_panda(tmp_path)
    np.savez(log, t=np.arange(9.0), q=np.zeros((9, 7)), tau=np.zeros((9, 6)))
    with pytest.raises(ValueError, match="expected tau of shape"):
        panda.load_panda(tmp_path)
    np.savez(log, t=np.arange(9.0), q=np.zeros((9, 7)), tau=np.full((9, 7), np.nan))
    with pytest.raises(ValueError, match="'tau' holds numbers that are not finite"):
        panda.load_panda(tmp_path)
    (tmp_path / "reference_values.json").write_text("{}")
    with pytest.raises(ValueError, match="friction values"):
        panda.load_published(tmp_path)
    np.savez(tmp_path / "DATA_EMPS.npz", t=np.arange(9) * 1e-3, qm=np.zeros(9), vir=np.zeros(8), gtau=1.0)
    with pytest.raises(ValueError, match="of one length"):
        emps.load_emps(tmp_path, "DATA_EMPS")


@pytest.mark.slow
def test_real_panda(
    experiment: Callable[[str], ModuleType], shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    panda = experiment("real_panda")
    panda.main(panda.RealPanda(data=shared_data("franka_gaz2019"), out=tmp_path))
    result = json.loads((tmp_path / "real_panda.json").read_text())
    # rigid body alone, as others computed it from the same log with a 6 Hz filter
    reference = [0.36, 0.63, 0.36, 0.61, 0.34, 0.19, 0.28]
    np.testing.assert_allclose(result["rigid_body_rms_whole_Nm"], reference, atol=0.02)
    assert all(result["targets"].values())
    assert result["models"]["friction"]["coulomb_close_but_joint_2"]


@pytest.mark.slow
def test_real_emps(experiment: Callable[[str], ModuleType], shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    emps = experiment("real_emps")
    emps.main(emps.RealEmps(data=shared_data("emps"), out=tmp_path))
    result = json.loads((tmp_path / "real_emps.json").read_text())
    assert all(result["targets"].values())
    assert result["after"]["DATA_EMPS_PULSES"]["rms_N"] < 2.63  # the reference's, mass, viscous, Coulomb and offset
