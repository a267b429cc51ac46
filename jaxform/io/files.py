"""Scene and study files to objects and back."""

from __future__ import annotations

import contextlib
import csv
import functools
import hashlib
import io
import sys
import traceback
import types
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform import materials
from jaxform.core import disk
from jaxform.core.compilation import with_standard_promotion
from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real, check_untraced, parameter_ranges
from jaxform.core.ranges import check, current_keys
from jaxform.core.store import Store
from jaxform.io import catalog, geometry, schema
from jaxform.io.geometry import (
    build_mold,
    build_part,
    build_profile,
    build_sheet,
    build_tools,
    error_context,
    name_tools,
)
from jaxform.io.scene_checks import warn_of_scene, warn_of_thin_features
from jaxform.io.validation import validate
from jaxform.loads import Loading, make_gas, make_pressure, make_regional_load, make_two_sided_load
from jaxform.materials import LAWS, Law
from jaxform.mesh import bisection, meshes, shapes
from jaxform.mesh.grids import Profile
from jaxform.model.scene import Parison, Refinement, Scene, make_parison, make_refinement, make_solver
from jaxform.prepare.scene_builder import build_scene

REFERENCE_COLUMNS = ("initial_radius", "arc", "thickness_ratio")


@dataclass(frozen=True)
class SceneDocument:
    """A validated scene file.

    Attributes:
        file: Name in messages.
        folder: Base of its relative paths.
        data: Its tables, as in the file.
        model: The validated tables, with defaults filled in.
        path: Path of the file; None for a scene made of tables.
        mesh_of: The scene to whose wall `parison.adapt` adapts the mesh; None if it is this one.
    """

    file: str
    folder: Path
    data: dict[str, Any]
    model: schema.SceneFile
    path: Path | None = None
    mesh_of: SceneDocument | None = None

    @property
    def name(self) -> str:
        """The scene's name; that of the file where it gives none."""
        return self.model.name or Path(self.file).stem

    def __reduce__(self) -> Any:
        """A copy for another process: its tables, which are validated again there."""
        return validate_scene, (self.data, self.file, self.folder, self.path, self.mesh_of)


@dataclass(frozen=True)
class StudyDocument:
    """A validated study file.

    Attributes:
        file: Name in messages.
        folder: Base of its relative paths.
        data: Its tables, as in the file.
        model: The validated tables, with defaults filled in.
        scene: The scene that it varies.
    """

    file: str
    folder: Path
    data: dict[str, Any]
    model: schema.StudyFile
    scene: SceneDocument


def load(name_or_path: str | Path) -> Scene:
    """A scene, built from a built-in name or a TOML file, with all host work done.

    Raises:
        InputError: There is no such scene, or something in it cannot be simulated.
    """
    return build(read_scene(name_or_path))


def read_scene(name_or_path: str | Path, folder: Path | None = None) -> SceneDocument:
    """A scene file, validated but not built.

    Args:
        name_or_path: A built-in name or the path of a TOML file.
        folder: Base of a relative path; by default the working directory.

    Raises:
        InputError: There is no such scene, or a key or value in it is wrong.
    """
    file, path, data = catalog.read(name_or_path, "scene", folder)
    return validate_scene(data, file, path.resolve().parent, path)


def validate_scene(
    tables: dict[str, Any], file: str, folder: Path, path: Path | None = None, mesh_of: SceneDocument | None = None
) -> SceneDocument:
    """The validated tables of a scene.

    Args:
        tables: The tables.
        file: Name in messages.
        folder: Base of relative paths.
        path: Path of the file; None for a scene made of tables.
        mesh_of: The scene to whose wall an adapted mesh is adapted; None if it is this one.

    Raises:
        InputError: A key or value is wrong.
    """
    import_models_of(tables, folder, file)
    if isinstance(tables.get("refinement"), dict):
        tables = tables | {"refinement": current_keys("refinement", tables["refinement"], file)}
    return SceneDocument(file, folder, tables, validate(schema.SceneFile, tables, file), path, mesh_of)


