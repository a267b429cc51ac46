"""Surfaces of a user's own as sheets: what they must be, where they are held, and their symmetry planes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh

PLANE_TOLERANCE = 1e-6
"""Distance from a symmetry plane up to which a node is on it, relative to the size: float32 files round."""


def check_surface(mesh: Mesh) -> None:
    """Raises InputError where triangles are degenerate or turned, or three meet at an edge."""
    bad = np.flatnonzero(meshes.degenerate(mesh.positions, mesh.triangles))
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
    return "at (" + ", ".join(f"{x:.6g}" for x in mesh.positions[edge].mean(axis=0)) + ") m"


def snapped(positions: NDArray[np.float64], planes: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Positions moved exactly onto the planes they are on, and which components those hold."""
    key, positions, fixed = "parison.planes", positions.copy(), np.zeros(positions.shape, dtype=bool)
    tolerance = PLANE_TOLERANCE * meshes.size(positions)
    for plane in planes:
        if plane not in ("x", "y", "z"):
            raise InputError("is no symmetry plane", 'name planes as in ["x", "y"]', key, planes)
        axis = "xyz".index(plane)
        on = np.abs(positions[:, axis]) <= tolerance
        if not on.any():
            raise InputError(f"no node lies on {plane} = 0", "cut the mesh there or leave the plane out", key, planes)
        if positions[~on, axis].min(initial=0.0) < 0 < positions[~on, axis].max(initial=0.0):
            problem = f"nodes lie on both sides of {plane} = 0"
            raise InputError(problem, "keep the mesh of one side only or leave the plane out", key, planes)
        positions[on, axis] = 0.0
        fixed[:, axis] = on
    return positions, fixed


def held_rim(mesh: Mesh, clamp: str, rim: NDArray[np.int64]) -> NDArray[np.bool_]:
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
