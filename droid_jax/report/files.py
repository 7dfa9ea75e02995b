"""Names of files that commands write and the page or another command reads; light, for the command line."""

FITTED, REPLAY, REPLAY_FILM = "fitted.xml", "replay.npz", "replay.webp"
GAUSSIAN, EXTENDED = "gaussian.json", "extended.json"
POLICY, TRAINING, TRANSFER, FILMS = "policy.npz", "training.json", "transfer.json", "films"
STAND_IN = "stand_in.json"  # beside the stand-in's recordings: its springs, seed and hidden effects
# Folders in one of `all`, and what is written last in each: its presence says that the run is whole.
LAST_FILES = {"identify": "config.json", "gap": "gap.json", "train": TRAINING}
# What else is in them that would be taken for the next run's.
RESULTS = {
    "identify": ("fit.json", GAUSSIAN, EXTENDED),
    "gap": ("gap.npz", EXTENDED, "extended.xml"),
    "train": (POLICY, TRANSFER, EXTENDED, FILMS, "export"),
}
