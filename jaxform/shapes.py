"""Sheets as meshes: disc, rectangle, sphere, tube, preform, half a bottle's parison, or a surface of one's own."""

from jaxform.mesh.shapes import (
    Sheet,
    Symmetry,
    bottle_half,
    clamp_borders,
    disc,
    from_mesh,
    outline,
    preform,
    rectangle,
    sphere,
    tube,
)

__all__ = [
    "Sheet",
    "Symmetry",
    "bottle_half",
    "clamp_borders",
    "disc",
    "from_mesh",
    "outline",
    "preform",
    "rectangle",
    "sphere",
    "tube",
]
