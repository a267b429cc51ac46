"""Parts of the page of the paper's scenes: stretches, cuts, stages, tables, and that it was made."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from xml.etree import ElementTree

import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from PIL import Image

import jaxform
from benchmarks.paper import bottle as tables
from benchmarks.paper import figures
from jaxform import molds, shapes
from jaxform.cli import command, session
from jaxform.mesh.bottle import Bottle
from jaxform.results import sections
from jaxform.results.result import Result
from tests import scenes

DOCS = Path(__file__).parents[2] / "docs"


def _at_rest(sheet: shapes.Sheet) -> tuple[jaxform.Scene, Result]:
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=1.0),
    )
    return scene, scenes.at_rest(scene)


def test_stretches_along_and_around_a_cone() -> None:
    """A disc pulled into a cone: radii shrink by 0.8, meridians grow to the slant."""
    scene, part = _at_rest(shapes.disc(radius=1.0, elements=600, symmetry="quarter"))
    start = np.asarray(scene.parison.positions)
    radius = np.hypot(*start[:, :2].T)
    cone = start * [0.8, 0.8, 1.0] + np.outer(2.0 * (1.0 - radius), [0.0, 0.0, 1.0])
    moved = dataclasses.replace(part, positions=jnp.asarray(cone))
    place, radial, hoop = figures.directional_stretches(scene, moved)
    away = place > 0.3
    np.testing.assert_allclose(hoop[away], 0.8, rtol=0.02)
    np.testing.assert_allclose(radial[away], np.hypot(0.8, 2.0), rtol=0.02)


def test_exact_stretches_keep_the_volume() -> None:
    exact = figures.exact_dish()
    np.testing.assert_allclose(exact["hoop"] * exact["radial"] * exact["ratio"], 1.0, rtol=1e-12)
    np.testing.assert_allclose([exact["hoop"][-1], exact["hoop"][0] / exact["radial"][0]], 1.0, rtol=0.02)


def test_a_cut_through_the_formed_part_lies_in_its_plane() -> None:
    scene, part = _at_rest(shapes.rectangle(size=(2.0, 1.0), elements=64))
    shifted = dataclasses.replace(part, positions=part.positions + jnp.asarray([0.0, 0.3, 0.0]))
    before = sections.cuts(scene, shifted, 1, 0.4)[0]
    after = sections.cuts(scene, shifted, 1, 0.4, formed=True)[0]
    np.testing.assert_allclose(before.place[:, 1], 0.7, atol=1e-8)
    np.testing.assert_allclose(after.place[:, 1], 0.4, atol=1e-8)
    np.testing.assert_allclose([before.arc[-1], after.arc[-1]], 2.0)


def test_regions_of_the_bottle_lie_where_they_are_named() -> None:
    mold = molds.bottle_half()
    middle = mold.vertices[mold.triangles].mean(1)
    found = tables.regions(middle, Bottle())
    assert all(part.sum() > 20 for part in found.values())
    assert np.stack(list(found.values())).sum(0).max() == 1  # none overlap
    # A round neck of 14 mm, and a handle that is a rod beside the hole.
    np.testing.assert_allclose(np.hypot(*middle[found["neck"]][:, [0, 2]].T), 0.014, rtol=0.07)
    assert middle[found["handle"]][:, 0].min() > 0.0239 and np.abs(middle[found["bottom"]][:, 1]).max() < 0.0115


def test_flat_rubber_in_half_a_tube_thins_by_geometry() -> None:
    assert 36 < tables.geometry(jaxform.scenes.soap_bottle())["largest mean thinning"] < 42


def test_stages_are_even_in_the_wall_and_end_with_the_last() -> None:
    scene, part = _at_rest(shapes.disc(radius=1.0, elements=60, symmetry="quarter"))
    walls = 0.01 * np.linspace(1.0, 0.2, 81)
    parts = [(scene, dataclasses.replace(part, element_thickness=jnp.full(len(part.triangles), h))) for h in walls]
    shown = [float(each.element_thickness[0]) for _, each in figures.evenly(parts, 4)]
    np.testing.assert_allclose(shown, [0.008, 0.006, 0.004, 0.002], atol=2e-4)


def test_the_page_has_the_tables_of_its_numbers() -> None:
    """Nobody typed them: made anew from the file of numbers they are the same."""
    text, found = (DOCS / "scenes.md").read_text(), json.loads((DOCS / "scenes.json").read_text())
    assert set(found["counts"]) == set(figures.SCENES) and set(figures.TABLES) - {"checks"} <= set(found)
    assert figures.with_tables(text, found) == text
    with pytest.raises(ValueError, match="no marks"):
        figures.with_tables("nothing", found)


def test_the_animations_move_and_are_small() -> None:
    for name in figures.SCENES:
        with Image.open(DOCS / f"{name}.gif") as picture:
            assert getattr(picture, "n_frames", 1) >= 8
        assert (DOCS / f"{name}.gif").stat().st_size < 1_000_000


def test_frames_play_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The list names every frame with its time, and each is a mesh that other programs read."""
    monkeypatch.setattr(session, "cache_folder", lambda: None)
    scene = tmp_path / "scene.toml"
    source = (Path(jaxform.__file__).parent / "scenes" / "bowl.toml").read_text()
    source = source.replace("element_size = 0.01\n", "elements = 24\n").replace("end_time = 0.24", "end_time = 0.1")
    scene.write_text(source + "\n[output]\nframes = 4\n")
    assert command.main(["simulate", str(scene), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    sets = ElementTree.parse(tmp_path / "out" / "frames.pvd").getroot().findall("./Collection/DataSet")
    times = [float(each.attrib["timestep"]) for each in sets]
    assert len(times) == 4 and times == sorted(set(times)) and times[-1] <= 0.1 * (1 + 1e-9)
    heights = []
    for each in sets:
        frame = meshio.read(tmp_path / "out" / each.attrib["file"])
        assert frame.cells_dict["triangle"].shape == (len(frame.cell_data["thickness"][0]), 3)
        heights.append(frame.points[:, 2].max())
    assert heights[0] < heights[-1]
