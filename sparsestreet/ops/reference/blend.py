"""Blends splats front to back into every pixel, and measures what each of them adds."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from sparsestreet.ops.raster import LeaveOneOutSums, Raster
from sparsestreet.ops.reference.projection import Splats, on_screen, visible_rows
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.validate import check_dtype
from sparsestreet.types import Camera, Contribution, Gaussians, LeaveOneOut, MedianDepth

_CHUNK_ELEMENTS = 1 << 20


def rasterize(
    gaussians: Gaussians,
    screen_offsets: Float[Tensor, "n 2"],
    camera: Camera,
    settings: SplatSettings,
    *,
    gates: Float[Tensor, " n"] | None = None,
    changes: LeaveOneOutSums | None = None,
) -> Raster:
    """Project all rows, sort them and blend them densely into every pixel; float32 or float64."""
    check_dtype(gaussians, "backend 'reference'")
    # The op is not differentiable in the camera, even where its tensors ask for a gradient.
    camera = replace(camera, camera_from_world=camera.camera_from_world.detach(), intrinsics=camera.intrinsics.detach())
    rows = visible_rows(gaussians, camera, settings)
    splats = on_screen(gaussians, rows, camera, settings)
    offsets = screen_offsets[rows]
    factors = None if gates is None else gates[rows, None]

    def blend(pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        alphas = _alphas(pixels, splats, offsets, settings)
        weights, transmittance = _weights(alphas if factors is None else alphas * factors, settings)
        return weights.T @ splats.colors, transmittance, weights.T @ splats.depths

    # Backward recomputes chunk by chunk, so that memory does not grow with the image.
    parts = [
        checkpoint(blend, chunk, use_reentrant=False, preserve_rng_state=False)
        for chunk in _pixel_chunks(camera, splats)
    ]
    rgb, transmittance, depth_sum = (torch.cat(part) for part in zip(*parts, strict=True))
    if changes is not None:
        rgb.register_hook(lambda _: _fill(changes, gaussians, camera, settings))
    radii = gaussians.means.detach().new_zeros(len(gaussians))
    if len(rows):
        radii[rows] = splats.half_boxes.amax(-1)
    shape = (camera.height, camera.width)
    return Raster(rgb.reshape(*shape, 3), transmittance.reshape(shape), depth_sum.reshape(shape), radii)


def _fill(changes: LeaveOneOutSums, gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> None:
    """Ask passes of their own, where other backends go on with what they have drawn."""
    ways = [leave_one_out(gaussians, changes.background, each, camera, settings) for each in changes.pixel_weights]
    squared = torch.stack([one.squared_change for one in ways], dim=1)
    changes.found = replace(ways[0], squared_change=squared)


@torch.no_grad()
def contribution(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Contribution:
    """Blend weights, touched pixels and dominated pixels per row of one view."""
    check_dtype(gaussians, "backend 'reference'")
    rows = visible_rows(gaussians, camera, settings)
    splats = on_screen(gaussians, rows, camera, settings)
    weight = torch.zeros(len(gaussians), dtype=torch.float64, device=rows.device)
    pixels, dominant = torch.zeros(2, len(gaussians), dtype=torch.int64, device=rows.device)
    if not len(rows):
        return Contribution(weight, pixels, dominant)
    for chunk in _pixel_chunks(camera, splats):
        weights = _weights(_alphas(chunk, splats, torch.zeros_like(splats.means), settings), settings)[0]
        touched = weights > 0
        weight[rows] += weights.double().sum(1)
        pixels[rows] += touched.sum(1)
        # argmax does not promise the first of equal maxima; the first row that equals the maximum is the nearer one.
        first = (weights == weights.amax(0)).to(torch.int8).cumsum(0).eq(0).sum(0)
        dominant[rows] += torch.bincount(first[touched.any(0)], minlength=len(rows))
    return Contribution(weight, pixels, dominant)


@torch.no_grad()
def median_depth(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> MedianDepth:
    """Which splat finished each pixel; ``settings`` stop inclusively at half of the light."""
    check_dtype(gaussians, "backend 'reference'")
    rows, shape = visible_rows(gaussians, camera, settings), (camera.height, camera.width)
    splats = on_screen(gaussians, rows, camera, settings)
    numbers, still = torch.arange(len(rows), device=rows.device)[:, None], torch.zeros_like(splats.means)
    lasts, lights = [], []
    for chunk in _pixel_chunks(camera, splats):
        weights, transmittance = _weights(_alphas(chunk, splats, still, settings), settings)
        drawn = torch.where(weights > 0, numbers, -1)
        lasts.append(torch.cat((drawn, drawn.new_full((1, len(chunk)), -1))).amax(0))
        lights.append(transmittance)
    passed, last = torch.cat(lights).reshape(shape), torch.cat(lasts).reshape(shape)
    met = passed <= settings.transmittance_min
    depth, found = splats.depths.new_full(shape, torch.inf), rows.new_full(shape, -1)
    depth[met], found[met] = splats.depths[last[met]], rows[last[met]]
    return MedianDepth(depth, found, 1 - passed)


@torch.no_grad()
def leave_one_out(
    gaussians: Gaussians,
    background: Float[Tensor, "h w 3"] | None,
    pixel_weights: Float[Tensor, "h w"] | None,
    camera: Camera,
    settings: SplatSettings,
) -> LeaveOneOut:
    """The change of the view without each row: -alpha dC/dalpha = -w c + (light behind) alpha / (1 - alpha)."""
    check_dtype(gaussians, "backend 'reference'")
    rows = visible_rows(gaussians, camera, settings)
    splats = on_screen(gaussians, rows, camera, settings)
    largest, squared, total = torch.zeros(3, len(gaussians), dtype=torch.float64, device=rows.device)
    if not len(rows):
        return LeaveOneOut(largest, squared, total)
    if background is None:
        background = splats.colors.new_zeros(camera.height, camera.width, 3)
    if pixel_weights is None:
        pixel_weights = splats.colors.new_ones(camera.height, camera.width)
    still, begin = torch.zeros_like(splats.means), 0
    for chunk in _pixel_chunks(camera, splats):
        weights, transmittance = _weights(_alphas(chunk, splats, still, settings), settings)
        light = weights[..., None] * splats.colors[:, None]
        here = slice(begin, begin + len(chunk))
        behind = transmittance[:, None] * background.reshape(-1, 3)[here]
        # Summed from the back, so that little light keeps its digits; without row k itself.
        rest = light.flip(0).cumsum(0).flip(0) - light + behind
        # Never 0: alpha_max < 1, and a finished pixel's weights are 0.
        before = (1 - weights.double().cumsum(0) + weights).to(weights)
        alphas = weights / before
        change = rest * (alphas / (1 - alphas))[..., None] - light
        largest[rows] = torch.maximum(largest[rows], change.abs().amax((1, 2)).double())
        squared[rows] += change.double().square().sum(2) @ pixel_weights.reshape(-1)[here].double()
        total[rows] += weights.double().sum(1)
        begin += len(chunk)
    return LeaveOneOut(largest, squared, total)


def _pixel_chunks(camera: Camera, splats: Splats) -> tuple[Float[Tensor, "p 2"], ...]:
    """Pixel centers in row order, in chunks that keep a splats x pixels table small."""
    like = {"dtype": splats.means.dtype, "device": splats.means.device}
    y, x = torch.meshgrid(torch.arange(camera.height, **like), torch.arange(camera.width, **like), indexing="ij")
    centers = torch.stack((x, y), dim=-1).reshape(-1, 2) + 0.5
    return centers.split(max(1, _CHUNK_ELEMENTS // max(1, len(splats.means))))


def _alphas(
    pixels: Float[Tensor, "p 2"], splats: Splats, offsets: Float[Tensor, "v 2"], settings: SplatSettings
) -> Float[Tensor, "v p"]:
    """Clamped alpha of each splat in each pixel, 0 outside the splat's reach."""
    every = (-1, len(pixels), -1)
    shifts = offsets[:, None].expand(every) if settings.plain_gradients else _AbsoluteOffset.apply(offsets, len(pixels))
    dx, dy = (pixels[None] - splats.means[:, None] - shifts).unbind(-1)
    l11, l21, l22 = (column[:, None] for column in splats.cholesky.unbind(-1))
    q = (l11 * dx + l21 * dy).square() + (l22 * dy).square()
    raw = splats.opacities[:, None] * torch.exp(-0.5 * q)
    return torch.where(q <= splats.reaches[:, None], raw.clamp(max=settings.alpha_max), 0.0)


def _weights(alphas: Float[Tensor, "v p"], settings: SplatSettings) -> tuple[Float[Tensor, "v p"], Float[Tensor, " p"]]:
    """Blend weight of each splat in each pixel, and the light that passes all of them.

    Transmittance never rises along a ray, so the stop rule is one test per splat and pixel.
    """
    passed = (1 - alphas).cumprod(0)
    before = torch.cat((torch.ones_like(passed[:1]), passed[:-1]))
    still_open = (before if settings.stop == "inclusive" else passed) > settings.transmittance_min
    alphas = torch.where(still_open, alphas, 0.0)
    return alphas * before, (1 - alphas).prod(0)


class _AbsoluteOffset(torch.autograd.Function):
    """Spreads offsets [v, 2] over p pixels; backward sums absolute values over them (AbsGS, Ye et al. 2024)."""

    @staticmethod
    def forward(ctx, offsets: Tensor, pixels: int) -> Tensor:
        return offsets[:, None].expand(-1, pixels, -1)

    @staticmethod
    def backward(ctx, cotangent: Tensor) -> tuple[Tensor, None]:
        return cotangent.abs().sum(1), None
