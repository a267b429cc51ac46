"""Slivers of a mold are merged where its surface stays where it is, and nowhere else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import jaxform
from jaxform.io import files
from jaxform.mesh import meshes, topology
from jaxform.tools.distances import Distances
from jaxform.tools.molds import MoldShape, revolved
from jaxform.tools.slivers import merge_slivers

Array = NDArray[np.float64]


def _dome(segments: int) -> MoldShape:
    angle = np.linspace(0.0, 0.5 * np.pi, 9)
    return revolved(profile=np.stack([0.1 * np.sin(angle), 0.06 * np.cos(angle)], axis=1), segments=segments)


_CONE = [[0.0, 0.05], [0.1, 0.0]]
_CAN = [[0.0, 0.05], [0.1, 0.05], [0.1, 0.0]]
_SHAPES = {
    "fan": (revolved(profile=_CONE, segments=20_000), 10),
    "can with a fan for its floor": (revolved(profile=_CAN, segments=10_000), 3),
    "dome with slivers at its pole": (_dome(4000), 1.5),
}


def _farthest(one: tuple[Array, NDArray[np.integer]], other: tuple[Array, NDArray[np.integer]]) -> float:
    """Largest distance of places all over a surface, and of its corners, from another."""
    corners = one[0][one[1]]
    random = np.random.default_rng(0)
    weight = random.dirichlet(np.ones(3), 1000)
    places = np.einsum("nc,nck->nk", weight, corners[random.integers(0, len(corners), 1000)])
    places = np.concatenate([places, one[0][random.integers(0, len(one[0]), 500)]])
    return float(Distances(*other, 1e-3).nearest(places).distance.max())


@pytest.mark.parametrize("name", _SHAPES)
def test_merged_slivers_are_the_same_surface_of_fewer_triangles(name: str) -> None:
    shape, fewer = _SHAPES[name]
    vertices, triangles, _ = merge_slivers(shape.vertices, shape.triangles)
    assert fewer * len(triangles) < len(shape.triangles)
    before, after = (shape.vertices, shape.triangles), (vertices, triangles)
    size = np.ptp(shape.vertices, axis=0).max()
    assert max(_farthest(before, after), _farthest(after, before)) < 2e-6 * size
    assert not meshes.find_degenerate(*after).any() and len(topology.nonmanifold_edges(triangles)) == 0
    # No hole is made: what is open is the rim as before, of one loop.
    rim, loop = topology.open_rims(triangles, len(vertices))
    assert loop.max() == 0 and np.abs(vertices[rim][..., 2]).max() < 1e-12
    turned = np.sign(topology.orientations(triangles)[1])
    assert (turned == turned[0]).all()


def test_sharp_edges_and_corners_stay_and_a_mold_of_few_slivers_is_not_changed() -> None:
    # A ring of narrow steps, none of whose sides is in the plane of the next.
    count = 4000
    angle = 2 * np.pi * np.arange(count) / count
    radius = np.where(np.arange(count) % 2, 0.1, 0.099)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([np.insert(ring, 2, z, axis=1) for z in (0.0, 0.05)])
    k = np.arange(count)
    a, b = k, (k + 1) % count
    triangles = np.concatenate([np.stack([a, b, b + count], 1), np.stack([a, b + count, a + count], 1)])
    merged = merge_slivers(vertices, triangles)[0]
    np.testing.assert_array_equal(np.unique(merged, axis=0), np.unique(vertices, axis=0))
    few = revolved(profile=_CONE, segments=1500)
    same_vertices, same_triangles, _ = merge_slivers(few.vertices, few.triangles)
    np.testing.assert_array_equal(same_triangles, few.triangles)
    np.testing.assert_array_equal(same_vertices, few.vertices)


_SCENE = """
[parison]
shape = "disc"
radius = 0.1
elements = 150
thickness = 1.0e-3
[material]
model = "mooney-rivlin"
c = 0.2e6
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0, 0.04]
value = [0.0, 2.0e4]
[mold]
shape = "file"
path = {path}
[solver]
end_time = 0.05
damping = 100.0
"""


def _scene(folder: Path, name: str, shape: MoldShape) -> jaxform.Scene:
    meshes.write_vtu(folder / f"{name}.vtu", shape.vertices, shape.triangles)
    file = folder / f"{name}.toml"
    file.write_text(_SCENE.format(path=f'"{name}.vtu"'))
    return files.build(files.read_scene(file))


@pytest.mark.long
def test_a_sheet_over_a_fan_of_slivers_is_as_over_the_same_cone_well_meshed(tmp_path: Path) -> None:
    fan = _scene(tmp_path, "fan", revolved(profile=_CONE, segments=100_000))
    assert fan.mold is not None and len(fan.mold.triangles) < 2500
    # A surface of rings, each as high as its triangles are wide.
    along = np.linspace(0.0, 1.0, 41)[:, None]
    rings = (1 - along) * _CONE[0] + along * _CONE[1]
    fine = _scene(tmp_path, "fine", revolved(profile=rings, segments=400))
    one, other = jaxform.run(fan), jaxform.run(fine)
    assert int(one.status) == int(other.status)
    # All but the clamped rim lies on the cone.
    free = ~np.asarray(fan.parison.clamped)
    assert np.count_nonzero(np.asarray(one.wall)[free] == 0) <= 1
    thickness = np.asarray(other.element_thickness)
    np.testing.assert_allclose(np.asarray(one.element_thickness), thickness, rtol=5e-3)


def test_a_part_named_by_files_has_the_triangles_of_these_once_slivers_are_merged(tmp_path: Path) -> None:
    floor = revolved(profile=_CAN[:2], segments=5000)
    wall = revolved(profile=_CAN[1:], segments=5000)
    for name, shape in (("floor", floor), ("wall", wall)):
        meshes.write_vtu(tmp_path / f"{name}.vtu", shape.vertices, shape.triangles)
    file = tmp_path / "scene.toml"
    text = _SCENE.format(path='["floor.vtu", "wall.vtu"]')
    file.write_text(text + '[part]\nmolds = ["floor.vtu"]\n')
    scene = files.build(files.read_scene(file))
    assert scene.mold is not None and scene.part is not None and len(scene.mold.triangles) < 10_000
    corners = np.asarray(scene.mold.vertices)[np.asarray(scene.mold.triangles)]
    on_floor = np.abs(corners[..., 2] - 0.05).max(1) < 1e-7
    assert on_floor.any() and not on_floor.all()
    np.testing.assert_array_equal(np.asarray(scene.part.walls), on_floor)
