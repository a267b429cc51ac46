"""The geometry under the pictures, and that pictures show something for every kind of sheet."""

from __future__ import annotations

import csv
import dataclasses
import resource
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image

import jaxform
from jaxform import shapes
from jaxform.core.errors import InputError
from jaxform.core.store import Store
from jaxform.io import canvas, files, geometry, plots, surfaces
from jaxform.mesh import raster, topology
from jaxform.results import sections
from jaxform.results.result import Result
from jaxform.runs import host
from jaxform.sheet import state
from tests import scenes


def _at_rest(sheet: shapes.Sheet, end_time: float = 1.0) -> tuple[jaxform.Scene, Result]:
    """A scene and its part before the first step: the geometry is known exactly."""
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.01]),
        solver=jaxform.make_solver(end_time=end_time),
    )
    return scene, scenes.at_rest(scene)


SHEETS = {
    "disc": shapes.disc(radius=1.0, elements=60, symmetry="quarter"),
    "rectangle": shapes.rectangle(size=(2.0, 1.0), elements=64),
    "half rectangle": shapes.rectangle(size=(2.0, 1.0), elements=64, symmetry="half"),
    "sphere": shapes.sphere(radius=1.0, elements=512),
    "half tube": shapes.tube(radius=0.2, length=2.0, elements=200, symmetry="half"),
}


def test_the_meridian_of_a_cone_is_its_slant() -> None:
    scene, result = _at_rest(SHEETS["disc"])
    start = np.asarray(scene.parison.positions)
    radius = np.hypot(start[:, 0], start[:, 1])
    cone = start + np.outer(2.0 * (1.0 - radius), [0.0, 0.0, 1.0])
    arc = sections.meridian_arc(scene, dataclasses.replace(result, positions=jnp.asarray(cone)))
    np.testing.assert_allclose(arc, np.sqrt(5.0) * radius, atol=1e-12)


def test_the_section_of_a_sphere_closes() -> None:
    scene, result = _at_rest(SHEETS["sphere"])
    pieces = sections.section(scene, result, 1, 0.123)
    assert len(pieces) == 1
    arc, wall = pieces[0]
    np.testing.assert_allclose(arc[-1], 2 * np.pi * np.sqrt(1 - 0.123**2), rtol=0.02)
    np.testing.assert_allclose(wall, 0.01, rtol=1e-9)


@pytest.mark.parametrize("name", ["rectangle", "half rectangle"])
def test_the_sections_of_a_rectangle_have_its_sides_lengths(name: str) -> None:
    scene, result = _at_rest(SHEETS[name])
    along_x, along_y = sections.curves(scene, result)
    np.testing.assert_allclose(along_x.arc[-1], 1.0 if name.startswith("half") else 2.0, rtol=1e-6)
    np.testing.assert_allclose(along_y.arc[-1], 1.0, rtol=1e-6)


def test_the_first_section_of_a_tube_runs_along_it() -> None:
    scene, result = _at_rest(SHEETS["half tube"])
    thin = np.asarray(scene.parison.positions)[np.asarray(scene.parison.triangles)[7]].mean(0)
    along, around = sections.curves(scene, result, through=thin)
    np.testing.assert_allclose(along.arc[-1], 2.0, rtol=1e-3)
    np.testing.assert_allclose(around.arc[-1], 0.2 * np.pi, rtol=0.05)


def test_images_make_the_part_whole() -> None:
    scene, _ = _at_rest(SHEETS["disc"])
    corners = np.asarray(scene.parison.positions)[np.asarray(scene.parison.triangles)]
    whole = np.concatenate(surfaces.mirror_points(scene, corners))
    edges = np.cross(whole[:, 1] - whole[:, 0], whole[:, 2] - whole[:, 0])
    area = 0.5 * np.linalg.norm(edges, axis=1).sum()
    assert len(whole) == 4 * len(corners)
    np.testing.assert_allclose(area, np.pi, rtol=0.02)
    np.testing.assert_allclose(whole.reshape(-1, 3).mean(0), 0.0, atol=1e-12)


