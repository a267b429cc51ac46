"""Tools of scene files: tables, errors in words, files of other folders, paths of studies and sweeps."""

from __future__ import annotations

import copy
import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import jaxform
from jaxform.cli import check_command
from jaxform.core import errors
from jaxform.core.store import Store
from jaxform.io import files, plausibility, plots, scene_rewriting
from jaxform.mesh import meshes
from jaxform.sweeps import designs
from jaxform.tools import molds
from optimize.variables import Scale
from tests import scenes

pytestmark = pytest.mark.quick
PLUG: dict[str, Any] = {
    "name": "plug",
    "shape": "rod",
    "radius": 0.02,
    "length": 0.05,
    "translate": [0.0, 0.0, -0.001],
    "direction": [0.0, 0.0, 2.0],
    "time": [0.0, 0.05],
    "displacement": [0.0, 0.03],
    "contact": "coulomb",
    "friction": 0.2,
}


def _tables(tools: Any, **others: Any) -> dict[str, Any]:
    tables = {key: value for key, value in tomllib.loads(scenes.FILE).items() if key != "mold"}
    return copy.deepcopy({**tables, "tool": tools, **others})


def _document(tools: Any, **others: Any) -> files.SceneDocument:
    return files.validate_scene(_tables(tools, **others), "s.toml", Path("."))


def _plug(**changes: Any) -> dict[str, Any]:
    return {key: value for key, value in (PLUG | changes).items() if value is not None}


def _over(**changes: Any) -> dict[str, Any]:
    """A friction over the temperature."""
    return {"along": "temperature", "at": [90.0, 130.0], "value": [0.15, 0.5]} | changes


def test_a_friction_over_the_temperature_is_read_named_and_written_again(tmp_path: Path) -> None:
    document = _document([_plug(friction=_over())])
    document.data["parison"]["temperature"] = 120.0
    document = files.validate_scene(document.data, "s.toml", Path("."))
    scene = files.build_unchecked(document)
    law = scene.tools[0].contact
    assert isinstance(law, jaxform.Coulomb)
    np.testing.assert_array_equal(law.temperature, [90.0, 130.0])
    np.testing.assert_array_equal(law.friction, [0.15, 0.5])
    lines = list(check_command.scene_lines(document, scene, Store()))
    words = "nodes on it slide with friction (coulomb, friction 0.15 to 0.5 over the sheet's temperature)"
    assert any(line.endswith(words) for line in lines)
    written = scene_rewriting.write_scene(document, {"tool.plug.friction": np.array([0.2, 0.4])}, tmp_path)
    again = jaxform.load(written).tools[0].contact
    assert isinstance(again, jaxform.Coulomb)
    np.testing.assert_array_equal(again.friction, [0.2, 0.4])
    np.testing.assert_array_equal(again.temperature, [90.0, 130.0])


def test_a_file_with_tools_makes_a_scene_with_them() -> None:
    plate = {
        "shape": "plate",
        "size": [0.2, 0.1],
        "translate": [-0.1, -0.05, 0.06],
        "contact": "slide",
        "friction": 0.0,
    }
    scene = files.build_unchecked(_document([PLUG, plate]))
    plug, below = scene.tools
    assert (plug.name, below.name) == ("plug", "tool2")
    assert isinstance(plug.contact, jaxform.Coulomb) and float(plug.contact.friction) == 0.2
    assert isinstance(below.contact, jaxform.Slide)
    assert plug.motion is not None and below.motion is None
    np.testing.assert_allclose(np.asarray(plug.motion.direction), [0.0, 0.0, 1.0])
    np.testing.assert_allclose(np.asarray(plug.vertices)[:, 2].max(), -0.001)
    np.testing.assert_allclose(np.asarray(below.vertices).min(0), [-0.1, -0.05, 0.06])
    with_mold = files.build_unchecked(_document([], mold={"shape": "plate", "radius": 0.1, "translate": [0, 0, 0.02]}))
    assert with_mold.mold is not None and with_mold.tools == () and with_mold.mold.contact.sticks


