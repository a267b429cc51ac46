"""Contents that the page draws, packed into text: meshes, parts, quantities and their colors, the mold."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.io import previous_results
from jaxform.io.report.stored_results import Results, StoredPart
from jaxform.io.surfaces import color_range, counted_elements
from jaxform.mesh.meshes import Mesh

if TYPE_CHECKING:
    from jaxform.tools.mold import Motion

Array = NDArray[np.float64]

# Arrays and facts packed into text that a browser unpacks: 16 bits a number, differences, deflate, base64.
#
# The layout, which `unpack.js` reads: after inflating, the length of the header (four bytes, little-endian), the header
# as JSON, then the arrays one after the other. Of every column the more significant bytes come first, then the others:
# those are nearly all zero, and deflate leaves hardly anything of them.

NOTHING = 65535
"""Code of a value that is no number."""
_MANY, _FEW = NOTHING - 1, 4095
_CELLS = 1023  # along a side of space, between which places are ordered
_LEVEL = 6  # of deflate: more takes twice the time for a hundredth


class Parcel:
    """Arrays that are packed together, and their description.

    Attributes:
        described: Layout of each array for unpacking, by name.
    """

    def __init__(self) -> None:
        """Create an empty parcel."""
        self.described: dict[str, dict[str, Any]] = {}
        self._bytes: list[bytes] = []
        self._size = 0

    def add(self, name: str, values: NDArray[Any], *, relative: bool = False, coarse: bool = False) -> None:
        """Packs numbers (n,) or (n, k), to a 65534th of the range of each column.

        Args:
            name: Name of the array.
            values: The numbers; those that are not finite come out as NaN.
            relative: All are positive, and the error is the same part of each instead.
            coarse: To a 4095th instead, which takes half the space.
        """
        columns = np.atleast_2d(np.asarray(values, np.float64).T)
        with np.errstate(all="ignore"):
            columns = np.log(columns) if relative else columns
        codes, lows, steps = zip(*(_quantise(column, _FEW if coarse else _MANY) for column in columns), strict=True)
        coding = "relative" if relative else "linear"
        self._append(name, [_differences(column) for column in codes], 2, coding, low=list(lows), step=list(steps))

    def add_triangles(self, name: str, triangles: NDArray[Any]) -> None:
        """Packs triangles (n, 3) of nodes that are numbered in the order in which they first occur."""
        corners = np.asarray(triangles, np.int64).ravel()
        newest = np.maximum.accumulate(np.concatenate([[-1], corners]))[:-1]
        self._append(name, [newest + 1 - corners], 3, "index")

    def text(self, facts: Mapping[str, Any]) -> str:
        """All in base64, with facts (plain numbers, words, lists and tables) in the header."""
        described = _valid({**facts, "arrays": self.described})
        header = json.dumps(described, separators=(",", ":"), allow_nan=False).encode()
        content = b"".join([len(header).to_bytes(4, "little"), header, *self._bytes])
        return base64.b64encode(zlib.compress(content, _LEVEL)).decode("ascii")

    def _append(self, name: str, columns: list[NDArray[Any]], width: int, coding: str, **more: Any) -> None:
        """Adds columns (n,) of numbers of so many bytes, byte by byte."""
        planes = [(column >> 8 * byte) & 255 for column in columns for byte in reversed(range(width))]
        content = np.concatenate(planes).astype(np.uint8).tobytes()
        count = len(columns[0])
        self.described[name] = {"at": self._size, "count": count, "columns": len(columns), "coding": coding, **more}
        self._bytes.append(content)
        self._size += len(content)


def by_first_use(triangles: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles (n, 3) with nodes numbered as they first occur, and which node each of these was (m,)."""
    corners = np.asarray(triangles, np.int64).ravel()
    first = np.full(corners.max(initial=-1) + 1, len(corners))
    np.minimum.at(first, corners, np.arange(len(corners)))
    nodes = np.argsort(first, kind="stable")[: np.count_nonzero(first < len(corners))]
    number = np.empty(len(first), np.int64)
    number[nodes] = np.arange(len(nodes))
    return number[corners].reshape(-1, 3), nodes


