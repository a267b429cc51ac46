"""The 38 kinds of files that strangers have: bucks, scans, cups, crates, bottles, bowls and tubes, made anew.

A kind is a mesh in its own unit, in the format and with the faults of its kind: no shared vertices, mixed winding,
several shells. Lengths in this module are millimetres; `write` converts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

UNITS = {"mm": 1.0, "cm": 10.0, "inch": 25.4, "m": 1000.0}
"""Millimetres per unit."""


@dataclass(frozen=True)
class Kind:
    """One kind of file.

    Attributes:
        made: Makes the mesh [mm], at a fineness of 1 (as strangers have it) or less.
        unit: Unit of the file, a name in `UNITS`.
        suffix: Suffix of the file: "stl" is binary, "ascii.stl" text.
        damage: Function that damages the mesh before it is written.
    """

    made: Callable[[float], trimesh.Trimesh]
    unit: str = "mm"
    suffix: str = "stl"
    damage: Callable[[trimesh.Trimesh], trimesh.Trimesh] = lambda mesh: mesh

    def write(self, folder: Path, name: str, fine: float = 1.0) -> Path:
        """Writes the file into a folder; returns its path."""
        mesh = self.damage(self.made(fine))
        mesh = _mesh(mesh.vertices / UNITS[self.unit], mesh.faces)
        path = folder / f"{name.replace(' ', '-')}.{self.suffix}"
        text = "stl_ascii" if self.suffix == "ascii.stl" else self.suffix
        path.write_bytes(_bytes(mesh.export(file_type=text)))
        return path


def _bytes(exported: object) -> bytes:
    return exported if isinstance(exported, bytes) else str(exported).encode()


def _mesh(vertices: ArrayLike, faces: ArrayLike) -> trimesh.Trimesh:
    return trimesh.Trimesh(np.asarray(vertices, float), np.asarray(faces), process=False)


def _join(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    """Several shells in one mesh, not united."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return _mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def _merge(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh = _mesh(mesh.vertices, mesh.faces)
    mesh.merge_vertices(digits_vertex=6)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


def blocks(x: ArrayLike, y: ArrayLike, z: ArrayLike, solid: NDArray[np.bool_]) -> trimesh.Trimesh:
    """The surface of the solid cells (nx, ny, nz) between planes at x (nx + 1,), y and z."""
    planes = [np.asarray(along, float) for along in (x, y, z)]
    padded, quads = np.pad(solid, 1), []
    for axis in range(3):
        change = np.diff(padded.astype(int), axis=axis)
        for sign in (1, -1):
            cells = np.argwhere(change == sign)
            first, second = (axis + 1) % 3, (axis + 2) % 3
            corner = cells - 1
            corner[:, axis] += 1
            steps = np.zeros((4, 3), int)
            steps[1:3, first], steps[2:, second] = 1, 1
            quad = corner[:, None] + (steps if sign < 0 else steps[::-1])
            quads.append(np.stack([planes[k][quad[..., k]] for k in range(3)], axis=2))
    corners = np.concatenate(quads)
    number = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate([number + np.array(half) for half in ([0, 1, 2], [0, 2, 3])])
    return _merge(_mesh(corners.reshape(-1, 3), faces))


def box(low: Sequence[float], high: Sequence[float]) -> trimesh.Trimesh:
    """A box of 12 triangles."""
    x, y, z = ([a, b] for a, b in zip(low, high, strict=True))
    return blocks(x, y, z, np.ones((1, 1, 1), bool))


def turn_mesh(profile: ArrayLike, segments: int, share: float = 1.0) -> trimesh.Trimesh:
    """The surface of revolution of a line of (radius, z), or a share of it."""
    line = np.asarray(profile, float)
    steps = round(segments * share)
    angle = 2 * np.pi * share * np.arange(steps + 1) / steps
    points = np.stack([np.outer(np.cos(angle), line[:, 0]), np.outer(np.sin(angle), line[:, 0])], axis=2)
    points = np.dstack([points, np.broadcast_to(line[:, 1], points.shape[:2])])
    return _sheet(points)