def test_feature_edges_of_a_box_are_its_edges() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ]
    edges = topology.feature_edges(corners, np.array(faces, np.int32))
    assert len(edges) == 12
    np.testing.assert_allclose(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1), 1.0)


def test_the_image_in_front_of_the_eye_is_left_out() -> None:
    """The same for a disc about the origin and a rectangle that begins there."""
    for name, middle in (("disc", [0.0, 0.0]), ("quarter rectangle", [1.0, 0.5])):
        sheet = SHEETS.get(name) or shapes.rectangle(size=(2.0, 1.0), elements=64, symmetry="quarter")
        scene, _ = _at_rest(sheet)
        images = surfaces.mirror_points(scene, np.asarray(scene.parison.positions), open_front=True)
        centers = np.array([image[:, :2].mean(0) for image in images]) - middle
        assert len(images) == 3 and not np.any((centers[:, 0] > 0) & (centers[:, 1] < 0))


def test_sections_run_through_a_place_and_tell_where_it_is() -> None:
    scene, result = _at_rest(SHEETS["rectangle"])
    along_x, along_y = sections.curves(scene, result, through=[0.7, 0.3, 0.0])
    assert along_x.marked is not None and along_y.marked is not None
    # Within an element of the place.
    assert min(abs(along_x.marked - 0.7), abs(along_x.marked - 1.3)) < 0.2
    assert min(abs(along_y.marked - 0.3), abs(along_y.marked - 0.7)) < 0.2
    assert "y = 300" in along_x.label and "x = 700" in along_y.label
    disc, at_rest = _at_rest(SHEETS["disc"])
    (meridian,) = sections.curves(disc, at_rest, through=[0.3, 0.4, 0.0])
    assert meridian.marked is not None
    np.testing.assert_allclose(meridian.marked, 0.5, rtol=1e-9)


def test_a_plane_cuts_a_closed_surface_along_its_girth() -> None:
    ball = shapes.sphere(radius=1.0, elements=2000)
    lines = sections.cut_triangles(ball.positions[ball.triangles], 2, 0.6)
    np.testing.assert_allclose(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum(), 2 * np.pi * 0.8, rtol=5e-3)
    np.testing.assert_allclose(lines[..., 2], 0.6)


def test_colours_tell_the_formed_part_apart_not_its_flange() -> None:
    """A cup in a flat flange of 10 mm: its wall runs from 3 to 5 mm."""
    sheet = shapes.disc(radius=1.0, elements=600)
    scene, result = _at_rest(sheet)
    start, triangles = np.asarray(scene.parison.positions), np.asarray(scene.parison.triangles)
    radius = np.hypot(start[:, 0], start[:, 1])
    formed = start + np.outer(np.square(np.clip(0.5 - radius, 0.0, None)), [0.0, 0.0, 1.0])
    middle = radius[triangles].mean(1)
    wall = np.where(middle < 0.45, 3e-3 + 4e-3 * middle, 1e-2)
    result = dataclasses.replace(result, positions=jnp.asarray(formed), element_thickness=jnp.asarray(wall))
    low, high = plots.wall_scale([(scene, result)])
    np.testing.assert_allclose(low, 1e3 * wall.min())
    assert high < 5.0


def test_triangles_cover_the_pixels_whose_middles_they_hold() -> None:
    square = np.array([[[2.0, 3.0], [6.0, 3.0], [6.0, 5.0]], [[2.0, 3.0], [6.0, 5.0], [2.0, 5.0]]])
    depth = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    seen = raster.nearest_in_pixels(square, depth, 10, 8).reshape(8, 10) >= 0
    wanted = np.zeros((8, 10), bool)
    wanted[3:5, 2:6] = True
    np.testing.assert_array_equal(seen, wanted)
    # One that slopes through another is seen where it is nearer; what is outside, behind or broken is not.
    sloping = np.array([[[-20.0, -20.0], [40.0, -20.0], [-20.0, 40.0]]])
    broken = np.full((1, 3, 2), np.nan)
    corners = np.concatenate([square, sloping, broken])
    away = np.concatenate([depth, [[-5.5, 6.5, -5.5]], [[0.0, 0.0, 0.0]]])
    view = raster.nearest_in_pixels(corners, away, 10, 8).reshape(8, 10)
    # Along x it comes from -5.5 to 6.5 in 60 pixels, and is at 1 at 12.5: nearer than the square everywhere.
    assert np.all(view == 2)
    behind = raster.nearest_in_pixels(corners, np.concatenate([depth, [[0.0, 12.0, 0.0]], [[0.0] * 3]]), 10, 8)
    # From 0 to 12 in 60 pixels: at 1 where x = -15, so the square is in front.
    assert np.all(behind.reshape(8, 10)[wanted] < 2) and np.all(behind.reshape(8, 10)[~wanted] == 2)


