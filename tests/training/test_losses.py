"""The terms of the loss against hand values, other libraries and finite differences, with random cotangents."""

import inspect
import math
from collections.abc import Callable
from dataclasses import replace

import kornia
import numpy as np
import pytest
import torch
from torch import Tensor

from sparsestreet.ops import splat as ops_splat
from sparsestreet.ops.ssim import ssim
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.scene.rendering import RenderOptions, SceneRendering, render
from sparsestreet.scene.state import SceneState
from sparsestreet.training import losses
from sparsestreet.training.losses import (
    Depth,
    DynamicRegion,
    InverseDepthSmoothness,
    Loss,
    MaskSparsity,
    OpacityEntropy,
    Photometric,
    SkyMask,
)
from sparsestreet.types import Frame, Rendering
from tests.training.stubs import background, frame_at, no_gaussians, rigid, set_rows
from tests.typed import there

HEIGHT, WIDTH = 13, 17
SCENE = SceneGraph({"background": background(1)})
"""Of the losses only the masks' asks the scene anything."""


def frame(**known: Tensor) -> Frame:
    return frame_at(0, WIDTH, HEIGHT, **known)


def rendering(
    rgb: Tensor | None = None,
    alpha: Tensor | None = None,
    depth: Tensor | None = None,
    radii: Tensor | None = None,
    spans: dict[str, slice] | None = None,
) -> SceneRendering:
    rgb = torch.zeros(HEIGHT, WIDTH, 3) if rgb is None else rgb
    alpha = torch.zeros(HEIGHT, WIDTH) if alpha is None else alpha
    depth = torch.ones(HEIGHT, WIDTH) if depth is None else depth
    radii = torch.zeros(0) if radii is None else radii
    splats = Rendering(rgb, alpha, depth, radii, torch.zeros(len(radii), 2))
    return SceneRendering(rgb, alpha, depth, splats, spans or {}, {}, no_gaussians())


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_ssim_of_images_of_different_sizes_is_an_error():
    with pytest.raises(ValueError, match="of one shape"):
        # Unwrapped: in tests the type checker would be first.
        inspect.unwrap(ssim)(torch.zeros(11, 12, 3), torch.zeros(12, 11, 3))


