from . import molds, scenes, shapes
from .building import build_scene
from .compiling import compiler_options
from .errors import InputError, InputWarning
from .files import load
from .materials import Law, ModifiedMooneyRivlin, MooneyRivlin, NeoHookean, law, parameter
from .mold import Mold, make_mold
from .padding import padded
from .refinement import fitted
from .replacing import replace
from .result import Result, explain, summarize
from .scene import (
    Parison,
    Pressure,
    Refinement,
    Scene,
    Solver,
    make_parison,
    make_pressure,
    make_refinement,
    make_solver,
)
from .simulation import Moment, run, simulate, simulate_batch
from .state import Schedule

__all__ = [
    "InputError",
    "InputWarning",
    "Law",
    "ModifiedMooneyRivlin",
    "Mold",
    "Moment",
    "MooneyRivlin",
    "NeoHookean",
    "Parison",
    "Pressure",
    "Refinement",
    "Result",
    "Scene",
    "Schedule",
    "Solver",
    "build_scene",
    "compiler_options",
    "explain",
    "fitted",
    "law",
    "load",
    "make_mold",
    "make_parison",
    "make_pressure",
    "make_refinement",
    "make_solver",
    "molds",
    "padded",
    "parameter",
    "replace",
    "run",
    "scenes",
    "shapes",
    "simulate",
    "simulate_batch",
    "summarize",
]
