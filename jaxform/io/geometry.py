"""Sheets and molds of scene files; meshes that take long are kept between runs."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxform.core import disk
from jaxform.core.errors import InputError
from jaxform.core.store import Arrays, Store
from jaxform.io import previous_results, schema
from jaxform.io.scene_text import COVERS
from jaxform.mesh import meshes, shapes
from jaxform.mesh.profiles import Profile
from jaxform.model.part import Part, make_part, select_mold_files
from jaxform.tools import molds, motion, rims
from jaxform.tools.distances import TriangleSurface
from jaxform.tools.mold import Mold, make_mold
from jaxform.tools.slivers import Merged, has_slivers, merge_slivers

if TYPE_CHECKING:
    from jaxform.io.files import SceneDocument

_SAME = 1e-6  # of the mold's size: middles of triangles that are as near are those of one triangle


@contextlib.contextmanager
def error_context(file: str, key: str = "") -> Iterator[None]:
    """Errors inside name the file, and the key."""
    try:
        yield
    except InputError as error:
        raise error.with_context(file=file, key=key) from None


def build_sheet(
    document: SceneDocument, store: Store | None = None, find_mold: Callable[[], Mold | None] | None = None
) -> shapes.Sheet:
    """The sheet of a document.

    One whose outline is filled with elements takes half a second, and is kept: but not where it is refined, for that
    asks the outline where new nodes belong.

    Args:
        document: The scene.
        store: Store for the sheet; none by default.
        find_mold: Gives the document's mold, where it is there already or will be needed again.
    """
    find_mold = find_mold or functools.cache(lambda: build_mold(document, store))
    table, meshed = document.model.parison, schema.Outline | schema.BottleHalfParison
    if store is None or document.model.refinement is not None or not isinstance(table, meshed):
        return _make_shape(document, find_mold)
    depends: list[Any] = [table.model_dump(exclude={"thickness", "temperature"})]
    if isinstance(table, schema.Outline) and table.polygon is None and (mold := find_mold()) is not None:
        depends += [np.asarray(mold.vertices), np.asarray(mold.triangles)]
    kept = store.arrays("sheet", tuple(depends), lambda: _arrays(_make_shape(document, find_mold)))
    return shapes.Sheet(kept["positions"], kept["triangles"], kept["clamped"], kept["fixed"])


def _arrays(shape: shapes.Sheet | molds.MoldShape) -> Arrays:
    """The arrays of a shape, by name."""
    return {name: value for name, value in vars(shape).items() if isinstance(value, np.ndarray)}


def _make_shape(document: SceneDocument, find_mold: Callable[[], Mold | None]) -> shapes.Sheet:
    table = document.model.parison
    if isinstance(table, schema.FileParison):
        with error_context("", "parison.path"):
            path = disk.expand_path(table.path, document.folder)
            mesh = meshes.read_mesh(path, scale=table.scale)
            previous_results.check_planes(path, table.scale, table.planes)
            return shapes.from_mesh(mesh, flip=table.flip, clamp=table.clamp, planes=table.planes)
    if isinstance(table, schema.RectangleTable):
        return shapes.rectangle(
            size=table.size,
            element_size=table.element_size,
            elements=table.elements,
            symmetry=table.symmetry,
        )
    if isinstance(table, schema.Sphere):
        return shapes.sphere(
            radius=table.radius,
            element_size=table.element_size,
            elements=table.elements,
            symmetry=table.symmetry,
        )
    if isinstance(table, schema.Outline):
        size = {"element_size": table.element_size, "elements": table.elements}
        if table.polygon is not None:
            return shapes.outline(polygon=table.polygon, planes=table.planes, **size)
        mold = find_mold()
        if mold is None:
            raise InputError("there is no mold", "add [mold], or give polygon", "parison.mold_rim", True)
        return rims.sheet_over_opening(np.asarray(mold.vertices, float), np.asarray(mold.triangles), **size)
    if isinstance(table, schema.BottleHalfParison):
        return shapes.bottle_half(**table.model_dump(exclude={"shape", "thickness", "temperature"}))
    size = table.element_size
    local = build_profile(size, "parison.element_size") if isinstance(size, schema.ProfileTable) else size
    return shapes.disc(radius=table.radius, element_size=local, elements=table.elements, symmetry=table.symmetry)


def build_profile(table: schema.ProfileTable, key: str) -> Profile:
    """A profile of positive numbers from its table."""
    return Profile(table.along, tuple(table.at), tuple(table.value), key).positive()


def _paths(table: schema.FileMold) -> list[str]:
    return [table.path] if isinstance(table.path, str) else list(table.path)


def _shape_of_files(document: SceneDocument, table: schema.FileMold, names: Sequence[str]) -> molds.MoldShape:
    """A mold of files of these names, as its table places them."""
    with error_context("", "mold.path"):
        parts = [meshes.read_mesh(disk.expand_path(name, document.folder), scale=table.scale) for name in names]
        mesh = parts[0] if len(parts) == 1 else meshes.merge(parts)
        return molds.from_mesh(mesh, translate=table.translate, rotate=table.rotate)


def build_part(document: SceneDocument, mold: Mold | None, store: Store | None = None) -> Part | None:
    """The part of the formed sheet that the document's [part] selects; None without one.

    Raises:
        InputError: It names a file that is none of the mold's, or the box has no inside.
    """
    table = document.model.part
    if table is None:
        return None
    trim = None if table.trim is None else (table.trim.axis, table.trim.at, table.trim.keep)
    walls = None if table.molds is None else _wall_triangles(document, table.molds, mold, store)
    return make_part(box=table.box, trim=trim, walls=walls)


def cover_triangles(document: SceneDocument, mold: Mold | None, store: Store | None = None) -> Any:
    """Mask of the mold's triangles (n_triangle,) that `jaxform new` made to cover holes; None where there are none."""
    table = document.model.mold
    if mold is None or not isinstance(table, schema.FileMold):
        return None
    names = _paths(table)
    covers = [name for name in names if Path(name).name == COVERS]
    return _triangles_of_files(document, table, covers, mold, store) if covers else None


