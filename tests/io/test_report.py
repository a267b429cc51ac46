"""The report: what it packs and tells is what the files say, in one file that a browser draws without a network."""

from __future__ import annotations

import base64
import dataclasses
import itertools
import json
import re
import shutil
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from jaxform import molds, shapes
from jaxform.core.errors import InputError
from jaxform.io import files, report, scene_rewriting, surfaces
from jaxform.io.report import charts, contents, stored_results
from jaxform.mesh import meshes, raster
from tests import browser, scenes

Array = NDArray[np.float64]

SHEET = shapes.disc(radius=0.1, elements=60, symmetry="quarter")
NAME = "cup <script>alert(1)</script> & more"
RADIUS = np.hypot(*SHEET.positions[:, :2].T) / 0.1


def _write_part(path: Path, height: float, sheet: float | Array = 1e-3) -> dict[str, Array]:
    """Writes a cap of a height over the sheet and returns its data; the outer half touches, from the rim inwards.

    Its wall is by no law: from 0.2 mm in the middle to 1 mm at the rim; that of no height is the sheet.
    """
    positions = SHEET.positions + np.outer(height * (1 - RADIUS**2), [0.0, 0.0, 1.0])
    middle = RADIUS[SHEET.triangles].mean(1)
    walls = 2e-4 + 8e-4 * middle**2 if height else np.full(len(middle), 1e-3)
    time = np.where(RADIUS > 0.5, 0.2 * (1 - RADIUS), -1.0)
    nodal = {
        "reference": SHEET.positions,
        "thickness": 2e-4 + 8e-4 * RADIUS**2,
        "initial_thickness": np.full(len(RADIUS), sheet),
        "contact_time": np.where(SHEET.clamped, 0.0, time),
    }
    cells = {"thickness": walls, "stretch_1": 1e-3 / walls / 1.25, "stretch_2": 0 * walls + 1.25, "level": 0 * walls}
    meshes.write_vtu(path, positions, SHEET.triangles, nodal, cells)
    return {"positions": positions, "walls": walls, "area": _areas(positions)}


