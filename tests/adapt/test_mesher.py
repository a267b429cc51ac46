"""Sheets meshed anew with a size at their nodes: sizes, boundaries, symmetry planes, area, clamping, fields."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jaxform.adapt import mesher
from jaxform.core.errors import InputError
from jaxform.mesh import shapes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.shapes import Sheet
from jaxform.mesh.volumes import areas, longest_sides
from jaxform.tools.distances import Distances, segment_distance

pytestmark = pytest.mark.quick
pytest.importorskip("mmgpy")

_L = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 1.0], [1.0, 2.0], [0.0, 2.0]]
_PREFORM = [[0.0, 0.0], [0.6, 0.1], [0.9, 0.5], [1.0, 3.0]]


def _sheets() -> dict[str, Sheet]:
    patch = shapes.rectangle(size=(2.0, 1.0), elements=300, symmetry="quarter")
    bent = Mesh(patch.positions + patch.positions[:, :1] ** 2 * [0.0, 0.0, 0.3], patch.triangles, {}, {})
    return {
        "disc": shapes.disc(radius=1.0, elements=300),
        "quarter of a disc": shapes.disc(radius=1.0, elements=300, symmetry="quarter"),
        "rectangle": shapes.rectangle(size=(2.0, 1.0), elements=300),
        "half of a rectangle": shapes.rectangle(size=(2.0, 1.0), elements=300, symmetry="half"),
        "outline": shapes.outline(polygon=_L, elements=300),
        "cut outline": shapes.outline(polygon=_L, elements=300, planes=["x"]),
        "sphere": shapes.sphere(radius=1.0, elements=300),
        "quarter of a sphere": shapes.sphere(radius=1.0, elements=300, symmetry="quarter"),
        "tube": shapes.tube(radius=1.0, length=3.0, elements=400, ends=["guided", "clamped"]),
        "quarter of a tube": shapes.tube(radius=1.0, length=3.0, elements=300, symmetry="quarter"),
        "preform": shapes.preform(profile=_PREFORM, elements=400),
        "half of a preform": shapes.preform(profile=_PREFORM, elements=400, symmetry="half"),
        "file": shapes.from_mesh(bent, planes=["x=1.0", "y=0.5"]),
        "bottle": shapes.bottle_half(),
    }


SHEETS = _sheets()
FLAT = ("rectangle", "half of a rectangle", "outline", "cut outline")  # whose boundary is straight


def _sizes(sheet: Sheet) -> np.ndarray:
    """Sizes that fall to a quarter at a place on the boundary, or on a closed surface."""
    rim = topology.boundary_nodes(sheet.triangles)
    place = sheet.positions[rim[len(rim) // 3] if len(rim) else 0]
    away = np.linalg.norm(sheet.positions - place, axis=1) / np.ptp(sheet.positions, axis=0).max()
    return 0.25 + np.minimum(0.75, 1.5 * away)


@pytest.mark.parametrize("name", SHEETS)
def test_a_sheet_on_its_new_mesh(name: str) -> None:
    sheet = SHEETS[name]
    made = mesher.remesh(sheet, _sizes(sheet), 900)
    assert 0.9 * 900 <= len(made.triangles) <= 900
    shapes.check_surface(Mesh(made.positions, made.triangles, {}, {}))
    np.testing.assert_array_equal(np.unique(made.triangles), np.arange(len(made.positions)))
    # Every element moves, and what was held is held in the same places and planes.
    assert not made.clamped[made.triangles].all(1).any()
    old, new = areas(sheet.positions, sheet.triangles).sum(), areas(made.positions, made.triangles).sum()
    assert abs(new / old - 1) < (1e-12 if name in FLAT else 0.02)
    for axis in range(3):
        levels = np.unique(sheet.positions[sheet.fixed[:, axis], axis])
        np.testing.assert_array_equal(np.unique(made.positions[made.fixed[:, axis], axis]), levels)
        # The cut's edges are those of the plane, from end to end.
        if len(levels):
            assert np.ptp(made.positions[made.fixed[:, axis]], axis=0) == pytest.approx(
                np.ptp(sheet.positions[sheet.fixed[:, axis]], axis=0), rel=1e-9, abs=1e-12
            )
    assert made.guided == sheet.guided
    rim, edge = topology.boundary_edges(made.triangles), topology.boundary_edges(sheet.triangles)
    held, was_held = _constraint_lengths(made, rim), _constraint_lengths(sheet, edge)
    assert sorted(held) == sorted(was_held)
    for kind, length in was_held.items():
        assert held[kind] == pytest.approx(length, rel=1e-9 if name in FLAT else 0.01), kind


def _constraint_lengths(sheet: Sheet, edge: np.ndarray) -> dict[tuple[bool, ...], float]:
    """Length of the boundary that is held in each way [m]."""
    ways = np.concatenate([sheet.clamped[:, None], sheet.fixed], axis=1)[edge].all(1)
    length = np.linalg.norm(sheet.positions[edge[:, 1]] - sheet.positions[edge[:, 0]], axis=1)
    return {tuple(way.tolist()): float(length[(ways == way).all(1)].sum()) for way in np.unique(ways, axis=0)}


@pytest.mark.parametrize("name", ["quarter of a disc", "outline", "sphere", "preform"])
def test_elements_have_the_sizes_that_are_asked_for(name: str) -> None:
    sheet = SHEETS[name]
    wanted = _sizes(sheet)
    made = mesher.remesh(sheet, wanted, 3000)
    edge, _ = topology.edges(made.triangles)
    length = np.linalg.norm(made.positions[edge[:, 1]] - made.positions[edge[:, 0]], axis=1)
    from scipy.spatial import KDTree

    ratio = length / wanted[KDTree(sheet.positions).query(made.positions[edge].mean(1))[1]]
    ratio /= np.median(ratio)
    assert np.quantile(ratio, 0.05) > 0.55 and np.quantile(ratio, 0.95) < 1.6, np.quantile(ratio, [0.05, 0.95])
    angle = _angles(made)
    assert np.quantile(angle, 0.01) > 30.0 and angle.min() > 12.0


@pytest.mark.parametrize("name", ["quarter of a disc", "rectangle", "sphere", "tube"])
def test_lines_are_edges_of_the_new_mesh(name: str) -> None:
    sheet = SHEETS[name]
    lines = _lines_across(sheet)
    made = mesher.remesh(sheet, np.ones(len(sheet.positions)), 900, lines)
    assert 0.9 * 900 <= len(made.triangles) <= 900
    shapes.check_surface(Mesh(made.positions, made.triangles, {}, {}))
    edge, _ = topology.edges(made.triangles)
    side = np.median(np.linalg.norm(made.positions[edge[:, 1]] - made.positions[edge[:, 0]], axis=1))
    for line in lines:
        on_line = np.array([_distance(line, place) < 0.15 * side for place in made.positions])
        along = edge[on_line[edge].all(1)]
        covered = np.linalg.norm(made.positions[along[:, 1]] - made.positions[along[:, 0]], axis=1).sum()
        length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
        # All of it but for a last piece, beside the boundary or where both lines meet.
        assert covered > length - 1.5 * side, (covered / side, length / side)
    angle = _angles(made)
    assert np.quantile(angle, 0.01) > 20.0 and angle.min() > 8.0, (np.quantile(angle, 0.01), angle.min())


def test_lines_are_left_out_where_elements_between_their_nodes_are_low(monkeypatch: pytest.MonkeyPatch) -> None:
    # The lowest element at lines across this sheet has a fifth of the usual height.
    monkeypatch.setattr(mesher, "_LOW", 0.35)
    sheet = SHEETS["sphere"]
    lowest = []
    for keep in (True, False):
        made = mesher.remesh(sheet, np.ones(len(sheet.positions)), 900, _lines_across(sheet), keep_lines=keep)
        corners = made.positions[made.triangles]
        height = 2.0 * areas(made.positions, made.triangles) / longest_sides(corners)
        lowest.append(height.min() / np.median(height))
    assert lowest[1] > 0.35 > lowest[0]


def _lines_across(sheet: Sheet) -> list[np.ndarray]:
    """A closed line near the middle of a sheet, through many of its triangles, and one that begins on it."""
    low, high = sheet.positions.min(0), sheet.positions.max(0)
    middle, radius = sheet.positions[sheet.triangles[len(sheet.triangles) // 3]].mean(0), 0.2 * (high - low).min()
    radius = radius if radius > 0.0 else 0.2 * (high - low)[:2].min()
    turns = np.linspace(0.0, 2.0 * np.pi, 120)
    normal = np.cross(*(np.diff(sheet.positions[sheet.triangles[len(sheet.triangles) // 3]], axis=0)))
    first = np.cross(normal, [0.3, 0.5, 0.8])
    second = np.cross(normal, first)
    first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)
    ring = middle + radius * (np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second)
    bar = middle + np.linspace(1.0, 2.2, 40)[:, None] * radius * first
    distances = Distances(sheet.positions, sheet.triangles, 10.0)
    return [distances.nearest(line).place for line in (ring, bar)]


def _distance(line: np.ndarray, place: np.ndarray) -> float:
    """Distance of a place from a line (k, 3) [m]."""
    return float(segment_distance(np.repeat(place[None], len(line) - 1, axis=0), line[:-1], line[1:] + 1e-12).min())


def _angles(sheet: Sheet) -> np.ndarray:
    corners = sheet.positions[sheet.triangles]
    ways: Any = [np.roll(corners, -k, axis=1) - corners for k in (1, 2)]
    cosine = np.sum(ways[0] * ways[1], axis=2) / np.prod(np.linalg.norm(ways, axis=3), axis=0)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_a_round_rim_and_a_surface_of_revolution_stay_so() -> None:
    disc = mesher.remesh(SHEETS["quarter of a disc"], _sizes(SHEETS["quarter of a disc"]), 900)
    np.testing.assert_allclose(np.hypot(*disc.positions[disc.clamped, :2].T), 1.0, rtol=1e-14)
    tube = mesher.remesh(SHEETS["tube"], _sizes(SHEETS["tube"]), 900)
    np.testing.assert_allclose(np.hypot(*tube.positions[:, :2].T), 1.0, rtol=1e-12)
    assert set(tube.positions[tube.fixed[:, 2], 2]) == {0.0} and set(tube.positions[tube.clamped, 2]) == {3.0}


def test_fields_of_the_sheet_are_carried_over() -> None:
    sheet = SHEETS["quarter of a disc"]
    plane = 1.0 + sheet.positions[:, :2] @ [0.3, -0.2]
    field = Sheet(sheet.positions, sheet.triangles, sheet.clamped, sheet.fixed, {"wall": plane}, sheet.snap)
    made = mesher.remesh(field, _sizes(sheet), 900)
    # New nodes of the rim lie on the circle, outside the old chords.
    np.testing.assert_allclose(made.fields["wall"], 1.0 + made.positions[:, :2] @ [0.3, -0.2], atol=2e-3)


def test_nodes_that_are_clamped_inside_stay_where_they_are() -> None:
    sheet = SHEETS["rectangle"]
    held = np.array(sheet.clamped)
    middle = np.flatnonzero(np.linalg.norm(sheet.positions - [1.0, 0.5, 0.0], axis=1) < 0.2)
    held[middle] = True
    made = mesher.remesh(Sheet(sheet.positions, sheet.triangles, held, sheet.fixed), _sizes(sheet), 1500)
    inside = np.setdiff1d(np.flatnonzero(made.clamped), topology.boundary_nodes(made.triangles))
    there = {tuple(p) for p in made.positions[inside]}
    assert {tuple(p) for p in sheet.positions[middle]} <= there


def test_too_few_elements_are_refused() -> None:
    corners = [[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 41)[:-1]]
    points = [[x * (1.0 + 0.3 * (k % 2)), y * (1.0 + 0.3 * (k % 2))] for k, (x, y) in enumerate(corners)]
    star = shapes.outline(polygon=points, elements=600)
    with pytest.raises(InputError, match=r"too few elements for this sheet: its boundary needs .* allow more"):
        mesher.remesh(star, np.ones(len(star.positions)), 20)


def test_sides_are_divided_as_far_as_there_may_be_so_many_elements_and_none_are_low() -> None:
    sheet = shapes.rectangle(size=[0.4, 0.4], elements=100, symmetry="quarter")
    ends, count = topology.edges(sheet.triangles)
    rim, middle = sheet.clamped[ends].all(1), sheet.positions[ends].mean(1)
    # A side in a plane of symmetry, a clamped one, and two inside.
    plane = np.flatnonzero((count == 1) & ~rim)[0]
    inside = [int(np.linalg.norm(middle - place, axis=1).argmin()) for place in ((0.1, 0.1, 0.0), (0.1, 0.03, 0.0))]
    chosen = ends[[plane, np.flatnonzero(rim)[0], *inside]]
    share = np.array([0.3, 0.5, 0.5, 0.7])
    whole = mesher.divide_sides(sheet, chosen, share, 10_000)
    assert len(whole.triangles) == len(sheet.triangles)  # a part would be lower than the lowest
    sheet = _with_a_low_triangle(sheet)
    made = mesher.divide_sides(sheet, chosen, share, 10_000)
    assert len(made.triangles) == len(sheet.triangles) + 1 + 2 + 2
    new = made.positions[len(sheet.positions) :]
    one, other = sheet.positions[chosen[[0, 2, 3]]].transpose(1, 0, 2)
    np.testing.assert_allclose(new, one + share[[0, 2, 3], None] * (other - one))
    assert made.fixed[len(sheet.positions) :].any(1).tolist() == [True, False, False]
    assert not made.clamped[len(sheet.positions) :].any()
    total = areas(made.positions, made.triangles).sum()
    np.testing.assert_allclose(total, areas(sheet.positions, sheet.triangles).sum())
    few = mesher.divide_sides(sheet, chosen, share, len(sheet.triangles) + 3)
    assert len(few.triangles) == len(sheet.triangles) + 1 + 2


def _with_a_low_triangle(sheet: Sheet) -> Sheet:
    """The sheet with the inner node farthest from both planes of symmetry close to an opposite side."""
    free = np.flatnonzero(~sheet.clamped)
    node = free[sheet.positions[free].sum(1).argmax()]
    triangle = sheet.triangles[(sheet.triangles == node).any(1)][0]
    one, other = sheet.positions[triangle[triangle != node]]
    positions = sheet.positions.copy()
    positions[node] += 0.9 * (0.5 * (one + other) - positions[node])
    return replace(sheet, positions=positions)


def test_a_number_of_elements_between_two_sizes_at_which_it_jumps_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    sheet = shapes.disc(radius=1.0, elements=300, symmetry="quarter")

    def jump(sheet: Sheet, size: np.ndarray) -> Sheet:
        count = 352 if size[0] < 1.0 else 290 if size[0] < 1.02 else 242
        return replace(sheet, triangles=np.zeros((count, 3), np.int32))

    monkeypatch.setattr(mesher, "_remesh_once", jump)
    for start in (0.95, 1.0, 1.1):
        assert len(mesher._search_count(sheet, np.full(len(sheet.positions), start), 300, ()).triangles) == 290