def test_photometric_and_its_gradient_equal_numpy_and_kornia(generator):
    """Value and gradient of the whole term, with a random cotangent."""
    seen = frame()
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    truth = seen.image.double() / 255
    planes = (rgb.permute(2, 0, 1)[None], truth.permute(2, 0, 1)[None])
    dissimilarity = 1 - kornia.metrics.ssim(*planes, window_size=11, padding="valid").mean()
    difference = rgb.detach().numpy() - truth.numpy()
    expected = 3.0 * (0.7 * np.abs(difference).mean() + 0.3 * dissimilarity.item())
    ours = Photometric(weight=3.0, lambda_dssim=0.3, white=None)(rendering(rgb), seen, SCENE)
    assert ours.item() == pytest.approx(expected, rel=1e-8)
    cotangent = torch.randn((), dtype=torch.float64, generator=generator)
    l1_gradient = 3.0 * 0.7 * torch.from_numpy(np.sign(difference)) / difference.size
    ssim_gradient = 3.0 * 0.3 * torch.autograd.grad(dissimilarity, rgb)[0]
    (gradient,) = torch.autograd.grad(ours, rgb, cotangent)
    # kornia adds 1e-12 to the denominator.
    torch.testing.assert_close(gradient, cotangent * (l1_gradient + ssim_gradient), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("lambda_dssim", [0.0, 0.2])
def test_where_the_sensor_was_cut_off_more_light_is_no_error(lambda_dssim, generator):
    """As if the light had been exactly white there; what was recorded darker keeps the pull of its whole error."""
    term, seen = Photometric(lambda_dssim=lambda_dssim), frame()
    image = torch.randint(0, 250, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
    white = torch.rand(HEIGHT, WIDTH, 3, generator=generator) < 0.4
    image[white] = torch.randint(250, 256, (int(white.sum()),), generator=generator, dtype=torch.uint8)
    seen = replace(seen, image=image)
    truth = image.double() / 255
    drawn = torch.rand(HEIGHT, WIDTH, 3, generator=generator, dtype=torch.float64) * 1.5
    light = drawn.clone().requires_grad_()
    exact = torch.where(white & (drawn > truth), truth, drawn).requires_grad_()
    losses = [term(rendering(light), seen, SCENE), replace(term, white=None)(rendering(exact), seen, SCENE)]
    assert losses[0].item() == pytest.approx(losses[1].item(), rel=1e-12)
    (pulled,), (expected,) = (torch.autograd.grad(loss, rgb) for loss, rgb in zip(losses, (light, exact), strict=True))
    enough = white & (drawn > truth)
    assert enough.any()
    assert not pulled[enough].any()
    torch.testing.assert_close(pulled[~enough], expected[~enough], rtol=1e-9, atol=1e-15)
    assert (pulled[~white & (drawn > 1.0)] != 0).all()


def half_sky() -> Tensor:
    sky = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    sky[:4] = True
    return sky


@pytest.mark.parametrize(
    ("alpha", "in_the_sky"),
    # -log((1 - alpha + 0.001) / 1.001) and -log((alpha + 0.001) / 1.001), by hand.
    [(0.0, (0.0, 6.9087548)), (0.5, (0.6921486, 0.6921486)), (1.0, (6.9087548, 0.0)), (0.9991, (6.2669008, 0.0008995))],
)
def test_sky_by_hand(alpha, in_the_sky):
    sky = half_sky()
    share = float(sky.float().mean())
    seen = rendering(alpha=torch.full((HEIGHT, WIDTH), alpha, dtype=torch.float64))
    loss = SkyMask(weight=0.3)(seen, frame(sky=sky), SCENE)
    assert loss.item() == pytest.approx(0.3 * (share * in_the_sky[0] + (1 - share) * in_the_sky[1]), abs=1e-7)


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 0.3, 0.9989, 0.9991, 1.0])
def test_sky_pushes_alpha_out_of_the_sky_and_up_elsewhere_at_any_alpha(alpha):
    sky = half_sky()
    values = torch.full((HEIGHT, WIDTH), alpha, requires_grad=True)
    SkyMask(weight=0.3, eps=1e-3)(rendering(alpha=values), frame(sky=sky), SCENE).backward()
    # Per pixel 1 / (error + eps) and no more than 1 / eps; float32 knows 1 - alpha + eps to 6e-8 of 1e-3.
    gradient = values.grad * sky.numel() / 0.3
    assert gradient[sky].unique().tolist() == pytest.approx([1 / (1 - alpha + 1e-3)], rel=1e-4)
    assert gradient[~sky].unique().tolist() == pytest.approx([-1 / (alpha + 1e-3)], rel=1e-4)


def test_sky_approaches_the_plain_cross_entropy_as_eps_vanishes(generator):
    sky = torch.rand(HEIGHT, WIDTH, generator=generator) > 0.5
    alpha = (0.1 + 0.8 * torch.rand(HEIGHT, WIDTH, generator=generator)).double()
    loss = SkyMask(weight=1.0, eps=1e-9)(rendering(alpha=alpha), frame(sky=sky), SCENE)
    plain = torch.nn.functional.binary_cross_entropy(alpha, (~sky).double())
    torch.testing.assert_close(loss, plain, rtol=1e-7, atol=0)  # eps / 0.1


def test_depth_leaves_out_measured_pixels_in_which_nothing_is_rendered():
    """The op answers depth 0 where no Gaussian is: such a pixel neither counts nor makes anything infinite."""
    measured = torch.zeros(HEIGHT, WIDTH)
    measured[2, 3], measured[6, 8], measured[5, 5], measured[7, 7] = 4.0, 5.0, 200.0, 0.1
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    depth[6, 8] = 0.0
    depth.requires_grad_()
    loss = Depth(weight=0.5)(rendering(depth=depth), frame(depth=measured), SCENE)
    assert loss.item() == pytest.approx(0.5 * (1 / 2 - 1 / 4))  # the mean of one pixel, not of two
    loss.backward()
    assert bool(depth.grad.isfinite().all())
    assert torch.nonzero(there(depth.grad)).tolist() == [[2, 3]]


