"""What must hold for any scene: symmetries of the world, of the rows, of the image and of the background."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sparsestreet.geometry.quaternions import from_matrix, multiply, to_matrix
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.types import Camera, Gaussians, Rendering, Shutter
from tests.ops.scenes import DEFAULT, FIELDS, camera, cast, device_of, every_backend, every_precision, random_gaussians

# triton/test_shared_properties.py holds two smaller scenes for Triton's interpreter.
pytestmark = [pytest.mark.slow_if_interpreted, pytest.mark.lengthy]
few = settings(max_examples=12, derandomize=True, database=None, deadline=None)
"""The same examples in every run: a failure in CI is the failure at home."""
BAR = {torch.float64: 1e-11, torch.float32: 1e-5}
"""Found 7e-15 and 3e-6: coordinates of 30 m, 2e-6 m apart in float32, at 40 px a meter and less."""
SHIFT_BAR = {torch.float64: 1e-12, torch.float32: 4e-6}
"""Of images of the same rows elsewhere on the image plane: 41 px are known to 2e-6 px in float32, and alpha changes by
at most 1.1 per pixel (a blur of 0.55 px)."""
SMOOTH = SplatSettings(alpha_min=1e-12, transmittance_min=0.0)
"""No cut-off that rounding could move a pixel across."""
Scene = tuple[Gaussians, Camera, Tensor]


def make_scene(seed: int, width: int, height: int, focal: float, rows: int, terms: int) -> Scene:
    """Gaussians, a camera, and as many random numbers as a test wants, all from one seed."""
    view = camera(width, height, focal=focal)
    noise = torch.randn(64, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    return random_gaussians(rows, view, terms=terms, seed=seed), view, noise


scenes = st.builds(
    make_scene,
    seed=st.integers(0, 2**31 - 1),
    width=st.integers(1, 24),
    height=st.integers(1, 20),
    focal=st.floats(8, 40),
    rows=st.integers(0, 60),
    terms=st.sampled_from([1, 1, 4, 9, 16]),
)


def through_a_lens(view: Camera) -> Camera:
    return dataclasses.replace(view, distortion=torch.tensor([-0.2, 0.05, 1e-3, -2e-3, 0.0], dtype=torch.float64))


def with_effects(gaussians: Gaussians, view: Camera, noise: Tensor) -> tuple[Gaussians, Camera]:
    """Lens, shutter and motion."""
    shutter = Shutter(0.1 * noise[:3], 0.02 * noise[3:6])
    shaken = 0.1 * noise[6:9] * torch.ones_like(gaussians.means)
    moving = dataclasses.replace(gaussians, displacements=shaken)
    return moving, dataclasses.replace(through_a_lens(view), shutter=shutter)


def rows_of(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    moved = gaussians.displacements
    kept = Gaussians(*(getattr(gaussians, name)[rows] for name in FIELDS))
    return kept if moved is None else dataclasses.replace(kept, displacements=moved[rows])


def pixels_of(gaussians: Gaussians, view: Camera) -> Tensor:
    """Where the pinhole sees the means."""
    in_camera = gaussians.means @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
    return in_camera[:, :2] / in_camera[:, 2:] * view.intrinsics.diagonal()[:2] + view.intrinsics[:2, 2]


def before_the_limit(gaussians: Gaussians, view: Camera) -> Gaussians:
    """Rows at which the Jacobian is not limited: the limit moves with the image's edges (0.15 of its sides)."""
    size = torch.tensor([view.width, view.height], dtype=torch.float64)
    pixels = pixels_of(gaussians, view)
    return rows_of(gaussians, ((pixels > -0.15 * size) & (pixels < 1.15 * size)).all(-1))


def window(view: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The same camera with another piece of its image plane."""
    intrinsics = view.intrinsics.clone()
    intrinsics[:2, 2] -= torch.tensor([left, top])
    return dataclasses.replace(view, intrinsics=intrinsics, width=width, height=height)


def seen_by(
    backend: str,
    dtype: torch.dtype,
    gaussians: Gaussians,
    view: Camera,
    choice: SplatSettings = DEFAULT,
    background: Tensor | None = None,
) -> Rendering:
    """The op's answer in ``dtype``, brought back in float64."""
    device = device_of(backend)
    behind = None if background is None else background.to(device, dtype)
    rows = cast(gaussians, dtype, device=device)
    answer = splat(rows, view, background=behind, settings=choice, backend=backend)
    return Rendering(*(value.double().cpu() for value in vars(answer).values()))


def assert_same(seen: Rendering, expected: Rendering, dtype: torch.dtype) -> None:
    assert (seen.rgb - expected.rgb).abs().max() < BAR[dtype]
    assert (seen.alpha - expected.alpha).abs().max() < BAR[dtype]
    torch.testing.assert_close(seen.radii, expected.radii, rtol=BAR[dtype], atol=BAR[dtype])


def assert_same_inside(whole: Rendering, inside: tuple[slice, slice], part: Rendering, dtype: torch.dtype) -> None:
    assert (whole.rgb[inside] - part.rgb).abs().max() < SHIFT_BAR[dtype]
    assert (whole.alpha[inside] - part.alpha).abs().max() < SHIFT_BAR[dtype]


@every_precision
@few
@given(scene=scenes)
def test_moving_the_world_and_the_camera_together(backend, dtype, scene):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise)
    turn, shift = to_matrix(noise[10:14]), 5 * noise[14:17]
    if gaussians.dense_sh().shape[1] > 1:  # Harmonics of higher degree are fixed to the world's axes.
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
    expected = seen_by(backend, dtype, gaussians, view, SMOOTH)
    assert_same(seen_by(backend, dtype, moved, elsewhere, SMOOTH), expected, dtype)