def _sheet(points: Array) -> trimesh.Trimesh:
    """The triangles of a lattice of points (n, m, 3)."""
    number = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return _merge(_mesh(points.reshape(-1, 3), faces))


def tube_along(way: ArrayLike, radius: float, segments: int = 16) -> trimesh.Trimesh:
    """A closed round bar along points (n, 3): a handle."""
    line = np.asarray(way, float)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    side = np.cross(along, np.linalg.svd(line - line.mean(0))[2][2])
    side /= np.linalg.norm(side, axis=1)[:, None]
    other = np.cross(along, side)
    angle = 2 * np.pi * np.arange(segments + 1) / segments
    ring = radius * (np.cos(angle)[:, None, None] * side + np.sin(angle)[:, None, None] * other)
    points = line[:, None] + np.swapaxes(ring, 0, 1)
    ends = [np.broadcast_to(line[k], (1, segments + 1, 3)) for k in (0, -1)]
    return _sheet(np.concatenate([ends[0], points, ends[1]]))


def _arch(middle: Sequence[float], across: float, out: float, direction: Sequence[float], up: Sequence[float]) -> Array:
    """Half an ellipse (25, 3) from one foot to the other: `across` apart along `up`, `out` far along `direction`."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 25)[:, None]
    return np.asarray(middle) + out * np.cos(angle) * direction + 0.5 * across * np.sin(angle) * np.asarray(up)


def _count(fine: float, full: int, least: int = 12) -> int:
    return max(least, round(full * fine))


# Bucks.


def _frustum(low: Sequence[float], high: Sequence[float], height: float, chamfer: float = 0.0) -> trimesh.Trimesh:
    """A buck on z = 0, of half sides `low` at its base and `high` at its top, whose top edge may be cut."""
    rings = [(low, 0.0), (high, height)]
    if chamfer:
        share = 1 - chamfer / height
        below = [a + share * (b - a) for a, b in zip(low, high, strict=True)]
        rings = [(low, 0.0), (below, height - chamfer), ([b - chamfer for b in high], height)]
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    lines = [np.column_stack([corner * sides, np.full(5, z)]) for sides, z in rings]
    ends = [np.tile([[0.0, 0.0, z]], (5, 1)) for z in (0.0, height)]
    return _sheet(np.stack([ends[0], *lines, ends[1]])[:, ::-1])


def _divide(mesh: trimesh.Trimesh, size: float) -> trimesh.Trimesh:
    """The mesh in triangles of about a size."""
    finer = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, size, max_iter=30)
    return _merge(_mesh(finer[0], finer[1]))


def _noisy_dome(fine: float, full: int, closed: bool = False) -> trimesh.Trimesh:
    """A scan of a face, 160 by 220 by 90: a dome with a nose and hollows of eyes, and noise."""
    rows = _count(fine, full, 40)
    s, t = np.meshgrid(np.linspace(0, 1, rows), 2 * np.pi * np.arange(rows + 1) / rows, indexing="ij")
    x, y = 80 * s * np.cos(t), 110 * s * np.sin(t)
    z = 90 * np.sqrt(np.clip(1 - 0.95 * s**2, 0, None))
    z += 22 * np.exp(-((x / 14) ** 2 + ((y + 5) / 28) ** 2))
    for side in (32, -32):
        z -= 7 * np.exp(-(((x - side) / 16) ** 2 + ((y - 25) / 10) ** 2))
    noise = np.random.default_rng(0).normal(0.0, 0.15, z.shape)
    noise[0], noise[:, -1] = 0.0, noise[:, 0]
    points = np.stack([x, y, z + noise], axis=2)
    if closed:
        foot = points[-1:] * [1, 1, 0]
        points = np.concatenate([points, foot, np.zeros_like(foot)])
    return _sheet(points)


def _limb(fine: float, round_: float = 0.55) -> trimesh.Trimesh:
    """A scan of a lower leg, lying: more than half of a tube of changing radius, open all round, with noise."""
    rows = _count(fine, 160, 40)
    along = np.linspace(0, 1, rows)
    radius = 45 + 14 * np.sin(np.pi * along) - 12 * along
    angle = np.linspace(-np.pi * round_, np.pi * round_, rows)
    noise = np.random.default_rng(1).normal(0.0, 0.1, (rows, rows))
    r = radius[:, None] + noise
    return _sheet(np.stack([300 * along[:, None] + 0 * r, r * np.sin(angle), r * np.cos(angle)], axis=2))


def _knee(fine: float) -> trimesh.Trimesh:
    """A scan of a knee, bent: a dome on a half tube, open below."""
    rows = _count(fine, 120, 40)
    x, y = np.meshgrid(np.linspace(-110, 110, rows), np.linspace(-1, 1, rows), indexing="ij")
    half = 58 + 8 * np.cos(np.pi * x / 220)
    z = half * np.sqrt(1 - 0.97 * y**2) + 26 * np.exp(-((x / 42) ** 2) - (y / 0.6) ** 2)
    noise = np.random.default_rng(2).normal(0.0, 0.1, z.shape)
    return _sheet(np.stack([x, half * y, z + noise], axis=2))


def _canopy(fine: float) -> trimesh.Trimesh:
    """An open shell like a canopy of a glider: 700 long, 240 wide, 160 high."""
    rows = _count(fine, 100, 40)
    s, t = np.meshgrid(np.linspace(0, 1, rows), 2 * np.pi * np.arange(rows + 1) / rows, indexing="ij")
    x, y = 350 * s * np.cos(t), 120 * s * np.sin(t)
    z = 160 * (1 - s**2) ** 0.75 * (1 - 0.25 * x / 350)
    return _sheet(np.stack([x, y, z], axis=2))


def _on_platen(buck: trimesh.Trimesh, half: float, thick: float = 10.0) -> trimesh.Trimesh:
    return _join(box([-half, -half, -thick], [half, half, 0.0]), buck)


def _cone(segments: int) -> trimesh.Trimesh:
    return turn_mesh([[0, 0], [40, 0], [5, 55], [0, 55]], segments)


def _stepped_cup(fine: float) -> trimesh.Trimesh:
    return turn_mesh([[0, 0], [60, 0], [58, 30], [35, 30], [33, 60], [0, 60]], _count(fine, 96, 24))


# Cups, mugs, bowls.


def _cup(fine: float, *, wall: float = 2.5, foot: float = 18.0, rim: float = 25.0, height: float = 60.0):
    """A cup with a wall, upright on z = 0, open at its height."""
    outside = [[0, 0], [foot, 0], [rim, height]]
    inside = [[rim - wall, height], [foot - wall, wall * 2], [0, wall * 2]]
    return turn_mesh(outside + inside, _count(fine, 96, 24))


def _mug(fine: float) -> trimesh.Trimesh:
    handle = tube_along(_arch([24, 0, 32], 34, 22, [1, 0, 0], [0, 0, 1]), 3.5)
    return _join(_cup(fine, foot=25.0), handle)


def _two_ears(fine: float) -> trimesh.Trimesh:
    bowl = _bowl(fine)
    ears = [tube_along(_arch([side * 52, 0, 34], 44, 26, [side, 0, 0], [0, 1, 0]), 4.0) for side in (1.0, -1.0)]
    return _join(bowl, *ears)


def _bowl(fine: float, wall: float = 3.0) -> trimesh.Trimesh:
    """A round bowl with a wall, 120 across, 45 deep."""
    angle = np.linspace(0, np.pi / 2, _count(fine, 24, 10))
    outside = np.stack([60 * np.sin(angle), 45 * (1 - np.cos(angle))], axis=1)
    inside = np.stack([(60 - wall) * np.sin(angle), 45 - (45 - wall) * np.cos(angle)], axis=1)[::-1]
    return turn_mesh(np.concatenate([outside, inside]), _count(fine, 96, 24))


def _shell_bowl(fine: float) -> trimesh.Trimesh:
    angle = np.linspace(0, np.pi / 2, _count(fine, 40, 10))
    return turn_mesh(np.stack([200 * np.sin(angle), 120 * (1 - np.cos(angle))], axis=1), _count(fine, 160, 24))


def _rolled_lip(fine: float) -> trimesh.Trimesh:
    """A thin cup whose rim is rolled outwards and down: a beaker."""
    roll = np.linspace(np.pi, -np.pi / 4, 14)
    lip = np.stack([31 + 3 * np.cos(roll), 66 + 3 * np.sin(roll)], axis=1)
    return turn_mesh(np.concatenate([[[0, 0], [20, 0]], lip]), _count(fine, 96, 24))


def _skirted_cup(fine: float) -> trimesh.Trimesh:
    """A cup in a skirt that hangs from its rim nearly to its foot."""
    line = [[0, 8], [22, 8], [30, 60], [36, 60], [46, 4], [43, 4], [34, 57], [33, 57], [25, 5], [0, 5]]
    return turn_mesh(line, _count(fine, 96, 24))


def _slotted_cup(fine: float) -> trimesh.Trimesh:
    """A cup with eight upright slots in its wall, between its foot and its rim."""
    segments = 96
    sector = np.arange(segments) % 12
    angle = 2 * np.pi * np.arange(segments + 1) / segments
    levels, radii = np.array([0.0, 5.0, 15.0, 45.0, 60.0]), np.array([27.0, 30.0])
    # Cells in radius, angle and height; the foot is a disc below.
    solid = np.ones((2, segments, 4), bool)
    solid[0, :, 1:] = False
    solid[1][((sector >= 4) & (sector < 7))[:, None] & (np.arange(4) == 2)] = False
    return _polar([0.0, *radii], angle, levels, solid)


def _polar(radii: ArrayLike, angle: Array, levels: ArrayLike, solid: NDArray[np.bool_]) -> trimesh.Trimesh:
    """The surface of solid cells (nr, n, nz) in radius, angle and height."""
    number = np.arange(len(angle), dtype=float)
    # Three turns side by side, of which the outer two only close the middle one.
    mesh = blocks(np.asarray(radii, float), number, np.asarray(levels, float), solid)
    ends = np.isin(mesh.vertices[mesh.faces][..., 1], [0, len(angle) - 1])
    flat = (np.ptp(mesh.vertices[mesh.faces][..., 1], axis=1) == 0) & ends.all(1)
    radius, turn, z = mesh.vertices.T
    at = np.interp(turn, number, angle)
    return _merge(_mesh(np.stack([radius * np.cos(at), radius * np.sin(at), z], axis=1), mesh.faces[~flat]))


# Crates and trays.


def _wall_mesh(
    half: Sequence[float], height: float, wall: float, holes: Sequence[tuple[int, float, float, float, float]]
):
    """A box with walls, open at the top, with holes through pairs of walls.

    Args:
        half: Half its outer sides.
        height: Outside.
        wall: Thickness of walls and bottom.
        holes: Axis across the walls (0 or 1), or 2 through the bottom; range along the wall; range of height, or of y.
    """
    x, y, z = (_planes(-half[0], half[0], wall), _planes(-half[1], half[1], wall), {0.0, wall, height})
    planes = [x, y, z]
    for axis, begin, end, low, high in holes:
        along, up = {0: (1, 2), 1: (0, 2), 2: (0, 1)}[axis]
        planes[along] |= {begin, end}
        planes[up] |= {low, high}
    lines = [np.array(sorted(some)) for some in planes]
    middle = np.stack(np.meshgrid(*(0.5 * (line[1:] + line[:-1]) for line in lines), indexing="ij"), axis=-1)
    inner = (np.abs(middle[..., 0]) < half[0] - wall) & (np.abs(middle[..., 1]) < half[1] - wall)
    solid = ~(inner & (middle[..., 2] > wall))
    for axis, begin, end, low, high in holes:
        along, up = {0: (1, 2), 1: (0, 2), 2: (0, 1)}[axis]
        through = (middle[..., along] > begin) & (middle[..., along] < end)
        through &= (middle[..., up] > low) & (middle[..., up] < high)
        solid &= ~(through & (middle[..., 2] < wall if axis == 2 else middle[..., 2] > wall))
    return blocks(lines[0], lines[1], lines[2], solid)


def _planes(low: float, high: float, wall: float) -> set[float]:
    return {low, low + wall, high - wall, high}


def _crate(fine: float) -> trimesh.Trimesh:
    long = [(1, x, x + 22, z, z + 22) for x in (-130, -100, -70, -40, -10, 20, 50, 80, 110) for z in (20, 55)]
    short = [(0, y, y + 22, z, z + 22) for y in (-85, -55, -25, 5, 35, 65) for z in (20, 55)]
    return _wall_mesh([150, 100], 110, 6, [*long, *short])


def _basket(fine: float) -> trimesh.Trimesh:
    slots = [(1, x, x + 6, 15, 65) for x in range(-84, 80, 14)] + [(0, y, y + 6, 15, 65) for y in range(-56, 50, 14)]
    floor = [(2, x, x + 6, -50, 50) for x in range(-84, 80, 14)]
    return _wall_mesh([100, 70], 80, 4, [*slots, *floor])


def _holed_tray(fine: float) -> trimesh.Trimesh:
    return _wall_mesh([100, 60], 40, 5, [(0, -20, 20, 22, 34)])


def _flanged_tray(fine: float) -> trimesh.Trimesh:
    """An open shell: a tray with a flange and leaning walls."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    rings = [([120, 90], 35.0), ([100, 70], 35.0), ([90, 60], 0.0), ([0, 0], 0.0)]
    return _divide(_sheet(np.stack([np.column_stack([corner * s, np.full(5, z)]) for s, z in rings])), 12.0 / fine)


