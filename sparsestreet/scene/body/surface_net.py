"""A closed triangle mesh around the region where a function is negative."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64, Int64

Field = Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, " n"]]

_STEP = 1e-4
"""Step of the finite differences of the field, meters."""


def surface_net(
    field: Field, low: tuple[float, float, float], high: tuple[float, float, float], spacing: float
) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "t 3"]]:
    """Returns vertices on the zeros of a signed distance, and triangles, counterclockwise from the positive side.

    Surface nets (Gibson, MICCAI 1998) put one vertex in each grid cell that the surface passes through. The four cells
    around each edge that it crosses make a quadrilateral. The field must be positive on the faces of the box.

    >>> ball = lambda points: np.linalg.norm(points, axis=1) - 1.0
    >>> vertices, faces = surface_net(ball, (-1.5, -1.5, -1.5), (1.5, 1.5, 1.5), spacing=0.5)
    >>> bool(np.abs(ball(vertices)).max() < 1e-3), len(faces) == 2 * len(vertices) - 4
    (True, True)
    """
    lows, highs = np.array(low), np.array(high)
    # Odd, so that nodes lie in the middle plane: then a symmetric body has a symmetric mesh and a gap between its legs.
    counts = 2 * np.ceil((highs - lows) / (2 * spacing)).astype(int) + 1
    start = (lows + highs) / 2 - spacing * (counts - 1) / 2
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1)
    values = field((start + spacing * nodes).reshape(-1, 3)).reshape(tuple(counts))
    edges, cells, outwards = _crossings(values)
    number, quads = np.unique(cells, return_inverse=True)
    quads = quads.reshape(cells.shape)
    # A vertex starts at the mean of the crossings around its cell and is then moved to the surface.
    sums = np.zeros((len(number), 4))
    np.add.at(sums, quads, np.append(edges, np.ones((len(edges), 1)), 1)[:, None])
    vertices = start + spacing * sums[:, :3] / sums[:, 3:]
    for _ in range(3):
        vertices = _projected(field, vertices)
    quads = np.where(outwards[:, None], quads, quads[:, ::-1])
    return vertices, np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))


def _crossings(
    values: Float64[np.ndarray, "x y z"],
) -> tuple[Float64[np.ndarray, "e 3"], Int64[np.ndarray, "e 4"], np.ndarray]:
    """Returns points of sign changes along edges, in units of the grid; the four cells around; whether values grow."""
    strides = np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
    places, cells, grows = [], [], []
    for axis in range(3):
        behind, ahead = np.delete(values, -1, axis), np.delete(values, 0, axis)
        lower = np.argwhere((behind < 0) != (ahead < 0))
        before, after = behind[tuple(lower.T)], ahead[tuple(lower.T)]
        place = lower.astype(float)
        place[:, axis] += before / (before - after)
        second, third = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        # In right-handed order around the axis; each cell is named after its lowest corner.
        around = np.array([-second - third, -third, 0, -second])
        places.append(place)
        cells.append((lower @ strides)[:, None] + around)
        grows.append(before < 0)
    return np.concatenate(places), np.concatenate(cells), np.concatenate(grows)


def _projected(field: Field, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Returns the points after one step of Newton's method along the gradient."""
    value = field(points)
    slope = np.stack([(field(points + step) - value) / _STEP for step in _STEP * np.eye(3)], 1)
    return points - value[:, None] * slope / (slope * slope).sum(1, keepdims=True)
