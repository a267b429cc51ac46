"""Adaptation of a sheet's mesh by runs before the run, each of which shows where its wall is less accurate."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.adapt import mesher, smoothing
from jaxform.core.errors import InputError, InputWarning, redirect_warnings, warn_of
from jaxform.core.store import Arrays, Store
from jaxform.io import files, scene_rewriting
from jaxform.io.files import SceneDocument
from jaxform.mesh.shapes import Sheet
from jaxform.model.scene import Scene
from jaxform.results import size_field
from jaxform.results.result import Result
from jaxform.results.summary import explain
from jaxform.results.tool_contact import measure_cuts
from jaxform.runs.host import run
from jaxform.sheet.state import Status

Report = Callable[[dict[str, Any]], object]
"""Called with the facts of each run, as of `_facts`."""

Array = NDArray[np.float64]

_STOPS = (
    Status.NON_FINITE
    | Status.UNSTABLE
    | Status.WINDOWS_EXHAUSTED
    | Status.CONTACT_MISSED
    | Status.STOPPED
    | Status.RUNAWAY
    | Status.ESCAPED
    | Status.BURST
    | Status.INPUT
)
"""Statuses of runs whose wall does not say where elements should be; an unfilled corner is none of them."""
_FITS, _MOVES = 3, 2  # runs after which sides that cut are divided, and nodes are moved onto edges, at most
_SPARE = 0.04  # of the elements, which are kept for new nodes on sides that cut edges
_FITTED = 0.02  # of an element, which no node is moved by for the last time
_BETTER = 0.75  # times the estimated error before: a mesh with that is taken though it is cut deeper
_DOUBTFUL, _GOOD = 0.10, 0.05  # estimated errors of the elements' wall: of one to warn of, and of one that will do
_ELEMENTS = 2500  # of a new mesh by default, where the first has no more
_RECENT = 8  # adapted meshes that a process keeps, which a study and its best scene ask for again
_recent: dict[str, Arrays] = {}

# Names of the arrays that are kept of an adapted sheet, besides those of its mesh.

_ERROR = "estimated_error"  # of the elements' wall
_RUNS, _UNMOVED = "runs", -1.0  # facts of the runs (n, 5): see `_facts`; of one without moves their number is this
_FIELD = "field:"  # prefix of the names of the sheet's fields, which may be any


def adapt_sheet(
    document: SceneDocument, sheet: Sheet, store: Store | None = None, report: Report | None = None
) -> Sheet:
    """The sheet of a document on the mesh that its `parison.adapt` asks for.

    Args:
        document: The scene.
        sheet: Its sheet on its own mesh, on which it is run first.
        store: Store for the mesh and for programs; none by default.
        report: Is told of each run, also where the mesh is kept from before.

    Raises:
        InputError: Mmg is not installed, a run stopped, or the sheet needs more elements.

    Warns:
        InputWarning: The elements are too few for the wall.
    """
    key, reported = _key(document, sheet), list[Array]()

    def report_run(run: Array) -> None:
        reported.append(run)
        if report is not None:
            report(_facts(run))

    if key not in _recent:
        made = (store or Store()).arrays("adapted", (key,), lambda: _make(document, sheet, store, report_run))
        while len(_recent) >= _RECENT:
            _recent.pop(next(iter(_recent)))
        _recent[key] = made
    arrays = dict(_recent[key])
    for run_before in arrays.pop(_RUNS, np.zeros((0, 5)))[len(reported) :]:
        report_run(run_before)
    _warn_of_error(float(arrays.pop(_ERROR, 0.0)), len(arrays["triangles"]))
    mesh: Any = {name: arrays.pop(name) for name in ("positions", "triangles", "clamped", "fixed")}
    fields = {name.removeprefix(_FIELD): values for name, values in arrays.items()}
    return Sheet(**mesh, fields=fields, snap=sheet.snap, guided=sheet.guided)


def adaptable(document: SceneDocument, **wanted: Any) -> SceneDocument:
    """The document with keys of `parison.adapt`; those that are None are left as they are, or at their defaults.

    Raises:
        InputError: A number is out of range, or the scene is refined as it forms.
    """
    table = dict(document.data["parison"].get("adapt") or {})
    table |= {key: value for key, value in wanted.items() if value is not None}
    tables = document.data | {"parison": document.data["parison"] | {"adapt": table}}
    return files.validate_scene(tables, document.file, document.folder, document.path)


def without_adaptation(document: SceneDocument) -> SceneDocument:
    """The document on the mesh from which its adaptation begins."""
    parison = {key: value for key, value in document.data["parison"].items() if key != "adapt"}
    return files.validate_scene(document.data | {"parison": parison}, document.file, document.folder, document.path)


def _key(document: SceneDocument, sheet: Sheet) -> str:
    """A digest of the data for the mesh: the scene without its name and output, its files, and the precision."""
    digest = hashlib.sha256(repr((jax.config.jax_enable_x64, len(sheet.positions))).encode())
    tables = {key: value for key, value in document.data.items() if key not in ("name", "description", "output")}
    digest.update(repr(tables).encode())
    digest.update(np.ascontiguousarray(sheet.positions).tobytes() + np.ascontiguousarray(sheet.triangles).tobytes())
    for path in scene_rewriting.referenced_files(document):
        digest.update(path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest()


def _warn_of_error(error: float, elements: int) -> None:
    """Warns of a large error of the elements' wall, which falls with the root of their number."""
    if error > _DOUBTFUL:
        wanted = int(float(f"{elements * (error / _GOOD) ** 2:.1g}"))
        problem = f"is too few elements: the estimated error of their wall is about {100 * error:.0f} %"
        warn_of(problem, f"allow about {wanted} for {100 * _GOOD:.0f} %", key="parison.adapt.elements", value=elements)


