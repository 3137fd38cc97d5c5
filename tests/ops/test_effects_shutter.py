"""Rolling shutter against a brute-force one: every image row or column rendered at its own instant."""

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch

from sparsestreet.geometry.quaternions import from_rotation_vector, to_matrix
from sparsestreet.ops import SplatSettings, guards, splat
from sparsestreet.types import Camera, Gaussians, Shutter, Side
from tests.ops.oracles import brown_conrady, fitted_splat, naive_image
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    device_of,
    every_double,
    every_precision,
    front_camera,
    one_gaussian,
    random_gaussians,
    render,
)
from tests.typed import there

pytestmark = pytest.mark.lengthy

# The low-pass belongs to the sensor and does not move with the splat, so the moving-Gaussian identity is exact without.
SHARP = SplatSettings(eps2d=0.0)
FITTED = SplatSettings(eps2d=0.0, alpha_min=0.0, transmittance_min=0.0)
LENS = (-0.25, 0.08, 2e-3, -1e-3, -0.01)
every_lens = pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "distorted"])
every_direction = pytest.mark.parametrize("direction", ["top", "bottom", "left", "right"])


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def rolling(
    view: Camera, translation=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0), direction: Side = "top", lens=None
) -> Camera:
    shutter = Shutter(vector(*translation), vector(*rotation), direction)
    return dataclasses.replace(view, shutter=shutter, distortion=None if lens is None else vector(*lens))


def moved(gaussians: Gaussians, displacements) -> Gaussians:
    return dataclasses.replace(gaussians, displacements=torch.as_tensor(displacements, dtype=torch.float64))


def read_at(view: Camera, x: float, y: float) -> float:
    """When a place of the image is read, -1/2 to 1/2 of the readout."""
    right, down = x / view.width - 0.5, y / view.height - 0.5
    return {"top": down, "bottom": -down, "left": right, "right": -right}[there(view.shutter).direction]


def at_instant(gaussians: Gaussians, view: Camera, tau: float) -> tuple[Gaussians, Camera]:
    """The world and the global-shutter camera at ``tau`` of the readout, -1/2 to 1/2."""
    turn = torch.eye(4, dtype=torch.float64)
    # world_from_camera(tau) = world_from_camera [R(tau w) | tau t]
    turn[:3, :3] = to_matrix(from_rotation_vector(tau * view.shutter.rotation))
    turn[:3, 3] = tau * view.shutter.translation
    means = gaussians.means
    if gaussians.displacements is not None:
        means = means + tau * gaussians.displacements
    pose = torch.linalg.inv(turn) @ view.camera_from_world
    return dataclasses.replace(gaussians, means=means), dataclasses.replace(view, camera_from_world=pose, shutter=None)


def brute_force(gaussians: Gaussians, view: Camera, settings: SplatSettings) -> np.ndarray:
    """Through a lens each line comes from an image of the reference, which has no shutter to simulate there."""
    image, rows = np.zeros((view.height, view.width, 3)), there(view.shutter).direction in ("top", "bottom")
    for line in range(view.height if rows else view.width):
        scene, instant = at_instant(gaussians, view, read_at(view, line + 0.5, line + 0.5))
        place = line if rows else (slice(None), line)
        if view.distortion is None:
            drawn = naive_image(scene, instant, settings, **{"rows" if rows else "columns": [line]})
        else:
            drawn = splat(scene, instant, settings=settings, backend="reference").rgb.numpy()
        image[place] = drawn[place]
    return image


def flat_cards(generator_seed: int = 2) -> Gaussians:
    """Splats without thickness, parallel to the image plane of front_camera: there J does not depend on x and y."""
    generator = torch.Generator().manual_seed(generator_seed)
    rows = 6
    half_angles = 3 * torch.rand(rows, generator=generator, dtype=torch.float64)
    zero = torch.zeros(rows, dtype=torch.float64)
    means = torch.rand(rows, 3, generator=generator, dtype=torch.float64) - 0.5
    return Gaussians(
        means + vector(0.0, 0.0, 2.0),
        torch.stack((half_angles.cos(), zero, zero, half_angles.sin()), -1),
        torch.stack((0.2 + 0.1 * half_angles, 0.1 + zero, zero), -1),
        0.3 + 0.1 * half_angles,
        torch.randn(rows, 1, 3, generator=generator, dtype=torch.float64),
    )


@every_double
@every_direction
@pytest.mark.parametrize(
    ("translation", "displacement"),
    [((0.3, 0.0, 0.0), None), ((0.0, -0.25, 0.0), None), ((-0.2, 0.3, 0.0), (0.1, 0.3, 0.0))],
    ids=["sideways", "up", "both and the rows move"],
)
def test_cards_moving_in_their_planes_are_exact(backend, translation, displacement, direction):
    view = rolling(front_camera(13, 11, 12.0), translation, direction=direction)
    gaussians = flat_cards()
    if displacement is not None:
        speeds = torch.linspace(-1, 1, len(gaussians), dtype=torch.float64)[:, None]
        gaussians = moved(gaussians, speeds * vector(*displacement))
    image = splat(gaussians, view, settings=SHARP, backend=backend).rgb
    expected = brute_force(gaussians, view, SHARP)
    still = naive_image(gaussians, view, SHARP)
    assert abs(expected - still).max() > 0.05
    np.testing.assert_allclose(image.numpy(), expected, atol=1e-11)


