"""The simulation model: `Scene` and its parts, and their validation.

A scene is a pytree. Every number in it is a leaf that can be designed; every choice (which law, is there a mold) is
static. What the host must build from it (reference geometry, search structure, number of windows) is built once by
`build_scene` and travels with the scene as `scene.tables`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.pytree import abbreviate, as_index, as_real, pytree, row_count, static
from jaxform.core.ranges import MOST_STEPS, RENAMED, as_numbers, check, check_one, current_keys
from jaxform.loads import Loading, RegionalLoad
from jaxform.materials import Cooling, Law
from jaxform.mesh import volumes
from jaxform.model.field import Field
from jaxform.model.part import Part
from jaxform.model.tables import BisectionHierarchy, Precomputed
from jaxform.tools.mold import Mold, Motion, ToolFrame
from jaxform.tools.surface_walk import ContactSurface


@pytree
class Parison:
    """The initial sheet or tube.

    Attributes:
        positions: Initial node positions (n_node, 3) [m]; with refinement those of the whole forest, the mesh's first.
        triangles: Node numbers (n_element, 3); pressure acts along their normals (right-hand rule).
        thickness: Initial thickness at the nodes (n_node,) [m].
        clamped: Nodes that the clamp holds (n_node,): they do not move, as long as it is not opened.
        fixed: Components that never move (n_node, 3), on symmetry planes.
        temperature: Initial temperature at the nodes (n_node,) [degC]; None where nothing needs it.
        pre_stretch: Stretches along x and y (2,) that the flat sheet has in its initial positions; its thickness is
            that before. None where the initial sheet is free of stress.
        clamp_until: Time [s] at which the clamp opens, so that the clamped nodes are free from then on; None where it
            holds them to the end.
        guided: Axes (0 to 2) along which nodes are fixed in planes that are no planes of symmetry.
    """

    positions: jax.Array
    triangles: jax.Array
    thickness: jax.Array
    clamped: jax.Array
    fixed: jax.Array
    temperature: jax.Array | None = None
    pre_stretch: jax.Array | None = None
    clamp_until: jax.Array | None = None
    guided: tuple[int, ...] = static(default=())

    def remove_pre_stretch(self, positions: ArrayLike) -> np.ndarray:
        """Positions (n, 3) [m] of initial positions (n, 3) [m] before the pre-stretch; on the host."""
        places = np.asarray(positions, float)
        return places if self.pre_stretch is None else places / np.append(np.asarray(self.pre_stretch, float), 1.0)


@pytree
class Solver:
    """Options of the time integration.

    Attributes:
        end_time: End of the simulation [s].
        damping: Mass-proportional damping [1/s], rho h0 (a + damping v) = f; None leaves the term out.
        gravity: Acceleration of gravity (3,) [m/s^2]; None leaves the term out.
        safety: Fraction of the stable step that is taken.
        skip_stuck: True if elements with all nodes in contact are removed from the active set.
        skip_far: True if contact is tested only for nodes that can reach the mold within a window.
        end_early: True if the run ends when nothing can move any more.
        sharp_step: True if the stable step is computed by Lanczos' method; else it is bounded element by element.
        quasi_static: True if the process is meant to be slow; there is a warning if inertia or damping affects the
            wall.
        self_contact: True if films stick to each other that meet back to back in a fold, a web.
        edge_contact: True if sides of elements are held at sharp edges of tools that they would pass between two nodes.
        smooth_landing: True if nodes land on curved paths and stop at the time of impact, not at the end of a step.
            With short steps (a safety of 0.6 or less) derivatives of a run then follow the trend of its results.
        max_steps: Largest number of steps of `run`.
    """

    end_time: jax.Array
    damping: jax.Array | None = None
    gravity: jax.Array | None = None
    safety: jax.Array | float = 0.9
    skip_stuck: bool = static(default=True)
    skip_far: bool = static(default=True)
    end_early: bool = static(default=True)
    sharp_step: bool = static(default=True)
    quasi_static: bool = static(default=False)
    self_contact: bool = static(default=False)
    edge_contact: bool = static(default=False)
    smooth_landing: bool = static(default=False)
    max_steps: int = static(default=MOST_STEPS)


@pytree
class Refinement:
    """Adaptive refinement: elements are bisected at window boundaries.

    Attributes:
        angle: Largest angle [degrees] of an element's and its neighbours' normals to their mean (paper, 3.3).
        min_area: Smallest initial area of a part [m^2].
        interval: Steps between two checks of the mesh, rounded up to whole windows.
        max_level: Elements at this level are bisected only for conformity with their neighbours.
        base_level: Elements near a bent part of the mold are bisected to this level before they touch it.
        proximity_factor: Distance that counts as near, as a multiple of the element's longest side.
        jump: Largest ratio, less 1, of neighbours' thicknesses; None leaves it out.
        mass_scaling_levels: Number of the finest levels whose mass is scaled, so that they do not shorten the step.
        at_rest: True if new nodes start at rest where they are closer to the mold than half the length of their edge,
            or the reach of the search grid; above one length they have the velocity of their edge, in between a
            fraction of it. Without it all new nodes have the velocity of their edge, which conserves the momentum, but
            makes a replay discontinuous where a node comes into contact close to a window boundary.
        elements: Capacity: the largest number of elements.
    """

    angle: jax.Array
    min_area: jax.Array
    jump: jax.Array | None
    proximity_factor: jax.Array
    interval: np.int32 | jax.Array
    max_level: np.int32 | jax.Array
    base_level: np.int32 | jax.Array
    mass_scaling_levels: np.int32 | jax.Array
    at_rest: bool = static()
    elements: int = static()

    @property
    def deepest(self) -> int:
        """The highest level to which an element is bisected for its own shape."""
        return int(max(self.max_level, self.base_level))


Adaptivity = tuple[Refinement, BisectionHierarchy]
"""Adaptive refinement: its limits, and the hierarchy of triangles that the mesh can be refined to."""


@pytree
class Scene:
    """A scene to simulate, built by `build_scene` or `load`.

    Attributes:
        parison: The sheet.
        material: The material model.
        pressure: The loading.
        solver: Options of the time integration.
        mold: The mold; None for free inflation.
        refinement: Adaptive refinement; None for a fixed mesh.
        tables: Precomputed data, built on the host.
        name: Name of the scene.
        fields: User-defined nodal fields, by name.
        cooling: Cooling of the sheet; None where it keeps its temperature.
        fill: True if the mold is to be filled: the status of a run that leaves a gap then has `UNFILLED`.
        part: The part of the formed sheet; None where all of it is the part.
        tools: Tools besides the mold, such as plugs.
    """

    parison: Parison
    material: Law
    pressure: Any  # a `Loading`; its numbers are those of its class
    solver: Solver
    mold: Mold | None
    refinement: Refinement | None
    tables: Precomputed
    name: str = static(default="scene")
    fields: dict[str, Field] = dataclasses.field(default_factory=dict)
    cooling: Cooling | None = None
    fill: bool = static(default=True)
    part: Part | None = None
    tools: tuple[Mold, ...] = ()

    def __repr__(self) -> str:
        """The name, the size of the mesh and the kinds of the parts, in one line."""
        kinds = type(self.material).__name__, type(self.pressure).__name__
        parts = [f"{row_count(self.parison.triangles)} elements", *kinds]
        parts += [] if self.mold is None else [f"mold of {row_count(self.mold.triangles)} triangles"]
        parts += [f"tool {tool.name!r} of {row_count(tool.triangles)} triangles" for tool in self.tools]
        parts += [] if self.refinement is None else [f"refined up to {self.refinement.elements} elements"]
        parts += [f"end_time={abbreviate(self.solver.end_time)}"]
        return f"Scene({self.name!r}: {', '.join(parts)})"

    @property
    def law(self) -> Law:
        """The material at the sheet's initial temperature, with the numbers that this shifts at each node."""
        return self.material.at(self.parison.temperature)

    @property
    def surfaces(self) -> tuple[ContactSurface, ...]:
        """The surfaces that the sheet can touch: the mold, where there is one, then the tools in their order."""
        tables = self.tables
        molds = [] if self.mold is None or tables.grid is None else [(self.mold, tables.grid)]
        pairs = [*molds, *zip(self.tools, tables.tool_grids, strict=True)]
        neighbors = tables.neighbors or (None,) * len(pairs)
        return tuple(ContactSurface(*pair, own) for pair, own in zip(pairs, neighbors, strict=True))

    @property
    def moves(self) -> bool:
        """True where a tool moves."""
        return any(surface.mold.motion is not None for surface in self.surfaces)

    @property
    def slides(self) -> bool:
        """True where nodes may lie on a tool without sticking to it."""
        return any(not surface.mold.contact.sticks for surface in self.surfaces)

    @property
    def lands_smoothly(self) -> bool:
        """True where nodes land on curved paths, at their own time within a step."""
        return self.solver.smooth_landing and bool(self.surfaces)

    @property
    def moving_tools(self) -> tuple[int, ...]:
        """Numbers of the surfaces that move, where there are several: the work of each is counted by itself."""
        moving = [number for number, surface in enumerate(self.surfaces) if surface.mold.motion is not None]
        return tuple(moving) if len(moving) > 1 else ()

    @property
    def rubbing_tools(self) -> tuple[int, ...]:
        """Numbers of the surfaces with friction, where there are several: the loss on each is counted by itself."""
        rubbing = [number for number, surface in enumerate(self.surfaces) if surface.mold.contact.has_friction]
        return tuple(rubbing) if len(rubbing) > 1 else ()

    def frames(self, begin: jax.Array, end: jax.Array) -> tuple[ToolFrame | None, ...]:
        """The frames of the surfaces in a step from one time to another [s]; None of those at rest."""
        motions = [surface.mold.motion for surface in self.surfaces]
        return tuple(None if motion is None else motion.frame(begin, end) for motion in motions)

    @property
    def tool_warmth(self) -> tuple[tuple[jax.Array, jax.Array], ...] | None:
        """Heat transfer coefficient [W/(m^2 K)] and temperature [degC] of each surface; None where there is only one.

        With a single surface, the mold cools the sheet by the parameters of `cooling`.
        """
        tools, cooling = [surface.mold for surface in self.surfaces], self.cooling
        own = any(tool.temperature is not None or tool.heat_transfer is not None for tool in tools)
        if cooling is None or (len(tools) < 2 and not own):
            return None
        return tuple(
            (
                cooling.mold if tool.heat_transfer is None else tool.heat_transfer,
                cooling.mold_temperature if tool.temperature is None else tool.temperature,
            )
            for tool in tools
        )

    @property
    def adaptivity(self) -> Adaptivity | None:
        """Limits and hierarchy of the adaptive refinement; None for a fixed mesh."""
        limits, forest = self.refinement, self.tables.forest
        return None if limits is None or forest is None else (limits, forest)

    @property
    def first_nodes(self) -> int:
        """Nodes of the mesh before it is refined."""
        forest = self.tables.forest
        return len(self.parison.positions) if forest is None else forest.first_nodes

    @property
    def packs_moving(self) -> bool:
        """True where windows step only the nodes and elements that can still move."""
        sticks = any(surface.mold.contact.sticks for surface in self.surfaces)
        return sticks and self.solver.skip_stuck and self.rests

    @property
    def rests(self) -> bool:
        """True if nothing changes any more at nodes that stick to tools at rest: no field of the scene does."""
        return all(field.rests for field in self.fields.values())

    @property
    def motion(self) -> Motion | None:
        """The motion of the mold; None where it rests, or there is none."""
        return None if self.mold is None else self.mold.motion

    def pushes(self) -> np.ndarray:
        """Sampled pressures [Pa] of the process, which show the magnitude and sign of its push; on the host."""
        return sample_pressures(self.pressure, self.solver, self.parison, self.material)

    def strongest_push(self) -> float:
        """The pressure of the largest magnitude [Pa], with its sign; on the host."""
        knots = self.pushes()
        return float(knots[np.argmax(np.abs(knots))])

    @property
    def stiffens(self) -> bool:
        """True where the moduli change during a run, since the sheet cools."""
        shift = self.material.shift
        return self.cooling is not None and shift is not None and shift.stiffens

    @property
    def reversible(self) -> bool:
        """True if the steps can be inverted, as the reversed scheme does."""
        return not self.irreversible_parts

    @property
    def irreversible_parts(self) -> list[str]:
        """Descriptions of the parts whose steps cannot be inverted; none if the scene is reversible."""
        parts = {
            "it has user-defined fields": bool(self.fields),
            "its material has Prony terms": self.material.viscous is not None,
            "the sheet cools": self.cooling is not None,
            "its pressure follows the enclosed volume": self.pressure.follows_volume,
            "the mold moves": self.motion is not None,
            "nodes slide on the mold": self.mold is not None and not self.mold.contact.sticks,
            "it has tools besides the mold": bool(self.tools),
            "sides are held at edges of its tools": bool(self.tables.edges),
        }
        return [reason for reason, holds in parts.items() if holds]


