"""The strangers' files in small: what they are, what the judge of formed parts says, and two of them through new."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import trimesh

from benchmarks.strangers import file_molds, files
from benchmarks.strangers.file_molds import KINDS


def test_the_kinds_are_as_many_and_as_fine_as_strangers_files() -> None:
    made = {name: kind.made(1.0) for name, kind in KINDS.items()}
    counts = [len(mesh.faces) for mesh in made.values()]
    assert len(made) == 38 and min(counts) >= 132 and 70_000 < max(counts) <= 80_000
    open_ones = {name for name, mesh in made.items() if not mesh.is_watertight}
    scans = {"face", "fine face", "knee", "limb", "canopy", "open bowl in metres"}
    assert open_ones == scans | {"tray with a flange", "cup with a rolled lip"}
    assert {kind.unit for kind in KINDS.values()} == set(file_molds.UNITS)
    assert {kind.suffix for kind in KINDS.values()} == {"stl", "ascii.stl", "obj", "ply"}


@pytest.mark.parametrize(
    "name", ["box buck", "drafted buck", "canopy", "buck of unshared vertices", "mug in inches", "tray with a flange"]
)
def test_files_are_written_in_their_units_and_with_their_faults(tmp_path: Path, name: str) -> None:
    kind, size = KINDS[name], np.ptp(KINDS[name].made(1.0).vertices, axis=0)
    read: Any = trimesh.load(kind.write(tmp_path, name), process=False, force="mesh")
    np.testing.assert_allclose(np.ptp(read.vertices, axis=0) * file_molds.UNITS[kind.unit], size, rtol=1e-5)
    if name == "buck of unshared vertices":
        assert len(read.vertices) == 3 * len(read.faces)
    if name == "tray with a flange":
        assert not read.is_winding_consistent


def _scene(folder: Path, depth: float, formed: float) -> tuple[Path, Path]:
    """A box of a depth below a rim in z = 0, and a sheet that is formed to a depth, straight down."""
    mesh = file_molds.blocks([0, 100], [0, 60], [0, 1e3 * depth], np.ones((1, 1, 1), bool))
    top = (mesh.vertices[mesh.faces][..., 2] == 0).all(1)
    trimesh.Trimesh(mesh.vertices, mesh.faces[~top], process=False).export(folder / "box.stl")
    scene = folder / "scene.toml"
    scene.write_text('[parison]\nelement_size = 0.004\n[mold]\npath = "box.stl"\nscale = 0.001\n')
    x, y = np.meshgrid(np.linspace(0, 0.1, 51), np.linspace(0, 0.06, 31), indexing="ij")
    flat = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3)
    number = np.arange(len(flat)).reshape(51, 31)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    inside = (np.minimum(x, 0.1 - x) > 0) & (np.minimum(y, 0.06 - y) > 0)
    places = flat + np.stack([0 * x, 0 * x, formed * inside], axis=2).reshape(-1, 3)
    part = folder / "final.vtu"
    meshio.Mesh(places, [("triangle", triangles)], point_data={"reference": flat}).write(part)
    return scene, part


@pytest.mark.parametrize(("formed", "least", "most"), [(0.03, 0.99, 1.0), (0.015, 0.2, 0.4), (0.0, 0.0, 0.1)])
def test_the_judge_counts_what_the_part_is_near(tmp_path: Path, formed: float, least: float, most: float) -> None:
    """Bottom 0.006 m^2, walls 0.0096 m^2: half as deep, half of the walls are near and the bottom is not."""
    share = files.share_within_an_element(*_scene(tmp_path, 0.03, formed))
    assert least <= share <= most


def test_what_is_right_in_a_row() -> None:
    filled = files.Row("cup", status="ok", filled=0.99)
    assert filled.right and files.Row("cup", refused=True, way="--drape", status="ok", filled=0.99).right
    for wrong in (
        files.Row("cup", refused=True),
        files.Row("cup", status="ok", filled=0.5),
        files.Row("cup", status="exit -1: no end in 9 s"),
    ):
        assert not wrong.right
    told = files.Row("cup", status="not filled: 3 mm", filled=0.5)
    assert told.right
    line = files.summary_line([filled, told, files.Row("cup", refused=True)])
    assert line == (
        "3 kinds: 1 refused, 0 of them run by the flag that is named; 2 run, 1 ok; 1 filled, 1 not and say so; 2 right"
    )


@pytest.mark.long
@pytest.mark.parametrize("name", ["tray with holes in its walls", "cone buck"])
def test_two_of_them_in_small(tmp_path: Path, name: str) -> None:
    row = files.try_file(name, tmp_path, coarse=5.0, fine=0.5)
    assert row.right, str(row)
    assert not row.refused and row.thinnest > 0
