"""The arm alone: the built-in Panda without its hand, for logs of a bare robot."""

from __future__ import annotations

import mujoco

from droid_jax.door.builtin import ARM, FINGERS, mjcf_dir
from droid_jax.model.scene import Scene, compile_scene

HAND = "hand"


def panda_arm_scene() -> Scene:
    """The seven-joint Panda of `mjcf/panda.xml` with nothing mounted on its flange.

    Joint ranges are not enforced: a replay of a measured motion keeps inside them.
    """
    spec = mujoco.MjSpec.from_file(str(mjcf_dir() / "panda.xml"))
    for finger in FINGERS:  # its actuator would drive a joint that is gone
        spec.delete(spec.actuator(finger))
    spec.delete(spec.body(HAND))
    spec.modelname = "panda_arm"
    return compile_scene(spec, "Panda arm", joints=ARM, unlimited=ARM)
