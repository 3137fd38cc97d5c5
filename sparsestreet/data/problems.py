"""What is wrong with a log on disk: said once for each file, all at once, with the remedy."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar, get_args

_SHOWN = 5
"""Problems an error message spells out; a check returns all of them."""

T = TypeVar("T")


@dataclass(frozen=True)
class Problem:
    """One thing to repair before the log can be read."""

    path: Path
    """The file (or folder) at fault."""
    message: str
    """Which rule is broken, and the value found."""
    remedy: str

    def __str__(self) -> str:
        return f"{self.path}: {self.message}; {self.remedy}"


class LogError(ValueError):
    """The log on disk breaks its layout; ``problems`` holds everything that was found."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        count = "1 problem" if len(self.problems) == 1 else f"{len(self.problems)} problems"
        lines = [f"{count} in the log:", *(f"  {problem}" for problem in self.problems[:_SHOWN])]
        if len(self.problems) > _SHOWN:
            lines.append(f"  ... and {len(self.problems) - _SHOWN} more (`sparsestreet data check` lists them all)")
        super().__init__("\n".join(lines))


def fault(path: Path, message: str, remedy: str) -> LogError:
    """The error of one file."""
    return LogError((Problem(path, message, remedy),))


def attempt(problems: list[Problem], read: Callable[[], T]) -> T | None:
    """What ``read`` returns; where it raises LogError its problems are added to the list, and None comes back."""
    try:
        return read()
    except LogError as error:
        problems.extend(error.problems)
        return None


def missing_files(paths: Iterable[Path]) -> list[Problem]:
    """One problem for each folder that lacks some of ``paths``, naming the first few."""
    absent: dict[Path, list[Path]] = {}
    for path in paths:
        if not path.is_file():
            absent.setdefault(path.parent, []).append(path)
    remedy = (
        "write the missing files, leave out what is scattered (data.log.missing=skip, of readers that have it), or "
        "read only complete frames (data.log.first_frame, .last_frame) and cameras (data.log.cameras)"
    )
    problems = []
    for files in absent.values():
        names = ", ".join(path.name for path in files[:_SHOWN]) + (", ..." if len(files) > _SHOWN else "")
        message = "the file is missing" if len(files) == 1 else f"{len(files)} files of the folder are missing: {names}"
        problems.append(Problem(files[0], message, remedy))
    return problems


Missing = Literal["error", "skip"]
"""What becomes of listed images without a file: an error, or they are left out with a note."""


def check_missing(missing: str) -> None:
    """Raise ValueError for what is no choice of ``Missing``."""
    if missing not in get_args(Missing):
        raise ValueError(f"missing must be one of {', '.join(get_args(Missing))}, got {missing!r}")


def missing_notes(absent: int, total: int, what: str = "listed images") -> list[str]:
    """Say how many of ``total`` were left out; nothing where none was."""
    return [f"{absent} of {total} {what} lack files and are left out (data.log.missing=skip)"] if absent else []
