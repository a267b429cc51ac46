"""Sheets, molds and nodal fields of scene files; meshes that take long are kept between runs."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core import disk
from jaxform.core.errors import InputError
from jaxform.core.store import Arrays, Store
from jaxform.io import previous_results, schema
from jaxform.io.scene_text import COVERS
from jaxform.mesh import meshes, shapes
from jaxform.mesh.grids import Profile
from jaxform.mesh.meshes import Mesh
from jaxform.model.part import Part, make_part, select_mold_files
from jaxform.tools import footprint, mold, molds, parting
from jaxform.tools.contact_law import ContactLaw, make_contact_law
from jaxform.tools.distances import Distances, interpolate, weights
from jaxform.tools.mold import Mold, make_mold
from jaxform.tools.slivers import collapse_short_sides, has_slivers

if TYPE_CHECKING:
    from jaxform.io.files import SceneDocument

Array = NDArray[np.float64]

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
    """The sheet of a document, on the mesh that it names or that is adapted to its wall, where it asks for one.

    Args:
        document: The scene.
        store: Store for the sheet; none by default.
        find_mold: Gives the document's mold, where it is there already or will be needed again.
    """
    table = document.model.parison
    sheet = _unmeshed_sheet(document, store, find_mold or functools.cache(lambda: build_mold(document, store)))
    if table.mesh is not None:
        with error_context("", "parison.mesh"):
            sheet = read_sheet_mesh(sheet, disk.expand_path(table.mesh, document.folder))
    if table.adapt is None:
        return sheet
    from jaxform.io.adaptation import adapt_sheet  # runs scenes, whose sheets are made here

    return adapt_sheet(document, sheet, store)


def _unmeshed_sheet(document: SceneDocument, store: Store | None, find_mold: Callable[[], Mold | None]) -> shapes.Sheet:
    """The sheet with its own triangles.

    One whose outline is filled with elements takes half a second, and is kept: but not where it is refined or meshed
    anew, for that asks the outline where new nodes belong.
    """
    table, meshed = document.model.parison, schema.Outline | schema.BottleHalfParison
    anew = document.model.refinement is not None or table.mesh is not None or table.adapt is not None
    if store is None or anew or not isinstance(table, meshed):
        return _make_shape(document, find_mold)
    depends: list[Any] = [table.model_dump(exclude={"thickness", "temperature", "clamp_until"})]
    if isinstance(table, schema.Outline) and table.polygon is None and (mold := find_mold()) is not None:
        depends += [np.asarray(mold.vertices), np.asarray(mold.triangles)]
    kept = store.arrays("sheet", tuple(depends), lambda: _arrays(_make_shape(document, find_mold)))
    return shapes.Sheet(kept["positions"], kept["triangles"], kept["clamped"], kept["fixed"])


_HOLDS = ("clamped", "fixed_x", "fixed_y", "fixed_z")
"""Nodal fields of a sheet's mesh file: how its nodes are held, 1 or 0."""


def sheet_fields(sheet: shapes.Sheet) -> dict[str, Array]:
    """The nodal fields (n_node,) of a sheet's mesh file: its own, and how its nodes are held."""
    return sheet.fields | dict(zip(_HOLDS, np.stack([sheet.clamped, *sheet.fixed.T]).astype(float), strict=True))


def read_sheet_mesh(sheet: shapes.Sheet, path: Path) -> shapes.Sheet:
    """The sheet on the mesh of a file that `sheet_fields` are in.

    Raises:
        InputError: It is no mesh, lacks a field, or is not a mesh of this sheet.
    """
    mesh = meshes.read_mesh(path)
    lacking = [name for name in _HOLDS if name not in mesh.fields]
    if lacking:
        raise InputError(
            f"has no nodal field {lacking[0]}", "give the file that `jaxform adapt` wrote", value=str(path)
        )
    clamped, *fixed = (mesh.fields[name] != 0.0 for name in _HOLDS)
    shapes.check_surface(mesh)
    fields = {name: values for name, values in mesh.fields.items() if name not in _HOLDS}
    made = replace(
        sheet,
        positions=mesh.positions,
        triangles=mesh.triangles.astype(np.int32),
        clamped=clamped,
        fixed=np.stack(fixed, axis=1),
        fields=fields,
    )
    for one, other in ((sheet, made), (made, sheet)):
        size = meshes.size(one.positions)
        away = Distances(one.positions, one.triangles, size).nearest(other.positions).distance.max()
        if away > FARTHEST * size:
            problem = f"is not a mesh of this sheet: they are up to {away:.3g} m apart"
            raise InputError(problem, "run `jaxform adapt` again, or leave it out", value=str(path))
    return made


