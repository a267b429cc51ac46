"""Parts, sheets and molds seen from outside: solid surfaces in matplotlib's 3-D axes, drawn pixel by pixel.

Matplotlib sorts polygons by their mean depth and draws each by itself, which takes a minute for 400 000 and lets large
ones hide small ones wrongly. Here every pixel looks for the nearest surface; what no eye can see costs nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import raster, topology
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.result import Result
from jaxform.tools.search import cut

Array = NDArray[np.float64]

COLORS = "viridis"  # reads the same to all eyes, and in grey
SHEET = "#5b9bd5"
_GREY, _MOLD_SHARE = 0.62, 0.55  # of the mold, and how much of it the paper lets through
_TO_EYE = np.array([1.0, -1.0, 0.0])
_LIGHT = np.array([0.35, -0.5, 0.79])
_MOLD_LINES = 2000  # triangles, above which a mold's outline is not drawn
_MOLD_PIECES = 20  # of its size, along a large triangle of the mold
_FINER, _MANY = 2, 150_000  # pixels of the surfaces along one of the picture; triangles from which it is one
_LINE, _LINED = 0.7, 5.0  # pixels: half an element's edge, and how high an element is whose edges are drawn
_TOO_LARGE = 2.5  # times as large as the part, a mold is left out


class Surface(NamedTuple):
    """Triangles (n, 3, 3) [mm], their colours (n, 3), how opaque they are, whether edges are drawn, what is cut away.

    `open_at` are two axes and places [mm]: what lies between the eye and both planes is left out.
    """

    faces: Array
    paint: Array
    opaque: float = 1.0
    edges: bool = False
    open_at: tuple[tuple[int, float], tuple[int, float]] | None = None


def draw_part(
    axes: Any, scene: Scene, result: Result, scale: tuple[float, float], *, edges: bool = False, mark: Any = None
) -> Any:
    """The part in colours of its wall, with the mold in grey behind it.

    Args:
        axes: Matplotlib's 3-D axes.
        scene: What was simulated.
        result: The part, of used nodes and elements alone.
        scale: Range of the colours [mm].
        edges: Draw the elements' edges.
        mark: A place (3,) [m] to mark as the minimum, or None.

    Returns:
        What a colour bar needs.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colors = ScalarMappable(Normalize(*scale, clip=True), COLORS)
    corners = 1e3 * np.asarray(result.positions, float)[np.asarray(scene.parison.triangles)]
    images = [1e3 * image for image in mirrored(scene, corners / 1e3, open_front=True)]
    paint = np.asarray(colors.to_rgba(1e3 * np.asarray(result.element_thickness, float)))[:, :3]
    part = Surface(np.concatenate(images), np.tile(paint, (len(images), 1)), edges=edges)
    _draw(axes, [*_mold(axes, scene, part.faces), part], _hangs(scene, result))
    if mark is not None:
        axes.plot(*(1e3 * np.asarray(mark)[:, None]), "o", color="#d00000", mec="white", mew=1.2, ms=8, zorder=5)
    return colors


def draw_sheet(axes: Any, scene: Scene) -> None:
    """The sheet before the first step, with the mold in grey behind it."""
    corners = np.asarray(scene.parison.positions, float)[np.asarray(scene.parison.triangles)]
    faces = 1e3 * np.concatenate(mirrored(scene, corners))
    from matplotlib.colors import to_rgb

    paint = np.tile(to_rgb(SHEET), (len(faces), 1))
    sheet = Surface(faces, paint, opaque=0.8, edges=True)
    _draw(axes, [*_mold(axes, scene, faces, whole=True), sheet], hangs=False)


def mirrored(scene: Scene, points: Array, open_front: bool = False) -> list[Array]:
    """The points (..., 3) and their images in the symmetry planes, so that the whole part is seen.

    Args:
        scene: The scene, which knows the planes.
        points: In the modelled part.
        open_front: Leave one image out where there are four, for a look inside.
    """
    planes = sections.symmetry_planes(scene)
    images = []
    for flips in itertools.product((False, True), repeat=len(planes)):
        image = np.array(points)
        for (axis, place), flip in zip(planes.items(), flips, strict=True):
            if flip:
                image[..., axis] = 2 * place - image[..., axis]
        images.append(image)
    if not open_front or len(images) != 4:
        return images
    front = int(np.argmax([image.reshape(-1, 3).mean(0) @ _TO_EYE for image in images]))
    return [image for k, image in enumerate(images) if k != front]


def _hangs(scene: Scene, result: Result) -> bool:
    """Whether the part is drawn hanging, so that one looks into it: sheets that rose from a plane."""
    rise = np.asarray(result.positions, float)[:, 2] - np.asarray(scene.parison.positions, float)[:, 2]
    return bool(np.asarray(scene.parison.clamped).any() and rise.mean() > 0 and sections.symmetry_planes(scene))


