"""Triton's kernels run on a GPU if there is one, else by its interpreter on CPU tensors (tests/conftest.py)."""

import importlib.util

import numpy as np
import pytest

if importlib.util.find_spec("triton") is None:
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(autouse=True)
def _without_floating_point_warnings():
    """The interpreter computes in NumPy, which warns of infinities in lanes that are masked off; a GPU does not."""
    with np.errstate(all="ignore"):
        yield
