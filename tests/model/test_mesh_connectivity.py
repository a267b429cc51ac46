"""Connectivity of parisons: seams whose nodes do not match, parts, bow ties, parts that face opposite ways."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import jaxform
from jaxform import InputWarning, shapes
from jaxform.mesh import grids, meshes
from jaxform.mesh.meshes import Mesh
from jaxform.model import mesh_connectivity
from tests import scenes

pytestmark = pytest.mark.quick

Array = NDArray[np.float64]


def _patch(
    columns: int, rows: int, low: tuple[float, float] = (0.0, 0.0), size: tuple[float, float] = (1.0, 1.0)
) -> Mesh:
    """A rectangle in z = 0 of so many cells, normals +z."""
    x, y = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1), indexing="ij")
    places = np.stack([low[0] + size[0] * x.ravel(), low[1] + size[1] * y.ravel(), np.zeros(x.size)], axis=1)
    return Mesh(places, grids.union_jack(columns, rows).astype(np.int32))


def _together(*parts: Mesh, gap: float = 0.0) -> Mesh:
    """The parts as one mesh, welded where nodes coincide; all but the first moved by a gap along x."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    places = np.concatenate([_move(part, gap * (k > 0)).positions for k, part in enumerate(parts)])
    faces = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    return meshes.weld(Mesh(places, np.concatenate(faces).astype(np.int32)))


def _move(mesh: Mesh, shift: float) -> Mesh:
    return Mesh(mesh.positions + np.array([shift, 0.0, 0.0]), mesh.triangles)


def _fan(*points: tuple[float, float], faces: list[list[int]]) -> Mesh:
    return Mesh(np.insert(np.array(points), 2, 0.0, axis=1), np.array(faces, np.int32))


def _flip(mesh: Mesh) -> Mesh:
    return Mesh(mesh.positions, mesh.triangles[:, ::-1])


def _bend(mesh: Mesh) -> Mesh:
    """Bent round a cylinder about the x axis, three quarters of a turn."""
    angle = 1.5 * np.pi * mesh.positions[:, 1]
    return Mesh(np.stack([mesh.positions[:, 0], np.cos(angle), np.sin(angle)], axis=1), mesh.triangles)


def _connectivity(mesh: Mesh) -> mesh_connectivity.MeshConnectivity:
    return mesh_connectivity.find_connectivity(mesh.positions, mesh.triangles, np.zeros(mesh.positions.shape, bool))


def test_halves_whose_nodes_do_not_match_have_hanging_nodes() -> None:
    one, other = _patch(3, 3, low=(-1.0, 0.0)), _patch(3, 2)
    found = _connectivity(_together(one, other))
    mesh = _together(one, other)
    assert found.part_count == 2
    np.testing.assert_allclose(np.sort(mesh.positions[found.loose, 1]), [1 / 3, 1 / 2, 2 / 3])
    np.testing.assert_allclose(mesh.positions[found.loose, 0], 0.0)
    match = _connectivity(_together(one, _patch(3, 3)))
    assert match.part_count == 1 and match.rims == 1 and not len(match.loose) and not len(match.pinched)


@pytest.mark.parametrize(("coarse", "fine"), [(12, 13), (12, 36), (20, 50)])
def test_hanging_nodes_of_a_curved_seam_lie_off_the_chords(coarse: int, fine: int) -> None:
    mesh = _bend(_together(_patch(3, coarse, low=(-1.0, 0.0)), _patch(3, fine)))
    on_seam = np.abs(mesh.positions[:, 0]) < 1e-12
    found = _connectivity(mesh)
    assert on_seam[found.loose].all()
    # Nodes of the seam that both sides share are joined; of the others hardly one is missed.
    shared = len(found.pinched)
    assert len(found.loose) >= 0.9 * (on_seam.sum() - shared)


def test_a_crack_within_one_part_is_found() -> None:
    mesh = _patch(4, 4)
    # One node in the middle becomes two, each with half of the elements, a third of an edge's thousandth apart.
    middle = int(np.argmin(np.linalg.norm(mesh.positions - [0.5, 0.5, 0.0], axis=1)))
    left = mesh.positions[mesh.triangles].mean(1)[:, 0] < 0.5
    faces = mesh.triangles.copy()
    faces[left] = np.where(faces[left] == middle, len(mesh.positions), faces[left])
    torn = Mesh(np.concatenate([mesh.positions, mesh.positions[[middle]] - [1e-4, 0, 0]]), faces)
    found = _connectivity(torn)
    assert found.part_count == 1
    assert sorted(found.loose.tolist()) == [middle, len(mesh.positions)]


def test_rims_that_coincide_but_for_rounding_are_not_joined() -> None:
    mesh = _together(_patch(3, 3, low=(-1.0, 0.0)), _patch(3, 3), gap=1e-6)
    found = _connectivity(mesh)
    assert len(found.loose) == 8
    np.testing.assert_allclose(mesh.positions[found.loose, 0], 0.0, atol=2e-6)


