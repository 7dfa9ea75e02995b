"""Pages, figures and films of results."""

from droid_jax.quiet import quiet_matplotlib

quiet_matplotlib()  # before a module of this folder imports it
