"""`jaxform new` of male molds: its folder is a scene that drapes, and the part that comes out lies on the mold."""

from __future__ import annotations

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxform
from jaxform.cli import command
from jaxform.io import files, plausibility, scene_wizard
from jaxform.io.scene_choices import VACUUM
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh
from jaxform.results.summary import summarize
from tests import scenes
from tests.tools.test_bucks import BUCKS, dome, drafted_block


def write(path: Path, mold: Mesh, unit: float = 0.001) -> Path:
    """An STL file in a unit [m]."""
    meshes.write_stl(path, mold.positions / unit, mold.triangles)
    return path


def coarse(folder: Path, elements: int) -> jaxform.Scene:
    """The scene of a folder with about so many elements."""
    path = folder / "scene.toml"
    text, count = re.subn("element_size = .*", f"elements = {elements}", path.read_text())
    assert count == 1
    path.write_text(text)
    return files.load(path)


@pytest.mark.parametrize("name", scenes.short_first((name for name in BUCKS if name != "open below"), 3))
def test_bucks_get_a_frame_a_platen_and_a_way(tmp_path, capfd, name):
    mold = write(tmp_path / "part.stl", BUCKS[name])
    folder = tmp_path / "scene"
    assert command.main(["new", str(folder), "--mold", str(mold)]) == 0
    said = capfd.readouterr()
    assert said.err == "" and "taken as a male mold" in said.out and "draped over it" in said.out
    own = name == "cone on platen"
    assert (folder / "platen.stl").exists() != own
    data = files.read_scene(folder / "scene.toml").data
    scene = files.load(folder / "scene.toml")
    assert scene.mold is not None and scene.motion is not None
    walls = np.asarray(scene.mold.vertices)
    thickness = data["parison"]["thickness"]
    # It starts behind the sheet, and ends with its platen at the frame.
    top = 0.05 + (0.01 if name == "rough dome" else 0.0)
    assert 0 < walls[:, 2].min() < thickness
    end = walls[:, 2] + float(scene.motion.offset(jnp.asarray(1e3))[2])
    level = np.sort(end)[-1] if not own else 0.0
    assert 0 <= level < 0.2 * thickness and end.min() < -0.02 and top > 0
    # The pressure rises when the mold has arrived, and no more than a vacuum has.
    assert data["pressure"]["time"][1] == data["mold"]["motion"]["time"][1]
    assert 0 < data["pressure"]["value"][2] <= VACUUM
    # The part is what stands above the platen, where it ends.
    trim = data["part"]["trim"]
    assert trim["keep"] == "below" and trim["axis"] == "z" and -2 * thickness < trim["at"] < 0
    # The frame is around the mold, and the platen before all of the sheet.
    sheet = np.asarray(scene.parison.positions)
    assert walls[:, :2].min() <= sheet[:, :2].min() and walls[:, :2].max() >= sheet[:, :2].max()


@pytest.mark.long
@pytest.mark.parametrize(("name", "elements"), [("drafted", 700), ("dome", 500)])
def test_the_draped_sheet_lies_on_the_buck_down_to_the_platen(tmp_path, name, elements):
    mold = write(tmp_path / "part.stl", BUCKS[name])
    assert command.main(["new", str(tmp_path / "scene"), "--mold", str(mold), "--quiet"]) == 0
    scene = coarse(tmp_path / "scene", elements)
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    summary, wall = summarize(result, scene), np.asarray(result.thickness)
    nodes, clamped = np.asarray(result.positions), np.asarray(scene.parison.clamped)
    # The mold where it ends: its side wall and top are touched all over.
    assert scene.mold is not None and scene.motion is not None
    walls = np.asarray(scene.mold.vertices) + np.asarray(scene.motion.offset(jnp.asarray(1e3)))
    triangles = np.asarray(scene.mold.triangles)
    size = np.sqrt(4 / np.sqrt(3) * np.prod(np.ptp(np.asarray(scene.parison.positions)[:, :2], axis=0)) / elements)
    assert summary["contact_fraction"] > 0.97 and summary["gap_max"] < 1.5 * size
    solid = trimesh.Trimesh(walls, triangles, process=False)
    distance = trimesh.proximity.closest_point_naive(solid, nodes[~clamped])[1]
    np.testing.assert_allclose(distance, 0.0, atol=1e-6)
    # At every height of the wall there are nodes of the sheet.
    heights = np.linspace(walls[:, 2].min(), walls[:, 2].max(), 6)
    on_wall = nodes[(nodes[:, 2] < walls[:, 2].max() - 1e-4) & ~clamped]
    assert (np.histogram(on_wall[:, 2], heights)[0] >= 8).all()
    # The top keeps its thickness, since it is touched first; the wall is thinner.
    first = nodes[:, 2] < walls[:, 2].min() + 1e-6
    initial = np.asarray(scene.parison.thickness)[0]
    assert wall[first].max() > 0.95 * initial and wall[~clamped].min() < 0.8 * initial


