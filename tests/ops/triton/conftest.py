"""Triton's kernels run on a GPU if there is one, else by its interpreter on CPU tensors (tests/conftest.py)."""

import importlib.util

if importlib.util.find_spec("triton") is None:
    collect_ignore_glob = ["test_*.py"]
