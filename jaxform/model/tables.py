"""What the host builds for a scene: initial geometry, how nodes gather forces, the forest, and counts."""

from __future__ import annotations

import jax
import numpy as np

from jaxform.core.pytree import pytree, static
from jaxform.tools.search import SearchGrid

SHORT_WINDOW, LONG_WINDOW = 64, 256  # steps
RANGE_PER_STEP = 0.1  # of the search grid's reach, that a node passes at most
MOST_COOLING = 1.0  # K, of the sheet in a window


@pytree
class ReferenceGeometry:
    """The initial geometry, component-first.

    Attributes:
        triangles: Node numbers (3, n_element).
        inverse_metric: Inverse of the initial metric (3, n_element) [1/m^2].
        area: Initial area (n_element,) [m^2].
        origin: A point (3,) [m] on every symmetry plane, from which the enclosed volume is counted.
    """

    triangles: jax.Array
    inverse_metric: jax.Array
    area: jax.Array
    origin: jax.Array


@pytree
class ElementPairs:
    """Elements in pairs that share an edge, with which the nodes of both begin.

    Attributes:
        element: The pairs (2, n_pair); -1 for the second of one that is left over.
        pair: The pair that each element (n_element,) is of.
        triangles: Node numbers (3, n_element) in that order.
        inverse_metric: Of the initial metric in that order (3, n_element) [1/m^2].
        orientation: Whether the order is that of the element's normal (n_element,): 1, or -1.
    """

    element: jax.Array
    pair: jax.Array
    triangles: jax.Array
    inverse_metric: jax.Array
    orientation: jax.Array


@pytree
class Assembly:
    """Which corners of which elements a node gathers its force from: four times the element plus the corner.

    Or of which pairs: the ends of the common edge, then the node of the first element that is apart, and the second's.

    Attributes:
        table: (depth, n_node), -1 where there are no more.
        overflow_node, overflow: Nodes (k,) with more corners than the table is deep, and these corners (k,).
        pairs: None where elements are worked out one by one.
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
    """Where the mold is bent.

    Attributes:
        distance: To a bent part of the mold (n_cell,) [m], from the parts of the search grid's cells, x by y by z.
        parts: Into how many parts each cell is cut along each axis.
    """

    distance: jax.Array
    parts: jax.Array


@pytree
class BisectionHierarchy:
    """Every triangle of the mesh bisected beforehand; see `jaxform.mesh.bisection`, which explains the numbering.

    Attributes:
        sheet: Initial geometry of all triangles.
        bound: Largest eigenvalue of each triangle's shape gradients (n_triangle,) [1/m^2].
        heavier: How many times its mass each triangle is given (n_triangle,).
        partner: The other triangle with the same refinement edge (n_triangle,).
        middle: Node in the middle of the refinement edge (n_triangle,), -1 at the deepest level.
        half_edges: (3, n_triangle).
        root_row: For the corners (3, root_count) of the first triangles: which of their node's triangles they are.
        ends: Of the edge that each node is the middle of (2, n_node).
        owner: A triangle that each node is in the middle of the refinement edge of (n_node,); 0 for the first nodes.
        mobility: 1 where a component of a node may move, else 0, (3, n_node).
        bend: Where the mold is bent; None where unused.
        fine_at_once: Triangles (n,) that are bisected when a run begins, ascending, then the largest number; None where
            none are.
        root_count: Triangles at level 0.
        depth: The deepest level.
        first_nodes: Nodes of the mesh before it is refined.
        half_edge_count: Numbers of half edges are below this.
        valence: How many triangles can meet at a node.
        node_room: Room for so many nodes.
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
    node_room: int = static()


@pytree
class Counts:
    """How many there are of what arrays have more room for; see `jaxform.runs.arrays`.

    Attributes:
        elements: Of the mesh before it is refined.
        nodes: Its nodes.
        pairs: Pairs of its elements; None where they are worked out one by one.
    """

    elements: jax.Array
    nodes: jax.Array
    pairs: jax.Array | None = None


@pytree
class SceneBox:
    """What a sheet and its mold lie in at first, and wherever the mold moves.

    Attributes:
        middle: (3,) [m].
        reach: Distance from it [m] along an axis, where a sheet is beyond the box by the longest of its sides.
    """

    middle: jax.Array
    reach: jax.Array


@pytree
class Precomputed:
    """What the host built for a scene; depends on its meshes and limits, not on the numbers to be designed.

    Attributes:
        sheet: Initial geometry.
        assembly: How nodes gather their force.
        bound: Largest eigenvalue of each element's shape gradients (n_element,) [1/m^2], for the stable step.
        mobility: 1 where a component of a node may move, else 0, (3, n_node).
        size: Largest initial coordinate [m].
        box: Of sheet and mold: a sheet that gets far out of it has left its mold; None without one.
        grid: Search structure of the mold, or None.
        forest: What the mesh can be refined to, or None.
        lying: Which nodes (n_node,) lie on the mold when a run begins, and on which of its triangles, as `State.wall`
            has it; None where none do.
        window_count: Number of windows that a run may take.
        planned: How many were planned for what is expected, where more may be met: windows then become longer, so that
            they do. The largest number where enough were planned.
        longest_window: Steps that a window may take at most.
        window_room: Room for so many.
        pairs_per_node: Room for so many pairs of node and mold triangle that come near each other, for each node.
        counts: How many elements and nodes there are; None where arrays are as long as that.
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
    window_room: int = static(default=LONG_WINDOW)
    pairs_per_node: int = static(default=2)
    counts: Counts | None = None
    rim: Rim | None = None
