"""What the pages say of the code: files that they name, the floors, the options of conf."""

import fnmatch
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from sparsestreet import __version__

ROOT = Path(__file__).parents[1]
EVERY_PAGE = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
PAGES = [page for page in EVERY_PAGE if page.name != "CHANGELOG.md" and page.parent.name != "results"]
"""Without those that also name what has been."""
ROOMS = (ROOT, ROOT / "sparsestreet", ROOT / "tests", ROOT / "conf")
WRITTEN = {"outputs", "build", "records", "pictures"}
"""Folders that a build or a run writes."""
TOPS = {path.name for room in ROOMS for path in room.iterdir() if path.name[0] not in "._"} - WRITTEN


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_is_named_is_there(page):
    named = re.findall(r"(?<![\w/.$-])(?:[\w.-]+/)+(?:[\w*.-]*\w)?", page.read_text())
    named = {name for name in named if name.partition("/")[0] in TOPS}
    assert [name for name in named if not any(list(room.glob(name.rstrip("/"))) for room in ROOMS)] == []


@pytest.mark.parametrize("page", EVERY_PAGE, ids=lambda page: page.name)
def test_every_link_leads_to_a_file(page):
    links = re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text())
    assert [link for link in links if not (page.parent / link).is_file()] == []


def test_every_page_of_results_is_linked():
    linked = set(re.findall(r"\(results/(\w+\.md)\)", (ROOT / "docs" / "results.md").read_text()))
    assert linked == {page.name for page in (ROOT / "docs" / "results").glob("*.md")}


def test_every_page_stands_in_the_navigation_of_the_site_once():
    trees = re.findall(r"```\{toctree\}\n(.*?)```", (ROOT / "docs" / "index.md").read_text(), flags=re.S)
    named = re.findall(r"^(?!:)(?:.* <)?([\w/*\[\]]+)>?$", "".join(trees), flags=re.M)
    pages = {page.relative_to(ROOT / "docs").with_suffix("").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    assert sorted(page for name in named for page in fnmatch.filter(pages, name)) == sorted(pages - {"index"})
    assert [name for name in named if not fnmatch.filter(pages, name)] == []


@pytest.mark.slow
def test_the_site_is_built_and_a_broken_link_is_an_error(tmp_path):
    pytest.importorskip("furo", reason="pip install 'sparsestreet[docs]'")
    build = [sys.executable, "-m", "sphinx", "-q", "-E", "-W", "-n", "-d", str(tmp_path / "trees")]
    subprocess.run([*build, str(ROOT / "docs"), str(tmp_path / "site")], check=True)
    page = (tmp_path / "site" / "index.html").read_text()
    assert "datasets/own_log.html" in page
    assert re.findall(r"<(?:script|img|link|iframe)[^>]*=\"(?:https?:)?//", page) == []  # nothing is loaded
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    shutil.copy(ROOT / "README.md", tmp_path)
    with (tmp_path / "docs" / "gpu.md").open("a") as file:
        file.write("\n[lost](scaling.md#there-is-no-such-heading)\n")
    broken = subprocess.run([*build, str(tmp_path / "docs"), str(tmp_path / "site")], capture_output=True, text=True)
    assert broken.returncode != 0
    assert "there-is-no-such-heading" in broken.stderr


def test_the_citation_names_the_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    assert f"version = {{{__version__}}}" in (ROOT / "docs" / "cite.md").read_text()
    assert citation["references"][0]["doi"] in (ROOT / "docs" / "cite.md").read_text()


def test_the_last_release_of_the_changelog_is_the_version():
    releases = re.findall(r"^## (\d\S*) - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), flags=re.M)
    assert releases[0] == __version__


def test_the_floors_are_those_of_the_import_contract():
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    floors = [layer.replace("sparsestreet.", "") for layer in contract["layers"]]
    assert "```\n" + "\n".join(floors) + "\n```" in (ROOT / "docs" / "architecture.md").read_text()


def test_every_group_of_conf_is_explained():
    page = (ROOT / "docs" / "architecture.md").read_text()
    cells = re.findall(r"^\| (`[a-z_`, ]+`) \| (.*) \|$", page, flags=re.M)
    said = {group: text for groups, text in cells for group in re.findall(r"\w+", groups)}
    folders = [path for path in (ROOT / "conf").iterdir() if path.is_dir()]
    assert said.keys() == {folder.name for folder in folders}
    for folder in folders:
        options = {path.stem for path in folder.glob("*.yaml")}
        if folder.name in ("method", "sparsify", "schedule", "experiment"):
            assert options == set(re.findall(r"`(\w+)`", said[folder.name]))
