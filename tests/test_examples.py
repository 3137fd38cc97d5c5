"""The examples in docstrings: they run, and whatever users call in the rooms below has one."""

import doctest
import importlib
import inspect
import math
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import sparsestreet
from tests.typed import there

ROOMS = (
    "sparsestreet.atomic",
    "sparsestreet.geometry",
    "sparsestreet.metrics",
    "sparsestreet.noise",
    "sparsestreet.ops",
    "sparsestreet.phases",
    "sparsestreet.pickles",
)
"""Modules, and packages, in which everything public has an example: the names in ``__all__``, else each function."""

PACKAGE = Path(sparsestreet.__file__).parent
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


class AnyProcessor(doctest.OutputChecker):
    """Compares numbers by their value: a sum in another order has another last digit, or is -0.0 instead of 0.0.

    A number with a point equals what is printed to 1e-5 of it (float32 has seven digits, a sum loses one or two) or
    1e-12; all other text stays as it is.
    """

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        return super().check_output(want, got, optionflags) or super().check_output(want, alike(want, got), optionflags)


NUMBER = re.compile(r"-?\d+\.\d*(?:e[-+]?\d+)?")


def alike(want: str, got: str) -> str:
    """``got`` with each number as in ``want`` where the two are equal but for rounding."""
    wanted, found = NUMBER.findall(want), NUMBER.findall(got)
    if len(wanted) != len(found):
        return got
    close = [math.isclose(float(a), float(b), rel_tol=1e-5, abs_tol=1e-12) for a, b in zip(wanted, found, strict=True)]
    words = iter(a if same else b for a, b, same in zip(wanted, found, close, strict=True))
    return NUMBER.sub(lambda _: next(words), got)


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = sorted(name_of(path) for path in PACKAGE.rglob("*.py") if re.search("^ *>>> ", path.read_text(), flags=re.M))


def public(room: str) -> list[tuple[str, object]]:
    """What users of a room call: the names in ``__all__``, else the functions of its modules."""
    package = importlib.import_module(room)
    if hasattr(package, "__all__"):
        return [(f"{room}.{name}", getattr(package, name)) for name in package.__all__]
    folder = Path(there(package.__file__)).parent
    names = map(name_of, folder.glob("*.py")) if hasattr(package, "__path__") else [room]
    modules = [importlib.import_module(name) for name in names]
    return [
        (f"{module.__name__}.{name}", thing)
        for module in modules
        for name, thing in vars(module).items()
        if name[0] != "_" and inspect.isfunction(thing) and thing.__module__ == module.__name__
    ]


PUBLIC = [pair for room in ROOMS for pair in public(room)]


def names_in(module: str) -> dict[str, object]:
    """What an example may use without importing it: the names of its module, torch and np."""
    return {"torch": torch, "np": np, **vars(importlib.import_module(module))}


def examples(name: str, thing: object) -> list[doctest.DocTest]:
    """Those of a function, or of a class and its methods."""
    # Without a module: the finder takes functions whose shapes are checked for those of jaxtyping.
    return doctest.DocTestFinder(exclude_empty=True).find(thing, name, module=False, globs=names_in(thing.__module__))


def examples_of(module: ModuleType) -> Iterator[doctest.DocTest]:
    """Those of a module, and of everything that is defined in it."""
    names = names_in(module.__name__)
    yield doctest.DocTestParser().get_doctest(module.__doc__ or "", names, module.__name__, None, None)
    for name, thing in list(vars(module).items()):
        if (inspect.isroutine(thing) or inspect.isclass(thing)) and thing.__module__ == module.__name__:
            yield from examples(f"{module.__name__}.{name}", thing)


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_work(name):
    runner, said = doctest.DocTestRunner(AnyProcessor(), optionflags=FLAGS), []
    for test in examples_of(importlib.import_module(name)):
        runner.run(test, out=said.append)
    assert runner.tries > 0, f"{name} has '>>>' where no example is found"
    assert runner.failures == 0, "".join(said)


@pytest.mark.parametrize(("name", "thing"), PUBLIC, ids=[name for name, _ in PUBLIC])
def test_what_is_public_has_an_example(name, thing):
    assert any(test.examples for test in examples(name, thing)), f"{name} needs an example: a few lines of >>>"


@pytest.mark.parametrize(
    ("want", "got", "same"),
    [
        ("[0.0, 0.0, -2.0]", "[-0.0, -0.0, -2.0]", True),
        ("tensor([0.5000, 2.])", "tensor([0.5000, 2.0001])", False),
        ("(1.0, 'x')", "(1.0000001, 'y')", False),
        ("3.1415", "3.14150001", True),
        ("[1, 2]", "[1, 3]", False),
    ],
)
def test_numbers_count_by_value_and_all_else_as_it_is_written(want: str, got: str, same: bool):
    assert AnyProcessor().check_output(want + "\n", got + "\n", FLAGS) is same
