"""Sheets that take long to mesh come back from the store as they were made, and nothing else does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import jaxform
from jaxform.core.store import Store
from jaxform.io import files, geometry
from jaxform.mesh import meshes
from jaxform.tools import molds, slivers

REST = """
thickness = 1.0e-3
[material]
model = "neo-hookean"
c = 1.0e5
density = 1000.0
[pressure]
time = [0.0, 0.1]
value = [0.0, 3.0e3]
[solver]
end_time = 0.1
damping = 100.0
"""
POLYGON = 'shape = "outline"\npolygon = [[0.0, 0.0], [0.1, 0.0], [0.12, 0.06], [0.0, 0.08]]\nelements = 200'
RIM = 'shape = "outline"\nmold_rim = true\nelements = 150'
BOTTLE = 'shape = "bottle-half"\nelement_size = 0.008'
MOLD = '[mold]\nshape = "file"\npath = "mold.stl"\n'


def _document(folder: Path, sheet: str, more: str = "", rest: str = REST) -> files.SceneDocument:
    path = folder / "scene.toml"
    path.write_text(f"[parison]\n{sheet}{rest}{more}")
    return files.read_scene(path)


def _write_mold(folder: Path, depth: float) -> None:
    cup = molds.revolved(profile=[[0.0, -depth], [0.04, -depth], [0.05, 0.0]], segments=24)
    meshes.write_stl(folder / "mold.stl", cup.vertices, cup.triangles)


def _assert_same(one: Any, other: Any) -> None:
    for name in ("positions", "triangles", "clamped", "fixed"):
        found, wanted = getattr(one, name), getattr(other, name)
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize(
    ("sheet", "more"), [(POLYGON, ""), (RIM, MOLD), (BOTTLE, "")], ids=["polygon", "rim", "bottle"]
)
def test_a_meshed_outline_is_kept(sheet: str, more: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write_mold(tmp_path, 0.03)
    document, folder = _document(tmp_path, sheet, more), tmp_path / "kept"
    made = geometry.build_sheet(document)
    _assert_same(geometry.build_sheet(document, Store(folder)), made)
    monkeypatch.setattr(geometry, "_make_shape", lambda *_: pytest.fail("it is kept"))
    _assert_same(geometry.build_sheet(document, Store(folder)), made)
    monkeypatch.undo()
    # Another number is another sheet; another wall is not.
    smaller = _document(tmp_path, sheet.replace("200", "300").replace("150", "250").replace("0.008", "0.01"), more)
    assert len(geometry.build_sheet(smaller, Store(folder)).triangles) != len(made.triangles)
    monkeypatch.setattr(geometry, "_make_shape", lambda *_: pytest.fail("it is kept"))
    thicker = _document(tmp_path, sheet, more, REST.replace("1.0e-3", "2.0e-3"))
    _assert_same(geometry.build_sheet(thicker, Store(folder)), made)


def test_over_another_mold_there_is_another_sheet(tmp_path: Path) -> None:
    kept, document = Store(tmp_path / "kept"), _document(tmp_path, RIM, MOLD)
    _write_mold(tmp_path, 0.03)
    one = geometry.build_sheet(document, kept)
    cup = molds.revolved(profile=[[0.0, -0.03], [0.05, -0.03], [0.06, 0.0]], segments=24)
    meshes.write_stl(tmp_path / "mold.stl", cup.vertices, cup.triangles)
    other = geometry.build_sheet(document, kept)
    assert np.ptp(other.positions[:, 0]) > 1.1 * np.ptp(one.positions[:, 0])


def test_what_is_refined_asks_its_outline_where_new_nodes_belong(tmp_path: Path) -> None:
    kept = Store(tmp_path / "kept")
    document = _document(tmp_path, POLYGON, "[refinement]\nangle = 10.0\nmax_level = 1\n")
    for _ in range(2):
        assert geometry.build_sheet(document, kept).snap is not None
    assert not (tmp_path / "kept").exists()


def test_a_bottle_s_mold_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document, folder = files.read_scene("soap-bottle"), tmp_path / "kept"
    made = geometry.build_mold(document, Store(folder))
    monkeypatch.setattr(molds, "bottle_half", lambda **_: pytest.fail("it is kept"))
    again = geometry.build_mold(document, Store(folder))
    assert made is not None and again is not None
    np.testing.assert_array_equal(again.vertices, made.vertices)
    np.testing.assert_array_equal(again.triangles, made.triangles)


def test_a_mold_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write_mold(tmp_path, 0.03)
    document, read, reader = _document(tmp_path, RIM, MOLD), [], meshes.read_mesh
    monkeypatch.setattr(meshes, "read_mesh", lambda *path, **scale: read.append(path) or reader(*path, **scale))
    files.build_unchecked(document, Store(tmp_path / "kept"))
    assert len(read) == 1


def test_a_part_of_some_of_the_mold_s_files_reads_none_of_them_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And whether a mold has slivers is asked once for the mold and once for the part."""
    _write_mold(tmp_path, 0.03)
    ball = molds.revolved(profile=[[0.0, -0.2], [0.01, -0.2], [0.01, -0.19]], segments=12)
    meshes.write_stl(tmp_path / "other.stl", ball.vertices, ball.triangles)
    text = MOLD.replace('path = "mold.stl"', 'path = ["mold.stl", "other.stl"]')
    document, read, reader = _document(tmp_path, RIM, text + '[part]\nmolds = ["mold.stl"]\n'), [], meshes.read_mesh
    monkeypatch.setattr(meshes, "read_mesh", lambda *path, **scale: read.append(path) or reader(*path, **scale))
    asked: list[int] = []
    has_slivers = slivers.has_slivers
    for module in (geometry, slivers):
        monkeypatch.setattr(module, "has_slivers", lambda *mesh: asked.append(1) or has_slivers(*mesh))
    scene = files.build_unchecked(document, Store(tmp_path / "kept"))
    assert scene.part is not None and scene.part.walls is not None and len(read) == 2 and len(asked) == 2
    assert int(np.asarray(scene.part.walls).sum()) == len(np.asarray(scene.part.walls)) - len(ball.triangles)


def test_a_scene_is_not_built_inside_a_traced_function(tmp_path: Path) -> None:
    """One clear error, whatever part of a scene would be met first; where arrays have values it is built."""
    words = r"built inside a function that JAX traces.*load or build it before"
    built = files.load("dish-coarse")
    parts = {name: getattr(built, name) for name in ("parison", "material", "pressure", "solver", "mold")}
    for build in (
        lambda: jaxform.load("dish-coarse"),
        lambda: jaxform.scenes.dish(),
        lambda: jaxform.build_scene(**parts),
    ):
        with pytest.raises(jaxform.InputError, match=words):
            jax.jit(lambda factor, build=build: factor * build().solver.end_time)(1.0)
    assert jax.grad(lambda factor: factor * jaxform.load("dish-coarse").solver.end_time)(1.0) == built.solver.end_time
