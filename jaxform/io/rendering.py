"""A smooth picture of a formed part by PyVista, which is not installed with jaxform: from outside and from inside."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.disk import atomic_path
from jaxform.core.errors import InputError
from jaxform.io import previous_results
from jaxform.io.report.contents import formed_element_areas
from jaxform.io.report.stored_results import Results, StoredPart, read_results
from jaxform.io.surfaces import color_range

Array = NDArray[np.float64]

_SIZE = 2000, 1000  # pixels, of both views
_LINES = 9  # of equal thickness
_CUT_OFF, _FAINT = "#a0a0a0", 0.25  # colour and opacity of what is cut off the part
_CREASE = 40.0  # degrees between elements, from which the surface is drawn with an edge
_ASIDE, _AHEAD = 0.8, 0.75  # of the way from the part to the eye: across its depth, and along it


def render(folder: Path, path: Path) -> None:
    """Draws the part in a folder of results: thickness in colours and lines.

    Args:
        folder: Folder of results of `jaxform simulate` or `jaxform optimize`.
        path: Path of the picture, PNG.

    Raises:
        InputError: PyVista is not installed or cannot draw here, or there are no results.
    """
    results = read_results(folder)
    pyvista = _pyvista()
    with _quiet():
        plotter = pyvista.Plotter(off_screen=True, shape=(1, 2), window_size=_SIZE, border=False)
        plotter.set_background("white")
        (part, rest), limits = _split_part(_part(pyvista, results)), _range(results.part)
        for column, eye in enumerate(_eyes(results.part)):
            plotter.subplot(0, column)
            _draw(plotter, part, limits, last=column == 1)
            if rest is not None:
                plotter.add_mesh(rest, color=_CUT_OFF, opacity=_FAINT)
            _look(plotter, part, *eye)
        with atomic_path(path) as fresh:
            _write(plotter, fresh)
        plotter.close()


def _pyvista() -> Any:
    try:
        return importlib.import_module("pyvista")
    except ImportError:
        raise InputError("needs PyVista", "install it beside jaxform: pip install pyvista", "render") from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppresses the message of VTK on a missing display, without which it draws all the same."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _surface(pyvista: Any, positions: Array, triangles: NDArray[np.integer]) -> Any:
    """A surface [mm] of nodes (n_node, 3) [m] and triangles (n, 3)."""
    faces = np.column_stack([np.full(len(triangles), 3), triangles]).ravel()
    return pyvista.PolyData(1e3 * positions, faces)


def _whole(surface: Any, planes: dict[int, float]) -> Any:
    """The surface with its images in symmetry planes [m]."""
    for axis, level in planes.items():
        normal = np.eye(3)[axis]
        surface = surface.merge(surface.reflect(normal, point=1e3 * level * normal)).clean()
    return surface


def _part(pyvista: Any, results: Results) -> Any:
    surface = _surface(pyvista, results.part.positions, results.part.triangles)
    surface.point_data["wall"] = 1e3 * results.part.nodal["thickness"]
    if results.part.part_mask is not None:
        surface.cell_data["part"] = results.part.part_mask
    return _whole(surface, previous_results.symmetry_planes(results.summary))


def _split_part(surface: Any) -> tuple[Any, Any]:
    """The part that the scene selects, and the sheet that is cut off; None where nothing is cut off."""
    marked = "part" in surface.cell_data
    in_part = np.asarray(surface.cell_data["part"]) != 0 if marked else np.ones(surface.n_cells, bool)
    if in_part.all() or not in_part.any():
        return surface, None
    return tuple(surface.extract_cells(np.flatnonzero(some)).extract_surface() for some in (in_part, ~in_part))


def _range(part: StoredPart) -> tuple[float, float]:
    """Range of the colours [mm]."""
    area, formed = formed_element_areas(part)
    low, high = color_range(part.cells["thickness"][formed], area)
    return 1e3 * low, 1e3 * high


def _eyes(part: StoredPart) -> list[tuple[Array, Array]]:
    """Directions to the eye and upwards: from where the sheet went, and from where it came."""
    way = (part.positions - part.reference).mean(0)
    length = np.linalg.norm(way)
    ahead = way / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    # Across, along the longer side where there is one.
    across = np.linalg.svd(ahead[None])[2][1:].T
    spread = across @ np.linalg.eigh(np.cov((part.reference @ across).T))[1]
    aside = spread[:, 0] + 0.6 * spread[:, 1]
    aside /= np.linalg.norm(aside)
    return [(_ASIDE * aside + sign * _AHEAD * ahead, sign * ahead) for sign in (1.0, -1.0)]


def _draw(plotter: Any, part: Any, limits: tuple[float, float], *, last: bool) -> None:
    place = {"vertical": True, "width": 0.05, "height": 0.7, "position_x": 0.9, "position_y": 0.15}
    bar = {"title": "wall [mm]", "color": "#202020", "fmt": "%.3g", "title_font_size": 24, "label_font_size": 22}
    smooth = {"smooth_shading": True, "split_sharp_edges": True, "feature_angle": _CREASE}
    shine = {"specular": 0.25, "specular_power": 20.0, "ambient": 0.15}
    bars = {"show_scalar_bar": last, "scalar_bar_args": bar | place if last else None}
    plotter.add_mesh(part, scalars="wall", clim=limits, cmap="viridis", **smooth, **shine, **bars)
    lines = part.contour(np.linspace(*limits, _LINES + 2)[1:-1], scalars="wall")
    if lines.n_points:
        drawn = plotter.add_mesh(lines, color="#202020", line_width=2.0, opacity=0.5)
        # In front of the surface that they lie in.
        drawn.mapper.SetResolveCoincidentTopologyToPolygonOffset()
        drawn.mapper.SetRelativeCoincidentTopologyLineOffsetParameters(-2.0, -2.0)


def _look(plotter: Any, part: Any, eye: Array, up: Array) -> None:
    center = np.asarray(part.center)
    plotter.camera_position = [tuple(center + eye * part.length), tuple(center), tuple(up)]
    plotter.reset_camera(bounds=part.bounds)
    plotter.camera.zoom(0.95)


def _write(plotter: Any, path: Path) -> None:
    from matplotlib.image import imsave

    try:
        pixels = plotter.screenshot(return_img=True)
    except RuntimeError as error:
        problem = f"cannot render on this machine ({str(error).splitlines()[0]})"
        raise InputError(problem, "install Mesa, or draw on a machine with a display", "render") from None
    imsave(path, pixels, format="png")
