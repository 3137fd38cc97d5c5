"""Triton's own launch path on CPU tensors, without a device: binding, specialization of integers, machine code.

Only the launch itself is missing, so outputs stay unwritten. For a process without TRITON_INTERPRET, in which
``install`` comes before the first launch. Works with Triton 3.6.0 and 3.7.1.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime import driver

_PROPERTIES = {"max_shared_mem": 232448, "max_num_regs": 65536, "multiprocessor_count": 132, "warpSize": 32}
"""Of an H100 (CUDA C++ Programming Guide, compute capability 9.0)."""


@dataclass
class Binary:
    """A kernel as it was specialized, and its machine code."""

    name: str
    source: ASTSource
    shared: int
    """Bytes of shared memory."""
    cubin: bytes = b""

    def specialized(self) -> dict[str, str]:
        """What is known of each argument that is no constant: "1" (its value), "16" (what divides it) or ""."""
        known = {}
        for i, name in enumerate(self.source.fn.arg_names):
            if not self.source.fn.params[i].is_constexpr:
                divisible = ["tt.divisibility", 16] in self.source.attrs.get((i,), [])
                known[name] = "1" if (i,) in self.source.constants else "16" if divisible else ""
        return known


@dataclass
class FakeDevice:
    """A device of compute capability ``arch`` that compiles what is launched and runs nothing."""

    arch: int = 90
    binaries: list[Binary] = field(default_factory=list)
    """What was compiled."""
    launches: list[Binary] = field(default_factory=list)
    """Which of them was launched, time after time."""


class _Driver:
    """What Triton asks of a driver; it is its own ``utils``."""

    def __init__(self, device: FakeDevice):
        self._device, self.utils = device, self

    def launcher_cls(self, source: ASTSource, metadata: Any) -> Callable[..., None]:
        """What starts a kernel: made just before its machine code is loaded."""
        binary, device = Binary(metadata.name, source, metadata.shared), self._device
        device.binaries.append(binary)

        def start(*arguments: Any) -> None:
            device.launches.append(binary)

        return start

    def load_binary(self, name: str, cubin: bytes, shared: int, device: int) -> tuple[int, int, int, int, int]:
        """Module, function, registers, spills, most threads of a program."""
        self._device.binaries[-1].cubin = cubin
        return 1, 1, 0, 0, 1024

    def unload_module(self, module: int) -> None:
        pass

    def get_device_properties(self, device: int) -> dict[str, int]:
        return _PROPERTIES

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int = 0) -> int:
        return 0

    def get_current_target(self) -> GPUTarget:
        return GPUTarget("cuda", self._device.arch, 32)

    def get_device_interface(self) -> Any:
        return torch.cuda

    def get_active_torch_device(self) -> torch.device:
        return torch.device("cpu")


def install(device: FakeDevice) -> None:
    """Make ``device`` the one that Triton launches on, for the rest of the process."""
    driver.set_active(_Driver(device))  # pyright: ignore[reportArgumentType]
