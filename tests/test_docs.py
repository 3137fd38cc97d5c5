"""What the pages say of the code: files that they name, the floors, the options of conf."""

import fnmatch
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

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


def test_the_readme_names_every_option_of_a_group():
    """Where its row does not end in three points."""
    rows = re.findall(r"^\| `([a-z_/]+)` \| (.*?) \| ", (ROOT / "README.md").read_text(), flags=re.M)
    said: dict[str, set[str]] = {}
    for group, options in rows:
        said.setdefault(group, set()).update(["..."] if "..." in options else re.findall(r"`([\w/.]+)`", options))
    whole = {group: names for group, names in said.items() if "..." not in names and (ROOT / "conf" / group).is_dir()}
    assert {"sparsify", "pruning", "layout", "method"} <= whole.keys()
    assert whole == {group: {path.stem for path in (ROOT / "conf" / group).glob("*.yaml")} for group in whole}


def numbers_of_scripts() -> ModuleType:
    spec = importlib.util.spec_from_file_location("check_numbers", ROOT / "scripts" / "check_numbers.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclass asks for it
    spec.loader.exec_module(module)
    return module


def test_numbers_of_the_pages_are_those_of_their_records():
    found = numbers_of_scripts().check()
    assert found.problems == []
    assert sum(kind == "record" for page in found.agree.values() for kind in page.values()) > 300


PAGE = """A step takes **0.68** of the other's
time (1,227 splats at 960x576, `step=7`), which is 32.2 % less. Elsewhere it is 5 ms.

| | full | full |
|---|---:|---:|
| *plain* | 30.72 [1, 2] | 31.5 |
| `ours` | 30.58 | **-0.4** |
"""
BOUND = """
rows:
  ours: {file: a.jsonl, name: "ours*", size.width: 960}
  peer: {file: a.jsonl, name: peer}
  plain: {file: docs/findings.md, row: plain, table: 1}
  small: {file: docs/findings.md, row: ours}
numbers:
  - page: docs/findings.md
    text: "takes {} of the {whose} time ({} splats at 960x576, `step=7`), which is {} % less."
    values: [x.step.median / peer.step.median, x.rows, 100 - total(x.parts) / total(peer.parts) * 100]
    each: [{whose: other's, x: ours}]
  - {page: README.md, text: "gains {} and {} dB", values: [plain.full - small.full, plain.full_2 + small.full_2]}
"""


@pytest.mark.parametrize(
    ("page", "bound", "said"),
    [
        (PAGE, BOUND, ""),
        (PAGE.replace("32.2", "32.3"), BOUND, "docs/findings.md:2: 32.3 is printed, 100 - total(x.parts)"),
        (PAGE.replace("1,227", "1,228"), BOUND, "1,228 is printed, x.rows is 1227"),
        (PAGE.replace("30.58", "30.57"), BOUND, "README.md:1: 0.14 is printed, plain.full - small.full is 0.15"),
        (PAGE.replace("less", "fewer"), BOUND, "docs/findings.md: the text 'takes {} of the other's time"),
        (PAGE + PAGE, BOUND, "stands there 2 times, expected once"),
        (PAGE, BOUND.replace(", size.width: 960", ""), "rows.ours: 2 lines of a.jsonl fit, expected one"),
        (PAGE, BOUND.replace("name: peer", "name: none"), "rows.peer: 0 lines"),
        (PAGE, BOUND.replace("x.rows", "x.row"), "x.row has no value"),
        (PAGE, BOUND.replace("x.rows, ", ""), "has 3 numbers and 2 values"),
    ],
)
def test_a_number_that_is_not_its_records_is_an_error(page, bound, said, tmp_path):
    """What differs, what is gone from its page, and what its records lack or have twice."""
    ours = {"name": "ours staged", "size": {"width": 960}, "rows": 1227, "step": {"median": 6.36}}
    lines: list[dict[str, Any]] = [
        ours,
        ours | {"size": {"width": 640}, "rows": 3},
        {"name": "peer", "step": {"median": 9.38}},
    ]
    parts = [{"parts": {"a": line["step"], "b": {"median": 0.0}}} for line in lines]
    write_pages(tmp_path, page, bound, [line | more for line, more in zip(lines, parts, strict=True)])
    script = numbers_of_scripts()
    found = script.check(tmp_path)
    assert said in " ".join(found.problems).replace('"', "'")
    assert bool(found.problems) == bool(said)
    if not said:
        assert [kind for page in sorted(found.agree) for kind in found.agree[page].values()] == 2 * ["page"] + 3 * [
            "record"
        ]
        left = list(script.unchecked(tmp_path, found))
        assert left[:2] == [("README.md", 1, "3"), ("docs/findings.md", 2, "5")]
        assert [number for _, _, number in left[2:]] == ["30.72", "1", "2", "31.5", "30.58", "-0.4"]


def write_pages(root: Path, page: str, bound: str, lines: list[dict[str, Any]]) -> None:
    (root / "benchmarks").mkdir()
    (root / "docs").mkdir()
    (root / "benchmarks" / "a.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (root / "docs" / "findings.md").write_text(page)
    (root / "README.md").write_text("It gains 0.14 and 31.1 dB (3 runs of 3DGS).\n")
    (root / "benchmarks" / "numbers.yaml").write_text(bound)
