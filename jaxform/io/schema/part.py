"""The table that selects the part from the formed sheet."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from jaxform.io.schema.quantities import Triple
from jaxform.io.validation import Coordinate, Table, validation_error


class TrimTable(Table):
    """A plane across an axis at which the part is cut off.

    Attributes:
        axis: Axis normal to the plane.
        at: Position of the plane along the axis [m], in formed positions.
        keep: Side that is the part.
    """

    axis: Literal["x", "y", "z"]
    at: Coordinate
    keep: Literal["above", "below"]


class PartTable(Table):
    """Selection of the part from the formed sheet: the elements that all keys hold for.

    Statistics, the thinnest place, mass, objectives, pictures and exports are then of the part alone, not of what
    clamp frame, platen, flanges and covers hold.

    Attributes:
        box: Lowest and highest corner [[x0, y0, z0], [x1, y1, z1]] [m] of the box for an element's centroid, in
            formed positions.
        trim: A plane at which the part is cut off.
        molds: Files of `mold.path`, by name, that the part touches: more of an element's nodes stick to these than to
            others; what touches nothing belongs to what is next to it, and clamped nodes to no file.
    """

    box: Annotated[list[Triple], Field(min_length=2, max_length=2)] | None = None
    trim: TrimTable | None = None
    molds: Annotated[list[str], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _check(self) -> PartTable:
        if self.box is None and self.trim is None and self.molds is None:
            raise validation_error("says nothing", "give box, trim or molds, or leave [part] out", "", {})
        return self
