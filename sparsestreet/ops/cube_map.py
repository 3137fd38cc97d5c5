"""A cube map: a color for every direction, interpolated bilinearly, also across the edges of faces."""

from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

# Rows of each face: outward axis, direction of increasing column, direction of increasing row.
# Faces +x, -x, +y, -y, +z, -z. The orientation of a face on its square is our own choice; nobody else reads it.
_FACES = torch.tensor(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
        [[0, 0, -1], [1, 0, 0], [0, 1, 0]],
    ],
    dtype=torch.float64,
)


def colors_along(texels: Float[Tensor, "6 r r 3"], directions: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
    """Colors along directions of any non-zero length; gradients go to the texels only."""
    corners, weights = _corners(directions.detach().to(texels.dtype), texels.shape[1])
    # Of the ways to read rows, gather has the fastest backward pass on the CPU.
    index = corners.reshape(-1, 1).expand(-1, 3)
    values = texels.reshape(-1, 3).gather(0, index).reshape(-1, 4, 3)
    return (values * weights[..., None]).sum(1)


@cache
def bordered_texels(side: int, device: torch.device) -> Int[Tensor, " n"]:
    """Flat texel index for every entry of the faces with a border of one texel, flattened [6, side + 2, side + 2].

    A border entry is the texel of the neighboring face in its direction. Bilinear interpolation then mixes the same two
    texels on both sides of an edge, so the sky has no seams. Where three faces meet, all of them take the x face's
    texel
    for their corner entry. So there are no seams at the corners of the cube either.
    """
    centers = (torch.arange(-1, side + 1, dtype=torch.float64) + 0.5) * (2 / side) - 1
    row, column = torch.meshgrid(centers, centers, indexing="ij")
    on_face = torch.stack((torch.ones_like(row), column, row), dim=-1)
    # The sign is a corner of the cube. There all three axes are equal, and the first is taken as the largest.
    at_corner = (row.abs() > 1) & (column.abs() > 1)
    on_face = torch.where(at_corner[..., None], on_face.sign(), on_face)
    directions = torch.einsum("rca,fab->frcb", on_face, _FACES)
    face, column, row = _face_coordinates(directions.reshape(-1, 3), side)
    column, row = (texel.round().long().clamp(0, side - 1) for texel in (column, row))
    return ((face * side + row) * side + column).to(device)


def _corners(directions: Float[Tensor, "p 3"], side: int) -> tuple[Int[Tensor, "p 4"], Float[Tensor, "p 4"]]:
    """Flat indices of the four texels around each direction, and their bilinear weights."""
    face, column, row = _face_coordinates(directions, side)
    left, top = column.floor(), row.floor()
    right_share, bottom_share = column - left, row - top
    # The border is one texel wide, so texel 0 of a face is entry 1 of the bordered table.
    stride = side + 2
    first = (face * stride + (top.long() + 1)) * stride + (left.long() + 1)
    around = torch.stack((first, first + 1, first + stride, first + stride + 1), dim=1)
    left_share, top_share = 1 - right_share, 1 - bottom_share
    weights = (left_share * top_share, right_share * top_share, left_share * bottom_share)
    return bordered_texels(side, directions.device)[around], torch.stack((*weights, right_share * bottom_share), dim=1)


def _face_coordinates(
    directions: Float[Tensor, "p 3"], side: int
) -> tuple[Int[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, " p"]]:
    """Face, column and row of each direction, in texels with centers at whole numbers: [-0.5, side - 0.5]."""
    largest = directions.abs().argmax(1, keepdim=True)
    component = directions.gather(1, largest)
    on_cube = directions / component.abs()
    face = 2 * largest.squeeze(1) + (component.squeeze(1) < 0)
    # Column axis: y on the x faces, else x. Row axis: y on the z faces, else z.
    across = torch.where(largest == 0, on_cube[:, 1:2], on_cube[:, 0:1]).squeeze(1)
    down = torch.where(largest == 2, on_cube[:, 1:2], on_cube[:, 2:3]).squeeze(1)
    return face, (across + 1) * (0.5 * side) - 0.5, (down + 1) * (0.5 * side) - 0.5
