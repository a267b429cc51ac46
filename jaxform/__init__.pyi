from . import molds, plot, scenes, shapes
from .adapt.refinement import fitted
from .adjoint.strategies import Adjoint, Checkpointed, GradientCheck, Reversed, Stored, check_gradient
from .core.compilation import compiler_options, keep_programs
from .core.errors import InputError, InputWarning
from .core.pytree import parameter
from .io.files import load
from .loads import (
    Gas,
    Interval,
    Loading,
    Pressure,
    RegionalLoad,
    TwoSidedLoad,
    loading,
    make_gas,
    make_pressure,
    make_regional_load,
    make_two_sided_load,
)
from .materials import (
    Arrhenius,
    ArrheniusStiffness,
    Christensen,
    Cooling,
    Gent,
    Law,
    Maxwell,
    ModifiedMooneyRivlin,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    PlaneLaw,
    Wlf,
    Yeoh,
    law,
)
from .mesh.grids import Profile
from .model.field import Field, Surroundings, field
from .model.part import Part, Trim, make_part
from .model.replacement import replace
from .model.scene import (
    Parison,
    Refinement,
    Scene,
    Solver,
    make_parison,
    make_refinement,
    make_solver,
)
from .prepare.scene_builder import build_scene
from .results.result import Result, parison_of
from .results.summary import explain, summarize
from .runs.host import Moment, run
from .runs.padding import padded
from .runs.simulation import sensitivity, simulate, simulate_batch
from .sheet.state import Schedule, Status
from .sweeps.sweep import sweep
from .sweeps.workers import Outcome
from .tools.contact_law import ContactLaw, Coulomb, Slide, Stick, make_contact_law
from .tools.mold import Mold, Motion, make_mold, make_motion

__all__ = [
    "Adjoint",
    "Arrhenius",
    "ArrheniusStiffness",
    "Checkpointed",
    "Christensen",
    "ContactLaw",
    "Cooling",
    "Coulomb",
    "Field",
    "Gas",
    "Gent",
    "GradientCheck",
    "InputError",
    "InputWarning",
    "Interval",
    "Law",
    "Loading",
    "Maxwell",
    "ModifiedMooneyRivlin",
    "Mold",
    "Moment",
    "MooneyRivlin",
    "Motion",
    "NeoHookean",
    "Ogden",
    "Outcome",
    "Parison",
    "Part",
    "PlaneLaw",
    "Pressure",
    "Profile",
    "Refinement",
    "RegionalLoad",
    "Result",
    "Reversed",
    "Scene",
    "Schedule",
    "Slide",
    "Solver",
    "Status",
    "Stick",
    "Stored",
    "Surroundings",
    "Trim",
    "TwoSidedLoad",
    "Wlf",
    "Yeoh",
    "build_scene",
    "check_gradient",
    "compiler_options",
    "explain",
    "field",
    "fitted",
    "keep_programs",
    "law",
    "load",
    "loading",
    "make_contact_law",
    "make_gas",
    "make_mold",
    "make_motion",
    "make_parison",
    "make_part",
    "make_pressure",
    "make_refinement",
    "make_regional_load",
    "make_solver",
    "make_two_sided_load",
    "molds",
    "padded",
    "parameter",
    "parison_of",
    "plot",
    "replace",
    "run",
    "scenes",
    "sensitivity",
    "shapes",
    "simulate",
    "simulate_batch",
    "summarize",
    "sweep",
]