def _arrays(sheet: Sheet) -> Arrays:
    """A sheet as named arrays."""
    mesh = {"positions": sheet.positions, "triangles": sheet.triangles, "clamped": sheet.clamped, "fixed": sheet.fixed}
    return {_FIELD + name: values for name, values in sheet.fields.items()} | mesh


def _make(document: SceneDocument, sheet: Sheet, store: Store | None, report: Callable[[Array], None]) -> Arrays:
    """The sheet after all runs, the facts of each, which are reported, and the error expected of its wall, by name."""
    wanted = document.model.parison.adapt
    assert wanted is not None
    mesher.load_mmg()
    runs, most, first = list[Array](), wanted.elements or max(_ELEMENTS, len(sheet.triangles)), sheet

    def note(*run: float) -> None:
        runs.append(np.array(run))
        report(runs[-1])

    for number in range(1, wanted.passes + 1):
        scene, result = _run_pass(document, sheet, store, number)
        note(len(sheet.triangles), size_field.mean_error(scene, result), _UNMOVED, 0.0, 0)
        lines, before = size_field.edge_lines(scene, result), sheet
        # With edge contact nodes are moved onto edges below, and lines are worth no short steps.
        keep = not document.model.solver.edge_contact
        last, holds = number == wanted.passes, any(edges.size for edges in scene.tables.edges)
        elements = int((1.0 - _SPARE) * most) if last and holds else most
        sheet = mesher.remesh(before, size_field.wanted_sizes(scene, result), elements, lines, keep_lines=keep)
        if last:
            # Only the last mesh: the sizes of the next are found from elements in any direction.
            sheet = smoothing.smooth(
                sheet, before, np.asarray(result.positions, float), size_field.beside_edges(scene, result)
            )
        sheet = _with_fields_of(first, sheet)
    if holds:
        sheet = _with_fields_of(first, _move_to_edges(document, sheet, store, (wanted.passes, most), note))
    expected = runs[-1][1] * float(np.sqrt(runs[-1][0] / len(sheet.triangles)))
    return {**_arrays(sheet), _RUNS: np.array(runs), _ERROR: np.array(expected)}


def _with_fields_of(first: Sheet, sheet: Sheet) -> Sheet:
    """The sheet with the fields of its first mesh: those of a mesh in between are smoothed by it."""
    return replace(sheet, fields=mesher.carry_fields(first, sheet.positions))


