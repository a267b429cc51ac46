"""Parts of earlier runs as what a later one begins with: sheet, thickness, symmetry planes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import jaxform
from jaxform.core.errors import InputWarning
from jaxform.io import files, output
from jaxform.mesh import meshes, shapes
from jaxform.mesh.volumes import areas
from jaxform.results.result import Result
from jaxform.results.summary import summarize
from tests import scenes

_BEGIN, _END = scenes.FILE.index('shape = "disc"'), scenes.FILE.index("[material]")
_MOLD = scenes.FILE[scenes.FILE.index("[mold]") : scenes.FILE.index("[solver]")]


def _again(parison: str, **changes: str) -> str:
    """The scene with another sheet."""
    text = scenes.FILE[:_BEGIN] + parison + scenes.FILE[_END:]
    for old, new in changes.items():
        text = text.replace(dict(pressure="[0.0, 2.0e4]", mold=_MOLD)[old], new)
    return text


def _file(planes: str = '["x", "y"]') -> str:
    return f'shape = "file"\npath = "final.vtu"\nthickness = "field:thickness"\nplanes = {planes}\n'


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, jaxform.Scene, Result]:
    """A part that was formed over 50 mm, and the folder it was left in."""
    folder = tmp_path_factory.mktemp("first")
    (folder / "scene.toml").write_text(scenes.FILE)
    scene = jaxform.load(folder / "scene.toml")
    result = jaxform.run(scene)
    output.write_part(scene, result, folder / "final.vtu")
    output.write_json(folder / "summary.json", summarize(result, scene))
    return folder, scene, result


def test_a_formed_part_is_the_sheet_of_the_next_stage(first: tuple[Path, jaxform.Scene, Result]) -> None:
    folder, scene, result = first
    (folder / "second.toml").write_text(_again(_file(), mold=""))
    sheet = files.load(folder / "second.toml").parison
    np.testing.assert_allclose(sheet.positions, result.positions, atol=1e-15)
    np.testing.assert_array_equal(sheet.clamped, scene.parison.clamped)
    np.testing.assert_array_equal(sheet.fixed, scene.parison.fixed)
    # No wall is lost: the elements are as thick in the mean as they were formed.
    wall, triangles = np.asarray(sheet.thickness), np.asarray(sheet.triangles)
    volume = areas(np.asarray(sheet.positions), triangles) @ wall[triangles].mean(1)
    assert volume == pytest.approx(float(result.mass) / 1000.0, rel=1e-9)
    np.testing.assert_allclose(wall, result.thickness, rtol=0.05)


def test_the_next_stage_begins_without_stress(first: tuple[Path, jaxform.Scene, Result]) -> None:
    """Without pressure nothing moves, though the sheet was stretched to three quarters of its thickness."""
    folder, _, result = first
    assert float(np.asarray(result.thickness).min()) < 0.75e-3
    deeper = _MOLD.replace("[[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]]", "[[0.0, 0.08], [0.12, 0.08], [0.13, 0.0]]")
    (folder / "still.toml").write_text(_again(_file(), pressure="[0.0, 0.0]", mold=deeper))
    with pytest.warns(InputWarning) as told:
        still = jaxform.run(jaxform.load(folder / "still.toml"))
    assert "there is no pressure" in str(told[0].message)
    np.testing.assert_allclose(still.positions, result.positions, atol=1e-12)
    assert float(still.mass) == pytest.approx(float(result.mass), rel=1e-9)


def test_the_formed_thickness_is_found_by_initial_position(first: tuple[Path, jaxform.Scene, Result]) -> None:
    folder, scene, result = first
    text = scenes.FILE.replace("thickness = 1.0e-3", 'thickness = { file = "final.vtu", field = "thickness" }')
    (folder / "thinner.toml").write_text(text)
    sheet = files.load(folder / "thinner.toml").parison
    np.testing.assert_array_equal(sheet.positions, scene.parison.positions)
    np.testing.assert_allclose(sheet.thickness, result.thickness, rtol=1e-12)


def test_other_symmetry_planes_than_the_part_was_cut_at_are_warned_of(
    first: tuple[Path, jaxform.Scene, Result],
) -> None:
    folder, _, _ = first
    (folder / "cut.toml").write_text(_again(_file('["x"]'), mold=""))
    with pytest.warns(InputWarning, match=r'is cut at planes = \["x=0", "y=0"\]') as told:
        files.load(folder / "cut.toml")
    assert "parison.planes = ['x']" in str(told[0].message)


def test_a_plane_may_be_anywhere(tmp_path: Path) -> None:
    """A quarter of a rectangle is cut at its middle."""
    whole = shapes.rectangle(size=[0.3, 0.2], elements=60, symmetry="quarter")
    path = tmp_path / "quarter.vtu"
    meshes.write_vtu(path, whole.positions, whole.triangles)
    sheet = shapes.from_mesh(meshes.read_mesh(path), planes=["x=0.15", "y = 0.1"])
    np.testing.assert_array_equal(sheet.fixed, whole.fixed)
    np.testing.assert_array_equal(sheet.clamped, whole.clamped)
    np.testing.assert_array_equal(sheet.positions, whole.positions)
    with pytest.raises(jaxform.InputError, match=r"no node lies on x = 0\.14"):
        shapes.from_mesh(meshes.read_mesh(path), planes=["x=0.14"])
    with pytest.raises(jaxform.InputError, match="is not a symmetry plane"):
        shapes.from_mesh(meshes.read_mesh(path), planes=["x=inf"])
