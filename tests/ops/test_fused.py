"""Which implementation of a step takes which tensors. (No GPU is needed to ask for one's tensors.)"""

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from sparsestreet.ops import fused
from sparsestreet.ops.fused import fused_backend


@pytest.fixture
def on_gpu() -> Tensor:
    with FakeTensorMode():
        return torch.empty(4, 3, device="cuda")


@pytest.mark.parametrize(
    ("built", "installed", "wanted", "on_gpu_wanted"),
    [(True, True, "cpu", "triton"), (False, True, "torch", "triton"), (True, False, "cpu", "torch")],
)
def test_auto_takes_what_is_there(monkeypatch, on_gpu, built, installed, wanted, on_gpu_wanted):
    monkeypatch.setattr(fused, "find_library", lambda: "libsplat.so" if built else None)
    monkeypatch.setattr(fused, "has_triton", lambda: installed)
    assert fused_backend("auto", torch.zeros(4, 3)) == wanted
    assert fused_backend("auto", torch.zeros(4, 3).double()) == wanted
    assert fused_backend("auto", on_gpu) == on_gpu_wanted


def test_auto_takes_torch_for_what_does_not_fit(on_gpu):
    for other in (on_gpu.T, on_gpu.double()):
        assert fused_backend("auto", on_gpu, other) == "torch"
    assert fused_backend("auto", torch.zeros(3), torch.zeros(3).double()) == "torch"
    assert fused_backend("auto", torch.zeros(3), choices=("torch", "triton")) == "torch"
    assert fused_backend("auto", on_gpu, choices=("torch", "cpu")) == "torch"


@pytest.mark.parametrize("choices", [("torch", "triton"), ("torch", "cpu")])
def test_what_a_step_does_not_have_is_unknown(choices):
    other = ({"cpu", "triton"} - {*choices}).pop()
    with pytest.raises(ValueError, match=rf"no backend '{other}' of this step: choose one of \('auto', 'torch', "):
        fused_backend(other, torch.zeros(3), choices=choices)


def test_triton_that_cannot_run(monkeypatch):
    monkeypatch.setattr(fused, "_interpreting", lambda: False)
    monkeypatch.setattr(fused, "has_triton", lambda: True)
    with pytest.raises(ValueError, match="'triton' needs tensors on a CUDA device, got cpu: use backend='torch'"):
        fused_backend("triton", torch.zeros(3))
    monkeypatch.setattr(fused, "has_triton", lambda: False)
    with pytest.raises(RuntimeError, match="'triton' needs the package triton: pip install"):
        fused_backend("triton", torch.zeros(3))
