"""Finding and loading the C++ library, and its plain C interface."""

import ctypes
import importlib.metadata
from functools import cache
from pathlib import Path

# torch first: the library then shares torch's OpenMP runtime and its threads.
import torch  # noqa: F401

LIBRARY_NAME = "libsparsestreet_splat.so"


def remedy() -> str:
    """How to build the library."""
    return (
        "install a C++17 compiler and reinstall the package (pip install --no-build-isolation -e . or pip install .), "
        "then look for the line 'sparsestreet_splat' in its build log"
    )


@cache
def find_library() -> Path | None:
    """Path of the library: beside this module, or where an editable install put it; None if it was not built."""
    beside = Path(__file__).parent / LIBRARY_NAME
    if beside.is_file():
        return beside
    try:
        files = importlib.metadata.files("sparsestreet") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if file.name == LIBRARY_NAME and Path(file.locate()).is_file():
            return Path(file.locate())
    return None


@cache
def load_library() -> ctypes.CDLL:
    """The loaded library."""
    path = find_library()
    if path is None:
        raise RuntimeError(f"the splat library is not built: {remedy()}")
    return ctypes.CDLL(str(path))
