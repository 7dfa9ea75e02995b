"""Where simulation and measurement still disagree after the fit, and which physical effect explains it.

In the order in which a search uses them: `config` (all thresholds), `case` and `log_case` (the recordings of a
search, with repeats or as logs), `statistics` (what a residual says), `candidates` (what could be missing), `fitting`
(a model with effects in it), `maps` (where it disagrees), `selection` (which effects pass), `verdict` (the
answer), `search` (from a base fit to a verdict), `results` (files), `missing` (the whole search as one call).
"""