def read_study(name_or_path: str | Path) -> StudyDocument:
    """A study file and the scene that it names (a built-in name, or a path relative to the study), validated.

    Raises:
        InputError: There is no such study or scene, or a key or value in one of them is wrong.
    """
    file, path, data = catalog.read(name_or_path, "study")
    model = validate(schema.StudyFile, data, file)
    folder = path.resolve().parent
    with error_context(file, "scene"):
        scene = read_scene(model.scene, folder)
    return StudyDocument(file, folder, data, model, scene)


@with_standard_promotion
def build(document: SceneDocument, store: Store | None = None) -> Scene:
    """The scene of a document; host work.

    Args:
        document: The scene.
        store: Store for expensive host work between runs; none by default.

    Raises:
        InputError: A mesh cannot be read or simulated, or values do not fit together.

    Warns:
        InputWarning: The scene has a likely error, but can be simulated: units, a mold on the wrong side, open seams.
    """
    scene = build_unchecked(document, store)
    review_scene(scene, document)
    return scene


def review_scene(scene: Scene, document: SceneDocument) -> None:
    """Warns of likely errors in a document's scene that can be simulated."""
    warn_of_scene(scene, document.file, document.model)
    warn_of_thin_features(scene, document.file)


def build_unchecked(document: SceneDocument, store: Store | None = None, sheet: shapes.Sheet | None = None) -> Scene:
    """The scene of a document, like `build`, but without `review_scene`, which is left to the caller.

    Args:
        document: The scene.
        store: Store for expensive host work between runs; none by default.
        sheet: Its sheet on another mesh; by default on its own.
    """
    model = document.model
    with error_context(document.file), name_tools():
        solver = model.solver
        check_untraced()
        read = functools.cache(meshes.read_mesh)  # [part] asks for the mold's files again
        find_mold = functools.cache(lambda: build_mold(document, store, read))
        sheet = sheet or build_sheet(document, store, find_mold)
        refinement, forest = _refinement(document, sheet)
        grown = _extend_sheet(sheet, forest)
        parison = _parison(document, grown, forest)
        if forest is not None and parison.pre_stretch is not None:
            forest = replace(forest, positions=np.asarray(parison.positions, float))
        scene = build_scene(
            parison=parison,
            refinement=refinement,
            forest=forest,
            material=_material(document, grown),
            pressure=_loading(document, sheet),
            solver=make_solver(
                end_time=solver.end_time,
                damping=solver.damping,
                gravity=solver.gravity,
                safety=solver.safety,
                quasi_static=solver.quasi_static,
                self_contact=solver.self_contact,
                edge_contact=solver.edge_contact,
                smooth_landing=solver.smooth_landing,
                max_steps=solver.max_steps,
            ),
            mold=find_mold(),
            tools=build_tools(document, store, read),
            cooling=_cooling(document),
            fill=model.mold is None or model.mold.fill,
            part=build_part(document, find_mold(), store, read),
            name=document.name,
            frames=model.output.frames,
            store=store,
        )
    return scene


def read_reference(document: SceneDocument) -> dict[str, NDArray[np.float64]] | None:
    """The exact solution that [output] names: initial_radius [m], arc [m], thickness_ratio, each (n,); or None.

    Raises:
        InputError: The file cannot be read, or a column or number is missing.
    """
    name = document.model.output.reference
    if name is None:
        return None
    with error_context(document.file, "output.reference"):
        path = disk.expand_path(name, document.folder)
        text = disk.read_text(path)
        try:
            rows = list(csv.DictReader(io.StringIO(text, newline="")))
            columns = {key: np.array([float(row[key]) for row in rows]) for key in REFERENCE_COLUMNS}
        except (KeyError, TypeError, ValueError, csv.Error):
            columns = {}
        if not columns or not all(len(x) and np.isfinite(x).all() for x in columns.values()):
            remedy = f"give the columns {', '.join(REFERENCE_COLUMNS)}"
            raise InputError("is not a table of numbers with a header", remedy, value=str(path))
        return columns