def sample_pressures(pressure: Loading, solver: Solver, parison: Parison, material: Law) -> np.ndarray:
    """The pressures [Pa] of `Scene.pushes`, from the parts of a scene; that of the sheet's weight is added."""
    volume: Any = enclosed_volumes(pressure, parison) if pressure.follows_volume else 0.0
    pushes = pressure.pushes(float(solver.end_time), volume)
    return pushes if solver.gravity is None else pushes + _weight_pressure(solver.gravity, parison, material)


def enclosed_volumes(pressure: Loading, parison: Parison) -> Any:
    """The volume [m^3] that a parison encloses initially, or those (n_load,) of the regions of a load; on the host."""
    positions, triangles = np.asarray(parison.positions, float), np.asarray(parison.triangles)
    if not isinstance(pressure, RegionalLoad):
        return volumes.enclosed_volume(positions, triangles)
    return np.array([volumes.enclosed_volume(positions, triangles[own]) for own in np.asarray(pressure.regions)])


def _weight_pressure(gravity: jax.Array, parison: Parison, material: Law) -> float:
    """The pressure [Pa] that pushes a flat sheet as its weight does."""
    corners = np.asarray(parison.positions, float)[np.asarray(parison.triangles)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1).sum()
    weight = np.mean(np.asarray(material.density, float)) * np.mean(np.asarray(parison.thickness, float))
    return float(weight * np.asarray(gravity, float) @ normals.sum(0) / area)


