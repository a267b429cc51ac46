"""The simulation model: the scene, its fields, and the replacement of its numbers."""
