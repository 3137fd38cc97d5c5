"""A training step as a CUDA device would run it, without one: where would the host wait?

Tensors on the device "meta" have no numbers and stand for those of the GPU. The op's kernels are not launched, all else
of its host side runs. What would wait is noted with its place, answered with made-up numbers, and the step goes on.
"""

import importlib
import pkgutil
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

import sparsestreet
from sparsestreet.host_copy import HostCopy
from sparsestreet.ops import backend, triton
from sparsestreet.ops.triton import graphs, launch, rasterizer, screen
from sparsestreet.training import nonfinite

META = torch.device("meta")
PACKAGE = Path(sparsestreet.__file__).parent

SPLAT = "splat"
"""The op's own wait, for the numbers of its rows and pairs."""

NUMBERS = {"_local_scalar_dense", "is_nonzero", "equal", "_linalg_check_errors"}
"""Operations that need a number of the device on the host."""
SIZES = {"nonzero", "masked_select", "_unique", "_unique2", "unique_dim", "unique_consecutive", "bincount"}
"""Operations whose answer has as many rows as the numbers on the device say."""
FROM_NUMBERS = {torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor}
"""Copies from pageable memory, behind which torch waits."""


class Waits:
    """Places in the package, in the order in which a step would wait there."""

    def __init__(self) -> None:
        self.places: list[str] = []
        self.renderings = 0
        """How often the splat op has waited."""

    def note(self, what: str) -> None:
        frames = [frame for frame in traceback.extract_stack() if Path(frame.filename).is_relative_to(PACKAGE)]
        innermost = frames[-1] if frames else traceback.extract_stack()[-3]
        name = Path(innermost.filename)
        module = name.relative_to(PACKAGE) if name.is_relative_to(PACKAGE) else name.name
        self.places.append(f"{module}:{innermost.name}: {what}")


class _Numbers(TorchFunctionMode):
    """Notes tensors that are made of Python's numbers on the device: torch copies them unseen by dispatch."""

    def __init__(self, waits: Waits) -> None:
        super().__init__()
        self._waits = waits

    def __torch_function__(self, func, types, args=(), kwargs=None):
        answer = func(*args, **(kwargs or {}))
        if func in FROM_NUMBERS and answer.device == META and not isinstance(args[-1], Tensor):
            self._waits.note("copy to the device")
        if func in (Tensor.__getitem__, Tensor.__setitem__) and _on_device(args[:1]) and _has_list(args[1]):
            self._waits.note("index of the host")
        return answer


class _Operations(TorchDispatchMode):
    def __init__(self, waits: Waits) -> None:
        super().__init__()
        self._waits = waits

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        given = _on_device(args)
        if given and name in NUMBERS:
            self._waits.note(name)
            return None if name == "_linalg_check_errors" else _made_up(args[0])
        if given and name in SIZES:
            self._waits.note(name)
            return _as_many(name, args[0])
        if name == "repeat_interleave" and given and kwargs.get("output_size") is None:
            self._waits.note(name)
        if name in ("index", "index_put", "index_put_", "_index_put_impl_") and given:
            return func(args[0], self._numbered(name, args), *args[2:], **kwargs)
        if name in ("_to_copy", "copy_"):
            source = args[1] if name == "copy_" else args[0]
            target = args[0].device if name == "copy_" else torch.device(kwargs.get("device") or source.device)
            if self._copies(source, target, kwargs.get("non_blocking", args[2:] == (True,))):
                dtype = kwargs.get("dtype") or (args[0].dtype if name == "copy_" else source.dtype)
                zeros = torch.zeros(source.shape, dtype=dtype)
                return args[0].copy_(zeros) if name == "copy_" else zeros
        if name == "_fused_adam_":
            return None  # which has no shapes to check
        return func(*args, **kwargs)

    def _copies(self, source: Tensor, target: torch.device, non_blocking: bool) -> bool:
        """Whether numbers that are not there are copied to the host; notes what waits."""
        if source.device == META and target.type == "cpu":
            self._waits.note("copy to the host")
            return True
        if source.device.type == "cpu" and target == META and not non_blocking:
            self._waits.note("copy to the device")
        return False

    def _numbered(self, name: str, args: tuple) -> list[Tensor | None]:
        """Masks as the numbers of all rows; a mask that is filled with one number waits for nothing."""
        indices = list(args[1])
        filled = name != "index" and args[2].numel() == 1 and args[2].device.type == "cpu"
        for place, index in enumerate(indices):
            if index is None:
                continue
            if index.device.type == "cpu":
                self._waits.note("index of the host")
            elif index.dtype in (torch.bool, torch.uint8) and not filled:
                self._waits.note("index by a mask")
            if index.dtype == torch.bool and index.dim() == 1:
                indices[place] = torch.empty(len(index), dtype=torch.int64, device=META)
        return indices


