"""Built-in sheets and a user's mesh: counts, areas, angles, orientation, symmetry, clamps, and bad input."""

import math
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import jaxform
from jaxform.core.errors import InputError, InputWarning
from jaxform.mesh import topology
from jaxform.mesh.grids import Profile
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.shapes import disc, from_mesh, rectangle, sphere

pytestmark = pytest.mark.quick

SYMMETRIES = ["none", "half", "quarter"]
KEPT = {"none": 1.0, "half": 0.5, "quarter": 0.25}
CUTS = {"none": [], "half": [0], "quarter": [0, 1]}


def normals(sheet) -> np.ndarray:
    """Area vectors, (m, 3)."""
    corner = sheet.positions[sheet.triangles]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2


def area(sheet) -> float:
    return float(np.linalg.norm(normals(sheet), axis=1).sum())


def lengths(sheet) -> np.ndarray:
    edge = topology.edges(sheet.triangles)[0]
    return np.linalg.norm(sheet.positions[edge[:, 0]] - sheet.positions[edge[:, 1]], axis=1)


def minimum_angle(sheet) -> float:
    corner = sheet.positions[sheet.triangles]
    smallest = 180.0
    for k in range(3):
        u, v = corner[:, k - 1] - corner[:, k], corner[:, k - 2] - corner[:, k]
        cosine = (u * v).sum(axis=1) / np.linalg.norm(u, axis=1) / np.linalg.norm(v, axis=1)
        smallest = min(smallest, float(np.degrees(np.arccos(cosine)).min()))
    return smallest


def characteristic(sheet) -> int:
    return len(sheet.positions) - len(topology.edges(sheet.triangles)[0]) + len(sheet.triangles)


def check_sound(sheet) -> None:
    """Every node used, no copies, one surface, all triangles turned the same way."""
    assert sheet.positions.dtype == np.float64 and sheet.triangles.dtype == np.int32
    np.testing.assert_array_equal(np.unique(sheet.triangles), np.arange(len(sheet.positions)))
    assert len(np.unique(sheet.positions.round(12), axis=0)) == len(sheet.positions)
    assert len(topology.nonmanifold_edges(sheet.triangles)) == 0
    assert len(topology.inconsistent_edges(sheet.triangles)) == 0
    assert len(set(topology.components(sheet.triangles, len(sheet.positions)))) == 1


def check_cut(sheet, symmetry: str, planes: tuple[float, float]) -> None:
    """Exactly the nodes on the cut planes are fixed, in the normal component alone."""
    for axis in range(3):
        on = sheet.positions[:, axis] == planes[axis] if axis in CUTS[symmetry] else np.zeros(len(sheet.fixed), bool)
        np.testing.assert_array_equal(sheet.fixed[:, axis], on)


# Disc


@pytest.mark.parametrize("symmetry", SYMMETRIES)
@pytest.mark.parametrize("rings", [2, 3, 5, 12, 37])
def test_disc(symmetry, rings):
    sheet = disc(radius=0.1, element_size=0.1 / rings, symmetry=symmetry)
    check_sound(sheet)
    check_cut(sheet, symmetry, (0.0, 0.0))
    assert characteristic(sheet) == 1
    assert np.all(normals(sheet)[:, 2] > 0) and np.all(sheet.positions[:, 2] == 0)
    assert minimum_angle(sheet) > 37
    assert sheet.positions[:, CUTS[symmetry]].min(initial=0.0) == 0
    r = np.hypot(sheet.positions[:, 0], sheet.positions[:, 1])
    np.testing.assert_array_equal(sheet.clamped, np.isclose(r, 0.1, rtol=1e-9))
    np.testing.assert_allclose(r[sheet.clamped], 0.1, rtol=4e-16)
    assert 0.7 * 0.1 / rings < lengths(sheet).min() and lengths(sheet).max() < 1.5 * 0.1 / rings


def ring_angles(sheet, radius: float) -> np.ndarray:
    """Angles [degrees] of the nodes of a ring, ascending."""
    node = sheet.positions[np.isclose(np.hypot(*sheet.positions[:, :2].T), radius)]
    return np.sort(np.degrees(np.arctan2(node[:, 1], node[:, 0])))


