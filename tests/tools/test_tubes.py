"""Tubes are refused with a way forward; what is short, closed at one end, or has small openings, is none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from jaxform import InputError
from jaxform.mesh.meshes import Mesh
from jaxform.tools import footprint, kinds


def _mold(body: Any) -> Mesh:
    return footprint.weld_mold(np.asarray(body.vertices, float), np.asarray(body.faces))


def _pipe(length: float) -> trimesh.Trimesh:
    return trimesh.creation.annulus(r_min=0.028, r_max=0.030, height=length)


def _turn(body: Any, *angles: Any) -> trimesh.Trimesh:
    body.apply_transform(trimesh.transformations.euler_matrix(*angles))
    return body


def _duct() -> trimesh.Trimesh:
    """A square duct without thickness: four faces of a box, 60 mm wide and 150 mm long."""
    box = trimesh.creation.box(extents=(0.06, 0.06, 0.15))
    box.update_faces(np.abs(box.face_normals[:, 2]) < 0.5)
    return box


@pytest.mark.parametrize(
    ("body", "axis", "width", "other"),
    [
        (_pipe(0.12), (0, 0, 1), 0.056, "[xy]"),
        (_turn(_pipe(0.12), 0.0, np.pi / 2, 0.0), (1, 0, 0), 0.056, "[yz]"),
        (_turn(_pipe(0.12), 0.5, 0.3, 0.0), None, 0.056, "[xyz]"),
        (_duct(), (0, 0, 1), 0.06, "[xy]"),
    ],
    ids=["upright", "lying", "oblique", "duct"],
)
def test_a_tube_is_found_along_its_axis(
    body: trimesh.Trimesh, axis: tuple[float, ...] | None, width: float, other: str
) -> None:
    found = kinds.widest_tube(_mold(body))
    assert found is not None
    inside, _, direction = found
    if axis is not None:
        np.testing.assert_allclose(np.abs(direction), axis, atol=1e-9)
    assert inside == pytest.approx(width, rel=0.05)
    with pytest.raises(InputError, match=rf"open from end to end.*--drape --direction=\+{other} "):
        kinds.refuse_tubes(_mold(body))


def test_frames_cups_and_walls_with_holes_are_no_tubes() -> None:
    cup = _pipe(0.12)
    bottom = trimesh.creation.cylinder(radius=0.03, height=0.004)
    bottom.apply_translation((0, 0, -0.058))
    small = trimesh.creation.annulus(r_min=0.01, r_max=0.030, height=0.12)
    for body in (_pipe(0.04), trimesh.util.concatenate([cup, bottom]), small, trimesh.creation.box()):
        assert kinds.widest_tube(_mold(body)) is None
        kinds.refuse_tubes(_mold(body))
