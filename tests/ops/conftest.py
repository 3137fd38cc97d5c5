"""Triton's interpreter in reasonable time: one needless patch left out, and costly cases left to ``make test-all``."""

from pathlib import Path
from typing import Any

import pytest
import torch

from sparsestreet.ops.backend import has_triton

INTERPRETED = has_triton() and not torch.cuda.is_available()
if INTERPRETED:
    from triton.runtime.interpreter import InterpretedFunction

    patch_and_call = InterpretedFunction.__call__
    called: set[InterpretedFunction] = set()

    def call_from_a_kernel(function: InterpretedFunction, *arguments: Any, **options: Any) -> Any:
        if function in called:
            return function.rewrite()(*arguments, **options)
        called.add(function)
        return patch_and_call(function, *arguments, **options)

    # For each call of a function from a kernel the interpreter patches all that the function sees of triton.language,
    # which the kernel's launch and the function's first call have patched for good: more than half of its time.
    InterpretedFunction.__call__ = call_from_a_kernel


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    kernels = Path(__file__).parent / "triton"
    for item in items:
        if INTERPRETED and item.path.parent == kernels:
            item.add_marker("interpreted")
        if item.get_closest_marker("interpreted") and item.get_closest_marker("slow_if_interpreted"):
            item.add_marker("slow")