def make_parison(
    positions: np.ndarray,
    triangles: np.ndarray,
    thickness: ArrayLike,
    clamped: np.ndarray,
    fixed: np.ndarray | None = None,
    temperature: ArrayLike | None = None,
    pre_stretch: ArrayLike | None = None,
    guided: Collection[int] = (),
    clamp_until: float | None = None,
) -> Parison:
    """A parison from positions (n_node, 3) [m], triangles (n_element, 3) and clamped nodes (n_node,).

    Args:
        positions: Initial node positions.
        triangles: Node numbers.
        thickness: Initial thickness [m], a number or (n_node,).
        clamped: Mask of the nodes that do not move, as long as the clamp is not opened.
        fixed: Mask (n_node, 3) of components that never move, for symmetry planes; none by default.
        temperature: Temperature of the sheet [degC], a number or (n_node,); None if the material does not depend on it.
        pre_stretch: Stretches along x and y (2,) of a sheet in a plane z = const, which is stretched from the origin
            before it is clamped; positions and thickness are those before.
        guided: Axes (0 to 2) along which `fixed` holds nodes in planes that are no planes of symmetry, such as the ends
            of a tube.
        clamp_until: Time [s] at which the clamp opens, so that the clamped nodes are free from then on; by default it
            holds them to the end.

    Raises:
        InputError: If a thickness is not a positive finite number, or thickness or temperature do not fit the mesh; if
            a pre-stretch is below 1, or the sheet is not flat; if a clamp opens that holds no node.
    """
    count = len(positions)
    if clamp_until is not None:
        check_one("parison.clamp_until", clamp_until)
        remedy = "leave it out, or clamp nodes"
        require(bool(np.any(clamped)), "no node is clamped", "parison.clamp_until", clamp_until, remedy)
    stretches = None if pre_stretch is None else _pre_stretch(pre_stretch, np.asarray(positions, float))
    if stretches is not None:
        positions = np.asarray(positions, float) * np.append(stretches, 1.0)
    return Parison(
        positions=as_real(positions),
        triangles=as_index(triangles),
        thickness=_nodal("parison.thickness", thickness, count),
        clamped=jnp.asarray(clamped, bool),
        fixed=jnp.zeros((count, 3), bool) if fixed is None else jnp.asarray(fixed, bool),
        temperature=None if temperature is None else _nodal("parison.temperature", temperature, count),
        pre_stretch=None if stretches is None else as_real(stretches),
        clamp_until=None if clamp_until is None else as_real(clamp_until),
        guided=tuple(sorted(guided)),
    )