@pytest.mark.parametrize("symmetry", ["half", "quarter"])
def test_arcs_of_a_disc_are_even_and_end_on_the_axes(symmetry):
    sheet = disc(radius=7.0, element_size=1.0, symmetry=symmetry)
    for ring in range(1, 8):
        angle = ring_angles(sheet, ring)
        segments = 3 * ring if symmetry == "half" else math.floor(1.5 * ring + 0.5)
        assert len(angle) == segments + 1
        np.testing.assert_allclose(angle, np.linspace(-90 if symmetry == "half" else 0, 90, segments + 1), atol=1e-12)


@pytest.mark.parametrize("count", [10, 20, 41])
def test_rings_of_a_disc_are_even_and_turned_against_those_with_as_many_segments(count):
    sheet = disc(radius=float(count), element_size=1.0)
    rings = [np.sort(ring_angles(sheet, ring).round(9) % 360) for ring in range(1, count + 1)]
    for ring, angle in enumerate(rings, 1):
        np.testing.assert_allclose(np.diff(angle), 360 / len(angle), atol=1e-6)
        assert ring <= 2 or 0.75 * ring < len(angle) / 6 < 1.35 * ring
    alike = [(inner, outer) for inner, outer in pairwise(rings) if len(inner) == len(outer)]
    assert len(alike) > 0.25 * count
    for inner, outer in alike:
        assert abs(inner[0] - outer[0]) == pytest.approx(180 / len(inner))
    # The rim is as fine as is asked.
    assert len(rings[-1]) == 6 * count


@pytest.mark.parametrize("count", [11, 20, 37])
def test_disc_has_no_spokes(count):
    """No node but those near the centre has an edge straight inwards and one straight outwards."""
    sheet = disc(radius=1.0, element_size=1 / count)
    edge = topology.edges(sheet.triangles)[0]
    edge = np.concatenate([edge, edge[:, ::-1]])
    begin, end = sheet.positions[edge, :2].swapaxes(0, 1)
    across = begin[:, 0] * end[:, 1] - begin[:, 1] * end[:, 0]
    radius = np.hypot(*sheet.positions[:, :2].T)
    radial = np.abs(across) <= 1e-9 * radius[edge[:, 0]]
    inwards, outwards = (
        np.isin(np.arange(len(radius)), edge[radial & side, 0])
        for side in (radius[edge[:, 1]] < radius[edge[:, 0]], radius[edge[:, 1]] > radius[edge[:, 0]])
    )
    assert not (inwards & outwards)[radius > 0.55].any()


@pytest.mark.parametrize(
    ("at", "value", "angle"),
    [
        ((0.0, 0.05, 0.1), (0.004, 0.002, 0.004), 40),
        ((0.0, 0.1), (0.008, 0.001), 39),
        ((0.0, 0.04, 0.05, 0.06, 0.1), (0.008, 0.008, 0.0015, 0.008, 0.008), 25),
        ((0.0, 0.09, 0.1), (0.002, 0.002, 0.01), 20),
    ],
)
def test_numbers_of_segments_follow_a_size_that_changes_fast(at, value, angle):
    sheet = disc(radius=0.1, element_size=Profile("radius", at, value))
    check_sound(sheet)
    assert np.all(normals(sheet)[:, 2] > 0) and minimum_angle(sheet) > angle


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_disc_area_converges_with_order_two(symmetry):
    exact = KEPT[symmetry] * math.pi * 0.3**2
    error = [exact - area(disc(radius=0.3, element_size=0.3 / n, symmetry=symmetry)) for n in (8, 16, 32)]
    order = np.log2(np.array(error[:-1]) / error[1:])
    assert np.all(np.abs(order - 2) < 0.05), order


def test_disc_parts_have_their_share_of_the_area():
    whole = area(disc(radius=0.1, element_size=0.01))
    assert area(disc(radius=0.1, element_size=0.01, symmetry="half")) == pytest.approx(whole / 2, rel=1e-13)
    assert area(disc(radius=0.1, element_size=0.01, symmetry="quarter")) == pytest.approx(whole / 4, rel=1e-13)


def test_disc_is_symmetric_under_sixth_turns_and_mirrors():
    sheet = disc(radius=1.0, element_size=1 / 6)
    centres = sheet.positions[sheet.triangles].mean(axis=1)[:, :2]
    c, s = math.cos(math.pi / 3), math.sin(math.pi / 3)
    for image in (centres @ np.array([[c, s], [-s, c]]), centres * [1, -1], centres * [-1, 1]):
        distance = np.linalg.norm(centres[:, None] - image[None], axis=2).min(axis=0)
        assert distance.max() < 1e-12