def test_what_is_asked_for_counts(tmp_path, capfd):
    mold = write(tmp_path / "part.stl", BUCKS["drafted"])
    folder = tmp_path / "scene"
    assert command.main(["new", str(folder), "--mold", str(mold), "--direction=-z"]) == 0
    said = capfd.readouterr()
    assert "comes from -z" in said.out and "undercut by up to 17" in said.err and "--direction" in said.err
    # Both sides of an open bowl.
    bowl = write(tmp_path / "bowl.stl", dome())
    for given, words in ((["--drape"], "taken as a male mold"), (["--cavity"], "its opening was found")):
        assert command.main(["new", str(folder), "--mold", str(bowl), "--force", *given]) == 0
        assert words in capfd.readouterr().out
    cup = [[0.0, 0.0], [0.04, 0.0], [0.05, 0.05], [0.048, 0.05], [0.038, 0.002], [0.0, 0.002]]
    turned = jaxform.molds.revolved(profile=cup, segments=48)
    over = write(tmp_path / "cup.stl", Mesh(turned.vertices, turned.triangles))
    assert command.main(["new", str(folder), "--mold", str(over), "--force"]) == 0
    assert "its opening was found" in capfd.readouterr().out
    assert command.main(["new", str(folder), "--mold", str(over), "--force", "--drape"]) == 0
    assert "taken as a male mold" in capfd.readouterr().out


def test_a_vacuum_has_a_limit_and_says_what_it_fills(tmp_path, capfd):
    """T = 2 c h (1 + alpha stretch^2); corners are filled down to r = 2 T / p."""
    mold = write(tmp_path / "part.stl", BUCKS["cylinder"])
    vacuum, air = (
        scene_wizard.draft([mold], thickness=0.01),
        scene_wizard.draft([mold], thickness=0.01, process="pressure"),
    )
    assert vacuum.pressure == VACUUM and vacuum.is_limited
    assert air.pressure > 2 * VACUUM and not air.is_limited
    np.testing.assert_allclose(air.corner(air.pressure) / vacuum.corner(VACUUM), VACUUM / air.pressure)
    np.testing.assert_allclose(air.corner(air.pressure), 1.3 * air.element_size, rtol=0.05)
    folder = tmp_path / "scene"
    given = ["new", str(folder), "--mold", str(mold), "--thickness", "0.01"]
    assert command.main(given) == 0
    radius = 1e3 * vacuum.corner(VACUUM)
    words = f"a vacuum of 0.9 bar fills corners down to a radius of about {radius:.2g} mm"
    assert words in capfd.readouterr().out
    assert words.capitalize() in (folder / "scene.toml").read_text()
    assert command.main([*given, "--force", "--process", "pressure"]) == 0
    assert "a vacuum of" not in capfd.readouterr().out
    assert files.read_scene(folder / "scene.toml").data["pressure"]["value"][-1] == air.pressure


