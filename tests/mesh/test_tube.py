"""The tube: its mesh, and its inflation between ends that are clamped, guided or free."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.mesh import topology
from tests import scenes


@pytest.mark.quick
@pytest.mark.parametrize(("symmetry", "parts"), [("none", 1), ("half", 2), ("quarter", 4)])
def test_mesh_covers_the_tube_with_outward_normals(symmetry: Any, parts: int) -> None:
    sheet = shapes.tube(radius=0.02, length=0.1, element_size=0.002, symmetry=symmetry)
    corners = sheet.positions[sheet.triangles]
    normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = corners.mean(1) * [1.0, 1.0, 0.0]
    assert np.all((normals * outward).sum(1) > 0.0)
    area = 2.0 * np.pi * 0.02 * 0.1 / parts
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1).sum(), area, rtol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(sheet.positions[:, :2], axis=1), 0.02, rtol=1e-12)
    assert np.array_equal(sheet.clamped, np.isin(sheet.positions[:, 2], [0.0, 0.1]))
    for axis in range(parts.bit_length() - 1):
        assert np.array_equal(sheet.fixed[:, axis], sheet.positions[:, axis] == 0.0) and sheet.fixed[:, axis].any()
    assert len(topology.inconsistent_edges(sheet.triangles)) == 0
    rims = topology.boundary_nodes(sheet.triangles)
    assert np.all(sheet.clamped[rims] | sheet.fixed[rims].any(1)), "nothing but ends and cuts is open"


@pytest.mark.quick
@pytest.mark.parametrize(
    ("given", "key"),
    [({"radius": 0.0}, "radius"), ({"length": -1.0}, "length"), ({"ends": "pinched"}, "ends")],
)
def test_bad_tubes_are_refused(given: dict[str, Any], key: str) -> None:
    with pytest.raises(jaxform.InputError, match=f"parison.{key}"):
        shapes.tube(**({"radius": 1.0, "length": 4.0, "elements": 100} | given))


def _inflate(pressure: float, ends: Any, symmetry: Any = "quarter", elements: int = 1200) -> jaxform.Result:
    """A tube of radius 1 and length 4 under a slow pressure, in units of c h0 / R."""
    sheet = shapes.tube(radius=1.0, length=4.0, ends=ends, elements=elements, symmetry=symmetry)
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 40.0], [0.0, 0.01 * pressure]),
        solver=jaxform.make_solver(end_time=60.0, damping=1.0),
    )
    result = jaxform.run(scene)
    assert int(result.status) == 0 and float(result.energy.balance_error) < 1e-4
    return result


def test_clamped_tube_bulges_as_the_membrane_solution() -> None:
    # Invariants along the meridian, l1 W1 - W and r T1 cos(phi) - P r^2 / 2: middle radius 1.4, and the wall there.
    result = _inflate(1.70287174, "clamped")
    middle = np.asarray(result.reference)[:, 2] == 2.0
    radius = np.linalg.norm(np.asarray(result.positions)[middle, :2], axis=1)
    np.testing.assert_allclose(radius.mean(), 1.4, rtol=3e-3)
    np.testing.assert_allclose(np.asarray(result.thickness)[middle].mean(), 0.69026670e-2, rtol=3e-3)


@pytest.mark.long
def test_guided_tube_is_a_part_of_a_long_one() -> None:
    result = _inflate(1.7, "guided")
    positions = np.asarray(result.positions)
    stretch = np.linalg.norm(positions[:, :2], axis=1).mean()
    np.testing.assert_allclose(2.0 * (1.0 - stretch**-4) * (1.0 + 0.1), 1.7, rtol=3e-3)
    np.testing.assert_allclose(np.asarray(result.thickness), 0.01 / stretch, rtol=3e-3)
    np.testing.assert_allclose(positions[:, 2], np.asarray(result.reference)[:, 2], atol=1e-9)


@pytest.mark.long
def test_free_tube_shortens_as_a_hoop_in_uniaxial_tension() -> None:
    positions = np.asarray(_inflate(1.0, "free", "half", 400).positions)
    stretch = np.linalg.norm(positions[:, :2], axis=1).mean()
    np.testing.assert_allclose(np.ptp(positions[:, 2]) / 4.0, stretch**-0.5, rtol=3e-3)
    np.testing.assert_allclose(positions[:, 2].mean(), 2.0, rtol=1e-9)


@pytest.mark.long
def test_tube_blown_into_a_cylinder_has_its_wall(tmp_path: Path) -> None:
    file = tmp_path / "tube.toml"
    file.write_text(
        """
        [parison]
        shape = "tube"
        radius = 0.02
        length = 0.08
        ends = "guided"
        elements = 400
        symmetry = "quarter"
        thickness = 1.0e-3
        [material]
        model = "mooney-rivlin"
        c = 2.0e5
        alpha = 0.1
        density = 1000.0
        [pressure]
        time = [0.0, 0.05]
        value = [0.0, 5.0e4]
        [mold]
        shape = "revolved"
        profile = [[0.03, -0.01], [0.03, 0.09]]
        segments = 192
        [solver]
        end_time = 0.1
        damping = 200.0
        """
    )
    scene = jaxform.load(file)
    result = jaxform.run(scene)
    assert np.all(np.asarray(result.stuck))
    np.testing.assert_allclose(np.asarray(result.thickness), 1e-3 / 1.5, rtol=3e-3)
