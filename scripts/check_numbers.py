"""Compare the numbers of our pages with the records that they come from, and list those without a record.

``benchmarks/numbers.yaml`` binds them. Under ``rows`` it names lines of records: a file in ``benchmarks`` and the
fields by which one line is found (``*`` stands for any text, ``a.b`` for a field within a field). A file that ends in
.md is a page: its table rows are found by ``row``, the first cell, and ``table``, counted from 1. Their columns' heads
are fields, such as ``full``, and ``people_2`` for a second one of a name. Such a number only agrees with that page.

Under ``numbers`` each entry has a ``page``, a piece of its ``text`` with ``{}`` where a number stands, and one of the
``values`` for each ``{}``: a row's field, such as ``street.step.median``, or arithmetic of several; ``total(...)`` adds
up medians. Bold marks and line breaks do not count. An entry with ``each`` is repeated with other names for rows, and
with other words for ``{WORD}``. A page prints rounded numbers: half of the last printed digit may differ.

The status is 1 if a number differs, a text is not in its page exactly once, or a row is not exactly one line.
"""

import ast
import fnmatch
import json
import operator
import re
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "docs/results.md", "docs/results/*.md")
"""Whose numbers are listed where nothing binds them; other pages are listed where something does."""
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?=x?(?![\w])(?!\.\d))")
"""A number of a text, without sizes such as 320x192, versions and words such as 3DGS."""
NOT_PROSE = re.compile(r"```.*?```|`[^`\n]*`|\]\([^)]*\)", re.S)
OPERATORS = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv}


@dataclass
class Check:
    """Sentences about what is wrong, and the spans of each page that agree, by what they agree with."""

    problems: list[str] = field(default_factory=list)
    agree: dict[str, dict[tuple[int, int], str]] = field(default_factory=dict)


def check(root: Path = ROOT, bindings: Path | None = None) -> Check:
    """Compare every bound number. Raises ValueError for a file of bindings that cannot be read."""
    bound = yaml.safe_load((bindings or root / "benchmarks/numbers.yaml").read_text())
    found = Check()
    rows: dict[str, Any] = {}
    kinds: dict[str, str] = {}
    for name, wanted in bound["rows"].items():
        file = wanted.pop("file")
        lines = [line for line in records(root, file) if all(fits(line, *one) for one in wanted.items())]
        kinds[name] = "page" if file.endswith(".md") else "record"
        if len(lines) == 1:
            rows[name] = lines[0]
        else:
            found.problems.append(f"rows.{name}: {len(lines)} lines of {file} fit, expected one")
    for entry in bound["numbers"]:
        for words in entry.get("each", [{}]):
            _compare(root, entry, words, rows, kinds, found)
    return found


def records(root: Path, file: str) -> list[dict[str, Any]]:
    """Return the lines of a JSONL file in ``benchmarks``, or the rows of a page's tables."""
    if not file.endswith(".md"):
        return [json.loads(line) for line in (root / "benchmarks" / file).read_text().splitlines()]
    rows: list[dict[str, Any]] = []
    head: list[str] = []
    table = 0
    for line in (root / file).read_text().splitlines():
        cells = [cell.strip().replace("*", "").replace("`", "") for cell in line.strip("|").split("|")]
        if not line.startswith("|"):
            head = []
        elif not head:
            names = [re.sub(r"\W+", "_", cell).strip("_") for cell in cells]
            head = [name + f"_{names[: i + 1].count(name)}" * (name in names[:i]) for i, name in enumerate(names)]
            table += 1
        elif set(line) - set("|-: "):
            numbers = {name: value_of(NUMBER.search(cell)) for name, cell in zip(head, cells, strict=False) if name}
            rows.append({**numbers, "row": cells[0], "table": table})
    return rows


def value_of(match: re.Match[str] | None) -> float | None:
    return None if match is None else float(match[0].replace(",", ""))


def fits(line: Any, path: str, wanted: Any) -> bool:
    for key in path.split("."):
        line = line.get(key) if isinstance(line, dict) else None
    return fnmatch.fnmatchcase(line, wanted) if isinstance(line, str) else line == wanted


