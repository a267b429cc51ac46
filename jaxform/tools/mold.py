"""Tools: rigid triangulated surfaces that the sheet touches. The mold is one of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_index, as_real, pytree, static
from jaxform.core.ranges import as_numbers, check, check_one
from jaxform.mechanics.membrane import Vector
from jaxform.mesh import meshes
from jaxform.tools.contact_law import ContactLaw, Stick


@pytree
class Mold:
    """A tool, the mold or another one: a rigid triangulated surface; the orientation of its triangles has no effect.

    Attributes:
        vertices: Vertex positions (n_vertex, 3) [m].
        triangles: Vertex numbers (n_triangle, 3).
        dropped: Degenerate or duplicate triangles that were left out of the file's.
        motion: Its motion, which nodes in contact follow; None if it is at rest.
        contact: The contact law.
        name: Its name; "" of the mold, and where names do not matter.
        temperature: Its temperature [degC]; None where it is `Cooling.mold_temperature`.
        heat_transfer: Heat transfer coefficient from the sheet to it [W/(m^2 K)]; None where it is `Cooling.mold`.
    """

    vertices: jax.Array
    triangles: jax.Array
    dropped: int = static(default=0)
    motion: Motion | None = None
    contact: ContactLaw = dataclasses.field(default_factory=Stick)
    name: str = static(default="")
    temperature: jax.Array | None = None
    heat_transfer: jax.Array | None = None

    def describe(self) -> str:
        """Its name in messages."""
        return f"the tool {self.name}" if self.name else "the mold"

    def offset_at(self, time: ArrayLike) -> NDArray[np.float64]:
        """The displacement (3,) [m] from where it starts at a time [s], or (n, 3) at times (n,); on the host."""
        return np.zeros((*np.shape(time), 3)) if self.motion is None else self.motion.offset_at(time)

    def vertices_at(self, time: float) -> NDArray[np.float64]:
        """The vertices (n_vertex, 3) [m] at a time [s]; on the host."""
        places = np.asarray(self.vertices, float)
        return places if self.motion is None else places + self.motion.offset_at(time)

    def where_it_turns(self) -> NDArray[np.float64]:
        """Its corners (n, 3) [m] at all times between which it moves one way; on the host.

        A mold that moves stays between where it starts and where it turns.
        """
        corners = np.unique(np.asarray(self.triangles))
        times = [0.0] if self.motion is None else np.asarray(self.motion.time, float).tolist()
        return np.concatenate([self.vertices_at(time)[corners] for time in times])

    def at(self, time: float) -> Mold:
        """The mold at rest at its position at a time [s]; on the host."""
        there: Any = self.vertices_at(time)
        return self if self.motion is None else dataclasses.replace(self, vertices=there, motion=None)


def make_mold(
    vertices: np.ndarray,
    triangles: np.ndarray,
    dropped: int = 0,
    motion: Motion | None = None,
    contact: ContactLaw | None = None,
    name: str = "",
    temperature: float | None = None,
    heat_transfer: float | None = None,
) -> Mold:
    """A mold, or another tool, from vertices (n_vertex, 3) [m] and triangles (n_triangle, 3).

    Degenerate triangles and copies are left out, and counted in `dropped` beside those left out before.

    Args:
        vertices: The vertices, when the run begins.
        triangles: Their numbers.
        dropped: Triangles left out before.
        motion: Its motion; None if it is at rest.
        contact: The contact law, from `make_contact_law`; by default nodes stick.
        name: Name of the tool.
        temperature: Temperature of the tool [degC], where the sheet cools; by default `Cooling.mold_temperature`.
        heat_transfer: Heat transfer coefficient to it [W/(m^2 K)]; by default `Cooling.mold`.

    Raises:
        InputError: If no triangle has an area, a triangle has a vertex that does not exist, or a coordinate is not
            finite.
    """
    vertices, triangles = np.asarray(vertices, float), np.asarray(triangles)
    if not np.all(np.isfinite(vertices)):
        raise InputError("a vertex is not finite", "repair the mesh", key="mold")
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise InputError("a triangle has a vertex that does not exist", "repair the mesh", key="mold")
    bad = meshes.find_degenerate(vertices, triangles) if len(triangles) else np.zeros(0, bool)
    if np.all(bad):
        raise InputError("has no triangles", "give a surface mesh of triangles", key="mold")
    law = Stick() if contact is None else contact
    warmth = {"temperature": temperature, "heat_transfer": heat_transfer}
    for key, value in warmth.items():
        if value is not None:
            check_one(f"mold.{key}", value)
    numbers = {key: None if value is None else as_real(value) for key, value in warmth.items()}
    return Mold(as_real(vertices), as_index(triangles[~bad]), dropped + int(bad.sum()), motion, law, name, **numbers)


# Motion of a tool, and its frame: contact is computed there, so that a tool at rest costs nothing.

FASTEST = 3.0  # times the mean speed between two knots, at most: a cubic is no steeper
FAR_LATER = 1e6
"""Times as late as the last knot, or as many seconds: where the knots of the padding are."""
_SLACK = 16  # roundings of a time


@pytree
class Motion:
    """Displacement of a tool along a straight line; it rests before its first and after its last knot.

    Between knots it follows monotone cubics, at rest where the direction changes (F. N. Fritsch,
    J. Butland, SIAM J. Sci. Stat. Comput. 5, 1984).

    Attributes:
        direction: Direction of the displacement (3,), a unit vector.
        time: Knots (n_knot,) [s], increasing.
        displacement: Displacements at the knots (n_knot,) [m]; 0 at the first.
    """

    direction: jax.Array
    time: jax.Array
    displacement: jax.Array

    def offset(self, time: jax.Array) -> jax.Array:
        """Displacement (3,) [m] of the tool from its start, at a time [s]."""
        width = jnp.diff(self.time)
        rise = jnp.diff(self.displacement) / width
        one, other = rise[:-1], rise[1:]
        turns = one * other <= 0.0
        slope = jnp.where(turns, 0.0, 2.0 * one * other / jnp.where(turns, 1.0, one + other))
        slope = jnp.pad(slope, 1)
        k = jnp.clip(jnp.sum(self.time <= time) - 1, 0, self.time.size - 2)
        s = jnp.clip((time - self.time[k]) / width[k], 0.0, 1.0)
        begin, end = self.displacement[k], self.displacement[k + 1]
        far = begin - self.displacement[0] + s * s * (3.0 - 2.0 * s) * (end - begin)
        far += width[k] * s * (1.0 - s) * ((1.0 - s) * slope[k] - s * slope[k + 1])
        return far * self.direction

    def offset_at(self, time: ArrayLike) -> NDArray[np.float64]:
        """Displacements (..., 3) [m] at times (...) [s]; on the host, by one program for all its knots."""
        times = np.asarray(time, float)
        return np.asarray(_offsets(self, as_real(times.ravel())), float).reshape(*times.shape, 3)

    def highest_speed(self) -> jax.Array:
        """A bound on its speed [m/s]: between two knots a cubic is at most three times as steep as their line."""
        return FASTEST * jnp.max(jnp.abs(jnp.diff(self.displacement) / jnp.diff(self.time)))

    def mean_speeds(self) -> np.ndarray:
        """Mean speeds between knots (n_knot - 1,) [m/s]; on the host."""
        return np.abs(np.diff(np.asarray(self.displacement, float)) / np.diff(np.asarray(self.time, float)))

    def speed_from(self, time: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A bound on its speed [m/s] from a time on, and until when [s] that holds: a knot from which it is faster."""
        now = time * (1.0 + _SLACK * jnp.finfo(time.dtype).eps)  # a window that ends at a knot is there to rounding
        bound = FASTEST * jnp.abs(jnp.diff(self.displacement) / jnp.diff(self.time))
        begins, ends = self.time[:-1], self.time[1:]
        here = jnp.sum(jnp.where((begins <= now) & (now < ends), bound, 0.0))
        return here, jnp.min(jnp.where((begins > now) & (bound > here), begins, jnp.inf))

    @property
    def last_time(self) -> jax.Array:
        """The time [s] from which on it rests for good: that of its last knot, but for those of the padding.

        Displacements do not count: a later knot with the same one may be designed, and has a derivative.
        """
        gap = FAR_LATER * jnp.maximum(1.0, jnp.abs(self.time[:-1]))
        padded = jax.lax.cummax((jnp.diff(self.time) >= 0.5 * gap).astype(jnp.int32)) > 0
        return jnp.max(jnp.where(padded, self.time[0], self.time[1:]))

    def frame(self, begin: jax.Array, end: jax.Array) -> ToolFrame:
        """The tool's frame in a step from one time to another [s]."""
        before, after = self.offset(begin), self.offset(end)
        length = end - begin
        still = length <= 0.0
        return ToolFrame(after, jnp.where(still, 0.0, (after - before) / jnp.where(still, 1.0, length)))


