"""Scenes to files and back, and fields between meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import jaxform
import optimize
from jaxform import shapes
from jaxform.io import files, geometry, output, scene_rewriting
from jaxform.mesh import meshes
from tests import scenes


def test_a_scene_written_with_changes_runs_the_same_from_its_new_folder(tmp_path: Path) -> None:
    document = files.read_scene("bowl")
    scene = files.build(document)
    random = np.random.default_rng(0)
    thickness = np.asarray(scene.parison.thickness) * random.uniform(0.8, 1.2, scene.parison.thickness.size)
    pressure = np.array([0.0, 1.5e4])
    changes = {"parison.thickness": thickness, "pressure.value": pressure}
    path = scene_rewriting.write_scene(document, changes, tmp_path / "")
    again = jaxform.load(path)
    np.testing.assert_array_equal(again.parison.thickness, thickness)
    changed = jaxform.replace(scene, changes)
    one, other = jaxform.run(changed), jaxform.run(again)
    scenes.assert_same(one.positions, other.positions)
    scenes.assert_same(one.thickness, other.thickness)


def test_relative_paths_are_rewritten(tmp_path: Path) -> None:
    document = files.read_scene("dish-coarse")
    path = scene_rewriting.write_scene(document, {}, tmp_path)
    here, there = files.read_reference(document), files.read_reference(files.read_scene(path))
    assert here is not None and there is not None
    np.testing.assert_array_equal(here["arc"], there["arc"])


def test_a_field_is_exact_at_its_own_nodes_and_linear_between(tmp_path: Path) -> None:
    coarse, fine = (shapes.disc(radius=1.0, elements=n) for n in (100, 700))

    def field(positions: np.ndarray) -> np.ndarray:
        return 0.01 + 0.003 * positions[:, 0] - 0.002 * positions[:, 1]

    path = tmp_path / "field.vtu"
    meshes.write_vtu(path, coarse.positions, coarse.triangles, point_data={"wall": field(coarse.positions)})
    np.testing.assert_array_equal(geometry.nodal_field(path, "wall", coarse.positions), field(coarse.positions))
    inside = fine.positions[np.hypot(fine.positions[:, 0], fine.positions[:, 1]) < 0.9]
    np.testing.assert_allclose(geometry.nodal_field(path, "wall", inside), field(inside), rtol=1e-9)
    with pytest.raises(jaxform.InputError, match="wal"):
        geometry.nodal_field(path, "wal", coarse.positions)


def test_a_field_of_a_formed_part_is_matched_by_initial_position(tmp_path: Path) -> None:
    """A result is far from where it began; its own sheet and another mesh of it find its wall all the same."""
    coarse, fine = (shapes.disc(radius=1.0, elements=n) for n in (100, 700))
    radius = np.hypot(coarse.positions[:, 0], coarse.positions[:, 1])
    formed = coarse.positions + np.stack([0 * radius, 0 * radius, 2.0 * (1.0 - radius**2)], axis=1)
    wall = 0.01 + 0.003 * coarse.positions[:, 0]
    path = tmp_path / "final.vtu"
    data = {"reference": coarse.positions, "thickness": wall}
    meshes.write_vtu(path, formed, coarse.triangles, point_data=data)
    np.testing.assert_array_equal(geometry.nodal_field(path, "thickness", coarse.positions), wall)
    inside = fine.positions[np.hypot(fine.positions[:, 0], fine.positions[:, 1]) < 0.9]
    np.testing.assert_allclose(geometry.nodal_field(path, "thickness", inside), 0.01 + 0.003 * inside[:, 0], rtol=1e-9)
    # A second forming begins where the first one ended.
    np.testing.assert_array_equal(geometry.nodal_field(path, "thickness", formed[::-1]), wall[::-1])
    with pytest.raises(jaxform.InputError, match="does not cover"):
        geometry.nodal_field(path, "thickness", 1e3 * coarse.positions)


def test_the_wall_of_an_own_result_is_a_target(tmp_path: Path) -> None:
    """Read by a study: the wall of the run that left it is no deviation."""
    (tmp_path / "scene.toml").write_text(scenes.FILE)
    (tmp_path / "study.toml").write_text(
        'scene = "scene.toml"\n[[variable]]\nkind = "thickness-profile"\nalong = "radius"\nknots = 4\n'
        'bounds = [5e-4, 2e-3]\n[objective]\nkind = "target"\n'
        'thickness = { file = "final.vtu", field = "thickness" }\n[solver]\nmethod = "lbfgs"\n'
    )
    scene = jaxform.load(tmp_path / "scene.toml")
    result = jaxform.run(scene)
    assert np.linalg.norm(np.asarray(result.positions - scene.parison.positions), axis=1).max() > 0.01
    output.write_part(scene, result, tmp_path / "final.vtu")
    study = optimize.load_study(tmp_path / "study.toml")
    assert isinstance(study.objective, optimize.Target)
    assert float(study.objective.error(scene, result)) < 1e-12
