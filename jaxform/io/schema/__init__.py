"""The one description of scene and study files: keys, types, ranges.

Lengths are in m, times in s, pressures and stiffnesses in Pa, densities in kg/m^3; nothing is converted. What needs
the mesh or several numbers at once is checked where the scene is built. The docstring of a table says what each of its
keys means: the pages of the reference are made of it.
"""

from jaxform.io.schema.material import (
    Gent,
    Material,
    ModifiedMooneyRivlin,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Viscous,
    Yeoh,
)
from jaxform.io.schema.methods import Adam, FixedPoint, Lbfgs, LeastSquares, Method
from jaxform.io.schema.mold import BottleHalfMold, BoxInsertMold, FileMold, Mold, RevolvedMold
from jaxform.io.schema.objectives import (
    FormingTime,
    KineticEnergy,
    LeastMass,
    Objective,
    Objectives,
    Target,
    Uniform,
    Wanted,
)
from jaxform.io.schema.parison import BottleHalfParison, Disc, FileParison, Outline, Parison, Rectangle, Sphere
from jaxform.io.schema.part import Part, Trim
from jaxform.io.schema.quantities import (
    ElementSize,
    FieldReference,
    NumberProfile,
    Profile,
    SceneReference,
    TargetProfile,
    TargetThickness,
    Thickness,
)
from jaxform.io.schema.scene import Output, Pressure, Refinement, SceneFile, Solver
from jaxform.io.schema.study import StudyFile
from jaxform.io.schema.variables import HeaterZones, PressureKnots, Scale, ThicknessField, ThicknessProfile, Variable

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
    "Gent",
    "HeaterZones",
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
    "NumberProfile",
    "Objective",
    "Objectives",
    "Ogden",
    "Outline",
    "Output",
    "Parison",
    "Part",
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
    "Trim",
    "Uniform",
    "Variable",
    "Viscous",
    "Wanted",
    "Yeoh",
]
