"""Five molds by a CAD kernel (Gmsh's OpenCASCADE), in millimetres, with their flange in the sheet's plane."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import meshio
import numpy as np

FORMS = ("open stl", "quads msh", "block stl", "pieces obj")
_WALL = 10.0  # mm of the block beyond the cavity's bottom


@dataclass(frozen=True)
class Part:
    """A mold, in millimetres, and the sheet that is drawn into it, in metres.

    Attributes:
        cavity: Makes the air in the mold, z > 0; gives the solids' tags.
        size: Sides of the block with a corner at the origin, or its radius about it [mm].
        depth: Depth of the cavity [mm].
        mesh_size: Size of the mold's triangles [mm].
        sheet: Lines of the scene file that say the shape; {size} is the element size.
        element_size: Element size of a uniform sheet [m]; twice that where it is refined.
        thickness: Thickness of the sheet [m].
        pressure: At the end [Pa].
        ramp: Duration of the pressure's rise [s].
        mirrors: Maps of initial places (n, 2) to where the wall must be the same.
    """

    cavity: Callable[[Any], list[int]]
    size: tuple[float, ...]
    depth: float
    mesh_size: float
    sheet: str
    element_size: float
    thickness: float
    pressure: float
    ramp: float
    mirrors: Sequence[Callable[[np.ndarray], np.ndarray]] = field(default=())


def _fuse(occ: Any, solids: list[int]) -> list[int]:
    made, _ = occ.fuse([(3, solids[0])], [(3, solid) for solid in solids[1:]])
    return [tag for _, tag in made]


def _cut(occ: Any, solids: list[int], tools: list[int]) -> list[int]:
    made, _ = occ.cut([(3, solid) for solid in solids], [(3, solid) for solid in tools])
    return [tag for _, tag in made]


def _pyramid(occ: Any, low: Sequence[float], high: Sequence[float], depth: float, draft: float) -> int:
    """Air over a rectangle of the flange whose walls lean by so many millimetres over the depth."""
    loops = []
    for inset, z in ((0.0, 0.0), (draft, depth)):
        (x0, y0), (x1, y1) = (low[0] + inset, low[1] + inset), (high[0] - inset, high[1] - inset)
        points = [occ.addPoint(x, y, z) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        lines = [occ.addLine(points[k], points[(k + 1) % 4]) for k in range(4)]
        loops.append(occ.addCurveLoop(lines))
    return next(tag for dim, tag in occ.addThruSections(loops, makeSolid=True, makeRuled=True) if dim == 3)


def _round_edges(occ: Any, solid: int, radius: float, *, above: float) -> list[int]:
    """The solid with the edges that lie at this z or beyond rounded."""
    occ.synchronize()
    edges = [tag for dim, tag in occ.getEntities(1) if occ.getBoundingBox(dim, tag)[5] > above]
    return [tag for dim, tag in occ.fillet([solid], edges, [radius]) if dim == 3]


def _ribbed_cup(occ: Any) -> list[int]:
    """Eight ribs stand in it; a ring under its rim is wider than its opening."""
    solids = _fuse(occ, [occ.addCone(0, 0, 0, 0, 0, 45, 40, 34), occ.addCylinder(0, 0, 4, 0, 0, 4, 42)])
    ribs = []
    for k in range(8):
        rib = occ.addBox(31, -1.5, 14, 20, 3, 40)
        occ.rotate([(3, rib)], 0, 0, 0, 0, 0, 1, np.pi * (2 * k + 1) / 8)
        ribs.append(rib)
    return _cut(occ, solids, ribs)


def _pockets(occ: Any) -> list[int]:
    """Three by two pockets of 50 by 50 mm."""
    found = []
    for x in (15, 75, 135):
        for y in (15, 75):
            found.append(_pyramid(occ, (x, y), (x + 50, y + 50), 20, 4))
    return found


def _tub(occ: Any) -> list[int]:
    """A bath, its bottom rounded."""
    return _round_edges(occ, _pyramid(occ, (100, 100), (1800, 700), 400, 60), 50.0, above=399.0)


def _plug(occ: Any) -> list[int]:
    """A plug whose top lies in the sheet's plane, in a tray with an open rim."""
    return _cut(occ, [_pyramid(occ, (20, 20), (180, 180), 35, 4)], [_pyramid(occ, (75, 75), (125, 125), 36, -8)])


def _bottle(occ: Any) -> list[int]:
    """Half a bottle along y with a handle beside it, round an island of the flange."""
    body, neck = occ.addCylinder(70, 20, 0, 0, 110, 0, 30), occ.addCylinder(70, 120, 0, 0, 60, 0, 12)
    arm = occ.addTorus(70, 100, 0, 40, 8)
    whole = _fuse(occ, [body, neck, arm])
    half, _ = occ.intersect([(3, tag) for tag in whole], [(3, occ.addBox(0, 0, 0, 140, 190, 60))])
    return [tag for dim, tag in half if dim == 3]


def _flip(axis: int, side: float) -> Callable[[np.ndarray], np.ndarray]:
    def mirror(place: np.ndarray) -> np.ndarray:
        mirrored = place.copy()
        mirrored[:, axis] = side - mirrored[:, axis]
        return mirrored

    return mirror


def _swap(place: np.ndarray) -> np.ndarray:
    return place[:, ::-1]


def _rectangle(a: float, b: float, symmetry: str) -> str:
    return f'shape = "rectangle"\nsize = [{a}, {b}]\nsymmetry = "{symmetry}"\nelement_size = {{size}}'


