"""No loss learns the recording car: what its pixels show changes neither value nor gradient."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import render
from sparsestreet.scene.state import SceneState
from sparsestreet.training.losses import (
    Depth,
    DynamicRegion,
    InverseDepthSmoothness,
    OpacityEntropy,
    Photometric,
    SkyMask,
    without_hood,
)
from tests.training.stubs import HEIGHT, WIDTH, StubTrainer, background, frame_at, make_system, rigid
from tests.typed import there

HOOD = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
HOOD[10:, 4:20] = True
LOSSES = (
    Photometric(),
    SkyMask(),
    SkyMask(floor=0.1),
    Depth(),
    Depth(inverse=False),
    OpacityEntropy(),
    InverseDepthSmoothness(),
    DynamicRegion(from_progress=0.0, threshold=0.01),
)


def known(seed: int) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)
    depth = 1 + 9 * torch.rand(HEIGHT, WIDTH, generator=generator)
    return {"depth": depth, "sky": torch.rand(HEIGHT, WIDTH, generator=generator) < 0.3}


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_what_lies_on_the_hood_does_not_count(loss):
    scene = SceneGraph({"road": background(20), "cars": rigid(10)})
    one, other = frame_at(0, **known(0), ego=HOOD), frame_at(1, **known(1), ego=HOOD)
    pixels = {name: getattr(one, name).clone() for name in ("image", "depth", "sky")}
    for name, values in pixels.items():
        values[HOOD] = getattr(other, name)[HOOD]
    rendering = render(scene, one, SceneState(progress=0.5, sh_degree=0))
    layers = {name: getattr(rendering, name).detach().clone().requires_grad_() for name in ("rgb", "alpha", "depth")}
    seen, first = without_hood(replace(rendering, **layers), one)
    value = loss(seen, first, scene)
    assert value.item() == loss(seen, without_hood(rendering, replace(one, **pixels))[1], scene).item() > 0
    gradients = torch.autograd.grad(value, list(layers.values()), allow_unused=True)
    given = [gradient for gradient in gradients if gradient is not None]
    assert given
    assert all(not gradient[HOOD].any() and gradient[~HOOD].any() for gradient in given)


def test_the_photometric_term_is_that_of_two_images_with_a_black_hood():
    """As in DriveStudio: the mean is over all pixels."""
    scene, frame = SceneGraph({"road": background(20)}), frame_at(0, ego=HOOD)
    with torch.no_grad():
        rendering = render(scene, frame)
        term = Photometric(lambda_dssim=0.0)(*without_hood(rendering, frame), scene)
    error = (rendering.rgb - frame.image / 255).abs()
    assert term.item() == pytest.approx(float(error[~HOOD].sum() / error.numel()))


def test_a_region_of_objects_ends_at_the_hood():
    scene = SceneGraph({"cars": rigid(40)})
    whole, cut = frame_at(0), frame_at(0, ego=HOOD)
    rendering = render(scene, whole, SceneState(progress=1.0, sh_degree=0))
    term = DynamicRegion(from_progress=0.0, threshold=0.01)(*without_hood(rendering, cut), scene)
    region = (rendering.alpha > 0.01) & ~HOOD
    assert bool((rendering.alpha[HOOD] > 0.01).any())
    error = (rendering.rgb - whole.image / 255).abs().mean(-1)
    assert term.item() == pytest.approx(error[region].mean().item())


def test_without_a_mask_nothing_is_touched():
    scene, frame = SceneGraph({"road": background(4)}), frame_at(0)
    rendering = render(scene, frame)
    assert without_hood(rendering, frame) == (rendering, frame)
    _, recorded = without_hood(rendering, frame_at(0, **known(0), ego=HOOD))
    assert not there(recorded.depth)[HOOD].any()


def test_a_training_step_leaves_the_hood_out():
    found = []
    for image in (frame_at(0).image, torch.where(HOOD[..., None], 255 - frame_at(0).image, frame_at(0).image)):
        system = make_system({"road": background(20)})
        StubTrainer(system).train(2, replace(frame_at(0, ego=HOOD), image=image))
        found.append(system.scene.nodes["road"].rows.means.detach())
    assert torch.equal(*found)
