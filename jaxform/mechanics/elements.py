"""Elements for loops over blocks, sums of their corner forces at nodes, and the nodal fields of a run."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import Halves, PerBlock, entry, materialize, on_cpu, over_blocks, put, split_halves
from jaxform.mechanics.membrane import (
    Metric,
    Vector,
    cross,
    dot,
    edges,
    gather,
    gather_rows,
    gather_sum,
    metric,
    minus,
    vector,
)

_USUAL_ROWS, _USUAL_PAIR_ROWS = 6, 4  # of the shares of a node; all that are looked up without asking
Corners = list[jax.Array]  # component by component, (3 corners, capacity); of pairs (2, capacity)


@pytree
class Elements:
    """The elements that the force is computed for; no derivative is taken with respect to them.

    Arrays over elements have capacity for whole blocks; beyond the elements in use they hold others of area 0.

    Attributes:
        triangles: Places of the nodes (3, capacity).
        inverse_metric: Inverse of the initial metric (3, capacity) [1/m^2].
        area: Initial area (capacity,) [m^2].
        orientation: 1 where the order of the nodes, which starts with the common edge, is that of the element's normal,
            else -1; 0 beyond the elements (capacity,). The first element of a pair is in a block's first half, the
            other in its second. None where elements stand one by one.
        origin: A point (3,) [m] on every symmetry plane, from which the enclosed volume is counted.
        slots: Indices of the corners' shares of each node (depth, place): corner times capacity plus element. Of a pair
            both ends of the common edge share the first row, half by half, and the nodes apart have the second.
        overflow, overflow_into: Further shares (k,), of nodes with more elements than `slots` is deep, and the shares
            of these nodes that they are added to.
        overflow_count: Number of these in use.
        block_count, node_block_count: Blocks of elements, and of nodes, in use.
        row_count: Rows of `slots` in use, of each block of nodes (n_node_block,).
        regions: True for the elements that each of several loads pushes (n_load, capacity); None where one load pushes
            all of them.
    """

    triangles: jax.Array
    inverse_metric: jax.Array
    area: jax.Array
    orientation: jax.Array | None
    origin: jax.Array
    slots: jax.Array
    overflow: jax.Array
    overflow_into: jax.Array
    overflow_count: jax.Array
    block_count: jax.Array
    node_block_count: jax.Array
    row_count: jax.Array
    regions: jax.Array | None = None


def typical_row_count(paired: bool) -> int:
    """The usual number of shares of a node, of elements or of pairs of elements."""
    return _USUAL_PAIR_ROWS if paired else _USUAL_ROWS


GatherTable = tuple[jax.Array, Any]
"""Places of the nodes' shares of corner forces: `slots` and `row_count` of `Elements`, or those of a block."""


def gather_table(elements: Elements) -> GatherTable:
    """The nodes' shares of corner forces, for `over_blocks`."""
    return elements.slots, PerBlock(elements.row_count)


def add_overflow(corners: Corners, elements: Elements) -> Corners:
    """Corner forces, and with them the shares that `slots` has no capacity for: added to others of the same nodes."""
    if elements.overflow.size == 0:
        return corners
    flat = [corner.reshape(-1) for corner in corners]

    def add(k: jax.Array, flat: Corners) -> Corners:
        share, into = entry(elements.overflow, k), entry(elements.overflow_into, k)
        # All is read before anything is written (docs/explanation/kernels.md).
        sums = materialize([entry(corner, share) + entry(corner, into) for corner in flat])
        return [put(corner, sum_[None], into) for corner, sum_ in zip(flat, sums, strict=True)]

    if on_cpu():
        flat = jax.lax.fori_loop(0, elements.overflow_count, add, flat)
    else:
        used = jnp.arange(elements.overflow.size) < elements.overflow_count
        flat = [
            corner.at[elements.overflow_into].add(jnp.where(used, corner[elements.overflow], 0.0)) for corner in flat
        ]
    return [new.reshape(corner.shape) for new, corner in zip(flat, corners, strict=True)]


def gather_shares(corners: Corners, table: GatherTable) -> list[jax.Array]:
    """Sum (n,) at nodes of their `own` shares of corner forces, component by component."""
    flat, (slots, row_count) = [corner.reshape(-1) for corner in corners], table

    def add(k: jax.Array, totals: list[jax.Array]) -> list[jax.Array]:
        return [total + gather(corner, slots[k]) for total, corner in zip(totals, flat, strict=True)]

    usual = typical_row_count(len(corners[0]) == 2)
    totals = gather_sum(flat, slots[:usual])
    if len(slots) > usual:
        # Few nodes have more, and they are packed together.
        totals = jax.lax.fori_loop(usual, row_count, add, totals)
    return totals


def nodal_sum(corners: Corners, elements: Elements) -> jax.Array:
    """Sum of the corners' shares at the nodes in use (3, place), 0 at the others."""

    def compute_block(table: GatherTable) -> Any:
        return [gather_shares(corners, table)], []

    into = [jnp.zeros((3, elements.slots.shape[1]), corners[0].dtype)]
    (nodal,), _ = over_blocks(compute_block, elements.node_block_count, (gather_table(elements),), into)
    return nodal


