"""Molds as surfaces: revolved profiles, the paper's box and bottle, or a surface of one's own."""

from jaxform.tools.molds import MoldShape, bottle_half, box_insert, divided, from_mesh, revolved

__all__ = ["MoldShape", "bottle_half", "box_insert", "divided", "from_mesh", "revolved"]
