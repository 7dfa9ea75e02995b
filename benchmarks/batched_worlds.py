"""Draws of fitted results in engines that step many worlds, against plain C MuJoCo world by world.

    python benchmarks/batched_worlds.py --fit so101 runs/so101/identify --warp WARP/bin/python --mjlab MJLAB/bin/python

For each fit (a folder with fitted.json, apply_fit.py, mjlab_terms.py and fitted.xml) a process of each given Python
puts draws into the worlds: in mujoco_warp with the arrays of `apply_fit.batch`, in mjlab with its event term.  It then
steps all worlds with the same commands, and each draw in plain C MuJoCo.  mujoco_warp and mjlab work in single
precision.  Their difference from C at the fitted values, without any draw, is the scale for the draws' differences.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

AMPLITUDE, PERIOD = 0.15, 1.0  # of the commands around the start: rad or m, s
SEED = 0
Step = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # controls [nu] -> positions [W, nq], forces [W, nv]


def commands(model: mujoco.MjModel, seconds: float) -> np.ndarray:
    """[T, nu] a sine on every actuator, around the control that holds the start, within the control range."""
    time = np.arange(int(seconds / model.opt.timestep)) * model.opt.timestep
    centre = np.zeros(model.nu)
    for u in range(model.nu):
        if model.actuator_trntype[u] == mujoco.mjtTrn.mjTRN_JOINT:
            joint = model.actuator_trnid[u, 0]
            centre[u] = model.actuator_gear[u, 0] * model.qpos0[model.jnt_qposadr[joint]]
    out = centre + AMPLITUDE * np.sin(2 * np.pi * time[:, None] / PERIOD + np.arange(model.nu))
    limited = model.actuator_ctrllimited.astype(bool)
    out[:, limited] = np.clip(out[:, limited], *model.actuator_ctrlrange[limited].T)
    return out


def in_c(models: list[mujoco.MjModel], start: np.ndarray, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, W, nq] and actuators' forces [T, W, nv] after each step."""
    datas = [mujoco.MjData(model) for model in models]
    for data in datas:
        data.qpos[:] = start  # a fitted qpos0 differs between the worlds
    qpos, force = [], []
    for ctrl in command:
        for model, data in zip(models, datas, strict=True):
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
        qpos.append([data.qpos.copy() for data in datas])
        force.append([data.qfrc_actuator.copy() for data in datas])
    return np.array(qpos), np.array(force)


def compared(step: Step, models: list[mujoco.MjModel], start: np.ndarray, command: np.ndarray) -> dict[str, float]:
    """Largest difference of worlds and C models, and the largest between two worlds in C."""
    qpos, force = in_c(models, start, command)
    own = [step(ctrl) for ctrl in command]
    out = {"worlds": len(models), "steps": len(command)}
    for name, there, here in (("position", qpos, [o[0] for o in own]), ("force", force, [o[1] for o in own])):
        out[name] = float(np.abs(np.array(here) - there).max())
        out[f"{name}_between_worlds"] = float(np.ptp(there, axis=1).max())
    return out


def drawn(apply_fit: Any, model: mujoco.MjModel, fit: dict[str, Any], worlds: int) -> list[mujoco.MjModel]:
    """The model with draw k for each world k: `apply` writes it, not `batch`."""
    import copy

    models = [copy.copy(model) for _ in range(worlds)]
    for k, each in enumerate(models):
        apply_fit.apply(each, fit, sample=k, seed=SEED)
    return models


