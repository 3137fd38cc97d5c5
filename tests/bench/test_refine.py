"""A refined street looks like the street, at the density of a larger one."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.bench.refine import refined
from sparsestreet.bench.scenes import BenchScene
from sparsestreet.geometry.cameras import project
from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.types import Gaussians

CAMERA = frustum_camera(48, 32)


def scene(rows: int) -> BenchScene:
    return BenchScene("street", "of a run", frustum_gaussians(rows, CAMERA, sigma_pixels=3.0, terms=4), CAMERA)


def test_the_small_splats_of_each_are_as_wide_as_it_was():
    """The mixture's covariance about the splat's mean is the splat's own: C (1 - 1/k^2) + C / k^2."""
    one, copies = scene(1), 2500
    street = replace(one, gaussians=Gaussians.concatenate([one.gaussians] * copies))
    fine = refined(street, 2).gaussians
    axes = (to_matrix(one.gaussians.quaternions[0]) * one.gaussians.scales[0]).double()
    small = (to_matrix(fine.quaternions[0]) * fine.scales[0]).double()
    offsets = (fine.means - one.gaussians.means).double()
    expected, found = axes @ axes.T, offsets.T @ offsets / (4 * copies) + small @ small.T
    # A variance of 10,000 draws has an error of sqrt(2 / 10,000) = 1.4 %; 5 of these. Without the narrowing: 25 %.
    assert float((found - expected).norm() / expected.norm()) < 0.07
    assert float(offsets.mean(0).norm()) < 5 * float(expected.trace().sqrt()) / 100


def test_what_else_they_have_is_their_splats():
    street = scene(5)
    street = replace(street, gaussians=replace(street.gaussians, displacements=torch.rand(5, 3)))
    fine = refined(street, 3)
    for name in ("quaternions", "opacities", "sh", "displacements"):
        before, after = getattr(street.gaussians, name), getattr(fine.gaussians, name)
        assert torch.equal(after.view(5, 9, *before.shape[1:]), before[:, None].expand(5, 9, *before.shape[1:]))
    assert torch.equal(fine.gaussians.scales[::9], street.gaussians.scales / 3)
    assert fine.source == "of a run, refined 3x3"
    pixels, _, _ = project(CAMERA, street.gaussians.means)
    larger, _, _ = project(fine.camera, street.gaussians.means)
    torch.testing.assert_close(larger, 3 * pixels)  # pixel centers at +0.5 scale with the image
    assert (fine.camera.width, fine.camera.height) == (144, 96)


def test_a_seed_is_a_street_and_one_is_the_street_itself():
    street = scene(5)
    assert torch.equal(refined(street, 2).gaussians.means, refined(street, 2).gaussians.means)
    assert not torch.equal(refined(street, 2).gaussians.means, refined(street, 2, seed=1).gaussians.means)
    assert refined(street, 1) is street
    with pytest.raises(ValueError, match="factor of at least 1, got 0"):
        refined(street, 0)
