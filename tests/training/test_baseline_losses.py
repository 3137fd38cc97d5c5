"""The terms of the paper's baselines: hand values, kornia, finite differences; when the dynamic region is rendered."""

import math
from dataclasses import replace

import kornia
import pytest
import torch

from sparsestreet.ops import splat as ops_splat
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.scene.state import SceneState
from sparsestreet.training.losses import (
    Depth,
    DynamicRegion,
    InverseDepthSmoothness,
    Loss,
    OpacityEntropy,
    dynamic_region,
)
from tests.training.stubs import background, frame_at, rigid
from tests.training.test_losses import HEIGHT, SCENE, WIDTH, check_gradient, frame, rendering


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


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


def test_gradient_of_opacity_entropy(generator):
    alpha = torch.rand(HEIGHT, WIDTH, generator=generator) * 0.98 + 0.01
    check_gradient(lambda values: OpacityEntropy(weight=0.7)(rendering(alpha=values), frame(), SCENE), alpha, generator)


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


def test_gradient_of_smoothness(generator):
    depth = torch.rand(HEIGHT, WIDTH, generator=generator) * 30 + 0.5
    term = InverseDepthSmoothness(weight=0.7)
    check_gradient(lambda values: term(rendering(depth=values), frame(), SCENE), depth, generator)


def test_what_is_not_drawn_is_no_step_of_depth():
    """Two depths side by side, and nothing in the lower rows: one column of steps counts."""
    depth = torch.full((HEIGHT, WIDTH), 2.0, dtype=torch.float64)
    depth[:, 8:] = 4.0
    depth[5:] = 0.0
    depth.requires_grad_()
    flat = replace(frame(), image=torch.full((HEIGHT, WIDTH, 3), 7, dtype=torch.uint8))
    loss = InverseDepthSmoothness(weight=1.0)(rendering(depth=depth), flat, SCENE)
    assert loss.item() == pytest.approx(5 * 0.25 / (HEIGHT * (WIDTH - 1)), rel=1e-4)  # 1e-5 m of 2 m
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
    term = Depth(weight=0.3, inverse=False)
    noisy = depth + torch.rand(HEIGHT, WIDTH, generator=generator)
    check_gradient(lambda values: term(rendering(depth=values), frame(depth=measured), SCENE), noisy, generator)


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

    monkeypatch.setattr(dynamic_region, "splat", splat)
    assert DynamicRegion()(rendered, seen, scene).requires_grad
    assert recorded == [False]


def test_before_its_time_and_without_objects_nothing_is_rendered(monkeypatch):
    monkeypatch.setattr(dynamic_region, "splat", None)
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


@pytest.mark.parametrize("term", [OpacityEntropy(), InverseDepthSmoothness(), DynamicRegion()])
def test_they_ask_nothing_of_a_frame(term):
    assert isinstance(term, Loss)
    assert term.applies(frame())


def test_an_entropy_without_eps_is_refused():
    with pytest.raises(ValueError, match=r"finite slope .*, got 0"):
        OpacityEntropy(eps=0.0)
