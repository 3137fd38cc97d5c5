"""Ops that torch.compile calls instead of tracing them."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
Result = TypeVar("Result")


def disable_compile(op: Callable[P, Result]) -> Callable[P, Result]:
    """Returns ``op``, which a compiled function then calls uncompiled: the graph breaks there.

    Dynamo would otherwise trace into the choice of the backend and the library's pointers, and warn. The function
    ``torch.compiler.disable`` does the same, but imports the compiler at once, which takes as long as torch itself.
    """

    @functools.wraps(op)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        if torch.compiler.is_compiling():
            # torch's annotation takes the function for the decorator with options, and so for what makes one.
            return torch.compiler.disable(op)(*args, **kwargs)  # pyright: ignore[reportCallIssue]
        return op(*args, **kwargs)

    return call
