"""A scene whose mold has a rib between the nodes of its sheet is warned of when it is loaded, with place and size."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

import jaxform
from jaxform import shapes

SCENE = """
[parison]
shape = "rectangle"
size = [0.1, 0.1]
elements = {elements}
thickness = 1.0e-3
[material]
model = "mooney-rivlin"
c = 0.2e6
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0, 0.1]
value = [0.0, 4.0e4]
[mold]
shape = "file"
path = "mold.stl"
[solver]
end_time = 0.12
damping = 100.0
"""


def _write(folder: Path, elements: int, further: str = "", width: float = 0.0005) -> Path:
    """A scene of a sheet 30 mm below a plate on which a blade stands, towards the sheet, 18 mm high."""
    plate = trimesh.creation.box(bounds=[(-0.01, -0.01, 0.03), (0.11, 0.11, 0.04)])
    blade = trimesh.creation.box(bounds=[(0.0531, 0.02, 0.012), (0.0531 + width, 0.08, 0.031)])
    trimesh.util.concatenate([plate, blade]).export(folder / "mold.stl")
    path = folder / "scene.toml"
    path.write_text(SCENE.format(elements=elements) + further)
    return path


def test_a_blade_between_the_nodes_is_named(tmp_path: Path) -> None:
    with pytest.warns(jaxform.InputWarning, match=r"rib or pin at \(0\.053\S*, .*\) m that is 0\.018 m high"):
        jaxform.load(_write(tmp_path, 300))


def test_refinement_near_the_mold_is_counted(tmp_path: Path) -> None:
    """A blade of 5 mm is thinner than elements of 10 mm, but not than what four bisections near the mold leave."""
    further = "[refinement]\nangle = 4.0\ninterval = 64\nmax_level = 4\nbase_level = 4\n"
    with pytest.warns(jaxform.InputWarning, match="rib or pin"):
        jaxform.load(_write(tmp_path, 400, width=0.005))
    jaxform.load(_write(tmp_path, 400, further, width=0.005))


def test_the_remedies_are_possible(tmp_path: Path) -> None:
    """Elements half as wide as a blade of 0.5 mm would be too many; where edge contact is on, nothing warns."""
    with pytest.warns(jaxform.InputWarning, match=r"edge_contact = true") as said:
        jaxform.load(_write(tmp_path, 300))
    assert not any("element_size" in str(one.message) for one in said)
    with pytest.warns(jaxform.InputWarning, match=r"edge_contact = true.*element_size = 0.003\)"):
        jaxform.load(_write(tmp_path, 300, width=0.004))
    with warnings.catch_warnings():
        warnings.simplefilter("error", jaxform.InputWarning)
        jaxform.load(_write(tmp_path, 300, "edge_contact = true\n"))


def test_a_pin_within_an_element_is_warned_of_after_the_run_with_edge_contact(tmp_path: Path) -> None:
    """No side of an element meets it, so nothing is held; how far it comes through is said, and what to do."""
    sheet = shapes.rectangle(size=[0.1, 0.1], elements=72)
    middle = sheet.positions[sheet.triangles].mean(1)
    place = middle[np.argmin(np.linalg.norm(middle - 0.05, axis=1))]
    plate = trimesh.creation.box(bounds=[(-0.01, -0.01, 0.02), (0.11, 0.11, 0.03)])
    pin = trimesh.creation.cylinder(radius=3e-4, height=0.019, sections=8)
    pin.apply_translation((place[0], place[1], 0.0115))
    trimesh.util.concatenate([plate, pin]).export(tmp_path / "mold.stl")
    (tmp_path / "scene.toml").write_text(SCENE.format(elements=72) + "edge_contact = true\n")
    scene = jaxform.load(tmp_path / "scene.toml")
    result = jaxform.run(scene)
    assert result.held_sides == 0
    facts = jaxform.summarize(result, scene)
    assert facts["penetration_max"] == pytest.approx(0.018, abs=1e-4)
    np.testing.assert_allclose(facts["penetration_place"][:2], place[:2], atol=3e-4)
    words = (
        r"passed through a rib or pin of the mold in 1 place; at .* it stands 0\.018 m above the sheet .* no node met "
        r"it; "
        r".*make the elements smaller \(parison.* or parison\.elements\), run `jaxform adapt`, or "
        r"replace solver\.edge_contact by \[refinement\]"
    )
    assert any(re.search(words, warning) for warning in facts["warnings"]), facts["warnings"]
