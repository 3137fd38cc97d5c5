"""Random splats that fill a camera's frustum: the scene of the op's timings."""

import torch
from torch import Tensor

from sparsestreet.types import Camera, Gaussians


def frustum_camera(width: int, height: int) -> Camera:
    """A camera at the origin that looks along +z, 53 degrees wide."""
    intrinsics = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float32)
    return Camera(torch.eye(4), intrinsics, width, height)


def frustum_gaussians(rows: int, camera: Camera, sigma_pixels: float, terms: int, seed: int = 0) -> Gaussians:
    """Gaussians of depth 2 to 50 m, log-normal sizes of this median on the screen, opacity 0.05 to 0.95; float32."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    focal = float(camera.intrinsics[0, 0])
    depth = 2 + 48 * uniform(rows)
    pixels = uniform(rows, 2) * torch.tensor([camera.width, camera.height])
    centered = (pixels - torch.tensor([camera.width / 2, camera.height / 2])) / focal
    sizes = sigma_pixels * torch.exp(0.5 * torch.randn(rows, 3, generator=generator))
    return Gaussians(
        torch.cat((centered * depth[:, None], depth[:, None]), -1),
        torch.randn(rows, 4, generator=generator),
        sizes * depth[:, None] / focal,
        0.05 + 0.9 * uniform(rows),
        0.3 * torch.randn(rows, terms, 3, generator=generator),
    )
