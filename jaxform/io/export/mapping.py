"""The wall of a formed part carried over to a mesh of the user's own, its volume kept."""

from __future__ import annotations

import filecmp
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core import disk
from jaxform.core.errors import InputError, format_extent, format_percent, warn_of
from jaxform.io import previous_results
from jaxform.io.export.wall import WallSurface
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.volumes import areas, conserve_volume
from jaxform.tools.distances import Distances, NearestPlaces, interpolate, weights
from jaxform.tools.mold import make_motion
from jaxform.tools.molds import rotation
from jaxform.tools.search import split_long_triangles

Array = NDArray[np.float64]

FARTHEST = 0.05
"""Distance from the formed part beyond which a mesh does not lie on it, relative to the part's size."""
_ON_RIM = 1e-6  # of the part's size: as far as that beyond an open rim a place is still on it
_FINEST, _MOST = 300, 100_000  # samples along the part's size, and about how many there are
_CHUNK = 50_000  # places looked for together
_LEAST_SHARE, _MISSING_SHARE = 0.01, 0.005  # shares of the mesh's area: what lies on the part, or does not
_AREA_DIFFERS, _TWO_SIDED = 0.05, 0.5  # by which areas differ: of another surface, and of one with two sides
_ALIKE = 10.0  # times as large as the part, or as small, a mesh may be


class Coverage(NamedTuple):
    """Coverage of a mesh by a formed part, and of the part by the mesh.

    Attributes:
        mesh: Share of the mesh's area that lies on the part.
        part: Share of the part's volume that has a place on the mesh.
        farthest: Largest distance [m] of the mesh from the part.
        scaled: Factor that the thickness was multiplied by, so that the volume is the part's.
        volume: Volume of the part [m^3] that has a place on the mesh.
    """

    mesh: float
    part: float
    farthest: float
    scaled: float
    volume: float

    def __str__(self) -> str:
        """The coverage as a sentence."""
        return (
            f"{format_percent(self.mesh, 4)} of the mesh lies on the part, its farthest place about "
            f"{1e3 * self.farthest:.3g} mm away, and {format_percent(self.part, 4)} of the part's volume has a place "
            f"on it; the thickness was scaled by {self.scaled:.5g} to keep {self.volume:.6g} m3"
        )


def lies_within(found: NearestPlaces, reach: float, size: float) -> NDArray[np.bool_]:
    """Places (n,) that are no farther than a reach [m] from a surface of a size [m], and not beyond its open rim."""
    beside = found.at_rim & (found.distance > _ON_RIM * size)
    return (found.distance <= reach) & ~beside


def read_target(path: Path, scale: float) -> Mesh:
    """The user's mesh in m, its nodes in their order: welded, without triangles that have no area.

    Raises:
        InputError: There is no such mesh, or nothing of it is left.
    """
    try:
        mesh, dropped = meshes.drop_degenerate(meshes.weld(meshes.read_mesh(path, scale=scale, further=True)))
    except InputError as error:
        raise replace(error, key="--scale" if error.key == "scale" else "--onto") from None
    if not len(mesh.triangles):
        raise InputError("has no triangle with an area", "export its surface again", "--onto", str(path))
    if dropped:
        remedy = "they are left out of the exported mesh"
        warn_of(f"{dropped} triangles have no area or are duplicates", remedy, key="--onto", value=str(path))
    return mesh


def map_wall(wall: WallSurface, mesh: Mesh, name: str) -> tuple[WallSurface, Coverage]:
    """The wall on another mesh, and the coverage of that by the part.

    Every place of the mesh takes the thickness of the nearest place of the part, also where that is far away. All are
    then multiplied by one number, so that the mesh has the part's volume where each lies on the other.

    Args:
        wall: Wall of the part.
        mesh: The mesh, positions in m.
        name: Name of the mesh in messages.

    Raises:
        InputError: The mesh is somewhere else, or is no single surface.

    Warns:
        InputWarning: Some of the mesh does not lie on the part, or its area is another there.
    """
    size = meshes.size(wall.positions)
    _check_size(size, mesh, name)
    reach = FARTHEST * size
    part = Mesh(wall.positions, wall.triangles.astype(np.int32))
    owner, places, area = _sample_surface(mesh, part, size)
    part_owner, part_places, part_area = _sample_surface(part, mesh, size)
    on_part, on_mesh = _nearest(part, places, reach), _nearest(mesh, part_places, reach)
    on, used = lies_within(on_part, reach, size), lies_within(on_mesh, reach, size)
    share = float(area[on].sum() / area.sum())
    if share < _LEAST_SHARE or not used.any():
        raise InputError(
            _no_overlap_message(wall, mesh, reach), "move or scale the mesh to where the part is", "--onto", name
        )
    mapped = _transfer_wall(wall, mesh, owner, area, on_part, reach)
    weight = weights(part_places, wall.positions[wall.triangles[part_owner]])
    volumes = part_area * interpolate(wall.thickness, wall.triangles, part_owner, weight)
    volume = float(volumes[used].sum())
    weight = weights(places, mesh.positions[mesh.triangles[owner]])
    before = float(area[on] @ interpolate(mapped.thickness, mesh.triangles, owner, weight)[on])
    coverage = Coverage(
        share,
        volume / float(volumes.sum()),
        float(on_part.distance.max()),
        volume / before,
        volume,
    )
    _warn_of_coverage(coverage, float(area[on].sum() / part_area[used].sum()), wall, reach, name)
    mapped = replace(
        mapped,
        thickness=coverage.scaled * mapped.thickness,
        element_thickness=coverage.scaled * mapped.element_thickness,
        words=(*wall.words, f"mapped onto the mesh {Path(name).name}: {coverage}"),
    )
    return mapped, coverage