def _move_to_edges(
    document: SceneDocument, sheet: Sheet, store: Store | None, wanted: tuple[int, int], note: Callable[..., None]
) -> Sheet:
    """The sheet with nodes beside sharp edges moved so that they land on them, and new nodes on sides that cut edges.

    By how much is seen in a run. The stretch beside an edge changes with the move, so another run shows what is left:
    where no element cuts too deep, the mesh stays; where one cuts deeper than before, the mesh before is taken, and
    from then on, and after two moves in any case, sides that cut get new nodes, but no node is moved. A mesh whose
    wall is much less in error is taken even so: sides that are held over a ridge do not cut it, and ruin the wall.

    Args:
        document: The scene.
        sheet: The sheet.
        store: Store for programs.
        wanted: Number of passes before, and of elements at most.
        note: Is called with the facts of each run.
    """
    passes, most = wanted
    best, sides, least, moving = sheet, (np.zeros((0, 2), np.int64), np.zeros(0)), (np.inf, np.inf), True
    for fit in range(_FITS + 1):
        scene, result = _run_pass(document, sheet, store, passes + 1 + fit)
        depth, corner_share = measure_cuts(result, scene)
        ends, share, worst = size_field.cut_sides(scene, result, depth, corner_share)
        facts = len(sheet.triangles), (error := size_field.mean_error(scene, result))
        if worst <= max(least[0], 1.0) or error < _BETTER * least[1]:
            best, sides, least = sheet, (ends, share), (worst, error)
        elif not moving:
            note(*facts, 0, 0.0, 0)
            return best
        moving &= best is sheet and fit < _MOVES and (fit == 0 or len(ends) > 0)
        if moving:
            sheet, moves = _move_and_divide(sheet, scene, result, depth, sides, most)
        else:
            sheet, moves = mesher.divide_sides(best, *sides, most), np.zeros(1)
        added = len(sheet.positions) - len(best.positions)
        note(*facts, np.count_nonzero(moves), float(moves.max()), added)
        if moves.max() <= _FITTED and not added:
            break
    return sheet


def _move_and_divide(
    sheet: Sheet, scene: Scene, result: Result, depth: Array, sides: tuple[NDArray[np.int64], Array], most: int
) -> tuple[Sheet, Array]:
    """The sheet with nodes moved onto edges, and with new nodes on sides, as of `cut_sides`, that no move changes.

    Also returns the moves (n_node,) of the nodes, in mean sizes of an element.
    """
    moved = mesher.move_nodes(sheet, *size_field.places_at_edges(scene, result, depth))
    moves = np.linalg.norm(moved.positions - sheet.positions, axis=1) / np.sqrt(np.mean(scene.tables.sheet.area))
    changed = np.unique(sheet.triangles[(moves[sheet.triangles] > 0.0).any(1)])
    ends, share = sides
    still = ~np.isin(ends, changed).any(1)  # the others are as deep no more
    return mesher.divide_sides(moved, ends[still], share[still], most), moves


def _facts(run: Array) -> dict[str, Any]:
    """A run before the run, by name: its elements, and the estimated relative rms error of their wall.

    Of a run after which nodes were moved onto sharp edges of tools also how many were moved, how far at most, in mean
    sizes of an element, and how many were added on sides that cut edges.
    """
    facts = {"elements": int(run[0]), "estimated_error": float(run[1])}
    if run[2] == _UNMOVED:
        return facts
    return facts | {"nodes_moved": int(run[2]), "farthest_move": float(run[3]), "nodes_added": int(run[4])}


def _run_pass(document: SceneDocument, sheet: Sheet, store: Store | None, number: int) -> tuple[Scene, Result]:
    """The scene of a document on a mesh, and its result, from which a size can be found."""
    scene = files.build_unchecked(document, store, sheet)
    result = _run_quietly(scene, store)
    _check_end(result, number)
    return scene, result


def _run_quietly(scene: Scene, store: Store | None) -> Result:
    """The result of a run, without warnings about the scene, which the run on the last mesh gives."""
    with warnings.catch_warnings(), redirect_warnings(lambda _: None):
        warnings.simplefilter("ignore", InputWarning)
        return run(scene, store=store)


def _check_end(result: Result, number: int) -> None:
    """Raises where a run has no wall from which a size can be found."""
    wall = np.asarray(result.thickness)
    if not np.isfinite(wall).all() or not (wall > 0.0).all() or int(result.status) & _STOPS:
        problem = f"adaptation pass {number} stopped: {explain(result)}"
        raise InputError(problem, "correct the scene without parison.adapt first", "parison.adapt")
