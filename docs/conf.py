"""How `make docs` builds these pages as a site: outputs/site, without a network, a broken link being an error."""

import re

from sphinx.application import Sphinx

project = "SparseStreet"
html_title = project
extensions = ["myst_parser"]
myst_heading_anchors = 4
html_theme = "furo"
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
html_static_path = ["site"]
html_css_files = ["pages.css"]
exclude_patterns = ["site"]
# Blocks of commands and of messages need no colors.
highlight_language = "none"

_PAGE = re.compile(r"`docs/([\w/]+\.md|datasets)/?`")


def _link_pages(app: Sphinx, page: str, source: list[str]) -> None:
    """`docs/gpu.md` leads to that page, with its title; `docs/datasets` to that folder's first page."""
    up = "../" * page.count("/")
    source[0] = _PAGE.sub(lambda found: f"[]({up}{found[1]}{'/README.md' * (found[1] == 'datasets')})", source[0])


def setup(app: Sphinx) -> None:
    app.connect("source-read", _link_pages)
    app.connect("include-read", lambda app, path, page, content: _link_pages(app, page, content))