@jax.jit
def _offsets(motion: Motion, times: jax.Array) -> jax.Array:
    """Displacements (n, 3) [m] at times (n,) [s]; operation by operation they would be some thirty programs."""
    return jax.vmap(motion.offset)(times)


class ToolFrame(NamedTuple):
    """A tool's frame in a step: its displacement at the step's end (3,) [m], and its velocity in it (3,) [m/s]."""

    offset: jax.Array
    velocity: jax.Array

    def places(self, positions: Any) -> Vector:
        """Positions, three times (n,) [m], in the tool's frame at the step's end."""
        x, y, z = (component - far for component, far in zip(positions, self.offset, strict=True))
        return x, y, z

    def speeds(self, velocities: Any) -> Vector:
        """Velocities, three times (n,) [m/s], relative to the tool."""
        x, y, z = (component - speed for component, speed in zip(velocities, self.velocity, strict=True))
        return x, y, z


def tool_velocity(frames: tuple[ToolFrame | None, ...], tool: jax.Array | None) -> Any:
    """Velocity of the tool that each node touches: three numbers where there is one tool, else three times (n,) [m/s].

    None where no tool moves.
    """
    return _select_by_tool([None if frame is None else frame.velocity for frame in frames], tool)


def tool_offset(frames: tuple[ToolFrame | None, ...], tool: jax.Array | None) -> Any:
    """Displacement at the step's end [m] of the tool that each node touches, as `tool_velocity` gives velocities."""
    return _select_by_tool([None if frame is None else frame.offset for frame in frames], tool)


