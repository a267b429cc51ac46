"""How the site is built: `make docs`, into out/docs. Sphinx and Furo work without a network, and any warning fails.

The reference of scene and study files is written from the schema, that of the command from its parser, that of Python
from docstrings; the notebooks are rendered as they are committed.
"""

import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path[:0] = [str(ROOT), str(DOCS)]

import reference_pages  # noqa: E402  (found by the line above)

project = "jaxform"
copyright = "the authors of jaxform"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "mathml"]
exclude_patterns = ["**.ipynb_checkpoints"]
html_theme = "furo"
html_title = "jaxform"
html_show_sphinx = False
html_math_renderer = "mathml"
html_copy_source = False
html_theme_options = {"top_of_page_buttons": []}

nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_use_rtype = False
nitpicky = True
# Types of other packages, and of ours that no page shows.
nitpick_ignore_regex = [("py:class", r"(jax|numpy|collections|jaxform|optimize)\..*")]

GENERATED = DOCS / "_generated"
shutil.rmtree(GENERATED, ignore_errors=True)
reference_pages.write(GENERATED)
shutil.copytree(ROOT / "notebooks", GENERATED / "notebooks", ignore=shutil.ignore_patterns(".*"))