@every_precision
@few
@given(scene=scenes, unit=st.sampled_from([1e-3, 0.25, 3.7, 1e3]))
def test_another_unit_of_length(backend, dtype, scene, unit):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise)
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
    expected = seen_by(backend, dtype, gaussians, view, SMOOTH)
    near = dataclasses.replace(SMOOTH, near_plane=unit * SMOOTH.near_plane)
    seen = seen_by(backend, dtype, scaled, elsewhere, near)
    assert_same(seen, expected, dtype)
    # Depth is divided by alpha, of which float32 keeps no digits where it is faint.
    sums = (seen.depth / unit * seen.alpha, expected.depth * expected.alpha)
    torch.testing.assert_close(*sums, rtol=BAR[dtype], atol=BAR[dtype])


@every_precision
@few
@given(scene=scenes)
def test_order_of_the_rows(backend, dtype, scene):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise)
    order = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(int(1e6 * noise[20].abs())))
    plain, shuffled = (seen_by(backend, dtype, rows, view) for rows in (gaussians, rows_of(gaussians, order)))
    assert torch.equal(plain.rgb, shuffled.rgb)
    assert torch.equal(plain.depth, shuffled.depth)
    assert torch.equal(plain.radii[order], shuffled.radii)


@every_precision
@few
@given(scene=scenes, numbers=st.tuples(*[st.floats(0, 0.5)] * 4))
def test_a_crop_is_the_image_of_a_shifted_principal_point(backend, dtype, scene, numbers):
    gaussians, view, _ = scene
    left, top = (int(numbers[i] * view_size) for i, view_size in enumerate((view.width, view.height)))
    width, height = (rest - int(numbers[i + 2] * rest) for i, rest in enumerate((view.width - left, view.height - top)))
    crop = window(view, left, top, width, height)
    gaussians = before_the_limit(gaussians, crop)
    whole, part = (seen_by(backend, dtype, gaussians, seen, SMOOTH) for seen in (view, crop))
    inside = (slice(top, top + height), slice(left, left + width))
    assert_same_inside(whole, inside, part, dtype)


@every_precision
@few
@given(scene=scenes, cut=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_crops_together_make_the_image(backend, dtype, scene, cut):
    # Through a lens, where the shape of no row depends on the image's edges.
    gaussians, view, _ = scene
    view = through_a_lens(view)
    left, top = (round(part * size) for part, size in zip(cut, (view.width, view.height), strict=True))
    whole = seen_by(backend, dtype, gaussians, view, SMOOTH)
    for x, width in ((0, left), (left, view.width - left)):
        for y, height in ((0, top), (top, view.height - top)):
            if width and height:
                part = seen_by(backend, dtype, gaussians, window(view, x, y, width, height), SMOOTH)
                assert_same_inside(whole, (slice(y, y + height), slice(x, x + width)), part, dtype)


@every_precision
@few
@given(scene=scenes, padding=st.tuples(*[st.integers(0, 17)] * 4), lens=st.booleans())
def test_where_the_tiles_fall_does_not_matter(backend, dtype, scene, padding, lens):
    # A pixel that rounding moves across this cut-off changes by less than the bar, a tile that is missing by more.
    cut = SplatSettings(alpha_min=SHIFT_BAR[dtype] / 4, transmittance_min=0.0)
    gaussians, view, _ = scene
    if lens:
        view = through_a_lens(view)
    else:
        gaussians = before_the_limit(gaussians, view)
    left, top, right, bottom = padding
    padded = window(view, -left, -top, left + view.width + right, top + view.height + bottom)
    whole, part = (seen_by(backend, dtype, gaussians, seen, cut) for seen in (padded, view))
    inside = (slice(top, top + view.height), slice(left, left + view.width))
    assert_same_inside(whole, inside, part, dtype)


@every_precision
@few
@given(scene=scenes)
def test_a_masked_duplicate_changes_no_bit(backend, dtype, scene):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise)
    masked = dataclasses.replace(gaussians, opacities=0 * gaussians.opacities)
    more = Gaussians.concatenate([masked, gaussians, masked])
    plain, doubled = (seen_by(backend, dtype, rows, view) for rows in (gaussians, more))
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(plain, name), getattr(doubled, name))


@every_precision
@few
@given(scene=scenes)
def test_the_image_is_linear_in_the_background(backend, dtype, scene):
    gaussians, view, noise = scene
    first, second = noise[:3], torch.rand(view.height, view.width, 3, dtype=torch.float64)
    black, one, other, both = (
        seen_by(backend, dtype, gaussians, view, background=background).rgb
        for background in (None, first, second, 0.5 * first - 2 * second)
    )
    # A few roundings of numbers below 4.
    bar = 8 * torch.finfo(dtype).eps
    torch.testing.assert_close(both - black, 0.5 * (one - black) - 2 * (other - black), rtol=0, atol=bar)


@every_backend
@few
@given(scene=scenes)
def test_float32_is_close_to_float64(backend, scene):
    gaussians, view, noise = scene
    gaussians, view = with_effects(gaussians, view, noise)
    # "exact": no cut-off, over which a pixel could fall in one precision only.
    exact = SplatSettings.preset("exact")
    double = seen_by("reference", torch.float64, gaussians, view, exact)
    single = seen_by(backend, torch.float32, gaussians, view, exact)
    assert (double.rgb - single.rgb).abs().max() < 2e-5
    assert (double.alpha - single.alpha).abs().max() < 2e-5