@pytest.mark.parametrize("name", ["disc", "rectangle"])
def test_of_a_part_the_diagram_draws_what_is_in_it_and_the_rest_faintly(name: str) -> None:
    """A sheet that is folded up beyond a plane, where its wall is half as thick; the part is what lies below."""
    scene, result = _at_rest(SHEETS[name])
    start = np.asarray(scene.parison.positions, float)
    along = np.hypot(start[:, 0], start[:, 1]) if name == "disc" else np.abs(start[:, 0] - 1.0)
    up = np.clip(along - 0.5, 0.0, None)
    formed = start + np.outer(up, [0.0, 0.0, 1.0])
    wall = np.where(up > 0.0, 5e-3, 1e-2)
    changes = {"positions": jnp.asarray(formed), "thickness": jnp.asarray(wall)}
    result = dataclasses.replace(result, **changes)
    picture = plots.part_picture(dataclasses.replace(scene, part=jaxform.make_part(trim=("z", 1e-9, "below"))), result)
    (across, faint, faint_style), (drawn_across, drawn, drawn_style) = picture.lines[:2]
    assert faint_style["label"] == "cut off the part" and faint_style["color"] != drawn_style["color"]
    shown = np.isfinite(drawn)
    np.testing.assert_array_equal(across, drawn_across)
    # Nodes of the part's elements lie at most an element beyond the plane.
    np.testing.assert_array_equal(drawn[shown], faint[shown])
    middle = np.median(across) if name == "rectangle" else 0.0
    reach = np.abs(across - middle)
    assert shown[reach < 400].all() and not shown[reach > 800].any() and 0.2 < shown.mean() < 0.9
    whole = plots.part_picture(scene, result).lines
    assert np.isfinite(whole[0][1]).all() and all(style["label"] != "cut off the part" for _, _, style in whole)


def test_covers_of_holes_hardly_show_before_a_run(tmp_path: Path) -> None:
    """A mold that is a box without a floor, which a cover closes: beneath it a sheet and the box are seen."""
    box = trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [1.0, 1.0, 0.4]])
    open_box = trimesh.Trimesh(box.vertices, box.faces[np.abs(box.face_normals[:, 2]) < 0.5])
    cover = trimesh.Trimesh(
        [[0.0, 0.0, 0.4], [1.0, 0.0, 0.4], [1.0, 1.0, 0.4], [0.0, 1.0, 0.4]], [[0, 1, 2], [0, 2, 3]]
    )
    open_box.export(tmp_path / "box.stl")
    cover.export(tmp_path / "covers.stl")
    (tmp_path / "scene.toml").write_text(
        """[parison]
shape = "rectangle"
size = [1.0, 1.0]
elements = 30
thickness = 0.01
[material]
model = "neo-hookean"
c = 1e5
density = 1000.0
[pressure]
time = [0.0, 1.0]
value = [0.0, 100.0]
[mold]
shape = "file"
path = ["box.stl", "covers.stl"]
[solver]
end_time = 1.0
"""
    )
    document = files.read_scene(str(tmp_path / "scene.toml"))
    scene = files.build(document, Store())
    covers = geometry.cover_triangles(document, scene.mold)
    assert scene.mold is not None and len(covers) == 10
    heights = np.asarray(scene.mold.vertices)[np.asarray(scene.mold.triangles)][..., 2].min(1)
    np.testing.assert_array_equal(covers, heights > 0.39)
    walls, closing, sheet = surfaces.sheet_view(scene, covers).surfaces
    assert closing.opaque < 0.5 * walls.opaque and sheet.opaque < 0.6
    np.testing.assert_allclose(closing.faces[..., 2], 400.0, rtol=1e-6)
    assert len(walls.faces) == 8