def _arrays(shape: shapes.Sheet | molds.MoldShape) -> Arrays:
    """The arrays of a shape, by name."""
    return {name: value for name, value in vars(shape).items() if isinstance(value, np.ndarray)}


_BUILT_IN: dict[type, Callable[..., shapes.Sheet]] = {
    schema.RectangleTable: shapes.rectangle,
    schema.Sphere: shapes.sphere,
    schema.Tube: shapes.tube,
    schema.Preform: shapes.preform,
    schema.BottleHalfParison: shapes.bottle_half,
}
"""Sheets whose keys are the arguments of a function."""


def _make_shape(document: SceneDocument, find_mold: Callable[[], Mold | None]) -> shapes.Sheet:
    table = document.model.parison
    if isinstance(table, schema.FileParison):
        with error_context("", "parison.path"):
            path = disk.expand_path(table.path, document.folder)
            mesh = meshes.read_mesh(path, scale=table.scale)
            previous_results.check_planes(path, table.scale, table.planes)
            return shapes.from_mesh(mesh, flip=table.flip, clamp=table.clamp, planes=table.planes)
    if not isinstance(table, schema.Disc | schema.Outline):
        given = table.model_dump(
            exclude={"shape", "thickness", "temperature", "pre_stretch", "radius", "mesh", "adapt", "clamp_until"}
        )
        if (radius := getattr(table, "radius", None)) is not None:
            local = isinstance(radius, schema.ProfileTable)
            given["radius"] = build_profile(radius, "parison.radius") if local else radius
        return _BUILT_IN[type(table)](**given)
    if isinstance(table, schema.Outline):
        size = {"element_size": table.element_size, "elements": table.elements}
        if table.polygon is not None:
            return shapes.outline(polygon=table.polygon, planes=table.planes, **size)
        mold = find_mold()
        if mold is None:
            raise InputError("there is no mold", "add [mold], or give polygon", "parison.mold_rim", True)
        return footprint.sheet_over_opening(np.asarray(mold.vertices, float), np.asarray(mold.triangles), **size)
    size = table.element_size
    local = build_profile(size, "parison.element_size") if isinstance(size, schema.ProfileTable) else size
    return shapes.disc(radius=table.radius, element_size=local, elements=table.elements, symmetry=table.symmetry)


def build_profile(table: schema.ProfileTable, key: str) -> Profile:
    """A profile of positive numbers from its table."""
    return Profile(table.along, tuple(table.at), tuple(table.value), key).positive()


ReadMesh = Callable[..., meshes.Mesh]


def _paths(table: schema.MeshFile) -> list[str]:
    return [table.path] if isinstance(table.path, str) else list(table.path)


def _shape_of_files(
    document: SceneDocument, table: schema.MeshFile, names: Sequence[str], read: ReadMesh
) -> molds.MoldShape:
    """A surface of files of these names, as its table places them."""
    with error_context("", "mold.path"):
        parts = [read(disk.expand_path(name, document.folder), scale=table.scale) for name in names]
        mesh = parts[0] if len(parts) == 1 else meshes.merge(parts)
        assert isinstance(table, schema.PlacedTable)
        return molds.from_mesh(mesh, translate=table.translate, rotate=table.rotate)


