"""Tables of designs and designs of experiments: what is read, what is refused, and how a design is recognised."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import qmc

import jaxform
from jaxform.io import schema
from jaxform.io.validation import validate
from jaxform.sweeps import designs
from jaxform.sweeps.designs import DesignRow, sample
from tests import scenes

BOX = scenes.FILE.replace(
    scenes.FILE[scenes.FILE.index("[mold]") : scenes.FILE.index("fill = false")],
    '[mold]\nshape = "box-insert"\nsize = [0.3, 0.3]\n',
)


def _write(folder: Path, table: str, scene: str = scenes.FILE) -> Path:
    (folder / "scene.toml").write_text(scene)
    (folder / "table.csv").write_text(table)
    return folder / "table.csv"


def _designs(folder: Path, table: str, scene: str = scenes.FILE) -> list[DesignRow]:
    path = _write(folder, table, scene)
    return designs.make_designs(designs.read_table(path), folder / "scene.toml")


def _model(design: DesignRow) -> Any:
    assert design.document is not None, design.error
    return design.document.model


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("-0.5", -0.5),
        ("1.e-3", 1e-3),
        (" 2E4 ", 2e4),
        ("true", True),
        ("[1, 2.5]", [1, 2.5]),
        ('{ along = "radius", at = [0.0], value = [1.0] }', {"along": "radius", "at": [0.0], "value": [1.0]}),
        ("mold.stl", "mold.stl"),
        ("part #2.stl", "part #2.stl"),
        ("1,5", "1,5"),
        ("1_000", "1_000"),
        ("[1, 2", "[1, 2"),
        ("12345678901234567890123", 1.2345678901234568e22),
    ],
)
def test_a_cell_is_what_a_scene_file_would_have(text: str, value: Any) -> None:
    found = designs.parse_cell(text)
    assert found == value and type(found) is type(value)


def test_values_go_to_their_places_and_an_empty_cell_leaves_the_scenes_own(tmp_path: Path) -> None:
    table = (
        "mold.profile[0][1],pressure.value[-1],material.c,solver.damping,parison.element_size,name\n"
        "0.06,3.0e4,,50,0.02,deep\n\n"
        ",,0.3e6,,,\n"
    )
    deep, stiff = _designs(tmp_path, "\ufeff" + table)
    model = _model(deep)
    assert model.mold.profile == [[0.0, 0.06], [0.055, 0.05], [0.1, 0.0]]
    assert model.pressure.value == [0.0, 3.0e4] and model.solver.damping == 50 and model.name == "deep"
    assert (model.parison.element_size, model.parison.elements, model.material.c) == (0.02, None, 0.2e6)
    model = _model(stiff)
    assert (model.material.c, model.parison.elements, model.solver.damping) == (0.3e6, 40, 100.0)
    assert model.mold.profile[0] == [0.0, 0.05] and model.name == "small"
    assert (deep.number, stiff.number) == (1, 2) and deep.values["solver.damping"] == 50


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_columns_are_separated_by_commas_semicolons_or_tabs(tmp_path: Path, mark: str) -> None:
    lines = [["mold.depth", "mold.size"], ["0.06", '"[0.3, 0.2]"'], ["0.07", '"[0.2, 0.2]"']]
    path = _write(tmp_path, "\r\n".join(mark.join(line) for line in lines))
    assert designs.read_table(path).rows == [
        {"mold.depth": 0.06, "mold.size": [0.3, 0.2]},
        {"mold.depth": 0.07, "mold.size": [0.2, 0.2]},
    ]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", "is empty"),
        ("material.c\n", "has no designs"),
        ("material.c,\n1,2\n", "no name for column 2"),
        ("material.c,material.c\n1,2\n", "material.c: occurs twice"),
        ("material.c\n1,2\n", "has 2 cells in line 2, and 1 columns"),
        ("parison.thickness;material.c\n1,0e-3;2e5\n", r"thickness = '1,0e-3': has a decimal comma in line 2; write"),
        ("material.c,solver.damping\n1,2\n3\n", "has 1 cells in line 3"),
        ("material..c\n1\n", "is not a path of a scene file"),
        ("profile[x]\n1\n", "is not a path of a scene file"),
        ("\x00\x1b[2J\n1\n", "x1b[2J': is not a path of a scene file"),
        ('material.c\n"1\n', "is not a table"),
        ("solver.safty\n0.5\n0.6\n", "did you mean safety"),
        ("mould.depth\n0.1\n", "mould: is not a valid key here"),
        ("material.c[0]\n1e5\n", "is not a list in the scene"),
        ("pressure.value[7]\n1e4\n2e4\n", "is not there: the scene's list has 2 elements"),
        ("material.c.value\n1e5\n", "does not belong to a table of the scene"),
    ],
)
def test_a_table_that_is_wrong_for_every_design_is_refused(tmp_path: Path, table: str, words: str) -> None:
    with pytest.raises(jaxform.InputError, match=words.replace("[", r"\[")) as caught:
        _designs(tmp_path, table)
    assert "table.csv" in str(caught.value)


def test_an_empty_cell_is_drawn_at_the_number_of_the_scene(tmp_path: Path) -> None:
    """A key of the scene, an element of a list and a default have one; a text has none."""
    rows = _designs(tmp_path, "material.c,pressure.value[1],solver.safety,name\n1e5,,,\n,1e4,0.5,other\n")
    paths = ["material.c", "pressure.value[1]", "solver.safety", "name"]
    cells = [
        {"design": str(k + 1)} | {path: str(row.values.get(path, "")) for path in paths} for k, row in enumerate(rows)
    ]
    first, second = designs.complete_rows(cells, rows, paths)
    assert first["material.c"] == "100000.0" and first["name"] == ""
    assert float(first["pressure.value[1]"]) == 2e4 and float(first["solver.safety"]) == 0.9
    assert float(second["material.c"]) == 2e5 and second["pressure.value[1]"] == "10000.0"


def test_a_scene_that_is_wrong_is_refused_with_its_own_name(tmp_path: Path) -> None:
    with pytest.raises(jaxform.InputError, match=r"scene.toml: solver.end_tim.*did you mean end_time"):
        _designs(tmp_path, "material.c\n1e5\n2e5\n", scenes.FILE.replace("end_time", "end_tim"))
    with pytest.raises(jaxform.InputError, match="name one with --scene"):
        designs.make_designs(designs.read_table(tmp_path / "table.csv"), None)
    with pytest.raises(jaxform.InputError, match="is neither a file nor a built-in scene"):
        designs.make_designs(designs.read_table(tmp_path / "table.csv"), tmp_path / "none.toml")


def test_a_design_that_is_wrong_is_named_and_the_others_are_not(tmp_path: Path) -> None:
    table = "parison.thickness,mold.segments,pressure.value[1]\n1e-3,48,2e4\n-1,48,2e4\n1e-3,48.5,2e4\n1e-3,48,high\n"
    good, *bad = _designs(tmp_path, table)
    assert not good.error and good.document is not None
    assert [design.document for design in bad] == [None] * 3
    for design, words in zip(bad, ("parison.thickness = -1", "mold.segments = 48.5", "value[1] = 'high'"), strict=True):
        assert words in design.error and "scene.toml" not in design.error and "\n" not in design.error


def test_all_designs_may_be_wrong(tmp_path: Path) -> None:
    assert all(design.error for design in _designs(tmp_path, "parison.thickness\n-1\n-1\n"))


def test_a_list_element_that_is_not_there_is_named(tmp_path: Path) -> None:
    good, bad = _designs(tmp_path, 'pressure.value,pressure.value[2]\n"[0.0, 1e4, 2e4]",3e4\n,3e4\n')
    assert "pressure.value[2]" in bad.error and "2 elements" in bad.error
    assert "time" in good.error or good.document is None or _model(good).pressure.value == [0.0, 1e4, 3e4]


def test_files_are_sought_beside_the_table_then_beside_the_scene(tmp_path: Path) -> None:
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "old.stl").write_text("old")
    (tmp_path / "new.stl").write_text("new")
    text = BOX.replace('shape = "box-insert"\nsize = [0.3, 0.3]', 'shape = "file"\npath = "old.stl"')
    (tmp_path / "scenes" / "scene.toml").write_text(text)
    (tmp_path / "table.csv").write_text("mold.path\nnew.stl\nold.stl\n\ngone.stl\n")
    table = designs.read_table(tmp_path / "table.csv")
    made = designs.make_designs(table, tmp_path / "scenes" / "scene.toml")
    found = [_model(design).mold.path for design in made]
    assert found == [str(tmp_path / "new.stl"), str(tmp_path / "scenes" / "old.stl"), str(tmp_path / "gone.stl")]


def test_scenes_can_be_a_column(tmp_path: Path) -> None:
    (tmp_path / "box.toml").write_text(BOX)
    path = _write(tmp_path, "scene,parison.thickness\nbox.toml,2e-3\nscene.toml,\ndish-coarse,\nnone.toml,\n")
    box, small, dish, none = designs.make_designs(designs.read_table(path), None)
    assert _model(box).mold.shape == "box-insert" and _model(box).parison.thickness == 2e-3
    assert _model(small).mold.shape == "revolved" and dish.document is not None
    assert dish.document.name == "dish-coarse" and "none.toml" in none.error


def test_a_design_is_recognised_by_its_content(tmp_path: Path) -> None:
    mold = tmp_path / "mold.stl"
    mold.write_text("one")
    text = BOX.replace('shape = "box-insert"\nsize = [0.3, 0.3]', 'shape = "file"\npath = "mold.stl"')
    first, second = _designs(tmp_path, "material.c\n1e5\n2e5\n", text)
    swapped = _designs(tmp_path, "material.c,solver.safety\n2e5,\n1e5,\n1e5,0.5\n", text)
    assert [design.digest for design in swapped[:2]] == [second.digest, first.digest]
    assert len({design.digest for design in swapped}) == 3
    named = _designs(tmp_path, "material.c\n1e5\n", text.replace('"small"', '"other"'))
    assert named[0].digest == first.digest
    for change in (text.replace("alpha = 0.1", "alpha = 0.2"), text):
        if change is text:
            mold.write_text("two")
        assert _designs(tmp_path, "material.c\n1e5\n", change)[0].digest != first.digest


ADAPTED = scenes.FILE.replace("[material]", "adapt = {}\n[material]", 1)


@pytest.mark.parametrize(
    ("table", "meshes", "columns"),
    [
        ("material.c,parison.thickness,mold.friction\n1e5,,\n2e5,2e-3,\n,1e-3,0.2\n,,\n", 1, ""),
        ("pressure.value[1],solver.end_time\n1e4,0.04\n,\n", 1, ""),
        ("material.c,mold.profile[0][1]\n1e5,0.06\n2e5,0.06\n1e5,0.05\n2e5,0.05\n", 2, "mold.profile[0][1]"),
        ("parison.radius,parison.adapt.elements\n0.05,300\n0.06,300\n,400\n", 3, "parison.radius, parison.adapt.el"),
    ],
)
def test_designs_of_one_shape_share_an_adapted_mesh(tmp_path: Path, table: str, meshes: int, columns: str) -> None:
    contact = (
        ADAPTED.replace("[mold]", '[mold]\ncontact = "coulomb"\nfriction = 0.1') if "friction" in table else ADAPTED
    )
    made = _designs(tmp_path, table, contact)
    adapted = {repr(document.mesh_of or document) for document in (one.document for one in made) if document}
    assert len(adapted) == meshes
    sentence = designs.describe_meshes(designs.read_table(tmp_path / "table.csv"), made)
    assert sentence.startswith("one mesh for all " if meshes == 1 else f"{meshes} meshes for {len(made)} designs: ")
    assert columns in sentence


def test_a_design_on_a_shared_mesh_is_another_where_the_scene_of_that_mesh_changes(tmp_path: Path) -> None:
    (plain,) = _designs(tmp_path, "material.c\n1e5\n")
    assert designs.describe_meshes(designs.read_table(tmp_path / "table.csv"), [plain]) == ""
    first, again, other = (
        _designs(tmp_path, "material.c\n1e5\n", scene)[0].digest
        for scene in (ADAPTED, ADAPTED, ADAPTED.replace("c = 0.2e6", "c = 0.3e6"))
    )
    assert first == again != other


def test_units_are_those_of_the_scene_file(tmp_path: Path) -> None:
    model = _model(_designs(tmp_path, "material.c\n1e5\n")[0])
    units = {
        "material.c": "Pa",
        "material.alpha": "",
        "material.density": "kg/m^3",
        "parison.thickness": "m",
        "mold.profile[0][1]": "m",
        "mold.segments": "",
        "pressure.value[1]": "Pa",
        "pressure.time[1]": "s",
        "solver.damping": "1/s",
        "solver.end_time": "s",
    }
    assert {path: designs.unit_of(model, path) for path in units} == units


def _sweep(text: str) -> schema.SweepTable:
    return validate(schema.SweepFile, {"sweep": tomllib.loads(text)}, "study.toml").sweep


VARIABLES = """
[[variable]]
path = "mold.depth"
bounds = [0.04, 0.08]
[[variable]]
path = "material.c"
bounds = [1e5, 1e7]
scale = "log"
[[variable]]
path = "mold.segments"
bounds = [3, 5]
integer = true
[[variable]]
path = "mold.path"
values = ["a.stl", "b.stl"]
"""


def test_a_full_factorial_has_every_combination_of_levels() -> None:
    rows = sample(_sweep(VARIABLES))
    assert len(rows) == 3**3 * 2 and len({tuple(row.values()) for row in rows}) == len(rows)
    assert sorted({row["mold.depth"] for row in rows}) == pytest.approx([0.04, 0.06, 0.08])
    assert sorted({row["material.c"] for row in rows}) == pytest.approx([1e5, 1e6, 1e7])
    assert {row["material.c"] for row in rows} >= {1e5, 1e7}
    assert sorted({row["mold.segments"] for row in rows}) == [3, 4, 5]
    assert {type(row["mold.segments"]) for row in rows} == {int}
    assert {row["mold.path"] for row in rows} == {"a.stl", "b.stl"}


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_whole_numbers_lie_within_the_bounds(scale: str) -> None:
    text = f'[[variable]]\npath = "n"\nbounds = [1.4, 4.6]\ninteger = true\nlevels = 9\nscale = "{scale}"\n'
    assert [design["n"] for design in sample(_sweep(text))] == [2, 3, 4]


def test_a_latin_hypercube_has_one_design_in_each_slice_of_each_variable() -> None:
    rows = sample(_sweep(f'method = "latin-hypercube"\ndesigns = 30\nseed = 4\n{VARIABLES}'))
    depth = (np.sort([row["mold.depth"] for row in rows]) - 0.04) / 0.04
    log = (np.sort(np.log10([row["material.c"] for row in rows])) - 5) / 2
    for shares in (depth, log):
        assert np.array_equal(np.floor(30 * shares), np.arange(30))
    assert [sum(row["mold.segments"] == k for row in rows) for k in (3, 4, 5)] == [10, 10, 10]
    assert sum(row["mold.path"] == "a.stl" for row in rows) == 15


def test_a_sobol_sequence_is_that_of_scipy() -> None:
    text = 'method = "sobol"\ndesigns = 16\nseed = 7\n[[variable]]\npath = "a"\nbounds = [-1.0, 1.0]\n'
    text += '[[variable]]\npath = "b"\nbounds = [2.0, 4.0]\n'
    expected = qmc.scale(qmc.Sobol(2, rng=7).random(16), [-1.0, 2.0], [1.0, 4.0])
    np.testing.assert_allclose([[row["a"], row["b"]] for row in sample(_sweep(text))], expected, rtol=1e-14)
    with pytest.warns(jaxform.InputWarning, match="balanced for 8 or 16"):
        assert len(sample(_sweep(text.replace("designs = 16", "designs = 12")))) == 12


def test_the_seed_decides() -> None:
    text = f'method = "latin-hypercube"\ndesigns = 5\nseed = 1\n{VARIABLES}'
    assert sample(_sweep(text)) == sample(_sweep(text))
    assert sample(_sweep(text)) != sample(_sweep(text.replace("seed = 1", "seed = 2")))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "sweep.variable: is missing"),
        ('[[variable]]\npath = "a"\n', "bounds: is missing"),
        ('[[variable]]\npath = "a"\nbounds = [2.0, 1.0]\n', "does not increase"),
        ('[[variable]]\npath = "a"\nbounds = [0.0, 1.0]\nscale = "log"\n', "has no logarithm"),
        ('[[variable]]\npath = "a"\nbounds = [1.2, 1.4]\ninteger = true\n', "has no whole number between"),
        ('[[variable]]\npath = "a"\nbounds = [0.0, 1.0]\nvalues = [1]\n', "is given together with values"),
        ('method = "sobol"\n[[variable]]\npath = "a"\nbounds = [0.0, 1.0]\n', "sweep.designs: is missing"),
        ('designs = 4\n[[variable]]\npath = "a"\nbounds = [0.0, 1.0]\n', "cannot be combined with a full factorial"),
        ('[[variable]]\npath = "a"\nvalues = [1]\n[[variable]]\npath = "a"\nvalues = [2]\n', "occurs twice"),
        ('table = "t.csv"\n[[variable]]\npath = "a"\nvalues = [1]\n', "is given together with table"),
        ('method = "random"\n[[variable]]\npath = "a"\nvalues = [1]\n', "sweep.method = 'random'"),
    ],
)
def test_a_design_of_experiments_that_is_none_is_refused(text: str, words: str) -> None:
    with pytest.raises(jaxform.InputError) as caught:
        _sweep(text)
    assert words in str(caught.value)


def test_a_factorial_of_too_many_designs_is_refused() -> None:
    many = "".join(f'[[variable]]\npath = "p{k}"\nbounds = [0.0, 1.0]\nlevels = 10000\n' for k in range(5))
    with pytest.raises(jaxform.InputError, match="more than 1000000"):
        sample(_sweep(many))


def test_a_study_names_a_table_or_variables(tmp_path: Path) -> None:
    _write(tmp_path, "material.c\n1e5\n2e5\n")
    (tmp_path / "study.toml").write_text('scene = "scene.toml"\n[sweep]\ntable = "table.csv"\n')
    (_, folder, _), scene, rows = designs.read_sweep(tmp_path / "study.toml")
    assert rows.rows == [{"material.c": 1e5}, {"material.c": 2e5}]
    assert len(designs.make_designs(rows, scene, folder)) == 2
    (tmp_path / "study.toml").write_text('scene = "scene.toml"\n')
    with pytest.raises(jaxform.InputError, match="sweep: is missing"):
        designs.read_sweep(tmp_path / "study.toml")
