"""Projects rows of Gaussians to splats on the screen.

Notation: u = mean on the screen, d = pixel center - u, Sigma = V V^T + blur I with the screen factor V (footprint.py),
Sigma^-1 = L^T L with L = [[l11, l21], [0, l22]]. A splat's alpha is o exp(-q/2) with q = |L d|^2.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.geometry.cameras import exact_position
from sparsestreet.geometry.lenses import distort, distortion_jacobian, fold_radius_squared
from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.spherical_harmonics import view_colors
from sparsestreet.ops.validate import check_values
from sparsestreet.types import Camera, Gaussians, Shutter


class Reason(IntEnum):
    """Reasons in the order in which the projection checks them; the first that holds counts (``ops.Guards``)."""

    DRAWN = 0
    MASKED = 1
    NEAR = 2
    PAST_FOLD = 3
    OUTRUNS_SHUTTER = 4
    VANISHED = 5
    OVERFLOWED = 6
    FAINT = 7
    OUTSIDE = 8


def first_reason(holds: dict[Reason, Bool[Tensor, " v"]]) -> Int[Tensor, " v"]:
    """The first reason that holds for each row, DRAWN if none does; at least one reason must be given."""
    reasons = torch.zeros_like(next(iter(holds.values())), dtype=torch.int64)
    for reason in sorted(holds, reverse=True):
        reasons[holds[reason]] = reason
    return reasons


Footprint = tuple[Float[Tensor, "v 2"], Float[Tensor, "v 2 k"]]


def pinhole(in_camera: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3 3"], camera: Camera) -> Footprint:
    """Means, and V = J axes, with J at the row's mean and its slopes clamped to ``slope_limits``.

    Past the limit x/z has no derivative.
    """
    K, inverse_z, zero = camera.intrinsics.to(in_camera), 1 / in_camera[:, 2], torch.zeros_like(in_camera[:, 2])
    slopes = in_camera[:, :2] / in_camera[:, 2:]
    x, y = slopes.clamp(*slope_limits(camera, in_camera)).unbind(-1)
    row_x = torch.stack((K[0, 0] * inverse_z, zero, -K[0, 0] * x * inverse_z), -1)
    row_y = torch.stack((zero, K[1, 1] * inverse_z, -K[1, 1] * y * inverse_z), -1)
    return slopes * K.diagonal()[:2] + K[:2, 2], torch.stack((row_x, row_y), 1) @ axes


def slope_limits(camera: Camera, like: Tensor) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Least and largest x/z and y/z: -(cx/fx + 0.3 t) and (w - cx)/fx + 0.3 t with t = w / (2 fx), y likewise.

    It is the limit 1.3 tan(fov/2) of 3DGS, moved with the principal point.
    """
    K, size = camera.intrinsics.to(like), like.new_tensor([camera.width, camera.height])
    focal, center = K.diagonal()[:2], K[:2, 2]
    margin = 0.3 * size / (2 * focal)
    return -center / focal - margin, (size - center) / focal + margin


def slopes_held(in_camera: Float[Tensor, "v 3"], camera: Camera) -> Bool[Tensor, " v"]:
    """Rows whose Jacobian :func:`pinhole` takes at a limit instead of at their mean."""
    slopes = in_camera[:, :2] / in_camera[:, 2:]
    lowest, highest = slope_limits(camera, in_camera)
    return ((slopes < lowest) | (slopes > highest)).any(-1)


def unscented(
    in_camera: Float[Tensor, "v 3"],
    axes: Float[Tensor, "v 3 3"],
    camera: Camera,
    distortion: Float[Tensor, "5"],
    near: float,
) -> Footprint:
    """Mean and covariance of seven sigma points sent through projection and lens.

    With alpha = 1, beta = 2, kappa = 0 the points are mu and mu +- sqrt(3) a_k. mu has weight 0 in the mean and 2 in
    the
    covariance, the others 1/6 in both. No weight is negative, so V V^T is a covariance. The depth of a point nearer
    than ``near`` meters is set to ``near`` and has no derivative.
    """
    K = camera.intrinsics.to(in_camera)
    points = _sigma_points(in_camera, axes)
    normalized = points[..., :2] / points[..., 2:].clamp(min=near)
    # Relative to the principal point, because adding it would cost the differences digits.
    pixels = distort(normalized, distortion) * K.diagonal()[:2]
    centers = pixels[:, 1:].mean(1)
    weights = pixels.new_tensor([2.0] + [1 / 6] * 6)
    return centers + K[:2, 2], ((pixels - centers[:, None]) * weights.sqrt()[:, None]).mT