def _areas(positions: Array) -> Array:
    a, b, c = np.moveaxis(positions[SHEET.triangles], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _summary(part: dict[str, Array]) -> dict[str, Any]:
    """As the simulator writes it."""
    walls, thin = part["walls"], SHEET.triangles[np.argmin(part["walls"])]
    mean = float(np.average(walls, weights=part["area"]))
    return {
        "scene": NAME,
        "status": "ok",
        "elements_final": len(walls),
        "time": 0.1,
        "steps": 123,
        "thickness": {"min": walls.min(), "mean": mean, "max": walls.max(), "cv": 0.25},
        "thinnest": {
            "thickness": walls.min(),
            "ratio": 0.25,
            "formed": part["positions"][thin].mean(0).tolist(),
            "initial": SHEET.positions[thin].mean(0).tolist(),
        },
        "symmetry_planes": {"x": 0.0, "y": 0.0},
        "contact_fraction": 0.625,
        "mass": 0.0123,
        "energy": {"strain": 1.5, "kinetic": 0.0, "external_work": 2.0, "damping_loss": 0.5, "balance_error": 1e-5},
        "warnings": ["the mold is <b>doubtful</b>; turn it"],
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a simulation with two frames before the end."""
    folder = tmp_path_factory.mktemp("results")
    (folder / "summary.json").write_text(json.dumps(_summary(_write_part(folder / "final.vtu", 0.05))))
    mold = molds.revolved(profile=[[0.0, 0.06], [0.08, 0.06], [0.11, 0.0]], segments=24)
    meshes.write_vtu(folder / "mold.vtu", mold.vertices, mold.triangles)
    (folder / "frames").mkdir()
    for name, height in (("0", 0.0), ("1", 0.02)):
        _write_part(folder / "frames" / f"{name}.vtu", height)
    meshes.write_pvd(folder / "frames.pvd", [(0.0, "frames/0.vtu"), (0.05, "frames/1.vtu"), (0.1, "final.vtu")])
    (folder / "simulated.toml").write_text('name = "<cup>" # in its own words\n')
    report.write_report(folder)
    return folder


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a search."""
    folder = tmp_path_factory.mktemp("design")
    first = {
        "objective": 0.5,
        "thickness_rms_error": 0.25,
        "wall_min": 2e-4,
        "wall_mean": 6e-4,
        "wall_cv": 0.1,
        "mass": 1.0,
    }
    found = {"before": first, "after": first | {"objective": 0.125}, "evaluations": 2, "message": "done"}
    summary = _summary(_write_part(folder / "final.vtu", 0.05)) | {"design": found}
    (folder / "summary.json").write_text(json.dumps(summary))
    _write_part(folder / "start.vtu", 0.02, sheet=2e-3)
    rows = [
        "simulations,thickness_rms_error,wall_min,wall_mean",
        "1,0.25,2e-4,6e-4",
        "3,,3e-4,6e-4",
        "5,0.01,4e-4,6e-4",
    ]
    (folder / "history.csv").write_text("\n".join(rows))
    report.write_report(folder)
    return folder


def _unpack(text: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a parcel, by another way than the page's script: whole columns at once."""
    content = zlib.decompress(base64.b64decode(text))
    size = int.from_bytes(content[:4], "little")
    facts, body = json.loads(content[4 : 4 + size]), np.frombuffer(content[4 + size :], np.uint8)
    arrays = {}
    for name, told in facts["arrays"].items():
        width, count = 3 if told["coding"] == "index" else 2, told["count"]
        planes = (
            body[told["at"] :][: width * count * told["columns"]].reshape(told["columns"], width, count).astype(int)
        )
        codes = np.tensordot(256 ** np.arange(width)[::-1], planes, (0, 1))
        if width == 3:
            newest = -1
            corners = np.zeros(count, int)
            for k, code in enumerate(codes[0]):
                corners[k] = newest + 1 - code
                newest = max(newest, corners[k])
            arrays[name] = corners.reshape(-1, 3)
            continue
        change = np.where(codes % 2, -(codes + 1) // 2, codes // 2)
        known = np.cumsum(change, axis=1) % 65536
        values = np.where(
            known == 65535, np.nan, np.asarray(told["low"])[:, None] + np.asarray(told["step"])[:, None] * known
        )
        arrays[name] = (np.exp(values) if told["coding"] == "relative" else values).T
    return facts, arrays


def _parcel(page: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    found = re.search(r'id="parcel">([^<]*)<', page.read_text(encoding="utf-8"))
    assert found
    return _unpack(found[1])


def test_what_is_packed_comes_back() -> None:
    random = np.random.default_rng(0)
    places, walls = random.normal(size=(400, 3)) * [1.0, 1e-3, 0.0], np.exp(random.uniform(-9, -4, 300))
    places[7, 1] = np.nan
    parcel, nodes = contents.Parcel(), random.permutation(400)
    triangles, used = contents.by_first_use(nodes[random.integers(0, 390, (900, 3))])
    parcel.add("places", places)
    parcel.add("walls", walls, relative=True)
    parcel.add("coarse", walls, relative=True, coarse=True)
    parcel.add_triangles("triangles", triangles)
    facts, arrays = _unpack(parcel.text({"name": "ü", "numbers": [1, {"k": np.inf}]}))
    assert facts["name"] == "ü" and facts["numbers"] == [1, {"k": None}]
    np.testing.assert_allclose(
        arrays["places"], places, atol=np.nanmax(np.nanmax(places, 0) - np.nanmin(places, 0)) / 131068
    )
    np.testing.assert_allclose(arrays["places"][:, 1], places[:, 1], atol=1e-3 * 8 / 131068)
    np.testing.assert_allclose(arrays["walls"][:, 0], walls, rtol=5 / 131068 + 1e-9)
    np.testing.assert_allclose(arrays["coarse"][:, 0], walls, rtol=5 / 8190 + 1e-6)
    np.testing.assert_array_equal(arrays["triangles"], triangles)
    first = list(dict.fromkeys(triangles.ravel().tolist()))
    assert first == list(range(len(used)))


def test_the_report_holds_the_parts_of_the_files(folder: Path) -> None:
    facts, arrays = _parcel(folder / "report.html")
    wanted = meshes.read_mesh(folder / "final.vtu")
    corners = arrays["part0.positions"][arrays["mesh0.triangles"]]
    np.testing.assert_allclose(corners, wanted.positions[wanted.triangles], atol=1e-6)
    initial_places = np.stack([wanted.fields[f"reference.{axis}"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(
        arrays["mesh0.reference"][arrays["mesh0.triangles"]], initial_places[wanted.triangles], atol=1e-6
    )
    for name in ("thickness", "stretch_1", "stretch_2"):
        np.testing.assert_allclose(arrays[f"part0.{name}"][:, 0], wanted.cell_fields[name], rtol=2e-5)
    times = arrays["part0.contact_time"][:, 0][arrays["mesh0.triangles"]]
    told = wanted.fields["contact_time"][wanted.triangles]
    np.testing.assert_allclose(times, np.where(told < 0, np.nan, told), atol=2e-6)
    half = meshes.read_mesh(folder / "frames" / "1.vtu")
    np.testing.assert_allclose(
        arrays["part2.positions"][arrays["mesh0.triangles"]], half.positions[half.triangles], atol=2e-5
    )
    assert [part["label"] for part in facts["parts"]] == ["end", "frame", "frame"]
    assert (
        facts["symmetry"] == {"x": 0.0, "y": 0.0}
        and facts["hangs"]
        and facts["mold"] == {"mirrored": False, "rough": False}
    )
    shown = {quantity["key"]: quantity for quantity in facts["quantities"]}
    assert set(shown) == {"thickness", "stretch_1", "stretch_2", "area_stretch", "contact_time"}
    np.testing.assert_allclose(shown["thickness"]["low"], 1e3 * wanted.cell_fields["thickness"].min())


def test_the_page_says_what_the_summary_says_and_asks_nobody(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    summary = json.loads((folder / "summary.json").read_text())
    for value, unit in ((summary["thickness"]["min"], "mm"), (summary["thickness"]["mean"], "mm")):
        assert f"{1e3 * value:.4g} {unit}" in text
    assert f"{1e3 * summary['thickness']['min']:.4g} mm, 25 % of the initial thickness" in text
    assert f"{1e3 * 4 * summary['mass']:.4g} g (a quarter of it is modelled: {1e3 * summary['mass']:.4g} g)" in text
    assert "cup &lt;script&gt;alert(1)&lt;/script&gt; &amp; more" in text and "<script>alert" not in text
    assert "the mold is &lt;b&gt;doubtful&lt;/b&gt;; turn it" in text and "&lt;cup&gt;" in text
    assert not re.search(r"(src|href)=(?!\"data:,\")", text) and "url(" not in text
    assert set(re.findall(r"https?://[^\"'\s]*", text)) == {"http://www.w3.org/2000/svg"}  # a name, not an address
    assert "default-src 'none'" in text


def test_places_to_measure(folder: Path) -> None:
    """The wall grows outwards from the middle: thinnest there, thickest at the rim."""
    results = stored_results.read_results(folder)
    thin, thick, other = charts.measuring_points(results.part, results.summary)
    radius = [float(np.linalg.norm(point.initial[:2])) for point in (thin, thick, other)]
    walls, mean = results.part.cells["thickness"], results.summary["thickness"]["mean"]
    assert thin.thickness == walls.min() and thick.thickness == walls.max()
    assert radius[0] < 0.02 and radius[1] > 0.08 and radius[0] < radius[2] < radius[1]
    away = np.abs(walls / mean - 1)
    assert abs(other.thickness / mean - 1) <= max(0.02, float(away.min())) + 1e-12
    assert charts.is_disc(results.part, {"x": 0.0, "y": 0.0})


def test_a_large_part_takes_little_room() -> None:
    """A cap of 200 000 triangles with a noise of a hundredth on its wall, and one of 2000."""
    for elements, most in ((2000, 100_000), (200_000, 3_900_000)):
        side = int(np.sqrt(elements / 2))
        x, y = np.meshgrid(*[np.linspace(-1, 1, side + 1)] * 2)
        a = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
        triangles = np.stack([a, a + 1, a + side + 1, a + side + 1, a + 1, a + side + 2], axis=1).reshape(-1, 3)
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        height = np.cos(flat[:, 0]) * np.cos(flat[:, 1])
        middle = height[triangles].mean(1) * np.random.default_rng(0).normal(1.0, 0.01, len(triangles))
        cells = {"thickness": 1e-3 * middle, "stretch_1": 2 - middle, "stretch_2": 3 - middle, "level": 0 * middle}
        nodal = {"thickness": height, "initial_thickness": 0 * height, "contact_time": height}
        part = stored_results.StoredPart(
            flat + np.outer(height, [0, 0, 1]), flat, triangles.astype(np.int32), nodal, cells
        )
        summary = {"time": 1.0, "symmetry_planes": {}}
        parcel = contents.Parcel()
        assert len(parcel.text(contents.pack_parts(stored_results.Results(summary, part), parcel))) < most


def test_frames_share_a_mesh_or_bring_their_own(folder: Path) -> None:
    """Every frame of a refined sheet has a mesh of its own, whose elements are packed in another order."""
    part, half = stored_results.read_results(folder).part, stored_results._part(folder / "frames" / "1.vtu")
    order = np.random.default_rng(0).permutation(len(part.triangles))
    finer = part._replace(triangles=part.triangles[order], cells={name: x[order] for name, x in part.cells.items()})
    parcel = contents.Parcel()
    results = stored_results.Results({"time": 1.0}, part, frames=[(0.1, half), (0.2, finer), (0.3, finer)])
    arrays = _unpack(parcel.text(contents.pack_parts(results, parcel)))[1]
    assert {name for name in arrays if name.startswith("mesh")} == {
        f"mesh{mesh}.{name}" for mesh in (0, 1) for name in ("triangles", "reference", "level")
    }
    assert "part1.contact_time" not in arrays and "part2.contact_time" in arrays
    wanted = {tuple(row) for row in np.round(part.positions[part.triangles].reshape(-1, 9), 4)}
    packed = arrays["part2.positions"][arrays["mesh1.triangles"]].reshape(-1, 9)
    walls = dict(
        zip(map(tuple, np.round(part.positions[part.triangles].mean(1), 4)), part.cells["thickness"], strict=True)
    )
    assert len(wanted) == len(packed)
    near = np.linalg.norm(packed[:, None] - np.array(sorted(wanted))[None], axis=2).min(1)
    assert near.max() < 2e-4
    middles = np.array(list(walls))
    for row, wall in zip(packed.reshape(-1, 3, 3).mean(1), arrays["part2.thickness"][:, 0], strict=True):
        closest = tuple(middles[np.argmin(np.linalg.norm(middles - row, axis=1))])
        assert wall == pytest.approx(walls[closest], rel=1e-3)


def test_a_mold_that_ends_at_the_symmetry_plane_has_images() -> None:
    whole = molds.revolved(profile=[[0.0, 0.06], [0.08, 0.06], [0.11, 0.0]], segments=24)
    half = whole.triangles[(whole.vertices[whole.triangles][..., 0] > -1e-9).all(1)]
    for triangles, mirrored in ((whole.triangles, False), (half, True)):
        mold = meshes.drop_unused_nodes(meshes.Mesh(whole.vertices, triangles))
        told = contents._pack_mold(mold, {"x": 0.0}, contents.Parcel())
        assert told == {"mirrored": mirrored, "rough": False}


def test_a_fine_mold_is_drawn_more_roughly() -> None:
    ball = shapes.sphere(radius=1.0, elements=80_000)
    vertices, triangles = contents._coarsen(ball.positions, ball.triangles)
    assert len(ball.triangles) > contents._MOST_WALLS >= len(triangles) > 1000
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0)
    corners = vertices[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    np.testing.assert_allclose(area, 4 * np.pi, rtol=0.05)


def _without_wall(text: str) -> str:
    """The text of a part with its nodal thickness under another name; that of the elements comes later."""
    return text.replace('Name="thickness"', 'Name="wall"', 1)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("summary.json", None, "holds no summary.json; name the folder"),
        ("final.vtu", None, "holds no final.vtu"),
        ("summary.json", "{", "summary.json: is not valid JSON"),
        ("summary.json", "[]", "summary.json: is not a table"),
        ("summary.json", "{}", "summary.json: scene: is missing"),
        ("summary.json", "[" * 100_000, "summary.json: is not valid JSON"),
        ("final.vtu", _without_wall, "final.vtu: thickness: is missing"),
        ("final.vtu", "<VTKFile>", "final.vtu: is not a readable VTU file"),
        ("frames.pvd", "<VTKFile>", "frames.pvd: is not a list of frames"),
        ("frames.pvd", '<a><DataSet timestep="-1" file="gone.vtu"/></a>', "gone.vtu"),
        ("mold.vtu", "", "mold.vtu: is empty"),
    ],
)
def test_damaged_results_are_named(
    folder: Path, tmp_path: Path, name: str, text: str | Callable[[str], str] | None, words: str
) -> None:
    for file in folder.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "frames.pvd").unlink()
    (tmp_path / name).unlink(missing_ok=True)
    if text is not None:
        (tmp_path / name).write_text(text if isinstance(text, str) else text((folder / name).read_text()))
    with pytest.raises(InputError) as error:
        report.write_report(tmp_path)
    assert words in str(error.value) and str(tmp_path) in str(error.value)


def _places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The keys of all that is in a tree of tables and lists."""
    yield at
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from _places(item, (*at, key))


def test_whatever_summary_says_there_is_a_report_or_a_clear_error(design: Path, tmp_path: Path) -> None:
    for name in ("final.vtu", "start.vtu", "history.csv"):
        (tmp_path / name).write_bytes((design / name).read_bytes())
    text, refused = (design / "summary.json").read_text(), 0
    for at in list(_places(json.loads(text)))[1:]:
        for value in (None, True, -1, 1e308, 10**400, "x", [], {}, ["x"]):
            facts = json.loads(text)
            inner = facts
            for key in at[:-1]:
                inner = inner[key]
            inner[at[-1]] = value
            (tmp_path / "summary.json").write_text(json.dumps(facts))
            try:
                report.write_report(tmp_path)
            except InputError as error:
                refused += 1
                assert "summary.json" in str(error) and str(at[0]) in str(error)
    assert refused > 200


def test_numbers_that_are_missing_are_dashes(folder: Path, tmp_path: Path) -> None:
    """A run that broke off has null where numbers were not finite."""
    for name in ("final.vtu", "summary.json"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    summary = json.loads((tmp_path / "summary.json").read_text())
    summary |= {
        "status": "unstable: it <broke>",
        "mass": None,
        "design": None,
        "thickness": dict.fromkeys(summary["thickness"]),
        "time": None,
    }
    summary["thinnest"] = {"thickness": None, "formed": [None] * 3, "initial": [None] * 3}
    summary["energy"] = dict.fromkeys(summary["energy"])
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    text = report.write_report(tmp_path).read_text(encoding="utf-8")
    assert "unstable: it &lt;broke&gt;" in text and ">problem<" in text and "\N{EN DASH}" in text
    assert ">simulation, " in text and "search for a design" not in text


def test_a_scene_is_kept_in_its_own_words_and_runs_from_elsewhere(tmp_path: Path) -> None:
    mold = molds.revolved(profile=[[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]], segments=12)
    meshes.write_stl(tmp_path / "cup.stl", mold.vertices, mold.triangles)
    text = re.sub(
        r"\[mold\]\n.*?\n\[solver\]",
        '[mold] # of steel\nshape = "file"\npath = "cup.stl"\n[solver]',
        scenes.FILE,
        flags=re.S,
    )
    text = text.replace('name = "small"\n', "")
    (tmp_path / "small.toml").write_text(text)
    kept = scene_rewriting.keep_scene(files.read_scene(tmp_path / "small.toml"), tmp_path / "..")
    try:
        assert kept.read_text() == 'name = "small"\n' + text.replace('"cup.stl"', json.dumps(str(tmp_path / "cup.stl")))
        again = files.read_scene(kept)
        assert again.name == "small" and len(files.build(again).mold.triangles) == len(mold.triangles)  # pyright: ignore
        # Where the words do not hold any more, the tables do.
        (tmp_path / "small.toml").write_text(text.replace('path = "cup.stl"', 'path = """\\\n  cup.stl"""'))
        scene_rewriting.keep_scene(files.read_scene(tmp_path / "small.toml"), tmp_path / "..")
        assert files.read_scene(kept).data["mold"]["path"] == str(tmp_path / "cup.stl")
    finally:
        kept.unlink()


def test_a_mold_that_moves_is_where_it_was_at_each_frame(folder: Path) -> None:
    results = stored_results.read_results(folder)
    assert results.motion is None and results.scene is not None
    text = results.scene[1] + "\n[mold.motion]\ndirection = [0, 0, 2]\ntime = [0.0, 1e-3]\ndisplacement = [0.0, 0.05]\n"
    motion = stored_results._motion(stored_results._tables(text)["mold"])
    assert motion is not None
    # Nothing is said of a scene that a user has changed since.
    for other in ("[mold", text.replace("1e-3", '"x"'), text.replace("direction", "way"), text.replace("0.05", "nan")):
        assert stored_results._motion(stored_results._tables(other).get("mold")) is None
    facts = contents.pack_parts(dataclasses.replace(results, motion=motion), contents.Parcel())
    for part in facts["parts"]:
        rise = [0.05 * s * s * (3 - 2 * s) for s in (min(time / 1e-3, 1.0) for time in (part["time"], facts["end"]))]
        np.testing.assert_allclose(part["mold"], [0.0, 0.0, rise[0] - rise[1]], atol=1e-12)
    assert facts["parts"][0]["label"] == "end" and facts["parts"][0]["mold"] == [0.0, 0.0, 0.0]
    assert len({tuple(part["mold"]) for part in facts["parts"]}) > 1


def test_tools_are_where_they_were_at_each_frame(folder: Path, tmp_path: Path) -> None:
    results = stored_results.read_results(folder)
    assert results.tools == [] and results.scene is not None
    plug = molds.plate(radius=0.02)
    meshes.write_vtu(tmp_path / "tool_plug.vtu", plug.vertices, plug.triangles)
    meshes.write_vtu(tmp_path / "tool_tool2.vtu", plug.vertices, plug.triangles)
    moving = '[[tool]]\nname = "plug"\ndirection = [0, 0, 2]\ntime = [0.0, 1e-3]\ndisplacement = [0.0, 0.05]\n'
    tables = stored_results._tables(moving + '[[tool]]\nshape = "plate"\n[[tool]]\nname = "no-file"\n')
    tools = stored_results._tools(tmp_path, tables["tool"])
    assert [(name, motion is not None) for name, _, motion in tools] == [("plug", True), ("tool2", False)]
    facts = contents.pack_parts(dataclasses.replace(results, tools=tools), contents.Parcel())
    assert facts["tools"] == [{"name": name, "mirrored": False, "rough": False} for name in ("plug", "tool2")]
    for part in facts["parts"]:
        rise = [0.05 * s * s * (3 - 2 * s) for s in (min(time / 1e-3, 1.0) for time in (part["time"], facts["end"]))]
        np.testing.assert_allclose(part["tools"], [[0.0, 0.0, rise[0] - rise[1]], [0.0, 0.0, 0.0]], atol=1e-12)
    assert len({part["tools"][0][2] for part in facts["parts"]}) > 1


def test_the_process_has_a_diagram_for_each_panel() -> None:
    rows = [{"time": "0", "pressure": "0", "displacement_plug": "0", "contact_mold": "0", "contact_plug": ""}]
    rows += [{"time": "1", "pressure": "2e4", "displacement_plug": "0.05", "contact_mold": "1", "contact_plug": "0.1"}]
    drawn = charts._process(rows, None, contents.Parcel())
    assert [chart["y"] for chart in drawn] == ["pressure [kPa]", "displacement [mm]", "area in contact [%]"]
    assert [[line["label"] for line in chart["series"]] for chart in drawn] == [
        ["pressure"],
        ["plug"],
        ["mold", "plug"],
    ]


def _write_field(design: Path, folder: Path) -> Array:
    """Copies the results of a search, of which the best sheet is a field [m] that varies around the axis."""
    shutil.copytree(design, folder)
    field = 1e-3 * (1.0 + 0.3 * np.sin(4.0 * np.arctan2(SHEET.positions[:, 1], SHEET.positions[:, 0])))
    _write_part(folder / "final.vtu", 0.05, sheet=field)
    return field


def test_a_designed_field_is_a_map_and_a_profile_a_line(design: Path, tmp_path: Path) -> None:
    """A field has thousands of values at about the same radius, which are a cloud along it."""
    field = _write_field(design, tmp_path / "field")
    results = stored_results.read_results(tmp_path / "field")
    (chart,) = [one for one in charts.pack_charts(results, contents.Parcel()) if one["title"] == "The initial sheet"]
    assert chart["series"] == [] and chart["legend"] == "start: 2 everywhere"
    assert chart["map"]["angles"] is None and chart["map"]["words"] == "initial thickness [mm]"
    np.testing.assert_allclose([chart["map"][end] for end in ("low", "high")], [1e3 * field.min(), 2.0])
    # A start that is a field, too, has a map of its own.
    assert results.start is not None
    start = results.start._replace(nodal=results.start.nodal | {"initial_thickness": field[::-1]})
    both = charts._initial(start, results.part, {}, contents.Parcel())
    assert [one["map"]["points"] for one in both] == ["map0.points", "map1.points"]
    assert not any(one["legend"] for one in both)
    profile = results.part._replace(nodal=results.part.nodal | {"initial_thickness": 1e-3 * (1.0 + RADIUS)})
    (chart,) = charts._initial(results.start, profile, {}, contents.Parcel())
    assert len(chart["series"]) == 2 and "map" not in chart


def _write_tube(design: Path, folder: Path) -> tuple[shapes.Sheet, Array]:
    """Copies the results of a search, of which the best sheet is a tube with a field [m] that varies around it."""
    shutil.copytree(design, folder)
    tube = shapes.tube(radius=0.02, length=0.1, elements=200)
    turn = np.array([[np.cos(0.2), -np.sin(0.2), 0.0], [np.sin(0.2), np.cos(0.2), 0.0], [0.0, 0.0, 1.0]])
    tube = dataclasses.replace(tube, positions=tube.positions @ turn.T)
    x, y, z = tube.positions.T
    field = 1e-3 * (1.0 + 0.3 * np.sin(np.arctan2(y, x)) + z)
    count = len(tube.triangles)
    nodal = {"reference": tube.positions, "thickness": field, "initial_thickness": field, "contact_time": -1.0 + 0 * z}
    cells = {"thickness": np.ones(count), "stretch_1": np.ones(count), "stretch_2": np.ones(count)}
    meshes.write_vtu(
        folder / "final.vtu", 1.1 * tube.positions, tube.triangles, nodal, cells | {"level": 0 * np.ones(count)}
    )
    summary = json.loads((folder / "summary.json").read_text()) | {"symmetry_planes": {}, "elements_final": count}
    (folder / "summary.json").write_text(json.dumps(summary))
    return tube, field


def test_a_field_over_a_tube_is_a_map_over_the_angle(design: Path, tmp_path: Path) -> None:
    """Elements across the cut at 180 degrees are there at both ends, so that the map has no gap."""
    tube, field = _write_tube(design, tmp_path / "tube")
    results, parcel = stored_results.read_results(tmp_path / "tube"), contents.Parcel()
    (chart,) = [one for one in charts.pack_charts(results, parcel) if one["title"] == "The initial sheet"]
    assert (chart["x"], chart["y"]) == ("z [mm]", "angle about z [degrees]")
    np.testing.assert_allclose(chart["map"]["angles"], [-180.0, 180.0])
    arrays = _unpack(parcel.text({}))[1]
    along, angle, value = arrays[chart["map"]["points"]].T
    # The whole field in its place.
    np.testing.assert_allclose(value, 1.0 + 0.3 * np.sin(np.radians(angle)) + 1e-3 * along, atol=1e-4)
    triangles = arrays[chart["map"]["triangles"]].reshape(-1, 3).astype(int)
    assert len(triangles) > len(tube.triangles)
    assert np.ptp(angle[triangles], axis=1).max() < 60.0
    assert angle.min() < -180.0 and angle.max() > 180.0
    np.testing.assert_allclose([chart["map"][end] for end in ("low", "high")], [1e3 * field.min(), 2.0])


def test_the_wall_beyond_the_part_is_grey(folder: Path) -> None:
    """The curve of the part ends where it is cut off; clicks on both show the place."""
    results = stored_results.read_results(folder)
    inner = RADIUS[SHEET.triangles].mean(1) < 0.5
    cells = results.part.cells | {"part": inner.astype(float)}
    parcel = contents.Parcel()
    chart = charts._wall(dataclasses.replace(results, part=results.part._replace(cells=cells)), parcel)
    arrays = _unpack(parcel.text({}))[1]
    assert [line["label"] for line in chart["series"]] == ["cut off the part", "all nodes"]
    beyond, part = (arrays[line["points"]] for line in chart["series"])
    np.testing.assert_array_equal(beyond[:, 0], part[:, 0])
    assert np.isfinite(beyond).all() and 45.0 < part[np.isfinite(part[:, 1]), 0].max() < 60.0
    assert len({line["places"] for line in chart["series"]}) == 1
    assert len(charts._wall(results, contents.Parcel())["series"]) == 1


def test_a_tool_has_its_colour_in_all_diagrams_of_the_process() -> None:
    """As in the pictures, and no two of five gases or tools have the same."""
    names = ("left", "right", "top", "base", "pin")
    keys = [f"pressure_{name}" for name in names] + ["displacement_pin", "contact_mold"]
    keys += [f"contact_{name}" for name in names[:2] + names[-1:]]
    rows = [{"time": time, **dict.fromkeys(keys, time)} for time in ("0", "1")]
    pressures, displacements, contact = (chart["series"] for chart in charts._process(rows, None, contents.Parcel()))
    assert len({line["color"] for line in pressures}) == 5
    colors = {line["label"]: line["color"] for line in contact}
    assert colors == {
        "mold": surfaces.MOLD_COLOR,
        **dict(zip(("left", "right", "pin"), surfaces.tool_colors(3), strict=True)),
    }
    assert displacements[0]["color"] == colors["pin"]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[browser.Browser]:
    if browser.find_browser() is None:
        pytest.skip("no Chromium or Chrome on this machine")
    with browser.browser(tmp_path_factory.mktemp("browser")) as page:
        yield page


READY = "document.documentElement?.dataset.ready"


def _visit(page: browser.Browser, path: Path) -> tuple[float, float, float, float]:
    """Opens a report; left, top, width and height of its view."""
    page.requests.clear()
    page.complaints.clear()
    page.visit(path, READY)
    assert page.value(READY) == "yes", page.value("document.getElementById('problem').textContent")
    box = page.value("(({left, top, width, height}) => [left, top, width, height])(canvas.getBoundingClientRect())")
    return tuple(box)


def _click(page: browser.Browser, box: tuple[float, float, float, float], across: float, down: float) -> dict[str, Any]:
    page.click(box[0] + across * box[2], box[1] + down * box[3])
    return page.value("({...document.getElementById('reading').dataset})")


def _choose(page: browser.Browser, name: str, value: str, event: str = "change") -> None:
    changed = f"it.value = '{value}', it.dispatchEvent(new Event('{event}'))"
    page.value(f"(it => ({changed}))(document.getElementById('{name}'))")
    page.frame()


def test_a_browser_draws_it_and_a_click_tells_the_wall(page: browser.Browser, folder: Path) -> None:
    box = _visit(page, folder / "report.html")
    left, top, width, height = (round(x) for x in box)
    pixels = page.picture()[top : top + height, left : left + width].astype(int)
    drawn = np.abs(pixels - pixels[2, 2]).max(2) > 40
    colored = np.ptp(pixels, axis=2) > 60
    assert 0.1 < drawn.mean() < 0.9 and colored.mean() > 0.1
    wanted = meshes.read_mesh(folder / "final.vtu")
    for across, down in ((0.5, 0.4), (0.4, 0.5), (0.6, 0.55), (0.5, 0.65)):
        read = _click(page, box, across, down)
        element, place = int(read["element"]), np.array(read["place"].split(","), float)
        np.testing.assert_allclose(float(read["thickness"]), wanted.cell_fields["thickness"][element], rtol=3e-5)
        corners = wanted.positions[wanted.triangles[element]]
        share = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), [*place, 1.0], rcond=None)[0]
        assert share.min() > -1e-3
        np.testing.assert_allclose(share @ corners, place, atol=2e-5)
        words = page.value("document.getElementById('reading').innerText")
        assert f"{1e3 * wanted.cell_fields['thickness'][element]:.4g} mm" in words and "contact" in words
    assert page.complaints == [] and page.requests == [(folder / "report.html").as_uri()]


def test_a_click_beyond_the_part_says_so(page: browser.Browser, folder: Path, tmp_path: Path) -> None:
    """It said that the wall was a dash in mm."""
    cut = shutil.copytree(folder, tmp_path / "cut")
    whole = meshes.read_mesh(cut / "final.vtu")
    cells = whole.cell_fields | {"part": (RADIUS[SHEET.triangles].mean(1) < 0.9).astype(float)}
    meshes.write_vtu(cut / "final.vtu", whole.positions, whole.triangles, whole.fields, cells)
    box = _visit(page, report.write_report(cut))
    said = set()
    for down in np.linspace(0.2, 0.8, 25):
        read = _click(page, box, 0.5, down)
        if read and cells["part"][int(read["element"])] == 0.0:
            said.add(page.value("document.querySelector('#reading dd').innerText"))
    assert said == {"not part of the product"}


def _visible_elements(folder: Path, width: int, height: int) -> NDArray[np.int64]:
    """Elements that the pixels (height, width) of the first view show, -1 none: by a camera and raster of ours."""
    part = stored_results.read_results(folder).part
    images = [part.positions * [x, y, 1] for y in (1, -1) for x in (1, -1)]
    faces = np.concatenate([image[part.triangles] for image in images])
    low, high = faces.min((0, 1)), faces.max((0, 1))
    middle, turn, tilt, half = (low + high) / 2, -np.pi / 4, 0.62, np.tan(np.pi / 12)
    # The part hangs: up is -z.
    away = np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), -np.sin(tilt)])
    right = np.cross(-away, [0, 0, -1])
    right /= np.linalg.norm(right)
    above = np.cross(right, -away)
    corners = np.array(list(itertools.product(*zip(low - middle, high - middle, strict=True))))
    aspect = width / height
    size = np.maximum(np.abs(corners @ right) / aspect, np.abs(corners @ above)) / (0.92 * half)
    distance = (size + corners @ away).max()
    offset = faces - middle - distance * away
    depth = -offset @ away
    across, up = offset @ right / (depth * half * aspect), offset @ above / (depth * half)
    pixels = np.stack([(1 + across) / 2 * width, (1 - up) / 2 * height], axis=-1)
    found = raster.nearest_in_pixels(pixels, -1 / depth, width, height).reshape(height, width)
    return np.where(found < 0, -1, found % len(part.triangles))


def test_clicks_are_exact_to_the_element(page: browser.Browser, folder: Path) -> None:
    left, top, width, height = _visit(page, folder / "report.html")
    seen = _visible_elements(folder, round(width), round(height))
    random, asked = np.random.default_rng(1), []
    while len(asked) < 40:
        x, y = random.integers(2, [round(width) - 2, round(height) - 2])
        around = seen[y - 1 : y + 2, x - 1 : x + 2]
        if seen[y, x] >= 0 and (around == seen[y, x]).all():
            page.click(left + x, top + y)
            asked.append((page.value("Number(document.getElementById('reading').dataset.element)"), seen[y, x]))
    told, wanted = np.array(asked).T
    np.testing.assert_array_equal(told, wanted)
    assert len(set(wanted)) > 15


def test_the_keyboard_turns_it_and_reads_the_middle(page: browser.Browser, folder: Path) -> None:
    """From straight above or below the middle of the view is the axis of the cup."""
    _visit(page, folder / "report.html")
    page.value("document.getElementById('canvas').focus()")
    for _ in range(9):
        page.key("ArrowDown")
    before = page.picture()
    page.key("Enter")
    place = np.array(page.value("document.getElementById('reading').dataset.place").split(","), float)
    np.testing.assert_allclose(place, [0.0, 0.0, 0.05], atol=1e-3)
    page.key("+")
    assert (page.picture() != before).any(axis=2).mean() > 0.02
    assert page.complaints == []


def test_places_of_the_table_and_of_the_diagram_are_shown(page: browser.Browser, folder: Path) -> None:
    _visit(page, folder / "report.html")
    results = stored_results.read_results(folder)
    for number, point in enumerate(charts.measuring_points(results.part, results.summary)):
        page.value(f"document.querySelector('[data-point=\"{number}\"]').click()")
        read = page.value("({...document.getElementById('reading').dataset})")
        assert float(read["thickness"]) == pytest.approx(point.thickness, rel=3e-5)
        np.testing.assert_allclose(np.array(read["place"].split(","), float), point.formed, atol=2e-6)
    # The first point of the meridian is on the axis, the last one at the rim.
    for across, place in ((70 / 640, [0.0, 0.05]), (620 / 640, [0.1, 0.0])):
        page.value(
            "(it => (({left, top, width}) => it.dispatchEvent(new MouseEvent('click', "
            f"{{clientX: left + {across} * width, clientY: top + 9}})))(it.getBoundingClientRect()))"
            "(document.querySelector('svg.chart'))"
        )
        read = page.value("document.getElementById('reading').dataset.place.split(',').map(Number)")
        np.testing.assert_allclose([np.hypot(read[0], read[1]), read[2]], place, atol=1e-4)
    assert page.complaints == []


def test_frames_colours_and_limits(page: browser.Browser, folder: Path) -> None:
    box = _visit(page, folder / "report.html")
    assert page.value("document.getElementById('frame').max") == "2"
    _choose(page, "frame", "0", "input")
    flat = _click(page, box, 0.5, 0.5)
    assert float(flat["place"].split(",")[2]) == pytest.approx(0.0, abs=1e-5)
    assert float(flat["thickness"]) == pytest.approx(1e-3, rel=1e-4)
    _choose(page, "frame", "2", "input")
    _choose(page, "limit", "0.5", "input")
    part = stored_results.read_results(folder).part
    area = _areas(part.positions)
    share = 100 * area[part.cells["thickness"] < 5e-4].sum() / area.sum()
    assert float(page.value("document.getElementById('below').textContent").split()[0]) == pytest.approx(
        share, rel=5e-3
    )
    options = page.value("[...document.getElementById('quantity').options].map(({text}) => text)")
    assert options == [
        "wall thickness [mm]",
        "larger stretch",
        "smaller stretch",
        "area stretch",
        "time of contact [s]",
    ]
    _choose(page, "limit", "", "input")
    pictures = []
    for number in range(len(options)):
        _choose(page, "quantity", str(number))
        pictures.append(page.picture())
    assert all((one != other).any() for one, other in itertools.pairwise(pictures))
    assert page.complaints == []


def test_a_design_is_shown_beside_its_start(page: browser.Browser, design: Path) -> None:
    box = _visit(page, design / "report.html")
    wanted = [stored_results._part(design / name) for name in ("start.vtu", "final.vtu")]
    for across, part, label in ((0.25, wanted[0], "start of the search"), (0.75, wanted[1], "best design")):
        read = _click(page, box, across, 0.5)
        words = page.value("document.getElementById('reading').innerText")
        assert f"part\n{label}" in words and "wall there" in words
        place, corners = np.array(read["place"].split(","), float), part.positions[part.triangles[int(read["element"])]]
        assert np.linalg.norm(corners.mean(0) - place) < np.ptp(corners, axis=0).max()
    titles = page.value("[...document.querySelectorAll('h2')].map(({textContent}) => textContent)")
    for title in ("The search", "Wall along the meridian", "The initial sheet", "History of the search"):
        assert title in titles
    assert page.value("document.querySelectorAll('svg.chart').length") == 4
    assert page.complaints == [] and page.requests == [(design / "report.html").as_uri()]


def test_a_field_is_drawn_as_a_map(page: browser.Browser, design: Path, tmp_path: Path) -> None:
    field = 1e3 * _write_field(design, tmp_path / "field")
    _visit(page, report.write_report(tmp_path / "field"))
    drawn = "[...document.querySelectorAll('svg.map path:not(.axis)')]"
    assert page.value(
        f"{drawn}.map((path) => path.getAttribute('d').split('M').length - 1).reduce((a, b) => a + b)"
    ) == (len(SHEET.triangles))
    assert page.value(f"{drawn}.length") > 5  # shades
    legend = page.value("document.querySelector('.ramp').innerText")
    assert legend == f"initial thickness [mm]: {field.min():.3g}2" and "start: 2 everywhere" in page.value(
        "document.querySelector('.ramp').parentNode.innerText"
    )
    # The reading is that of the nearest node.
    box = page.value(
        "(({left, top, width}) => [left, top, width])(document.querySelector('svg.map').getBoundingClientRect())"
    )
    page.value(
        "document.querySelector('svg.map').dispatchEvent(new PointerEvent('pointermove', "
        f"{{clientX: {box[0] + 0.5 * box[2]}, clientY: {box[1] + 0.2 * box[2]}}}))"
    )
    value, place = page.value("document.querySelector('svg.map .value').textContent").split(" mm at (")
    away = np.hypot(*(1e3 * SHEET.positions[:, :2] - np.array(place.split(")")[0].split(","), float)).T)
    assert away.min() < 0.05 and float(value) == pytest.approx(field[np.argmin(away)], rel=1e-3)
    assert page.complaints == []


def test_a_map_of_a_tube_is_cut_off_at_one_turn(page: browser.Browser, design: Path, tmp_path: Path) -> None:
    _write_tube(design, tmp_path / "tube")
    _visit(page, report.write_report(tmp_path / "tube"))
    low, high, top, height = page.value(
        "(([field], texts) => ['-100', '100'].map((word) => texts.findLast((text) => text.textContent === word))"
        ".concat([field]).flatMap((node) => ['y', 'height'].map((name) => node.getAttribute(name))).filter(Boolean))"
        "([...document.querySelectorAll('svg.map svg')], [...document.querySelectorAll('svg.map text')]).map(Number)"
    )
    degree = (low - high) / 200.0
    assert height == pytest.approx(360.0 * degree, rel=1e-3)
    assert top + 0.5 * height == pytest.approx(0.5 * (low + high), abs=6.0)  # a word is beside its line
    page.value(
        "(({left, top, width, height}) => document.querySelector('svg.map').dispatchEvent(new PointerEvent("
        "'pointermove', {clientX: left + width / 2, clientY: top + height / 2})))"
        "(document.querySelector('svg.map').getBoundingClientRect())"
    )
    value, where = page.value("document.querySelector('svg.map .value').textContent").split(" mm at ")
    along, angle = (float(part.split()[0]) for part in where.split(", "))
    assert where.endswith(" degrees")
    assert float(value) == pytest.approx(1.0 + 0.3 * np.sin(np.radians(angle)) + 1e-3 * along, rel=1e-3)
    assert page.complaints == []


def test_without_webgl_the_tables_and_diagrams_are_there(page: browser.Browser, folder: Path) -> None:
    script = "HTMLCanvasElement.prototype.getContext = () => null"
    number = page.call("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"]
    page.visit(folder / "report.html", READY)
    page.call("Page.removeScriptToEvaluateOnNewDocument", identifier=number)
    assert page.value(READY) == "no"
    assert "no WebGL2" in page.value("document.getElementById('problem').innerText")
    assert page.value("document.querySelectorAll('svg.chart').length") == 1
    assert "0.0123" not in page.value("document.body.innerText")  # masses are in g
    assert "12.3 g" in page.value("document.body.innerText")


def test_the_energy_table_shows_what_is_released_with_its_sign() -> None:
    account = {"external_work": 24.0, "strain": 23.0, "refinement_loss": -0.06, "balance_error": 4e-4}
    text = report.page.energy({"energy": account | {"contact_loss": -1e-6, "quasi_static_error": 0.01}})
    assert "-0.25 %" in text and "95.8 %" in text and "0.04 % of the work" in text
    assert "&lt; 0.01 %" in text and "-&lt;" not in text
