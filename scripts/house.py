#!/usr/bin/env python3
"""Print how large this checkout is and how it hangs together: the numbers by which a redesign is judged.

    python scripts/house.py [FOLDER]

FOLDER is a checkout; the one of this script without it. Lines are those of `wc -l`. Rooms are the direct children of
the package. An arrow is a pair of rooms of which one imports the other; floors are the longest chain of arrows.
"""

import ast
import statistics
import subprocess
import sys
import time
from pathlib import Path

SHORT = 60
"""Lines below which a module needs a reason (CONTRIBUTING.md)."""


def lines_of(paths: list[Path]) -> list[int]:
    return [len(path.read_text().splitlines()) for path in paths]


def words_of(paths: list[Path]) -> int:
    return sum(len(path.read_text().split()) for path in paths)


def imports_of(path: Path, root: Path) -> set[str]:
    """Return the dotted names of our own modules that a module imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in found if name.startswith(f"{root.name}.")}


def arrows_of(root: Path) -> dict[str, set[str]]:
    """Return for each room the rooms that it imports."""
    rooms = {path.stem for path in root.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()} - {
        "__init__",
        "__main__",
    }
    arrows: dict[str, set[str]] = {room: set() for room in rooms}
    for path in root.rglob("*.py"):
        room = path.relative_to(root).parts[0].removesuffix(".py")
        if room in rooms:
            arrows[room] |= {name.split(".")[1] for name in imports_of(path, root)} & rooms - {room}
    return arrows


def floors_of(arrows: dict[str, set[str]]) -> tuple[int, list[str]]:
    """Return the length of the longest chain of arrows, and the rooms that stand in a circle."""
    height: dict[str, int] = {}
    left = dict(arrows)
    while ready := [room for room, below in left.items() if below <= height.keys()]:
        for room in ready:
            height[room] = 1 + max((height[other] for other in left.pop(room)), default=0)
    return max(height.values(), default=0), sorted(left)


def seconds_of_help(root: Path) -> list[float]:
    """Return the seconds of `sparsestreet --help`, five times, behind one that fills the caches."""
    seconds = []
    for _ in range(6):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", root.name, "--help"], cwd=root.parent, check=True, capture_output=True)
        seconds.append(time.perf_counter() - start)
    return seconds[1:]


def main(top: Path) -> None:
    root = top / "sparsestreet"
    modules = sorted(root.rglob("*.py"))
    lines = lines_of(modules)
    tests = sorted((top / "tests").rglob("*.py"))
    docs = sorted((top / "docs").rglob("*.md"))
    arrows = arrows_of(root)
    short = [path for n, path in zip(lines, modules, strict=True) if n < SHORT and path.stem != "__init__"]
    floors, circles = floors_of(arrows)
    help_seconds = seconds_of_help(root)
    rows = (
        ("package, lines", sum(lines)),
        ("package, modules", len(modules)),
        ("module, median lines", statistics.median(lines)),
        ("module, p90 lines", sorted(lines)[int(0.9 * len(lines))]),
        (f"modules below {SHORT} lines, without __init__", len(short)),
        ("C++, lines", sum(lines_of(sorted(path for path in root.rglob("src/*") if path.is_file())))),
        ("tests, lines", sum(lines_of(tests))),
        ("tests, files", len(tests)),
        ("conf, files", sum(path.is_file() for path in (top / "conf").rglob("*"))),
        ("README, words", words_of([top / "README.md"])),
        ("docs, words (README included)", words_of([*docs, top / "README.md"])),
        ("rooms", len(arrows)),
        ("floors", floors),
        ("arrows", sum(map(len, arrows.values()))),
        ("rooms in circles", len(circles)),
        ("sparsestreet --help, s", f"{statistics.median(help_seconds):.2f} (at most {max(help_seconds):.2f})"),
    )  # fmt: skip
    for name, value in rows:
        print(f"{name:48} {value:>22,}" if isinstance(value, int) else f"{name:48} {value:>22}")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else Path(__file__).resolve().parents[1])
