"""Names of files in a run's folder that one layer writes and another reads; imports nothing."""

SETUP, CONFIG, FIT = "setup.json", "config.json", "fit.json"
GAUSSIAN, SAMPLES = "gaussian.json", "samples.csv"
FULL_GAUSSIAN = "gaussian_full.json"  # with the nuisances
TRACES, CORRELATION, DISTRIBUTION = "traces.npz", "correlation.npz", "distribution.npz"
HISTORY, HISTORY_TABLE = "history.npz", "history.csv"
FITTED, REPLAY, REPLAY_FILM = "fitted.xml", "replay.npz", "replay.webp"
# A fit for programs that have MuJoCo but not droid_jax.
NEUTRAL = FITTED_JSON, APPLY_FIT, MJLAB_TERMS = "fitted.json", "apply_fit.py", "mjlab_terms.py"
VIEWER = "viewer.html"  # measured and simulated motion in a browser
ASKED = "all.json"  # the options of a run of all stages, beside their folders
GAP, GAP_TRACES = "gap.json", "gap.npz"
FIT_VERSION, GAP_VERSION = 3, 2  # of fit.json and gap.json
LOST = "the fitted model on the test recording"  # in "failed" of gap.json, where that replay failed: no U of it then
# States in "amendments" of gap.json: the run was stopped before; "not made: " and the reason.
TO_BE_MADE, NOT_MADE = "to be made", "not made"
EXTENDED, EXTENDED_MJCF = "extended.json", "extended.xml"
POLICY, TRAINING, TRANSFER, FILMS = "policy.npz", "training.json", "transfer.json", "films"
EVALUATION, EVALUATION_TRACES = "evaluation.json", "evaluation.npz"  # of a fit on other recordings
EVALUATION_FORMAT, EVALUATION_VERSION = "droid_jax evaluation", 1
REHEARSAL, REHEARSAL_PAGE = "rehearsal.json", "rehearsal.html"
SYNTHETIC_ROBOT = (
    "synthetic_robot.json"  # beside the synthetic robot's recordings: its springs, seed and hidden effects
)
SYNTHETIC_SOURCE = "synthetic robot (plain C MuJoCo), not a real one"  # in the metadata of what it recorded
# Folders inside that of `all`, and the file that is written last in each: where it exists, the run is complete.
LAST_FILES = {"identify": CONFIG, "gap": GAP, "train": TRAINING}
# Other results in them, which could be mistaken for those of the next run.
RESULTS = {
    "identify": (FIT, GAUSSIAN, FULL_GAUSSIAN, EXTENDED),
    "gap": (GAP_TRACES, EXTENDED, EXTENDED_MJCF, "extended.patch", "extended_parts", *NEUTRAL),
    "train": (POLICY, TRANSFER, EXTENDED, FILMS, "export"),
}
# Exists while a run writes to the folder.
LOCK = ".droid_jax.lock"
# All files that a stage writes in its folder, or removes there before it begins.
WRITTEN: dict[str, tuple[str, ...]] = {
    stage: (SETUP, last, *RESULTS[stage], "report.html", "figures", "checkpoints", "tensorboard")
    for stage, last in LAST_FILES.items()
}
WRITTEN["identify"] += (SAMPLES, TRACES, CORRELATION, DISTRIBUTION, HISTORY, HISTORY_TABLE)
WRITTEN["identify"] += (FITTED, "fitted.patch", "fitted_parts", *NEUTRAL, REPLAY, FILMS, "frames", VIEWER)
WRITTEN["train"] += (GAUSSIAN,)
WRITTEN["all"] = (ASKED, "report.html")
