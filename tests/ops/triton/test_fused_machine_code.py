"""The fused steps of training compile for sm_80 and sm_90 without a GPU, and keep everything in registers."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.ops.activate import activate
from sparsestreet.ops.adam import AdamStep, adam_all_, adam_step_
from sparsestreet.ops.photometric import photometric
from sparsestreet.ops.pixel_losses import depth_error, sky_entropy
from sparsestreet.ops.poses import poses_at
from sparsestreet.ops.sky import over_sky
from sparsestreet.ops.ssim import ssim
from sparsestreet.ops.statistics import add_view_
from sparsestreet.ops.triton import activate as fused_activate
from sparsestreet.ops.triton import adam
from sparsestreet.ops.triton import photometric as fused_photometric
from sparsestreet.ops.triton import pixel_losses as fused_losses
from sparsestreet.ops.triton import poses as fused_poses
from sparsestreet.ops.triton import sky as fused_sky
from sparsestreet.ops.triton import ssim as fused_ssim
from sparsestreet.ops.triton import statistics as fused_statistics
from tests.ops.scenes import camera, device_of
from tests.ops.test_activate import case
from tests.ops.test_activate import values_and_gradients as activated
from tests.ops.test_poses import MAX_GAP, on_device
from tests.ops.triton.recording import Launch, compile_launches, record_launches

pytestmark = pytest.mark.slow
DEVICE = device_of("triton")
# Measured with Triton 3.7.1: 64, 94, 41, 64, 22, 64, 24, 32, 40, 32, 40, 64, 64. A multiprocessor has 65536 registers:
# at 32 in each lane it holds all the warps it can, at 64 half of them. Rows take many, because 16 coefficients are on
# their way at once; of poses there is a warp or two.
REGISTERS = {
    "activate_rows": 64, "activate_rows_backward": 96, "interpolate": 41, "interpolate_backward": 64,
    "step_numbers": 32, "step_tables": 64, "add_rows": 32, "sum_pixels": 32, "add_sums": 40,
    "compare_colors": 32, "add_terms": 40, "compare_colors_backward": 32,
    "lay_over_sky": 32, "lay_over_sky_backward": 40, "similarity": 64, "similarity_backward": 64,
}  # fmt: skip
# Where the sine of an angle above 1e5 would be reduced.
STACK = {"interpolate": 32, "interpolate_backward": 32}


MODULES = (
    fused_activate, fused_poses, adam, fused_sky, fused_ssim, fused_statistics, fused_losses, fused_photometric,
)  # fmt: skip


@pytest.fixture(scope="module", params=[80, 90], ids=["sm_80", "sm_90"])
def compiled(request) -> list[tuple[Launch, dict]]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        launches = record_launches(monkeypatch, MODULES)
        launch_nodes()
        launch_images()
        for shape in ((2, 15, 3), (2, 3)):
            values, gradient, first, second = (torch.zeros(shape, device=DEVICE) for _ in range(4))
            adam_step_(
                values,
                gradient,
                first,
                second,
                torch.ones(2, dtype=torch.bool, device=DEVICE),
                AdamStep(1, 0.1),
                backend="triton",
            )
        launch_all_parameters()
    return compile_launches(launches, request.param)


def launch_nodes() -> None:
    for rest, degree, every in ((15, 3, True), (0, 0, False)):
        rows = case(rest, every, every, 2, torch.float32, DEVICE)
        activated(rows, lambda parts, degree=degree: activate(parts, sh_degree=degree, backend="triton"))
    row = torch.zeros(1, device=DEVICE)
    add_view_(row, row.long(), row, row.expand(1, 2), row, (2, 2), watched=[(row, row)], backend="triton")
    table, deltas = on_device("triton", torch.float32)
    poses_at(table, *deltas, 0.3, MAX_GAP, backend="triton").translations.sum().backward()


def launch_all_parameters() -> None:
    """At multiples of 16 bytes, and elsewhere."""
    refused = torch.zeros(1, 2, dtype=torch.int64, device=DEVICE)
    for begin in (0, 1):
        one = [torch.zeros(6, device=DEVICE)[begin:]]
        adam_all_(one, one, one, one, refused, [AdamStep(1, 0.1)], [1], backend="triton")


def launch_images() -> None:
    image = torch.zeros(11, 11, 3, device=DEVICE)
    ssim(image, image, backend="triton")
    plane = image[..., 0].contiguous().requires_grad_()
    depth_error(plane, plane, backend="triton")
    sky_entropy(plane, plane > 0, backend="triton")
    ssim(image.requires_grad_(), image, backend="triton").backward()
    photometric(image, image.to(torch.uint8), lambda_dssim=0.2, backend="triton").backward()
    texels = torch.zeros(6, 2, 2, 3, device=DEVICE)
    for view in (replace(camera(11, 11), distortion=torch.zeros(5)), camera(11, 11)):
        over_sky(image, image[..., 0], texels, view, transmittance_min=0.1, backend="triton").sum().backward()


def test_every_kernel_is_compiled(compiled):
    of_two_sizes = [
        "activate_rows", "activate_rows_backward", "lay_over_sky", "lay_over_sky_backward", "step_numbers",
        "step_tables",
    ]  # fmt: skip
    of_one = [
        "add_rows", *["sum_pixels", "add_sums"] * 2, "interpolate", "interpolate_backward", *["similarity"] * 3,
        *["similarity_backward"] * 2, "compare_colors", "add_terms", "compare_colors_backward",
    ]  # fmt: skip
    expected = [*of_one, *of_two_sizes * 2]
    assert sorted(launch.name for launch, _ in compiled) == sorted(expected)


def test_nothing_spills_and_registers_are_few(compiled):
    for launch, found in compiled:
        assert found["spilled"] <= STACK.get(launch.name, 0), launch
        assert found["registers"] <= REGISTERS[launch.name], (launch, found)


def test_adam_reads_and_writes_sixteen_bytes_at_once_where_tables_begin_at_multiples(compiled):
    """Of the four tensors that it reads, and the three that it writes, where all rows of a program step."""
    wide, narrow = (
        next(found for launch, found in compiled if launch.constants.get("ALIGNED") is aligned)
        for aligned in (True, False)
    )
    assert (narrow["loads"] - wide["loads"], narrow["stores"] - wide["stores"]) == (4 * 3, 3 * 3)


def test_no_tensor_cores_and_atomics_for_the_texels_and_refused_rows_only(compiled):
    """Four corners of three channels; a count and the least number."""
    assert [launch for launch, found in compiled if found["tensor_core"]] == []
    assert {(launch.name, found["atomics"]) for launch, found in compiled if found["atomics"]} == {
        ("lay_over_sky_backward", 12),
        ("step_tables", 2),
    }
