"""Tables of the mold."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag

from jaxform.io.schema.quantities import Point, Triple
from jaxform.io.validation import Length, NotNegative, Number, Positive, Table, choice, form


class MotionTable(Table):
    """Motion of the mold along a straight line, smooth from knot to knot; nodes that stick to it move with it.

    Attributes:
        direction: Direction of the displacement, a vector of any length.
        time: Knots [s].
        displacement: Displacement from the initial position at the knots [m]; the first is 0.
    """

    direction: Triple
    time: Annotated[list[Number], Field(min_length=2)]
    displacement: Annotated[list[Number], Field(min_length=2)]


class RevolvedMold(Table):
    """A profile [[r, z], ...] from the axis outwards, turned about the z axis.

    Attributes:
        shape: The kind of mold.
        profile: Points [r, z] [m] from the axis outwards.
        segments: Number of segments around the axis.
        motion: Motion of the mold; at rest by default.
        fill: Whether the mold is to be filled; if so, the status reports a gap of a fifth of the opening's depth.
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
        size: Sides of the box along x and y [m].
        depth: Depth of the box [m].
        insert_size: Sides of the block along x and y [m].
        insert_height: Height of the block [m].
        draft: Draft angle of all walls [degrees].
        divisions: Number of parts into which each side of a triangle is divided.
        motion: Motion of the mold; at rest by default.
        fill: Whether the mold is to be filled; if so, the status reports a gap of a fifth of the opening's depth.
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
        height: Height of the bottle [m].
        radius: Radius of its body [m].
        neck_radius: Radius of its neck [m].
        hole: Half width and half height of the hole of the handle [m].
        element_size: Side of a triangle [m].
        motion: Motion of the mold; at rest by default.
        fill: Whether the mold is to be filled; if so, the status reports a gap of a fifth of the opening's depth.
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
        translate: Translation [m] after the rotation.
        rotate: Rotation about x, y and z, one after the other [degrees].
        motion: Motion of the mold; at rest by default.
        fill: Whether the mold is to be filled; if so, the status reports a gap of a fifth of the opening's depth.
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
