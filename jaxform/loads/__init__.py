"""Loadings of the sheet, one file each; `loading.py` says how another is added."""

from jaxform.loads.gas import Gas, make_gas
from jaxform.loads.history import Pressure, make_pressure
from jaxform.loads.loading import Interval, Loading, LoadState, first_pressure, loading, next_pressure
from jaxform.loads.supply import GasSupply, make_gas_supply

__all__ = [
    "Gas",
    "GasSupply",
    "Interval",
    "LoadState",
    "Loading",
    "Pressure",
    "first_pressure",
    "loading",
    "make_gas",
    "make_gas_supply",
    "make_pressure",
    "next_pressure",
]
