"""A recording replayed: by its servo, by inverse dynamics, in MJX and in C."""