def test_depth_limits_by_numpy(generator):
    """The returns inside the limits, and only those: the mean over them, one by one."""
    depth = 0.4 + 10 * torch.rand(HEIGHT, WIDTH, generator=generator).double()
    measured = torch.rand(HEIGHT, WIDTH, generator=generator) * 12
    depth[0, :2], measured[0, :2] = 3.0, torch.tensor([1.999, 2.001])
    depth[1, :2], measured[1, :2] = 3.0, torch.tensor([8.999, 9.001])
    seen = frame(depth=measured)
    terms = [
        abs(1 / rendered - 1 / lidar)
        for rendered, lidar in zip(depth.flatten().tolist(), measured.flatten().tolist(), strict=True)
        if 2.0 < lidar < 9.0 and rendered > 2.0
    ]
    loss = Depth(weight=0.25, nearest=2.0, farthest=9.0)(rendering(depth=depth), seen, SCENE)
    assert loss.item() == pytest.approx(0.25 * sum(terms) / len(terms), rel=1e-6)  # lidar is float32


def test_depth_of_an_image_without_returns_is_zero():
    depth = torch.ones(HEIGHT, WIDTH, requires_grad=True)
    loss = Depth()(rendering(depth=depth), frame(depth=torch.zeros(HEIGHT, WIDTH)), SCENE)
    loss.backward()
    assert loss.item() == 0.0
    assert bool((depth.grad == 0).all())


@pytest.mark.parametrize(
    ("loss", "without", "known"),
    [
        (SkyMask(), False, {"sky": torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)}),
        (Depth(), False, {"depth": torch.zeros(HEIGHT, WIDTH)}),
        (Photometric(), True, {}),
        (MaskSparsity(), True, {}),
        (OpacityEntropy(), True, {}),
        (InverseDepthSmoothness(), True, {}),
        (DynamicRegion(), True, {}),
    ],
)
def test_terms_apply_only_where_the_data_has_them(loss: Loss, without: bool, known: dict[str, Tensor]):
    assert isinstance(loss, Loss)
    assert loss.applies(frame()) is without
    assert loss.applies(frame(**known))


def masked_scene(visible_only: bool = False) -> SceneGraph:
    """3 masked rows, 4 without a mask, 2 masked ones."""
    nodes = {
        "background": background(3, mask=StaticMaskSettings(2.5e-3)),
        "unmasked": background(4),
        "rigid": rigid(2, mask=StaticMaskSettings(1e-4, visible_only=visible_only)),
    }
    set_rows(nodes["background"], "mask_logits", {0: 0.0, 1: 2.0, 2: -1.0})
    set_rows(nodes["rigid"], "mask_logits", {0: 1.0, 1: -3.0})
    return SceneGraph(nodes)


SPANS = {"background": slice(0, 3), "unmasked": slice(3, 7), "rigid": slice(7, 9)}


def sigmoid(*logits: float) -> np.ndarray:
    return 1 / (1 + np.exp(-np.array(logits)))


def test_mask_sparsity_is_the_papers_formula():
    """(lambda_m / K) sum_n lambda_n sum_k sigma(m_k), K over all rows of all nodes, with its gradient."""
    scene = masked_scene()
    loss = MaskSparsity(weight=2.0)(rendering(radii=torch.zeros(9), spans=SPANS), frame(), scene)
    standing, moving = sigmoid(0.0, 2.0, -1.0), sigmoid(1.0, -3.0)
    assert loss.item() == pytest.approx(2.0 / 9 * (2.5e-3 * standing.sum() + 1e-4 * moving.sum()), rel=1e-6)
    loss.backward(torch.tensor(-1.7))
    for name, weight, scores in (("background", 2.5e-3, standing), ("rigid", 1e-4, moving)):
        expected = -1.7 * 2.0 / 9 * weight * scores * (1 - scores)
        assert scene.nodes[name].rows.mask_logits.grad.tolist() == pytest.approx(expected.tolist(), rel=1e-5), name


def test_mask_sparsity_of_what_is_visible_only():
    """The same K, but rows of such a mask that the view does not draw add nothing and get no gradient."""
    scene = masked_scene(visible_only=True)
    radii = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 2.0])
    loss = MaskSparsity()(rendering(radii=radii, spans=SPANS), frame(), scene)
    standing, moving = sigmoid(0.0, 2.0, -1.0), sigmoid(-3.0)
    assert loss.item() == pytest.approx((2.5e-3 * standing.sum() + 1e-4 * moving.sum()) / 9, rel=1e-6)
    loss.backward()
    gradient = scene.nodes["rigid"].rows.mask_logits.grad
    assert gradient[0] == 0
    assert float(gradient[1]) == pytest.approx(1e-4 / 9 * float(moving[0] * (1 - moving[0])), rel=1e-5)


