"""What must hold for any scene: symmetries of the world, of the rows, of the image and of the background."""

import dataclasses

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn
from torch import Tensor

from sparsestreet.geometry.quaternions import from_matrix, multiply, to_matrix
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.types import Camera, Gaussians, Rendering, Shutter
from tests.ops.scenes import EFFECT_BACKENDS, FIELDS, camera, cast, every_backend, random_gaussians

few = settings(max_examples=12, derandomize=True, database=None, deadline=None)
"""The same examples in every run: a failure in CI is the failure at home."""
SMOOTH = SplatSettings(alpha_min=1e-12, transmittance_min=0.0)
"""No cut-off that rounding could move a pixel across."""


@st.composite
def scenes(draw: DrawFn) -> tuple[Gaussians, Camera, Tensor]:
    """Gaussians, a camera of odd size and as many random numbers as a test wants, all from one seed."""
    seed = draw(st.integers(0, 2**31 - 1))
    view = camera(draw(st.integers(1, 24)), draw(st.integers(1, 20)), focal=draw(st.floats(8, 40)))
    gaussians = random_gaussians(
        draw(st.integers(0, 40)), view, terms=draw(st.sampled_from([1, 1, 4, 9, 16])), seed=seed
    )
    return gaussians, view, torch.randn(64, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)


def with_effects(gaussians: Gaussians, view: Camera, noise: Tensor, backend: str) -> tuple[Gaussians, Camera]:
    """Lens, shutter and motion where the backend has them."""
    if backend not in EFFECT_BACKENDS:
        return gaussians, view
    shutter = Shutter(0.1 * noise[:3], 0.02 * noise[3:6])
    lens = torch.tensor([-0.2, 0.05, 1e-3, -2e-3, 0.0], dtype=torch.float64)
    shaken = 0.1 * noise[6:9] * torch.ones_like(gaussians.means)
    return (
        dataclasses.replace(gaussians, displacements=shaken),
        dataclasses.replace(view, shutter=shutter, distortion=lens),
    )


def rows_of(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    moved = gaussians.displacements
    kept = (getattr(gaussians, name)[rows] for name in FIELDS)
    return Gaussians(*kept, None if moved is None else moved[rows])


def assert_same(seen: Rendering, expected: Rendering, bar: float) -> None:
    assert (seen.rgb - expected.rgb).abs().max() < bar
    assert (seen.alpha - expected.alpha).abs().max() < bar
    torch.testing.assert_close(seen.radii, expected.radii, rtol=1e-7, atol=1e-7)


@every_backend
@few
@given(scene=scenes())
def test_moving_the_world_and_the_camera_together(backend, scene):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise, backend)
    turn, shift = to_matrix(noise[10:14]), 5 * noise[14:17]
    if gaussians.sh.shape[1] > 1:  # Harmonics of higher degree are fixed to the world's axes.
        turn = torch.eye(3, dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn.T, -turn.T @ shift
    moved = dataclasses.replace(
        gaussians,
        means=gaussians.means @ turn.T + shift,
        quaternions=multiply(from_matrix(turn).expand_as(gaussians.quaternions), gaussians.quaternions),
        displacements=None if gaussians.displacements is None else gaussians.displacements @ turn.T,
    )
    elsewhere = dataclasses.replace(view, camera_from_world=view.camera_from_world @ pose)
    expected = splat(gaussians, view, settings=SMOOTH, backend=backend)
    assert_same(splat(moved, elsewhere, settings=SMOOTH, backend=backend), expected, 1e-9)


@every_backend
@few
@given(scene=scenes(), unit=st.sampled_from([1e-3, 0.25, 3.7, 1e3]))
def test_another_unit_of_length(backend, scene, unit):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise, backend)
    moved = gaussians.displacements
    scaled = dataclasses.replace(
        gaussians,
        means=unit * gaussians.means,
        scales=unit * gaussians.scales,
        displacements=None if moved is None else unit * moved,
    )
    pose = view.camera_from_world.clone()
    pose[:3, 3] *= unit
    shutter = view.shutter and Shutter(unit * view.shutter.translation, view.shutter.rotation)
    elsewhere = dataclasses.replace(view, camera_from_world=pose, shutter=shutter)
    expected = splat(gaussians, view, settings=SMOOTH, backend=backend)
    near = dataclasses.replace(SMOOTH, near=unit * SMOOTH.near)
    seen = splat(scaled, elsewhere, settings=near, backend=backend)
    assert_same(seen, expected, 1e-9)
    torch.testing.assert_close(seen.depth, unit * expected.depth, rtol=1e-9, atol=1e-9 * unit)


