"""Triton's own launch path on CPU tensors, without a device: binding, specialization of integers, machine code.

Only the launch itself is missing, so outputs stay unwritten. For a process without TRITON_INTERPRET, in which
``install`` comes before the first launch. Works with Triton 3.6.0 and 3.7.1.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from triton.backends.compiler import GPUTarget
from triton.runtime import driver

_PROPERTIES = {"max_shared_mem": 232448, "max_num_regs": 65536, "multiprocessor_count": 132, "warpSize": 32}
"""Of an H100 (CUDA C++ Programming Guide, compute capability 9.0)."""


@dataclass
class FakeDevice:
    """What was launched on it, and what stands in for kernels whose outputs somebody reads."""

    arch: int = 90
    stand_ins: dict[str, Callable[..., None]] = field(default_factory=dict)
    """By a kernel's name: called with the kernel's arguments in place of the kernel."""
    launches: list[tuple[str, int, Any]] = field(default_factory=list)
    """Name, programs and the compiled source of each launch; its attributes tell what was specialized."""
    recording: bool = True


class _Utils:
    def load_binary(self, name: str, kernel: bytes, shared: int, device: int) -> tuple[int, int, int, int, int]:
        """Module, function, registers, spills, most threads of a program."""
        return 1, 1, 0, 0, 1024

    def unload_module(self, module: int) -> None:
        pass

    def get_device_properties(self, device: int) -> dict[str, int]:
        return _PROPERTIES


class _Driver:
    def __init__(self, device: FakeDevice):
        self._device, self.utils = device, _Utils()

    def launcher_cls(self, source: Any, metadata: Any) -> Callable[..., None]:
        name, device = metadata.name, self._device

        def start(x: int, y: int, z: int, stream: int, function: int, packed: Any, lazy: Any, enter, leave, *arguments):
            if device.recording:
                device.launches.append((name, x, source))
            if name in device.stand_ins:
                device.stand_ins[name](*arguments)

        return start

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

    def map_python_to_cpp_type(self, kind: str) -> str:
        return "int"


def install(device: FakeDevice) -> None:
    """Make ``device`` the one that Triton launches on, for the rest of the process."""
    driver.set_active(_Driver(device))
