"""The library of effects that a model may lack: one file each, one registry.

    from droid_jax.model.effects.registry import library
    effects = library(scene)  # all effects that the scene can have, each at neutral

A user effect is a function Scene -> Effect (or None if the scene cannot have it) with the decorator
`registry.register`; see docs/your-effect.md.
"""