def sigma_points_held(
    in_camera: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3 3"], distortion: Float[Tensor, "5"], near: float
) -> Bool[Tensor, " v"]:
    """Rows with a point that :func:`unscented` moves to ``near``, or that lies past the fold of the lens."""
    points = _sigma_points(in_camera, axes)
    slopes = points[..., :2] / points[..., 2:].clamp(min=near)
    past_fold = slopes.square().sum(-1) > fold_radius_squared(distortion)
    return (past_fold | (points[..., 2] < near)).any(-1)


def _sigma_points(in_camera: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3 3"]) -> Float[Tensor, "v 7 3"]:
    steps = math.sqrt(3) * axes.mT
    return in_camera[:, None] + torch.cat((torch.zeros_like(steps[:, :1]), steps, -steps), 1)


SLOWEST_READOUT = 0.1
"""Least a = 1 - u_y / H. A splat that moves as the readout does (a = 0) would be stretched without bound."""


def screen_motion(
    gaussians: Gaussians, rows: Int[Tensor, " v"], in_camera: Float[Tensor, "v 3"], camera: Camera, shutter: Shutter
) -> Float[Tensor, "v 2"]:
    """u, pixels per readout: the motion of the mean in the camera frame, times the exact derivative of its pixel.

    It is reversed if the readout runs towards smaller coordinates.
    """
    rotation = shutter.rotation.to(in_camera).detach()
    motion = -shutter.translation.to(in_camera).detach() - torch.linalg.cross(rotation[None], in_camera)
    if gaussians.displacements is not None:
        motion = motion + gaussians.displacements[rows].detach() @ camera.camera_from_world[:3, :3].to(in_camera).T
    depth = in_camera[:, 2:]
    slopes = in_camera[:, :2] / depth
    # d(X / Z) / dt = (dX - (X / Z) dZ) / Z
    velocity = (motion[:, :2] - slopes * motion[:, 2:]) / depth
    if camera.distortion is not None:
        velocity = (distortion_jacobian(slopes, camera.distortion) @ velocity[..., None])[..., 0]
    return velocity * (shutter.sign * camera.intrinsics.to(in_camera).diagonal()[:2])


def read_out(
    means: Float[Tensor, "v 2"],
    factors: Float[Tensor, "v 2 k"],
    motion: Float[Tensor, "v 2"],
    camera: Camera,
    shutter: Shutter,
) -> tuple[Footprint, Bool[Tensor, " v"]]:
    """The splats as the readout records them, and whether each of them does not outrun it."""
    if not shutter.reads_columns:
        return _rows_read_out(means, factors, motion, camera.height)
    (means, factors), read = _rows_read_out(means.flip(1), factors.flip(1), motion.flip(1), camera.width)
    return (means.flip(1), factors.flip(1)), read


def _rows_read_out(
    means: Float[Tensor, "v 2"], factors: Float[Tensor, "v 2 k"], motion: Float[Tensor, "v 2"], height: int
) -> tuple[Footprint, Bool[Tensor, " v"]]:
    slowness = 1 - motion[:, 1] / height
    y = (means[:, 1] - motion[:, 1] / 2) / slowness
    x = means[:, 0] + motion[:, 0] * (y / height - 0.5)
    factor_y = factors[:, 1] / slowness[:, None]
    factor_x = factors[:, 0] + (motion[:, 0] / height)[:, None] * factor_y
    return (torch.stack((x, y), -1), torch.stack((factor_x, factor_y), 1)), slowness >= SLOWEST_READOUT


BOX_MARGIN = 0.01
"""Pixels by which boxes are widened before culling, so that rounding never decides about a touched pixel."""
COMPENSATION_FLOOR = 0.005
"""Least antialias compensation (gsplat 1.6); below it the ratio of determinants has no correct digits."""
MIN_OPACITY = 2.0**-126
"""Smallest normal float32. The fast backends keep log2 of the opacity, which loses digits below it."""
DETERMINANT_MIN = 1e-12
"""Least determinant, px^4. Only without blur are splats thinner; they touch no pixel center, their conic overflows."""


@dataclass(frozen=True)
class Splats:
    """Rows projected to the screen."""

    means: Float[Tensor, "v 2"]
    cholesky: Float[Tensor, "v 3"]
    """(l11, l21, l22), 1/px: exponent = -((l11 dx + l21 dy)^2 + (l22 dy)^2) / 2, never positive."""
    opacities: Float[Tensor, " v"]
    colors: Float[Tensor, "v 3"]
    depths: Float[Tensor, " v"]
    reaches: Float[Tensor, " v"]
    """Largest q that is drawn: where alpha falls to alpha_min or the settings' box ends, whichever is nearer."""
    half_boxes: Float[Tensor, "v 2"]
    """Half sides of the box around the ellipse q = reach, pixels; infinite if nothing bounds it."""
    ratios: Float[Tensor, " v"] | None
    """Determinant without blur over that with blur; None without antialias."""
    refusals: dict[Reason, Bool[Tensor, " v"]]
    """Rows without a valid shape on this screen, by reason."""


@torch.no_grad()
def row_reasons(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Int[Tensor, " n"]:
    """The first ``Reason`` why each row is not drawn, or DRAWN. Comparisons are written so that NaN culls."""
    depths = to_camera(gaussians.means, camera)[:, 2]
    reasons = first_reason({Reason.MASKED: ~(gaussians.opacities > 0), Reason.NEAR: ~(depths > settings.near_plane)})
    rows = (reasons == Reason.DRAWN).nonzero().squeeze(-1)
    splats = on_screen(gaussians, rows, camera, settings)
    size = torch.tensor([camera.width, camera.height], dtype=depths.dtype, device=depths.device)
    box = splats.half_boxes + BOX_MARGIN
    inside = ((splats.means + box >= 0.5) & (splats.means - box <= size - 0.5)).all(-1)
    faint = ~(splats.opacities >= max(settings.alpha_min, MIN_OPACITY))
    reasons[rows] = first_reason(splats.refusals | {Reason.FAINT: faint, Reason.OUTSIDE: ~inside})
    return reasons


@torch.no_grad()
def visible_rows(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Int[Tensor, " v"]:
    """Rows whose box holds a pixel center, nearest first, ties in row order.

    Culled rows are removed before the graph begins, so that none of their infinities can meet a zero cotangent. Raises
    ValueError for bad values.
    """
    drawn = row_reasons(gaussians, camera, settings) == Reason.DRAWN
    check_values(gaussians, drawn)
    rows = drawn.nonzero().squeeze(-1)
    depths = to_camera(gaussians.means, camera)[:, 2]
    return rows[torch.sort(_sort_keys(depths[rows], settings.depth_bits), stable=True).indices]


def on_screen(gaussians: Gaussians, rows: Int[Tensor, " v"], camera: Camera, settings: SplatSettings) -> Splats:
    """Project the given rows, which must lie in front of the camera."""
    in_camera = to_camera(gaussians.means[rows], camera)
    means, factors, refusals = _footprints(gaussians, rows, in_camera, camera, settings)
    determinant, bare = _determinants(factors, settings.eps2d)
    variances = factors.square().sum(-1) + settings.eps2d
    covariance, variance_y = (factors[:, 0] * factors[:, 1]).sum(-1), variances[:, 1]
    l11 = (variance_y / determinant).sqrt()
    cholesky = torch.stack((l11, -covariance / (variance_y.sqrt() * determinant.sqrt()), variance_y.rsqrt()), -1)

    opacities, ratio = gaussians.opacities[rows], None
    if settings.antialias:
        ratio, floor = bare / determinant, COMPENSATION_FLOOR**2
        opacities = opacities * torch.where(ratio > floor, ratio, floor).sqrt()
    seen_from = in_camera.detach() if settings.detach_directions else in_camera
    colors = view_colors(gaussians.dense_sh()[rows], seen_from @ _rotation(camera, in_camera), settings.clamp_colors)
    if settings.half_colors:
        colors = _rounded_to_half(colors)
    reaches = _reaches(opacities.detach(), settings)
    half_boxes = (reaches[:, None] * variances.detach()).sqrt()
    # The direction of a color is divided by its length, whose square float32 holds up to 1.8e19 m.
    overflowed = ~torch.isfinite(determinant) | ~torch.isfinite(in_camera.square().sum(-1))
    refusals |= {Reason.VANISHED: determinant < DETERMINANT_MIN, Reason.OVERFLOWED: overflowed}
    return Splats(means, cholesky, opacities, colors, in_camera[:, 2], reaches, half_boxes, ratio, refusals)


def _rotation(camera: Camera, like: Tensor) -> Float[Tensor, "3 3"]:
    return camera.camera_from_world[:3, :3].to(like)


def to_camera(means: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 3"]:
    """Means in the camera: R ((m - c) - rest), where c + rest is the camera's position with twice the dtype's digits.

    The difference of two near points far from the origin is exact; R m + t would round two large numbers.
    """
    position = exact_position(camera).to(means.device)
    center = position.to(means.dtype)
    rest = (position - center).to(means.dtype)
    return ((means - center) - rest) @ _rotation(camera, means).T


def axes_in_camera(gaussians: Gaussians, rows: Int[Tensor, " v"], camera: Camera) -> Float[Tensor, "v 3 3"]:
    """The rows' own axes times their standard deviations, as columns, meters in the camera frame."""
    axes = to_matrix(gaussians.quaternions[rows]) * gaussians.scales[rows][:, None]
    return _rotation(camera, axes) @ axes


def _footprints(
    gaussians: Gaussians,
    rows: Int[Tensor, " v"],
    in_camera: Float[Tensor, "v 3"],
    camera: Camera,
    settings: SplatSettings,
) -> tuple[Float[Tensor, "v 2"], Float[Tensor, "v 2 k"], dict[Reason, Bool[Tensor, " v"]]]:
    """Means and screen factors, and the rows that lens or shutter cannot show."""
    axes, refusals = axes_in_camera(gaussians, rows, camera), {}
    if camera.distortion is None:
        means, factors = pinhole(in_camera, axes, camera)
    else:
        means, factors = unscented(in_camera, axes, camera, camera.distortion, settings.near_plane)
        slopes = in_camera.detach()[:, :2] / in_camera.detach()[:, 2:]
        refusals[Reason.PAST_FOLD] = ~(slopes.square().sum(-1) <= fold_radius_squared(camera.distortion))
    if camera.shutter is not None:
        motion = screen_motion(gaussians, rows, in_camera, camera, camera.shutter)
        (means, factors), read = read_out(means, factors, motion, camera, camera.shutter)
        refusals[Reason.OUTRUNS_SHUTTER] = ~read
    return means, factors, refusals


def _determinants(factors: Float[Tensor, "v 2 k"], blur: float) -> tuple[Float[Tensor, " v"], Float[Tensor, " v"]]:
    """det(V V^T + blur I) and det(V V^T) by Cauchy-Binet: sums of squares, without cancellation for needles."""
    products = factors[:, 0, :, None] * factors[:, 1, None]
    bare = (products - products.mT).square().sum((-1, -2)) / 2  # each pair of columns comes twice
    return bare + blur * factors.square().sum((-1, -2)) + blur * blur, bare


def _reaches(opacities: Float[Tensor, " v"], settings: SplatSettings) -> Float[Tensor, " v"]:
    """Largest q: o exp(-q/2) >= alpha_min needs q <= 2 ln(o / alpha_min), ``max_sigma`` needs q <= max_sigma^2."""
    end = settings.max_sigma * settings.max_sigma
    if settings.alpha_min == 0:
        return torch.full_like(opacities, end)
    return (2 * (opacities / settings.alpha_min).log().clamp(min=0)).clamp(max=end)


def _sort_keys(depths: Float[Tensor, " v"], bits: int) -> Float[Tensor, " v"]:
    """Depths with only the upper ``bits`` of their float32 form; for 32 all digits of the dtype."""
    if bits == 32:
        return depths
    # Positive floats have the order of their bits.
    return (depths.float().view(torch.int32) & -(1 << (32 - bits))).view(torch.float32)


def _rounded_to_half(colors: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3"]:
    """Nearest float16, at most its largest finite value; the gradient passes straight through."""
    exact = colors.detach()
    rounded = exact.clamp(max=torch.finfo(torch.float16).max).half().to(colors.dtype)
    return rounded + (colors - exact)
