"""Configures the documentation site: `make docs` builds it into build/docs."""

import re
import sys
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "site"))

from sphinx.ext.napoleon.docstring import GoogleDocstring  # noqa: E402

# Napoleon takes the text before a colon in the docstring of an attribute for its type.
GoogleDocstring._consume_inline_attribute = lambda self: ("", self._consume_to_end())

project = "emberlink"
version = release = installed("emberlink")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "reference_pages"]
exclude_patterns = ["data", "site"]

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
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
html_theme_options = {
    "navigation_depth": 2,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
copyright = "2026, the emberlink authors, MIT licence"

LINK = re.compile(r"\[(?P<text>[^\]]+)\]\((?P<target>(?!https?:)[^)\s#]+)(?:#[^)]*)?\)")


def setup(app: Any) -> None:
    """Shows links to files outside of the site, which Sphinx would copy, as paths."""
    app.connect("source-read", _show_paths)


def _show_paths(_: Any, page: str, source: list[str]) -> None:
    folder = (HERE / page).parent

    def shown(link: re.Match[str]) -> str:
        target = (folder / link["target"]).resolve()
        in_site = target.is_relative_to(HERE) and not target.is_relative_to(HERE / "data")
        if in_site or not target.exists():
            return link[0]  # a link to nowhere is a warning of Sphinx
        path, text = str(target.relative_to(HERE.parent)), link["text"].strip("`")
        return f"`{path}`" if text in path else f"{link['text']} (`{path}`)"

    source[0] = LINK.sub(shown, source[0])
