"""Checks of a recording before a replay: units, signs, order, clocks, limits."""
