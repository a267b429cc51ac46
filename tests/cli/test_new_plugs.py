"""`jaxform new --plug`: plugs made from the cavity, and users' plugs, start before the sheet and end in the cavity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from jaxform.cli import command
from jaxform.io import files, plausibility
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.model.scene import Scene
from jaxform.tools import molds
from jaxform.tools.distances import Distances

TURNED = molds.rotation(np.array([180.0, 0.0, 0.0]))
AWAY = np.array([0.3, 0.2, 0.1])


def _cup() -> Mesh:
    """A cup that is 0.05 deep and 0.13 wide at its opening, with a flange."""
    profile = [[0.0, 0.05], [0.05, 0.05], [0.056, 0.045], [0.065, 0.0], [0.08, 0.0]]
    shape = molds.revolved(profile=profile, segments=60)
    return Mesh(shape.vertices, shape.triangles, {})


def _tray() -> Mesh:
    """A tray with a raised block in its bottom, 0.2 x 0.12 x 0.05."""
    shape = molds.box_insert(
        size=(0.2, 0.12), depth=0.05, insert_size=(0.06, 0.03), insert_height=0.015, draft=8, divisions=8
    )
    return Mesh(shape.vertices, shape.triangles, {})


def _write(path: Path, mesh: Mesh) -> Path:
    """An STL file in millimetres, upside down and away from the origin."""
    meshes.write_stl(path, 1e3 * (mesh.positions @ TURNED.T + AWAY), mesh.triangles)
    return path


def _new(folder: Path, mold: Path, plug: Path | str) -> Scene:
    assert command.main(["new", str(folder), "--mold", str(mold), "--plug", str(plug), "--quiet"]) == 0
    return files.load(folder / "scene.toml")


@pytest.mark.parametrize(("depth", "named"), [(0.05, False), (0.12, True)])
def test_a_deep_draw_without_a_plug_names_the_plug(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], depth: float, named: bool
) -> None:
    shape = molds.revolved(profile=[[0.0, depth], [0.05, depth], [0.065, 0.0], [0.08, 0.0]], segments=60)
    mold = _write(tmp_path / "mold.stl", Mesh(shape.vertices, shape.triangles, {}))
    assert command.main(["new", str(tmp_path / "scene"), "--mold", str(mold)]) == 0
    assert ("--plug auto" in capfd.readouterr().out) == named


@pytest.mark.parametrize("mold", [_cup(), _tray()], ids=["cup", "tray"])
def test_a_plug_of_the_cavity_keeps_off_the_mold(tmp_path: Path, mold: Mesh) -> None:
    scene = _new(tmp_path / "scene", _write(tmp_path / "mold.stl", mold), "auto")
    (plug,) = scene.tools
    assert scene.mold is not None and plug.motion is not None and plug.contact.kind == "coulomb"
    places, triangles = np.asarray(plug.vertices, float), np.asarray(plug.triangles)
    assert np.all(topology.edges(triangles)[1] == 2)  # closed
    start = float(places[:, 2].max())
    depth, stroke = np.asarray(scene.mold.vertices)[:, 2].max(), float(plug.motion.displacement[-1])
    assert -0.02 * depth < start < 0.0
    np.testing.assert_allclose(start + stroke, 0.8 * depth, rtol=0.01)
    across, opening = (
        np.ptp(places, axis=0)[:2],
        np.array([0.13, 0.13] if mold.positions[:, 0].min() < 0 else [0.2, 0.12]),
    )
    np.testing.assert_allclose(opening - across, 0.25 * opening.min(), rtol=0.1)
    assert plausibility.find_meetings(scene) == []
    # Where the plug ends it is not nearer to the mold than a tenth of the depth.
    away = Distances(scene.mold.vertices, scene.mold.triangles, 1.0).upper_bounds(places + np.array([0.0, 0.0, stroke]))
    assert away[places[:, 2] + stroke > 0.1 * depth].min() > 0.1 * depth


def test_a_plug_that_is_beside_the_cavity_is_put_before_its_middle(tmp_path: Path) -> None:
    rod = molds.rod(radius=0.03, length=0.08, end_radius=0.01)
    for name, beside in (("above.stl", [0.01, 0.0, -0.3]), ("beside.stl", [0.5, 0.0, 0.0])):
        plug = _write(tmp_path / name, Mesh(rod.vertices + beside, rod.triangles, {}))
        scene = _new(tmp_path / f"scene-{name}", _write(tmp_path / "mold.stl", _cup()), plug)
        (tool,) = scene.tools
        assert tool.motion is not None
        middle, tip = np.asarray(tool.vertices).mean(0)[:2], float(np.asarray(tool.vertices)[:, 2].max())
        # The place of one above the cavity is kept.
        np.testing.assert_allclose(middle, [0.01 if name == "above.stl" else 0.0, 0.0], atol=1e-3)
        np.testing.assert_allclose(tip + float(tool.motion.displacement[-1]), 0.04, rtol=0.01)
        assert plausibility.find_meetings(scene) == []
        assert (tmp_path / f"scene-{name}" / name).read_bytes() == plug.read_bytes()


@pytest.mark.parametrize(
    ("radius", "length", "arguments", "words"),
    [
        (0.07, 0.1, [], "does not fit into the cavity: it is 140 x 140 x 100 mm large"),
        (0.03, 0.1, ["--drape"], "pushes a sheet into a cavity, and this mold is male"),
        (0.03, 0.1, ["--thickness", "0.001"], ""),
    ],
)
def test_plugs_that_do_not_fit(tmp_path: Path, capfd, radius, length, arguments, words) -> None:
    rod = molds.rod(radius=radius, length=length, end_radius=0.01)
    plug = _write(tmp_path / "rod.stl", Mesh(rod.vertices, rod.triangles, {}))
    mold = _write(tmp_path / "mold.stl", _cup())
    status = command.main(["new", str(tmp_path / "s"), "--mold", str(mold), "--plug", str(plug), *arguments])
    said = capfd.readouterr().err
    assert (status, said.count("\n")) == ((2, 1) if words else (0, 0)), said
    assert words in said and (not words or "--plug" in said)


def test_a_missing_plug_is_named(tmp_path: Path, capfd) -> None:
    mold = _write(tmp_path / "mold.stl", _cup())
    assert command.main(["new", str(tmp_path / "s"), "--mold", str(mold), "--plug", str(tmp_path / "no.stl")]) == 2
    assert "--plug = " in (said := capfd.readouterr().err) and "no.stl" in said and not (tmp_path / "s").exists()


def test_a_plug_in_other_units_is_warned_of_and_a_wide_one_says_that_it_goes_less_far(tmp_path: Path, capfd) -> None:
    mold = _write(tmp_path / "mold.stl", _cup())
    narrow, wide = (molds.rod(radius=radius, length=0.08, end_radius=0.0) for radius in (3e-5, 0.06))
    for name, rod in (("narrow", narrow), ("wide", wide)):
        plug = _write(tmp_path / f"{name}.stl", Mesh(rod.vertices, rod.triangles, {}))
        assert command.main(["new", str(tmp_path / name), "--mold", str(mold), "--plug", str(plug)]) == 0
        out, said = capfd.readouterr()
        assert ("is 0.06 mm wide" in said and "units of the mold's file" in said) == (name == "narrow"), said
        assert ("until it is near the mold" in out + said) == (name == "wide"), out
