from . import molds, scenes, shapes
from .adjoint import Adjoint, Checkpointed, Reversed, Stored
from .building import build_scene
from .carried import Field, Surroundings, field
from .compiling import compiler_options
from .errors import InputError, InputWarning
from .files import load
from .loads import Loading, Pressure, loading, make_pressure
from .materials import Law, ModifiedMooneyRivlin, MooneyRivlin, NeoHookean, law
from .mold import Mold, make_mold
from .padding import padded
from .parameters import parameter
from .refinement import fitted
from .replacing import replace
from .result import Result, explain, summarize
from .scene import (
    Parison,
    Refinement,
    Scene,
    Solver,
    make_parison,
    make_refinement,
    make_solver,
)
from .simulation import Moment, run, simulate, simulate_batch
from .state import Schedule

__all__ = [
    "Adjoint",
    "Checkpointed",
    "Field",
    "InputError",
    "InputWarning",
    "Law",
    "Loading",
    "ModifiedMooneyRivlin",
    "Mold",
    "Moment",
    "MooneyRivlin",
    "NeoHookean",
    "Parison",
    "Pressure",
    "Refinement",
    "Result",
    "Reversed",
    "Scene",
    "Schedule",
    "Solver",
    "Stored",
    "Surroundings",
    "build_scene",
    "compiler_options",
    "explain",
    "field",
    "fitted",
    "law",
    "load",
    "loading",
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
