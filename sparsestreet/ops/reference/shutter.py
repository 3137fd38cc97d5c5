"""A rolling shutter that costs nothing per pixel, because the moving splat is again a 2D Gaussian.

Read from its top, image row y (pixel center at +0.5) is read at tau = y / H - 1/2 of the readout. The splat's mean is
then at m + tau u, with u its motion on the screen over the whole readout. tau is linear in y, so the exponent stays
quadratic in the pixel.
With A = [[1, -u_x / H], [0, 1 - u_y / H]] the splat's mean m' solves A m' = m - u / 2. Its covariance is
A^-1 Sigma A^-T.

Read from its bottom, tau changes its sign, which is the same as a motion -u. Columns are rows of the image with x and y
exchanged.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.geometry.lenses import distortion_jacobian
from sparsestreet.ops.reference.footprint import Footprint
from sparsestreet.types import Camera, Gaussians, Shutter

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
