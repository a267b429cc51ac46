"""Diagrams of parts, sheets and searches in matplotlib axes: each function takes `ax` and returns it."""

from jaxform.io.axes_plots import convergence, part, pressure, sheet, wall

__all__ = ["convergence", "part", "pressure", "sheet", "wall"]
