"""Preforms: their mesh against closed forms, profiles that are refused, and inflation; uneven tubes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.mesh import topology
from tests import scenes

R, LENGTH = 0.01, 0.08


def _profile(points: int = 33, pole: float = -1.0) -> np.ndarray:
    """A cylinder with a hemisphere at its end, the pole below (or above) the neck."""
    angle = np.linspace(0.0, 0.5 * np.pi, points)
    rounded = np.stack([R * np.sin(angle), pole * R * np.cos(angle)], axis=1)
    rounded[0, 0] = 0.0
    return np.concatenate([rounded, [[R, -pole * LENGTH]]])


def _corners(sheet: shapes.Sheet) -> np.ndarray:
    return sheet.positions[sheet.triangles]


def _normals(sheet: shapes.Sheet) -> np.ndarray:
    corners = _corners(sheet)
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _angles(sheet: shapes.Sheet) -> np.ndarray:
    """Angles (3, n_element) [degrees] at the corners of the elements."""
    corners = _corners(sheet)
    ways = [[corners[:, (k + j) % 3] - corners[:, k] for j in (1, 2)] for k in range(3)]
    sines = [np.linalg.norm(np.cross(way[0], way[1]), axis=1) for way in ways]
    return np.degrees([np.arctan2(sine, np.sum(way[0] * way[1], 1)) for sine, way in zip(sines, ways, strict=True)])


@pytest.mark.quick
@pytest.mark.parametrize(("symmetry", "parts"), [("none", 1), ("half", 2), ("quarter", 4)])
@pytest.mark.parametrize("pole", [-1.0, 1.0])
def test_mesh_is_that_of_a_cylinder_with_a_hemisphere(symmetry: Any, parts: int, pole: float) -> None:
    sheet = shapes.preform(profile=_profile(pole=pole), element_size=0.001, symmetry=symmetry)
    normals, middles = _normals(sheet), _corners(sheet).mean(1)
    area = (2.0 * np.pi * R * LENGTH + 2.0 * np.pi * R**2) / parts
    volume = (np.pi * R**2 * LENGTH + 2.0 / 3.0 * np.pi * R**3) / parts
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1).sum(), area, rtol=2e-3)
    # Seen from the middle of the neck's plane: neither that nor symmetry planes add anything.
    inside = np.sum(normals * (middles - [0.0, 0.0, -pole * LENGTH])) / 3.0
    np.testing.assert_allclose(inside, volume, rtol=5e-3)
    outward = np.where((-pole * middles[:, 2] > 0.0)[:, None], middles * [1.0, 1.0, 0.0], middles)
    assert np.all(np.sum(normals * outward, axis=1) > 0.0)
    assert np.array_equal(sheet.clamped, np.abs(sheet.positions[:, 2] + pole * LENGTH) < 1e-12)
    for axis in range(parts.bit_length() - 1):
        assert np.array_equal(sheet.fixed[:, axis], sheet.positions[:, axis] == 0.0) and sheet.fixed[:, axis].any()
    assert len(topology.inconsistent_edges(sheet.triangles)) == 0 == len(topology.nonmanifold_edges(sheet.triangles))
    rims = topology.boundary_nodes(sheet.triangles)
    assert np.all(sheet.clamped[rims] | sheet.fixed[rims].any(1)), "nothing but neck and cuts is open"


@pytest.mark.quick
@pytest.mark.parametrize("symmetry", ["none", "half", "quarter"])
@pytest.mark.parametrize("elements", [60, 700, 6000])
def test_no_element_is_a_sliver(symmetry: Any, elements: int) -> None:
    # Also a narrow neck, a flat bottom with a corner, and a round one of few points.
    narrow = [[0.0, 0.0], [0.02, 0.002], [0.022, 0.01], [0.012, 0.06], [0.012, 0.08]]
    for profile in (_profile(), narrow, [[R, 0.05], [R, 0.0], [0.0, 0.0]]):
        sheet = shapes.preform(profile=profile, elements=elements, symmetry=symmetry)
        area = np.linalg.norm(_normals(sheet), axis=1)
        assert _angles(sheet).min() > 22.0 and _angles(sheet).max() < 120.0
        assert area.max() < 6.0 * area.min()
        assert 0.6 * elements < len(area) < 1.5 * elements + 20


@pytest.mark.quick
def test_profile_may_begin_at_either_end_and_corners_are_nodes() -> None:
    profile = [[0.0, 0.0], [R, 0.0], [R, 0.05]]
    one, other = (shapes.preform(profile=p, element_size=0.003) for p in (profile, profile[::-1]))
    np.testing.assert_array_equal(one.positions, other.positions)
    radius = np.hypot(*one.positions[:, :2].T)
    assert np.any((np.abs(radius - R) < 1e-12) & (one.positions[:, 2] == 0.0)), "a ring on the corner"
    np.testing.assert_allclose(one.fields["arc"], np.where(one.positions[:, 2] > 0, R + one.positions[:, 2], radius))


@pytest.mark.quick
@pytest.mark.parametrize(
    ("profile", "words"),
    [
        ([[0.01, 0.0], [0.01, 0.1]], "does not reach the axis"),
        ([[0.0, 0.0], [0.01, 0.05], [0.0, 0.1]], "closed at both ends"),
        ([[0.0, 0.0], [0.01, 0.05], [0.0, 0.06], [0.01, 0.1]], "touches the axis"),
        ([[0.0, 0.0], [-0.01, 0.05], [0.01, 0.1]], "negative radius"),
        ([[0.0, 0.0], [0.02, 0.05], [0.02, 0.02], [0.001, 0.1]], "crosses"),
        ([[0.0, 0.0], [0.02, 0.0], [0.02, 0.05], [0.02, 0.03]], "crosses"),
        ([[0.0, 0.0], [0.02, 0.0]], "encloses no volume"),
        ([[0.0, 0.0]], "fewer than two"),
        ([[0.0, 0.0], [0.0, 0.0]], "fewer than two"),
        ([[0.0, 0.0], [np.nan, 0.1]], "not a list of points"),
        ([0.0, 1.0], "not a list of points"),
    ],
)
def test_bad_profiles_are_refused(profile: Any, words: str) -> None:
    with pytest.raises(jaxform.InputError, match=f"parison.profile.*{words}"):
        shapes.preform(profile=profile, elements=200)


@pytest.mark.quick
def test_bad_sizes_are_refused() -> None:
    with pytest.raises(jaxform.InputError, match=r"parison\.element_size"):
        shapes.preform(profile=_profile(), element_size=1.0)
    with pytest.raises(jaxform.InputError, match=r"parison\.element_size"):
        shapes.preform(profile=_profile())
    with pytest.raises(jaxform.InputError, match=r"parison\.symmetry"):
        shapes.preform(profile=_profile(), elements=100, symmetry="third")  # pyright: ignore


def _hemisphere(elements: int) -> tuple[shapes.Sheet, jaxform.Parison]:
    """A quarter of a hemisphere of radius 1 whose neck stays in its plane: so it remains half a sphere."""
    angle = np.linspace(0.0, 0.5 * np.pi, 101)
    profile = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    profile[0, 0] = profile[-1, 1] = 0.0
    sheet = shapes.preform(profile=profile, elements=elements, symmetry="quarter")
    sheet.fixed[:, 2] |= sheet.clamped
    return sheet, jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, np.zeros(len(sheet.fixed)), sheet.fixed)


@pytest.mark.long
def test_hemisphere_is_inflated_as_a_sphere() -> None:
    stretch = 1.3  # below the maximum of the pressure
    pressure = 4.0 * 0.01 * (1.0 / stretch - stretch**-7) * (1.0 + 0.1 * stretch**2)
    scene = jaxform.build_scene(
        parison=_hemisphere(800)[1],
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 20.0], [0.0, pressure]),
        solver=jaxform.make_solver(end_time=40.0, damping=1.0),
    )
    result = jaxform.run(scene)
    assert int(result.status) == 0 and float(result.energy.balance_error) < 1e-3
    radius = np.linalg.norm(np.asarray(result.positions), axis=1)
    np.testing.assert_allclose(radius, stretch, rtol=4e-3)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(radius / stretch - 1.0))), 0.0, atol=2e-3)
    thickness = np.asarray(result.thickness) / 0.01 * stretch**2
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(thickness - 1.0))), 0.0, atol=4e-3)
    pole = int(np.argmin(np.asarray(result.reference)[:, 2]))
    np.testing.assert_allclose(thickness[pole], 1.0, rtol=1e-2)


_SCENE = """
[parison]
shape = "preform"
profile = [[0.0, 0.0], [0.004, 0.0008], [0.007, 0.003], [0.01, 0.01], [0.01, 0.06]]
elements = 150
symmetry = "quarter"
thickness = { along = "arc", at = [0.0, 0.02, 0.06], value = [2.0e-3, 2.0e-3, 1.0e-3] }
[material]
model = "mooney-rivlin"
c = 2.0e5
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0, 0.02]
value = [0.0, 5.0e4]
[solver]
end_time = 0.03
damping = 300.0
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> jaxform.Scene:
    file = tmp_path_factory.mktemp("preform") / "scene.toml"
    file.write_text(_SCENE)
    return jaxform.load(file)