def _compare(root: Path, entry: Any, words: Any, rows: Any, kinds: Any, found: Check) -> None:
    page, text = entry["page"], entry["text"]
    names = {name: words.get(name, name) for value in entry["values"] for name in re.findall(r"[a-z_]\w*", str(value))}
    for name, word in words.items():
        text = text.replace("{" + name + "}", str(word))
    prose = (root / page).read_text()
    matches = list(pattern_of(text).finditer(prose))
    if len(matches) != 1:
        found.problems.append(f"{page}: the text {text!r} stands there {len(matches)} times, expected once")
        return
    (match,) = matches
    if len(match.groups()) != len(entry["values"]):
        found.problems.append(f"{page}: {text!r} has {len(match.groups())} numbers and {len(entry['values'])} values")
        return
    for index, expression in enumerate(entry["values"], 1):
        place = f"{page}:{line_of(prose, match.start(index))}"
        used = {names.get(one.id) for one in ast.walk(ast.parse(str(expression))) if isinstance(one, ast.Name)}
        try:
            value = evaluate(ast.parse(str(expression), mode="eval").body, rows, words)
        except (KeyError, TypeError) as error:
            found.problems.append(f"{place}: {expression} has no value ({type(error).__name__}: {error})")
            continue
        printed = match[index].replace(",", "")
        half = 0.5 * 10.0 ** -len(printed.partition(".")[2])
        if abs(float(printed) - value) > half * (1 + 1e-6):
            found.problems.append(f"{place}: {match[index]} is printed, {expression} is {value:.6g}")
        else:
            kind = "page" if "page" in {kinds.get(str(name)) for name in used} else "record"
            found.agree.setdefault(page, {})[match.span(index)] = kind


def pattern_of(text: str) -> re.Pattern[str]:
    """Return what finds the text: ``{}`` is a number, a space any white space, and bold marks may stand anywhere."""
    bold = r"(?:\*\*)?"
    letters = {" ": bold + r"\s+" + bold}
    parts = re.sub(r"\s+", " ", text.replace("**", "")).split("{}")
    literal = ["".join(letters.get(one, bold + re.escape(one)) for one in part) for part in parts]
    return re.compile((bold + r"([-+]?\d[\d,]*(?:\.\d+)?)").join(literal))


def evaluate(node: ast.expr, rows: Any, words: Any) -> Any:
    """Return the value of an expression of names of rows, fields, numbers and arithmetic."""
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        return OPERATORS[type(node.op)](evaluate(node.left, rows, words), evaluate(node.right, rows, words))
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name):
        return rows[words.get(node.id, node.id)]
    if isinstance(node, ast.Attribute):
        return evaluate(node.value, rows, words)[node.attr]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "total":
        return sum(one["median"] for one in evaluate(node.args[0], rows, words).values())
    raise ValueError(f"{ast.unparse(node)} is no field, number or arithmetic: write ROW.FIELD")


def line_of(text: str, place: int) -> int:
    return text.count("\n", 0, place) + 1


def unchecked(root: Path, found: Check) -> Iterator[tuple[str, int, str]]:
    """Yield page, line and number of each number that nothing binds; code, commands and links are no numbers."""
    listed = {path.relative_to(root).as_posix() for pattern in PAGES for path in root.glob(pattern)}
    for page in sorted(listed | set(found.agree)):
        text = (root / page).read_text()
        prose = NOT_PROSE.sub(lambda one: re.sub(r"[^\n]", " ", one[0]), text)
        spans = found.agree.get(page, {})
        for one in NUMBER.finditer(prose):
            if not any(start < one.end() and one.start() < end for start, end in spans):
                yield page, line_of(text, one.start()), one[0]


def main() -> int:
    """Print what differs, what cannot be checked by line, and a count of each page."""
    found = check()
    missing = list(unchecked(ROOT, found))
    by_line: dict[str, list[str]] = {}
    for page, line, number in missing:
        by_line.setdefault(f"{page}:{line}", []).append(number)
    print("No record in the repository has these numbers:")
    for place, numbers in by_line.items():
        print(f"  {place}: {' '.join(numbers)}")
    counts = Counter(page for page, _, _ in missing)
    print(f"\n{'page':42}{'record':>8}{'page':>8}{'none':>8}")
    total: Counter[str] = Counter()
    for page in sorted(counts.keys() | found.agree.keys()):
        one = Counter(found.agree.get(page, {}).values()) + Counter({"none": counts[page]})
        total += one
        print(f"{page:42}{one['record']:8}{one['page']:8}{one['none']:8}")
    print(f"{'all':42}{total['record']:8}{total['page']:8}{total['none']:8}")
    print("record: agrees with a record; page: agrees with the table of another page; none: cannot be checked")
    for problem in found.problems:
        print(f"WRONG {problem}")
    return 1 if found.problems else 0


if __name__ == "__main__":
    sys.exit(main())
