"""Facts of summary.json that the report shows, checked: the file may be of another version, or by somebody else."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jaxform.core.errors import InputError
from jaxform.io import previous_results
from jaxform.io.previous_results import AGAIN

Number = float | None
"""Null where it was not finite."""
Place = Annotated[list[Number], Field(min_length=3, max_length=3)]


class _FactsTable(BaseModel):
    """A table that may have more keys than are asked for."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)


class _WallFacts(_FactsTable):
    min: Number
    mean: Number
    max: Number
    cv: Number


class _Thinnest(_FactsTable):
    thickness: Number
    formed: Place
    initial: Place
    recovered: Number = None
    recovered_place: Place | None = None
    scatter: Number = None
    scatter_of: str = ""


class _DesignFacts(_FactsTable):
    before: dict[str, Number]
    after: dict[str, Number]
    evaluations: Number = None
    simulations: Number = None
    stopped_by: str = ""
    message: str = ""


class _SummaryFacts(_FactsTable):
    scene: str
    status: str
    elements_final: Number = None
    steps: Number = None
    time: Number = None
    thickness: _WallFacts
    thinnest: _Thinnest
    symmetry_planes: dict[str, float] = {}
    contact_fraction: Number
    mass: Number
    sheet_mass: Number = None
    penetration_max: Number = None
    penetration_place: Place | None = None
    gap_max: Number = None
    gap_place: Place | None = None
    energy: dict[str, Number]
    warnings: list[str]
    design: _DesignFacts | None = None


def read_summary(folder: Path) -> dict[str, Any]:
    """The contents of a folder's summary.json, those that the report shows being of the right kind.

    Raises:
        InputError: It cannot be read, is no JSON, or a key is missing or of another kind.
    """
    path, facts = folder / previous_results.SUMMARY, previous_results.read_summary(folder)
    try:
        return _SummaryFacts.model_validate(facts).model_dump(exclude_unset=True)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        if first["type"] == "missing":
            raise InputError(
                "is missing, the file is of another version or damaged", AGAIN, key, file=str(path)
            ) from None
        problem = "is of another kind than is expected, the file is of another version or damaged"
        raise InputError(problem, AGAIN, key, first["input"], str(path)) from None
