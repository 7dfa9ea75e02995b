"""What the experiments with policies share: the doors, and how their trials are summed up."""