@pytest.mark.parametrize(
    "mesh",
    [
        _patch(60, 1, size=(1.0, 0.002)),  # a strip, one element wide
        _together(_patch(3, 3, low=(-1.0, 0.0)), _patch(3, 3), gap=0.1),  # a slit of a third of an element
        _fan((0, 0), (1, 0), (1, 0.27), (2, 0), (2, 0.54), faces=[[0, 1, 2], [1, 3, 4], [1, 4, 2]]),
        _fan((0, 0), (1, 0), (1, 0.02), (1, 0.06), (0, 1), faces=[[0, 1, 2], [0, 2, 3], [0, 3, 4]]),
    ],
    ids=["strip", "slit", "wedge", "graded"],
)  # fmt: skip
def test_rims_that_are_meant_are_left_alone(mesh: Mesh) -> None:
    found = _connectivity(mesh)
    assert not len(found.loose) and not len(found.pinched)


def test_built_in_sheets_hang_together() -> None:
    for sheet, rims in (
        (shapes.disc(radius=1.0, elements=200, symmetry="quarter"), 1),
        (shapes.rectangle(size=(2.0, 1.0), elements=100, symmetry="half"), 1),
        (shapes.sphere(radius=1.0, elements=200), 0),
        (shapes.bottle_half(element_size=0.012), 2),
    ):
        found = mesh_connectivity.find_connectivity(sheet.positions, sheet.triangles, sheet.fixed)
        assert (found.part_count, found.rims) == (1, rims)
        assert not len(found.loose) + len(found.pinched) + len(found.opposed)


def test_bow_ties_open_and_closed() -> None:
    found = _connectivity(_together(_patch(2, 2, low=(-1.0, -1.0)), _patch(2, 2)))
    assert found.part_count == 2 and len(found.pinched) == 1 and found.rims == 1
    ball = shapes.sphere(radius=1.0, elements=128)
    one, other = (_move(Mesh(ball.positions, ball.triangles), shift) for shift in (-1.0, 1.0))
    mesh = _together(one, other)
    found = _connectivity(mesh)
    np.testing.assert_allclose(mesh.positions[found.pinched], [[0.0, 0.0, 0.0]], atol=1e-12)


def test_parts_that_face_opposite_ways() -> None:
    one, other = _patch(4, 4), _patch(3, 3, low=(2.0, 0.0))
    assert not len(_connectivity(_together(one, other)).opposed)
    assert len(_connectivity(_together(one, _flip(other))).opposed) == 1
    # The front and the back of a parison, each pushed away from the other.
    back = _flip(Mesh(one.positions - [0, 0, 0.2], one.triangles))
    assert not len(_connectivity(_together(one, back)).opposed)
    ball = shapes.sphere(radius=1.0, elements=128)
    near, far = (_move(Mesh(ball.positions, ball.triangles), shift) for shift in (0.0, 3.0))
    assert not len(_connectivity(_together(near, far)).opposed)
    assert len(_connectivity(_together(near, _flip(far))).opposed) == 1


def test_joints_of_many_elements_take_no_time_to_speak_of() -> None:
    sheet = shapes.rectangle(size=(1.0, 1.0), elements=100_000)
    began = time.perf_counter()
    assert mesh_connectivity.find_connectivity(sheet.positions, sheet.triangles, sheet.fixed).part_count == 1
    assert time.perf_counter() - began < 5.0  # 0.13 s where nothing else runs


def test_a_parison_file_with_hanging_nodes_is_warned_of_by_place_and_number(tmp_path: Path) -> None:
    text = scenes.FILE
    begin, end = text.index('shape = "disc"'), text.index("[material]")
    text = text.replace(text[begin:end], 'shape = "file"\npath = "halves.vtu"\nthickness = 1e-3\n')
    text = text.replace(text[text.index("[mold]") : text.index("[solver]")], "")
    (tmp_path / "scene.toml").write_text(text)
    size = (0.1, 0.1)
    halves = _together(_patch(3, 3, low=(-0.1, 0.0), size=size), _patch(3, 2, size=size))
    meshes.write_vtu(tmp_path / "halves.vtu", halves.positions, halves.triangles)
    with pytest.warns(InputWarning) as told:
        jaxform.load(tmp_path / "scene.toml")
    sentences = [str(warning.message) for warning in told]
    assert len(sentences) == 2
    assert "3 rim nodes on another rim" in sentences[0] and "(0, 0.03333, 0) m" in sentences[0]
    assert "with 3 of the nodes clamped" in sentences[0] and "scene.toml" in sentences[0]
    assert "'halves.vtu'" in sentences[0] and "2 parts" in sentences[1]
