"""Ops that torch.compile calls instead of tracing them."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
Result = TypeVar("Result")


def disable_compile(op: Callable[P, Result]) -> Callable[P, Result]:
    """``op`` as it is written, also inside a function that is compiled: the graph breaks there.

    Dynamo would trace into the backend's choice and the library's pointers, and warn. As ``torch.compiler.disable``,
    but that one imports the compiler at once, which takes as long as torch itself.
    """

    @functools.wraps(op)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(op)(*args, **kwargs)
        return op(*args, **kwargs)

    return call
