"""Triton's interpreter in a third of its time. It computes what it computed; what is left out it did again and again.

The functions that are replaced are those of Triton 3.6 and 3.7.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from triton.language import core
from triton.runtime import interpreter
from triton.runtime.interpreter import InterpretedFunction


def speed_up() -> None:
    """For the whole process."""
    functions: Any = InterpretedFunction
    tuples: Any = core.tuple
    functions.__call__ = _call_from_a_kernel
    interpreter._get_np_dtype = _numpy_type
    tuples.__init__ = _init_tuple
    tuples.type = property(_type_of_tuple, lambda values, kind: setattr(values, "_type", kind))


def check_overflow(on: bool) -> None:
    """Whether each sum, difference and product of integers is computed in 64 bits too, and compared: a third of all
    time. A compiled kernel does not either."""
    builder = interpreter.interpreter_builder
    if builder.options.sanitize_overflow != on:
        builder.options = replace(builder.options, sanitize_overflow=on)


_patch_and_call = InterpretedFunction.__call__
_called: set[InterpretedFunction] = set()


def _call_from_a_kernel(function: InterpretedFunction, *arguments: Any, **options: Any) -> Any:
    """For each call of a function from a kernel the interpreter patches all that the function sees of triton.language,
    which the kernel's launch and the function's first call have patched for good."""
    if function in _called:
        return function.rewrite()(*arguments, **options)
    _called.add(function)
    return _patch_and_call(function, *arguments, **options)


_make_table_and_look = interpreter._get_np_dtype


def _numpy_type(kind: core.dtype) -> np.dtype:
    """It makes its table of all types for each answer."""
    return np.dtype(np.uint64) if kind.scalar.is_ptr() else _numpy_type_of_scalar(kind.scalar)


@cache
def _numpy_type_of_scalar(kind: core.dtype) -> np.dtype:
    return _make_table_and_look(kind)


_type_for_values = core._type_for_tuple_values


def _init_tuple(values: Any, args: Any, type: Any = None) -> None:
    """Every shape is a tuple, and hardly a shape is asked for its type."""
    values.values = [*args]
    values._type = type if type is None or isinstance(type, core.tuple_type) else core.tuple_type(type)


def _type_of_tuple(values: Any) -> core.tuple_type:
    if values._type is None:
        values._type = _type_for_values(values.values)
    return values._type