def _wall_triangles(document: SceneDocument, wanted: Sequence[str], mold: Mold | None, store: Store | None) -> Any:
    """Mask of the mold's triangles (n_triangle,) that belong to the wanted files."""
    table = document.model.mold
    if mold is None or not isinstance(table, schema.FileMold):
        raise InputError("there is no mold of files", "give part.box or part.trim instead", "part.molds", list(wanted))
    names = _paths(table)
    return _triangles_of_files(document, table, [names[k] for k in select_mold_files(names, wanted)], mold, store)


def _triangles_of_files(
    document: SceneDocument, table: schema.FileMold, names: Sequence[str], mold: Mold, store: Store | None
) -> Any:
    """Mask of the mold's triangles (n_triangle,) that belong to files of these names."""
    chosen = _shape_of_files(document, table, names)
    whole = _shape_of_files(document, table, _paths(table))
    merged = _merge_slivers(whole, store)
    # Triangles are identified by their centroids, which do not depend on welding or on triangles left out.
    middles, near = _centroids(whole), _SAME * meshes.size(whole.vertices)
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    own = KDTree(_centroids(chosen)).query(middles, distance_upper_bound=near)[0] <= near
    # The mold's triangles are the merged ones, without degenerate ones.
    return own[merged.source[KDTree(_centroids(merged)).query(_centroids(mold))[1]]]


def _centroids(surface: TriangleSurface) -> Any:
    """The centroids of the triangles (n, 3) [m]."""
    return np.asarray(surface.vertices, float)[np.asarray(surface.triangles)].mean(1)


def _merge_slivers(shape: molds.MoldShape, store: Store | None) -> Merged:
    """The mold's surface with its slivers merged, which is kept; unchanged where it has few."""

    def merge() -> Merged:
        return merge_slivers(shape.vertices, shape.triangles)

    if not has_slivers(shape.vertices, shape.triangles):
        return merge()
    return Merged(**(store or Store()).arrays("merged", (shape.vertices, shape.triangles), lambda: merge()._asdict()))


def build_mold(document: SceneDocument, store: Store | None = None) -> Mold | None:
    """The mold of a document, or None."""
    table = document.model.mold
    if table is None:
        return None
    if isinstance(table, schema.RevolvedMold):
        shape = molds.revolved(profile=table.profile, segments=table.segments)
    elif isinstance(table, schema.BoxInsertMold):
        shape = molds.box_insert(**table.model_dump(exclude={"shape", "motion", "fill"}))
    elif isinstance(table, schema.BottleHalfMold):
        numbers = table.model_dump(exclude={"shape", "motion", "fill"})
        kept = (store or Store()).arrays("bottle", (numbers,), lambda: _arrays(molds.bottle_half(**numbers)))
        shape = molds.MoldShape(kept["vertices"], kept["triangles"])
    else:
        shape = _shape_of_files(document, table, _paths(table))
    if isinstance(table, schema.FileMold | schema.RevolvedMold):
        merged = _merge_slivers(shape, store)
        shape = molds.MoldShape(merged.vertices, merged.triangles, shape.dropped)
    moves = None if table.motion is None else motion.make_motion(**table.motion.model_dump())
    return make_mold(shape.vertices, shape.triangles, shape.dropped, moves)