@every_backend
@few
@given(scene=scenes())
def test_order_of_the_rows(backend, scene):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise, backend)
    order = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(int(1e6 * noise[20].abs())))
    plain, shuffled = (splat(rows, view, backend=backend) for rows in (gaussians, rows_of(gaussians, order)))
    assert torch.equal(plain.rgb, shuffled.rgb)
    assert torch.equal(plain.depth, shuffled.depth)
    assert torch.equal(plain.radii[order], shuffled.radii)


@every_backend
@few
@given(scene=scenes(), numbers=st.tuples(*[st.floats(0, 1)] * 4))
def test_a_crop_is_the_image_of_a_shifted_principal_point(backend, scene, numbers):
    gaussians, view, _ = scene
    left, top = (int(numbers[i] * (size - 1)) for i, size in enumerate((view.width, view.height)))
    width, height = (
        1 + int(numbers[i + 2] * (size - first - 1))
        for i, (size, first) in enumerate(((view.width, left), (view.height, top)))
    )
    intrinsics = view.intrinsics.clone()
    intrinsics[0, 2] -= left
    intrinsics[1, 2] -= top
    crop = Camera(view.camera_from_world, intrinsics, width, height)
    # The Jacobian's limit moves with the image's edges, so only rows before the crop's limit look the same.
    in_camera = gaussians.means @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
    pixels = in_camera[:, :2] / in_camera[:, 2:] * intrinsics.diagonal()[:2] + intrinsics[:2, 2]
    margin = torch.tensor([0.15 * width, 0.15 * height], dtype=torch.float64)
    size = torch.tensor([width, height], dtype=torch.float64)
    gaussians = rows_of(gaussians, ((pixels > -margin) & (pixels < size + margin)).all(-1))
    whole, part = (splat(gaussians, seen, settings=SMOOTH, backend=backend) for seen in (view, crop))
    inside = (slice(top, top + height), slice(left, left + width))
    assert (whole.rgb[inside] - part.rgb).abs().max() < 1e-9
    assert (whole.alpha[inside] - part.alpha).abs().max() < 1e-9


@every_backend
@few
@given(scene=scenes())
def test_a_masked_duplicate_changes_no_bit(backend, scene):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise, backend)
    masked = dataclasses.replace(gaussians, opacities=0 * gaussians.opacities)
    plain, doubled = (
        splat(rows, view, backend=backend) for rows in (gaussians, Gaussians.concatenate([masked, gaussians, masked]))
    )
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(plain, name), getattr(doubled, name))


@every_backend
@few
@given(scene=scenes())
def test_the_image_is_linear_in_the_background(backend, scene):
    gaussians, view, noise = scene
    first, second = noise[:3], torch.rand(view.height, view.width, 3, dtype=torch.float64)
    black, one, other, both = (
        splat(gaussians, view, background=background, backend=backend).rgb
        for background in (None, first, second, 0.5 * first - 2 * second)
    )
    torch.testing.assert_close(both - black, 0.5 * (one - black) - 2 * (other - black), rtol=0, atol=1e-12)


@every_backend
@few
@given(scene=scenes())
def test_float32_is_close_to_float64(backend, scene):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise, backend)
    # "exact": no cut-off, over which a pixel could fall in one precision only.
    exact = SplatSettings.preset("exact")
    double, single = (
        splat(cast(gaussians, dtype), view, settings=exact, backend=backend) for dtype in (torch.float64, torch.float32)
    )
    assert (double.rgb - single.rgb).abs().max() < 2e-5
    assert (double.alpha - single.alpha).abs().max() < 2e-5
