"""Triton's interpreter in a fifth of its time. It computes what it computed; what is left out it did again and again.

The functions that are replaced are those of Triton 3.6 and 3.7.
"""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from triton.language import core
from triton.language.semantic import TritonSemantic
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
    tuples.__eq__ = _same_values
    blocks: Any = core.block_type
    blocks.name = property(lambda block: f"<{block.shape}, {block.element_ty}>", lambda block, name: None)
    blocks.__init__ = _init_block
    tensors: Any = core.tensor
    tensors.__init__ = _init_tensor
    internals: Any = core
    internals._unwrap_if_constexpr = _unwrap
    semantics: Any = TritonSemantic
    semantics.broadcast_impl_value = _broadcast
    interpreter._patch_attr = _patch_attribute


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


_YES, _NO = core.constexpr(True), core.constexpr(False)


def _same_values(values: Any, other: Any) -> core.constexpr:
    return _YES if values.values == [*other] else _NO


_make_block = core.block_type.__init__
_blocks: dict[tuple[int, ...], tuple[core.tuple, int]] = {}


def _init_block(block: Any, element_ty: core.dtype, shape: Any) -> None:
    """Every value has a block's type of its own; of shapes there are a few, which are looked through once."""
    sizes = tuple([_unwrap(size) for size in shape])
    if sizes not in _blocks:
        _make_block(block, element_ty, shape)
        _blocks[sizes] = block.shape, block.numel
    block.element_ty = element_ty
    block.shape, block.numel = _blocks[sizes]


def _init_tensor(tensor: Any, handle: Any, type: Any) -> None:
    tensor.handle, tensor.type, tensor.dtype = handle, type, type.scalar
    tensor.shape, tensor.numel = _axes(tuple(type.shape.values) if type.is_block() else ())


@cache
def _axes(sizes: tuple[int, ...]) -> tuple[core.tuple, core.constexpr]:
    return core.tuple([core.constexpr(size) for size in sizes]), core.constexpr(math.prod(sizes))


_broadcast_to_a_shape: Any = TritonSemantic.broadcast_impl_value


def _broadcast(semantic: TritonSemantic, left: core.tensor, right: core.tensor) -> tuple[core.tensor, core.tensor]:
    kinds: Any = left.type, right.type
    if kinds[0].is_block() and kinds[1].is_block() and kinds[0].shape is kinds[1].shape:
        return left, right
    return _broadcast_to_a_shape(semantic, left, right)


_unwrap_all: Any = core._unwrap_if_constexpr
_BARE = {core.tensor, core.dtype, core.block_type, core.pointer_type, int, float, bool, str, type(None)}


def _unwrap(value: Any) -> Any:
    """Most are numbers and tensors."""
    kind = value.__class__
    if kind is core.constexpr:
        return value.value
    return value if kind in _BARE else _unwrap_all(value)


_asked_for = core.builtin(lambda: None).__code__
"""Of the wrapper that refuses a call outside of a kernel."""


def _patch_attribute(owner: Any, name: str, member: Any, builder: Any, scope: Any) -> None:
    """Two wrappers around each operation are one."""
    bare = member.__wrapped__ if getattr(member, "__code__", None) is _asked_for else member

    def in_a_kernel(*arguments: Any, **options: Any) -> Any:
        options["_semantic"] = interpreter.interpreter_semantic
        return bare(*arguments, **options)

    scope.set_attr(owner, name, in_a_kernel)
