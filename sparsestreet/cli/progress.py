"""How far a command has come: a bar on a terminal, else a few lines."""

import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

LINES = 5

Item = TypeVar("Item")


def shown(items: Iterable[Item], total: int, what: str) -> Iterator[Item]:
    """The items as they come, with the progress shown; ``what`` names them (``frames``)."""
    console = Console()
    if not console.is_terminal:
        yield from _lines(items, total, what)
        return
    columns = (BarColumn(20), MofNCompleteColumn(), TextColumn(what), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        yield from bar.track(items, total=total)


def _lines(items: Iterable[Item], total: int, what: str) -> Iterator[Item]:
    started, every = time.perf_counter(), max(total // LINES, 1)
    for count, item in enumerate(items, start=1):
        yield item
        if count % every == 0 or count == total:
            rate = count / max(time.perf_counter() - started, 1e-9)
            print(f"{count} of {total} {what}, {rate:.1f} a second", flush=True)
