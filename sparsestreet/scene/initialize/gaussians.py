"""Makes a table of Gaussians from colored points."""

import math
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.geometry.quaternions import normalized
from sparsestreet.scene.gaussians import Rows

SH_CONSTANT = 0.5 / math.sqrt(math.pi)
"""Value of the spherical harmonic of degree 0."""

MINIMUM_SCALE = 1e-3
"""Meters; coincident points have distance 0, but a scale needs a logarithm."""

DARKEST = 1 / 510
"""Half a gray level. The op cuts colors off at 0, where they have no gradient: a black one would stay black."""

FLAT = 0.01
"""Meters, largest start of a scale across a surface. From 3 mm to 30 mm nothing changes (docs/moved_views.md)."""


def neighbor_scales(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Returns the mean distance to the three nearest other points (or fewer if there are fewer), at least 1 mm.

    A point without any neighbor gets 1 mm.

    >>> neighbor_scales(torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])).tolist()
    [2.0, 2.0]
    """
    num_points = points.shape[0]
    neighbors = min(3, num_points - 1)
    if neighbors < 1:
        return torch.full((num_points,), MINIMUM_SCALE)
    # The nearest is the point itself or a coincident one. Both have distance 0, so the first can be dropped.
    positions = points.double().numpy()
    places = np.arange(2, neighbors + 2)
    distances, _ = KDTree(positions).query(positions, k=places)  # pyright: ignore[reportArgumentType]
    return torch.from_numpy(distances.mean(1)).float().clamp(min=MINIMUM_SCALE)


def init_gaussians(
    points: Float[Tensor, "n 3"],
    colors: Float[Tensor, "n 3"],
    scales: Float[Tensor, " n"],
    *,
    opacities: Float[Tensor, " n"],
    sh_degree: int,
    generator: torch.Generator,
    columns: Mapping[str, Tensor] | None = None,
    mask_columns: Mapping[str, Tensor] | None = None,
    buffers: Mapping[str, Tensor] | None = None,
) -> Rows:
    """Returns isotropic Gaussians with random rotations (as in 3DGS), one per point; RGB in [0, 1], scales in meters.

    ``columns`` are further parameters of a node, ``mask_columns`` those that a mask learns, ``buffers`` further data of
    each row. Raises ValueError if an opacity is outside (0, 1) or the degree outside 0 to 3.

    >>> points, start = torch.rand(5, 3), {"opacities": torch.full((5,), 0.1), "sh_degree": 1}
    >>> rows = init_gaussians(points, points, torch.ones(5), generator=torch.Generator(), **start)
    >>> rows.sh_rest.shape
    torch.Size([5, 3, 3])
    """
    if not bool(((opacities > 0) & (opacities < 1)).all()):
        raise ValueError(
            f"initial opacities must lie between 0 and 1, got {float(opacities.min())} to {float(opacities.max())}"
        )
    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"spherical harmonics are known up to degree 3, got sh_degree={sh_degree}")
    num_rows = points.shape[0]
    parameters = {
        "means": points.float(),
        "log_scales": scales.float().log()[:, None].expand(-1, 3),
        "quaternions": normalized(torch.randn(num_rows, 4, generator=generator)),
        "opacity_logits": torch.logit(opacities.float()),
        "sh_dc": ((colors.float().clamp(min=DARKEST) - 0.5) / SH_CONSTANT)[:, None, :],
        "sh_rest": torch.zeros(num_rows, (sh_degree + 1) ** 2 - 1, 3),
    }
    masks = dict(mask_columns or {})
    return Rows(parameters | dict(columns or {}) | masks, buffers, transient=masks.keys())


@torch.no_grad()
def lie_flat(rows: Rows, normals: Float[Tensor, "n 3"]) -> None:
    """Turns the third axis of each Gaussian into its normal and makes it thin there; NaN: it stays as it is.

    The rotation is the shortest one from (0, 0, 1), so normals point up: z must not be negative.
    """
    known = normals.isfinite().all(1)
    x, y, z = normals[known].unbind(1)
    # Twice the half angle's cosine and sine along (0, 0, 1) x normal, both times the cosine.
    rows.quaternions[known] = normalized(torch.stack((1 + z, -y, x, torch.zeros_like(z)), 1))
    rows.log_scales[known, 2] = rows.log_scales[known, 2].clamp(max=math.log(FLAT))
