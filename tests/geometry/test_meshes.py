"""Meshes by hand, and their files read back by programs that are not ours."""

import io
import re

import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from sparsestreet.geometry.meshes import Mesh, box_corners, grid_mesh, hull, obj_text, ply_bytes
from tests.typed import there

TURN = Rotation.from_euler("zyx", [0.7, -0.3, 1.1]).as_matrix()
POSE = np.block([[TURN, np.array([[40.0], [-3.0], [9.0]])], [np.zeros((1, 3)), np.ones((1, 1))]])


def signed_volume(mesh: Mesh) -> float:
    """By the divergence theorem: positive if all triangles are counterclockwise from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def test_the_hull_of_a_turned_box_is_the_box():
    low, high = np.array([-2.0, -1.0, 0.5]), np.array([3.0, 1.0, 2.0])
    inside = np.random.default_rng(0).uniform(low + 0.1, high - 0.1, (200, 3))
    points = np.concatenate([inside, box_corners(low, high)]) @ TURN.T
    found = there(hull(points))
    assert len(found.vertices) == 8
    assert len(found.faces) == 12
    assert signed_volume(found) == pytest.approx(5 * 2 * 1.5, rel=1e-12)
    a, b, c = (found.vertices[found.faces[:, corner]] for corner in range(3))
    outward = (np.cross(b - a, c - a) * (a - points.mean(0))).sum(1)
    assert (outward > 0).all()
    assert hull(points[:3]) is None
    assert hull(np.random.default_rng(1).uniform(size=(50, 3)) * [1.0, 1.0, 0.0]) is None


def test_a_grid_has_no_square_with_a_node_that_is_not_known():
    heights = np.arange(20.0).reshape(4, 5) ** 2 / 100
    heights[0, 0] = heights[3, 2] = np.nan
    mesh, used = grid_mesh(np.array([7.0, -4.0]), 0.5, heights)
    assert len(mesh.faces) == 2 * (12 - 1 - 2)
    rows, columns = np.unravel_index(used, heights.shape)
    np.testing.assert_array_equal(mesh.vertices[:, 0], 7 + 0.5 * rows)
    np.testing.assert_array_equal(mesh.vertices[:, 1], -4 + 0.5 * columns)
    np.testing.assert_array_equal(mesh.vertices[:, 2], heights[rows, columns])
    assert np.isfinite(mesh.vertices).all()
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    up = np.cross(b - a, c - a)[:, 2]
    np.testing.assert_allclose(up, 0.25)  # twice the area from above, counterclockwise
    assert len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) == len(mesh.faces)


def test_a_ply_is_one_of_triangles_for_every_reader():
    mesh, _ = grid_mesh(np.array([1.0, 2.0]), 0.25, np.random.default_rng(0).uniform(size=(4, 3)))
    data = ply_bytes(mesh.moved(POSE))
    said = PlyData.read(io.BytesIO(data))
    assert [(one.name, len(one)) for one in said.elements] == [("vertex", 12), ("face", 12)]
    np.testing.assert_array_equal(np.stack(list(said["face"]["vertex_indices"])), mesh.faces)
    assert data.partition(b"end_header\n")[2][12 * 12 :: 13] == bytes([3]) * 12
    read = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
    homogeneous = np.column_stack([mesh.vertices, np.ones(12)])
    np.testing.assert_allclose(read.vertices, (homogeneous @ POSE.T)[:, :3], atol=4e-6)  # float32 at 40 m


def test_an_obj_has_an_object_for_each_mesh():
    flat, _ = grid_mesh(np.zeros(2), 1.0, np.zeros((3, 3)))
    box = there(hull(box_corners(np.array([5.0, 6, 7]), np.array([6.0, 8, 10]))))
    text = obj_text({"the ground": flat, "car": box})
    assert re.findall("^o (.*)$", text, flags=re.M) == ["the_ground", "car"]
    whole = trimesh.load_mesh(io.StringIO(text), file_type="obj", process=False)
    parts = [trimesh.Trimesh(whole.vertices, rows) for rows in (whole.faces[:8], whole.faces[8:])]
    assert (parts[0].area, parts[1].volume) == pytest.approx((4.0, 6.0))
    with pytest.raises(ValueError, match="two meshes are named 'a_b'"):
        obj_text({"a b": flat, "a\tb": box})
