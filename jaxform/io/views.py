"""Surfaces seen from outside, drawn in matplotlib's 3-D axes pixel by pixel. Knows arrays alone, and no JAX.

Matplotlib sorts polygons by their mean depth and draws each by itself, which takes a minute for 400 000 and lets large
ones hide small ones wrongly. Here every pixel looks for the nearest surface; what no eye can see costs nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import raster

Array = NDArray[np.float64]

TO_EYE = np.array([1.0, -1.0, 0.0])
MINIMUM = "#d00000"
_COLORS = "viridis"  # reads the same to all eyes, and in grey
_CUT_OFF = 0.82  # grey of what is formed with the part, but cut off it
_LIGHT = np.array([0.35, -0.5, 0.79])
_FINER, _MANY = 2, 150_000  # pixels of the surfaces along one of the picture; triangles from which it is one
_TALL, _FITS = 0.8, 4  # times as high as wide, a view is measured before it is drawn, so often at most
_LINE, _LINED = 0.7, 5.0  # pixels: half an element's edge, and how high an element is whose edges are drawn


class DrawnSurface(NamedTuple):
    """A surface to draw.

    Attributes:
        faces: Triangles (n, 3, 3) [mm].
        paint: Their colours (n, 3), or numbers (n,) that colours show; NaN is grey.
        opaque: Their opacity, 0 to 1.
        edges: Whether their edges are drawn.
        open_at: Two axes and places [mm]: what lies between the eye and both planes is left out.
    """

    faces: Array
    paint: Array
    opaque: float = 1.0
    edges: bool = False
    open_at: tuple[tuple[int, float], tuple[int, float]] | None = None


class View(NamedTuple):
    """Content of a view from outside.

    Attributes:
        surfaces: Surfaces, from back to front.
        outline: Lines (n, 2, 3) [mm] behind them, thin and grey; None where there are none.
        hangs: Whether z points down, for a view into a hanging part, or onto one that stands up towards -z.
        turned: Whether y is reversed as well, so that the view is no mirror image: for parts without symmetry.
        scale: Range of the values that colours show.
        mark: A place (3,) [mm] to mark as the minimum, or None.
    """

    surfaces: list[DrawnSurface]
    outline: Array | None = None
    hangs: bool = False
    turned: bool = False
    scale: tuple[float, float] = (0.0, 1.0)
    mark: Array | None = None


def draw(axes: Any, view: View) -> Any:
    """Draws a view in matplotlib's 3-D axes; returns what a colour bar needs."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colors = ScalarMappable(Normalize(*view.scale, clip=True), _COLORS)
    if view.outline is not None:
        _draw_outline(axes, view.outline)
    _draw_surfaces(axes, [_color_faces(surface, colors) for surface in view.surfaces], view.hangs, view.turned)
    if view.mark is not None:
        axes.plot(*view.mark[:, None], "o", color=MINIMUM, mec="white", mew=1.2, ms=8, zorder=5)
    return colors


def _color_faces(surface: DrawnSurface, colors: Any) -> DrawnSurface:
    """The surface with colours for its values, and grey where there is none."""
    if surface.paint.ndim == 2:
        return surface
    paint = np.asarray(colors.to_rgba(surface.paint))[:, :3]
    return surface._replace(paint=np.where(np.isfinite(surface.paint)[:, None], paint, _CUT_OFF))


def _draw_outline(axes: Any, lines: Array) -> None:
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    axes.computed_zorder = False
    axes.add_collection3d(Line3DCollection(lines, colors="#00000040", linewidths=0.6, zorder=0.5), autolim=False)


def _draw_surfaces(axes: Any, surfaces: list[DrawnSurface], hangs: bool, turned: bool) -> None:
    axes.computed_zorder = False
    for order, surface in enumerate(surfaces):
        axes.add_artist(_scenery(surface, zorder=float(order)))
    points = np.concatenate([surface.faces.reshape(-1, 3) for surface in surfaces])
    low, high = points.min(0), points.max(0)
    size = np.maximum(high - low, 0.02 * (high - low).max())
    axes.set_box_aspect(size, zoom=1.0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2] + 1e-9))
    if hangs:
        axes.set_zlim(high[2] + 1e-9, low[2])
    if hangs and turned:
        axes.set_ylim(high[1], low[1])
    axes.view_init(elev=36 if hangs else 24, azim=-45)
    axes.tick_params(labelsize=8)
    axes.locator_params(nbins=4)
    axes.set_xlabel("x [mm]", fontsize=9)
    axes.set_ylabel("y [mm]", fontsize=9)
    axes.set_zlabel("z [mm]", fontsize=9)
    if size[2] > _TALL * size[:2].max():
        _fit(axes, size)


