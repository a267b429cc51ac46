"""Surfaces of a user's own as sheets: what they must be, where they are held, and their symmetry planes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.core.formatting import format_coordinate
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh

PLANE_TOLERANCE = 1e-6
"""Distance from a symmetry plane up to which a node is on it, relative to the size: float32 files round."""


def check_surface(mesh: Mesh) -> None:
    """Raises InputError where triangles are degenerate or turned, or three meet at an edge."""
    bad = np.flatnonzero(meshes.find_degenerate(mesh.positions, mesh.triangles))
    many = topology.nonmanifold_edges(mesh.triangles)
    against = topology.inconsistent_edges(mesh.triangles)
    if bad.size:
        problem = f"{bad.size} degenerate triangles (no area, or twice the same), the first is number {bad[0]}"
        raise InputError(problem, "remove them from the mesh", key="parison.path")
    if len(many):
        problem = f"{len(many)} edges belong to more than two triangles, the first {_place(mesh, many[0])}"
        raise InputError(problem, "a parison is one surface: remove inner walls and copies", key="parison.path")
    if len(against):
        problem = f"inverted triangles at {len(against)} edges, the first {_place(mesh, against[0])}"
        raise InputError(problem, "turn the triangles so that all normals agree", key="parison.path")


def _place(mesh: Mesh, edge: NDArray[np.int64]) -> str:
    return "at (" + ", ".join(format_coordinate(x, digits=6) for x in mesh.positions[edge].mean(axis=0)) + ") m"


def parse_plane(text: str) -> tuple[int, float]:
    """Axis and place [m] of a symmetry plane that is written `x`, which is x = 0, or `x=0.15`.

    Raises:
        InputError: It is no such plane.
    """
    axis, equals, place = text.partition("=")
    try:
        level = float(place) if equals else 0.0
    except ValueError:
        level = math.nan
    if axis.strip() not in ("x", "y", "z") or not abs(level) <= meshes.LARGEST:
        raise InputError("is no symmetry plane", 'name planes as in ["x", "y"], or with their place, ["x=0.15"]')
    return "xyz".index(axis.strip()), level


def snap_to_planes(
    positions: NDArray[np.float64], planes: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Positions moved exactly onto the planes they are on, and which components those hold."""
    key, positions, fixed = "parison.planes", positions.copy(), np.zeros(positions.shape, dtype=bool)
    tolerance = PLANE_TOLERANCE * meshes.size(positions)
    for plane in planes:
        try:
            axis, level = parse_plane(plane)
        except InputError as error:
            raise replace(error, key=key, value=list(planes)) from None
        name, away = f"{'xyz'[axis]} = {level:g}", positions[:, axis] - level
        on = np.abs(away) <= tolerance
        if not on.any():
            raise InputError(f"no node lies on {name}", "cut the mesh there or leave the plane out", key, planes)
        if away[~on].min(initial=0.0) < 0 < away[~on].max(initial=0.0):
            problem = f"nodes lie on both sides of {name}"
            raise InputError(problem, "keep the mesh of one side only or leave the plane out", key, planes)
        positions[on, axis] = level
        fixed[:, axis] = on
    return positions, fixed


def snap_corners(corners: NDArray[np.float64], planes: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """A polygon's corners (k, 2) [m] in z = 0 moved exactly onto the planes, and which components (k, 3) those hold."""
    moved, fixed = snap_to_planes(np.insert(corners, 2, 0.0, axis=1), planes)
    # Corners beside the one of two planes may be the same now.
    apart = (moved != np.roll(moved, -1, axis=0)).any(1)
    return moved[apart, :2], fixed[apart]


def clamped_nodes(mesh: Mesh, clamp: str, rim: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Nodes (n_node,) that never move, as `clamp` says."""
    key, clamped = "parison.clamp", np.zeros(len(mesh.positions), dtype=bool)
    if clamp == "boundary":
        clamped[rim] = True
    elif clamp.startswith("field:"):
        name = clamp.removeprefix("field:")
        if name not in mesh.fields:
            known = ", ".join(sorted(mesh.fields)) or "none"
            raise InputError("the mesh has no such field", f"its fields: {known}", key, clamp)
        if not np.isfinite(mesh.fields[name]).all() or not mesh.fields[name].any():
            raise InputError("the field marks no node", "set it to 1 where nothing may move, 0 elsewhere", key, clamp)
        clamped = mesh.fields[name] != 0
    elif clamp != "none":
        raise InputError("is no way to clamp", "use boundary, none or field:NAME", key, clamp)
    return clamped
