"""Bucket sizes: the array lengths for which programs are compiled.

A program is compiled for the lengths of its arrays. Scenes whose arrays are as long as the same buckets share all their
programs, for any meshes and molds; entries beyond a mesh are not active. A bucket size is twice the one
below, or half as long again where unused capacity takes some time all the same, or four times as long.
"""

from __future__ import annotations

import itertools

from jaxform.kernels.blocks import BLOCK

_RATIO = 1.5
_ELEMENTS = 11 * BLOCK  # the first bucket size: meshes of fewer elements take hardly any time
_ROOTS, _ADDED = 24, 14 * BLOCK  # of a mesh that is refined: elements at first, and capacity for those there will be
_RIM = 1.5  # of the root of the elements' number: half the nodes at the rim of a sheet about as wide as it is long
_PAIRS = 9 / 16  # of the elements: few are left over
_SPILL, _KNOTS, _WINDOWS, _RECORDED = BLOCK, 16, 256, 512
_RIM_EDGES, _SHARP_EDGES = 64, 32
_ROWS = 4, 6, 16  # of an assembly's table
# Arrays for look-up take memory, but no time: few buckets, far apart.
_MOLD, _CELLS, _LISTED, _BEND, _FAR_APART = 4096, 49_152, 196_608, 500_000, 4.0
_HALF_EDGES = 17 / 8  # of all triangles of a forest


def bucket_size(count: int, first: int, ratio: float = 2.0) -> int:
    """The first of the lengths `first`, `first` times the ratio, and so on, that is not below `count`."""
    return next(length for k in itertools.count() if (length := round(first * ratio**k)) >= count)


def staggered_capacity(capacity: int, block: int = BLOCK) -> int:
    """Capacity for as much or somewhat more, in so many blocks that rows of numbers do not share the cache's sets.

    Rows that are a multiple of 4096 bytes apart do: an odd number of eighths of that keeps them apart.
    """
    return capacity + block if (capacity // block + 1) % 8 == 0 else capacity


def element_capacity(count: int) -> int:
    """Capacity for the elements of a mesh without refinement, and for one more, of which padded pairs are."""
    return _block_multiple(count + 1, _ELEMENTS)


def root_capacity(count: int) -> int:
    """Capacity for the elements of a mesh that is refined, before it is."""
    return bucket_size(count, _ROOTS)


def refined_capacity(count: int) -> int:
    """Capacity for the elements of a mesh that is refined."""
    return _block_multiple(count, _ADDED)


def _block_multiple(count: int, first: int) -> int:
    return staggered_capacity(
        next(capacity for k in itertools.count() if (capacity := BLOCK * round(first * _RATIO**k / BLOCK)) >= count)
    )


def node_capacity(count: int, capacity: int) -> int:
    """Capacity for the nodes of a mesh with capacity for so many elements, and for one more.

    A sheet has half as many nodes as elements, and half as many more as its rim has.
    """
    return staggered_capacity(bucket_size(count + 1, int(0.5 * capacity + _RIM * capacity**0.5) + 8, _RATIO))


def pair_capacity(count: int, capacity: int) -> int:
    """Capacity for the pairs of elements of a mesh with capacity for so many elements, and for one more."""
    return staggered_capacity(bucket_size(count + 1, int(_PAIRS * capacity)), BLOCK // 2)


def half_edge_capacity(count: int, triangles: int) -> int:
    """Capacity for half edges of a forest of so many triangles, and for one edge more; even."""
    return 2 * (bucket_size(count + 2, int(_HALF_EDGES * triangles)) // 2 + 1)


def table_row_capacity(count: int) -> int:
    """Rows of an assembly's table."""
    return next(capacity for capacity in _ROWS if capacity >= count)


def valence_capacity(count: int) -> int:
    """Capacity for the triangles of a forest that meet at a node."""
    return bucket_size(count, 16, 1.5)


def overflow_capacity(count: int) -> int:
    """Capacity for shares beyond an assembly's table."""
    return bucket_size(count, _SPILL, _FAR_APART)


def knot_capacity(count: int) -> int:
    """Capacity for the knots of a pressure history."""
    return bucket_size(count, _KNOTS, _FAR_APART)


def window_capacity(count: int, *, recorded: bool = False) -> int:
    """Capacity for windows; where they are only recorded, more capacity takes no time."""
    return bucket_size(count, _RECORDED if recorded else _WINDOWS)


def rim_edge_capacity(count: int) -> int:
    """Capacity for the edges of rims that move."""
    return bucket_size(count, _RIM_EDGES)


def mold_triangle_capacity(count: int) -> int:
    """Capacity for the triangles of a mold."""
    return bucket_size(count, _MOLD, _FAR_APART)


def sharp_edge_capacity(count: int) -> int:
    """Capacity for the sharp edges of a mold; none where it has none."""
    return 0 if count == 0 else bucket_size(count, _SHARP_EDGES)


def cell_capacity(count: int) -> int:
    """Capacity for the cells of a mold's search grid, and for the wider ones."""
    return bucket_size(count, _CELLS, _FAR_APART)


def cell_list_capacity(count: int) -> int:
    """Capacity for the entries of the cells' lists."""
    return bucket_size(count, _LISTED, _FAR_APART)


def bend_part_capacity(count: int) -> int:
    """Capacity for the parts of cells with the distance to bends of the mold."""
    return bucket_size(count, _BEND)
