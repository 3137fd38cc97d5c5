"""Rigid transforms as 4x4 matrices named a_from_b."""

import torch
from jaxtyping import Float
from torch import Tensor


def transform_points(a_from_b: Float[Tensor, "4 4"], points_in_b: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points of frame b in frame a.

    >>> a_from_b = torch.eye(4)
    >>> a_from_b[0, 3] = 2.0
    >>> transform_points(a_from_b, torch.tensor([[1.0, 0.0, 0.0]])).tolist()
    [[3.0, 0.0, 0.0]]
    """
    return points_in_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def inverse(a_from_b: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The transform b_from_a of a rigid a_from_b, without a linear solve.

    >>> a_from_b = torch.eye(4)
    >>> a_from_b[:3, 3] = torch.tensor([2.0, 3.0, 1.0])
    >>> inverse(a_from_b)[:3, 3].tolist()
    [-2.0, -3.0, -1.0]
    """
    transposed = a_from_b[..., :3, :3].mT
    b_from_a = torch.zeros_like(a_from_b)
    b_from_a[..., :3, :3] = transposed
    b_from_a[..., :3, 3] = -(transposed @ a_from_b[..., :3, 3:]).squeeze(-1)
    b_from_a[..., 3, 3] = 1
    return b_from_a


def rigidity_error(a_from_b: Float[Tensor, "4 4"]) -> float:
    """The largest absolute entry of R^T R - I and of the last row less (0, 0, 0, 1); at least 1 for a reflection.

    >>> rigidity_error(torch.diag(torch.tensor([2.0, 1.0, 1.0, 1.0])))
    3.0
    """
    rotation = a_from_b[:3, :3]
    identity = torch.eye(3, dtype=a_from_b.dtype)
    last = a_from_b[3] - torch.tensor([0, 0, 0, 1], dtype=a_from_b.dtype)
    error = max(float((rotation.T @ rotation - identity).abs().max()), float(last.abs().max()))
    return max(error, 1.0) if torch.linalg.det(rotation) < 0 else error
