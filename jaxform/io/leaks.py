"""A mold with holes in its side walls, which no view along the push shows. On the host, before a run."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import warn_of
from jaxform.core.formatting import format_place
from jaxform.io.scene_checks import survey
from jaxform.io.surfaces import mirror_points
from jaxform.mesh import raster
from jaxform.model.scene import Scene
from jaxform.tools.cells import cells_behind
from jaxform.tools.opening import rotation_to_z
from jaxform.tools.side_holes import find_side_holes

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FLAT = 1e-3  # of a sheet's size, by which one that is flat is off a plane
_PIXELS = 800  # of the longer side of the sheet


def warn_of_side_holes(scene: Scene, file: str = "") -> None:
    """Warns of holes in the side walls of a mold at rest, before which a flat sheet lies."""
    seen = survey(scene)
    if scene.mold is None or scene.motion is not None or not seen.faces or seen.changes_sign:
        return
    turn = rotation_to_z(seen.push / np.linalg.norm(seen.push))
    sheet, mold = (
        np.concatenate(mirror_points(scene, np.asarray(surface, float)[np.asarray(triangles)])) @ turn.T
        for surface, triangles in (
            (scene.parison.positions, scene.parison.triangles),
            (scene.mold.vertices, scene.mold.triangles),
        )
    )
    if np.ptp(sheet[..., 2]) > _FLAT * seen.sheet.size or mold[..., 2].max() <= sheet[..., 2].min():
        return
    level = float(sheet[..., 2].min())
    holes = find_side_holes(cells_behind(mold, level, _region_before_mold(sheet[..., :2], mold, level)))
    if not holes:
        return
    what = "a hole in a side wall" if len(holes) == 1 else f"{len(holes)} holes in side walls"
    where = f"{holes[0].size:.2g} m wide at {format_place(holes[0].place @ turn)}"
    largest = "" if len(holes) == 1 else "the largest "
    remedy = "close it in the file, or let `jaxform new` cover it: it writes covers.stl"
    warn_of(f"has {what}, {largest}{where}: the sheet would be blown through", remedy, key="mold", file=file)


def _region_before_mold(sheet: Array, mold: Array, level: float) -> Callable[[Array], Mask]:
    """A function that masks the places (n, 2) [m] at which a sheet (m, 3, 2) [m] has mold (k, 3, 3) [m] before it."""
    low, high = sheet.min((0, 1)), sheet.max((0, 1))
    pixel = float((high - low).max()) / _PIXELS
    width, height = (max(1, round(float(extent) / pixel)) for extent in high - low)
    covered, before = np.zeros(width * height, bool), np.zeros(width * height, bool)
    for found in raster.rasterize((sheet - low) / pixel, width, height):
        covered[found.pixel] = True
    for found in raster.rasterize((mold[..., :2] - low) / pixel, width, height):
        before[found.pixel[found.interpolate(mold[..., 2]) >= level]] = True
    region = (covered & before).reshape(height, width)

    def over(places: Array) -> Mask:
        column, row = np.floor((places - low) / pixel).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return inside & region[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]

    return over
