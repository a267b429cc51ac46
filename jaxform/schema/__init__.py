"""The one description of scene and study files: keys, types, ranges.

Lengths are in m, times in s, pressures and stiffnesses in Pa, densities in kg/m^3; nothing is converted. What needs
the mesh or several numbers at once is checked where the scene is built. The docstring of a table says what each of its
keys means: the pages of the reference are made of it.
"""

from jaxform.schema.material import Material, ModifiedMooneyRivlin, MooneyRivlin, NeoHookean
from jaxform.schema.methods import Adam, FixedPoint, Lbfgs, LeastSquares, Method
from jaxform.schema.mold import BottleHalfMold, BoxInsertMold, FileMold, Mold, RevolvedMold
from jaxform.schema.objectives import (
    FormingTime,
    KineticEnergy,
    LeastMass,
    Objective,
    Objectives,
    Target,
    Uniform,
    Wanted,
)
from jaxform.schema.parison import BottleHalfParison, Disc, FileParison, Parison, Rectangle, Sphere
from jaxform.schema.quantities import (
    ElementSize,
    FieldReference,
    Profile,
    SceneReference,
    TargetProfile,
    TargetThickness,
    Thickness,
)
from jaxform.schema.scene import Output, Pressure, Refinement, SceneFile, Solver
from jaxform.schema.study import StudyFile
from jaxform.schema.variables import PressureKnots, Scale, ThicknessField, ThicknessProfile, Variable

__all__ = [
    "Adam",
    "BottleHalfMold",
    "BottleHalfParison",
    "BoxInsertMold",
    "Disc",
    "ElementSize",
    "FieldReference",
    "FileMold",
    "FileParison",
    "FixedPoint",
    "FormingTime",
    "KineticEnergy",
    "Lbfgs",
    "LeastMass",
    "LeastSquares",
    "Material",
    "Method",
    "ModifiedMooneyRivlin",
    "Mold",
    "MooneyRivlin",
    "NeoHookean",
    "Objective",
    "Objectives",
    "Output",
    "Parison",
    "Pressure",
    "PressureKnots",
    "Profile",
    "Rectangle",
    "Refinement",
    "RevolvedMold",
    "Scale",
    "SceneFile",
    "SceneReference",
    "Solver",
    "Sphere",
    "StudyFile",
    "Target",
    "TargetProfile",
    "TargetThickness",
    "Thickness",
    "ThicknessField",
    "ThicknessProfile",
    "Uniform",
    "Variable",
    "Wanted",
]
