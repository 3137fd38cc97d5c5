"""The truth the fast backends are held to: dense plain torch with autograd, any float dtype.

Notation: u = mean on the screen, d = pixel centre - u, Sigma = V V^T + blur I with V = J R S the 2x3 screen factor of
the covariance (EWA splatting, Zwicker et al. 2001), Sigma^-1 = L^T L with L = [[l11, l21], [0, l22]].
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.ops.raster import Raster
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.spherical_harmonics import view_colors
from sparsestreet.types import Camera, Contribution, Gaussians, Removal

BOX_MARGIN = 0.01
"""Pixels by which boxes are widened before culling, so that rounding never decides about a touched pixel."""
COMPENSATION_FLOOR = 0.005
"""Least antialias compensation (gsplat 1.6): below it the ratio of determinants has no correct digits."""
DETERMINANT_MIN = 1e-12
"""px^4. Reached only without blur, by splats so thin that they touch no pixel centre; their conic would overflow."""
_CHUNK_ELEMENTS = 1 << 20


@dataclass(frozen=True)
class Splats:
    """Rows on the screen."""

    means: Float[Tensor, "v 2"]
    cholesky: Float[Tensor, "v 3"]
    """(l11, l21, l22), 1/px: exponent = -((l11 dx + l21 dy)^2 + (l22 dy)^2) / 2, never positive."""
    opacities: Float[Tensor, " v"]
    colors: Float[Tensor, "v 3"]
    depths: Float[Tensor, " v"]
    half_boxes: Float[Tensor, "v 2"]
    """Half sides of the box in which alpha >= alpha_min, pixels; infinite for alpha_min = 0."""
    usable: Bool[Tensor, " v"]
    """False where the determinant vanished or overflowed the dtype."""


def rasterise(
    gaussians: Gaussians, screen_offsets: Float[Tensor, "n 2"], camera: Camera, settings: SplatSettings
) -> Raster:
    """Project all rows, sort them and blend them densely into every pixel."""
    rows = visible_rows(gaussians, camera, settings)
    splats = on_screen(gaussians, rows, camera, settings)
    offsets = screen_offsets[rows]

    def blend(pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        weights, transmittance = _weights(_alphas(pixels, splats, offsets, settings), settings)
        return weights.T @ splats.colors, transmittance, weights.T @ splats.depths

    # Recomputed in backward chunk by chunk: memory does not grow with the image.
    parts = [
        checkpoint(blend, chunk, use_reentrant=False, preserve_rng_state=False)
        for chunk in _pixel_chunks(camera, splats)
    ]
    rgb, transmittance, depth_sum = (torch.cat(part) for part in zip(*parts, strict=True))
    radii = gaussians.means.detach().new_zeros(len(gaussians))
    if len(rows):
        radii[rows] = splats.half_boxes.amax(-1)
    shape = (camera.height, camera.width)
    return Raster(rgb.reshape(*shape, 3), transmittance.reshape(shape), depth_sum.reshape(shape), radii)


@torch.no_grad()
def contribution(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Contribution:
    """Blend weights, touched pixels and dominated pixels per row of one view."""
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
def removal(
    gaussians: Gaussians, background: Float[Tensor, "h w 3"] | None, camera: Camera, settings: SplatSettings
) -> Removal:
    """Change of the view without each row: -alpha dC/dalpha = -w c + (light behind) alpha / (1 - alpha)."""
    rows = visible_rows(gaussians, camera, settings)
    splats = on_screen(gaussians, rows, camera, settings)
    largest, squared = torch.zeros(2, len(gaussians), dtype=torch.float64, device=rows.device)
    if not len(rows):
        return Removal(largest, squared)
    if background is None:
        background = splats.colors.new_zeros(camera.height, camera.width, 3)
    still, begin = torch.zeros_like(splats.means), 0
    for chunk in _pixel_chunks(camera, splats):
        weights, transmittance = _weights(_alphas(chunk, splats, still, settings), settings)
        light = weights[..., None] * splats.colors[:, None]
        behind = transmittance[:, None] * background.reshape(-1, 3)[begin : begin + len(chunk)]
        # Summed from the back, so that little light keeps its digits; without row k itself.
        rest = light.flip(0).cumsum(0).flip(0) - light + behind
        # Never 0: alpha_max < 1, and a finished pixel's weights are 0.
        before = (1 - weights.double().cumsum(0) + weights).to(weights)
        alphas = weights / before
        change = rest * (alphas / (1 - alphas))[..., None] - light
        largest[rows] = torch.maximum(largest[rows], change.abs().amax((1, 2)).double())
        squared[rows] += change.double().square().sum((1, 2))
        begin += len(chunk)
    return Removal(largest, squared)


@torch.no_grad()
def visible_rows(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Int[Tensor, " v"]:
    """Rows whose box holds a pixel centre, nearest first, ties in row order.

    Found before anything is differentiated: a culled row takes no part in the graph, so no infinity of its
    intermediates can meet a zero cotangent.
    """
    depths = _in_camera(gaussians.means, camera)[:, 2]
    rows = ((depths > settings.near) & (gaussians.opacities > 0)).nonzero().squeeze(-1)
    splats = on_screen(gaussians, rows, camera, settings)
    size = torch.tensor([camera.width, camera.height], dtype=depths.dtype, device=depths.device)
    box = splats.half_boxes + BOX_MARGIN
    inside = ((splats.means + box >= 0.5) & (splats.means - box <= size - 0.5)).all(-1)
    rows = rows[splats.usable & (splats.opacities >= settings.alpha_min) & inside]
    return rows[torch.sort(depths[rows], stable=True).indices]


def on_screen(gaussians: Gaussians, rows: Int[Tensor, " v"], camera: Camera, settings: SplatSettings) -> Splats:
    """Project the given rows, which must lie in front of the camera."""
    in_camera = _in_camera(gaussians.means[rows], camera)
    K = camera.intrinsics.to(in_camera)
    means = in_camera[:, :2] / in_camera[:, 2:] * K.diagonal()[:2] + K[:2, 2]

    factors = _screen_factors(gaussians, rows, in_camera, camera)
    determinant, bare = _determinants(factors, settings.blur)
    variances = factors.square().sum(-1) + settings.blur
    covariance, variance_y = (factors[:, 0] * factors[:, 1]).sum(-1), variances[:, 1]
    l11 = (variance_y / determinant).sqrt()
    cholesky = torch.stack((l11, -covariance / (variance_y.sqrt() * determinant.sqrt()), variance_y.rsqrt()), -1)

    opacities = gaussians.opacities[rows]
    if settings.antialias:
        ratio, floor = bare / determinant, COMPENSATION_FLOOR**2
        opacities = opacities * torch.where(ratio > floor, ratio, floor).sqrt()
    colors = view_colors(gaussians.sh[rows], in_camera @ _rotation(camera, in_camera))
    half_boxes = _half_boxes(opacities.detach(), variances.detach(), settings.alpha_min)
    usable = (determinant >= DETERMINANT_MIN) & torch.isfinite(determinant)
    return Splats(means, cholesky, opacities, colors, in_camera[:, 2], half_boxes, usable)


def _rotation(camera: Camera, like: Tensor) -> Float[Tensor, "3 3"]:
    return camera.camera_from_world[:3, :3].to(like)


def _in_camera(means: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 3"]:
    return means @ _rotation(camera, means).T + camera.camera_from_world[:3, 3].to(means)


def _screen_factors(
    gaussians: Gaussians, rows: Int[Tensor, " v"], in_camera: Float[Tensor, "v 3"], camera: Camera
) -> Float[Tensor, "v 2 3"]:
    """V = J R S, so that the covariance on the screen is V V^T (px^2).

    J is taken at the row's mean, with x/z limited to [-(cx/fx + 0.3 t), (w - cx)/fx + 0.3 t], t = w / (2 fx), and y/z
    likewise: the limit 1.3 tan(fov/2) of 3DGS, moved with the principal point. Past the limit x/z has no derivative.
    """
    K, inverse_z, zero = camera.intrinsics.to(in_camera), 1 / in_camera[:, 2], torch.zeros_like(in_camera[:, 2])
    limited = []
    for axis, size in ((0, camera.width), (1, camera.height)):
        focal, centre = K[axis, axis], K[axis, 2]
        margin = 0.3 * size / (2 * focal)
        limited.append(
            (in_camera[:, axis] * inverse_z).clamp(-centre / focal - margin, (size - centre) / focal + margin)
        )
    row_x = torch.stack((K[0, 0] * inverse_z, zero, -K[0, 0] * limited[0] * inverse_z), -1)
    row_y = torch.stack((zero, K[1, 1] * inverse_z, -K[1, 1] * limited[1] * inverse_z), -1)
    axes = to_matrix(gaussians.quaternions[rows]) * gaussians.scales[rows][:, None]
    return torch.stack((row_x, row_y), 1) @ _rotation(camera, in_camera) @ axes


def _determinants(factors: Float[Tensor, "v 2 3"], blur: float) -> tuple[Float[Tensor, " v"], Float[Tensor, " v"]]:
    """det(V V^T + blur I) and det(V V^T) by Cauchy-Binet: sums of squares, no cancellation for needles."""
    bare = torch.linalg.cross(factors[:, 0], factors[:, 1]).square().sum(-1)
    return bare + blur * factors.square().sum((-1, -2)) + blur * blur, bare


def _half_boxes(
    opacities: Float[Tensor, " v"], variances: Float[Tensor, "v 2"], alpha_min: float
) -> Float[Tensor, "v 2"]:
    """o exp(-q/2) >= alpha_min needs q <= 2 ln(o / alpha_min); that ellipse reaches sqrt(q Sigma_xx) along x."""
    if alpha_min == 0:
        return torch.full_like(variances, torch.inf)
    reach = 2 * (opacities / alpha_min).log().clamp(min=0)
    return (reach[:, None] * variances).sqrt()


def _pixel_chunks(camera: Camera, splats: Splats) -> tuple[Float[Tensor, "p 2"], ...]:
    """Pixel centres in row order, as many at a time as keep a splats x pixels table small."""
    like = {"dtype": splats.means.dtype, "device": splats.means.device}
    y, x = torch.meshgrid(torch.arange(camera.height, **like), torch.arange(camera.width, **like), indexing="ij")
    centres = torch.stack((x, y), dim=-1).reshape(-1, 2) + 0.5
    return centres.split(max(1, _CHUNK_ELEMENTS // max(1, len(splats.means))))


def _alphas(
    pixels: Float[Tensor, "p 2"], splats: Splats, offsets: Float[Tensor, "v 2"], settings: SplatSettings
) -> Float[Tensor, "v p"]:
    """Clamped alpha of each splat in each pixel, 0 where it is below alpha_min."""
    shifts = _AbsoluteOffset.apply(offsets, len(pixels))
    dx, dy = (pixels[None] - splats.means[:, None] - shifts).unbind(-1)
    l11, l21, l22 = (column[:, None] for column in splats.cholesky.unbind(-1))
    raw = splats.opacities[:, None] * torch.exp(-0.5 * ((l11 * dx + l21 * dy).square() + (l22 * dy).square()))
    return torch.where(raw >= settings.alpha_min, raw.clamp(max=settings.alpha_max), 0.0)


def _weights(alphas: Float[Tensor, "v p"], settings: SplatSettings) -> tuple[Float[Tensor, "v p"], Float[Tensor, " p"]]:
    """Blend weight of each splat in each pixel, and the light that gets past all of them.

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
