"""Study files to studies, and the history to a file."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxform
from jaxform import InputError, Profile, Scene
from jaxform.extend import Store, drop_unused
from jaxform.scene_files import (
    Mesh,
    StudyDocument,
    atomic_path,
    build,
    nodal_field,
    read_scene,
    read_study,
    schema,
    transfer_values,
)
from optimize.designs import COLUMNS, LIMIT_COLUMNS, Study
from optimize.heaters import HeaterZones
from optimize.objectives import FormingTime, KineticEnergy, LeastMass, Objective, Target, Uniform, Weighted
from optimize.pressures import PressureKnots
from optimize.sheets import ThicknessField, ThicknessProfile
from optimize.variables import Scale, Variable
from optimize.wall_statistics import formed_part

_HOW_LONG = (
    "iterations",
    "max_simulations",
    "minutes",
    "rounds",
    "goal",
    "tolerance",
    "gradient_tolerance",
    "hops",
    "starts",
)


def load_study(name_or_path: str | Path, store: Store | None = None) -> Study:
    """A study, built from a built-in name or a TOML file, with its scene.

    Args:
        name_or_path: The study.
        store: Store for expensive host work between runs; none by default.

    Raises:
        InputError: There is no such study or scene, or something in one of them is wrong.
    """
    return build_study(read_study(name_or_path), store)


def build_study(document: StudyDocument, store: Store | None = None) -> Study:
    """The study of a document, with its scene.

    Args:
        document: The study.
        store: Store for expensive host work between runs; none by default.

    Raises:
        InputError: Something in the study or its scene does not fit.
    """
    scene = build(document.scene, store)
    solver = document.model.solver
    options = {name: value for name, value in solver.model_dump().items() if value is not None}
    try:
        return Study(
            scene=scene,
            variables=tuple(_variable(table, scene) for table in document.model.variable),
            objective=_objectives(document, scene),
            document=document.scene,
            digest=_digest(document, scene),
            file=document.file,
            **options,
        )
    except InputError as error:
        raise error.with_context(file=document.file) from None


def _digest(document: StudyDocument, scene: Scene) -> str:
    """Hash of all that determines a search except its length, so that one that has ended can be continued."""
    data = {key: value for key, value in document.data.items() if key not in ("description", "sweep")}
    data["solver"] = {key: value for key, value in data["solver"].items() if key not in _HOW_LONG}
    digest = hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode())
    for leaf in jax.tree.leaves(scene):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


def _variable(table: schema.Variable, scene: Scene) -> Variable:
    options: dict[str, Any] = table.model_dump(exclude={"kind"})
    options["bounds"] = tuple(options["bounds"])
    if isinstance(table, schema.PressureKnotsTable):
        options["end_time"] = None if table.end_time is None else tuple(table.end_time)
        return PressureKnots(scene, **options)
    if isinstance(table, schema.ThicknessFieldTable):
        return ThicknessField(scene, **options)
    if isinstance(table, schema.HeaterZonesTable):
        return HeaterZones(scene, **options)
    return (Scale if isinstance(table, schema.ScaleTable) else ThicknessProfile)(scene, **options)


def _objectives(document: StudyDocument, scene: Scene) -> Objective:
    tables = document.model.objective
    if not isinstance(tables, list):
        tables = [tables]
    parts = [(table.weight, _objective(table, document, scene)) for table in tables]
    return parts[0][1] if len(parts) == 1 else Weighted(parts)


def _objective(table: schema.ObjectiveTable, document: StudyDocument, scene: Scene) -> Objective:
    if isinstance(table, schema.LeastMassTable):
        return LeastMass(scene, table.minimum, flash=table.flash)
    if isinstance(table, schema.FormingTimeTable):
        return FormingTime(scene, table.power)
    if isinstance(table, schema.TargetTable):
        return _target(table, document, scene)
    return Uniform() if isinstance(table, schema.UniformTable) else KineticEnergy()


def _target(table: schema.TargetTable, document: StudyDocument, scene: Scene) -> Target:
    wanted, key = table.thickness, "objective.thickness"
    if isinstance(wanted, schema.TargetProfile):
        initial = wanted.along.startswith("initial-")
        along = wanted.along.removeprefix("initial-")
        profile = Profile(along, tuple(wanted.at), tuple(wanted.value), key)
        return Target(scene, profile, initial=initial, limit=table.limit)
    if isinstance(wanted, schema.FieldReference):
        path = document.folder / wanted.file
        positions = np.asarray(scene.parison.positions, float)
        return Target(scene, nodal_field(path, wanted.field, positions, key), limit=table.limit)
    if isinstance(wanted, schema.SceneReference):
        return Target(scene, _wall_of(wanted.scene, document, scene), limit=table.limit)
    return Target(scene, wanted, limit=table.limit)


def _wall_of(name: str, document: StudyDocument, scene: Scene) -> np.ndarray:
    """The wall (n_node,) [m] that another scene makes, at the initial places of this one's nodes."""
    key = "objective.thickness.scene"
    try:
        other = build(read_scene(name, document.folder))
    except InputError as error:
        raise error.with_context(key=key) from None
    result = formed_part(other)
    if int(result.status):
        raise InputError(f"fails: {jaxform.explain(result)}", "correct that scene first", key, name)
    other, result = drop_unused(other, result)
    places, triangles = np.asarray(other.parison.positions, float), np.asarray(result.triangles)
    try:
        wall = np.asarray(result.thickness, float)
        return transfer_values(Mesh(places, triangles, {}), wall, np.asarray(scene.parison.positions, float))
    except InputError as error:
        raise error.with_context(key=key) from None


def write_history(path: str | Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes the rows of a history as CSV with the columns `COLUMNS`, and `LIMIT_COLUMNS` where there are limits.

    Raises:
        InputError: It cannot be written; a previous file is kept.
    """
    rows = list(rows)
    limits = LIMIT_COLUMNS if rows and LIMIT_COLUMNS[0] in rows[0] else ()
    with atomic_path(path, "then resume with --resume") as fresh, fresh.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*COLUMNS, *limits], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
