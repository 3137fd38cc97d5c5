"""CUDA graphs without a device: what a capture starts is written down, and started again over the same tables.

As on a device, a replay runs no Python of ours: numbers that the host has put into a launch stay what they were.
"""

import importlib
import pkgutil
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

from sparsestreet.ops import triton
from sparsestreet.ops.triton import graphs, launch


class RecordedMemory:
    """In place of ``graphs.Memory``."""

    def captured(self, run: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
        run()
        recorder = Recorder()
        with recorder:
            answer = run()
        for table in recorder.tables:
            _spoil(table)  # a capture computes nothing
        return recorder.replay, answer


class HostCalls(TorchDispatchMode):
    """Counts what the host starts: operations but for views and bare memory, launches, and replays as one call each."""

    newest: "HostCalls | None" = None

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __enter__(self) -> "HostCalls":
        HostCalls.newest = self
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        HostCalls.newest = None
        super().__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        view = any(one.alias_info is not None and not one.alias_info.is_write for one in func._schema.returns)
        self.count += not view and func.overloadpacket.__name__ not in BARE
        return func(*args, **(kwargs or {}))


BARE = ("empty", "new_empty", "empty_like", "empty_strided", "new_empty_strided")


class Recorder(TorchDispatchMode):
    """Operations and launches in their order."""

    newest: "Recorder | None" = None

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[Callable[[], None]] = []
        self.tables: list[Tensor] = []

    def __enter__(self) -> "Recorder":
        Recorder.newest = self
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        Recorder.newest = None
        super().__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        found = func(*args, **kwargs)
        aliases = [result.alias_info for result in func._schema.returns]
        if any(alias is not None and not alias.is_write for alias in aliases):
            return found  # a view
        written = [one for one in tree_leaves(found) if isinstance(one, Tensor)]
        if func.overloadpacket.__name__ in BARE:
            self.tables += written
            return found
        in_place = any(alias is not None for alias in aliases) or not written
        if not in_place:
            self.tables += written

        def again() -> None:
            new = func(*args, **kwargs)
            if not in_place:
                for to, value in zip(
                    written, (one for one in tree_leaves(new) if isinstance(one, Tensor)), strict=True
                ):
                    to.copy_(value)

        self.steps.append(again)
        return found

    def replay(self) -> None:
        if HostCalls.newest is not None:
            HostCalls.newest.count += 1
        with torch.no_grad(), _disable_current_modes():
            for step in self.steps:
                step()


def _spoil(table: Tensor) -> None:
    with torch.no_grad():
        table.fill_(float("nan") if table.dtype.is_floating_point else 77 if table.dtype != torch.bool else 1)


def record_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let graphs be recordings, from now on."""
    started = launch.launch

    def launched(*arguments: Any, **constants: Any) -> None:
        recorder = Recorder.newest
        if recorder is not None:
            recorder.steps.append(lambda: started(*arguments, **constants))
        elif HostCalls.newest is not None:
            HostCalls.newest.count += 1
        with _disable_current_modes():
            started(*arguments, **constants)

    names = [found.name for found in pkgutil.iter_modules(triton.__path__, "sparsestreet.ops.triton.")]
    for module in [importlib.import_module(name) for name in names]:  # what is imported later would keep it
        if getattr(module, "launch", None) is started:
            monkeypatch.setattr(module, "launch", launched)
    monkeypatch.setattr(graphs, "Memory", RecordedMemory)
    monkeypatch.setattr(graphs, "_kept", type(graphs._kept)())
    monkeypatch.setattr(graphs, "COUNTS", Counter())
