"""From the cost to a distribution: search, refinement, calibrated Gaussian, identifiability."""
