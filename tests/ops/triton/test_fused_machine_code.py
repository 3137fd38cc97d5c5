"""The fused steps of training compile for sm_80 and sm_90 without a GPU, and keep everything in registers."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.ops.sky import over_sky
from sparsestreet.ops.ssim import ssim
from sparsestreet.ops.triton import adam
from sparsestreet.ops.triton import sky as fused_sky
from sparsestreet.ops.triton import ssim as fused_ssim
from sparsestreet.ops.visible_adam import AdamStep, adam_step_
from tests.ops.scenes import camera, device_of
from tests.ops.triton.recording import Launch, compile_launches, record_launches

# One process compiles for all tests.
pytestmark = pytest.mark.xdist_group("machine code")
DEVICE = device_of("triton")
# Measured with Triton 3.7.1: 22, 32, 40, 64, 64. A streaming multiprocessor has 65536 registers: at 32 in each lane it
# holds all the warps it can, at 64 half of them.
REGISTERS = {
    "step_numbers": 32, "lay_over_sky": 32, "lay_over_sky_backward": 40, "similarity": 64, "similarity_backward": 64
}  # fmt: skip


@pytest.fixture(scope="module", params=[90, pytest.param(80, marks=pytest.mark.slow)], ids=["sm_90", "sm_80"])
def compiled(request) -> list[tuple[Launch, dict]]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        launches = record_launches(monkeypatch, (adam, fused_sky, fused_ssim))
        for shape in ((2, 3), (2, 15, 3)):
            fields = [torch.zeros(shape, device=DEVICE) for _ in range(4)]
            adam_step_(*fields, torch.ones(2, dtype=torch.bool, device=DEVICE), AdamStep(1, 0.1), backend="triton")
        image = torch.zeros(11, 11, 3, device=DEVICE)
        ssim(image, image, backend="triton")
        ssim(image.requires_grad_(), image, backend="triton").backward()
        texels = torch.zeros(6, 2, 2, 3, device=DEVICE)
        for view in (camera(11, 11), replace(camera(11, 11), distortion=torch.zeros(5))):
            over_sky(image, image[..., 0], texels, view, transmittance_min=0.1, backend="triton").sum().backward()
    return compile_launches(launches, request.param)


def test_every_kernel_is_compiled(compiled):
    assert sorted(launch.name for launch, _ in compiled) == [
        "lay_over_sky", "lay_over_sky", "lay_over_sky_backward", "lay_over_sky_backward",
        "similarity", "similarity", "similarity_backward", "step_numbers", "step_numbers"
    ]  # fmt: skip


def test_nothing_spills_and_registers_are_few(compiled):
    for launch, found in compiled:
        assert found["spilled"] == 0, launch
        assert found["registers"] <= REGISTERS[launch.name], (launch, found)


def test_no_tensor_cores_and_atomics_for_the_texels_only(compiled):
    """Four corners of three channels."""
    assert [launch for launch, found in compiled if found["tensor_core"]] == []
    assert {(launch.name, found["atomics"]) for launch, found in compiled if found["atomics"]} == {
        ("lay_over_sky_backward", 12)
    }
