"""Molds from a CAD kernel as a stranger has them: in millimetres, with a flange in the sheet's plane, in many forms.

`python -m benchmarks.strangers.cad [--few] [PART ...]` makes five parts with Gmsh's OpenCASCADE, writes each as
triangles, quadrilaterals, an open surface, a closed block and in pieces that do not share their edges' nodes, uniform
and refined, runs `jaxform check` and `jaxform simulate` on a scene file for each, and prints a row for each. It needs
the package gmsh, which nothing else here does.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from matplotlib.tri import LinearTriInterpolator, Triangulation

from benchmarks.strangers.cad_molds import FORMS, PARTS, Part, mold_mesh, write_surface

Row = dict[str, Any]
_LIMIT = 900  # s for a command
_COMMAND = (sys.executable, "-c", "import sys; from jaxform.cli import main; sys.exit(main())")
_SYMMETRIC, _BETWEEN_CHORDS = 0.01, 0.002
_DENSITY = 1000.0  # kg/m^3
_CUTS = "an element cuts an edge"  # a warning that elements of these sizes give at sharp edges, with the depth

_SCENE = """name = "{name}"
[parison]
{sheet}
thickness = {thickness}
[material]
model = "mooney-rivlin"
c = 0.2e6
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0, {ramp}]
value = [0.0, {pressure}]
[mold]
shape = "file"
path = "{mold}"
scale = 0.001
fill = false
{refinement}
[solver]
end_time = {end}
damping = {damping}
"""
_REFINED = """[refinement]
angle = 12.0
max_level = 4
base_level = 4"""


def scene_text(part: Part, name: str, mold: str, refined: bool) -> str:
    """A scene file as a stranger would write it."""
    size = 2 * part.element_size if refined else part.element_size
    return _SCENE.format(
        name=name,
        sheet=part.sheet.format(size=f"{size:g}"),
        thickness=part.thickness,
        ramp=part.ramp,
        end=1.1 * part.ramp,
        damping=20.0 / part.ramp,
        pressure=part.pressure,
        mold=mold,
        refinement=_REFINED if refined else "",
    )


def _call(*arguments: str) -> tuple[int, str, str, float]:
    """Exit status, what was printed, and the seconds of a command."""
    began = time.perf_counter()
    try:
        done = subprocess.run([*_COMMAND, *arguments], capture_output=True, text=True, timeout=_LIMIT)
    except subprocess.TimeoutExpired:
        return -1, "", f"no end in {_LIMIT} s", time.perf_counter() - began
    return done.returncode, done.stdout, done.stderr, time.perf_counter() - began


def try_part(part: Part, name: str, form: str, refined: bool, folder: Path) -> Row:
    """The outcome of `check` and `simulate` for one scene."""
    stem = f"{name} {form} {'refined' if refined else 'uniform'}".replace(" ", "-")
    mold = folder / f"{name}-{form}".replace(" ", "-")
    mold = mold.with_suffix("." + form.split()[-1])
    if not mold.exists():
        write_surface(mold, mold_mesh(part, form))
    scene = folder / f"{stem}.toml"
    scene.write_text(scene_text(part, stem, mold.name, refined))
    row: Row = {"scene": stem}
    code, said, complaint, _ = _call("check", str(scene))
    row |= {"check": code, "check says": (said + complaint).strip().splitlines()}
    out = folder / stem
    code, _, complaint, seconds = _call("simulate", str(scene), "--out", str(out), "--force", "--quiet")
    row |= {"simulate": code, "complaints": complaint.strip().splitlines(), "seconds": seconds}
    if not (out / "summary.json").exists():
        return row
    summary = json.loads((out / "summary.json").read_text())
    row |= {key: summary[key] for key in ("status", "warnings", "thickness", "penetration_max", "contact_fraction")}
    row |= {"elements": summary["elements_final"], "steps": summary["steps"]}
    return row | measure_part(out / "final.vtu", part, summary["mass"])


def measure_part(path: Path, part: Part, mass: float) -> Row:
    """Mass kept and symmetry, from the file that a user would look at.

    Against the summary's mass [kg] the file's must be exact; against the sheet's as its mesh is now, it holds what lies
    between the rim of a disc and its chords.
    """
    mesh = meshio.read(path)
    triangles = mesh.cells_dict["triangle"]
    start, wall = np.asarray(mesh.point_data["reference"]), np.asarray(mesh.point_data["thickness"])
    before, after = _areas(start[triangles]), _areas(np.asarray(mesh.points)[triangles])
    volume = float(np.sum(after * np.asarray(mesh.cell_data["thickness"][0])))
    row: Row = {"in the file": _DENSITY * volume / mass - 1.0}
    row["mass"] = mass / float(_DENSITY * part.thickness * np.sum(before)) - 1.0
    flat = Triangulation(start[:, 0], start[:, 1], triangles)
    place = start[triangles].mean(1)[:, :2]
    at = LinearTriInterpolator(flat, wall)
    here = np.asarray(at(*place.T))
    apart = [np.ma.filled(at(*mirror(place).T), np.nan) / here - 1 for mirror in part.mirrors]
    return row | {"asymmetry": max(float(np.sqrt(np.nanmean(a**2 * before) / before.mean())) for a in apart)}


def _areas(corners: np.ndarray) -> np.ndarray:
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def words(row: Row) -> str:
    """A row of the table."""
    line = f"{row['scene']:34} check {row['check']}, simulate {row['simulate']}, {row['seconds']:.0f} s"
    if "thickness" not in row:
        return f"{line}: {' | '.join(row['complaints'][-2:])}"
    wall = row["thickness"]
    touched, deep, apart = 100 * row["contact_fraction"], 1e3 * row["penetration_max"], 100 * row["asymmetry"]
    line += (
        f"; wall {1e3 * wall['min']:.3f} to {1e3 * wall['max']:.3f} mm, mean {1e3 * wall['mean']:.3f}; mass "
        f"{row['mass']:+.1e} (in the file {row['in the file']:+.1e}), asymmetry {apart:.2f} %, "
        f"beyond {deep:.3f} mm, touches {touched:.0f} %, {row['elements']} elements, {row['steps']} steps"
    )
    told = [w for w in row["warnings"]] + ([row["status"]] if row["status"] != "ok" else [])
    return line + "".join(f"\n    {sentence[:200]}" for sentence in told)


def well(row: Row) -> bool:
    """True if a scene ran to a plausible part and warns of cuts of edges alone; refusals are looked at by a person."""
    if row["simulate"] != 0:
        return False
    kept = abs(row["mass"]) < _BETWEEN_CHORDS and abs(row["in the file"]) < 1e-9
    return kept and row["asymmetry"] < _SYMMETRIC and all(_CUTS in words for words in row["warnings"])


def main(options: list[str]) -> int:
    """Runs the named parts, or all."""
    if importlib.util.find_spec("gmsh") is None:
        print("the package gmsh is not there: python -m pip install gmsh", file=sys.stderr)
        return 2
    names = [name for name in PARTS if name in options] or list(PARTS)
    forms = FORMS[:1] if "--few" in options else FORMS
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            for form in forms:
                for refined in (False, True):
                    rows.append(try_part(PARTS[name], name, form, refined, Path(folder)))
                    print(words(rows[-1]), flush=True)
    cut = sum(bool(row["warnings"]) for row in rows if well(row))
    print(f"{sum(map(well, rows))} of {len(rows)} run well, {cut} of them with elements that cut edges and say so")
    return int(not all(map(well, rows)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
