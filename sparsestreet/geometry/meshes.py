"""Meshes of triangles: of a grid of heights, of the hull of points; as .ply and .obj."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial import ConvexHull, QhullError

_PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])


@dataclass(frozen=True)
class Mesh:
    """Triangles on numbered vertices."""

    vertices: Float64[np.ndarray, "v 3"]
    """Meters."""
    faces: Int64[np.ndarray, "t 3"]
    """Rows of the vertices of each triangle, counterclockwise from outside or above."""

    def moved(self, world_from_mesh: Float64[np.ndarray, "4 4"]) -> "Mesh":
        """Return the mesh in another frame, by a rigid motion."""
        return Mesh(self.vertices @ world_from_mesh[:3, :3].T + world_from_mesh[:3, 3], self.faces)


def grid_mesh(
    corner: Float64[np.ndarray, "2"], spacing: float, heights: Float64[np.ndarray, "x y"]
) -> tuple[Mesh, Int64[np.ndarray, " v"]]:
    """Return two triangles for each square of a grid whose four nodes have a height, seen from above.

    Args:
        corner: x and y of the first node, meters.
        spacing: meters between neighbors.
        heights: z of the nodes, meters; NaN: none.

    Returns:
        The mesh without nodes that no square has, and the place of each vertex in the flattened grid.

    >>> mesh, _ = grid_mesh(np.zeros(2), 1.0, np.array([[0.0, 1.0], [2.0, 3.0], [4.0, np.nan]]))
    >>> mesh.vertices.tolist(), mesh.faces.tolist()
    ([[0.0, 0.0, 0.0], [0.0, 1.0, 1.0], [1.0, 0.0, 2.0], [1.0, 1.0, 3.0]], [[0, 2, 3], [0, 3, 1]])
    """
    places = np.arange(heights.size).reshape(heights.shape)
    four = np.stack([places[:-1, :-1], places[1:, :-1], places[1:, 1:], places[:-1, 1:]], -1).reshape(-1, 4)
    four = four[np.isfinite(heights.ravel()[four]).all(1)]
    corners = np.concatenate([four[:, [0, 1, 2]], four[:, [0, 2, 3]]], 1).reshape(-1, 3)
    used, faces = np.unique(corners, return_inverse=True)
    nodes = np.stack(np.unravel_index(used, heights.shape), 1)
    vertices = np.column_stack([corner + spacing * nodes, heights.ravel()[used]])
    return Mesh(vertices, faces.reshape(-1, 3)), used


def hull(points: Float[np.ndarray, "n 3"]) -> Mesh | None:
    """Return the convex hull of points; None of fewer than four, and of points in a plane.

    >>> len(hull(np.concatenate([np.zeros((1, 3)), np.eye(3)])).faces), hull(np.eye(3))
    (4, None)
    """
    if len(points) < 4:
        return None
    try:
        found = ConvexHull(points)
    except QhullError:
        return None
    used, faces = np.unique(found.simplices, return_inverse=True)
    vertices, faces = points[used].astype(np.float64), faces.reshape(-1, 3)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    inward = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(1) < 0
    faces[inward] = faces[inward, ::-1]
    return Mesh(vertices, faces)


def box_corners(low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "8 3"]:
    """Return the corners of a box with such ends.

    >>> box_corners(np.zeros(3), np.ones(3)).sum(0)
    array([4., 4., 4.])
    """
    return np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(8, 3)


def ply_bytes(mesh: Mesh) -> bytes:
    """Return a mesh as a .ply: binary, little endian, float32, three corners a face, as AlpaSim reads it.

    >>> ply_bytes(Mesh(np.eye(3), np.array([[0, 1, 2]])))[-12:]  # the corners of the face
    b'\\x00\\x00\\x00\\x00\\x01\\x00\\x00\\x00\\x02\\x00\\x00\\x00'
    """
    faces = np.empty(len(mesh.faces), _PLY_FACE)
    faces["count"], faces["corners"] = 3, mesh.faces
    header = (
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(mesh.vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    )
    return ("\n".join(header) + "\n").encode("ascii") + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()


def obj_text(meshes: Mapping[str, Mesh]) -> str:
    """Return meshes as one .obj that has an object for each; white space in a name becomes ``_``.

    Raises ValueError for two names that are then one.

    >>> flat = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    >>> print(obj_text({"the ground": flat, "car": flat}).replace(chr(10), "; "))  # doctest: +ELLIPSIS
    o the_ground; v 1.0000 0.0000 0.0000; ...; f 1 2 3; o car; ...; v 0.0000 0.0000 1.0000; f 4 5 6;...
    """
    lines, count, taken = [], 0, set()
    for name, mesh in meshes.items():
        word = "_".join(name.split())
        if word in taken:
            raise ValueError(f"two meshes are named {word!r} in an .obj: rename one")
        taken.add(word)
        lines.append(f"o {word}")
        lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1 + count]
        count += len(mesh.vertices)
    return "\n".join([*lines, ""])
