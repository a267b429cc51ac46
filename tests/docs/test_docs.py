"""The documentation: it builds without a warning and without a network, and says what every key of a file means."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from jaxform.io import schema

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))

import reference_pages  # noqa: E402  (found by the line above)

NO_OBJECTS = {"molds", "plot", "scenes", "shapes"}
"""Public modules."""

MADE_BY_FUNCTIONS = {"Parison", "Part", "Trim", "Pressure", "Refinement", "Scene", "Solver", "Mold", "Motion"}
"""Records that are made by functions that are shown."""

OF_THE_COMMAND = {"COLUMNS", "Search", "doubts", "fitting"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--quiet", "--builder", "html", "docs", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def test_the_site_takes_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        loaded = re.findall(r"<(?:script|img|iframe)[^>]*\ssrc=\"([^\"]*)\"", page.read_text(encoding="utf-8"))
        loaded += re.findall(r"<link[^>]*rel=\"stylesheet\"[^>]*href=\"([^\"]*)\"", page.read_text(encoding="utf-8"))
        assert not [link for link in loaded if re.match(r"(https?:)?//", link)], page
    styles = " ".join(style.read_text(encoding="utf-8") for style in site.rglob("*.css"))
    assert not re.search(r"url\(\s*['\"]?https?:", styles)


def test_the_reference_names_every_public_name() -> None:
    """As its pages are written; that the site has them is asked of the built one."""
    import jaxform
    import optimize

    left_out = {"jaxform": NO_OBJECTS | MADE_BY_FUNCTIONS, "optimize": OF_THE_COMMAND}
    for module, page in ((jaxform, "python"), (optimize, "optimize")):
        text = (ROOT / "docs" / "reference" / f"{page}.md").read_text(encoding="utf-8")
        shown = set(re.findall(r"^\.\. auto\w+:: (?:\w+\.)*(\w+)", text, re.MULTILINE))
        assert not set(module.__all__) - left_out[module.__name__] - shown


def test_the_site_shows_formulas_notebooks_and_every_public_name(site: Path) -> None:
    import jaxform
    import optimize

    assert "<math" in (site / "explanation" / "method.html").read_text(encoding="utf-8")
    notebook = site / "_generated" / "notebooks" / "01_first_simulation.html"
    assert re.search(r"<img [^>]*\.png", notebook.read_text(encoding="utf-8"))
    text = (site / "reference" / "python.html").read_text(encoding="utf-8")
    missing = [
        name for name in set(jaxform.__all__) - NO_OBJECTS - MADE_BY_FUNCTIONS if f'id="jaxform.{name}"' not in text
    ]
    assert not missing
    text = (site / "reference" / "optimize.html").read_text(encoding="utf-8")
    assert not [name for name in set(optimize.__all__) - OF_THE_COMMAND if f'id="optimize.{name}"' not in text]


@pytest.mark.parametrize("model", [schema.SceneFile, schema.StudyFile])
def test_every_key_of_a_file_is_described_and_nothing_else_is(model: Any) -> None:
    found = reference_pages.tables(model)
    assert len(found) > 10
    for _, table in found:
        assert list(reference_pages.describe(table)) and set(reference_pages.describe(table)) == set(
            table.model_fields
        ), table


def test_links_between_pages_and_files_lead_somewhere() -> None:
    """As they are read in the repository; those of the site are checked when it is built."""
    pages = [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "benchmarks" / "README.md",
        *(ROOT / "docs").rglob("*.md"),
    ]
    for page in pages:
        if "_generated" in page.parts:
            continue
        for link in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8").replace("\n", " ")):
            made = "_generated" in link or link.startswith("http")
            assert made or (page.parent / link).exists(), f"{page.relative_to(ROOT)}: {link}"
