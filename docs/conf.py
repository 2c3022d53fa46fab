"""Configures the documentation site: `make docs` builds it into build/docs."""

import sys
from importlib.metadata import version as installed
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "site"))

from sphinx.ext.napoleon.docstring import GoogleDocstring  # noqa: E402

# Napoleon takes the text before a colon in the docstring of an attribute for its type.
GoogleDocstring._consume_inline_attribute = lambda self: ("", self._consume_to_end())

project = "emberlink"
author = "the emberlink authors"
version = release = installed("emberlink")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "maths",
    "reference_pages",
    "source_links",
]
exclude_patterns = ["data", "site"]
nitpicky = False

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "dollarmath"]
html_math_renderer = "mathml"
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True

default_role = "literal"
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_numpy_docstring = False
napoleon_use_rtype = False

html_static_path = ["_static"]
html_extra_path = ["replay.html"]
html_css_files = ["site.css"]
html_theme = "pydata_sphinx_theme"
html_context = {"default_mode": "auto"}
html_title = f"emberlink {version}"
html_copy_source = False
html_show_sourcelink = False
html_show_search_summary = False  # a page opened from a file cannot read other files
html_theme_options = {
    "navigation_depth": 2,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
copyright = "2026, the emberlink authors, MIT licence"