def _parison(document: SceneDocument, sheet: shapes.Sheet, forest: bisection.TriangleForest | None) -> Parison:
    table = document.model.parison
    thickness = _quantity(document, table.thickness, "parison.thickness", sheet)
    temperature = table.temperature
    if temperature is not None:
        temperature = _quantity(document, temperature, "parison.temperature", sheet)
    stretches = getattr(table, "pre_stretch", None)
    if stretches is not None and getattr(table, "mold_rim", False):
        # The opening of the mold is the shape that the sheet has when it is clamped.
        sheet = replace(sheet, positions=sheet.positions / np.append(stretches, 1.0))
    triangles = sheet.triangles if forest is None else forest.triangles[: forest.root_count]
    clamped, fixed = (sheet.clamped, sheet.fixed) if forest is None else (forest.clamped, forest.fixed)
    own = {"guided": sheet.guided, "clamp_until": table.clamp_until}
    return make_parison(sheet.positions, triangles, thickness, clamped, fixed, temperature, stretches, **own)


def _loading(document: SceneDocument, sheet: shapes.Sheet) -> Loading:
    """The gases or the pressure history; a scene that gravity or a moving mold drives has no pressure."""
    model = document.model
    if model.regional_gases:
        return _regional_load(document, sheet)
    gases = [make_gas(**gas.numbers) for gas in model.gases]
    if (table := model.pressure) is not None:
        pressure = make_pressure(table.time, table.value, table.interpolation)
        return make_two_sided_load(pressure, gases[0]) if gases else pressure
    if not gases:
        return make_pressure([0.0], [0.0])
    return gases[0] if len(gases) == 1 else make_two_sided_load(*gases)


def _regional_load(document: SceneDocument, sheet: shapes.Sheet) -> Loading:
    """The gases of regions of the sheet, and the pressure history on all of it, where one is given."""
    model, masks = document.model, geometry.gas_regions(document, sheet)
    loads: dict[str, tuple[Loading, Any]] = {}
    if (table := model.pressure) is not None:
        pressure = make_pressure(table.time, table.value, table.interpolation)
        loads["inside"] = pressure, np.ones(len(sheet.triangles), bool)
    for name, gas in model.regional_gases.items():
        with _gas_errors(name):
            loads[name] = make_gas(**gas.numbers), masks[name]
    return make_regional_load(loads)


@contextlib.contextmanager
def _gas_errors(name: str) -> Iterator[None]:
    """Errors inside about a gas are about that of this name."""
    try:
        yield
    except InputError as error:
        if not error.key.startswith("gas."):
            raise
        raise replace(error, key=f"gas.{name}.{error.key.removeprefix('gas.')}") from None


def _extend_sheet(sheet: shapes.Sheet, forest: bisection.TriangleForest | None) -> shapes.Sheet:
    """The sheet with all nodes that refinement may make, and its fields at them."""
    if forest is None:
        return sheet
    given = {name: bisection.extend_values(values, forest.ends, forest.depth) for name, values in sheet.fields.items()}
    return replace(sheet, positions=forest.positions, fields=given)


def _refinement(
    document: SceneDocument, sheet: shapes.Sheet
) -> tuple[Refinement | None, bisection.TriangleForest | None]:
    table = document.model.refinement
    if table is None:
        return None, None
    roots, deepest = len(sheet.triangles), bisection.even_depth(max(table.max_level, table.base_level))
    elements = min(table.elements or default_capacity(roots), roots << deepest)
    refinement = make_refinement(**table.model_dump(exclude={"elements"}), elements=elements)
    masks = list(geometry.gas_regions(document, sheet).values())
    made = bisection.build_forest(
        sheet.positions,
        sheet.triangles,
        deepest,
        clamped=sheet.clamped,
        fixed=sheet.fixed,
        snap=sheet.snap,
        region=bisection.number_regions(np.stack(masks)) if masks else None,
    )
    return refinement, made


def default_capacity(roots: int) -> int:
    """Default capacity for elements: as many as the paper's scenes end with, and not much more.

    A run increases a capacity that is too small, but compiles again. Unused capacity takes time, so large meshes get
    less.
    """
    return max(16 * roots, min(max(2300, 32 * roots), 8192))


