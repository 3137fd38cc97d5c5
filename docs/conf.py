"""How `make docs` builds these pages as a site: outputs/site, without a network, a broken link being an error."""

import re
from pathlib import Path

import yaml
from sphinx.application import Sphinx

project = "SparseStreet"
html_title = project
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
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
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
# Types of annotations are of libraries, whose pages a build without a network cannot link to.
nitpick_ignore_regex = [("py:.*", ".*")]

CONF = Path(__file__).resolve().parents[1] / "conf"
GROUPS = "<!-- the groups of conf -->"
"""Where the page of options gets its tables."""
_PAGE = re.compile(r"`docs/([\w/]+\.md|datasets)/?`")


def groups_of(conf: Path) -> dict[str, dict[str, str]]:
    """Return for each group its options, each with the first sentence of its comment.

    An option is a file of the group's folder, or an entry of ``options/GROUP.yaml``.
    """
    groups: dict[str, dict[str, str]] = {}
    for path in sorted(conf.glob("*/**/*.yaml")):
        folder = path.parent.relative_to(conf)
        if folder.parts == ("options",):
            entries = yaml.safe_load(path.read_text())
            groups.setdefault(path.stem, {}).update({name: _said(path.read_text(), name) for name in entries})
        elif "base" not in folder.parts:  # what several options share
            option = path.relative_to(conf / folder.parts[0]).with_suffix("").as_posix()
            groups.setdefault(folder.parts[0], {})[option] = _said(path.read_text())
    return dict(sorted(groups.items()))


def _said(text: str, entry: str | None = None) -> str:
    """Return the first sentence of the comment above an entry, or at the head of a file."""
    lines = text.splitlines()
    if entry is None:
        lines = [line for line in lines if not line.startswith("# @package")]
        end = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
        start = 0
    else:
        end = next(i for i, line in enumerate(lines) if re.match(rf"""["']?{re.escape(entry)}["']?:""", line))
        start = end
        while start and lines[start - 1].startswith("#"):
            start -= 1
    words = " ".join(line.removeprefix("#").strip() for line in lines[start:end])
    if not words:
        target = re.search(r"_target_: \S*\.(\w+)$", "\n".join(lines[end:]), flags=re.M)
        return f"`{target[1]}`" if target else ""
    # A period, a colon or a bracket ends what fits into a cell.
    return re.split(r"(?<=\w)[.:;](?= |$)| \(", words)[0].replace("|", r"\|")


def tables_of(conf: Path) -> str:
    """Return a table for each group, in Markdown."""
    parts = []
    for group, options in groups_of(conf).items():
        rows = "".join(f"| `{name}` | {said} |\n" for name, said in options.items())
        parts.append(f"## {group}\n\n| option | what |\n|---|---|\n{rows}")
    return "\n".join(parts)


def _link_pages(app: Sphinx, page: str, source: list[str]) -> None:
    """Turn `docs/gpu.md` into a link with the page's title, and `docs/datasets` into one to its first page."""
    up = "../" * page.count("/")
    source[0] = _PAGE.sub(lambda found: f"[]({up}{found[1]}{'/README.md' * (found[1] == 'datasets')})", source[0])
    source[0] = source[0].replace(GROUPS, tables_of(CONF) if GROUPS in source[0] else "")


def setup(app: Sphinx) -> None:
    app.connect("source-read", _link_pages)
    app.connect("include-read", lambda app, path, page, content: _link_pages(app, page, content))
