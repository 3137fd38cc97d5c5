"""Unit quaternions, wxyz, Hamilton product. All conversions between forms of rotations are here."""

import torch
from jaxtyping import Float
from torch import Tensor


def normalized(quaternions: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternions; an exact zero becomes the identity and gets no gradient.

    Gradients grow as 1 / length. Below the length tiny / eps of the dtype (1e-31 in float32) they grow no further, so
    that they remain finite.

    >>> normalized(torch.tensor([[0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])).tolist()
    [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]
    """
    shortest = torch.finfo(quaternions.dtype).tiny / torch.finfo(quaternions.dtype).eps
    values = quaternions.detach()
    # Divided by the largest component first: the squared length leaves the dtype's range long before the length does.
    largest = values.abs().amax(-1, keepdim=True)
    usable = largest > 0
    scaled = values / torch.where(usable, largest, 1.0) + (quaternions - values) / largest.clamp(min=shortest)
    identity = torch.zeros_like(values)
    identity[..., 0] = 1
    safe = torch.where(usable, scaled, identity)
    return safe / safe.norm(dim=-1, keepdim=True)


def multiply(a: Float[Tensor, "*b 4"], b: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """The rotation b followed by the rotation a: to_matrix(multiply(a, b)) = to_matrix(a) @ to_matrix(b).

    >>> i, j = torch.tensor([0.0, 1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0, 0.0])
    >>> multiply(i, j).tolist()  # k
    [0.0, 0.0, 0.0, 1.0]
    """
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def to_matrix(quaternions: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of quaternions of any length; a zero quaternion gives the identity.

    >>> to_matrix(torch.tensor([0.0, 0.0, 0.0, 5.0])).tolist()  # half a turn about z
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = normalized(quaternions).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def from_matrix(rotations: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternions with w >= 0 of rotation matrices, by the largest squared component (Shepperd's method).

    >>> from_matrix(torch.diag(torch.tensor([-1.0, -1.0, 1.0]))).tolist()  # half a turn about z
    [0.0, 0.0, 0.0, 1.0]
    """
    m = rotations
    diagonal = torch.diagonal(m, dim1=-2, dim2=-1)
    xx, yy, zz = diagonal.unbind(-1)
    squares = torch.stack((1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz), dim=-1)
    xw, yw, zw = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    # Row i holds 4 q_i q_j. Each row divided by its norm is the quaternion; that of the largest q_i is the most exact.
    outer = torch.stack(
        (
            torch.stack((squares[..., 0], xw, yw, zw), -1),
            torch.stack((xw, squares[..., 1], xy, xz), -1),
            torch.stack((yw, xy, squares[..., 2], yz), -1),
            torch.stack((zw, xz, yz, squares[..., 3]), -1),
        ),
        dim=-2,
    )
    largest = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = normalized(outer.gather(-2, largest).squeeze(-2))
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def from_rotation_vector(vectors: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """Exponential map: a rotation by |v| radians about v; smooth at zero.

    >>> from_rotation_vector(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, torch.pi / 3]]))
    tensor([[1.0000, 0.0000, 0.0000, 0.0000],
            [0.8660, 0.0000, 0.0000, 0.5000]])
    """
    half = 0.5 * vectors
    squared = half.square().sum(-1, keepdim=True)
    # Near zero sinc(|half|) is its Taylor series, because the gradient of the norm is undefined at zero.
    small = squared < 1e-6
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    sinc = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    cosine = torch.where(small, 1 - squared / 2 + squared.square() / 24, torch.cos(angle))
    return torch.cat((cosine, sinc * half), dim=-1)


def to_rotation_vector(quaternions: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3"]:
    """Logarithm: the axis times the angle, radians, of the shorter turn (at most pi); undoes ``from_rotation_vector``.

    >>> to_rotation_vector(torch.tensor([0.0, 0.0, 0.0, -2.0])).tolist()  # half a turn about -z
    [0.0, 0.0, -3.1415927410125732]
    """
    unit = normalized(quaternions)
    unit = torch.where(unit[..., :1] < 0, -unit, unit)
    sine = unit[..., 1:].norm(dim=-1, keepdim=True)
    # Near zero the angle over its sine is 2, to the square of 1e-8.
    small = sine < 1e-8
    safe = torch.where(small, torch.ones_like(sine), sine)
    return unit[..., 1:] * torch.where(small, 2.0, 2 * torch.atan2(sine, unit[..., :1]) / safe)


def slerp(a: Float[Tensor, "*b 4"], b: Float[Tensor, "*b 4"], fraction: Float[Tensor, "*b"]) -> Float[Tensor, "*b 4"]:
    """The rotation at ``fraction`` of the shorter arc from a to b (q and -q are the same rotation).

    >>> a, b = torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 0.0, 1.0])
    >>> slerp(a, b, torch.tensor(1 / 3))  # a third of half a turn about z
    tensor([0.8660, 0.0000, 0.0000, 0.5000])
    """
    a, b = normalized(a), normalized(b)
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot = dot.abs().clamp(max=1.0)
    fraction = fraction[..., None]
    near = dot > 0.9995  # below 1.8 degrees a normalized lerp differs from slerp by less than 1e-6
    theta = torch.acos(torch.where(near, torch.zeros_like(dot), dot))
    sine = torch.sin(theta)
    weight_a = torch.where(near, 1 - fraction, torch.sin((1 - fraction) * theta) / sine)
    weight_b = torch.where(near, fraction, torch.sin(fraction * theta) / sine)
    return normalized(weight_a * a + weight_b * b)
