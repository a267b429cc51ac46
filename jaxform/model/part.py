"""The part of the formed sheet: elements in a box, on one side of a plane, or on some triangles of the mold.

The clamped edge, platens, covers and flanges are formed with the part, but are trimmed off.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real, pytree, static


@pytree
class Trim:
    """A plane across an axis at which the part is cut off.

    Attributes:
        at: Its position along the axis [m].
        axis: 0, 1 or 2.
        above: True if the part is above it.
    """

    at: jax.Array
    axis: int = static()
    above: bool = static()


@pytree
class Part:
    """The part of the formed sheet: the elements that meet all given conditions.

    Attributes:
        box: Lowest and highest corner (2, 3) [m] of the box that holds an element's middle; None for everywhere.
        trim: The side of a plane on which the centre of an element lies; None for both.
        walls: Mask of the mold's triangles (n_triangle,) of the part: an element belongs to it if more of its nodes are
            in contact with these than with others, and an element without contact if its neighbours do. None for all.
        tool_walls: The same masks of the tools' triangles, in the order of the scene's tools; None for a tool whose
            contact does not matter. Empty where none does.
    """

    box: jax.Array | None = None
    trim: Trim | None = None
    walls: jax.Array | None = None
    tool_walls: tuple[jax.Array | None, ...] = ()

    @property
    def by_contact(self) -> bool:
        """True where the part depends on what the sheet touches."""
        return self.walls is not None or any(each is not None for each in self.tool_walls)

    def holds(self, places: Any) -> Any:
        """Mask (n,) of the places (n, 3) [m] in the box and on the chosen side of the plane; NumPy's or traced."""
        inside = jnp.ones(places.shape[0], bool)
        if self.box is not None:
            inside &= jnp.all((places >= self.box[0]) & (places <= self.box[1]), axis=1)
        if self.trim is not None:
            along = places[:, self.trim.axis]
            inside &= along >= self.trim.at if self.trim.above else along <= self.trim.at
        return inside


def make_part(
    *,
    box: ArrayLike | None = None,
    trim: tuple[Literal["x", "y", "z"], float, Literal["above", "below"]] | None = None,
    walls: ArrayLike | None = None,
    tool_walls: Sequence[ArrayLike | None] = (),
) -> Part:
    """Defines the part of the formed sheet, for `build_scene`.

    Args:
        box: Lowest and highest corner (2, 3) [m], in formed positions.
        trim: Axis, place along it [m], and which side is the part: ("z", 0.002, "above").
        walls: Mask (n_triangle,) of the mold's triangles with which the part is in contact.
        tool_walls: The same masks of the tools' triangles, None for a tool whose contact does not matter.

    Raises:
        InputError: Nothing is given, a number is not finite, or a box has no volume.
    """
    if box is None and trim is None and walls is None and all(each is None for each in tool_walls):
        raise InputError("is empty", "give box, trim or walls", "part")
    return Part(
        None if box is None else as_real(_box(box)),
        None if trim is None else _trim(*trim),
        None if walls is None else jnp.asarray(np.asarray(walls, bool)),
        tuple(None if each is None else jnp.asarray(np.asarray(each, bool)) for each in tool_walls),
    )


def _box(given: ArrayLike) -> np.ndarray:
    try:
        box = np.asarray(given, float)
    except (TypeError, ValueError):
        box = np.zeros(0)
    if box.shape != (2, 3) or not np.isfinite(box).all():
        raise InputError("is not a box", "give [[x0, y0, z0], [x1, y1, z1]] in m", "part.box", given)
    if not (box[0] < box[1]).all():
        raise InputError("has no inside", "give the lowest corner first, then the highest", "part.box", given)
    return box


def _trim(axis: str, at: float, keep: str) -> Trim:
    if axis not in ("x", "y", "z"):
        raise InputError("is not an axis", 'give "x", "y" or "z"', "part.trim.axis", axis)
    if keep not in ("above", "below"):
        raise InputError("is not a side of a plane", 'give "above" or "below"', "part.trim.keep", keep)
    if not np.isfinite(at):
        raise InputError("is not finite", "give a place along the axis in m", "part.trim.at", at)
    return Trim(as_real(at), "xyz".index(axis), keep == "above")


def check_part(part: Part | None, triangle_count: int | None, tool_counts: Sequence[int] = ()) -> None:
    """Refuses a part that does not fit the mold, of so many triangles, and the tools; None without a mold.

    Raises:
        InputError: It names triangles of a mold or tool that is not there, or not as many as that has.
    """
    if part is None:
        return
    for number, mask in enumerate(part.tool_walls):
        count = tool_counts[number] if number < len(tool_counts) else 0
        if mask is not None and mask.shape != (count,):
            key = f"part.tool_walls[{number}]"
            raise InputError("is not a mask of the tool's triangles", f"give {count} values", key, mask.shape)
    if part.walls is None:
        return
    if triangle_count is None:
        raise InputError("there is no mold", "give a mold, or box or trim", "part.walls")
    if part.walls.shape != (triangle_count,):
        remedy = f"give one for each of the mold's {triangle_count} triangles"
        raise InputError("is not a mask of the mold's triangles", remedy, "part.walls", part.walls.shape)


def select_mold_files(paths: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Indices in `paths` of the mold's files that are wanted, by path or else by file name.

    Raises:
        InputError: A name is none of them.
    """
    chosen: set[int] = set()
    for name in wanted:
        found = [k for k, path in enumerate(paths) if path == name]
        found = found or [k for k, path in enumerate(paths) if _file_name(path) == _file_name(name)]
        if not found:
            known = ", ".join(paths) or "none"
            raise InputError("is not a file of the mold", f"its files: {known}", "part.molds", name)
        chosen.update(found)
    return sorted(chosen)


def _file_name(path: str) -> str:
    return path.replace("\\", "/").split("/")[-1]
