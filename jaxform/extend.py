"""Names for code that is built on jaxform, such as `optimize`: parameters, material points, programs, results."""

from jaxform.core.compilation import compile_function
from jaxform.core.errors import format_percent, warn_of
from jaxform.core.pytree import as_real, list_parameter_names, parameter_ranges
from jaxform.core.ranges import LEAST, MOST, Range
from jaxform.core.store import Store
from jaxform.materials import LAWS, MODES, Modes
from jaxform.mechanics.constitutive import (
    Overstress,
    ViscousMemory,
    advance_memory,
    initial_overstress,
    principal_nominal_stress,
    principal_overstress,
)
from jaxform.mesh.bisection import extend_values
from jaxform.mesh.topology import boundary_nodes
from jaxform.model.replacement import number_at
from jaxform.results.part import mask_part, part_elements
from jaxform.results.result import drop_unused
from jaxform.results.sections import symmetry_planes
from jaxform.results.summary import QUASI_STATIC_LIMIT
from jaxform.sweeps.designs import MOST_SOBOL
from jaxform.sweeps.evaluation import Setting as WorkerSetting
from jaxform.sweeps.evaluation import compile_once, set_up, worker_setting
from jaxform.sweeps.workers import Outcome, evaluate, guarded

__all__ = [
    "LAWS",
    "LEAST",
    "MODES",
    "MOST",
    "MOST_SOBOL",
    "QUASI_STATIC_LIMIT",
    "Modes",
    "Outcome",
    "Overstress",
    "Range",
    "Store",
    "ViscousMemory",
    "WorkerSetting",
    "advance_memory",
    "as_real",
    "boundary_nodes",
    "compile_function",
    "compile_once",
    "drop_unused",
    "evaluate",
    "extend_values",
    "format_percent",
    "guarded",
    "initial_overstress",
    "list_parameter_names",
    "mask_part",
    "number_at",
    "parameter_ranges",
    "part_elements",
    "principal_nominal_stress",
    "principal_overstress",
    "set_up",
    "symmetry_planes",
    "warn_of",
    "worker_setting",
]
