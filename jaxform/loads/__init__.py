"""Loadings of the sheet, one file each; `loading.py` says how another is added."""

from jaxform.loads.gas import (
    Gas,
    RegionalLoad,
    TwoSidedLoad,
    list_gases,
    make_gas,
    make_regional_load,
    make_two_sided_load,
)
from jaxform.loads.loading import (
    Interval,
    Loading,
    LoadState,
    Pressure,
    first_pressure,
    loading,
    make_pressure,
    next_pressure,
    sample_pressure,
)

__all__ = [
    "Gas",
    "Interval",
    "LoadState",
    "Loading",
    "Pressure",
    "RegionalLoad",
    "TwoSidedLoad",
    "first_pressure",
    "list_gases",
    "loading",
    "make_gas",
    "make_pressure",
    "make_regional_load",
    "make_two_sided_load",
    "next_pressure",
    "sample_pressure",
]