def _fit(axes: Any, size: Array) -> None:
    """Makes a tall view smaller until its ticks and labels are in its place in the figure."""
    scenery, place = [artist for artist in axes.artists if artist.get_visible()], axes.bbox
    for artist in scenery:
        artist.set_visible(False)
    zoom = 1.0
    for _ in range(_FITS):
        axes.figure.draw_without_rendering()
        extent = axes.get_tightbbox(axes.figure.canvas.get_renderer())
        # Labels stay as large as they are, so a view shrinks a little more than its box.
        beyond = max(
            (extent.y1 - extent.y0) / place.height,
            (extent.x1 - extent.x0) / place.width,
            1.0 + 2 * max(place.y0 - extent.y0, extent.y1 - place.y1) / place.height,
        )
        if beyond <= 1.0:
            break
        zoom /= beyond
        axes.set_box_aspect(size, zoom=zoom)
    for artist in scenery:
        artist.set_visible(True)


def _scenery(surface: DrawnSurface, zorder: float) -> Any:
    """An artist that draws a surface as an image over its axes."""
    from matplotlib.artist import Artist

    class Scenery(Artist):
        def draw(self, renderer: Any) -> None:
            axes: Any = self.axes
            low = np.maximum(np.floor(axes.bbox.min), 0)
            high = np.minimum(np.ceil(axes.bbox.max), np.ceil(axes.figure.bbox.max))
            width, height = (int(extent) for extent in high - low)
            pixels, depth = _project(axes, surface.faces)
            finer = _FINER if len(surface.faces) <= _MANY else 1
            image = _image(surface, finer * (pixels - low), depth, width, height, finer)
            context = renderer.new_gc()
            renderer.draw_image(context, float(low[0]), float(low[1]), np.round(255 * image).astype(np.uint8))
            context.restore()

    artist = Scenery()
    artist.set_zorder(zorder)
    return artist


def _project(axes: Any, faces: Array) -> tuple[Array, Array]:
    """Corners (n, 3, 2) in pixels of the figure, from its lower left, and their depth (n, 3)."""
    x, y, z = (np.ascontiguousarray(faces[..., k]).ravel() for k in range(3))
    across, up, depth, away = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in np.asarray(axes.M))
    pixels = axes.transData.transform(np.stack([across / away, up / away], axis=1))
    return pixels.reshape(-1, 3, 2), (depth / away).reshape(-1, 3)


def _image(surface: DrawnSurface, corners: Array, depth: Array, width: int, height: int, finer: int) -> Array:
    """Colours of a surface and its coverage (height, width, 4), sampled in so many times as many pixels.

    The corners are in these finer pixels. Partly covered pixels are less opaque.
    """
    faces, wide = surface.faces, finer * width
    kept = None if surface.open_at is None else _is_behind(surface)
    nearest = raster.nearest_in_pixels(corners, depth, wide, finer * height, kept)
    hit = np.flatnonzero(nearest >= 0)
    triangle = nearest[hit]
    # Of many triangles few are seen.
    seen = np.zeros(len(faces), bool)
    seen[triangle] = True
    a, b, c = (faces[seen, corner] for corner in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    bright = np.zeros(len(faces))
    bright[seen] = 0.72 + 0.28 * np.abs(normal @ _LIGHT) / np.where(length > 0, length, 1.0)
    paint = surface.paint[triangle] * bright[triangle, None]
    if surface.edges:
        paint[_is_on_edge(corners, triangle, raster.weights(corners, triangle, hit, wide))] *= 0.6
    pixel = hit // (wide * finer) * width + hit % wide // finer
    sums = [np.bincount(pixel, part, width * height) for part in (*paint.T, np.ones(len(hit)))]
    covered = sums.pop()
    shares = [total / np.maximum(covered, 1.0) for total in sums]
    image = np.stack([*shares, surface.opaque / finer**2 * covered], axis=1)
    return image.reshape(height, width, 4)


def _is_behind(surface: DrawnSurface) -> Callable[[raster.Interpolation], NDArray[np.bool_]]:
    """A function for the mask of a cut-open surface's pixels that are not between the eye and both planes."""

    def is_visible(interpolate: raster.Interpolation) -> NDArray[np.bool_]:
        # As the triangles are small, perspective hardly bends them.
        front = [
            TO_EYE[axis] * (interpolate(surface.faces[:, :, axis]) - place) > 0 for axis, place in surface.open_at or ()
        ]
        return ~np.logical_and.reduce(front)

    return is_visible


def _is_on_edge(corners: Array, triangle: NDArray[np.integer], weights: Array) -> NDArray[np.bool_]:
    """Mask of pixels (n,), with weights (3, n), on the edges of triangles that are large enough to show them."""
    side = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    twice = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    tall = twice[:, None] / np.maximum(np.linalg.norm(side, axis=2), 1e-12)
    away = functools.reduce(np.minimum, [w * side[triangle] for w, side in zip(weights, tall.T, strict=True)])
    return (away < _LINE) & (tall.min(1) > _LINED * _FINER)[triangle]