def _pre_stretch(given: ArrayLike, positions: np.ndarray) -> np.ndarray:
    """Stretches along x and y (2,), checked."""
    key = "parison.pre_stretch"
    values = as_numbers(key, given)
    require(
        values.shape == (2,), "is not a pair of stretches", key, np.asarray(given).tolist(), "give [along x, along y]"
    )
    check(key, values)
    flat = np.ptp(positions[:, 2]) <= 1e-9 * np.ptp(positions, axis=0).max()
    require(flat, "stretches a sheet that is not flat", key, values.tolist(), "give a sheet in a plane z = const")
    return np.asarray(values, float)


def _nodal(key: str, given: ArrayLike, count: int) -> jax.Array:
    """A number, or one for each node, as (n_node,)."""
    values = as_numbers(key, given)
    if values.ndim and values.shape != (count,):
        raise InputError(f"needs one value per node: {count}, not {values.shape}", "match the mesh", key)
    check(key, values)
    return as_real(np.broadcast_to(values, (count,)))


def make_solver(
    *,
    end_time: float,
    damping: float | None = None,
    gravity: ArrayLike | None = None,
    safety: float = 0.9,
    quasi_static: bool = False,
    self_contact: bool = False,
    edge_contact: bool = False,
    smooth_landing: bool = False,
    max_steps: int = MOST_STEPS,
) -> Solver:
    """Options of the time integration; see `Solver`.

    Raises:
        InputError: If a number is out of its range.
    """
    numbers = {"end_time": end_time, "damping": damping, "safety": safety, "max_steps": max_steps}
    for name, value in numbers.items():
        if value is not None:
            check_one(f"solver.{name}", value)
    damped = None if damping is None else as_real(damping)
    weighs = None if gravity is None else as_numbers("solver.gravity", gravity)
    if weighs is not None:
        remedy = "give three numbers [m/s^2], such as [0, 0, -9.81]"
        require(weighs.shape == (3,), "is not a vector", "solver.gravity", np.asarray(gravity).tolist(), remedy)
        check("solver.gravity", weighs)
    return Solver(
        end_time=as_real(end_time),
        damping=damped,
        gravity=None if weighs is None else as_real(weighs),
        safety=as_real(safety),
        quasi_static=bool(quasi_static),
        self_contact=bool(self_contact),
        edge_contact=bool(edge_contact),
        smooth_landing=bool(smooth_landing),
        max_steps=int(max_steps),
    )


