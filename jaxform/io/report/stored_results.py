"""A results folder, read and validated: the report shows the contents of its files."""

from __future__ import annotations

import csv
import io
import tomllib
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jaxform.core import disk
from jaxform.core.errors import InputError
from jaxform.io import previous_results
from jaxform.io.previous_results import AGAIN
from jaxform.mesh import meshes

if TYPE_CHECKING:
    from jaxform.tools.mold import Motion

Array = NDArray[np.float64]

# Facts of summary.json that the report shows, checked: the file may be of another version or another program.

Number = float | None
"""Null where it was not finite."""
Place = Annotated[list[Number], Field(min_length=3, max_length=3)]


class _FactsTable(BaseModel):
    """A table that may have more keys than are asked for."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)


class _WallFacts(_FactsTable):
    min: Number
    mean: Number
    max: Number
    cv: Number


class _Thinnest(_FactsTable):
    thickness: Number
    formed: Place
    initial: Place
    ratio: Number = None
    recovered: Number = None
    recovered_ratio: Number = None
    recovered_place: Place | None = None
    scatter: Number = None
    scatter_of: str = ""


class _DesignFacts(_FactsTable):
    before: dict[str, Number]
    after: dict[str, Number]
    evaluations: Number = None
    simulations: Number = None
    stopped_by: str = ""
    message: str = ""


class _ToolFacts(_FactsTable):
    name: str
    contact_fraction: Number = None
    contact_fraction_max: Number = None
    contact_period: list[Number] | None = None
    thickness: _WallFacts | None = None
    work: Number = None
    friction_loss: Number = None
    penetration_max: Number = None


class _SummaryFacts(_FactsTable):
    scene: str
    status: str
    elements_final: Number = None
    steps: Number = None
    time: Number = None
    thickness: _WallFacts
    thinnest: _Thinnest
    symmetry_planes: dict[str, float] = {}
    contact_fraction: Number
    tools: list[_ToolFacts] = []
    mass: Number
    sheet_mass: Number = None
    penetration_max: Number = None
    penetration_place: Place | None = None
    gap_max: Number = None
    gap_place: Place | None = None
    energy: dict[str, Number]
    warnings: list[str]
    design: _DesignFacts | None = None


def read_summary(folder: Path) -> dict[str, Any]:
    """The contents of a folder's summary.json, those that the report shows being of the right kind.

    Raises:
        InputError: It cannot be read, is no JSON, or a key is missing or of another kind.
    """
    path, facts = folder / previous_results.SUMMARY, previous_results.read_summary(folder)
    try:
        return _SummaryFacts.model_validate(facts).model_dump(exclude_unset=True)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        if first["type"] == "missing":
            raise InputError(
                "is missing: the file is of another version or damaged", AGAIN, key, file=str(path)
            ) from None
        problem = "is of another type than expected: the file is of another version or damaged"
        raise InputError(problem, AGAIN, key, first["input"], str(path)) from None


_NODAL = (*meshes.REFERENCE, "thickness", "initial_thickness", "contact_time")
_OF_ELEMENTS = ("thickness", "stretch_1", "stretch_2", "level")
_MOST_FRAMES, _MOST_FRAME_ELEMENTS = 60, 300_000  # that are shown, and their elements together


class StoredPart(NamedTuple):
    """A part as a VTU file has it.

    Attributes:
        positions, reference: Positions of the nodes (n_node, 3) [m], at that time and in the initial sheet.
        triangles: Node numbers of the elements (n_element, 3).
        nodal: Values at the nodes (n_node,), by name.
        cells: Values of the elements (n_element,), by name.
    """

    positions: Array
    reference: Array
    triangles: NDArray[np.int32]
    nodal: dict[str, Array]
    cells: dict[str, Array]

    @property
    def touched_tools(self) -> Array:
        """The number of the tool that each element touches (n_element,): NaN where it touches none, or is not known."""
        if "tool" not in self.nodal:
            return np.full(len(self.triangles), np.nan)
        tool, time = (self.nodal[name][self.triangles] for name in ("tool", "contact_time"))
        touches = ((tool >= 0) | (time >= 0)).all(1) & (time > 0).any(1)
        return np.where(touches, tool.max(1), np.nan)

    @property
    def part_mask(self) -> Array | None:
        """Values (n_element,), not 0 for elements of the part that the scene's [part] selects; None without one."""
        return self.cells.get("part")


@dataclass(frozen=True)
class Results:
    """Results that a command left in a folder.

    Attributes:
        summary: Contents of summary.json.
        part: The part in final.vtu.
        start: The part in start.vtu, with which a search began; None for a simulation.
        frames: Times [s] and parts before the end; only so many as a page can hold.
        frame_count: Number of frames in the folder.
        mold: The mold in mold.vtu, at its final position; None without one.
        motion: Motion of the mold; None where it rests.
        tools: Name of each tool besides the mold, its mesh at its final position, and its motion; None where it rests.
        scene: The scene file, its name and its text; None where there is none.
        history: Rows of history.csv; empty for a simulation.
        process: Rows of process.csv; empty where nothing changes over time.
        release: Time [s] at which the clamp opens; None where it does not.
    """

    summary: dict[str, Any]
    part: StoredPart
    start: StoredPart | None = None
    frames: list[tuple[float, StoredPart]] = field(default_factory=list)
    frame_count: int = 0
    mold: meshes.Mesh | None = None
    motion: Motion | None = None
    tools: list[tuple[str, meshes.Mesh, Motion | None]] = field(default_factory=list)
    scene: tuple[str, str] | None = None
    history: list[dict[str, str]] = field(default_factory=list)
    process: list[dict[str, str]] = field(default_factory=list)
    release: float | None = None