def build_part(
    document: SceneDocument, mold: Mold | None, store: Store | None = None, read: ReadMesh = meshes.read_mesh
) -> Part | None:
    """The part of the formed sheet: what the document's [part] selects, without flash; None where it is all of it.

    Args:
        document: The document.
        mold: Its mold.
        store: The store of merged slivers.
        read: Reads a mold's file of a path and a scale.

    Raises:
        InputError: It names a file that is none of the mold's, or the box has no inside.
    """
    table = document.model.part
    keep_flash = table is not None and table.flash
    surfaces = [document.model.mold, *document.model.tool]
    cavities = [None if keep_flash else _cavity_triangles(document, each, store, read) for each in surfaces]
    trim = None if table is None or table.trim is None else (table.trim.axis, table.trim.at, table.trim.keep)
    walls = None
    if table is not None and table.molds is not None:
        walls = _wall_triangles(document, table.molds, mold, store, read)
    if cavities[0] is not None:
        walls = cavities[0] if walls is None else walls & cavities[0]
    tool_walls = cavities[1:] if any(each is not None for each in cavities[1:]) else ()
    box = None if table is None else table.box
    if box is None and trim is None and walls is None and not tool_walls:
        return None
    return make_part(box=box, trim=trim, walls=walls, tool_walls=tool_walls)


def _cavity_triangles(
    document: SceneDocument, table: schema.PlacedTable | None, store: Store | None, read: ReadMesh
) -> NDArray[np.bool_] | None:
    """Mask of a mold's or tool's triangles (n_triangle,) that are none of its land; None if it has no land."""
    if table is None or table.land is None:
        return None
    shape, land = _make_surface(document, table, store, read)
    made = make_mold(shape.vertices, shape.triangles)
    return np.arange(len(made.triangles)) < len(made.triangles) - land


def cover_triangles(document: SceneDocument, mold: Mold | None, store: Store | None = None) -> Any:
    """Mask of the mold's triangles (n_triangle,) that `jaxform new` made to cover holes; None where there are none."""
    table = document.model.mold
    if mold is None or not isinstance(table, schema.FileMold):
        return None
    names = _paths(table)
    covers = [name for name in names if Path(name).name == COVERS]
    return _triangles_of_files(document, table, covers, mold, store, meshes.read_mesh) if covers else None


def _wall_triangles(
    document: SceneDocument, wanted: Sequence[str], mold: Mold | None, store: Store | None, read: ReadMesh
) -> Any:
    """Mask of the mold's triangles (n_triangle,) that belong to the wanted files."""
    table = document.model.mold
    if mold is None or not isinstance(table, schema.FileMold):
        raise InputError("there is no mold of files", "give part.box or part.trim instead", "part.molds", list(wanted))
    names = _paths(table)
    chosen = [names[k] for k in select_mold_files(names, wanted)]
    return _triangles_of_files(document, table, chosen, mold, store, read)


def _triangles_of_files(
    document: SceneDocument,
    table: schema.FileMold,
    names: Sequence[str],
    mold: Mold,
    store: Store | None,
    read: ReadMesh,
) -> Any:
    """Mask of the mold's triangles (n_triangle,) that belong to files of these names."""
    read = functools.cache(read)
    chosen = _shape_of_files(document, table, names, read)
    whole = _shape_of_files(document, table, _paths(table), read)
    merged, source = _merge_slivers(whole, store)
    # Triangles are identified by their centroids, which do not depend on welding or on triangles left out.
    middles, near = _centroids(whole), _SAME * meshes.size(whole.vertices)
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    in_part = KDTree(_centroids(chosen)).query(middles, distance_upper_bound=near)[0] <= near
    # The mold's triangles are the merged ones, without degenerate ones.
    return in_part[source[KDTree(_centroids(merged)).query(_centroids(mold))[1]]]


def _centroids(surface: molds.MoldShape | Mold) -> Any:
    """The centroids of the triangles (n, 3) [m]."""
    return np.asarray(surface.vertices, float)[np.asarray(surface.triangles)].mean(1)


def _merge_slivers(shape: molds.MoldShape, store: Store | None) -> tuple[molds.MoldShape, Any]:
    """The surface with its slivers merged, which is kept, and the number (m,) that each triangle had before."""
    if not has_slivers(shape.vertices, shape.triangles):
        return shape, np.arange(len(shape.triangles))

    def merge() -> dict[str, Any]:
        vertices, triangles, source = collapse_short_sides(shape.vertices, np.asarray(shape.triangles, np.int64))
        return {"vertices": vertices, "triangles": triangles, "source": source}

    found = (store or Store()).arrays("merged", (shape.vertices, shape.triangles), merge)
    return molds.MoldShape(found["vertices"], found["triangles"], shape.dropped), found["source"]


