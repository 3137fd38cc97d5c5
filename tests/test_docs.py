"""What the pages say of the code: files that they name, the floors, the options of conf."""

import fnmatch
import importlib.util
import json
import re
import shutil
import subprocess
import sys
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


def test_every_page_that_the_code_names_is_there():
    texts = [
        (path, path.read_text())
        for room in ("sparsestreet", "conf", "tests", "scripts", "examples", "benchmarks")
        for path in (ROOT / room).rglob("*")
        if path.suffix in (".py", ".yaml", ".sh") and path != Path(__file__)
    ]
    named = {(path, page) for path, text in texts for page in re.findall(r"\bdocs/[\w/]+\.md", text)}
    gone = [f"{path.relative_to(ROOT)}: {page}" for path, page in named if not (ROOT / page).is_file()]
    assert sorted(gone) == []


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
    for folder in ("examples", "conf", "tests/cli/toy"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
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


def test_every_room_is_in_the_table_of_rooms():
    rooms = {path.parent.name for path in (ROOT / "sparsestreet").glob("*/__init__.py")}
    page = (ROOT / "docs" / "architecture.md").read_text().partition("## A run's folder")[0]
    rows = re.findall(r"^\| `(\w+)/` \|", page, flags=re.M)
    assert sorted(rows) == sorted(rooms)


def test_every_option_of_conf_is_in_the_tables_with_a_sentence():
    """And the groups that the pages send a reader to have the options that the pages name."""
    groups = module_of(ROOT / "docs" / "conf.py").groups_of(ROOT / "conf")
    folders = {path.name for path in (ROOT / "conf").iterdir() if path.is_dir()} - {"options"}
    files = {path.stem for path in (ROOT / "conf" / "options").glob("*.yaml")}
    assert groups.keys() == folders | files
    assert [(group, name) for group, options in groups.items() for name, said in options.items() if not said] == []
    assert groups["method"].keys() == {"3dgs", "deformgs", "pvg", "streetgs", "omnire"}
    assert {"paper", "paper_short", "removal"} < groups["sparsify"].keys()


def test_the_tables_of_options_have_files_and_entries(tmp_path):
    page = module_of(ROOT / "docs" / "conf.py")
    for name, text in {
        "loss/mine.yaml": "# @package _global_\n# Pulls at every alpha (Kerbl et al. 2023). Off here.\nmine: {}\n",
        "loss/base/shared.yaml": "a: 1\n",
        "trainer/bare.yaml": "_target_: lightning.Trainer\n",
        "options/rule.yaml": "# Rules.\n\n# The first one: a | b.\nfirst:\n  at: 3\n\n# Another.\nsub/second: {}\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert page.groups_of(tmp_path) == {
        "loss": {"mine": "Pulls at every alpha"},
        "rule": {"first": "The first one", "sub/second": "Another"},
        "trainer": {"bare": "`Trainer`"},
    }
    assert "## rule\n\n| option | what |\n|---|---|\n| `first` | The first one |\n" in page.tables_of(tmp_path)


def module_of(path: Path) -> ModuleType:
    pytest.importorskip("sphinx", reason="pip install 'sparsestreet[docs]'")
    return loaded(path)


def loaded(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # a dataclass of it asks for it
    spec.loader.exec_module(module)
    return module


def numbers_of_scripts() -> ModuleType:
    return loaded(ROOT / "scripts" / "check_numbers.py")


def test_numbers_of_the_pages_are_those_of_their_records():
    found = numbers_of_scripts().check()
    assert found.problems == []
    assert sum(kind == "record" for page in found.agree.values() for kind in page.values()) > 250


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
  plain: {file: docs/results.md, row: plain, table: 1}
  small: {file: docs/results.md, row: ours}
numbers:
  - page: docs/results.md
    text: "takes {} of the {whose} time ({} splats at 960x576, `step=7`), which is {} % less."
    values: [x.step.median / peer.step.median, x.rows, 100 - total(x.parts) / total(peer.parts) * 100]
    each: [{whose: other's, x: ours}]
  - {page: README.md, text: "gains {} and {} dB", values: [plain.full - small.full, plain.full_2 + small.full_2]}
"""


@pytest.mark.parametrize(
    ("page", "bound", "said"),
    [
        (PAGE, BOUND, ""),
        (PAGE.replace("32.2", "32.3"), BOUND, "docs/results.md:2: 32.3 is printed, 100 - total(x.parts)"),
        (PAGE.replace("1,227", "1,228"), BOUND, "1,228 is printed, x.rows is 1227"),
        (PAGE.replace("30.58", "30.57"), BOUND, "README.md:1: 0.14 is printed, plain.full - small.full is 0.15"),
        (PAGE.replace("less", "fewer"), BOUND, "docs/results.md: the text 'takes {} of the other's time"),
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
        assert left[:2] == [("README.md", 1, "3"), ("docs/results.md", 2, "5")]
        assert [number for _, _, number in left[2:]] == ["30.72", "1", "2", "31.5", "30.58", "-0.4"]


def write_pages(root: Path, page: str, bound: str, lines: list[dict[str, Any]]) -> None:
    (root / "benchmarks").mkdir()
    (root / "docs").mkdir()
    (root / "benchmarks" / "a.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (root / "docs" / "results.md").write_text(page)
    (root / "README.md").write_text("It gains 0.14 and 31.1 dB (3 runs of 3DGS).\n")
    (root / "benchmarks" / "numbers.yaml").write_text(bound)