def read_results(folder: Path) -> Results:
    """The results in a folder.

    Raises:
        InputError: It holds none, or a file there is damaged or of another version.
    """
    for name in ("summary.json", "final.vtu"):
        if not disk.is_file(folder / name):
            raise InputError(f"holds no {name}", AGAIN, "DIR", str(folder))
    summary = read_summary(folder)
    part = _part(folder / "final.vtu")
    # A folder may hold more than the last command wrote there.
    is_search = summary.get("design") is not None
    scene = folder / ("best.toml" if is_search else "simulated.toml")
    frames, count = ([], 0) if is_search else _frames(folder, part, float(summary.get("time") or 0.0))
    text = disk.read_text(scene) if disk.is_file(scene) else None
    return Results(
        summary=summary,
        part=part,
        start=_part(folder / "start.vtu") if is_search and disk.is_file(folder / "start.vtu") else None,
        frames=frames,
        frame_count=count,
        mold=_mesh(folder / "mold.vtu") if disk.is_file(folder / "mold.vtu") else None,
        motion=None if text is None else _motion(_tables(text).get("mold")),
        tools=[] if text is None else _tools(folder, _tables(text).get("tool")),
        scene=None if text is None else (scene.name, text),
        history=_rows(folder / "history.csv") if is_search else [],
        process=_rows(folder / "process.csv"),
        release=None if text is None else _release_time(_tables(text).get("parison")),
    )


def _tables(scene: str) -> dict[str, Any]:
    """The tables of a scene file; none where it cannot be read."""
    try:
        return tomllib.loads(scene)
    except tomllib.TOMLDecodeError:
        return {}


def _release_time(parison: Any) -> float | None:
    """Time [s] at which the clamp of a scene file's parison opens; None if it does not, or is not readable."""
    until = parison.get("clamp_until") if isinstance(parison, dict) else None
    return float(until) if isinstance(until, int | float) else None


_MOTION = ("direction", "time", "displacement")


def _motion(table: Any) -> Motion | None:
    """The motion of a mold or tool of a scene file; None where it has none, or none that can be read."""
    try:
        numbers = table.get("motion") or {key: table[key] for key in _MOTION if key in table}
        if not numbers:
            return None
        from jaxform.tools.mold import make_motion  # with JAX, which takes a second to import

        return make_motion(**numbers)
    except (InputError, AttributeError, TypeError):
        return None


def _tools(folder: Path, tables: Any) -> list[tuple[str, meshes.Mesh, Motion | None]]:
    """The tools of a scene file whose meshes are in a folder."""
    found = []
    for number, table in enumerate(tables if isinstance(tables, list) else [], 1):
        name = str(table.get("name", f"tool{number}")) if isinstance(table, dict) else ""
        path = folder / f"tool_{Path(name).name}.vtu"
        if name and disk.is_file(path):
            found.append((name, _mesh(path), _motion(table)))
    return found


def _mesh(path: Path) -> meshes.Mesh:
    try:
        return meshes.read_mesh(path)
    except InputError as error:
        raise InputError(error.problem, AGAIN, file=str(path)) from None


def _part(path: Path) -> StoredPart:
    mesh = _mesh(path)
    for names, found in ((_NODAL, mesh.fields), (_OF_ELEMENTS, mesh.cell_fields)):
        missing = [name for name in names if name not in found]
        if missing:
            raise InputError("is missing: the file is of another version", AGAIN, missing[0], file=str(path))
    reference = np.stack([mesh.fields[name] for name in meshes.REFERENCE], axis=1)
    for name, values in (("reference", reference), ("thickness", mesh.cell_fields["thickness"])):
        # NaN is not below it either.
        if not np.abs(values).max() <= meshes.LARGEST:
            raise InputError("has numbers that are not finite, or too large", AGAIN, name, file=str(path))
    nodal = {name: values for name, values in mesh.fields.items() if name not in meshes.REFERENCE}
    return StoredPart(mesh.positions, reference, mesh.triangles, nodal, mesh.cell_fields)


def _frames(folder: Path, last: StoredPart, end: float) -> tuple[list[tuple[float, StoredPart]], int]:
    """Times [s] and parts before the end, evenly chosen where there are many; and how many there are."""
    listed = folder / "frames.pvd"
    if not disk.is_file(listed):
        return [], 0
    try:
        entries = [item.attrib for item in ElementTree.fromstring(disk.read_text(listed)).iter("DataSet")]
        named = [(float(item["timestep"]), item["file"]) for item in entries if item.get("part", "0") == "0"]
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("is not a list of frames", AGAIN, file=str(listed)) from None
    earlier = [(time, name) for time, name in named if time < end]
    limit = min(_MOST_FRAMES, max(_MOST_FRAME_ELEMENTS // len(last.triangles), 1))
    chosen = np.unique(np.linspace(0, len(earlier) - 1, min(limit, len(earlier))).round().astype(int))
    return [(earlier[k][0], _part(disk.expand_path(earlier[k][1], folder))) for k in chosen], len(named)


def _rows(path: Path) -> list[dict[str, str]]:
    if not disk.is_file(path):
        return []
    try:
        return list(csv.DictReader(io.StringIO(disk.read_text(path), newline="")))
    except csv.Error:
        raise InputError("is not a table", AGAIN, file=str(path)) from None