# Rectangle


@pytest.mark.parametrize("symmetry", SYMMETRIES)
@pytest.mark.parametrize("size", [(0.3, 0.1), (0.1, 0.37), (1.0, 1.0)])
def test_rectangle(symmetry, size):
    sheet = rectangle(size=size, element_size=0.02, symmetry=symmetry)
    check_sound(sheet)
    edge = (size[0] / 2, size[1] / 2)
    check_cut(sheet, symmetry, edge)
    assert characteristic(sheet) == 1
    assert np.all(normals(sheet)[:, 2] > 0)
    assert area(sheet) == pytest.approx(KEPT[symmetry] * size[0] * size[1], rel=1e-13)
    assert minimum_angle(sheet) > 35
    # A side of two and a half cells gets two; diagonals are 1.42 to 1.5 times a side.
    assert 0.013 < lengths(sheet).min() and lengths(sheet).max() < 0.02 * 1.25 * 1.5
    np.testing.assert_array_equal(sheet.positions.min(axis=0), 0)
    x, y = sheet.positions[:, 0], sheet.positions[:, 1]
    outer = (x == 0) | (y == 0)
    if symmetry == "none":
        outer |= x == size[0]
    if symmetry != "quarter":
        outer |= y == size[1]
    np.testing.assert_array_equal(sheet.clamped, outer)


@pytest.mark.parametrize("symmetry", SYMMETRIES)
@pytest.mark.parametrize("elements", [4, 9, 50, 333])
def test_rectangle_has_no_triangle_that_can_never_move(symmetry, elements):
    sheet = rectangle(size=(0.3, 0.2), elements=elements, symmetry=symmetry)
    assert not sheet.clamped[sheet.triangles].all(axis=1).any()


def test_rectangle_diagonals_alternate():
    sheet = rectangle(size=(1.0, 1.0), element_size=0.1)
    degree = np.bincount(topology.edges(sheet.triangles)[0].ravel())
    assert sorted(set(degree[~sheet.clamped])) == [4, 8]


# Sphere


@pytest.mark.parametrize("symmetry", SYMMETRIES)
@pytest.mark.parametrize("elements", [8, 72, 800])
def test_sphere(symmetry, elements):
    sheet = sphere(radius=2.0, elements=elements, symmetry=symmetry)
    check_sound(sheet)
    check_cut(sheet, symmetry, (0.0, 0.0))
    assert characteristic(sheet) == (2 if symmetry == "none" else 1)
    assert topology.is_closed(sheet.triangles) == (symmetry == "none")
    centre = sheet.positions[sheet.triangles].mean(axis=1)
    assert np.all((normals(sheet) * centre).sum(axis=1) > 0)
    assert not sheet.clamped.any()
    np.testing.assert_allclose(np.linalg.norm(sheet.positions, axis=1), 2.0, rtol=1e-15)
    assert minimum_angle(sheet) > 44.9
    one = np.linalg.norm(normals(sheet), axis=1)
    assert one.max() < 1.8 * one.min()
    # The open edges of a part are those on its cut planes, no others.
    rim = topology.boundary_edges(sheet.triangles)
    assert (sheet.fixed[rim[:, 0]] & sheet.fixed[rim[:, 1]]).any(axis=1).all()


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_sphere_area_and_volume_converge_with_order_two(symmetry):
    exact = np.array([4 * math.pi, 4 * math.pi / 3]) * KEPT[symmetry]
    error = []
    for n in (4, 8, 16):
        sheet = sphere(radius=1.0, element_size=math.pi / 2 / n, symmetry=symmetry)
        inside = (normals(sheet) * sheet.positions[sheet.triangles[:, 0]]).sum() / 3
        error.append(exact - [area(sheet), inside])
    order = np.log2(np.array(error[:-1]) / np.array(error[1:]))
    assert np.all(np.abs(order - 2) < 0.15), order


def test_parts_of_the_sphere_are_sub_meshes_of_the_whole():
    def faces(sheet, keep):
        corner = sheet.positions[sheet.triangles]
        return {tuple(sorted(map(tuple, c))) for c in corner[keep(corner)].round(12) + 0.0}

    whole = sphere(radius=1.0, element_size=0.2)
    half, quarter = (sphere(radius=1.0, element_size=0.2, symmetry=s) for s in ("half", "quarter"))
    everything = lambda c: np.ones(len(c), bool)  # noqa: E731
    assert faces(half, everything) == faces(whole, lambda c: c[:, :, 0].min(axis=1) >= 0)
    assert faces(quarter, everything) == faces(whole, lambda c: c[:, :, :2].min(axis=(1, 2)) >= 0)


