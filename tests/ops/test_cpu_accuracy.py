"""Gradients of the C++ backend in float32 where many terms nearly cancel: deep stacks and needles."""

import pytest
import torch

from sparsestreet.ops import SplatSettings
from sparsestreet.types import Gaussians
from tests.ops.scenes import FIELDS, front_camera, one_gaussian, relative_error, render


def stack(rows: int, low: float, high: float) -> Gaussians:
    """Float64 rows that hold float32 values, all of them in every pixel."""
    generator = torch.Generator().manual_seed(4)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    sides = (uniform(rows, 2) - 0.5) * 0.2
    parts = (
        torch.cat((sides, 2 + uniform(rows, 1)), -1),
        uniform(rows, 4) - 0.5,
        0.4 + 0.4 * uniform(rows, 3),
        low + (high - low) * uniform(rows),
        uniform(rows, 4, 3) - 0.5,
    )
    return Gaussians(*(part.float().double() for part in parts))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_a_pixel_ends_before_its_transmittance_underflows(dtype):
    # 400 splats of alpha 0.99 would leave 1e-800; what is behind the first hundreds adds nothing to any digit.
    view, settings = front_camera(3, 3, 10.0), SplatSettings(transmittance_min=0.0)
    result = render(stack(400, 0.999, 1.0), view, "cpu", dtype, settings)
    truth = render(stack(400, 0.999, 1.0), view, "reference", torch.float64, settings)
    assert result.is_finite()
    assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < 1e-5
    for name in FIELDS:
        assert truth.gradients[name].norm() > 0
        assert relative_error(result.gradients[name], truth.gradients[name]) < 5e-6, name


@pytest.mark.parametrize("length", [1e-2, 1e-1])
def test_needles(length):
    # The scales' gradient of some needles nearly vanishes, so that their relative error has no bound; against what such
    # needles usually have, the error is small for all of them. What is left is the rounding of the mean: 2e-6 px at
    # pixel 28, times a slope of alpha of up to 5 per pixel.
    view, errors, norms = front_camera(48, 40, 40.0), [], []
    for seed in range(24):
        generator = torch.Generator().manual_seed(seed)
        needle = one_gaussian(
            quaternions=[torch.randn(4, generator=generator).tolist()],
            scales=torch.tensor([[length, 1e-4, 1e-4]], dtype=torch.float32).double().tolist(),
            means=torch.tensor([[0.2, -0.1, 2.0]], dtype=torch.float32).double().tolist(),
            opacities=[0.75],
        )
        truth, result = (render(needle, view, "cpu", dtype) for dtype in (torch.float64, torch.float32))
        errors.append(float((result.gradients["scales"] - truth.gradients["scales"]).norm()))
        norms.append(float(truth.gradients["scales"].norm()))
    assert max(errors) < 4e-5 * sorted(norms)[len(norms) // 2]
