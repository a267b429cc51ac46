"""Arrays and facts packed into text that a browser unpacks: 16 bits a number, differences, deflate, base64.

The layout, which `unpack.js` reads: after inflating, the length of the header (four bytes, little-endian), the header
as JSON, then the arrays one after the other. Of every column the more significant bytes come first, then the others:
those are nearly all zero, and deflate leaves hardly anything of them.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOTHING = 65535
"""Code of a value that is no number."""
_MANY, _FEW = NOTHING - 1, 4095
_CELLS = 1023  # along a side of space, between which places are ordered
_LEVEL = 6  # of deflate: more takes twice the time for a hundredth


class Parcel:
    """Arrays that are packed together, and their description.

    Attributes:
        described: Layout of each array for unpacking, by name.
    """

    def __init__(self) -> None:
        """Create an empty parcel."""
        self.described: dict[str, dict[str, Any]] = {}
        self._bytes: list[bytes] = []
        self._size = 0

    def add(self, name: str, values: NDArray[Any], *, relative: bool = False, coarse: bool = False) -> None:
        """Packs numbers (n,) or (n, k), to a 65534th of the range of each column.

        Args:
            name: Name of the array.
            values: The numbers; those that are not finite come out as NaN.
            relative: All are positive, and the error is the same part of each instead.
            coarse: To a 4095th instead, which takes half the space.
        """
        columns = np.atleast_2d(np.asarray(values, np.float64).T)
        with np.errstate(all="ignore"):
            columns = np.log(columns) if relative else columns
        codes, lows, steps = zip(*(_quantise(column, _FEW if coarse else _MANY) for column in columns), strict=True)
        coding = "relative" if relative else "linear"
        self._append(name, [_differences(column) for column in codes], 2, coding, low=list(lows), step=list(steps))

    def add_triangles(self, name: str, triangles: NDArray[Any]) -> None:
        """Packs triangles (n, 3) of nodes that are numbered in the order in which they first occur."""
        corners = np.asarray(triangles, np.int64).ravel()
        newest = np.maximum.accumulate(np.concatenate([[-1], corners]))[:-1]
        self._append(name, [newest + 1 - corners], 3, "index")

    def text(self, facts: Mapping[str, Any]) -> str:
        """All in base64, with facts (plain numbers, words, lists and tables) in the header."""
        described = _valid({**facts, "arrays": self.described})
        header = json.dumps(described, separators=(",", ":"), allow_nan=False).encode()
        content = b"".join([len(header).to_bytes(4, "little"), header, *self._bytes])
        return base64.b64encode(zlib.compress(content, _LEVEL)).decode("ascii")

    def _append(self, name: str, columns: list[NDArray[Any]], width: int, coding: str, **more: Any) -> None:
        """Adds columns (n,) of numbers of so many bytes, byte by byte."""
        planes = [(column >> 8 * byte) & 255 for column in columns for byte in reversed(range(width))]
        content = np.concatenate(planes).astype(np.uint8).tobytes()
        count = len(columns[0])
        self.described[name] = {"at": self._size, "count": count, "columns": len(columns), "coding": coding, **more}
        self._bytes.append(content)
        self._size += len(content)


def by_first_use(triangles: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles (n, 3) with nodes numbered as they first occur, and which node each of these was (m,)."""
    corners = np.asarray(triangles, np.int64).ravel()
    first = np.full(corners.max(initial=-1) + 1, len(corners))
    np.minimum.at(first, corners, np.arange(len(corners)))
    nodes = np.argsort(first, kind="stable")[: np.count_nonzero(first < len(corners))]
    number = np.empty(len(first), np.int64)
    number[nodes] = np.arange(len(nodes))
    return number[corners].reshape(-1, 3), nodes


def spatial_order(places: Array) -> NDArray[np.int64]:
    """An order (n,) of places (n, 3) in which neighbours are near each other, so that their differences are small."""
    low, size = places.min(0), float(np.ptp(places, axis=0).max()) or 1.0
    cells = ((places - low) / size * _CELLS).astype(np.int64)
    # Morton's curve: the bits of the three coordinates by turns.
    key = np.zeros(len(places), np.int64)
    for bit in range(_CELLS.bit_length()):
        for axis in range(3):
            key |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _quantise(values: Array, most: int) -> tuple[NDArray[np.int64], float, float]:
    """Codes (n,) from 0 to the most, the value of code 0 and the difference of neighbours."""
    known = np.isfinite(values)
    low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
    step = (high - low) / most
    codes = np.full(len(values), NOTHING, np.int64)
    codes[known] = np.rint((values[known] - low) / (step or 1.0)).astype(np.int64)
    return codes, low, step


def _valid(value: Any) -> Any:
    """A copy with null for numbers that are not finite, which JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _valid(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_valid(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _differences(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Differences (n,) to the code before, around 65536, those of either sign by turns: 0, -1, 1, -2 are 0, 1, 2, 3."""
    change = np.diff(codes, prepend=0).astype(np.int16).astype(np.int64)
    return ((change << 1) ^ (change >> 15)) & 65535
