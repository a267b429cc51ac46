"""Warnings of a sheet that reaches beyond the land of a mold half, where nothing pinches it."""

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
