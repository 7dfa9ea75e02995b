"""A tool or load that the arm's controller does not know of."""

from droid_jax.model.effects import amplitudes as a
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import write
from droid_jax.model.parameters import Mode, Parameter
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect

MASS = "payload_mass"


@register
def payload(scene: Scene) -> Effect | None:
    """m more kilograms at the centre of mass of the heaviest body behind the arm's last joint.

    The gravity of the nominal mass goes on being compensated, that of the payload is not.
    """
    joints = a.arm(scene)
    if not joints:
        return None
    last = max(joints, key=lambda joint: scene.id("joint", joint))  # in the chain, whatever order the channels have
    body = _carrier(scene, last)
    mass = float(scene.model.body_mass[body])
    if mass <= 0:
        return None
    share = dict(gain=1.0 / mass, offset=1.0)
    writes = [write(scene, "body_mass", (body,), Mode.SCALE, **share)]
    if scene.model.body_gravcomp[body] != 0:
        writes.append(write(scene, "body_gravcomp", (body,), Mode.DIVIDE, **share))
    low = -0.9 * min(mass, 1.0)
    return Effect(
        "payload",
        (Parameter(MASS, "kg", 0.0, 0.2, low, 2.0, writes=tuple(writes), group=a.GROUP),),
        what="a tool or load that the arm's controller does not know of",
        mark="free motion: all joints in proportion to their lever",
        confused_with=("torque_bias", "cable_pull"),
        places={last: (MASS,)},
        smallest=0.02,
    )


def _carrier(scene: Scene, joint: str) -> int:
    """Id of the heaviest body that moves with a joint and with no other one after it."""
    model = scene.model
    last = int(model.jnt_bodyid[scene.id("joint", joint)])
    moving = [last]
    for body in range(last + 1, model.nbody):
        if int(model.body_parentid[body]) in moving and model.body_jntnum[body] == 0:
            moving.append(body)
    return max(moving, key=lambda body: float(model.body_mass[body]))
