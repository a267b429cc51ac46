"""The sheet and the platen around a male mold. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import contours, masks, meshes, outlines
from jaxform.mesh.contours import Circle, OrientedRectangle
from jaxform.mesh.meshes import Mesh
from jaxform.tools import molds
from jaxform.tools.buck import Buck
from jaxform.tools.footprint import Planform

Array = NDArray[np.float64]

_ROUND = 0.9  # of the smallest circle round the body, that the body covers: the sheet is a disc
_STEEP = 0.5  # of what a body is higher than wide, by which the margin grows
_LEAST = 0.15  # of the body's width, the least margin
_NARROWER = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2)  # of the margin, that a platen of the mold's own may have
_NARROW, _INSET = 0.6, 0.01  # of the margin, below which the sheet covers the whole platen; less so much of its width
_WITHIN = 0.995  # of the sheet, that lies before a platen of the mold's own
_BEYOND = 0.03  # of the sheet's width, by which a platen reaches beyond the sheet
_RINGS, _SECTORS, _CELLS = 12, 72, 24  # of a platen's mesh: gaps are measured at its nodes


class Site(NamedTuple):
    """The sheet over a male mold, and the platen around it.

    Attributes:
        planform: Planform of the sheet, in the plane of the view.
        margin: Distance from the body to the frame [m].
        platen: The surface added around the body, as the mold's file has it [m]; None where the mold has its own.
    """

    planform: Planform
    margin: float
    platen: Mesh | None


def fit_site(buck: Buck) -> Site:
    """The sheet for a male mold, a disc or a rectangle with a margin of about the body's height, and the platen."""
    body = _around(buck)
    wide = 2 * body.radius if isinstance(body, Circle) else float(body.sides.min())
    height = buck.height
    margin = max(min(height, wide + _STEEP * max(height - wide, 0.0)), _LEAST * wide)
    if buck.on_platen:
        for share in _NARROWER:
            planform = Planform(_enlarge(body, share * margin), True)
            if _lies_before(planform, buck):
                return Site(_platen_site(planform, share, buck), share * margin, None)
    planform = Planform(_enlarge(body, margin), True)
    mesh = _mesh(planform.shape)
    turned = np.column_stack([mesh.positions[:, :2], np.full(len(mesh.positions), buck.base)])
    return Site(planform, margin, Mesh(turned @ buck.view.turn, mesh.triangles))


def _lies_before(planform: Planform, buck: Buck) -> bool:
    """True when a sheet lies before the mold."""
    # Pixels outside of the view count too.
    wanted = abs(outlines.area(planform.polygon)) / buck.view.pixel**2
    return bool((buck.view.inside_polygon(planform.polygon) & buck.view.inside).sum() >= _WITHIN * wanted)


def _platen_site(planform: Planform, share: float, buck: Buck) -> Planform:
    """The sheet over all of a platen that is narrow beside the body; else the one that there is."""
    corners = contours.hull(buck.view.places(buck.view.inside))
    around = contours.smallest_rectangle(corners)
    whole = Planform(around.enlarge(-_INSET * float(around.sides.min())), True)
    return whole if share < _NARROW and _lies_before(whole, buck) else planform


def _around(buck: Buck) -> Circle | OrientedRectangle:
    corners = contours.hull(buck.view.places(masks.fill_holes(buck.body)))
    circle = contours.smallest_circle(corners)
    if abs(outlines.area(corners)) >= _ROUND * np.pi * circle.radius**2:
        return circle
    return contours.smallest_rectangle(corners)


def _enlarge(shape: Circle | OrientedRectangle, margin: float) -> Circle | OrientedRectangle:
    return Circle(shape.center, shape.radius + margin) if isinstance(shape, Circle) else shape.enlarge(margin)


def _mesh(shape: Circle | OrientedRectangle | Array) -> Mesh:
    """A flat mesh in z = 0 that reaches beyond a disc or rectangle."""
    if isinstance(shape, Circle):
        radius = np.linspace(0.0, (1 + 2 * _BEYOND) * shape.radius, _RINGS + 1)
        disc = molds.revolved(profile=np.column_stack([radius, np.zeros(len(radius))]), segments=_SECTORS)
        return Mesh(disc.vertices + np.append(shape.center, 0.0), disc.triangles)
    assert isinstance(shape, OrientedRectangle)
    around = shape.enlarge(_BEYOND * float(shape.sides.min()))
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * around.sides @ around.axes + around.corner
    flat = molds.MoldShape(np.insert(corners, 2, 0.0, axis=1), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    fine = molds.divided(flat, _CELLS)
    return meshes.drop_unused_nodes(Mesh(fine.vertices, fine.triangles))