def _colors(path: Path) -> int:
    with Image.open(path) as picture:
        return len(picture.convert("RGB").getcolors(1 << 24) or [])


@pytest.mark.parametrize("name", SHEETS)
def test_every_sheet_has_a_picture(name: str, tmp_path: Path) -> None:
    scene, result = _at_rest(SHEETS[name])
    stopped = dataclasses.replace(result, status=jnp.int32(state.Status.UNSTABLE))
    plots.thickness_picture(tmp_path / "thickness.png", scene, stopped)
    assert _colors(tmp_path / "thickness.png") > 50


def test_a_picture_for_which_there_is_no_room_is_named_and_not_left_in_part(tmp_path: Path) -> None:
    path, limits = tmp_path / "thickness.png", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_text("what was there")
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(InputError, match=r"thickness.png.*cannot be written.*limit on the size of files"):
            plots.thickness_picture(path, *_at_rest(SHEETS["disc"]))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["what was there"]


def test_pictures_of_a_search(tmp_path: Path) -> None:
    scene, result = _at_rest(SHEETS["disc"])
    other = jaxform.replace(scene, {"parison.thickness": 0.02, "pressure.value": 0.02})
    plots.design_picture(tmp_path / "design.png", (scene, result), (other, scenes.at_rest(other)), 0.015)
    assert _colors(tmp_path / "design.png") > 50
    names = ("simulations", "thickness_rms_error", "wall_min", "wall_mean", "wall_cv")
    text = [",".join(names), "3,0.5,0.1,0.2,0.4", "6,inf,,0.2,0.4", "9,0.1,0.15,0.2,0.1"]
    plots.convergence_picture(tmp_path / "convergence.png", list(csv.DictReader(text)))
    assert _colors(tmp_path / "convergence.png") > 20


def test_a_design_of_a_gas_has_the_pressures_that_its_runs_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, result = _at_rest(SHEETS["disc"])
    scene = dataclasses.replace(scene, pressure=jaxform.make_gas([0.0, 1.0], [0.0, 1e-3], dead_volume=1.0))
    drawn: list[np.ndarray] = []

    def draw(_: object, time: np.ndarray, *pair: dict[str, np.ndarray]) -> None:
        drawn.append(np.stack([time, *(values for part in pair for values in part.values())]))

    monkeypatch.setattr(plots, "_draw_pressures", draw)
    first, last = (
        dataclasses.replace(result, pressures=np.array([[0.0, 0.5], [0.0, end]]), status=jnp.int32(0))
        for end in (1.0, 3.0)
    )
    plots.design_picture(tmp_path / "design.png", (scene, first), (scene, last))
    time, before, after = drawn[0]
    np.testing.assert_allclose([before, after], [np.minimum(2 * time, 1.0), 3 * np.minimum(2 * time, 1.0)])
    plots.design_picture(tmp_path / "none.png", (scene, result), (scene, result))
    assert len(drawn) == 1 and (tmp_path / "none.png").exists()


def test_a_design_on_a_mesh_that_is_refined_otherwise_is_drawn(tmp_path: Path) -> None:
    scene = scenes.refinable(shapes.disc(radius=1.0, elements=12, symmetry="quarter"), 60)
    begun, first = scenes.begin_run(scene)
    finer = scenes.bisect_scene(scene, begun, first, jnp.arange(60) < 4)[0]
    before, after = ((scene, host.result_of(state, scene, first)) for state in (begun, finer))
    assert int(after[1].used.sum()) > int(before[1].used.sum())
    plots.design_picture(tmp_path / "design.png", before, after)
    plots.stages_picture(tmp_path / "stages.png", scene, [before[1], after[1]])
    assert _colors(tmp_path / "design.png") > 50 and _colors(tmp_path / "stages.png") > 50


