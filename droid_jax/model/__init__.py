"""What is simulated: scene, parameters, physics, effects and the simulation step."""