PARTS: dict[str, Part] = {
    "ribbed cup": Part(
        _ribbed_cup, (60.0,), 45.0, 4.0,
        'shape = "disc"\nradius = 0.06\nsymmetry = "quarter"\nelement_size = {size}',
        0.0022, 1e-3, 4e4, 0.2, (_swap,),
    ),
    "six pockets": Part(
        _pockets, (200.0, 140.0), 20.0, 6.0, _rectangle(0.2, 0.14, "none"),
        0.004, 1e-3, 3e4, 0.2, (_flip(0, 0.2), _flip(1, 0.14)),
    ),
    "tub": Part(
        _tub, (1900.0, 800.0), 400.0, 40.0, _rectangle(1.9, 0.8, "half"),
        0.03, 5e-3, 3e4, 2.0, (_flip(1, 0.8),),
    ),
    "plug": Part(
        _plug, (200.0, 200.0), 35.0, 8.0, _rectangle(0.2, 0.2, "quarter"),
        0.003, 1e-3, 3e4, 0.2, (_swap,),
    ),
    "bottle": Part(
        _bottle, (140.0, 190.0), 30.0, 4.0, _rectangle(0.14, 0.19, "none"),
        0.004, 1e-3, 3e4, 0.2, (_flip(0, 0.14),),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Surface:
    """A mesh in millimetres: its points (n, 3), and its faces (m, 3) or (m, 4) of points."""

    points: np.ndarray
    faces: list[np.ndarray]


def mold_mesh(part: Part, form: str) -> Surface:
    """The mold of a part in one of the forms, by the CAD kernel."""
    gmsh: Any = importlib.import_module("gmsh")  # in no list of what must be there: nothing else needs it
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        occ = gmsh.model.occ
        air = part.cavity(occ)
        bottom = part.depth + _WALL
        block = (
            occ.addCylinder(0, 0, 0, 0, 0, bottom, part.size[0])
            if len(part.size) == 1
            else occ.addBox(0, 0, 0, *part.size, bottom)
        )
        _cut(occ, [block], air)
        occ.synchronize()
        tags = [tag for _, tag in gmsh.model.getEntities(2)]
        meshed = _mesh_solid(gmsh, tags, part.mesh_size, form.startswith("quads"))
        if not form.startswith("block"):
            # The block's outside reaches beyond the cavity; the boxes that the kernel gives are too large to tell.
            tags = [tag for tag in tags if _lowest(meshed[tag]) < bottom - 0.5 * _WALL]
        if form.startswith("pieces"):
            finer = _mesh_solid(gmsh, tags, 0.7 * part.mesh_size, False)
            return _join([(meshed if k % 2 else finer)[tag] for k, tag in enumerate(tags)])
        return _join([meshed[tag] for tag in tags])
    finally:
        gmsh.finalize()


def _mesh_solid(gmsh: Any, tags: list[int], size: float, quads: bool) -> dict[int, Surface]:
    """Each face of the model meshed."""
    gmsh.model.mesh.clear()
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", 16)
    gmsh.option.setNumber("Mesh.RecombineAll", int(quads))
    gmsh.model.mesh.generate(2)
    numbers, places, _ = gmsh.model.mesh.getNodes()
    row = np.zeros(int(numbers.max()) + 1, int)
    row[numbers.astype(int)] = np.arange(len(numbers))
    points, found = places.reshape(-1, 3), {}
    for tag in tags:
        kinds, _, nodes = gmsh.model.mesh.getElements(2, tag)
        corners = {2: 3, 3: 4}
        faces = [row[n.astype(int)].reshape(-1, corners[k]) for k, n in zip(kinds, nodes, strict=True)]
        found[tag] = Surface(points, faces)
    return found


def _lowest(surface: Surface) -> float:
    return max(surface.points[corners][..., 2].max() for corners in surface.faces)


def _join(pieces: list[Surface]) -> Surface:
    """All of them in one file, nodes not shared between them where they do not share their points."""
    same = all(piece.points is pieces[0].points for piece in pieces)
    points = pieces[0].points if same else np.concatenate([piece.points for piece in pieces])
    begin = np.zeros(len(pieces), int) if same else np.cumsum([0, *[len(piece.points) for piece in pieces[:-1]]])
    faces = [corners + start for piece, start in zip(pieces, begin, strict=True) for corners in piece.faces]
    used, renumbered = np.unique(np.concatenate([corners.ravel() for corners in faces]), return_inverse=True)
    sizes = [corners.size for corners in faces]
    split = np.split(renumbered, np.cumsum(sizes)[:-1])
    return Surface(points[used], [part.reshape(corners.shape) for part, corners in zip(split, faces, strict=True)])


def write_surface(path: Path, surface: Surface) -> None:
    """In the format that the file's ending tells: binary STL, OBJ, MSH."""
    kinds = {3: "triangle", 4: "quad"}
    counts = sorted({corners.shape[1] for corners in surface.faces})
    cells: list[Any] = [(kinds[n], np.concatenate([f for f in surface.faces if f.shape[1] == n])) for n in counts]
    ones: Any = {"gmsh:physical": [np.ones(len(c), int) for _, c in cells]}
    mesh = meshio.Mesh(surface.points, cells, cell_data=ones | {"gmsh:geometrical": ones["gmsh:physical"]})
    if path.suffix == ".stl":
        meshio.write(path, meshio.Mesh(surface.points, cells), file_format="stl", binary=True)
    elif path.suffix == ".msh":
        meshio.write(path, mesh, file_format="gmsh22", binary=False)
    else:
        lines = ["# millimetres"] + [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in surface.points]
        lines += ["f " + " ".join(str(k + 1) for k in face) for corners in surface.faces for face in corners]
        path.write_text("\n".join(lines) + "\n")
