"""Other sizes of the C++ backend's tiles: the library is compiled for them and runs in a separate process.

The size is a constant of the compiled loops, so that users pay nothing for the choice. A process loads one library.
"""

import fcntl
import os
import pickle
import shlex
import shutil
import subprocess
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import torch

from sparsestreet.ops.cpu.library import LIBRARY_NAME, LIBRARY_VARIABLE, find_library, tile_size

Result = TypeVar("Result")
TILE_SIZES = (8, 16, 32)
"""What CMakeLists.txt accepts as SPARSESTREET_TILE."""
ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Build:
    """A library, or why there is none."""

    library: Path | None
    missing: str | None = None


@cache
def build(size: int) -> Build:
    """Returns the library in use if its tiles have this size, else one compiled into ``.cache`` of the checkout.

    Compiling takes half a minute the first time, and almost nothing later."""
    if size == tile_size():
        return Build(find_library())
    if not (ROOT / "CMakeLists.txt").is_file():
        return Build(None, "other tile sizes are compiled from a checkout, and the package is installed without one")
    if shutil.which("cmake") is None:
        return Build(None, "other tile sizes are compiled, and there is no cmake: install it and a C++ compiler")
    folder = f".cache/tiles/{size}"
    (ROOT / folder).mkdir(parents=True, exist_ok=True)
    configure = ["cmake", "-S", ".", "-B", folder, f"-DSPARSESTREET_TILE={size}"]
    compile_it = ["cmake", "--build", folder, "--parallel", str(os.cpu_count())]
    with (ROOT / folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another measurement or test may be compiling it
        for command in (configure, compile_it):
            status = subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode
            if status:
                return Build(None, f"status {status} of '{shlex.join(command)}': run that in the checkout to see why")
    return Build(ROOT / folder / LIBRARY_NAME)


def with_tiles(size: int, function: Callable[..., Result], *arguments: object) -> Result:
    """Calls ``function(*arguments)`` in a process whose C++ backend has tiles of this size, with our number of threads.

    Function, arguments and result must pickle. Raises RuntimeError with the reason if there is no such library.
    """
    # Pickled here, because torch would put tensors into shared memory, of which a machine may have little.
    request = pickle.dumps((function, arguments))
    return pickle.loads(_process(size, torch.get_num_threads()).submit(_call, request).result())


def _call(request: bytes) -> bytes:
    function, arguments = pickle.loads(request)
    return pickle.dumps(function(*arguments))


@cache
def _process(size: int, threads: int) -> ProcessPoolExecutor:
    """One spawned process, because a forked one would inherit the library that is loaded here. It ends with ours."""
    made = build(size)
    if made.library is None:
        raise RuntimeError(f"no library with tiles of {size} pixels: {made.missing}")
    return ProcessPoolExecutor(1, get_context("spawn"), _start, (str(made.library), threads))


def _start(library: str, threads: int) -> None:
    os.environ[LIBRARY_VARIABLE] = library
    torch.set_num_threads(threads)