@every_double
def test_ball_on_the_axis_is_exact_to_first_order(backend):
    # Sideways motion and yaw leave the shape of a ball on the optical axis alone, to first order; half, then a quarter.
    ball = one_gaussian(scales=[[0.25] * 3])
    errors = []
    for size in (0.01, 0.005, 0.0025):
        view = rolling(front_camera(15, 13, 14.0), (2 * size, -size, 0.0), (0.5 * size, size, 0.0))
        gaussians = moved(ball, [[size, size, 0.0]])
        image = splat(gaussians, view, settings=FITTED, backend=backend).rgb.numpy()
        errors.append(abs(image - brute_force(gaussians, view, FITTED)).max())
    assert errors[-1] > 1e-7, "the test measures nothing"
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.03)


@every_double
@every_lens
@every_direction
def test_mean_follows_any_motion_to_first_order(backend, lens, direction):
    # A long lens shifted off the axis shows 20 x 40 pixels; the ball, 1.5 px in size, is not read in the middle. For
    # columns x and y are exchanged, so that it moves as far along the readout.
    order = [0, 1, 2] if direction in ("top", "bottom") else [1, 0, 2]
    focal, mean, width, height = 2000.0, vector(0.7, -0.4, 2.0)[order], (20, 40)[order[0]], (20, 40)[order[1]]
    intrinsics = torch.tensor([[focal, 0, 0.0], [0, focal, 0.0], [0, 0, 1]], dtype=torch.float64)
    view = Camera(torch.eye(4, dtype=torch.float64), intrinsics, width, height, None if lens is None else vector(*lens))
    ball = one_gaussian(means=[mean.tolist()], scales=[[1.5 * 2 / focal] * 3])

    def place(instant: Camera, scene: Gaussians) -> np.ndarray:
        x, y, z = (instant.camera_from_world[:3, :3] @ scene.means[0] + instant.camera_from_world[:3, 3]).tolist()
        return focal * brown_conrady(np.array(x / z), np.array(y / z), lens or (0.0,) * 5)

    start = place(view, ball)
    view.intrinsics[0, 2], view.intrinsics[1, 2] = (10, 28)[order[0]] - start[0], (10, 28)[order[1]] - start[1]
    settled = fitted_splat(splat(ball, view, settings=FITTED, backend=backend).alpha)[0]
    errors = []
    for size in (1.0, 0.5):
        steps, angles = size * vector(6e-3, -4e-3, 0.02)[order], size * vector(3e-3, -5e-3, 4e-3)[order]
        shot = rolling(view, steps.tolist(), angles.tolist(), direction, lens)
        gaussians = moved(ball, size * vector(4e-3, 6e-3, -0.03)[None, order])
        found = fitted_splat(splat(gaussians, shot, settings=FITTED, backend=backend).alpha)[0]
        # Where the true path crosses the line that is being read; the settled mean includes what the shape adds.
        true = settled
        for _ in range(50):
            scene, instant = at_instant(gaussians, shot, read_at(shot, *true))
            true = settled + place(instant, scene) - start
        assert np.abs(true - settled).max() > 0.2 * size
        errors.append(np.abs(found - true).max())
    assert errors[0] < 0.02
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.15)


@cache
def moving_scene(direction: Side, lens: tuple[float, ...] | None) -> tuple[Gaussians, Camera, np.ndarray, float]:
    """A moving scene, its true image, and how far from that the image without a shutter is."""
    view = rolling(camera(20, 15, focal=80.0), (0.15, -0.05, 0.3), (0.02, 0.03, 0.02), direction, lens)
    still = random_gaussians(30, view, terms=1)
    near = (still.means @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3])[:, 2] < 3
    still = Gaussians(*(getattr(still, name)[~near] for name in FIELDS))
    gaussians = moved(still, 0.2 * torch.randn(len(still), 3, generator=torch.Generator().manual_seed(3)).double())
    expected = brute_force(gaussians, view, FITTED)
    at_once = splat(gaussians, dataclasses.replace(view, shutter=None), settings=FITTED, backend="reference").rgb
    return gaussians, view, expected, float(np.linalg.norm(at_once.numpy() - expected))


