"""Which implementation of a step takes which tensors. (No GPU is needed to ask for one's tensors.)"""

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.ops import backend as fused
from sparsestreet.ops.activate import activate
from sparsestreet.ops.adam import AdamStep, adam_all_
from sparsestreet.ops.backend import fused_backend
from sparsestreet.ops.photometric import photometric
from sparsestreet.ops.pixel_losses import depth_error, sky_entropy
from sparsestreet.ops.poses import poses_at
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.ops.sky import over_sky
from sparsestreet.ops.ssim import ssim
from sparsestreet.ops.statistics import add_view_
from sparsestreet.types import Camera

MEANS, SCALES, TURNS, OPACITIES, DC, REST = (torch.zeros(1, *shape) for shape in ((3,), (3,), (4,), (), (1, 3), (0, 3)))
ROWS = RawGaussians(MEANS, SCALES, TURNS, OPACITIES, DC, REST)
TRACKS = Trajectories(
    torch.zeros(1, 1), torch.zeros(1, 1, 4), torch.zeros(1, 1, 3), torch.ones(1, 1).bool(), torch.zeros(1, 2)
)
IMAGE = torch.zeros(11, 11, 3)
CAMERA = Camera(torch.eye(4), torch.eye(3), width=11, height=11)
STEPS = {
    "adam": lambda backend: adam_all_(
        [MEANS], [MEANS], [MEANS], [MEANS], torch.zeros(1, 2).long(), [AdamStep(1, 0.1)], [3], backend=backend
    ),
    "activate": lambda backend: activate([ROWS], sh_degree=0, backend=backend),
    "poses": lambda backend: poses_at(TRACKS, torch.zeros(1, 1, 3), torch.zeros(1, 1, 3), 0.0, 0.1, backend=backend),
    "sky": lambda backend: over_sky(
        IMAGE, IMAGE[..., 0], torch.zeros(6, 1, 1, 3), CAMERA, transmittance_min=0.1, backend=backend
    ),
    "ssim": lambda backend: ssim(IMAGE, IMAGE, backend=backend),
    "photometric": lambda backend: photometric(IMAGE, IMAGE.to(torch.uint8), lambda_dssim=0.2, backend=backend),
    "depth": lambda backend: depth_error(IMAGE[..., 0], IMAGE[..., 0], backend=backend),
    "alpha": lambda backend: sky_entropy(IMAGE[..., 0], IMAGE[..., 0].bool(), backend=backend),
    "statistics": lambda backend: add_view_(
        OPACITIES, OPACITIES.long(), OPACITIES, MEANS[:, :2], OPACITIES, (2, 2), backend=backend
    ),
}
PLACES = {
    "adam": {"cpu": "adam._step_in_library_", "triton": "triton.adam.AdamTables.launch"},
    "activate": {"cpu": "cpu.rows.activate", "triton": "triton.activate.activate"},
    "poses": {"cpu": "cpu.rows.poses_at", "triton": "triton.poses.poses_at"},
    "sky": {"cpu": "cpu.images.over_sky", "triton": "triton.sky.over_sky"},
    "statistics": {"cpu": "statistics._add_in_library_", "triton": "triton.statistics.add_view_"},
    "photometric": {"cpu": "cpu.images.compare", "triton": "triton.photometric.compare"},
    "depth": {"cpu": "pixel_losses._mean_in_library_", "triton": "triton.pixel_losses.mean_of_"},
    "alpha": {"cpu": "pixel_losses._mean_in_library_", "triton": "triton.pixel_losses.mean_of_"},
    "ssim": {"cpu": "cpu.images.mean_ssim", "triton": "triton.ssim.mean_ssim"},
}
"""Where each implementation lies in sparsestreet.ops."""


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


@pytest.mark.parametrize("backend", ["cpu", "triton", "auto"])
@pytest.mark.parametrize("step", STEPS)
def test_the_named_implementation_runs(monkeypatch, step, backend):
    """On the CPU "auto" takes the library. Torch's numbers would be as good."""
    ran = RuntimeError(f"{backend} ran")

    def run(*_, **__):
        raise ran

    monkeypatch.setattr(f"sparsestreet.ops.{PLACES[step].get(backend, PLACES[step]['cpu'])}", run)
    with pytest.raises(RuntimeError, match=str(ran)):
        STEPS[step](backend)


@pytest.mark.parametrize("step", STEPS)
def test_what_is_not_there_is_an_error(monkeypatch, step):
    monkeypatch.setattr(fused, "find_library", lambda: None)
    with pytest.raises(RuntimeError, match=r"'cpu' needs the C\+\+ library: install a C\+\+17 compiler"):
        STEPS[step]("cpu")
    with pytest.raises(ValueError, match=r"no backend 'cuda' of this step: choose one of .*'cpu'"):
        STEPS[step]("cuda")


def test_a_named_implementation_refuses_what_it_does_not_take(on_gpu):
    for other in (on_gpu.T, on_gpu.double()):
        with pytest.raises(ValueError, match=r"'triton' takes contiguous float32 tensors, got .*: use backend='torch'"):
            fused_backend("triton", on_gpu, other)
    for other in (on_gpu, torch.zeros(3).double()):
        with pytest.raises(ValueError, match=r"'cpu' takes float32 or float64 tensors on the CPU, got .*: use backend"):
            fused_backend("cpu", torch.zeros(3), other)
