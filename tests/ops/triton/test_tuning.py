"""Every choice of the pixel kernels draws the same bits and the same slots, and reads nothing that is not written."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings
from sparsestreet.ops.triton import pixels
from sparsestreet.ops.triton.screen import Screen, project
from sparsestreet.ops.triton.tuning import Tuning, tuned
from sparsestreet.ops.triton.view import KernelView
from tests.ops.scenes import cast, device_of, first_interpreted, front_camera, one_gaussian
from tests.ops.triton.test_parts import stack

DEVICE = device_of("triton")
ONE_BY_ONE = Tuning(shortest_part=3, two_launches=False)
"""Whole tiles, products and parts after each other."""
VARIANTS = {
    "two launches": {"two_launches": True},
}
STOPS = {
    "exclusive": SplatSettings(stop="exclusive", transmittance_min=0.02),
    "inclusive": SplatSettings(transmittance_min=0.02),
    "never": SplatSettings(transmittance_min=0.0),
}
# Sides that are no multiples of a tile's: four tiles, split and not.
VIEW = front_camera(27, 17, 22.0)
CASES = [(stop, "split") for stop in STOPS] + [("exclusive", "whole"), ("exclusive", "nothing")]


def project_case(stop: str, kind: str) -> tuple[Screen, KernelView, Tuning]:
    """The records and lists of a view, and how its tiles are split."""
    scene = stack(10, 0.8)
    if kind == "nothing":
        scene = one_gaussian(means=[[0.0, 0.0, -5.0]])
    view = KernelView(VIEW, STOPS[stop])
    choices = ONE_BY_ONE if kind == "split" else replace(ONE_BY_ONE, shortest_part=100)
    with tuned(choices):
        return project(cast(scene, torch.float32, device=DEVICE), view), view, choices


def drawn(screen: Screen, view: KernelView, choices: Tuning, cotangents: dict[str, Tensor]) -> dict[str, Tensor]:
    """Layers, where pixels end, and the slots of all pairs."""
    with tuned(choices):
        layers = pixels.blend_view(screen, view, lasts=True)
        images = {"rgb": layers.rgb, "transmittance": layers.ends.transmittance, "depth_sum": layers.depth_sum}
        slots = pixels.differentiate_view(screen, view, layers.ends, pixels.Cotangents(**cotangents), absolute=True)
    return {**images, "lasts": layers.ends.lasts, "slots": slots}


@pytest.mark.parametrize("case", first_interpreted(*CASES), ids=" ".join)
def test_every_choice_draws_the_same_bits(case, monkeypatch):
    stop, kind = case
    screen, view, choices = project_case(stop, kind)
    generator = torch.Generator().manual_seed(2)
    shapes = {"rgb": (17, 27, 3), "transmittance": (17, 27), "depth_sum": (17, 27)}
    cotangents = {name: torch.randn(*shape, generator=generator).to(DEVICE) for name, shape in shapes.items()}
    expected = drawn(screen, view, choices, cotangents)
    if kind == "split":
        assert (screen.lists.ends - screen.lists.begins).tolist() == [10, 11, 6, 0]
        # The first tile's pixels end in its first part, in a later one, and not at all.
        ends = set(expected["lasts"][:16, :16].flatten().tolist())
        assert 10 in ends
        assert stop == "never" or (min(ends) < 4 and ends & {5, 6, 7, 8, 9})
    empty = torch.Tensor.new_empty

    def poisoned(*args, **kwargs):
        tensor = empty(*args, **kwargs)
        return tensor.fill_(float("nan") if tensor.is_floating_point() else torch.iinfo(tensor.dtype).max)

    monkeypatch.setattr(torch.Tensor, "new_empty", poisoned)
    assert all(image.isfinite().all() for image in expected.values())
    for name, changes in ({"again": {}} | VARIANTS).items():
        found = drawn(screen, view, replace(choices, **changes), cotangents)
        for image, values in expected.items():
            assert torch.equal(found[image], values), (name, image)
