"""The smooth picture: where it is seen from, that it is drawn where PyVista is, and what is said where it is not."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

import jaxform
from jaxform.cli import command
from jaxform.io import output, rendering
from jaxform.io.report.stored_results import read_results
from tests import scenes


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a cup's quarter."""
    made, scene = tmp_path_factory.mktemp("cup"), scenes.cup()
    output.write_result(scene, jaxform.run(scene), made)
    return made


def test_it_is_seen_from_both_sides(folder: Path) -> None:
    part = read_results(folder).part
    (eye, up), (other, down) = rendering._eyes(part)
    way = (part.positions - part.reference).mean(0)
    assert eye @ way > 0.0 > other @ way
    np.testing.assert_allclose(up, -down)
    low, high = rendering._range(part)
    assert 1e3 * part.cells["thickness"].min() == pytest.approx(low) and low < high


def test_without_pyvista_it_is_said_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    assert command.main(["render", str(folder)]) == 2
    assert "pip install pyvista" in capsys.readouterr().err
    assert not (folder / "part.png").exists()


def test_a_folder_without_results_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["render", str(tmp_path)]) == 2
    assert "holds no summary.json" in capsys.readouterr().err


@pytest.mark.skipif(importlib.util.find_spec("pyvista") is None, reason="PyVista is not installed")
@pytest.mark.filterwarnings("ignore")
def test_the_picture_shows_the_part_twice(folder: Path) -> None:
    assert command.main(["render", str(folder), "--quiet"]) == 0
    pixels = imread(folder / "part.png")[..., :3]
    colored = pixels.max(-1) - pixels.min(-1) > 0.1
    half = pixels.shape[1] // 2
    assert all(0.1 < share.mean() < 0.9 for share in (colored[:, :half], colored[:, half:]))


@pytest.mark.skipif(importlib.util.find_spec("pyvista") is None, reason="PyVista is not installed")
@pytest.mark.filterwarnings("ignore")
def test_what_is_cut_off_the_part_is_apart_from_it(tmp_path: Path) -> None:
    scene = scenes.cup()
    scene = dataclasses.replace(scene, part=jaxform.make_part(trim=("z", 0.25, "above")))
    output.write_result(scene, jaxform.run(scene), tmp_path)
    results = read_results(tmp_path)
    surface = rendering._part(rendering._pyvista(), results)
    part, rest = rendering._split_part(surface)
    assert part.n_cells + rest.n_cells == surface.n_cells == 4 * len(results.part.triangles)
    assert part.cell_centers().points[:, 2].min() >= 250.0 > rest.cell_centers().points[:, 2].max()
    assert command.main(["render", str(tmp_path), "--quiet"]) == 0
