"""Data that the host builds for a scene: initial geometry, assembly of forces, the forest, and counts."""

from __future__ import annotations

import jax
import numpy as np

from jaxform.core.pytree import pytree, static
from jaxform.tools.search import SearchGrid

SHORT_WINDOW, LONG_WINDOW = 64, 256  # steps
RANGE_PER_STEP = 0.1  # of the search grid's reach, that a node passes at most
MOST_COOLING = 1.0  # K, of the sheet in a window
SLACK = 1e-3  # of a step: less is rounding
UNDAMPED = 0.45  # of the step, where nothing damps: nearer the limit, fast modes gain energy (docs/stability.md)


@pytree
class ReferenceGeometry:
    """The initial geometry, component-first.

    Attributes:
        triangles: Node numbers (3, n_element).
        inverse_metric: Inverse of the initial metric (3, n_element) [1/m^2].
        area: Initial area (n_element,) [m^2].
        origin: A point (3,) [m] on every symmetry plane, from which the enclosed volume is counted.
        regions: True for the elements that each of several loads pushes (n_load, n_element); None where one load pushes
            the whole sheet.
    """

    triangles: jax.Array
    inverse_metric: jax.Array
    area: jax.Array
    origin: jax.Array
    regions: jax.Array | None = None


@pytree
class ElementPairs:
    """Pairs of elements that share an edge; the nodes of both elements start with its ends.

    Attributes:
        element: The pairs (2, n_pair); -1 for the second of one that is left over.
        pair: The pair of each element (n_element,).
        triangles: Node numbers (3, n_element) in that order.
        inverse_metric: Inverse of the initial metric in that order (3, n_element) [1/m^2].
        orientation: 1 where the order is that of the element's normal, else -1 (n_element,).
    """

    element: jax.Array
    pair: jax.Array
    triangles: jax.Array
    inverse_metric: jax.Array
    orientation: jax.Array


@pytree
class Assembly:
    """The element corners from which each node gathers its force: four times the element plus the corner.

    Or the corners of pairs: the ends of the common edge, then the node of the first element that is apart,
    and the second's.

    Attributes:
        table: Corners of each node (depth, n_node), -1 where there are no more.
        overflow_node, overflow: Nodes (k,) with more corners than the table is deep, and these corners (k,).
        pairs: Pairs of elements; None where elements are computed one by one.
    """

    table: jax.Array
    overflow_node: jax.Array
    overflow: jax.Array
    pairs: ElementPairs | None = None


@pytree
class Rim:
    """Edges of a rim that moves so that the enclosed volume is not all that the sheet sweeps.

    Attributes:
        ends: Their nodes (2, n_edge), in the sense of the element's; one node twice beyond those there are.
        triangle: The triangle of the forest that each is a side of (n_edge,); None without one.
    """

    ends: jax.Array
    triangle: jax.Array | None


@pytree
class Bend:
    """Distance to the bent parts of the mold.

    Attributes:
        distance: Distance (n_cell,) [m] to a bent part, from the parts of the search grid's cells, x by y by z.
        parts: Number of parts into which each cell is cut along each axis.
    """

    distance: jax.Array
    parts: jax.Array


@pytree
class BisectionHierarchy:
    """Every triangle of the mesh bisected beforehand; see `jaxform.mesh.bisection`, which explains the numbering.

    Attributes:
        sheet: Initial geometry of all triangles.
        bound: Largest eigenvalue of each triangle's shape gradients (n_triangle,) [1/m^2].
        mass_scale: Mass scaling factor of each triangle (n_triangle,).
        partner: The other triangle with the same refinement edge (n_triangle,).
        middle: Node in the middle of the refinement edge (n_triangle,), -1 at the deepest level.
        half_edges: Numbers of the sides from each corner to the next (3, n_triangle).
        root_row: For the corners (3, root_count) of the first triangles: their index among their node's triangles.
        ends: End nodes (2, n_node) of the edge of which each node is the middle.
        owner: A triangle (n_node,) whose refinement edge has the node in its middle; 0 for the first nodes.
        mobility: 1 where a component of a node may move, else 0, (3, n_node).
        bend: Distance to bent parts of the mold; None where unused.
        fine_at_once: Triangles (n,) that are bisected at the start of a run, ascending, then the largest number; None
            where none are.
        root_count: Triangles at level 0.
        depth: The deepest level.
        first_nodes: Nodes of the mesh before it is refined.
        half_edge_count: Numbers of half edges are below this.
        valence: Largest number of triangles that can meet at a node.
        node_capacity: Capacity for nodes.
    """

    sheet: ReferenceGeometry
    bound: jax.Array
    mass_scale: jax.Array
    partner: jax.Array
    middle: jax.Array
    half_edges: jax.Array
    root_row: jax.Array
    ends: jax.Array
    owner: jax.Array
    mobility: jax.Array
    bend: Bend | None
    fine_at_once: jax.Array | None
    root_count: int = static()
    depth: int = static()
    first_nodes: int = static()
    half_edge_count: int = static()
    valence: int = static()
    node_capacity: int = static()


