"""What the check of a GPU needs and this machine does not have: one line each, with its remedy, within a second.

``python gpu_needs.py SITE [WHEELS]`` unpacks the wheels of a folder into SITE first, which is on PYTHONPATH. No package
is imported. Ends with status 2 if no part of the check could run.
"""

import importlib
import importlib.util
import os
import shutil
import sys
import sysconfig
import zipfile
from pathlib import Path

# What does not run without them: the names to import.
PACKAGES = {
    "nothing runs": ("torch", "numpy", "jaxtyping", "pytest"),
    "no kernel": ("triton",),
    "no train, no bench": ("hydra", "omegaconf", "antlr4", "yaml"),
    "no train": ("lightning", "torchmetrics", "scipy", "matplotlib", "safetensors", "rich", "PIL", "cv2"),
    "no train, tests check no shapes and types": ("beartype",),
    "tests take turns and may not end in time": ("xdist",),
    "test files left out": ("hypothesis",),
    "nothing beside our times": ("gsplat",),
    "no .street is read or written": ("zstandard",),
}
DISTRIBUTIONS = {
    "hydra": "hydra-core",
    "antlr4": "antlr4-python3-runtime==4.9.3",
    "yaml": "PyYAML",
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "xdist": "pytest-xdist",
    "gsplat": "gsplat==1.5.3",
}
CARRIED = ("hydra-core", "omegaconf", "antlr4-python3-runtime==4.9.3", "beartype", "zstandard", "gsplat==1.5.3")
"""What a machine for training networks lacks: distributions whose wheels gpu_pack.py fetches."""


def unpack_wheels(folder: Path, site: Path) -> list[str]:
    """Unpack what fits this Python into ``site``; the other wheels, by name."""
    if not folder.is_dir():
        return [f"no folder {folder}: SPARSESTREET_WHEELS names none"]
    if importlib.util.find_spec("packaging") is None:
        return ["no packaging (no wheel is unpacked): pip install packaging"]
    from packaging.tags import sys_tags
    from packaging.utils import parse_wheel_filename

    tags, refused = set(sys_tags()), []
    for wheel in sorted(folder.glob("*.whl")):
        if tags.isdisjoint(parse_wheel_filename(wheel.name)[3]):
            refused.append(f"{wheel.name} is for another Python or platform: fetch the one for this")
        else:
            zipfile.ZipFile(wheel).extractall(site)
    importlib.invalidate_caches()
    return refused


def missing_packages() -> list[str]:
    """One line for each package that is not found."""
    return [
        f"no {name} ({effect}): pip install {DISTRIBUTIONS.get(name, name)}, or its wheel into SPARSESTREET_WHEELS"
        for effect, names in PACKAGES.items()
        for name in names
        if importlib.util.find_spec(name) is None
    ]


def missing_tools() -> list[str]:
    """What Triton calls when a kernel is first launched, and what compiles gsplat."""
    lines = []
    if not any(map(shutil.which, (os.environ.get("CC", "cc"), "gcc", "clang"))):
        lines.append("no C compiler (no kernel): apt-get install gcc, or name one with CC")
    header = Path(sysconfig.get_path("include")) / "Python.h"
    if not header.is_file():
        lines.append(f"no {header} (no kernel): apt-get install python3-dev")
    homes = (os.environ.get("CUDA_HOME", ""), os.environ.get("CUDA_PATH", ""), "/usr/local/cuda")
    if not shutil.which("nvcc") and not any((Path(home) / "bin" / "nvcc").is_file() for home in homes if home):
        lines.append("no nvcc (gsplat is not compiled): install CUDA's toolkit, or name its folder with CUDA_HOME")
    if not shutil.which("ninja"):
        lines.append("no ninja (gsplat is not compiled): pip install ninja")
    return lines


if __name__ == "__main__":
    site, *wheels = (Path(argument) for argument in sys.argv[1:])
    for line in unpack_wheels(wheels[0], site) if wheels else ():
        print(line)
    lines = missing_packages()
    print(*lines, *missing_tools(), sep="\n")
    sys.exit(2 if any("(nothing runs)" in line for line in lines) else 0)