def test_mask_sparsity_of_a_scene_without_rows_or_masks_is_zero():
    empty = SceneGraph({"background": background(0, mask=StaticMaskSettings(1.0))})
    nothing = rendering(spans={"background": slice(0, 0)})
    assert MaskSparsity()(nothing, frame(), empty).item() == 0.0
    assert MaskSparsity()(rendering(), frame(), SCENE).item() == 0.0


def test_the_rendered_depth_has_a_limit_of_its_own():
    """DriveStudio's: returns from 0.01 to 80 m, against all that is rendered beyond 0.1 mm."""
    measured, rendered = torch.full((HEIGHT, WIDTH), 5.0), torch.full((HEIGHT, WIDTH), 0.00005)
    measured[0, 0], measured[0, 1] = 0.02, 0.005
    rendered[0, :3] = torch.tensor([0.3, 0.3, 0.0002])
    term = Depth(1.0, inverse=False, nearest=0.01, nearest_rendered=1e-4)
    assert term(rendering(depth=rendered), frame(depth=measured), SCENE).item() == pytest.approx((0.28 + 4.9998) / 2)
    # One limit for both, unless said.
    assert Depth(nearest=0.5)(rendering(depth=rendered), frame(depth=measured), SCENE).item() == 0


@pytest.mark.parametrize("in_the_sky", [False, True])
def test_a_floor_stops_the_value_of_the_sky_but_not_its_pull(in_the_sky):
    """DriveStudio's safe_bce: -log max(a, 0.1), with the slope -1 / max(a, 0.1), of the alpha a that is right."""
    right = torch.tensor([0.0, 0.05, 0.1, 0.4, 1.0], dtype=torch.float64)
    alpha = (1 - right if in_the_sky else right).clone().requires_grad_()
    mask = torch.full((1, 5), in_the_sky)
    black, depth = torch.zeros(1, 5, 3), torch.ones(1, 5)
    loss = SkyMask(1.0, eps=1e-12, floor=0.1)
    term = loss(rendering(black, alpha[None], depth), frame_at(0, 5, 1, sky=mask), SCENE)
    (slope,) = torch.autograd.grad(term, alpha)
    assert term.item() == pytest.approx(-right.clamp(min=0.1).log().mean().item())
    sign = 1 if in_the_sky else -1
    torch.testing.assert_close(slope, sign / right.clamp(min=0.1) / 5)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: SkyMask(eps=0.0), "finite for eps > 0 only, got 0.0"),
        (lambda: SkyMask(floor=0.0), "floor of a cross entropy lies between 0 and 1"),
        (lambda: OpacityEntropy(eps=0.0), "finite slope .*, got 0"),
    ],
)
def test_terms_that_cannot_be_are_refused(make: Callable[[], Loss], said: str):
    with pytest.raises(ValueError, match=said):
        make()


@pytest.mark.parametrize(
    ("alpha", "entropy"), [(0.0, 0.0), (1.0, 0.0), (0.5, 0.5 * math.log(2)), (1 / math.e, 1 / math.e)]
)
def test_opacity_entropy_by_hand(alpha, entropy):
    values = torch.full((HEIGHT, WIDTH), alpha, dtype=torch.float64, requires_grad=True)
    loss = OpacityEntropy(weight=0.3)(rendering(alpha=values), frame(), SCENE)
    # eps moves the logarithm by eps / alpha.
    assert loss.item() == pytest.approx(0.3 * entropy, abs=3e-6)
    loss.backward()
    slope = -math.log(alpha) - 1 if alpha else -math.log(1e-6)
    assert values.grad.unique().tolist() == pytest.approx([0.3 * slope / (HEIGHT * WIDTH)], abs=1e-7)


def test_smoothness_of_inverse_depth_equals_kornias(generator):
    seen = frame()
    depth = torch.rand(HEIGHT, WIDTH, generator=generator, dtype=torch.float64) * 30 + 0.5
    depth.requires_grad_()
    ours = InverseDepthSmoothness(weight=2.0)(rendering(depth=depth), seen, SCENE)
    truth = seen.image.permute(2, 0, 1)[None].double() / 255
    theirs = 2 * kornia.losses.inverse_depth_smoothness_loss(1 / (depth + 1e-5)[None, None], truth)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=0)
    cotangent = torch.randn((), dtype=torch.float64, generator=generator)
    for mine, other in zip(*(torch.autograd.grad(t, depth, cotangent) for t in (ours, theirs)), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-10, atol=1e-14)


