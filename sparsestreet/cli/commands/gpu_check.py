"""``sparsestreet check``: whether a GPU can train here; what is missing, and what would help."""

import os
import shutil
import sys
import sysconfig
import time
import warnings
from collections.abc import Callable
from pathlib import Path

HELP = """\
sparsestreet check: whether a GPU can train here.

It looks at torch, the driver and the device, what compiles kernels, and memory, in this order, and says what is missing
and what would help. Last it draws 200 Gaussians on the device and on the CPU and compares both, with gradients. The
first time, this compiles kernels. Ends with status 0 if trainer=gpu will train here, else 1.
"""

CUDA_TORCH = (
    "pip uninstall torch, then pip install -c constraints.txt torch --index-url https://download.pytorch.org/whl/cu130 "
    "(CUDA 13.0; pytorch.org lists others)"
)
"""A build that is there satisfies pip, with CUDA or without."""
MIN_CAPABILITY = (8, 0)
"""Of NVIDIA's devices: what Triton compiles for (A100, RTX 30 and newer)."""
MIN_GB = 1.0
"""Free memory without which not even a small street trains."""
SIDE, ROWS = 64, 200
"""Of the image that is drawn, pixels, and of its Gaussians."""


class MissingError(Exception):
    """What stands in the way of a training on a GPU, with its remedy."""


def check(arguments: list[str]) -> int:
    """Look at each part in turn, up to the first that is missing; 0 if there is none, else 1."""
    if arguments in (["-h"], ["--help"]):
        print(HELP)
        return 0
    if arguments:
        print(f"sparsestreet check takes no arguments, got {' '.join(arguments)}", file=sys.stderr)
        return 2
    for name, look in PARTS.items():
        print(f"{name:<10}", end="", flush=True)
        try:
            print(look())
        except MissingError as missing:
            print(f"MISSING: {missing}")
            return 1
    print("a GPU trains here: sparsestreet train trainer=gpu")
    return 0


def torch_build() -> str:
    """Torch's version and that of its CUDA."""
    try:
        import torch
    except ImportError as error:
        raise MissingError(f"torch cannot be imported ({first_line(error)}): {CUDA_TORCH}") from error
    if torch.version.cuda is None:
        build = f"torch {torch.__version__} is a build without CUDA"
        if has_driver():
            raise MissingError(f"{build}: {CUDA_TORCH}")
        raise MissingError(f"{build}, and no NVIDIA driver is here: where a GPU is, install its driver; {CUDA_TORCH}")
    return f"torch {torch.__version__} with CUDA {torch.version.cuda}"


def has_driver() -> bool:
    """Whether the kernel shows NVIDIA's devices."""
    return Path("/dev/nvidiactl").exists() or shutil.which("nvidia-smi") is not None


def device() -> str:
    """Name and capability of the device that torch takes, on which it can compute."""
    import torch

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        there = torch.cuda.is_available()
    if not there:
        reason = str(said[-1].message).split(" (Triggered")[0] if said else "torch sees no CUDA device"
        remedy = (
            f"a driver must be as new as CUDA {torch.version.cuda}, and CUDA_VISIBLE_DEVICES must name a device"
            if has_driver()
            else "install NVIDIA's driver; in a container, start it with the devices (docker run --gpus all)"
        )
        raise MissingError(f"{reason}: {remedy}")
    capability = torch.cuda.get_device_capability()
    name = "{}, compute capability {}.{}".format(torch.cuda.get_device_name(), *capability)
    if capability < MIN_CAPABILITY:
        least = "{}.{}".format(*MIN_CAPABILITY)
        raise MissingError(f"{name}, and kernels need {least}: take another device, or train with trainer=cpu")
    try:
        torch.ones(2, device="cuda").sum().item()
    except RuntimeError as error:
        raise MissingError(f"torch cannot compute on {name}: {first_line(error)}; {CUDA_TORCH}") from error
    return name


def compiler() -> str:
    """The C compiler that Triton calls."""
    named = os.environ.get("CC")
    found = shutil.which(named) if named else shutil.which("gcc") or shutil.which("clang")
    if found is None:
        what = f"the C compiler that CC names ({named}) is not there" if named else "there is no C compiler"
        raise MissingError(f"{what}, and Triton calls one: apt-get install gcc, or name one with CC")
    return found


def headers() -> str:
    """Python's header, and Triton."""
    header = Path(sysconfig.get_path("include")) / "Python.h"
    if not header.is_file():
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise MissingError(f"there is no {header}, which Triton compiles with: apt-get install python{version}-dev")
    try:
        import triton
    except ImportError as error:
        from sparsestreet.ops.backend import TRITON_REMEDY

        raise MissingError(f"Triton cannot be imported ({first_line(error)}): {TRITON_REMEDY}") from error
    return f"{header}; triton {triton.__version__}"


def memory() -> str:
    """What is free of the device's memory."""
    import torch

    free, total = (1e-9 * count for count in torch.cuda.mem_get_info())
    if free < MIN_GB:
        raise MissingError(
            f"{free:.1f} of {total:.1f} GB are free: nvidia-smi lists who holds the rest; end it, or name another "
            "device with CUDA_VISIBLE_DEVICES"
        )
    return f"{free:.1f} of {total:.1f} GB are free"


def splat() -> str:
    """Draw and differentiate a small scene on the device and, in float64, on the CPU."""
    import torch

    from sparsestreet.bench.accuracy import agrees, answer, errors
    from sparsestreet.bench.scenes import frustum_camera, frustum_gaussians
    from sparsestreet.ops.settings import SplatSettings

    camera, settings = frustum_camera(SIDE, SIDE), SplatSettings()
    rows, began = frustum_gaussians(ROWS, camera, sigma_pixels=2.0, terms=16), time.perf_counter()
    try:
        drawn = answer(rows, camera, settings, "triton", torch.float32, "cuda")
    except Exception as error:  # a compiler, a driver or a launch may raise anything
        raise MissingError(
            f"{type(error).__name__}: {first_line(error)}; with the versions of constraints.txt kernels are known to "
            "compile (docs/gpu.md)"
        ) from error
    seconds = time.perf_counter() - began
    found = errors(drawn, answer(rows, camera, settings, "reference", torch.float64))
    if not agrees(found):
        worst = max(found.gradients.values(), key=lambda one: one.relative_l2 or 0.0).relative_l2
        raise MissingError(
            f"the device draws another image than the CPU (colors differ by up to {found.image.maximum:.1e}, gradients "
            f"by {worst:.1e} of their length): take the versions of constraints.txt, and report it"
        )
    return f"{ROWS} Gaussians as on the CPU, with gradients: {seconds:.1f} s with what was compiled"


def first_line(error: BaseException) -> str:
    """What an error says, in one line."""
    return next(iter(str(error).strip().splitlines()), "no message")


PARTS: dict[str, Callable[[], str]] = {
    "torch": torch_build,
    "device": device,
    "compiler": compiler,
    "headers": headers,
    "memory": memory,
    "splat": splat,
}
"""What is looked at, in this order."""
