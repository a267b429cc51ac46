"""Tools: rigid triangulated surfaces that the sheet touches. The mold is one of them."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_index, as_real, pytree, static
from jaxform.core.ranges import check_one
from jaxform.mesh import meshes
from jaxform.tools.contact_law import ContactLaw, Stick
from jaxform.tools.motion import Motion


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

    def vertices_at(self, time: float) -> NDArray[np.float64]:
        """The vertices (n_vertex, 3) [m] at a time [s]; on the host."""
        places = np.asarray(self.vertices, float)
        return places if self.motion is None else places + np.asarray(self.motion.offset(as_real(time)), float)

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
        raise InputError("a vertex of the mold is not finite", "repair the mesh", key="mold")
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise InputError("a triangle of the mold has a vertex that does not exist", "repair the mesh", key="mold")
    bad = meshes.find_degenerate(vertices, triangles) if len(triangles) else np.zeros(0, bool)
    if np.all(bad):
        raise InputError("the mold has no triangles", "give a surface mesh of triangles", key="mold")
    law = Stick() if contact is None else contact
    warmth = {"temperature": temperature, "heat_transfer": heat_transfer}
    for key, value in warmth.items():
        if value is not None:
            check_one(f"mold.{key}", value)
    numbers = {key: None if value is None else as_real(value) for key, value in warmth.items()}
    return Mold(as_real(vertices), as_index(triangles[~bad]), dropped + int(bad.sum()), motion, law, name, **numbers)