@pytest.mark.parametrize(
    ("tools", "words"),
    [
        ({"plug": PLUG}, "tool = .*: is not a list of tools; write each tool as a section \\[\\[tool\\]\\]"),
        ([PLUG, PLUG], "tool\\[1\\].name = 'plug': is the name of another tool"),
        ([_plug(name="Mold")], "tool\\[0\\].name = 'Mold': is the name of the mold"),
        ([_plug(name="")], "tool\\[0\\].name = '': cannot be the name of a tool"),
        ([_plug(name="../x")], "tool\\[0\\].name = '../x': cannot be"),
        ([_plug(name=1)], "tool\\[0\\].name = 1: is not a string"),
        ([_plug(friction=-0.1)], "tool.plug.friction = -0.1: is too small"),
        ([_plug(friction=float("nan"))], "tool.plug.friction = nan: is not finite"),
        ([_plug(friction="0.2")], "tool.plug.friction = '0.2': is not a number"),
        ([_plug(friction=None)], "tool.plug.friction: is missing, and contact is coulomb; give the coefficient"),
        ([_plug(contact=None)], "tool.plug.friction = 0.2: has no effect with contact = stick"),
        ([_plug(contact="slide")], "tool.plug.friction = 0.2: has no effect with contact = slide"),
        ([_plug(friction=_over(value=[0.1]))], "tool.plug.friction.value = \\[0.1\\]: has 1 values for 2 knots"),
        ([_plug(friction=_over(value=[0.1, -0.1]))], "tool.plug.friction.value\\[1\\] = -0.1: is too small"),
        ([_plug(friction=_over(at=[130.0, 90.0]))], "tool.plug.friction.at = \\[130.0, 90.0\\]: does not increase"),
        ([_plug(friction=_over(along="radius"))], "tool.plug.friction.along = 'radius': is unknown; use 'temperature'"),
        (
            [_plug(friction=_over(), contact="slide")],
            "tool.plug.friction = \\[0.15, 0.5\\]: has no effect with contact = slide",
        ),
        ([_plug(contact="glue")], "tool.plug.contact = 'glue': is unknown; use 'stick', 'coulomb' or 'slide'"),
        ([_plug(direction=None)], "tool.plug.direction: is missing, but time is given"),
        ([_plug(displacement=None)], "tool.plug.displacement: is missing, but direction is given"),
        ([_plug(direction=[0.0, 0.0, 0.0])], "tool.plug.direction = .*: is not a direction"),
        ([_plug(time=[0.1, 0.1])], "tool.plug.time = .*: the knots do not increase"),
        ([_plug(displacement=[0.0])], "tool.plug.displacement = .*: is too short"),
        ([_plug(displacement=[0.0, 1.0, 2.0])], "tool.plug.displacement: 2 times and 3 displacements"),
        ([_plug(displacement=[0.1, 0.2])], "tool.plug.displacement = 0.1: .* place the surface .*\\(translate\\)"),
        ([_plug(direction=[1.0, 0.0, 0.0])], "tool.plug.direction = .*: the tool plug moves across a symmetry plane"),
        ([_plug(temperature=40.0)], "tool.plug.temperature = 40.0: has no effect, for the sheet does not cool"),
        ([_plug(heat_transfer=9.0)], "tool.plug.heat_transfer = 9.0: has no effect"),
        ([_plug(shape="cone")], "tool.plug.shape = 'cone': is unknown"),
        ([_plug(length=0.01)], "tool.plug.length = 0.01: is not more than the rounding"),
        ([_plug(end_radius=0.03)], "tool.plug.end_radius = 0.03: is not between 0 and the radius"),
        ([_plug(fill=True)], "tool.plug.fill: is not a valid key"),
        ([_plug(translate=[0.0, 0.0])], "tool.plug.translate = .*: is too short"),
        ([{"name": "base", "shape": "plate"}], "tool.base.size: is missing; give size = \\[a, b\\] or radius"),
        ([{"name": "base", "shape": "file", "path": "no.stl"}], "tool.base.path = .*no.stl.*: does not exist"),
        ([3], "tool\\[0\\] = 3: is not a table"),
        (
            [_plug(translate=[0.02, 0.02, 0.03])],
            "tool.plug: the parison initially penetrates the tool plug, .*move the tool plug",
        ),
        # A ring of its vertices, and edges between them, lie in the sheet.
        ([_plug(translate=[0.0, 0.0, 0.01])], "tool.plug: the parison initially penetrates the tool plug, "),
    ],
)
def test_errors_name_the_tool(tools: Any, words: str) -> None:
    with pytest.raises(jaxform.InputError, match=f"^s.toml: {words}"):
        files.build_unchecked(_document(tools))


