"""Simulation against measurement: the cost, its residuals and the noise that weighs them."""
