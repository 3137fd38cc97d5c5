"""A shutter of any direction is one from the top, of a camera that is turned or moves the other way."""

import dataclasses

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings, contribution, leave_one_out, splat
from sparsestreet.types import Camera, Gaussians, Shutter, Side
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    every_double,
    every_precision,
    random_gaussians,
    relative_error,
    render,
)
from tests.typed import there

pytestmark = pytest.mark.lengthy
SETTINGS = SplatSettings(antialias=True)
LENS = (-0.25, 0.08, 2e-3, -1e-3, -0.01)


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def scene(direction: Side, bent: bool, size: tuple[int, int] = (13, 9), rows: int = 40) -> tuple[Gaussians, Camera]:
    """Moving rows, and a camera that drives and turns."""
    shutter = Shutter(vector(0.15, -0.3, 0.3), vector(0.02, 0.04, 0.02), direction)
    view = dataclasses.replace(camera(*size), shutter=shutter, distortion=vector(*LENS) if bent else None)
    speeds = 0.3 * torch.randn(rows, 3, generator=torch.Generator().manual_seed(3)).double()
    return dataclasses.replace(random_gaussians(rows, view), displacements=speeds), view


def turned(view: Camera) -> tuple[Camera, int]:
    """The camera turned about its optical axis until its top is read first.

    Also the quarter turns, counterclockwise, that bring its image back.
    """
    shutter = there(view.shutter)
    w, h, k = view.width, view.height, view.intrinsics.tolist()
    fx, fy, cx, cy = k[0][0], k[1][1], k[0][2], k[1][2]
    k1, k2, p1, p2, k3 = LENS
    size, (fx, fy, cx, cy), (x, y), (p1, p2), back = {
        # The left side becomes the top: clockwise.
        "left": ((h, w), (fy, fx, h - cy, cx), ((0, -1, 0), (1, 0, 0)), (p2, -p1), 1),
        "right": ((h, w), (fy, fx, cy, w - cx), ((0, 1, 0), (-1, 0, 0)), (-p2, p1), -1),
        "bottom": ((w, h), (fx, fy, w - cx, h - cy), ((-1, 0, 0), (0, -1, 0)), (-p1, -p2), 2),
    }[shutter.direction]
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :3] = torch.tensor([x, y])
    other = Camera(
        turn @ view.camera_from_world,
        torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
        *size,
        None if view.distortion is None else vector(k1, k2, p1, p2, k3),
        Shutter(turn[:3, :3] @ shutter.translation, turn[:3, :3] @ shutter.rotation),
    )
    return other, back


@every_double
@pytest.mark.parametrize("bent", [False, True], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("direction", ["bottom", "left", "right"])
def test_a_turned_camera_sees_the_turned_image(backend, direction, bent):
    gaussians, view = scene(direction, bent)
    other, back = turned(view)
    results = []
    for seen, quarters in ((view, 0), (other, back)):
        leaves = cast(gaussians, torch.float64, requires_grad=True)
        rendering = splat(leaves, seen, settings=SETTINGS, backend=backend)
        images = [torch.rot90(part, quarters) for part in (rendering.rgb, rendering.alpha, rendering.depth)]
        torch.autograd.backward(images, list(cotangents(view)))
        gradients = [there(getattr(leaves, name).grad) for name in FIELDS]
        across = rendering.screen_gradients.flip(1) if quarters in (1, -1) else rendering.screen_gradients
        results.append(([image.detach() for image in images], [*gradients, across], rendering.radii))
    (images, gradients, radii), (expected, true_gradients, true_radii) = results
    for image, truth in zip(images, expected, strict=True):
        torch.testing.assert_close(image, truth, rtol=0, atol=1e-11)
    assert (radii > 0).sum() > 15
    torch.testing.assert_close(radii, true_radii, rtol=1e-11, atol=0)
    for gradient, truth in zip(gradients, true_gradients, strict=True):
        assert truth.norm() > 0
        assert relative_error(gradient, truth) < 1e-10


@every_double
@pytest.mark.parametrize("direction", ["bottom", "left", "right"])
def test_rows_count_as_for_a_turned_camera(backend, direction):
    gaussians, view = scene(direction, True)
    found, expected = (contribution(gaussians, seen, backend=backend) for seen in (view, turned(view)[0]))
    assert expected.pixels.sum() > 500
    assert torch.equal(found.pixels, expected.pixels)
    assert torch.equal(found.dominant, expected.dominant)
    torch.testing.assert_close(found.weight, expected.weight, rtol=1e-10, atol=1e-12)
    lost, truth = (leave_one_out(gaussians, seen, backend=backend) for seen in (view, turned(view)[0]))
    assert (truth.max_abs_change > 0.01).sum() > 10
    torch.testing.assert_close(lost.max_abs_change, truth.max_abs_change, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(lost.squared_change, truth.squared_change, rtol=1e-9, atol=1e-12)


@every_precision
@pytest.mark.parametrize(("direction", "opposite"), [("bottom", "top"), ("right", "left")])
def test_the_opposite_side_is_the_reversed_motion_bit_for_bit(backend, dtype, direction, opposite):
    """Rounding knows no sign."""
    gaussians, view = scene(direction, True, (9, 7), 12)
    forth = there(view.shutter)
    back = Shutter(-forth.translation, -forth.rotation, opposite)
    reversed_motion = dataclasses.replace(gaussians, displacements=-there(gaussians.displacements))
    found = render(gaussians, view, backend, dtype)
    expected = render(reversed_motion, dataclasses.replace(view, shutter=back), backend, dtype)
    assert found.images["alpha"].any()
    for part in ("images", "gradients"):
        for name, value in getattr(expected, part).items():
            assert torch.equal(getattr(found, part)[name], value), name
    assert torch.equal(found.radii, expected.radii)