def test_a_tool_cools_by_its_own_numbers_or_by_those_of_the_mold() -> None:
    cooling = {"heat_capacity": 2000.0, "mold": 500.0, "mold_temperature": 40.0}
    others = [_plug(temperature=60.0, heat_transfer=5.0), _plug(name="second", translate=[0.06, 0.0, -0.001])]
    tables = _tables(others, cooling=cooling)
    tables["parison"]["temperature"] = 140.0
    document = files.validate_scene(tables, "s.toml", Path("."))
    scene = files.build_unchecked(document)
    (line,) = [one for one in check_command.scene_lines(document, scene, Store()) if "cools the sheet" in one]
    assert line.startswith("the tool plug") and line.endswith(
        " with its own temperature 60 degC, heat transfer 5 W/(m² K)"
    )
    assert scene.tool_warmth is not None
    own, general = [tuple(map(float, warmth)) for warmth in scene.tool_warmth]
    assert own == (5.0, 60.0) and general == (500.0, 40.0)
    with pytest.raises(jaxform.InputError, match=r"tool.plug.temperature = -300.0: is too small"):
        _document([_plug(temperature=-300.0)], cooling=cooling)
    with pytest.raises(jaxform.InputError, match=r"tool.plug.heat_transfer = -1.0: is too small"):
        _document([_plug(heat_transfer=-1.0)], cooling=cooling)


def test_a_tool_alone_may_form_the_sheet_but_not_one_that_rests() -> None:
    tables = _tables([PLUG])
    tables.pop("pressure")
    files.validate_scene(tables, "s.toml", Path("."))
    tables["tool"] = [_plug(direction=None, time=None, displacement=None)]
    with pytest.raises(
        jaxform.InputError, match=r"pressure: is missing, and nothing else moves the sheet; give .*tool"
    ):
        files.validate_scene(tables, "s.toml", Path("."))


def test_rods_are_closed_and_as_large_as_they_say() -> None:
    for end, low in ((None, 0.0), (0.005, 0.015), (0.0, 0.02)):
        made = molds.rod(radius=0.02, length=0.05, end_radius=end, segments=32)
        corners = made.vertices[made.triangles]
        volume = abs(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum()) / 6
        edges = np.sort(made.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)
        np.testing.assert_allclose([made.vertices[:, 2].min(), made.vertices[:, 2].max()], [-0.05, 0.0], atol=1e-15)
        flat = np.hypot(*made.vertices[made.vertices[:, 2] == 0.0].T[:2]).max()
        np.testing.assert_allclose(flat, low, atol=1e-12)
        rounding = 0.02 if end is None else end
        lost = np.pi * rounding**3 / 3 if end is None else 0.0
        if end in (None, 0.0):
            np.testing.assert_allclose(volume, np.pi * 0.02**2 * 0.05 - lost, rtol=0.015)


