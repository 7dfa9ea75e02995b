"""Replays a fitted result in plain C MuJoCo without jax, for `neutral_result.py` and its test.

    python benchmarks/neutral_replay.py FOLDER MJCF INPUT.npz OUTPUT.npz

FOLDER holds fitted.json and apply_fit.py.  INPUT holds `command` [T, U], `timestep` s, `qpos0` [nq], `gains` [U, 2]
(factors on position and velocity gains), `fine` (steps of C in one of the command's), `time_offset` s, `laws` (0 or 1)
and `spec` (1: the values are written into an MjSpec, 0: into a compiled model).
OUTPUT gets `qpos` [T, nq], `torque` [T, nv] (the actuators'), and `foreign`, which of jax and droid_jax were loaded.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import mujoco
import numpy as np

BLOCKED = ("jax", "jaxlib", "droid_jax", "brax", "mujoco.mjx")


class Block:
    """Import hook that refuses modules which must not be needed."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name in BLOCKED or name.split(".")[0] in BLOCKED:
            raise ImportError(f"{name} is blocked here")


def main(folder: Path, mjcf: Path, given: Path, out: Path) -> None:
    sys.meta_path.insert(0, Block())  # type: ignore[arg-type]
    spec = importlib.util.spec_from_file_location("apply_fit", folder / "apply_fit.py")
    assert spec is not None and spec.loader is not None
    apply_fit = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(apply_fit)
    ask, fit = np.load(given), apply_fit.load(folder / "fitted.json")
    scene = mujoco.MjSpec.from_file(str(mjcf))
    if int(ask["spec"]):
        values = apply_fit.apply(scene, fit)
        model = scene.compile()
    else:
        model = scene.compile()
        values = apply_fit.apply(model, fit)
    model.actuator_gainprm[:, 0] *= ask["gains"][:, 0]
    model.actuator_biasprm[:, 1] *= ask["gains"][:, 0]
    model.actuator_biasprm[:, 2] *= ask["gains"][:, 1]
    command, step, fine = ask["command"], float(ask["timestep"]), int(ask["fine"])
    model.opt.timestep = step / fine
    data = mujoco.MjData(model)
    data.qpos[:] = ask["qpos0"]
    laws = apply_fit.forces(model, fit, values) if int(ask["laws"]) else None
    clock = np.arange(len(command)) * step
    qpos, torque = np.empty((len(command), model.nq)), np.empty((len(command), model.nv))
    for k in range(len(command) * fine):
        at = k * step / fine - float(ask["time_offset"])
        sent = np.array([np.interp(at, clock, column) for column in command.T])
        data.ctrl[:] = sent if laws is None else laws.control(data, sent)
        if laws is not None:
            laws(model, data)
        if k % fine == 0:
            qpos[k // fine] = data.qpos
        mujoco.mj_step(model, data)
        if k % fine == 0:
            torque[k // fine] = data.qfrc_actuator
    foreign = [name for name in BLOCKED if name in sys.modules]
    np.savez(out, qpos=qpos, torque=torque, foreign=np.array(foreign, dtype=str))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
