"""Meshes in the coordinates of a mold's own file, and the side of a closed solid that the sheet touched."""

from __future__ import annotations

import filecmp
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core import disk
from jaxform.core.errors import InputError
from jaxform.io.export.wall import WallSurface
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.volumes import areas
from jaxform.tools.distances import Distances
from jaxform.tools.molds import rotation

Array = NDArray[np.float64]

_SCENES = ("best.toml", "simulated.toml")  # in a folder of results; the first one that is there
_NEAR = 0.02  # of the part's size: as near as that a mesh follows it
_BETTER = 0.3  # by what share more of the part a mesh must follow it where the scene's pose is taken unasked
_ON_RIM = 1e-6  # of the part's size: as far as that beyond an open rim a place is still on it
_FACING = 0.3  # the cosine between normals of a side and of the part on it
_AGREED = 0.8  # of what is nearest to the part, so much has normals to one side where triangles turn one way


class Pose(NamedTuple):
    """Pose of a scene's mold: scale, rotation and displacement of its files.

    Attributes:
        scale: Metres per unit of their lengths.
        turn: Rotation (3, 3).
        shift: Displacement (3,) [m] after the rotation; of a moving mold, that at the end of the run.
        files: The files.
    """

    scale: float
    turn: Array
    shift: Array
    files: tuple[Path, ...]

    def place(self, positions: Array) -> Array:
        """Positions in the scene [m] of points (n, 3) [m] of the files."""
        return positions @ self.turn.T + self.shift

    def contains_file(self, path: Path) -> bool:
        """True if a file is one of the mold's, or a copy of one."""
        return any(disk.is_file(file) and filecmp.cmp(file, path, shallow=False) for file in self.files)


def read_pose(folder: Path) -> Pose | None:
    """The pose of the mold of the scene in a folder of results; None where that has no mold from files."""
    from jaxform.io import files, schema

    name = next((folder / name for name in _SCENES if disk.is_file(folder / name)), None)
    if name is None:
        return None
    try:
        document = files.read_scene(name)
    except InputError:
        return None
    table = document.model.mold
    if not isinstance(table, schema.FileMold):
        return None
    shift = np.array(table.translate, float)
    if table.motion is not None:
        way = np.array(table.motion.direction, float)
        shift = shift + way / np.linalg.norm(way) * table.motion.displacement[-1]
    paths = [table.path] if isinstance(table.path, str) else table.path
    located = tuple(disk.expand_path(path, document.folder) for path in paths)
    return Pose(table.scale, rotation(np.array(table.rotate, float)), shift, located)


def match_fraction(wall: WallSurface, positions: Array, triangles: NDArray[np.integer]) -> float:
    """Share of the part's nodes that a surface is near to."""
    near = _NEAR * meshes.size(wall.positions)
    distance = Distances(positions, triangles, near).upper_bounds(wall.positions)
    return float((distance <= near).mean())


def fits_better_posed(wall: WallSurface, mesh: Mesh, posed: Array, otherwise: Mesh) -> bool:
    """True if a mesh matches the part clearly better in the scene's pose than where it is."""
    return match_fraction(wall, posed, mesh.triangles) > _BETTER + match_fraction(
        wall, otherwise.positions, otherwise.triangles
    )


def contact_side(
    wall: WallSurface, mesh: Mesh, reach: float, whole: bool = True
) -> tuple[Mesh, NDArray[np.int64], float]:
    """The side of a closed solid on which the part lies; any other mesh unchanged, or only its region near the part.

    Args:
        wall: Surface of the part.
        mesh: The mesh, in the position of the part [m].
        reach: Largest distance from the part [m] at which the mesh gets a wall.
        whole: Whether a mesh that is no closed solid is returned unchanged.

    Returns:
        The mesh of that side, the indices (n,) of its nodes in the given mesh, and its share of the area.
    """
    every = np.arange(len(mesh.positions), dtype=np.int64)
    closed = not len(topology.boundary_edges(mesh.triangles))
    if whole and not closed:
        return mesh, every, 1.0
    corners, part = mesh.positions[mesh.triangles], wall.positions[wall.triangles]
    near = Distances(wall.positions, wall.triangles, reach).nearest(corners.mean(1))
    cosine = np.einsum("ij,ij->i", _normals(corners), _normals(part)[near.triangle])
    size = areas(mesh.positions, mesh.triangles)
    covered = (near.distance <= reach) & ~(near.at_rim & (near.distance > _ON_RIM * meshes.size(wall.positions)))
    closest = covered & (near.distance <= np.median(near.distance[covered])) if covered.any() else covered
    along = float(size[closest & (cosine > 0)].sum()) / max(float(size[closest].sum()), 1e-300)
    if closed and max(along, 1 - along) >= _AGREED:
        covered &= (cosine if along > 0.5 else -cosine) > _FACING
    if not covered.any():
        return mesh, every, 1.0
    nodes, triangles = np.unique(mesh.triangles[covered], return_inverse=True)
    side = replace(mesh, positions=mesh.positions[nodes], triangles=triangles.reshape(-1, 3), fields={}, cell_fields={})
    return side, nodes.astype(np.int64), float(size[covered].sum() / size.sum())


def _normals(corners: Array) -> Array:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
