"""Background, alpha and depth by one kernel each way: the bits of torch's own operations, for every combination."""

from itertools import product

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import splat
from sparsestreet.ops.raster import Raster
from sparsestreet.ops.splat import _compose
from sparsestreet.ops.triton.pixels import compose, decompose
from tests.ops.scenes import camera, cast, device_of, random_gaussians

DEVICE = device_of("triton")
# More pixels than a program has lanes.
HEIGHT, WIDTH = 25, 23
BACKGROUNDS = {"none": None, "color": (3,), "image": (HEIGHT, WIDTH, 3)}


def drawn(shape: tuple[int, ...] | None, seed: int) -> list[Tensor]:
    """Layers of a view, with pixels that are empty and nearly so; and a background."""
    generator = torch.Generator().manual_seed(seed)
    rgb, passed, depth = (
        torch.rand(*size, generator=generator) for size in ((HEIGHT, WIDTH, 3), (HEIGHT, WIDTH), (HEIGHT, WIDTH))
    )
    passed[0], passed[1], depth[0] = 1, 1 - 2e-7, 0
    background = [] if shape is None else [torch.rand(shape, generator=generator)]
    return [value.to(DEVICE) for value in (rgb, passed, 50 * depth, *background)]


@pytest.mark.parametrize("asked", [*product([False, True], repeat=3)][1:])
@pytest.mark.parametrize("behind", BACKGROUNDS)
def test_against_torch(behind, asked):
    layers = [value.requires_grad_() for value in drawn(BACKGROUNDS[behind], 0)]
    rgb, passed, depth_sum, *background = layers
    behind_it = background[0] if background else None
    truth = _compose(Raster(rgb, passed, depth_sum, torch.zeros(1)), torch.zeros(1, 2), behind_it)
    images = [truth.rgb, truth.alpha, truth.depth]
    given = [torch.randn_like(image) if wanted else None for image, wanted in zip(images, asked, strict=True)]
    used = [image for image, wanted in zip(images, asked, strict=True) if wanted]
    expected = torch.autograd.grad(
        used, [passed, depth_sum, *background], [v for v in given if v is not None], allow_unused=True
    )

    colors, light, depth = (value.detach().clone() for value in layers[:3])
    no_graph = None if behind_it is None else behind_it.detach()
    alpha = compose(colors, light, depth, no_graph)
    for ours, theirs in zip((colors, alpha, depth), images, strict=True):
        assert torch.equal(ours, theirs)
    v_rgb = torch.zeros_like(rgb) if given[0] is None else given[0]
    found = decompose(light, depth, no_graph, v_rgb, given[1], given[2], background_too=bool(background))
    for ours, theirs in zip(found, (*expected, None), strict=False):
        if theirs is None:
            assert ours is None or not ours.any()
        else:
            assert ours is not None
            assert torch.equal(ours, theirs)


def test_a_background_alone_is_differentiated():
    """The kernels of the splats' gradients need not run, and without ``lasts`` cannot."""
    view = camera(21, 9)
    scene = cast(random_gaussians(6, view), torch.float32, device=DEVICE)
    background = torch.rand(9, 21, 3, device=DEVICE).mT.contiguous().mT.requires_grad_()
    assert not background.is_contiguous()
    rendering = splat(scene, view, background=background, backend="triton")
    rendering.rgb.sum().backward()
    # alpha is 1 - transmittance, rounded.
    assert (background.grad + rendering.alpha[..., None] - 1).abs().max() <= 1e-7