def test_a_design_with_tools_runs_from_another_folder(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    made = molds.rod(radius=0.02, length=0.05, segments=12)
    meshes.write_stl(tmp_path / "a" / "plug.stl", 1e3 * made.vertices, made.triangles)
    of_file = _plug(shape="file", radius=None, length=None, path="plug.stl", scale=1e-3)
    document = files.validate_scene(_tables([of_file]), "s.toml", tmp_path / "a")
    written = scene_rewriting.write_scene(document, {"tool.plug.friction": 0.3}, tmp_path)
    scene = jaxform.load(written)
    assert float(scene.tools[0].contact.friction) == 0.3  # pyright: ignore
    assert scene_rewriting.referenced_files(document) == [tmp_path / "a" / "plug.stl"]
    shutil.rmtree(tmp_path / "a")
    with pytest.raises(jaxform.InputError, match=r"best.toml: tool.plug.path = .*plug.stl"):
        jaxform.load(written)


def test_studies_name_numbers_of_tools_as_the_file_does() -> None:
    scene = files.build_unchecked(_document([PLUG]))
    for key, value in (("friction", 0.2), ("displacement", [0.0, 0.03]), ("time", [0.0, 0.05])):
        scale = Scale(scene, of=f"tool.plug.{key}", bounds=(0.5, 2.0))
        np.testing.assert_allclose(scale.document(jnp.asarray(scale.start))[f"tool.plug.{key}"], value, rtol=1e-12)
        jaxform.replace(scene, scale.changes(jnp.asarray(scale.start)))
    words = (
        r"^variable.of = 'tool.pug.friction': is not a number of the scene; those of its tools are tool.plug.friction, "
    )
    with pytest.raises(jaxform.InputError, match=words):
        Scale(scene, of="tool.pug.friction", bounds=(0.5, 2.0))


CUP = {"shape": "revolved", "profile": [[0.0, 0.05], [0.07, 0.05], [0.1, 0.0]], "segments": 48}


@pytest.mark.parametrize(
    ("tools", "words"),
    [
        ([PLUG], []),
        ([_plug(displacement=[0.0, 0.06])], ["tool.plug: meets the mold at 0.0387 s, near "]),
        (
            [_plug(translate=[0.0, 0.0, -0.02], displacement=[0.0, 0.015])],
            ["tool.plug: never reaches the sheet: .*farther"],
        ),
        (
            [_plug(time=[9.0, 9.1])],
            ["tool.plug: never reaches the sheet: it begins to move at 9 s, and the run ends at "],
        ),
        ([_plug(direction=[0.0, 0.0, -1.0])], ["tool.plug: never reaches the sheet: .* reverse tool.plug.direction"]),
        ([_plug(translate=[0.026, 0.003, 0.01], radius=5e-4, segments=6)], ["tool.plug: starts in the sheet, near "]),
        # A ring of its vertices lies in the sheet: inside of an element, or at its pole alone.
        ([_plug(translate=[0.026, 0.003, 2.5e-4], radius=5e-4)], ["tool.plug: starts in the sheet, near "]),
        ([_plug(translate=[0.026, 0.003, 0.0], radius=5e-4)], []),
        (
            [_plug(radius=20.0, length=50.0, translate=[0.0, 0.0, -0.5])],
            ["tool.plug: the tool plug is 250 times .*milli"],
        ),
        # In milliseconds, or in a run that ends too early: it is said once.
        (
            [_plug(time=[0.0, 50.0])],
            ["tool.plug.time = .*: the tool plug is 0.03 m from the end of its way .*; give the times in seconds"],
        ),
        ([_plug(time=[0.0, 1e-4])], ["tool.plug.time = .*: the tool plug moves at 300 m/s, faster than waves"]),
        (
            [PLUG, _plug(name="stop", translate=[0.01, 0.0, -0.001], direction=None, time=None, displacement=None)],
            [
                "tool.stop: reaches 30 mm before .* x = 0 m, and 10 mm beyond it",
                "tool.stop: meets the tool plug at the start, ",
            ],
        ),
        # Two that move side by side, and one that follows another, do not meet.
        ([PLUG, _plug(name="ring", shape="plate", length=None, translate=[0.0, 0.0, -0.1])], []),
    ],
)
def test_check_warns_of_tools(tools: Any, words: list[str]) -> None:
    document = _document(tools, mold={**CUP, "fill": False})
    scene = files.build_unchecked(document)
    told: list[str] = []
    with errors.redirect_warnings(told.append):
        files.review_scene(scene, document)
    assert len(told) == len(words), told
    for text, expected in zip(told, words, strict=True):
        assert re.match(f"s.toml: {expected}", text), text


def test_a_plug_that_passes_through_the_sheet_reaches_it() -> None:
    """However fast and thin: no time at which it is looked at has it near to a node."""
    pin = _plug(radius=0.004, length=0.01, translate=[0.021, 0.013, -0.02], displacement=[0.0, 0.05])
    document = _document([pin], pressure={"time": [0.0], "value": [0.0]})
    scene = files.build_unchecked(document)
    away, _ = plausibility._ways_from_sheet(scene, scene.tools[0])
    assert min(away) > 1e-4 * 0.2
    told: list[str] = []
    with errors.redirect_warnings(told.append):
        files.review_scene(scene, document)
    assert told == []


def test_tools_meet_where_they_do() -> None:
    scene = files.build_unchecked(_document([_plug(displacement=[0.0, 0.06])], mold=CUP))
    ((one, other, time, place),) = plausibility.find_meetings(scene)
    assert one is scene.mold and other is scene.tools[0]
    reached = -0.001 + float(other.motion.offset(jnp.asarray(time))[2])  # pyright: ignore
    # The tip is in the bottom of the cup at that time, and one compared time earlier it was not.
    assert 0.05 < reached < 0.053
    np.testing.assert_allclose(place[2], 0.05, atol=2e-3)


def test_check_tells_of_tools_and_draws_them(tmp_path: Path) -> None:
    document = _document([_plug(time=[0.0, 0.02, 0.04], displacement=[0.0, 0.04, 0.01])], mold=CUP)
    scene = files.build_unchecked(document)
    lines = list(check_command.scene_lines(document, scene, Store()))
    assert "tool plug: 1248 triangles; -0.02 to 0.02 x -0.02 to 0.02 x -0.051 to -0.001 m" in lines
    way = "by 0.04 m at 0.02 s, 0.01 m at 0.04 s"
    law = "nodes on it slide with friction (coulomb, friction 0.2)"
    assert f"the tool plug moves along (0, 0, 1), {way}; {law}" in lines
    assert not any(line.startswith("skipped") and "contact" in line for line in lines)
    drawn = {name: faces for name, *_, faces in plots._tool_lines(scene)}
    assert list(drawn) == ["mold", "plug", "plug, farthest", "plug at the end"]
    tips = [faces[..., 2].max() for faces in drawn.values()]
    np.testing.assert_allclose(tips, [0.05, -0.001, 0.039, 0.009], atol=1e-12)
    plots.check_picture(tmp_path / "check.png", scene)
    with Image.open(tmp_path / "check.png") as picture:
        assert picture.size == (1600, 750)


def test_a_revolved_mold_and_plug_need_no_number_of_segments() -> None:
    """They have 96, of which the facets miss the circle by 0.05 % of its radius."""
    profile = [[0.0, 0.05], [0.07, 0.05], [0.1, 0.0]]
    plug = {"name": "plug", "shape": "revolved", "profile": [[0.0, -0.01], [0.02, -0.02]]}
    scene = files.build_unchecked(_document([plug], mold={"shape": "revolved", "profile": profile}))
    assert scene.mold is not None
    np.testing.assert_array_equal(scene.mold.vertices, molds.revolved(profile=profile, segments=96).vertices)
    assert len(scene.tools[0].vertices) == 97
    miss = 0.1 - np.linalg.norm(np.asarray(scene.mold.vertices)[-2:, :2].mean(0))
    assert 0.04e-3 < miss < 0.06e-3


def test_the_image_of_a_tool_moves_to_the_symmetry_plane_as_the_tool_does() -> None:
    """As the two halves of a mold that close on a tube."""
    half = _plug(name="half", translate=[0.05, 0.05, -0.06], direction=[-1.0, 0.0, 0.0], displacement=[0.0, 0.03])
    scene = files.build_unchecked(_document([half], mold=CUP))
    drawn = {name: faces for name, *_, faces in plots._tool_lines(scene)}
    for name, (near, far) in {"half": (0.03, 0.07), "half at the end": (0.0, 0.04)}.items():
        x = drawn[name][..., 0]
        np.testing.assert_allclose([np.abs(x).min(), x.max(), -x.min()], [near, far, far], atol=1e-9)


def test_sweeps_name_tools() -> None:
    tables = _tables([PLUG])
    for path, unit in (("tool.plug.radius", "m"), ("tool[0].length", "m"), ("tool.plug.displacement[1]", "m")):
        designs.set_value(tables, path, 0.025)
        assert designs.unit_of(_document([PLUG]).model, path) == unit
    assert tables["tool"][0] == PLUG | {"radius": 0.025, "length": 0.025, "displacement": [0.0, 0.025]}
    with pytest.raises(jaxform.InputError, match=r"tool.pug.radius: is not a tool of the scene; its tools are plug"):
        designs.set_value(tables, "tool.pug.radius", 0.1)
    del tables["tool"]
    with pytest.raises(jaxform.InputError, match=r"tool.plug.radius: is not a tool of the scene, which has none"):
        designs.set_value(tables, "tool.plug.radius", 0.1)
