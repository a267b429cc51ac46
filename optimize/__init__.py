"""Inverse design on top of jaxform: the sheet and the pressure for the required wall of a part."""

from optimize import fitting
from optimize.designs import COLUMNS, Study
from optimize.feasibility import doubts
from optimize.heaters import HeaterZones
from optimize.journal import Journal
from optimize.objectives import FormingTime, KineticEnergy, LeastMass, Objective, Target, Uniform, Weighted
from optimize.pressures import PressureKnots
from optimize.search import Search
from optimize.sheets import ThicknessField, ThicknessProfile
from optimize.solvers import Design, check
from optimize.starts import solve, write_starts
from optimize.study import build_study, load_study, write_history
from optimize.variables import Scale

__all__ = [
    "COLUMNS",
    "Design",
    "FormingTime",
    "HeaterZones",
    "Journal",
    "KineticEnergy",
    "LeastMass",
    "Objective",
    "PressureKnots",
    "Scale",
    "Search",
    "Study",
    "Target",
    "ThicknessField",
    "ThicknessProfile",
    "Uniform",
    "Weighted",
    "build_study",
    "check",
    "doubts",
    "fitting",
    "load_study",
    "solve",
    "write_history",
    "write_starts",
]
