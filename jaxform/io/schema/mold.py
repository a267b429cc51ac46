"""Tables of the mold."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag

from jaxform.io.schema.quantities import Point, Triple
from jaxform.io.validation import Length, NotNegative, Number, Positive, Table, choice, form


class MotionTable(Table):
    """How the mold moves: along a straight line, smoothly from knot to knot, and with it what sticks to it.

    Attributes:
        direction: Of the displacement, of any length.
        time: Knots [s].
        displacement: From where the mold starts, at the knots [m]; the first is 0.
    """

    direction: Triple
    time: Annotated[list[Number], Field(min_length=2)]
    displacement: Annotated[list[Number], Field(min_length=2)]


class RevolvedMold(Table):
    """A profile [[r, z], ...] from the axis outwards, turned about the z axis.

    Attributes:
        shape: The kind of mold.
        profile: Points [r, z] [m] from the axis outwards.
        segments: Around the axis.
        motion: How it moves; at rest by default.
        fill: Whether it is to be filled: where a fifth of the opening's depth is left open, the status says so.
    """

    shape: Literal["revolved"]
    profile: Annotated[list[Point], Field(min_length=2)]
    segments: Annotated[int, Field(ge=3, le=1_000_000)]
    motion: MotionTable | None = None
    fill: bool = True


class BoxInsertMold(Table):
    """A box, open at z = 0, with a raised block in the middle of its bottom.

    Attributes:
        shape: The kind of mold.
        size: Of the box along x and y [m].
        depth: Of the box [m].
        insert_size: Of the block along x and y [m].
        insert_height: Of the block [m].
        draft: Of all walls [degrees].
        divisions: Into how many parts each side of a triangle is divided.
        motion: How it moves; at rest by default.
        fill: Whether it is to be filled: where a fifth of the opening's depth is left open, the status says so.
    """

    shape: Literal["box-insert"]
    size: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [0.3, 0.2])
    depth: Length = 0.08
    insert_size: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(
        default_factory=lambda: [0.12, 0.08]
    )
    insert_height: Length = 0.04
    draft: NotNegative = 0.0
    divisions: Annotated[int, Field(ge=1, le=200)] = 1
    motion: MotionTable | None = None
    fill: bool = True


class BottleHalfMold(Table):
    """Half of a soap bottle with a handle, z >= 0.

    Attributes:
        shape: The kind of mold.
        height: Of the bottle [m].
        radius: Of its body [m].
        neck_radius: Of its neck [m].
        hole: Half width and half height of the hole of the handle [m].
        element_size: Side of a triangle [m].
        motion: How it moves; at rest by default.
        fill: Whether it is to be filled: where a fifth of the opening's depth is left open, the status says so.
    """

    shape: Literal["bottle-half"]
    height: Length = 0.23
    radius: Length = 0.04
    neck_radius: Length = 0.014
    hole: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [0.0075, 0.027])
    element_size: Length = 0.00595
    motion: MotionTable | None = None
    fill: bool = True


Paths = Annotated[
    Annotated[str, Tag("<one>")] | Annotated[Annotated[list[str], Field(min_length=1)], Tag("<several>")],
    form(lambda value: "several" if isinstance(value, list) else "one"),
]


class FileMold(Table):
    """A user's mesh, in one file or several: scaled, turned about x, y, z [degrees], then moved [m].

    Attributes:
        shape: The kind of mold.
        path: A mesh file or several that are one mold, relative to the scene file.
        scale: Factor on its coordinates: 0.001 of a mesh in millimetres.
        translate: Moved by this [m], after it was turned.
        rotate: Turned about x, y and z, one after the other [degrees].
        motion: How it moves; at rest by default.
        fill: Whether it is to be filled: where a fifth of the opening's depth is left open, the status says so.
    """

    shape: Literal["file"]
    path: Paths
    scale: Positive = 1.0
    translate: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    rotate: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    motion: MotionTable | None = None
    fill: bool = True


Mold = Annotated[
    Annotated[RevolvedMold, Tag("<revolved>")]
    | Annotated[BoxInsertMold, Tag("<box-insert>")]
    | Annotated[BottleHalfMold, Tag("<bottle-half>")]
    | Annotated[FileMold, Tag("<file>")],
    *choice("shape", ["revolved", "box-insert", "bottle-half", "file"]),
]