def _select_by_tool(values: Sequence[jax.Array | None], tool: jax.Array | None) -> Any:
    """The value (3,) of the tool that each node touches, 0 where there is none; None where no tool has one."""
    if tool is None or all(value is None for value in values):
        return next((value for value in values if value is not None), None)
    found = [jnp.zeros(tool.shape, value.dtype) for value in values if value is not None][:1] * 3
    for number, value in enumerate(values):
        if value is not None:
            found = [jnp.where(tool == number, value[k], old) for k, old in enumerate(found)]
    return found


def make_motion(direction: ArrayLike, time: ArrayLike, displacement: ArrayLike) -> Motion:
    """A motion along a direction (3,), through knots (n_knot,): times [s], increasing, and displacements [m].

    Raises:
        InputError: If the knots do not increase, are fewer than two or not finite, or do not match; if the first
            displacement is not 0, or the direction has no length.
    """
    way = np.atleast_1d(as_numbers("mold.motion.direction", direction)).astype(float)
    times = np.atleast_1d(as_numbers("mold.motion.time", time))
    far = np.atleast_1d(as_numbers("mold.motion.displacement", displacement))
    if way.shape != (3,) or not np.all(np.isfinite(way)) or not np.any(way):
        raise InputError(
            "is not a direction", "give three numbers, such as [0, 0, 1]", "mold.motion.direction", way.tolist()
        )
    if times.shape != far.shape or times.ndim != 1 or times.size < 2:
        problem = f"{times.size} times and {far.size} displacements do not define a motion"
        raise InputError(problem, "give two or more knots, one displacement per time", "mold.motion.displacement")
    check("mold.motion.time", times)
    check("mold.motion.displacement", far)
    if far[0] != 0.0:
        remedy = "start with 0, and place the surface at its start (translate)"
        raise InputError(
            "the motion does not start with a displacement of 0", remedy, "mold.motion.displacement", float(far[0])
        )
    way /= np.abs(way).max()  # so that no square overflows or vanishes
    return Motion(as_real(way / np.linalg.norm(way)), as_real(times), as_real(far))
