"""Measuring points for a first part, and its wall along sections, from stored results."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.io.report.stored_results import StoredPart
from jaxform.io.scales import counted_elements
from jaxform.mesh import topology
from jaxform.results import sections

Array = NDArray[np.float64]

_ALIKE = 0.02  # of the mean, by which the wall of a representative place may differ from it


class MeasuringPoint(NamedTuple):
    """A place to measure the wall at.

    Attributes:
        name: Name of the place.
        chosen: Criterion of its choice, in words.
        thickness: Thickness of the wall there [m].
        formed, initial: The middle of the element (3,) [m], in the part and in the initial sheet.
    """

    name: str
    chosen: str
    thickness: float
    formed: list[float]
    initial: list[float]

    def description(self) -> dict[str, Any]:
        """Its name and place, for the view."""
        return {"name": self.name, "formed": self.formed}


def measuring_points(part: StoredPart, summary: Mapping[str, Any]) -> list[MeasuringPoint]:
    """Three places to measure on a first part: the thinnest, the thickest that was formed, and a representative one.

    Args:
        part: The part.
        summary: The contents of summary.json, which knows the thinnest place and the mean wall.
    """
    thin, mean = summary["thinnest"], summary["thickness"]["mean"]
    walls = part.cells["thickness"]
    formed = np.flatnonzero(counted_elements(part.reference, part.positions, part.triangles, part.part_mask))
    thickest = int(formed[np.argmax(walls[formed])])
    points = [
        MeasuringPoint("thinnest", "the thinnest element", thin["thickness"], thin["formed"], thin["initial"]),
        _point("thickest", "the thickest element of those that were formed", part, thickest),
    ]
    if mean:
        words = f"of the formed elements within {100 * _ALIKE:.0f} % of the mean wall, that where the wall varies least"
        points.append(_point("representative", words, part, _representative(part, formed, mean)))
    return points


def wall_curves(part: StoredPart, symmetry: Mapping[str, float], through: ArrayLike) -> list[sections.SectionCurve]:
    """The curves of `jaxform.results.sections.curves`, through a place [m] in the initial sheet.

    Args:
        part: The part.
        symmetry: Place [m] of the symmetry planes by the name of their axis.
        through: The place (3,) [m].
    """
    result: Any = SimpleNamespace(positions=part.positions, thickness=part.nodal["thickness"])
    return sections.curves(_scene(part, symmetry), result, through)


def is_disc(part: StoredPart, symmetry: Mapping[str, float]) -> bool:
    """True if the initial sheet is flat and its rim a circle about the z axis."""
    return sections.is_disc(_scene(part, symmetry))


def _scene(part: StoredPart, symmetry: Mapping[str, float]) -> Any:
    """The sheet as sections take it from a scene, as far as the file of the part tells."""
    sheet = SimpleNamespace(positions=part.reference, triangles=part.triangles, clamped=_clamped_nodes(part, symmetry))
    return SimpleNamespace(parison=sheet)


def _point(name: str, chosen: str, part: StoredPart, element: int) -> MeasuringPoint:
    nodes = part.triangles[element]
    formed, initial = (places[nodes].mean(0).tolist() for places in (part.positions, part.reference))
    return MeasuringPoint(name, chosen, float(part.cells["thickness"][element]), formed, initial)


def _representative(part: StoredPart, formed: NDArray[np.int64], mean: float) -> int:
    """The element, of those whose wall is nearly the mean, at whose corners the wall differs least for its size."""
    away = np.abs(part.cells["thickness"][formed] / mean - 1.0)
    alike = formed[away <= max(_ALIKE, float(away.min()))]
    corners = part.positions[part.triangles[alike]]
    size = np.linalg.norm(np.ptp(corners, axis=1), axis=1)
    change = np.ptp(part.nodal["thickness"][part.triangles[alike]], axis=1)
    return int(alike[np.argmin(change / np.maximum(size, 1e-300))])


def _clamped_nodes(part: StoredPart, symmetry: Mapping[str, float]) -> NDArray[np.bool_]:
    """Nodes (n_node,) of the rim that were held from the start: ends of edges in no symmetry plane."""
    edges = topology.boundary_edges(part.triangles)
    near = 1e-6 * float(np.ptp(part.reference, axis=0).max())
    for axis, level in symmetry.items():
        there = np.abs(part.reference[:, "xyz".index(axis)] - level) <= near
        edges = edges[~there[edges].all(1)]
    rim = np.zeros(len(part.positions), bool)
    rim[edges.ravel()] = True
    return rim & (part.nodal["contact_time"] == 0.0)
