"""Where a Gaussian lands on the screen: its mean, and a factor V of its covariance V V^T (px^2).

Pinhole: V = J R S, the derivative of the projection at the mean (EWA splatting, Zwicker et al. 2001), 2x3. With lens
distortion: the unscented transform (Julier and Uhlmann 1997; for splats 3DGUT, Wu et al. 2025), 2x7.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry.distortion import distort
from sparsestreet.types import Camera

Footprint = tuple[Float[Tensor, "v 2"], Float[Tensor, "v 2 k"]]


def pinhole(in_camera: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3 3"], camera: Camera) -> Footprint:
    """Means, and V = J axes with J taken at the row's mean.

    There x/z is limited to [-(cx/fx + 0.3 t), (w - cx)/fx + 0.3 t], t = w / (2 fx), and y/z likewise: the limit
    1.3 tan(fov/2) of 3DGS, moved with the principal point. Past the limit x/z has no derivative.
    """
    K, inverse_z, zero = camera.intrinsics.to(in_camera), 1 / in_camera[:, 2], torch.zeros_like(in_camera[:, 2])
    means = in_camera[:, :2] / in_camera[:, 2:] * K.diagonal()[:2] + K[:2, 2]
    limited = []
    for axis, size in ((0, camera.width), (1, camera.height)):
        focal, centre = K[axis, axis], K[axis, 2]
        margin = 0.3 * size / (2 * focal)
        limited.append(
            (in_camera[:, axis] * inverse_z).clamp(-centre / focal - margin, (size - centre) / focal + margin)
        )
    row_x = torch.stack((K[0, 0] * inverse_z, zero, -K[0, 0] * limited[0] * inverse_z), -1)
    row_y = torch.stack((zero, K[1, 1] * inverse_z, -K[1, 1] * limited[1] * inverse_z), -1)
    return means, torch.stack((row_x, row_y), 1) @ axes


def unscented(in_camera: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3 3"], camera: Camera, near: float) -> Footprint:
    """Mean and covariance of seven sigma points sent through projection and lens.

    With alpha = 1, beta = 2, kappa = 0 the points are mu and mu +- sqrt(3) a_k; mu weighs 0 in the mean and 2 in the
    covariance, the others 1/6 in both: no weight is negative, so V V^T is a covariance. A point at less than ``near``
    metres is taken there, with its x and y; its depth has no derivative then.
    """
    K = camera.intrinsics.to(in_camera)
    steps = math.sqrt(3) * axes.mT
    points = in_camera[:, None] + torch.cat((torch.zeros_like(steps[:, :1]), steps, -steps), 1)
    normalised = points[..., :2] / points[..., 2:].clamp(min=near)
    # From the principal point, whose digits the differences would lose.
    pixels = distort(normalised, camera.distortion) * K.diagonal()[:2]
    centres = pixels[:, 1:].mean(1)
    weights = pixels.new_tensor([2.0] + [1 / 6] * 6)
    return centres + K[:2, 2], ((pixels - centres[:, None]) * weights.sqrt()[:, None]).mT
