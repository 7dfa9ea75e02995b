"""The paper's door: scene, arm, parameter space, demonstrations and task."""
