"""Names of the files that a policy's commands write and the page reads; light, for the command line."""

POLICY, TRAINING, TRANSFER, FILMS = "policy.npz", "training.json", "transfer.json", "films"
