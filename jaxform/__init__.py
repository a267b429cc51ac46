"""jaxform: a differentiable simulator of blow moulding and thermoforming."""

from jaxform import molds, scenes, shapes
from jaxform.building import build_scene
from jaxform.errors import InputError
from jaxform.files import load
from jaxform.materials import ModifiedMooneyRivlin, MooneyRivlin, NeoHookean
from jaxform.mold import Mold, make_mold
from jaxform.refinement import fitted
from jaxform.result import Result, explain, summarize
from jaxform.scene import (
    Parison,
    Pressure,
    Refinement,
    Scene,
    Solver,
    make_parison,
    make_pressure,
    make_refinement,
    make_solver,
    replace,
)
from jaxform.simulation import Moment, run, simulate, simulate_batch
from jaxform.state import Schedule

__all__ = [
    "InputError",
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
    "explain",
    "fitted",
    "load",
    "make_mold",
    "make_parison",
    "make_pressure",
    "make_refinement",
    "make_solver",
    "molds",
    "replace",
    "run",
    "scenes",
    "shapes",
    "simulate",
    "simulate_batch",
    "summarize",
]
