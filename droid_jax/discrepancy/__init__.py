"""Where simulation and measurement still disagree after the fit, and which physical effect explains it.

In the order in which a search uses them: `config` (all thresholds), `statistics` and `residual_set` (one recording
against a model), `candidates` (what could be missing), `fitting` (a model with effects in it), `case` (the recordings
of a search), `maps` (where it disagrees), `selection` (which effects pass), `verdict` (the answer), `search` (from a
base fit to a verdict), `results` (files), `missing` (the whole search as one call).
"""
