"""Triton's kernels run on a GPU if there is one, else by its interpreter on CPU tensors (tests/conftest.py)."""

import importlib.util

import pytest
import torch

if importlib.util.find_spec("triton") is None:
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture
def poisoned(monkeypatch):
    """Memory from ``new_empty`` holds NaN and the largest numbers until it is written."""
    empty = torch.Tensor.new_empty

    def filled(*args, **kwargs):
        tensor = empty(*args, **kwargs)
        return tensor.fill_(float("nan") if tensor.is_floating_point() else torch.iinfo(tensor.dtype).max)

    monkeypatch.setattr(torch.Tensor, "new_empty", filled)
