"""Study files to studies, and the history to a file."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxform import Scene, fields, files, schema
from jaxform.errors import InputError
from jaxform.profiles import Profile
from jaxform.store import Store
from optimize.objectives import Target
from optimize.solvers import COLUMNS, Study
from optimize.variables import PressureKnots, ThicknessProfile, Variable


def load_study(name_or_path: str | Path, store: Store | None = None) -> Study:
    """A study, built from a built-in name or a TOML file, with its scene.

    Args:
        name_or_path: The study.
        store: Where expensive host work is kept between runs; nowhere by default.

    Raises:
        InputError: There is no such study or scene, or something in one of them is wrong.
    """
    document = files.read_study(name_or_path)
    scene = files.build(document.scene, store)
    solver = document.model.solver
    options = {
        name: getattr(solver, name)
        for name in ("tolerance", "learning_rate")
        if getattr(solver, name, None) is not None
    }
    try:
        return Study(
            scene=scene,
            variables=tuple(_variable(table, scene) for table in document.model.variable),
            objective=_objective(document, scene),
            method=solver.method,
            iterations=solver.iterations,
            document=document.scene,
            **options,
        )
    except InputError as error:
        raise error.within(file=document.file) from None


def _variable(table: schema.ThicknessProfile | schema.PressureKnots, scene: Scene) -> Variable:
    bounds = (table.bounds[0], table.bounds[1])
    if isinstance(table, schema.PressureKnots):
        return PressureKnots(scene, bounds=bounds, increasing=table.increasing)
    return ThicknessProfile(scene, along=table.along, bounds=bounds, knots=table.knots, at=table.at)


def _objective(document: files.StudyDocument, scene: Scene) -> Target:
    wanted = document.model.objective.thickness
    if isinstance(wanted, schema.TargetProfile):
        initial = wanted.along.startswith("initial-")
        along = wanted.along.removeprefix("initial-")
        profile = Profile(along, tuple(wanted.at), tuple(wanted.value), "objective.thickness")
        return Target(scene, profile, initial=initial)
    if isinstance(wanted, schema.FieldReference):
        path = document.folder / wanted.file
        positions = np.asarray(scene.parison.positions, float)
        return Target(scene, fields.nodal_field(path, wanted.field, positions, "objective.thickness"))
    return Target(scene, wanted)


def write_history(path: str | Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes the rows of a history as CSV with the columns `COLUMNS`."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