def map_elements(
    work: Callable[..., Any], elements: Elements, more: tuple[Any, ...], into: list[jax.Array], sums: int = 1
) -> Any:
    """Rows and sums of a pass over the blocks of elements in use; `work` gets their geometry and `more`."""
    return over_blocks(work, elements.block_count, (element_block(elements), *more), into, sums=sums)


def allocate_corner_forces(positions: jax.Array, elements: Elements) -> Corners:
    """Capacity for corner forces, for elements whose nodes are at positions (3, place)."""
    shape = 3 if elements.orientation is None else 2, elements.area.size
    return [jnp.zeros(shape, positions.dtype) for _ in range(3)]


class ElementBlock(NamedTuple):
    """The elements of a block; fields as in `Elements`."""

    triangles: jax.Array
    inverse_metric: jax.Array
    area: jax.Array
    orientation: jax.Array | None
    regions: jax.Array | None


def element_block(elements: Elements) -> ElementBlock:
    """The element arrays that a pass over the elements reads."""
    own = elements.triangles, elements.inverse_metric, elements.area, elements.orientation
    return ElementBlock(*own, elements.regions)


def on_elements(values: jax.Array, regions: jax.Array | None) -> jax.Array:
    """A number of the load on elements (n,): that of the whole sheet, or the sum of those (n_load,) of its regions."""
    if regions is None:
        return values
    return functools.reduce(jnp.add, [jnp.where(own, values[k], 0.0) for k, own in enumerate(regions)])


def by_region(values: jax.Array, regions: jax.Array | None) -> list[jax.Array]:
    """Values of elements (n,) to be summed up: for the whole sheet, or for each region, 0 outside of it."""
    return [values] if regions is None else [jnp.where(own, values, 0.0) for own in regions]


def sum_regions(sums: Sequence[jax.Array], regions: jax.Array | None) -> jax.Array:
    """The sums of `by_region` over all elements, as one number or (n_load,)."""
    return sums[0] if regions is None else jnp.stack(sums)


def region_count(regions: jax.Array | None) -> int:
    """The number of sums of `by_region`."""
    return 1 if regions is None else len(regions)


EdgeVectors = tuple[Vector, Vector, Vector]
"""A nodal vector field at elements: at the first node, and differences along both edges; three (n,) each."""


def edge_vectors(block: ElementBlock, *nodal: Vector) -> list[EdgeVectors]:
    """The edge vectors of several nodal fields at once, looked up together and materialized for all uses."""
    rows = [row for values in nodal for row in values]
    places = list(block.triangles)
    if block.orientation is not None:
        # Both elements of a pair have the nodes of the common edge.
        places[:2] = [split_halves(nodes).first for nodes in places[:2]]
    corners = [gather_rows(rows, nodes) for nodes in places]

    def at_elements(first: Vector, second: Vector, third: Vector) -> EdgeVectors:
        edge1 = minus(second, first)
        if block.orientation is not None:
            first, edge1 = (materialize(_duplicate_halves(v)) for v in materialize((first, edge1)))
        edge1, edge2 = materialize((edge1, minus(third, first)))
        return first, edge1, edge2

    return [at_elements(*(vector(corner[k : k + 3]) for corner in corners)) for k in range(0, len(rows), 3)]


def _duplicate_halves(v: Vector) -> Vector:
    """A vector (n / 2,) that both elements of a pair share, repeated for each of them."""
    return vector(Halves(x, x).concatenate() for x in v)


def combine_pairs(corners: Sequence[Vector], block: ElementBlock) -> list[Any]:
    """Corner forces, component by component; of a pair's elements they are summed up at the common edge's ends."""
    if block.orientation is None:
        return list(corners)

    def sum_halves(part: jax.Array) -> jax.Array:
        both = split_halves(part)
        return both.first + both.second

    # Kept, for they are cut into halves.
    ends = materialize([(first, second) for first, second, _ in corners])
    return [(Halves(*map(sum_halves, two)), third) for two, (_, _, third) in zip(ends, corners, strict=True)]


def element_metrics(positions: jax.Array, elements: Elements) -> tuple[Metric, Metric]:
    """Present metric and inverse of the initial one of all elements (capacity,), of nodes at positions (3, place).

    Unused elements have the metrics of unstrained ones, so that derivatives stay finite.
    """
    _, edge1, edge2 = edges(positions, elements.triangles)
    return masked_metrics(elements.area > 0.0, metric(edge1, edge2), elements.inverse_metric)


def masked_metrics(there: jax.Array, g: Metric, inverse: jax.Array) -> tuple[Metric, Metric]:
    """Present metric and inverse of the initial one of the elements (n,) that exist; the others are unstrained."""

    def safe(g: Metric | jax.Array) -> Metric:
        a, b, c = (jnp.where(there, part, unit) for part, unit in zip(g, (1.0, 0.0, 1.0), strict=True))
        return a, b, c

    return safe(g), safe(inverse)


