"""Search structure of the mold's triangles: a uniform grid, built once on the host, for the mold does not move.

Space is cut into cubes. Each cell near the mold lists every triangle within a certain distance (the *reach*) of it,
and every cell holds a lower bound on the distance from anywhere inside it to the mold. A node far away is then
dismissed by one look-up, and a near one is compared with the few triangles of its cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.core.pytree import as_index, as_real, pytree
from jaxform.core.store import Store
from jaxform.tools.reach import HALF_DIAGONAL, CellFrame, pairs_in_reach

Array = NDArray[np.float64]

_MOST_CELLS = 2_000_000
_MOST_LISTED = 5_000_000, 60  # entries of all cells' lists, in all or for each triangle, whichever are more
_COARSEST, _FINEST = 32, 256  # cells along the longest side of a mold
_FEWEST = 16  # where a coarse sheet moves far in a window
# In cells: a coarse mold's lists are short and may reach far; a fine one's as far as the sheet moves, within this.
_REACH = {"coarse": 1.5, "fine": (0.75, 1.0)}
_FAR = 3  # how many times as wide the cells for nodes that move far are, and as long their reach
CLASSES = 4  # of distance, in which a cell's list is sorted: a small ball is compared with what is near alone
_SLACK = 1e-6  # relative to a cell, for rounding


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
    number = _space_filling_order(corners.mean(1), frame)
    corners = corners[number]
    lists = _stored_lists(corners, frame, store)
    listed, far = as_index(lists["listed"]), None
    if _moves_far(frame, travel):
        wider = _frame_box(corners.min((0, 1)), corners.max((0, 1)), _FAR * frame.width, _FAR * frame.reach)
        more = _stored_lists(corners, wider, store)
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


def _stored_lists(corners: Array, frame: CellFrame, store: Store | None) -> Mapping[str, NDArray[Any]]:
    place = np.array([*frame.corner, frame.width, frame.reach])
    return (store or Store()).arrays(
        "grid in exact classes", (corners, place, frame.shape), lambda: _lists(corners, frame)
    )


def _lists(corners: Array, frame: CellFrame) -> dict[str, NDArray[Any]]:
    """The contents of a grid's cells: `bound`, `start`, `ends` and `listed`."""
    from scipy import sparse  # not needed where the lists are kept

    cell, triangle, distance = pairs_in_reach(corners, frame)
    beside = frame.width * (HALF_DIAGONAL + _SLACK)
    kind = np.clip(np.ceil((CLASSES / frame.reach) * (distance - beside)) - 1, 0, CLASSES - 1)
    row = CLASSES * cell + kind.astype(np.int64)
    # A matrix with a row for each cell and class: the rows' entries stay in their order.
    size = (CLASSES * int(np.prod(frame.shape)), len(corners))
    rows = sparse.csr_array((np.ones(len(row), bool), (row, triangle)), size)
    return {
        "bound": _distance_bound(cell, distance, frame),
        "start": rows.indptr[::CLASSES].astype(np.int32),
        "ends": rows.indptr[1:].astype(np.int32),
        "listed": rows.indices.astype(np.int32),
    }


def _frame(corners: Array, travel: float) -> CellFrame:
    """Cells about twice as wide as a typical triangle, within what memory and the mold's own size allow."""
    low, high = corners.min((0, 1)), corners.max((0, 1))
    size = float((high - low).max())
    edge = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    width = min(max(1.2 * edge, size / _FINEST), size / _COARSEST)
    long, most = edge > width, _most_listed(len(corners))
    coarse = long and _estimate_listed(corners, width, _REACH["coarse"]) <= most
    if coarse:
        width = min(max(width, travel / _REACH["coarse"]), size / _FEWEST)
    while np.prod(_cell_counts(low, high, width)) > _MOST_CELLS:
        width *= 1.1
    widest = size / (_FEWEST if long else _COARSEST)
    while not coarse and width < widest and _estimate_listed(corners, width, _REACH["fine"][0]) > most:
        width = min(1.1 * width, widest)
    reach = _REACH["coarse"] * width if coarse else np.clip(1.5 * travel, *(cells * width for cells in _REACH["fine"]))
    return _frame_box(low, high, width, float(reach))


def _most_listed(triangle_count: int) -> int:
    """The largest number of entries of the cells' lists."""
    in_all, each = _MOST_LISTED
    return max(in_all, each * triangle_count)


def _estimate_listed(corners: Array, width: float, reach: float) -> float:
    """About how many entries cells of a width [m] list; the reach is in cells.

    Slivers as long as a mold are in reach of very many.
    """
    long = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    beside = 2 * (reach + HALF_DIAGONAL)
    return float(2 * ((long / width + beside) * (area / long / width + beside)).sum())


def _moves_far(frame: CellFrame, travel: float) -> bool:
    """True when a sheet moves beyond the reach of cells that a fine mold made small."""
    return frame.reach < _REACH["coarse"] * frame.width and 1.5 * travel > frame.reach * (1 + _SLACK)


def _frame_box(low: Array, high: Array, width: float, reach: float) -> CellFrame:
    """Cells of a width [m] about the box (3,), (3,) [m]."""
    shape = _cell_counts(low, high, width)
    return CellFrame(0.5 * (low + high) - 0.5 * width * shape, width, reach, shape)


def _cell_counts(low: Array, high: Array, width: float) -> NDArray[np.int64]:
    """One cell more on each side than the mold needs; a rounding error more or less changes nothing."""
    return np.ceil((high - low) / width - 1e-3).astype(int) + 2


def _space_filling_order(places: Array, frame: CellFrame) -> NDArray[np.int64]:
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


def split_long_triangles(corners: Array, longest: float) -> tuple[Array, NDArray[np.int64]]:
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


def _distance_bound(cell: NDArray[np.integer], distance: Array, frame: CellFrame) -> Array:
    """Near the mold from the listed triangles, elsewhere from the distance between cells."""
    from scipy import ndimage  # not needed where the lists are kept

    half_diagonal = HALF_DIAGONAL * frame.width * (1 + _SLACK)
    nearest = np.full(int(np.prod(frame.shape)), np.inf)
    np.minimum.at(nearest, cell, distance)
    touched = (nearest <= half_diagonal).reshape(frame.shape)
    apart = np.asarray(ndimage.distance_transform_edt(~touched)).ravel()
    far = np.maximum(frame.reach, (apart - np.sqrt(3.0)) * frame.width)
    return np.where(np.isfinite(nearest), np.maximum(nearest - half_diagonal, 0.0), far)
