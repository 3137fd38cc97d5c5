"""Renders and differentiates as on a device, up to the launches, and says what was launched and how.

Run as a script, without TRITON_INTERPRET: cases come in as JSON on standard input, what was found goes out as JSON.
"""

import json
import sys
from contextlib import nullcontext
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from sparsestreet.host_copy import HostCopy
from sparsestreet.ops import splat, validate
from sparsestreet.ops.triton import rasterizer, screen
from tests.ops.scenes import camera, cast, random_gaussians
from tests.ops.triton.compile_offline import forbidden_in, instructions_of, resources_of
from tests.ops.triton.fake_driver import Binary, FakeDevice, install

ROWS, VISIBLE = 40, 30
_ALLOCATIONS = ("empty", "new_empty", "empty_like", "empty_strided", "new_empty_strided")


class Dispatches(TorchDispatchMode):
    """Names of torch's operations: all of them, and those that start something on a device: no views (something that is
    returned shares memory with an argument that is not written) and no bare allocations."""

    def __init__(self) -> None:
        super().__init__()
        self.all: list[str] = []
        self.names: list[str] = []
        self.after_wait: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        returned = [result.alias_info for result in func._schema.returns]
        view = any(alias is not None and not alias.is_write for alias in returned)
        name = func._schema.name.removeprefix("aten::")
        self.all.append(name)
        if not view and name not in _ALLOCATIONS:
            self.names.append(name)
            self.after_wait.append(name)
        return func(*args, **(kwargs or {}))


class Case:
    """One scene and view; the numbers that the host waits for are planted."""

    def __init__(self, case: dict):
        self.view = camera(case["width"], case["height"])
        scene = random_gaussians(ROWS, self.view, terms=case["terms"])
        self.gaussians = cast(scene, torch.float32, requires_grad=True)
        self.background = torch.zeros(3) if case["background"] else None
        # On a device the values of a background are not read.
        validate._check_background = lambda *_: None
        self.numbers, self.dispatches = [case["pairs"], VISIBLE, 0], Dispatches()
        screen.wait_for = self.wait_for

    def wait_for(self, arriving: HostCopy) -> list[int]:
        self.dispatches.after_wait.clear()
        return self.numbers

    def run(self, backward: bool = True, counted: bool = False) -> list[str]:
        """Torch's operations that start something, forward."""
        self.dispatches.all.clear()
        self.dispatches.names.clear()
        with self.dispatches if counted else nullcontext():
            drawn = splat(self.gaussians, self.view, background=self.background, backend="triton")
        if backward:
            (drawn.rgb.sum() + drawn.depth.sum()).backward()
        return list(self.dispatches.names)


def found_in(binaries: list[Binary], arch: int) -> list[dict]:
    machine_code = instructions_of([binary.cubin for binary in binaries], arch)
    return [
        {"name": binary.name, "types": dict(binary.source.signature), "known": binary.specialized()}
        | {"shared": binary.shared, **resources_of(binary.cubin), **forbidden_in(instructions)}
        for binary, instructions in zip(binaries, machine_code, strict=True)
    ]


def python_calls(case: Case) -> int:
    """How many Python functions a forward pass calls, which takes no clock to compare."""
    called: list[str] = []
    sys.setprofile(lambda frame, event, _: called.append(frame.f_code.co_name) if event == "call" else None)
    case.run(backward=False)
    sys.setprofile(None)
    return len(called)


def measure(device: FakeDevice, given: dict) -> dict:
    """All that is asked of a case."""
    before = len(device.binaries)
    case = Case(given)
    case.run()
    answer: dict[str, Any] = {"compiled": found_in(device.binaries[before:], device.arch)}
    device.launches.clear()
    answer["dispatches"] = case.run(backward=False, counted=True)
    answer["after_wait"] = list(case.dispatches.after_wait)
    answer["calls"], answer["forward"] = list(case.dispatches.all), [binary.name for binary in device.launches]
    answer["python"] = python_calls(case)
    return answer


if __name__ == "__main__":
    fake = FakeDevice()
    install(fake)
    # The only other thing that a device's tensors have and these have not.
    rasterizer.is_interpreted = lambda kernel: True
    json.dump([measure(fake, given) for given in json.load(sys.stdin)], sys.stdout)
