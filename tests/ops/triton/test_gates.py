"""Gates on the Triton kernels: as the reference and the C++ library have them, for whole tiles and for parts."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.types import Camera, Gaussians
from tests.ops.scenes import (
    BACKENDS,
    camera,
    cast,
    device_of,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
)
from tests.ops.test_gates import gated
from tests.ops.test_parity import EFFECTS
from tests.ops.triton.splitting import Rule, split_by
from tests.ops.triton.test_parts import stack
from tests.typed import there

DEVICE = device_of("triton")
PARTS = Rule(min_part_pairs=3)
VIEW = front_camera(19, 9, 16.0)
BACKGROUND = torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64)
LIMIT = 0.02
ORACLES = [("reference", torch.float64), *[("cpu", torch.float32)] * ("cpu" in BACKENDS)]
EXCLUSIVE = SplatSettings(stop="exclusive", transmittance_min=LIMIT)
INCLUSIVE = SplatSettings(transmittance_min=LIMIT)


def deep() -> tuple[Gaussians, Tensor]:
    """A tile of nine pairs, three parts, and one of few; rows with gates of 0, of 1 and between.

    With the gates some pixels end in a part before the last, which ends in two hidden rows."""
    gates = torch.tensor([0.6, 0.0, 1.0, 0.25, 1.0, 0.0, 1.0, 0.7, 0.0, 0.0])
    return stack(9, 0.9), gates.double()


def moving() -> tuple[Gaussians, Tensor, Camera]:
    """Rows that move before a lens and a rolling shutter."""
    view = camera(17, 13)
    generator = torch.Generator().manual_seed(0)
    moves = 0.3 * torch.randn(9, 3, generator=generator, dtype=torch.float64)
    gates = torch.rand(9, generator=generator).round(decimals=1).double()
    gates[::3] = 0.0
    gaussians = replace(random_gaussians(9, view, terms=1), displacements=moves)
    return gaussians, gates, replace(view, **EFFECTS["lens and shutter"])


def assert_all_say_the_same(
    gaussians: Gaussians, view: Camera, gates: Tensor, settings: SplatSettings, image_bar: float, gradient_bar: float
) -> dict[str, Tensor]:
    """Images and all gradients beside the float64 reference, and the library in float32 if it is there (which a GPU's
    machine may lack); returns the reference's images."""
    images, gradients = gated(gaussians, view, gates, "triton", torch.float32, settings, BACKGROUND)
    for backend, dtype in ORACLES:
        truth, of_truth = gated(gaussians, view, gates, backend, dtype, settings, BACKGROUND)
        for name in ("rgb", "alpha"):
            assert (images[name] - truth[name]).abs().max() <= image_bar, (backend, name)
        assert relative_error(images["depth"], truth["depth"]) <= image_bar, backend
        torch.testing.assert_close(images["radii"], truth["radii"], rtol=3e-5, atol=0)
        for name, gradient in of_truth.items():
            assert gradient.norm() > 0, f"{name}: the scene tests nothing"
            assert relative_error(gradients[name], gradient) <= gradient_bar, (backend, name)
        hidden = (gates == 0) & (truth["radii"] > 0)
        assert of_truth["gates"][hidden].any() == bool((gates == 0).any())
        assert relative_error(gradients["gates"][hidden], of_truth["gates"][hidden]) <= gradient_bar, backend
    return gradients


CASES = {
    "exclusive, parts": (EXCLUSIVE, PARTS),
    "inclusive, parts": (INCLUSIVE, PARTS),
    "inclusive, whole tiles": (INCLUSIVE, Rule()),
}


@pytest.mark.parametrize("name", first_interpreted(*CASES))
def test_long_tiles(name, poisoned):
    """The bars are those of test_parts.py."""
    settings, choices = CASES[name]
    gaussians, gates = deep()
    with split_by(choices):
        gradients = assert_all_say_the_same(gaussians, VIEW, gates, settings, 1e-6, 1e-5)
    endless = replace(settings, transmittance_min=0.0)
    _, if_none_ended = gated(gaussians, VIEW, gates, "reference", settings=endless, background=BACKGROUND)
    # Some pixels end before the last row, which is hidden; others reach it.
    assert gradients["gates"][-1] != 0
    assert relative_error(gradients["gates"][-1], if_none_ended["gates"][-1]) > 0.01


def test_rows_that_move(poisoned):
    """The bars of the op in float32, as in test_parity.py."""
    gaussians, gates, view = moving()
    assert_all_say_the_same(gaussians, view, gates, SplatSettings(antialias=True), 1e-5, 1e-4)


def test_gates_learn_alone_in_any_layout():
    """No field is in the graph, gates are not contiguous, two rows are not drawn; without gradients the same image."""
    view = camera(9, 7)
    culled = Gaussians.concatenate(
        [one_gaussian(means=[[0.0, 0.0, -5.0]], sh=[[[0.0] * 3] * 4]), random_gaussians(6, view)]
    )
    rows = replace(culled, opacities=culled.opacities * (torch.arange(7) != 3))
    values, found = torch.rand(14, generator=torch.Generator().manual_seed(4)), []
    for backend, dtype in (("reference", torch.float64), ("triton", torch.float32)):
        device = device_of(backend)
        gates = values.to(device, dtype).requires_grad_()
        scene = cast(rows, dtype, device=device)
        rgb = splat(scene, view, backend=backend, gates=gates[::2]).rgb
        rgb.square().sum().backward()
        found.append(there(gates.grad).double().cpu())
        with torch.no_grad():
            assert torch.equal(splat(scene, view, backend=backend, gates=gates[::2]).rgb, rgb)
    assert found[0].norm() > 0
    assert relative_error(found[1], found[0]) < 1e-5
    assert not found[1].view(7, 2)[[0, 3]].any()
