"""Pairs of triangles of two sets that may meet, found by cells that are made for one search. On the host."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.crossings import all_columns, bounding_boxes, expand_ranges, short_pieces

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_WIDE = 2.0  # cells, in boxes: most triangles then need not be cut


class _PieceCells(NamedTuple):
    """The cells of a set's pieces, in the order of the cells: cell and piece of each entry (n_entry,)."""

    cell: Integers
    piece: Integers


class _PieceBoxes(NamedTuple):
    """Boxes of pieces of triangles (n, 3), (n, 3) [m], no wider than a cell, and which triangle each is part of."""

    low: Array
    high: Array
    owner: Integers

    @classmethod
    def of(cls, corners: Array, width: float, low: Array, high: Array) -> _PieceBoxes:
        pieces, owner = short_pieces(corners, width, low, high)
        return cls(*bounding_boxes(pieces), owner)

    def cells(self, corner: Array, width: float, shape: Integers) -> _PieceCells:
        """The cells of each piece: at most two along each axis."""
        first, last = (np.floor((end - corner) / width).astype(np.int64) for end in (self.low, self.high))
        found = []
        for step in np.ndindex(2, 2, 2):
            index = first + step
            piece = np.flatnonzero(all_columns(index <= last))
            found.append((np.ravel_multi_index(tuple(index[piece].T), tuple(shape)), piece))
        cell, piece = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.argsort(cell, kind="stable")
        return _PieceCells(cell[order], piece[order])


def overlapping_pairs(one: Array, other: Array) -> Iterator[tuple[Integers, Integers]]:
    """Numbers of triangles (n, 3, 3) [m] and of others (m, 3, 3) that may meet, part by part; the first are not empty.

    Large ones are cut into pieces: each pair that has pieces with boxes that overlap comes at least once. The width of
    the cells follows the mean of the logarithms of the first set's boxes: then neither the pieces of the large ones nor
    the small ones in a cell are many.
    """
    low, high = bounding_boxes(one)
    extent = functools.reduce(np.maximum, (high - low).T)
    width = _WIDE * float(np.exp(np.log(np.maximum(extent, 1e-3 * extent.max())).mean()))
    box = low.min(0), high.max(0)
    sets = _PieceBoxes.of(one, width, *box), _PieceBoxes.of(other, width, *box)
    if not len(sets[1].owner):
        return
    corner = np.min([pieces.low.min(0) for pieces in sets], axis=0)
    shape = np.max([np.floor((pieces.high - corner) / width).max(0) for pieces in sets], axis=0) + 2
    mine, theirs = (pieces.cells(corner, width, shape.astype(np.int64)) for pieces in sets)
    begin, end = (np.searchsorted(theirs.cell, mine.cell, side) for side in ("left", "right"))
    for row, place in expand_ranges(begin, end):
        first, second = mine.piece[row], theirs.piece[place]
        for axis in range(3):
            over = sets[0].low[first, axis] <= sets[1].high[second, axis]
            over &= sets[0].high[first, axis] >= sets[1].low[second, axis]
            first, second = first[over], second[over]
        yield sets[0].owner[first], sets[1].owner[second]
