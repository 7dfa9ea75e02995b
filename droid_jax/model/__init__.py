"""What is simulated: scene, parameters, physics, effects and the simulation step."""

from droid_jax.installation import check_mujoco

check_mujoco()  # before the first import of mujoco
