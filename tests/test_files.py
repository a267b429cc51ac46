"""Scenes to files and back, fields between meshes, and the README's own example."""

from __future__ import annotations

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import fields, files, meshes, shapes

ROOT = Path(__file__).parent.parent


def test_a_scene_written_with_changes_runs_the_same_from_its_new_folder(tmp_path: Path) -> None:
    document = files.read_scene("bowl")
    scene = files.build(document)
    random = np.random.default_rng(0)
    thickness = np.asarray(scene.parison.thickness) * random.uniform(0.8, 1.2, scene.parison.thickness.size)
    pressure = np.array([0.0, 1.5e4])
    changes = {"parison.thickness": thickness, "pressure.value": pressure}
    path = files.write_scene(document, changes, tmp_path / "")
    again = jaxform.load(path)
    np.testing.assert_array_equal(again.parison.thickness, thickness)
    changed = jaxform.replace(scene, changes)
    one, other = jaxform.run(changed), jaxform.run(again)
    np.testing.assert_array_equal(one.positions, other.positions)
    np.testing.assert_array_equal(one.thickness, other.thickness)


def test_relative_paths_are_rewritten(tmp_path: Path) -> None:
    document = files.read_scene("dish-coarse")
    path = files.write_scene(document, {}, tmp_path)
    here, there = files.read_reference(document), files.read_reference(files.read_scene(path))
    assert here is not None and there is not None
    np.testing.assert_array_equal(here["arc"], there["arc"])


def test_a_field_is_exact_at_its_own_nodes_and_linear_between(tmp_path: Path) -> None:
    coarse, fine = (shapes.disc(radius=1.0, elements=n) for n in (100, 700))

    def field(positions: np.ndarray) -> np.ndarray:
        return 0.01 + 0.003 * positions[:, 0] - 0.002 * positions[:, 1]

    path = tmp_path / "field.vtu"
    meshes.write_vtu(path, coarse.positions, coarse.triangles, point_data={"wall": field(coarse.positions)})
    np.testing.assert_array_equal(fields.nodal_field(path, "wall", coarse.positions), field(coarse.positions))
    inside = fine.positions[np.hypot(fine.positions[:, 0], fine.positions[:, 1]) < 0.9]
    np.testing.assert_allclose(fields.nodal_field(path, "wall", inside), field(inside), rtol=1e-9)
    with pytest.raises(jaxform.InputError, match="wal"):
        fields.nodal_field(path, "wal", coarse.positions)


def test_the_example_in_the_readme_works(capsys: pytest.CaptureFixture[str]) -> None:
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert code is not None
    exec(code.group(1), {})
    before, after = map(float, capsys.readouterr().out.split())
    assert after < before
    assert jnp.zeros(1).dtype == np.float64