def _pockets(fine: float) -> trimesh.Trimesh:
    """A solid block with six pockets."""
    x, y = np.array([0, 10, 60, 70, 120, 130, 180, 190.0]), np.array([0, 10, 60, 70, 120, 130.0])
    solid = np.ones((7, 5, 2), bool)
    solid[1::2, 1::2, 1] = False
    return blocks(x, y, [0.0, 8.0, 38.0], solid)


# Bottles, cans, tubes.

_BOTTLE = [[0, 0], [30, 0], [32, 6], [32, 130], [14, 165], [12, 172], [12, 200]]


def _bottle(fine: float, hollow: bool) -> trimesh.Trimesh:
    inside = [[r - 1.5, max(z, 2.0)] for r, z in _BOTTLE[1:]][::-1]
    line = [*_BOTTLE, *([*inside, [0, 2]] if hollow else [[0, 200]])]
    return turn_mesh(line, _count(fine, 96, 24))


def _jerry_can(fine: float) -> trimesh.Trimesh:
    """A closed hollow can with a neck: two closed shells, one in the other."""
    solid = np.ones((4, 4, 4), bool)
    x, y, z = ([-80, -77, 77, 80.0], [-45, -42, 42, 45.0], [0, 3, 197, 200.0])
    solid = np.ones((3, 3, 3), bool)
    solid[1, 1, 1] = False
    neck = turn_mesh([[0, 199], [18, 199], [18, 230], [0, 230]], _count(fine, 48, 24))
    neck.apply_translation([50, 0, 0])
    return _join(blocks(x, y, z, solid), neck)