@pytree
class Counts:
    """Numbers of used entries in arrays with a larger capacity; see `jaxform.runs.arrays`.

    Attributes:
        elements: Elements of the mesh before it is refined.
        nodes: Nodes of that mesh.
        pairs: Pairs of its elements; None where elements are computed one by one.
    """

    elements: jax.Array
    nodes: jax.Array
    pairs: jax.Array | None = None


@pytree
class SceneBox:
    """Bounding box of the initial sheet, and of its mold wherever that moves.

    Attributes:
        middle: Middle of the box (3,) [m].
        reach: Distance from the middle [m] along an axis at which a sheet is beyond the box by its longest side.
    """

    middle: jax.Array
    reach: jax.Array


@pytree
class Precomputed:
    """Data that the host built for a scene; it depends on meshes and limits, not on the numbers to be designed.

    Attributes:
        sheet: Initial geometry.
        assembly: Assembly of the nodal forces.
        bound: Largest eigenvalue of each element's shape gradients (n_element,) [1/m^2], for the stable step.
        mobility: 1 where a component of a node may move, else 0, (3, n_node).
        size: Largest initial coordinate [m].
        box: Box of sheet and mold: a sheet far outside of it has left its mold; None without a mold.
        grid: Search structure of the mold, or None.
        tool_grids: Those of the other tools.
        neighbors: For the mold and the tools in their order, the triangles (n_triangle, 3) beside each side of a
            triangle, signed and counted from 1 as in `Nodes.wall`; empty where all of them stick.
        edges: For the mold and the tools in their order, the sharp edges (4, n_edge) at which sides of elements are
            held: the vertices at their ends, then the third corner of both faces. Empty where sides are not held.
        initial_tool: The number (n_node,) of the surface that nodes touch at the start; None with a single surface.
        forest: Hierarchy that the mesh can be refined to, or None.
        initial_contact: Mold triangles (n_node,) that nodes touch at the start of a run, signed as in `Nodes.wall`;
            None where there is no contact.
        window_count: Number of windows that a run may take.
        planned: Number of windows planned for the expected stretch, where a larger one may occur: windows then become
            longer, so that they suffice. The largest number where enough were planned.
        longest_window: Largest number of steps of a window.
        step_capacity: Capacity of a window, in steps.
        pairs_per_node: Capacity per node for pairs of node and mold triangle that come near each other.
        counts: Numbers of elements and nodes; None where arrays have exactly these lengths.
        rim: Edges of rims that move; None where every rim is clamped or stays on a symmetry plane.
    """

    sheet: ReferenceGeometry
    assembly: Assembly
    bound: jax.Array
    mobility: jax.Array
    size: jax.Array
    box: SceneBox | None
    grid: SearchGrid | None
    forest: BisectionHierarchy | None
    initial_contact: jax.Array | None
    longest_window: np.int32 | jax.Array
    planned: np.int32 | jax.Array
    window_count: int = static()
    step_capacity: int = static(default=LONG_WINDOW)
    pairs_per_node: int = static(default=2)
    counts: Counts | None = None
    rim: Rim | None = None
    tool_grids: tuple[SearchGrid, ...] = ()
    neighbors: tuple[jax.Array, ...] = ()
    initial_tool: jax.Array | None = None
    edges: tuple[jax.Array, ...] = ()
