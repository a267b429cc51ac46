"""The work of `jaxform sweep --optimize` for a design: a search, whose best design is the row."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import optimize
from jaxform.core.errors import InputError
from jaxform.io import output, scene_rewriting, schema
from jaxform.io.files import SceneDocument, StudyDocument
from jaxform.io.validation import validate
from jaxform.sweeps import evaluation
from jaxform.sweeps.evaluation import Setting
from jaxform.sweeps.workers import OK, Outcome

MEASURES = {"objective": "", "thickness_rms_error": "", "violation": "", "simulations": ""}
"""Columns of what a search gives, besides those of the simulated best design, and their units."""
_SEARCH = ("variable", "objective", "solver")


def search_of(study: tuple[str, Path, dict[str, Any]] | None, source: str) -> tuple[str, Path, dict[str, Any]]:
    """The search that a study describes, for scenes of a sweep.

    Returns:
        The name of the study in messages, the base of its relative paths, and its tables but the sweep.

    Raises:
        InputError: It is a table of designs alone, or a table of the search is missing or wrong.
    """
    if study is None:
        remedy = "name the table in a study (sweep.table), with variables, an objective and a solver"
        raise InputError("is a table, which has no objective for --optimize", remedy, value=source)
    file, folder, tables = study
    data = {key: value for key, value in tables.items() if key != "sweep"}
    validate(schema.StudyFile, {"scene": "any", **data}, file)
    return file, folder, data


def search_digest(data: dict[str, Any]) -> str:
    """Hash of those tables of a search that determine its result."""
    determining = json.dumps([data.get(key) for key in _SEARCH], sort_keys=True, default=str)
    return hashlib.sha256(determining.encode()).hexdigest()


def optimize_design(task: tuple[SceneDocument, Setting, tuple[str, Path, dict[str, Any]]]) -> Outcome:
    """The best design that a search finds for a scene document: its numbers and files, and its status in words.

    Raises:
        InputError: The scene cannot be simulated, or the search does not fit it.
    """
    document, setting, (file, base, data) = task
    before, warned = evaluation.count_compiled(), []
    worker = store, _ = evaluation.set_up(setting)
    model = validate(schema.StudyFile, {"scene": document.name, **data}, file)
    with evaluation.compile_once(worker, search_digest(data)), evaluation.tell_warnings(warned.append):
        began = time.perf_counter()
        study = optimize.build_study(StudyDocument(file, base, data, model, document), store)
        with tempfile.TemporaryDirectory(prefix="jaxform-") as name:
            folder = Path(name)
            design = optimize.solve(study, on_warning=warned.append)
            summary = _write_files(folder, document, design, warned)
            archive = evaluation.pack(folder)
    found = design.summary()
    measures = evaluation.measures_of(summary) | {"seconds": time.perf_counter() - began}
    measures |= {name: found["after"][name] for name in ("objective", "thickness_rms_error")}
    measures |= {"violation": found["violation"], "simulations": found["simulations"]}
    status = summary["status"] if int(design.result.status) or design.broken else OK
    return Outcome(status, (measures, archive, evaluation.count_compiled() - before))


def _write_files(folder: Path, document: SceneDocument, design: Any, warned: list[str]) -> dict[str, Any]:
    """Writes what `jaxform optimize` writes, but for its pictures; returns the summary."""
    scene_rewriting.write_scene(document, design.changes, folder)
    summary = output.write_result(
        design.scene, design.result, folder, list(dict.fromkeys(warned)), design.amend_summary
    )
    output.write_part(design.first_scene, design.first_result, folder / "start.vtu")
    optimize.write_history(folder / "history.csv", design.history)
    output.write_json(folder / "design.json", design.summary())
    return summary