def test_refusals_say_what_to_give_next(tmp_path, capfd):
    """Each remedy works."""
    turned = jaxform.molds.revolved(profile=[[0.0, 0.0], [0.04, 0.0]], segments=24)
    plate = write(tmp_path / "plate.stl", Mesh(turned.vertices, turned.triangles))
    assert command.main(["new", str(tmp_path / "scene"), "--mold", str(plate)]) == 2
    assert "--drape" in capfd.readouterr().err
    buck = write(tmp_path / "buck.stl", BUCKS["drafted"])
    assert command.main(["new", str(tmp_path / "scene"), "--mold", str(buck), "--cavity"]) == 2
    assert "--drape" in capfd.readouterr().err
    assert command.main(["new", str(tmp_path / "scene"), "--mold", str(buck), "--drape"]) == 0
    assert command.main(["new", str(tmp_path / "other"), "--mold", str(buck), "--direction", "up"]) == 2
    assert "--direction = 'up'" in capfd.readouterr().err


def test_a_scan_with_holes_and_a_rough_rim_is_closed(tmp_path, capfd):
    scan = dome(rough=0.004)
    high = np.argsort(-scan.positions[scan.triangles][..., 2].mean(1))
    mold = write(tmp_path / "face.stl", Mesh(scan.positions, np.delete(scan.triangles, high[30:34], axis=0)))
    folder = tmp_path / "scene"
    assert command.main(["new", str(folder), "--mold", str(mold)]) == 0
    assert "platen.stl closes 1 hole too" in capfd.readouterr().out
    assert "closes 1 hole" in (folder / "scene.toml").read_text()


@pytest.mark.parametrize(
    ("box", "name", "others"),
    [
        ((12.0, 8.0, 5.0), "centimetres", ("0.001", "0.0254")),
        ((4.72, 3.15, 1.97), "inches", ("0.01 ", "0.001")),
        ((120.0, 80.0, 50.0), "millimetres", ()),
        ((30.0, 20.0, 10.0), "millimetres", ("0.01 ",)),
        ((0.12, 0.08, 0.05), "metres", ()),
    ],
)
def test_units(box, name, others):
    _, found, told = plausibility.guess_units(np.array(box))
    assert found == name and all(f"--scale {other}" in told + " " for other in others)


@pytest.mark.long
def test_the_docs_example_of_a_motion_drapes(tmp_path):
    """With the keys of the page the sheet lies on a block 50 mm high on a platen, both on z = 0 of their files."""
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "mold.md").read_text()
    keys = next(text.split("```")[0] for text in page.split("```toml\n")[1:] if "[mold.motion]" in text)
    block = drafted_block().apply_scale([0.4, 0.6, 1.25])
    plate = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    write(tmp_path / "block.stl", Mesh(np.array(block.vertices), np.array(block.faces)))
    write(tmp_path / "platen.stl", Mesh(plate, np.array([[0, 1, 2], [0, 2, 3]])))
    (tmp_path / "scene.toml").write_text(
        'parison = { shape = "disc", radius = 0.08, elements = 300, thickness = 1e-3 }\n'
        'material = { model = "mooney-rivlin", c = 2e4, alpha = 0.1, density = 1000.0 }\n'
        f"solver = {{ end_time = 0.8, damping = 100.0 }}\n{keys}"
    )
    scene = files.load(tmp_path / "scene.toml")
    result = jaxform.run(scene)
    nodes = np.asarray(result.positions)
    assert jaxform.explain(result) == "ok" and nodes[:, 2].min() < -0.0495
    assert summarize(result, scene)["contact_fraction"] > 0.95


def test_a_body_much_higher_than_wide_is_said_to_fold(tmp_path, capfd):
    for height, told in ((300.0, True), (100.0, False)):
        path = tmp_path / f"{height:g}.stl"
        trimesh.creation.box((60.0, 60.0, height)).export(path)
        folder = str(tmp_path / f"{height:g}")
        # Laid down, it is a flat body again.
        for flags, expected in (([], told), (["--direction=+x"], False)):
            arguments = ["new", folder, "--mold", str(path), "--drape", "--direction=+z", "--force", *flags]
            assert command.main(arguments) == 0
            said = capfd.readouterr().err
            assert ("times as high as it is wide" in said and "--direction" in said) == expected
