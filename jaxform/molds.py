"""Molds and other tools as surfaces: revolved profiles, rods, plates, the paper's box and bottle, or a mesh."""

from jaxform.tools.molds import MoldShape, bottle_half, box_insert, divided, from_mesh, placed, plate, revolved, rod

__all__ = ["MoldShape", "bottle_half", "box_insert", "divided", "from_mesh", "placed", "plate", "revolved", "rod"]
