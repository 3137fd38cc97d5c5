"""Every choice of the pixel kernels draws the same bits and the same slots, and reads nothing that is not written.

On a device up to rounding."""

from dataclasses import replace

import pytest
import torch
import triton.language as tl
from torch import Tensor

from sparsestreet.ops import SplatSettings
from sparsestreet.ops.triton import pixels, rasterizer
from sparsestreet.ops.triton.screen import Screen, list_exactly, project_all
from sparsestreet.ops.triton.tuning import Tuning, tuned
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.types import Gaussians
from tests.ops.scenes import cast, device_of, first_interpreted, front_camera, one_gaussian
from tests.ops.triton.test_parts import stack

DEVICE = device_of("triton")
ONE_BY_ONE = Tuning(shortest_part=3, two_launches=False, staged=False)
"""Whole tiles, products and parts after each other; each pair's record is fetched alone."""
VARIANTS = {
    "all": {"two_launches": True, "marked_slots": True, "staged": True},
    "two launches": {"two_launches": True},
    "marked slots": {"marked_slots": True},
    "staged": {"staged": True},
}
STOPS = {
    "exclusive": SplatSettings(stop="exclusive", transmittance_min=0.02),
    "inclusive": SplatSettings(transmittance_min=0.02),
    "never": SplatSettings(transmittance_min=0.0),
}
# Sides that are no multiples of a tile's: four tiles, split and not.
VIEW = front_camera(27, 17, 22.0)
CASES = [
    *((stop, "split", name) for stop in STOPS for name in VARIANTS),
    *(("exclusive", kind, "all") for kind in ("whole", "nothing")),
    *(("exclusive", "gated", name) for name in VARIANTS),
    ("inclusive", "gated", "all"),
]


def project_case(stop: str, kind: str) -> tuple[Screen, KernelView, Tuning]:
    """The records and lists of a view, and how its tiles are split."""
    # Three that close the right tile, whose other pairs are not walked.
    wall = [
        one_gaussian(means=[[0.36, 0.0, 1 + 0.01 * k]], scales=[[0.42, 1.0, 0.01]], opacities=[1.0]) for k in range(3)
    ]
    scene = Gaussians.concatenate([*wall, stack(7, 0.8)])
    if kind == "nothing":
        scene = one_gaussian(means=[[0.0, 0.0, -5.0]])
    view = KernelView(VIEW, STOPS[stop])
    choices = ONE_BY_ONE if kind in ("split", "gated") else replace(ONE_BY_ONE, shortest_part=100)
    single = cast(scene, torch.float32, device=DEVICE)
    gates = torch.linspace(0, 1, len(scene), device=DEVICE) if kind == "gated" else None
    with tuned(choices):
        return list_exactly(single, project_all(single, view, gates), view), view, choices


def drawn(screen: Screen, view: KernelView, choices: Tuning, cotangents: dict[str, Tensor]) -> dict[str, Tensor]:
    """Layers, where pixels end, the slots of all pairs, and their sums."""
    with tuned(choices):
        layers = pixels.blend_view(screen, view, lasts=True)
        images = {"rgb": layers.rgb, "transmittance": layers.ends.transmittance, "depth": layers.depth}
        v = pixels.Cotangents(**cotangents)
        slots, walked = pixels.differentiate_view(screen, view, layers.ends, v, absolute=True)
        sums = slots.new_zeros(len(screen.records), slots.shape[1])
        rasterizer._sum_slots(slots, screen.lists, sums, 16, tl.float32, walked)
    if walked is not None:
        assert torch.equal(slots.isfinite().all(1), walked.bool())
        slots = torch.where(walked[:, None] != 0, slots, 0.0)
    assert layers.ends.lasts is not None
    return {**images, "lasts": layers.ends.lasts, "slots": slots, "sums": sums}


@pytest.mark.parametrize("case", first_interpreted(*CASES), ids=" ".join)
def test_every_choice_draws_the_same_bits(case, poisoned):
    stop, kind, variant = case
    screen, view, choices = project_case(stop, kind)
    generator = torch.Generator().manual_seed(2)
    shapes = {"rgb": (17, 27, 3), "transmittance": (17, 27), "depth_sum": (17, 27)}
    cotangents = {name: torch.randn(*shape, generator=generator).to(DEVICE) for name, shape in shapes.items()}
    expected = drawn(screen, view, choices, cotangents)
    assert all(image.isfinite().all() for image in expected.values())
    if kind == "split":
        assert (screen.lists.ends - screen.lists.begins).tolist() == [10, 11, 6, 3]
        # The first tile's pixels end in its first part, in a later one, and not at all.
        ends = set(expected["lasts"][:16, :16].flatten().tolist())
        assert 10 in ends
        assert stop == "never" or (min(ends) < 4 and ends & {5, 6, 7, 8, 9})
        zeros = (expected["slots"] == 0).all(1)
        assert zeros.any() == (stop != "never")
    found = drawn(screen, view, replace(choices, **VARIANTS[variant]), cotangents)
    for image, values in expected.items():
        # On a device the compiler contracts other products in other kernels.
        rounding = 0.0 if DEVICE.type == "cpu" or not values.numel() else 1e-6 * float(values.abs().max())
        torch.testing.assert_close(found[image], values, rtol=0.0, atol=rounding, msg=image)
