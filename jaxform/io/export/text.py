"""Parts that the text formats share: the head of a file, and numbers in rows."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from jaxform.io.export.wall import WallSurface


def head(wall: WallSurface, middles: int = 0) -> list[str]:
    """Lines that describe the content of a file, without the marks of comments.

    Args:
        wall: The wall that is written.
        middles: Number of mid-side nodes in the file, besides those of the wall.
    """
    low, high = (1e3 * float(value) for value in (wall.thickness.min(), wall.thickness.max()))
    # Names of scenes and files may have any characters; solvers read comments in one line and ASCII.
    words = [" ".join(line.encode("ascii", "backslashreplace").decode().split()) for line in wall.words]
    between = f" and {middles} in the middles of sides" if middles else ""
    return [
        *("".join(filter(str.isprintable, line)) for line in words),
        "Units: SI (m, kg, s, N, Pa); thickness in m",
        f"{len(wall.positions)} nodes{between}, {len(wall.triangles)} triangles, {low:.4g} to {high:.4g} mm thick, "
        f"volume {wall.volume:.6g} m3",
    ]


def rows(numbers: NDArray[np.integer], many: int, form: str, between: str = "") -> Iterator[str]:
    """Numbers as text, so many in a row, each in a form such as `%10d`."""
    for start in range(0, len(numbers), many):
        yield between.join(form % number for number in numbers[start : start + many])


def table(form: str, *columns: NDArray[np.generic]) -> Iterator[str]:
    """A row of text for each row of columns (n,) or (n, k)."""
    flat = [part for column in columns for part in np.atleast_2d(column.T)]
    for values in zip(*(column.tolist() for column in flat), strict=True):
        yield form % values