@pytest.mark.long
def test_mass_is_kept_and_the_wall_has_the_gradient_of_differences(scene: jaxform.Scene) -> None:
    base = jaxform.run(scene)
    assert int(base.status) == 0 and float(base.energy.balance_error) < 1e-3
    corners = np.asarray(base.positions)[np.asarray(scene.parison.triangles)]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    first = np.asarray(scene.parison.positions)[np.asarray(scene.parison.triangles)]
    start = 0.5 * np.linalg.norm(np.cross(first[:, 1] - first[:, 0], first[:, 2] - first[:, 0]), axis=1)
    rubber = start * np.asarray(scene.parison.thickness)[np.asarray(scene.parison.triangles)].mean(1)
    np.testing.assert_allclose(area * np.asarray(base.element_thickness), rubber, rtol=1e-9)
    np.testing.assert_allclose(float(base.mass), 1000.0 * rubber.sum(), rtol=1e-9)
    assert area.sum() > 1.1 * start.sum()

    weight = jnp.asarray(np.random.default_rng(3).normal(size=base.thickness.shape))
    way = jnp.asarray(1.0 + 0.5 * np.sin(300.0 * np.asarray(scene.parison.positions)[:, 2]))

    @jax.jit
    @jax.value_and_grad
    def both(share: jax.Array) -> jax.Array:
        thickness = scene.parison.thickness * (1.0 + share * way)
        result = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness}), schedule=base.schedule)
        return jnp.sum(weight * (1e3 * result.thickness + 1e2 * result.positions[:, 2]))

    difference = (both(1e-5)[0] - both(-1e-5)[0]) / 2e-5
    np.testing.assert_allclose(both(0.0)[1], difference, rtol=1e-6)