def spatial_order(places: Array) -> NDArray[np.int64]:
    """An order (n,) of places (n, 3) in which neighbours are near each other, so that their differences are small."""
    low, size = places.min(0), float(np.ptp(places, axis=0).max()) or 1.0
    cells = ((places - low) / size * _CELLS).astype(np.int64)
    # Morton's curve: the bits of the three coordinates by turns.
    key = np.zeros(len(places), np.int64)
    for bit in range(_CELLS.bit_length()):
        for axis in range(3):
            key |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _quantise(values: Array, most: int) -> tuple[NDArray[np.int64], float, float]:
    """Codes (n,) from 0 to the most, the value of code 0 and the difference of neighbours."""
    known = np.isfinite(values)
    low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
    step = (high - low) / most
    codes = np.full(len(values), NOTHING, np.int64)
    codes[known] = np.rint((values[known] - low) / (step or 1.0)).astype(np.int64)
    return codes, low, step


def _valid(value: Any) -> Any:
    """A copy with null for numbers that are not finite, which JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _valid(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_valid(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _differences(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Differences (n,) to the code before, around 65536, those of either sign by turns: 0, -1, 1, -2 are 0, 1, 2, 3."""
    change = np.diff(codes, prepend=0).astype(np.int16).astype(np.int64)
    return ((change << 1) ^ (change >> 15)) & 65535


_MOST_WALLS = 60_000  # triangles of a mold; a finer one is drawn more roughly
_FINEST = 2048  # cells along a mold that is drawn more roughly, at first


class Quantity(NamedTuple):
    """A quantity that colours show: `factor` times the value in the files."""

    key: str
    label: str
    unit: str = ""
    factor: float = 1.0
    relative: bool = False


_ELEMENT_QUANTITIES = (
    Quantity("thickness", "wall thickness", "mm", 1e3, relative=True),
    Quantity("stretch_1", "larger stretch", relative=True),
    Quantity("stretch_2", "smaller stretch", relative=True),
    Quantity("level", "refinement level"),
)
_AREA_STRETCH = Quantity("area_stretch", "area stretch")
_NODAL_QUANTITIES = (
    Quantity("contact_time", "time of contact", "s"),
    Quantity("initial_thickness", "initial thickness", "mm", 1e3),
    Quantity("slip_distance", "slip distance", "mm", 1e3),
    Quantity("temperature", "temperature of the sheet", "°C"),
)
_TOOL = Quantity("tool", "tool in contact")
_ALWAYS = ("thickness", "stretch_1", "stretch_2", "contact_time")  # others are shown where they vary


def pack_parts(results: Results, parcel: Parcel) -> dict[str, Any]:
    """Packs meshes, parts and mold; returns their description for the page, as plain numbers and words."""
    search = results.start is not None
    end = float(results.summary.get("time") or 0.0)
    names = tool_names(results)
    parts = _Parts(parcel, [results.motion, *(motion for _, _, motion in results.tools)], end, bool(names))
    parts.add(results.part, "best design" if search else "end", end)
    if results.start is not None:
        parts.add(results.start, "start of the search", end)
    for time, part in results.frames:
        parts.add(part, "frame", time, coarse=True)
    return {
        "parts": parts.described,
        "search": search,
        "end": end,
        "quantities": [
            *_quantities([part for part in (results.part, results.start) if part is not None]),
            *([_of_tools(names)] if names else []),
        ],
        "symmetry": symmetry_of(results),
        "hangs": _hangs(results.part, results.motion is not None),
        "mold": None if results.mold is None else _pack_mold(results.mold, symmetry_of(results), parcel),
        "tools": [
            {"name": name} | _pack_mold(mesh, symmetry_of(results), parcel, f"tool{number}")
            for number, (name, mesh, _) in enumerate(results.tools)
        ],
    }


def tool_names(results: Results) -> list[str]:
    """Names of the mold and the tools, by their numbers, where there are tools that elements can be coloured by."""
    names = [str(tool["name"]) for tool in results.summary.get("tools", [])]
    return names if results.tools and "tool" in results.part.nodal else []


def _of_tools(names: list[str]) -> dict[str, Any]:
    """The quantity that has a colour for each tool."""
    return _TOOL._asdict() | {"low": 0.0, "high": max(len(names) - 1.0, 1.0), "of": "elements", "names": names}


