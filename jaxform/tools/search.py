"""Where the mold's triangles are: a uniform grid, built once on the host, for the mold does not move.

Space is cut into cubes. Each cell near the mold lists every triangle within a certain distance (the *reach*) of it,
and every cell holds a lower bound on the distance from anywhere inside it to the mold. A node far away is then
dismissed by one look-up, and a near one is compared with the few triangles of its cell.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.core.pytree import as_index, as_real, pytree
from jaxform.core.store import Store

Array = NDArray[np.float64]

_MOST_CELLS = 2_000_000
_COARSEST, _FINEST = 32, 256  # cells along the longest side of a mold
_FEWEST = 16  # where a coarse sheet moves far in a window
# In cells: a coarse mold's lists are short and may reach far; a fine one's as far as the sheet moves, within this.
_REACH = {"coarse": 1.5, "fine": (0.75, 1.0)}
_FAR = 3  # how many times as wide the cells for nodes that move far are, and as long their reach
CLASSES = 4  # of distance, in which a cell's list is sorted: a small ball is compared with what is near alone
_CHUNK = 120_000  # pairs of cell and triangle looked at together: what a core's cache holds
_SLACK = 1e-6  # relative to a cell, for rounding
_HALF_DIAGONAL = np.sqrt(0.75)  # of a cell of width 1


@pytree
class FarCells:
    """Wider cells of a finely meshed mold, for the few nodes that move far beyond the reach of the others.

    Attributes:
        corner, width, reach, start, ends, shape: As those of `SearchGrid`, which holds the lists.
    """

    corner: jax.Array
    width: jax.Array
    reach: jax.Array
    start: jax.Array
    ends: jax.Array
    shape: jax.Array


@pytree
class SearchGrid:
    """The search structure of a mold.

    Attributes:
        corner: Lowest corner (3,) [m].
        width: Side of a cell [m].
        reach: Distance [m] from a cell within which it lists all triangles.
        size: Largest side of the mold's bounding box [m].
        bound: Lower bound (n_cell,) [m] on the distance to the mold from anywhere in the cell.
        start: Where each cell's list begins (n_cell + 1,) in `listed`.
        ends: Where those triangles of each cell's list end (n_cell * CLASSES,) that are within a quarter of the reach,
            within a half, and so on; the nearer ones come first.
        listed: Rows of the tables below, cell by cell; rows are in an order in which neighbours are close.
        number: Of the mold's triangle in each row (n_triangle,).
        outlines: Of each triangle (n_triangle, 8) its middle and the largest distance from it [m], its unit normal
            and the place of its plane along it [m].
        far: Wider cells; None where the sheet moves no farther than the cells' reach.
        frames: Of each triangle (n_triangle, 18) its first vertex D [m], unit normal, the vectors [1/m] whose products
            with a point's offset from D are its gamma and delta (Eq. 10), and its edges DE and DF [m].
        shape: Number of cells along x, y, z (3,).
    """

    corner: jax.Array
    width: jax.Array
    reach: jax.Array
    size: jax.Array
    bound: jax.Array
    start: jax.Array
    ends: jax.Array
    listed: jax.Array
    number: jax.Array
    outlines: jax.Array
    frames: jax.Array
    far: FarCells | None
    shape: jax.Array

    @property
    def farthest(self) -> jax.Array:
        """Reach [m] of the widest cells."""
        return self.reach if self.far is None else self.far.reach


class _Frame(NamedTuple):
    """The cells: lowest corner (3,) [m], width [m], reach [m], number along x, y, z (3,)."""

    corner: Array
    width: float
    reach: float
    shape: NDArray[np.int64]


def build_grid(
    vertices: Array, triangles: NDArray[np.integer], travel: float = 0.0, store: Store | None = None
) -> SearchGrid:
    """The search structure of a mold.

    Args:
        vertices: (n_vertex, 3) [m].
        triangles: Vertex numbers (n_triangle, 3).
        travel: How far the sheet's nodes may well move within a window [m]; the grid is made for it.
        store: Where the cells' lists are kept between runs; nowhere by default.
    """
    corners = np.asarray(vertices, float)[np.asarray(triangles)]
    frame = _frame(corners, travel)
    number = _along_a_curve(corners.mean(1), frame)
    corners = corners[number]
    lists = _kept_lists(corners, frame, store)
    listed, far = as_index(lists["listed"]), None
    if _moves_far(frame, travel):
        wider = _framed(corners.min((0, 1)), corners.max((0, 1)), _FAR * frame.width, _FAR * frame.reach)
        more = _kept_lists(corners, wider, store)
        far = FarCells(
            corner=as_real(wider.corner),
            width=as_real(wider.width),
            reach=as_real(wider.reach),
            start=as_index(listed.size + more["start"]),
            ends=as_index(listed.size + more["ends"]),
            shape=as_index(wider.shape),
        )
        listed = as_index(np.concatenate([lists["listed"], more["listed"]]))
    return SearchGrid(
        corner=as_real(frame.corner),
        width=as_real(frame.width),
        reach=as_real(frame.reach),
        size=as_real(np.ptp(corners, axis=(0, 1)).max()),
        bound=as_real(lists["bound"]),
        start=as_index(lists["start"]),
        ends=as_index(lists["ends"]),
        listed=listed,
        number=as_index(number),
        outlines=as_real(np.hstack([_spheres(corners), _planes(corners)])),
        frames=as_real(_frames(corners)),
        far=far,
        shape=as_index(frame.shape),
    )


def _kept_lists(corners: Array, frame: _Frame, store: Store | None) -> Mapping[str, NDArray[Any]]:
    place = np.array([*frame.corner, frame.width, frame.reach])
    return (store or Store()).arrays("grid in classes", (corners, place, frame.shape), lambda: _lists(corners, frame))


def _lists(corners: Array, frame: _Frame) -> dict[str, NDArray[Any]]:
    """What a grid's cells hold: `bound`, `start`, `ends` and `listed`."""
    from scipy import sparse  # not needed where the lists are kept

    row, triangle, distance = _near_pairs(corners, frame)
    # A matrix with a row for each cell and class: the rows' entries stay in their order.
    size = (CLASSES * int(np.prod(frame.shape)), len(corners))
    rows = sparse.csr_array((np.ones(len(row), bool), (row, triangle)), size)
    return {
        "bound": _distance_bound(row // CLASSES, distance, frame),
        "start": rows.indptr[::CLASSES].astype(np.int32),
        "ends": rows.indptr[1:].astype(np.int32),
        "listed": rows.indices.astype(np.int32),
    }


def _frame(corners: Array, travel: float) -> _Frame:
    """Cells about twice as wide as a typical triangle, within what memory and the mold's own size allow."""
    low, high = corners.min((0, 1)), corners.max((0, 1))
    size = float((high - low).max())
    edge = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    width = min(max(1.2 * edge, size / _FINEST), size / _COARSEST)
    coarse = edge > width
    if coarse:
        width = min(max(width, travel / _REACH["coarse"]), size / _FEWEST)
    while np.prod(_cell_counts(low, high, width)) > _MOST_CELLS:
        width *= 1.1
    reach = _REACH["coarse"] * width if coarse else np.clip(1.5 * travel, *(cells * width for cells in _REACH["fine"]))
    return _framed(low, high, width, float(reach))


def _moves_far(frame: _Frame, travel: float) -> bool:
    """Whether a sheet moves beyond the reach of cells that a fine mold made small."""
    return frame.reach < _REACH["coarse"] * frame.width and 1.5 * travel > frame.reach * (1 + _SLACK)


def _framed(low: Array, high: Array, width: float, reach: float) -> _Frame:
    """Cells of a width [m] about the box (3,), (3,) [m]."""
    shape = _cell_counts(low, high, width)
    return _Frame(0.5 * (low + high) - 0.5 * width * shape, width, reach, shape)


def _cell_counts(low: Array, high: Array, width: float) -> NDArray[np.int64]:
    """One cell more on each side than the mold needs; a rounding error more or less changes nothing."""
    return np.ceil((high - low) / width - 1e-3).astype(int) + 2


def _along_a_curve(places: Array, frame: _Frame) -> NDArray[np.int64]:
    """An order of places (n, 3) in which neighbours are close: that of the bits of their cells, interleaved."""
    index = np.clip((places - frame.corner) / frame.width, 0, frame.shape - 1).astype(np.int64)
    code = np.zeros(len(places), np.int64)
    for bit in range(int(frame.shape.max()).bit_length()):
        for axis in range(3):
            code |= (index[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _frames(corners: Array) -> Array:
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge1, edge2)
    square = np.einsum("ij,ij->i", normal, normal)[:, None]
    duals = np.cross(edge2, normal) / square, np.cross(normal, edge1) / square
    return np.hstack([corners[:, 0], normal / np.sqrt(square), *duals, edge1, edge2])


def _spheres(corners: Array) -> Array:
    middle = corners.mean(1)
    radius = np.linalg.norm(corners - middle[:, None], axis=2).max(1)
    return np.column_stack([middle, radius * (1 + _SLACK)])


def _planes(corners: Array) -> Array:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.column_stack([normal, np.einsum("ij,ij->i", normal, corners[:, 0])])


def _near_pairs(corners: Array, frame: _Frame) -> tuple[NDArray[np.int32], NDArray[np.int32], Array]:
    """All (cell, triangle) closer than the reach, those of each cell in the triangles' order.

    The triangles are taken in pieces no longer than a cell: a large one is then near few cells that it does not
    touch, and its pieces' spheres and its plane bound the distance well.

    Returns:
        CLASSES times the cell plus the class of distance, triangles, and a lower bound on the distance from the
        cell's centre [m].
    """
    pieces, owner = cut(corners, frame.width)
    order = np.argsort(owner, kind="stable")
    owner, spheres, planes = owner[order], _spheres(pieces[order]), _planes(corners)
    # Wide enough for the reach, half a cell's diagonal and the largest piece.
    beside = frame.width * (_HALF_DIAGONAL + _SLACK)
    reach = frame.reach + beside + spheres[:, 3].max()
    wide = int(reach / frame.width + 0.5)
    stencil = np.arange(-wide, wide + 1)

    def pairs(part: slice) -> tuple[NDArray[np.int32], NDArray[np.int32], Array]:
        cell, piece, distance = _stencil_pairs(spheres[part], planes[owner[part]], stencil, frame)
        key = cell * len(corners) + owner[part][piece]
        if len(pieces) > len(corners):
            key, distance = _nearest(key, distance)
        cell, triangle = np.divmod(key, len(corners))
        kind = np.clip(np.ceil((CLASSES / frame.reach) * (distance - beside)) - 1, 0, CLASSES - 1)
        return (CLASSES * cell + kind.astype(np.int64)).astype(np.int32), triangle.astype(np.int32), distance

    # NumPy lets go of the interpreter's lock in long operations.
    with ThreadPoolExecutor(os.cpu_count()) as workers:
        rows, triangles, distances = zip(*workers.map(pairs, _parts(owner, _CHUNK // len(stencil) ** 3)), strict=True)
    return np.concatenate(rows), np.concatenate(triangles), np.concatenate(distances)


def _parts(owner: NDArray[np.int64], size: int) -> list[slice]:
    """Slices of about so many pieces; those of one triangle, which come one after the other, stay together."""
    begin = np.flatnonzero(np.diff(owner, prepend=-1))
    first = begin[np.unique(np.searchsorted(begin, np.arange(0, len(owner), max(1, size))).clip(max=len(begin) - 1))]
    ends = np.append(first[1:], len(owner))
    return [slice(int(a), int(b)) for a, b in zip(first, ends, strict=True)]


def _nearest(key: NDArray[np.int64], distance: Array) -> tuple[NDArray[np.int64], Array]:
    """Each key once, ascending, with its least distance: a triangle's pieces near one cell count as one."""
    order = _sorting(key)
    key, distance = key[order], distance[order]
    begin = np.flatnonzero(np.diff(key, prepend=-1))
    return key[begin], np.minimum.reduceat(distance, begin) if len(begin) else distance


def _sorting(key: NDArray[np.int64]) -> NDArray[np.int64]:
    """What sorts keys (n,) that are not negative, equal ones in their order: numbers sort faster than their places."""
    count = len(key)
    if count == 0 or int(key.max()) >= np.iinfo(np.int64).max // count - 1:
        return np.argsort(key, kind="stable")
    return np.sort(key * count + np.arange(count)) % count


def cut(corners: Array, longest: float) -> tuple[Array, NDArray[np.int64]]:
    """Triangles (n, 3, 3) [m] halved at their longest sides until none is longer, and the triangle each is part of."""
    owner = np.arange(len(corners))
    done, owners = [], []
    while len(corners):
        side = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)
        small = side.max(1) <= longest
        done.append(corners[small])
        owners.append(owner[small])
        corners, owner, side = corners[~small], owner[~small], side[~small]
        turn = (np.argmax(side, axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners, turn[..., None], axis=1), 1, 0)
        middle = 0.5 * (a + b)
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        owner = np.concatenate([owner, owner])
    return np.concatenate(done), np.concatenate(owners)


def _stencil_pairs(
    spheres: Array, planes: Array, stencil: NDArray[np.int64], frame: _Frame
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Cells around pieces (n, 4) that are in reach: cell number, piece, lower bound on the centre's distance [m]."""
    reach = frame.reach + frame.width * (_HALF_DIAGONAL + _SLACK)
    own = np.floor((spheres[:, :3] - frame.corner) / frame.width).astype(int)
    index = own[:, None] + stencil[:, None]
    valid = (index >= 0) & (index < frame.shape)
    center = frame.corner + (own + 0.5) * frame.width
    away = (center - spheres[:, :3])[:, None] + frame.width * stencil[:, None]
    square = np.where(valid, np.square(away), np.inf)
    total = (square[:, :, None, None, 0] + square[:, None, :, None, 1] + square[:, None, None, :, 2]).ravel()
    steps = np.stack(np.meshgrid(stencil, stencil, stencil, indexing="ij"), -1).reshape(-1, 3)
    height = np.einsum("ij,ij->i", planes[:, :3], center) - planes[:, 3]
    height = np.abs(height[:, None] + planes[:, :3] @ (frame.width * steps.T)).ravel()
    farthest = np.repeat(np.square(reach + spheres[:, 3]), len(steps))
    near = np.flatnonzero((total <= farthest) & (height <= reach))
    piece, spot = np.divmod(near, len(steps))
    gap = np.maximum(np.sqrt(total[near]) - spheres[piece, 3], height[near])
    strides = np.array([frame.shape[1] * frame.shape[2], frame.shape[2], 1])
    return (own @ strides)[piece] + (steps @ strides)[spot], piece, gap


def _distance_bound(cell: NDArray[np.integer], distance: Array, frame: _Frame) -> Array:
    """Near the mold from the listed triangles, elsewhere from the distance between cells."""
    from scipy import ndimage  # not needed where the lists are kept

    half_diagonal = _HALF_DIAGONAL * frame.width * (1 + _SLACK)
    nearest = np.full(int(np.prod(frame.shape)), np.inf)
    np.minimum.at(nearest, cell, distance)
    touched = (nearest <= half_diagonal).reshape(frame.shape)
    apart = np.asarray(ndimage.distance_transform_edt(~touched)).ravel()
    far = np.maximum(frame.reach, (apart - np.sqrt(3.0)) * frame.width)
    return np.where(np.isfinite(nearest), np.maximum(nearest - half_diagonal, 0.0), far)