# Common properties of all built-in shapes

MAKERS = {
    "disc": lambda **options: disc(**{"radius": 0.1, **options}),
    "rectangle": lambda **options: rectangle(**{"size": (0.2, 0.3), **options}),
    "sphere": lambda **options: sphere(**{"radius": 0.1, **options}),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_elements_are_about_as_many_as_asked_for(make, symmetry):
    for elements in (200, 1000, 20000):
        assert len(make(elements=elements, symmetry=symmetry).triangles) == pytest.approx(elements, rel=0.15)
    assert 4 <= len(make(elements=4, symmetry=symmetry).triangles) <= 12


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
@pytest.mark.parametrize(
    ("options", "key", "value"),
    [
        ({}, "parison.element_size", None),
        ({"elements": 50, "element_size": 0.01}, "parison.element_size", 0.01),
        ({"elements": 3}, "parison.elements", 3),
        ({"elements": 2_000_001}, "parison.elements", 2_000_001),
        ({"elements": 10**400}, "parison.elements", 10**400),
        ({"elements": math.nan}, "parison.elements", math.nan),
        ({"elements": "many"}, "parison.elements", "many"),
        ({"elements": True}, "parison.elements", True),
        ({"element_size": 0.5}, "parison.element_size", 0.5),
        ({"element_size": 0.0}, "parison.element_size", 0.0),
        ({"element_size": -1.0}, "parison.element_size", -1.0),
        ({"element_size": math.inf}, "parison.element_size", math.inf),
        ({"element_size": "small"}, "parison.element_size", "small"),
        ({"element_size": 1e-5}, "parison.element_size", 1e-5),
        ({"element_size": 1e-300}, "parison.element_size", 1e-300),
        ({"elements": 50, "symmetry": "third"}, "parison.symmetry", "third"),
    ],
)
def test_bad_parameters(make, options, key, value):
    with pytest.raises(InputError) as caught:
        make(**options)
    assert caught.value.key == key and caught.value.remedy
    np.testing.assert_equal(caught.value.value, value)


@pytest.mark.parametrize("radius", [0, -0.1, math.nan, math.inf, "wide", None])
@pytest.mark.parametrize("make", [disc, sphere])
def test_bad_radius(make, radius):
    with pytest.raises(InputError, match=r"parison\.radius.* is not a positive length|parison\.radius: is not"):
        make(radius=radius, elements=50)


@pytest.mark.parametrize("size", [(0, 1), (1, -1), (1, math.nan), (1,), (1, 2, 3), 4.0, "ab", None])
def test_bad_size(size):
    with pytest.raises(InputError, match=r"^parison\.size"):
        rectangle(size=size, elements=50)


def test_a_quarter_of_one_ring_is_too_coarse():
    with pytest.raises(InputError, match=r"gives 1\.5 elements"):
        disc(radius=1.0, element_size=1.0, symmetry="quarter")


# A user's mesh


def as_mesh(sheet, **fields) -> Mesh:
    return Mesh(sheet.positions, sheet.triangles, fields)


def soup(sheet) -> Mesh:
    """The sheet as an STL file has it: three nodes of its own for each triangle."""
    corners = sheet.positions[sheet.triangles].reshape(-1, 3)
    return Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))


def assert_rejected(key: str, mesh: Mesh, **options) -> str:
    with pytest.raises(InputError) as caught:
        from_mesh(mesh, **options)
    assert caught.value.key == key and caught.value.remedy
    return caught.value.problem


@pytest.mark.parametrize("symmetry", SYMMETRIES)
@pytest.mark.parametrize("make", [disc, sphere])
def test_from_mesh_finds_clamps_and_planes_of_the_built_in_shapes(symmetry, make):
    expected = make(radius=0.1, elements=200, symmetry=symmetry)
    # Nodes off the planes by the rounding of a float32 file.
    noise = np.where(expected.fixed, 3e-9 * np.sin(np.arange(expected.positions.size)).reshape(-1, 3), 0.0)
    mesh = Mesh(expected.positions + noise, expected.triangles)
    sheet = from_mesh(mesh, planes=["xy"[axis] for axis in CUTS[symmetry]])
    np.testing.assert_array_equal(sheet.positions, expected.positions)
    np.testing.assert_array_equal(sheet.triangles, expected.triangles)
    np.testing.assert_array_equal(sheet.clamped, expected.clamped)
    np.testing.assert_array_equal(sheet.fixed, expected.fixed)


