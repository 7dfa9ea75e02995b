"""Where simulation and measurement still disagree after the fit, and which physical effect explains it.

Modules, each imports only from those before it:

* `config`: all thresholds.
* `statistics`: the discrepancy U and its tests.
* `case`: the recordings of a search, the base parameters and the effects.
* `candidates`: the score test and the effects that it proposes.
* `fitting`: base parameters and effects fitted together.
* `step_error`: the error of the simulation's time step.
* `posterior`: the uncertainty of a fit.
* `log_noise`, `log_case`: logs in blocks of time, and their noise.
* `maps`: where simulation and measurement disagree.
* `selection`: validation tests and the choice of a model.
* `verdict`: the answer.
* `candidate_fits`, `cross_validation`, `search`: the steps from a base fit to a verdict.
* `results`: the files of a search.
* `missing`: the whole search as one call.
"""
