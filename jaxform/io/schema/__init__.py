"""The one description of scene and study files: keys, types, ranges.

Lengths are in m, times in s, pressures and stiffnesses in Pa, densities in kg/m^3; nothing is converted. What needs
the mesh or several numbers at once is checked where the scene is built. The docstring of a table says what each of its
keys means: the pages of the reference are made of it.
"""

from jaxform.io.schema.material import (
    GentTable,
    Material,
    ModifiedMooneyRivlinTable,
    MooneyRivlinTable,
    NeoHookeanTable,
    OgdenTable,
    Viscous,
    YeohTable,
)
from jaxform.io.schema.methods import Adam, FixedPoint, Lbfgs, LeastSquares, Method
from jaxform.io.schema.mold import BottleHalfMold, BoxInsertMold, FileMold, Mold, RevolvedMold
from jaxform.io.schema.objectives import (
    FormingTimeTable,
    KineticEnergyTable,
    LeastMassTable,
    Objective,
    Objectives,
    ObjectiveTable,
    TargetTable,
    UniformTable,
)
from jaxform.io.schema.parison import BottleHalfParison, Disc, FileParison, Outline, Parison, RectangleTable, Sphere
from jaxform.io.schema.part import PartTable, TrimTable
from jaxform.io.schema.quantities import (
    ElementSize,
    FieldReference,
    NumberProfile,
    ProfileTable,
    SceneReference,
    TargetProfile,
    TargetThickness,
    Thickness,
)
from jaxform.io.schema.scene import Output, PressureTable, RefinementTable, SceneFile, SolverTable
from jaxform.io.schema.study import StudyFile
from jaxform.io.schema.variables import (
    HeaterZonesTable,
    PressureKnotsTable,
    ScaleTable,
    ThicknessFieldTable,
    ThicknessProfileTable,
    Variable,
)

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
    "FormingTimeTable",
    "GentTable",
    "HeaterZonesTable",
    "KineticEnergyTable",
    "Lbfgs",
    "LeastMassTable",
    "LeastSquares",
    "Material",
    "Method",
    "ModifiedMooneyRivlinTable",
    "Mold",
    "MooneyRivlinTable",
    "NeoHookeanTable",
    "NumberProfile",
    "Objective",
    "ObjectiveTable",
    "Objectives",
    "OgdenTable",
    "Outline",
    "Output",
    "Parison",
    "PartTable",
    "PressureKnotsTable",
    "PressureTable",
    "ProfileTable",
    "RectangleTable",
    "RefinementTable",
    "RevolvedMold",
    "ScaleTable",
    "SceneFile",
    "SceneReference",
    "SolverTable",
    "Sphere",
    "StudyFile",
    "TargetProfile",
    "TargetTable",
    "TargetThickness",
    "Thickness",
    "ThicknessFieldTable",
    "ThicknessProfileTable",
    "TrimTable",
    "UniformTable",
    "Variable",
    "Viscous",
    "YeohTable",
]
