"""Inverse design on top of jaxform: which sheet and which pressure make the wall that the part needs?"""

from optimize.objectives import Target
from optimize.solvers import COLUMNS, Design, Study, solve
from optimize.study import load_study, write_history
from optimize.variables import PressureKnots, ThicknessProfile

__all__ = [
    "COLUMNS",
    "Design",
    "PressureKnots",
    "Study",
    "Target",
    "ThicknessProfile",
    "load_study",
    "solve",
    "write_history",
]
