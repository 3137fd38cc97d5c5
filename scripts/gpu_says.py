"""What the check of a GPU says: ``gpu_says.py machine``, or ``gpu_says.py training SUMMARY`` of a run's records."""

import json
import platform
import sys
from importlib.metadata import version
from pathlib import Path


def machine() -> None:
    """Three lines: what this is; the device's capability; the C++ library. The last two may be empty."""
    import torch

    from sparsestreet.ops.cpu.library import find_library, load_library

    found = torch.cuda.is_available()
    device = torch.cuda.get_device_name() if found else "no CUDA device"
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "numpy"))
    print(f"{device}; python {platform.python_version()}, {packages}, CUDA {torch.version.cuda}")
    print("{}.{}".format(*torch.cuda.get_device_capability()) if found else "")
    try:
        load_library()
    except (RuntimeError, OSError) as error:
        print()
        print(error, file=sys.stderr)
    else:
        print(find_library())


def training(summary: Path) -> None:
    """How long it took and how good it is."""
    record = json.loads(summary.read_text(encoding="utf-8"))
    seconds, psnr = record["run"]["training_seconds"], record["quality"]["held_out"]["psnr_full"]["mean"]
    print(f"{seconds:.1f} s of training, held-out PSNR {psnr:.2f} dB")


if __name__ == "__main__":
    if sys.argv[1] == "machine":
        machine()
    else:
        training(Path(sys.argv[2]))
