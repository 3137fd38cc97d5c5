"""What is launched, written down as the compiler needs to know it, and compiled in a process of its own."""

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import triton.language as tl

from sparsestreet.ops.triton import launch as package
from sparsestreet.ops.triton import lists, parts, passes, pixels, screen

_POINTERS = {
    torch.float32: "*fp32",
    torch.float64: "*fp64",
    torch.int16: "*i16",
    torch.int32: "*i32",
    torch.int64: "*i64",
    torch.uint8: "*u8",
}


@dataclasses.dataclass(frozen=True)
class Launch:
    """One way a kernel is compiled."""

    module: str
    name: str
    types: dict[str, str]
    constants: dict[str, Any]
    options: dict[str, Any]
    without: tuple[str, ...] = ()
    """Functions of the kernel's module that it must compile without."""


def record_launches(
    monkeypatch: pytest.MonkeyPatch, modules: Sequence[ModuleType] = (passes, screen, lists, parts, pixels)
) -> list[Launch]:
    """A list that every launch of the modules is appended to from now on."""
    launches: list[Launch] = []
    started = package.launch

    def launch(kernel, items, block, *arguments, options=None, **constants):
        names = [name for name in kernel.arg_names if name not in constants and name != "BLOCK"]
        types = {name: _type_of(value) for name, value in zip(names, arguments, strict=True)}
        written = {name: _written(value) for name, value in constants.items()} | {"BLOCK": block}
        launches.append(Launch(kernel.fn.__module__, kernel.fn.__name__, types, written, options or {}))
        started(kernel, items, block, *arguments, options=options, **constants)

    for module in modules:
        monkeypatch.setattr(module, "launch", launch)
    return launches


def compile_launches(launches: list[Launch], arch: int) -> list[tuple[Launch, dict]]:
    """What compile_offline.py finds of each launch, compiled for sm_``arch``."""
    given = {"arch": arch, "launches": [dataclasses.asdict(item) for item in launches]}
    return list(zip(launches, run_compiler("compile_offline", given), strict=True))


def run_compiler(script: str, given: Any) -> Any:
    """What a script of this folder answers, in a process that has the compiler: the interpreter replaces it in this."""
    environment = {"TRITON_CACHE_DIR": str(Path.cwd() / ".cache" / "triton")} | dict(os.environ)
    environment.pop("TRITON_INTERPRET", None)
    command = [sys.executable, "-m", f"tests.ops.triton.{script}"]
    ended = subprocess.run(
        command, input=json.dumps(given), env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr[-3000:]
    return json.loads(ended.stdout)


def _type_of(value: Any) -> str:
    if isinstance(value, torch.Tensor):
        return _POINTERS[value.dtype]
    return "fp32" if isinstance(value, float) else "i32"


def _written(value: Any) -> Any:
    return {"dtype": value.name} if isinstance(value, tl.dtype) else value
