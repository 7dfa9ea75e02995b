"""The synthetic robot, in plain C MuJoCo, and the effects hidden in it."""