# The lens is as strong as -0.25 would be in four times the angle: without it the error is half of the effect or more.
@every_double
@pytest.mark.parametrize("lens", [None, (-4.0, 4.8, 0.04, -0.02, 0.0)], ids=["pinhole", "distorted"])
@every_direction
def test_most_of_a_moving_scene_is_right(backend, lens, direction):
    # Tilted ellipsoids everywhere, a camera that drives, yaws and bumps, rows that walk: their shapes change during the
    # readout, which one Gaussian cannot follow. That is a sixth of the effect here, or less.
    gaussians, view, expected, effect = moving_scene(direction, lens)
    image = splat(gaussians, view, settings=FITTED, backend=backend).rgb.numpy()
    assert effect > 0.3
    assert np.linalg.norm(image - expected) < 0.2 * effect


@every_precision
def test_no_motion_is_no_shutter_bit_for_bit(backend, dtype):
    view, rows = camera(9, 7), 6 if backend == "triton" else 60
    gaussians = random_gaussians(rows, view)
    plain = render(gaussians, view, backend, dtype)
    resting = render(moved(gaussians, torch.zeros(rows, 3)), rolling(view), backend, dtype)
    # Without a shutter the rows' own motion shows nothing.
    unseen = render(moved(gaussians, torch.ones(rows, 3)), view, backend, dtype)
    for name, image in plain.images.items():
        assert torch.equal(image, unseen.images[name])
        assert torch.equal(image, resting.images[name])
    assert torch.equal(plain.radii, resting.radii)
    for name, gradient in plain.gradients.items():
        assert torch.equal(gradient, unseen.gradients[name])
        torch.testing.assert_close(gradient, resting.gradients[name], rtol=50 * torch.finfo(dtype).eps, atol=1e-6)


@every_precision
@pytest.mark.parametrize(
    ("direction", "fall", "drawn"),
    [
        *(("top", fall, fall < 0.9) for fall in (-20.0, 0.85, 0.95, 1.0, 20.0)),
        *((direction, fall, fall < 0.9) for direction in ("bottom", "left", "right") for fall in (0.85, 0.95)),
    ],
)
def test_rows_that_outrun_the_readout_are_culled(backend, dtype, direction, fall, drawn):
    # From the top the ball falls by `fall` image heights during the readout, so 1 - u_y / H = 1 - fall; culled below
    # 0.1. Its peak is at the middle row whenever it is drawn.
    view = rolling(front_camera(9, 10, 20.0), direction=direction)
    heights = {"top": (0, 10, 0), "bottom": (0, -10, 0), "left": (9, 0, 0), "right": (-9, 0, 0)}[direction]
    ball = moved(one_gaussian(), [[fall * height / 20 * 2 for height in heights]])
    result = render(ball, view, backend, dtype)
    assert result.is_finite()
    assert bool(result.radii[0] > 0) == drawn
    assert guards(cast(ball, dtype), view).outruns_shutter == (not drawn)
    assert bool(result.images["alpha"].any()) == drawn
    if not drawn:
        assert not any(gradient.any() for gradient in result.gradients.values())


@every_precision
@pytest.mark.parametrize("lens", [None, (-0.1, 0.0, 0.0, 0.0, 0.0)], ids=["pinhole", "distorted"])
def test_cameras_and_displacements_get_no_gradient(backend, dtype, lens):
    view = rolling(front_camera(9, 7, 12.0), (0.1, 0.1, 0.1), (0.01, 0.02, 0.03))
    view = dataclasses.replace(view, distortion=None if lens is None else vector(*lens))
    still = cast(one_gaussian(), dtype, requires_grad=True, device=device_of(backend))
    gaussians = dataclasses.replace(still, displacements=torch.full_like(still.means, 0.1).detach())
    given = [view.camera_from_world, view.intrinsics, view.shutter.translation, view.shutter.rotation]
    given += [gaussians.displacements, *([] if lens is None else [view.distortion])]
    for value in given:
        value.requires_grad_()
    rendering = splat(gaussians, view, backend=backend)
    (rendering.rgb.sum() + rendering.depth.sum()).backward()
    assert gaussians.means.grad.any()
    assert all(value.grad is None for value in given)


@every_double
@every_lens
@pytest.mark.parametrize("field", FIELDS)
def test_gradient_of_each_field(backend, field, lens):
    """For other directions test_effects_shutter_turned.py compares them with those of a turned camera."""
    view = rolling(camera(5, 4), (0.15, -0.3, 0.3), (0.02, 0.04, 0.02), "top", lens)
    gaussians = random_gaussians(8, view, terms=4, seed=3)
    speeds = 0.3 * torch.randn(8, 3, generator=torch.Generator().manual_seed(3)).double()
    values = {name: getattr(gaussians, name).clone() for name in FIELDS}
    settings = SplatSettings(alpha_min=1e-9, antialias=True)

    def images(value):
        moving = Gaussians(**(values | {field: value}), displacements=speeds)
        rendering = splat(moving, view, settings=settings, backend=backend)
        return rendering.rgb, rendering.alpha, rendering.depth

    assert torch.autograd.gradcheck(images, values[field].requires_grad_(), fast_mode=True)