def _tube(fine: float) -> trimesh.Trimesh:
    return turn_mesh([[28, 0], [30, 0], [30, 120], [28, 120], [28, 0]], _count(fine, 96, 24))


# Faults of files.


def _unshare(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Each triangle with vertices of its own."""
    return _mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


def _mix_orientation(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A third of the triangles turned over."""
    faces = mesh.faces.copy()
    over = np.random.default_rng(3).random(len(faces)) < 1 / 3
    faces[over] = faces[over][:, ::-1]
    return _mesh(mesh.vertices, faces)


def _several(fine: float) -> trimesh.Trimesh:
    """A buck of three shells that pass into each other."""
    knob = turn_mesh([[0, 20], [12, 20], [9, 50], [0, 50]], _count(fine, 48, 24))
    other = knob.copy()
    knob.apply_translation([30, 0, 0])
    other.apply_translation([-30, 10, 0])
    return _join(_frustum([70, 45], [64, 40], 35.0), knob, other)


KINDS: dict[str, Kind] = {
    "box buck": Kind(lambda f: _divide(box([-60, -40, 0], [60, 40, 30]), 25.0 / f)),
    "drafted buck": Kind(lambda f: _divide(_frustum([60, 40], [54, 34], 40.0), 25.0 / f), suffix="ascii.stl"),
    "chamfered buck": Kind(lambda f: _divide(_frustum([60, 40], [60, 40], 40.0, 5.0), 25.0 / f)),
    "cylinder buck": Kind(lambda f: turn_mesh([[0, 0], [40, 0], [40, 50], [0, 50]], _count(f, 96, 24))),
    "cone buck": Kind(lambda f: _cone(_count(f, 96, 24)), suffix="obj"),
    "dome buck": Kind(
        lambda f: turn_mesh([[0, 0], *_quarter(50.0, _count(f, 60, 12))], _count(f, 160, 24)), suffix="ply"
    ),
    "stepped buck": Kind(_stepped_cup, unit="inch"),
    "box on a platen": Kind(lambda f: _divide(_on_platen(box([-40, -30, 0], [40, 30, 35]), 90.0), 40.0 / f)),
    "cone on a platen": Kind(lambda f: _on_platen(_cone(_count(f, 96, 24)), 90.0)),
    "buck of unshared vertices": Kind(
        lambda f: _divide(_frustum([60, 40], [52, 32], 45.0), 20.0 / f), suffix="obj", damage=_unshare
    ),
    "buck of mixed winding": Kind(
        lambda f: _divide(_frustum([60, 40], [52, 32], 45.0), 20.0 / f), suffix="ply", damage=_mix_orientation
    ),
    "buck of several shells": Kind(_several),
    "buck in metres": Kind(lambda f: _divide(_frustum([300, 200], [280, 180], 150.0), 80.0 / f), unit="m"),
    "face": Kind(lambda f: _noisy_dome(f, 100)),
    "fine face": Kind(lambda f: _noisy_dome(f, 200), suffix="ply"),
    "face with a flat back": Kind(lambda f: _noisy_dome(f, 80, closed=True), suffix="obj"),
    "knee": Kind(_knee, unit="cm", suffix="ply"),
    "limb": Kind(_limb),
    "canopy": Kind(_canopy, unit="m"),
    "cup": Kind(_cup),
    "mug": Kind(_mug),
    "mug in inches": Kind(_mug, unit="inch", suffix="obj"),
    "bowl with two ears": Kind(_two_ears),
    "cup with a rolled lip": Kind(_rolled_lip),
    "cup with a skirt": Kind(_skirted_cup),
    "cup with slots": Kind(_slotted_cup),
    "turned cup of slivers": Kind(lambda f: _slivers(_count(f, 800, 200))),
    "bowl": Kind(_bowl, unit="cm"),
    "open bowl in metres": Kind(_shell_bowl, unit="m", suffix="ply"),
    "crate": Kind(_crate),
    "basket": Kind(_basket),
    "tray with holes in its walls": Kind(_holed_tray, suffix="ascii.stl"),
    "tray with a flange": Kind(_flanged_tray, damage=_mix_orientation, suffix="ply"),
    "six pockets": Kind(_pockets, suffix="obj"),
    "solid bottle": Kind(lambda f: _bottle(f, False)),
    "hollow bottle": Kind(lambda f: _bottle(f, True)),
    "jerry can": Kind(_jerry_can),
    "tube": Kind(_tube),
}
"""By name."""


def _quarter(radius: float, steps: int) -> list[list[float]]:
    angle = np.linspace(0, np.pi / 2, steps)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).tolist()


def _slivers(segments: int) -> trimesh.Trimesh:
    """A cup as turned by CAD: triangles as long as its wall, 26 rows of them."""
    corner = np.linspace(0, np.pi / 2, 12)
    inside = np.stack([20 + 8 * np.sin(corner), 13 - 8 * np.cos(corner)], axis=1)[::1]
    line = [[0, 0], [31, 0], [34, 60], [32, 60], *inside[::-1].tolist(), [0, 5]]
    return turn_mesh(line, segments)
