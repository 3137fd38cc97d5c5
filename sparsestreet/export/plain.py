"""Opacities for viewers that do not antialias.

A scene that was trained with antialias has small Gaussians whose opacity falls where the blur of the screen widens them
(Mip-Splatting, Yu et al. 2024): by sqrt(det / det_blurred), which depends on the camera. Viewers of plain 3DGS blur
without that factor, and would show far surfaces too thick and too bright. So a file for them holds opacities with the
mean factor of the cameras that see a Gaussian. What the log's cameras saw is then 2 to 15 dB nearer to what training
drew (docs/shipping.md).
"""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.lazy import spread
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.reference import on_screen, visible_rows
from sparsestreet.ops.reference.projection import COMPENSATION_FLOOR
from sparsestreet.types import Camera, Gaussians, View

MAX_CAMERAS = 36
"""Cameras of a log that are asked, spread over its time."""


@torch.no_grad()
def plain_factors(looks: Iterable[tuple[Gaussians, Sequence[Camera]]], settings: SplatSettings) -> Float[Tensor, "..."]:
    """Return by what each row's opacity is multiplied for viewers that do not antialias; 1 for a row nobody sees.

    Args:
        looks: the same rows where they are at some time, meters in the world, and the cameras of then.
        settings: those that the scene was trained with. Without antialias the one factor of all rows is 1.
    """
    if not settings.antialias:
        return torch.ones(())
    total = count = torch.zeros(())
    for gaussians, cameras in looks:
        for camera in cameras:
            rows = visible_rows(gaussians, camera, settings)
            ratios = on_screen(gaussians, rows, camera, settings).ratios
            assert ratios is not None  # with antialias
            own = torch.zeros_like(gaussians.opacities)
            seen = own.index_fill(0, rows, 1.0)
            own[rows] = ratios.clamp(min=COMPENSATION_FLOOR**2).sqrt()
            total, count = total + own, count + seen
    return torch.where(count > 0, total / count.clamp(min=1), 1.0)


def spread_cameras(views: Sequence[View]) -> list[Camera]:
    """Return cameras of some views, spread over all of them."""
    return [views[place].camera for place in spread(len(views), MAX_CAMERAS)]
