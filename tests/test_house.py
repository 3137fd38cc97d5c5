"""The rules of the house that a program can check (CONTRIBUTING.md): counts of what breaks them may only fall."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sparsestreet"
MIN_LINES = 60
MAX_LINES = 600
ALLOWED = {
    "modules below 60 lines": 11,
    "modules above 600 lines": 0,
    "docstrings that begin with a fragment": 74,
    "docstrings that begin in the third person": 30,
    "limits that are no MIN or MAX": 17,
    "words of README": 900,
    "words of docs": 40_000,
}
"""Lower a number with the change that lowers its count."""

FRAGMENT = re.compile(r"(?:Of|As|By|In|At) ")
THIRD_PERSON = re.compile(r"(?:Returns|Yields|Raises|Writes|Reads|Takes|Gives|Makes|Checks|Draws|Renders|Says|Adds) ")
OTHER_LIMIT = re.compile(r"_?(?:LEAST|MOST|FEW|FEWEST|LARGEST|SMALLEST)(?:_|$)")


def modules() -> dict[Path, str]:
    return {path: path.read_text() for path in sorted(PACKAGE.rglob("*.py")) if path.stem != "__init__"}


def docstrings(tree: ast.Module) -> list[str]:
    """Return those of modules, classes and functions; those below an attribute are expressions like any other."""
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)]
    return [text for node in nodes if (text := ast.get_docstring(node))]


def constants(tree: ast.Module) -> list[str]:
    """Return the names that a module assigns in capitals."""
    names = [node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
    return [name for name in names if name.isupper()]


def words(*pages: Path) -> int:
    return sum(len(page.read_text().split()) for page in pages)


def counted() -> dict[str, int]:
    texts = modules()
    lines = [len(text.splitlines()) for text in texts.values()]
    trees = [ast.parse(text) for text in texts.values()]
    said = [text for tree in trees for text in docstrings(tree)]
    readme = ROOT / "README.md"
    return {
        "modules below 60 lines": sum(count < MIN_LINES for count in lines),
        "modules above 600 lines": sum(count > MAX_LINES for count in lines),
        "docstrings that begin with a fragment": sum(bool(FRAGMENT.match(text)) for text in said),
        "docstrings that begin in the third person": sum(bool(THIRD_PERSON.match(text)) for text in said),
        "limits that are no MIN or MAX": sum(
            bool(OTHER_LIMIT.match(name)) for tree in trees for name in constants(tree)
        ),
        "words of README": words(readme),
        "words of docs": words(readme, *(ROOT / "docs").rglob("*.md")),
    }


@pytest.mark.lengthy
def test_what_breaks_a_rule_of_the_house_only_becomes_less():
    found = counted()
    assert found.keys() == ALLOWED.keys()
    assert {rule: count for rule, count in found.items() if count > ALLOWED[rule]} == {}


def unknown_names(room: Path) -> list[str]:
    """Names in the docstring of a room's __init__ that are neither its modules nor defined or imported below it."""
    text = (room / "__init__.py").read_text()
    below = " ".join(path.read_text() for path in room.rglob("*.py") if path.parent != room or path.stem != "__init__")
    known = {path.stem for path in room.iterdir()} | set(re.findall(r"(?:def|class) (\w+)", below))
    doc, code = ast.get_docstring(ast.parse(text)) or "", text.split('"""')[-1]
    known |= set(re.findall(r"\w+", code))
    names = (
        name.rpartition(".")[2] for name in re.findall(r"``([a-z][a-z0-9_.]*)``", doc) if not name.endswith(".json")
    )
    return [name for name in names if name not in known]


def test_a_room_names_no_module_that_is_gone():
    rooms = sorted(path.parent for path in (ROOT / "sparsestreet").rglob("__init__.py"))
    assert {room.name: gone for room in rooms if (gone := unknown_names(room))} == {}


def test_a_room_that_names_what_is_gone_is_found(tmp_path):
    (tmp_path / "__init__.py").write_text('"""``run`` trains, ``identity`` names."""\n')
    (tmp_path / "run.py").write_text("def train(): ...\n")
    assert unknown_names(tmp_path) == ["identity"]


def test_a_slip_is_counted():
    tree = ast.parse('"""Of a sweep."""\nMOST_ROWS = 3\nMAX_ROWS = 4\n\ndef f():\n    """Returns it."""\n')
    assert constants(tree) == ["MOST_ROWS", "MAX_ROWS"]
    assert [bool(OTHER_LIMIT.match(name)) for name in constants(tree)] == [True, False]
    assert [bool(FRAGMENT.match(text)) for text in docstrings(tree)] == [True, False]
    assert [bool(THIRD_PERSON.match(text)) for text in docstrings(tree)] == [False, True]
