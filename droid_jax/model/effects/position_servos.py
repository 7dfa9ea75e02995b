"""The law of the arm's position servos, as effects use it."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.effect_interface import State
from droid_jax.model.effects import coefficients as a
from droid_jax.model.scene import Scene


@dataclass(frozen=True, eq=False)
class PositionServos:
    """The arm's joints with a position servo.

    Attributes:
        joints: J names.
        actuators: [J] ids.
        positions, dofs: [J] position and velocity addresses.
        gear: [J] transmission ratio.
        stiffness: [J] N m/rad at the joint, of the MJCF.
    """

    joints: tuple[str, ...]
    actuators: np.ndarray
    positions: np.ndarray
    dofs: np.ndarray
    gear: np.ndarray
    stiffness: np.ndarray

    @property
    def compliances(self) -> dict[str, tuple[float, float]]:
        """Joint -> prior deviation and upper bound of its gear's compliance, rad/(N m).

        They are relative to the servo's own, since the data constrain both together.
        """
        each = zip(self.joints, self.stiffness.tolist(), strict=True)
        return {joint: (min(max(1e-4, 0.05 / k), 0.1 / k), min(max(1e-3, 0.3 / k), 1.0 / k)) for joint, k in each}

    def where(self, chosen: np.ndarray) -> PositionServos | None:
        """Those of `chosen`, [J] bool; None if it chooses none."""
        if not chosen.any():
            return None
        joints = tuple(j for j, take in zip(self.joints, chosen, strict=True) if take)
        arrays = (self.actuators, self.positions, self.dofs, self.gear, self.stiffness)
        return PositionServos(joints, *(values[chosen] for values in arrays))

    def rigid_torque(self, state: State, ctrl: jax.Array) -> jax.Array:
        """[J] N m, servo torque with motors at the positions of their links."""
        gain, bias = self.law(state)
        length, speed = self.gear * state.qpos[self.positions], self.gear * state.qvel[self.dofs]
        feedback = bias[:, 0] + bias[:, 1] * length + bias[:, 2] * speed
        model, given = state.model, ctrl[self.actuators]
        limited = np.asarray(model.actuator_ctrllimited, bool)[self.actuators]
        if limited.any() and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
            low, high = model.actuator_ctrlrange[self.actuators].T
            given = jnp.where(limited, jnp.clip(given, low, high), given)
        return jnp.asarray(self.gear) * (gain * given + feedback)

    def stiffness_in(self, state: State) -> jax.Array:
        """[J] N m/rad at the joint, of the sample's model."""
        return -self.law(state)[1][:, 1] * self.gear**2

    def damping_in(self, state: State) -> jax.Array:
        """[J] N m s/rad at the joint, the velocity gains of the sample's model."""
        return -self.law(state)[1][:, 2] * self.gear**2

    def limits_in(self, state: State) -> tuple[jax.Array, jax.Array]:
        """[J] lowest and highest torque, N m, of the sample's model; infinite where it states none."""
        model, dofs, lowest, highest = state.model, self.dofs, jnp.float32(-jnp.inf), jnp.float32(jnp.inf)
        joints = np.asarray(model.dof_jntid)[dofs]
        ranges = self.gear[:, None] * model.actuator_forcerange[self.actuators]
        limited = np.asarray(model.actuator_forcelimited, bool)[self.actuators]
        low, high = jnp.where(limited, ranges.min(axis=1), lowest), jnp.where(limited, ranges.max(axis=1), highest)
        ranges, limited = model.jnt_actfrcrange[joints], np.asarray(model.jnt_actfrclimited, bool)[joints]
        low = jnp.maximum(low, jnp.where(limited, ranges[:, 0], lowest))
        return low, jnp.minimum(high, jnp.where(limited, ranges[:, 1], highest))

    def held_torque(self, state: State, ctrl: jax.Array) -> jax.Array:
        """[J] N m, `rigid_torque` within the servos' limits."""
        return jnp.clip(self.rigid_torque(state, ctrl), *self.limits_in(state))

    def with_torque(self, state: State, ctrl: jax.Array, torque: jax.Array) -> jax.Array:
        """[U] the command with which the servos give torque [J] N m more; unchanged where the gain is zero."""
        gain, _ = self.law(state)
        scale = self.gear * gain
        return ctrl.at[self.actuators].add(jnp.where(scale != 0.0, torque / jnp.where(scale != 0.0, scale, 1.0), 0.0))

    def with_lead(self, state: State, ctrl: jax.Array, lead: jax.Array) -> jax.Array:
        """[U] the command with the same effect as motors that are ahead of their links by lead [J] rad."""
        return self.with_torque(state, ctrl, -self.stiffness_in(state) * lead)

    def law(self, state: State) -> tuple[jax.Array, jax.Array]:
        """Gain [J] and bias [J, 3] of the actuators."""
        gain, bias = state.model.actuator_gainprm, state.model.actuator_biasprm
        return gain[self.actuators, 0], bias[self.actuators, :3]


def arm_servos(scene: Scene) -> PositionServos | None:
    """The arm's joints with a position servo; None if there are none, since other motors do not use their position."""
    model = scene.model
    fixed = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED
    affine = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    gear = model.actuator_gear[:, 0]
    stiffness = np.where(fixed & affine & (model.actuator_gainprm[:, 0] != 0), -model.actuator_biasprm[:, 1], 0.0)
    stiffness = stiffness * gear**2
    row = {j: scene.command_names.index(j) for j in a.arm(scene) if j in scene.command_names}
    joints = tuple(j for j, u in row.items() if stiffness[u] > 0)
    if not joints:
        return None
    actuators = np.array([row[j] for j in joints], dtype=int)
    return PositionServos(
        joints=joints,
        actuators=actuators,
        positions=np.array([scene.qpos(j) for j in joints], dtype=int),
        dofs=np.array([scene.dof(j) for j in joints], dtype=int),
        gear=gear[actuators],
        stiffness=stiffness[actuators],
    )