def test_without_planes_the_cut_is_clamped_too():
    quarter = disc(radius=0.1, elements=200, symmetry="quarter")
    sheet = from_mesh(soup(quarter))
    assert len(sheet.positions) == len(quarter.positions) and not sheet.fixed.any()
    assert sheet.clamped.sum() == (quarter.clamped | quarter.fixed.any(axis=1)).sum()


def test_flip_turns_the_normals_only():
    ball = sphere(radius=0.1, elements=200)
    sheet = from_mesh(as_mesh(ball), flip=True)
    np.testing.assert_allclose(normals(sheet), -normals(ball), atol=1e-18)
    check_sound(sheet)


def test_clamp_by_field_keeps_the_fields():
    plate = disc(radius=0.1, elements=200)
    grip = (plate.positions[:, 0] > 0.05).astype(float)
    sheet = from_mesh(as_mesh(plate, grip=grip, heat=3 * plate.positions[:, 1]), clamp="field:grip")
    np.testing.assert_array_equal(sheet.clamped, sheet.positions[:, 0] > 0.05)
    np.testing.assert_array_equal(sheet.fields["heat"], 3 * sheet.positions[:, 1])


def test_clamp_none_is_for_closed_meshes_and_cut_ones():
    assert not from_mesh(as_mesh(sphere(radius=1.0, elements=200)), clamp="none").clamped.any()
    cut = as_mesh(sphere(radius=1.0, elements=200, symmetry="quarter"))
    assert not from_mesh(cut, clamp="none", planes=["x", "y"]).clamped.any()
    assert "unclamped open parison" in assert_rejected("parison.clamp", cut, clamp="none", planes=["x"])
    assert "unclamped open" in assert_rejected("parison.clamp", as_mesh(disc(radius=1.0, elements=50)), clamp="none")


def test_every_open_part_needs_a_clamp():
    plate = disc(radius=0.1, elements=100)
    ball = sphere(radius=0.1, elements=100)
    count = len(plate.positions)
    for other, fine in ((ball, True), (plate, False)):
        mesh = Mesh(
            np.concatenate([plate.positions, other.positions + np.array([0, 0, 1])]),
            np.concatenate([plate.triangles, other.triangles + np.int32(count)]),
            {"grip": np.concatenate([plate.clamped.astype(float), np.zeros(len(other.positions))])},
        )
        if fine:
            np.testing.assert_array_equal(from_mesh(mesh, clamp="field:grip").clamped, mesh.fields["grip"] == 1)
        else:
            assert "unclamped open" in assert_rejected("parison.clamp", mesh, clamp="field:grip")
        assert from_mesh(mesh).clamped.sum() == plate.clamped.sum() + other.clamped.sum()


def test_clamp_errors():
    plate = disc(radius=0.1, elements=100)
    one = np.ones(len(plate.positions))
    mesh = as_mesh(plate, zero=0 * one, nan=np.nan * one, all=one)
    assert "no such field" in assert_rejected("parison.clamp", mesh, clamp="field:grip")
    assert "no node" in assert_rejected("parison.clamp", mesh, clamp="field:zero")
    assert "no node" in assert_rejected("parison.clamp", mesh, clamp="field:nan")
    assert "every node" in assert_rejected("parison.clamp", mesh, clamp="field:all")
    assert "not a way" in assert_rejected("parison.clamp", mesh, clamp="rim")


def test_plane_errors():
    mesh = as_mesh(disc(radius=0.1, elements=100))
    away = replace(mesh, positions=mesh.positions + np.array([1, 0, 0]))
    assert "no node lies on x = 0" in assert_rejected("parison.planes", away, planes=["x"])
    assert "both sides of y = 0" in assert_rejected("parison.planes", mesh, planes=["y"])
    assert "not a symmetry plane" in assert_rejected("parison.planes", mesh, planes=["xy"])


