import inspect
from dataclasses import replace

import kornia
import pytest
import torch

from sparsestreet.ops.ssim import ssim
from sparsestreet.scene.graph import MaskTerm
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.training.losses import InverseDepth, MaskSparsity, Photometric, SkyMask
from sparsestreet.types import Camera, Frame, Rendering

HEIGHT, WIDTH = 13, 17


def frame(generator, **known) -> Frame:
    camera = Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT)
    image = torch.randint(0, 256, (HEIGHT, WIDTH, 3), dtype=torch.uint8, generator=generator)
    return Frame(frame_index=0, time=0.0, camera_index=0, camera=camera, image=image, **known)


def rendering(rgb=None, alpha=None, depth=None, rows=None, mask_terms=None) -> SceneRendering:
    rgb = torch.zeros(HEIGHT, WIDTH, 3) if rgb is None else rgb
    alpha = torch.zeros(HEIGHT, WIDTH) if alpha is None else alpha
    depth = torch.ones(HEIGHT, WIDTH) if depth is None else depth
    splats = Rendering(rgb, alpha, depth, torch.zeros(0), torch.zeros(0, 2))
    return SceneRendering(rgb, alpha, depth, splats, rows or {}, mask_terms or {})


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def test_ssim_and_its_gradient_equal_kornias(generator):
    image = torch.rand(HEIGHT, WIDTH, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    truth = torch.rand(HEIGHT, WIDTH, 3, generator=generator, dtype=torch.float64)
    ours = ssim(image, truth)
    # kornia pads with reflection: only where the whole window lies inside do the two definitions agree.
    planes = (image.permute(2, 0, 1)[None], truth.permute(2, 0, 1)[None])
    theirs = kornia.metrics.ssim(*planes, window_size=11, padding="valid").mean()
    # kornia adds 1e-12 to the denominator.
    torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=0)
    torch.testing.assert_close(
        torch.autograd.grad(ours, image)[0], torch.autograd.grad(theirs, image)[0], rtol=1e-6, atol=1e-12
    )


def test_ssim_of_equal_images_is_one_and_small_images_are_refused(generator):
    image = torch.rand(11, 11, 3, generator=generator)
    assert float(ssim(image, image)) == pytest.approx(1.0, abs=1e-5)  # float32 variances of 121 samples
    with pytest.raises(ValueError, match="at least 11x11"):
        ssim(image[:10], image[:10])


def test_ssim_of_images_of_different_sizes_is_an_error():
    with pytest.raises(ValueError, match="of one shape"):
        # Unwrapped: in tests the type checker would be first.
        inspect.unwrap(ssim)(torch.zeros(11, 12, 3), torch.zeros(12, 11, 3))


def test_photometric_mixes_l1_and_dissimilarity(generator):
    seen = frame(generator)
    truth = seen.image.float() / 255
    rgb = truth + 0.1
    l1_only = Photometric(weight=2.0, lambda_dssim=0.0)(rendering(rgb), seen)
    assert float(l1_only) == pytest.approx(0.2, abs=1e-6)
    mixed = Photometric(weight=1.0, lambda_dssim=0.25)(rendering(rgb), seen)
    assert float(mixed) == pytest.approx(0.75 * 0.1 + 0.25 * (1 - float(ssim(rgb, truth))), abs=1e-6)


def test_saturated_pixels_keep_their_gradient(generator):
    seen = frame(generator)
    rgb = torch.full((HEIGHT, WIDTH, 3), 1.5, requires_grad=True)
    Photometric(lambda_dssim=0.0)(rendering(rgb), seen).backward()
    assert bool((rgb.grad > 0).all())


def test_sky_pushes_alpha_out_of_the_sky_and_up_elsewhere(generator):
    sky = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    sky[:4] = True
    alpha = torch.full((HEIGHT, WIDTH), 0.5, requires_grad=True)
    loss = SkyMask(weight=0.3)(rendering(alpha=alpha), frame(generator, sky=sky))
    assert loss.item() == pytest.approx(0.3 * 0.6931472, rel=1e-6)
    loss.backward()
    assert bool((alpha.grad[sky] > 0).all())
    assert bool((alpha.grad[~sky] < 0).all())


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_sky_is_finite_at_alpha_zero_and_one(generator, value):
    alpha = torch.full((HEIGHT, WIDTH), value, requires_grad=True)
    sky = torch.rand(HEIGHT, WIDTH, generator=generator) > 0.5
    loss = SkyMask()(rendering(alpha=alpha), frame(generator, sky=sky))
    loss.backward()
    assert bool(loss.isfinite())
    assert bool(alpha.grad.isfinite().all())


def test_depth_compares_only_measured_pixels(generator):
    measured = torch.zeros(HEIGHT, WIDTH)
    measured[2, 3], measured[5, 5], measured[7, 7] = 4.0, 200.0, 0.1
    depth = torch.full((HEIGHT, WIDTH), 2.0, requires_grad=True)
    loss = InverseDepth(weight=0.5)(rendering(depth=depth), frame(generator, depth=measured))
    assert loss.item() == pytest.approx(0.5 * abs(1 / 2 - 1 / 4))
    loss.backward()
    assert torch.nonzero(depth.grad).tolist() == [[2, 3]]


def test_depth_of_an_image_without_returns_is_zero(generator):
    depth = torch.ones(HEIGHT, WIDTH, requires_grad=True)
    loss = InverseDepth()(rendering(depth=depth), frame(generator, depth=torch.zeros(HEIGHT, WIDTH)))
    loss.backward()
    assert loss.item() == 0.0
    assert bool((depth.grad == 0).all())


def test_terms_apply_only_where_the_data_has_them(generator):
    assert not SkyMask().applies(frame(generator))
    assert not InverseDepth().applies(frame(generator))


def test_mask_sparsity_is_the_papers_formula(generator):
    scores = {"background": torch.tensor([0.5, 0.25]), "rigid": torch.tensor([1.0])}
    terms = {"background": MaskTerm(scores["background"], 2.5e-3), "rigid": MaskTerm(scores["rigid"], 1e-4)}
    rows = {"background": slice(0, 2), "rigid": slice(2, 3), "unmasked": slice(3, 10)}
    loss = MaskSparsity(weight=2.0)(rendering(rows=rows, mask_terms=terms), frame(generator))
    assert loss.item() == pytest.approx(2.0 * (2.5e-3 * 0.75 + 1e-4 * 1.0) / 10, rel=1e-6)


def test_mask_sparsity_of_what_is_visible_only(generator):
    """The same K, but rows that the view does not draw add nothing and get no gradient."""
    scores = torch.tensor([0.5, 0.25, 0.75], requires_grad=True)
    seen = rendering(rows={"rigid": slice(1, 4)}, mask_terms={"rigid": MaskTerm(scores, 2.0, visible_only=True)})
    splats = replace(seen.splats, radii=torch.tensor([1.0, 0.0, 3.0, 2.0]), screen_offsets=torch.zeros(4, 2))
    loss = MaskSparsity()(replace(seen, splats=splats), frame(generator))
    assert loss.item() == pytest.approx(2.0 * (0.25 + 0.75) / 3)
    loss.backward()
    assert scores.grad.tolist() == pytest.approx([0.0, 2 / 3, 2 / 3])


def test_mask_sparsity_of_a_scene_without_rows_or_masks_is_zero(generator):
    assert float(MaskSparsity()(rendering(), frame(generator))) == 0.0