def symmetry_of(results: Results) -> dict[str, float]:
    """Place [m] of the planes about which the modelled part is symmetric, by the name of their axis."""
    return {"xyz"[axis]: level for axis, level in previous_results.symmetry_planes(results.summary).items()}


class _Parts:
    """Parts that are packed one after the other; those with the same mesh share it."""

    def __init__(self, parcel: Parcel, motions: Sequence[Motion | None], end: float, tools: bool) -> None:
        self.described: list[dict[str, Any]] = []
        self._tools = tools
        self._motions, self._end = motions, end
        self._parcel = parcel
        self._meshes: list[tuple[StoredPart, NDArray[np.int64]]] = []

    def add(self, part: StoredPart, label: str, time: float, coarse: bool = False) -> None:
        """Packs a part, coarsely if it is a frame: then without what it has in common with the last part."""
        if coarse:
            part = self._reorder_elements(part)
        mesh = self._mesh(part)
        nodes, prefix = self._meshes[mesh][1], f"part{len(self.described)}"
        nodal = {name: values[nodes] for name, values in part.nodal.items() if name not in ("thickness", "tool")}
        if coarse and mesh == 0:
            # Only the positions of the nodes are new: contact follows from the final times of contact.
            nodal = {}
        if "contact_time" in nodal:
            nodal["contact_time"] = np.where(nodal["contact_time"] < 0, np.nan, nodal["contact_time"])
        self._parcel.add(f"{prefix}.positions", part.positions[nodes], coarse=coarse)
        for quantity in _ELEMENT_QUANTITIES:
            if quantity.key != "level":
                name = f"{prefix}.{quantity.key}"
                values = part.cells[quantity.key]
                if quantity.key == "thickness" and part.part_mask is not None:
                    values = np.where(part.part_mask != 0, values, np.nan)  # drawn in grey
                self._parcel.add(name, values, relative=quantity.relative, coarse=coarse)
        for name, values in nodal.items():
            self._parcel.add(f"{prefix}.{name}", values, coarse=coarse)
        if self._tools:
            self._parcel.add(f"{prefix}.tool", part.touched_tools)  # of few values, which take little space
        mold, *tools = [self._offset(motion, time) for motion in self._motions]
        self.described.append({"label": label, "time": time, "mesh": mesh, "mold": mold, "tools": tools})

    def _offset(self, motion: Motion | None, time: float) -> list[float]:
        """Displacement of a mold or tool (3,) [m] at a time [s], relative to its final position."""
        if motion is None:
            return [0.0, 0.0, 0.0]
        there, last = motion.offset_at([time, self._end])
        return (there - last).tolist()

    def _reorder_elements(self, part: StoredPart) -> StoredPart:
        """The part with its elements in an order that takes little space, unless its mesh is already stored."""
        if any(_same_mesh(known, part) for known, _ in self._meshes):
            return part
        order = spatial_order(part.reference[part.triangles].mean(1))
        cells = {name: values[order] for name, values in part.cells.items()}
        return part._replace(triangles=part.triangles[order], cells=cells)

    def _mesh(self, part: StoredPart) -> int:
        """The number of the part's mesh, which is packed where it is a new one."""
        for number, (known, _) in enumerate(self._meshes):
            if _same_mesh(known, part):
                return number
        triangles, nodes = by_first_use(part.triangles)
        self._meshes.append((part, nodes))
        number = len(self._meshes) - 1
        self._parcel.add_triangles(f"mesh{number}.triangles", triangles)
        self._parcel.add(f"mesh{number}.reference", part.reference[nodes])
        self._parcel.add(f"mesh{number}.level", part.cells["level"])
        return number


def _same_mesh(one: StoredPart, other: StoredPart) -> bool:
    return np.array_equal(one.triangles, other.triangles) and np.array_equal(one.reference, other.reference)


