"""Files as strangers have them, through `jaxform new` and `jaxform simulate`: what is refused, what is filled.

`python -m benchmarks.strangers.files [--few] [--coarse TIMES] [--fine SHARE] [KIND ...]` makes the 38 kinds of
`file_molds`, or those that are named, runs both commands on each in processes of their own and prints a row for each.
`--coarse 2` doubles the elements' size in the scenes, `--fine 0.5` halves the fineness of the files, `--few` takes
every fifth kind. A file that is refused is tried again with the flag that the refusal names.

The judge shares no code with what it judges: it samples the mold as the scene places it at the end, looks which samples
a sheet could touch, by a buffer of least heights, and counts how many of them lie within an element of the formed part.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from benchmarks.strangers.file_molds import KINDS

Array = NDArray[np.float64]

_COMMAND = (sys.executable, "-c", "import sys; from jaxform.cli import main; sys.exit(main())")
_LIMIT = 900  # s for a command
_FILLED = 0.97  # of the surface that could be touched, that must lie within an element of the part
_SAMPLES, _CELLS = 20_000, 150  # of the mold; and along the sheet, of the buffer of heights
_FLAGS = re.compile(r"--(?:drape|cavity)(?: --direction=[+-][xyz])?|--direction=[+-][xyz]")
_REFUSED = 2  # exit status
_OF_FILLING = ("not filled", "closed off by contact")  # what says in words that a part is not filled


@dataclass
class Row:
    """The outcome of one file.

    Attributes:
        name: Name of the kind.
        triangles: Number of triangles in the file.
        said: The refusal of `new`, or else its warnings.
        refused: True if `new` refused, with the file alone.
        way: The flags that the refusal names, by which a scene was made; empty where none was.
        status: Status of the run; the message of `simulate` where it wrote nothing.
        filled: Share of the surface that a sheet could touch, within an element of the part; NaN without a part.
        thinnest: Wall [m].
        warnings: Warnings of the run.
        seconds: Time of both commands [s].
    """

    name: str
    triangles: int = 0
    said: list[str] = field(default_factory=list)
    refused: bool = False
    way: str = ""
    status: str = ""
    filled: float = np.nan
    thinnest: float = np.nan
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def says_unfilled(self) -> bool:
        """True if the run says that the part does not fill the mold."""
        told = " ".join([self.status, *self.warnings])
        return any(words in told for words in _OF_FILLING)

    @property
    def right(self) -> bool:
        """True if the file ran, or was refused with a remedy that runs, and the unfilled is reported."""
        ran = bool(self.status) and np.isfinite(self.filled)
        return ran and (self.filled >= _FILLED or self.says_unfilled)

    def __str__(self) -> str:
        """A row of the table, what was said below it."""
        way = f"refused, then {self.way or 'no way'}: " if self.refused else ""
        line = (
            f"{self.name:30} {self.triangles:6} {way}{self.status}; {100 * self.filled:5.1f} % within an element, "
            f"thinnest {1e3 * self.thinnest:.3f} mm, {self.seconds:.0f} s{'' if self.right else '   WRONG'}"
        )
        return line + "".join(f"\n    {sentence[:240]}" for sentence in [*self.said, *self.warnings])


def try_file(name: str, folder: Path, coarse: float = 1.0, fine: float = 1.0, limit: float = _LIMIT) -> Row:
    """The outcome of `new` and `simulate` for one kind of file, in a folder of its own."""
    row = Row(name)
    path = KINDS[name].write(folder, name, fine)
    row.triangles = len(_read(path).faces)
    scene = folder / path.name.split(".")[0]
    code, complaint, row.seconds = _call(limit, "new", str(scene), "--mold", str(path))
    row.said = complaint
    if code == _REFUSED:
        row.refused = True
        flags = _FLAGS.findall(" ".join(complaint))
        for flag in flags:
            code, complaint, more = _call(limit, "new", str(scene), "--mold", str(path), *flag.split(), "--force")
            row.seconds += more
            if code == 0:
                row.way = flag
                break
    if code != 0:
        return row
    text = (scene / "scene.toml").read_text()
    size = re.compile(r"^element_size = (\S+)", re.MULTILINE)
    text = size.sub(lambda found: f"element_size = {coarse * float(found[1]):.6g}", text)
    (scene / "scene.toml").write_text(text)
    out = scene / "formed"
    code, complaint, more = _call(limit, "simulate", str(scene / "scene.toml"), "--out", str(out), "--quiet")
    row.seconds += more
    if not (out / "summary.json").exists() or not (out / "final.vtu").exists():
        row.status = f"exit {code}: {' | '.join(complaint[-2:])}"
        return row
    summary = json.loads((out / "summary.json").read_text())
    row.status, row.warnings = summary["status"], summary["warnings"]
    row.thinnest = summary["thickness"]["min"]
    row.filled = share_within_an_element(scene / "scene.toml", out / "final.vtu")
    return row


def _call(limit: float, *arguments: str) -> tuple[int, list[str], float]:
    """Exit status, the lines on standard error, and the seconds of a command."""
    began = time.perf_counter()
    try:
        done = subprocess.run([*_COMMAND, *arguments], capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return -1, [f"no end in {limit:g} s"], time.perf_counter() - began
    return done.returncode, done.stderr.strip().splitlines(), time.perf_counter() - began


def share_within_an_element(scene: Path, part: Path) -> float:
    """The share of the mold that a sheet could touch, within an element of the formed part.

    A sample of the mold counts where a place a little off it, on either side, is over the sheet's outline and has
    nothing of the mold before it, seen from the sheet.
    """
    table = tomllib.loads(scene.read_text())
    mold = _place(scene.parent, table["mold"])
    mesh = meshio.read(part)
    triangles = mesh.cells_dict["triangle"]
    flat = np.asarray(mesh.point_data["reference"])[:, :2]
    size = float(table["parison"]["element_size"])
    low, high = flat.min(0), flat.max(0)
    cell = float((high - low).max()) / _CELLS
    least = _least_heights(mold, low, cell, np.ceil((high - low) / cell).astype(int) + 1)
    points, owner = trimesh.sample.sample_surface(mold, _SAMPLES, seed=1)[:2]
    normal = np.asarray(mold.face_normals)[owner]
    seen = np.zeros(len(points), bool)
    middle = flat[triangles].mean(1)
    over = KDTree(middle)
    for off in (1.5 * cell * normal, -1.5 * cell * normal):
        place = points + off
        index = np.floor((place[:, :2] - low) / cell).astype(int)
        inside = ((index >= 0) & (index < least.shape)).all(1)
        inside &= over.query(place[:, :2])[0] < 0.6 * size
        before = least[tuple(np.clip(index, 0, np.array(least.shape) - 1).T)]
        seen |= inside & (place[:, 2] <= before)
    formed = trimesh.Trimesh(np.asarray(mesh.points), triangles, process=False)
    many = trimesh.sample.sample_surface(formed, 20 * len(triangles), seed=2)[0]
    near = KDTree(np.concatenate([many, np.asarray(mesh.points)])).query(points[seen])[0]
    return float((near <= size).mean()) if seen.any() else 0.0


def _read(path: Path) -> Any:
    return trimesh.load(path, process=False, force="mesh")


def _place(folder: Path, table: dict[str, Any]) -> trimesh.Trimesh:
    """The mold of a scene [m], where it is at the end."""
    names = table["path"] if isinstance(table["path"], list) else [table["path"]]
    mesh: Any = trimesh.util.concatenate([_read(folder / name) for name in names])
    points = np.asarray(mesh.vertices) * table.get("scale", 1.0)
    for axis, degrees in zip(np.eye(3), table.get("rotate", [0.0, 0.0, 0.0]), strict=True):
        points = points @ trimesh.transformations.rotation_matrix(np.radians(degrees), axis)[:3, :3].T
    points = points + table.get("translate", [0.0, 0.0, 0.0])
    motion = table.get("motion")
    if motion is not None:
        way = np.asarray(motion["direction"], float)
        points = points + motion["displacement"][-1] * way / np.linalg.norm(way)
    return trimesh.Trimesh(points, mesh.faces, process=False)


def _least_heights(mold: trimesh.Trimesh, low: Array, cell: float, shape: NDArray[np.integer]) -> Array:
    """The least z [m] of the mold in square cells (nx, ny), from many samples; infinite where there is none."""
    finer = trimesh.remesh.subdivide_to_size(mold.vertices, mold.faces, 20 * cell, max_iter=30)
    fine = trimesh.Trimesh(finer[0], finer[1], process=False)
    count = int(min(20 * shape.prod() * max(1.0, fine.area / (shape.prod() * cell**2)), 4e6))
    points = np.concatenate([trimesh.sample.sample_surface(fine, count, seed=3)[0], fine.vertices])
    index = np.floor((points[:, :2] - low) / cell).astype(int)
    inside = ((index >= 0) & (index < shape)).all(1)
    least = np.full(shape, np.inf)
    np.minimum.at(least, tuple(index[inside].T), points[inside, 2])
    return least


def summary_line(rows: list[Row]) -> str:
    """Counts over all rows."""
    refused = [row for row in rows if row.refused]
    ran = [row for row in rows if np.isfinite(row.filled)]
    ok = [row for row in ran if row.status == "ok"]
    filled = [row for row in ran if row.filled >= _FILLED]
    told = [row for row in ran if row.filled < _FILLED and row.says_unfilled]
    ways = sum(bool(row.way) for row in refused)
    return (
        f"{len(rows)} kinds: {len(refused)} refused, {ways} of them run by the flag that is named; {len(ran)} run, "
        f"{len(ok)} ok; {len(filled)} filled, {len(told)} not and say so; {sum(row.right for row in rows)} right"
    )


def main(options: list[str]) -> int:
    """Runs the named kinds, or all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.strangers.files")
    parser.add_argument("kinds", nargs="*", choices=[[], *KINDS], default=[])
    parser.add_argument("--few", action="store_true")
    parser.add_argument("--coarse", type=float, default=1.0)
    parser.add_argument("--fine", type=float, default=1.0)
    parser.add_argument("--limit", type=float, default=_LIMIT)
    wanted = parser.parse_args(options)
    names, rows = wanted.kinds or list(KINDS)[:: 5 if wanted.few else 1], []
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            rows.append(try_file(name, Path(folder), wanted.coarse, wanted.fine, wanted.limit))
            print(rows[-1], flush=True)
    print(summary_line(rows))
    return int(not all(row.right for row in rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
