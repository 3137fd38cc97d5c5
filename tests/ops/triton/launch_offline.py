"""Renders and differentiates as on a device, up to the launches, and says what was launched and how.

Run as a script, without TRITON_INTERPRET: cases come in as JSON on standard input, what was found goes out as JSON.
"""

import json
import statistics
import sys
import time
from contextlib import nullcontext
from types import ModuleType
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from sparsestreet.host_copy import HostCopy
from sparsestreet.ops import splat, validate
from sparsestreet.ops.triton import lists, parts, pixels, rasterizer, screen
from sparsestreet.ops.triton.launch import launch
from tests.ops.scenes import camera, cast, random_gaussians
from tests.ops.triton.compile_offline import forbidden_in, instructions_of, resources_of
from tests.ops.triton.fake_driver import Binary, FakeDevice, install

MODULES: tuple[ModuleType, ...] = (screen, lists, parts, pixels, rasterizer, pixels)
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


def launch_time(case: Case, repeats: int) -> float:
    """Microseconds that a forward and a backward pass spend in their launches, median."""
    spent = [0.0]

    def timed(*arguments: Any, **options: Any) -> None:
        start = time.perf_counter()
        launch(*arguments, **options)
        spent[-1] += time.perf_counter() - start

    for module in MODULES:
        vars(module).update(launch=timed)
    for _ in range(repeats):
        case.run()
        spent.append(0.0)
    for module in MODULES:
        vars(module).update(launch=launch)
    return statistics.median(spent[:-1]) * 1e6


def python_calls(case: Case) -> int:
    """How many Python functions a forward pass calls, which takes no clock to compare."""
    called: list[str] = []
    sys.setprofile(lambda frame, event, _: called.append(frame.f_code.co_name) if event == "call" else None)
    case.run(backward=False)
    sys.setprofile(None)
    return len(called)


def host_time(case: Case, repeats: int) -> list[float]:
    """Microseconds of the host's thread in a forward pass: the least, the quartiles."""
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        case.run(backward=False)
        times.append(1e6 * (time.thread_time() - start))
    return [min(times), *statistics.quantiles(times, n=4)]


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
    if given["repeats"]:
        answer["microseconds"] = launch_time(case, given["repeats"])
        answer["forward_microseconds"] = host_time(case, given["repeats"])
    return answer


if __name__ == "__main__":
    fake = FakeDevice()
    install(fake)
    # The only other thing that a device's tensors have and these have not.
    rasterizer.is_interpreted = lambda kernel: True
    json.dump([measure(fake, given) for given in json.load(sys.stdin)], sys.stdout)