def _quantities(parts: list[StoredPart]) -> list[dict[str, Any]]:
    """Quantities that the parts can be coloured by, and the ranges of the colours, which they share."""
    areas, formed = zip(*(formed_element_areas(part) for part in parts), strict=True)
    known = {quantity.key for quantity in _NODAL_QUANTITIES} | {"thickness"}
    known |= {"tool"}  # its number is none that has a mean
    others = [Quantity(name, name.replace("_", " ")) for name in parts[0].nodal if name not in known]
    found = []
    for of, quantities in (("elements", (*_ELEMENT_QUANTITIES, _AREA_STRETCH)), ("nodes", _NODAL_QUANTITIES)):
        for quantity in (*quantities, *(others if of == "nodes" else [])):
            values = [_values(part, quantity.key, of)[chosen] for part, chosen in zip(parts, formed, strict=True)]
            joined, area = np.concatenate(values), np.concatenate(areas)
            kept = np.isfinite(joined)
            if not kept.any() or (quantity.key not in _ALWAYS and np.ptp(joined[kept]) == 0.0):
                continue
            most = {} if quantity.key == "thickness" else {"most": 1.0}
            low, high = color_range(joined[kept], area[kept], **most)
            shown = {"low": quantity.factor * low, "high": quantity.factor * high, "of": of}
            found.append(quantity._asdict() | shown)
    return found


def _values(part: StoredPart, key: str, of: str) -> Array:
    """Values at the elements (n_element,): the mean of nodal values, and the last of contact times."""
    if key == "area_stretch":
        return part.cells["stretch_1"] * part.cells["stretch_2"]
    if of == "elements":
        return part.cells[key]
    if key not in part.nodal:
        return np.full(len(part.triangles), np.nan)
    corners = part.nodal[key][part.triangles]
    if key == "contact_time":
        last = corners.max(1)
        return np.where((corners < 0).any(1) | (last <= 0), np.nan, last)
    return corners.mean(1)


def formed_element_areas(part: StoredPart) -> tuple[Array, NDArray[np.bool_]]:
    """Areas (n,) [m^2] of the elements that were formed, and which of all these are."""
    formed = counted_elements(part.reference, part.positions, part.triangles, part.part_mask)
    a, b, c = np.moveaxis(part.positions[part.triangles[formed]], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1), formed


def _hangs(part: StoredPart, moved: bool) -> bool:
    """True if the part is drawn with z down: for a view into a sheet that rose from a plane, or onto a buck.

    A buck moves, and pushes the sheet in the direction of its head.
    """
    rise = part.positions[:, 2] - part.reference[:, 2]
    flat = np.ptp(part.reference[:, 2]) <= 1e-6 * np.ptp(part.reference, axis=0).max()
    return bool(flat and (rise.mean() < 0 if moved else rise.mean() > 0))


def _pack_mold(mold: Mesh, symmetry: Mapping[str, float], parcel: Parcel, name: str = "mold") -> dict[str, Any]:
    """Packs the mold or a tool; returns whether it ends at a symmetry plane, so that its images are wanted."""
    vertices, triangles = _coarsen(mold.positions, mold.triangles)
    triangles, kept = by_first_use(triangles)
    parcel.add_triangles(f"{name}.triangles", triangles)
    parcel.add(f"{name}.positions", vertices[kept])
    tolerance = 1e-6 * float(np.ptp(mold.positions, axis=0).max())
    crosses = [
        (mold.positions[:, k] < symmetry["xyz"[k]] - tolerance).any()
        and (mold.positions[:, k] > symmetry["xyz"[k]] + tolerance).any()
        for k in range(3)
        if "xyz"[k] in symmetry
    ]
    return {"mirrored": not all(crosses), "rough": len(triangles) < len(mold.triangles)}


def _coarsen(vertices: Array, triangles: NDArray[np.int32]) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (n, 3) and triangles (m, 3) of a mold with few enough triangles: those in a cell of space become one."""
    cells, low, size = _FINEST, vertices.min(0), float(np.ptp(vertices, axis=0).max()) or 1.0
    while len(triangles) > _MOST_WALLS and cells > 1:
        place = np.floor((vertices - low) / size * cells).astype(np.int64)
        first, owner = np.unique(place @ [1, 4 * _FINEST, 16 * _FINEST**2], return_index=True, return_inverse=True)[1:]
        joined = owner.reshape(-1)[triangles]
        whole = (joined != np.roll(joined, 1, axis=1)).all(1)
        vertices, triangles = vertices[first], joined[whole].astype(np.int32)
        cells //= 2
    return vertices, triangles