def _sample_surface(surface: Mesh, other: Mesh, size: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Places all over a surface, as close as the elements of the finer one.

    Returns:
        The triangle of each place (n,), the places (n, 3) [m], and the areas (n,) [m^2] that they stand for.
    """
    area = float(areas(surface.positions, surface.triangles).sum())
    sides = [np.linalg.norm(np.diff(one.positions[one.triangles[:, :2]], axis=1), axis=2) for one in (surface, other)]
    longest = max(0.5 * min(float(np.median(side)) for side in sides), size / _FINEST, (area / _MOST) ** 0.5)
    pieces, owner = split_long_triangles(surface.positions[surface.triangles], longest)
    doubled = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1)
    return owner, pieces.mean(1), 0.5 * doubled


def _nearest(surface: Mesh, points: Array, reach: float) -> NearestPlaces:
    distances = Distances(surface.positions, surface.triangles, reach)
    parts = np.array_split(points, 1 + len(points) // _CHUNK)
    found = [distances.nearest(part) for part in parts]
    return NearestPlaces(*(np.concatenate(values) for values in zip(*found, strict=True)))


def _transfer_wall(
    wall: WallSurface, mesh: Mesh, owner: NDArray[np.int64], area: Array, found: NearestPlaces, reach: float
) -> WallSurface:
    """The wall with the mesh's nodes, each triangle as thick as its samples are on average.

    Args:
        wall: Wall of the part.
        mesh: The mesh.
        owner: The mesh's triangle of each sample (n,).
        area: The area that each stands for (n,) [m^2].
        found: The nearest places of the part.
        reach: Distance [m] to which distances are exact.
    """
    nodes = _nearest(Mesh(wall.positions, wall.triangles.astype(np.int32)), mesh.positions, reach)
    weight = weights(nodes.place, wall.positions[wall.triangles[nodes.triangle]])
    nodal = interpolate(wall.thickness, wall.triangles, nodes.triangle, weight)
    there = weights(found.place, wall.positions[wall.triangles[found.triangle]])
    thick = area * interpolate(wall.thickness, wall.triangles, found.triangle, there)
    count = len(mesh.triangles)
    elements = np.bincount(owner, thick, count) / areas(mesh.positions, mesh.triangles)
    return WallSurface(
        mesh.positions,
        mesh.triangles,
        conserve_volume(mesh.positions, mesh.triangles, nodal, elements),
        elements,
        interpolate(wall.reference, wall.triangles, nodes.triangle, weight),
        np.ones(len(mesh.positions), bool),
        wall.planes,
    )


def _check_size(size: float, mesh: Mesh, name: str) -> None:
    ratio = meshes.size(mesh.positions) / size
    if not 1 / _ALIKE <= ratio <= _ALIKE:
        problem = f"the mesh is {ratio:.3g} times as large as the part, which measures {size:.3g} m"
        many = "0.001 for millimetres" if ratio > 1 else "1 for metres, 0.001 for millimetres"
        raise InputError(problem, f"give its unit of length in m (--scale, {many})", "--onto", name)


def _no_overlap_message(wall: WallSurface, mesh: Mesh, reach: float) -> str:
    ends = [format_extent(positions.min(0), positions.max(0)) for positions in (mesh.positions, wall.positions)]
    boxes = f"mesh {ends[0]}, part {ends[1]}"
    return f"almost no part of the mesh lies within {1e3 * reach:.3g} mm of the part ({boxes})"


def _warn_of_coverage(coverage: Coverage, ratio: float, wall: WallSurface, reach: float, name: str) -> None:
    if ratio > 1 + _TWO_SIDED or ratio < 1 - _TWO_SIDED:
        problem = f"within the part, its area is {ratio:.3g} times the part's"
        less = "give a surface that follows the whole part: this one omits ribs, folds or a side"
        remedy = "give one side of the wall only, not both sides of a solid" if ratio > 1 else less
        raise InputError(problem, remedy, "--onto", name)
    if coverage.mesh < 1 - _MISSING_SHARE:
        cut_at = " ".join(f"{'xyz'[axis]}={level:g}" for axis, level in wall.planes.items())
        remedy = f"the part is cut: --mirror {cut_at} makes it whole; " if cut_at else ""
        near = f"all of it is within {1e3 * coverage.farthest:.3g} mm of it, but some is beyond its rim"
        far = f"its farthest place is {1e3 * coverage.farthest:.3g} mm away"
        where = near if coverage.farthest <= reach else far
        warn_of(
            f"{format_percent(1 - coverage.mesh, 3)} of the mesh's area does not lie on the formed part: {where}",
            f"{remedy}there it has the thickness of the nearest place, and does not count in the volume",
            key="--onto",
            value=name,
        )
    if abs(ratio - 1) > _AREA_DIFFERS:
        problem = f"where it lies on the part its area is {ratio:.4g} times the part's"
        remedy = f"the thickness was scaled by {coverage.scaled:.4g} to keep the volume; is it the same surface?"
        warn_of(problem, remedy, key="--onto", value=name)


# Meshes in the coordinates of a mold's own file, and the side of a closed solid that the sheet touched.

_SCENES = ("best.toml", "simulated.toml")  # in a folder of results; the first one that is there
_NEAR = 0.02  # of the part's size: as near as that a mesh follows it
_BETTER = 0.3  # by what share more of the part a mesh must follow it where the scene's pose is taken unasked
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
        motion = make_motion(**table.motion.model_dump())
        ended = previous_results.read_summary(folder).get("time")
        if not isinstance(ended, float | int) or not abs(ended) <= meshes.LARGEST:
            ended = document.model.solver.end_time
        shift = shift + motion.offset_at(ended)
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
        whole: True if a mesh that is no closed solid is returned unchanged.

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