def test_faults_of_the_surface():
    plate = disc(radius=0.1, elements=100)
    turned = plate.triangles.copy()
    turned[7] = turned[7, ::-1]
    assert "inverted" in assert_rejected("parison.path", Mesh(plate.positions, turned))
    fin = np.array([[0, 1, len(plate.positions)]])
    positions = np.concatenate([plate.positions, [[0, 0, 1.0]]])
    finned = Mesh(positions, np.concatenate([plate.triangles, fin]).astype(np.int32))
    assert "more than two triangles" in assert_rejected("parison.path", finned)
    flat = np.concatenate([plate.triangles, [[0, 1, 1], [2, 2, 3]]]).astype(np.int32)
    problem = assert_rejected("parison.path", Mesh(plate.positions, flat))
    assert problem.startswith("2 degenerate") and f"number {len(plate.triangles)}" in problem
    twice = np.concatenate([plate.triangles, plate.triangles[5:6]])
    assert f"number {len(plate.triangles)}" in assert_rejected("parison.path", Mesh(plate.positions, twice))


# Profiles


def test_profile_is_linear_between_knots_and_constant_outside():
    profile = Profile("radius", (0.1, 0.3), (1.0, 2.0))
    positions = np.array([[0, 0, 9.0], [0.12, 0.16, 1], [0, -0.25, 0], [3, 4, 0]])
    np.testing.assert_allclose(profile.coordinate(positions), [0, 0.2, 0.25, 5])
    np.testing.assert_allclose(profile(positions), [1, 1.5, 1.75, 2])


@pytest.mark.parametrize("axis", range(3))
def test_profile_along_an_axis(axis):
    positions = np.arange(12.0).reshape(2, 2, 3)
    profile = Profile("xyz"[axis], (0.0, 100.0), (0.0, 50.0))
    np.testing.assert_allclose(profile(positions), positions[..., axis] / 2)


@pytest.mark.parametrize(
    ("part", "along", "at", "value"),
    [
        ("along", "height", (0, 1), (1, 2)),
        ("at", "x", (1, 0), (1, 2)),
        ("at", "x", (0, 0), (1, 2)),
        ("at", "x", (0, math.nan), (1, 2)),
        ("at", "x", (), ()),
        ("at", "x", 3.0, (1, 2)),
        ("value", "x", (0, 1), (1, 2, 3)),
        ("value", "x", (0, 1), (1, math.inf)),
        ("value", "x", (0, 1), ("a", "b")),
    ],
)
def test_bad_profiles(part, along, at, value):
    with pytest.raises(InputError) as caught:
        Profile(along, at, value, key="parison.thickness")
    assert caught.value.key == f"parison.thickness.{part}" and caught.value.remedy


def test_positive_profile():
    good = Profile("x", (0, 1), (1e-3, 2e-3))
    assert good.positive() is good
    for value in ((1e-3, 0.0), (-1e-3, 1e-3)):
        with pytest.raises(InputError, match=r"profile\.value.*not positive"):
            Profile("x", (0, 1), value).positive()


def test_meshes_are_made_without_jax_and_two_modules_name_meshio() -> None:
    for path in (Path(jaxform.__file__).parent / "mesh").glob("*.py"):
        imported = set(re.findall(r"^ *(?:import|from) (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE))
        assert "jax" not in imported and ("meshio" in imported) == (path.stem in ("meshes", "formats")), path


def test_meshio_is_imported_only_when_a_file_is_read_or_written():
    code = "import sys; import jaxform.shapes, jaxform.molds; print('meshio' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("along", "at", "words"),
    [
        ("x", (0.0, 100.0), "hardly varies on the sheet: the sheet is from 0 to 0.3 m"),
        ("x", (0.5, 0.9), "varies nowhere on the sheet"),
        ("z", (0.0, 0.1), "varies nowhere on the sheet: the sheet is from 0 to 0 m"),
    ],
)
def test_a_profile_that_misses_the_sheet_is_warned_of(along: str, at: tuple[float, ...], words: str) -> None:
    sheet = rectangle(size=(0.3, 0.2), elements=8)
    with pytest.warns(InputWarning, match=f"thickness.at = .*{words}"):
        Profile(along, at, (1e-3, 2e-3), "thickness").over(sheet.positions)
    Profile(along, at, (1e-3, 1e-3), "thickness").over(sheet.positions)
    Profile("x", (-0.1, 0.5), (1e-3, 2e-3), "thickness").over(sheet.positions)
