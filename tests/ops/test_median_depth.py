"""The splat behind which half of the light is gone: against the textbook, and against what the op blends."""

from dataclasses import replace

import numpy as np
import torch

from sparsestreet.ops import SplatSettings, median_depth
from sparsestreet.types import Gaussians, Shutter
from tests.ops.oracles import naive_median_depth
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    device_of,
    every_backend,
    every_precision,
    fill_buffers_with_nan,
    front_camera,
    one_gaussian,
    random_gaussians,
    with_threads,
)


@every_precision
def test_depth_row_and_coverage_are_those_of_the_textbook(backend, dtype, monkeypatch):
    """A turned camera, an odd size; where pixels stop otherwise plays no part. A part of the pixels has none."""
    view = camera(17, 13)
    settings = SplatSettings(transmittance_min=0.9, stop="exclusive", alpha_min=0.02)
    gaussians = random_gaussians(24, view, terms=4, seed=1)
    depth, rows, alpha = naive_median_depth(gaussians, view, settings)
    fill_buffers_with_nan(monkeypatch)
    given = cast(gaussians, dtype, device=device_of(backend))
    found, again = with_threads((1, 3), lambda: median_depth(given, view, settings=settings, backend=backend))
    assert torch.equal(found.rows, again.rows)
    assert 0.05 < np.isinf(depth).mean() < 0.5
    assert len(np.unique(rows)) > 10
    np.testing.assert_array_equal(found.rows.cpu().numpy(), rows)
    # A mean's depth, up to 22 m, and a coverage, both with the precision of the type.
    np.testing.assert_allclose(found.depth.cpu().numpy(), depth, rtol=8 * torch.finfo(dtype).eps, atol=0)
    np.testing.assert_allclose(found.alpha.cpu().numpy(), alpha, rtol=0, atol=100 * torch.finfo(dtype).eps)


@every_backend
def test_half_of_the_light_is_enough_and_a_hair_more_is_not(backend):
    """At a mean alpha is the opacity: 0.5 leaves exactly half, 0.499 more."""
    for opacity, row in ((0.5, 0), (0.499, -1)):
        ball = cast(one_gaussian(opacities=[opacity]), torch.float32, device=device_of(backend))
        found = median_depth(ball, front_camera(3, 3, focal=9.0), backend=backend)
        assert found.rows[1, 1] == row
        assert found.depth[1, 1] == (2.0 if row == 0 else torch.inf)


@every_backend
def test_nothing_is_met_in_an_empty_scene(backend):
    view = camera(5, 4)
    none = cast(random_gaussians(0, view), torch.float32, device=device_of(backend))
    found = median_depth(none, view, backend=backend)
    assert bool(torch.isinf(found.depth).all())
    assert bool((found.rows == -1).all())
    assert not found.alpha.any()


@every_backend
def test_a_moving_lens_sees_the_row_that_takes_the_pixel_past_half(backend):
    """With lens and rolling shutter, where no textbook helps: without the row that is met, the depth is greater."""
    view = replace(
        camera(12, 7),
        distortion=torch.tensor([-0.2, 0.05, 0.001, -0.002, 0.0]),
        shutter=Shutter(torch.tensor([0.2, 0.0, 0.1]), torch.tensor([0.0, 0.03, 0.0])),
    )
    given = cast(random_gaussians(40, view, seed=1), torch.float32, device=device_of(backend))
    found = median_depth(given, view, backend=backend)
    met = found.rows[found.rows >= 0].unique().tolist()
    assert len(met) > 3
    for row in met[:3]:
        here, kept = found.rows == row, torch.arange(len(given)) != row
        others = Gaussians(*(getattr(given, name)[kept] for name in FIELDS))
        other = median_depth(others, view, backend=backend)
        assert bool((other.depth[here] > found.depth[here]).all())
        assert bool((found.alpha[here] >= 0.5).all())
