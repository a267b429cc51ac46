"""Contents of the pictures of a sweep: variables that vary among what was computed, and failures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxform.sweeps import report
from jaxform.sweeps.records import Row

PATHS = ["mold.depth", "mold.path", "solver.end_time", "material.c"]


def _row(depth: str, path: str, wall: str, status: str = "ok", end: str = "", c: str = "1e5") -> Row:
    measures = {"wall_min": wall, "wall_mean": wall, "wall_cv": "0.1" if wall else "", "mass": "0.1" if wall else ""}
    return {
        "mold.depth": depth,
        "mold.path": path,
        "solver.end_time": end,
        "material.c": c,
        "status": status,
    } | measures


def _axes(rows: list[Row], path: str, unit: str = "") -> report.Axis:
    axis = report._variable(path, rows, unit)
    assert axis is not None
    return axis


def test_texts_are_categories_and_wide_ranges_logarithmic() -> None:
    rows = [_row("0.05", "folder/a.stl", "1e-3", c="1e4"), _row("0.06", "b.stl", "2e-3", c="1e6")]
    depth, path, c = _axes(rows, "mold.depth", "m"), _axes(rows, "mold.path"), _axes(rows, "material.c", "Pa")
    np.testing.assert_allclose(depth.values, [50.0, 60.0])
    assert depth.label == "mold.depth [mm]" and not depth.logarithmic and depth.line == "-"
    assert path.names == ("a.stl", "b.stl") and list(path.values) == [0.0, 1.0] and path.line == "none"
    assert c.logarithmic and c.label == "material.c [kPa]"


def test_means_are_those_of_levels_or_of_groups_of_good_designs() -> None:
    values = np.repeat([1.0, 2.0, 3.0], 4)
    response, good = np.arange(12.0), np.ones(12, bool)
    good[0], response[1] = False, np.nan
    places, means = report._means(report.Axis("", values), response, good)
    np.testing.assert_allclose([places, means], [[1, 2, 3], [2.5, 5.5, 9.5]])
    rng = np.random.default_rng(1)
    many = rng.permutation(100.0 * np.arange(50))
    places, means = report._means(report.Axis("", many), many**2, np.ones(50, bool))
    expected = (100.0 * np.arange(50)).reshape(5, 10)
    np.testing.assert_allclose([places, means], [expected.mean(1), (expected**2).mean(1)])


def test_failures_do_not_disturb_and_what_does_not_vary_is_not_drawn(tmp_path: Path) -> None:
    rows = [_row(f"{0.01 * k}", "a.stl", f"{1e-3 / k}") for k in range(1, 6)]
    rows += [_row("0.09", "a.stl", "1e-9", "burst"), _row("", "a.stl", "", "is wrong", end="0.0")]
    assert len(report.draw_all(tmp_path, PATHS, rows, {"mold.depth": "m"})) == 3
    assert {path.name for path in tmp_path.iterdir()} == {
        "thinnest_wall.png",
        "main_effects.png",
        "scatter_matrix.png",
    }
    assert report.draw_all(tmp_path, PATHS, rows[-2:], {}) == []
    assert report.draw_all(tmp_path, [], rows, {}) == []


def test_of_many_variables_those_with_an_effect_are_drawn() -> None:
    rng = np.random.default_rng(2)
    variables = [report.Axis(f"v{k}", rng.permutation(np.arange(60.0))) for k in range(12)]
    for strong in (0, 7, 11):
        chosen, left = report._strongest(variables, variables[strong].values ** 2, np.ones(60, bool))
        labels = [axis.label for axis in chosen]
        assert f"v{strong}" in labels and labels == sorted(labels, key=lambda name: int(name[1:]))
        assert (len(chosen), left) == (8, 4)