def _over_a_plate(direction: float, pressure: float, rise: float, depth: float = 0.1) -> tuple[jaxform.Scene, Result]:
    """A square sheet whose middle rose, over a plate that moves along z, or rests, under a pressure."""
    sheet = shapes.rectangle(size=(1.0, 1.0), elements=64)
    corners = np.array([[x, y, 0.4 if direction <= 0 else -0.4] for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], float)
    moves = None if direction == 0 else jaxform.make_motion([0.0, 0.0, direction], [0.0, 0.5], [0.0, depth])
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [pressure]),
        solver=jaxform.make_solver(end_time=1.0),
        mold=jaxform.make_mold(corners, np.array([[0, 1, 2], [0, 2, 3]]), motion=moves),
    )
    positions = np.array(scene.parison.positions, float)
    positions[:, 2] = rise * np.clip(2.0 - 4.0 * np.abs(positions[:, :2] - 0.5).max(1), 0.0, 1.0)
    return scene, dataclasses.replace(scenes.at_rest(scene), positions=jnp.asarray(positions))


def test_a_design_of_a_way_alone_shows_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, result = _over_a_plate(1.0, 0.0, 0.3)
    other = jaxform.replace(scene, {"mold.motion.displacement": [0.0, 0.2]})
    seen: list[tuple[str, str, list[tuple[str, float]]]] = []

    def look(figure: Any, *_: object) -> None:
        for axes in figure.axes:
            lines = [(line.get_label(), float(line.get_ydata()[-1])) for line in axes.get_lines()]
            seen.append((axes.get_xlabel(), axes.get_ylabel(), lines))

    monkeypatch.setattr(canvas, "save", look)
    plots.design_picture(tmp_path / "design.png", (scene, result), (other, result))
    drawn = {(x, y): lines for x, y, lines in seen}
    assert drawn["time [s]", "displacement [mm]"] == [
        ("mold before", pytest.approx(100.0)),
        ("mold after", pytest.approx(200.0)),
    ]
    assert not any(y == "initial thickness [mm]" for _, y in drawn)


@pytest.mark.parametrize(
    ("direction", "pressure", "rise", "down"),
    [
        (-1.0, 1.0, -0.3, True),  # a buck that moves to -z through a sheet which is pushed to +z: its head is up
        (1.0, -1.0, 0.3, False),  # the same the other way round
        (1.0, 0.0, 0.3, False),  # a plug alone
        (-1.0, 0.0, -0.3, True),
        (0.0, 1.0, 0.3, True),  # a cavity: one looks into it
        (0.0, -1.0, -0.3, False),
    ],
)
def test_bucks_and_cavities_are_seen_from_where_the_sheet_was(
    direction: float, pressure: float, rise: float, down: bool
) -> None:
    view = plots.part_picture(*_over_a_plate(direction, pressure, rise)).view
    # With z down and no symmetry, y is reversed too: no mirror image is shown.
    assert view.hangs == down and view.turned


@pytest.mark.parametrize("rise", [0.3, 3.0, 8.0])
def test_labels_of_tall_parts_are_in_the_picture(rise: float) -> None:
    view = plots.part_picture(*_over_a_plate(0.0, 1.0, rise)).view
    figure = canvas.new_figure(16, 7, "")
    axes = figure.add_axes((0.0, 0.04, 0.47, 0.84), projection="3d")
    canvas.draw(axes, view)
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        extent = axis.get_tightbbox(renderer)
        assert extent.y0 >= 0.0 and extent.y1 <= figure.bbox.y1 and 0.0 <= extent.x0 < extent.x1 <= 0.475 * 1600
    # The drawing is not lost by it.
    assert all(artist.get_visible() for artist in axes.artists)


