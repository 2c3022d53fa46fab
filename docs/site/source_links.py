"""Changes links to files: those outside of the site become paths, copied pages are opened.

The site holds the pages only, and the files of `html_extra_path`. Sphinx would offer those for
download.
"""

import os
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

_LINK = re.compile(r"\[(?P<text>[^\]]+)\]\((?P<target>(?!https?:)[^)\s#]+)(?P<anchor>#[^)]*)?\)")


def setup(app: Sphinx) -> dict[str, Any]:
    """Registers the extension."""
    app.connect("source-read", _rewrite)
    return {"parallel_read_safe": True}


def _rewrite(app: Sphinx, page: str, source: list[str]) -> None:
    """Replaces links to files that are not pages of the site in the source of a page."""
    folder = Path(app.srcdir, page).parent
    root = Path(app.srcdir).parent
    copied = [Path(app.srcdir, name).resolve() for name in app.config.html_extra_path]

    def replace(match: re.Match[str]) -> str:
        target = (folder / match["target"]).resolve()
        if target in copied:
            address = Path(os.path.relpath(target, folder)).as_posix()
            return f'<a href="{address}{match["anchor"] or ""}">{match["text"]}</a>'
        in_site = target.is_relative_to(app.srcdir)
        in_site = in_site and "data" not in target.relative_to(app.srcdir).parts
        if in_site or not target.exists():
            return match[0]  # a link to nowhere is a warning of Sphinx
        path, text = str(target.relative_to(root)), match["text"].strip("`")
        return f"`{path}`" if text in path else f"{match['text']} (`{path}`)"

    source[0] = _LINK.sub(replace, source[0])