def test_thickness_along_the_arc_is_that_of_the_profile(scene: jaxform.Scene) -> None:
    sheet = shapes.preform(
        profile=[[0.0, 0.0], [0.004, 0.0008], [0.007, 0.003], [0.01, 0.01], [0.01, 0.06]],
        elements=150,
        symmetry="quarter",
    )
    expected = np.interp(sheet.fields["arc"], [0.0, 0.02, 0.06], [2.0e-3, 2.0e-3, 1.0e-3])
    np.testing.assert_allclose(np.asarray(scene.parison.thickness), expected, rtol=1e-12)
    assert np.ptp(expected) > 0.9e-3


def test_new_nodes_of_a_refined_preform_are_on_its_surface(tmp_path: Path) -> None:
    file = tmp_path / "refined.toml"
    file.write_text(_SCENE + "[refinement]\nangle = 3.0\nmax_level = 2\ninterval = 100\n")
    built = jaxform.load(file)
    nodes = np.asarray(built.parison.positions)
    profile = np.array([[0.0, 0.0], [0.004, 0.0008], [0.007, 0.003], [0.01, 0.01], [0.01, 0.06]])
    radius, height = np.hypot(*nodes[:, :2].T), nodes[:, 2]
    away = np.abs(radius - np.interp(height, profile[:, 1], profile[:, 0]))
    assert len(nodes) > 300 and away.max() < 1e-9
    assert np.all(radius[np.abs(height - 0.06) < 1e-12] > 0.00999), "new nodes of the neck are on its circle"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[[0.0, 0.0], ", "[", "parison.profile.*does not reach the axis"),
        ('along = "arc"', 'along = "arcs"', "parison.thickness"),
        ("elements = 150", "elements = 150\nradius = 1.0", "parison.radius"),
        ("[0.01, 0.06]]", "[0.01, 0.06, 0.1]]", "parison.profile"),
    ],
)
def test_bad_preforms_of_files_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(_SCENE.replace(old, new))
    with pytest.raises(jaxform.InputError, match=words):
        jaxform.load(file)


# Tubes that are not even: flare and die swell as a radius along z, a thickness around.

_TUBE = """
[parison]
shape = "tube"
radius = { along = "z", at = [0.0, 0.06, 0.1], value = [0.02, 0.01, 0.015] }
length = 0.1
elements = 1600
symmetry = "half"
thickness = { along = "angle", at = [0.0, 90.0, 180.0, 270.0, 360.0], value = [1.0e-3, 2.0e-3, 1.0e-3, 2.0e-3, 1.0e-3] }
"""


def test_tube_with_a_flare_and_a_thickness_around(tmp_path: Path) -> None:
    file = tmp_path / "tube.toml"
    file.write_text(_TUBE + _SCENE[_SCENE.index("[material]") :])
    built = jaxform.load(file)
    nodes, thickness = np.asarray(built.parison.positions), np.asarray(built.parison.thickness)
    radius = np.hypot(*nodes[:, :2].T)
    np.testing.assert_allclose(radius, np.interp(nodes[:, 2], [0.0, 0.06, 0.1], [0.02, 0.01, 0.015]), rtol=1e-12)
    around = np.abs(np.degrees(np.arctan2(nodes[:, 1], nodes[:, 0])))
    np.testing.assert_allclose(thickness, 1e-3 * (1.0 + around / 90.0), rtol=1e-9)
    corners = nodes[np.asarray(built.parison.triangles)]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    cones = np.pi * (0.03 * np.hypot(0.06, 0.01) + 0.025 * np.hypot(0.04, 0.005))
    np.testing.assert_allclose(area, 0.5 * cones, rtol=3e-3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('along = "z"', 'along = "x"', "parison.radius.*along"),
        ("0.01, 0.015", "0.0, 0.015", "parison.radius"),
        ('along = "angle"', 'along = "arc"', "parison.thickness.along.*preform"),
    ],
)
def test_bad_uneven_tubes_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    file = tmp_path / "tube.toml"
    file.write_text(_TUBE.replace(old, new) + _SCENE[_SCENE.index("[material]") :])
    with pytest.raises(jaxform.InputError, match=words):
        jaxform.load(file)
