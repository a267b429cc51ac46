"""Facts that the report takes from summary.json, checked: the file may be of another version, or written by somebody else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jaxform.core import disk
from jaxform.core.errors import InputError

AGAIN = "name the folder that `jaxform simulate` or `jaxform optimize` wrote, or run it again"

Number = float | None
"""Null where it was not finite."""
Place = Annotated[list[Number], Field(min_length=3, max_length=3)]


class _Table(BaseModel):
    """A table that may have more keys than are asked for."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)


class _Wall(_Table):
    min: Number
    mean: Number
    max: Number
    cv: Number


class _Thinnest(_Table):
    thickness: Number
    formed: Place
    initial: Place


class _Design(_Table):
    before: dict[str, Number]
    after: dict[str, Number]
    evaluations: Number = None
    simulations: Number = None
    stopped_by: str = ""
    message: str = ""


class _Summary(_Table):
    scene: str
    status: str
    elements_final: Number = None
    steps: Number = None
    time: Number = None
    thickness: _Wall
    thinnest: _Thinnest
    symmetry_planes: dict[str, float] = {}
    contact_fraction: Number
    mass: Number
    penetration_max: Number = None
    penetration_place: Place | None = None
    energy: dict[str, Number]
    warnings: list[str]
    design: _Design | None = None


def read_summary(path: Path) -> dict[str, Any]:
    """The contents of summary.json, those that the report shows being of the right kind.

    Raises:
        InputError: It cannot be read, is no JSON, or a key is missing or of another kind.
    """
    text = disk.read_text(path)
    try:
        facts = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("is not valid JSON", AGAIN, file=str(path)) from None
    if not isinstance(facts, dict):
        raise InputError("is no table", AGAIN, file=str(path))
    try:
        return _Summary.model_validate(facts).model_dump(exclude_unset=True)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        if first["type"] == "missing":
            raise InputError(
                "is missing, the file is of another version or damaged", AGAIN, key, file=str(path)
            ) from None
        problem = "is of another kind than is expected, the file is of another version or damaged"
        raise InputError(problem, AGAIN, key, first["input"], str(path)) from None