def make_refinement(
    *,
    angle: float,
    interval: int,
    max_level: int,
    elements: int,
    min_area: float = 0.0,
    base_level: int = 0,
    proximity_factor: float = 1.0,
    mass_scaling_levels: int = 0,
    at_rest: bool = True,
    jump: float | None = None,
    **renamed: Any,
) -> Refinement:
    """Limits of adaptive refinement; see `Refinement`.

    Older names of two keywords, `base_reach` and `scaled_levels`, are still accepted, with a warning.

    Raises:
        InputError: If a number is out of its range.
    """
    for name in renamed:
        if f"refinement.{name}" not in RENAMED:
            raise TypeError(f"make_refinement() got an unexpected keyword argument {name!r}")
    current = current_keys("refinement", renamed)
    proximity_factor = current.get("proximity_factor", proximity_factor)
    mass_scaling_levels = current.get("mass_scaling_levels", mass_scaling_levels)
    given = {"angle": angle, "min_area": min_area, "interval": interval, "max_level": max_level}
    given |= {
        "base_level": base_level,
        "proximity_factor": proximity_factor,
        "mass_scaling_levels": mass_scaling_levels,
        "elements": elements,
    }
    for name, value in (given if jump is None else given | {"jump": jump}).items():
        check_one(f"refinement.{name}", value)
    deepest = max(max_level, base_level)
    require(deepest > 0, "must not both be 0", "refinement.max_level", max_level)
    if mass_scaling_levels > deepest:
        problem = f"is more than the {deepest} levels of the scene"
        raise InputError(problem, f"give at most {deepest}", "refinement.mass_scaling_levels", mass_scaling_levels)
    uneven = None if jump is None else as_real(jump)
    return Refinement(
        angle=as_real(angle),
        min_area=as_real(min_area),
        jump=uneven,
        proximity_factor=as_real(proximity_factor),
        interval=np.int32(interval),
        max_level=np.int32(max_level),
        base_level=np.int32(base_level),
        mass_scaling_levels=np.int32(mass_scaling_levels),
        at_rest=at_rest,
        elements=elements,
    )


def require(good: bool, problem: str, key: str, value: Any, remedy: str = "give a number in that range") -> None:
    """Raises InputError about a value unless it is good."""
    if not good:
        raise InputError(problem, remedy, key, value)
