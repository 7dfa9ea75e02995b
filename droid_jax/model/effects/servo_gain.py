"""Servo gains that differ from the stated ones."""

from dataclasses import replace

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import servo_scale
from droid_jax.model.parameters import Parameter
from droid_jax.model.scene import Scene

GAIN = "servo_gain"


@register
def servo_gain(scene: Scene) -> Effect | None:
    """A joint's position gain times 1 + g."""
    joints = tuple(j for j in a.arm(scene) if j in scene.command_names)
    if not joints:
        return None

    def parameter(joint: str) -> Parameter:
        writes = tuple(replace(w, offset=1.0) for w in servo_scale(scene, joint).writes)
        return Parameter(f"{GAIN}[{joint}]", "-", 0.0, 0.1, -0.5, 0.5, writes=writes, group=a.GROUP)

    return Effect(
        GAIN,
        tuple(parameter(j) for j in joints),
        description="a servo whose position gain is not the stated one",
        signature="tracking error of one joint",
        confused_with=("joint_compliance", "command_delay", "torque_gain"),
        locations=a.locations(joints, GAIN),
        minimum_size=0.02,
    )
