"""Loadings of the sheet, one file each; `loading.py` says how another is added."""

from jaxform.loads.history import Pressure, make_pressure
from jaxform.loads.loading import Loading, loading

__all__ = ["Loading", "Pressure", "loading", "make_pressure"]