def element_normals(sides: EdgeVectors, block: ElementBlock) -> Vector:
    """Normals (n,) of twice the elements' present area [m^2], 0 at unused places; materialized for all their uses."""
    _, edge1, edge2 = sides
    normal = cross(edge1, edge2)
    if block.orientation is not None:
        return materialize(vector(block.orientation * x for x in normal))
    return materialize(vector(jnp.where(block.area > 0.0, x, 0.0) for x in normal))


def orient(v: Vector, block: ElementBlock) -> Vector:
    """A change (n,) of the cross product of an element's sides, oriented as its normal; unused places included."""
    return v if block.orientation is None else vector(block.orientation * x for x in v)


def usage_factor(area: jax.Array) -> jax.Array:
    """1 where an element (n,) is in use, else 0."""
    return jnp.where(area > 0.0, 1.0, 0.0).astype(area.dtype)


# The nodal fields of a run, each declared once with how it passes from one list of nodes to another.


class FieldRule(NamedTuple):
    """Rule for transferring a nodal field from one list of nodes to another.

    Attributes:
        smooth: True if it carries a derivative.
        beyond: Its value at places where there is no node; None where any will do.
        absent: Its value in a result at nodes that do not exist; None where the result has their initial value.
    """

    smooth: bool = False
    beyond: Any = None
    absent: Any = None


@pytree
class Nodes:
    """Nodal fields, in the mesh's order or in the packed one of `active_set.ActiveSet`.

    Attributes:
        positions: (3, n_node) [m]; inside a window's loop row by row, where no derivative is taken.
        velocities: (3, n_node) [m/s], half a step behind the positions.
        stuck: True for nodes that are clamped or stick to a tool (n_node,).
        contact_time: Time of a node's contact with a tool (n_node,) [s]; -1 where free, 0 where clamped.
        wall: Contact triangle (n_node,): one more than the number of the tool's triangle, negative where the node came
            from the far side of its normal; 0 without contact.
        tool: Number of the tool of the contact, or of the last one (n_node,), as in `Scene.surfaces`; None with one
            surface at most.
        temperature: Temperature of the sheet (n_node,) [degC] in the middle of the window; None where no contact law
            needs it.
        slip: Slip distance so far (n_node,) [m]; None where no node can slide.
        mode: Mode of the highest frequency (3, n_node); None where it is not computed.
        fields: The scene's own, by name (n_node,).
    """

    positions: Any = dataclasses.field(metadata={"rule": FieldRule(smooth=True)})
    velocities: jax.Array = dataclasses.field(metadata={"rule": FieldRule(smooth=True, beyond=0.0, absent=0.0)})
    stuck: jax.Array = dataclasses.field(metadata={"rule": FieldRule(beyond=True, absent=False)})
    contact_time: jax.Array = dataclasses.field(metadata={"rule": FieldRule(smooth=True, absent=-1.0)})
    wall: jax.Array = dataclasses.field(metadata={"rule": FieldRule(beyond=0, absent=0)})
    mode: jax.Array | None = dataclasses.field(metadata={"rule": FieldRule()})
    fields: dict[str, jax.Array] = dataclasses.field(metadata={"rule": FieldRule(smooth=True, absent=0.0)})
    tool: jax.Array | None = dataclasses.field(default=None, metadata={"rule": FieldRule(beyond=0, absent=-1)})
    temperature: jax.Array | None = dataclasses.field(
        default=None, metadata={"rule": FieldRule(smooth=True, beyond=0.0, absent=0.0)}
    )
    slip: jax.Array | None = dataclasses.field(
        default=None, metadata={"rule": FieldRule(smooth=True, beyond=0.0, absent=0.0)}
    )

    def map_fields(self, function: Callable[[Any, FieldRule], Any]) -> Nodes:
        """The nodes with a function applied to each field and its rule."""
        made = {
            part.name: jax.tree.map(lambda values, rule=part.metadata["rule"]: function(values, rule), values)
            for part in dataclasses.fields(self)
            for values in [getattr(self, part.name)]
        }
        return dataclasses.replace(self, **made)

    def contact_fields(self) -> Nodes:
        """The fields that contact uses: all but the mode and the scene's own fields."""
        return dataclasses.replace(self, mode=None, fields={})

    def pad(self, count: int) -> Nodes:
        """The nodes with capacity for `count` of them."""

        def pad_field(values: jax.Array, rule: FieldRule) -> jax.Array:
            shape = *values.shape[:-1], count - values.shape[-1]
            return jnp.concatenate([values, jnp.full(shape, rule.beyond or 0, values.dtype)], axis=-1)

        return self.map_fields(pad_field)


def highest_speed(velocities: jax.Array, blocks: jax.Array) -> jax.Array:
    """The highest speed [m/s] of nodes with velocities (3, n_node) in `blocks` blocks; not differentiable."""
    _, (square,) = over_blocks(lambda v: ([], [dot(v, v)]), blocks, (velocities,), [], most=1)
    return jnp.sqrt(square)
