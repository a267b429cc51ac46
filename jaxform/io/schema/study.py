"""The study file."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, field_validator

from jaxform.io.schema.methods import Method
from jaxform.io.schema.objectives import Objectives
from jaxform.io.schema.variables import Variable
from jaxform.io.validation import Table, validation_error


class StudyFile(Table):
    """A study file.

    Attributes:
        description: One line for the list of studies.
        scene: A built-in scene, or a scene file relative to this one.
        variable: Design variables: one table or more.
        objective: The objective: one table, or several that add up by weight.
        solver: The search method.
    """

    description: str = ""
    scene: str
    variable: Annotated[list[Variable], Field(min_length=1)]
    objective: Objectives
    solver: Method

    @field_validator("variable")
    @classmethod
    def _each_once(cls, variables: list[Any]) -> list[Any]:
        kinds = [getattr(variable, "of", variable.kind) for variable in variables]
        for index, kind in enumerate(kinds):
            if kind in kinds[:index]:
                raise validation_error("is there twice", "keep one of them", f"[{index}].kind", kind)
        return variables
