"""Turns of ellipsoids as three small numbers.

An ellipsoid is the same after half a turn about an axis, and after its axes are named in another order. Of the 24
rotations that this leaves, the nearest to none is stored, as its Rodrigues vector: axis times tan(angle / 2). Its parts
are at most tan(22.5 degrees) = 0.414: 4.6 bits less than for a rotation of anything, and no index of a largest part.
"""

import itertools

import numpy as np
from jaxtyping import Float64, Int64

_BLOCK = 8192
"""Rows whose 24 rotations are in memory at the same time."""


def _cube_rotations() -> Float64[np.ndarray, "24 4"]:
    """Returns the rotations of a cube as unit quaternions, wxyz, one of each pair q and -q."""
    found = []
    for numbers in itertools.product((-1, 0, 1), repeat=4):
        length = sum(abs(number) for number in numbers)
        if length in (1, 2, 4) and next(number for number in numbers if number) > 0:
            found.append(np.array(numbers) / np.sqrt(length))
    return np.array(found)


def _axis_orders(quaternions: Float64[np.ndarray, "24 4"]) -> Int64[np.ndarray, "24 3"]:
    """Returns, for each rotation of a cube, which old axis each new axis lies along."""
    w, x, y, z = quaternions.T
    rows = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.abs(rows).argmax(0).T


_CUBE = _cube_rotations()
_ORDERS = _axis_orders(_CUBE)


def nearest_turn(
    quaternions: Float64[np.ndarray, "n 4"],
) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "n 3"]]:
    """Returns Rodrigues vectors, and for each row the order of axes that its scales must be put in.

    Quaternions are wxyz, of any length; one of no length turns nothing.

    >>> half = np.sqrt(0.5)  # a quarter turn about z exchanges x and y
    >>> vector, order = nearest_turn(np.array([[half, 0, 0, half]]))
    >>> np.abs(vector).max().round(9).tolist(), order.tolist()
    (0.0, [[1, 0, 2]])
    """
    vectors, orders = np.empty((len(quaternions), 3)), np.empty((len(quaternions), 3), np.int64)
    for start in range(0, len(quaternions), _BLOCK):
        block = slice(start, start + _BLOCK)
        turned = _products(quaternions[block])
        best = np.abs(turned[:, :, 0]).argmax(1)
        chosen = turned[np.arange(len(turned)), best]
        none = chosen[:, :1] == 0  # of a quaternion of no length
        vectors[block] = chosen[:, 1:] / np.where(none, 1, chosen[:, :1])
        orders[block] = _ORDERS[best]
    return vectors, orders


def quaternions_of(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 4"]:
    """Returns unit quaternions, wxyz.

    >>> quaternions_of(np.zeros((1, 3))).tolist()
    [[1.0, 0.0, 0.0, 0.0]]
    """
    full = np.concatenate([np.ones((len(vectors), 1)), vectors], axis=1)
    return full / np.linalg.norm(full, axis=1, keepdims=True)


def _products(quaternions: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 24 4"]:
    """Returns each quaternion times each rotation of the cube."""
    aw, ax, ay, az = (part[:, None] for part in quaternions.T)
    bw, bx, by, bz = _CUBE.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )
