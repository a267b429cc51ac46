"""Search structure of the mold's triangles: a uniform grid, built once on the host, and look-ups in it.

Space is cut into cubes. Each cell near the mold lists every triangle within a certain distance (the *reach*) of it,
and every cell holds a lower bound on the distance from anywhere inside it to the mold. A node far away is then
dismissed by one look-up, and a near one is compared with the few triangles of its cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxform.core.installation import usable_cores
from jaxform.core.pytree import as_index, as_real, pytree
from jaxform.core.store import Store
from jaxform.kernels.blocks import materialize
from jaxform.mechanics.membrane import dot
from jaxform.mesh.topology import positions_in_rows
from jaxform.mesh.volumes import longest_sides

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Pairs of a uniform grid's cells and the triangles in their reach. On the host, in NumPy, vectorized.
#
# A triangle is taken apart into lines of cells: layer by layer along one axis, line by line along another, and along
# the third its plane says between which cells it is in reach. So a long sliver, an oblique plane and a small triangle
# are all compared with little more than the cells that do list them.

HALF_DIAGONAL = np.sqrt(0.75)  # of a cell of width 1
_CHUNK = 40_000  # pairs of cell and triangle processed together: what a core's cache holds
_LINES = 100_000  # lines of cells laid out together
_ROUNDING = 1e-4  # of a cell, by which a triangle counts as nearer than it is: distances are in float32


class CellFrame(NamedTuple):
    """The cells: lowest corner (3,) [m], width [m], reach [m], number along x, y, z (3,)."""

    corner: Array
    width: float
    reach: float
    shape: Integers


_Pairs = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]  # cells, triangles and distances


class _Local(NamedTuple):
    """Triangles in units of cells, whose middles have whole numbers, each with its axes in an order of its own.

    The first axis is that of the layers, the second that of the lines, and along the third the normal is longest.

    Attributes:
        corners: By corner and axis, (3, 3) arrays (n,).
        plane: The unit normal's components and the place of the plane along it, 4 arrays (n,).
        sides: For each side its unit vector with the place of its beginning along it, and the unit vector in the plane
            to the triangle's inside with the place of the side along that, (3, 2) lists of 4 arrays (n,).
        lengths: Lengths of the sides, 3 arrays (n,).
        shape: Number of cells along each axis, 3 arrays (n,).
        strides: Increment of a cell's number in a step along each axis, 3 arrays (n,).
    """

    corners: list[list[Array]]
    plane: list[Array]
    sides: list[list[list[Array]]]
    lengths: list[Array]
    shape: list[Integers]
    strides: list[Integers]


def pairs_in_reach(corners: Array, frame: CellFrame) -> _Pairs:
    """All pairs of a cell and a triangle (n, 3, 3) [m] that is no farther from any place in the cell than the reach.

    Returns:
        Numbers of cells (m,) and triangles (m,), which ascend, and the distance of each cell's middle (m,) [m].
    """
    far = (frame.reach / frame.width) + HALF_DIAGONAL + _ROUNDING
    parts = np.array_split(np.arange(len(corners)), 1 + len(corners) // 20_000 + usable_cores())

    def pairs(part: Integers) -> _Pairs:
        local = _local(corners[part], frame)
        cell, triangle, distance = _join_pairs([_pairs_of(local, *lines, far) for lines in _lines(local, far)])
        return cell, triangle + np.int32(part[0]), distance * np.float32(frame.width)

    # NumPy releases the interpreter's lock in long operations.
    with ThreadPoolExecutor(usable_cores()) as workers:
        return _join_pairs(list(workers.map(pairs, [part for part in parts if len(part)])))


def _join_pairs(found: list[_Pairs]) -> _Pairs:
    """Cells, triangles and distances of several lists of pairs, one after the other."""
    none = np.zeros(0, np.int32)
    cell, triangle, distance = zip((none, none, np.zeros(0, np.float32)), *found, strict=True)
    return np.concatenate(cell), np.concatenate(triangle), np.concatenate(distance)


def _local(corners: Array, frame: CellFrame) -> _Local:
    places = (corners - frame.corner) / frame.width - 0.5
    steepest = np.argmax(np.abs(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])), axis=1)
    extent = np.ptp(places, axis=1)
    # The layers are along that of the two other axes along which the triangle is longer.
    one, other = (steepest + 1) % 3, (steepest + 2) % 3
    row = np.arange(len(places))
    turn = extent[row, one] < extent[row, other]
    order = np.stack([np.where(turn, other, one), np.where(turn, one, other), steepest], axis=1)
    places = np.take_along_axis(places, order[:, None, :], axis=2)
    # Anew, for an order of axes may turn its sign.
    normal = np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = [places[:, (k + 1) % 3] - places[:, k] for k in range(3)]
    lengths = [np.linalg.norm(one, axis=1) for one in side]
    along = [one / length[:, None] for one, length in zip(side, lengths, strict=True)]
    shape = np.asarray(frame.shape, np.int64)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    return _Local(
        [[np.ascontiguousarray(places[:, k, axis]) for axis in range(3)] for k in range(3)],
        _form(normal, places[:, 0]),
        [[_form(along[k], places[:, k]), _form(np.cross(normal, along[k]), places[:, k])] for k in range(3)],
        lengths,
        list(shape[order].T),
        list(strides[order].T),
    )


def _form(vectors: Array, places: Array) -> list[Array]:
    """The components of vectors (n, 3), and the places (n, 3) along them: 4 arrays (n,)."""
    return [*np.ascontiguousarray(vectors.T), np.einsum("ij,ij->i", vectors, places)]


def _lines(local: _Local, far: float) -> Iterator[tuple[Integers, Integers, Integers]]:
    """Lines of cells that may be in reach: triangle, layer and line, part by part, in the triangles' order."""
    along = np.stack([corner[0] for corner in local.corners])
    first, count = _cells_between(along.min(0), along.max(0), far, local.shape[0])
    for part in _parts(count, _LINES):
        triangle = np.repeat(part, count[part])
        layer = first[triangle] + positions_in_rows(count[part])
        low, high = _within_layer(local, triangle, layer, far)
        begin, lines = _cells_between(low, high, far, local.shape[1][triangle])
        yield np.repeat(triangle, lines), np.repeat(layer, lines), np.repeat(begin, lines) + positions_in_rows(lines)


def _within_layer(local: _Local, triangle: Integers, layer: Integers, far: float) -> tuple[Array, Array]:
    """Intervals (n,), (n,) of triangles along the second axis, as far as they are in reach of a layer's middle."""
    low, high = np.full(len(layer), np.inf), np.full(len(layer), -np.inf)
    for k in range(3):
        begin, end = local.corners[k], local.corners[(k + 1) % 3]
        one, rise = begin[0][triangle] - layer, (end[0] - begin[0])[triangle]
        with np.errstate(divide="ignore", invalid="ignore"):
            enter, leave = (-far - one) / rise, (far - one) / rise
        level = rise == 0
        enter, leave = np.minimum(enter, leave), np.maximum(enter, leave)
        enter = np.where(level, 0.0, np.maximum(enter, 0.0))
        leave = np.where(level, np.where(np.abs(one) <= far, 1.0, -1.0), np.minimum(leave, 1.0))
        for share in (enter, leave):
            place = begin[1][triangle] + share * (end[1] - begin[1])[triangle]
            low = np.where(enter <= leave, np.minimum(low, place), low)
            high = np.where(enter <= leave, np.maximum(high, place), high)
    return low, high


def _cells_between(low: Array, high: Array, far: float, shape: Integers) -> tuple[Integers, Integers]:
    """The first cell (n,) whose middle is that near to an interval, and how many there are (n,)."""
    some = low <= high
    first = np.maximum(np.ceil(np.where(some, low, 0.0) - far), 0.0).astype(np.int64)
    last = np.minimum(np.floor(np.where(some, high, -2.0) + far), shape - 1).astype(np.int64)
    return first, np.where(some, np.maximum(last - first + 1, 0), 0)


def _pairs_of(local: _Local, triangle: Integers, layer: Integers, line: Integers, far: float) -> _Pairs:
    """The cells of lines (n,) that are in reach; distances are in cells."""
    one, two, three, level = (values[triangle] for values in local.plane)
    middle, wide = (level - one * layer - two * line) / three, far / np.abs(three)
    third = np.stack([corner[2] for corner in local.corners])
    low = np.maximum(middle - wide, third.min(0)[triangle] - far)
    high = np.minimum(middle + wide, third.max(0)[triangle] + far)
    first, count = _cells_between(low, high, 0.0, local.shape[2][triangle])
    strides = [stride[triangle] for stride in local.strides]
    number = layer * strides[0] + line * strides[1] + first * strides[2]
    found = []
    for part in _parts(count, _CHUNK):
        owner, times = triangle[part], count[part]
        step = positions_in_rows(times)
        distance = _distances(local, owner, (layer[part], line[part], first[part]), times, step.astype(np.float32))
        near = np.flatnonzero(distance <= far)
        row = np.repeat(part, times)[near]
        cell = (number[row] + step[near] * strides[2][row]).astype(np.int32)
        found.append((cell, triangle[row].astype(np.int32), distance[near]))
    return _join_pairs(found)


def _parts(count: Integers, most: int) -> list[Integers]:
    """Rows with entries, in parts of about so many entries."""
    some = np.flatnonzero(count)
    total = np.cumsum(count[some])
    cuts = np.searchsorted(total, np.arange(most, total[-1] if len(total) else 0, most)) + 1
    return [part for part in np.split(some, cuts) if len(part)]


def _distances(local: _Local, triangle: Integers, begin: tuple[Integers, ...], count: Integers, step: Any) -> Any:
    """Distances (n,) of the middles of cells from triangles, in cells, a little less than they are.

    Args:
        local: The triangles.
        triangle: Triangle of each line of cells (k,).
        begin: The first cell of each line, 3 arrays (k,).
        count: Number of cells of each line (k,).
        step: The number (n,) of each cell along its line.
    """

    def along_lines(form: list[Array]) -> Any:
        """A linear form at the middles; in float32, which is a few times as fast."""
        one, two, three, level = (values[triangle] for values in form)
        at_first = one * begin[0] + two * begin[1] + three * begin[2] - level
        at_first, rise = at_first.astype(np.float32), three.astype(np.float32)
        return np.repeat(at_first, count) + np.repeat(rise, count) * step

    square, inside = np.full(len(step), np.inf, np.float32), np.ones(len(step), bool)
    for (along, inwards), length in zip(local.sides, local.lengths, strict=True):
        place, depth = along_lines(along), along_lines(inwards)
        inside &= depth >= 0
        longest = np.repeat(length[triangle].astype(np.float32), count)
        place -= np.minimum(np.maximum(place, 0), longest)
        square = np.minimum(square, place * place + depth * depth)
    height = along_lines(local.plane)
    return np.sqrt(np.where(inside, 0, square) + height * height) - np.float32(_ROUNDING)


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
        start: Index of the start of each cell's list (n_cell + 1,) in `listed`.
        ends: Ends in each cell's list (n_cell * CLASSES,) of the triangles that are within a quarter of the reach,
            within a half, and so on; the nearer ones come first.
        listed: Rows of the tables below, cell by cell; rows are in an order in which neighbours are close.
        number: Number of the mold's triangle in each row (n_triangle,).
        outlines: For each triangle (n_triangle, 8) its middle and the largest distance from it [m], its unit normal and
            the place of its plane along it [m].
        far: Wider cells; None where the sheet moves no farther than the cells' reach.
        frames: For each triangle (n_triangle, 18) its first vertex D [m], unit normal, the vectors [1/m] whose products
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
        travel: Way that the sheet's nodes may well move within a window [m]; the grid is made for it.
        store: The store that keeps the cells' lists between runs; none by default.
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
    kind = np.float32(CLASSES / frame.reach) * (distance - np.float32(beside))
    kind = np.clip(np.ceil(kind, out=kind), 1, CLASSES, out=kind).astype(np.int8)
    row = CLASSES * cell + (kind - np.int8(1))
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
    long = longest_sides(corners)
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


def _distance_bound(cell: NDArray[np.integer], distance: NDArray[np.floating], frame: CellFrame) -> Array:
    """Near the mold from the listed triangles, elsewhere from the distance between cells."""
    from scipy import ndimage  # not needed where the lists are kept

    half_diagonal = HALF_DIAGONAL * frame.width * (1 + _SLACK)
    nearest = np.full(int(np.prod(frame.shape)), np.inf, distance.dtype)
    np.minimum.at(nearest, cell.astype(np.intp), distance)
    touched = (nearest <= half_diagonal).reshape(frame.shape)
    apart = np.asarray(ndimage.distance_transform_edt(~touched)).ravel()
    far = np.maximum(frame.reach, (apart - np.sqrt(3.0)) * frame.width)
    return np.where(np.isfinite(nearest), np.maximum(nearest - half_diagonal, 0.0), far)


# Cells of points in the mold's search grid, and distances of points from its triangles.


def cell_of(positions: jax.Array, grid: SearchGrid | FarCells, parts: jax.Array | int = 1) -> jax.Array:
    """Cell numbers (n,) of positions (3, n) [m]; outside the grid the nearest cell's, whose bound and list hold too.

    The cells may be cut into so many parts along each axis.
    """
    shape = parts * grid.shape
    place = jnp.floor((positions - grid.corner[:, None]) * (parts / grid.width)).astype(jnp.int32)
    i, j, k = jnp.clip(place, 0, shape[:, None] - 1)
    return (i * shape[1] + j) * shape[2] + k


def cell_bounds(positions: jax.Array, grid: SearchGrid) -> tuple[jax.Array, jax.Array]:
    """Cell numbers and lower bounds on the distance to the mold [m], each (n_node,)."""
    cell = cell_of(positions, grid)
    place = (positions - grid.corner[:, None]) / grid.width
    outside = place - jnp.clip(place, 0.0, grid.shape.astype(place.dtype)[:, None])
    return cell, jnp.maximum(grid.bound[cell], grid.width * jnp.sqrt(dot(outside, outside)))


def distance_bound(points: jax.Array, triangle: jax.Array, grid: SearchGrid) -> jax.Array:
    """Lower bound (n, k) [m] on the distance of points (3, n) from triangles (n, k): their spheres and planes."""
    # Whole rows at once, and once: they are far apart in memory.
    rows = materialize(rows_of_table(grid.outlines, triangle))
    x, y, z = points[:, :, None]
    a, b, c = x - rows[..., 0], y - rows[..., 1], z - rows[..., 2]
    outside = jnp.sqrt(a * a + b * b + c * c) - rows[..., 3]
    height = x * rows[..., 4] + y * rows[..., 5] + z * rows[..., 6] - rows[..., 7]
    return jnp.maximum(outside, jnp.abs(height)) - touch_distance(grid)


def distance(points: jax.Array, frame: jax.Array) -> jax.Array:
    """Distance (n,) [m] of points (3, n) from triangles of frames (n, 18), pair by pair."""
    d, normal, dual1, dual2, edge1, edge2 = frame.T.reshape(6, 3, -1)
    away = points - d
    gamma, delta = dot(away, dual1), dot(away, dual2)
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    rim = jnp.minimum(_to_segment(away, edge1), _to_segment(away, edge2))
    rim = jnp.minimum(rim, _to_segment(away - edge1, edge2 - edge1))
    return jnp.where(inside, jnp.abs(dot(away, normal)), jnp.sqrt(rim))


def _to_segment(away: jax.Array, along: jax.Array) -> jax.Array:
    """Squared distance (n,) [m^2] from segments to points, both from the segments' start."""
    t = jnp.clip(dot(away, along) / dot(along, along), 0.0, 1.0)
    gap = away - t[None] * along
    return dot(gap, gap)


def touch_distance(grid: SearchGrid) -> jax.Array:
    """Distance [m] from a plane within which a node touches it: rounding, relative to the size of the mold."""
    return 64 * jnp.finfo(grid.size.dtype).eps * grid.size


def rows_of_table(table: jax.Array, triangle: jax.Array) -> jax.Array:
    """Gathers rows (..., k) of a table (n, k), as `gather` does entries."""
    return table.at[triangle].get(mode="promise_in_bounds", wrap_negative_indices=False)