def test_the_colour_bar_and_the_diagram_have_room_for_their_labels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Labels of both lay over one another where numbers of the diagram have three decimals."""
    drawn: list[Any] = []
    monkeypatch.setattr(canvas, "save", lambda figure, _: drawn.append(figure))
    part = plots.part_picture(*_over_a_plate(0.0, 1.0, 0.3))
    line = (np.linspace(0.0, 130.0, 9), np.linspace(0.0, 0.2, 9), {"label": "all nodes"})
    canvas.draw_part(tmp_path / "part.png", part._replace(lines=[line]))
    drawn[0].draw_without_rendering()
    left, middle, right = (axes.get_tightbbox() for axes in drawn[0].axes)
    assert left.x1 < middle.x0 and middle.x1 + 10.0 < right.x0 and right.x1 < drawn[0].bbox.x1


@pytest.mark.parametrize("symmetry", ["none", "half", "quarter"])
@pytest.mark.parametrize("cap", [False, True])
def test_a_tube_or_preform_is_unrolled_for_a_map(symmetry: Any, cap: bool) -> None:
    """Seen from the side, its front would hide its back."""
    wall = [[0.2, 0.0], [0.2, 1.0]]
    profile = [*wall, *([[0.14, 1.14], [0.0, 1.2]] if cap else [])]
    sheet = (
        shapes.preform(profile=profile, elements=600, symmetry=symmetry)
        if cap
        else shapes.tube(radius=0.2, length=1.0, elements=600, symmetry=symmetry)
    )
    scene, _ = _at_rest(sheet)
    start = np.asarray(scene.parison.positions)
    places, node, triangles, labels = surfaces.map_sheet(scene)
    assert labels == ["z [mm]", "angle about z [degrees]"]
    np.testing.assert_allclose(places[:, 0], 1e3 * start[node, 2], rtol=1e-12)
    around = np.hypot(*start[node, :2].T) > 0.01
    turned = np.degrees(np.arctan2(*start[node, 1::-1].T)) - places[:, 1]
    np.testing.assert_allclose(np.round(turned / 360.0)[around] * 360.0, turned[around], atol=1e-9)
    # Each element once, or, across 180 degrees, at both ends: they fill the angle of the sheet along all of its wall.
    areas = surfaces._signed_areas(places, triangles)
    once = np.unique(np.sort(node[triangles], axis=1), axis=0, return_index=True)[1]
    full = 360.0 / {"none": 1, "half": 2, "quarter": 4}[symmetry] * 1e3 * np.ptp(start[:, 2])
    assert len(once) == len(scene.parison.triangles)
    assert 0.5 * np.abs(areas[once]).sum() == pytest.approx(full, rel=0.04 if cap else 1e-9)
    assert not surfaces._overlaps(areas) and (len(once) < len(triangles)) == (symmetry == "none")
    design = jaxform.replace(scene, {"parison.thickness": scene.parison.thickness * (1.3 + jnp.sin(5.0 * start[:, 0]))})
    assert plots._designed_field(scene, design) == ("parison.thickness", "initial thickness [mm]")
    ax = jaxform.plot.sheet(design, ax=canvas.new_figure(8, 5, "").add_axes((0.1, 0.1, 0.6, 0.8)), bar=False)
    (drawn,) = ax.collections
    np.testing.assert_allclose(drawn.get_array(), 1e3 * np.asarray(design.parison.thickness)[node], rtol=1e-12)


@pytest.mark.parametrize("shape", ["disc", "rectangle"])
def test_a_designed_field_of_thickness_is_a_map_and_a_profile_a_line(shape: str) -> None:
    """Over the place along the sheet the values of a field are a cloud, in which nothing is seen of it."""
    sheets = {
        "disc": shapes.disc(radius=1.0, elements=400),
        "rectangle": shapes.rectangle(size=[2.0, 1.0], elements=400),
    }
    scene, _ = _at_rest(sheets[shape])
    x, y = np.asarray(scene.parison.positions)[:, :2].T
    along = np.hypot(x, y) if shape == "disc" else x
    found = {}
    for name, field in (("field", np.exp(-4 * ((x - 0.5) ** 2 + y**2))), ("profile", np.maximum(along, 0.5))):
        design = jaxform.replace(scene, {"parison.thickness": scene.parison.thickness * (1 + jnp.asarray(field))})
        found[name] = plots._designed_field(scene, design)
        figure = canvas.new_figure(8, 5, "")
        plots._draw_field(figure, figure.add_axes((0.1, 0.1, 0.6, 0.8)), design, "parison.thickness", "thickness")
        (drawn,) = figure.axes[0].collections
        np.testing.assert_allclose(drawn.get_array(), 1e3 * np.asarray(design.parison.thickness), rtol=1e-12)
    assert found == {"field": ("parison.thickness", "initial thickness [mm]"), "profile": None}
