"""Replays of the door to be timed: this program's, the C engine's, and mjx.step alone.

Each maker returns a function without arguments that computes one whole population and returns when
its work is done.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from droid_jax import runtime
from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_space
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model, make_physics
from droid_jax.model.scene import Scene
from droid_jax.recordings.formats import load_recording
from droid_jax.simulate.batching import over_block, over_population
from droid_jax.simulate.c_engine import instrument, simulate
from droid_jax.simulate.c_reference import control_of
from droid_jax.simulate.compiled import LONG, batch_replay
from droid_jax.simulate.replay import Drive, make_drive, servo_replay

C_CHUNK = 64  # samples of which the C engine holds traces at once
Run = Callable[[], Any]


@dataclass(frozen=True, eq=False)
class Case:
    """A replay to time: scene, parameter space, command [T, U] on the clock, and the seed of the samples."""

    scene: Scene
    space: Space
    drive: Drive
    seed: int

    @property
    def steps(self) -> int:
        """T, steps of each sample."""
        return len(self.drive.command)

    def values(self, population: int) -> np.ndarray:
        """[P, D] samples of the initial Gaussian, in physical units; a larger population starts with the same."""
        rng = np.random.default_rng(self.seed)
        return self.space.from_search(rng.standard_normal((population, len(self.space))))


def make_case(seed: int, steps: int | None = None) -> Case:
    """Demonstration A in the door scene, whole or its first `steps` steps."""
    scene = door_scene()
    drive = make_drive(scene, load_recording(demonstration_path("A")))
    if steps is not None:
        drive = replace(drive, command=drive.command[:steps])
    return Case(scene, door_space(scene), drive, seed)


def padded(values: np.ndarray, multiple: int) -> np.ndarray:
    """[P, D] -> [Q, D] with Q the next multiple of `multiple`; the last row is repeated."""
    missing = -len(values) % multiple
    return np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])


def in_blocks(case: Case) -> Callable[[np.ndarray], Any]:
    """The replay as a search runs it: [P, D] -> Rollout on the host, in the program's own blocks."""
    replay = servo_replay(case.scene, case.drive)
    long = case.steps >= LONG
    return over_population(lambda values: replay(make_physics(case.scene, case.space, values)), long)


def as_one_block(case: Case, population: int) -> Run:
    """The replay compiled for the whole population at once; the results stay on the device."""
    batch = batch_replay(case.scene, case.space, servo_replay(case.scene, case.drive))
    values = padded(case.values(population), runtime.devices_mesh().size)
    return lambda: jax.block_until_ready(batch(values))


def c_engine(case: Case, population: int) -> Callable[[], np.ndarray]:
    """The same through plain C on all cores; returns torque [P, T, J] N m.

    The models are built beforehand, so that only physics is timed.
    """
    plain = replace(case.scene, model=instrument(case.scene))
    models = [make_c_model(plain, case.space, row) for row in case.values(population)]
    control = control_of(case.drive)

    def run() -> np.ndarray:
        chunks = [models[i : i + C_CHUNK] for i in range(0, population, C_CHUNK)]
        start = case.drive.qpos0[None]
        return np.concatenate([simulate(plain, c, start, control[None]).torque for c in chunks])

    return run


def _mjx_step(case: Case) -> Callable[[jax.Array], jax.Array]:
    """values [D] -> torque [T, nv] N m by mjx.step itself, all of mjx.Data carried from step to step."""
    start = mjx.make_data(case.scene.mjx).replace(qpos=jnp.asarray(case.drive.qpos0, jnp.float32))
    command = jnp.asarray(case.drive.command, jnp.float32)

    def replay(values: jax.Array) -> jax.Array:
        model = make_physics(case.scene, case.space, values).model

        def step(data: Any, ctrl: jax.Array) -> tuple[Any, jax.Array]:
            data = mjx.step(model, data.replace(ctrl=ctrl))
            return data, data.qfrc_actuator

        return jax.lax.scan(step, start, command)[1]

    return replay


def mjx_on_one_device(case: Case, population: int, options: dict[str, Any] | None = None) -> Run:
    """mjx.step with vmap and jit, with or without compiler options, on one device."""
    batch = jax.jit(jax.vmap(_mjx_step(case)), compiler_options=options)
    values = np.float32(case.values(population))
    return lambda: jax.block_until_ready(batch(values))


def mjx_on_all_devices(case: Case, population: int) -> Run:
    """mjx.step with this program's compiler option, its rows split over all devices."""
    batch = over_block(_mjx_step(case))
    values = padded(case.values(population), runtime.devices_mesh().size)
    return lambda: jax.block_until_ready(batch(values))