def build_mold(document: SceneDocument, store: Store | None = None, read: ReadMesh = meshes.read_mesh) -> Mold | None:
    """The mold of a document, or None; `read` reads a file of a path and a scale."""
    table = document.model.mold
    if table is None:
        return None
    moves = None if table.motion is None else mold.make_motion(**table.motion.model_dump())
    return _build_surface(document, table, moves, store, read)


def build_tools(document: SceneDocument, store: Store | None = None, read: ReadMesh = meshes.read_mesh) -> list[Mold]:
    """The tools of a document besides its mold; `read` reads a file of a path and a scale."""
    made = []
    for number, table in enumerate(document.model.tool, 1):
        name = schema.tool_name(table, number)
        with _tool_errors(name):
            moves = None if table.motion is None else mold.make_motion(**table.motion)
            made.append(_build_surface(document, table, moves, store, read, name))
    return made


@contextlib.contextmanager
def _tool_errors(name: str) -> Iterator[None]:
    """Errors inside are about a tool of this name, and not about the mold."""
    try:
        yield
    except InputError as error:
        raise tool_error(error, name) from None


def tool_error(error: InputError, name: str) -> InputError:
    """An error about the mold as one about a tool, whose keys of motion are its own."""

    def rename(text: str) -> str:
        text = re.sub(r"\bmold\.(?:motion\.|contact\.)?(?=[a-z])", f"tool.{name}.", text)
        return text.replace("the mold", "the tool").replace("mold triangle", "triangle")

    key = re.sub(rf"^(?:mold|tool[ .]{re.escape(name)})(?:\.motion|\.contact(?=\.))?", f"tool.{name}", error.key)
    return replace(error, problem=rename(error.problem), remedy=rename(error.remedy), key=key)


@contextlib.contextmanager
def name_tools() -> Iterator[None]:
    """Errors inside about a tool of a scene name its keys as the scene file does."""
    try:
        yield
    except InputError as error:
        found = re.match(r"tool[ .]([\w-]+)", error.key)
        raise error if found is None else tool_error(error, found[1]) from None


_SHAPES: dict[type, Callable[..., molds.MoldShape]] = {
    schema.Revolved: molds.revolved,
    schema.BoxInsert: molds.box_insert,
    schema.BottleHalf: molds.bottle_half,
    schema.Rod: molds.rod,
    schema.Plate: molds.plate,
}
"""Surfaces whose keys are the arguments of a function."""


def _build_surface(
    document: SceneDocument,
    table: schema.PlacedTable,
    moves: mold.Motion | None,
    store: Store | None,
    read: ReadMesh,
    name: str = "",
) -> Mold:
    """The mold or a tool of this name from its table."""
    shape, _ = _make_surface(document, table, store, read)
    law = _contact_law(table)
    warmth = {key: getattr(table, key, None) for key in ("temperature", "heat_transfer")}
    return make_mold(shape.vertices, shape.triangles, shape.dropped, moves, law, name, **warmth)


def _contact_law(table: schema.PlacedTable) -> ContactLaw:
    """The contact law of a table."""
    friction = table.friction if table.contact == "coulomb" else None
    if isinstance(friction, schema.FrictionTable):
        return make_contact_law(table.contact, friction.value, temperature=friction.at)
    return make_contact_law(table.contact, friction)


def _make_surface(
    document: SceneDocument, table: schema.PlacedTable, store: Store | None, read: ReadMesh
) -> tuple[molds.MoldShape, int]:
    """The surface of a table, with the triangles of its land last, and their number."""
    if isinstance(table, schema.MeshFile):
        shape = _shape_of_files(document, table, _paths(table), read)
    else:
        kind = next(kind for kind in _SHAPES if isinstance(table, kind))
        numbers = table.model_dump(include=set(kind.model_fields) - {"shape"})
        shape = _built_in_shape(kind, numbers, store)
        shape = molds.placed(shape, translate=table.translate, rotate=table.rotate)
    if isinstance(table, schema.MeshFile | schema.Revolved):
        shape, _ = _merge_slivers(shape, store)
    return (shape, 0) if table.land is None else parting.add_land(shape, table.land)