def _mold(axes: Any, scene: Scene, part: Array, whole: bool = False) -> list[Surface]:
    """The mold behind a part (n, 3, 3) [mm], unless it is so much larger that nothing else would be seen."""
    if scene.mold is None:
        return []
    vertices, triangles = np.asarray(scene.mold.vertices, float), np.asarray(scene.mold.triangles)
    size = 1e3 * float(np.ptp(vertices[np.unique(triangles)], axis=0).max())
    if size > _TOO_LARGE * float(np.ptp(part, axis=(0, 1)).max()) and not whole:
        return []
    walls, planes = vertices[triangles], sections.symmetry_planes(scene)
    tolerance = 1e-6 * size / 1e3
    crosses = all(
        walls[..., k].min() < level - tolerance and walls[..., k].max() > level + tolerance
        for k, level in planes.items()
    )
    opened = None
    if crosses and len(planes) == 2 and not whole:
        (one, at), (other, there) = planes.items()
        opened = (one, 1e3 * at), (other, 1e3 * there)
    images = [walls] if crosses else mirrored(scene, walls, open_front=not whole)
    faces = 1e3 * np.concatenate(images)
    if opened is not None:
        faces = cut(faces, size / _MOLD_PIECES)[0]
    if opened is None and len(triangles) <= _MOLD_LINES:
        _draw_outline(axes, scene, vertices, triangles, crosses)
    return [Surface(faces, np.full((len(faces), 3), _GREY), _MOLD_SHARE, open_at=opened)]


def _draw_outline(axes: Any, scene: Scene, vertices: Array, triangles: NDArray[Any], crosses: bool) -> None:
    """The mold's sharp and free edges, thin and grey."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    lines = np.asarray(topology.feature_edges(vertices, triangles), np.float64)
    lines = 1e3 * np.concatenate([lines] if crosses else mirrored(scene, lines, open_front=True))
    axes.computed_zorder = False
    axes.add_collection3d(Line3DCollection(lines, colors="#00000040", linewidths=0.6, zorder=0.5), autolim=False)


def _draw(axes: Any, surfaces: list[Surface], hangs: bool) -> None:
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
    axes.view_init(elev=36 if hangs else 24, azim=-45)
    axes.tick_params(labelsize=8)
    axes.locator_params(nbins=4)
    axes.set_xlabel("x [mm]", fontsize=9)
    axes.set_ylabel("y [mm]", fontsize=9)
    axes.set_zlabel("z [mm]", fontsize=9)


def _scenery(surface: Surface, zorder: float) -> Any:
    """An artist that draws a surface as an image over its axes."""
    from matplotlib.artist import Artist

    class Scenery(Artist):
        def draw(self, renderer: Any) -> None:
            axes: Any = self.axes
            low = np.maximum(np.floor(axes.bbox.min), 0)
            high = np.minimum(np.ceil(axes.bbox.max), np.ceil(axes.figure.bbox.max))
            width, height = (int(extent) for extent in high - low)
            pixels, depth = _projected(axes, surface.faces)
            finer = _FINER if len(surface.faces) <= _MANY else 1
            image = _painted(surface, finer * (pixels - low), depth, width, height, finer)
            context = renderer.new_gc()
            renderer.draw_image(context, float(low[0]), float(low[1]), np.round(255 * image).astype(np.uint8))
            context.restore()

    artist = Scenery()
    artist.set_zorder(zorder)
    return artist


def _projected(axes: Any, faces: Array) -> tuple[Array, Array]:
    """Corners (n, 3, 2) in pixels of the figure, from its lower left, and their depth (n, 3)."""
    x, y, z = (np.ascontiguousarray(faces[..., k]).ravel() for k in range(3))
    across, up, depth, away = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in np.asarray(axes.M))
    pixels = axes.transData.transform(np.stack([across / away, up / away], axis=1))
    return pixels.reshape(-1, 3, 2), (depth / away).reshape(-1, 3)


def _painted(surface: Surface, corners: Array, depth: Array, width: int, height: int, finer: int) -> Array:
    """Colours of a surface and how much it covers (height, width, 4), looked at in so many times as many pixels.

    The corners are in these finer pixels. What is covered in part is less opaque.
    """
    faces, wide = surface.faces, finer * width
    kept = None if surface.open_at is None else _behind(surface)
    view = raster.nearest(corners, depth, wide, finer * height, kept)
    hit = np.flatnonzero(view.triangle >= 0)
    triangle = view.triangle[hit]
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
        paint[_on_edges(corners, triangle, view.weight[hit])] *= 0.6
    pixel = hit // (wide * finer) * width + hit % wide // finer
    sums = [np.bincount(pixel, part, width * height) for part in (*paint.T, np.ones(len(hit)))]
    covered = sums.pop()
    shares = [total / np.maximum(covered, 1.0) for total in sums]
    image = np.stack([*shares, surface.opaque / finer**2 * covered], axis=1)
    return image.reshape(height, width, 4)


def _behind(surface: Surface) -> Callable[[raster.Hits], NDArray[np.bool_]]:
    """Which hits of a surface that is cut open are not between the eye and both planes."""

    def kept(found: raster.Hits) -> NDArray[np.bool_]:
        front = np.ones(len(found.triangle), bool)
        for axis, place in surface.open_at or ():
            # As the triangles are small, perspective hardly bends them.
            at = np.einsum("nc,nc->n", found.weight, surface.faces[found.triangle, :, axis])
            front &= _TO_EYE[axis] * (at - place) > 0
        return ~front

    return kept


def _on_edges(corners: Array, triangle: NDArray[np.int64], weight: Array) -> NDArray[np.bool_]:
    """Which pixels (n,) are on the edges of triangles that are large enough to have some."""
    side = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    twice = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    tall = twice[:, None] / np.maximum(np.linalg.norm(side, axis=2), 1e-12)
    return ((weight * tall[triangle]).min(1) < _LINE) & (tall.min(1) > _LINED * _FINER)[triangle]
