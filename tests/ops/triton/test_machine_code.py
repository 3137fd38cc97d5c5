"""Every kernel compiles for sm_80 and sm_90 without a GPU, and the pixel loops stay within their budgets.

Budgets are what was measured with Triton 3.7.1 (3.6.0 in a comment where it differs). The bars the design was held to are
those of a serial one-warp kernel for RGB alone: 72 registers and 20.8 instructions per (splat, pixel) sample forward, 96
and 59.1 backward. What the op adds costs: depth 1.1 instructions and 8 registers forward; absolute gradients 7.3
instructions, depth 3.4 and 32 registers backward.
"""

import dataclasses
import json
import os
import subprocess
import sys

import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution, splat
from sparsestreet.types import Shutter
from tests.ops.scenes import camera, cast, device_of, random_gaussians
from tests.ops.triton.recording import Launch, record_launches

ARCHITECTURES = ("80", "90")
DEVICE = device_of("triton")


def launches_of_the_op(monkeypatch: pytest.MonkeyPatch) -> list[Launch]:
    """All kernels, with every switch on and off."""
    launches = record_launches(monkeypatch)
    view = camera(5, 4)
    leaves = cast(random_gaussians(3, view, terms=16), torch.float32, requires_grad=True, device=DEVICE)
    splat(leaves, view, backend="triton").rgb.sum().backward()
    rendering = splat(leaves, view, backend="triton", settings=SplatSettings(stop="exclusive", antialias=True))
    rendering.depth.sum().backward()
    contribution(leaves, view, backend="triton")
    small = cast(random_gaussians(3, view, terms=1), torch.float32, requires_grad=True, device=DEVICE)
    moving = dataclasses.replace(
        view, distortion=torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0]), shutter=Shutter(torch.ones(3), torch.zeros(3))
    )
    splat(small, moving, backend="triton").depth.sum().backward()
    splat(small, dataclasses.replace(moving, distortion=None), backend="triton").depth.sum().backward()
    unique = {json.dumps(dataclasses.asdict(launch), sort_keys=True): launch for launch in launches}
    return list(unique.values())


def bare(launch: Launch) -> Launch:
    """The pixel kernels for RGB alone."""
    constants = launch.constants | {"DEPTH": False}
    if "ABSOLUTE" in constants:
        constants["ABSOLUTE"] = False
    return dataclasses.replace(launch, constants=constants)


@pytest.fixture(scope="module")
def compiled() -> list[tuple[Launch, dict]]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        launches = launches_of_the_op(monkeypatch)
    default = [launch for launch in launches if launch.name.startswith("blend") and not launch.constants["EXCLUSIVE"]]
    launches += [bare(launch) for launch in default[:2]]
    # The interpreter replaces the compiler in this process.
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    given = {"archs": [int(arch) for arch in ARCHITECTURES], "launches": [dataclasses.asdict(item) for item in launches]}
    command = [sys.executable, "-m", "tests.ops.triton.compile_offline"]
    ended = subprocess.run(command, input=json.dumps(given), env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-3000:]
    return list(zip(launches, json.loads(ended.stdout), strict=True))
