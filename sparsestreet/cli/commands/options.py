"""``key=value`` words of a command as a frozen dataclass: strict in keys and types, one line where one is wrong."""

import math
import sys
import time
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar, cast

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sparsestreet.cli.process import stdout_closed
from sparsestreet.demand import as_demand
from sparsestreet.naming import nearest, printable

Options = TypeVar("Options")

_WORDS = {"true": True, "false": False}


class OptionError(ValueError):
    """Words that do not fit a command; says in one line which, and what would."""


class MissingOptionError(OptionError):
    """A word that a command needs."""


def run_command(
    name: str,
    usage: str,
    words: Sequence[str],
    kind: type[Options],
    action: Callable[[Options], None],
    positional: str | Sequence[str] = (),
) -> int:
    """Parse the words of ``sparsestreet NAME`` and act on them.

    Returns 0, or 2 for words that do not fit, 1 where the action finds something missing or malformed (OSError,
    ValueError, ImportError: its sentence is printed) or memory does not do (``demand.as_demand``), 130 after Ctrl-C.
    Without words, and for --help, the usage is printed.
    """
    if not words or "--help" in words or "-h" in words:
        print(usage)
        return 0 if words else 2
    try:
        action(parse_options(words, kind, positional))
    except OptionError as error:
        # The form of a command is the first of its usage, up to its meaning.
        form = f": {usage.splitlines()[0].partition('  ')[0]}" if isinstance(error, MissingOptionError) else ""
        print(printable(f"sparsestreet {name}: {error}{form}"), file=sys.stderr)
        return 2
    except (OSError, ValueError, ImportError) as error:
        if isinstance(error, BrokenPipeError) and stdout_closed():
            raise  # ``main`` ends quietly; a program of ours that broke, such as ffmpeg, is told
        print(printable(f"sparsestreet {name}: {error}"), file=sys.stderr)
        return 1
    except Exception as error:
        demand = as_demand(error)
        if demand is None:
            raise
        print(printable(f"sparsestreet {name}: {demand}"), file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"sparsestreet {name}: stopped, nothing was written", file=sys.stderr)
        return 130
    return 0


def parse_options(words: Sequence[str], kind: type[Options], positional: str | Sequence[str] = ()) -> Options:
    """The dataclass that the words describe; a field without default must be given.

    Args:
        words: ``key=value``, each key once.
        kind: a dataclass; its fields are str, int, float, bool, Path, slice (``0:40``), a Literal, ``tuple[X, ...]``
            (``[a,b]`` or ``a,b``) or one of them or None.
        positional: the field, tuple[X, ...], that takes all words without a key; or the fields that take one each, in
            this order, if they are not given by their keys.

    Raises OptionError.
    """
    hints = typing.get_type_hints(kind)
    declared = fields(cast(Any, kind))  # no annotation says that it is a dataclass
    names = [field.name for field in declared if field.name != positional]
    paths = bool(positional)
    given: dict[str, Any] = {}
    loose = []
    for word in words:
        key, equals, text = word.partition("=")
        # A folder may have an equals sign in its name: those of sweeps do.
        if not equals or not key.isidentifier() or (paths and Path(word).exists()):
            loose.append(word)
        elif key not in names:
            raise OptionError(_unknown_key(key, names))
        elif key in given:
            raise OptionError(f"{key} is given twice: choose one")
        else:
            given[key] = _value(key, text, hints[key])
    if isinstance(positional, str):
        given[positional] = tuple(_value(positional, word, typing.get_args(hints[positional])[0]) for word in loose)
    else:
        places = [name for name in positional if name not in given]
        unfit = [word for word in loose if word.startswith("-")] or loose[len(places) :]
        if unfit:
            raise OptionError(f"{unfit[0]!r} is no option: write key=value, with one of {', '.join(names)}")
        given |= {name: _value(name, word, hints[name]) for name, word in zip(places, loose, strict=False)}
    for field in declared:
        if field.default is MISSING and field.name not in given:
            raise MissingOptionError(f"{field.name}=... is missing")
    try:
        return kind(**given)
    except ValueError as error:
        raise OptionError(str(error)) from error


def _unknown_key(key: str, known: Sequence[str]) -> str:
    """Return one line about a key that does not exist, with the one that was probably meant, or all."""
    close = nearest(key, known, cutoff=0.5)
    return f"no key {key!r}; " + (f"did you mean {close[0]!r}?" if close else f"there are {', '.join(known)}")


def _value(key: str, text: str, kind: Any) -> Any:
    """``text`` as ``kind``."""
    if not text:
        raise OptionError(f"{key} has no value: write {key}=..., or leave it out")
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):  # ``X | None``; Python 3.11 has the second of a Literal
        (inner,) = (argument for argument in arguments if argument is not types.NoneType)
        return _value(key, text, inner)
    if origin is tuple:
        bare = text[1:-1] if text.startswith("[") and text.endswith("]") else text
        return tuple(_value(key, part.strip(), arguments[0]) for part in bare.split(","))
    if origin is typing.Literal:
        return _chosen(key, text, {str(choice): choice for choice in arguments})
    if kind is bool:
        return _chosen(key, text, _WORDS)
    try:
        return _CONVERSIONS[kind](text)
    except ValueError as error:
        raise OptionError(f"{key} must be {_NAMES[kind]}, got {text!r}") from error


def _chosen(key: str, text: str, choices: Mapping[str, Any]) -> Any:
    if text not in choices:
        raise OptionError(f"{key} must be one of {', '.join(choices)}, got {text!r}")
    return choices[text]


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _slice(text: str) -> slice:
    start, colon, stop = text.partition(":")
    if not colon:
        raise ValueError(text)
    return slice(int(start) if start else None, int(stop) if stop else None)


_CONVERSIONS: Mapping[type, Callable[[str], Any]] = {
    str: str,
    int: int,
    float: _finite,
    Path: lambda text: Path(text).expanduser(),
    slice: _slice,
}
_NAMES = {int: "a whole number", float: "a number", slice: "a range like 0:40"}


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