def test_what_is_not_drawn_is_no_step_of_depth():
    """Two depths side by side, and nothing in the first and the lower rows: one column of steps counts."""
    depth = torch.full((HEIGHT, WIDTH), 2.0, dtype=torch.float64)
    depth[:, 8:] = 4.0
    depth[0] = depth[5:] = 0.0
    depth.requires_grad_()
    flat = replace(frame(), image=torch.full((HEIGHT, WIDTH, 3), 7, dtype=torch.uint8))
    loss = InverseDepthSmoothness(weight=1.0)(rendering(depth=depth), flat, SCENE)
    assert loss.item() == pytest.approx(4 * 0.25 / (HEIGHT * (WIDTH - 1)), rel=1e-4)  # 1e-5 m of 2 m
    loss.backward()
    assert bool(depth.grad.isfinite().all())
    assert depth.grad.abs().sum(0).nonzero().squeeze(1).tolist() == [7, 8]
    nothing = InverseDepthSmoothness()(rendering(depth=torch.zeros(HEIGHT, WIDTH)), flat, SCENE)
    assert nothing.item() == 0


def test_plain_depth_by_hand_and_its_gradient(generator):
    depth, measured = torch.full((HEIGHT, WIDTH), 3.0), torch.zeros(HEIGHT, WIDTH)
    measured[2, 3], measured[4, 5], measured[0, 0] = 4.0, 2.5, 90.0
    loss = Depth(weight=0.01, inverse=False)(rendering(depth=depth), frame(depth=measured), SCENE)
    assert loss.item() == pytest.approx(0.01 * (1.0 + 0.5) / 2)
    for term in (Depth(weight=0.3, inverse=False), Depth(weight=0.7)):
        noisy = (depth + torch.rand(HEIGHT, WIDTH, generator=generator)).double().requires_grad_()
        assert torch.autograd.gradcheck(lambda at: term(rendering(depth=at), frame(depth=measured), SCENE), noisy)  # noqa: B023


STREET = {"background": background(30), "cars": rigid(30)}
LATE = SceneState(progress=0.7)


def seen_at(state: SceneState, scene: SceneGraph | None = None):
    """A scene of stub nodes as a view sees it: its rendering, the frame, the scene."""
    scene = SceneGraph(STREET) if scene is None else scene
    seen = frame_at(1)
    return render(scene, seen, state, RenderOptions(backend="reference")), seen, scene


def test_the_dynamic_region_is_where_objects_alone_are_opaque():
    rendered, seen, scene = seen_at(LATE)
    alone = render(SceneGraph({"cars": STREET["cars"]}), seen, options=RenderOptions(backend="reference")).alpha
    term = DynamicRegion(weight=3.0, threshold=0.4)
    region = alone > 0.4
    assert 20 < int(region.sum()) < region.numel() - 20
    expected = 3.0 * (rendered.rgb - seen.image.float() / 255).abs()[region].mean()
    loss = term(rendered, seen, scene)
    torch.testing.assert_close(loss, expected, rtol=1e-5, atol=0)
    (gradient,) = torch.autograd.grad(loss, rendered.rgb)
    assert torch.equal(gradient.abs().sum(-1) > 0, region)


def test_the_region_itself_is_not_differentiated(monkeypatch):
    rendered, seen, scene = seen_at(LATE)
    recorded = []

    def splat(*args, **kwargs):
        recorded.append(torch.is_grad_enabled())
        return ops_splat(*args, **kwargs)

    monkeypatch.setattr(losses, "splat", splat)
    assert DynamicRegion()(rendered, seen, scene).requires_grad
    assert recorded == [False]


def test_before_its_time_and_without_objects_nothing_is_rendered(monkeypatch):
    monkeypatch.setattr(losses, "splat", None)
    term = DynamicRegion(from_progress=0.6666)
    assert term(*seen_at(SceneState(progress=0.66))).item() == 0
    assert term(*seen_at(LATE, SceneGraph({"background": background(5)}))).item() == 0
    with pytest.raises(TypeError, match="not callable"):
        term(*seen_at(SceneState(progress=0.6667)))


def test_objects_without_gaussians_or_out_of_view_are_no_region():
    for cars in (rigid(0), rigid(6)):
        with torch.no_grad():
            cars.translation_deltas[..., 2] = -50.0
        scene = SceneGraph({"background": background(30), "cars": cars})
        assert DynamicRegion()(*seen_at(LATE, scene)).item() == 0
