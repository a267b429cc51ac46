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
from jaxform.core.errors import InputError, warn_of
from jaxform.core.store import Arrays, Store
from jaxform.io import previous_results, schema
from jaxform.io.scene_text import COVERS
from jaxform.mesh import meshes, shapes
from jaxform.mesh.bisection import number_regions
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
    if document.model.regional_gases:
        sheet = _hold_borders(document, sheet)
    if table.adapt is None:
        return sheet
    from jaxform.io.adaptation import adapt_sheet  # runs scenes, whose sheets are made here

    return adapt_sheet(document.mesh_of or document, sheet, store)


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
        cell_fields={},
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
        if isinstance(table, schema.RectangleTable):
            given["lines"] = [[place for one, place in _border_places(document) if one == axis] for axis in "xy"]
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


# Regions of the sheet that gases push, and their borders.

_BESIDE = 0.01  # of an element's side: borders that are as near to their place are there


def gas_regions(document: SceneDocument, sheet: shapes.Sheet) -> dict[str, NDArray[np.bool_]]:
    """The elements (n_element,) of a sheet that the gas of each region pushes, by name: those with a centroid there.

    Raises:
        InputError: A region is empty, or the mesh has no field of its name.
    """
    middles, found = sheet.positions[sheet.triangles].mean(1), {}
    for name, gas in document.model.regional_gases.items():
        own = np.ones(len(sheet.triangles), bool)
        if isinstance(gas.region, str):
            own = _marked_elements(sheet, gas.region, f"gas.{name}.region")
        for one in _conditions(gas.region):
            place = _place(one.along, middles)
            own &= (place >= one.between[0]) & (place < one.between[1])
        if not own.any():
            raise _empty_region_error(name, gas.region, sheet)
        found[name] = own
    return found


def _conditions(region: Any) -> list[schema.RegionTable]:
    return region if isinstance(region, list) else [] if region is None or isinstance(region, str) else [region]


def _place(along: str, positions: Array) -> Array:
    return Profile(along, (0.0,), (1.0,), "gas.region").coordinate(positions)


def _border_places(document: SceneDocument) -> list[tuple[str, float]]:
    """Places [m] that bound the conditions of regions, with their axes; each once."""
    conditions = [one for gas in document.model.regional_gases.values() for one in _conditions(gas.region)]
    return list(dict.fromkeys((one.along, place) for one in conditions for place in one.between))


def _empty_region_error(name: str, region: Any, sheet: shapes.Sheet) -> InputError:
    value = [one.model_dump() for one in region] if isinstance(region, list) else region
    if isinstance(region, schema.RegionTable):
        value = region.model_dump()
    spans = [
        f"{one.along} from {p.min():.4g} to {p.max():.4g} m"
        for one in _conditions(region)
        for p in [_place(one.along, sheet.positions)]
    ]
    remedy = f"the sheet has {', '.join(spans)}" if spans else "choose a value that the field has"
    return InputError("holds the centroid of no element", remedy, f"gas.{name}.region", value)


def _marked_elements(sheet: shapes.Sheet, region: str, key: str) -> NDArray[np.bool_]:
    """The elements at which a field has a value, or is not 0 where none is given; of a nodal field at all nodes."""
    name, _, number = region.removeprefix("field:").partition("=")
    values = sheet.cell_fields.get(name)
    if values is None:
        if name not in sheet.fields:
            known = ", ".join(sorted({*sheet.fields, *sheet.cell_fields})) or "none"
            raise InputError("the mesh has no such field", f"its fields: {known}", key, region)
        values = sheet.fields[name][sheet.triangles].T
    marked = np.isclose(values, float(number)) if number else values != 0.0
    return marked if marked.ndim == 1 else marked.all(0)


def _hold_borders(document: SceneDocument, sheet: shapes.Sheet) -> shapes.Sheet:
    """The sheet with its nodes on the borders of regions clamped, and, unless it is a mesh file, edges along these.

    Pressures on both sides of a border differ, so that something holds the sheet there: a clamp grid, or the web
    between two cavities. Nothing else keeps a border from sweeping volume, which belongs to no gas.
    """
    table = document.model.parison
    free = not isinstance(table, schema.FileParison) and table.mesh is None
    places = _border_places(document)
    if free and not isinstance(table, schema.RectangleTable):
        for along, place in places:
            sheet = shapes.cut_sheet(sheet, lambda points, along=along, place=place: _place(along, points) - place)
    masks = np.stack(list(gas_regions(document, sheet).values()))
    held = shapes.clamp_borders(sheet, number_regions(masks), cut=free)
    if not free and places:
        _warn_of_ragged_borders(sheet, held, places)
    if held.clamped.all():
        key = f"gas.{next(iter(document.model.regional_gases))}.region"
        raise InputError("leaves no node that is not clamped", "make elements smaller, or regions larger", key)
    return held


def _warn_of_ragged_borders(sheet: shapes.Sheet, held: shapes.Sheet, places: list[tuple[str, float]]) -> None:
    """Warns where the mesh of a file has no edges on the borders of regions, so that these follow its edges beside."""
    border = sheet.positions[held.clamped & ~sheet.clamped]
    if not len(border):
        return
    away = np.min([np.abs(_place(along, border) - place) for along, place in places], axis=0)
    corners = sheet.positions[sheet.triangles]
    side = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    if away.max() > _BESIDE * side:
        problem = f"has borders without edges of the mesh on them: the clamp is up to {away.max():.3g} m beside them"
        warn_of(problem, "give a mesh with edges on the borders, or mark the regions by a field", key="gas.region")


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
    """The part of the formed sheet that the document's [part] selects, without flash; None for the whole sheet.

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
    """An error about a surface with its key of the mold as one with the key of a tool, whose motion has no table."""
    key = re.sub(rf"^(?:mold|tool[ .]{re.escape(name)})(?:\.motion|\.contact(?=\.))?", f"tool.{name}", error.key)
    return replace(error, key=key)


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
