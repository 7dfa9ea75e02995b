"""Names of files that commands write and the page or another command reads; light, for the command line."""

STAGES = ("identify", "gap", "train")  # folders in one of `all`
FITTED, REPLAY, REPLAY_FILM = "fitted.xml", "replay.npz", "replay.webp"
POLICY, TRAINING, TRANSFER, FILMS = "policy.npz", "training.json", "transfer.json", "films"
