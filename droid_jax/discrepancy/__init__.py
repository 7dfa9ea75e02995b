"""Where simulation and measurement still disagree, and which effect explains it."""