def _quantity(document: SceneDocument, table: Any, key: str, sheet: shapes.Sheet) -> NDArray[np.float64] | float:
    """A quantity that may vary over the sheet: a number, or values at its nodes (n_node,)."""
    if isinstance(table, schema.ProfileTable):
        return build_profile(table, key).over(sheet.positions, sheet.fields.get("arc"))
    if isinstance(table, schema.NumberProfile):
        profile = Profile(table.along, tuple(table.at), tuple(table.value), key)
        return profile.over(sheet.positions, sheet.fields.get("arc"))
    if isinstance(table, schema.FieldReference):
        with error_context("", f"{key}.file"):
            path = disk.expand_path(table.file, document.folder)
        return geometry.nodal_field(path, table.field, sheet.positions, key)
    if isinstance(table, str):
        name = table.removeprefix("field:")
        if name not in sheet.fields:
            known = ", ".join(sorted(sheet.fields)) or "none"
            raise InputError("the mesh has no such field", f"its fields: {known}", key, table)
        return sheet.fields[name]
    return table


def _material(document: SceneDocument, sheet: shapes.Sheet) -> materials.Law:
    table = document.model.material
    law = table.law

    def number(name: str) -> Any:
        value, key = getattr(table, name), f"material.{name}"
        for profile in value if isinstance(value, list) else [value]:
            if isinstance(profile, schema.NumberProfile):
                check(f"{key}.value", profile.value, parameter_ranges(law)[name])
        if not isinstance(value, list):
            return as_real(_quantity(document, value, key, sheet))
        terms = [_quantity(document, one, f"{key}[{k}]", sheet) for k, one in enumerate(value)]
        return as_real(np.stack(np.broadcast_arrays(*terms)))

    def part(kinds: dict[str, Any], given: Any) -> Any:
        if given is None:
            return None
        kind = kinds[given.kind]
        return kind(**{name: as_real(getattr(given, name)) for name in parameter_ranges(kind)})

    made = law(**{name: number(name) for name in parameter_ranges(law)})
    viscous, shift = part(materials.MODES, table.viscous), part(materials.SHIFTS, table.shift)
    return replace(made, viscous=viscous, shift=shift, tension_field=table.tension_field)


def _cooling(document: SceneDocument) -> materials.Cooling | None:
    table = document.model.cooling
    return None if table is None else materials.Cooling(**table.model_dump())


# Python files of users, which declare material models for scene files.

_run_files: dict[tuple[Path, str], dict[str, type[Law]]] = {}


def import_models_of(tables: dict[str, Any], folder: Path, file: str) -> None:
    """Registers the material models of the file named by `model_file` in a scene's [material].

    Args:
        tables: Tables of a scene file, not validated.
        folder: Base of relative paths.
        file: Name of the scene file in messages.

    Raises:
        InputError: As `import_models`.
    """
    material = tables.get("material")
    name = material.get("model_file") if isinstance(material, dict) else None
    if isinstance(name, str):
        with error_context(file, "material.model_file"):
            import_models(disk.expand_path(name, folder))


def import_models(path: Path) -> None:
    """Runs a Python file, if its text has not been run before, and registers the material models that it declares.

    Raises:
        InputError: The file cannot be read or run, or declares no model with a name.
    """
    text = disk.read_text(path)
    key = path.resolve(), text
    if key not in _run_files:
        _run_files[key] = _run(path, text)
    LAWS.update(_run_files[key])


def _run(path: Path, text: str) -> dict[str, type[Law]]:
    """The models that a file declares, by name."""
    # A name outside this package's: a program with a user's class is not kept in files.
    digest = hashlib.sha256(f"{path.resolve()}\0{text}".encode()).hexdigest()
    module, before = types.ModuleType(f"models_{digest[:16]}"), dict(LAWS)
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # where dataclasses look for the types of fields
    try:
        exec(compile(text, str(path), "exec"), module.__dict__)
    except InputError as error:
        raise error.with_context(file=str(path)) from None
    except (Exception, SystemExit) as error:
        raise InputError(_describe(error, path), "correct the Python file", value=str(path)) from None
    declared = {name: made for name, made in LAWS.items() if before.get(name) is not made}
    if not declared:
        remedy = 'decorate the class of the model with @jaxform.law(model="NAME")'
        raise InputError("declares no material model", remedy, value=str(path))
    return declared


def _describe(error: BaseException, path: Path) -> str:
    """The exception of a user's file in words, with the last line of the file that led to it."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
    where = "" if line is None else f" in line {line}"
    return f"cannot be run ({type(error).__name__}{where}: {error})"
