"""Loadings of the sheet, one file each; `loading.py` says how another is added."""

from jaxform.loads.history import Pressure, make_pressure
from jaxform.loads.loading import Interval, Loading, Pressed, first_pressure, loading, next_pressure

__all__ = [
    "Interval",
    "Loading",
    "Pressed",
    "Pressure",
    "first_pressure",
    "loading",
    "make_pressure",
    "next_pressure",
]