def _built_in_shape(kind: type, numbers: dict[str, Any], store: Store | None) -> molds.MoldShape:
    if kind is not schema.BottleHalf:
        return _SHAPES[kind](**numbers)
    kept = (store or Store()).arrays("bottle", (numbers,), lambda: _arrays(_SHAPES[kind](**numbers)))
    return molds.MoldShape(kept["vertices"], kept["triangles"])


# Nodal fields in mesh files, carried over to another mesh by initial position.


SAME_PLACE = 1e-9
"""Distance up to which two nodes are at the same place, relative to the size of the field's mesh."""
FARTHEST = 0.05
"""Distance from the field's mesh beyond which nothing is known, relative to its size."""


def nodal_field(path: str | Path, name: str, positions: Array, key: str = "") -> Array:
    """A field of a mesh file at other places: exactly where nodes agree, linear in the nearest triangle elsewhere.

    Args:
        path: The file; its positions are initial positions in m, or it has such as point data `reference` [m].
        name: The field, point data of one number per node.
        positions: Positions at which it is evaluated [m], shape (n, 3).
        key: Key that names the file, for messages.

    Returns:
        The field, shape (n,), in the unit of the file.

    Raises:
        InputError: The file is no mesh, has no such field, or is not at those positions.
    """
    try:
        mesh = meshes.drop_unused_nodes(meshes.read_mesh(path))
        if name in mesh.cell_fields:
            # The mean over the triangles around a node wants all of them to know it.
            mesh = meshes.weld(mesh)
        values = _values(mesh, name, f"{key}.field" if key else "field")
        return transfer_values(_at_initial_positions(mesh, positions), values, positions)
    except InputError as error:
        raise error.with_context(key=f"{key}.file" if key else "file") from None


def _at_initial_positions(mesh: Mesh, positions: Array) -> Mesh:
    """A formed mesh at its initial positions, unless the places (n, 3) [m] are nodes of it as it is formed."""
    if not all(name in mesh.fields for name in meshes.REFERENCE):
        return mesh
    initial = np.stack([mesh.fields[name] for name in meshes.REFERENCE], axis=1)
    same = _tree(mesh.positions).query(positions)[0] <= SAME_PLACE * meshes.size(mesh.positions)
    # A sheet that is formed a second time is this mesh itself.
    return mesh if same.all() or not np.isfinite(initial).all() else replace(mesh, positions=initial)


def _values(mesh: Mesh, name: str, key: str) -> Array:
    known = meshes.nodal_fields(mesh)
    if name not in known:
        raise InputError("the file has no such field", f"its fields: {', '.join(sorted(known)) or 'none'}", key, name)
    if not np.isfinite(known[name]).all():
        raise InputError("the field is not finite everywhere", "repair the file", key, name)
    return known[name]


def transfer_values(mesh: Mesh, values: Array, positions: Array) -> Array:
    """Nodal values (n_node,) of a mesh at other places (n, 3) [m], as `nodal_field` carries them over.

    Raises:
        InputError: The mesh is not at those places, or nothing of it has an area.
    """
    size = meshes.size(mesh.positions)
    apart, node = _tree(mesh.positions).query(positions)
    result = values[node]
    elsewhere = np.flatnonzero(apart > SAME_PLACE * size)
    if len(elsewhere):
        triangles = mesh.triangles[~meshes.find_degenerate(mesh.positions, mesh.triangles)]
        if not len(triangles):
            raise InputError("has no triangle with an area", "give a mesh of the initial sheet, in metres")
        found = Distances(mesh.positions, triangles, FARTHEST * size).nearest(positions[elsewhere])
        worst = int(np.argmax(found.distance))
        if found.distance[worst] > FARTHEST * size:
            place = ", ".join(f"{x:.4g}" for x in positions[elsewhere[worst]])
            problem = f"does not cover ({place}) m: its mesh is {found.distance[worst]:.3g} m away"
            raise InputError(problem, "give a mesh of the initial sheet, in metres")
        weight = weights(found.place, mesh.positions[triangles[found.triangle]])
        result[elsewhere] = interpolate(values, triangles, found.triangle, weight)
    return result


def _tree(points: Array) -> Any:
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    return KDTree(points)
