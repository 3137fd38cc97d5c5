"""What the op launches, written down as the compiler needs to know it."""

import dataclasses
from typing import Any

import pytest
import torch
import triton.language as tl

from sparsestreet.ops.triton import launch as package
from sparsestreet.ops.triton import lists, rasteriser

_POINTERS = {
    torch.float32: "*fp32",
    torch.float64: "*fp64",
    torch.int16: "*i16",
    torch.int32: "*i32",
    torch.int64: "*i64",
}


@dataclasses.dataclass(frozen=True)
class Launch:
    """One way a kernel is compiled."""

    module: str
    name: str
    types: dict[str, str]
    constants: dict[str, Any]
    options: dict[str, Any]


def record_launches(monkeypatch: pytest.MonkeyPatch) -> list[Launch]:
    """A list that every launch is appended to from now on."""
    launches: list[Launch] = []
    started = package.launch

    def launch(kernel, items, block, *arguments, options=None, **constants):
        names = [name for name in kernel.arg_names if name not in constants and name != "BLOCK"]
        types = {name: _type_of(value) for name, value in zip(names, arguments, strict=True)}
        written = {name: _written(value) for name, value in constants.items()} | {"BLOCK": block}
        launches.append(Launch(kernel.fn.__module__, kernel.fn.__name__, types, written, options or {}))
        started(kernel, items, block, *arguments, options=options, **constants)

    for module in (rasteriser, lists):
        monkeypatch.setattr(module, "launch", launch)
    return launches


def _type_of(value: Any) -> str:
    if isinstance(value, torch.Tensor):
        return _POINTERS[value.dtype]
    return "fp32" if isinstance(value, float) else "i32"


def _written(value: Any) -> Any:
    return {"dtype": value.name} if isinstance(value, tl.dtype) else value