def warp_case(folder: Path, mjcf: Path, worlds: int, seconds: float) -> dict[str, Any]:
    """mujoco_warp on the CPU."""
    import mujoco_warp as mjw
    import warp as wp

    apply_fit = importlib.import_module("apply_fit")
    model, fit = mujoco.MjModel.from_xml_path(str(mjcf)), apply_fit.load(folder / "fitted.json")
    command, start = commands(model, seconds), model.qpos0.copy()

    def stepper(fields: dict[str, np.ndarray]) -> Step:
        there = mjw.put_model(model, batch_sizes={name: worlds for name in fields})
        for name, rows in fields.items():
            getattr(there, name).assign(rows)
        data = mjw.make_data(model, nworld=worlds)
        data.qpos.assign(np.tile(start, (worlds, 1)))

        def step(ctrl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            data.ctrl.assign(np.tile(ctrl, (worlds, 1)))
            mjw.step(there, data)
            return data.qpos.numpy().copy(), data.qfrc_actuator.numpy().copy()  # else views of the next step

        return step

    with wp.ScopedDevice("cpu"):
        fields = apply_fit.batch(model, fit, worlds, SEED)
        fields = {name: rows for name, rows in fields.items() if hasattr(mjw.put_model(model), name)}
        draws = compared(stepper(fields), drawn(apply_fit, model, fit, worlds), start, command)
        apply_fit.apply(model, fit)
        alone = compared(stepper({}), [model] * worlds, start, command)
    return {"fields": sorted(fields), "draws": draws, "fitted_values": alone, **versions("mujoco-warp", "warp-lang")}


def mjlab_case(folder: Path, mjcf: Path, worlds: int, seconds: float) -> dict[str, Any]:
    """mjlab's environment on the CPU, with the event term."""
    import mjlab_terms  # pyright: ignore[reportMissingImports]
    from mjlab.actuator import XmlActuatorCfg
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
    from mjlab.scene import SceneCfg
    from mjlab.sim import MujocoCfg, SimulationCfg

    apply_fit = importlib.import_module("apply_fit")
    fit, prefix = apply_fit.load(folder / "fitted.json"), "robot/"
    fit["table"] = [{**row, "name": prefix + row["name"]} for row in fit["table"]]  # for `apply`, by which C gets them
    option = mujoco.MjModel.from_xml_path(str(mjcf)).opt
    names = ("timestep", "iterations", "ls_iterations", "tolerance")
    settings = {name: getattr(option, name) for name in names}

    def environment(**events: Any) -> Any:
        robot = EntityCfg(
            spec_fn=lambda: mujoco.MjSpec.from_file(str(mjcf)),
            articulation=EntityArticulationInfoCfg(actuators=(XmlActuatorCfg(target_names_expr=(".*",)),)),
        )
        cfg = ManagerBasedRlEnvCfg(
            decimation=1, scene=SceneCfg(num_envs=worlds, entities={"robot": robot}), events=events,
            sim=SimulationCfg(mujoco=MujocoCfg(**settings)),
        )  # fmt: skip
        return ManagerBasedRlEnv(cfg, device="cpu")

    def stepper(env: Any) -> Step:
        import torch

        def step(ctrl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            env.sim.data.ctrl[:] = torch.as_tensor(ctrl, dtype=torch.float32)
            env.sim.step()
            return env.sim.data.qpos.numpy().copy(), env.sim.data.qfrc_actuator.numpy().copy()

        return step

    env = environment(fit=mjlab_terms.fitted("robot", draws=worlds, seed=SEED))
    model = env.sim.mj_model
    command, start = commands(model, seconds), env.sim.data.qpos.numpy()[0].copy()
    models = drawn(apply_fit, model, fit, worlds)
    draws = compared(stepper(env), models, start, command)
    fields = list(env.event_manager.domain_randomization_fields)
    written = 0.0  # largest difference of a field of the worlds' models, as a share of the field's largest number
    for name in fields:
        expected = np.array([getattr(each, name) for each in models])
        error = np.abs(getattr(env.sim.model, name).numpy() - expected).max()
        written = max(written, float(error / np.abs(expected).max()))
    alone = compared(stepper(environment()), [model] * worlds, start, command)
    found = {"fields": fields, "fields_relative_error": written, "draws": draws, "fitted_values": alone}
    return {**found, **versions("mjlab", "mujoco-warp", "torch")}


def versions(*packages: str) -> dict[str, Any]:
    return {"versions": {name: version(name) for name in ("mujoco", "numpy", *packages)}}


CASES = {"warp": warp_case, "mjlab": mjlab_case}


@dataclass(frozen=True)
class BatchedWorlds:
    """Compare draws in engines of many worlds with plain C MuJoCo."""

    fit: dict[str, Path] = field(default_factory=dict)
    """Folders with fitted.json by name of the case."""
    warp: Path | None = None
    """Python that has mujoco_warp."""
    mjlab: Path | None = None
    """Python that has mjlab."""
    worlds: int = 8
    """Worlds, each with another draw."""
    seconds: float = 1.0
    """Simulated time."""
    out: Path = Path(__file__).resolve().parent / "results"
    """Folder for batched_worlds.json."""
    quick: bool = False
    """Write batched_worlds_quick.json."""


def main(config: BatchedWorlds) -> None:
    import common

    pythons = {"warp": config.warp, "mjlab": config.mjlab}
    path = config.out / f"{common.stem('batched_worlds', config.quick)}.json"
    cases: dict[str, Any] = json.loads(path.read_text())["cases"] if path.is_file() else {}
    for name, folder in config.fit.items():
        for engine, python in pythons.items():
            if python is None:
                continue
            with tempfile.NamedTemporaryFile(suffix=".json") as answer:
                asked = (engine, folder.resolve(), config.worlds, config.seconds, answer.name)
                subprocess.run([python, __file__, "child", *map(str, asked)], check=True)
                found = json.loads(Path(answer.name).read_text())
            cases[f"{name}, {engine}"] = {"origin": common.origin(SEED), **found}
            print(name, engine, found, flush=True)
    result = {"benchmark": "batched_worlds", "commits": common.commits(cases.values()), "cases": cases}
    common.publish(config.out, "batched_worlds", config.quick, SEED, result)


def child(engine: str, folder: Path, worlds: int, seconds: float, out: Path) -> None:
    """The work of a Python without this package."""
    sys.path[:] = [str(folder), *(p for p in sys.path if Path(p).resolve() != Path(__file__).resolve().parent)]
    mjcf = folder / json.loads((folder / "fitted.json").read_text())["mjcf"]["file"]
    out.write_text(json.dumps(CASES[engine](folder, mjcf, worlds, seconds)))


if __name__ == "__main__":
    if sys.argv[1:2] == ["child"]:
        child(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5]), Path(sys.argv[6]))
    else:
        import tyro

        main(tyro.cli(BatchedWorlds, description=__doc__))
