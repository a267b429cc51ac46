"""Warnings of a sheet that reaches beyond the land of a mold half, and of a half that does not close."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import pytest

import jaxform

SCENE = (files("jaxform.scenes") / "extrusion-bottle.toml").read_text().replace("elements = 2400", "elements = 300")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # The tube's lower end is 25 mm below the land; the flattened tube is 25 mm wide to either side of a neck of 20.
        ("land = 0.035", "land = 0.005", r"mold\.land.*extends to.*wider, or the sheet shorter"),
        ("radius = 0.016", "radius = 0.05", r"mold\.land.*is spread to.*not pinched"),
        ("length = 0.26", "length = 0.30", r"mold\.land.*extends to"),
    ],
)
def test_film_beyond_the_land_is_warned_of(tmp_path: Path, old: str, new: str, words: str) -> None:
    file = tmp_path / "scene.toml"
    text = SCENE.replace(old, new)
    if old.startswith("radius"):
        text = text.replace("translate = [0.02, 0.0, 0.03]", "translate = [0.06, 0.0, 0.03]").replace("0.02]", "0.06]")
    file.write_text(text)
    with pytest.warns(jaxform.InputWarning, match=words):
        jaxform.load(file)


def test_a_land_that_covers_the_sheet_is_no_warning(tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(re.sub("land = 0.035", "land = 0.031", SCENE))
    jaxform.load(file)  # warnings are errors here


@pytest.mark.parametrize(
    ("old", "new", "millimetres"),
    [
        ("displacement = [0.0, 0.02]", "displacement = [0.0, 0.018]", "2"),
        ("[-1.0, 0.0, 0.0]", "[0.0, -1.0, 0.0]", "20"),
    ],
)
def test_a_half_that_ends_before_the_symmetry_plane_is_warned_of(
    tmp_path: Path, old: str, new: str, millimetres: str
) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(SCENE.replace(old, new))
    words = f"motion.displacement: .* ends {millimetres} mm from the symmetry plane x = 0 m, so that it pinches nothing"
    with pytest.warns(jaxform.InputWarning, match=words):
        jaxform.load(file)


def test_a_blow_pin_does_not_meet_the_parting_plane(tmp_path: Path) -> None:
    """The plate is behind the symmetry plane by a rounding, of float32 too: by 0.02 mm. Half of the pin is beyond."""
    file = tmp_path / "scene.toml"
    file.write_text(SCENE.replace("translate = [0.0, -0.07, -0.01]", "translate = [-2.0e-5, -0.07, -0.01]"))
    jaxform.load(file)  # warnings are errors here
