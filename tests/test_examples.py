"""The examples in docstrings: they run, and whatever users call in the rooms below has one."""

import doctest
import importlib
import inspect
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
    "sparsestreet.safe_pickle",
)
"""Modules, and packages, in which everything public has an example: the names in ``__all__``, else each function."""

PACKAGE = Path(sparsestreet.__file__).parent
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


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
    runner, said = doctest.DocTestRunner(optionflags=FLAGS), []
    for test in examples_of(importlib.import_module(name)):
        runner.run(test, out=said.append)
    assert runner.tries > 0, f"{name} has '>>>' where no example is found"
    assert runner.failures == 0, "".join(said)


@pytest.mark.parametrize(("name", "thing"), PUBLIC, ids=[name for name, _ in PUBLIC])
def test_what_is_public_has_an_example(name, thing):
    assert any(test.examples for test in examples(name, thing)), f"{name} needs an example: a few lines of >>>"
