"""Sheets and molds of scene files; what takes long to mesh is kept between runs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxform.core import disk
from jaxform.core.errors import InputError
from jaxform.core.store import Arrays, Store
from jaxform.io import earlier, schema
from jaxform.mesh import meshes, shapes
from jaxform.mesh.profiles import Profile
from jaxform.tools import molds, motion, rims
from jaxform.tools.mold import Mold, make_mold

if TYPE_CHECKING:
    from jaxform.io.files import SceneDocument


@contextlib.contextmanager
def told_of(file: str, key: str = "") -> Iterator[None]:
    """Errors inside name the file, and the key."""
    try:
        yield
    except InputError as error:
        raise error.within(file=file, key=key) from None


def sheet_of(document: SceneDocument, store: Store | None = None) -> shapes.Sheet:
    """The sheet of a document.

    One whose outline is filled with elements takes half a second, and is kept: but not where it is refined, for that
    asks the outline where new nodes belong.
    """
    table = document.model.parison
    if document.model.refinement is not None or not isinstance(table, schema.Outline | schema.BottleHalfParison):
        return _made(document, store)
    depends: list[Any] = [table.model_dump(exclude={"thickness", "temperature"})]
    if isinstance(table, schema.Outline) and table.polygon is None:
        mold = mold_of(document, store)
        depends += [] if mold is None else [np.asarray(mold.vertices), np.asarray(mold.triangles)]
    return shapes.Sheet(**_kept(store, "sheet", depends, lambda: _arrays(_made(document, store))))


def _kept(store: Store | None, name: str, depends: Any, make: Callable[[], Arrays]) -> dict[str, Any]:
    """The arrays of a shape, which are made once."""
    key = tuple(depends) if isinstance(depends, list) else (depends,)
    return dict(make() if store is None else store.arrays(name, key, make))


def _arrays(shape: shapes.Sheet | molds.MoldShape) -> Arrays:
    """What a shape is made of, but for what it would do."""
    return {name: value for name, value in vars(shape).items() if isinstance(value, np.ndarray)}


def _made(document: SceneDocument, store: Store | None) -> shapes.Sheet:
    table = document.model.parison
    if isinstance(table, schema.FileParison):
        with told_of("", "parison.path"):
            path = disk.located(table.path, document.folder)
            mesh = meshes.read_mesh(path, scale=table.scale)
            earlier.look_at_planes(path, table.scale, table.planes)
            return shapes.from_mesh(mesh, flip=table.flip, clamp=table.clamp, planes=table.planes)
    if isinstance(table, schema.Rectangle):
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
        mold = mold_of(document, store)
        if mold is None:
            raise InputError("there is no mold", "add [mold], or give polygon", "parison.mold_rim", True)
        return rims.over_opening(np.asarray(mold.vertices, float), np.asarray(mold.triangles), **size)
    if isinstance(table, schema.BottleHalfParison):
        return shapes.bottle_half(**table.model_dump(exclude={"shape", "thickness", "temperature"}))
    size = table.element_size
    local = profile_of(size, "parison.element_size") if isinstance(size, schema.Profile) else size
    return shapes.disc(radius=table.radius, element_size=local, elements=table.elements, symmetry=table.symmetry)


def profile_of(table: schema.Profile, key: str) -> Profile:
    """A profile of positive numbers from its table."""
    return Profile(table.along, tuple(table.at), tuple(table.value), key).positive()


def mold_of(document: SceneDocument, store: Store | None = None) -> Mold | None:
    """The mold of a document, or None."""
    table = document.model.mold
    if table is None:
        return None
    if isinstance(table, schema.RevolvedMold):
        shape = molds.revolved(profile=table.profile, segments=table.segments)
    elif isinstance(table, schema.BoxInsertMold):
        shape = molds.box_insert(**table.model_dump(exclude={"shape", "motion"}))
    elif isinstance(table, schema.BottleHalfMold):
        numbers = table.model_dump(exclude={"shape", "motion"})
        shape = molds.MoldShape(**_kept(store, "bottle", numbers, lambda: _arrays(molds.bottle_half(**numbers))))
    else:
        with told_of("", "mold.path"):
            names = [table.path] if isinstance(table.path, str) else table.path
            parts = [meshes.read_mesh(disk.located(name, document.folder), scale=table.scale) for name in names]
            mesh = parts[0] if len(parts) == 1 else meshes.merged(parts)
            shape = molds.from_mesh(mesh, translate=table.translate, rotate=table.rotate)
    moves = None if table.motion is None else motion.make_motion(**table.motion.model_dump())
    return make_mold(shape.vertices, shape.triangles, shape.dropped, moves)
