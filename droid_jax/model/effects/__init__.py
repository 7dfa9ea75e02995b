"""The library of effects that a model may lack: one file each, one registry.

    from droid_jax.model.effects.registry import library
    effects = library(scene)  # all that the scene can have, each at neutral

An effect of your own is a function Scene -> Effect (or None where the scene cannot have it) with
the decorator `registry.register`; see docs/your-effect.md.
"""