def _on_device(values: Any) -> bool:
    if isinstance(values, Tensor):
        return values.device == META
    return isinstance(values, list | tuple) and any(_on_device(value) for value in values)


def _has_list(index: Any) -> bool:
    return any(isinstance(one, list) for one in (index if isinstance(index, tuple) else (index,)))


def _made_up(value: Tensor) -> bool | int | float:
    return True if value.dtype == torch.bool else 1.0 if value.dtype.is_floating_point else 1


def _as_many(name: str, value: Tensor) -> Any:
    """As if all were seen."""
    if name == "nonzero":
        return torch.empty(value.numel(), value.dim(), dtype=torch.int64, device=META)
    if name == "masked_select":
        return torch.empty(value.numel(), dtype=value.dtype, device=META)
    if name == "bincount":
        return torch.empty(8, dtype=torch.int64, device=META)
    counts = torch.empty(value.numel(), dtype=torch.int64, device=META)
    return torch.empty_like(value).flatten(), counts, counts


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch) -> None:
    """ "meta" counts as a CUDA device with Triton, on which nothing is launched."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # does not know the device
    monkeypatch.setattr(backend, "_fastest", lambda device: "triton")
    monkeypatch.setattr(backend, "_on_gpu", lambda tensors: all(tensor.device == META for tensor in tensors))
    monkeypatch.setattr(rasterizer, "_check", lambda gaussians: None)
    monkeypatch.setattr(sys.modules["torch.optim.adam"], "_device_dtype_check_for_fused", lambda parameter: None)
    of_a_driver = {"launch": lambda *arguments, **constants: None, "stream_of": lambda device: 0}
    real = {name: getattr(launch, name, None) for name in of_a_driver}
    for found in pkgutil.iter_modules(triton.__path__, "sparsestreet.ops.triton."):
        module = importlib.import_module(found.name)
        for name, stand_in in of_a_driver.items():
            if real[name] is not None and getattr(module, name, None) is real[name]:
                monkeypatch.setattr(module, name, stand_in)


@contextmanager
def waits(monkeypatch: pytest.MonkeyPatch) -> Iterator[Waits]:
    """Notes where what is done would wait."""
    found = Waits()

    def counted(arriving: object) -> list[int]:
        found.places.append(SPLAT)
        found.renderings += 1
        return [40, 5, 0]

    @dataclass(frozen=True)
    class Queued(HostCopy):
        """A copy that has arrived once a later rendering has waited."""

        before: int = 0

        @property
        def ready(self) -> bool:
            return found.renderings > self.before

        def wait(self) -> Tensor:
            if not self.ready:
                found.note("arrival")
            return self.values

    def queued(values: Tensor) -> HostCopy:
        return Queued(torch.zeros(values.shape), None, found.renderings)

    with monkeypatch.context() as patch, _Numbers(found), _Operations(found):
        patch.setattr(screen, "wait_for", counted)
        for module in (nonfinite, screen, graphs):
            patch.setattr(module, "copy_to_host", queued)
        yield found
