"""Timings of the op: stages of the right workspace, no gradients left behind, the same cotangent everywhere."""

import pytest
import torch

from sparsestreet.bench.scenes import frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import Cotangent, TimingBudget, leaves, time_op, work_of
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.cpu.rasterizer import rasterize
from tests.typed import there

CAMERA = frustum_camera(48, 32)
GAUSSIANS = frustum_gaussians(80, CAMERA, sigma_pixels=2.0, terms=4)
ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)


def test_leaves_are_copies_that_collect_gradients():
    rows = leaves(GAUSSIANS, torch.float64)
    assert rows.means.dtype == torch.float64
    assert rows.dense_sh().requires_grad
    assert not GAUSSIANS.dense_sh().requires_grad
    same = leaves(GAUSSIANS, torch.float32)
    assert same.means.data_ptr() != GAUSSIANS.means.data_ptr()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_whole_op_and_its_stages(dtype):
    rows = leaves(GAUSSIANS, dtype)
    times = time_op(rows, CAMERA, SplatSettings(), "cpu", ONCE)
    assert set(times.stages) == {
        *("forward", "backward", "project", "bin", "blend", "blend_backward", "project_backward")
    }
    inner = sum(times.stages[name].minimum for name in ("project", "bin", "blend"))
    assert 0 < inner <= times.stages["forward"].minimum
    assert rows.means.grad is None


def test_work_is_that_of_the_view_whatever_was_rendered_before():
    few, many = leaves(frustum_gaussians(5, CAMERA, 2.0, 1), torch.float32), leaves(GAUSSIANS, torch.float64)
    settings = SplatSettings()
    pairs = there(work_of(many, CAMERA, settings, "cpu")[0])
    assert there(work_of(few, CAMERA, settings, "cpu")[0]) < pairs
    assert work_of(many, CAMERA, settings, "cpu")[0] == pairs
    assert work_of(many, CAMERA, settings, "reference") == (None, None)


def test_work_is_that_of_the_variant_that_splat_uses():
    few = leaves(frustum_gaussians(5, CAMERA, 2.0, 1), torch.float32)
    rasterize(few, torch.zeros(5, 2), CAMERA, SplatSettings(), 0)
    rows = leaves(GAUSSIANS, torch.float32)
    pairs, samples = work_of(rows, CAMERA, SplatSettings(), "cpu")
    assert pairs > 80  # each of the 80 splats covers a tile, most cover more
    assert samples > 80 * 16


def test_reference_has_no_stages():
    times = time_op(leaves(GAUSSIANS, torch.float32), CAMERA, SplatSettings(), "reference", ONCE)
    assert set(times.stages) == {"forward", "backward"}
    assert (times.pairs, times.samples) == (None, None)


def test_cotangents_are_the_same_numbers_in_every_dtype():
    single, double = (Cotangent.of(CAMERA, torch.zeros(1, dtype=dtype)) for dtype in (torch.float32, torch.float64))
    assert torch.equal(single.rgb, double.rgb.float())
    assert torch.equal(single.alpha, double.alpha.float())
    assert single.rgb.shape == (32, 48, 3)
